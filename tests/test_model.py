"""The forward model: options, their errors, and the rooms put together in the right order."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jitted import jitted

from jaxtrachea.mechanics import beam, equilibrium, force_law
from jaxtrachea.mechanics.press import Options, indentation, ligament_beam, local_law, press
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.geometry import Geometry, table_1
from jaxtrachea.trachea.material import Material

VALUES = {"EI_L": 1.862, "k_M": 0.1, "k_1": 0.3, "k_3": 0.02}
MORE = {"GA_L": 1.1, "k_1_ring": 0.9, "k_3_ring": 0.05}
D = np.array([-0.5, 0.0, 0.2, 1.0, 3.0])


def material(dtype="float64", **changes):
    return Material(**{n: jnp.asarray(v, dtype) for n, v in (VALUES | changes).items()})


laws = jitted(local_law, static_argnums=3)


@functools.cache
def run(options):
    return jitted(lambda g, m, s, d, onset: press(g, m, s, d, options, onset=onset))


def pressed(options, dtype="float64", s=44.0, displacement=D, onset=0.0, **changes):
    args = (jnp.asarray(v, dtype) for v in (s, displacement, onset))
    return run(options)(table_1(dtype=dtype), material(dtype, **changes), *args)


@pytest.mark.parametrize(
    "options",
    [
        Options(),
        Options(coupling="total", split="independent", form="reactions"),
        Options(shear=True, local="two-material", contact="bonded", transition=4.0),
    ],
    ids=["default", "paper", "everything"],
)
def test_shapes_dtypes_and_consistency(options):
    got = pressed(options, "float64", **(MORE if options.shear else {}))
    assert {v.dtype for v in got if v.dtype != jnp.int8} == {jnp.dtype("float64")}
    assert got.force.shape == got.depth.shape == got.status.shape == (5,)
    assert got.joints.shape == got.reactions.shape == (5, 15)
    rtol = 50 * np.finfo("float64").eps
    np.testing.assert_allclose(got.skeleton, got.compliance * got.force, rtol=rtol)
    np.testing.assert_allclose(got.reactions, VALUES["k_M"] * got.joints, rtol=rtol)
    moved = np.where((D > 0) | (options.contact == "bonded"), D, 0)
    # First touch changes nothing beyond `onset_width`.
    np.testing.assert_allclose(got.depth + got.skeleton, moved, rtol=rtol, atol=rtol)


def test_is_the_rooms_in_order():
    got = pressed(Options(), onset=0.1)
    g, m, s = table_1(), material(), np.asarray(44.0)

    @jax.jit
    def by_room(g, m, s, touched):
        b = ligament_beam(g, m, Options())
        c = beam.contact_compliance(b, s)
        alone = equilibrium.press_series(touched, c, force_law.Law(m.k_1, m.k_3))
        return alone.force, beam.deflect(b, s, alone.force[4]).w

    force, joints = by_room(g, m, s, np.asarray(np.maximum(np.asarray(D) - 0.1, 0)))
    np.testing.assert_allclose(got.force, force, rtol=1e-12)
    np.testing.assert_allclose(got.joints[4], joints, rtol=1e-10, atol=1e-14)


@pytest.mark.parametrize("coupling", ["series", "total"])
def test_no_contact_no_force(coupling):
    """Exactly zero up to the onset, whatever the skeleton."""
    d = np.array([-1e9, -1.0, 0.0, 0.299999, 0.3, 0.4])
    got = pressed(Options(coupling=coupling), displacement=d, onset=0.3)
    for v in (got.force, got.depth, got.skeleton, got.joints, got.reactions):
        np.testing.assert_array_equal(v[:5], 0)
    np.testing.assert_array_equal(got.status[:5], PressStatus.NO_CONTACT)
    assert got.force[5] > 0


@pytest.mark.parametrize("coupling", ["series", "total"])
def test_bonded_is_odd(coupling):
    d = np.array([-2.0, -0.3, 0.3, 2.0])
    got = pressed(Options(coupling=coupling, contact="bonded"), displacement=d + 0.1, onset=0.1)
    np.testing.assert_allclose(got.force, -got.force[::-1], rtol=1e-12)
    assert got.force[3] > 0


@pytest.mark.parametrize(
    ("options", "name"),
    [(Options(shear=True), "GA_L"), (Options(local="two-material"), "k_1_ring")],
)
def test_missing_values_are_named(options, name):
    with pytest.raises(ValueError, match=name):
        pressed(options)


def test_two_material():
    """On a ring the ring's own law, mid-span the ligament's; `k_3` holds on rings if not given."""
    options, g = Options(local="two-material"), table_1()
    m = material(**MORE)
    on, off = (laws(g, m, np.asarray(s), options) for s in (50.0, 55.0))
    np.testing.assert_allclose(on[:2], (0.9, 0.05), rtol=1e-14)
    np.testing.assert_allclose(off[:2], (0.3, 0.02), rtol=1e-14)
    plain = laws(g, material(k_1_ring=0.9), np.asarray(50.0), options)
    np.testing.assert_allclose(plain[:2], (0.9, 0.02), rtol=1e-14)


@pytest.mark.parametrize("x", [np.arange(2.0, 93, 10), np.arange(8.0, 99, 10)])
def test_two_material_goes_over_within_half_the_closest_spacing(x):
    """Also where the first or last ring is nearer to an end: 3 of 5 mm off, w = (1 - 0.6^2)^3."""
    g, w = Geometry.create(100.0, x), (1 - 0.36) ** 3
    law = laws(g, material(**MORE), np.asarray(x[4] + 3), Options(local="two-material"))
    np.testing.assert_allclose(1 / law.k_1, w / 0.9 + (1 - w) / 0.3, rtol=1e-12)
    for end in (0.0, 100.0):  # 2 mm off a ring, where the tube ends
        law = laws(g, material(**MORE), np.asarray(end), Options(local="two-material"))
        off = np.abs(x - end).min()
        w_end = (1 - min(off / 5, 1) ** 2) ** 3
        np.testing.assert_allclose(1 / law.k_1, w_end / 0.9 + (1 - w_end) / 0.3, rtol=1e-12)


def test_two_material_single_ring_has_a_transition():
    """With one ring the transition is measured to the ends: finite, not the infinity of no pair."""
    g = Geometry.create(100.0, [30.0])
    law = laws(g, material(**MORE), np.asarray(95.0), Options(local="two-material"))
    np.testing.assert_allclose(law[:2], (0.3, 0.02))
    assert law.k_5 is None


def test_shear_softens():
    one, two = pressed(Options()), pressed(Options(shear=True), **MORE)
    assert two.compliance > one.compliance
    stiff = pressed(Options(shear=True), **(MORE | {"GA_L": 1e12}))
    np.testing.assert_allclose(stiff.compliance, one.compliance, rtol=1e-9)


def test_per_ring_values():
    """Scalars spread over rings and spans are the arrays written out."""
    one = pressed(Options())
    two = pressed(Options(), k_M=np.full(15, 0.1), EI_L=np.full(16, 1.862))
    np.testing.assert_array_equal(one.joints, two.joints)


def test_touch_is_smooth_and_local():
    width, d = 0.2, np.linspace(-1, 1, 401)
    run = jitted(indentation, static_argnums=2)
    y = np.asarray(run(d, np.asarray(0.1), Options(onset_width=width)))
    np.testing.assert_array_equal(y[d <= 0.1], 0)
    beyond = d >= 0.1 + width
    np.testing.assert_allclose(y[beyond], d[beyond] - 0.1, rtol=1e-14)
    bonded = run(d, np.asarray(0.1), Options(contact="bonded"))
    np.testing.assert_array_equal(bonded, d - 0.1)


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_units(unit):
    """Every length in another unit: displacements rescale, forces stay."""
    import equinox as eqx

    g = table_1()

    def lengths(v):
        return (v.length, v.ring_positions, v.radius, v.ring_height)

    h = eqx.tree_at(lengths, g, tuple(v * unit for v in lengths(g)))
    m = material()
    n = Material(m.EI_L * unit**2, m.k_M / unit, m.k_1 / unit, m.k_3 / unit**3)
    s, d, zero = np.asarray(44.0), np.asarray(D), np.zeros(())
    one = run(Options(onset_width=0.0))(g, m, s, d, zero)
    two = run(Options(onset_width=0.0))(h, n, s * unit, d * unit, zero)
    np.testing.assert_allclose(two.force, one.force, rtol=1e-11)
    np.testing.assert_allclose(two.depth, one.depth * unit, rtol=1e-11)
    tolerance = 1e-12 * unit * np.max(np.abs(one.joints))
    np.testing.assert_allclose(two.joints, one.joints * unit, rtol=1e-9, atol=tolerance)


@pytest.mark.parametrize("coupling", ["series", "total"])
def test_bad_specimen_in_a_batch(coupling):
    """One specimen NaN, one past its fold: flagged; the others keep every bit."""
    one = jitted(jax.vmap(lambda EI, k_3: pressed(Options(coupling=coupling), EI_L=EI, k_3=k_3)))
    EI, k_3, keep = np.full(4, 1.862), np.full(4, 0.001), [1, 3]
    good = one(EI, k_3)
    EI[0], k_3[2] = np.nan, -1e6
    bad = one(EI, k_3)
    for p, q in zip(good, bad, strict=True):
        np.testing.assert_array_equal(p[keep], q[keep])
    assert np.all(bad.status[0, 2:] == PressStatus.NON_FINITE)
    assert np.all(bad.status[2, 2:] == PressStatus.PAST_FOLD)
    assert np.all(np.isnan(bad.force[2, 2:]))


def test_unilateral_contact_does_not_pull():
    """F = 0 at d = D = sqrt(-k_1 / k_3) whatever the compliance c < 1 / (2 k_1); then a pull."""
    stiff = {"EI_L": 1e3, "k_M": 10.0, "k_3": -0.3 / 4, "s": 44.0}  # F = 0 at 2 mm
    D = np.array([-1.0, 0.0, 1.9, 2.1, 2.2])
    got = pressed(Options(), "float64", displacement=D, **stiff)
    held = pressed(Options(contact="bonded"), "float64", displacement=D, **stiff)
    ok, no, pulls = PressStatus.OK, PressStatus.NO_CONTACT, PressStatus.PULLS
    assert 0.01 < got.compliance < 1 / 0.6
    np.testing.assert_array_equal(got.status, [no, no, ok, pulls, pulls])
    np.testing.assert_array_equal(held.status, [ok, no, ok, ok, ok])
    assert held.force[2] > 0 > held.force[3] > held.force[4]
    np.testing.assert_allclose(got.force[2], held.force[2], rtol=8 * np.finfo("float64").eps)
    for value in (got.force, got.depth, got.skeleton, got.joints, got.reactions):
        assert np.all(np.isnan(value[3:]) & ~np.any(np.isnan(value[:3])))


def test_a_pull_leaves_the_derivatives_of_the_others():
    """Derivative of the force at 1.9 mm by k_3, beside a row that pulls; by central differences."""
    at, o = np.asarray([1.9, 2.2]), Options()
    stiff = {"EI_L": 1e3, "k_M": 10.0}

    def first(k_3):
        return pressed(o, displacement=at, k_3=k_3, **stiff).force[0]

    slope = jax.grad(first)(np.asarray(-0.075))
    step = 1e-6
    difference = (first(-0.075 + step) - first(-0.075 - step)) / (2 * step)
    np.testing.assert_allclose(slope, difference, rtol=1e-7)
