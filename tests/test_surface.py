"""Surface: what the interpolation must reproduce, its borders, the local dent, derivatives."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jitted import jitted

from jaxtrachea.mechanics.beam import Beam, deflect
from jaxtrachea.surface import local, phong, regions
from jaxtrachea.trachea.geometry import Geometry, table_1
from jaxtrachea.trachea.mesh import Mesh
from jaxtrachea.trachea.tube import make_tube

pytestmark = pytest.mark.compiling

ALPHA = 2 * math.pi / 3
METHODS = ["linear", "hermite", "phong"]
GEOMETRY = table_1()
TUBE = make_tube(GEOMETRY)
bind = jax.jit(regions.bind)
BINDING = bind(TUBE, GEOMETRY)
QUICK = {"xla_backend_optimization_level": 0}  # most of the time here is compilation


def points(s, phi, radius=12.0, dtype="float64"):
    """A mesh of given skeleton positions without triangles."""
    s, phi = np.broadcast_arrays(np.asarray(s, dtype), np.asarray(phi, dtype))
    s, phi = (v.ravel() for v in (s, phi))
    distance = np.full_like(s, radius)
    vertices = np.stack([s, distance * np.cos(phi), distance * np.sin(phi)], axis=1)
    floats = vertices, np.zeros_like(vertices), s, phi, distance
    vertices, normals, s, phi, distance = map(jnp.asarray, floats)
    return Mesh(vertices, jnp.asarray(np.zeros((0, 3), np.int32)), normals, s, phi, distance)


def as_arrays(tree):
    """NumPy arrays as those of JAX, which the types of records ask for."""
    return jax.tree.map(jnp.asarray, tree)


def make_keys(*rows):
    return regions.Keys(*as_arrays(rows))


def random_keys(seed=0, s_c=73.0, dtype="float64", size=1.0, rings=15):
    def draw(*shape, by=1.0):
        return np.asarray(
            by * size * np.random.default_rng((seed, *shape)).normal(size=shape), dtype
        )

    return clamped(
        np.asarray(s_c, dtype), draw(3), draw(rings, 3), draw(rings, 3, by=2),
        draw(rings, 3, by=-3), draw(rings, 2, by=0.1), draw(2, by=0.1),
        clamps=np.stack([draw(1, 3)[0], draw(1, 3, by=-1)[0]]),
    )  # fmt: skip


clamped = jitted(regions.clamped, compiler_options=QUICK)
weigh = jitted(regions.weigh, compiler_options=QUICK)


def surface_of(method):
    def of(binding, phi_c, keys):
        weights = regions.weigh(binding, phi_c)
        return regions.interpolate(binding, weights, keys, method=method)

    return of


OF = {method: jitted(surface_of(method), compiler_options=QUICK) for method in METHODS}
deflected = jitted(deflect, compiler_options=QUICK)


def motion(method, s, phi, phi_c, keys, geometry=GEOMETRY):
    """Displacement at (s, phi); filled up to 128 points, so that each method is compiled once."""
    s, phi = np.broadcast_arrays(np.asarray(s, float), np.asarray(phi, float))
    count, dtype = s.size, keys.s_c.dtype
    s, phi = (np.resize(v.ravel(), 128) for v in (s, phi))
    at = bind(points(s, phi, dtype=dtype), geometry)
    return np.asarray(OF[method](at, jnp.asarray(phi_c, dtype), keys))[:count]


@pytest.mark.parametrize("phi_c", [-ALPHA, -1.3, 0.0, 0.4, ALPHA - 0.01, ALPHA])
def test_weights_are_a_partition_of_unity(phi_c):
    def cast(v):
        return v.astype("float64") if v.dtype == jnp.float64 else v

    w = weigh(jax.tree.map(cast, BINDING), jnp.asarray(phi_c, "float64"))
    eps = np.finfo("float64").eps
    np.testing.assert_allclose(w.U + w.J + w.V, 1, rtol=4 * eps)
    assert min(np.min(w.U), np.min(w.J), np.min(w.V)) >= 0
    assert w.J.dtype == jnp.dtype("float64")


def test_no_weights_behind_the_ends():
    """As for the ring itself: no answer, and no lane but this one spoilt."""
    phi_c = np.array([0.4, 2.3, -math.pi])
    w = jitted(jax.vmap(regions.weigh, (None, 0)))(BINDING, phi_c)
    assert np.all(np.isfinite(w.J[0]))
    for line in (w.U, w.J, w.V):
        assert np.all(np.isnan(line[1:]))


@pytest.mark.parametrize("method", ["linear", "hermite"])
def test_translation_is_exact(method):
    shift, rows = np.asarray([0.3, -1.7, 0.9], "float64"), np.ones((15, 1), "float64")
    still = np.zeros((15, 2), "float64")
    keys = clamped(
        np.asarray(73, "float64"), shift, *[rows * shift[None]] * 3, still, still[0],
        clamps=np.stack([shift, shift]),
    )  # fmt: skip
    geometry = table_1("float64")
    at = bind(make_tube(geometry), geometry)
    got = OF[method](at, jnp.asarray(0.4, "float64"), keys)
    assert got.dtype == jnp.dtype("float64")
    np.testing.assert_allclose(
        got, np.broadcast_to(shift, got.shape), rtol=8 * np.finfo("float64").eps
    )


@pytest.mark.parametrize("s_c", [73.0, 70.0, 3.0])
@pytest.mark.parametrize("method", ["linear", "hermite"])
def test_linear_field_along_the_tube(method, s_c):
    """Every component linear in s, the same round the tube: reproduced at every vertex."""
    slope, at_A = np.array([0.01, -0.03, 0.02]), np.array([0.1, 0.2, -0.5])

    def field(s):
        return np.asarray(at_A + slope * np.asarray(s)[..., None])

    nodes = np.asarray(BINDING.nodes)
    slopes = np.asarray(np.tile(slope[1:], (17, 1)))
    keys = make_keys(np.asarray(s_c), field(s_c), *[field(nodes)] * 3, slopes, slopes[0])
    got = OF[method](BINDING, np.asarray(0.4), keys)
    np.testing.assert_allclose(got, field(TUBE.s), atol=1e-13)


def test_linear_in_the_angle():
    """Three different rigid lines: linear in phi between them, over the back too."""
    U, J, V = np.array([[1.0, 2, 3], [-1, 0, 5], [4, 4, -2]])
    rows = [np.asarray(np.tile(v, (17, 1))) for v in (J, U, V)]
    still = np.zeros((17, 2))
    keys = make_keys(np.asarray(73.0), np.asarray(J), *rows, still, still[0])
    phi = np.linspace(-math.pi, math.pi, 61)
    back = 2 * math.pi - ALPHA
    wanted = np.stack(
        [
            np.interp(phi, [-back, -ALPHA, 0.4, ALPHA, back], [V[i], U[i], J[i], V[i], U[i]])
            for i in range(3)
        ],
        axis=1,
    )
    for method in ("linear", "hermite"):
        np.testing.assert_allclose(motion(method, 42.0, phi, 0.4, keys), wanted, atol=1e-13)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("phi_c", "s_c"), [(0.4, 73.0), (0.0, 70.0), (-1.9, 3.0), (0.4, 158.0)])
def test_key_points_are_met(method, phi_c, s_c):
    keys = random_keys(s_c=s_c)
    if s_c == 70.0:  # C on ring 7: one displacement, one place
        keys = make_keys(
            keys.s_c, keys.joints[7], keys.joints, keys.U, keys.V, keys.slopes, keys.slopes[7]
        )
    nodes = np.asarray(BINDING.nodes)
    # Directions within the fade of 1 um are bent towards the normal: (1e-3 mm)^2 / 1 mm^2.
    atol = 2e-5 if method == "phong" else 1e-13
    for phi, wanted in ((phi_c, keys.joints), (-ALPHA, keys.U), (ALPHA, keys.V)):
        np.testing.assert_allclose(motion(method, nodes, phi, phi_c, keys), wanted, atol=atol)
    at_C = motion(method, s_c, phi_c, phi_c, keys)[0]
    np.testing.assert_allclose(at_C, keys.contact, atol=atol)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("phi_c", [0.4, ALPHA])
def test_no_jumps(method, phi_c):
    """Neighbours 1e-7 apart across rings, C, the three lines and the seam behind move alike."""
    keys, h = random_keys(), 1e-7
    borders = np.concatenate([np.asarray(BINDING.nodes[1:-1]), [73.0]])
    for phi in (-3.0, -1.0, phi_c - 0.1, 1.9, 2.2):
        low, high = (motion(method, borders + d, phi, phi_c, keys) for d in (-h, h))
        np.testing.assert_allclose(low, high, atol=1e-5)
    angles = np.array([-ALPHA, phi_c, ALPHA, ALPHA + regions.NARROWEST])
    for s in (5.0, 66.0, 71.0, 74.0, 157.0):
        low, high = (motion(method, s, angles + d, phi_c, keys) for d in (-h, h))
        np.testing.assert_allclose(low, high, atol=1e-4)
        low, high = (motion(method, s, np.array([d]), phi_c, keys) for d in (-math.pi, math.pi))
        np.testing.assert_allclose(low, high, atol=1e-12)


def test_hermite_is_slope_continuous_along_the_joints():
    keys, h = random_keys(), 1e-5
    at = np.append(np.asarray(BINDING.nodes[1:-1]), 73.0)
    u = [motion("hermite", at + d, 0.4, 0.4, keys)[:, 1:] for d in (-h, 0, h)]
    slopes = np.concatenate([keys.slopes[1:-1], keys.contact_slope[None]])
    np.testing.assert_allclose((u[1] - u[0]) / h, slopes, atol=2e-4)
    np.testing.assert_allclose((u[2] - u[1]) / h, slopes, atol=2e-4)


@pytest.mark.parametrize("s_c", [73.0, 70.0, 0.5])
def test_hermite_is_the_beam(s_c):
    """Between rings the beam's own deflection, got from the beam by rings of no stiffness there."""
    x, s_c = np.asarray(GEOMETRY.ring_positions), np.asarray(s_c)
    force = np.asarray(0.2)

    def beam(extra):
        at = np.sort(np.concatenate([x, extra]))
        k = np.asarray(np.where(np.isin(at, x), 0.1, 0.0))
        solved = deflected(
            Beam(np.asarray(at), GEOMETRY.length, np.full(len(at) + 1, 1.86), k), s_c, force
        )
        return at, solved

    _, main = beam(np.array([]))
    towards = np.asarray([math.cos(0.4), math.sin(0.4)])  # deflection in one plane
    keys = clamped(
        s_c, *(np.concatenate([np.zeros(1), main.w_C * towards]),),
        np.concatenate([np.zeros((15, 1)), main.w[:, None] * towards[None]], 1),
        np.zeros((15, 3)), np.zeros((15, 3)),
        main.theta[:, None] * towards[None], main.theta_C * towards,
    )  # fmt: skip
    at, fine = beam(np.arange(1, 160, 1.7))
    got = motion("hermite", at, 0.4, 0.4, keys)
    np.testing.assert_allclose(
        got[:, 1:], fine.w[:, None] * towards[None], atol=1e-12 * float(main.w_C)
    )
    straight = motion("linear", at, 0.4, 0.4, keys)
    assert np.max(np.abs(straight - got)) > 1e-3 * float(main.w_C)  # and it is not the chord


