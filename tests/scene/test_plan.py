"""What the rules choose, why, and what they refuse."""

import dataclasses

import jax
import numpy as np
import pytest
from small_scenes import BALL, BARE, MATERIAL, MESH, OUTER, SPRINGS, TUBE, ball, presses

from jaxtrachea import EffectOptions, PlanError, Poses, make_scene, simulate
from jaxtrachea.scene import facts as scene_facts
from jaxtrachea.scene.declare import RELAXES, SceneFacts
from jaxtrachea.scene.rules import make_plan
from jaxtrachea.scene.stage import Tool

ALL = frozenset({"EA_L", "EI_C", "k_t", "GA_L", "k_A", "k_B", "k_1_ring"})


def levels(**facts):
    return {e.name: e.level for e in make_plan(SceneFacts(**facts)).effects}


@pytest.mark.parametrize(
    ("facts", "expected"),
    [
        ({}, {"contact": "off", "second_plane": "off", "rings": "mat", "axial": "off",
              "friction": "off", "surface": "hermite", "dent": "8"}),
        ({"poses": True}, {"contact": "on", "dent": "16", "contact_point": "fixed"}),
        ({"poses": True, "slip": 30.0, "spacing": 10.0}, {"contact_point": "per_step",
                                                          "friction": "off"}),
        ({"slip": 2.0, "along": 0.5}, {"second_plane": "on", "axial": "off", "friction": "off"}),
        ({"slip": 2.0, "along": 0.5, "known": ALL}, {"axial": "on", "end_motion": "on",
                                                     "rings": "arch2", "shear": "on",
                                                     "two_material": "on"}),
        ({"slip": 2.0, "friction": True, "across": 0.1, "known": ALL}, {"friction": "on",
                                                                       "rings": "arch2"}),
        ({"angle": 0.3, "known": ALL}, {"second_plane": "on", "rings": "arch2", "axial": "off"}),
        ({"angle": 0.3}, {"second_plane": "on", "rings": "mat"}),
        ({"near": False}, {"dent": "off"}),
        ({"several_points": True}, {"contact_point": "per_step"}),
    ],
)  # fmt: skip
def test_rules(facts, expected):
    found = levels(**facts)
    assert {name: found[name] for name in expected} == expected


def test_every_effect_has_a_reason_and_forcing_says_so():
    plan = make_plan(SceneFacts(known=ALL, slip=1.0, along=0.5), EffectOptions(axial="off"))
    assert all(e.reason for e in plan.effects)
    assert [e.name for e in plan.effects if e.forced] == ["axial"]
    assert not plan.axial
    assert hash(plan) == hash(dataclasses.replace(plan, effects=()))


@pytest.mark.parametrize(
    ("facts", "effects", "says"),
    [
        ({}, {"friction": "on"}, "friction: 'on', but the tool has no coefficient"),
        ({"friction": True}, {"friction": "on", "contact": "bonded"}, "unilateral"),
        ({}, {"axial": "on"}, "axial: 'on', but EA_L is not given"),
        ({}, {"shear": "on"}, "GA_L"),
        ({}, {"two_material": "on"}, "k_1_ring"),
        ({}, {"end_motion": "on"}, "k_A or k_B"),
        ({}, {"rings": "arch2"}, "rings: 'arch2', but EI_C or k_t is not given"),
        ({"angle": 0.5}, {"second_plane": "off"}, "28.6 deg off the midline"),
        ({"along": 0.5}, {"second_plane": "off"}, "oblique"),
        ({"mesh": False}, {}, "surface: asked for, but the scene has no mesh"),
        ({}, {"want_surface": False, "surface": "linear"}, "output.surface is false"),
        ({}, {"want_surface": False, "dent": "8"}, "there is no surface"),
        ({}, {"dent": "16"}, "no tool to shape the dent"),
        ({"several_points": True}, {"contact_point": "fixed"}, "different contact points"),
    ],
)
def test_wishes_that_cannot_be_met_are_refused(facts, effects, says):
    with pytest.raises(PlanError, match=says.replace("(", r"\(")):
        make_plan(SceneFacts(**facts), EffectOptions(**effects))


def test_a_moving_tool_needs_a_tool():
    with pytest.raises(PlanError, match="there is none"):
        make_scene(TUBE, MATERIAL, ball([75, 1, 0], [75, -2, 0]), effects=BARE)


