"""How deep a path presses, and which skeleton that depth needs: the rule of `effects`' skeleton.

The finite-element trachea of docs/virtual_trachea.md (outer radius R = 12.6 mm) answers a press of
depth D on the midline with 1 - 0.1127 D + 0.0061 D^2 (D in mm) of its stiffness at small strain: a
linear skeleton errs there by 1.4 % at R / 100 and by 13 % at R / 10. A ring alone, pinched between
two points, is off by 15 % at R / 4 (`ranges.DEEPEST`).
"""

from jaxtrachea.mechanics.press import Options
from jaxtrachea.scene.declare import SECTIONS, Case, PlanError, Verdict

#: Inward motion over the tube's radius up to which a linear skeleton will do: it errs by some 1 %.
SHALLOW = 0.01
#: The same beyond which a linear skeleton is a note of the scene, where nothing is known to soften
#: it (as docs/fit.md has it).
DEEP = 0.1
#: Values of the material that a skeleton softens by.
SOFTENING = ("e_1", "e_2")

_TOO_STIFF = (
    "a wall is softer there than a linear skeleton (drawn: stiffer), by 13 % at a tenth of the "
    "radius on the finite-element trachea of docs/virtual_trachea.md, by more beyond"
)
_MIDLINE = (
    "e_1 and e_2 in [material] soften a press straight in on the midline (rings 'mat'), [sections] "
    "in the place of [material] deform anywhere on the rings"
)
_ONE_PLANE = "which is for presses straight in on the midline, and this scene has a second plane"
_SERIES = "which needs coupling 'series': with 'total' the force knows nothing of the skeleton"


def reached(case: Case) -> float:
    """How far the wall is pressed in (bonded: or drawn), over the tube's radius."""
    facts = case.facts
    fixed = case.levels["contact_point"] == "fixed" or not facts.poses
    drawn, pressed = facts.way_fixed if fixed else facts.way_per_step
    return max(pressed, -drawn if case.options.contact == "bonded" else 0.0)


def skeleton(case: Case) -> Verdict:
    """Softening where the press is deep and the material says how; never linear without a word.

    Raises:
        PlanError: a deep press of a material that softens, where no skeleton of a scene does.
    """
    if SECTIONS in case.facts.known:
        return _sections(case)
    given = all(name in case.facts.known for name in SOFTENING)
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
    if share <= SHALLOW:
        least = f"{far}: a linear skeleton errs by some {100 * SHALLOW:g} % at most"
        return Verdict("linear", least if share > 0 else "nothing is pressed", refused)
    if not cannot:
        return Verdict("softening", f"{far}, and e_1 and e_2 are given", refused)
    if given and case.options.skeleton == "auto":
        raise PlanError("skeleton", "'auto'", f"{far}, and {cannot}", cure)
    doubt = ""
    if share > DEEP:
        doubt = f"but {far}: {_TOO_STIFF}; {_MIDLINE}"
    return Verdict("linear", f"{far}; {cannot}", refused, doubt=doubt)


def _sections(case: Case) -> Verdict:
    """Deforming cross-sections, which have no other level; what they cannot do is refused.

    Raises:
        PlanError: naming what the user asked for and the cure.
    """
    facts, options, levels = case.facts, case.options, case.levels
    why, cure = "the material is that of deforming cross-sections", "use 'sections', or 'auto'"
    refused = {"linear": (why, cure), "softening": (why, cure)}
    if case.led and facts.along > SMALL_SHARE:
        why = "the tool moves along the tube, which deforming cross-sections do not follow"
        raise PlanError("skeleton", "'sections'", why, "press across the tube")
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
    return Verdict("sections", "the material is that of deforming cross-sections", refused)


#: Share of the tool's motion along the tube below which there is none.
SMALL_SHARE = 1e-6
