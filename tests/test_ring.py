"""Cartilage ring: against a frame of straight bars, then its laws one by one."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jitted import jitted
from scipy.linalg import solve_banded

from jaxtrachea.mechanics.ring import (
    Ring,
    respond,
    ring_compliance,
    ring_influence,
    tie_stiffness,
)
from jaxtrachea.status import RingStatus

ALPHA = 2 * math.pi / 3
TABLE_1 = {"radius": 11.3, "half_angle": ALPHA, "EI": 13.0, "k_M": 0.1, "k_t": 0.4}
ANGLES = (0.0, 0.4, 1.9)
QUICK = {"xla_backend_optimization_level": 0}  # most of the time here is compilation

compliance = jitted(ring_compliance, static_argnames="order", compiler_options=QUICK)
response = jitted(respond, compiler_options=QUICK)
influence = jitted(jax.vmap(ring_influence, (None, 0, None)), compiler_options=QUICK)


def ring_of(dtype="float64", **changes):
    return Ring(**{name: jnp.asarray(v, dtype) for name, v in (TABLE_1 | changes).items()})


def C_of(ring, phi, **more):
    C, status = compliance(ring, jnp.asarray(phi, ring.radius.dtype), **more)
    assert status == RingStatus.OK
    return np.asarray(C)


def _bars(points, EI, EA):
    """Stiffness of bars in the (y, z) plane [bar, 6, 6]; dofs (y, z, turn) of its ends."""
    along = np.diff(points, axis=0)
    h = np.hypot(*along.T)
    c, s = along.T / h
    k = np.zeros((len(h), 6, 6))
    for i, j, sign in ((0, 0, 1), (0, 3, -1), (3, 0, -1), (3, 3, 1)):
        k[:, i, j] = sign * EA / h
    one, zero = np.ones_like(h), np.zeros_like(h)
    bend = [[12 * one, 6 * h, -12 * one, 6 * h], [6 * h, 4 * h * h, -6 * h, 2 * h * h]]
    bend += [[-12 * one, -6 * h, 12 * one, -6 * h], [6 * h, 2 * h * h, -6 * h, 4 * h * h]]
    k[np.ix_(range(len(h)), [1, 2, 4, 5], [1, 2, 4, 5])] = np.moveaxis(EI / h**3 * bend, 2, 0)
    node = np.moveaxis(np.array([[c, s, zero], [-s, c, zero], [zero, zero, one]]), 2, 0)
    turn = np.zeros((len(h), 6, 6))
    turn[:, :3, :3] = turn[:, 3:, 3:] = node
    return np.swapaxes(turn, 1, 2) @ k @ turn


@functools.cache
def frame(segments, phi_c, load, *fields):
    """Straight bars between points of the ring, one at phi_c; returns angles and motions."""
    radius, alpha, EI, k_M, k_t = fields
    left = max(1, min(segments - 1, round(segments * (phi_c + alpha) / (2 * alpha))))
    phi = np.concatenate(
        [np.linspace(-alpha, phi_c, left + 1), np.linspace(phi_c, alpha, segments - left + 1)[1:]]
    )
    points = radius * np.stack([np.cos(phi), np.sin(phi)], 1)
    # Next to inextensible; row `width` of `K` is the diagonal, those below are under it.
    bars, width, size = _bars(points, EI, 1e4 * EI), 5, 3 * segments + 3
    K = np.zeros((2 * width + 1, size))
    for i in range(6):
        for j in range(6):
            K[width + i - j, j : j + 3 * segments : 3] += bars[:, i, j]
    K[width, [0, 1, -3, -2]] += k_M / 2
    f = np.zeros((size, 2))
    f[3 * left : 3 * left + 2, 0] = load
    # The tie between the ends is not in the band: by Sherman and Morrison.
    f[[1, -2], 1] = 1, -1
    u, t = solve_banded((width, width), K, f).T
    u = u - k_t * (u[1] - u[-2]) / (1 + k_t * (t[1] - t[-2])) * t
    return phi, u.reshape(-1, 3)[:, :2], left


def frame_of(segments, phi_c, load, **changes):
    return frame(segments, phi_c, load, *(TABLE_1 | changes).values())


@pytest.mark.parametrize("phi_c", ANGLES)
@pytest.mark.parametrize(
    "changes", [{}, {"k_t": 0.0}, {"k_t": 1e3}, {"EI": 2.0, "half_angle": 2.6}]
)
def test_frame_of_bars_converges(phi_c, changes):
    """The chords come nearer to the arc with the square of their length.

    400 leave 3e-5 (5e-5 of the longer arc).

    What stays is the frame's axial strain (1e4 EI mm^-2): I / A R^2 = 1e-6 of the bending.
    """
    ring = ring_of(**changes)
    C = C_of(ring, phi_c)
    errors = []
    for segments in (50, 100, 200, 400):
        columns = [frame_of(segments, phi_c, load, **changes) for load in ((1, 0), (0, 1))]
        got = np.stack([motion[at] for _, motion, at in columns], 1)
        errors.append(np.max(np.abs(got - C)) / np.max(np.abs(C)))
    assert errors[-1] < (3e-5 if ring.half_angle < 2.5 else 5e-5)
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all(np.abs(orders[:2] - 2) < 0.15), errors


@pytest.mark.parametrize("phi_c", ANGLES)
def test_shape_and_ends_against_frame(phi_c):
    """Every point of the ring, and the ends U and V (paper fig. 7c)."""
    ring, load = ring_of(), (0.7, -0.4)
    phi, motion, _ = frame_of(400, phi_c, load)
    got = influence(ring, phi, jnp.asarray(phi_c)) @ np.array(load)
    np.testing.assert_allclose(got, motion, atol=5e-5 * np.max(np.abs(motion)))
    answer = response(ring, jnp.asarray(phi_c), jnp.asarray(load))
    np.testing.assert_allclose(answer.end_U, got[0], atol=1e-12)
    np.testing.assert_allclose(answer.end_V, got[-1], atol=1e-12)


@pytest.mark.parametrize("phi_c", [*ANGLES, -ALPHA, ALPHA])
def test_equilibrium_of_the_ends(phi_c):
    """Mat springs carry the load and its moment; tie and lateral springs make up the thrust."""
    ring, load = ring_of(), np.array([0.7, -0.4])
    got = response(ring, jnp.asarray(phi_c), jnp.asarray(load))
    U, V = (TABLE_1["k_M"] / 2 * np.asarray(end) for end in (got.end_U, got.end_V))
    np.testing.assert_allclose(U + V, load, atol=1e-14)

    def at(phi):
        return 11.3 * np.array([math.cos(phi), math.sin(phi)])

    def cross(r, f):
        return r[0] * f[1] - r[1] * f[0]

    moments = cross(at(-ALPHA), U) + cross(at(ALPHA), V)
    np.testing.assert_allclose(moments, cross(at(phi_c), load), atol=1e-12)
    np.testing.assert_allclose(got.tie, 0.4 * got.opening, rtol=1e-14)
    np.testing.assert_allclose(got.thrust, got.tie + 0.025 * got.opening, rtol=1e-13)
    np.testing.assert_allclose(got.joint, C_of(ring, phi_c) @ load, rtol=1e-12)


def test_crown_press_opens_the_ring():
    """Signs: the crown goes with the load, the ends settle alike and move apart."""
    got = response(ring_of(), jnp.asarray(0.0), np.array([-1.0, 0.0]))
    assert got.joint[0] < 0
    assert got.opening > 0
    np.testing.assert_allclose(got.end_U, got.end_V * np.array([1.0, -1.0]), rtol=1e-13)
    np.testing.assert_allclose(got.end_U[0], -1 / 0.1, rtol=1e-14)


@pytest.mark.parametrize("EI", [1e12, math.inf])
def test_rigid_arch_is_the_mat(EI):
    """Crown press: exactly P / k_M, the paper's d_i = P_i / k; a lateral one turns the ring too."""
    ring = ring_of("float64", EI=EI)
    C = C_of(ring, 0.0)
    eps = np.finfo("float64").eps
    np.testing.assert_allclose(C[0, 0], 10, rtol=4 * eps + 1e4 / EI)
    b, rise = math.sin(ALPHA), 1 - math.cos(ALPHA)
    np.testing.assert_allclose(C[1, 1], 10 * (1 + (rise / b) ** 2), rtol=8 * eps + 1e4 / EI)


