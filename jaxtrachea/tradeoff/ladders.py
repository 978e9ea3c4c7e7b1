"""The ladders of a scene: every accuracy choice that it uses, from coarse to fine.

Each has a kind: `truncation` (how far something is computed), `algebra` (another way to the same
numbers) or `model` (something left out).
"""

import dataclasses
from typing import Any, Literal, NamedTuple

from jaxtrachea.contact.search import FINE
from jaxtrachea.tradeoff.levels import Full, Levels, one_plane

Kind = Literal["truncation", "algebra", "model"]

#: Sharpness of the contact at the finest number of steps, and steps at the finest sharpness.
SHARPNESS = (100.0, 300.0, 1000.0, 3000.0)
STEPS = (1, 2, 4, 6, 8, 10, 12)
#: Sharpness and steps together, for the choice by tolerance.
QUALITY = {"rough": (300.0, 5), "fast": (300.0, 10), "standard": (1000.0, 10),
           "sharp": (3000.0, 10), "fine, 10 steps": (FINE.sharpness, 10)}  # fmt: skip
MESH = (0.25, 0.5, 1.0, 2.0)
KEPT = (1, 2, 3, 5, 7, 9, 11, 13)


class Ladder(NamedTuple):
    """One choice.

    Attributes:
        name: -
        kind: -
        rungs: what each changes in the finest levels, by name of the level; the finest last.
        base: what is changed for all of them, their reference included.
    """

    name: str
    kind: Kind
    rungs: dict[str, dict[str, Any]]
    base: dict[str, Any]

    def levels(self, full: Full, rung: str) -> Levels:
        """The finest levels with this rung."""
        return dataclasses.replace(full.levels, **self.base, **self.rungs[rung])


def ladders(full: Full) -> tuple[list[Ladder], dict[str, str]]:
    """The ladders of a scene, and why the others are left out, by name."""
    found: list[Ladder] = []
    out: dict[str, str] = {}

    def add(name, kind, rungs, why="", **base):
        if why:
            out[name] = why
        else:
            found.append(Ladder(name, kind, rungs, base))

    reasons = {effect.name: effect.reason for effect in full.scene.plan.effects}
    finest, flat = full.levels, one_plane(full)
    plane = {"second_plane": False}
    add("form", "algebra", _words("form", "reactions", "recursion"), flat, **plane)
    add("split", "model", _words("split", "independent", "continuous"), flat, **plane)
    both = flat or ("" if finest.second_plane else "the program is of one plane already")
    add("second_plane", "model", {"off": plane, "on": {}}, both)
    bends = "" if finest.rings == "arch2" else reasons["rings"]
    add("rings", "model", _words("rings", "mat", "arch", "arch2"), bends)
    sliding = "friction needs coupling 'series'" if finest.friction else ""
    add("coupling", "model", _words("coupling", "total", "series"), sliding)
    for name in ("shear", "axial", "end_motion", "friction"):
        why = "" if getattr(finest, name) else reasons[name]
        add(name, "model", {"off": {name: False}, "on": {name: True}}, why)
    two = "" if finest.local == "two-material" else reasons["two_material"]
    add("local", "model", _words("local", "uniform", "two-material"), two)
    _surface(full, add, reasons)
    _truncations(full, add)
    out["tolerance"] = "nothing stops at a tolerance: closed forms, and fixed numbers of steps"
    return found, out


def _words(name: str, *levels: str) -> dict[str, dict[str, Any]]:
    return {level: {name: level} for level in levels}


def _surface(full: Full, add, reasons: dict[str, str]) -> None:
    method, dent = full.levels.surface, full.levels.dent
    why = "" if method == "hermite" else reasons["surface"]
    add("interpolation", "model", _words("surface", "linear", "phong", "hermite"), why)
    counts = [n for n in (0, 8, 16, 32) if n <= dent]
    why = "" if dent else reasons["dent"]
    add("dent", "truncation", {str(n): {"dent": n} for n in counts}, why)


def _truncations(full: Full, add) -> None:
    """Contact, mesh, rings kept, dtype."""
    contact = "" if full.scene.plan.contact else "the contact points are given"
    sharp = {f"{v:g}": {"sharpness": v} for v in (*SHARPNESS, FINE.sharpness)}
    add("smoothing", "truncation", sharp, contact)
    steps = {str(n): {"steps": n} for n in (*STEPS, FINE.warm_steps)}
    add("iterations", "truncation", steps, contact)
    mesh = "" if full.made is not None else "the mesh is read from a file, or there is none"
    if not mesh and full.levels.surface is None and contact:
        mesh = "no surface and no contact"
    add("mesh", "truncation", {f"{v:g}": {"mesh": v} for v in MESH}, mesh)
    count = full.levels.kept
    kept = {str(n): {"kept": n} for n in (*(n for n in KEPT if n < count), count)}
    add("rings_kept", "truncation", kept, "" if count > 1 else "there is one ring")
    add("dtype", "truncation", _words("dtype", "float32", "float64"))
