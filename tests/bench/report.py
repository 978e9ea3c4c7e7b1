"""Write docs/evidence/benchmarks.md from the results. Run: python tests/bench/report.py."""

import statistics

from page import FOLDER, microseconds, number, quoted, ratio, read, table, verdict
from report_growth import against_section, commands_section, gradient_section, growth_section
from report_peers import identification_section, peers_section

SUITES = ("skeleton", "update", "fitting", "cohort", "joint", "startup", "peers", "growth",
          "gradient", "against")  # fmt: skip
OPENSEES = "w_C, reactions", "w_C, reactions, beam kept"
DOCUMENT = FOLDER.parents[1] / "docs" / "evidence" / "benchmarks.md"


def plain(rows: list[dict], *columns: str) -> list[list[str]]:
    """Lines of case, further columns, median and min."""

    def show(v):
        return "-" if v is None else v if isinstance(v, str) else f"{v:.1e}"

    return [
        [r["case"], *(show(r.get(c)) for c in columns), *map(number, microseconds(r))] for r in rows
    ]


def environment(of: dict[str, dict]) -> str:
    """Where and how, by suite."""
    environments = list(of.values())
    first = environments[0]
    assert all(e["cpu"] == first["cpu"] for e in environments)
    commits = commits_of({name: e.get("commit", "unknown") for name, e in of.items()})
    merged = {k: v for e in environments for k, v in e["versions"].items()}
    packages = ", ".join(f"{name} {version}" for name, version in merged.items())
    return (
        f"Measured {first['date']} at commit {commits} on one pinned core of a "
        f"{first['cores_of_machine']}-core {first['cpu']} (no GPU), shared with other work: **the "
        f"times are noisy, compare the ratios**, which come from samples taken in turn "
        f"(A B A B). {packages}; {first['compiler']}, `-O3 -march=native`. float64 everywhere.\n"
    )


def commits_of(suites: dict[str, str]) -> str:
    """Commits in words: that of most suites, and which suites are of another."""
    count = list(suites.values())
    most = max(count, key=count.count)
    names = {c: [n for n, v in suites.items() if v == c] for c in dict.fromkeys(count)}
    others = [f"{c} ({', '.join(n)})" for c, n in names.items() if c != most]
    return ", ".join([most, *others])


def skeleton_section(rows: list[dict], goals: list[list[str]]) -> str:
    """Tables of skeleton.jsonl; what it decides goes to `goals`."""

    def of(name):
        return [r for r in rows if r["table"] == name]

    single = [r for r in of("single") if r["kind"] == "row"]
    notes = [r["text"] for r in of("single") if r["kind"] == "note"]
    text = ["## One call\n", SINGLE]
    text.append(
        table(["case", "problem", "differs by", "median µs", "min µs"], plain(
            single, "problem", "error"
        ))
    )  # fmt: skip
    text += [f"{note}\n" for note in dict.fromkeys(notes)]
    for problem in ("mid-tube", "cantilever"):
        here = {r["case"]: r for r in single if r["problem"] == problem}
        rival = here.get("OpenSees: reset + analyze + reactions")
        for how in OPENSEES:
            ours = here.get(f"jaxtrachea: {how}")
            if rival is None or ours is None:
                continue
            word = verdict(ratio(ours, rival)[0] < 0.5)
            name = f"one call against OpenSees, {problem}: {how}"
            goals.append([name, "less than half its time", quoted(ours, rival), word])
    lanes = {r["case"]: r for r in of("lanes")}
    count = next(iter(lanes.values()))["lanes"]
    text += [f"## {count} lanes\n", LANES]
    head = ["case", "differs by", "median µs per lane", "min"]
    text.append(table(head, plain(list(lanes.values()), "error")))

    def ours(what):
        return lanes[f"jaxtrachea: {what}"]

    checks = [
        ("`contact_compliance` against the dense form", "at least 50 times as fast",
         lanes["dense: w_C"], ours("w_C"), lambda r: r >= 50),
        ("lane with reactions against scalar C", "at most 3 times its time",
         ours("all outputs"), lanes["C: all outputs"], lambda r: r <= 3),
        ("gradient (k, EI, s_c) against w_C alone", "at most 4 times",
         ours("w_C and gradient"), ours("w_C"), lambda r: r <= 4),
        ("gradient against scalar C adjoint", "-",
         ours("w_C and gradient"), lanes["C: w_C and gradient"], None),
    ]  # fmt: skip
    for name, goal, a, b, met in checks:
        word = "-" if met is None else verdict(met(ratio(a, b)[0]))
        goals.append([name, goal, quoted(a, b), word])
    return "\n".join(text)


