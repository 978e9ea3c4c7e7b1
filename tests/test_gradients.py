"""Every public derivative: forward = reverse = central differences, also at the nasty points."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from jaxtrachea.mechanics.beam import Beam, contact_compliance, deflect
from jaxtrachea.mechanics.equilibrium import press_series, press_total
from jaxtrachea.mechanics.force_law import Law
from jaxtrachea.mechanics.press import Options, press
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import Material

N = 5
RINGS = np.array([10.0, 20.0, 30.0, 42.0, 50.0])
STEP = 1e-3  # relative; the five-point rule is then exact to 1e-11


def tree(values):
    return jax.tree.map(lambda v: jnp.asarray(v, jnp.float64), values)


@functools.cache
def _compiled(f, key):
    unravel = key.unravel

    def flat(v):
        return ravel_pytree(f(unravel(v)))[0]

    # One scan over evaluations, one over columns: compiled once for all points.
    def differences(points):
        return jax.lax.map(flat, points)

    quick = {"xla_backend_optimization_level": 0}  # most of the time here is compilation
    programs = (jax.jacfwd(flat), jax.jacrev(flat), differences)
    return tuple(jax.jit(p, compiler_options=quick) for p in programs)


class _Key:
    """Hashable stand-in for the structure of the arguments (one compile per structure)."""

    def __init__(self, structure, unravel):
        self.structure, self.unravel = structure, unravel

    def __hash__(self):
        return hash(self.structure)

    def __eq__(self, other):
        return self.structure == other.structure


def check(f, arguments, *, rtol=1e-7, floor=1e-12):
    """Scaled Jacobians: d out / d log in, or per unit where the input is 0."""
    x, unravel = ravel_pytree(tree(arguments))
    forward_of, reverse_of, differences = _compiled(f, _Key(jax.tree.structure(arguments), unravel))
    scale = np.where(x == 0, 1.0, np.abs(x))
    forward, reverse = (np.asarray(of(x)) * scale for of in (forward_of, reverse_of))
    steps = STEP * np.diag(scale)
    values = differences(np.concatenate([np.asarray(x) + m * steps for m in (-2, -1, 1, 2)]))
    y = np.asarray(values).reshape(4, x.size, -1)
    numeric = (y[0] - 8 * y[1] + 8 * y[2] - y[3]).T / (12 * STEP)
    size = np.max(np.abs(forward), axis=1, keepdims=True)
    # Where every derivative of an output is zero, its rounding noise is all there is.
    size = np.maximum(size, floor / rtol * np.max(np.abs(y), axis=(0, 1))[:, None] + 1e-300)
    assert np.all(np.isfinite(forward))
    assert np.all(np.abs(forward - reverse) <= 1e-9 * size)
    assert np.all(np.abs(forward - numeric) <= rtol * size)


def beam_values(s, k=0.1, EI=1.862, **more):
    EI = np.full(N + 1, EI) * (1 + 0.1 * np.arange(N + 1))
    values = {"x": RINGS, "length": 61.0, "EI": EI, "k": np.full(N, k), "s": s}
    return values | more


def _beam(v):
    return Beam(v["x"], v["length"], v["EI"], v["k"], v.get("GA"))


@functools.cache
def deflection(split, form, loaded=False):
    def f(v):
        load = v["load"] if loaded else None
        return deflect(_beam(v), v["s"], v["force"], split=split, form=form, ring_load=load)

    return f


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize(
    ("form", "split", "shear"),
    [("recursion", "independent", True), ("reactions", "continuous", True)],
)
def test_deflect(form, split, shear):
    more = {"force": 0.4} | ({"GA": np.linspace(1, 2, N + 1)} if shear else {})
    check(deflection(split, form), beam_values(25.3, **more), rtol=1e-6)


@pytest.mark.slow
@pytest.mark.compiling
def test_deflect_with_ring_loads():
    load = np.array([0.1, -0.2, 0.0, 0.3, 0.05])
    values = beam_values(25.3, force=0.4, load=load)
    check(deflection("continuous", "recursion", loaded=True), values, rtol=1e-6)


slopes = jax.jit(jax.jacfwd(lambda b, s: deflect(b, s, jnp.asarray(1.0)), argnums=1))


@pytest.mark.parametrize("ring", range(N))
def test_contact_on_a_ring(ring):
    """d/ds of everything that is continuous there: neither half nor double the two-sided limit.

    The derivative of a rotation or a reaction may jump (it does for the ring under C); the mean of
    left and right is not required of it, one of the two is.
    """
    b = _beam(tree(beam_values(0.0)))
    left, at, right = (slopes(b, b.x[ring] + e) for e in (-1e-8, 0.0, 1e-8))
    for name in ("w_C", "theta_C", "w", "theta", "reaction"):
        p, q, r = (np.atleast_1d(getattr(v, name)) for v in (left, at, right))
        peak = 1e-6 * max(np.max(np.abs(p)), np.max(np.abs(r)))
        assert np.all((np.abs(q - p) < peak) | (np.abs(q - r) < peak)), name


@pytest.mark.parametrize("k", [1e-9, 0.1, 1e12])
@pytest.mark.parametrize("cut", [False, True])
def test_finite_at_nasty_positions(cut, k):
    """C on rings, at both clamps and beside them; with a span of EI = 1e-9: no NaN, no inf."""
    values = beam_values(0.0, k)
    if cut:
        values["EI"][2] = 1e-9
    v = jax.tree.map(lambda a: jnp.asarray(a, "float64"), values)
    s = jnp.asarray([0.0, 1e-3, 10.0, 25.0, 50.0, 60.999, 61.0], "float64")
    grads, c = _gradients(v, s)
    assert np.all(np.isfinite(c))
    for leaf in jax.tree.leaves(grads):
        assert leaf.dtype == "float64"
        assert np.all(np.isfinite(leaf))
    assert np.all(np.asarray(c)[[0, -1]] == 0)


@jax.jit
def _gradients(v, positions):
    def total(v, s):
        got = deflect(_beam(v), s, jnp.ones_like(s))
        return got.w_C + jnp.sum(got.w) + jnp.sum(got.theta) + jnp.sum(got.reaction), got.w_C

    return jax.vmap(jax.grad(total, has_aux=True), (None, 0))(v, positions)


@pytest.mark.parametrize("s", [0.0, 61.0])
def test_slope_at_the_clamps(s):
    """C ~ s^3 there: value and slope are exactly 0."""
    v = tree(beam_values(s))
    assert jax.jit(jax.grad(lambda s: contact_compliance(_beam(v), s)))(v["s"]) == 0


def series(v):
    return press_series(v["D"], v["c"], Law(v["k_1"], v["k_3"]))[:2]


def total(v):
    return press_total(v["D"], v["c"], Law(v["k_1"], v["k_3"]))[:2]


@pytest.mark.parametrize("f", [series, total])
@pytest.mark.parametrize("k_3", [0.0, 1e-30, 0.02, 1e6, 1e30, -1e-6, -0.01])
def test_press_law(f, k_3):
    check(f, {"D": np.array([0.5, -1.5, 3.0]), "c": 0.9, "k_1": 0.4, "k_3": k_3}, rtol=1e-6)


@pytest.mark.parametrize("k_3", [0.0, 1e-30, 1e30, -0.01])
def test_press_law_at_zero(k_3):
    """D = 0: d depth / dD = 1 / (1 + c k_1) whatever k_3, and no other input matters."""
    values = {"D": 0.0, "c": 0.9, "k_1": 0.4, "k_3": k_3}
    v = {n: jnp.asarray(a, "float64") for n, a in values.items()}
    gradient = jax.tree.map(np.asarray, _depth_gradient(v))
    np.testing.assert_allclose(gradient.pop("D"), 1 / 1.36, rtol=4 * np.finfo("float64").eps)
    assert all(g == 0 for g in gradient.values())


_depth_gradient = jax.jit(jax.grad(lambda v: series(v)[0]))
_series_slopes = [jax.jit(mode(lambda v: series(v)[0])) for mode in (jax.jacfwd, jax.jacrev)]


@pytest.mark.parametrize("near", [0.9, 0.99])
def test_near_the_fold(near):
    """Finite differences would step over the fold: closed-form derivatives instead."""
    c, k_1, k_3 = 0.9, 0.4, -0.02
    p, q = 1 + c * k_1, c * k_3
    d = near * np.sqrt(p / (-3 * q))
    D = p * d + q * d**3
    v = tree({"D": D, "c": c, "k_1": k_1, "k_3": k_3})
    for jacobian in _series_slopes:
        got = jacobian(v)
        slope = p + 3 * q * d * d
        expected = {"D": 1 / slope, "k_1": -c * d / slope, "k_3": -c * d**3 / slope}
        expected["c"] = -(k_1 * d + k_3 * d**3) / slope
        for name, value in expected.items():
            np.testing.assert_allclose(got[name], value, rtol=1e-10)


def test_second_derivative_of_press():
    """Hessian of the depth by D: forward over reverse = reverse over reverse = closed form."""
    v = tree({"D": 2.0, "c": 0.9, "k_1": 0.4, "k_3": 0.05})

    def depth(D):
        return series(v | {"D": D})[0]

    d, p, q = depth(v["D"]), 1 + 0.9 * 0.4, 0.9 * 0.05
    expected = -6 * q * d / (p + 3 * q * d * d) ** 3
    for hessian in (jax.jacfwd(jax.grad(depth)), jax.grad(jax.grad(depth))):
        np.testing.assert_allclose(jax.jit(hessian)(v["D"]), expected, rtol=1e-11)


MATERIAL = {"EI_L": 1.9, "k_M": 0.1, "k_1": 0.4, "k_3": 0.02, "GA_L": 1.3} | {
    "k_1_ring": 0.9,
    "k_3_ring": 0.05,
}


@functools.cache
def pressing(options):
    def f(v):
        arc = jnp.asarray(2.0)
        g = Geometry(v["length"], v["x"], jnp.asarray(11.0), arc, jnp.asarray(4.0))
        m = Material(**{n: v[n] for n in MATERIAL})
        got = press(g, m, v["s"], v["D"], options, onset=v["onset"])
        return got.force, got.depth, got.skeleton, got.joints, got.reactions, got.compliance

    return f


@pytest.mark.slow
@pytest.mark.compiling
def test_press():
    """The whole pipeline, by every leaf of material and geometry, s_c, displacement and onset."""
    options = Options(coupling="total", form="reactions", split="independent")
    D = np.array([0.3, 1.1, 2.5])
    values = {"x": RINGS, "length": 61.0, "s": 26.7, "D": D, "onset": 0.1} | MATERIAL
    check(pressing(options), values, rtol=1e-6)


@pytest.mark.parametrize("k_3", [0.0, 1e-30, 1e20, -1e-4])
def test_press_finite_at_zero(k_3):
    """Before, at and just after first touch, in both dtypes; k_3 from 0 to huge."""
    D = np.array([-1.0, 0.1, 0.1005, 2.0])
    values = {"x": RINGS, "length": 61.0, "s": 20.0, "D": D, "onset": 0.1} | MATERIAL
    v = jax.tree.map(lambda a: jnp.asarray(a, "float64"), values | {"k_3": k_3})
    for leaf in jax.tree.leaves(_press_gradient(v)):
        assert leaf.dtype == "float64"
        assert np.all(np.isfinite(leaf))


_press_gradient = jax.jit(jax.grad(lambda v: jnp.sum(pressing(Options())(v)[0])))


@pytest.mark.parametrize("mode", [jax.grad, jax.jacfwd])
def test_gradient_program_does_not_grow_with_rings(mode):
    """A scan: 20 and 200 rings are the same program but for its shapes; the cost is linear."""

    def operations(n):
        def total(EI, k):
            x = jnp.arange(1.0, n + 1)
            got = deflect(Beam(x, jnp.asarray(n + 1.0), EI, k), jnp.asarray(3.3), jnp.asarray(1.0))
            return jnp.sum(got.w) + got.w_C

        lowered = jax.jit(mode(total, argnums=1)).lower(jnp.ones(n + 1), jnp.ones(n))
        return lowered.as_text().count("\n")

    assert operations(20) == operations(200)
