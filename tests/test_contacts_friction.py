"""Friction of several tools that feel each other: closed forms, Coulomb's conditions, one tool."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_scenes import MATERIAL, TUBE

from jaxtrachea import Coulomb, Material, ObliqueOptions, press_contacts_path, press_path
from jaxtrachea.mechanics.contacts import solve
from jaxtrachea.mechanics.contacts_friction import slide_paths
from jaxtrachea.mechanics.force_law import Law
from jaxtrachea.mechanics.friction import slide_path
from jaxtrachea.mechanics.influence_vector import influence_vector
from jaxtrachea.mechanics.skeleton import local_frame, skeleton_response
from jaxtrachea.status import PressStatus

pytestmark = pytest.mark.compiling

OK, NO_CONTACT, LIFTED = PressStatus.OK, PressStatus.NO_CONTACT, PressStatus.LIFTED


@functools.cache
def program(of=slide_paths):
    """Quick to compile: that takes most of the time here."""

    def run(D, C, k_1, k_3, mu):
        return of(D, C, Law(k_1, k_3), Coulomb(mu))

    return jax.jit(run, compiler_options={"xla_backend_optimization_level": 0})


def follow(D, C, k_1, k_3, mu, *, of=slide_paths):
    return jax.device_get(program(of)(*map(jnp.asarray, (D, C, k_1, k_3, mu))))


@functools.cache
def drawn(m, seed=0, steps=8):
    """A skeleton that couples everything, and tools that wander in and out of contact."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(3 * m, 3 * m))
    C = (root @ root.T * (2 / (3 * m))).reshape(m, 3, m, 3)
    D = np.cumsum(rng.normal(size=(steps, m, 3)) / 2, axis=0) + [1, 0, 0]
    return D, C, rng.uniform(0.1, 2, m), rng.uniform(0, 1, m), rng.uniform(0, 1, m)


def missed(found, D, C, mu):
    """How far a path is from the conditions: balance, friction cone, gaps; work gained."""
    F, d = found.force, found.depth
    moved = np.einsum("iajb,tjb->tia", C, F)
    slip = np.concatenate([np.zeros_like(found.slip[..., :1]), found.slip], -1)
    touches = F[..., 0] > 0
    balance = np.abs(d + moved + slip - D)[touches].max()
    cone = (np.linalg.norm(F[..., 1:], axis=-1) - mu * F[..., 0]).max()
    closed = (D - moved)[..., 0][~touches].max(initial=0)
    return balance, cone, closed, -found.dissipated.min(), -F[..., 0].min()


@pytest.mark.long
def test_two_tools_stick_together_and_one_slides():
    """Held fast both are springs in series with the skeleton; the one without friction slides."""
    _, C, *_ = drawn(2)
    k, D = np.array([0.5, 0.8]), np.array([[[1, 0, 0], [1, 0, 0]], [[1, 0.3, 0.1], [1, -0.2, 0.0]]])
    held = follow(D, C, k, 0 * k, np.array([50.0, 50.0]))
    series = C.reshape(6, 6) + np.diag(np.repeat(1 / k, 3))
    # From a press straight in, which slides nowhere, on: all ways count.
    true = np.linalg.solve(series, D.reshape(2, 6).T).T.reshape(2, 2, 3)
    np.testing.assert_allclose(held.force, true, rtol=0, atol=1e-13)
    assert not held.sliding.any()
    np.testing.assert_allclose(held.slip, 0, atol=1e-13)
    free = follow(D, C, k, 0 * k, np.array([50.0, 0.0]))
    keep = [0, 1, 2, 3]  # the second tool presses along its normal alone
    true = np.linalg.solve(series[np.ix_(keep, keep)], D.reshape(2, 6)[:, keep].T).T
    np.testing.assert_allclose(free.force.reshape(2, 6)[:, keep], true, rtol=0, atol=1e-13)
    np.testing.assert_allclose(free.force[:, 1, 1:], 0, atol=1e-13)
    assert free.sliding[1].tolist() == [False, True]