def test_axial_motion_is_linear_from_C_to_the_ends():
    nodes = np.asarray(BINDING.nodes)
    rows = np.zeros((17, 3))
    rows[:, 0] = np.interp(nodes, [0, 73, 160], [0, 1, 0])
    still = np.zeros((17, 2))
    keys = make_keys(
        np.asarray(73.0), np.asarray([1.0, 0, 0]), *[np.asarray(rows)] * 3, still, still[0]
    )
    s = np.linspace(0, 160, 97)
    got = motion("hermite", s, 0.4, 0.4, keys)[:, 0]
    np.testing.assert_allclose(got, np.interp(s, [0, 73, 160], [0, 1, 0]), atol=1e-14)


@pytest.mark.parametrize("at_C", [0.3, 0.0])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_phong_interpolates_magnitude_and_angle(sign, at_C):
    """As printed: halfway between two keys of one azimuth, half the magnitude and half the angle.

    Press (angles from the inward normal) and draw.
    """

    def normal(phi):
        return np.array([0, math.cos(phi), math.sin(phi)])

    x = np.array([1.0, 0, 0])

    def keyed(size, angle, phi):
        return size * (math.cos(angle) * sign * normal(phi) + math.sin(angle) * x)

    contact, end = keyed(2.0, at_C, 0.0), keyed(1.0, 0.7, ALPHA)
    rows = [np.asarray(np.tile(v, (17, 1))) for v in (contact, 0 * end, end)]
    keys = make_keys(np.asarray(73.0), np.asarray(contact), *rows)
    got = motion("phong", 42.0, ALPHA / 2, 0.0, keys)[0]
    np.testing.assert_allclose(got, keyed(1.5, (at_C + 0.7) / 2, ALPHA / 2), atol=1e-5)


