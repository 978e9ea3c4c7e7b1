"""The surface of deforming cross-sections in scenes: where its vertices go, and what is refused."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrachea import EffectOptions, Geometry, PlanError, Presses, make_scene, simulate
from jaxtrachea._errors import InputError
from jaxtrachea.mechanics.sections.material import from_wall
from jaxtrachea.scene.assemble import with_geometry, with_mesh
from jaxtrachea.scene.build import stage
from jaxtrachea.scene.declare import SECTIONS, SceneFacts
from jaxtrachea.scene.rules import make_plan
from jaxtrachea.scene.spec import SceneSpec
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.tube import make_tube

pytestmark = pytest.mark.compiling

TUBE = Geometry.create(160.0, 10.0 * np.arange(1, 16), radius=11.7)
WALL = from_wall(TUBE)
#: Rows every 5 mm, columns every 40 deg: ring ends at 120 deg, and the contacts, are vertices.
MESH = make_tube(TUBE, around=9, along=32, wall=2 * float(WALL.offset), relief=0.0, flatten=0.0)
BONDED = EffectOptions(contact="bonded")
ON, OFF = BONDED, dataclasses.replace(BONDED, want_surface=False)
ANGLE = np.radians(40.0)
run = jax.jit(simulate)


def straight(s, phi, depth):
    """Presses along the inward normal."""
    s, phi, depth = np.broadcast_arrays(
        *(np.atleast_1d(np.asarray(v, float)) for v in (s, phi, depth))
    )
    D = depth[:, None] * np.stack([0 * phi, -np.cos(phi), -np.sin(phi)], 1)
    return Presses(s, phi, D)


PATH = straight([75, 70, 75, 75, 77.0], [ANGLE, -2 * ANGLE, ANGLE, ANGLE, 0.3], [4, 6, 0, 1, -2.0])
SCENE = make_scene(TUBE, WALL, PATH, mesh=MESH, effects=ON)


def vertex(s, phi):
    """Number of the vertex there."""
    off = np.hypot(np.asarray(MESH.s) - s, np.angle(np.exp(1j * (np.asarray(MESH.phi) - phi))))
    assert off.min() < 1e-9
    return int(np.argmin(off))


@pytest.mark.slow
def test_vertices_go_with_tool_and_rings():
    """The one under the tool by the tool's way, those at ring ends as these do; rest stays."""
    D = np.array(PATH.displacement)
    D[3, 0] = 0.5  # along the tube: no row of this plan
    path = Presses(PATH.s, PATH.phi, D)
    scene, wall, path = jax.tree.map(
        lambda v: jnp.asarray(v, "float64") if jnp.issubdtype(v.dtype, jnp.floating) else v,
        (SCENE, WALL, path),
    )
    out = run(scene, wall, path)
    OK, OFF_PLAN = PressStatus.OK, PressStatus.OFF_PLAN
    assert out.status.tolist() == [OK, OK, PressStatus.NO_CONTACT, OFF_PLAN, OK]
    assert (scene.plan.surface, scene.plan.dent, out.vertices.dtype) == ("sections", 8, "float64")
    assert out.vertices.shape == (5, *MESH.vertices.shape)
    u = np.asarray(out.vertices) - np.asarray(scene.mesh.vertices)
    exact, near = 1e-9, 5e-5
    for row, at in ((0, (75, ANGLE)), (1, (70, -2 * ANGLE))):
        np.testing.assert_allclose(u[row, vertex(*at)], D[row], atol=exact)
    assert np.abs(u[2]).max() < exact * 1e-2
    assert np.isnan(u[3]).all()
    ends = [
        [vertex(s, phi) for s in np.asarray(TUBE.ring_positions)] for phi in (-3 * ANGLE, 3 * ANGLE)
    ]
    for row in (0, 4):
        for vertices, wanted in zip(ends, (out.end_U, out.end_V), strict=True):
            np.testing.assert_allclose(u[row, vertices], wanted[row], atol=near)
            assert np.abs(wanted[row]).max() > 0.1
    # A draw of 2 mm between two vertices takes those next to it along, outwards.
    assert 0.5 < u[4, vertex(75, 0.0), 1] < 2.0
    lids = np.asarray(MESH.s) % 160 == 0
    assert np.abs(u[[0, 1, 4]][:, lids]).max() < exact
    # A solution with a warning has its surface, too.
    unlike = run(scene, dataclasses.replace(wall, extrapolated=wall.extrapolated + 1), path)
    assert unlike.status[0] == PressStatus.EXTRAPOLATED
    np.testing.assert_array_equal(unlike.vertices, out.vertices)


