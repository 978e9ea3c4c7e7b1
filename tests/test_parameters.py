"""Each parameter is declared once: material, fit table, scene keys and the page follow from it."""

import dataclasses
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrachea.config import SpecError
from jaxtrachea.fitting.parameters import (
    DECLARED,
    DEFAULTS,
    OF_THE_PRESS,
    SKELETON,
    in_model,
    visible,
)
from jaxtrachea.mechanics.force_law import ON_RING, Law, coefficient, power
from jaxtrachea.mechanics.press import Options
from jaxtrachea.mechanics.sections.material import SECTION_VALUES, SectionMaterial
from jaxtrachea.scene.spec import load_scene_spec
from jaxtrachea.scene.spec_parts import MaterialSection
from jaxtrachea.trachea.material import OF_PRESS, OF_TIME, VALUES, Material, material_of
from jaxtrachea.units import unit_factor

PAGE = (Path(__file__).parents[1] / "docs" / "reference.md").read_text()
ROWS = [
    [cell.strip() for cell in line.strip("|").split("|")]
    for line in PAGE.partition("## Parameters")[2].splitlines() if line.startswith("| `")
]  # fmt: skip


def test_page_has_the_declarations_and_no_others():
    """Name, unit, meaning, option, absence, array and all that a fit does; in this order."""
    assert [row[0].strip("`") for row in ROWS] == list(DECLARED)
    for (_, unit, meaning, needs, absent, each, *fit), p in zip(
        ROWS, DECLARED.values(), strict=True
    ):
        assert unit == p.unit
        assert meaning == p.description + (f" `{p.symbol}`" if p.symbol else "")
        assert needs == (p.needs or "always")
        assert absent == (p.absent or ("0" if p.name in OF_PRESS else "needed"))
        assert each == (f"each {p.varies_by}" if p.varies_by else "")
        if p.fit is None:
            assert fit == ["not fitted", "", "", ""]
            continue
        value, *notes = fit[0].split(", ")
        assert float(value) == p.fit.value
        plain = ["fixed"] * p.fit.fixed + ["if named"] * p.fit.if_named
        assert notes == (["auto"] if p.fit.auto else plain)
        assert [float(v) for v in fit[1].split(" … ")] == [p.fit.lower, p.fit.upper]
        assert fit[2:] == [p.fit.scale, p.fit.scope]


@pytest.mark.parametrize("p", DECLARED.values(), ids=lambda p: p.name)
def test_declaration_is_sound(p):
    """A unit of its dimension with factor 1 (it is the internal one); log scales are positive."""
    assert unit_factor(p.unit, p.dimension) == 1
    if p.fit is not None:
        assert p.fit.lower < p.fit.upper
        assert p.fit.lower <= p.fit.value <= p.fit.upper
        assert (p.fit.scale == "log") == (p.fit.lower > 0) == (not p.signed)
    if coefficient(p.name):
        assert p.dimension.startswith({1: "stiff", 3: "cubic", 5: "quintic"}[power(p.name)])
        assert p.part == "contact"


def test_tables_follow():
    """Those of today, by hand: the order of a fit's columns and of a material's arguments."""
    assert list(VALUES) == [f.name for f in dataclasses.fields(Material)]
    needed = ["EI_L", "k_M", "k_1", "k_3"]
    optional = [name for name, p in VALUES.items() if p.absent]
    assert [n for n in VALUES if n not in optional] == needed
    by_place = Material(1.0, 2.0, 3.0, 4.0)
    np.testing.assert_array_equal([getattr(by_place, n) for n in needed], [1, 2, 3, 4])
    assert all(getattr(by_place, n) is None for n in optional)
    assert SKELETON == ("EI_L", "GA_L", "k_M")
    assert OF_THE_PRESS == ("onset", "force_offset", "force_slope")
    assert set(MaterialSection.model_fields) == set(VALUES)
    fields = [f.name for f in dataclasses.fields(SectionMaterial)]
    assert [*SECTION_VALUES, "extrapolated"] == fields
    assert set(VALUES) & set(SECTION_VALUES) == {"EI_C"}
    assert material_of({n: jnp.ones(()) for n in [*needed, "onset"]}).GA_L is None