@pytest.mark.parametrize("phi_c", [0.0, 0.4, 1.9, -1.9])
@pytest.mark.parametrize("tilt", [0.0, 0.6, -0.9])
def test_phong_moves_the_back_of_a_moving_tube_with_it(phi_c, tilt):
    """A tube that moves as a whole, inwards at C or slanting, moves so everywhere: the back too."""
    turn = phi_c + tilt
    shift = -np.array([0.3 * tilt, math.cos(turn), math.sin(turn)])
    rows = [np.tile(shift, (17, 1))] * 3
    keys = make_keys(np.asarray(73.0), shift, *rows)
    got = motion("phong", 42.0, np.linspace(-math.pi, math.pi, 61), phi_c, keys)
    np.testing.assert_allclose(got, np.broadcast_to(shift, got.shape), atol=2e-6)  # fade 1 um


def test_phong_on_the_back_of_a_flattened_tube():
    """Ring ends that part and sink, mirror images: the angle to the normal is linear behind too.

    At V the displacement stands at an angle b to the outward normal (counted towards the rear), at
    U at -b; between them the tube's normal turns and the angle goes linearly through 0.
    """
    b, size = 0.5, 1.4

    def outward(angle):
        return np.array([0, math.cos(angle), math.sin(angle)])

    U, V = size * outward(-ALPHA - b), size * outward(ALPHA + b)
    rows = [np.tile(np.asarray(v), (17, 1)) for v in ([0.0, -2.0, 0.0], U, V)]
    keys = make_keys(np.asarray(73.0), np.array([0.0, -2.0, 0.0]), *rows)
    share = np.linspace(0, 1, 21)
    phi = ALPHA + share * 2 * (math.pi - ALPHA)
    angle = phi + b * (1 - 2 * share)
    wanted = size * np.stack([0 * angle, np.cos(angle), np.sin(angle)], axis=1)
    around = np.where(phi > math.pi, phi - 2 * math.pi, phi)
    np.testing.assert_allclose(motion("phong", 42.0, around, 0.0, keys), wanted, atol=5e-6)


