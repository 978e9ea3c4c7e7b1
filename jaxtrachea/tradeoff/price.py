"""What a program costs, for the choice by tolerance: seconds measured here, or operations."""

from typing import Literal

import jax

from jaxtrachea._arguments import check_word
from jaxtrachea.scene.operations import count_operations
from jaxtrachea.scene.simulation import simulate
from jaxtrachea.tradeoff.calls import Arguments, Call, last_row, one_pose, whole_path

#: What is made least: time of the whole path in one call (`simulate`), of a pose a call
#: (`Session`), or operations, those in float32 counted half: the same on every machine.
By = Literal["path", "step", "operations"]
#: Those that are a time.
Time = Literal["path", "step"]
#: What an operation in float32 counts where operations are the cost.
HALF = 0.5
#: Share of the time below which what a level saves is not told from noise.
GRAIN = 0.02
#: A time in words.
WORDS: dict[Time, str] = {"path": "the whole path in one call", "step": "one pose a call"}


def operations(arguments: Arguments, *, step: bool = False) -> float:
    """Of `simulate` for scene, material and path; those in float32 counted half.

    Args:
        arguments: scene, material and path.
        step: of the last row of the path alone.
    """
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


def words(by: By, cost: tuple[float, float]) -> str:
    """Cost of the full program and of another, in words.

    Raises:
        ValueError: another word.
    """
    check_word("by", by, By)
    share = f"{100 * cost[1] / cost[0]:.0f} %"
    if by == "operations":
        return f"{share} of its cost"
    full, own = (f"{1e3 * v:.2g} ms" for v in cost)
    return f"{share} of its time (measured here for {WORDS[by]}: {own} of {full})"
