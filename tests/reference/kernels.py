"""How many kernels a compiled program starts, counted in XLA's text of it.

A kernel is an instruction that runs by itself: on a CPU each takes some time to start, whatever it
computes. Those in a loop count once for each of its rounds.
"""

import re

#: The opcode of an instruction, behind its name and its type.
OPCODE = r"\s*(?:ROOT )?%?\S+ = (?:\(.*?\)|\S+) ([\w\-]+)\("
#: Instructions that start no kernel.
FREE = "parameter constant tuple get-tuple-element bitcast while call conditional".split()
#: What runs inside an instruction: for each opcode, where its computations are named.
INNER = {
    "while": r"(?:body|condition)=%?([\w.\-]+)",
    "call": r"to_apply=%?([\w.\-]+)",
    "conditional": r"(?:true|false)_computation=%?([\w.\-]+)|branch_computations=\{([^}]*)\}",
}

#: What marks the call that is one kernel.
ONE = 'xla_cpu_small_call="true"'

#: Opcode and line of every instruction, by the name of the computation.
Bodies = dict[str, list[tuple[str, str]]]


def count_kernels(text: str | None, *, inside: bool = True) -> tuple[int, int]:
    """Kernels that one call of a compiled program starts, and the loops in it.

    Of branches the longest counts.

    Args:
        text: `as_text()` of the compiled program.
        inside: what would be a kernel in a part that is compiled as one (`fusion.fuse`)
            counts: a measure of the work, since it takes about as long. Else that part counts once.

    Raises:
        ValueError: a loop has no fixed number of rounds, so that none is known before it runs (a
            Newton solve that stops where it has converged), or it is no text of a compiled program.
    """
    return _count(*computations(text or ""), inside)


def computations(text: str) -> tuple[str, Bodies]:
    """Name of the computation that runs first, and the instructions of all.

    Raises:
        ValueError: no computation is marked as the first.
    """
    bodies, entry = {}, None
    for block in text.split("\n\n"):
        lines = block.strip().split("\n")
        head = re.match(r"(ENTRY )?%?([\w.\-]+) .*\{$", lines[0])
        if head:
            found = [re.match(OPCODE, line) for line in lines]
            bodies[head[2]] = [(m[1], v) for m, v in zip(found, lines, strict=True) if m]
            entry = head[2] if head[1] else entry
    if entry is None:
        raise ValueError("the text has no ENTRY; expected that of a compiled program")
    return entry, bodies


def _count(name: str, bodies: Bodies, inside: bool) -> tuple[int, int]:
    count, loops = 0, 0
    for opcode, line in bodies[name]:
        if opcode == "call" and ONE in line and not inside:
            count += 1
            continue
        inner = [_count(v, bodies, inside) for v in _inner(opcode, line)]
        loops += (opcode == "while") + sum(n for _, n in inner)
        kernels = [n for n, _ in inner]
        if opcode == "while":
            count += _rounds(line) * sum(kernels)
        else:
            count += max(kernels, default=0)
        count += opcode not in FREE
    return count, loops


def _inner(opcode: str, line: str) -> list[str]:
    """Names of the computations that an instruction runs."""
    found = re.findall(INNER[opcode], line) if opcode in INNER else []
    names = [v for group in found for v in ([group] if isinstance(group, str) else group) if v]
    return [v.strip().lstrip("%") for name in names for v in name.split(",")]


def _rounds(line: str) -> int:
    known = re.search(r'known_trip_count":\{"n":"(\d+)"', line)
    if known is None:
        raise ValueError("the program has loops without a fixed number of rounds")
    return int(known[1])
