"""The sections of docs/evidence/benchmarks.md on other programs, from peers and identification."""

import statistics

from page import microseconds, number, table

OURS = "jaxtrachea"


def ratios(ours: list[dict], peer: list[dict]) -> list[float]:
    """Time of the peer over ours, per problem, of each turn.

    Raises:
        KeyError: the peer has a turn that we have not.
    """
    per = {r["turn"]: r["median"] / r["lanes"] for r in ours}
    return [r["median"] / r["lanes"] / per[r["turn"]] for r in peer]


def version(environment: dict, package: str) -> str:
    """Name and version; of C that of its compiler."""
    if package == "cc":
        return f"cc {environment['compiler'].split()[-1]}"
    return f"{package} {environment['versions'][package]}"


def peers_section(environment: dict, rows: list[dict]) -> str:
    """How it was measured, one line per group and peer, and what could not be measured."""
    timed = [r for r in rows if r["kind"] == "row"]
    notes = [f"{r['text']}\n" for r in rows if r["kind"] == "note"]
    cases: dict[tuple[str, str], list[dict]] = {}
    for r in timed:
        cases.setdefault((r["group"], r["case"]), []).append(r)

    def typical(rs):
        return number(1e6 * statistics.median(r["median"] / r["lanes"] for r in rs))

    lines = []
    for (group, case), peer in cases.items():
        if case == OURS:
            continue
        ours = cases[group, OURS]
        found = ratios(ours, peer)
        span = f"{number(statistics.median(found))} ({number(min(found))} to {number(max(found))})"
        told = [version(environment, peer[0]["package"]), f"{peer[0]['error']:.1e}"]
        lines.append([group, case, *told, typical(ours), typical(peer), span])
    loads = [r["load"] for r in timed]
    measured = (
        f"{1 + max(r['turn'] for r in timed)} turns; load of the machine, ours included, "
        f"{number(min(loads))} to {number(max(loads))}.\n"
    )
    head = ["group", "peer", "version", "differs by", "ours µs", "peer µs", "peer / ours"]
    return "\n".join([PEERS + measured, table(head, lines), *notes])


def identification_section(environment: dict, rows: list[dict]) -> str:
    """Presses and fits by MuJoCo beside ours: processor time, ratio to ours."""
    lines = []
    for what in ("press", "fit"):
        here = {r["case"]: r for r in rows if r["table"] == what}
        ours, *_ = microseconds(here[OURS])
        for case, r in here.items():
            spent, *_ = microseconds(r)
            told = [number(spent / 1e3), number(spent / ours)]
            told.append("-" if case == OURS else f"{r['differs']:.1e}")
            lines.append([what, case, *told])
    head = ["", "program", "processor ms", "over ours", "differs by"]
    where = (
        f"Measured {environment['date']} at commit {environment['commit']} on one core of a "
        f"{environment['cores_of_machine']}-core {environment['cpu']}, MuJoCo "
        f"{environment['versions']['mujoco']}.\n"
    )
    return "\n".join(["### Identification by MuJoCo\n", IDENTIFICATION, where, table(head, lines)])


PEERS = """\
`python tests/bench/peers.py`, by pytest-benchmark in one run: the cases of a group one after the
other, and this in turns. The last column is the median over the turns of the peer's median time
over ours in the same turn (smallest to largest turn): **above 1 we are faster**. Times are per
call, lane or fit. Problem, inputs, outputs and float64 are the same, and results are asserted to
agree before each timing. What is compiled, loaded or kept is not timed.

Not everything is equal. Ours is compiled for this one problem; it takes and gives JAX arrays, and
turning them from and into numpy arrays is not timed. PyNite is a general program for frames in
space, six degrees of freedom per node, in Python. scikit-fem is a general finite-element library,
to which we add the springs. They, OpenSees and the numpy rows (which keep the mesh) assemble and
solve the whole problem each time, also in *beam kept*, where the peers keep their model and ours
has rings and stiffness as constants of the program. The C loops are our own, written for the
problem. coal is called from Python for each of 16 capsules and gives no derivatives; ours searches
two of 16 patches and smooths the gap to be differentiable. Ours fits 500 specimens in one batch,
the solvers 10 one after the other; estimates differ by that part of a standard error.

"""
IDENTIFICATION = """\
`python tests/bench/identification.py`: EI_L, k_M, k_1, k_3 of one specimen from ten positions × 50
points with 0.5 % noise, start (10, 0.1, 1, 0.01), and these ten curves pressed once. MuJoCo 4 has
no beam on springs; it is made of its joints, tendons (with a cubic spring for the local law) and a
servo, and is exact for forces at nodes. Its steps of 1 s with the integrator `discrete` are Newton
steps to rest, eight at each depth. `mujoco.batch` presses the ten positions together;
`mujoco.sysid.optimize` differentiates by differences, by its own solver or SciPy's. Ours fits
500 specimens in one batch, with standard errors; the others two, one after the other. A press
differs relative to the largest force (the servo, 1e4 N/mm, is in series with MuJoCo's contact), an
estimate in standard errors. Other work kept the machine busy (load 4 to 5), and MuJoCo's fits were
timed once: orders of magnitude, no more.

What MuJoCo does better: contact, friction, several bodies and motion in time come with the same
model, without a rule which of them are solved together; a run of one batch has the same bits at any
number of threads; a model is read from a file that other programs read; `sysid` takes any sensor
and any parameter that can be written into the model, fits several models at once, and writes a
report. Nothing is compiled: the first answer comes at once. What it lacks here: derivatives of a
press, statics (a step that does not come to rest gives a force, not a status), a noise of each
curve, and verdicts on what the curves do not tell.
"""
