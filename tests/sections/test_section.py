"""One ring: brute force on 20,000 points, AD twice, and the modes linearised by hand."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from sections_linear import ring_stiffness, shapes

from jaxtrachea.mechanics.sections.section import (
    Ring,
    Shape,
    deform,
    energy,
    line_motion,
    make_grid,
)
from jaxtrachea.mechanics.sections.section_tangent import (
    line_forces,
    line_tangent,
    surface_tangent,
)
from jaxtrachea.mechanics.sections.span import linear_shapes

pytestmark = pytest.mark.compiling
R, OFFSET, ALPHA = 11.7, 0.9, 2.0
VALUES = {"EI_C": 24.0, "EI_M": 2.0, "Et_M": 0.68, "k_n": 0.0186, "k_t": 0.0018, "c_K": 22.0}
PITCH = 10.0


@functools.cache
def parts(midline, dtype="float64"):
    def cast(v):
        return jnp.asarray(v, dtype)

    shape = Shape(cast(R), cast(OFFSET), cast(ALPHA))
    ring = Ring(pitch=cast(PITCH), **{k: cast(v) for k, v in VALUES.items()})
    return ring, make_grid(shape, midline=midline), shape


def sample(midline, size=2.0, count=3):
    q = np.random.default_rng(1).normal(size=(count, 8)) * size
    return q[:, :4] if midline else q


def surface_motion(q, phi, grid, shape):
    return line_motion(deform(q, grid, shape), phi, grid, shape)


def brute_force(q, phi_c):
    """Energy and outer motion at phi_c from the equations of MODEL, by the trapezoidal rule."""
    a, e, b = q[:3], q[3], q[4:]
    n = 20000
    front = np.linspace(-ALPHA, ALPHA, 2 * n + 1)
    back = np.linspace(ALPHA, 2 * np.pi - ALPHA, n + 1)

    def turn(phi, lam, slope=False):
        f = [(np.sin, np.cos), (np.cos, lambda x: -np.sin(x))]
        s, c = (g[slope] for g in f)
        k = (lambda m: m) if slope else (lambda m: 1)
        total = (0 if slope else b[0]) + sum(
            (m - 1 / m) * k(m) * (a[m - 1] * s(m * phi) - b[m] * c(m * phi)) for m in (2, 3)
        )
        return total / R + lam[0] * s(phi) + lam[1] * c(phi)

    def slope(phi, strain, lam):
        x = phi + turn(phi, lam)
        return R * np.array([np.sin(phi) - strain * np.sin(x), strain * np.cos(x) - np.cos(phi)])

    pieces = [(front, 1.0), (back, 1 + e / R)]

    def gap(lam):
        return sum(np.trapezoid(slope(phi, strain, lam), phi) for phi, strain in pieces)

    lam = scipy.optimize.root(gap, np.zeros(2), tol=1e-13).x
    # Along the front from phi = -alpha, then along the back.
    motion, start = [], np.zeros(2)
    for phi, strain in pieces:
        v = slope(phi, strain, lam)
        step = np.diff(phi) * (v[:, 1:] + v[:, :-1]) / 2
        u = start[:, None] + np.concatenate([np.zeros((2, 1)), np.cumsum(step, 1)], 1)
        motion.append(u)
        start = u[:, -1]
    mean = sum(np.trapezoid(u, phi) for u, (phi, _) in zip(motion, pieces, strict=True))
    rest = np.array([a[0], b[1]]) - mean / (2 * np.pi)
    total, outer = 0.0, []
    for u, (phi, _), EI in zip(motion, pieces, (VALUES["EI_C"], VALUES["EI_M"]), strict=True):
        x = phi + turn(phi, lam)
        n_turned = np.array([np.cos(x) - np.cos(phi), np.sin(x) - np.sin(phi)])
        outer.append(u + rest[:, None] + OFFSET * n_turned)
        kappa = turn(phi, lam, slope=True) / R
        density = EI * kappa**2 / (1 + np.sqrt(1 + VALUES["c_K"] * kappa**2)) * R
        total += np.trapezoid(density, phi)
    y, z = outer[1]
    normal, around = y * np.cos(back) + z * np.sin(back), z * np.cos(back) - y * np.sin(back)
    bed = VALUES["k_n"] * normal**2 + VALUES["k_t"] * around**2
    total += PITCH * (R + OFFSET) * np.trapezoid(bed, back) / 2
    total += VALUES["Et_M"] * (np.pi - ALPHA) * PITCH * e**2 / R
    y, z = (np.interp(phi_c, front, v) for v in outer[0])
    c, s = np.cos(phi_c), np.sin(phi_c)
    return total, np.array([-y * c - z * s, z * c - y * s])


def test_against_brute_force():
    """Motions of 2 mm in every mode at once, far more than in a press: 1e-6 of the energy."""
    parts_ = parts(False)
    both = jax.jit(lambda q: (energy(q, *parts_), surface_motion(q, jnp.asarray(0.7), *parts_[1:])))
    for q in sample(False):
        U, moved = both(jnp.asarray(q))
        true_U, true_moved = brute_force(np.pad(q, (0, 8 - len(q))), 0.7)
        assert float(U) == pytest.approx(true_U, rel=3e-6)
        np.testing.assert_allclose(moved, true_moved, atol=1e-6)


@pytest.mark.slow
def test_forces_and_stiffness_are_the_derivatives_of_the_energy():
    parts_ = parts(False)

    def U(q):
        return energy(q, *parts_)

    q = jnp.asarray(sample(False))
    force, stiff = jax.jit(jax.vmap(lambda q: line_tangent(deform(q, *parts_[1:]), *parts_)))(q)
    alone = jax.jit(jax.vmap(lambda q: line_forces(deform(q, *parts_[1:]), *parts_)))(q)
    by_ad = jax.jit(jax.vmap(lambda q: (jax.grad(U)(q), jax.hessian(U)(q))))(q)
    np.testing.assert_allclose(force, by_ad[0], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(alone, force, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(stiff, by_ad[1], rtol=1e-11, atol=1e-11)


@pytest.mark.slow
def test_the_surface_has_its_derivatives():
    """Slope and second derivative along a force, by AD of the motion; motions of 2 mm."""
    _, grid, shape = parts(False)
    force = jnp.asarray([1.3, -0.7])
    phi = jnp.asarray(0.9)
    n = force.size

    def motion(q):
        return surface_motion(q, phi, grid, shape)[:n]

    def closed_form(q):
        return surface_tangent(deform(q, grid, shape), phi, force, grid, shape)

    q = jnp.asarray(sample(False))
    got = jax.jit(jax.vmap(closed_form))(q)
    along = jax.hessian(lambda q: force @ motion(q))
    by_ad = jax.jit(jax.vmap(lambda q: (motion(q), jax.jacfwd(motion)(q), along(q))))(q)
    for v, wanted in zip(got, by_ad, strict=True):
        np.testing.assert_allclose(v, wanted, rtol=1e-11, atol=1e-12)


def test_small_motions():
    """Stiffness and shapes at rest are those of the modes linearised by hand."""
    ring, grid, shape = parts(False)
    n = grid.modes
    p = VALUES | {"R": R, "alpha": ALPHA, "offset": OFFSET}
    _, stiff = jax.jit(lambda q: line_tangent(deform(q, grid, shape), ring, grid, shape))(
        jnp.zeros(n)
    )
    np.testing.assert_allclose(stiff, ring_stiffness(p, PITCH)[:n, :n], rtol=1e-9, atol=1e-8)
    phi = np.array([-1.9, -0.4, 0.0, 1.1])
    r, t, turn, _ = shapes(phi, R, ALPHA)
    slope = jax.jit(jax.vmap(jax.jacfwd(surface_motion), (None, 0, None, None)))
    got = slope(jnp.zeros(n), jnp.asarray(phi), grid, shape)
    wanted = np.stack([-r, t + OFFSET * turn], 1)[:n].transpose(2, 1, 0)
    np.testing.assert_allclose(got, wanted, atol=1e-12)
    everywhere = np.linspace(-3.1, 3.1, 25)
    for of_code, of_hand in zip(
        linear_shapes(jnp.asarray(everywhere), shape, False), shapes(everywhere, R, ALPHA)[:2],
        strict=True,
    ):  # fmt: skip
        np.testing.assert_allclose(of_code.reshape(-1, 25), of_hand[:n], atol=1e-12)


def test_the_ring_closes_or_is_nan():
    """Shapes far beyond any press: some close after 16 steps, of the others there is no number."""
    _, grid, shape = parts(False)
    q = jnp.asarray(sample(False, 25.0, 200))
    line = jax.jit(jax.vmap(lambda q: deform(q, grid, shape)))(q)
    closed = np.isfinite(line.w[:, -1])
    assert 0 < np.sum(~closed) < 150
    for v in (line.slope_y, line.slope_z):
        gap = np.asarray(v) @ np.asarray(grid.weights)
        np.testing.assert_allclose(gap[closed], 0, atol=1e-9)
        assert np.all(np.isnan(gap[~closed]))
    small = jax.jit(lambda q: deform(q, grid, shape).w)(jnp.asarray(sample(False, 3.0, 1)[0]))
    assert np.all(np.isfinite(small))
