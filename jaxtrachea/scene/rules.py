"""The rules: from facts and wishes to a `Plan`, each choice with its reason (docs/scenes.md).

What is not wished for is chosen here; a wish that cannot be met is refused, never dropped.
"""

import math
from typing import Literal, get_args

from jaxtrachea.mechanics.press import Options
from jaxtrachea.mechanics.skeleton import Rings
from jaxtrachea.scene.plan import Effect, Facts, Plan, PlanError, Wishes
from jaxtrachea.surface.regions import Method

#: Angle (rad) and share of the motion below which something counts as not there.
SMALL = 1e-6
#: What the material must give for rings that bend.
BENDS = frozenset({"EI_C", "k_t"})


class _Decisions:
    """Effects decided so far."""

    def __init__(self, wishes: Wishes):
        self.wishes, self.effects, self.ignored = wishes, [], set()

    def switch(self, name: str, rule: bool, reason: str, cannot: str = "", must: str = "") -> bool:
        """Decide on or off.

        Args:
            name: of the effect, a field of `Wishes`.
            rule: what the rules say.
            reason: why.
            cannot: why it cannot be on.
            must: why it cannot be off.
        """
        wish = getattr(self.wishes, name)
        on = rule if wish == "auto" else wish == "on"
        if wish == "on" and cannot:
            raise PlanError(f"{name}: 'on', but {cannot}; give it, or use 'auto'")
        if wish == "off" and must:
            raise PlanError(f"{name}: 'off', but {must}; use 'auto'")
        self.note(name, "on" if on else "off", reason, wish != "auto")
        if wish == "off":
            self.ignored.add(name)
        return on

    def choose(self, name: str, rule: str, reason: str) -> str:
        """Decide between words."""
        wish = getattr(self.wishes, name)
        level = rule if wish == "auto" else wish
        self.note(name, level, reason, wish != "auto")
        if wish != "auto":
            self.ignored.add(name)
        return level

    def note(self, name: str, level: str, reason: str, forced: bool = False) -> None:
        self.effects.append(Effect(name, level, "as you wish" if forced else reason, forced))


def make_plan(facts: Facts, wishes: Wishes = Wishes()) -> Plan:  # noqa: B008 (frozen)
    """Choose the program of a scene.

    Args:
        facts: of the scene.
        wishes: of the user.

    Raises:
        PlanError: a wish that cannot be met, with the cure.
    """
    d = _Decisions(wishes)
    if facts.poses:
        d.note("contact", "on", "the path is given as positions of the tool")
    else:
        d.note("contact", "off", "the contact points are given")
    curved = facts.poses and facts.curved
    if facts.curved:
        d.note(
            "curved", "on" if curved else "off",
            "the mesh is bent: motions are turned into the frame of its centreline at the contact"
            if curved else "displacements are given along the centreline's own frame",
        )  # fmt: skip
    seat = _seat(d, facts)
    friction = _friction(d, facts, seat)
    sideways = facts.along > SMALL or facts.across > SMALL
    off_middle = facts.angle > SMALL
    # A press of its own is led along the normal: nothing of it is axial or lateral.
    leads = seat == "first" or not facts.poses
    second = _second_plane(d, facts, friction, off_middle, leads and sideways)
    rings = _rings(d, facts, second)
    axial = _axial(d, facts, second, leads)
    springs = facts.known & {"k_A", "k_B"}
    surface = _surface(d, facts)
    end_motion = d.switch(
        "end_motion",
        bool(springs) and axial and surface is not None,
        f"{' and '.join(sorted(springs))} let the ends move"
        if springs else "the ends are held (no k_A, k_B)",
        cannot="" if springs and axial and surface else "it needs k_A or k_B, axial and a surface",
    )  # fmt: skip
    dent = _dent(d, facts, surface)
    shear = _given(d, facts, "shear", "GA_L")
    local = "two-material" if _given(d, facts, "two_material", "k_1_ring") else "uniform"
    d.note("coupling", wishes.coupling, "indentation and skeleton share the way"
           if wishes.coupling == "series" else "the local law takes the whole way")  # fmt: skip
    d.note("contact law", wishes.contact, "no pull" if wishes.contact == "unilateral" else "glued")
    for name, wanted in (("joints", wishes.want_joints), ("ring_ends", wishes.want_ring_ends)):
        d.note(name, "on" if wanted else "off", "asked for" if wanted else "not asked for")
    options = Options(
        coupling=wishes.coupling, shear=shear, local=local, contact=wishes.contact,
        onset_width=wishes.onset_width, transition=wishes.transition,
    )  # fmt: skip
    return Plan(
        facts.poses, curved, seat, friction, second, rings, axial, end_motion, surface, dent,
        wishes.want_joints, wishes.want_ring_ends, options, ignored=frozenset(d.ignored),
        effects=tuple(d.effects),
    )  # fmt: skip