@pytest.mark.long
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_coulombs_conditions_hold(dtype):
    """100 paths of four tools: balance, cone, no pull, no gap closed, no work gained."""
    cases = [drawn(4, seed) for seed in range(100)]
    given = [np.stack(v).astype(dtype) for v in zip(*cases, strict=True)]
    run = jax.jit(jax.vmap(lambda D, C, a, b, mu: slide_paths(D, C, Law(a, b), Coulomb(mu))))
    found = jax.device_get(run(*given))
    assert found.force.dtype == dtype
    assert set(np.unique(found.status)) == {OK, NO_CONTACT, LIFTED}
    assert found.sliding.mean() > 0.3
    assert (found.status == LIFTED).mean() > 0.02
    most = 1e-12 if dtype == "float64" else 2e-4
    for i, (D, C, _, _, mu) in enumerate(cases):
        assert max(missed(jax.tree.map(lambda v, i=i: v[i], found), D, C, mu)) < most
    # Whatever order the tools stand in.
    turned = [
        v[:, :, ::-1] if v.ndim == 4 else v[:, ::-1] if v.ndim == 2 else v[:, ::-1, :, ::-1]
        for v in given
    ]
    again = jax.device_get(run(*turned)).force[:, :, ::-1]
    np.testing.assert_allclose(again, found.force, rtol=0, atol=20 * most)


@pytest.mark.long
def test_one_tool_is_the_path_of_one():
    D, C, *rest = drawn(1)
    many = follow(D, C, *rest)
    one = follow(D[:, 0], C[0, :, 0], *(v[0] for v in rest), of=slide_path)
    for name in ("force", "depth", "slip", "dissipated"):
        np.testing.assert_allclose(getattr(many, name)[:, 0], getattr(one, name), atol=1e-13)
    assert (many.status[:, 0] == one.status).all()


@pytest.mark.long
def test_without_friction_it_is_the_balance_of_normal_forces():
    D, C, k_1, k_3, _ = drawn(4)
    found = follow(D, C, k_1, k_3, np.zeros(4))
    normal, law = jnp.asarray(C[:, 0, :, 0]), Law(*map(jnp.asarray, (k_1, k_3)))
    run = jax.jit(lambda D: solve(D, normal, law, width=jnp.asarray(1e-12)))
    for force, way in zip(found.force, D, strict=True):
        true = run(jnp.asarray(way[:, 0])).force
        np.testing.assert_allclose(force[:, 0], true, rtol=0, atol=1e-10)
    np.testing.assert_array_equal(found.force[..., 1:], 0)


@pytest.mark.long
def test_what_has_no_solution_goes_on_from_before():
    """A pose that is no number, and a law that softens past its fold."""
    D, C, k_1, k_3, mu = drawn(4)
    lost = np.insert(D, 3, np.nan, axis=0)
    lost[3, 1:] = 0
    found, true = follow(lost, C, k_1, k_3, mu), follow(D, C, k_1, k_3, mu)
    assert (found.status[3] == PressStatus.NON_FINITE).all()
    assert np.isnan(found.force[3]).all()
    np.testing.assert_allclose(np.delete(found.force, 3, axis=0), true.force, atol=1e-12)
    soft = follow(D + [20, 0, 0], C, k_1, np.array([-0.1, 0, 0, 0]), mu)
    assert (soft.status == PressStatus.PAST_FOLD).all()
    assert np.isnan(soft.force).all()


@pytest.mark.long
def test_gradients_are_those_of_differences():
    given = drawn(3)
    rng = np.random.default_rng(1)
    weights = rng.normal(size=(8, 3, 3))

    def value(D, root, *rest):
        C = (root + jnp.transpose(root, (2, 3, 0, 1))) / 2
        out = slide_paths(D, C, Law(*rest[:2]), Coulomb(rest[2]))
        return jnp.sum(out.force * weights) + jnp.sum(out.slip**2) + jnp.sum(out.dissipated)

    run, slopes = jax.jit(value), jax.jit(jax.grad(value, range(5)))
    ways = [rng.normal(size=np.shape(v)) for v in given]
    by = sum(np.sum(a * b) for a, b in zip(slopes(*given), ways, strict=True))

    def at(h):
        return float(run(*(v + h * w for v, w in zip(given, ways, strict=True))))

    assert abs(by - (at(1e-6) - at(-1e-6)) / 2e-6) < 1e-6 * abs(by)
    forward = jax.jit(lambda *t: jax.jvp(value, given, t)[1])(*ways)
    np.testing.assert_allclose(forward, by, rtol=1e-10)


#: The tube may move along at its ends.
SPRUNG = dataclasses.replace(MATERIAL, k_A=jnp.asarray(0.3), k_B=jnp.asarray(0.7))
S, PHI = np.array([60.0, 64.0, 110.0]), np.array([0.2, 0.25, -1.0])