def test_limits_of_the_tie():
    """0, inf and both sides of them; a stiffer tie never softens the ring."""
    chain = [C_of(ring_of(k_t=k), 0.4) for k in (0.0, 1e-9, 0.4, 0.975, 10.0, 1e9, math.inf)]
    np.testing.assert_allclose(chain[0], chain[1], rtol=1e-7)
    np.testing.assert_allclose(chain[-1], chain[-2], rtol=1e-7)
    for soft, stiff in zip(chain, chain[1:], strict=False):
        assert np.min(np.linalg.eigvalsh(soft - stiff)) > -1e-12
    phi, load = jnp.asarray(0.4), np.array([1.0, 0.2])
    held = response(ring_of(k_t=math.inf), phi, load)
    assert held.opening == 0
    np.testing.assert_allclose(held.tie, response(ring_of(k_t=1e9), phi, load).tie, rtol=1e-7)
    assert response(ring_of(k_t=0.0), phi, load).tie == 0
    both = C_of(ring_of(k_t=math.inf, EI=math.inf), 0.4)
    np.testing.assert_allclose(both, C_of(ring_of(EI=math.inf), 0.4), rtol=1e-14)


def test_ends_of_the_ring_and_behind():
    """At the ends the load stands on a spring; behind them there is no answer, and it is said."""
    ring, load = ring_of(), np.array([1.0, 0.0])
    end = response(ring, ring.half_angle, load)
    assert end.status == RingStatus.OK
    np.testing.assert_allclose(end.end_V[0], 20, rtol=1e-6)  # all of P on one k_M / 2
    np.testing.assert_allclose(end.end_U[0], 0, atol=1e-5)
    np.testing.assert_allclose(end.joint, end.end_V, atol=2e-5)
    near = response(ring, np.asarray(ring.half_angle) - 1e-5, load)
    np.testing.assert_allclose(near.joint, end.joint, rtol=1e-3, atol=1e-3)
    # One lane behind the gap leaves the others alone.
    phi = np.array([0.4, -2.2, math.pi, np.nan])
    C, status = jitted(jax.vmap(ring_compliance, (None, 0)))(ring, phi)
    wanted = ["OK", "BEHIND_GAP", "BEHIND_GAP", "NON_FINITE"]
    np.testing.assert_array_equal(status, [RingStatus[name] for name in wanted])
    np.testing.assert_allclose(C[0], C_of(ring, 0.4), rtol=8 * np.finfo("float64").eps)
    assert np.all(np.isnan(C[1:]))
    behind = response(ring, phi[2], load)
    assert behind.status == RingStatus.BEHIND_GAP
    assert all(np.all(np.isnan(v)) for v in behind[:-1])


