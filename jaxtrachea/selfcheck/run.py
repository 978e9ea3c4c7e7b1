"""Run the table: every case alone and between healthy neighbours, value and both Jacobians.

Two programs for each function and dtype serve all of its rows, one for a press by itself and one
for a batch; they are compiled beside each other, which takes nearly all of the time.
"""

import functools
import itertools
import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np

from jaxtrachea._compiler import quick_options
from jaxtrachea._threads import usable_cores
from jaxtrachea.selfcheck.assess import Outcome, assess, rank
from jaxtrachea.selfcheck.functions import FUNCTIONS
from jaxtrachea.selfcheck.table import Case, Truth


def _lane(call, constant, v, tangent, cotangent):
    """Values, status, one column of the Jacobian (forward) and one row of it (reverse)."""
    fixed = {n: v[n] for n in constant}
    moving = {n: w for n, w in v.items() if n not in constant}
    values, push, status = jax.linearize(lambda m: call(fixed | m), moving, has_aux=True)
    return values, status, push(tangent), jax.linear_transpose(push, moving)(cotangent)[0]


def _alone(call, constant, v, cotangent):
    """The same without the forward derivative: what one gradient of one press compiles to."""
    fixed = {n: v[n] for n in constant}
    moving = {n: w for n, w in v.items() if n not in constant}
    values, pull, status = jax.vjp(lambda m: call(fixed | m), moving, has_aux=True)
    return values, status, pull(cotangent)[0]


class _Programs:
    """What serves all rows of one function in one dtype.

    A batch holds a healthy neighbour, one lane for each column (row) of the Jacobian, and another
    neighbour.
    """

    def __init__(self, case: Case, dtype: str, *, unoptimised: bool = False):
        """Compile for the shapes of `case`."""
        call, self.dtype, self.constant = FUNCTIONS[case.function], dtype, case.constant
        healthy = self.arrays(case.healthy)
        out = jax.eval_shape(call, healthy)[0]
        moving = {n: np.shape(v) for n, v in case.healthy.items() if n not in case.constant}
        self.inputs, self.outputs = moving, {n: v.shape for n, v in out.items()}
        self.lanes = max(_size(self.inputs), _size(self.outputs))
        basis = [_basis(shapes, self.lanes, dtype) for shapes in (self.inputs, self.outputs)]
        self.directions = basis
        self.healthy = healthy
        one, many = (functools.partial(f, call, case.constant) for f in (_alone, _lane))
        first = {n: v[0] for n, v in basis[1].items()}
        options = quick_options() if unoptimised else None
        self.one = jax.jit(one).lower(healthy, first).compile(options)
        self.many = jax.jit(jax.vmap(many)).lower(self.batch(healthy), *basis).compile(options)

    def arrays(self, inputs: dict) -> dict[str, np.ndarray]:
        """Inputs of a row as arrays of the dtype."""
        return {n: np.asarray(v, self.dtype) for n, v in inputs.items()}

    def batch(self, row):
        """`row` in every lane but the first and last."""
        lanes = [self.healthy, *[row] * self.lanes, self.healthy]
        return {n: np.stack([lane[n] for lane in lanes]) for n in row}

    def between(self, row):
        """All lanes of a batch with `row` between healthy neighbours."""
        return jax.device_get(self.many(self.batch(row), *self.directions))

    def by_itself(self, row):
        """Values, status and the reverse Jacobian of one row, without neighbours."""
        rows = []
        for i in range(_size(self.outputs)):
            cotangent = {n: v[i + 1] for n, v in self.directions[1].items()}
            values, status, pulled = jax.device_get(self.one(row, cotangent))
            rows.append(pulled)
        reverse = {n: np.stack([r[n] for r in rows]) for n in self.inputs}
        return values, status, self.by_rows(reverse)

    def by_columns(self, columns):
        """Forward columns, (lane, *output), as {output: {input: (*output, *input)}}."""
        return {
            o: {
                i: np.moveaxis(v[at], 0, -1).reshape((*self.outputs[o], *shape))
                for i, (at, shape) in _places(self.inputs).items()
            }
            for o, v in columns.items()
        }

    def by_rows(self, rows):
        """Reverse rows, (lane, *input), in the same form."""
        return {
            o: {i: v[at].reshape((*shape, *self.inputs[i])) for i, v in rows.items()}
            for o, (at, shape) in _places(self.outputs).items()
        }


def _size(shapes) -> int:
    return sum(math.prod(shape) for shape in shapes.values())


def _places(shapes):
    """Where each name's numbers lie among all: {name: (slice, shape)}."""
    ends = list(itertools.accumulate(math.prod(s) for s in shapes.values()))
    starts = [0, *ends]
    return {
        n: (slice(a, b), shape)
        for (n, shape), a, b in zip(shapes.items(), starts, ends, strict=False)
    }


def _basis(shapes, lanes: int, dtype: str):
    """Unit directions, one to a lane, zeros for the neighbours and what is left."""
    made = {}
    for name, (at, shape) in _places(shapes).items():
        flat = np.zeros((lanes + 2, math.prod(shape)), dtype)
        flat[1 + at.start : 1 + at.stop] = np.eye(math.prod(shape))
        made[name] = flat.reshape((lanes + 2, *shape))
    return made


def run_table(
    cases: list[Case], truths: dict[str, Truth], dtypes, *, unoptimised: bool = False
) -> Iterator[Outcome]:
    """Run all cases; outcomes come in the order of the table, function by function."""
    groups: dict[tuple[str, str], list[Case]] = {}
    for case in cases:
        for dtype in dtypes:
            if dtype in case.dtypes:
                groups.setdefault((case.function, dtype), []).append(case)
    with ThreadPoolExecutor(usable_cores()) as pool:
        made = {
            key: pool.submit(_Programs, rows[0], key[1], unoptimised=unoptimised)
            for key, rows in groups.items()
        }
        for key, rows in groups.items():
            programs = made.pop(key).result()
            untouched = programs.between(programs.healthy)
            for case in rows:
                yield _run_case(case, truths.get(case.name), programs, untouched)


def _run_case(case: Case, truth: Truth | None, programs: _Programs, untouched) -> Outcome:
    row = programs.arrays(case.inputs)
    mixed = programs.between(row)
    faults = [] if _neighbours_agree(mixed, untouched) else ["it changed its neighbours"]
    if case.answer and truth is None:
        faults.append("no truth; run tests/reference/hard_cases_truth.py")
    values, status, columns, rows = jax.tree.map(lambda v: v[1:-1], mixed)
    values, status = jax.tree.map(lambda v: v[0], (values, status))
    jacobians = programs.by_columns(columns), programs.by_rows(rows)
    value, status_alone, reverse = programs.by_itself(row)
    found_in = functools.partial(assess, case, truth, faults)
    found = [found_in(values, status, jacobians), found_in(value, status_alone, (reverse,))]
    value_gaps, gradient_gaps, nans = zip(*found, strict=True)
    return Outcome(
        case.name,
        programs.dtype,
        max(value_gaps, key=rank),
        max(gradient_gaps, key=rank),
        max(nans),
        tuple(dict.fromkeys(faults)),
        case.tolerance[programs.dtype],
    )


def _neighbours_agree(mixed, untouched) -> bool:
    """Bit for bit, the rows on both sides."""
    same = jax.tree.map(
        lambda p, q: (
            np.array_equal(p[0], q[0], equal_nan=True)
            and np.array_equal(p[-1], q[-1], equal_nan=True)
        ),
        mixed,
        untouched,
    )
    return all(jax.tree.leaves(same))
