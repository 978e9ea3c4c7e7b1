"""Beam in two planes on coupling rings: against an independent 60-digit FEM, then its laws."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import spatial_fem

from jaxtrachea.mechanics import beam as one_plane
from jaxtrachea.mechanics.spatial_beam import SpatialBeam, contact_compliance, deflect

# float64: measured 3e-13 (rotations beside a soft span), else 1e-14.
TOLERANCE = {"float64": 1e-12, "float32": 1e-5}
N = 15
EI = np.float32(1.862)

QUICK = {"xla_backend_optimization_level": 0}  # most of the time here is compilation
plain = jax.jit(deflect, compiler_options=QUICK)
loaded = jax.jit(lambda b, s, f, g: deflect(b, s, f, ring_load=g), compiler_options=QUICK)
# Optimised, as users have it: the two off-diagonal entries are then equal bit by bit.
compliances = jax.jit(contact_compliance, compiler_options={"xla_backend_optimization_level": 3})


def cast(dtype, *values):
    return tuple(None if v is None else jnp.asarray(np.asarray(v), dtype) for v in values)


def turned(rng, n, k, decades):
    """Ring compliances about 1/k, principal values spread by `decades`, axes in any direction."""
    angle, d = rng.uniform(0, np.pi, n), 10 ** rng.uniform(-decades, decades, (n, 2)) / k
    axes = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    C = np.einsum("pin,ni,qin->npq", axes, d, axes)
    return np.float32((C + C.mT) / 2)


def tube(rng, k, *, spread=0.0, n=N, shear=False):
    """(x, length, EI, C, GA): even (spread 0) or random spans over 2 * `spread` decades."""
    even = 10.0 * np.arange(1, n + 1)
    x = np.float32(np.sort(rng.uniform(2, 158, n)) if spread else even)

    def draw():
        return np.float32(EI * 10 ** rng.uniform(-spread, spread, (n + 1, 2)))

    C = turned(rng, n, k, 1.0 if spread else 0.5)
    return x, np.float32(160), draw(), C, draw() if shear else None


def beam_of(t, dtype="float64", integrity=None):
    return SpatialBeam(*cast(dtype, *t, integrity))


def errors_of(got, exact):
    """Largest error of each quantity over its largest value (rotations share one scale)."""

    def number(v):
        return np.array(v, dtype=object).astype(float)

    names = ("w_C", "theta_C", "w", "theta", "reaction")
    truth = {q: number(getattr(exact, q)) for q in names}
    peak = {q: np.max(np.abs(v)) for q, v in truth.items()}
    peak["theta"] = peak["theta_C"] = max(peak["theta"], peak["theta_C"])
    return {
        q: np.max(np.abs(np.asarray(getattr(got, q), float) - truth[q])) / peak[q] for q in names
    }


AGAINST_FEM = [
    (1e-9, True, "float64"),
    (0.1, False, "float32"),
    (1e12, True, "float64"),
]


@functools.cache
def cases(k, with_load):
    """Even tubes at special positions of C, random ones anywhere, each with its exact solution."""
    rng, found = np.random.default_rng(0), []
    for s in (77.0, 70.0, 3.0, 1e-3, 159.999, None):
        t = tube(rng, k, spread=0.0 if s else 2.0, shear=s in (3.0, None))
        s = np.float32(s or rng.uniform(1, 159))
        force = np.float32(rng.normal(size=2))
        load = np.float32(0.3 * rng.normal(size=(N, 2))) if with_load else None
        found.append((t, s, force, load, spatial_fem.solve(*t[:4], s, force, t[4], load)))
    return found


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize(("k", "with_load", "dtype"), AGAINST_FEM)
def test_against_fem(k, with_load, dtype):
    """Oblique force, rings with axes of their own, ring loads, shear, soft to stiff rings.

    float32: w, R and the motion of C keep 1e-5 (with ring loads 2e-5: k = 1e-9, C near an end),
    rotations beside a soft span 1e-4.
    """
    worst = {}
    for t, s, force, load, exact in cases(k, with_load):
        args = beam_of(t, dtype), *cast(dtype, s, force)
        got = plain(*args) if load is None else loaded(*args, *cast(dtype, load))
        for q, error in errors_of(got, exact).items():
            worst[q] = max(worst.get(q, 0.0), error)
    rotation = max(worst.pop("theta"), worst.pop("theta_C"))
    factor = 2 if with_load else 1
    assert max(worst.values()) < factor * TOLERANCE[dtype], worst
    assert rotation < 10 * TOLERANCE[dtype]


@pytest.mark.slow
@pytest.mark.compiling
def test_equal_rings_are_two_plane_beams():
    """Diagonal and equal ring compliances: each plane is `beam.deflect`."""
    x, length, stiffness = 10.0 * np.arange(1, N + 1), 160.0, np.linspace(1, 3, N + 1)
    shear, load = np.linspace(2, 5, N + 1), 0.1 * np.sin(np.arange(N))
    flat = one_plane.Beam(*cast("float64", x, length, stiffness, np.full(N, 1e9), shear))

    def pair(v):
        return np.stack([v, v], 1)

    both = beam_of((x, length, pair(stiffness), np.eye(2) / 1e9 * np.ones((N, 1, 1)), pair(shear)))
    single = jax.jit(
        lambda b, s, f, g: one_plane.deflect(b, s, f, ring_load=g), compiler_options=QUICK
    )
    for s, g in ((77.0, 0 * load), (70.0, 0 * load), (3.0, 0 * load), (77.0, load)):
        p = single(flat, *cast("float64", s, 1.3, g))
        q = loaded(both, *cast("float64", s, [1.3, -2.6], pair(g) * np.array([1, -2])))
        for name in p._fields:
            wanted, got = getattr(p, name), getattr(q, name)
            peak = np.max(np.abs(p.theta if name == "theta_C" else wanted))
            for plane, factor in ((0, 1.0), (1, -2.0)):
                np.testing.assert_allclose(
                    got[..., plane] / factor, wanted, atol=1e-12 * peak, rtol=0, err_msg=name
                )


def test_planes_of_their_own():
    """A diagonal C: the force in y moves nothing in z, whatever the other plane is made of."""
    rng = np.random.default_rng(2)
    x, length, stiffness, C, _ = tube(rng, 0.1, spread=1.0)
    diagonal = C * np.eye(2, dtype=np.float32)
    got = plain(beam_of((x, length, stiffness, diagonal)), *cast("float64", 63.0, [1.0, 0.0]))
    k = 1 / diagonal[:, 0, 0].astype(float)
    flat = one_plane.Beam(*cast("float64", x, length, stiffness[:, 0], k))
    alone = jax.jit(one_plane.deflect)(flat, *cast("float64", 63.0, 1.0))
    np.testing.assert_array_equal(got.w[:, 1], 0)
    np.testing.assert_allclose(got.w[:, 0], alone.w, atol=1e-13)


@pytest.mark.parametrize("k", [1e-3, 0.1, 1e3])
def test_energy_and_equilibrium(k):
    """Work of the loads is the stored energy; rings and clamps carry all of the load."""
    rng = np.random.default_rng(4)
    t, s, force = tube(rng, k, spread=1.0), np.float32(63), np.float32([0.8, -0.3])
    load = np.float32(0.1 * rng.normal(size=(N, 2)))
    got = jax.tree.map(np.asarray, loaded(beam_of(t), *cast("float64", s, force, load)))
    exact = spatial_fem.solve(*t[:4], s, force, ring_load=load)
    work = (np.sum(got.w_C * force.astype(float)) + np.sum(got.w * load.astype(float))) / 2
    np.testing.assert_allclose(work, float(exact.energy), rtol=1e-12)
    clamps = np.sum(np.array(exact.end_shear, dtype=object).astype(float), axis=0)
    np.testing.assert_allclose(np.sum(got.reaction, 0) + clamps, force, atol=1e-11)
    moved = np.einsum("npq,nq->np", t[3].astype(float), got.reaction + load)
    np.testing.assert_allclose(got.w, moved, atol=1e-12 * np.max(np.abs(got.w)))


@pytest.mark.slow
@pytest.mark.compiling
def test_compliance_of_many_points():
    """M positions at once are the single answers; symmetric, positive, 0 on the clamps."""
    t = tube(np.random.default_rng(5), 0.1)
    b = beam_of(t, "float64")
    s = jnp.asarray([0.0, 0.5, 10.0, 77.3, 80.0, 159.0, 160.0], "float64")
    at_once = np.asarray(compliances(b, s))
    assert at_once.dtype == "float64"
    np.testing.assert_array_equal(at_once, at_once.mT)
    np.testing.assert_array_equal(at_once[[0, -1]], 0)
    assert np.all(np.linalg.eigvalsh(at_once[1:-1]) > 0)
    for v, C in zip(s[1:-1], at_once[1:-1], strict=True):
        alone = np.stack([plain(b, v, e).w_C for e in jnp.eye(2, dtype="float64")], 1)
        np.testing.assert_allclose(C, alone, atol=20 * np.finfo("float64").eps * np.max(alone))
    assert compliances(b, s[2]).shape == (2, 2)


@pytest.mark.slow
@pytest.mark.compiling
def test_smooth_across_a_ring():
    """Left limit, value and right limit of C and dC/ds agree on every ring."""
    b = beam_of(tube(np.random.default_rng(6), 0.1))
    slope = jax.jit(
        jax.vmap(jax.jacfwd(contact_compliance, argnums=1), (None, 0)), compiler_options=QUICK
    )
    step = 1e-7
    c = [compliances(b, b.x + e) for e in (-step, 0.0, step)]
    dc = [slope(b, b.x + e) for e in (-step, 0.0, step)]
    scale = np.max(np.abs(slope(b, b.x + 2.0)))
    np.testing.assert_allclose(c[0], c[2], atol=5 * step * scale)
    assert np.max(np.abs(dc[2] - dc[0])) < 1e-5 * scale
    assert np.max(np.abs(dc[1] - (dc[0] + dc[2]) / 2)) < 1e-6 * scale
    np.testing.assert_allclose(slope(b, jnp.asarray([0.0] * 7 + [160.0] * (N - 7))), 0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.compiling
def test_cut_and_rigid_rings():
    """Integrity 0 is a ring that is not there; compliance 0 a ring that does not move."""
    x, length, stiffness, C, _ = tube(np.random.default_rng(7), 0.1)
    s, force = cast("float64", 63.0, [1.0, 0.4])
    cut = np.ones(N)
    cut[5] = 0
    gone = np.delete(stiffness, 5, 0)
    without = beam_of((np.delete(x, 5), length, gone, np.delete(C, 5, 0)), "float64")
    b = beam_of((x, length, stiffness, C, None), "float64", cut)
    got, exact = plain(b, s, force), plain(without, s, force)
    tolerance = 200 * np.finfo("float64").eps
    np.testing.assert_allclose(got.w_C, exact.w_C, rtol=tolerance)
    np.testing.assert_array_equal(got.reaction[5], 0)
    half = plain(beam_of((x, length, stiffness, C, None), "float64", np.full(N, 0.5)), s, force)
    same = plain(beam_of((x, length, stiffness, 2 * C), "float64"), s, force)
    np.testing.assert_allclose(half.reaction, same.reaction, atol=tolerance)
    C = C.copy()
    C[5] = 0
    held = plain(beam_of((x, length, stiffness, C), "float64"), s, force)
    np.testing.assert_array_equal(held.w[5], 0)
    assert np.all(np.isfinite(held.reaction))
    at_ring = plain(
        beam_of((x, length, stiffness, C), "float64"), jnp.asarray(60.0, "float64"), force
    )
    np.testing.assert_array_equal(at_ring.w_C, 0)
    np.testing.assert_allclose(at_ring.reaction[5], force, rtol=tolerance)


def test_linear_and_mapped():
    b = beam_of(tube(np.random.default_rng(8), 0.1))
    s, force = jnp.asarray([12.0, 20.0, 151.0]), jnp.asarray([0.4, -1.0])
    mapped = jax.jit(jax.vmap(deflect, (None, 0, None)))(b, s, force)
    alone, twice = plain(b, s[1], force), plain(b, s[1], -2 * force)
    for m, a, t in zip(mapped, alone, twice, strict=True):
        np.testing.assert_allclose(m[1], a, atol=1e-12 * np.max(np.abs(a)))
        np.testing.assert_allclose(t, -2 * a, rtol=1e-12)


def _flat(values):
    names = ("x", "length", "EI", "C", "GA", "integrity")
    b = SpatialBeam(**{k: values[k] for k in names})
    got = deflect(b, values["s"], values["force"], ring_load=values["load"])
    c = contact_compliance(b, values["s"])
    return jnp.concatenate([v.ravel() for v in (*got, c)])


forward = jax.jit(jax.jacfwd(_flat), compiler_options=QUICK)
reverse = jax.jit(jax.jacrev(_flat), compiler_options=QUICK)
value = jax.jit(_flat, compiler_options=QUICK)


@pytest.mark.slow
@pytest.mark.compiling
def test_gradients():
    """Forward = reverse = central differences along a random direction of every argument."""
    s = 25.3
    rng = np.random.default_rng(9)
    n = 5
    x, _, stiffness, C, shear = tube(rng, 0.1, n=n, shear=True)
    point = {"x": x, "length": 61.0, "EI": stiffness, "C": C, "GA": shear, "s": s}
    point |= {"integrity": np.linspace(0.2, 1, n), "force": np.array([0.4, -0.2])}
    point |= {"load": 0.1 * rng.normal(size=(n, 2))}
    point = {name: jnp.asarray(v, "float64") for name, v in point.items()}
    ahead, back = forward(point), reverse(point)
    base = np.abs(value(point))
    for name, v in point.items():
        direction = rng.normal(size=v.shape) * np.abs(v)
        if name == "C":  # stay symmetric
            direction = (direction + np.swapaxes(direction, 1, 2)) / 2

        def along(J):
            return np.tensordot(J, direction, v.ndim)  # noqa: B023

        up, down = (value(point | {name: v + e * direction}) for e in (1e-5, -1e-5))
        size = np.abs(along(ahead[name])) + base
        np.testing.assert_array_less(np.abs(along(ahead[name]) - along(back[name])), 1e-9 * size)
        numeric = (up - down) / 2e-5
        assert np.max(np.abs(along(ahead[name]) - numeric) / size) < 1e-6, name