def _seat(d: _Decisions, facts: Facts) -> Literal["first", "each"]:
    near = facts.slip < facts.spacing / 2
    if facts.poses:
        level = "first" if near else "each"
        reason = (
            f"the tool moves {facts.slip:.3g} mm along the surface, less than half a ring spacing"
            if level == "first"
            else "the tool wanders over the rings: every row is a frictionless press of its own"
        )
        if d.wishes.contact == "bonded" and level == "each":
            level, reason = "first", "glued where it touches first"
    else:
        level = "each" if facts.seats else "first"
        reason = "several contact points" if facts.seats else "one contact point"
        if d.wishes.seat == "first" and facts.seats:
            raise PlanError("seat: 'first', but the presses have different contact points")
    return "first" if d.choose("seat", level, reason) == "first" else "each"


def _friction(d: _Decisions, facts: Facts, seat: str) -> bool:
    moves = facts.slip > SMALL
    cannot = ""
    if not facts.friction:
        cannot = "the tool has no coefficient; give tool.friction"
    elif seat != "first":
        cannot = "the contact does not keep its place; shorten the path or set seat 'first'"
    elif d.wishes.contact != "unilateral" or d.wishes.coupling != "series":
        cannot = "it needs contact 'unilateral' and coupling 'series'"
    reason = "the tool moves along the surface"
    if not moves:
        reason = "no motion along the surface"
    elif cannot:
        reason = f"{cannot}; the tool {'holds the surface' if seat == 'first' else 'slides freely'}"
    return d.switch("friction", moves and not cannot, reason, cannot)


def _second_plane(d: _Decisions, facts: Facts, friction: bool, off_middle: bool, oblique: bool):
    must = ""
    if off_middle:
        must = f"the contact lies up to {math.degrees(facts.angle):.3g} deg off the midline"
    elif oblique:
        must = "the tool's motion is oblique"
    elif friction:
        must = "friction works in the tangent plane"
    elif d.wishes.rings in ("arch", "arch2"):
        must = f"rings {d.wishes.rings!r} were asked for"
    elif d.wishes.rings == "auto" and facts.known >= BENDS:
        must = "rings bend (EI_C and k_t are given)"
    elif d.wishes.axial == "on":
        must = "axial motion was asked for"
    reason = must or "a normal press on the midline stays in one plane"
    if must:
        must += "; leave second_plane 'auto'"
    return d.switch("second_plane", bool(must), reason, must=must)


def _rings(d: _Decisions, facts: Facts, second: bool) -> Rings:
    """What a ring is, by what the material gives: the same wherever the tool touches."""
    bends = facts.known >= BENDS
    if bends:
        rule, reason = "arch2", "EI_C and k_t are given: a ring bends, on the midline and off it"
    elif facts.angle > SMALL:
        rule, reason = "mat", "off the midline a ring would bend, but EI_C and k_t are not given"
    else:
        rule, reason = "mat", "EI_C and k_t are not given: a ring is its spring k_M (paper 2.3)"
    level = d.choose("rings", rule, reason)
    if level != "mat" and not bends:
        raise PlanError(f"rings: {level!r}, but EI_C or k_t is not given; give both, or use 'mat'")
    assert level == "mat" or second, "arches need vectors"
    return next(v for v in get_args(Rings) if v == level)


def _axial(d: _Decisions, facts: Facts, second: bool, leads: bool) -> bool:
    needed = leads and facts.along > SMALL
    cannot = "" if "EA_L" in facts.known else "EA_L is not given"
    reason = "the tool moves along the tube" if needed else "no motion along the tube"
    if needed and cannot:
        reason = f"{cannot}; the skeleton does not stretch"
    return d.switch("axial", needed and not cannot, reason, cannot)


def _surface(d: _Decisions, facts: Facts) -> Method | None:
    if not d.wishes.want_surface:
        if d.wishes.surface not in ("auto", "off"):
            raise PlanError(f"surface: {d.wishes.surface!r}, but output.surface is false")
        d.note("surface", "off", "not asked for")
        return None
    if not facts.mesh:
        raise PlanError(
            "surface: asked for, but the scene has no mesh; give one, or do not ask (want_surface)"
        )
    level = d.choose("surface", "hermite", "asked for; exact for the beam without shear")
    return next((v for v in get_args(Method) if v == level), None)


def _dent(d: _Decisions, facts: Facts, surface) -> int:
    if surface is None:
        if d.wishes.dent not in ("auto", "off"):
            raise PlanError(f"dent: {d.wishes.dent!r}, but there is no surface")
        d.note("dent", "off", "no surface")
        return 0
    if not facts.near:
        rule, reason = "off", "no vertex comes near the contact"
    elif facts.poses:
        rule, reason = "16", "vertices lie near the tool"
    else:
        rule, reason = "8", "vertices lie near the contact; a peak, the tool's shape is not known"
    level = d.choose("dent", rule, reason)
    if level in ("16", "32") and not facts.poses:
        raise PlanError(
            f"dent: {level}, but a press at a point has no tool to shape the dent; use 8 or 'off', "
            "or give the path as motions of the tool"
        )
    return 0 if level == "off" else int(level)


def _given(d: _Decisions, facts: Facts, name: str, value: str) -> bool:
    there = value in facts.known
    reason = f"{value} is given" if there else f"{value} is not given"
    return d.switch(name, there, reason, "" if there else f"{value} is not given")
