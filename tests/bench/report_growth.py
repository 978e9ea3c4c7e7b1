"""Sections of the page of benchmarks: growth with size, derivatives, start of the commands."""

import statistics

import numpy as np
from page import microseconds, number, quoted, ratio, table, verdict

#: Most that a value with its derivatives may cost, in values.
DERIVATIVES = 4


def slopes(sizes, times) -> tuple[float, float]:
    """Exponent of the time: least squares over the upper half of the sizes; of the last step."""
    x, y = np.log(sizes), np.log(times)
    half = len(x) // 2
    return float(np.polyfit(x[half:], y[half:], 1)[0]), float((y[-1] - y[-2]) / (x[-1] - x[-2]))


def by_size(rows: list[dict], head: str, unit: str = "µs") -> str:
    """Least time by size (rows) and case (columns), and two lines of exponents."""
    rows = [r for r in rows if r["kind"] == "row"]
    cases = list(dict.fromkeys(r["case"] for r in rows))
    scale = {"µs": 1, "ns": 1e3}[unit]
    at = {(r["case"], r["size"]): scale * microseconds(r)[1] for r in rows}

    def shown(case, size):
        return number(at[case, size]) if (case, size) in at else "-"

    lines = [[f"{n:,}", *(shown(c, n) for c in cases)] for n in sorted({r["size"] for r in rows})]
    found = []
    for case in cases:
        sizes = sorted(n for c, n in at if c == case)
        found.append(slopes(sizes, [at[case, n] for n in sizes]))
    lines += [
        ["exponent, upper half of the sizes", *(f"{a:.2f}" for a, _ in found)],
        ["exponent, last step", *(f"{b:.2f}" for _, b in found)],
    ]
    return table([head, *(f"{c}, {unit}" for c in cases)], lines)


def growth_section(rows: list[dict], goals: list[list[str]]) -> str:
    """Tables of growth.jsonl; the goal of the rings goes to `goals`."""

    def of(name):
        return [r for r in rows if r["table"] == name]

    rings = [r for r in of("rings") if r["kind"] == "row"]
    best = {(r["case"], r["size"]): microseconds(r)[1] for r in rings}
    cases = list(dict.fromkeys(r["case"] for r in rings))
    for c in (c for c in cases if "lane of" not in c):
        growth = best[c, 500] / best[c, 100] / 5
        name = f"500 rings against 5 times 100 rings, {c}"
        goals.append([name, "linear: about 1", number(growth), verdict(growth < 1.3)])
    built = {(r["case"], r["size"]): r["compile"] for r in rings}
    first, last = min(r["size"] for r in rings), max(r["size"] for r in rings)
    compiled = "; ".join(
        f"{c} {number(built[c, first])} and {number(built[c, last])} s"
        for c in cases
        if (c, last) in built
    )
    parts = ["## Growth\n", GROWTH, by_size(of("rings"), "rings")]
    parts.append(f"Compile time with {first} and with {last:,} rings: {compiled}.\n")
    parts += [POSITIONS, by_size(of("positions"), "contact positions")]
    parts += [PATCHES, by_size(of("patches"), "patches"), by_size(of("path"), "poses of one path")]
    parts += ["## Vertices\n", VERTICES, vertices(of("vertices"))]
    parts += ["## Lanes\n", by_size(of("lanes"), "lanes"), falling(of("lanes"))]
    parts += [f"{r['text']}.\n" for r in rows if r["kind"] == "note"]
    return "\n".join(parts)


