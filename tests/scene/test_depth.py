"""Deep presses of a scene: a skeleton that softens, and the rule that chooses it."""

import dataclasses
import functools
import re

import beam_fem
import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from small_scenes import BALL, BARE, MATERIAL, MESH, OUTER, SPRINGS, TUBE, ball

from jaxtrachea import (
    EffectOptions,
    PlanError,
    Poses,
    Presses,
    make_scene,
    simulate,
    sweep,
)
from jaxtrachea._errors import InputError
from jaxtrachea.mechanics.energy import StraightPress, gradient
from jaxtrachea.mechanics.press import Options
from jaxtrachea.scene.build import dropped_effects
from jaxtrachea.scene.declare import SceneFacts
from jaxtrachea.scene.depth import SHALLOW
from jaxtrachea.scene.facts import facts_of
from jaxtrachea.scene.ranges import lacking
from jaxtrachea.scene.rules import make_plan
from jaxtrachea.status import PressStatus

pytestmark = pytest.mark.compiling

E_1, E_2 = 0.1127, 0.0061
SOFT = dataclasses.replace(SPRINGS, e_1=jnp.array(E_1), e_2=jnp.array(E_2))
BONDED = dataclasses.replace(BARE, contact="bonded")
OK, OFF_PLAN = PressStatus.OK, PressStatus.OFF_PLAN
run = jax.jit(simulate)


def down(depths, s=75.0):
    """Presses straight in on the midline."""
    D = np.asarray(depths, float)
    return Presses(np.full(len(D), s), np.zeros(len(D)), np.stack([0 * D, -D, 0 * D], 1))


def beam(material, s):
    """Deflections per unit force at s, in 80 digits (`beam_fem`)."""
    x = np.asarray(TUBE.ring_positions)
    EI, k = [float(material.EI_L)] * (len(x) + 1), [float(material.k_M)] * len(x)
    return beam_fem.solve(x, float(TUBE.length), EI, k, s, 1.0)


def solved(material, s, D):
    """Depth, deflection and force: small strain by bisection in 40 digits, times the ratio."""
    c = mp.mpf(str(beam(material, s).w_C))
    k_1, k_3, e_1, e_2 = (mp.mpf(float(getattr(material, n))) for n in ("k_1", "k_3", "e_1", "e_2"))
    with mp.workdps(40):
        sign, D = (-1 if D < 0 else 1), abs(mp.mpf(D))
        low, high = mp.mpf(0), D
        for _ in range(130):
            middle = (low + high) / 2
            less = middle + c * (k_1 * middle + k_3 * middle**3) < D
            low, high = (middle, high) if less else (low, middle)
        ratio = 1 - sign * e_1 * D + e_2 * D**2
        return sign * low, sign * (D - low), sign * ratio * (k_1 * low + k_3 * low**3)


@pytest.mark.parametrize("s", [70.0, 73.3])
def test_force_and_skeleton_are_those_of_the_law(s):
    """On a ring and between two, presses and a draw: everything that a row has."""
    depths = [-2.0, 0.5, 3.0, 6.0]
    path = down(depths, s)
    scene = make_scene(TUBE, SOFT, path, effects=BONDED)
    assert scene.plan.level("skeleton") == "softening"
    out = run(scene, SOFT, path)
    assert out.status.tolist() == [OK] * 4
    unit = beam(SOFT, s)
    for i, D in enumerate(depths):
        d, u, force = (float(v) for v in solved(SOFT, s, D))
        load = u / float(unit.w_C)
        for name, along, true in (
            ("force", out.force[i], force), ("depth", out.depth[i], -d),
            ("skeleton", out.skeleton[i], -u),
        ):  # fmt: skip
            sign = -1 if name == "force" else 1
            np.testing.assert_allclose(along, [0, sign * true, 0], rtol=1e-9, err_msg=name)
        for name, per_unit, factor in (
            ("joints", unit.w, load), ("end_U", unit.w, load), ("loads", unit.reaction, force),
        ):  # fmt: skip
            true = -factor * np.array([float(v) for v in per_unit])
            found = np.asarray(getattr(out, name))[i]
            np.testing.assert_allclose(found[:, 1], true, rtol=1e-7, atol=1e-12, err_msg=name)
            assert not found[:, [0, 2]].any()


