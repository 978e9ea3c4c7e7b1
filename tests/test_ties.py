"""Where several normals are equally right: the same one alone, in a batch, in every unit; FLAT."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from late import late

from jaxtrachea.contact.distance import signed_distance
from jaxtrachea.contact.patches import straight_patches, touch
from jaxtrachea.contact.pose import Pose, pose_from_vector
from jaxtrachea.contact.search import STANDARD
from jaxtrachea.contact.shapes import box, capsule, cloud, cylinder, padded, sphere
from jaxtrachea.contact.walls import TubeSurface, patches_of
from jaxtrachea.status import ContactStatus
from jaxtrachea.trachea.geometry import table_1
from jaxtrachea.trachea.tube import make_tube

pytestmark = pytest.mark.compiling

#: Most of the time here is compilation.
quick = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
ZERO = (0.0, 0.0, 0.0)
SCALES = (0.01, 1.0, 1000.0)
MOST = 24  # vertices of the largest shape: all are padded to as many
#: Agreement of the gap, in units of the size; of normal and witness: roundings of the vertices
#: shift the weights of the softmax by sharpness roundings each.
GAP = {"float32": 3e-6, "float64": 1e-13}
PLACE = {"float32": 3e-3, "float64": 1e-9}

CUBE, ROD = box([1.0, 1.0, 1.0]), capsule(2.0, 0.5)
SLAB, BRICK = box([1.0, 2.0, 3.0]), box([1.0, 1.0, 2.0], 0.1)
PRISM = cylinder(4.0, 2.0, sides=12)
HEXAGON = cylinder(4.0, 2.0, 0.1, sides=6)
OCTAHEDRON = cloud(np.concatenate([np.eye(3), -np.eye(3)]))
TETRAHEDRON = cloud(np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]))
DOT = cloud(np.full((3, 3), 0.1))
EYE = np.eye(3)
FACES = np.concatenate([EYE, -EYE])
UP_DOWN = FACES[[0, 3]]
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 3**0.5
EVEN = CORNERS[np.prod(CORNERS, axis=1) < 0]  # outward normals of the tetrahedron


def facets(sides):
    """Normals of a prism's sides, half way between its vertices."""
    turn = (np.arange(sides) + 0.5) * 2 * np.pi / sides
    return np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)


