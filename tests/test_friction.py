"""Friction along a path: closed forms of a block on springs, and an event-driven reference."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from jitted import jitted

from jaxtrachea.mechanics.force_law import Law
from jaxtrachea.mechanics.friction import Coulomb, slide, slide_path
from jaxtrachea.status import PressStatus

pytestmark = pytest.mark.compiling

MU = 0.66  # paper, Table 1
COUPLED = np.array([[1.4, 0.3, -0.2], [0.3, 2.0, 0.15], [-0.2, 0.15, 0.6]])


QUICK = {"xla_backend_optimization_level": 0}  # most of the time here is compilation


@functools.cache
def compiled(rounding):
    def run(D, C, a, b, mu):
        return slide_path(D, C, Law(a, b), Coulomb(mu, rounding))

    return jitted(run, compiler_options=QUICK)


def path(D, C=np.zeros((3, 3)), k_1=0.5, k_3=0.0, mu=MU, dtype="float64", rounding=0.0):  # noqa: B008
    return compiled(rounding)(*(jnp.asarray(v, dtype) for v in (D, C, k_1, k_3, mu)))


def sideways(x, normal=1.0):
    return np.stack([np.full_like(x, normal), x, np.zeros_like(x)], 1)


def test_block_on_a_spring():
    """A straight pull: F_t = k D until mu N, then mu N exactly, in series with the skeleton."""
    C = np.diag([1.0, 2.0, 3.0])
    x = np.linspace(0, 3, 13)
    got = path(sideways(x), C, dtype="float64")
    N, k = 0.5 / (1 + 0.5), 1 / (2 + 2.0)
    assert got.force.dtype == got.slip.dtype == "float64"
    rtol = 20 * np.finfo("float64").eps
    np.testing.assert_allclose(got.force[:, 0], N, rtol=rtol)
    np.testing.assert_allclose(got.force[:, 1], np.minimum(k * x, MU * N), rtol=rtol)
    np.testing.assert_allclose(got.slip[:, 0], np.maximum(x - MU * N / k, 0), atol=4 * rtol)
    np.testing.assert_array_equal(got.sliding, k * x > MU * N)
    np.testing.assert_array_equal(got.status, PressStatus.OK)


@pytest.mark.parametrize("steps", [9, 90])
def test_hysteresis_loop(steps):
    """Back and forth: the loop's area is what friction takes, 4 mu N (a - mu N / k) per cycle."""
    a, C = 3.0, np.diag([1.0, 2.0, 3.0])
    turn = np.concatenate([np.linspace(a, -a, steps)[1:], np.linspace(-a, a, steps)[1:]])
    x = np.concatenate([np.linspace(0, a, steps), turn, turn])
    got = path(sideways(x), C)
    F, cycle = np.asarray(got.force[:, 1]), 2 * (steps - 1)
    N, k = 0.5 / 1.5, 0.25
    area = 4 * MU * N * (a - MU * N / k)
    np.testing.assert_allclose(np.sum(got.dissipated[-cycle:]), area, rtol=1e-12)
    work = np.sum((F[1:] + F[:-1]) / 2 * np.diff(x))
    assert abs(np.sum(np.diff(x[-cycle - 1 :]) * (F[-cycle:] + F[-cycle - 1 : -1]) / 2) - area) < (
        2.5 * area / steps
    )
    assert work > 0
    assert np.all(np.abs(F) <= MU * N * (1 + 1e-12))


def _root(f, start, *args):
    found = scipy.optimize.root(f, start, args, tol=1e-12)
    assert np.max(np.abs(f(found.x, *args))) < 1e-11
    return found.x


def reference(D, C, k_1, k_3, mu):
    """Stick or slide step by step with SciPy: unknowns F, and the slip where it slides."""
    slip, forces, slips = np.zeros(2), [], []

    def depth_of(F):
        return F / (k_1 + k_3 * local(np.linalg.norm(F)) ** 2)

    def local(size):
        return max(
            r.real for r in np.roots([k_3, 0, k_1, -size]) if abs(r.imag) < 1e-9 * (1 + size)
        )

    F = np.array([1e-3, 0, 0])
    for target in D:

        def gap(F, slip):
            return depth_of(F) + C @ F + [0, *slip] - target  # noqa: B023

        F = _root(gap, F, slip)
        if np.linalg.norm(F[1:]) > mu * F[0]:
            old = slip

            def slides(v):
                force = v[0] * np.array([1, mu * np.cos(v[1]), mu * np.sin(v[1])])
                return gap(force, old + v[2] * force[1:])  # noqa: B023

            start = [F[0], np.arctan2(F[2], F[1]), 0.1]
            N, angle, rate = _root(slides, start)
            F = N * np.array([1, mu * np.cos(angle), mu * np.sin(angle)])
            assert rate > 0
            assert N > 0
            slip = old + rate * F[1:]
        forces.append(F)
        slips.append(slip)
    return np.array(forces), np.array(slips)


