"""Oblique presses: against a 3-D frame on ring springs, then symmetry, limits and gradients."""

import functools
import inspect
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jitted import jitted

from jaxtrachea.mechanics.friction import Coulomb
from jaxtrachea.mechanics.oblique import (
    ObliqueOptions,
    ObliquePress,
    place_at,
    press_oblique,
    press_path,
)
from jaxtrachea.mechanics.press import Options, press
from jaxtrachea.mechanics.ring import Ring, ring_compliance
from jaxtrachea.mechanics.skeleton import local_frame, skeleton_response
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.geometry import table_1
from jaxtrachea.trachea.material import Material

pytestmark = pytest.mark.compiling

ALPHA = 2 * math.pi / 3
VALUES = {"EI_L": 1.862, "k_M": 0.1, "k_1": 0.3, "k_3": 0.02, "EA_L": 3.9, "EI_C": 13.0, "k_t": 0.4}
MORE = {"k_A": 0.5, "k_B": 2.0, "EI_side": 5.0}
QUICK = {"xla_backend_optimization_level": 0}  # most of the time here is compilation
MOVES = np.array([[0.0, -1.0, 0.0], [0.3, -1.0, 0.5], [-2.0, 0.4, 1.0], [0.0, 0.0, 0.0]])
BONDED = Options(contact="bonded")
STUCK = ObliqueOptions(BONDED)


def material(dtype="float64", **changes):
    return Material(**{n: jnp.asarray(v, dtype) for n, v in (VALUES | changes).items()})


@functools.cache
def compiled(options, rings, axial):
    run = functools.partial(press_oblique, options=ObliqueOptions(options, rings, axial))
    return jax.jit(run, compiler_options=QUICK)


def pressed(
    s=63.0, phi=0.4, D=MOVES, options=BONDED, rings="arch2", axial=True, dtype="float64", **changes
) -> ObliquePress:
    args = (jnp.asarray(v, dtype) for v in (s, phi, D))
    run = compiled(options, rings, axial)
    return run(table_1(dtype=dtype), material(dtype, **changes), *args)


def turned(phi):
    """Columns x, y, z of inward normal, axial, circumferential: written apart from the code."""
    return np.array(
        [[0, -math.cos(phi), -math.sin(phi)], [1, 0, 0], [0, -math.sin(phi), math.cos(phi)]]
    )


def frame_fem(s_c, phi, force, v):
    """Nodes (x, y, z, dy/ds, dz/ds): bar and two Euler beams, ring springs as full 2x2 blocks."""
    x = 10.0 * np.arange(1, 16)
    nodes = np.unique(np.concatenate([[0.0, 160.0, s_c], x]))
    K = np.zeros((5 * nodes.size,) * 2)
    T = np.eye(5)
    T[1:3, 1:3] = T[3:, 3:] = turned(phi)[::2, 1:]  # local planes: normal, circumferential
    for e, h in enumerate(np.diff(nodes)):
        k = np.zeros((10, 10))
        k[np.ix_([0, 5], [0, 5])] = v["EA_L"] / h * np.array([[1, -1], [-1, 1]])
        for plane, EI in enumerate((v["EI_L"], v.get("EI_side", v["EI_L"]))):
            at = [1 + plane, 3 + plane, 6 + plane, 8 + plane]
            bend = [[12, 6 * h, -12, 6 * h], [6 * h, 4 * h * h, -6 * h, 2 * h * h]]
            bend += [[-12, -6 * h, 12, -6 * h], [6 * h, 2 * h * h, -6 * h, 4 * h * h]]
            k[np.ix_(at, at)] += EI / h**3 * np.array(bend)
        both = np.kron(np.eye(2), T)
        K[5 * e : 5 * e + 10, 5 * e : 5 * e + 10] += both.T @ k @ both
    ring = Ring(*(jnp.asarray(q) for q in (11.3, ALPHA, v["EI_C"], v["k_M"], v["k_t"])))
    spring = np.linalg.inv(np.asarray(ring_compliance(ring, jnp.asarray(phi))[0]))
    at = 5 * np.searchsorted(nodes, x)
    for i in at:
        K[i + 1 : i + 3, i + 1 : i + 3] += spring
    free = np.ones(K.shape[0], bool)
    for end, name in ((0, "k_A"), (K.shape[0] - 5, "k_B")):
        free[end : end + 5] = False
        if name in v:
            free[end], K[end, end] = True, K[end, end] + v[name]
    f = np.zeros(K.shape[0])
    at_C = 5 * np.searchsorted(nodes, s_c)
    f[at_C : at_C + 3] = force
    u = np.zeros_like(f)
    u[free] = np.linalg.solve(K[np.ix_(free, free)], f[free])
    joints = np.stack([u[i : i + 3] for i in at])
    slopes = np.stack([u[i + 3 : i + 5] for i in at])
    ends, loads = np.stack([u[:3], u[-5:-2]]), joints[:, 1:] @ spring.T
    return u[at_C : at_C + 3], u[at_C + 3 : at_C + 5], joints, slopes, loads, ends


