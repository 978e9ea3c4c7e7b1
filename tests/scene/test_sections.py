"""Deforming cross-sections in scenes: presses anywhere on the rings, and what is refused."""

import dataclasses
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_scenes import BARE

from jaxtrachea import (
    EffectOptions,
    Geometry,
    PlanError,
    Presses,
    make_scene,
    simulate,
    sweep,
)
from jaxtrachea._errors import InputError
from jaxtrachea.mechanics.sections.material import from_wall
from jaxtrachea.mechanics.sections.press import press_sections
from jaxtrachea.scene.build import ends_not_given, material_of, stage
from jaxtrachea.scene.declare import SECTIONS, SceneFacts
from jaxtrachea.scene.rules import make_plan
from jaxtrachea.scene.spec import SceneSpec
from jaxtrachea.status import PressStatus
from jaxtrachea.tradeoff.levels import full_scene

pytestmark = pytest.mark.compiling

TUBE = Geometry.create(160.0, 10.0 * np.arange(1, 16), radius=11.7)
WALL = from_wall(TUBE)
BONDED = dataclasses.replace(BARE, contact="bonded")
OK, OFF_PLAN = PressStatus.OK, PressStatus.OFF_PLAN
run = jax.jit(simulate)


def straight(s, phi, depth):
    """Presses along the inward normal."""
    s, phi, depth = np.broadcast_arrays(
        *(np.atleast_1d(np.asarray(v, float)) for v in (s, phi, depth))
    )
    D = depth[:, None] * np.stack([0 * phi, -np.cos(phi), -np.sin(phi)], 1)
    return Presses(s, phi, D)


#: Any place on the rings, in any direction across the tube: one program.
ANYWHERE = make_scene(TUBE, WALL, straight([75, 70], [0.5, 0.0], 2.0), effects=BONDED)


@pytest.mark.slow
def test_rows_are_presses_of_their_own_in_any_order():
    """Each as `press_sections` has it along a path of its own; a draw and no motion among them."""
    s, phi = [75.0, 70.0, 75.0, 75.0, 22.0], [0.5, 0.0, -0.5, 0.5, 1.2]
    depth = [4.0, 2.0, 4.0, 0.0, -2.0]
    path = straight(s, phi, depth)
    out = run(ANYWHERE, WALL, path)
    assert out.status.tolist() == [OK, OK, OK, PressStatus.NO_CONTACT, OK]
    assert out.loads is out.vertices is None
    alone = jax.jit(press_sections)
    for i in range(5):
        one = alone(TUBE, WALL, s[i], phi[i], jnp.array([0.5, 1.0]) * depth[i])
        for name in ("force", "depth", "skeleton", "joints", "end_U", "end_V"):
            found, true = getattr(out, name)[i], getattr(one, name)[-1]
            np.testing.assert_allclose(found, true, atol=1e-11, err_msg=name)
    # The other side is the mirror image: z turned round, the ends exchanged.
    mirror = np.array([1.0, 1.0, -1.0])
    np.testing.assert_allclose(out.force[2], mirror * np.asarray(out.force[0]), atol=1e-11)
    np.testing.assert_allclose(out.end_V[2], mirror * np.asarray(out.end_U[0]), atol=1e-11)
    np.testing.assert_allclose(out.skeleton[0] + out.depth[0], path.displacement[0], atol=1e-12)


@pytest.mark.slow
def test_each_row_has_its_status():
    """Along the tube, off the tube, behind the rings, not finite, too deep; a bad stiffness."""
    path = straight([75, 500, 75, 75, 75], [0.3, 0.3, 3.0, np.nan, 0.3], [1, 1, 1, 1, 14.0])
    D = np.array(path.displacement)
    D[0, 0] = 0.5
    out = run(ANYWHERE, WALL, Presses(path.s, path.phi, D))
    status = np.asarray(out.status).tolist()
    assert status[:4] == [
        OFF_PLAN, PressStatus.OFF_TUBE, PressStatus.BEHIND_GAP, PressStatus.NON_FINITE
    ]  # fmt: skip
    assert status[4] in (PressStatus.TOO_DEEP, PressStatus.PAST_FOLD)
    assert np.isnan(out.force[:4]).any(axis=1).all()
    bad = dataclasses.replace(WALL, EI_C=-1.0 * WALL.EI_C)
    assert run(ANYWHERE, bad, path).status.tolist() == [PressStatus.BAD_MATERIAL] * 5


