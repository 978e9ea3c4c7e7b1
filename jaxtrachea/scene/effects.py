"""The effects of a scene, each declared once: a field of `EffectOptions` with its `Effect`.

A declaration says which levels an effect has, the rule that chooses one and why, what it needs of
the material and of other effects, where a plan keeps it, and how it is climbed where accuracy is
traded. The table [effects] of a scene (`spec`), the decisions (`rules`), what a plan without it is
(`Plan.without`), its share of the operations (`cost`), what a row may lack (`ranges`) and the
ladders (`tradeoff`) follow from it. A rule reads the effects above its own.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, Literal, get_args, get_type_hints

from jaxtrachea._arguments import check_record
from jaxtrachea.mechanics.levels.choose import AnyMaterial, level_type
from jaxtrachea.mechanics.levels.relaxing import RelaxingMaterial, long_run
from jaxtrachea.mechanics.press import Options
from jaxtrachea.scene import depth, width
from jaxtrachea.scene.declare import (
    RELAXES,
    RELAXES_APART,
    SECTIONS,
    Case,
    Effect,
    PlanError,
    Verdict,
)
from jaxtrachea.surface.regions import Method
from jaxtrachea.trachea.material import DEEP

Switch = Literal["auto", "on", "off"]


def _contact_point(case: Case) -> Verdict:
    facts = case.facts
    if not facts.poses:
        if not facts.several_points:
            return Verdict("fixed", "one contact point")
        why = "the presses have different contact points"
        return Verdict("per_step", "several contact points", {"fixed": (why, "use 'auto'")})
    glued = facts.glued or case.options.contact == "bonded"
    sections = SECTIONS in facts.known
    wished = case.options.friction == "off" and "friction" not in case.finest
    why = "what is glued stays where it touched", "use 'auto'"
    refused = {"per_step": why} if glued and not sections else {}
    if wished and not (glued or sections):
        reason = "friction is off as you wish: every row is a frictionless press of its own"
        return Verdict("per_step", reason)
    if facts.slip < facts.spacing / 2:
        way = f"the tool moves {facts.slip:.3g} mm along the surface, less than half a ring spacing"
        hand = "" if facts.friction else "; a hand that goes on wants tool.friction, or 'per_step'"
        return Verdict("fixed", way + hand, refused)
    if glued:
        return Verdict("fixed", "glued where it touches first", refused)
    reason = "the tool wanders over the rings: every row is a frictionless press of its own"
    return Verdict("per_step", reason)


def _friction(case: Case) -> Verdict:
    facts, options = case.facts, case.options
    fixed = case.levels["contact_point"] == "fixed"
    cannot = ""
    if not facts.friction and facts.tools > 1:
        cannot = "not every tool has a coefficient; give each its tool.friction (0: it slides)"
    elif not facts.friction:
        cannot = "the tool has no coefficient; give tool.friction"
    elif not fixed:
        cannot = (
            "the contact does not keep its place; shorten the path or set contact_point 'fixed'"
        )
    elif options.contact != "unilateral" or options.coupling != "series":
        cannot = "it needs contact 'unilateral' and coupling 'series'"
    moves, reason = facts.slip > 0, "the tool moves along the surface"
    if not moves and facts.friction and facts.tools > 1 and facts.along + facts.across > 0:
        moves, reason = True, "a tool moves along the wall that others may raise to it"
    elif not moves and facts.friction and facts.angle > 0:
        # Whatever the coefficient: one that is 0 would be held, too.
        moves, reason = True, "off the midline the skeleton moves along the surface under the tool"
    if not moves:
        reason = "no motion along the surface"
    elif cannot:
        reason = f"{cannot}; the tool {'holds the surface' if fixed else 'slides freely'}"
    return _switch(moves and not cannot, reason, cannot)


def _second_plane(case: Case) -> Verdict:
    facts, options, must = case.facts, case.options, ""
    if facts.angle > 0:
        must = f"the contact lies up to {math.degrees(facts.angle):.3g} deg off the midline"
    elif case.prescribed and (facts.along > 0 or facts.across > 0):
        must = "the tool's motion is oblique"
    elif case.levels["friction"] == "on":
        must = "friction works in the tangent plane"
    elif options.rings in ("arch", "arch2"):
        must = f"rings {options.rings!r} were asked for"
        must = "arches need vectors" if "rings" in case.finest else must
    elif options.rings == "auto" and _bends(case):
        must = "rings bend (EI_C and k_t are given)"
    elif options.axial == "on":
        must = "axial motion was asked for"
    reason = must or "a normal press on the midline stays in one plane"
    cure = "leave second_plane 'auto'"
    return Verdict("on" if must else "off", reason, {"off": (must, cure)} if must else {})


def _bends(case: Case) -> bool:
    """Whether the material gives what rings that bend need."""
    return EFFECTS["rings"].given(case.facts.known)


def _rings(case: Case) -> Verdict:
    """What a ring is, by what the material gives: the same wherever the tool touches."""
    if _bends(case):
        reason = "EI_C and k_t are given: a ring bends, on the midline and off it"
        return Verdict("arch2", reason)
    reason = "EI_C and k_t are not given: a ring is its spring k_M (paper 2.3)"
    if case.facts.angle > 0:
        reason = "off the midline a ring would bend, but EI_C and k_t are not given"
    why = "EI_C or k_t is not given", "give both, or use 'mat'"
    if SECTIONS in case.facts.known:
        reason, why = "its cross-sections deform", ("a ring is a cross-section", "use 'mat'")
    return Verdict("mat", reason, {"arch": why, "arch2": why})


def _axial(case: Case) -> Verdict:
    drags = case.facts.tools == 1 or case.levels["friction"] == "on"
    needed = case.prescribed and case.facts.along > 0 and drags
    cannot = "" if EFFECTS["axial"].given(case.facts.known) else "EA_L is not given"
    reason = "the tool moves along the tube" if needed else "no motion along the tube"
    if not drags:
        cannot = reason = "the tools slide on the wall: none moves it along the tube"
    if needed and cannot:
        reason = f"{cannot}; the skeleton does not stretch"
    return _switch(needed and not cannot, reason, cannot)


def _surface(case: Case) -> Verdict:
    if not case.options.want_surface:
        why = "output.surface is false", ""
        levels = EFFECTS["surface"].levels
        refused = {level: why for level in levels if level != "off"}
        return Verdict("off", "not asked for", refused, free=False)
    if not case.facts.mesh:
        cure = "give one, or do not ask (want_surface)"
        raise PlanError("surface", "asked for", "the scene has no mesh", cure)
    if SECTIONS in case.facts.known:
        why = "it interpolates a line of joints, and the wall has a shape of its own"
        refused = {level: (why, "use 'sections', or 'auto'") for level in get_args(Method)}
        return Verdict("sections", "asked for; the wall has the shape of its sections", refused)
    refused = {"sections": ("the material is that of a line of joints", "use 'hermite', or 'auto'")}
    return Verdict("hermite", "asked for; exact for the beam without shear", refused)


def _end_motion(case: Case) -> Verdict:
    springs = sorted(case.facts.known & set(EFFECTS["end_motion"].material))
    on = all(case.levels[name] != "off" for name in EFFECTS["end_motion"].requires)
    cannot = "" if springs and on else "it needs k_A or k_B, axial and a surface"
    reason = f"{' and '.join(springs)} let the ends move"
    return _switch(not cannot, reason if springs else "the ends are held (no k_A, k_B)", cannot)


def _dent(case: Case) -> Verdict:
    if case.levels["surface"] == "off":
        why = "there is no surface", "leave it 'auto'"
        levels = EFFECTS["dent"].levels
        refused = {level: why for level in levels if level != "off"}
        return Verdict("off", "no surface", refused, free=False)
    refused = {}
    if not case.facts.poses:
        why = "a press at a point has no tool to shape the dent"
        cure = "use 8 or 'off', or give the path as motions of the tool"
        refused = {"16": (why, cure), "32": (why, cure)}
    if not case.facts.near:
        return Verdict("off", "no vertex comes near the contact", refused)
    if case.facts.poses:
        return Verdict("16", "vertices lie near the tool")
    reason = "vertices lie near the contact; a peak, the tool's shape is not known"
    return Verdict("8", reason, refused)


def _relaxation(case: Case) -> Verdict:
    """How the force relaxes, by what the material gives; never dropped without a word."""
    known, facts = case.facts.known, case.facts
    if RELAXES not in known:
        why = "the material does not say how its force relaxes", "give [relaxation], or use 'auto'"
        return Verdict("off", "the material has no relaxation", {"uniform": why, "parts": why})
    cannot, apart = _no_history(case), _no_parts(case)
    both = {"uniform": cannot, "parts": cannot} if cannot else {}
    if apart and not both:
        both = {"parts": apart}
    wished = case.options.relaxation
    level = "parts" if RELAXES_APART in known else "uniform"
    if wished == "auto" and level in both:
        raise PlanError("relaxation", "the force relaxes", *both[level])
    span = f"over {facts.duration:.3g} s" if facts.timed else "at no time"
    alike = "local contact and skeleton apart" if level == "parts" else "all parts alike"
    return Verdict(level, f"the material relaxes, {alike}; {span}", both)


def _no_history(case: Case) -> tuple[str, str] | None:
    """Why no force of this scene can relax, and the cure; None: it can."""
    or_off = "or set effects.relaxation = 'off' (the force of the long run)"
    if not case.facts.timed:
        return (
            "the path has no times",
            f"give each [[path]] a duration, or its file a column t, {or_off}",
        )
    if case.levels["contact_point"] != "fixed":
        shorter = "shorten the path or set contact_point 'fixed'"
        if not case.facts.poses:
            shorter = "simulate the presses of each place by themselves"
        return (
            "the contact does not keep its place, and each place has a history of its own",
            f"{shorter}, {or_off}",
        )
    if case.levels["friction"] == "on":
        return (
            "the tool slides: slip depends on the relaxed force",
            f"leave tool.friction out, or set friction 'off' and contact_point 'fixed', {or_off}",
        )
    return None


def _no_parts(case: Case) -> tuple[str, str] | None:
    """Why parts cannot relax apart, and the cure; None: they can."""
    or_uniform = "leave the numbers of the skeleton out, or set effects.relaxation = 'uniform'"
    if RELAXES_APART not in case.facts.known:
        return "the material does not say how its skeleton relaxes", "give it, or use 'uniform'"
    if SECTIONS in case.facts.known:
        return "a wall of deforming cross-sections has no compliance of its own", or_uniform
    if case.options.coupling != "series":
        return "with coupling 'total' the force does not depend on the skeleton", or_uniform
    if case.levels["second_plane"] == "on":
        return "parts that relax apart are derived for one plane alone", or_uniform
    return None


def _tools(case: Case) -> Verdict:
    """Whether contacts feel one another, by the number of tools.

    Raises:
        PlanError: several tools in a scene for which that is not derived.
    """
    count = case.facts.tools
    if count == 1:
        why = "one tool has a path", "leave it 'auto', or give a path to another tool"
        return Verdict("one", "one tool", {"apart": why, "coupled": why})
    if cannot := _no_company(case):
        raise PlanError("tools", f"{count} tools press one tube", *cannot)
    refused = {"one": (f"{count} tools have a path", "leave it 'auto'")}
    if case.options.coupling == "total":
        why = "with coupling 'total' no force knows the skeleton: contacts do not feel one another"
        refused["coupled"] = why, "use coupling 'series'"
        return Verdict("apart", f"{count} tools; {why}", refused)
    slides = case.levels["second_plane"] == "on" and case.levels["friction"] == "off"
    slide = "; they slide without friction" if slides else ""
    reason = f"{count} tools: the forces of all move each of them{slide}"
    return Verdict("coupled", reason, refused)


def _no_company(case: Case) -> tuple[str, str] | None:
    """Why several tools cannot press together, and the cure; None: they can."""
    levels, one_each = case.levels, "or simulate each tool by itself"
    if SECTIONS in case.facts.known:
        return (
            "deforming cross-sections are derived for one contact",
            f"give [material] in the place of [sections] and [wall], {one_each}",
        )
    if levels["second_plane"] != "off" and (cannot := _no_lines(case)):
        return cannot[0], f"{cannot[1]}, {one_each}"
    if levels["skeleton"] != "linear":
        return "a skeleton softens by one contact", f"set skeleton 'linear', {one_each}"
    if case.facts.glued and (levels["relaxation"] != "off" or case.options.coupling == "total"):
        return (
            "forces of glued tools beside others neither relax nor go with coupling 'total'",
            f"set relaxation 'off' and coupling 'series', {one_each}",
        )
    if levels["relaxation"] == "parts":
        return (
            "parts that relax apart are derived for one contact",
            "leave the numbers of the skeleton out, or set relaxation 'uniform' or 'off' (the "
            f"forces of the long run), {one_each}",
        )
    return None


def _no_lines(case: Case) -> tuple[str, str] | None:
    """Why several tools cannot press as vectors, and the cure; None: they can."""
    levels = case.levels
    if case.facts.drags and case.prescribed and levels["friction"] == "off":
        return (
            "one of them moves along the wall by more than a twentieth of its way: what it drags "
            "along needs friction",
            _instead_of_dragging(case),
        )
    if case.facts.glued or case.options.contact == "bonded":
        return (
            "off the midline, or where rings bend, a tool that is glued holds the wall along the "
            "surface, too, which is derived for one tool",
            "set contact 'unilateral', or press on the midline with rings 'mat'",
        )
    if levels["rings"] == "arch":
        return "rings 'arch' have no motion at one angle by a load at another", "use 'arch2'"
    if levels["surface"] == "phong":
        return "'phong' interpolates one line of joints", "use 'hermite' or 'linear'"
    return None


def _instead_of_dragging(case: Case) -> str:
    """The cure where tools without friction would drag the wall along."""
    rub, straight = "give each tool its friction (0: it slides freely)", "press straight in, or set"
    if case.facts.glued:
        return f"{straight} contact 'unilateral' and {rub}"
    if case.levels["relaxation"] != "off":
        return f"{straight} relaxation 'off' and {rub}"
    if case.options.coupling != "series":
        return f"{straight} coupling 'series' and {rub}"
    return f"{rub}, {straight} contact_point 'per_step' (frictionless)"


def _given(name: str) -> Callable[[Case], Verdict]:
    """The rule of an effect that is on wherever the material gives what it reads."""

    def rule(case: Case) -> Verdict:
        values, given = EFFECTS[name].material, EFFECTS[name].given(case.facts.known)
        reason = f"{' and '.join(values)} is {'' if given else 'not '}given"
        return _switch(given, reason, "" if given else reason)

    return rule


def _switch(on: bool, reason: str, cannot: str) -> Verdict:
    refused = {"on": (cannot, "give it, or use 'auto'")} if cannot else {}
    return Verdict("on" if on else "off", reason, refused)


def _effect(rule: Callable[[Case], Verdict], **declaration: Any) -> Any:
    return dataclasses.field(default="auto", metadata={"effect": Effect(rule=rule, **declaration)})


ON_OFF = ("off", "on")


@dataclasses.dataclass(frozen=True)
class EffectOptions:
    """What the user asks for; `auto` leaves it to the rules.

    Attributes:
        contact_point: `fixed`: the tool stays on the place it touched first; `per_step`: every row
            is a press of its own, frictionless along the surface.
        friction: Coulomb friction along the path; `off`: none, and of a tool led by poses the
            contact point is `per_step`, unless that is given.
        second_plane: bending along the circumference, vectors; off: a normal press on the midline.
        rings: see `skeleton_response`.
        axial: the ligament stretches.
        surface: method of interpolation, `sections`: the wall of deforming cross-sections, or off.
        end_motion: the clamps move on axial springs, and the surface with them.
        dent: centres of the local correction, or off.
        shear: the ligament shears.
        two_material: the rings have a local law of their own.
        width: `punch`: the tool has that of `half_width`; `point`: it has none.
        skeleton: `softening`: it yields more the deeper it is pressed; `sections`: deforming
            cross-sections, of a `SectionMaterial`; see `Options`.
        relaxation: the force relaxes in time: `uniform`, all parts alike; `parts`, local contact
            and skeleton apart; see `Options`.
        tools: `coupled`: the forces of all tools move each of them; `apart`: each force is that of
            its tool alone, and the skeleton moves under all of them; `one`: one tool.
        want_surface: deformed vertices are asked for.
        want_joints: joints and their loads are asked for.
        want_ring_ends: ends of the rings are asked for.
        coupling: see `Options`, as those below.
        contact: -
        onset_width: -
        transition: -
        half_width: -
    """

    contact_point: Literal["auto", "fixed", "per_step"] = _effect(
        _contact_point, least="", values={}
    )
    friction: Switch = _effect(
        _friction, implies=("second_plane",), blocks_removal=("second_plane",), rungs=ON_OFF
    )
    second_plane: Switch = _effect(_second_plane, rungs=ON_OFF)
    rings: Literal["auto", "mat", "arch", "arch2"] = _effect(
        _rings, least="mat", values={}, material=("EI_C", "k_t"), implies=("second_plane",),
        rungs=("mat", "arch", "arch2"),
    )  # fmt: skip
    axial: Switch = _effect(_axial, material=("EA_L",), implies=("second_plane",), rungs=ON_OFF)
    surface: Literal["auto", "off", "linear", "hermite", "phong", "sections"] = _effect(
        _surface, values={"off": None}, rungs=("linear", "phong", "hermite"),
        ladder="interpolation",
    )  # fmt: skip
    end_motion: Switch = _effect(
        _end_motion, material=("k_A", "k_B"), either=True, requires=("axial", "surface"),
        rungs=ON_OFF,
    )  # fmt: skip
    dent: Literal["auto", "off", "8", "16", "32"] = _effect(
        _dent, values={"off": 0, "8": 8, "16": 16, "32": 32}, requires=("surface",),
        rungs=("off", "8", "16", "32"), ladder_kind="truncation", words={"off": "0"},
    )  # fmt: skip
    shear: Switch = _effect(
        _given("shear"), field="options.shear", material=("GA_L",), rungs=ON_OFF
    )
    two_material: Switch = _effect(
        _given("two_material"), field="options.local",
        values={"off": "uniform", "on": "two-material"}, material=("k_1_ring",), rungs=ON_OFF,
        ladder="local", words={"off": "uniform", "on": "two-material"},
    )  # fmt: skip
    width: Literal["auto", "point", "punch"] = _effect(
        width.width, least="point", field="options.half_width", values={"point": 0.0},
        measured="punch", rungs=("point", "punch"),
    )  # fmt: skip
    skeleton: Literal["auto", "linear", "softening", "sections"] = _effect(
        depth.skeleton, least="linear", field="options.skeleton", values={},
        material=DEEP, rungs=("linear", "softening"),
    )  # fmt: skip
    relaxation: Literal["auto", "off", "uniform", "parts"] = _effect(
        _relaxation, field="options.relaxation", values={}, material=(RELAXES,),
        rungs=("off", "uniform", "parts"),
    )  # fmt: skip
    tools: Literal["auto", "one", "apart", "coupled"] = _effect(_tools, least="", values={})
    want_surface: bool = True
    want_joints: bool = True
    want_ring_ends: bool = True
    coupling: Literal["series", "total"] = "series"
    contact: Literal["unilateral", "bonded"] = "unilateral"
    onset_width: float = 1e-3
    transition: float | None = None
    half_width: float = 0.0

    def __post_init__(self):
        """Refuse words and numbers that mean nothing.

        Raises:
            ValueError: naming the field, what was found and what is expected.
        """
        check_record(self)
        Options(self.coupling, contact=self.contact, onset_width=self.onset_width,
                transition=self.transition, half_width=self.half_width)  # fmt: skip


def _declared() -> dict[str, Effect]:
    kinds, found = get_type_hints(EffectOptions), {}
    for field in dataclasses.fields(EffectOptions):
        effect, name = field.metadata.get("effect"), field.name
        if effect is not None:
            levels = tuple(word for word in get_args(kinds[name]) if word != "auto")
            field, ladder = effect.field or name, effect.ladder or name
            found[name] = dataclasses.replace(
                effect, name=name, levels=levels, field=field, ladder=ladder
            )
    return found


#: Every effect by name.
EFFECTS = _declared()


def given_values(material: AnyMaterial) -> frozenset[str]:
    """Optional values that effects read and the material gives; `SECTIONS` of one of sections."""
    of_time = set()
    if isinstance(material, RelaxingMaterial):
        of_time = {RELAXES} if material.relaxation.skeleton is None else {RELAXES, RELAXES_APART}
    if not level_type(material).hangs_on_rings:
        return frozenset({SECTIONS} | of_time)
    values = long_run(material)
    names = {name for effect in EFFECTS.values() for name in effect.material} - {RELAXES}
    return frozenset(of_time | {name for name in names if getattr(values, name) is not None})


def goes_with(name: str) -> set[str]:
    """Effects that cannot be without this one, and those that cannot be without them."""
    own = {e.name for e in EFFECTS.values() if name in (*e.requires, *e.implies)}
    return own.union(*map(goes_with, own))