def test_the_surface_follows_the_skeleton_not_the_force():
    """As a linear one does that is pressed until its skeleton moves as far."""
    effects = EffectOptions(dent="off", contact="bonded")
    scene = make_scene(TUBE, SOFT, down([5.0]), mesh=MESH, effects=effects)
    soft = run(scene, SOFT, down([5.0]))
    unit = beam(SOFT, 75.0)
    u = float(solved(SOFT, 75.0, 5.0)[1])
    load = u / float(unit.w_C)
    d = float(mp.findroot(lambda d: 0.3 * d + 0.02 * d**3 - load, 1.0))
    linear = make_scene(TUBE, SPRINGS, down([d + u]), mesh=MESH, effects=effects)
    alike = run(linear, SPRINGS, down([d + u]))
    moved = np.abs(np.asarray(soft.vertices[0]) - np.asarray(MESH.vertices)).max()
    assert moved > u / 2
    np.testing.assert_allclose(soft.vertices, alike.vertices, atol=1e-9)
    assert abs(float(soft.force[0, 1] / alike.force[0, 1])) < 0.9


@pytest.mark.slow
def test_the_energy_by_the_place_is_that_of_the_work():
    """Differences of fourth order of the work over the way, by quadrature in 15 digits."""
    material = dataclasses.replace(SOFT, GA_L=jnp.array(9.0))
    options = Options(skeleton="softening", shear=True, contact="bonded")
    s, D = 73.3, 4.0
    path = down([D], s)
    scene = make_scene(TUBE, material, path, effects=BONDED)
    assert scene.plan.options == options
    out = run(scene, material, path)
    x = np.asarray(TUBE.ring_positions)
    EI, k = [1.86] * (len(x) + 1), [0.1] * len(x)
    GA = [9.0] * (len(x) + 1)

    def stored(s):
        c = mp.mpf(str(beam_fem.solve(x, 160.0, EI, k, s, 1.0, GA).w_C))

        def force(x):
            d = mp.findroot(lambda d: d + c * (0.3 * d + 0.02 * d**3) - x, x / (1 + 0.3 * c))
            return (1 - E_1 * x + E_2 * x**2) * (0.3 * d + 0.02 * d**3)

        return mp.quad(force, [0, D])

    h = 0.01
    true = (8 * (stored(s + h) - stored(s - h)) - stored(s + 2 * h) + stored(s - 2 * h)) / (12 * h)
    unit = beam_fem.solve(x, 160.0, EI, k, s, 1.0, GA)
    theta = np.array([float(out.skeleton[0, 1]) * float(unit.theta_C) / float(unit.w_C), 0.0])
    solved_press = StraightPress(
        jnp.asarray(s), jnp.asarray(0.0), jnp.asarray(D), out.force[0], out.depth[0],
        jnp.asarray(theta), out.loads[0],
    )  # fmt: skip
    how = {"options": options, "rings": "mat", "axial": False, "one_plane": True}
    by = jax.jit(functools.partial(gradient, **how))(TUBE, material, solved_press).s
    assert abs(float(true)) > 1e-3
    np.testing.assert_allclose(by, float(true), rtol=1e-6)


GIVEN = frozenset({"e_1", "e_2"})
#: e_1 R and e_2 R^2 of the finite-element trachea, R = 12.6 mm.
OF_FE = (0.1127 * 12.6, 0.0061 * 12.6**2)


@pytest.mark.parametrize(
    ("facts", "effects", "level", "reason"),
    [
        ({"way_fixed": (0.0, 0.3)}, {}, "linear", "30 % of the radius; e_1 and e_2 are not given"),
        ({"way_fixed": (0.0, 0.3), "known": GIVEN}, {}, "softening", "30 % of the radius, and e_1"),
        # 1.4 * 0.009 + 0.97 * 0.009^2; with ten times the e_1 not little any more.
        ({"way_fixed": (0.0, 0.009), "known": GIVEN}, {}, "linear", "errs by at most 1.3 %"),
        ({"way_fixed": (0.0, 0.009), "known": GIVEN, "softness": (14.0, 0.0)}, {}, "softening",
         "0.9 % of the radius, and e_1"),
        ({"way_fixed": (0.0, 0.009)}, {}, "linear", "errs by some 1 % on the finite-element"),
        ({"known": GIVEN}, {}, "linear", "nothing is pressed"),
        ({"way_fixed": (-0.3, 0.0), "known": GIVEN}, {}, "linear", "nothing is pressed"),
        ({"way_fixed": (-0.3, 0.0), "known": GIVEN}, {"contact": "bonded"}, "softening", "30 %"),
        ({"way_per_step": (0.0, 0.3), "known": GIVEN, "poses": True}, {}, "linear", "nothing"),
        ({"way_per_step": (0.0, 0.3), "known": GIVEN, "poses": True, "slip": 9.0, "spacing": 2.0},
         {}, "softening", "30 %"),
        ({"way_fixed": (0.0, 0.009), "known": GIVEN, "angle": 0.5}, {}, "linear", "errs by at"),
        ({"way_fixed": (0.0, 0.3), "known": GIVEN}, {"skeleton": "linear"}, "linear", "you wish"),
        ({"way_fixed": (0.0, 0.3), "known": GIVEN, "angle": 0.5}, {"skeleton": "linear"}, "linear",
         "as you wish"),
        ({"known": GIVEN}, {"skeleton": "softening"}, "softening", "as you wish"),
    ],
)  # fmt: skip
def test_the_rule(facts, effects, level, reason):
    plan = make_plan(SceneFacts(**({"softness": OF_FE} | facts)), EffectOptions(**effects))
    found = next(e for e in plan.effects if e.name == "skeleton")
    assert (found.level, plan.options.skeleton) == (level, level)
    assert reason in found.reason