@pytest.mark.slow
def test_a_sweep_goes_round_the_rings():
    s, phi, depth = [75.0, 75.0, 70.0, 75.0, 75.0], [0.6, -0.6, 0.0, 3.0, 0.2], [2.0, 2, 2, 2, 0]
    out = jax.jit(sweep)(ANYWHERE, WALL, s, phi, depth)
    assert out.status.tolist() == [OK, OK, OK, PressStatus.BEHIND_GAP, PressStatus.NO_CONTACT]
    np.testing.assert_allclose(out.force[0], out.force[1], rtol=1e-10)
    rows = run(ANYWHERE, WALL, straight(s, phi, depth))
    force = np.asarray(rows.force)
    along = -force[:, 1] * np.cos(phi) - force[:, 2] * np.sin(phi)
    np.testing.assert_allclose(out.force[:3], along[:3], rtol=1e-10)
    np.testing.assert_allclose((out.compliance * out.force + out.indentation)[:3], 2.0)


KNOWN = {"known": frozenset({SECTIONS})}
ASKED = {"want_surface": False, "contact": "bonded"}


@pytest.mark.parametrize(
    ("facts", "effects", "says"),
    [
        ({}, {"want_surface": False}, "needs contact='bonded', found 'unilateral'.*set contact"),
        ({}, ASKED | {"coupling": "total"}, "needs coupling='series'"),
        ({}, ASKED | {"onset_width": 0.1}, "needs onset_width"),
        ({"along": 0.5}, ASKED, "moves along the tube"),
        ({"poses": True, "slip": 9.0, "spacing": 2.0}, ASKED | {"contact_point": "per_step"},
         "wanders.*contact_point 'fixed'"),
        ({}, ASKED | {"skeleton": "linear"}, "'linear', but the material is that of deforming"),
        ({}, ASKED | {"skeleton": "softening"}, "'softening', but the material is that of def"),
        ({}, ASKED | {"rings": "arch2"}, "rings: 'arch2', but a ring is a cross-section"),
        ({}, ASKED | {"axial": "on"}, "EA_L is not given"),
        ({}, ASKED | {"shear": "on"}, "GA_L is not given"),
    ],
)  # fmt: skip
def test_what_cross_sections_have_not_is_refused(facts, effects, says):
    with pytest.raises(PlanError, match=says):
        make_plan(SceneFacts(**KNOWN, **facts), EffectOptions(**effects))


def test_a_line_of_joints_has_no_cross_sections():
    with pytest.raises(PlanError, match="skeleton: 'sections', but the material is that of a line"):
        make_plan(SceneFacts(), EffectOptions(**ASKED, skeleton="sections"))
    plan = make_plan(SceneFacts(**KNOWN), EffectOptions(**ASKED))
    assert (plan.without("skeleton"), plan.level("skeleton")) == (None, "sections")
    for changed in ({"axial": "on"}, {"rings": "arch2"}, {"surface": "hermite"}, {"shear": "on"}):
        with pytest.raises((InputError, ValueError), match="sections"):
            plan.at(second_plane="on", **changed)
    with pytest.raises(InputError, match="contact_point 'per_step' of a tool"):
        dataclasses.replace(plan, contact=True, contact_point="per_step")


SCENE = {
    "trachea": {"radius": "11.7 mm"},
    "wall": {"E_C": "5.8 MPa"},
    "model": {"contact": "bonded"},
    "path": {"s": "75 mm", "phi": "30 deg", "displacement": ["0 mm", "-1 mm", "0 mm"], "steps": 2},
    "output": {"surface": False},
}  # fmt: skip