@pytest.mark.parametrize("mu", [0.2, MU])
def test_against_events(mu):
    """A curved path with changing pressure on a coupled skeleton with a hardening law."""
    k_3 = 1.0
    t = np.linspace(0, 2 * np.pi, 40)
    D = np.stack([1.5 + 0.5 * np.sin(2 * t), 2 * np.sin(t), 1.5 - 1.5 * np.cos(t)], 1)
    got = path(D, COUPLED, 0.7, k_3, mu)
    force, slip = reference(D, COUPLED, 0.7, k_3, mu)
    np.testing.assert_allclose(got.force, force, atol=1e-9)
    np.testing.assert_allclose(got.slip, slip, atol=1e-9)
    assert 5 < np.sum(got.sliding) < 40
    assert np.min(got.dissipated) >= 0


@pytest.mark.slow
def test_any_coupling():
    """3000 random steps: on the cone, in equilibrium, and friction never gives energy."""
    rng, n = np.random.default_rng(1), 3000
    axes = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    C = np.einsum("nij,nj,nkj->nik", axes, 10 ** rng.uniform(-2, 1, (n, 3)), axes)
    D = rng.normal(size=(n, 3))
    D[:, 0] = np.abs(D[:, 0])
    k_1, k_3, mu = 10 ** rng.uniform(-1, 1, n), 10 ** rng.uniform(-3, 2, n), rng.uniform(0, 0.9, n)

    def one(D, C, a, b, m):
        return slide(D, C, Law(a, b), Coulomb(m), jnp.zeros(2))

    step = jax.jit(jax.vmap(one))
    got = step(D, (C + C.mT) / 2, k_1, k_3, mu)
    F, d = np.asarray(got.force), np.asarray(got.depth)
    tangential = np.linalg.norm(F[:, 1:], axis=1)
    assert np.all(got.status == PressStatus.OK)
    assert np.all(F[:, 0] > 0)
    assert np.all(tangential <= mu * F[:, 0] * (1 + 1e-11) + 1e-12)
    slid = np.asarray(got.sliding)
    assert 2000 < np.sum(slid) < 3000
    np.testing.assert_allclose(tangential[slid], (mu * F[:, 0])[slid], rtol=1e-10)
    moved = d + np.einsum("nij,nj->ni", C, F)
    moved[:, 1:] += got.slip
    np.testing.assert_allclose(moved, D, atol=1e-12)
    np.testing.assert_allclose((k_1 + k_3 * np.sum(d * d, 1))[:, None] * d, F, rtol=1e-9)
    assert np.min(got.dissipated) >= 0


def test_no_friction_and_much():
    """Mu = 0: the normal press alone. Mu large: the tool sticks for good."""
    D = sideways(np.linspace(0, 2, 5))
    free = path(D, COUPLED, mu=0.0)
    np.testing.assert_array_equal(free.force[:, 1:], 0)
    np.testing.assert_allclose(free.force[:, 0], 1 / (1.4 + 2.0), rtol=1e-14)
    stuck = path(D, COUPLED, mu=50.0)
    assert not np.any(stuck.sliding)
    np.testing.assert_array_equal(stuck.slip, 0)


def test_lifting_off():
    """Out of contact no force, and the tool touches down anew where it then is."""
    D = np.array([[1, 0.1, 0], [1, 3, 0], [-0.5, 3, 1], [0, 5, 1], [1, 5, 1], [1, 5.1, 1]])
    got = path(D)
    np.testing.assert_array_equal(got.force[2:4], 0)
    no, ok = PressStatus.NO_CONTACT, PressStatus.OK
    np.testing.assert_array_equal(got.status, [ok, ok, no, no, ok, ok])
    np.testing.assert_allclose(got.slip[3], [5, 1])
    np.testing.assert_allclose(got.force[4], [0.5, 0, 0], atol=1e-15)
    np.testing.assert_allclose(got.force[5], [0.5, 0.05, 0], atol=1e-15)