@pytest.mark.parametrize("method", METHODS)
def test_nothing_moves_nothing(method):
    """Exactly 0; derivatives there are in `test_gradients`."""
    keys = random_keys(size=0.0, dtype="float64")
    geometry = table_1("float64")
    at = bind(points([3.0, 71, 73, 150], [0.4, -3.0, 1, 2.5], dtype="float64"), geometry)
    np.testing.assert_array_equal(OF[method](at, jnp.asarray(0.4, "float64"), keys), 0)


def test_phong_at_rest_in_float32():
    """Derivatives at rest, and at a joint that hardly moves between others that do: bounded."""
    of = jax.jit(jax.jacrev(surface_of("phong"), (1, 2)), compiler_options=QUICK)
    keys = random_keys(dtype="float32")
    small = keys.joints * np.where(np.arange(17) == 7, 1e-9, 1).astype("float32")[:, None]
    moving = make_keys(keys.s_c, keys.contact, small, keys.U, keys.V)
    for keys in (jax.tree.map(np.zeros_like, moving), moving):
        for slope in jax.tree.leaves(of(AT32, np.asarray(0.4, "float32"), keys)):
            assert np.max(np.abs(slope)) < 10 / (160 * phong.FADE)


def slopes_of(f):
    """Compiled: value, and along a tangent, against a cotangent, forward and reverse."""

    def both(x, tangent, weight):
        value, ahead = jax.jvp(f, (x,), (tangent,))
        back = jax.tree.leaves(jax.vjp(f, x)[1](weight)[0])
        dots = [jnp.sum(a * b) for a, b in zip(back, jax.tree.leaves(tangent), strict=True)]
        return value, ahead, sum(dots, jnp.zeros(()))

    return jitted(both, compiler_options=QUICK)


