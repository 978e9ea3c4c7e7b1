"""Signed distance: exact cases, outside numbers, laws, derivatives."""

import dataclasses
import functools
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrachea.contact.distance import signed_distance, track
from jaxtrachea.contact.pose import (
    Pose,
    compose,
    pose_from_quaternion,
    pose_from_vector,
    transform,
)
from jaxtrachea.contact.search import LEVELS, STANDARD, Settings
from jaxtrachea.contact.shapes import (
    Shape,
    box,
    capsule,
    cloud,
    cylinder,
    padded,
    sharp_support,
    sphere,
    support,
)
from jaxtrachea.status import ContactStatus

#: Rounding, in units of the size of the pair: of the reference and of the search together.
ROUNDING = {"float32": 3e-6, "float64": 1e-12}
#: Most of the time here is compilation.
quick = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
of_vectors = quick(jax.vmap(pose_from_vector))
supports = quick(jax.vmap(support, (None, 0, None)))
sharp_supports = quick(jax.vmap(sharp_support, (None, 0)))
ZERO = (0.0, 0.0, 0.0)


def stack(shapes, count, scale, dtype):
    """Shapes of different kinds in one batch, in another unit of length."""
    shapes = [padded(s, count) for s in shapes]
    return jax.tree.map(
        lambda *v: jnp.asarray(np.asarray(np.stack(v) * scale, dtype), dtype), *shapes
    )


def poses(vectors, translations, scale, dtype):
    def cast(v):
        return jnp.asarray(np.asarray(v, dtype), dtype)

    return of_vectors(cast(vectors), cast(np.asarray(translations) * scale))


def sizes(shapes_a, shapes_b):
    """The size of each pair, as the settings define it."""

    def v(s):
        return np.asarray(s.vertices, float)

    def about(v):
        return v - v.mean(axis=1, keepdims=True)

    def reach(s):
        return np.linalg.norm(about(v(s)), axis=0).max()

    return np.array(
        [
            reach(a) + reach(b) + float(a.radius) + float(b.radius)
            for a, b in zip(shapes_a, shapes_b, strict=True)
        ]
    )


# ---------------------------------------------------------------- exact cases