@functools.cache
def unit(s=tuple(S), phi=tuple(PHI)):
    run = jax.jit(influence_vector, static_argnames=("rings", "shear", "tangential", "axial"))
    levels = {"rings": "arch2", "shear": False, "tangential": True, "axial": True}
    return jax.device_get(run(TUBE, SPRUNG, jnp.asarray(s), jnp.asarray(phi), **levels))


@pytest.mark.long
def test_every_contact_alone_moves_as_one():
    got = unit()
    for j, (s, phi) in enumerate(zip(S, PHI, strict=True)):
        alone = jax.device_get(jax.jit(skeleton_response)(TUBE, SPRUNG, s, phi))
        frame = np.asarray(local_frame(jnp.asarray(phi)))
        own = slice(3 * j, 3 * j + 3)
        true = frame @ alone.compliance @ frame.T
        np.testing.assert_allclose(got.compliance[own, own], true, rtol=0, atol=1e-12)
        for name, found in (
            ("joints", got.joints[own, j]),
            ("slopes", got.slopes[own, j]),
            ("loads", got.loads[own]),
            ("end_U", got.end_U[own]),
            ("clamps", got.clamps[own]),
        ):
            by_force = np.moveaxis(getattr(alone, name) @ frame.T, -1, 0)
            np.testing.assert_allclose(found, by_force, rtol=0, atol=1e-12, err_msg=name)
    np.testing.assert_array_equal(got.compliance, got.compliance.T)


def chain(s, j, EA, springs, at):
    """Motion at places of a chain of bars, fixed by springs, with a unit force at s_j."""
    nodes = np.unique(np.concatenate([[0, float(TUBE.length)], TUBE.ring_positions, [s[j]]]))
    K = np.zeros((len(nodes),) * 2)
    for i, h in enumerate(np.diff(nodes)):
        K[i : i + 2, i : i + 2] += EA / h * np.array([[1, -1], [-1, 1]])
    K[0, 0] += springs[0]
    K[-1, -1] += springs[1]
    u = np.linalg.solve(K, (nodes == s[j]).astype(float))
    whole = np.interp(at, nodes, u)
    rings = np.concatenate([[0, float(TUBE.length)], TUBE.ring_positions])
    rings.sort()
    return whole, np.interp(at, rings, np.interp(rings, nodes, u))


@pytest.mark.long
def test_a_pull_along_the_tube_is_that_of_a_chain_of_bars():
    """On one meridian as the chain itself; elsewhere as the rings, which move as a whole."""
    springs, EA = (0.3, 0.7), float(SPRUNG.EA_L)
    for phi, pick in ((tuple([0.3] * 3), 0), ((0.3, 1.0, -0.8), 1)):
        got = unit(phi=phi).compliance.reshape(3, 3, 3, 3)[:, 1, :, 1]
        for j in range(3):
            true = chain(S, j, EA, springs, S)[pick]
            true[j] = chain(S, j, EA, springs, S)[0][j]
            np.testing.assert_allclose(got[:, j], true, rtol=0, atol=1e-9)


@pytest.mark.long
def test_no_forces_gain_energy_and_none_jump_between_meridians():
    rng = np.random.default_rng(2)
    run = jax.jit(jax.vmap(lambda s, phi: influence_vector(
        TUBE, SPRUNG, s, phi, rings="arch2", shear=False, tangential=True, axial=True
    ).compliance))  # fmt: skip
    s, phi = rng.uniform(0, float(TUBE.length), (10_000, 4)), rng.uniform(-1.9, 1.9, (10_000, 4))
    s[::3, 1], phi[::2, 1] = s[::3, 0], phi[::2, 0] + rng.choice([0, 1e-4, 0.1], 5_000)
    C = np.asarray(run(s, phi))
    least = np.linalg.eigvalsh(C)
    assert (least[:, 0] > -1e-12 * least[:, -1]).all()
    near = np.asarray(run(s[:1] + np.zeros((3, 1)), np.array([0.3, 0.3, 0, 0]) + [
        [0, h, 0, 0] for h in (0, 1e-4, 2e-4)]))  # fmt: skip
    assert np.abs(np.diff(near, axis=0)).max() < 1e-3 * np.abs(near).max()


WAY = np.array([[0, -1, 0], [0, -2, 0], [0.5, -2, 0], [1.5, -2.2, 0.3], [0, -1, 0.2], [0, 1, 0]])