def random_like(tree, seed):
    leaves, form = jax.tree.flatten(tree)
    rng = np.random.default_rng(seed)
    return jax.tree.unflatten(form, [jnp.asarray(rng.normal(size=v.shape)) for v in leaves])


def check_gradient(slopes, x, tangent, shape, step=1e-6, rtol=1e-6, sides=(1, -1)):
    """Forward = reverse = differences, along `tangent`; `sides`: where the function is smooth."""
    weight = jnp.asarray(np.random.default_rng(9).normal(size=shape))
    _, ahead, back = slopes(x, tangent, weight)
    assert np.all(np.isfinite(ahead))
    np.testing.assert_allclose(back, jnp.sum(ahead * weight), rtol=1e-10, atol=1e-12)

    def at(h):
        return slopes(jax.tree.map(lambda a, b: a + h * b, x, tangent), tangent, weight)[0]

    numeric = (at(sides[0] * step) - at(sides[1] * step)) / ((sides[0] - sides[1]) * step)
    np.testing.assert_allclose(ahead, numeric, atol=rtol * max(1, float(jnp.max(jnp.abs(ahead)))))


AT = bind(points([3.0, 66.3, 71, 74, 152], [0.3, -3.0, 1.0, 1.9, -1.95]), GEOMETRY)
AT32 = bind(points([68.0, 71, 74], [0.3, 0.5, -2.5], dtype="float32"), table_1("float32"))


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_gradients(method):
    """In every key, in s_c and in phi_c; also where nothing moves, and with C on an end of a ring.

    At rest `phong` is quadratic within its fade of 1 um: the step is far below it. On an end in the
    keys both ways, in phi_c from the side of the ring.
    """
    slopes = slopes_of(lambda x: surface_of(method)(AT, *x))
    for size, step in ((1.0, 1e-6), (0.0, 1e-10)):
        x = (jnp.asarray(0.4), random_keys(size=size))
        check_gradient(slopes, x, random_like(x, 1), (5, 3), step=step)
    for side in (-1.0, 1.0):
        x = (jnp.asarray(side * ALPHA), random_keys())
        phi_c, keys = random_like(x, 1)
        check_gradient(slopes, x, (0 * phi_c, keys), (5, 3))
        tangent = (-jnp.asarray(side), jax.tree.map(jnp.zeros_like, keys))
        check_gradient(slopes, x, tangent, (5, 3), step=1e-7, rtol=3e-5, sides=(1, 0))


@pytest.mark.parametrize("method", METHODS)
def test_float32_and_lanes(method):
    """Single precision to 3e-6 (`phong`, whose angles divide: 3e-5); lanes are the single rows."""
    wide, narrow = random_keys(), random_keys(dtype="float32")
    s, phi = np.linspace(0, 160, 50), np.linspace(-3.1, 3.1, 50)
    exact = motion(method, s, phi, 0.4, wide)
    got = motion(method, s, phi, 0.4, narrow, table_1("float32"))
    assert got.dtype == np.float32
    np.testing.assert_allclose(got, exact, atol=3e-5 if method == "phong" else 3e-6)
    both = jax.tree.map(lambda *v: np.stack(v), wide, random_keys(seed=5, s_c=20.0))
    at = bind(points(s, phi), GEOMETRY)
    mapped = jitted(jax.vmap(surface_of(method), (None, 0, 0)), compiler_options=QUICK)
    lanes = mapped(at, np.asarray([0.4, 0.1]), both)
    np.testing.assert_allclose(lanes[0], exact, atol=1e-12)