DEEP = {"way_fixed": (0.0, 0.3), "known": GIVEN, "softness": OF_FE}


@pytest.mark.parametrize(
    ("facts", "effects", "says"),
    [
        ({}, {"skeleton": "softening"}, "'softening', but e_1 and e_2 are not given; give both"),
        (DEEP | {"angle": 0.5}, {}, "skeleton: 'auto', but the wall is moved by 30 % .* midline.*"
         "; set skeleton 'linear'"),
        (DEEP | {"known": GIVEN | {"EI_C", "k_t"}}, {}, "second plane.*rings 'mat'"),
        (DEEP, {"coupling": "total"}, "with 'total' the force knows nothing.*; set skeleton"),
        (DEEP, {"coupling": "total", "skeleton": "softening"}, "'softening', but a skeleton soft"),
        (DEEP | {"friction": True, "slip": 1.0}, {"skeleton": "softening"}, "second plane"),
    ],
)  # fmt: skip
def test_what_softens_is_never_linear_without_a_word(facts, effects, says):
    with pytest.raises(PlanError, match=says):
        make_plan(SceneFacts(**facts), EffectOptions(**effects))


def notes_of(depth, material=SPRINGS, **effects):
    path = down([depth])
    effects = dataclasses.replace(BARE, **effects)
    return dropped_effects(make_scene(TUBE, material, path, effects=effects))


def test_a_deep_scene_that_cannot_soften_says_so():
    """From a tenth of the radius on; not where it softens, nor where the user wished it linear."""
    (note,) = notes_of(0.11 * OUTER)
    assert note.startswith("skeleton: linear, but the wall is moved by 11 % of the radius")
    assert "e_1 and e_2" in note
    assert notes_of(0.09 * OUTER) == notes_of(3.0, SOFT) == notes_of(3.0, skeleton="linear") == ()


def test_a_scene_deeper_than_the_skeleton_was_tested_says_so():
    """To half of the radius."""
    assert notes_of(0.49 * OUTER, SOFT) == ()
    (note,) = notes_of(0.51 * OUTER, SOFT)
    assert note.startswith("skeleton: softening, but the wall is moved by 51 % of the radius")
    assert "tested to 50 %" in note


def test_softer_than_the_specimen_softens_sooner():
    """Pressed by 0.1 mm with e_1 = 3 / mm: a linear skeleton would err by 30 %."""
    soft = dataclasses.replace(SPRINGS, e_1=jnp.array(3.0), e_2=jnp.array(3.5))
    assert make_scene(TUBE, soft, down([0.1]), effects=BARE).plan.level("skeleton") == "softening"
    assert make_scene(TUBE, SOFT, down([0.1]), effects=BARE).plan.level("skeleton") == "linear"


@pytest.mark.long
def test_ways_of_a_path_over_the_radius():
    """Of a tool that holds its place, and of one that wanders; of presses in any direction."""
    facts = facts_of(make_scene(TUBE, SOFT, down([3.0, -1.0]), effects=BARE), SOFT, down([3.0, -1]))
    np.testing.assert_allclose(facts.way_fixed, np.array([-1, 3]) / OUTER)
    aside = Presses([75.0], [0.5], [[1.0, -2 * np.cos(0.5), -2 * np.sin(0.5)]])
    scene = make_scene(TUBE, SPRINGS, aside, effects=BARE)
    np.testing.assert_allclose(facts_of(scene, SPRINGS, aside).way_fixed, np.array([0, 2]) / OUTER)
    path = ball([75, 1, 0], [75, -2, 0], 7)
    path = Poses(path.rotation, path.translation.at[5].set(jnp.nan))
    scene = make_scene(TUBE, SOFT, path, tool=BALL, effects=BARE)
    facts = facts_of(scene, SOFT, path)
    # The wall of patches lies lower than the round tube by up to 0.4 mm (docs/simulate.md).
    for least, most in (facts.way_fixed, facts.way_per_step):
        np.testing.assert_allclose(most * OUTER, 2.0, atol=0.4)
        assert least <= 0