def test_the_wrong_kind_of_path_is_refused():
    scene = make_scene(TUBE, MATERIAL, presses([0, -1, 0]), effects=BARE)
    with pytest.raises(ValueError, match="expected Presses"):
        simulate(scene, MATERIAL, ball([75, 1, 0], [75, -2, 0]))


@pytest.mark.slow
@pytest.mark.compiling
def test_what_the_scene_holds_reaches_the_rules():
    """Facts of a path of the tool: places, direction, friction, what the material gives."""
    path = ball([75, 1, 0.5], [77, -2, 1.0])
    scene = make_scene(TUBE, MATERIAL, path, tool=Tool(BALL, 0.66), mesh=MESH)
    level = {e.name: e.level for e in scene.plan.effects}
    assert level["friction"] == level["axial"] == level["second_plane"] == "on"
    assert (level["rings"], level["dent"], level["contact_point"]) == ("arch2", "16", "fixed")
    assert level["shear"] == level["end_motion"] == "off"
    far = make_scene(TUBE, MATERIAL, ball([40, -1, 0], [90, -1, 0]), tool=BALL, effects=BARE)
    assert far.plan.contact_point == "per_step"


@pytest.mark.slow
@pytest.mark.compiling
def test_one_step_from_afar_to_a_slanting_press():
    """The way along the surface between two rows, from first touch on, counts for the plan too."""
    path = ball([70, 4, 0], [76, -2, 0], 2)
    scene = make_scene(TUBE, MATERIAL, path, tool=Tool(BALL, 0.66), effects=BARE)
    assert scene.plan.friction
    assert scene.plan.axial
    assert jax.jit(simulate)(scene, MATERIAL, path).status.tolist() == [1, 0]


@pytest.mark.parametrize(
    ("rows", "friction", "says"), [(0, None, "no rows"), (2, -0.1, "-0.1; expected a finite")]
)
def test_misuse_is_named(rows, friction, says):
    path = ball([75, 1, 0], [75, -2, 0], 2)
    path = Poses(path.rotation[:rows], path.translation[:rows])
    with pytest.raises(ValueError, match=says):
        make_scene(TUBE, MATERIAL, path, tool=Tool(BALL, friction), effects=BARE)


def test_facts_of_paths_of_any_length_are_one_program():
    """Filled up by their last pose: the facts are those of the path without."""
    short, long = (ball([75, 1, 0], [76, -2, 0], rows) for rows in (3, 61))
    plans = [make_scene(TUBE, SPRINGS, p, tool=BALL, effects=BARE).plan for p in (short, long)]
    assert plans[0] == plans[1]
    before = scene_facts._TOUCHED._plain._cache_size()
    make_scene(TUBE, SPRINGS, ball([75, 1, 0], [76, -2, 0], 40), tool=BALL, effects=BARE)
    assert scene_facts._TOUCHED._plain._cache_size() == before


def test_an_array_that_its_owner_changes_later_leaves_the_path():
    """Of any place in memory: device and numpy may share what is aligned."""
    store = np.zeros(4000)
    for shift in range(8):
        own = store[shift : shift + 3000].reshape(1000, 3)
        path = Poses(np.broadcast_to(np.eye(3), (1000, 3, 3)), own)
        own += 1.0
        assert not np.asarray(path.translation).any()
        own -= 1.0


def test_presses_at_several_places_are_told_a_cure_that_works():
    """`fixed` would be refused for them."""
    facts = SceneFacts(several_points=True, timed=True, known=frozenset({RELAXES}))
    with pytest.raises(PlanError, match="simulate the presses of each place by themselves"):
        make_plan(facts, EffectOptions())


def test_rows_that_are_clear_of_a_round_wall_ask_for_no_depth():
    """4 mm round the tube the tangent plane lies 0.45 mm above a ball that is 0.2 mm clear."""
    r = OUTER + np.array([5.2, 5.2, 5.2, 4.9])
    angle = np.array([-4, -2, 0, 0]) / r[0]
    places = np.stack([0 * r + 75, r * np.cos(angle), r * np.sin(angle)], axis=1)
    path = Poses(np.broadcast_to(np.eye(3), (4, 3, 3)), places)
    scene = make_scene(TUBE, SPRINGS, path, tool=BALL, effects=BARE)
    facts = scene_facts.facts_of(scene, SPRINGS, path)
    depth = facts.way_fixed[1] * float(TUBE.radius)
    assert 0.1 < depth < 0.13  # the patches of a round wall stand 0.02 mm out