def vertices(rows: list[dict]) -> str:
    """Time, time per vertex and least traffic of the surface, beside a copy."""
    lines = []
    for dtype in ("float32", "float64"):
        pairs = {}
        for r in rows:
            if r["case"].endswith(dtype):
                pairs.setdefault(r["size"], []).append(r)
        for n, (surface, copy) in pairs.items():
            us, rest = microseconds(surface)[1], microseconds(copy)[1]

            def rate(t, b=surface["bytes"]):
                return number(1e-3 * b / t)

            line = [dtype, f"{n:,}", number(us), number(1e3 * us / n)]
            lines.append([*line, number(surface["bytes"] / n), rate(us), rate(rest)])
        sizes = list(pairs)
        a, b = slopes(sizes, [microseconds(pairs[n][0])[1] for n in sizes])
        lines.append([dtype, f"exponent {a:.2f}, last step {b:.2f}", *["" for _ in range(5)]])
    head = ["", "vertices", "µs", "ns per vertex", "bytes per vertex", "GB/s", "copy GB/s"]
    return table(head, lines)


def falling(rows: list[dict]) -> str:
    """From how many lanes on the time per lane is within a tenth of the least."""
    words = []
    rows = [r for r in rows if r["kind"] == "row"]
    for case in dict.fromkeys(r["case"] for r in rows):
        own = {r["size"]: microseconds(r)[1] for r in rows if r["case"] == case}
        least = min(own.values())
        size = min(n for n, t in own.items() if t <= 1.1 * least)
        words.append(f"{case}: {size:,} lanes, {number(least)} µs at the least")
    return f"Time per lane is within 10 % of its least from here on: {'; '.join(words)}.\n"


def gradient_section(rows: list[dict], goals: list[list[str]]) -> str:
    """Tables of gradient.jsonl; every reverse gradient and the Jacobian of the fit have a goal."""
    groups: dict[tuple, list[dict]] = {}
    for r in rows:
        groups.setdefault((r["table"], r.get("walls"), r.get("dtype"), r["lanes"]), []).append(r)
    lines = []
    for (what, walls, dtype, lanes), (value, *others) in groups.items():
        name = NAMES[what] if walls is None else f"{NAMES[what]}, {walls}, {dtype}"
        name = name if lanes == 1 else f"{name}, {lanes} lanes"
        by = {r["case"]: r for r in (value, *others)}
        lines.append([name, value["case"], *map(number, microseconds(value)), "1"])
        for r in others:
            lines.append([name, r["case"], *map(number, microseconds(r)), quoted(r, value)])
            if r["case"].startswith(WITH_GOAL):
                own = value["case"]
                if r["case"].startswith(DERIVED):
                    own = r["case"].replace(DERIVED, "value")
                both = [v <= DERIVATIVES for v in ratio(r, by[own])]
                met = verdict(all(both)) if all(both) or not any(both) else "unclear"
                goal = f"at most {DERIVATIVES} times"
                words = f"{r['case']} against {own}: {name}"
                goals.append([words, goal, quoted(r, by[own]), met])
    head = ["", "case", "median µs", "min", "against the first"]
    return "\n".join(["## Derivatives\n", GRADIENT, table(head, lines)])


def commands_section(rows: list[dict]) -> str:
    """Cold and warm start of the command line, in seconds."""
    timed = [r for r in rows if r["table"] == "commands"]
    lines = [
        [r["case"], number(statistics.median(r["samples"])), number(min(r["samples"]))]
        for r in timed
    ]
    found = "; ".join(
        f"`{r['case']}` keeps {r['kept']}, of which a warm start finds {r['hits']} of {r['asked']}"
        for r in rows
        if r["table"] == "cache"
    )
    after = f"{COMMANDS}{found}.\n"
    return "\n".join([table(["command", "median s", "min s"], lines), after])