@pytest.mark.slow
@pytest.mark.parametrize(
    ("s", "phi", "more"),
    [(60.0, -1.9, {}), (155.0, ALPHA, MORE)],
)
def test_against_frame(s, phi, more):
    """All parts of the skeleton at the solved force, and the local law in series with it."""
    got = pressed(s, phi, **more)
    for F, d, C_moved, slope_C, joints, slopes, loads, clamps, D in zip(
        got.force, got.depth, got.skeleton, got.slope_C, got.joints, got.slopes, got.loads,
        got.clamps, MOVES, strict=True,
    ):  # fmt: skip
        w_C, theta_C, w, theta, P, ends = frame_fem(s, phi, F, VALUES | more)
        scale = 1e-11 * (1e-3 + np.max(np.abs(w_C)))
        np.testing.assert_allclose(C_moved, w_C, atol=scale)
        np.testing.assert_allclose(slope_C, theta_C, atol=scale)
        np.testing.assert_allclose(joints, w, atol=scale)
        np.testing.assert_allclose(slopes, theta, atol=scale)
        np.testing.assert_allclose(loads[:, 1:], P, atol=scale)
        np.testing.assert_allclose(clamps, ends, atol=scale)
        np.testing.assert_allclose(d + C_moved, D, atol=1e-12)
        np.testing.assert_allclose(F, (0.3 + 0.02 * np.sum(d * d)) * d, atol=1e-13)


@pytest.mark.long
def test_axial_share_is_equal_along_each_side():
    """Paper fig. 7a: P^x the same at every joint of a side, F_A : F_B = L_BC : L_AC (eq. 2)."""
    got = pressed()
    P, F = np.asarray(got.loads[1, :, 0]), float(got.force[1, 0])
    np.testing.assert_allclose(P[:6], F * 97 / 160, rtol=1e-13)
    np.testing.assert_allclose(P[6:], F * 63 / 160, rtol=1e-13)
    d = np.asarray(got.joints[1, :, 0])
    np.testing.assert_allclose(np.diff(np.concatenate([[0], d[:6]])), d[0], rtol=1e-12)


@pytest.mark.long
@pytest.mark.parametrize("rings", ["mat", "arch", "arch2"])
def test_mirror(rings):
    """The press at -phi, mirrored in z, is the mirrored press: U and V change places."""
    flip = np.array([1.0, 1.0, -1.0])
    one, two = pressed(phi=0.7, rings=rings), pressed(phi=-0.7, D=MOVES * flip, rings=rings)
    for name in ("force", "depth", "skeleton", "joints", "loads"):
        mirrored = np.asarray(getattr(one, name)) * flip
        np.testing.assert_allclose(getattr(two, name), mirrored, atol=1e-12)
    np.testing.assert_allclose(two.end_U, np.asarray(one.end_V) * flip, atol=1e-12)


