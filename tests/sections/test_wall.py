"""The wall between the rings and round them: beams by hand, sections by brute force, the specimen.

Outside truth: Timoshenko's element matrices, the trapezoidal rule on 40,000 points, rigid motions,
and the finite element specimen's outer surface, hardly a node of which is a ring's end or joint.
"""

import functools
from pathlib import Path

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from jitted import jitted

from jaxtrachea.mechanics.sections.contact import Modal, end_shares, own_deflection
from jaxtrachea.mechanics.sections.material import from_wall
from jaxtrachea.mechanics.sections.press import press_sections
from jaxtrachea.mechanics.sections.wall import (
    WallModes,
    around,
    gather_points,
    side_of_contact,
    wall_motion,
)
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.geometry import Geometry

pytestmark = pytest.mark.compiling
VIRTUAL = Path(__file__).parents[2] / "fits" / "virtual_trachea"
RINGS = 10.0 * np.arange(1, 16)
TUBE = Geometry.create(160.0, RINGS, radius=11.7)
MATERIAL = from_wall(TUBE)
R, ALPHA, OUTER = 11.7, float(TUBE.half_angle), 11.7 + float(MATERIAL.offset)


def element(h, a, c):
    """Stiffness of a shear-flexible beam by (w, psi) of both ends (Przemieniecki)."""
    p = 12 * c / (a * h * h)
    own, other = (4 + p) * h * h, (2 - p) * h * h
    rows = [[12, 6 * h, -12, 6 * h], [6 * h, own, -6 * h, other],
            [-12, -6 * h, 12, -6 * h], [6 * h, other, -6 * h, own]]  # fmt: skip
    return c / (h**3 * (1 + p)) * np.array(rows)


own, shares, side = map(jitted, (own_deflection, end_shares, side_of_contact))


def by_elements(x, load, h, a, c):
    """Deflection at x of a beam with both ends held, by a unit force at `load`; its stiffness."""
    places = np.unique([0.0, x, load, h])
    K = np.zeros((2 * len(places),) * 2)
    for i, length in enumerate(np.diff(places)):
        K[2 * i : 2 * i + 4, 2 * i : 2 * i + 4] += element(length, a, c)
    force = np.zeros(len(K))
    force[2 * np.searchsorted(places, load)] = 1
    u = np.zeros(len(K))
    u[2:-2] = np.linalg.solve(K[2:-2, 2:-2], force[2:-2])
    return u[2 * np.searchsorted(places, x)], K


@pytest.mark.parametrize("a", [0.3, 40.0, 1e6])
def test_a_span_is_a_beam_of_elements(a):
    """Own deflection and shape functions of modes that warp; of one that only shears, by hand."""
    h, c = 9.0, 50.0
    warps = np.array([[1.0, 1.0, 1.0, 0.0]], "float64")
    beam = Modal(np.full((1, 4), a, "float64"), np.full((1, 4), c, "float64"), warps)
    rtol = 1e-9
    for x, load in [(2.0, 3.5), (6.0, 3.5), (3.5, 3.5), (8.5, 1.0)]:
        got = own(*(np.asarray(v, "float64") for v in (x, load, h)), beam)
        np.testing.assert_allclose(got[0, 0], by_elements(x, load, h, a, c)[0], rtol=rtol)
        shear = min(x, load) * (h - max(x, load)) / h / a
        np.testing.assert_allclose(got[0, 3], shear, rtol=rtol)
        K = by_elements(x, x, h, a, c)[1]
        by_ends = -np.linalg.solve(K[2:4, 2:4], K[2:4][:, [0, 1, 4, 5]])[0]
        (w_L, r_L), (w_R, r_R) = shares(*(np.asarray(v, "float64") for v in (x, h)), beam)
        got = [float(v[0, 0]) for v in (w_L, r_L, w_R, r_R)]
        np.testing.assert_allclose(got, by_ends, rtol=10 * rtol, atol=1e-12)
        assert float(r_L[0, 3]) == pytest.approx(0.5 * x * (h - x) / h)  # which `selector` drops


