"""Tools of several convex parts: the deepest touches; the contact of the whole, if they are it."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrachea.contact.patches import straight_patches, touch
from jaxtrachea.contact.pose import Pose, pose_from_vector
from jaxtrachea.contact.shapes import (
    MAX_PARTS,
    Shape,
    box,
    capsule,
    cloud,
    compound,
    parts_of,
    sphere,
)
from jaxtrachea.output.solids import tool_distance, tool_triangles
from jaxtrachea.status import ContactStatus
from jaxtrachea.trachea.mesh import volume
from jaxtrachea.viewer.protocol import foremost
from jaxtrachea.viewer.scene import reach

#: Most of the time here is compilation.
quick = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
R = 12.0
TUBE = straight_patches(np.r_[0.0, np.arange(10, 151, 20), 160.0], R)
BETA, LANES = 50.0, 60


def at(x, y, z, turn=(0.0, 0.0, 0.0)):
    """A place in the frame of the tool."""
    return pose_from_vector(jnp.asarray(turn), jnp.asarray([x, y, z], float))


HALF = box([1.5, 2.0, 4.0], 0.5)
WHOLE = box([3.0, 2.0, 4.0], 0.5)
HALVES = compound([HALF, HALF], [at(-1.5, 0, 0), at(1.5, 0, 0)])
BALL, BRICK = sphere(2.0), box([1.0, 1.0, 3.0])
#: A ball and a brick, 10 mm apart: parts of unlike numbers of vertices.
PAIR = compound([BALL, BRICK], [at(0, 0, -5), at(0, 0, 5)])
APART = [cloud([[0, 0, -5.0]], 2.0), Shape(BRICK.vertices + np.c_[[0, 0, 5.0]], BRICK.radius)]


@functools.cache
def solver(near):
    def one(tool, tube, turn, shift, beta):
        return touch(tool, pose_from_vector(turn, shift), tube, near=near, beta=beta)

    return quick(jax.vmap(one, (None, None, 0, 0, None)))


def poses(seed=0):
    """Tools turned anyhow, beside the tube and up to 1.5 mm in it."""
    draw = np.random.default_rng(seed)
    phi, high = draw.uniform(-1.2, 1.2, LANES), draw.uniform(14.0, 22.0, LANES)
    place = np.stack([draw.uniform(20, 140, LANES), high * np.cos(phi), high * np.sin(phi)], 1)
    return draw.normal(size=(LANES, 3)) * 0.6, place


def solve(tool, near, turn, place, dtype="float64"):
    given = tool, TUBE, turn, place, np.float64(BETA)
    return solver(near)(*jax.tree.map(lambda v: jnp.asarray(v, dtype), given))


@pytest.mark.long
def test_two_halves_are_the_whole():
    """Within the smoothing of the cut: both parts have its vertices and its faces."""
    whole, halves = (solve(v, n, *poses(), "float64") for v, n in ((WHOLE, 3), (HALVES, 6)))
    assert whole.part is None
    more = np.asarray(whole.gap - halves.gap)
    slack = 0.01 / BETA
    assert more.min() >= -slack  # the cut's own vertices, which the whole has not
    assert more.max() <= np.log(2) / BETA + slack
    beside = np.linalg.norm(whole.point - halves.point, axis=1)
    assert np.median(beside) < 5e-3
    assert set(np.unique(halves.part)) == {0, 1}
    assert np.all(halves.complete)


@pytest.mark.long
def test_the_deeper_part_alone_but_at_ties():
    """And a ball that fills up 8 vertices is a ball."""
    turn, place = poses(1)
    pair = solve(PAIR, 6, turn, place)
    alone = [solve(v, 3, turn, place) for v in APART]
    gaps = np.stack([v.gap for v in alone])
    away = np.abs(gaps[0] - gaps[1]) > 30 / BETA
    assert 0.5 < away.mean() < 1
    deeper = gaps.argmin(axis=0)
    assert set(deeper[away]) == {0, 1}
    np.testing.assert_array_equal(pair.part[away], deeper[away])
    for name in ("gap", "point", "normal", "s", "phi", "tool_point"):
        both = np.stack([getattr(v, name) for v in alone])
        expected = both[deeper, np.arange(LANES)]
        np.testing.assert_allclose(getattr(pair, name)[away], expected[away], atol=1e-9)
    low = gaps.min(axis=0)
    assert (pair.gap <= low + 1e-12).all()
    assert (pair.gap >= low - np.log(2) / BETA - 1e-12).all()


@pytest.mark.long
def test_a_tie_is_smooth_and_told():
    """Two balls turned through the pose where both are as deep: derivative, and the status."""
    balls = compound([sphere(2.0), sphere(2.0)], [at(-5, 0, 0), at(5, 0, 0)])

    def seen(angle, height=14.05):
        place = jnp.stack([jnp.asarray(v, float) for v in (80, height, 0)])
        pose = pose_from_vector(jnp.stack([0 * angle, 0 * angle, angle]), place)
        return touch(balls, pose, TUBE, near=4, beta=jnp.asarray(BETA))

    angles = np.linspace(-0.02, 0.02, 41)
    run = quick(jax.vmap(lambda v: (jax.value_and_grad(lambda a: seen(a).gap)(v), seen(v))))
    ((gap, slope), found), step = run(jnp.asarray(angles)), 1e-6
    up, down = (run(jnp.asarray(angles + d))[0][0] for d in (step, -step))
    np.testing.assert_allclose(slope, (up - down) / (2 * step), atol=1e-6)
    alone = solve(BALL, 3, np.zeros((LANES, 3)), np.tile([75.0, 14.05, 0], (LANES, 1)))
    np.testing.assert_allclose(gap[20], alone.gap[0] - np.log(2) / BETA, atol=1e-9)
    np.testing.assert_allclose(found.s[::20], [85, 80, 75], atol=0.1)
    flat = np.asarray(found.status) == ContactStatus.FLAT
    assert flat[20]
    assert not flat[[0, 40]].any()
    # Both well in the wall, one deeper: there are two contacts.
    both = quick(seen)(jnp.asarray(0.05), 13.0)
    assert (int(both.status), int(both.part)) == (ContactStatus.FLAT, 0)
    np.testing.assert_allclose(both.s, 75, atol=0.1)


def test_equal_points_count_once():
    corners = np.asarray(HALF.vertices).T
    again = cloud(np.concatenate([corners, corners[::-1], corners[:3]]), 0.5)
    np.testing.assert_array_equal(again.vertices, HALF.vertices)


def test_parts_come_back():
    found = parts_of(PAIR)
    assert [part.vertices.shape[1] for part in found] == [1, 8]
    for part, expected in zip(found, APART, strict=True):
        np.testing.assert_array_equal(part.vertices, expected.vertices)
    assert len(parts_of(compound([PAIR, BALL, HALVES]))) == 5


def test_pictures_have_all_parts():
    """Volumes, distances and tips of each, written out."""
    expected = 4 / 3 * np.pi * 2**3 + 2 * 2 * 6
    assert abs(volume(*tool_triangles(PAIR)) / expected - 1) < 0.02
    away = tool_distance(PAIR, np.array([[0, 0, -8.0], [0, 3, 5], [0, 0, 0]]))
    np.testing.assert_allclose(away, [1, 2, 2], atol=0.02)
    np.testing.assert_allclose(reach(PAIR, np.array([0, 0, 1.0])), 8)
    np.testing.assert_allclose(foremost(PAIR, np.eye(3), np.array([0, 0, -1.0])), [0, 0, -7])


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: compound([]), "shapes: expected 1 to 32 convex parts, found 0"),
        (lambda: compound([HALVES] * (MAX_PARTS // 2 + 1)), "found 34"),
        (lambda: compound([BALL], [at(0, 0, 0)] * 2), r"poses: expected one a shape .1., found 2"),
        (
            lambda: compound([BALL], [Pose(jnp.diag(jnp.array([1.0, 1, -1])), jnp.zeros(3))]),
            "poses: rotation of part 0: row 0 .* is no rotation",
        ),
        (
            lambda: touch(HALVES, at(0, 20, 0), TUBE, near=99),
            "near: expected 1 to 18 .the number of patches, 9, times that of parts, 2",
        ),
        (
            lambda: compound([BALL, capsule(1.0, 1.0, "float32")]),
            "shapes: part 1 is float32; expected float64",
        ),
    ],
)  # fmt: skip
def test_what_is_no_tool(make, words):
    with pytest.raises(ValueError, match=words):
        make()