CUBE = box([0.5, 0.5, 0.5])
BIG = box([1.0, 1.0, 1.0])
ROD = capsule(1.0, 0.5)
NEEDLE = capsule(10.0, 0.01)
PLATE = box([50.0, 50.0, 0.05])
BALL = sphere(0.5)
TRIANGLE = cloud([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
LINE = cloud([[0.0, 0, -1], [0, 0, 0.2], [0, 0, 1], [0, 0, 0.5]])
POINT = cloud([[0.0, 0, 0]] * 3)
MESSY = cloud(np.vstack([CUBE.vertices.T, CUBE.vertices.T[-1:], [[0.1] * 3]]))
QUARTER = (0.0, np.pi / 2, 0.0)


#: 1 - cosine of the tilt by smoothing: a few times 1 / sharpness, rad.
TILT = 5e-6


def along(*direction):
    u = np.array(direction) / np.linalg.norm(direction)
    return lambda n: n @ u > 1 - TILT


def any_direction(n):
    return True


def face(n):
    return np.abs(n).max() > 1 - TILT


def across_y(n):
    return abs(n[1]) > 1 - TILT


def cone(*axes):
    """No part against the outward axes, none along the others."""
    out = np.zeros(3, bool)
    out[list(axes)] = True
    return lambda n: (n[out] > -1e-3).all() and (np.abs(n[~out]) < 1e-3).all()


def facet(n):
    """A facet of the prism: half way between two of its 24 vertices."""
    return abs(np.sin(12 * (np.arctan2(n[1], n[0]) - np.pi / 24))) < 1e-3 and abs(n[2]) < 1e-3


#: name: (A, B, rotation vector, translation, exact distance, law of the normal)
HARD = {
    "spheres apart": (sphere(1.0), sphere(2.0), ZERO, (5.0, 0, 0), 2, along(1, 0, 0)),
    "spheres touching": (sphere(1.0), sphere(2.0), ZERO, (3.0, 0, 0), 0, along(1, 0, 0)),
    "spheres concentric": (sphere(1.0), sphere(2.0), ZERO, ZERO, -3, any_direction),
    "spheres nearly so": (sphere(1.0), sphere(2.0), ZERO, (1e-5, 0, 0), -2.99999, along(1, 0, 0)),
    "spheres far apart": (sphere(1.0), sphere(2.0), ZERO, (300.0, 400, 0), 497, along(3, 4, 0)),
    "rods parallel": (ROD, ROD, ZERO, (2.0, 0, 0), 1, along(1, 0, 0)),
    "rods nearly parallel": (ROD, ROD, (1e-6, 0, 0), (2.0, 0, 0), 1, along(1, 0, 0)),
    "rods crossing": (ROD, ROD, QUARTER, ZERO, -1, across_y),
    "rods in line": (ROD, ROD, ZERO, (0, 0, 4.0), 1, along(0, 0, 1)),
    "ball in cube": (BIG, BALL, ZERO, ZERO, -1.5, face),
    "ball on vertex": (BIG, BALL, ZERO, (1.0, 1, 1), -0.5, cone(0, 1, 2)),
    "ball on edge": (BIG, BALL, ZERO, (1.0, 1, 0), -0.5, cone(0, 1)),
    "ball on face": (BIG, BALL, ZERO, (1.0, 0, 0), -0.5, along(1, 0, 0)),
    "cubes coincident": (CUBE, CUBE, ZERO, ZERO, -1, face),
    "cubes touching": (CUBE, CUBE, ZERO, (1.0, 0, 0), 0, along(1, 0, 0)),
    "cubes 1e-6 apart": (CUBE, CUBE, ZERO, (1 + 1e-6, 0, 0), 1e-6, along(1, 0, 0)),
    "cubes at vertices": (CUBE, CUBE, ZERO, (1.0, 1, 1), 0, cone(0, 1, 2)),
    "cubes at edges": (CUBE, CUBE, ZERO, (1.0, 1, 0), 0, cone(0, 1)),
    "plate and ball": (PLATE, sphere(1.0), ZERO, (10.0, -7, 2), 0.95, along(0, 0, 1)),
    "plates turned": (PLATE, PLATE, (0, 0, np.pi / 6), (3.0, 2, 1), 0.9, along(0, 0, 1)),
    "cube and needle": (CUBE, NEEDLE, ZERO, (2.0, 0, 0), 1.49, along(1, 0, 0)),
    "needles crossed": (NEEDLE, NEEDLE, QUARTER, (0, 0.5, 0), 0.48, along(0, 1, 0)),
    "triangle": (TRIANGLE, BALL, ZERO, (0.2, 0.2, 1), 0.5, along(0, 0, 1)),
    "collinear": (LINE, BALL, ZERO, (2.0, 0, 0.3), 1.5, along(1, 0, 0)),
    "points": (POINT, POINT, ZERO, (3.0, 4, 0), 5, along(3, 4, 0)),
    "points coincident": (POINT, POINT, ZERO, ZERO, 0, any_direction),
    "interior and doubled": (MESSY, BALL, ZERO, (2.0, 0, 0), 1, along(1, 0, 0)),
    "prism round ball": (
        cylinder(3.0, 2.0),
        BALL,
        ZERO,
        ZERO,
        -(2 * np.cos(np.pi / 24) + 0.5),
        facet,
    ),
}
MOST = 48  # vertices of the prism


@functools.cache
def with_derivatives(dtype):
    """Contact, gradient (reverse) and Jacobian (forward) with respect to the pose, per lane."""

    def one(a, b, q, t, v):
        def moved(v):
            turned = compose(pose_from_vector(v[:3], 0 * t), Pose(q, 0 * t))
            return Pose(turned.rotation, v[3:] + t)

        def solve(v):
            return signed_distance(a, b, moved(v))

        gradient = jax.grad(lambda v: solve(v).distance)(v)

        def read(v):
            return (lambda c: (c.distance, c.normal, c.point_a, c.point_b))(solve(v))

        return solve(v), gradient, jax.jacfwd(read)(v)

    return quick(jax.vmap(one))


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize(("dtype", "scale"), [("float64", 1e-3), ("float32", 1.0)])
def test_hard_cases(dtype, scale):
    """Exact - bound <= phi <= exact, the normal right, every value and derivative finite."""
    a, b, turn, shift, exact, law = (list(v) for v in zip(*HARD.values(), strict=True))
    size = np.maximum(sizes(a, b), 1e-30)
    at = poses(turn, shift, scale, dtype)
    zero = jnp.zeros((len(a), 6), dtype)
    shapes = stack(a, MOST, scale, dtype), stack(b, MOST, scale, dtype)
    c, gradient, jacobian = with_derivatives(dtype)(*shapes, at.rotation, at.translation, zero)
    for leaf in jax.tree.leaves((c, gradient, jacobian)):
        assert leaf.dtype in (dtype, "int8")
        bad = ~np.isfinite(np.asarray(leaf)).reshape(len(a), -1).all(axis=1)
        assert not bad.any(), [n for n, b in zip(HARD, bad, strict=True) if b]
    size = np.where(size > 1e-20, size, np.linalg.norm(shift, axis=1))
    size = np.where(size > 0, size, 1 / scale)  # coincident points have no size: 1 mm is taken
    rounding = ROUNDING[dtype] * np.maximum(size, np.linalg.norm(shift, axis=1))
    bound = 2 * np.log(MOST) / STANDARD.sharpness * size
    got, lower, upper = (np.asarray(v, float) / scale for v in (c.distance, c.lower, c.upper))
    normals = np.asarray(c.normal, float)
    for i, name in enumerate(HARD):
        assert exact[i] - bound[i] - rounding[i] <= got[i] <= exact[i] + rounding[i], name
        assert got[i] - rounding[i] <= lower[i] <= exact[i] + rounding[i], name
        assert exact[i] - rounding[i] <= upper[i], name
        assert law[i](normals[i]), (name, normals[i])
        assert c.status[i] in (ContactStatus.OK, ContactStatus.FLAT), (name, c.status[i])
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=ROUNDING[dtype])
    # Moving B along the normal opens the gap by as much; forward and reverse agree. Where many
    # normals are right, float32 may take another one in the derivative than in the value.
    one = [dtype == "float64" or v.__qualname__.startswith("along") for v in law]
    reverse, forward = np.asarray(gradient, float), np.asarray(jacobian[0], float)
    np.testing.assert_allclose(reverse[one, 3:], normals[one], atol=50 * ROUNDING[dtype])
    for i, name in enumerate(HARD):
        assert law[i](reverse[i, 3:]), (name, reverse[i])
        assert law[i](forward[i, 3:]), (name, forward[i])
    rounding = 50 * ROUNDING[dtype] * float(np.max(reverse) + 1)
    np.testing.assert_allclose(forward[one], reverse[one], atol=rounding)


# ---------------------------------------------------------------- closed forms


@pytest.mark.slow
@pytest.mark.compiling
def test_spheres_have_no_bias_and_derivatives_of_every_order():
    """Phi = |t| - r_A - r_B along a line, and its first three derivatives."""
    start, step = jnp.array([1.0, 2.0, -0.5]), jnp.array([0.3, -1.0, 0.7])

    def gap(s):
        there = pose_from_vector(jnp.array([0.1, 0.2, 0.3]), start + s * step)
        return track(sphere(0.3), sphere(0.4), there, start).distance

    def exact(s):
        return jnp.sqrt(jnp.sum((start + s * step) ** 2)) - 0.7

    def orders(f):
        first = jax.grad(f)
        second = jax.jacfwd(first)
        return quick(lambda s: (f(s), first(s), second(s), jax.jacfwd(second)(s)))(jnp.asarray(0.2))

    np.testing.assert_allclose(orders(gap), orders(exact), rtol=1e-12)


def box_distance(half, radius, p):
    q = np.abs(p) - half
    return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0) - radius


