"""The section of docs/evidence/benchmarks.md on other programs, from results/peers.jsonl."""

import statistics

from page import number, table

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
