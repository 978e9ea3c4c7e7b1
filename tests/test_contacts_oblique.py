"""Several contacts anywhere on the rings: against exact finite elements, and what must hold."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import spatial_fem
from small_scenes import SPRINGS

from jaxtrachea.mechanics.influence_vector import STRIP, influence_vector
from jaxtrachea.mechanics.levels.options import Options
from jaxtrachea.mechanics.oblique import ObliqueOptions
from jaxtrachea.mechanics.press_contacts import press_contacts
from jaxtrachea.mechanics.press_contacts_oblique import press_contacts_oblique
from jaxtrachea.mechanics.ring import Ring, ring_influence
from jaxtrachea.mechanics.skeleton import skeleton_response
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.geometry import table_1
from jaxtrachea.trachea.material import Material

pytestmark = pytest.mark.compiling
#: All but the refusals share programs that take ten seconds each to compile.
long = pytest.mark.long

VALUES = {"EI_L": 1.9, "EI_side": 2.4, "GA_L": 9.0, "k_M": 0.1, "k_1": 0.3, "k_3": 0.02,
          "EI_C": 9.9, "k_t": 0.03}  # fmt: skip
OK, NO_CONTACT, LIFTED = PressStatus.OK, PressStatus.NO_CONTACT, PressStatus.LIFTED
TUBE = table_1()
N, X, LENGTH = TUBE.rings, np.asarray(TUBE.ring_positions), float(TUBE.length)


@functools.partial(jax.jit, static_argnames="rings")
def by_program(s, phi, values, *, rings="arch2"):
    return influence_vector(TUBE, Material(**values), s, phi, rings=rings, shear=True)


@functools.partial(jax.jit, static_argnames="rings")
def press_program(s, phi, D, values, present, *, rings="arch2"):
    options = ObliqueOptions(Options(shear=True), rings)
    return press_contacts_oblique(TUBE, Material(**values), s, phi, D, options, present=present)


def responses(*given, **more):
    return jax.device_get(by_program(*given, **more))


def pressed(*given, **more):
    return jax.device_get(press_program(*given, **more))


@functools.cache
def _ring(rings):
    """Motion of a ring at one angle per load at another; y, z."""
    if rings == "mat":
        return lambda at, by: np.eye(2) / VALUES["k_M"]
    ring = Ring(
        TUBE.radius, TUBE.half_angle, *(jnp.asarray(VALUES[n]) for n in ("EI_C", "k_M", "k_t"))
    )
    by = jax.jit(lambda at, by: ring_influence(ring, at, by))
    return lambda at, load: np.asarray(by(at, load))


def frame(phi):
    """Rows: inward normal, circumference."""
    return np.array([[-np.cos(phi), -np.sin(phi)], [-np.sin(phi), np.cos(phi)]])


def strip(C, s, force, load=None):
    """Exact elements of one strip on its rings, pressed at s or with loads on its rings."""
    planes = [VALUES["EI_L"], VALUES["EI_side"]], [VALUES["GA_L"]] * 2
    EI, GA = (np.tile(v, (N + 1, 1)) for v in planes)
    found = spatial_fem.solve(X, LENGTH, EI, np.tile(C, (N, 1, 1)), s, [force, 0.0], GA, load)
    names = "w_C", "w", "reaction", "end_shear"
    return {name: np.array(getattr(found, name), float) for name in names}


def by_elements(s, phi, rings):
    """Motion at contact 0 by a force at contact 1, and of the strip there, on far meridians.

    The force loads its own strip, the strip its rings; where those move the rings at the other
    meridian, the other strip lies on them.
    """
    ring, F = _ring(rings), [frame(v) for v in phi]
    own = [f @ ring(v, v) @ f.T for f, v in zip(F, phi, strict=True)]
    P = strip(own[1], s[1], 1.0)["reaction"]
    moved = P @ F[1] @ ring(*phi).T @ F[0].T
    found = strip(own[0], s[0], 0.0, moved @ np.linalg.inv(own[0]).T)
    return found["w_C"] @ F[0], found["w"] @ F[0]


@long
@pytest.mark.parametrize("rings", ["mat", "arch2"])
def test_opposite_and_equal_meridians_against_finite_elements(rings):
    """Both loads, each at the other's place; on one meridian on one strip."""
    s, phi = np.array([73.0, 80.0, 96.5]), np.array([-1.4, 1.5, 1.5])
    got = responses(s, phi, VALUES, rings=rings)
    size = got.compliance.max()
    for i, j in ((0, 1), (1, 0), (2, 0)):
        w, line = by_elements(s[[i, j]], phi[[i, j]], rings)
        np.testing.assert_allclose(got.contacts[j, i, i, 1:], w, rtol=0, atol=1e-12 * size)
        np.testing.assert_allclose(got.joints[j, i, :, 1:], line, rtol=0, atol=1e-11 * size)
    ring, F = _ring(rings), frame(1.5)
    line = strip(F @ ring(1.5, 1.5) @ F.T, s[2], 1.0)["w"]
    np.testing.assert_allclose(got.joints[2, 1, :, 1:], line @ F, rtol=0, atol=1e-12 * size)
    at_ring = np.searchsorted(X, s[1])
    assert X[at_ring] == s[1]  # there the second contact is the joint of the third's strip
    np.testing.assert_allclose(got.compliance[1, 2], line[at_ring, 0], rtol=0, atol=1e-12 * size)