def brute_force(q, phi, distance):
    """Displacement of points of one section by the equations of `section`, trapezoidal rule."""
    a, e, b = q[:3], q[3], q[4:]
    front = np.linspace(-ALPHA, ALPHA, 30001)
    back = np.linspace(ALPHA, 2 * np.pi - ALPHA, 10001)

    def turn(x, lam):
        modes = (b[0] + sum((m - 1 / m) * (a[m - 1] * np.sin(m * x) - b[m] * np.cos(m * x))
                            for m in (2, 3))) / R  # fmt: skip
        return modes + lam[0] * np.sin(x) + lam[1] * np.cos(x)

    def slope(x, strain, lam):
        t = x + turn(x, lam)
        return R * np.array([np.sin(x) - strain * np.sin(t), strain * np.cos(t) - np.cos(x)])

    pieces = [(front, 1.0), (back, 1 + e / R)]
    lam = scipy.optimize.root(
        lambda lam: sum(np.trapezoid(slope(x, k, lam), x) for x, k in pieces), [0, 0], tol=1e-13
    ).x
    angle, line = np.concatenate([front, back]), [np.zeros((2, 1))]
    for x, k in pieces:
        v = slope(x, k, lam)
        steps = np.cumsum(np.diff(x) * (v[:, 1:] + v[:, :-1]) / 2, 1)
        line += [line[-1][:, -1:] + steps] + (
            [line[-1][:, -1:] + steps[:, -1:]] if x is front else []
        )
    line = np.concatenate(line, 1)
    line += np.array([a[0], b[1]])[:, None] - np.trapezoid(line, angle)[:, None] / (2 * np.pi)
    at = np.where(phi < -ALPHA, phi + 2 * np.pi, phi)
    u = np.stack([np.interp(at, angle, v) for v in line], 1)
    x = phi + turn(phi, lam)
    normal = np.stack([np.cos(x) - np.cos(phi), np.sin(x) - np.sin(phi)], 1)
    return u + (distance - R)[:, None] * normal


PHI = np.array([-3.1, -2.4, -ALPHA, -1.9, -0.7, 0.0, 0.4, 1.3, 2.05, 2.6, np.pi])
DISTANCE = np.linspace(9.0, 14.0, len(PHI))
SHAPE = TUBE.radius, TUBE.half_angle
move = jitted(wall_motion)


@jitted
def _carried(q, points, *shape):
    modes = WallModes(q[None], jnp.zeros_like(q)[None])
    return wall_motion(modes, around(points, *shape), jnp.zeros((), q.dtype), *shape)


def carried(q, phi=PHI, distance=DISTANCE, dtype="float64"):
    """Points of one section that no contact presses."""
    points = gather_points(*(jnp.asarray(v, dtype) for v in (0 * phi, phi, distance)))
    return _carried(np.asarray(q, dtype), points, *(np.asarray(v, dtype) for v in SHAPE))


@pytest.mark.slow
@pytest.mark.compiling
def test_sections_against_brute_force():
    """Cartilage and muscle, inside and outside of the mid-line.

    Between its points the quadrature is a polynomial, off by 7e-5 mm at 2 mm in every mode at once.
    """
    for size, tolerance in ((2.0, 1e-4), (0.3, 2e-6)):
        q = np.random.default_rng(1).normal(size=8) * size
        got = carried(q)
        assert (got[:, 0] == 0).all()
        wanted = brute_force(q, PHI, DISTANCE)
        np.testing.assert_allclose(got[:, 1:], wanted, atol=tolerance)