@pytest.mark.long
def test_one_tool_on_the_tube_is_press_path():
    path = jax.jit(press_path, static_argnames="options")(
        TUBE, MATERIAL, 63.0, 0.2, WAY, Coulomb(0.4)
    )
    run = jax.jit(press_contacts_path, static_argnames="options")
    many = run(TUBE, MATERIAL, [63.0], [0.2], WAY[:, None], Coulomb(0.4))
    for name in ("force", "depth", "skeleton", "joints"):
        np.testing.assert_allclose(
            getattr(many, name)[:, 0], getattr(path.press, name), rtol=0, atol=1e-13, err_msg=name
        )
    np.testing.assert_allclose(many.slip[:, 0], path.slip, rtol=0, atol=1e-13)
    np.testing.assert_allclose(many.end_U, path.press.end_U, rtol=0, atol=1e-13)
    assert (np.asarray(many.status)[:, 0] == path.press.status).all()
    assert np.asarray(many.sliding).any()
    for mu, place, status in (
        (-1.0, 63.0, PressStatus.BAD_MATERIAL), (np.nan, 63.0, PressStatus.NON_FINITE),
        (0.4, -1.0, PressStatus.OFF_TUBE),
    ):  # fmt: skip
        bad = run(TUBE, MATERIAL, [place], [0.2], WAY[:, None], Coulomb(mu))
        assert (np.asarray(bad.status) == status).all()
        assert np.isnan(bad.force).all()


@pytest.mark.long
def test_every_input_has_its_derivative():
    """Of `press_contacts_path`: places, stiffnesses, friction and tube; lanes and float32."""
    way = np.stack([WAY, WAY * [-1, 0.8, -1]], axis=1)
    weights = np.random.default_rng(3).normal(size=way.shape)
    places, mu = [63.0, 71.0, 0.2, -0.4], [0.4, 0.3]
    x = np.array([*places, *mu, 1.86, 3.9, 13.0, 0.1, 0.4, 0.3, 0.02, 0.3, 0.7, 11.3])

    def value(x):
        names = "EI_L", "EA_L", "EI_C", "k_M", "k_t", "k_1", "k_3", "k_A", "k_B"
        tube = dataclasses.replace(TUBE, radius=x[15])
        tube = jax.tree.map(lambda v: v.astype(x.dtype), tube)
        material = Material(**dict(zip(names, x[6:15], strict=True)))
        D = jnp.asarray(way, x.dtype)
        out = press_contacts_path(tube, material, x[:2], x[2:4], D, Coulomb(x[4:6]))
        return jnp.sum(out.force * weights.astype(x.dtype)) + jnp.sum(out.slip[-1])

    run, slopes = jax.jit(jax.vmap(value)), jax.jit(jax.grad(value))
    by = np.asarray(slopes(x))
    h = np.eye(16) * 1e-6 * np.maximum(np.abs(x), 0.1)
    true = (np.asarray(run(x + h)) - np.asarray(run(x - h))) / (2 * np.diag(h))
    size = np.maximum(np.abs(x), 0.1)
    most = 1e-6 * np.abs(true * size).max()
    np.testing.assert_allclose(by * size, true * size, rtol=0, atol=most)
    single = np.asarray(run((x + h).astype(np.float32)))
    np.testing.assert_allclose(single, run(x + h), rtol=2e-4)


def test_what_does_not_fit_is_told():
    for args, friction, words in (
        (([], [], WAY[:, None]), Coulomb(0.4), "s_c has 0 contacts"),
        (([60, 70], [0.1], WAY[:, None]), Coulomb(0.4), "phi_c has 1 value; expected 2"),
        (([60, 70], [0.1, 0], WAY), Coulomb(0.4), "displacement has shape"),
        (
            ([60, 70], [0.1, 0], WAY[:, None][:, [0, 0]]),
            Coulomb([0.4] * 3),
            "friction has 3 values; expected 2",
        ),
    ):
        with pytest.raises(ValueError, match=words):
            press_contacts_path(TUBE, MATERIAL, *args, friction)
    options = ObliqueOptions(rings="arch")
    with pytest.raises(ValueError, match="press_contacts_path needs rings='arch2' or 'mat'"):
        press_contacts_path(TUBE, MATERIAL, [60], [0.1], WAY[:, None], Coulomb(0.4), options)