def fitting_section(rows: list[dict], goals: list[list[str]]) -> str:
    """Table of fitting.jsonl."""
    lines = []
    for r in rows:
        median, least = microseconds(r)
        first = "-" if r["first_call"] is None else number(r["first_call"])
        misses = "-" if r["worst_excess"] is None else str(r["missed"])
        steps = f"{r['evaluations']:g} / {r['most_evaluations']}"
        line = [r["case"], number(1e6 / median), number(median), number(least), steps]
        lines.append([*line, misses, first])
    by = {r["case"]: r for r in rows}
    ours = by["jaxtrachea: fit with standard errors"]
    for case in (name for name in by if not name.startswith("jaxtrachea")):
        goal = "at least 25 times as fast" if case.startswith("scipy least_squares lm, n") else "-"
        value = ratio(by[case], ours)[0]
        word = verdict(value >= 25) if goal != "-" else "-"
        name = f"fits with standard errors, nothing profiled, against {case}"
        goals.append([name, goal, quoted(by[case], ours), word])
    head = ["solver", "fits/s", "median µs per fit", "min", "evaluations median / most"]
    return "\n".join([FITTING, table([*head, "missed", "first call s"], lines)])


def cohort_section(rows: list[dict], goals: list[list[str]]) -> str:
    """Tables of cohort.jsonl: fits a second, and the command from file to plots."""
    serial = [r for r in rows if r["table"] == "cohort"]
    lines = [[r["case"], number(1e6 / microseconds(r)[0]), *map(number, microseconds(r))]
             for r in serial]  # fmt: skip
    for r in (r for r in serial if not r["case"].startswith("jaxtrachea")):
        name = f"cohort fits with standard errors, nothing profiled, against {r['case']}"
        goals.append([name, "-", quoted(r, serial[0]), "-"])
    (told,) = (r for r in rows if r["table"] == "command")
    seconds = ", ".join(f"{name} {number(v)} s" for name, v in told["seconds"].items())
    after = (
        f"`jaxtrachea fit` on the same data, {told['case'].split(', ')[1]}: "
        f"{number(told['samples'][0])} s ({seconds}), peak memory {told['peak_MB']:,} MB, "
        f"{told['output_MB']} MB of results. "
        f"Peak of the process above: {serial[0]['peak_MB']:,} MB.\n"
    )
    head = ["solver", "fits/s", "median µs per fit", "min"]
    return "\n".join([COHORT, table(head, lines), after])


def joint_section(rows: list[dict]) -> str:
    """Table of joint.jsonl: processor time per specimen."""
    lines = [
        [f"{r['lanes']:,}", r["how"], number(1e3 * r["cpu"] / r["lanes"]),
         number(1e-3 * microseconds(r)[0]), str(r["iterations"]), f"{r['peak_MB']:,}"]
        for r in rows
    ]  # fmt: skip
    head = ["specimens", "", "processor ms per specimen", "median ms", "iterations", "peak MB"]
    return "\n".join([JOINT, table(head, lines)])