def test_models_see_what_their_options_read():
    local = ["k_1", "k_3"]
    press = ["onset", "force_offset"]
    both = Options(shear=True, local="two-material")
    assert in_model(Options(), joints=False) == ["EI_L", "k_M", *local, *press]
    assert in_model(Options(coupling="total"), joints=False) == [*local, *press]
    assert "k_M" in in_model(Options(coupling="total"), joints=True)
    rich = in_model(both, joints=False)
    assert rich == ["EI_L", "GA_L", "k_M", *local, "k_1_ring", *press]
    assert "k_3_ring" in in_model(both, joints=False, named=["k_3_ring"])
    assert "k_3_ring" not in visible(Options(), joints=True)
    deep = Options(shear=True, local="two-material", skeleton="softening")
    assert set(visible(deep, joints=True)) == set(DEFAULTS) - set(SECTION_VALUES) - set(OF_TIME)
    sections = Options(skeleton="sections", contact="bonded")
    assert visible(sections, joints=False) == [
        n for n in DECLARED if n in SECTION_VALUES or n in press
    ]
    free = {n for n in visible(sections, joints=False) if not DEFAULTS[n].fixed}
    assert free == {"EI_C", "Et_L", "D_L", "c_W", "bed_n", "bed_t"}
    assert {"e_1", "e_2"}.isdisjoint(visible(both, joints=True))
    timed = Options(relaxation="parts", branches="power")
    own = ["gamma", "beta", "gamma_skeleton", "beta_skeleton"]
    assert in_model(timed, joints=False) == ["EI_L", "k_M", *local, *own, *press]


@pytest.mark.parametrize("name", Law._fields)
def test_every_coefficient_of_the_law_is_declared(name):
    """On the ligament and on a ring, where it may be left out."""
    assert coefficient(name) == coefficient(name + ON_RING) == name
    assert {name, name + ON_RING} <= set(VALUES)
    assert VALUES[name + ON_RING].needs == "two-material"
    assert coefficient("k_M") is None


SCENE = """
[material]
EI_L = "1 N mm^2"
k_M = "1 N/mm"
k_1 = "1 N/mm"
k_3 = "{}"
{}
[[path]]
s = "40 mm"
displacement = ["0 mm", "-1 mm", "0 mm"]
"""


def test_scene_keys_follow(tmp_path):
    """Units and signs by the declaration: a coefficient may soften, a stiffness is positive."""
    path = tmp_path / "scene.toml"
    rings = 'k_1_ring = "3 N/mm"\nk_3_ring = "0 N/mm^3"'
    path.write_text(SCENE.format("-2 mN/mm^3", f'GA_L = "2 kN"\n{rings}'))
    material = load_scene_spec(path).material.model_dump()
    assert (material["k_3"], material["GA_L"], material["k_3_ring"]) == (-0.002, 2000.0, 0.0)
    assert material["EA_L"] is None
    for k_3, more, words in (
        ("1 N/mm", "", ["material.k_3", "cubic_stiffness"]),
        ("0 N/mm^3", 'k_A = "0 N/mm"', ["material.k_A", "expected a positive stiffness"]),
        ("0 N/mm^3", 'k_9 = "1 N"', ["material.k_9"]),
        ("0 N/mm^3", 'k_3_ring = "1 N/mm^3"', ["material: k_3_ring needs k_1_ring; give"]),
        ("0 N/mm^3", 'k_5_ring = "1 N/mm^5"', ["material: k_5_ring needs k_1_ring; give"]),
        ("0 N/mm^3", 'GA_side = "1 N"', ["material: GA_side needs GA_L; give GA_L too, or remove"]),
    ):
        path.write_text(SCENE.format(k_3, more))
        with pytest.raises(SpecError) as error:
            load_scene_spec(path)
        assert all(word in str(error.value) for word in words), str(error.value)