def test_rigid_motions():
    """Translations move every point alike; a roll b0 turns the section by b0 / R, at any size."""
    q = np.array([1.5, 0, 0, 0, 4.0, -0.7, 0, 0])
    angle = q[4] / R
    rest = DISTANCE[:, None] * np.stack([np.cos(PHI), np.sin(PHI)], 1)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    np.testing.assert_allclose(carried(q)[:, 1:], rest @ turn.T - rest + [1.5, -0.7], atol=1e-13)


def test_many_sections_at_once():
    """`vmap` over the modes gives each as alone; a point knows its place."""
    q, phi_c = jnp.asarray(np.random.default_rng(4).normal(size=(2, 3, 4))), jnp.asarray(0.0)
    s, same = jnp.asarray([0.0, 5.0, 9.0, 5.0]), jnp.full(4, 0.4)
    points, modes = around(gather_points(s, same, same + 11), *SHAPE), WallModes(q, 0.1 * q)
    run = jitted(jax.vmap(lambda m: wall_motion(m, points, phi_c, *SHAPE)))
    both = run(modes)
    for i in range(2):
        alone = move(jax.tree.map(lambda v, i=i: v[i], modes), points, phi_c, *SHAPE)
        np.testing.assert_allclose(both[i], alone, atol=1e-13)
        np.testing.assert_array_equal(both[i, 1], both[i, 3])
        assert np.abs(both[i, 1] - both[i, 0]).max() > 0.1


def test_where_the_own_deflection_goes():
    """cos^2 of one and a half times the angle to 60 degrees, on either side, over +-pi."""
    x = np.linspace(-3.0, 3.0, 61)
    wanted = np.where(np.abs(x) < np.pi / 3, np.cos(1.5 * x) ** 2, 0)
    for turns in (0, 2 * np.pi):
        np.testing.assert_allclose(side(x + turns), wanted, atol=1e-12)


def pressed(s_c, phi_c, D, s, phi, material=MATERIAL):
    """Press and wall at points of the outer surface."""
    points = gather_points(*(jnp.asarray(v) for v in (s, phi, np.full(len(s), OUTER))))
    places = jnp.pad(points.s, (0, 96 - points.s.size))  # one program for all
    out = press_at(material, s_c, phi_c, jnp.asarray(D), places)
    assert np.all(out.status == PressStatus.OK)
    seats = around(points, *SHAPE)
    u = [move(jax.tree.map(lambda v, i=i: v[i], out.along), seats, phi_c, *SHAPE)
         for i in range(len(D))]  # fmt: skip
    return out, np.stack(u)


@jax.jit
def press_at(material, s_c, phi_c, D, places):
    return press_sections(TUBE, material, s_c, phi_c, D, places=places)


@pytest.mark.slow
def test_the_wall_meets_rings_and_contact_and_is_continuous():
    """At rings: joints and ends, which `section.way_to` gives. At C: the skeleton's motion there.

    A tool with a footprint acts nearer to the ring than it is: there the wall moves as it says.
    """
    s_c, phi_c, D, e = 72.5, 1.1, [2.0, 6.0], 1e-7
    acts = 70 + 5 * 0.5 ** float(MATERIAL.footprint)
    s = np.concatenate([np.tile(RINGS, 3), [acts]])
    phi = np.concatenate([np.repeat([phi_c, -ALPHA, ALPHA], 15), [phi_c]])
    rings, there, acting, corner = (70.0, 0.3), (90.0, 2.5), (acts, -0.2), phi_c + np.pi / 3
    pairs = [[(x - e, y), (x + e, y)] for x, y in (rings, there, acting)]
    pairs += [[(71.0, y - e), (71.0, y + e)] for y in (ALPHA, -ALPHA, corner)]
    pairs += [[(71.0, np.pi), (71.0, -np.pi)], [(0.0, 0.0), (160.0, 1.0)]]
    along, angle = np.reshape(pairs, (-1, 2)).T
    s, phi = np.concatenate([s, along]), np.concatenate([phi, angle])
    out, u = pressed(s_c, phi_c, D, s, phi)
    for part, wanted in zip(range(3), (out.joints, out.end_U, out.end_V), strict=True):
        np.testing.assert_allclose(u[:, 15 * part : 15 * part + 15], wanted, atol=5e-5)
    np.testing.assert_allclose(u[:, 45], out.skeleton, atol=5e-5)
    below, above = np.moveaxis(u[:, 46:].reshape(2, -1, 2, 3), 2, 0)
    np.testing.assert_allclose(below, above, atol=1e-6)
    assert (np.abs(below[:, :-1, 1:]).max(axis=2) > 0.05).all()
    assert np.abs(below[:, -1]).max() < 1e-14  # the ends of the tube
    mirrored = pressed(s_c, -phi_c, D, s, -phi)[1]
    np.testing.assert_allclose(mirrored, u * [1, 1, -1], atol=1e-10)