@pytest.mark.slow
def test_derivatives():
    """By material, way and radius: reverse = forward = differences of fourth order.

    Of the midline's program, which compiles in half the time; by all modes: tests/sections.
    """
    weights = np.random.default_rng(3).normal(size=(2, *MESH.vertices.shape))
    path = straight([75.0, 71.0], 0.0, 3.0)
    scene = make_scene(TUBE, WALL, path, mesh=MESH, effects=ON)

    def value(x):
        tube = dataclasses.replace(TUBE, radius=TUBE.radius * x[3])
        material = dataclasses.replace(WALL, EI_C=WALL.EI_C * x[0], c_W=WALL.c_W * x[1])
        moved = Presses(path.s, path.phi, path.displacement * x[2])
        out = simulate(with_geometry(scene, tube), material, moved)
        return jnp.sum(weights * out.vertices)

    x = jnp.ones(4)
    forward = jax.jit(lambda x, d: jax.jvp(value, (x,), (d,)))
    reverse = np.asarray(jax.jit(jax.grad(value))(x))
    h = 1e-3
    for i, e in enumerate(np.eye(4)):
        ahead = float(forward(x, e)[1])
        assert ahead == pytest.approx(reverse[i], rel=1e-9, abs=1e-8)
        near = [float(forward(x + k * h * e, e)[0]) for k in (1, -1, 2, -2)]
        difference = (8 * (near[0] - near[1]) - (near[2] - near[3])) / (12 * h)
        assert ahead == pytest.approx(difference, rel=1e-6, abs=1e-5)


def test_without_a_surface_nothing_of_it_is_there():
    """The same scene, with and without a mesh: so one program."""
    bare = make_scene(TUBE, WALL, PATH, effects=OFF)
    meshed = make_scene(TUBE, WALL, PATH, mesh=MESH, effects=OFF)
    assert jax.tree.structure(bare) == jax.tree.structure(meshed)
    assert bare.mesh is bare.points is bare.runs is None


def test_another_mesh():
    other = make_tube(TUBE, around=7, along=16, wall=1.6, relief=0.0)
    scene = with_mesh(SCENE, other)
    assert scene.binding is None
    assert scene.points.s.shape == (17,)
    np.testing.assert_array_equal(np.asarray(scene.points.s)[scene.points.place], other.s)
    with pytest.raises(ValueError, match="scene.points is None"):
        simulate(dataclasses.replace(SCENE, points=None), WALL, PATH)


KNOWN = {"known": frozenset({SECTIONS})}


@pytest.mark.parametrize(
    ("facts", "effects", "says"),
    [
        (KNOWN, {"surface": "hermite"}, "surface: 'hermite', but it interpolates a line of joints"),
        (KNOWN, {"dent": "16"}, "dent: '16', but a press at a point has no tool"),
        (KNOWN | {"mesh": False}, {}, "the scene has no mesh"),
        ({}, {"surface": "sections"}, "surface: 'sections', but the material is that of a line"),
    ],
)
def test_what_is_refused(facts, effects, says):
    with pytest.raises(PlanError, match=says):
        make_plan(SceneFacts(**facts), EffectOptions(contact="bonded", **effects))


def test_a_plan_has_the_surface_of_its_skeleton():
    plan = make_plan(SceneFacts(**KNOWN), BONDED)
    assert (plan.surface, plan.dent) == ("sections", 8)
    assert plan.without("surface").surface is None
    with pytest.raises(InputError, match="surface is 'phong', with a skeleton 'sections'"):
        plan.at(surface="phong")
    joints = make_plan(SceneFacts(), EffectOptions())
    with pytest.raises(InputError, match="surface is 'sections', with a skeleton 'linear'"):
        joints.at(surface="sections")


FILE = {
    "trachea": {"radius": "11.7 mm"},
    "wall": {"E_C": "5.8 MPa"},
    "model": {"contact": "bonded"},
    "path": {"s": "75 mm", "phi": "30 deg", "displacement": ["0 mm", "-1 mm", "0 mm"], "steps": 2},
}


def test_the_surface_of_a_file_is_round():
    """As far outside of the mid-line as the wall is there, where a tool touches it."""
    staged = stage(SceneSpec.model_validate(FILE), Path())
    mesh = staged.scene.mesh
    np.testing.assert_allclose(mesh.distance, float(staged.scene.radius), rtol=1e-12)
    assert mesh.vertices.shape == (3430, 3)
    with pytest.raises(ValueError, match="trachea.wall: the outside of deforming cross-sections"):
        SceneSpec.model_validate(FILE | {"trachea": {"radius": "11.7 mm", "wall": "2 mm"}})
    thick = FILE | {"sections": {"offset": "6 mm"}}
    with pytest.raises(ValueError, match=r"of 12 mm \(twice offset\): wall is 12 mm"):
        stage(SceneSpec.model_validate(thick), Path())


def test_a_small_tube_has_its_own_wall():
    """Thinner than the default wall of a line of joints is thick."""
    sizes = {"radius": "0.75 mm", "length": "10 mm", "ring_height": "0.3 mm",
             "rings": {"count": 9, "first": "1 mm", "last": "9 mm"}}  # fmt: skip
    wall = {"h": "0.16 mm", "h_C": "0.1 mm", "h_M": "0.12 mm"}
    way = {"s": "5 mm", "displacement": ["0 mm", "-0.2 mm", "0 mm"], "steps": 2}
    small = SceneSpec.model_validate(FILE | {"trachea": sizes, "wall": wall, "path": way})
    scene = stage(small, Path()).scene
    np.testing.assert_allclose(scene.mesh.distance, float(scene.radius), rtol=1e-12)
    assert 0.75 < float(scene.radius) < 0.91