def segment_distance(half, p):
    return np.linalg.norm(p - np.clip(p[:, 2], -half, half)[:, None] * [0, 0, 1], axis=1)


@functools.cache
def lanes(settings_, dtype):
    """One program per accuracy and dtype: a batch of pairs of 12 vertices."""
    del dtype

    def one(a, b, pose):
        return signed_distance(a, b, pose, settings_)

    return quick(jax.vmap(one))


@pytest.mark.slow
@pytest.mark.compiling
def test_box_and_capsule_against_a_ball():
    """Closed forms of the signed distance, balls all round and inside."""
    p = np.random.default_rng(3).uniform(-2, 2, (250, 3))  # as many as random pairs: one program
    half, r = np.array([1.0, 0.7, 0.4]), 0.1
    first = [box(half, r)] * 125 + [capsule(1.2, 0.3)] * 125
    exact = np.append(box_distance(half, r, p[:125]), segment_distance(1.2, p[125:]) - 0.3) - 0.5
    at = poses(np.zeros((250, 3)), p, 1, "float64")
    second = stack([BALL] * 250, 12, 1, "float64")
    c = lanes(STANDARD, "float64")(stack(first, 12, 1, "float64"), second, at)
    bound = 2 * np.log(12) / STANDARD.sharpness * sizes(first, [BALL] * 250)
    assert (c.distance <= exact + 1e-12).all()
    assert (c.distance >= exact - bound).all()
    assert (c.status == ContactStatus.OK).all()