def startup_section(rows: list[dict]) -> str:
    """Table of startup.jsonl, in seconds."""
    lines = [
        [r["case"], number(statistics.median(r["samples"])), number(min(r["samples"]))]
        for r in rows
        if r["table"] == "startup"
    ]
    return table(["fresh process", "median s", "min s"], lines)


def update_section(rows: list[dict], goals: list[list[str]]) -> str:
    """Tables of update.jsonl: single calls, then many at once."""
    single = {r["case"]: r for r in rows if r["kind"] == "latency"}
    quantiles = ("p5", "median", "p99", "worst")
    lines = [
        [case, *(number(1e6 * r[q]) for q in quantiles), str(r["above_1_ms"])]
        for case, r in single.items()
    ]
    head = ["case", "5 % µs", "median µs", "99 % µs", "worst µs", "calls above 1 ms"]
    goals += update_goals(single, {r["case"]: r for r in rows if r.get("table") == "in turns"})
    many = [
        [r["case"], *map(number, microseconds(r)), f"{1e6 / microseconds(r)[0]:,.0f}"]
        for r in rows
        if r.get("table") == "lanes"
    ]
    head_many = ["poses together", "median µs per pose", "min", "poses/s"]
    return "\n".join([UPDATE, table(head, lines), table(head_many, many)])


def update_goals(single: dict[str, dict], turns: dict[str, dict]) -> list[list[str]]:
    """Whole updates against the C loop on the round tube, in turns; medians of contacts alone."""
    goals, loop = [], turns["C loop: whole, dent of 16; round tube; float64"]
    slow = single["C loop: contact, skeleton, surface; round tube; float64"]
    most = f"at most 2 times (the C loop's: {number(slow['p99'] / slow['median'])})"
    for walls in ("round tube", "patches of the mesh"):
        for dtype in ("float32", "float64"):
            whole = turns[f"whole, dent of 16; {walls}; {dtype}"]
            alone = single[f"contact, skeleton; {walls}; {dtype}"]
            name, speed = f"whole update, {walls}, {dtype}, against the C loop", ratio(loop, whole)
            met = verdict(speed[0] > 0.65)
            goals.append([name, "at least 0.65 of its speed", quoted(loop, whole), met])
            found = f"{number(1e6 * alone['median'])} µs", verdict(alone["median"] < 60e-6)
            goals.append([f"contact, skeleton, {walls}, {dtype}", "median below 60 µs", *found])
            spread = alone["p99"] / alone["median"]
            name = f"contact, skeleton, {walls}, {dtype}: 99 % against median"
            goals.append([name, most, number(spread), verdict(spread <= 2)])
    return goals