def test_material_of_a_file():
    """What [wall] gives, and [sections] names; or all of it in [sections]."""

    def material(**tables):
        return stage(SceneSpec.model_validate(SCENE | tables), Path()).material

    tube = Geometry.create(160.0, 10.0 * np.arange(1, 16), radius=11.7)
    staged = stage(SceneSpec.model_validate(SCENE), Path())
    outer = 10.0 + 2.6 + 11.7 - 11.730  # mid-line of a ring: tests/sections/test_specimen.py
    assert float(staged.scene.radius) == pytest.approx(outer, abs=1e-3)
    both = material(sections={"EI_C": "30 N mm^2", "c_n": "0.004 mm/N"})
    expected = dataclasses.replace(from_wall(tube), EI_C=30.0, c_n=0.004)
    assert jax.tree.all(jax.tree.map(lambda a, b: bool(jnp.all(a == b)), both, expected))
    said = {
        "offset": "0.9 mm", "EI_C": "23 N mm^2", "EI_M": "2 N mm^2", "Et_M": "0.6 N/mm",
        "bed_n": "0.02 N/mm^3", "bed_t": "0.002 N/mm^3", "Gt_L": "20 N/mm", "Et_L": "1.2 N/mm",
        "D_L": "4 N mm", "c_W": "0.9 1/N/mm",
    }  # fmt: skip
    alone = material(wall=None, sections=said)
    (note,) = ends_not_given(SceneSpec.model_validate(SCENE | {"wall": None, "sections": said}))
    assert "c_end = 1, k_end = inf, footprint = 1 (not given)" in note
    own = said | {"c_end": "0", "k_end": "0.16 1/mm", "footprint": "2.85"}
    assert ends_not_given(SceneSpec.model_validate(SCENE | {"wall": None, "sections": own})) == ()
    assert ends_not_given(SceneSpec.model_validate(SCENE)) == ()
    assert (float(alone.D_L), float(alone.rho)) == (4.0, 1e-3)
    assert np.isinf(alone.k_end)
    with pytest.raises(ValueError, match=re.escape("sections.D_L: missing; give it, or [wall]")):
        material(wall=None, sections={k: v for k, v in said.items() if k != "D_L"})
    with pytest.raises(ValueError, match=r"sections: not together with \[material\]"):
        material(sections=said, material={"EI_L": "1 N mm^2", "k_M": "1 N/mm", "k_1": "1 N/mm",
                                          "k_3": "0 N/mm^3"})  # fmt: skip
    with pytest.raises(ValueError, match="trachea.file: .* outer wall"):
        material(trachea={"file": "a.stl"})
    with pytest.raises(ValueError, match="wall.h_C is 4.0 mm"):
        material(wall={"h_C": "4 mm"})
    for low, says in (
        ({"c_end": -1}, "c_end is -1; expected 0 or more"),
        ({"c_K": "-2 mm^2"}, "c_K is -2 mm^2; expected 0 or more"),
        ({"footprint": 0.5}, "footprint is 0.5; expected 1 or more"),
    ):
        with pytest.raises(ValueError, match=re.escape(says)):
            material(sections=low)


def test_factors_that_are_left_of_another_tube_are_extrapolated():
    """Estimates of a fit keep what the fit kept fixed, until that is named as well."""

    def extrapolated(sections, wall=None, **model):
        tables = {"sections": sections, "wall": wall or {"E_C": "9 MPa"}, "model": model}
        spec = SceneSpec.model_validate(SCENE | tables)
        return bool(material_of(spec, TUBE).extrapolated)

    fitted = {"EI_C": "23 N mm^2", "bed_n": "0.02 N/mm^3", "bed_t": "0.002 N/mm^3",
              "Et_L": "1.2 N/mm", "D_L": "4 N mm", "c_W": "0.9 1/N/mm"}  # fmt: skip
    rest = {"Et_M": "0.6 N/mm", "Gt_L": "20 N/mm", "k_end": "0.16 1/mm", "footprint": 2.85,
            "c_t": "0.1 mm/N", "c_t_ring": "0.1 mm/N"}  # fmt: skip
    assert extrapolated({})
    assert extrapolated(fitted)
    assert extrapolated(fitted | {k: v for k, v in rest.items() if k != "footprint"})
    assert not extrapolated(fitted | rest)
    like = {"E_C": "5.8 MPa"}
    assert not extrapolated({}, like)
    assert extrapolated({}, like, half_width="2.4 mm")
    spec = SceneSpec.model_validate(SCENE | {"wall": like, "model": {"half_width": "2.4 mm"}})
    assert material_of(spec, TUBE).footprint == 1


def test_cross_sections_are_not_traded():
    spec = SceneSpec.model_validate(SCENE)
    with pytest.raises(PlanError, match="nothing of deforming cross-sections is traded"):
        full_scene(spec, stage(spec, Path()))
