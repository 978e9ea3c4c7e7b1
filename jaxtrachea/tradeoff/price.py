"""What a program costs, for the choice by tolerance: seconds on this machine, or operations."""

from typing import Any, Literal, NamedTuple

import jax

from jaxtrachea._arguments import check_word
from jaxtrachea.scene.declare import AnyMaterial
from jaxtrachea.scene.operations import count_operations
from jaxtrachea.scene.simulation import simulate
from jaxtrachea.scene.stage import Poses, Presses, Scene
from jaxtrachea.tradeoff.kernels import count_kernels
from jaxtrachea.tradeoff.time_model import TimeModel, Uncalibrated, Work

#: What is made least: time of the whole path in one call (`simulate`), of a pose a call
#: (`Session`), or operations, those in float32 counted half: the same on every machine.
By = Literal["path", "step", "operations"]
#: Times predicted are no better than this share of the full program's.
GRAIN = 0.01


class Price(NamedTuple):
    """Which cost is made least.

    Attributes:
        by: see `By`.
        model: of this machine's time; None for operations.
    """

    by: By = "operations"
    model: TimeModel | None = None

    @property
    def timed(self) -> bool:
        """Whether it is a time, for which the kernels of a program must be known."""
        return self.model is not None

    def call(self, arguments: tuple[Scene, AnyMaterial, Poses | Presses]) -> tuple:
        """Scene, material and what of the path one call takes: all of it, or its last row."""
        return single(arguments) if self.by == "step" else arguments

    def of(self, arguments: tuple[Scene, AnyMaterial, Poses | Presses], kernels: int) -> float:
        """Cost of `simulate` for scene, material and path: s, or operations.

        Args:
            arguments: scene, material and path.
            kernels: that the compiled program of `call` starts; no matter for operations.
        """
        work = work_of(self.call(arguments), kernels)
        return work.operations if self.model is None else self.model.seconds(work)

    def saved(self, cost: float, full: float) -> float:
        """Share saved of the full program's cost; times in whole per cent."""
        share = 1 - cost / full
        return round(share / GRAIN) * GRAIN if self.timed else share

    def words(self, cost: tuple[float, float]) -> str:
        """Cost of the full program and of another, in words."""
        share = f"{100 * cost[1] / cost[0]:.0f} %"
        if self.model is None:
            return f"{share} of its cost"
        full, own = (f"{1e3 * v:.2g} ms" for v in cost)
        what = {"path": "the whole path in one call", "step": "one pose a call"}[self.by]
        within = f"within {100 * self.model.worst:.0f} %"
        return f"{share} of its time (predicted here for {what}: {own} of {full}, {within})"


OPERATIONS = Price()


def price(by: By, model: TimeModel | None) -> Price:
    """The price by this word; without a model operations.

    Raises:
        ValueError: another word.
    """
    check_word("by", by, By)
    return OPERATIONS if by == "operations" or model is None else Price(by, model)


def work_of(arguments: tuple, kernels: int) -> Work:
    """Work of `simulate` for scene, material and path, which starts so many kernels."""
    count = count_operations(simulate, *arguments)
    half = str(jax.tree.leaves(arguments[1])[0].dtype) == "float32"
    return Work(kernels, count * half, count * (not half))


def started(program: Any) -> int:
    """Kernels that a call of a compiled program starts.

    Args:
        program: as `jax.jit(...).lower(...).compile()` gives it.

    Raises:
        Uncalibrated: no number is known, see `kernels.count_kernels`; the message says why.
    """
    try:
        return count_kernels(program.as_text())[0]
    except ValueError as error:
        raise Uncalibrated(str(error)) from None
    except KeyError as error:
        raise Uncalibrated(f"the program's text names {error}, which is not in it") from None


def single(arguments: tuple) -> tuple:
    """The same with the last row of the path alone."""
    scene, material, path = arguments
    return scene, material, jax.tree.map(lambda v: v[-1:], path)
