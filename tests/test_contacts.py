"""Several contacts on one skeleton: against exact finite elements, enumeration and `press`."""

import functools

import beam_fem
import contact_sets
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrachea.mechanics.compliance import Beam
from jaxtrachea.mechanics.contacts import solve
from jaxtrachea.mechanics.force_law import Law
from jaxtrachea.mechanics.influence import influence, level_influence
from jaxtrachea.mechanics.levels.options import Options
from jaxtrachea.mechanics.press import press
from jaxtrachea.mechanics.press_contacts import press_contacts
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.geometry import table_1
from jaxtrachea.trachea.material import Material

X, LENGTH = np.arange(10.0, 151.0, 10.0), 160.0
EI, GA, K = np.linspace(900.0, 1800.0, 16), np.linspace(7.0, 11.0, 16), np.linspace(0.1, 0.3, 15)
VALUES = {"EI_L": 1.9, "k_M": 0.1, "k_1": 0.3, "k_3": 0.02, "k_5": 0.004}
OK, NO_CONTACT, LIFTED = PressStatus.OK, PressStatus.NO_CONTACT, PressStatus.LIFTED


def on_host(function):
    """The function with NumPy arrays as results: what a test does with them compiles nothing."""
    return lambda *given, **more: jax.device_get(function(*given, **more))


@functools.partial(jax.jit, static_argnames=("shear", "half"))
def by_recursion(s, k, EI, *, shear=True, half=0.0):
    """All responses of the beam to a force at each contact; k and EI as numbers."""
    dtype = s.dtype
    stiff = jnp.asarray(GA, dtype) if shear else None
    beam = Beam(jnp.asarray(X, dtype), jnp.asarray(LENGTH, dtype), EI, k, stiff)
    return influence(beam, s) if half == 0 else level_influence(beam, s, half)


responses = on_host(by_recursion)


def by_elements(points, at, shear=True):
    """Deflection of all points and rings by a force at each of `at`, in 80 digits."""
    nodes = np.unique(np.concatenate([X, points]))
    inner = nodes[(nodes > 0) & (nodes < LENGTH)]
    k = np.zeros(len(inner))
    k[np.searchsorted(inner, X)] = K
    edges = np.concatenate([[0.0], inner, [LENGTH]])
    span = np.searchsorted(X, (edges[:-1] + edges[1:]) / 2)
    rows = []
    for s in at:
        more = GA[span] if shear else None
        found = beam_fem.solve(inner, LENGTH, EI[span], k, s, 1.0, more)
        w = np.zeros(len(nodes))
        w[np.searchsorted(nodes, inner)] = [float(v) for v in found.w]
        rows.append(w)
    w = np.array(rows)
    return w[:, np.searchsorted(nodes, points)], w[:, np.searchsorted(nodes, X)]


#: Out of order, on rings, two and three on one place, near a ring, near the ends.
PLACES = [[75.0, 30.0, 33.0, 30.0, 151.0, 2.0], [20.0, 10.0, 10.0, 90.0, 90.001, 10.0]]