#: name: A, B, rotation vector, translation, exact distance, the exact set of normals (rows; a
#: function: a continuous set).
TIES = {
    "ball in a cube": (CUBE, sphere(0.5), ZERO, ZERO, -1.5, FACES),
    "ball in a cube, on an axis' plane": (
        CUBE, sphere(0.5), ZERO, (0.3, 0.3, 0.1), -1.2, FACES[[0, 1]],
    ),
    "ball on a cube's diagonal": (CUBE, sphere(0.5), ZERO, (0.2, 0.2, 0.2), -1.3, FACES[:3]),
    "ball in a slab": (SLAB, sphere(0.5), ZERO, ZERO, -1.5, UP_DOWN),
    "ball in a slab's mid-plane": (SLAB, sphere(0.2), ZERO, (0.0, 0.3, 1.0), -1.2, UP_DOWN),
    "cubes coincident": (CUBE, CUBE, ZERO, ZERO, -2, FACES),
    "slab in a cube": (CUBE, box([0.2, 0.1, 0.4]), ZERO, ZERO, -1.1, FACES[[1, 4]]),
    "brick in a brick": (BRICK, BRICK, ZERO, ZERO, -2.2, FACES[[0, 1, 3, 4]]),
    "ball in a prism": (PRISM, sphere(0.5), ZERO, ZERO, -2 * np.cos(np.pi / 12) - 0.5, facets(12)),
    "ball along a prism": (
        HEXAGON, sphere(0.3), ZERO, (0.0, 0.0, 1.0), -2 * np.cos(np.pi / 6) - 0.4, facets(6),
    ),
    "ball in an octahedron": (
        OCTAHEDRON, sphere(0.25), ZERO, ZERO, -(3**-0.5) - 0.25, CORNERS,
    ),
    "ball in a tetrahedron": (
        TETRAHEDRON, sphere(0.25), ZERO, ZERO, -(3**-0.5) - 0.25, EVEN,
    ),
    "rod in a box, level": (box([1.0, 1.0, 5.0]), ROD, ZERO, ZERO, -1.5, FACES[[0, 1, 3, 4]]),
    "rods crossing": (ROD, ROD, (0.0, np.pi / 2, 0.0), ZERO, -1, FACES[[1, 4]]),
    "rod through a slab": (SLAB, ROD, (0.0, np.pi / 2, 0.0), ZERO, -2.5, FACES[[1, 4]]),
    "box on the mid-plane of a rod": (
        ROD, box([0.3, 0.4, 3.0]), ZERO, ZERO, -0.8, FACES[[0, 3]],
    ),
    "balls concentric": (sphere(1.0), sphere(2.0), ZERO, ZERO, -3, lambda n: np.ones(len(n))),
    "dots coincident": (DOT, DOT, ZERO, ZERO, 0, lambda n: np.ones(len(n))),
    "dots coincident, turned": (
        DOT, DOT, (0.0, 0.0, np.pi / 2), (0.2, 0.0, 0.0), 0, lambda n: np.ones(len(n)),
    ),
    "rods in each other": (ROD, ROD, ZERO, ZERO, -1, lambda n: np.abs(n[:, 2]) < 1e-3),
    "ball on a rod's axis": (
        ROD, sphere(0.25), ZERO, (0.0, 0.0, 0.5), -0.75, lambda n: np.abs(n[:, 2]) < 1e-3,
    ),
}  # fmt: skip
#: The same a little off (or flat against each other): one normal, the last entry.
SINGLE = {
    "ball in a cube": (CUBE, sphere(0.5), ZERO, (0.0, 0.02, 0.0), -1.48, EYE[1]),
    "ball in a slab": (SLAB, sphere(0.5), ZERO, (-0.02, 0.0, 0.0), -1.48, -EYE[0]),
    "cubes coincident": (CUBE, CUBE, ZERO, (0.0, 0.0, -0.02), -1.98, -EYE[2]),
    "brick in a brick": (BRICK, BRICK, ZERO, (0.02, 0.01, 0.0), -2.18, EYE[0]),
    "rods crossing": (ROD, ROD, (0.0, np.pi / 2, 0.0), (0.0, 0.02, 0.0), -0.98, EYE[1]),
    "balls concentric": (sphere(1.0), sphere(2.0), ZERO, (0.0, 0.0, 0.02), -2.98, EYE[2]),
    "rods in each other": (ROD, ROD, ZERO, (0.02, 0.0, 0.0), -0.98, EYE[0]),
    "cubes face to face": (CUBE, CUBE, ZERO, (2.0, 0.0, 0.0), 0, EYE[0]),
    "plates turned": (
        box([50.0, 50.0, 0.05]), box([50.0, 50.0, 0.05]), (0.0, 0.0, np.pi / 6), (3.0, 2.0, 1.0),
        0.9, EYE[2],
    ),
}  # fmt: skip


def batch(cases, scale, dtype):
    """Shapes, poses of all cases, in another unit of length."""
    kinds = list(cases.values())
    kinds += kinds[-1:] * (len(TIES) - len(kinds))  # one program for all
    made = [jax.tree.map(lambda *v: np.stack(v) * scale, *(padded(c[i], MOST) for c in kinds))
            for i in (0, 1)]  # fmt: skip
    at = jax.vmap(pose_from_vector)(
        jnp.asarray(np.array([c[2] for c in kinds])),
        jnp.asarray(np.array([c[3] for c in kinds]) * scale),
    )
    return jax.tree.map(lambda v: jnp.asarray(v, dtype), (*made, at))


def sizes(cases, scale=1.0):
    """Of each pair, as the settings define it, over the scale; 1 mm for what has none."""

    def reach(s):
        return np.linalg.norm(s.vertices - s.vertices.mean(1)[:, None], axis=0).max()

    size = [reach(c[0]) + reach(c[1]) + c[0].radius + c[1].radius for c in cases.values()]
    return np.where(np.array(size) > 1e-9, size, 1 / scale if scale else np.inf)


@functools.cache
def programs(dtype):
    """One pose alone, and many: compiled apart, so that their roundings differ."""
    del dtype
    alone = quick(signed_distance)
    return alone, jax.jit(jax.vmap(signed_distance))


@functools.cache
def results(name, dtype, scale):
    """All cases in a batch; numpy arrays in units of the first scale."""
    cases = {"ties": TIES, "single": SINGLE}[name]
    c = programs(dtype)[1](*batch(cases, scale, dtype))
    return in_unit(jax.tree.map(lambda v: v[: len(cases)], c), scale)


def in_unit(c, scale):
    """Lengths over the scale."""
    lengths = {k: np.asarray(getattr(c, k), float) / scale for k in ("distance", "lower")}
    points = {k: np.asarray(getattr(c, k), float) / scale for k in ("point_a", "point_b")}
    return {**lengths, **points, "normal": np.asarray(c.normal, float), "status": c.status}