def from_the_air(rows):
    """Down on the surface in `rows` steps, along it, off it and down again; the kinks are steps.

    Touches at (0, 0.6, -0.3), where 0.6 of the first way is behind, and at (0, 3.4, 0.8).
    """
    corners = np.array([[-1.2, 0, 0], [0.8, 1.0, -0.5], [0.8, 3, 0.4], [-0.8, 3, 1.2]])
    corners = np.array([*corners, [0.8, 3.8, 0.4]])
    return np.concatenate(
        [np.linspace(a, b, rows + 1)[1:] for a, b in zip(corners, corners[1:], strict=False)]
    )


TOUCHES = np.array([[0, 0.6, -0.3], [0, 3.4, 0.8]])


@pytest.mark.parametrize("rows", [1, 4])
def test_a_step_from_the_air_counts_from_where_it_touches(rows):
    """Against SciPy, told the points of both touches; one step down is as good as many."""
    D = np.concatenate([[[-1.2, 0, 0]], from_the_air(rows)])
    got = path(D, COUPLED, 0.7, 0.3, MU)
    down = np.flatnonzero((D[1:, 0] > 0) & (D[:-1, 0] <= 0)) + 1
    up = np.flatnonzero((D[1:, 0] <= 0) & (D[:-1, 0] > 0)) + 1, len(D)
    for begin, end, point in zip(down, (up[0][0], up[1]), TOUCHES, strict=True):
        force, slip = reference(D[begin:end] - point, COUPLED, 0.7, 0.3, MU)
        np.testing.assert_allclose(got.force[begin:end], force, atol=1e-9)
        np.testing.assert_allclose(got.slip[begin:end], slip + point[1:], atol=1e-9)
    assert np.any(got.sliding)
    np.testing.assert_array_equal(np.asarray(got.force)[D[:, 0] <= 0], 0)
    work = np.sum(got.dissipated)
    assert 0 < work
    np.testing.assert_allclose(got.slip[0], 0, atol=0)


def test_what_sticks_is_stretched_from_where_it_touched():
    """Mu = 1e3, an uncoupled skeleton: F = k (D - D_touch) in closed form, after two touches."""
    C = np.diag([1.0, 2.0, 3.0])
    D = np.concatenate([[[-1.2, 0, 0]], from_the_air(1)])
    got = path(D, C, mu=1e3, dtype="float64")
    k = 1 / (np.diag(C) + 2)
    tolerance = 50 * np.finfo("float64").eps
    for rows, point in zip((np.array([1, 2]), np.array([4])), TOUCHES, strict=True):
        np.testing.assert_allclose(got.force[rows], k * (D[rows] - point), atol=tolerance)
        np.testing.assert_allclose(got.slip[rows], [point[1:]] * len(rows), atol=tolerance)
    np.testing.assert_allclose(got.dissipated, 0, atol=tolerance)


@pytest.mark.slow
def test_gradients_through_touches():
    """Forward = reverse = central differences; of a path that never touches all are 0."""
    D = np.concatenate([[[-1.2, 0.1, 0]], from_the_air(1)])

    def f(D, k_1, mu, height):
        start = jnp.zeros(2, D.dtype)
        law = Law(k_1, jnp.full_like(k_1, 0.3))
        got = slide_path(D, jnp.asarray(COUPLED, D.dtype), law, Coulomb(mu), start, height)
        return jnp.concatenate([got.force.ravel(), got.slip.ravel(), got.dissipated])

    rng = np.random.default_rng(3)
    quick = functools.partial(jax.jit, compiler_options=QUICK)
    both = quick(lambda *v: (jax.jacfwd(f, (0, 1, 2, 3))(*v), jax.jacrev(f, (0, 1, 2, 3))(*v)))
    value = quick(f)
    for point in ((D, 0.7, MU, 0.2), (D[1:], 0.7, MU, 0.9)):
        forward, reverse = both(*(jnp.asarray(v, "float64") for v in point))
        for i, v in enumerate(point):
            way = rng.normal(size=np.shape(v))
            size = np.max(np.abs(forward[i]))
            tolerance = 2e4 * np.finfo("float64").eps * size
            np.testing.assert_allclose(forward[i], reverse[i], atol=tolerance)
            ends = (
                [jnp.asarray(p + e * way if i == j else p, float) for j, p in enumerate(point)]
                for e in (1e-6, -1e-6)
            )
            up, down = (value(*p) for p in ends)
            along = np.tensordot(forward[i], way, np.ndim(v))
            atol = max(tolerance, 1e-6 * max(size, 1))
            np.testing.assert_allclose(along, (up - down) / 2e-6, atol=atol)
    away = np.concatenate([-np.ones((len(D), 1)), D[:, 1:]], 1)
    slopes = both(*(jnp.asarray(v, "float64") for v in (away, 0.7, MU, 0.2)))[1]
    assert all(np.all(np.isfinite(slope)) for slope in slopes)
    for slope in slopes[1:]:
        np.testing.assert_array_equal(slope, 0)


