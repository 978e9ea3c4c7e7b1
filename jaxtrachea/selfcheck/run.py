"""Run the table: every case alone and between healthy neighbours, value and both Jacobians.

One program for each function and dtype serves all of its rows; a batch of three is a second one.
Programs are compiled beside each other.
"""

import dataclasses
import functools
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np

from jaxtrachea.selfcheck.functions import FUNCTIONS
from jaxtrachea.selfcheck.table import Case, Tolerance, Truth


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What became of one case in one dtype.

    Attributes:
        case: name.
        dtype: name.
        value: worst error of a value over its tolerance, in either run.
        gradient: worst error of an entry of the Jacobian, forward or reverse, over its tolerance.
        value_error: worst relative error of a value.
        gradient_error: worst relative error of a derivative.
        where: output and input of the worst derivative.
        nans: numbers that are not finite where they must be.
        faults: what else is wrong, as sentences.
        tolerance: what was asked.
    """

    case: str
    dtype: str
    value_error: float
    gradient_error: float
    where: str
    nans: int
    faults: tuple[str, ...]
    tolerance: Tolerance

    @property
    def value(self) -> float:
        """Error of the values over their tolerance."""
        return self.value_error / (self.tolerance.value * _eps(self.dtype))

    @property
    def gradient(self) -> float:
        """Error of the derivatives over their tolerance."""
        return self.gradient_error / (self.tolerance.gradient * _eps(self.dtype))

    @property
    def passed(self) -> bool:
        """Whether everything is as it should be (a NaN error is not)."""
        close = self.value <= 1 and self.gradient <= 1
        return close and self.nans == 0 and not self.faults


def _eps(dtype: str) -> float:
    return float(np.finfo(dtype).eps)


def program(function: str, constant: tuple[str, ...]) -> Callable:
    """Inputs to (values, status, forward Jacobian, reverse Jacobian)."""
    call = FUNCTIONS[function]

    def all_of(v):
        fixed = {n: v[n] for n in constant}
        moving = {n: w for n, w in v.items() if n not in constant}
        run = lambda moving: call(fixed | moving)  # noqa: E731
        values, status = run(moving)
        forward, _ = jax.jacfwd(run, has_aux=True)(moving)
        reverse, _ = jax.jacrev(run, has_aux=True)(moving)
        return values, status, forward, reverse

    return all_of


def arrays(inputs: dict, dtype: str) -> dict[str, jax.Array]:
    """Inputs of a row as arrays of one dtype."""
    return {n: jnp.asarray(v, dtype) for n, v in inputs.items()}


def _stacked(rows: list[dict], dtype: str):
    return {n: jnp.asarray(np.stack([np.asarray(r[n], float) for r in rows]), dtype) for n in rows[0]}


def run_table(cases: list[Case], truths: dict[str, Truth], dtypes) -> Iterator[Outcome]:
    """Run all cases; outcomes come in the order of the table, function by function.

    Args:
        cases: rows of the table.
        truths: by name.
        dtypes: some of `table.DTYPES`.
    """
    groups: dict[tuple[str, str], list[Case]] = {}
    for case in cases:
        for dtype in dtypes:
            if dtype in case.dtypes:
                groups.setdefault((case.function, dtype), []).append(case)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        made = {key: pool.submit(_compiled, rows[0], key[1]) for key, rows in groups.items()}
        for key, rows in groups.items():
            yield from _run_group(rows, truths, key[1], *made[key].result())


def _compiled(case: Case, dtype: str):
    """The program for one row, and for a batch of three."""
    run = program(case.function, case.constant)
    one, three = arrays(case.healthy, dtype), _stacked([case.healthy] * 3, dtype)
    return tuple(
        jax.jit(f).lower(given).compile() for f, given in ((run, one), (jax.vmap(run), three))
    )


def _run_group(rows: list[Case], truths, dtype: str, one, three) -> Iterator[Outcome]:
    healthy = rows[0].healthy
    untouched = jax.device_get(three(_stacked([healthy] * 3, dtype)))
    for case in rows:
        alone = jax.device_get(one(arrays(case.inputs, dtype)))
        mixed = jax.device_get(three(_stacked([healthy, case.inputs, healthy], dtype)))
        between = jax.tree.map(lambda v: v[1], mixed)
        faults = [] if _neighbours_agree(mixed, untouched) else ["it changed its neighbours"]
        truth = truths.get(case.name)
        if case.answer and truth is None:
            faults.append("no truth; run tests/reference/hard_cases_truth.py")
        found = [_judge(case, truth, answer, faults) for answer in (alone, between)]
        worst = max(found, key=lambda f: (f[2], np.nan_to_num(f[1][0], nan=np.inf)))
        value = max((f[0] for f in found), key=functools.partial(np.nan_to_num, nan=np.inf))
        gradient, where = worst[1]
        tolerance = case.tolerance[dtype]
        said = tuple(dict.fromkeys(faults))
        yield Outcome(case.name, dtype, value, gradient, where, worst[2], said, tolerance)


def _neighbours_agree(mixed, untouched) -> bool:
    """Bit for bit, the rows on both sides."""
    same = jax.tree.map(
        lambda p, q: np.array_equal(p[0], q[0], equal_nan=True)
        and np.array_equal(p[2], q[2], equal_nan=True),
        mixed,
        untouched,
    )
    return all(jax.tree.leaves(same))


def _judge(case: Case, truth: Truth | None, answer, faults: list[str]):
    """(value error, (gradient error, where), number of values that are not finite)."""
    values, status, forward, reverse = answer
    if int(status) != case.code:
        faults.append(f"status {int(status)}, expected {case.code} ({case.status})")
    if not case.answer:
        first = next(iter(values.values()))
        if np.any(np.isfinite(first)):
            faults.append("a number where the model has no answer")
        return 0.0, (0.0, ""), 0
    nans = sum(int(np.sum(~np.isfinite(v))) for v in jax.tree.leaves((values, forward, reverse)))
    if truth is None:
        return np.nan, (np.nan, ""), nans
    error = functools.partial(_error, case)
    value = max(error(o, values[o], wanted) for o, wanted in truth.value.items())
    worst = (0.0, "")
    for o, by in truth.gradient.items():
        for i, wanted in by.items():
            for got in (forward[o][i], reverse[o][i]):
                name = f"{o} by {i}"
                gap = error(name, got, wanted)
                if not gap <= worst[0]:
                    worst = gap, name
    return value, worst, nans


def _error(case: Case, name: str, got, wanted) -> float:
    """Largest error over the largest truth (or each over its own); exact zeros must be zeros."""
    got, wanted = np.asarray(got, float), np.asarray(wanted, float)
    size = np.abs(wanted) if case.entrywise else np.max(np.abs(wanted), initial=0)
    size = np.maximum(size, case.scale.get(name, np.finfo(float).tiny))
    gap = np.abs(got - wanted)
    return float(np.max(np.where(gap == 0, 0, gap / size), initial=0))
