"""How far a result is from the truth, and how far it may be."""

import dataclasses
import functools
import math
import operator
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxtrachea.selfcheck.table import Case, Tolerance, Truth


class Gap(NamedTuple):
    """The worst of some errors, in units of the dtype's epsilon.

    Attributes:
        over: error over the size of the truth and what the truth itself moves (its spread).
        error: the same error over the size alone.
        condition: size and spread over size: how much rounding the case itself magnifies.
        where: output, or output and input.
    """

    over: float = 0.0
    error: float = 0.0
    condition: float = 1.0
    where: str = ""

    def limit(self, roundings: float) -> float:
        """Largest error allowed, on the scale of `error`."""
        return roundings * self.condition

    @property
    def rank(self) -> float:
        """What the worst is chosen by: NaN above all."""
        return math.inf if math.isnan(self.over) else self.over


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What became of one case in one dtype.

    Attributes:
        case: name.
        dtype: name.
        value_gap: worst error of a value, in either run.
        gradient_gap: worst error of an entry of the Jacobian, forward or reverse.
        nans: numbers that are not finite where they must be.
        faults: what else is wrong, as sentences.
        tolerance: what was asked.
    """

    case: str
    dtype: str
    value_gap: Gap
    gradient_gap: Gap
    nans: int
    faults: tuple[str, ...]
    tolerance: Tolerance

    @property
    def value(self) -> float:
        """Error of the values over their tolerance."""
        return self.value_gap.over / self.tolerance.value

    @property
    def gradient(self) -> float:
        """Error of the derivatives over their tolerance."""
        return self.gradient_gap.over / self.tolerance.gradient

    @property
    def passed(self) -> bool:
        """Whether everything is as it should be (a NaN error is not)."""
        close = self.value <= 1 and self.gradient <= 1
        return close and self.nans == 0 and not self.faults


rank = operator.attrgetter("rank")


def assess(case: Case, truth: Truth | None, faults: list[str], values, status, jacobians):
    """(worst value, worst derivative, number of values that are not finite)."""
    if int(status) != case.code:
        faults.append(f"status {int(status)}, expected {case.code} ({case.status})")
    if not case.answer:
        if np.any(np.isfinite(values.get("force", next(iter(values.values()))))):
            faults.append("a number where the model has no answer")
        return Gap(), Gap(), 0
    nans = sum(int(np.sum(~np.isfinite(v))) for v in jax.tree.leaves((values, jacobians)))
    if truth is None:
        return Gap(math.nan), Gap(math.nan), nans
    gap = functools.partial(gap_of, case)
    value = (gap(o, values[o], truth.value[o], truth.spread[o]) for o in truth.value)
    gradient = (
        gap(f"{o} by {i}", jacobian[o][i], wanted, truth.gradient_spread[o][i], least)
        for o, by in truth.gradient.items()
        for i, wanted in by.items()
        for least in [_natural(case, truth, o, i)]
        for jacobian in jacobians
    )
    return max(value, key=rank), max(gradient, key=rank, default=Gap()), nans


def _natural(case: Case, truth: Truth, output: str, name: str):
    """Size of y/x for every number x of the input, or 0 where the case does not ask for it."""
    if name not in case.natural:
        return 0.0
    x, y = np.abs(case.inputs[name]), np.abs(truth.value[output])
    per_input = np.where((x > 0) & (x < np.inf), 1 / np.where(x > 0, x, 1), 0)
    return np.multiply.outer(y if case.entrywise else np.full_like(y, np.max(y)), per_input)


def gap_of(case: Case, name: str, got, wanted, spread, least: Any = 0.0) -> Gap:
    """Largest error over the largest truth and its spread (or each over its own).

    What is smaller than the dtype can hold to its precision counts as that small; a truth of 0 has
    the size of its spread; an error of exactly 0 is none whatever it is compared with.
    """
    kind = np.finfo(got.dtype)
    got, wanted = np.asarray(got, float), np.asarray(wanted, float)
    size = np.abs(wanted) if case.entrywise else np.full_like(wanted, np.max(np.abs(wanted)))
    size = np.maximum(size, np.maximum(least, case.scale.get(name, float(kind.tiny / kind.eps))))
    allowed = size + np.reshape(spread, wanted.shape if case.entrywise else ())
    size = size if np.any(wanted) else allowed
    error = np.abs(got - wanted)
    over = np.where(error == 0, 0, error / allowed)
    at = np.unravel_index(np.argmax(over), over.shape)
    condition = allowed[at] / size[at]
    relative = error[at] / size[at]
    return Gap(float(over[at] / kind.eps), float(relative / kind.eps), float(condition), name)