def test_bad_step_is_flagged_and_left_behind():
    """NaN and a folded step: flagged, and the steps after them start from the slip before."""
    D = sideways(np.array([0.2, 2.0, 2.1, 2.2]))
    good = path(D, COUPLED, 0.5, -0.01)
    for at, value, status in ((0, np.nan, "NON_FINITE"), (0, 50.0, "PAST_FOLD")):
        broken = D.copy()
        broken[2, at] = value
        got = path(broken, COUPLED, 0.5, -0.01)
        assert got.status[2] == PressStatus[status]
        assert np.all(np.isnan(got.force[2]))
        np.testing.assert_array_equal(got.slip[2], good.slip[1])
        np.testing.assert_allclose(got.force[3], good.force[3], atol=1e-4)


@pytest.mark.slow
def test_rounding():
    """Within w of Coulomb's limit, exact outside (1 +- w) of it, and without a kink."""
    w = 0.1
    x = np.linspace(0, 2, 401)
    step = jax.jit(
        lambda x: slide(
            jnp.stack([jnp.ones_like(x), x, jnp.zeros_like(x)]),
            jnp.diag(jnp.asarray([1.0, 2.0, 3.0])),
            Law(jnp.asarray(0.5), jnp.asarray(0.0)),
            Coulomb(jnp.asarray(MU), rounding=w),
            jnp.zeros(2),
        ).force[1]
    )
    both = jax.jit(jax.vmap(jax.value_and_grad(step)), compiler_options=QUICK)
    F, slope = both(jnp.asarray(x))
    limit, k = MU / 3, 0.25
    sharp = np.minimum(k * x, limit)
    inside = np.abs(k * x / limit - 1) < w
    np.testing.assert_allclose(F[~inside], sharp[~inside], rtol=1e-12)
    assert np.all((F <= sharp + 1e-15) & (F > sharp - w * limit / 3.9))
    jump = np.max(np.abs(np.diff(slope)))
    assert jump < 1.1 * k / (2 * w) * (x[1] - x[0]) * k / limit
    np.testing.assert_allclose(np.cumsum(slope)[-1] * (x[1] - x[0]), F[-1], rtol=5e-3)
    creeping = path(sideways(np.linspace(0, 3, 300)), np.diag([1.0, 2, 3]), rounding=w)
    assert (1 - w) * limit < creeping.force[-1, 1] <= limit


@pytest.mark.slow
def test_gradient_at_rest_is_finite():
    """No tangential motion, no pressure: nothing divides by the length of zero."""
    rounding = 0.0
    C, local, mu = jnp.asarray(COUPLED), Law(jnp.asarray(0.5), jnp.asarray(0.1)), jnp.asarray(MU)
    D = jnp.asarray([[0.0, 0, 0], [1.0, 0, 0], [-1.0, 2, 0], [0.0, 1, 0]])

    def f(D, mu):
        return slide(D, C, local, Coulomb(mu, rounding), jnp.zeros(2)).force

    slopes = jax.jit(jax.vmap(jax.jacrev(f, (0, 1)), (0, None)), compiler_options=QUICK)(D, mu)
    assert all(np.all(np.isfinite(slope)) for slope in slopes)


def softening(n, quintic, dtype):
    """Random steps on random skeletons, with laws of which at least one part softens."""
    rng = np.random.default_rng(7)
    axes = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    C = np.einsum("nij,nj,nkj->nik", axes, 10 ** rng.uniform(-2, 1, (n, 3)), axes)
    D = rng.normal(size=(n, 3))
    D[:, 0] = np.abs(D[:, 0])
    k_1, mu = 10 ** rng.uniform(-1, 1, n), rng.uniform(0, 0.9, n)
    soft, hard = -k_1 * 10 ** rng.uniform(-3, 0.5, n), k_1 * 10 ** rng.uniform(-3, 1, n)
    if not quintic:
        return [v.astype(dtype) for v in (D, (C + C.mT) / 2, k_1, soft, 0 * soft, mu)]
    which = rng.integers(3, size=n)
    k_3, k_5 = np.where(which == 0, hard, soft), np.where(which == 1, hard, soft)
    return [v.astype(dtype) for v in (D, (C + C.mT) / 2, k_1, k_3, k_5, mu)]