@pytest.mark.parametrize("phi", [0.4, 1.9])
def test_mirror_and_reciprocity(phi):
    """The mirrored load gives the mirrored answer; Maxwell-Betti between any two points."""
    ring, flip = ring_of(), np.array([1, -1])
    C = C_of(ring, phi)
    np.testing.assert_allclose(C_of(ring, -phi), C * flip * flip[:, None], rtol=1e-12)
    assert np.min(np.linalg.eigvalsh(C)) > 0
    assert abs(C_of(ring, 0.0)[0, 1]) < 1e-14 * C[0, 0]
    others = np.array([-1.3, 0.2, ALPHA])
    to = influence(ring, others, phi)
    back = np.stack([influence(ring, np.array([phi]), v)[0] for v in others])
    np.testing.assert_allclose(to, back.mT, atol=1e-13 * C.max())
    np.testing.assert_allclose(influence(ring, np.array([phi]), phi)[0], C, rtol=1e-12)


def test_order():
    """What the docstring says of `order`: the error at the worst of the angles."""
    errors = {}
    for order in (4, 6, 8, 12):
        worst = 0.0
        for EI in (0.1, 13.0):
            for phi in (*ANGLES, ALPHA):
                C, exact = (C_of(ring_of(EI=EI), phi, order=o) for o in (order, 40))
                worst = max(worst, np.max(np.abs(C - exact)) / np.max(np.abs(exact)))
        errors[order] = worst
    assert 1e-4 < errors[4] < 1e-3
    assert 2e-7 < errors[6] < 2e-6
    assert errors[8] < 1e-9
    assert errors[12] < 1e-13


