"""What a program costs, for the choice by tolerance: seconds measured here, or operations."""

import math
from typing import Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxtrachea._arguments import check_word
from jaxtrachea.scene.simulation import simulate
from jaxtrachea.tradeoff.calls import Arguments, Call, last_row, one_pose, whole_path
from jaxtrachea.tradeoff.operations import count_operations

#: What is made least: time of the whole path in one call (`simulate`), of a pose a call
#: (`Session`), or operations, those in float32 counted half: the same on every machine.
Objective = Literal["path", "step", "operations"]
#: Those that are a time.
Time = Literal["path", "step"]
#: What an operation in float32 counts where operations are the cost.
HALF = 0.5
#: Share of the time below which it is not worth an error to save it.
MIN_SAVING = 0.02
#: A time in words.
WORDS: dict[Time, str] = {"path": "the whole path in one call", "step": "one pose a call"}


class Cost(NamedTuple):
    """Of the full program, and of another against it.

    Attributes:
        full: s (the median of turns), or operations.
        share: cost of the other over that of the full program; of times the median over turns of
            the ratio within a turn.
        low: lower end of the 95 % interval of that median; of operations the share itself.
        high: upper end.
    """

    full: float
    share: float
    low: float
    high: float

    @classmethod
    def exact(cls, full: float, own: float) -> "Cost":
        """Of two numbers that are known."""
        return cls(full, own / full, own / full, own / full)

    @classmethod
    def measured(
        cls, full: Float[np.ndarray, " turns"], own: Float[np.ndarray, " turns"]
    ) -> "Cost":
        """From seconds in the same turns, 6 at least (`calls.turn_medians`).

        The interval is that of the order statistics (no distribution assumed), for turns that do
        not depend on each other.
        """
        ratios = np.sort(own / full)
        n = len(ratios)
        below = max(round(n / 2 - 0.98 * math.sqrt(n)) - 1, 0)
        low, high = ratios[below], ratios[n - 1 - below]
        return cls(float(np.median(full)), float(np.median(ratios)), float(low), float(high))

    @property
    def saved(self) -> float:
        """Share of the full program's cost; 0 where noise may be all of it."""
        return 1 - self.share if self.high < 1 else 0.0


def operations(arguments: Arguments, *, step: bool = False) -> float:
    """Of `simulate` for scene, material and path; those in float32 counted half."""
    if step:
        scene, material, path = arguments
        arguments = scene, material, last_row(path)
    half = str(jax.tree.leaves(arguments[1])[0].dtype) == "float32"
    return float(count_operations(simulate, *arguments)) * (HALF if half else 1)


def compiled(by: Time, arguments: Arguments) -> Call:
    """The call whose time is the cost; compiles it.

    Raises:
        ValueError: another word.
    """
    check_word("by", by, Time)
    return {"path": whole_path, "step": one_pose}[by](arguments)


def describe(by: Objective, cost: Cost) -> str:
    """What the other program costs, in words.

    Raises:
        ValueError: another word.
    """
    check_word("by", by, Objective)
    share, low, high = (f"{100 * v:.0f}" for v in (cost.share, cost.low, cost.high))
    if by == "operations":
        return f"{share} % of its cost"
    full, own = (f"{1e3 * v:.2g} ms" for v in (cost.full, cost.full * cost.share))
    return (
        f"{share} % of its time ({low} to {high} %, measured here for {WORDS[by]}: {own} of {full})"
    )