def test_misuse_is_told():
    weights, keys = as_arrays((weigh(BINDING, np.asarray(0.4)), random_keys(rings=3)))
    with pytest.raises(ValueError, match=r"keys have 5 rows; expected 17"):
        regions.interpolate(BINDING, weights, keys)
    k = as_arrays(random_keys())
    bare = make_keys(k.s_c, k.contact, k.joints, k.U, k.V)
    with pytest.raises(ValueError, match=r"needs slopes and contact_slope"):
        regions.interpolate(BINDING, weights, bare)
    with pytest.raises(ValueError, match=r"count is 5; expected one of 1, 8, 16, 32"):
        local.pattern(5)


def test_one_ring():
    geometry = Geometry.create(40.0, [15.0])
    keys = random_keys(rings=1, s_c=30.0)
    got = motion("hermite", [15.0, 30.0], 0.4, 0.4, keys, geometry)
    np.testing.assert_allclose(got, [keys.joints[1], keys.contact], atol=1e-13)


fit = jitted(local.fit, compiler_options=QUICK)
centres = jitted(local.centres, static_argnames="count", compiler_options=QUICK)
targets = jitted(local.targets, compiler_options=QUICK)
correction = jitted(local.correction, compiler_options=QUICK)
kernel = jitted(local.kernel, compiler_options=QUICK)


def dent(count, spacing=1.5, reach=5.0, depth=(0.2, -1.0, 0.3), sag=0.0, dtype="float64"):
    s, phi, radius, spacing, reach = (np.asarray(v, dtype) for v in (73, 0.4, 12.0, spacing, reach))
    at = centres(s, phi, radius, spacing, count)
    wanted = targets(np.asarray(depth, dtype), np.full(count, sag, dtype))
    return at, wanted, fit(at, wanted, reach)


@pytest.mark.parametrize("reach", [3.0, 7.5])
@pytest.mark.parametrize("count", [1, 16, 32])
def test_dent_meets_its_targets(count, reach):
    """2 to 5 spacings: condition below 1e3, targets to the ridge times the weights."""
    at, wanted, found = dent(count, reach=reach, dtype="float64")
    np.testing.assert_allclose(at[0], [73, 12 * math.cos(0.4), 12 * math.sin(0.4)], rtol=1e-6)
    np.testing.assert_allclose(np.hypot(at[:, 1], at[:, 2]), 12, rtol=1e-6)
    matrix = np.asarray(kernel(at, at, np.asarray(reach, "float64")), float)
    assert np.linalg.cond(matrix) < 1e3
    got = correction(found, at)
    assert got.dtype == jnp.dtype("float64")
    atol = 20 * 16 * count * np.finfo("float64").eps
    np.testing.assert_allclose(got, wanted, atol=atol)
    collar = local.pattern(count)[1]
    assert collar.sum() == {1: 0, 16: 9, 32: 15}[count]
    np.testing.assert_array_equal(np.asarray(wanted)[collar], 0)


def test_dent_is_zero_out_of_reach():
    at, _, found = dent(16)
    points = TUBE.straight
    moved = np.abs(np.asarray(correction(found, points))).max(axis=1)
    away = np.linalg.norm(np.asarray(points)[:, None] - np.asarray(at)[None], axis=2).min(axis=1)
    np.testing.assert_array_equal(moved[away >= 5.0], 0)
    assert np.all(moved[away < 4.5] > 0)


def shuffled(mesh, seed=3):
    """The same vertices in another order."""
    order = np.random.default_rng(seed).permutation(len(mesh.s))
    return mesh.straight[order]