SINGLE = """\
15 rings 10 mm apart, k = 0.1 N/mm, EI = 1.86 N mm²; value and the reactions of all rings, every
result waited for. *mid-tube*: clamped at 0 and 160 mm, contact at 83 mm. *cantilever*: the test
problem of the package comparison, loaded at its free end, 155 mm. "Differs by": against ours,
relative to the largest entry, asserted below 1e-8 before anything is timed. OpenSees keeps its
model and repeats reset, analyze, reactions (BandSPD), as does our row "beam kept", whose rings and
stiffness are constants of the program. Our other rows read everything at every call. The numpy
rows write a banded stiffness matrix by slices, solve it and multiply out the reactions. A jitted
call that computes nothing shows how much of ours is JAX's own. All with
`jax.config.update("jax_cpu_enable_async_dispatch", False)`: by default jax hands programs that it
does not deem cheap to another thread, which costs 7 to 9 µs a call.
"""
LANES = """\
Every lane has its own 16 EI, 15 k, contact position and force; "all outputs" are deflection,
rotation and reaction at every ring, and motion, force and moment at C. The gradient is of w_C with
respect to k, EI and s_c (32 numbers), ours by reverse mode. C is a plain scalar loop with the same
inputs and outputs (`sweep.c`); its gradient uses that the beam is self-adjoint and needs no tape.
The dense form is the paper's force method (`form="reactions"`).
"""
UPDATE = """\
Pose of a ball of 5 mm in, force and all 3,430 vertices (6,856 triangles) out; 10,000 calls each, in
turns of 1,000. The tool touches the mesh itself (16 patches of up to 128 corners) or a round tube
(capsules). The C loop (`update.c`, `sweep.c`) has the round tube, the closed form of ball and
capsule, and the angular weights prepared; called through ctypes. coal is called once for each of 16
capsules. The paper states 10 kHz for the skeleton and 1 kHz with the surface (100 and 1,000 µs).

The contact alone was some 500 small kernels with a ball on the round tube and 800 with a box on
the mesh, most of them in a loop of twelve rounds. For one pose on a CPU it is one kernel now
(`jaxtrachea/fusion.py`, gains in [measured.md](measured.md)); when these times were taken skeleton
and parts of the surface were, too. 256 poses together share the small kernels.
Slow calls come to all rows, the C loop included: the core is shared, and its speed may change
between two blocks of calls. Goals against the C loop are of calls in turns.
"""
COHORT = """\
The same model, truths and start with five positions of 200 points: 10,000 specimens in one batch of
ours, 20 by each serial solver, in turn.
"""
JOINT = """\
EI_L and k_M shared by all specimens, k_1 and k_3 of each its own; four positions of 50 points, two
starts. *dense*: the study as one lane.
"""
FITTING = """\
Four parameters (EI_L, k_M, k_1, k_3) from 4 contact positions × 50 points, noise 0.5 % of the peak;
truths log-normal (20 %) around (100, 1, 1, 0.01), start (10, 0.1, 1, 0.01). Ours fits 2,000
specimens in one batch; optimistix 512 in chunks of 256; the serial solvers 60, one after the other.
Default tolerances of each, 1e-8 for optimistix
(ours, 1e-10, are the strictest). The numpy residual is as fast as we could write
it: compliance of the uniform beam from a spectrum prepared once, hyperbolic root of the cubic,
Jacobian by the implicit function rule, parts shared between value and Jacobian. "Missed": fits of
the first 60 whose cost is more than 1e-6 above the lowest any solver found. The first call contains
the compilation. What is in doubt: a fit unless told otherwise looks for other minima and profiles
unknowns whose local error says little (here of 88 % of the specimens); no other does.
"""


def document() -> str:
    """The whole page."""
    suites = {name: read(name) for name in SUITES}
    goals: list[list[str]] = []
    parts = [
        "## Peers\n",
        peers_section(*suites["peers"]),
        identification_section(*read("identification")),
        skeleton_section(suites["skeleton"][1], goals),
        growth_section(suites["growth"][1], goals),
        gradient_section(suites["gradient"][1], goals),
        "## Whole update\n",
        update_section(suites["update"][1], goals),
        "## Fits\n",
        fitting_section(suites["fitting"][1], goals),
        "## Cohort\n",
        cohort_section(suites["cohort"][1], goals),
        "## Joint fits\n",
        joint_section(suites["joint"][1]),
        "## Import and compilation\n",
        startup_section(suites["startup"][1]),
        commands_section(suites["startup"][1]),
        "### Against an earlier commit\n",
        against_section(*suites["against"], goals),
    ]
    intro = [
        "# Benchmarks\n",
        "*For developers: times against other programs, growth with size, cost of derivatives.*\n",
        "Generated by `tests/bench/report.py` from `tests/bench/results/*.jsonl`, which hold every "
        "sample (of the peers every turn); do not edit.\n",
        environment({name: environment for name, (environment, _) in suites.items()}),
        "Ratios are the median over pairs of neighbouring samples, in brackets that of the "
        "smallest samples.\n",
        "## Goals\n",
        table(["what", "goal", "ratio of times", ""], goals),
    ]
    return "\n".join(intro + parts)


if __name__ == "__main__":
    DOCUMENT.write_text(document())