# ---------------------------------------------------------------- outside numbers


@functools.cache
def reference_pairs():
    path = pathlib.Path(__file__).parent / "reference" / "contact_pairs.npz"
    return dict(np.load(path))


def pairs(index, dtype, scale):
    """Stored pairs as a batch, their size (unscaled) and a priori bound over size."""
    data = reference_pairs()
    count, size = data["count"][index].astype(int), np.zeros(len(index))
    made = []
    for side in range(2):
        v = data["vertices"][index, side] / 1024.0
        v = np.stack([x[np.arange(12) % n] for x, n in zip(v, count[:, side], strict=True)])
        radius = data["radius"][index, side] / 1024.0
        true_mean = np.stack([x[:n].mean(axis=0) for x, n in zip(v, count[:, side], strict=True)])
        size += np.linalg.norm(v - true_mean[:, None], axis=2).max(axis=1) + radius

        def cast(x):
            return jnp.asarray(np.asarray(x * scale, dtype), dtype)

        made.append(Shape(cast(v.transpose(0, 2, 1)), cast(radius)))
    turn = np.asarray(data["quaternion"][index], dtype)
    shift = np.asarray(data["translation"][index].astype(float) * scale, dtype)
    at = quick(jax.vmap(pose_from_quaternion))(turn, shift)
    return (*made, at), size


def check_pairs(index, settings_, dtype, scale, missed):
    """Bounds for every pair; at most `missed` overlapping ones in a basin not the lowest."""
    data = reference_pairs()
    batch, size = pairs(index, dtype, scale)
    c = lanes(settings_, dtype)(*batch)
    exact = data["distance"][index] / size
    got, lower, upper = (
        np.asarray(v, float) / scale / size for v in (c.distance, c.lower, c.upper)
    )
    rounding = ROUNDING[dtype] + 2e-9  # coal's own error where the cores do not overlap
    assert (got <= exact + rounding).all()
    assert (got <= lower + rounding).all()
    assert (lower <= exact + rounding).all()
    assert (exact <= upper + rounding).all()
    # Padding repeats vertices: the mean that defines the size may move, by less than a tenth.
    short = exact - got > 1.1 * 2 * np.log(12) / settings_.sharpness + rounding
    assert short.sum() <= missed
    assert not short[data["group"][index] < 2].any()
    sure = data["unique"][index] & ~short & (exact < -0.02)
    cosine = np.sum(np.asarray(c.normal, float) * data["normal"][index], axis=1)
    assert np.median(1 - cosine[sure]) < 1e-2
    assert (c.status == ContactStatus.NOT_CONVERGED).sum() <= missed
    assert not (c.status == ContactStatus.NON_FINITE).any()


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize(("level", "missed"), [("fast", 6), ("standard", 4)])
def test_all_random_pairs(level, missed):
    check_pairs(np.arange(2000), LEVELS[level], "float64", 1e-3, missed)


# ---------------------------------------------------------------- laws

