"""How deep a path presses, and which skeleton that depth needs: the rule of `effects`' skeleton.

The finite-element trachea of docs/evidence/virtual_trachea.md (outer radius R = 12.6 mm) answers a
press of depth D on the midline with 1 - 0.1127 D + 0.0061 D^2 (D in mm) of its stiffness at small
strain: a linear skeleton errs there by 1.4 % at R / 100 and by 13 % at R / 10. A ring alone,
pinched between two points, is off by 15 % at R / 4 (`ranges.DEEPEST`).
"""

from jaxtrachea.mechanics.levels import line, sections
from jaxtrachea.mechanics.levels.options import Options
from jaxtrachea.scene.declare import SECTIONS, Case, PlanError, Verdict
from jaxtrachea.trachea.material import DEEP

#: Error of a linear skeleton up to which it will do, where the material says how it softens.
SHALLOW = 0.015
#: Inward motion over the radius to which nothing is said where it does not: a hundredth of it.
LITTLE = 0.01

_TOO_STIFF = (
    "a wall is softer there than a linear skeleton (drawn: stiffer), by 13 % at a tenth of the "
    "radius on the finite-element trachea of docs/evidence/virtual_trachea.md, by more beyond"
)
_MIDLINE = (
    "e_1 and e_2 in [material] soften a press straight in on the midline (rings 'mat'), [sections] "
    "in the place of [material] deform anywhere on the rings"
)
_LITTLE = (
    "a linear skeleton errs by some 1 % on the finite-element trachea of "
    "docs/evidence/virtual_trachea.md"
)
_ONE_PLANE = "which is for presses straight in on the midline, and this scene has a second plane"
_SERIES = "which needs coupling 'series': with 'total' the force knows nothing of the skeleton"


def reached(case: Case) -> float:
    """How far the wall is pressed in (bonded: or drawn), over the tube's radius."""
    facts = case.facts
    fixed = case.levels["contact_point"] == "fixed" or not facts.poses
    retracted, pressed = facts.way_fixed if fixed else facts.way_per_step
    draws = facts.glued or case.options.contact == "bonded"
    return max(pressed, -retracted if draws else 0.0)


def departure(softness, way):
    """Bound of what a linear skeleton errs by: |e_1| u + |e_2| u^2 at a way u, any units."""
    e_1, e_2 = map(abs, softness)
    return way * (e_1 + e_2 * way)


def _unvalidated(tested: float, share: float) -> str:
    """A doubt where the wall is moved further than the skeleton was tested; else empty."""
    if share <= tested:
        return ""
    return (
        f"but the wall is moved by {100 * share:.2g} % of the radius, and it was tested to "
        f"{100 * tested:g} %"
    )


def skeleton(case: Case) -> Verdict:
    """Softening where the press is deep and the material says how; never linear without a word.

    Raises:
        PlanError: a deep press of a material that softens, where no skeleton of a scene does.
    """
    if SECTIONS in case.facts.known:
        return _sections(case)
    given = all(name in case.facts.known for name in DEEP)
    share = reached(case)
    far = f"the wall is moved by {100 * share:.2g} % of the radius"
    cannot, cure = "", ""
    if not given:
        cannot, cure = "e_1 and e_2 are not given", "give both, or use 'linear'"
    elif case.levels["second_plane"] != "off":
        cannot = f"a skeleton softens by e_1 and e_2, {_ONE_PLANE}"
        cure = (
            "set skeleton 'linear', give [sections] in the place of [material], or press straight "
            "in on the midline: no friction, no axial motion, rings 'mat'"
        )
    elif case.options.coupling != "series":
        cannot, cure = f"a skeleton softens by e_1 and e_2, {_SERIES}", "set skeleton 'linear'"
    refused = {"softening": (cannot, cure)} if cannot else {}
    refused["sections"] = (
        "the material is that of a line of joints",
        "give a SectionMaterial, [sections] in a file, in its place",
    )
    if share == 0:
        return Verdict("linear", "nothing is pressed", refused)
    error = departure(case.facts.softness, share)
    if given and error <= SHALLOW:
        least = f"{far}: by e_1 and e_2 a linear skeleton errs by at most {100 * error:.2g} %"
        return Verdict("linear", least, refused)
    if not given and share <= LITTLE:
        return Verdict("linear", f"{far}: {_LITTLE}", refused)
    if not cannot:
        why = f"{far}, and e_1 and e_2 are given"
        return Verdict(
            "softening", why, refused, caveat=_unvalidated(line.VALIDATED_DEPTH["softening"], share)
        )
    if given and case.options.skeleton == "auto":
        raise PlanError("skeleton", "'auto'", f"{far}, and {cannot}", cure)
    caveat = ""
    if share > line.VALIDATED_DEPTH["linear"]:
        caveat = f"but {far}: {_TOO_STIFF}; {_MIDLINE}"
    return Verdict("linear", f"{far}; {cannot}", refused, caveat=caveat)


def _sections(case: Case) -> Verdict:
    """Deforming cross-sections, which have no other level; what they cannot do is refused."""
    facts, options, levels = case.facts, case.options, case.levels
    why, cure = "the material is that of deforming cross-sections", "use 'sections', or 'auto'"
    refused = {"linear": (why, cure), "softening": (why, cure)}
    if case.prescribed and facts.along > 0:
        why = "the tool moves along the tube, which deforming cross-sections do not follow"
        raise PlanError("skeleton", "'sections'", why, "press across it: one x in all rows")
    if facts.poses and levels["contact_point"] == "per_step":
        why = "the tool wanders, and its force along the surface is not known on cross-sections"
        cure = "set contact_point 'fixed', shorten the path, or give it as presses (s, phi)"
        raise PlanError("skeleton", "'sections'", why, cure)
    try:
        Options(
            options.coupling, contact=options.contact, onset_width=options.onset_width,
            transition=options.transition, skeleton="sections",
        )  # fmt: skip
    except ValueError as error:
        cure = "set contact = 'bonded' and no other key of [model]"
        raise PlanError("skeleton", "'sections'", str(error), cure) from None
    why = "the material is that of deforming cross-sections"
    return Verdict(
        "sections", why, refused, caveat=_unvalidated(sections.VALIDATED_DEPTH, reached(case))
    )