@pytest.mark.long
@pytest.mark.parametrize(
    "options", [Options(), Options(coupling="total", shear=True, local="two-material")], ids=repr
)
def test_normal_on_the_midline_is_press(options):
    """Same law, ligament, touch and rings: `press` to rounding, sideways nothing."""
    changes = {"GA_L": 1.1, "k_1_ring": 0.9} if options.shear else {}
    depth = np.array([-0.5, 0.0, 0.2, 1.0, 3.0])
    D = depth[:, None] * np.array([0.0, -1.0, 0.0])
    got = pressed(44.0, 0.0, D, options, "mat", dtype="float64", **changes)
    run = jitted(functools.partial(press, options=options), compiler_options=QUICK)
    s, d = np.asarray(44.0, "float64"), np.asarray(depth, "float64")
    one = run(table_1(dtype="float64"), material("float64", **changes), s, d)
    rtol = 100 * np.finfo("float64").eps

    def close(a, b):
        return np.testing.assert_allclose(a, b, atol=rtol * np.max(np.abs(b)), rtol=0)

    close(-got.force[:, 1], one.force)
    close(-got.depth[:, 1], one.depth)
    close(-got.joints[..., 1], one.joints)
    close(-got.loads[..., 1], one.reactions)
    np.testing.assert_array_equal(got.status, one.status)
    np.testing.assert_array_equal(got.force[:, 0], 0)
    assert got.force.dtype == "float64"


def test_reciprocity_and_ends():
    """C symmetric and positive; ring ends carry the mat's share, all of the load and no more."""
    run = jitted(functools.partial(skeleton_response), compiler_options=QUICK)
    for phi in (0.0, 0.9, -ALPHA):
        unit = run(table_1(), material(), np.asarray(63.0), np.asarray(phi))
        C = np.asarray(unit.compliance)
        np.testing.assert_allclose(C, C.T, rtol=1e-14)
        assert np.min(np.linalg.eigvalsh(C)) > 0
        carried = 0.05 * (np.asarray(unit.end_U) + np.asarray(unit.end_V))[:, 1:]
        np.testing.assert_allclose(carried, unit.loads[:, 1:], atol=1e-13)
    np.testing.assert_allclose(local_frame(jnp.asarray(0.9)), turned(0.9), atol=1e-15)


@pytest.mark.long
def test_mat_and_arch():
    """`mat`: 1 / k_M both ways, rings as one piece; `arch`: the stiffness along the normal."""
    mat, arch = pressed(rings="mat"), pressed(rings="arch")
    np.testing.assert_allclose(mat.loads[..., 1:], 0.1 * mat.joints[..., 1:], atol=1e-14)
    np.testing.assert_array_equal(mat.end_U, mat.joints)
    ring = Ring(*(jnp.asarray(q) for q in (11.3, ALPHA, 13.0, 0.1, 0.4)))
    n = np.array([math.cos(0.4), math.sin(0.4)])
    k = 1 / (n @ np.asarray(jitted(ring_compliance)(ring, np.asarray(0.4))[0]) @ n)
    np.testing.assert_allclose(arch.loads[..., 1:], k * arch.joints[..., 1:], atol=1e-14)


@pytest.mark.slow
@pytest.mark.compiling
def test_bonded_is_odd_and_unilateral_does_not_pull():
    one, two = pressed(), pressed(D=-MOVES)
    np.testing.assert_allclose(two.force, -one.force, atol=1e-14)
    inward, sideways, out = turned(0.4)[0], turned(0.4)[2], -turned(0.4)[0]
    rows = [inward + 0.1 * sideways, 0.01 * inward + 3 * sideways, out + sideways]
    D = np.stack([*rows, 0.01 * inward - 3 * sideways])
    got = pressed(D=D, options=Options())
    wanted = [PressStatus.OK, PressStatus.PULLS, PressStatus.NO_CONTACT]
    if float(got.force[1] @ inward) > 0:
        wanted[1] = PressStatus.OK
    np.testing.assert_array_equal(got.status[:3], wanted)
    np.testing.assert_array_equal(got.force[2], 0)
    assert PressStatus.PULLS in (got.status[1], got.status[3])
    np.testing.assert_allclose(got.force[0], pressed(D=D).force[0], rtol=1e-12)


