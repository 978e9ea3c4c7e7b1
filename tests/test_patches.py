"""A tube as a row of patches: closed forms, surfaces, borders, derivatives, hostile input."""

import dataclasses
import functools
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from jaxtrachea._compiler import quick_options
from jaxtrachea.contact.line import skeleton_coordinates
from jaxtrachea.contact.patches import Patches, gap_bounds, straight_patches, touch
from jaxtrachea.contact.pose import Pose, pose_from_vector
from jaxtrachea.contact.shapes import Shape, box, capsule, padded, sphere
from jaxtrachea.contact.walls import TubeSurface, patches_of
from jaxtrachea.scene.build import stage
from jaxtrachea.scene.spec import load_scene_spec
from jaxtrachea.scene.stage import touch_tube
from jaxtrachea.scene.wall import patches_of_wall
from jaxtrachea.status import ContactStatus
from jaxtrachea.trachea.geometry import table_1
from jaxtrachea.trachea.imported import read_mesh
from jaxtrachea.trachea.tube import make_tube
from jaxtrachea.tradeoff.levels import full_scene, program

ROOT = Path(__file__).parents[1]
REAL = ROOT.parent / "shared" / "data" / "meshes" / "hra_vh_male"
needs_real = pytest.mark.skipif(
    not REAL.is_dir(), reason="the Visible Human meshes (CC BY 4.0) are not beside the repository"
)
#: Most of the time here is compilation, so every pose goes through programs of this many lanes.
quick = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
LANES, SEARCHED = 250, 100
BORDERS = np.r_[0.0, np.arange(10, 151, 10), 160.0]
R, BEND = 12.0, 80.0
TUBE = straight_patches(BORDERS, R)
TOOLS = {
    "sphere": padded(sphere(2.0), 8),
    "capsule": padded(capsule(4.0, 0.7), 8),
    "box": box([2.0, 1.5, 4.0], 0.3),
}
#: The normals of a patch and of the rounded end of its neighbour, weighted with exp(-beta gap),
#: give a tilt of up to exp(-1/2) / (1 + exp(-1/2)) / sqrt(beta x distance from the axis).
TILT = 0.02


@functools.cache
def solver(near, search):
    def one(tool, patches, turn, shift):
        return touch(tool, pose_from_vector(turn, shift), patches, near=near, search=search)

    return quick(jax.vmap(one, (None, None, 0, 0)))


def solve(tool, patches, turn, at, near=2, search=False, dtype="float64"):
    """Many poses, as numpy arrays of float64."""
    lanes = SEARCHED if search else LANES

    def pad(v):
        return np.concatenate([v, np.repeat(v[-1:], -len(v) % lanes, 0)])

    chunks = []
    for t, a in zip(*(pad(v).reshape(-1, lanes, 3) for v in (turn, at)), strict=True):
        c = solver(near, search)(*cast((tool, patches, t, a), dtype))
        assert c.gap.dtype == c.point.dtype == c.normal.dtype == c.s.dtype == dtype
        fields = {k: v for k, v in vars(c).items() if v is not None} | {"complete": c.complete}
        chunks.append({k: np.asarray(v) for k, v in fields.items()})
    return SimpleNamespace(
        **{k: np.concatenate([c[k] for c in chunks])[: len(at)] for k in chunks[0]}
    )


def cast(tree, dtype):
    return jax.tree.map(lambda v: jnp.asarray(v, dtype), tree)


def places(count, low=6.0, high=30.0, seed=0, ends=(5.0, 155.0)):
    """s, phi, distance from the axis, positions, and rotation vectors of a tool."""
    rng = np.random.default_rng(seed)
    s, phi = rng.uniform(*ends, count), rng.uniform(-np.pi, np.pi, count)
    away = rng.uniform(low, high, count)
    at = np.stack([s, away * np.cos(phi), away * np.sin(phi)], axis=1)
    return s, phi, away, at, rng.normal(size=(count, 3))