@pytest.mark.slow
@pytest.mark.parametrize(("order", "count"), [("by s", 8), ("shuffled", 32)])
def test_dent_of_the_vertices_near_it_is_that_of_all(order, count):
    """Values, and derivatives by s_c and depth; also at both ends of the tube, in a batch."""
    at = jnp.asarray(TUBE.straight if order == "by s" else shuffled(TUBE), "float64")
    spacing = jnp.asarray(1.5, "float64")
    chosen = local.runs(at[:, 0], spacing)
    assert (chosen.order is None) == (order == "by s")
    s = jnp.asarray([-2.0, 0.0, 1.0, 73.3, 81.0, 159.0, 160.0, 163.0], "float64")
    assert max(chosen.longest) < len(at) / 3

    def both(s_c, depth):
        phi, radius = jnp.asarray(0.4, "float64"), jnp.asarray(12.0, "float64")
        where = local.centres(s_c, phi, radius, spacing, count)
        wanted = local.targets(depth, jnp.full(count, 0.2, "float64"))
        found = local.fit(where, wanted, 3 * spacing)
        u = at * depth[None]
        near = local.add_correction(u, found, at, chosen, s_c)
        far = u + local.correction(found, at)
        return jnp.stack([near, far]), jnp.stack([jnp.sum(near**2), jnp.sum(far**2)])

    def program(s, d):
        return both(s, d)[0], jax.jacrev(lambda *x: both(*x)[1], argnums=(0, 1))(s, d)

    batch = jax.jit(jax.vmap(program, (0, None)), compiler_options=QUICK)
    moved, derivatives = batch(s, jnp.asarray([0.2, -1.0, 0.3], "float64"))
    assert moved.dtype == jnp.dtype("float64")
    ulp = 8 * np.finfo("float64").eps
    np.testing.assert_allclose(moved[:, 0], moved[:, 1], rtol=ulp, atol=ulp)
    for slope in derivatives:
        near, far = (np.asarray(slope[:, i]) for i in (0, 1))
        scale = 4 * count * np.finfo("float64").eps * np.abs(far).max()
        np.testing.assert_allclose(near, far, rtol=0, atol=scale)


@pytest.mark.long
def test_shares_of_a_way_are_its_targets():
    """Three columns of weights, and one times the way: values and derivatives, near and of all."""
    at, count = jnp.asarray(shuffled(TUBE), "float64"), 16
    spacing, radius = jnp.asarray(1.5, "float64"), jnp.asarray(12.0, "float64")
    chosen = local.runs(at[:, 0], spacing)

    def move(kind, s_c, phi_c, depth, sag, spacing):
        where = local.centres(s_c, phi_c, radius, spacing, count)
        if kind == "way":
            found = local.fit(where, local.shares(depth, sag)[:, None], 3 * spacing, depth)
            assert found.weights.shape == (count, 1)
        else:
            found = local.fit(where, local.targets(depth, sag), 3 * spacing)
        near = local.add_correction(0 * at, found, at, chosen, s_c)
        return near, local.correction(found, where)

    @functools.partial(jax.jit, static_argnums=0, compiler_options=QUICK)
    def program(kind, x, tangent, cotangent):
        f = functools.partial(move, kind)
        return jax.jvp(f, x, tangent), jax.vjp(f, *x)[1](cotangent)

    for depth in ((0.2, -1.0, 0.3), (0.0, 0.0, 0.0)):
        s_c, phi_c, depth = (jnp.asarray(v, "float64") for v in (73.3, 0.4, depth))
        x = s_c, phi_c, depth, jnp.linspace(0, 1.5, count, dtype="float64"), spacing
        moved = jax.eval_shape(functools.partial(move, "way"), *x)
        given = x, random_like(x, 4), random_like(moved, 5)
        given = jax.tree.map(lambda v: v.astype("float64"), given)
        way, columns = program("way", *given), program("targets", *given)
        for a, b in zip(jax.tree.leaves(way), jax.tree.leaves(columns), strict=True):
            assert a.dtype == b.dtype == jnp.dtype("float64")
            # Rounding only: both solve with the same factors.
            atol = 64 * np.finfo("float64").eps * max(np.abs(b).max(), 1)
            np.testing.assert_allclose(a, b, rtol=0, atol=atol)


def test_vertices_of_a_dent_wider_than_prepared_are_nan():
    chosen = local.runs(TUBE.s, jnp.asarray(1.0))
    at, wanted, found = as_arrays(dent(8, spacing=2.0, reach=6.0))

    def corrected(chosen):
        none = jnp.zeros_like(TUBE.straight)
        add = local.add_correction
        return jax.jit(lambda: add(none, found, TUBE.straight, chosen, at[0, 0]))()

    assert np.isnan(corrected(chosen)).any()
    right = local.runs(TUBE.s, jnp.asarray(2.0))
    assert np.isfinite(corrected(right)).all()