@pytest.mark.slow
def test_path():
    """Sticking, a path is the bonded press; sliding, the force is on the cone, off the midline."""
    frame = turned(0.4)
    x = np.linspace(0, 2, 6)
    D = 0.8 * frame[0] + x[:, None] * (frame[1] + frame[2])
    run = functools.partial(press_path, table_1(), material(), jnp.asarray(63.0), jnp.asarray(0.4))
    quick = jax.jit(run, compiler_options=QUICK)
    stuck, slid = (quick(jnp.asarray(D), Coulomb(jnp.asarray(mu))) for mu in (1e3, 0.3))
    np.testing.assert_allclose(stuck.press.force, pressed(D=D).force, atol=1e-12)
    np.testing.assert_array_equal(stuck.slip, 0)
    local = np.asarray(slid.press.force) @ frame.T
    np.testing.assert_allclose(np.hypot(*local[1:, 1:].T), 0.3 * local[1:, 0], rtol=1e-11)
    total = slid.press.depth + slid.press.skeleton + slid.slip
    np.testing.assert_allclose(total, D, atol=1e-12)
    assert np.all(slid.dissipated >= 0)
    with pytest.raises(ValueError, match="unilateral"):
        run(jnp.asarray(D), Coulomb(jnp.asarray(0.3)), STUCK)


@pytest.mark.slow
def test_a_path_sticks_where_it_touches():
    """Straight from rest with an onset, mu = 1e3: the press of `press_oblique`, in any steps."""
    rows = 5
    D = (np.array([1.0, -1.6, -0.9]) * np.linspace(0, 1, rows + 1)[1:, None]).astype(float)
    at = table_1(), material(), 63.0, 0.4, jnp.asarray(D)
    options = ObliqueOptions()

    @functools.partial(jax.jit, compiler_options=QUICK)
    def run(onset):
        path = press_path(*at, Coulomb(jnp.asarray(1e3)), options, onset=onset)
        return path, press_oblique(*at, options, onset=onset)

    got, wanted = run(0.7)
    inward = D @ turned(0.4)[0]
    assert rows == 1 or 0 < np.sum(inward < 0.7) < rows - 1
    np.testing.assert_allclose(got.press.force, wanted.force, atol=1e-12)
    np.testing.assert_array_equal(got.press.status, wanted.status)
    np.testing.assert_allclose(got.dissipated, 0, atol=1e-15)
    start = D[-1] * 0.7 / inward[-1]
    along = start - (start @ turned(0.4)[0]) * turned(0.4)[0]
    for slip in np.asarray(got.slip)[inward > 0.7]:
        np.testing.assert_allclose(slip, along, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "keywords"),
    [
        ("EA_L", {"rings": "mat"}),
        ("EI_C", {"axial": False}),
        ("k_t", {"axial": False, "EI_C": 13.0}),
    ],
)
def test_missing_values_are_named(name, keywords):
    values = {n: VALUES[n] for n in ("EI_L", "k_M", "k_1", "k_3")}
    values |= {n: keywords.pop(n) for n in ("EI_C",) if n in keywords}
    zero = np.zeros(())
    with pytest.raises(ValueError, match=name):
        jax.eval_shape(
            lambda: press_oblique(
                table_1(), Material(**values), zero, zero, jnp.zeros(3), ObliqueOptions(**keywords)
            )
        )


def test_wrong_options_are_named():
    with pytest.raises(ValueError, match="split"):
        ObliqueOptions(Options(split="independent"))
    with pytest.raises((ValueError, TypeError), match="arch3"):  # TypeError: the shape checks
        ObliqueOptions(rings="arch3")  # pyright: ignore