A = box([1.0, 0.7, 0.4], 0.1)
B = padded(capsule(0.8, 0.3), 8)
solve = quick(signed_distance)
PLACES = {
    "apart": jnp.array([0.3, 0.2, 0.1, 1.5, 1.2, 0.4]),
    "touching": jnp.array([0.3, 0.9, 0.1, 1.6, 0.2, 0.1]),
    "overlap": jnp.array([0.5, -0.4, 0.2, 0.1, 0.2, 0.5]),
}


def place(v):
    return pose_from_vector(v[:3], v[3:])


cold_lanes = quick(jax.vmap(lambda v: signed_distance(A, B, place(v))))


@pytest.mark.long
@pytest.mark.parametrize("name", PLACES)
def test_witness_points(name):
    """On both smoothed boundaries, `distance` apart along the normal."""
    there = place(PLACES[name])
    c = solve(A, B, there)
    np.testing.assert_allclose(c.point_b - c.point_a, c.distance * c.normal, atol=1e-12)
    # Of the sharp shapes, which the smoothed ones hold: nearer by no more than both are larger.
    beyond = 2 * np.log(8) / (1000.0 / sizes([A], [B])[0])
    assert c.distance - 1e-12 <= c.lower <= c.distance + beyond
    assert c.lower <= c.upper + 1e-12
    d = np.random.default_rng(4).normal(size=(300, 3))
    d = jnp.asarray(np.vstack([d / np.linalg.norm(d, axis=1)[:, None], c.normal, -c.normal]))
    moved = dataclasses.replace(B, vertices=transform(there, B.vertices))
    for shape, point, tight in ((A, c.point_a, -2), (moved, c.point_b, -1)):
        beta = jnp.asarray(1000.0 / sizes([A], [B])[0])
        room = supports(shape, d, beta).value - d @ point
        assert room.min() > -1e-12
        assert abs(room[tight]) < 1e-12
        outside = d @ point - sharp_supports(shape, d)
        assert outside.max() <= np.log(8) / beta


@pytest.mark.slow
@pytest.mark.compiling
def test_a_ball_inside_leaves_by_the_thin_side():
    """Of a box off its origin; the ball is near the end of the box, and does not leave ahead."""
    half, off = jnp.array([3.0, 1.0, 0.3]), jnp.array([20.0, -30.0, 5.0])
    there = Pose(jnp.eye(3), off + jnp.array([2.0, 0.0, 0.05]))
    slab = Shape(box(half).vertices + off[:, None], jnp.asarray(0.0))
    np.testing.assert_allclose(solve(slab, BALL, there).lower, -0.75, atol=1e-3)


@pytest.mark.slow
@pytest.mark.compiling
def test_tracking_follows_a_path():
    """From the normal of the step before, the whole path is the cold solution."""
    start, end = PLACES["apart"], PLACES["touching"]
    path = jnp.stack([start + (end - start) * s for s in np.linspace(0, 1, 120)])
    cold = cold_lanes(path)

    def step(normal, v):
        c = track(A, B, place(v), normal)
        return c.normal, c

    _, warm = quick(lambda n, p: jax.lax.scan(step, n, p))(cold.normal[0], path)
    np.testing.assert_allclose(warm.distance, cold.distance, atol=1e-12)
    np.testing.assert_allclose(warm.normal, cold.normal, atol=1e-7)
    assert (warm.status == ContactStatus.OK).all()


# ---------------------------------------------------------------- derivatives


@functools.cache
def derivatives():
    """Warm programs: derivatives are attached where the search stopped, whichever search it was."""

    def at(v, size, near):
        return track(box(size, 0.1), B, place(v), near, beta=jnp.asarray(200.0))

    def distance(*where):
        return at(*where).distance

    def normal(v, near):
        return at(v, jnp.array([1.0, 0.7, 0.4]), near).normal

    gradient = jax.grad(distance, (0, 1))

    def both(*w):
        return (gradient(*w), jax.jacfwd(distance, (0, 1))(*w))

    by_pose = jax.grad(distance)

    def second(*w):
        return (jax.jacfwd(by_pose)(*w), jax.jacrev(by_pose)(*w))

    def turning(*w):
        return (jax.jacfwd(normal)(*w), jax.jacrev(normal)(*w), normal(*w))

    return quick(distance), quick(both), quick(second), quick(turning)