def fields(C, at, fine):
    """Shear forces and moments at points of a strip, by statics; no end turns."""
    found = strip(C, at, 1.0)
    P, start = found["reaction"], found["end_shear"][0]
    beyond = np.maximum(fine - at, 0)[:, None] * [1.0, 0.0]
    M = beyond - fine[:, None] * start - np.maximum(fine[:, None] - X, 0) @ P
    middle = (fine[1:] + fine[:-1]) / 2
    V = (middle > at)[:, None] * [1.0, 0.0] - start - (middle[:, None] > X) @ P
    turn = np.diff(fine) @ ((M[1:] + M[:-1]) / 2)
    return P, V, M - turn / LENGTH


@long
def test_a_part_of_two_strips_in_common_by_their_moments():
    """Rings, and kappa times the energy of what both strips bear, all from exact elements."""
    s, phi, ring = np.array([73.0, 77.0, 120.0]), np.array([0.3, 0.4, -1.5]), _ring("arch2")
    C = responses(s, phi, VALUES).compliance
    fine, F = np.unique([0, LENGTH, *X, *s]), [frame(v) for v in phi]
    own = [f @ ring(v, v) @ f.T for f, v in zip(F, phi, strict=True)]
    (P, V, M), (P_2, V_2, M_2) = (fields(own[i], s[i], fine) for i in (0, 1))
    span, EI = np.diff(fine), [VALUES["EI_L"], VALUES["EI_side"]]
    ends = 2 * (M[1:] * M_2[1:] + M[:-1] * M_2[:-1]) + M[1:] * M_2[:-1] + M[:-1] * M_2[1:]
    shared = np.sum(span @ (ends / 6 / EI)) + np.sum(span @ (V * V_2 / VALUES["GA_L"]))
    by_rings = np.einsum("rp,pq,rq->", P, F[0] @ ring(*phi[:2]) @ F[1].T, P_2)
    kappa = 1 - 0.1 / STRIP
    np.testing.assert_allclose(C[0, 1], by_rings + kappa * shared, rtol=0, atol=1e-11 * C.max())


@long
def test_one_contact_is_the_skeleton_of_one():
    material = Material(**VALUES)
    more = {"axial": False, "shear": True}
    one = jax.device_get(jax.jit(lambda s, phi: skeleton_response(
        TUBE, material, s, phi, **more))(73.0, -1.4))  # fmt: skip
    got = responses(np.array([73.0, 80.0, 96.5]), np.array([-1.4, 1.5, 1.5]), VALUES)
    inward = np.array([0, -np.cos(1.4), np.sin(1.4)])
    np.testing.assert_allclose(got.contacts[0, 0, 0], one.compliance @ inward, rtol=0, atol=1e-12)
    np.testing.assert_allclose(got.turns[0, 0, 0], one.slope_C @ inward, rtol=0, atol=1e-12)
    for name in ("joints", "slopes"):
        v = getattr(one, name) @ inward
        np.testing.assert_allclose(getattr(got, name)[0, 0], v, rtol=0, atol=1e-12)
    for name in ("loads", "end_U", "end_V"):
        v = getattr(one, name) @ inward
        np.testing.assert_allclose(getattr(got, name)[0], v, rtol=0, atol=1e-12)


@long
def test_continuous_across_equal_meridians_and_the_ends_of_a_strip():
    """The largest step over 1e-4 rad is below 1e-3 of C."""
    for middle in (0.4, 0.4 + STRIP, 0.4 - STRIP):
        phi = middle + 1e-4 * np.arange(-4, 5)
        s = np.broadcast_to([73.0, 74.0, 110.0], (9, 3))
        C = np.array([
            responses(at, np.array([0.4, v, -1.2]), VALUES).compliance
            for at, v in zip(s, phi, strict=True)
        ])  # fmt: skip
        assert np.abs(np.diff(C, axis=0)).max() < 1e-3 * np.abs(C).max()


@long
def test_compliances_are_positive_semi_definite():
    """10,000 random sets, a third of them with contacts close to each other or on one place."""
    rng = np.random.default_rng(5)
    s, phi = rng.uniform(1, 159, (10_000, 3)), rng.uniform(-2.09, 2.09, (10_000, 3))
    phi[::3] = phi[::3, :1] + rng.uniform(-0.3, 0.3, (len(phi[::3]), 3))
    phi[::9, 1], s[::9, 1] = phi[::9, 0], s[::9, 0]
    phi = np.clip(phi, -2.09, 2.09)
    k, EI = 10 ** rng.uniform(-3, 2, 10_000), 10 ** rng.uniform(-1, 2, 10_000)

    @jax.jit
    @jax.vmap
    def many(s, phi, k, EI):
        material = Material(**(VALUES | {"k_M": k, "EI_L": EI}))
        found = influence_vector(TUBE, material, s, phi, rings="arch2", shear=True)
        return found.compliance

    C = np.asarray(many(s, phi, k, EI))
    size = np.sqrt(np.einsum("nii->ni", C))
    C = C / (size[:, :, None] * size[:, None])
    assert np.linalg.eigvalsh(C).min() > -1e-11
    np.testing.assert_array_equal(C, np.swapaxes(C, 1, 2))


