"""The ladders of a scene: every accuracy choice that it uses, from coarse to fine.

Each has a kind: `truncation` (how far something is computed), `algebra` (another way to the same
numbers), `model` (something left out) or `together` (several of them at once).
"""

from typing import Any, Literal, NamedTuple

from jaxtrachea.contact.search import FINE
from jaxtrachea.scene.effects import EFFECTS, Effect
from jaxtrachea.tradeoff.levels import Full, Levels, one_plane

Kind = Literal["truncation", "algebra", "model", "together"]

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
        rungs: what each changes in the finest levels, by name of the level; the finest last.
        base: what is changed for all of them, their reference included.
        effect: that it is of; empty: of none.
    """

    name: str
    kind: Kind
    rungs: dict[str, dict[str, Any]]
    base: dict[str, Any]
    effect: str = ""

    def levels(self, full: Full, rung: str) -> Levels:
        """The finest levels with this rung."""
        return full.levels.changed(**self.base, **self.rungs[rung])


def ladders(full: Full) -> tuple[list[Ladder], dict[str, str]]:
    """The ladders of a scene, and why the others are left out, by name."""
    found: list[Ladder] = []
    out: dict[str, str] = {}

    def add(name, kind, rungs, why="", effect="", **base):
        if why:
            out[name] = why
        else:
            found.append(Ladder(name=name, kind=kind, rungs=rungs, base=base, effect=effect))

    flat, plan = one_plane(full), full.scene.plan
    alone = flat or ("a tool with a width has one form and one split" if plan.has("width") else "")
    add("form", "algebra", _words("form", "reactions", "recursion"), alone, second_plane="off")
    wanders = plan.contact and plan.contact_point == "per_step"
    jumps = alone or (
        "with 'independent' the energy of a contact that wanders jumps" if wanders else ""
    )
    add("split", "model", _words("split", "independent", "continuous"), jumps, second_plane="off")
    series = "friction needs coupling 'series'" if plan.friction else ""
    if plan.has("skeleton"):
        series = "a skeleton that softens needs coupling 'series'"
    if plan.level("relaxation") == "parts":
        series = "parts that relax apart need coupling 'series'"
    add("coupling", "model", _words("coupling", "total", "series"), series)
    reasons = {effect.name: effect.reason for effect in plan.effects}
    if plan.second_plane:
        reasons["second_plane"] = flat
    else:
        reasons["second_plane"] = flat or "the program is of one plane already"
    for effect in EFFECTS.values():
        if effect.rungs:
            why = "" if _at_its_finest(effect, full) else reasons[effect.name]
            add(effect.ladder, effect.ladder_kind, _rungs(effect, full), why, effect.name)
    _truncations(full, add)
    out["tolerance"] = "nothing stops at a tolerance: closed forms, and fixed numbers of steps"
    return found, out


def _at_its_finest(effect: Effect, full: Full) -> bool:
    """Whether the ladder of an effect is climbed: a truncation wherever it is on."""
    plan = full.scene.plan
    if effect.name == "second_plane" and one_plane(full):
        return False
    if effect.ladder_kind == "truncation":
        return plan.has(effect.name)
    return plan.level(effect.name) == effect.rungs[-1]


def _rungs(effect: Effect, full: Full) -> dict[str, dict[str, Any]]:
    """Levels up to that of the full program, by the name that they have on the ladder."""
    level = full.scene.plan.level(effect.name)
    top = effect.rungs.index(level) if level in effect.rungs else -1
    return {effect.words.get(v, v): {effect.name: v} for v in effect.rungs[: top + 1]}


def _words(name: str, *levels: str) -> dict[str, dict[str, Any]]:
    return {level: {name: level} for level in levels}


def _truncations(full: Full, add) -> None:
    """Contact, mesh, rings kept, dtype."""
    contact = "" if full.scene.plan.contact else "the contact points are given"
    sharp = {f"{v:g}": {"sharpness": v} for v in (*SHARPNESS, FINE.sharpness)}
    add("smoothing", "truncation", sharp, contact)
    steps = {str(n): {"steps": n} for n in (*STEPS, FINE.warm_steps)}
    add("iterations", "truncation", steps, contact)
    mesh = "" if full.made is not None else "the mesh is read from a file, or there is none"
    if not mesh and full.scene.plan.surface is None and contact:
        mesh = "no surface and no contact"
    add("mesh", "truncation", {f"{v:g}": {"mesh": v} for v in MESH}, mesh)
    count = full.levels.kept
    kept = {str(n): {"kept": n} for n in (*(n for n in KEPT if n < count), count)}
    add("rings_kept", "truncation", kept, "" if count > 1 else "there is one ring")
    add("dtype", "truncation", _words("dtype", "float32", "float64"), effect="precision")