def central(f, v, step):
    rows = [(f(v.at[i].add(step)) - f(v.at[i].add(-step))) / (2 * step) for i in range(v.size)]
    return np.stack([np.asarray(r) for r in rows], axis=-1)


@pytest.mark.slow
@pytest.mark.compiling
def test_gradients():
    """Pose and size of a box: reverse = forward = central differences; second = first of first."""
    for v in PLACES.values():
        check_gradients(v, *derivatives())


def check_gradients(v, distance, both, second, turning):
    size = jnp.array([1.0, 0.7, 0.4])
    near = solve(A, B, place(v)).normal
    (by_pose, by_size), forward = both(v, size, near)
    np.testing.assert_allclose(forward[0], by_pose, atol=1e-11)
    np.testing.assert_allclose(forward[1], by_size, atol=1e-11)
    # Truncation 1e-10 times a third derivative of up to 1e3 and rounding 1e-15 / 1e-5.
    np.testing.assert_allclose(
        by_pose, central(lambda u: distance(u, size, near), v, 1e-5), atol=1e-6
    )
    np.testing.assert_allclose(
        by_size, central(lambda s: distance(v, s, near), size, 1e-5), atol=1e-6
    )
    hessian, reverse = second(v, size, near)
    np.testing.assert_allclose(reverse, hessian, atol=1e-9)
    np.testing.assert_allclose(hessian, hessian.T, atol=1e-9)
    numeric = central(lambda u: both(u, size, near)[0][0], v, 1e-5)
    np.testing.assert_allclose(hessian, numeric, atol=1e-5 * (1 + np.abs(numeric).max()))
    by_forward, by_reverse, _ = turning(v, near)
    np.testing.assert_allclose(by_reverse, by_forward, atol=1e-9)
    numeric = central(lambda u: turning(u, near)[2], v, 1e-6)
    np.testing.assert_allclose(by_forward, numeric, atol=1e-5 * (1 + np.abs(numeric).max()))


# ---------------------------------------------------------------- outcomes and misuse


@pytest.mark.slow
@pytest.mark.compiling
def test_outcomes():
    here = place(PLACES["apart"])
    nowhere = Pose(here.rotation, here.translation * jnp.nan)
    assert solve(A, B, here).status == ContactStatus.OK
    assert solve(A, B, nowhere).status == ContactStatus.NON_FINITE
    level = quick(lambda t: signed_distance(sphere(1.0), BALL, Pose(jnp.eye(3), t)).status)
    assert level(jnp.zeros(3)) == ContactStatus.FLAT
    one_step = dataclasses.replace(STANDARD, warm_steps=1)
    behind = quick(lambda d: track(A, B, here, d, one_step).status)(-solve(A, B, here).normal)
    assert behind == ContactStatus.NOT_CONVERGED
    assert all(member.message for member in ContactStatus)


@pytest.mark.slow
@pytest.mark.compiling
def test_a_saddle_by_symmetry_is_not_converged():
    """A cube of 2 mm in itself is 2 mm deep, to a face; towards an edge or a corner 2.8 and 3.5."""
    cube, here = box(jnp.ones(3)), Pose(jnp.eye(3), jnp.zeros(3))
    tracked = quick(lambda d: track(cube, cube, here, d))
    for start in ((1.0, 1, 0), (1.0, 1, 1), (0.0, -1, 1)):
        got = tracked(jnp.asarray(start))
        assert got.distance < -2.7
        assert got.curvature < -0.5
        assert got.status == ContactStatus.NOT_CONVERGED
    face = tracked(jnp.asarray([1.0, 0.01, 0.02]))
    np.testing.assert_allclose(face.distance, -2, atol=0.011)  # log(64) / sharpness of the size
    assert face.status == ContactStatus.OK


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Settings(directions=4), "directions: expected at least 16, found 4"),
        (lambda: Settings(sharpness=0.0), "sharpness: expected a positive number"),
        (lambda: Settings(starts=2, survivors=3), "expected survivors <= starts <= directions"),
        (lambda: Settings(final_steps=0), "final_steps: expected at least 1, found 0"),
    ],
)
def test_misuse_is_named(make, words):
    with pytest.raises(ValueError, match=words):
        make()