def test_one_centre_is_the_kernel():
    """Wendland's C2 function by hand: psi(1/2) = 3/16."""
    at, wanted, found = dent(1, reach=4.0)
    got = correction(found, at + np.asarray([[2.0, 0, 0]]))
    np.testing.assert_allclose(got, 3 / 16 * wanted, rtol=1e-12)


def test_sag_makes_the_footprint_shallower():
    got = targets(np.asarray([0.0, -2.0, 0]), np.asarray([9.0] + [0.5] * 6 + [0] * 9))
    np.testing.assert_allclose(got[:, 1], [-2] + [-1.5] * 6 + [0] * 9)
    np.testing.assert_array_equal(targets(np.asarray([0.0, -0.3, 0]), np.full(16, 0.5))[1:], 0)


def test_repeated_centres():
    """A twin with the same target changes nothing; with another, they share the mean."""
    at = np.asarray([[0.0, 0, 0], [0, 0, 0], [2, 0, 0]])
    reach = np.asarray(5.0)
    one = fit(at[1:], np.asarray([[1.0, 0, 0], [0, 1, 0]]), reach)
    two = fit(at, np.asarray([[1.0, 0, 0], [1, 0, 0], [0, 1, 0]]), reach)
    x = np.asarray([[0.5, 0.3, 0], [1.5, 0, 1]])
    np.testing.assert_allclose(correction(two, x), correction(one, x), atol=1e-3)
    odd = fit(at, np.asarray([[1.0, 0, 0], [3, 0, 0], [0, 1, 0]]), reach)
    np.testing.assert_allclose(correction(odd, at)[0, 0], 2, atol=1e-2)


@pytest.mark.slow
def test_dent_gradients():
    """Through centres, targets, factors and kernel, also on a centre and with no depth."""
    count = 16

    def f(x):
        s, phi, depth, sag, reach = x
        at = local.centres(s, phi, jnp.asarray(12.0), jnp.asarray(1.5), count)
        found = local.fit(at, local.targets(depth, sag), reach)
        here = jnp.concatenate([jnp.asarray([[73.0, 11, 5], [74, 12, 3]]), at[:1]])
        return local.correction(found, here)

    slopes = slopes_of(f)
    for depth in ((0.2, -1.0, 0.3), (0.0, 0.0, 0.0)):
        x = (jnp.asarray(73.0), jnp.asarray(0.4), jnp.asarray(depth))
        x = (*x, jnp.full(count, 0.3), jnp.asarray(5.0))
        tangent = random_like(x, 1)
        if depth == (0.0, 0.0, 0.0):  # the footprint lifts off where |d| reaches the sag
            tangent = (*tangent[:3], 0 * tangent[3], tangent[4])
        check_gradient(slopes, x, tangent, (3, 3), rtol=3e-6)


def test_global_and_local_make_up_the_tool_displacement():
    """The model's sum: C moves by its global part plus d."""
    keys = random_keys()
    d = np.asarray([0.2, -1.0, 0.3])
    at_C = motion("hermite", 73.0, 0.4, 0.4, keys)[0]
    _, _, found = dent(16)
    here = points(73.0, 0.4).straight
    np.testing.assert_allclose(at_C + correction(found, here)[0], keys.contact + d, atol=1e-9)


def test_a_dent_is_that_of_numpy():
    rng = np.random.default_rng(2)
    centres, points = rng.normal(size=(8, 3)), rng.normal(size=(5, 3))
    targets = 10 * rng.normal(size=(8, 3))
    found = correction(fit(centres, targets, np.asarray(3.0)), points)
    q = np.minimum(np.linalg.norm(centres[:, None] - centres, axis=2) / 3, 1)
    weights = np.linalg.solve((1 - q) ** 4 * (4 * q + 1), targets)
    q = np.minimum(np.linalg.norm(points[:, None] - centres, axis=2) / 3, 1)
    np.testing.assert_allclose(found, (1 - q) ** 4 * (4 * q + 1) @ weights, rtol=1e-9, atol=1e-9)