def test_float32():
    """1e-6 of the largest entry for soft and stiff ties and arches."""
    for changes in ({}, {"EI": 1e-3}, {"EI": 1e6}, {"k_t": 1e9}, {"k_M": 1e-6}, {"k_M": 1e6}):
        rounded = {k: float(np.float32(v)) for k, v in (TABLE_1 | changes).items()}
        for phi in ANGLES:
            C, exact = (
                C_of(ring_of("float32", **rounded), phi),
                C_of(ring_of(**rounded), float(np.float32(phi))),
            )
            assert C.dtype == np.float32
            assert np.max(np.abs(C - exact)) < 1e-6 * np.max(np.abs(exact)), (changes, phi)


def test_all_rings_of_a_tube():
    """One call for rings that differ in k_M: the single answers."""
    k_M, base = np.array([0.05, 0.1, 0.3]), ring_of()

    def one_ring(k):
        return Ring(base.radius, base.half_angle, base.EI, k, base.k_t)

    C, _ = jitted(jax.vmap(lambda k: ring_compliance(one_ring(k), jnp.asarray(0.4))))(k_M)
    for k, one in zip(k_M, C, strict=True):
        np.testing.assert_allclose(one, C_of(ring_of(k_M=k), 0.4), rtol=1e-13)


def test_tie_stiffness():
    got = jax.jit(tie_stiffness)(2.4, 11.3, ALPHA)
    np.testing.assert_allclose(got, 2.4 / (11.3 * math.sqrt(3)), rtol=1e-14)


def _all(values):
    ring = Ring(**{k: values[k] for k in TABLE_1})
    load = jnp.stack([values["P_y"], values["P_z"]])
    got = respond(ring, values["phi"], load)
    there = ring_influence(ring, values["at"], values["phi"])
    return jnp.concatenate(
        [got.joint, got.end_U, got.end_V, there.ravel(), jnp.stack([got.thrust, got.tie])]
    )


forward = jax.jit(jax.jacfwd(_all), compiler_options=QUICK)
reverse = jax.jit(jax.jacrev(_all), compiler_options=QUICK)
value = jax.jit(_all, compiler_options=QUICK)


@pytest.mark.slow
@pytest.mark.compiling
def test_gradients():
    """Forward = reverse = central differences in everything; k_t = 0.975 is where k_e = 1."""
    for phi, changes in ((0.0, {}), (-1.9, {"k_t": 20.0, "EI": 1e3}), (0.0, {"k_t": 0.975})):
        point = TABLE_1 | changes | {"phi": phi, "at": 0.4, "P_y": 0.7, "P_z": -0.4}
        check_gradients({k: jnp.asarray(v) for k, v in point.items()})


def check_gradients(point):
    ahead, back = forward(point), reverse(point)
    for name, v in point.items():
        step = 1e-5 * max(1.0, abs(float(v)))
        up, down = (value(point | {name: v + d}) for d in (step, -step))
        numeric = (up - down) / (2 * step)
        size = np.max(np.abs(ahead[name])) + 1e-6
        np.testing.assert_allclose(ahead[name], back[name], atol=1e-11 * size, err_msg=name)
        np.testing.assert_allclose(ahead[name], numeric, atol=2e-7 * size, err_msg=name)


@pytest.mark.slow
@pytest.mark.compiling
def test_gradients_at_the_edges_are_finite():
    for name, value in (("EI", math.inf), ("k_t", math.inf), ("phi", ALPHA)):
        point = TABLE_1 | {"phi": 0.4, "at": 0.4, "P_y": 0.7, "P_z": -0.4, name: value}
        point = {k: jnp.asarray(v) for k, v in point.items()}
        for of in (forward, reverse):
            slopes = of(point)
            assert all(np.all(np.isfinite(slope)) for slope in slopes.values())
            assert name == "phi" or np.all(slopes[name] == 0)