def turned(angle):
    return (np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi


@pytest.mark.slow
@pytest.mark.compiling
def test_sphere_against_an_endless_cylinder():
    """Too small by at most the bound; point, normal and phi across exactly, s within the tilt."""
    dtype, rounding = "float64", 1e-11
    s, phi, away, at, turn = places(1000)
    c = solve(TOOLS["sphere"], TUBE, turn, at, dtype=dtype)
    error = c.gap - (away - R - 2)
    assert (error < rounding).all()
    assert (error > -c.bound - rounding).all()
    assert c.bound.max() < 0.1
    # 1e-3: points averaged over two directions lie a little inside the round wall.
    assert (np.abs(c.s - s) < TILT * np.abs(away - R) + 1e-3).all()
    np.testing.assert_allclose(turned(c.phi - phi), 0, atol=rounding)
    np.testing.assert_array_equal(c.status, ContactStatus.OK)
    np.testing.assert_array_equal(c.patch, s // 10)
    across = np.stack([0 * s, np.cos(phi), np.sin(phi)], axis=1)
    np.testing.assert_allclose(np.sum(c.normal * across, axis=1), 1, atol=TILT**2 / 2)
    # Eight equal vertices make the smoothed ball larger by log(8) / beta, within the bound.
    np.testing.assert_allclose(np.linalg.norm(c.tool_point - at, axis=1), 2, atol=c.bound.max())
    np.testing.assert_allclose(np.hypot(*c.point[:, 1:].T), R, atol=0.02)


@pytest.mark.slow
@pytest.mark.compiling
def test_capsule_against_an_endless_cylinder():
    """In the plane across the axis: the origin against a segment."""
    _, _, _, at, turn = places(LANES, low=14, ends=(10.0, 150.0))
    c = solve(TOOLS["capsule"], TUBE, turn, at)
    ends = Rotation.from_rotvec(turn).as_matrix()[:, :, 2] * 4.0
    a, way = at - ends, 2 * ends
    share = np.clip(-np.sum(a[:, 1:] * way[:, 1:], 1) / np.sum(way[:, 1:] ** 2, 1), 0, 1)
    nearest = a + share[:, None] * way
    error = c.gap - (np.hypot(nearest[:, 1], nearest[:, 2]) - R - 0.7)
    assert (error < 1e-11).all()
    assert (error > -c.bound).all()
    np.testing.assert_array_equal(c.status, ContactStatus.OK)
    # Where the capsule is not nearly level with the wall, its nearest end is clear.
    tilted = np.abs(np.sum(way[:, 1:] * nearest[:, 1:], 1)) / np.hypot(*nearest[:, 1:].T) > 2
    assert tilted.sum() > 100
    angle = np.arctan2(nearest[:, 2], nearest[:, 1])
    np.testing.assert_allclose(c.s[tilted], nearest[tilted, 0], atol=TILT * 18)
    np.testing.assert_allclose(turned(c.phi - angle)[tilted], 0, atol=0.02)


@pytest.mark.slow
@pytest.mark.compiling
def test_broad_phase_leaves_out_nothing():
    """Two patches searched from the broad phase's direction, or all over all directions."""
    _, _, _, at, turn = places(SEARCHED, low=10)
    for name, tool in TOOLS.items():
        two = solve(tool, TUBE, turn, at)
        every = solve(tool, TUBE, turn, at, 16, True)
        assert two.complete.all(), name
        assert not np.isfinite(every.left_out).any()
        np.testing.assert_array_equal(two.patch, every.patch)
        # The patches left out take part in the smooth minimum, with up to exp(-5) / beta = 1e-4;
        # "solved" leaves up to a hundredth of 1 / beta = 2e-4.
        np.testing.assert_allclose(two.gap, every.gap, atol=5e-4, err_msg=name)
        # A box nearly level with the wall: its witness moves far while the gap hardly changes.
        np.testing.assert_allclose(two.point, every.point, atol=0.5)


def test_bounds_are_bounds():
    """No patch is nearer than its bound says: corners of a box against capsules, by formula."""
    _, _, _, at, turn = places(LANES, low=2)
    tool = TOOLS["box"]

    def one(turn, shift):
        return gap_bounds(tool, pose_from_vector(turn, shift), TUBE)

    bounds, directions = map(np.asarray, quick(jax.vmap(one))(turn, at))
    corners = Rotation.from_rotvec(turn).as_matrix() @ np.asarray(tool.vertices) + at[:, :, None]
    off = corners[:, None, 0] - np.clip(
        corners[:, None, 0], BORDERS[:-1, None] - 0.5, BORDERS[1:, None] + 0.5
    )
    radial = np.hypot(corners[:, None, 1], corners[:, None, 2])
    gap = np.hypot(off, radial).min(axis=2) - R - 0.3
    assert (bounds <= gap + 1e-12).all()
    np.testing.assert_allclose(np.linalg.norm(directions, axis=2), 1, atol=1e-12)
    outside = gap > 0
    assert np.median((gap - bounds)[outside]) < 0.1


@pytest.mark.long
@pytest.mark.parametrize("height", [0.0, 5.0])
def test_continuous_across_borders(height):
    """Gap, s, phi and normal along a path that crosses a border, in steps of 1 and 25 um."""
    for low, high in ((59.75, 60.25), (55.0, 65.0)):
        x = np.linspace(low, high, LANES)
        step, level = x[1] - x[0], 0 * x + R + 2 + height
        at = np.stack([x, level * 0.8, level * 0.6], 1)
        c = solve(TOOLS["sphere"], TUBE, 0 * at, at)
        assert set(c.patch) == {5, 6}
        assert np.abs(np.diff(c.gap)).max() < TILT * step
        exact = level - R - float(TOOLS["sphere"].radius)  # which is in both patches' reach
        assert (c.gap <= exact + 1e-12).all()
        assert (exact <= c.gap + c.bound).all()
        if high - low < 1:  # two patches count alike: log 2 of log 32; copies of the centre do not
            assert (exact - c.gap > 0.19 * c.bound).all()
            assert (exact - c.gap < 0.3 * c.bound).all()
        slope = np.diff(c.s) / step
        assert (np.abs(slope - 1) < 0.1 * (2 + abs(height)) / 2).all()
        np.testing.assert_allclose(c.phi, np.arctan2(0.6, 0.8), atol=1e-12)
        assert np.abs(np.diff(c.normal, axis=0)).max() < 0.05 * step


POSES = {
    "far": (77.3, 60.0),
    "near": (73.0, 15.0),
    "touching": (76.0, 14.0),
    "pressed in": (71.5, 11.5),
    "on a border": (80.0, 13.0),
    "near a border": (79.97, 14.0),
    "between changes of the second patch": (75.0, 13.9),
    "beyond the end": (165.0, 10.0),
}


@pytest.mark.slow
@pytest.mark.compiling
def test_derivatives():
    """Reverse = forward = differences, of gap, s, phi, normal, witness by all six of the pose."""
    count, h = len(POSES), 1e-5

    def read(c):
        return jnp.concatenate([jnp.stack([c.gap, c.s, c.phi], -1), c.normal, c.tool_point], -1)

    def f(v, shift, tool):
        return read(touch(tool, pose_from_vector(v[:3], shift + v[3:]), TUBE))

    @quick
    @functools.partial(jax.vmap, in_axes=(None, 0, 0))
    def both(v, shift, tool):
        back = jax.vjp(lambda v: f(v, shift, tool), v)[1]
        return jax.jacfwd(f)(v, shift, tool), jax.vmap(back)(jnp.eye(9))[0]

    at = np.array([[s, d * np.cos(2.5), d * np.sin(2.5)] for s, d in POSES.values()])
    box = TOOLS["box"]  # as the padded ball says which vertices count, so does the box
    each = TOOLS["sphere"], Shape(box.vertices, box.radius, jnp.ones(box.vertices.shape[1]))
    tools = [tool for tool in each for _ in POSES]
    v0 = np.array([0.3, -0.5, 0.2, 0, 0, 0])
    stacked = jax.tree.map(lambda *v: jnp.stack(v), *tools)
    forward, reverse = both(jnp.asarray(v0), jnp.tile(at, (2, 1)), stacked)
    steps = np.concatenate([v0 + k * h * np.eye(6) for k in (-2, -1, 1, 2)])
    turn = np.repeat(steps[:, :3], count, 0)
    moved = (steps[:, None, 3:] + at).reshape(-1, 3)
    d = [read(solve(TOOLS[k], TUBE, turn, moved)) for k in ("sphere", "box")]
    d = np.concatenate([x.reshape(4, 6, count, 9) for x in d], axis=2)
    numeric = np.moveaxis((d[0] - d[3] + 8 * (d[2] - d[1])) / (12 * h), 0, 2)
    for i, place in enumerate([*POSES] * 2):
        scale = np.abs(numeric[i]).max() + 1
        np.testing.assert_allclose(forward[i], reverse[i], atol=1e-9 * scale, err_msg=place)
        # Rounding 1e-14 over h, and h^4 times fifth derivatives of order beta^4.
        np.testing.assert_allclose(forward[i], numeric[i], atol=2e-6 * scale, err_msg=place)
    # Danskin: the gap changes with the average of the normals, here a unit vector but for TILT^2.
    c = solve(TOOLS["sphere"], TUBE, np.tile(v0[:3], (count, 1)), at)
    np.testing.assert_allclose(forward[:count, 0, 3:], c.normal, atol=2e-3)


def on_arc(s, phi, away):
    """Points round an arc that bends to the front; points and frames of its line."""
    a, zero = s / BEND, 0 * s
    t, n = np.stack([np.cos(a), np.sin(a), zero], 1), np.stack([-np.sin(a), np.cos(a), zero], 1)
    centres = BEND * np.stack([np.sin(a), 1 - np.cos(a), zero], 1)
    b = np.tile([0.0, 0, 1], (len(s), 1))
    out = np.cos(phi)[:, None] * n + np.sin(phi)[:, None] * b
    return centres + np.asarray(away).reshape(-1, 1) * out, centres, np.stack([t, n, b], 2)


@functools.cache
def bent(relief: float, flatten: float) -> tuple[trimesh.Trimesh, Patches]:
    """A generated tube laid onto the arc, as a surface and as patches."""
    m = make_tube(
        table_1(), around=48, along=160, wall=2 * (R - 11.3) + 2 * relief, relief=relief,
        flatten=flatten, lids=False,
    )  # fmt: skip
    s, phi, away = (np.asarray(v) for v in (m.s, m.phi, m.distance))
    vertices, centres, frames = on_arc(s, phi, away)
    surface = TubeSurface(vertices=vertices, faces=m.faces, s=s, centres=centres, frames=frames)
    p = patches_of(surface, BORDERS, most=48)
    return trimesh.Trimesh(vertices, np.asarray(m.faces), process=False), p


@pytest.mark.long
def test_skeleton_coordinates_on_an_arc():
    s, phi, away, _, _ = places(LANES, low=1, high=40)
    point, _, _ = on_arc(s, phi, away)
    found = quick(jax.vmap(skeleton_coordinates, (None, 0)))(bent(0.0, 0.0)[1].line, point)
    # The line is known by points 1 mm apart: off by 1 / (8 BEND), twice that 40 mm inside the bend.
    np.testing.assert_allclose(found[0], s, atol=2 / (1 - 40 / BEND) / (8 * BEND))
    # The same error of the points, seen from 1 mm away.
    np.testing.assert_allclose(turned(found[1] - phi), 0, atol=1 / (8 * BEND))


@pytest.mark.slow
@pytest.mark.compiling
def test_sphere_against_a_bent_tube():
    """Closed form of the torus, within thinning, bridged hollows and smoothing."""
    s, phi, away, _, turn = places(LANES, low=10, high=18)
    at, _, _ = on_arc(s, phi, away)
    _, p = bent(0.0, 0.0)
    c = solve(sphere(2.0), p, turn, at, 3)
    error = c.gap - (away - R - 2)
    polygon = R * (1 - np.cos(np.pi / 48))
    assert (error < p.lost.max() + polygon).all()
    assert (error > -(p.filled.max() + c.bound)).all()
    assert c.complete.all()
    np.testing.assert_array_equal(c.status, ContactStatus.OK)
    # A span of 11 mm with its overlaps is bridged by 11^2 / (8 (80 - 12)) mm on the hollow side.
    assert 0.15 < p.filled.max() < 0.25
    # The witness stands beside the tool, but for the facets and the tilt.
    np.testing.assert_allclose(c.s, s, atol=0.5)
    np.testing.assert_allclose(turned(c.phi - phi), 0, atol=0.05)


def distance_to(surface: trimesh.Trimesh, points):
    """To the closest of all triangles, each with a centre near enough to hold it."""
    centres = surface.triangles_center
    reach = np.linalg.norm(surface.triangles - centres[:, None], axis=2).max()
    tree, found = cKDTree(centres), []
    for p, least in zip(points, tree.query(points)[0], strict=True):
        near = surface.triangles[tree.query_ball_point(p, least + reach)]
        closest = trimesh.triangles.closest_point(near, np.tile(p, (len(near), 1)))
        found.append(np.linalg.norm(closest - p, axis=1).min())
    return np.array(found)


def beside(surface: trimesh.Trimesh, count, radius, low, high, seed=0):
    """Centres of balls that hold a distance (or are pressed in) from random points of a surface."""
    points, face = trimesh.sample.sample_surface(surface, count, seed=seed)
    height = np.random.default_rng(seed).uniform(low, high, count)
    return points + (radius + height)[:, None] * surface.face_normals[face]


@pytest.mark.slow
@pytest.mark.compiling
def test_sphere_against_a_bent_and_flattened_surface():
    """Closest points on triangles, with rings, a flat back and a bend."""
    surface, p = bent(0.6, 0.15)
    at = beside(surface, LANES, 2.0, -1.5, 4.0)
    c = solve(sphere(2.0), p, 0 * at, at, 3)
    error = c.gap - (distance_to(surface, at) - 2)
    # Recorded: -0.74 to 0.33 mm; lost 0.37 (crests of rings), filled 0.73 (hollows), bound 0.09.
    assert (error < p.lost.max() + 1e-9).all()
    assert (error > -(p.filled.max() + c.bound)).all()
    assert abs(np.median(error)) < 0.5
    assert c.complete.all()
    np.testing.assert_array_equal(c.status, ContactStatus.OK)


@pytest.mark.slow
@pytest.mark.compiling
def test_surface_lies_where_the_patches_say():
    """Points of the surface as tools: their depth is within what is lost and filled."""
    surface, p = bent(0.6, 0.15)
    at = surface.vertices[48 * 3 : -48 * 3 : 5]
    c = solve(sphere(0.0), p, 0 * at, at, 3)
    assert (c.gap < p.lost.max() + 1e-9).all()
    assert (c.gap > -(p.filled.max() + c.bound)).all()
    assert c.gap.max() > 0.3 * p.lost.max()
    assert c.gap.min() < -0.5 * p.filled.max()


@pytest.mark.parametrize("mesh", [{}, {"around": 24, "along": 120}, {"around": 9, "along": 40}])
def test_patches_of_a_float32_mesh_are_those_of_float64(mesh):
    """Roundings split corners in two, of which each counted: contacts were up to 0.06 mm off."""
    cores = []
    for dtype in ("float32", "float64"):
        tube = table_1(dtype=dtype)
        found = patches_of_wall(tube, make_tube(tube, **mesh))
        cores.append(np.asarray(found.shapes.vertices, float))
    assert cores[0].shape == cores[1].shape
    for one, other in zip(*cores, strict=True):
        assert cKDTree(one.T).query(other.T)[0].max() < 1e-3
        assert cKDTree(other.T).query(one.T)[0].max() < 1e-3
        filled = np.sum(np.isclose(other, other[:, -1:]).all(axis=0))  # of one place, for length
        distinct = other[:, : other.shape[1] - max(filled - 1, 0)]
        assert not cKDTree(distinct.T).query_pairs(1e-3)


def test_beyond_its_ends_a_line_goes_on_straight():
    line = straight_patches(BORDERS, R).line
    for at, s, phi in (([170.0, 5, 0], 170.0, 0.0), ([-4.0, 0, 3], -4.0, np.pi / 2)):
        found = jax.jit(skeleton_coordinates)(line, jnp.asarray(at))
        np.testing.assert_allclose(found, (s, phi), atol=1e-9)


def test_straight_is_a_line_along_x():
    """Without a centreline the patches are those with the x-axis as one."""
    m = make_tube(table_1())
    axis = np.asarray(m.s)[:, None] * np.eye(3)[0]
    frames = np.tile(np.eye(3), (len(axis), 1, 1))
    surface = TubeSurface(vertices=m.vertices, faces=m.faces, s=m.s)
    a = patches_of(surface, BORDERS)
    b = patches_of(surface._replace(centres=axis, frames=frames), BORDERS)
    np.testing.assert_allclose(a.centres, b.centres, atol=1e-12)
    np.testing.assert_allclose(a.lost, b.lost, atol=1e-9)
    np.testing.assert_allclose(a.line.points[-1], b.line.points[-1], atol=1e-12)
    # The flat back is the hollow that a hull cannot follow; the relief of the rings another.
    assert a.filled.max() < 0.6 + 12.6 * 0.15


@pytest.mark.slow
@pytest.mark.compiling
def test_deep_is_told_and_a_broken_lane_keeps_to_itself():
    at = np.array([[75.0, 13, 0], [75, 0.1, 0.1], [np.nan, 13, 0], [75, 13, 0]])
    tool = box([3.0, 3.0, 3.0], 0.1)
    c = solve(tool, TUBE, np.zeros((4, 3)), at)
    expected = [ContactStatus.OK, ContactStatus.NOT_CONVERGED, ContactStatus.NON_FINITE] + [0]
    np.testing.assert_array_equal(c.status, expected)
    assert c.gap[0] == c.gap[3]
    assert np.isfinite(c.gap[:2]).all()
    # Searched over all directions: out of the cylinder by 12 + 3 less 0.1 mm off the axis.
    every = solve(tool, TUBE, 0 * at, at, 16, True)
    assert every.status[1] == ContactStatus.FLAT  # as well to the front as to the left
    assert abs(every.gap[1] + 12 + 3.1 - 0.1) < every.bound[1]


def test_a_steep_funnel_has_a_bounded_patch():
    """No face of it looks sideways."""
    m = make_tube(table_1(), relief=0.0, flatten=0.0, lids=False)
    s, phi = np.asarray(m.s), np.asarray(m.phi)
    wide = 5 + np.minimum(s, 10.0)
    vertices = np.stack([s, wide * np.cos(phi), wide * np.sin(phi)], 1)
    p = patches_of(TubeSurface(vertices=vertices, faces=m.faces, s=s), [0.0, 9.0], overlap=0.0)
    assert np.abs(p.shapes.vertices[:, 1:]).max() < 15
    np.testing.assert_allclose(p.filled, 14 - 5, atol=0.5)


@needs_real
@pytest.mark.slow
def test_real_trachea():
    """Balls beside the outer wall of a real trachea, against closest points on its triangles."""
    m = read_mesh(REAL / "3d-vh-m-trachea.glb")
    surface, outer, wall = outer_wall(m.mesh)
    borders = np.r_[0, m.geometry.ring_positions, m.geometry.length]
    p = patches_of(wall, borders, most=48)
    at = beside(outer, LANES * 2, 2.0, -1.0, 3.0)
    c = solve(sphere(2.0), p, 0 * at, at, 3)
    error = c.gap - (distance_to(surface, at) - 2)
    assert c.complete.all()
    assert (error < p.lost.max()).all()
    assert (error > -(p.filled.max() + c.bound)).all()
    # Between the first and the last ring; beyond them 17 and 32 mm with the carina are one hull.
    between = (c.s > borders[1]) & (c.s < borders[-2])
    assert between.sum() > 200
    assert np.abs(error[between]).max() < 0.5
    assert np.percentile(np.abs(error[between]), 95) < 0.15
    assert (c.status[between] != ContactStatus.OK).mean() < 0.01
    assert p.lost[1:-1].max() < 0.15
    assert p.filled[1:-1].max() < 0.5


def outer_wall(m):
    """Whole surface, outer wall, and the latter as arrays for `patches_of`."""
    v, f, s, n = (np.asarray(x) for x in (m.vertices, m.faces, m.s, m.normals))
    frames, phi = np.asarray(m.frames), np.asarray(m.phi)[:, None]
    out = np.cos(phi) * frames[:, :, 1] + np.sin(phi) * frames[:, :, 2]
    kept = np.sum(n * out, axis=1) > 0
    faces = (np.cumsum(kept) - 1)[f[kept[f].all(axis=1)]]
    centres = v - np.asarray(m.distance)[:, None] * out
    outer = trimesh.Trimesh(v[kept], faces, process=False)
    wall = TubeSurface(
        vertices=v[kept], faces=faces, s=s[kept], centres=centres[kept], frames=frames[kept]
    )
    return trimesh.Trimesh(v, f, process=False), outer, wall


def test_misuse_is_told():
    m = make_tube(table_1())
    surface = TubeSurface(vertices=m.vertices, faces=m.faces, s=m.s)
    ring = Pose(jnp.eye(3), jnp.array([75.0, 13, 0]))
    for near in (0, 17):
        with pytest.raises(ValueError, match=r"near: expected 1 to 16 .* found"):
            touch(sphere(1.0), ring, TUBE, near=near)
    for borders in ([0.0], [0.0, 0.0, 1.0], [0.0, np.nan], [3.0, 1.0]):
        with pytest.raises(ValueError, match="borders: expected two or more rising"):
            straight_patches(borders, 3.0)
    with pytest.raises(ValueError, match="radius: expected a positive number"):
        straight_patches(BORDERS, -1.0)
    with pytest.raises(ValueError, match="overlap"):
        straight_patches(BORDERS, 1.0, overlap=-1.0)
    with pytest.raises(ValueError, match="rounding, overlap, spacing, most"):
        patches_of(surface, BORDERS, rounding=1.0)
    with pytest.raises(ValueError, match="centres, frames: expected both"):
        patches_of(surface._replace(centres=np.zeros((3430, 3))), BORDERS)
    vertices = np.array(m.vertices)
    vertices[0, 0] = np.nan
    with pytest.raises(ValueError, match="vertices, s: expected finite"):
        patches_of(surface._replace(vertices=vertices), BORDERS)
    with pytest.raises(ValueError, match=r"between s = 200 and 210 mm encloses nothing: 35 vert"):
        patches_of(surface, np.r_[BORDERS, 200.0, 210.0])


@pytest.mark.long
@pytest.mark.parametrize("beta", [None, 50.0])
def test_a_patch_that_is_no_number_is_told(beta):
    """Wherever it is: the broad phase cannot know which patch is nearest."""
    pose = Pose(*map(jax.device_put, (np.eye(3), np.array([73.0, 15.6, 0.0]))))
    sharp = None if beta is None else jnp.asarray(beta)
    vertices = np.array(TUBE.shapes.vertices)
    vertices[2] = np.nan
    shapes = dataclasses.replace(TUBE.shapes, vertices=jax.device_put(vertices))
    spoilt = dataclasses.replace(TUBE, shapes=shapes)
    for tube, status in ((TUBE, ContactStatus.OK), (spoilt, ContactStatus.NON_FINITE)):
        assert int(quick(touch)(sphere(5.0), pose, tube, beta=sharp).status) == status


#: Modules of a program that are compiled beside each other; XLA's own number.
PARTS = {"xla_cpu_parallel_codegen_split_count": 32}


@pytest.mark.slow
def test_a_ball_over_the_border_of_two_patches_touches_the_border():
    """By symmetry; in a batch a compiler once rounded the patches' bounds in two ways.

    Then no patch was the lowest, and the last one, out of reach, was searched in its place: the
    gap was that of one side, 1.7e-3 mm off, in another scene 0.4 mm, with status OK.
    """
    spec = load_scene_spec(ROOT / "configs" / "deep.toml")
    full = full_scene(spec, stage(spec, ROOT / "configs"))
    scene, _, path = program(full, dataclasses.replace(full.levels, dtype="float32"))
    assert np.all(np.asarray(path.translation)[:, 0] == 75)  # between the rings at 70 and 80
    # As a ladder of `tradeoff` compiles it, whatever the flags of the suite.
    parts = PARTS if "xla_cpu_use_fusion_emitters" in quick_options() else {}
    found = jax.jit(touch_tube, compiler_options=quick_options() | parts)(scene, path)
    np.testing.assert_allclose(found.s, 75.0, atol=1e-3)
    np.testing.assert_array_equal(found.status, 0)