S, PHI = np.array([75.0, 77.0, 73.0]), np.array([-1.5, 1.5, 0.0])
ALL = np.ones(3, bool)
#: A pinch with a tool in front: it waits 0.05 mm off the wall, presses, is lifted off.
ROWS = np.array([[2.0, 3.0, -0.05], [2.0, 3.0, 1.0], [1.0, 0.1, 4.0]])


@long
def test_a_pinch_brings_the_wall_against_a_tool_in_front():
    """Ring and strip balance the laws, and the front bulges towards the third tool."""
    found = pressed(S, PHI, ROWS, VALUES, ALL)
    inward = np.stack([0 * PHI, -np.cos(PHI), -np.sin(PHI)], -1)
    F = np.einsum("nmi,mi->nm", found.force, inward)
    np.testing.assert_allclose(found.force, F[..., None] * inward, atol=1e-15)
    C, d = np.asarray(found.compliance), np.asarray(found.depth)
    np.testing.assert_allclose(d + F @ C, ROWS, rtol=0, atol=1e-12)
    p = np.maximum(d, 0)
    np.testing.assert_allclose(F, 0.3 * p + 0.02 * p**3, rtol=0, atol=4e-4)  # rounded touch
    moved = np.einsum("nmi,mi->nm", found.skeleton, inward)
    np.testing.assert_allclose(moved, F @ C, rtol=0, atol=1e-12)
    assert found.status[0].tolist() == [OK, OK, OK]
    assert F[0, 2] > 0
    rest = found.loads.sum(axis=(1, 2)) - found.force.sum(axis=1)
    assert np.abs(rest).max() < 0.05 * F.max()  # what the clamps bear


@long
def test_the_order_of_tools_does_not_matter():
    order = np.array([2, 0, 1])
    a = pressed(S, PHI, ROWS, VALUES, ALL)
    b = pressed(S[order], PHI[order], ROWS[:, order], VALUES, ALL)
    np.testing.assert_allclose(b.force, a.force[:, order], rtol=0, atol=1e-12)
    np.testing.assert_allclose(b.joints, a.joints[:, order], rtol=0, atol=1e-12)
    np.testing.assert_allclose(b.end_U, a.end_U, rtol=0, atol=1e-12)


@long
def test_on_the_midline_it_is_press_contacts():
    D = np.array([[3.0, 1.0, 4.0], [4.0, 0.5, 0.1], [-1.0, 2.0, 0.0]])
    got = pressed(S, 0 * PHI, D, VALUES, ALL, rings="mat")
    values = {n: v for n, v in VALUES.items() if n not in ("EI_C", "k_t")}
    other = press_contacts(TUBE, Material(**values), S, D, Options(shear=True))
    np.testing.assert_allclose(-got.force[..., 1], other.force, rtol=0, atol=1e-13)
    np.testing.assert_allclose(-got.joints[:, 1, :, 1], other.joints, rtol=0, atol=1e-13)
    np.testing.assert_allclose(-got.loads.sum(1)[..., 1], other.reactions, rtol=0, atol=1e-13)
    np.testing.assert_array_equal(got.status, other.status)
    assert LIFTED in got.status


@long
def test_absent_and_refused_contacts():
    there = np.array([True, False, True])
    got = pressed(np.array([75.0, 900.0, 73.0]), np.array([-1.5, 3.0, 0.0]), ROWS, VALUES, there)
    other = pressed(S, PHI, ROWS, VALUES, there)
    np.testing.assert_array_equal(got.force, other.force)
    assert (got.status[:, 1] == NO_CONTACT).all()
    for s, phi, status in (
        (S, [-1.5, 2.2, 0.0], PressStatus.BEHIND_GAP),
        (S, [-1.5, np.nan, 0.0], PressStatus.NON_FINITE),
        ([75.0, 900.0, 73.0], PHI, PressStatus.OFF_TUBE),
    ):
        got = pressed(np.array(s), np.array(phi), ROWS, VALUES, ALL)
        assert (got.status == status).all()
        assert np.isnan(got.force).all()
        assert np.isnan(got.end_V).all()


def test_what_is_not_derived():
    for options, says in (
        (ObliqueOptions(Options(contact="bonded")), "found 'bonded': a tool that is glued"),
        (ObliqueOptions(rings="arch"), "needs rings='arch2' or 'mat'"),
        (ObliqueOptions(Options(coupling="total")), "press_contacts_oblique needs coupling"),
    ):
        with pytest.raises(ValueError, match=says):
            press_contacts_oblique(TUBE, Material(**VALUES), S, PHI, ROWS, options)
    with pytest.raises(ValueError, match="EI_C"):
        press_contacts_oblique(TUBE, SPRINGS, S, PHI, ROWS)
