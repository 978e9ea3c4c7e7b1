"""The part of a scene's program that a ladder changes, as a program of its own."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Literal, NamedTuple

import jax

from jaxtrachea._arguments import check_word
from jaxtrachea._compiler import quick_options
from jaxtrachea.mechanics.levels.relaxing import long_run
from jaxtrachea.scene.approach import Approach, approach
from jaxtrachea.scene.deform import deform
from jaxtrachea.scene.programs import Moved, one_plane, vectors
from jaxtrachea.scene.simulation import simulate
from jaxtrachea.scene.stage import Poses, Presses
from jaxtrachea.tradeoff.calls import last_row
from jaxtrachea.tradeoff.levels import Full, Levels, cast, program

Part = Literal["contact", "skeleton", "surface"]
#: What each ladder changes; of those not named here the force and the skeleton.
PART: dict[str, Part] = {
    "smoothing": "contact", "iterations": "contact", "mesh": "surface", "interpolation": "surface",
    "dent": "surface", "end_motion": "surface",
}  # fmt: skip
#: Ladders that change every part: there the whole is all there is.
WHOLE = ("dtype", "together", "relaxation")


class Inputs(NamedTuple):
    """What the parts of one pose are given, from the finest program: float64, one row.

    Attributes:
        path: of the tool or of the presses.
        made: how the tool comes; None for presses.
        presses: at the contact.
        moved: force and skeleton.
    """

    path: Poses | Presses
    made: Approach | None
    presses: Presses
    moved: Moved


def part_of(ladder: str) -> Part | None:
    """Which part a ladder changes; None: all of them."""
    return None if ladder in WHOLE else PART.get(ladder, "skeleton")


def inputs(full: Full) -> Inputs:
    """What the parts of the last row are given."""
    scene, material, path = full.scene, full.material, full.path
    row = last_row(path)
    made, presses = None, row
    if isinstance(row, Poses):
        made = _quickly(approach)(scene, row)
        bare = dataclasses.replace(scene, plan=scene.plan.at(dent="off", surface="off"))
        out = _quickly(simulate)(bare, material, row)
        presses = Presses(out.s, out.phi, out.displacement, row.time)
    assert isinstance(presses, Presses)
    return Inputs(row, made, presses, _quickly(_skeleton)(scene, material, presses))


def part(name: Part, full: Full, levels: Levels, given: Inputs) -> tuple[Callable, tuple] | None:
    """A part at these levels: a function and its arguments; None where the scene has no such part.

    Raises:
        ValueError: another word.
    """
    check_word("name", name, Part)
    scene, material, _ = program(full, levels)
    path, made, presses, moved = cast(given, levels.dtype)
    if name == "skeleton":
        return lambda m, p: _skeleton(scene, m, p), (material, presses)
    if name == "contact":
        return None if made is None else (lambda p: approach(scene, p), (path,))
    if scene.plan.surface is None:
        return None
    if not scene.plan.end_motion:  # of the finest scene, where the ends may move
        moved = moved._replace(clamps=None)
    return functools.partial(deform, scene), (presses, moved, path, made)


def _skeleton(scene, material, presses) -> Moved:
    """Force and skeleton, of a force that relaxes in the long run."""
    solve = vectors if scene.plan.second_plane else one_plane
    return solve(scene, long_run(material), presses)


def _quickly(function: Callable) -> Callable:
    return jax.jit(function, compiler_options=quick_options())
