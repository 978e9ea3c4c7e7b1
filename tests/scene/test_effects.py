"""An effect is declared once; options, table, plan, what a row lacks and ladders follow."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_scenes import BALL, BARE, MATERIAL, SPRINGS, TUBE, poses

from jaxtrachea import Poses, make_scene, simulate, sweep
from jaxtrachea.scene.declare import RELAXES, RELAXES_APART, SceneFacts
from jaxtrachea.scene.effects import EFFECTS, EffectOptions, goes_with
from jaxtrachea.scene.facts import facts_of
from jaxtrachea.scene.rules import make_plan
from jaxtrachea.scene.spec import EffectsSection
from jaxtrachea.status import PressStatus

run, swept = jax.jit(simulate), jax.jit(sweep)
ALL = frozenset({"EA_L", "EI_C", "k_t", "GA_L", "k_A", "k_B", "k_1_ring"})
#: What has no second plane (a tool with a width, a skeleton that softens), or no friction.
FLAT = {"width", "skeleton", "relaxation"}
#: A scene in which every other effect is on.
EVERYTHING = SceneFacts(
    poses=True, angle=0.3, along=0.5, across=0.5, slip=1.0, spacing=10.0, friction=True, known=ALL
)


def test_the_table_has_the_words_of_the_declarations():
    fields = EffectsSection.model_fields
    assert list(fields) == list(EFFECTS)
    for effect in EFFECTS.values():
        for word in ("auto", *effect.levels):
            assert getattr(EffectsSection(**{effect.name: word}), effect.name) == word
            assert getattr(EffectOptions(**{effect.name: word}), effect.name) == word
        with pytest.raises(ValueError, match=effect.name):
            EffectsSection(**{effect.name: "no such level"})


def test_a_plan_keeps_every_level_it_is_given():
    plan = make_plan(EVERYTHING)
    assert {name for name in EFFECTS if not plan.has(name)} == FLAT
    for effect in (effect for effect in EFFECTS.values() if effect.name not in FLAT):
        for level in set(effect.levels) - {"sections"}:  # with its skeleton: test_sections_surface
            assert plan.at(**{effect.name: level}).level(effect.name) == level


#: What goes with an effect, by mechanics: vectors need a second plane; clamps move on axial
#: springs and are seen on the surface only, as the dent is.
TAKES = {
    "friction": {"friction"},
    "rings": {"rings"},
    "axial": {"axial", "end_motion"},
    "surface": {"surface", "end_motion", "dent"},
    "end_motion": {"end_motion"},
    "dent": {"dent"},
    "shear": {"shear"},
    "two_material": {"two_material"},
}


def test_a_plan_without_friction_relaxes():
    known = ALL - {"EI_C", "k_t"} | {RELAXES, RELAXES_APART}
    plan = make_plan(SceneFacts(known=known, timed=True, duration=2.0))
    assert plan.level("relaxation") == "parts"
    assert plan.at(relaxation="uniform").options.relaxation == "uniform"
    assert plan.without("relaxation").ignored == {"relaxation"}


@pytest.mark.parametrize("name", EFFECTS)
def test_what_goes_with_an_effect(name):
    plan = make_plan(EVERYTHING)
    less = plan.without(name)
    if name not in TAKES:  # a place is no effect to leave out; friction holds the second plane
        assert less is None
        return
    gone = {e for e in EFFECTS if plan.has(e) and not less.has(e)}
    assert gone == TAKES[name] == {name} | goes_with(name)
    assert less.ignored == plan.ignored | gone
    assert less.without(name) is None


def test_the_second_plane_goes_without_friction():
    less = make_plan(dataclasses.replace(EVERYTHING, friction=False)).without("second_plane")
    assert (less.second_plane, less.rings, less.axial, less.end_motion) == (
        False, "mat", False, False
    )  # fmt: skip


def test_words_of_no_meaning_are_refused_from_python():
    record = object.__new__(EffectOptions)  # as users do, without a checker of annotations
    for name, value in (vars(EffectOptions()) | {"contact_point": "each"}).items():
        object.__setattr__(record, name, value)
    with pytest.raises(ValueError, match="'each'; expected 'auto' or 'fixed' or 'per_step'"):
        record.__post_init__()


#: Straight down beside the midline, a little along the tube.
DOWN = [[75.0, 18.0, 0.0], [75.5, 16.0, 0.0], [76.0, 15.0, 0.0]]


@pytest.mark.slow
@pytest.mark.compiling
def test_rows_in_the_lumen_are_no_contacts_of_the_plan():
    """The facts are those of the path without them; they made another contact point of each."""
    small = dataclasses.replace(BARE)
    inside = [[40.0, 0.0, 0.0], [40.0, 7.0, 0.0]]  # begins within the wall, and reaches into it
    away = [[75.0, 40.0, 0.0]]
    whole, outside = (
        Poses(jnp.tile(jnp.eye(3), (len(rows), 1, 1)), jnp.asarray(rows))
        for rows in (inside + away + DOWN, away + DOWN)
    )
    scene = make_scene(TUBE, SPRINGS, outside, tool=BALL, effects=small)
    assert facts_of(scene, SPRINGS, whole) == facts_of(scene, SPRINGS, outside)
    made = make_scene(TUBE, SPRINGS, whole, tool=BALL, effects=small)
    assert made.plan == scene.plan
    found = run(made, SPRINGS, whole)
    # The same program: as many rows, by two more of the last pose.
    filled = jax.tree.map(lambda v: np.concatenate([v, v[-1:], v[-1:]]), outside)
    alone = run(scene, SPRINGS, filled)
    assert found.status[:2].tolist() == [PressStatus.IN_LUMEN] * 2
    np.testing.assert_allclose(found.force[2:], alone.force[:4], rtol=1e-12)


@pytest.mark.slow
@pytest.mark.compiling
def test_a_bad_material_is_one_in_simulate_and_in_sweep():
    """Off the plan too: `sweep` said OFF_PLAN where `simulate` says BAD_MATERIAL."""
    path = poses([75, 18, 0], [75, 15, 0], 2)
    scene = make_scene(TUBE, SPRINGS, path, tool=BALL, effects=BARE)
    bad = dataclasses.replace(MATERIAL, k_1=jnp.asarray(-0.3))
    assert run(scene, bad, path).status.tolist() == [PressStatus.BAD_MATERIAL] * 2
    places, depth = np.full(3, 75.0), np.array([2.0, 0.0, 1.0])
    assert swept(scene, bad, places, np.zeros(3), depth).status.tolist() == (
        [PressStatus.BAD_MATERIAL] * 3
    )
    out = swept(scene, MATERIAL, places, np.zeros(3), depth)
    off = PressStatus.OFF_PLAN
    assert out.status.tolist() == [off, PressStatus.NO_CONTACT, off]