def test_influence_against_finite_elements():
    for s in (*PLACES, [33.0, 30.0]):
        got = responses(np.asarray(s), K, EI)
        C, w = by_elements(s, s)
        np.testing.assert_allclose(got.compliance, C, rtol=0, atol=1e-12 * C.max())
        np.testing.assert_allclose(got.joints, w, rtol=0, atol=1e-12 * C.max())
        np.testing.assert_allclose(got.reactions, K * w, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(got.compliance, got.compliance.T)
        on_ring = [i for i, v in enumerate(s) if v in X]  # motion of the joint there, Maxwell
        rings = np.searchsorted(X, np.array(s)[on_ring])
        np.testing.assert_allclose(np.asarray(got.joints)[:, rings], C[:, on_ring], atol=1e-12)


def test_punches_against_finite_elements():
    """Two that overlap, and one on a ring: the moments that keep them level, by least energy."""
    s, half = np.array([75.0, 30.0, 78.0, 110.0, 40.0, 140.0]), 2.4
    got = responses(s, K, EI, half=half)
    points = np.concatenate([s - half, s + half])
    C, w = by_elements(points, points)
    level = np.concatenate([np.eye(6), -np.eye(6)]).T  # differences that are 0
    whole = np.concatenate([np.eye(6), np.eye(6)]).T  # sums of forces that are given
    zero = np.zeros((6, 6))
    system = np.block([[C, -whole.T, level.T], [whole, zero, zero], [level @ C, zero, zero]])
    given = np.concatenate([np.zeros((12, 6)), np.eye(6), zero])
    forces = np.linalg.lstsq(system, given, rcond=None)[0][:12].T
    np.testing.assert_allclose(got.compliance, forces @ C @ whole.T / 2, atol=1e-10)
    np.testing.assert_allclose(got.joints, forces @ w, atol=1e-10)


def test_two_punches_on_one_place_are_one():
    s = np.array([75.0, 30.0, 75.0, 110.0, 40.0, 140.0])
    C = responses(s, K, EI, half=2.4).compliance
    np.testing.assert_allclose(C[0], C[2], rtol=1e-13)
    np.testing.assert_allclose(C[0, 0], C[0, 2], rtol=1e-13)


def test_a_punch_too_narrow_for_its_digits_says_nothing():
    s = np.asarray(PLACES[0])
    C = responses(s, K, EI, shear=False, half=1e-9).compliance
    assert np.all(np.isnan(C))


def random_beams(count, m, seed):
    """Stiffnesses over eight decades, contacts anywhere, some on one place or one ring."""
    rng = np.random.default_rng(seed)
    half = rng.random((count, 1)) < 0.5
    k = np.where(half, 10 ** rng.uniform(-4, 4, (count, 15)), 10 ** rng.uniform(-4, 4, (count, 1)))
    half = rng.random((count, 1)) < 0.5
    EI = np.where(half, 10 ** rng.uniform(-1, 2, (count, 16)), 1.86)
    s = rng.uniform(2, 158, (count, m))
    s[::7, 1] = s[::7, 0]
    s[::11] = s[::11, :1]
    s[::13, 2] = 70.0
    s[::17] = 80 + rng.uniform(-12, 12, s[::17].shape)
    return k, EI, s


@functools.cache
def random_scenes(count, m, seed=7):
    """Displacements, compliances and laws."""
    rng, shape = np.random.default_rng(seed), (count, m)
    k, EI, s = random_beams(count, m, seed + 1)
    C = jax.jit(jax.vmap(lambda s, k, EI: by_recursion(s, k, EI, shear=False).compliance))(s, k, EI)
    D = rng.uniform(-3, 8, shape)
    D[::23] = 0
    k_1 = 10 ** rng.uniform(-3, 3, shape)
    k_3 = np.where(rng.random(shape) < 0.3, 0, 10 ** rng.uniform(-4, 3, shape))
    k_5 = np.where(rng.random(shape) < 0.5, 0, 10 ** rng.uniform(-4, 2, shape))
    return D, np.asarray(C), k_1, k_3, k_5


@on_host
@jax.jit
@jax.vmap
def sharp(D, C, k_1, k_3, k_5):
    """Solved scenes; contacts touch without a rounded corner."""
    return solve(D, C, Law(k_1, k_3, k_5), width=jnp.zeros_like(D[0]))


@pytest.mark.slow
def test_compliances_are_positive_semi_definite():
    many = jax.jit(jax.vmap(lambda s, k, EI: by_recursion(s, k, EI, shear=False).compliance))
    k, EI, s = random_beams(10_000, 6, 3)
    C = np.asarray(many(s, k, EI))
    size = np.sqrt(np.einsum("nii->ni", C))
    C = C / (size[:, :, None] * size[:, None])
    assert np.linalg.eigvalsh(C).min() > -1e-11
    np.testing.assert_array_equal(C, np.swapaxes(C, 1, 2))


def test_against_enumeration_of_what_touches():
    count, m = 200, 3
    scenes = random_scenes(count, m)
    got, true = sharp(*scenes), contact_sets.balanced(scenes[0], scenes[1], scenes[2:])
    assert np.all(np.isfinite(true))
    size = np.abs(true).max(1, keepdims=True) + 1e-300
    np.testing.assert_allclose(got.force / size, true / size, rtol=0, atol=1e-10)
    D, status = scenes[0], np.asarray(got.status)
    lifted = (true == 0) & (D > 0)
    np.testing.assert_array_equal(status == LIFTED, lifted)
    np.testing.assert_array_equal(status == OK, true > 0)
    assert lifted.sum() > count / 10
    u = np.einsum("nij,nj->ni", scenes[1], true)
    whole = np.abs(u).max(1, keepdims=True) + 8
    np.testing.assert_allclose(got.depth / whole, (D - u) / whole, rtol=0, atol=1e-12)


def test_a_start_changes_the_steps_alone():
    D, C, *laws = random_scenes(200, 3)

    @on_host
    @jax.jit
    @jax.vmap
    def begun(D, C, start, *laws):
        return solve(D, C, Law(*laws), width=jnp.zeros_like(D[0]), start=start)

    cold = sharp(D, C, *laws)
    warm = begun(D, C, cold.force, *laws)
    size = np.abs(cold.force).max(1, keepdims=True) + 1e-300
    np.testing.assert_allclose(warm.force / size, cold.force / size, rtol=0, atol=1e-12)
    assert np.mean(warm.steps) < 0.6 * np.mean(cold.steps)


@on_host
@functools.partial(jax.jit, static_argnames="options")
def pressed(s, D, values, present, onset=0.0, *, options=Options()):
    """`press_contacts` on the tube of Table 1."""
    onset, material = jnp.broadcast_to(onset, s.shape), Material(**values)
    return press_contacts(table_1(), material, s, D, options, onset=onset, present=present)


@pytest.mark.long
def test_float32_says_where_a_stiff_law_leaves_no_digits():
    """k_3 up to 1e10 N/mm^3: what has a number is that of float64."""
    D, C, k_1, *_ = random_scenes(500, 6)
    run = on_host(jax.jit(jax.vmap(
        lambda D, C, *law: solve(D, C, Law(*law), width=jnp.asarray(1e-3, D.dtype))
    )))  # fmt: skip
    for k_3 in (1.0, 1e4, 1e7, 1e10):
        given = D, C, k_1, np.full_like(k_1, k_3)
        true = run(*given)
        found = run(*(np.asarray(v, np.float32) for v in given))
        solved = np.isfinite(found.force).all(1)
        off = np.abs(found.force - true.force).max(1) / np.abs(true.force).max(1).clip(1e-30)
        assert np.isfinite(true.force).all(1).mean() > 0.7
        assert np.nanmax(off[solved]) < 2e-4
        assert not np.isin(found.status[~solved], [OK, NO_CONTACT, LIFTED]).any()
        assert solved.mean() > (0.9 if k_3 < 10 else 0.1)


@on_host
@functools.partial(jax.jit, static_argnames="options")
def alone(s, D, values, *, options):
    return press(table_1(), Material(**values), s, D, options)


ALL = np.ones(4, bool)
WIDE = Options(half_width=2.4, local="two-material", shear=True)


def test_one_contact_is_press():
    """To rounding but within the rounded corner; there by 0.07 k_1 of its width at most."""
    values = VALUES | {"GA_L": 9.0, "k_1_ring": 0.9, "k_3_ring": 0.1}
    D = np.concatenate([[-1.0, 0.0], np.logspace(-6, 1.2, 40)])
    for s in (75.0, 70.0, 31.0, 4.0):
        one = alone(s, D, values, options=WIDE)
        got = pressed(np.array([s]), D[:, None], values, ALL[:1], options=WIDE)
        off = (D > 0) & (D <= WIDE.onset_width * (1 + float(one.compliance) * 0.9))
        for name in ("force", "depth", "skeleton", "joints", "reactions"):
            a, b = (np.asarray(getattr(v, name)).reshape(len(D), -1) for v in (one, got))
            if name == "depth":  # of a tool that does not touch: the gap
                a = np.where((D < 0)[:, None], D[:, None], a)
            size = np.abs(a).max(1, keepdims=True) + 1e-300
            np.testing.assert_allclose((b / size)[~off], (a / size)[~off], rtol=0, atol=1e-13)
        np.testing.assert_allclose(got.force[off, 0], one.force[off], atol=0.07 * 0.9e-3)
        np.testing.assert_array_equal(got.status[:, 0], one.status)


S = np.array([70.0, 80.0, 75.0, 120.0])
NEAR = np.array([4.0, 4.0, 0.5, 1.0])  # the two outer ones lift the wall off the middle one


def test_neighbours_lift_the_wall_off_a_third():
    found = pressed(S, NEAR, VALUES, ALL)
    np.testing.assert_array_equal(found.status, [OK, OK, LIFTED, OK])
    assert found.force[2] == 0
    assert found.depth[2] < 0
    both = pressed(S, NEAR, VALUES, np.array([True, True, False, True]))
    np.testing.assert_allclose(both.force, found.force, rtol=0, atol=1e-15)
    assert both.status[2] == NO_CONTACT
    balance = NEAR - found.depth - np.asarray(found.compliance) @ found.force
    np.testing.assert_allclose(balance, 0, atol=1e-14)


@pytest.mark.long
def test_a_glued_tool_beside_others():
    """Linear laws: those that touch and the glued one, which pulls, are springs in series."""
    values, glued = VALUES | {"k_3": 0.0, "k_5": 0.0}, np.array([False, False, True, False])
    program = jax.jit(press_contacts, static_argnames="options")
    run = functools.partial(program, table_1(), Material(**values), S)
    rows = np.stack([NEAR, [3.0, 3.0, -2.0, -8.0]])
    found = jax.device_get(run(rows, bonded=glued))
    np.testing.assert_array_equal(found.status, [[OK] * 4, [OK, OK, OK, NO_CONTACT]])
    assert (found.force[:, 2] < 0).all()  # the wall is drawn up to it
    for force, D, touch in zip(found.force, rows, (slice(0, 4), slice(0, 3)), strict=True):
        series = found.compliance[touch, touch] + np.eye(4)[touch, touch] / values["k_1"]
        true = np.linalg.solve(series, D[touch])
        # Within the smooth first touch a deep press lacks its mean.
        np.testing.assert_allclose(force[touch], true, rtol=0, atol=1e-12)
    every = jax.device_get(run(rows, options=Options(contact="bonded")))
    all_glued = jax.device_get(run(rows, bonded=np.ones(4, bool)))
    np.testing.assert_allclose(all_glued.force, every.force, rtol=0, atol=1e-14)


def test_onset_is_where_each_first_touches():
    onset = np.array([0.5, -0.25, 1.0, 2.0])
    found = pressed(S, NEAR + onset, VALUES, ALL, onset)
    np.testing.assert_allclose(found.force, pressed(S, NEAR, VALUES, ALL).force, rtol=1e-13)


def test_the_order_of_tools_does_not_matter():
    order, D = np.array([2, 0, 3, 1]), np.array([3.0, 1.0, 4.0, 2.0])
    a, b = pressed(S, D, VALUES, ALL), pressed(S[order], D[order], VALUES, ALL)
    np.testing.assert_allclose(b.force, a.force[order], rtol=1e-12)
    np.testing.assert_allclose(b.joints, a.joints, atol=1e-12)


def test_tools_on_one_place_are_one_with_all_their_laws():
    """Four equal ones at one place: one of four times the stiffness; also rigid ones."""
    for stiff in (1.0, 1e9):
        values = {"EI_L": 1.9, "k_M": 0.1, "k_1": 0.3 * stiff, "k_3": 0.02, "k_5": 0.004}
        four = pressed(np.full(4, 75.0), np.full(4, 4.0), values, ALL)
        sum_of = {n: 4 * v if n[0:2] in ("k_",) and n != "k_M" else v for n, v in values.items()}
        one = pressed(np.full(4, 75.0), np.full(4, 4.0), sum_of, ALL & (np.arange(4) == 2))
        np.testing.assert_allclose(four.force, np.full(4, one.force[2] / 4), rtol=1e-6)
        np.testing.assert_allclose(np.sum(four.force), one.force[2], rtol=1e-9)


def test_a_row_without_an_answer_leaves_the_others():
    rows = np.tile(NEAR, (4, 1))
    rows[1, 2], rows[2, 0] = np.nan, -np.inf
    found = pressed(S, rows, VALUES, ALL)
    bad = np.isin(np.arange(4), [1, 2])
    for v in (found.force, found.depth, found.skeleton, found.joints, found.reactions):
        assert np.all(np.isnan(np.asarray(v)[bad]))
        assert np.all(np.isfinite(np.asarray(v)[~bad]))
    assert np.all(np.asarray(found.status)[bad] == PressStatus.NON_FINITE)
    np.testing.assert_array_equal(found.force[0], found.force[3])


@pytest.mark.parametrize(
    ("changes", "status"),
    [
        ({"s": np.array([70.0, 180.0, 75.0, 120.0])}, PressStatus.OFF_TUBE),
        ({"s": np.array([70.0, np.nan, 75.0, 120.0])}, PressStatus.NON_FINITE),
        ({"k_M": -0.1}, PressStatus.BAD_MATERIAL),
        ({"k_1": np.inf}, PressStatus.NON_FINITE),
    ],
)
def test_what_is_refused_is_nan_throughout(changes, status):
    values = VALUES | {n: v for n, v in changes.items() if n != "s"}
    found = pressed(changes.get("s", S), np.tile(NEAR, (4, 1)), values, ALL)
    assert np.all(np.asarray(found.status) == status)
    assert np.all(np.isnan(found.force))
    assert np.all(np.isnan(found.compliance))


def test_an_absent_tool_may_stand_anywhere():
    s, there = np.array([70.0, np.nan, 75.0, 900.0]), np.array([True, False, True, False])
    D = np.array([3.0, np.nan, 2.0, 1.0])
    found = pressed(s, D, VALUES, there)
    other = pressed(S, D, VALUES, there)
    np.testing.assert_array_equal(found.force, other.force)
    np.testing.assert_array_equal(found.status, [OK, NO_CONTACT, OK, NO_CONTACT])


def test_a_law_that_softens_is_followed_to_its_peak():
    """The balance d + C f(d) = D holds before; at the peak of k_1 d + k_3 d^3 all ends."""
    values = VALUES | {"k_3": -0.02, "k_5": 0.0}
    peak = np.sqrt(0.3 / 0.06)
    rows = np.linspace(0.5, 8, 16)[:, None] * np.array([[1.0, 0.7, 0.3, 0.9]])
    found = pressed(S, np.concatenate([rows, NEAR[None]]), values, ALL)
    status, d = np.asarray(found.status)[:16], np.asarray(found.depth)[:16]
    past = status == PressStatus.PAST_FOLD
    np.testing.assert_array_equal(past.all(1), past.any(1))
    solved = ~past[:, 0]
    assert 0 < solved.sum() < 16
    assert np.all(solved == (np.arange(16) < solved.sum()))
    assert np.nanmax(d) < peak
    F = np.where(d[solved] > 0, 0.3 * d[solved] - 0.02 * d[solved] ** 3, 0)
    off = d[solved] + F @ np.asarray(found.compliance) - rows[solved]
    np.testing.assert_allclose(off, 0, atol=1e-5)  # the rounded corner


def test_float32_arguments_on_a_float64_tube():
    """As `press`: the tube's precision, for rounded places and displacements."""
    s, D = np.float32([60.0, 90.0]), np.float32([[2.0, 3.0]])
    tube, material = table_1(), Material(**VALUES)
    # Shapes alone: the loop of the solve was refused, which is found without compiling it.
    with jax.numpy_dtype_promotion("standard"):  # users' default
        given = jax.eval_shape(lambda: press_contacts(tube, material, s, D))
    assert given.force.dtype == given.compliance.dtype == np.float64


def test_too_many_and_what_does_not_fit():
    tube, material = table_1(), Material(**VALUES)
    for arguments, says in [
        ((np.full(17, 75.0), np.zeros(17)), "s_c has 17 contacts; expected 1 to 16"),
        ((np.zeros(0), np.zeros(0)), "s_c has 0 contacts"),
        ((75.0, np.zeros(2)), "s_c has no axis"),
        ((S, np.zeros(3)), r"displacement has 3 values; expected shape \(..., 4\)"),
        ((S, NEAR, Options(coupling="total")), "needs coupling='series'"),
        ((S, NEAR, Options(skeleton="softening")), "its softening is that of one contact"),
        ((S, NEAR, Options(skeleton="sections", contact="bonded")), "press_sections"),
        ((S, NEAR, Options(split="independent")), "needs split='continuous'"),
        ((S, NEAR, Options(form="reactions")), "needs form='recursion'"),
        ((S, NEAR, Options(relaxation="uniform")), "knows no time"),
    ]:
        with pytest.raises(ValueError, match=says):
            press_contacts(tube, material, *arguments)
    with pytest.raises(ValueError, match=r"present has shape \(3,\)"):
        press_contacts(tube, material, S, NEAR, present=np.ones(3, bool))
    with pytest.raises(ValueError, match=r"bonded has shape \(4,\) of int64; expected \(4,\)"):
        press_contacts(tube, material, S, NEAR, bonded=np.ones(4, int))
    with pytest.raises(ValueError, match="expected one for each contact|onset has 2 values"):
        press_contacts(tube, material, S, NEAR, onset=np.zeros(2))


@pytest.mark.slow
@pytest.mark.compiling
def test_second_derivatives_with_a_lifted_contact():
    """Forward over reverse against differences of the gradient; nothing is NaN where E = 0."""

    def energy(D):
        return jnp.sum(press_contacts(table_1(), Material(**VALUES), S, D).force ** 2)

    at, step = jnp.asarray(NEAR), 1e-5
    slope, bend = jax.jit(jax.grad(energy)), jax.jit(jax.hessian(energy))
    numeric = [(slope(at + step * e) - slope(at - step * e)) / (2 * step) for e in np.eye(4)]
    np.testing.assert_allclose(bend(at), np.array(numeric), atol=1e-8)