#: Press: rms of the error over D, for D = 1 and 6 mm; what is measured, and 0.002.
SPECIMEN = {
    "off_s075_p90": (0.059, 0.067),
}


@functools.cache
def specimen(name):
    """Nodes of the outer surface, motion of the specimen's and of the wall, over D."""
    with h5py.File(VIRTUAL / "surface.h5") as file:
        data = {k: np.asarray(v[()], float) for k, v in file[name].items()}
    s, D = np.round(data["s"], 4), data["displacement"]
    u = pressed(data["s_c"], data["phi_c"], D, s, data["phi"])[1]
    return s, data["phi"], data["phi_c"], data["motion"] / D[:, None, None], u / D[:, None, None]


@pytest.mark.slow
@pytest.mark.parametrize("name", SPECIMEN)
def test_the_specimens_outer_surface(name):
    """Anywhere within 25 mm of the press but under the punch; the wall moves by 0.4 D (rms)."""
    s, phi, phi_c, true, got = specimen(name)
    off = np.abs(s[:, None] - RINGS[None]).min(1)
    marker = (off < 0.1) & (np.abs(phi - phi_c) < 0.1)
    assert marker.mean() < 0.02  # no fit has seen the others
    assert (off > 2).mean() > 0.45  # beside the rings, which are 4 mm high
    error = np.linalg.norm((got - true)[..., 1:], axis=2)
    for rows, most in zip(error, SPECIMEN[name], strict=True):
        assert np.sqrt(np.mean(rows**2)) < most
        assert rows.max() < 0.18
    size = np.linalg.norm(true[..., 1:], axis=2)
    assert np.all(np.sqrt(np.mean(size**2, axis=1)) > 0.39)
    # Nothing moves along the tube; the specimen's surface does, by a tenth of D.
    assert np.abs(true[..., 0]).max() < 0.13


@pytest.mark.slow
def test_derivatives():
    """By modes, angle of the contact, radius and half-angle: forward = reverse = differences."""
    q, own = np.random.default_rng(2).normal(size=8), jnp.full((1, 8), 0.3)
    points = gather_points(jnp.zeros(len(PHI)), jnp.asarray(PHI), jnp.asarray(DISTANCE))

    def values(x):
        shape = x[8], x[9]
        seats, modes = around(points, *shape), WallModes(x[None, :8], own)
        return wall_motion(modes, seats, x[10], *shape).ravel()

    x = jnp.concatenate([q, jnp.asarray([R, ALPHA + 0.02, 0.4])])
    value = jax.jit(values)
    forward, reverse = jax.jit(jax.jacfwd(values))(x), jax.jit(jax.jacrev(values))(x)
    np.testing.assert_allclose(forward, reverse, atol=1e-12)
    h = 1e-3
    for i, e in enumerate(np.eye(len(x))):
        near = [np.asarray(value(x + k * h * e)) for k in (1, -1, 2, -2)]
        difference = (8 * (near[0] - near[1]) - (near[2] - near[3])) / (12 * h)
        np.testing.assert_allclose(forward[:, i], difference, atol=1e-8)
