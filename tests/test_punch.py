"""A tool with a width: against finite elements of the beam with two equal deflections imposed."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import punch_fem
import pytest
from scipy.integrate import quad

from jaxtrachea.mechanics import beam as point
from jaxtrachea.mechanics.compliance import Beam
from jaxtrachea.mechanics.press import Options, compliance, local_law, press
from jaxtrachea.mechanics.punch import mean_ring_weight, punch_deflection
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.geometry import table_1
from jaxtrachea.trachea.material import Material

QUICK = {"xla_backend_optimization_level": 0}
X, LENGTH, HALF = np.arange(10.0, 151.0, 10.0), 160.0, 2.4
EI, GA, K = np.linspace(900.0, 1800.0, 16), np.linspace(7.0, 11.0, 16), np.linspace(0.1, 0.3, 15)


def beam(dtype="float64", shear=True):
    def cast(v):
        return jnp.asarray(v, dtype)

    return Beam(cast(X), cast(LENGTH), cast(EI), cast(K), cast(GA) if shear else None)


def by_elements(s, shear, half=HALF):
    """Dense stiffness, both points held at 1 mm."""
    return punch_fem.held(X, LENGTH, EI, K, s, half, GA if shear else None)


PLACES = [2.5, 22.0, 30.0, 31.2, 27.6, 32.4, 35.0, 75.0, 157.0]


@pytest.mark.parametrize("shear", [True, False])
def test_against_finite_elements(shear):
    held = jax.jit(jax.vmap(lambda s: punch_deflection(beam("float64", shear), s, HALF)))
    got = held(jnp.asarray(PLACES, "float64"))
    rtol = 1e-9
    for i, s in enumerate(PLACES):
        true = by_elements(s, shear)
        c = true.w_C
        np.testing.assert_allclose(got.w_C[i], c, rtol=rtol, err_msg=f"{s}")
        np.testing.assert_allclose(got.w[i], true.w, rtol=rtol, atol=rtol * c)
        np.testing.assert_allclose(got.reaction[i], true.reaction, rtol=rtol, atol=rtol * c)
        size = rtol * np.abs(true.edges).max()
        np.testing.assert_allclose(got.edges[i], true.edges, rtol=rtol, atol=size)
        np.testing.assert_allclose(got.theta_C[i], true.share @ true.edges, rtol=rtol, atol=size)


@pytest.mark.parametrize("s", [22.0, 31.2, 35.0])
def test_rotation_is_half_of_what_the_place_changes(s):
    """Without shear, by differences of fourth order of the finite elements' compliance."""
    h = 0.05
    c = {i: by_elements(s + i * h, shear=False).w_C for i in (-2, -1, 1, 2)}
    slope = (8 * (c[1] - c[-1]) - c[2] + c[-2]) / (12 * h)
    theta = jax.jit(lambda s: punch_deflection(beam(shear=False), s, HALF).theta_C)(s)
    np.testing.assert_allclose(2 * theta, slope, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.compiling
def test_narrow_punch_is_a_point_that_does_not_tilt():
    """As the square of the width, in the middle of a uniform beam, where a point does not either.

    An edge beyond the end (refused by `press`) is taken to stand on the clamp.
    """
    middle = Beam(jnp.asarray(X), jnp.asarray(LENGTH), jnp.full(16, 900.0), jnp.full(15, 0.2))
    s = jnp.asarray(80.0)
    truth = point.contact_compliance(middle, s)
    errors = [punch_deflection(middle, s, a).w_C / truth - 1 for a in (0.4, 0.2)]
    assert abs(errors[0]) < 1e-3
    np.testing.assert_allclose(errors[0] / errors[1], 4, rtol=0.1)
    for end in (0.0, 1.0, 159.0, 160.0):
        assert punch_deflection(beam(), jnp.asarray(end), HALF).w_C == 0


def test_continuous_over_a_ring():
    """A ring that comes under the edge does so without a jump, in compliance and joints."""
    edge = X[3] - HALF
    held = jax.jit(jax.vmap(lambda s: punch_deflection(beam(), s, HALF)))
    got = held(jnp.asarray([edge - 1e-9, edge, edge + 1e-9]))
    for v in got:
        np.testing.assert_allclose(v, np.broadcast_to(v[1], v.shape), rtol=1e-6, atol=1e-9)


def test_no_notch():
    """Between two rings the force falls to the middle and rises again, at 0.1 mm steps.

    Stiffnesses mixed in place of compliances had a notch of 2.7 % in the last 0.2 mm. What is left
    is a corner of its slope where a ring comes under an edge, 0.35 % of the force in 0.1 mm.
    """
    geometry = table_1()
    material = Material(1930.0, 0.2126, 8.18, 0.0, GA_L=6.97, k_1_ring=1e6)
    options = Options(shear=True, local="two-material", half_width=HALF, contact="bonded")
    s = jnp.linspace(70, 80, 101)
    F = jax.jit(jax.vmap(lambda s: press(geometry, material, s, 0.1, options).force))(s)
    F = np.asarray(F)
    np.testing.assert_allclose(F, F[::-1], rtol=2e-3)
    assert np.all(np.diff(F[:51]) < 0)
    assert np.all(np.diff(F[50:]) > 0)
    assert np.max(np.abs(np.diff(F))) < 4e-3 * F.max()
    assert F[48] - F[50] < 1e-3 * F.max()


def weight(s, transition):
    t = np.clip((s - X) / transition, -1, 1)
    return 1 - np.prod(1 - (1 - t * t) ** 3)


@functools.cache
def exact_mean(s, transition, half):
    """By quadrature from kink to kink."""
    kinks = np.concatenate([X - transition, X, X + transition])
    ends = [-1, *sorted((k - s) / half for k in kinks if abs(k - s) < half), 1]
    return sum(
        quad(lambda u: weight(s + half * u, transition), a, b, epsabs=1e-14)[0] / 2
        for a, b in itertools.pairwise(ends)
    )


@functools.cache
def compiled_mean(half, dtype):
    """Value and slope of one width by places and transition."""

    def mean(s, transition):
        return mean_ring_weight(s, jnp.asarray(X, dtype), transition, half)

    return jax.jit(jax.vmap(jax.value_and_grad(mean), (0, None)), compiler_options=QUICK)


@pytest.mark.long
@pytest.mark.parametrize(
    ("transition", "atol"), [(0.5, 1e-12), (2.0, 1e-12), (5.0, 1e-12), (8.0, 1e-12), (25.0, 2e-4)]
)
def test_mean_ring_weight(transition, atol):
    """A narrow ring under a wide tool slipped between 8 points.

    Its derivative is the difference of both edges over the width, by definition.
    """
    places = (80.0, 79.5, 81.0, 72.3, 30.0)
    bound = atol
    for half in (1e-3, 0.1, HALF, 5.0, 20.0):  # narrow ones lost their width in float32
        got, slope = compiled_mean(half, "float64")(
            *(jnp.asarray(v, "float64") for v in (places, transition))
        )
        assert got.dtype == jnp.dtype("float64")
        exact = [exact_mean(s, transition, half) for s in places]
        np.testing.assert_allclose(got, exact, rtol=0, atol=bound)
        edges = [[weight(s + e * half, transition) for s in places] for e in (1, -1)]
        steep = np.subtract(*edges) / (2 * half)
        np.testing.assert_allclose(slope, steep, rtol=0, atol=10 * bound / min(transition, 1))


@pytest.mark.slow
@pytest.mark.compiling
def test_compliance_and_law_of_press():
    """`press`, `compliance` and the fit's law see one and the same punch."""
    geometry = table_1()
    options = Options(shear=True, local="two-material", half_width=HALF, contact="bonded")
    material = Material(1930.0, 0.2126, 8.18, 0.0, GA_L=6.97, k_1_ring=40.0)
    s = jnp.asarray([22.0, 70.0, 75.0])
    c = compliance(geometry, material, s, options)
    for i in range(3):
        got = press(geometry, material, s[i], 0.1, options)
        weight = mean_ring_weight(s[i], geometry.ring_positions, jnp.asarray(5.0), HALF)
        local = (1 - weight) / 8.18 + weight / 40.0  # compliances add
        np.testing.assert_allclose(1 / local_law(geometry, material, s[i], options).k_1, local)
        np.testing.assert_allclose(got.force, 0.1 / (c[i] + local), rtol=1e-12)


@pytest.mark.slow
@pytest.mark.compiling
def test_beyond_an_end_is_refused():
    """No punch stands on a clamp: OFF_TUBE, NaN; its derivatives are 0, good rows keep theirs.

    With its edge just on the end it stands there: rigid for forces, as a point at the end is.
    """
    options = Options(shear=True, local="two-material", half_width=2.5, skeleton="softening")
    wide = Options(shear=True, half_width=80.5, skeleton="softening")
    places = [75.0, 2.5, 157.5, 2.4, 157.6, 0.0, 160.0, -1.0, 162.0]
    values = {"EI_L": 1930.0, "k_M": 0.2126, "k_1": 8.18, "k_3": 0.1, "GA_L": 6.97,
              "k_1_ring": 40.0, "e_1": 0.1, "e_2": 0.005}  # fmt: skip
    geometry = table_1(dtype="float64")

    def press_row(options, s, values):
        return press(geometry, Material(**values), s, 0.1, options)

    def run(options, places, values):
        columns = {k: jnp.full(len(places), v, "float64") for k, v in values.items()}

        def total(s, values):
            out = press_row(options, s, values)
            solved = out.status == PressStatus.OK
            return jnp.where(solved, out.force + jnp.sum(out.joints), 0), out

        slope = jax.vmap(jax.value_and_grad(total, (0, 1), has_aux=True))
        (_, out), by = jax.jit(slope)(jnp.asarray(places, "float64"), columns)
        return out, np.stack(jax.tree.leaves(by), axis=1)

    out, by = run(options, places, values)
    assert out.status.tolist() == [PressStatus.OK] * 3 + [PressStatus.OFF_TUBE] * 6
    for v in out[:-1]:
        assert np.isfinite(v[:3]).all()
        assert np.isnan(v[3:]).all()
    assert np.isfinite(by).all()
    assert np.all(by[3:] == 0)
    assert np.all(by[0, 1:] != 0)
    material = Material(**{k: jnp.asarray(v, "float64") for k, v in values.items()})
    c = compliance(geometry, material, jnp.asarray(places, "float64"), options)
    assert np.isfinite(c[:3]).all()
    assert np.isnan(c[3:]).all()
    values.pop("k_1_ring")
    out, by = run(wide, [79.0, 80.0, 81.0], values)
    assert out.status.tolist() == [PressStatus.OFF_TUBE] * 3
    assert np.isnan(out.force).all()
    assert np.all(by == 0)


def test_options():
    for other in ({"form": "reactions"}, {"split": "independent"}):
        with pytest.raises(ValueError, match="half_width"):
            Options(half_width=1.0, **other)
    with pytest.raises(ValueError, match="half_width"):
        Options(half_width=-1.0)