@pytest.mark.slow
def test_rows_that_need_a_softer_skeleton_are_off_the_plan():
    """A plan made shallow: its linear skeleton serves what is shallow."""
    # e_1 u + e_2 u^2 is the largest error that a linear skeleton may have.
    limit = (np.sqrt(E_1**2 + 4 * E_2 * SHALLOW) - E_1) / (2 * E_2)
    path = down([0.5 * limit, 0.99 * limit])
    scene = make_scene(TUBE, SOFT, path, effects=BARE)
    assert scene.plan.level("skeleton") == "linear"
    assert lacking(scene, SOFT) == ["axial", "skeleton"]
    more = down([0.99 * limit, 1.01 * limit, 3.0, -3.0])
    expected = [OK, OFF_PLAN, OFF_PLAN, PressStatus.NO_CONTACT]
    assert run(scene, SOFT, more).status.tolist() == expected
    assert run(scene, SPRINGS, more).status.tolist() == [OK] * 3 + expected[3:]
    swept = jax.jit(sweep)(scene, SOFT, more.s, more.phi, -more.displacement[:, 1])
    assert swept.status.tolist() == expected
    assert np.isnan(swept.force[1:3]).all()
    wished = dataclasses.replace(BARE, skeleton="linear")
    scene = make_scene(TUBE, SOFT, path, effects=wished)
    assert run(scene, SOFT, more).status.tolist() == [OK] * 3 + expected[3:]


def test_a_sweep_of_the_midline_softens():
    """Off the midline it is off the plan, behind the rings and off the tube as ever."""
    scene = make_scene(TUBE, SOFT, down([4.0]), effects=BARE)
    s = [75.0, 73.3, 75.0, 75.0, 75.0, 500.0, 75.0]
    phi = [0.0, 0.0, 0.4, 3.0, 0.4, 0.0, np.nan]
    depth = [4.0, 2.0, 4.0, 4.0, 0.0, 2.0, 1.0]
    out = jax.jit(sweep)(scene, SOFT, s, phi, depth)
    assert out.status.tolist() == [
        OK, OK, OFF_PLAN, PressStatus.BEHIND_GAP, PressStatus.NO_CONTACT, PressStatus.OFF_TUBE,
        PressStatus.NON_FINITE,
    ]  # fmt: skip
    for i in (0, 1):
        d, u, force = (float(v) for v in solved(SOFT, s[i], depth[i]))
        # The smooth first touch takes 5e-4 mm.
        np.testing.assert_allclose(out.force[i], force, rtol=1e-3)
        np.testing.assert_allclose(out.compliance[i], u / force, rtol=1e-3)
        np.testing.assert_allclose(out.indentation[i], d, rtol=1e-3)
    assert np.isnan(np.asarray(out.force)[[2, 3, 5, 6]]).all()
    assert out.force[4] == 0


@pytest.mark.parametrize(("one", "other"), [("e_1", "e_2"), ("e_2", "e_1")])
def test_half_a_law_is_refused(one, other):
    material = dataclasses.replace(SPRINGS, **{one: jnp.array(0.1)})
    with pytest.raises(
        InputError, match=re.escape(f"Material.{one}: given without Material.{other}")
    ):
        make_scene(TUBE, material, down([4.0]), effects=BARE)


def test_a_plan_of_vectors_has_no_skeleton_that_softens():
    plan = make_scene(TUBE, MATERIAL, down([4.0]), effects=BARE).plan
    assert plan.second_plane
    with pytest.raises(InputError, match="options.skeleton is 'softening', with second_plane 'on'"):
        plan.at(skeleton="softening")
    flat = make_scene(TUBE, SOFT, down([4.0]), effects=BARE).plan
    assert flat.without("skeleton").ignored >= {"skeleton"}
    assert flat.without("skeleton").level("skeleton") == "linear"
    assert flat.at(skeleton="softening") == flat