def test_records_of_another_class_are_named():
    """Without the suite's type checks, as a user calls them."""
    call, tube = inspect.unwrap, table_1()
    with pytest.raises(ValueError, match=r"options is Options.*expected ObliqueOptions"):
        call(place_at)(tube, material(), 63.0, 0.4, Options())
    with pytest.raises(ValueError, match=r"friction is 0.66; expected Coulomb"):
        call(press_path)(tube, material(), 63.0, 0.4, MOVES, 0.66)
    wrong = object.__new__(ObliqueOptions)
    for name, value in {"press": STUCK, "rings": "mat", "axial": True}.items():
        object.__setattr__(wrong, name, value)
    with pytest.raises(ValueError, match=r"press is ObliqueOptions.*expected Options"):
        wrong.__post_init__()


@pytest.mark.long
def test_unused_effects_are_not_in_the_program():
    """Without stretch, and on the mat, the compiled program has fewer operations."""
    args = table_1(), material(), np.asarray(63.0), np.asarray(0.4), np.asarray(MOVES)

    def operations(**keywords):
        options = ObliqueOptions(BONDED, **keywords)
        run = jax.jit(functools.partial(press_oblique, options=options))
        return run.lower(*args).as_text().count(" = ")

    full = operations()
    assert operations(axial=False) < full
    assert operations(rings="mat") < operations(rings="arch2") - 100


def _values(v):
    m = Material(**{n: v[n] for n in (*VALUES, *MORE)})
    got = press_oblique(table_1(dtype=v["s"].dtype), m, v["s"], v["phi"], v["D"], STUCK)
    return jnp.concatenate([q.ravel() for q in got[:-1]])


# A random combination of all results: one reverse pass instead of one for each (compilation).
weights = np.random.default_rng(0).normal(size=10_000)
forward_of = jitted(jax.jacfwd(_values), compiler_options=QUICK)
reverse_of = jitted(jax.grad(lambda v, w: jnp.dot(w, _values(v))), compiler_options=QUICK)
value_of = jitted(_values, compiler_options=QUICK)


@pytest.mark.slow
def test_gradients_at_rest():
    """Forward = reverse = central differences through the whole, without displacement."""
    point = VALUES | MORE | {"s": 63.0, "phi": 0.4, "D": np.zeros(3)}
    here = {n: jnp.asarray(v, "float64") for n, v in point.items()}
    forward = forward_of(here)
    w = weights[: forward["s"].shape[0]]
    reverse = reverse_of(here, jnp.asarray(w, "float64"))
    for name, v in point.items():
        ahead, back = (np.asarray(of[name], float) for of in (forward, reverse))
        size = np.max(np.abs(ahead)) + 1e-9
        combined = np.tensordot(w, ahead, 1)
        close = 5e3 * np.finfo("float64").eps * size * np.linalg.norm(w)
        np.testing.assert_allclose(combined, back, atol=close, rtol=0)
        direction = np.ones(np.shape(v))
        step = 1e-5 * max(1.0, float(np.max(np.abs(v))))
        up, down = (
            value_of(
                {
                    n: jnp.asarray(p, "float64")
                    for n, p in (point | {name: v + e * direction}).items()
                }
            )
            for e in (step, -step)
        )
        along = np.tensordot(ahead, direction, np.ndim(v))
        close = max(1e4 * np.finfo("float64").eps, 3e-7) * size
        np.testing.assert_allclose(along, (up - down) / (2 * step), atol=close, rtol=0)


@pytest.mark.long
@pytest.mark.parametrize("rings", ["mat", "arch", "arch2"])
def test_numbers_of_python_are_of_the_tubes_type(rings):
    """Level `mat` made numbers of the material float64, which ended in a fault of a loop."""
    numbers = Material(EI_L=1.862, k_M=0.1, k_1=0.3, k_3=0.02, EI_C=100.0, k_t=2.0)
    options = ObliqueOptions(rings=rings, axial=False)
    found = jax.eval_shape(
        lambda: press_oblique(table_1(jnp.float32), numbers, 75.0, 0.3, [0.0, -1.0, -0.3], options)
    )
    assert {v.dtype for v in found[:-1]} == {jnp.dtype("float32")}
