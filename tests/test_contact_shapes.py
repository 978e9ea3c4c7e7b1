"""Shapes, their smoothed support functions, and rigid motions."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from jitted import jitted
from scipy.spatial.transform import Rotation

from jaxtrachea.contact.pose import (
    Pose,
    check_rotations,
    compose,
    inverse,
    is_rotation,
    nearest_rotation,
    pose_from_quaternion,
    pose_from_vector,
    relative,
    transform,
)
from jaxtrachea.contact.shapes import (
    Shape,
    box,
    capsule,
    cloud,
    cylinder,
    hull,
    padded,
    sharp_support,
    sphere,
    support,
)

POINTS = np.array([[0, 0, 0], [2, 0, 0], [0, 3, 0], [0, 0, 1], [0.4, 0.4, 0.2], [2, 0, 0]], float)
SHAPES = {
    "sphere": sphere(1.5),
    "point": sphere(0.0),
    "capsule": capsule(2.0, 0.5),
    "box": box([1.0, 2.0, 0.1], 0.2),
    "cylinder": cylinder(1.0, 2.0, 0.1),
    "cloud": cloud(POINTS, 0.3),
    "flat": cloud([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]),
}
#: Exact support h(d) of the sharp shape.
EXACT = {
    "sphere": lambda d: 1.5,
    "capsule": lambda d: 2 * abs(d[2]) + 0.5,
    "box": lambda d: np.abs(d) @ [1, 2, 0.1] + 0.2,
    "flat": lambda d: max(0, d[0], d[1]),
}
vectors = arrays(float, 3, elements=st.floats(-3, 3))
few = settings(max_examples=40, deadline=None, derandomize=True)


#: Most of the time here is compilation.
quick = functools.partial(jitted, compiler_options={"xla_backend_optimization_level": 0})
smoothed, smooth = quick(jax.vmap(support, (None, 0, None))), quick(support)
sharp = quick(jax.vmap(sharp_support, (None, 0)))


def some_directions(count, seed):
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1)[:, None]


def unit(v, dtype="float64"):
    return jnp.asarray(np.asarray(v) / np.linalg.norm(v), dtype)


@pytest.mark.parametrize("name", EXACT)
def test_sharp_support_is_exact(name):
    d = some_directions(100, 0)
    exact = [EXACT[name](v) for v in d]
    np.testing.assert_allclose(sharp(SHAPES[name], d), exact, atol=1e-14)


@pytest.mark.parametrize("beta", [1.0, 1e2, 1e6])
@pytest.mark.parametrize("name", SHAPES)
def test_smoothing_is_within_its_bound(name, beta):
    """0 <= h - sharp <= log(n) / beta, and the softmax mean lies in the core."""
    shape = SHAPES[name]
    directions = some_directions(100, 1)
    got = smoothed(shape, directions, np.asarray(beta))
    excess = got.value - sharp(shape, directions)
    assert excess.min() >= -1e-14
    assert excess.max() <= np.log(shape.vertices.shape[1]) / beta + 1e-14
    others = sharp(Shape(shape.vertices, jnp.asarray(0.0)), directions)
    assert np.max(got.core @ directions.T - others[None]) <= 1e-14


@pytest.mark.parametrize("name", SHAPES)
def test_point_is_on_the_smoothed_boundary_with_that_normal(name):
    """x(d) . d = h(d), and x(d) . e <= h(e) for every other direction."""
    shape, beta = SHAPES[name], np.asarray(7.0)
    d = some_directions(100, 2)
    at = smoothed(shape, d, beta)
    reached = at.point @ d.T
    np.testing.assert_allclose(np.diag(reached), at.value, rtol=1e-13, atol=1e-13)
    assert np.max(reached - at.value[None]) <= 1e-13


def test_no_overflow_and_dtype():
    shape = box([1e3, 1.0, 1e-3], 0.1, "float64")
    got = smooth(shape, unit([1, 1, 1], "float64"), jnp.asarray(1e6, "float64"))
    assert got.point.dtype == got.value.dtype == shape.radius.dtype == "float64"
    assert np.isfinite(got.point).all()
    for made in (sphere(1, "float64"), capsule(1, 1, "float64"), cylinder(1, 1, dtype="float64")):
        assert made.vertices.dtype == made.radius.dtype == "float64"


def test_constructors_differentiate():
    def reach(size):
        d, beta = unit([1, 2, 2]), jnp.asarray(1e6)
        shapes = [
            sphere(size),
            capsule(size, size),
            box(jnp.stack([size, size, size]), size),
            cylinder(size, size),
        ]
        return jnp.stack([support(s, d, beta).value for s in shapes])

    # Apart from the smoothing, each value is proportional to the size.
    at = jnp.asarray(2.0)
    np.testing.assert_allclose(quick(jax.jacfwd(reach))(at), quick(reach)(at) / 2, rtol=1e-5)


def test_cylinder_is_inscribed():
    sides = 24
    angle = np.linspace(0, 2 * np.pi, 500)
    shape = cylinder(3.0, 2.0, sides=sides)
    d = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    reach = sharp(shape, d)
    assert reach.max() <= 2 + 1e-12
    np.testing.assert_allclose(reach.min(), 2 * np.cos(np.pi / sides), rtol=1e-4)
    np.testing.assert_allclose(sharp(shape, np.array([[0.0, 0, 1]])), 3)


def test_hull_drops_what_is_inside():
    assert hull(POINTS).vertices.shape == (3, 4)
    flat = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0], [1, 1, 0]]
    assert hull(flat).vertices.shape == (3, 4)
    assert hull([[1, 2, 3]], 2.0).vertices.shape == (3, 1)


def test_hull_of_a_box_with_many_points_on_its_faces():
    """Roundings lift points out of faces; each counted in the smooth support, 0.07 mm here."""
    line = np.linspace(-1, 1, 9)
    grid = np.stack(np.meshgrid(line, line, line), -1).reshape(-1, 3)
    faces = grid[np.abs(grid).max(axis=1) == 1] * [5, 3, 10]
    turn = Rotation.from_euler("xyz", [0.3, 0.4, 0.5]).as_matrix()
    found = hull((faces @ turn.T).astype(np.float32))
    corners = np.asarray(box([5.0, 3.0, 10.0]).vertices).T @ turn.T
    assert found.vertices.shape == (3, 8)
    apart = np.linalg.norm(corners[:, None] - np.asarray(found.vertices).T[None], axis=2)
    assert apart.min(axis=0).max() < 1e-5
    assert apart.min(axis=1).max() < 1e-5


@pytest.mark.parametrize("thickness", [1e-9, 1e-6, 1e-3, 0.1])
def test_hull_of_a_thin_plate_keeps_its_edges(thickness):
    draw = np.random.default_rng(5)
    line = np.linspace(0, 10, 5)
    plate = np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)
    plate = np.concatenate([plate, thickness * draw.normal(size=(25, 1))], axis=1)
    kept = np.asarray(hull(plate).vertices).T
    turn = np.linspace(0, 2 * np.pi, 100)
    d = np.stack([np.cos(turn), np.sin(turn), 0 * turn])
    np.testing.assert_allclose((kept @ d).max(axis=0), (plate @ d).max(axis=0), atol=1e-3)


def test_padded_is_the_same_shape():
    shape = SHAPES["capsule"]
    more = padded(shape, 8)
    assert more.vertices.shape == (3, 8)
    d, beta = unit([1, 1, 3]), jnp.asarray(50.0)
    assert sharp(more, d[None]) == sharp(shape, d[None])
    jax.tree.map(
        functools.partial(np.testing.assert_allclose, rtol=1e-14),
        smooth(more, d, beta), smooth(shape, d, beta),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: sphere(-1.0), "radius: expected a length not below 0, found -1.0"),
        (lambda: cloud(np.zeros((3, 2))), r"expected shape \(n, 3\)"),
        (lambda: cloud(np.zeros((0, 3))), "n >= 1"),
        (lambda: hull(np.zeros(3)), r"expected shape \(n, 3\)"),
        (lambda: cylinder(1.0, 1.0, sides=2), "sides: expected at least 3, found 2"),
        (lambda: padded(SHAPES["box"], 4), "count: expected at least 8"),
    ],
)
def test_misuse_is_named(make, words):
    with pytest.raises(ValueError, match=words):
        make()


@quick
def group_laws(w_1, t_1, w_2, t_2):
    """Pairs of what must be equal."""
    a, b = pose_from_vector(w_1, t_1), pose_from_vector(w_2, t_2)
    points = jnp.asarray(POINTS.T)
    return [
        (a.rotation @ a.rotation.T, jnp.eye(3)),
        (jnp.linalg.det(a.rotation), 1),
        (transform(compose(a, b), points), transform(a, transform(b, points))),
        (transform(inverse(a), transform(a, points)), points),
        (transform(a, transform(relative(a, b), points)), transform(b, points)),
    ]


@few
@given(vectors, vectors, vectors, vectors)
def test_poses_form_a_group(w_1, t_1, w_2, t_2):
    for left, right in group_laws(*(jnp.asarray(v) for v in (w_1, t_1, w_2, t_2))):
        np.testing.assert_allclose(left, right, atol=1e-12)


@few
@given(vectors)
def test_rotation_vector_is_the_quaternion(w):
    angle = np.linalg.norm(w)
    axis = w / angle if angle > 0 else w
    q = np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * axis])
    zero = jnp.zeros(3)
    by_vector = quick(pose_from_vector)(jnp.asarray(w), zero).rotation
    by_quaternion = quick(pose_from_quaternion)(jnp.asarray(3 * q), zero).rotation
    np.testing.assert_allclose(by_vector, by_quaternion, atol=1e-13)
    np.testing.assert_allclose(by_vector @ w, w, atol=1e-13)


@quick
def turning(w, t):
    def turn(t):
        return pose_from_vector(w * t, jnp.zeros(3)).rotation

    second = jax.jacfwd(jax.jacrev(turn))
    return turn(t), jax.jacfwd(turn)(t), second(t), jax.jacfwd(jax.jacfwd(second))(t)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1.2e-4, 1.3e-4, 0.1])
def test_rotation_derivatives_are_finite_and_right(angle):
    """d/dt exp([w] t) = [w] exp([w] t), also past the end of the series; second derivative too."""
    w = np.array([0.6, 0.0, 0.8])
    skew = np.cross(np.eye(3), w)
    value, first, second, fourth = turning(w, angle)
    np.testing.assert_allclose(first, skew @ value, atol=1e-12)
    np.testing.assert_allclose(second, skew @ skew @ value, atol=1e-7)
    if angle in (0.0, 0.1):  # in between, closed form and series both lose digits at this order
        np.testing.assert_allclose(fourth, skew @ skew @ skew @ skew @ value, atol=1e-6)


def test_pose_is_a_pytree():
    assert len(jax.tree.leaves(Pose(jnp.eye(3), jnp.zeros(3)))) == 2


def test_nearest_rotation_is_the_polar_factor():
    """Of means of two rotations, by scipy; of those half a turn apart the one that is given."""
    rng = np.random.default_rng(0)
    axis = rng.normal(size=(60, 3))
    angle = np.r_[np.linspace(0, 2, 30), np.linspace(2, 2.65, 28), 3.1, np.pi]
    vector = axis / np.linalg.norm(axis, axis=1, keepdims=True) * angle[:, None]
    turns = jax.jit(jax.vmap(lambda w: pose_from_vector(w, jnp.zeros(3)).rotation))
    start = np.asarray(turns(jnp.asarray(rng.normal(size=(60, 3)))))
    share = np.r_[rng.uniform(size=20), np.full(40, 0.5)][:, None, None]
    mean = (1 - share) * start + share * (start @ np.asarray(turns(jnp.asarray(vector))))
    found = jax.jit(jax.vmap(nearest_rotation))(
        jnp.asarray(mean, "float64"), jnp.asarray(start, "float64")
    )
    found, eps = np.asarray(found), np.finfo("float64").eps
    assert found.dtype == "float64"
    for i in range(58):
        known = scipy.linalg.polar(mean[i])[0]
        error = np.abs(np.asarray(found[i], float) - known).max()
        assert error < (50 * eps if angle[i] <= 2 else 50 * eps + 4e-6), angle[i]
    np.testing.assert_array_equal(found[58:], np.asarray(start[58:], "float64"))
    slope = jax.jit(jax.grad(lambda m: nearest_rotation(m, m)[0, 1]))(
        jnp.asarray(mean[25], "float64")
    )
    step = 1e-6 * rng.normal(size=(3, 3))
    ends = [scipy.linalg.polar(mean[25] + sign * step)[0][0, 1] for sign in (1, -1)]
    near = np.sum(np.asarray(slope, float) * step)
    np.testing.assert_allclose(near, (ends[0] - ends[1]) / 2, rtol=1e-5 + 50 * eps)


NO_ROTATIONS = {
    "twice": (2 * np.eye(3), "is 3, the determinant 8"),
    "shrunk": (0.9 * np.eye(3), "is 0.19, the determinant 0.729"),
    "mirrored": (-np.eye(3), "is 0, the determinant -1"),
    "zero": (np.zeros((3, 3)), "is 1, the determinant 0"),
    "sheared": (np.eye(3) + np.diag([0.3, 0], 1), "is 0.3, the determinant 1"),
    "huge": (1e200 * np.eye(3), "is inf"),
    "one row": (np.diag([1, 1, 1.001]), "is 0.002"),
}


@pytest.mark.parametrize("name", NO_ROTATIONS)
def test_matrices_that_are_no_rotations_are_refused(name):
    wrong, found = NO_ROTATIONS[name]
    assert not is_rotation(wrong)
    with pytest.raises(ValueError, match=rf"(?s)turn: row 1 .*{found}.*pose_from_vector"):
        check_rotations("turn", np.stack([np.eye(3), wrong, wrong]))


def test_rotations_pass_rounded_to_float32_and_after_many_products():
    """Whatever is not finite is left to a status."""
    q = np.random.default_rng(0).normal(size=(200, 4))
    turns = jax.jit(jax.vmap(lambda q: pose_from_quaternion(q, jnp.zeros(3)).rotation))
    for dtype in (np.float32, np.float64):
        R = np.asarray(turns(jnp.asarray(q, dtype)), dtype)
        product = np.eye(3, dtype=dtype)
        for one in (*R, *R, *R, *R, *R):
            product = product @ one
        assert all(map(is_rotation, (*R, product)))
        check_rotations("turn", np.stack([*R, product]))
    missing = np.full((3, 3), np.nan)
    assert not is_rotation(missing)
    rough = R[:, None] + 1e-5 * np.random.default_rng(1).normal(size=(200, 50, 3, 3))
    sure = [m for m in rough.reshape(-1, 3, 3) if is_rotation(m)]
    assert 10 < len(sure) < 9_000
    check_rotations("turn", np.stack(sure))  # one by one nothing passes that is refused here
    check_rotations("turn", missing[None])
    check_rotations("turn", np.eye(3)[None] + np.inf)


def test_a_capsule_is_of_the_type_of_its_length():
    for length, expected in ((np.float32(2), "float32"), (2.0, "float64"), (2, "float64")):
        found = capsule(length, 1.0)
        assert {v.dtype for v in (found.vertices, found.radius)} == {jnp.dtype(expected)}
    assert capsule(2.0, 1.0, jnp.float32).vertices.dtype == jnp.float32