def same(one, two, size, dtype, name):
    """Two answers are one; lengths over `size`, where that is infinite they are not compared."""
    size, name = np.atleast_1d(size), np.atleast_1d(name)
    unit = {"distance": size * GAP[dtype] / PLACE[dtype], "normal": np.ones(len(size))}
    for key, by in {**unit, "point_a": size, "point_b": size}.items():
        off = np.abs(one[key] - two[key]).reshape(len(size), -1).max(axis=1) / by
        wrong = (off >= PLACE[dtype]) & np.isfinite(by)
        assert not wrong.any(), (key, name[wrong], off[wrong])
    np.testing.assert_array_equal(one["status"], two["status"])


@pytest.mark.slow
@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("dtype", ["float64", *late("float32")])
def test_ties_are_right_and_told(dtype, scale):
    """The gap of the closed form, a normal of the exact set, FLAT."""
    got, size = results("ties", dtype, scale), sizes(TIES, scale)
    for i, (name, (*_, exact, normals)) in enumerate(TIES.items()):
        bound = 2 * np.log(MOST) / STANDARD.sharpness * size[i]
        short = exact - got["distance"][i]
        assert -GAP[dtype] * size[i] <= short <= bound + GAP[dtype] * size[i], (name, short)
        n = got["normal"][i]
        if callable(normals):
            assert normals(n[None])[0], (name, n)
        else:
            assert (normals @ n).max() > 1 - 5e-6, (name, n)
        assert got["status"][i] == ContactStatus.FLAT, name


@pytest.mark.slow
@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("dtype", ["float64", *late("float32")])
def test_off_a_tie_the_normal_is_the_only_one(dtype, scale):
    """A hundredth of the size off: OK, and the one normal; flat faces have one normal too."""
    got, size = results("single", dtype, scale), sizes(SINGLE)
    for i, (name, (*_, exact, normal)) in enumerate(SINGLE.items()):
        bound = 2 * np.log(MOST) / STANDARD.sharpness * size[i]
        short = exact - got["distance"][i]
        assert -GAP[dtype] * size[i] <= short <= bound + GAP[dtype] * size[i], (name, short)
        assert normal @ got["normal"][i] > 1 - 5e-6, (name, got["normal"][i])
        assert got["status"][i] == ContactStatus.OK, name


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize("name", ["ties", "single"])
@pytest.mark.parametrize("dtype", ["float64", *late("float32")])
def test_every_unit_gives_the_same(name, dtype):
    cases = {"ties": TIES, "single": SINGLE}[name]
    # Points without a size are smoothed as if it were 1 mm: their lengths depend on the unit.
    size = np.where(sizes(cases, 0.0) < np.inf, sizes(cases), np.inf)
    for scale in SCALES[::2]:
        same(results(name, dtype, scale), results(name, dtype, 1.0), size, dtype, list(cases))


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize("name", ["ties", "single"])
def test_both_dtypes_give_the_same(name):
    cases = {"ties": TIES, "single": SINGLE}[name]
    one, two = (results(name, dtype, 1.0) for dtype in ("float32", "float64"))
    same(one, two, sizes(cases), "float32", list(cases))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ties", "single"])
@pytest.mark.parametrize("dtype", ["float64", *late("float32")])
def test_alone_as_in_a_batch(name, dtype):
    """Programs of one lane and of many round differently; at an odd scale that vertices feel."""
    cases, scale = {"ties": TIES, "single": SINGLE}[name], 0.01
    rows, together = batch(cases, scale, dtype), results(name, dtype, scale)
    for i, (case, size) in enumerate(zip(cases, sizes(cases), strict=True)):
        one = in_unit(programs(dtype)[0](*jax.tree.map(lambda v: v[i], rows)), scale)  # noqa: B023
        same(one, {k: v[i] for k, v in together.items()}, size, dtype, [case])


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [pytest.param("float32", marks=pytest.mark.slow), "float64"])
def test_derivatives_at_ties_are_finite_and_those_of_the_normal_taken(dtype):
    """By a shift of B: the gap changes with the normal; forward = reverse."""

    def one(a, b, pose):
        def gap(shift):
            c = signed_distance(a, b, Pose(pose.rotation, pose.translation + shift))
            return c.distance, c

        zero = jnp.zeros(3, dtype)
        back, c = jax.grad(gap, has_aux=True)(zero)
        return back, jax.jacfwd(lambda v: gap(v)[0])(zero), c.normal

    reverse, forward, normal = quick(jax.vmap(one))(*batch(TIES, 1.0, dtype))
    np.testing.assert_allclose(reverse, normal, atol=PLACE[dtype])
    np.testing.assert_allclose(forward, normal, atol=PLACE[dtype])


