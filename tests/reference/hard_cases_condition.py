"""How much the truth of a hard case moves when its inputs move: the condition of the case.

Every input number is moved in turn by the same small fraction of itself. Inputs named in `spans`
are positions on one line and enter by their differences, which floating point forms without error
of its own: there the spans between neighbours are moved instead, and positions that coincide stay
together. Angles named in `angles` enter by directions, whose entries are of size 1: what is less
than 1 rad is moved as if it were 1 rad. What a value or a derivative moves, added over all inputs,
per unit of that fraction, is its spread. Differences of the independent models in high precision.
"""

import mpmath as mp
import numpy as np

STEP = mp.mpf(10) ** -35
ONE = mp.mpf(1)


def moved(inputs, name, index, step):
    """`inputs` with one number of one input moved."""

    def place(value, index):
        if not index:
            return value + step
        return [place(v, index[1:]) if i == index[0] else v for i, v in enumerate(value)]

    return inputs | {name: place(inputs[name], index)}


def flat(value):
    return [q for v in value for q in flat(v)] if isinstance(value, list) else [value]


def spread(model, case, inputs, base):
    """{"value": {output: size}, "gradient": {output: {input: size}}}, largest entry or each.

    Sizes are numbers, of the entry that moves most, or lists over all entries, flat, where the case
    is seen entry by entry.
    """

    def at(given):
        return {o: np.array(flat(v)) for o, v in model(given).items()}

    here = {o: np.array(flat(v)) for o, v in base.items()}
    ways = list(_directions(case, inputs))
    ahead = [at(way(inputs)) for way in ways]
    value = {o: sum(abs((p[o] - v) / STEP) for p in ahead) + 0 * v for o, v in here.items()}
    gradient = {o: {} for o in base}
    for name, given in case.inputs.items():
        if name in case.constant or name in case.free:
            continue
        columns = {o: [] for o in base}
        for index in np.ndindex(np.shape(given)):
            column = _column(at, case, inputs, (name, index), here, ways, ahead)
            for o, moves in column.items():
                columns[o].append(moves)
        for o in base:
            if f"{o} by {name}" not in case.free:
                gradient[o][name] = _size(case, np.array(columns[o]).T)
    return {"value": {o: _size(case, v) for o, v in value.items()}, "gradient": gradient}


def _size(case, entries):
    entries = [float(f"{float(v):.3g}") for v in np.ravel(entries)]
    return entries if case.entrywise else max(entries)


def _column(at, case, inputs, place, here, ways, ahead):
    """Spread of the derivatives by one number, of all outputs."""
    name, index = place
    x = np.asarray(case.inputs[name], float)[index]
    if np.isinf(x):
        return {o: 0 * v for o, v in here.items()}
    h = STEP * (abs(mp.mpf(float(x))) if x != 0 else ONE) * case.one_sided.get(name, 1)
    turned = at(moved(inputs, name, index, h))
    total = {o: 0 * v for o, v in here.items()}
    for way, near in zip(ways, ahead, strict=True):
        both = at(moved(way(inputs), name, index, h))
        for o in total:
            total[o] = total[o] + abs((both[o] - near[o] - turned[o] + here[o]) / (h * STEP))
    return total


def _directions(case, inputs):
    """Functions that move `inputs` by STEP of one number, or of one span."""
    for name, value in case.inputs.items():
        if name in case.spans:
            continue
        for index in np.ndindex(np.shape(value)):
            x = max(abs(float(np.asarray(value, float)[index])), 1.0 * (name in case.angles))
            if x != 0 and np.isfinite(x):
                h = STEP * mp.mpf(x) * case.one_sided.get(name, 1)
                yield lambda v, at=(name, index, h): moved(v, *at)
    places = [(n, i) for n in case.spans for i in np.ndindex(np.shape(case.inputs[n]))]
    where = {p: mp.mpf(float(np.asarray(case.inputs[p[0]], float)[p[1]])) for p in places}
    low = mp.mpf(0)
    for high in sorted(set(where.values()) - {low}):
        beyond = [(n, i, STEP * (high - low)) for (n, i), x in where.items() if x >= high]

        def stretch(v, beyond=beyond):
            for at in beyond:
                v = moved(v, *at)
            return v

        yield stretch
        low = high