def against_section(environment: dict, rows: list[dict], goals: list[list[str]]) -> str:
    """Whole commands beside those of an earlier commit."""
    lines = []
    earlier = {r["case"]: r for r in rows if r["table"] == "earlier"}
    for now in (r for r in rows if r["table"] == "now"):
        was = earlier[now["case"]]
        by = {}
        for what, key in (("wall", "samples"), ("processor", "processor")):
            a, b = (statistics.median(r[key]) for r in (was, now))
            by[what] = b / a
            lines.append([now["case"] if what == "wall" else "", what,
                          number(a), number(b), f"{b / a:.2f}"])  # fmt: skip
        for case, what, least in AGAINST_GOALS:
            if case == now["case"]:
                words = f"{case}: {what} time against {environment['earlier']}"
                goals.append([words, f"at most {least:.2g} of it", f"{by[what]:.2f}",
                              verdict(by[what] <= least)])  # fmt: skip
    head = ["command", "time", f"{environment['earlier']}, s", "now, s", "now / then"]
    return "\n".join([AGAINST.format(**environment), table(head, lines)])


NAMES = {
    "pipeline": "whole update",
    "fit": "fit",
    "curve": "press curve of 50 displacements, 5 arguments",
}
DERIVED = "value and gradient (reverse)"
WITH_GOAL = (
    DERIVED, "value and gradient", "residual and Jacobian", "one Levenberg-Marquardt step",
)  # fmt: skip
#: Command, kind of time, and most of the earlier one: of 135 s of a cohort 45, of 350 s of a
#: selfcheck 120.
AGAINST_GOALS = (
    ("jaxtrachea fit, cold", "wall", 0.6),
    ("jaxtrachea fit, 10,000 specimens", "wall", 45 / 135),
    ("jaxtrachea selfcheck, cold", "processor", 120 / 350),
)
AGAINST = """\
`python tests/bench/against.py FOLDER`: commands of a checkout of {earlier}, from before these
benchmarks had goals, and of today in turns, on the same specification and measurements; fit and
simulate three times, the others once. The model of the fit is that of {earlier} (no width of the
punch). Today's fit also follows up what is in doubt (other minima, profiles); its programs of few
lanes are compiled without optimisation (`measured.md`). Each selfcheck runs the table of its
commit.
"""
GROWTH = """\
Time against size, and its exponent: least squares of log time against log size over the upper half
of the sizes, and that of the last step alone. Every size is compiled for itself. Times are the
least of 5 to 25 samples: the others are disturbed by what else the machine does.

Rings: contact at 52 % of the length; lanes: 256 together (or 32), time per lane. From 500 rings on
256 lanes are slower per lane than 32, so it is the size of the intermediate arrays that costs (each
1 to 2 MiB at 500 rings); whether by leaving the cache or by fresh memory at every call is open.
"""
POSITIONS = """\
Contact positions of one sweep over the tube of Table 1; `sweep` goes through them 256 at a time.
"""
PATCHES = """\
Patches of the tube that a ball may touch (the broad phase bounds all of them, two are searched);
and poses of one path of the tool on 16 patches.
"""
VERTICES = """\
Skeleton, global shape and a dent of 16 centres under a given press. Bytes: what must at least be
read (s, phi, fraction and place of each vertex, its rest position) and written (its position); GB/s
is this over the time, beside a copy (`v + 1`) of as many bytes. Far below the copy, this least
traffic is not the limit; intermediate arrays are not counted and may be.
"""
GRADIENT = """\
Whole update: as below, dent of 16, out comes force + mean square of the vertices' motion; gradient
by EI_L, k_M, k_1, k_3 and the tool's place (7 numbers), forward mode along the first or all four of
the material. Fit: residual of 4 positions × 50 points, its Jacobian by four parameters,
and a whole step (residual, Jacobian, normal equations, one more residual for the curvature, the
trust region). Times are per lane. In brackets: ratio of the smallest samples.

When these times were taken small parts of a program, and their derivatives, were one kernel each
for one pose on a CPU, and surfaces of many poses were taken one after the other. `jax.lax.map` over
the function that gives value and gradient (one at a time) does so with everything. A step of the
fit has a second residual in it, for the curvature.
"""
COMMANDS = """\
Whole processes. Cold: the folder of compiled programs is empty; warm: as the cold start left it.
`fit` is that of the README, `simulate` that of `configs/normal.toml`. That a warm start compiles
nothing is asserted. Programs: """