# ---------------------------------------------------------------- flat tools on a symmetric tube

#: Half-sizes of boxes, rounded by 0.5: 100 mm along the tube, 100 mm across, and shorter ones.
BOXES = {
    "along": (50.0, 5, 5),
    "across": (5.0, 5, 50),
    "square": (10.0, 5, 10),
    "short": (4.0, 3, 4),
}
MIDDLE, RADIUS = 80.0, 12.0
TURNS = np.arange(0, 35, 5) * 2 * np.pi / 35
#: Below: deeper than both radii, where `touch` says NOT_CONVERGED.
DEPTHS = np.linspace(1.0, -1.3, 8)


@functools.cache
def tubes():
    """Symmetric about the plane across their middle and about every plane of `TURNS`."""
    m = make_tube(table_1(), flatten=0.0, relief=0.0, lids=False)
    s, phi = np.asarray(m.s) * 2 * MIDDLE / float(table_1().length), np.asarray(m.phi)
    wall = np.stack([s, RADIUS * np.cos(phi), RADIUS * np.sin(phi)], axis=1)
    borders = np.linspace(0.0, 2 * MIDDLE, 8)
    surface = TubeSurface(vertices=wall, faces=m.faces, s=s)
    mesh = patches_of(surface, borders, rounding=0.25, most=80)
    return {"round": straight_patches(borders, RADIUS), "mesh": mesh}


@functools.cache
def led_over(kind):
    """Contact of any box, by rotation vector and place; one program for each tube."""
    tube = tubes()[kind]

    def one(tool, w, t):
        return touch(tool, pose_from_vector(w, t), tube, near=7)

    return quick(jax.vmap(one, (None, 0, 0)))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["round", "mesh"])
@pytest.mark.parametrize("name", BOXES)
def test_a_level_box_touches_a_symmetric_tube_in_the_middle(name, kind):
    """By symmetry: s in the middle, phi and normal straight up, no force to the side; and OK.

    The box lies along or across the tube on a corner of the 35-gon (or on the round wall).
    """
    half, tube = BOXES[name], tubes()[kind]
    tool = box(np.array(half), 0.5)
    turn, depth = (v.ravel() for v in np.meshgrid(TURNS, DEPTHS))
    out = RADIUS + half[1] + 0.5 + depth
    at = np.stack([MIDDLE + 0 * out, out * np.cos(turn), out * np.sin(turn)], axis=1)
    vectors = np.stack([turn, 0 * turn, 0 * turn], axis=1)
    c = led_over(kind)(tool, jnp.asarray(vectors), jnp.asarray(at))
    np.testing.assert_array_equal(c.status, ContactStatus.OK)
    assert (np.abs(c.gap - depth) < c.bound + tube.lost.max()).all()
    # The witness of a flat contact moves by the extent times the residue of the search.
    np.testing.assert_allclose(c.s, MIDDLE, atol=0.1)
    off = (np.asarray(c.phi) - turn + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(off, 0, atol=2e-3)
    side = np.stack([0 * turn, -np.sin(turn), np.cos(turn)], axis=1)
    np.testing.assert_allclose(np.sum(c.normal * side, axis=1), 0, atol=2e-3)


@pytest.mark.slow
def test_of_two_patches_equally_near_one_is_always_taken():
    """A box over the middle of a patch, its neighbours level: alone, in a batch, each dtype."""
    tube, tool = tubes()["round"], box(np.array(BOXES["square"]), 0.5)

    def one(x, tool, tube):
        return touch(tool, Pose(jnp.eye(3, dtype=x.dtype), x), tube)

    found = []
    for dtype in ("float32", "float64"):
        cast = jax.tree.map(lambda v: jnp.asarray(v, dtype), (tool, tube))  # noqa: B023
        at = np.stack([MIDDLE + 0 * DEPTHS, RADIUS + 5.5 + DEPTHS, 0 * DEPTHS], axis=1)
        together = quick(jax.vmap(one, (0, None, None)))(jnp.asarray(at, dtype), *cast)
        alone = [jax.jit(one)(jnp.asarray(x, dtype), *cast).s for x in at[:3]]
        np.testing.assert_allclose(together.s[:3], np.stack(alone), atol=0.05)
        found.append(np.asarray(together.s, float))
    np.testing.assert_allclose(*found, atol=0.05)
    assert np.ptp(found[1]) < 0.5