def summed(quintic):
    """Force, slip and friction's work of a step, and the step; NaN counts as nothing."""

    def one(D, C, a, b, e, mu):
        law = Law(a, b, e if quintic else None)
        got = slide(D, C, law, Coulomb(mu), jnp.zeros(2, D.dtype))
        known = jnp.where(got.status == PressStatus.OK, got.force, 0)
        return jnp.sum(known) + jnp.sum(got.slip) + got.dissipated, got

    return one


@pytest.mark.slow
def test_softening_steps_are_right_or_refused():
    """Each solved step fulfils the equations, in double precision; its gradient is finite."""
    quintic = True
    given = softening(3000, quintic, "float64")
    step = jax.value_and_grad(summed(quintic), (0, 1, 2, 3, 5), has_aux=True)
    (_, got), slopes = jax.jit(jax.vmap(step), compiler_options=QUICK)(*given)
    assert all(np.all(np.isfinite(slope)) for slope in slopes)
    ok, slid = np.asarray(got.status) == PressStatus.OK, np.asarray(got.sliding)
    assert got.force.dtype == "float64"
    assert set(np.unique(got.status)) == {0, PressStatus.PAST_FOLD, PressStatus.PULLS}
    assert 2400 < np.sum(ok & slid) < 2800
    for field in (got.force, got.depth):
        assert np.all(np.isnan(np.asarray(field)[~ok]))
    np.testing.assert_array_equal(np.asarray(got.slip)[~ok], 0)
    D, C, k_1, k_3, k_5, mu = (v[ok].astype(float) for v in given)
    F, d, slip = (np.asarray(v)[ok].astype(float) for v in (got.force, got.depth, got.slip))
    size, q = np.linalg.norm(F, axis=1), np.sum(d * d, 1)
    tolerance = (
        10 * np.finfo("float64").eps ** 0.5
    )  # what the search may leave, times its condition
    assert np.all(F[:, 0] > 0)
    by_law = (k_1 + k_3 * q + k_5 * q * q)[:, None] * d - F
    assert np.all(np.linalg.norm(by_law, axis=1) <= tolerance * k_1 * np.sqrt(q))
    above = np.linalg.norm(F[:, 1:], axis=1) - mu * F[:, 0]
    assert np.all(np.where(slid[ok], np.abs(above), above) <= tolerance * size)
    moved = d + np.einsum("nij,nj->ni", C, F)
    moved[:, 1:] += slip
    np.testing.assert_allclose(moved, D, atol=tolerance)
    assert np.all(np.sum(slip * F[:, 1:], 1) >= -tolerance * size)


@pytest.mark.parametrize("mu", [0.0, MU])
def test_past_the_zero_of_a_softening_law_it_pulls(mu):
    """On a stiff skeleton F = D (1 - 0.1 D^2) is 0 at sqrt(10) and would pull beyond it."""
    got = path(sideways(np.zeros(3), np.array([1.0, 3.1, 3.2])), k_1=1.0, k_3=-0.1, mu=mu)
    ok, pulls = PressStatus.OK, PressStatus.PULLS
    np.testing.assert_array_equal(got.status, [ok, ok, pulls])
    np.testing.assert_allclose(got.force[:2, 0], [0.9, 3.1 * (1 - 0.1 * 3.1**2)], rtol=1e-12)
    assert np.all(np.isnan(got.force[2]) & np.isnan(got.depth[2]))
    np.testing.assert_array_equal(got.slip, 0)


@pytest.mark.slow
def test_a_failed_step_leaves_the_derivatives_of_the_others():
    """The same path without the step that folds: same slips after it, same gradients."""
    D = sideways(np.array([0.2, 2.0, 2.1, 2.2]))
    D[2, 0] = 50.0

    def after(k_3, D):
        return jnp.sum(slide_path(D, jnp.asarray(COUPLED), Law(jnp.asarray(0.5), k_3),
                                  Coulomb(jnp.asarray(MU))).force[-1])  # fmt: skip

    slope = jax.jit(jax.grad(after), compiler_options=QUICK)
    k_3 = jnp.asarray(-0.01)
    np.testing.assert_allclose(slope(k_3, D), slope(k_3, D[[0, 1, 3]]), rtol=1e-12)
