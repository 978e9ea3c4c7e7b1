"""Rows off the tube or of negative stiffness: a status of their own, no touch to the others.

Statuses and gradients are checked against presses of the good rows alone, values of refused ones
against NaN; nothing here is a number of the code's own.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from admitted import FULL
from late import late

from jaxtrachea.mechanics.friction import Coulomb
from jaxtrachea.mechanics.levels.level import Motion
from jaxtrachea.mechanics.oblique import ObliqueOptions, press_oblique, press_path
from jaxtrachea.mechanics.press import Options, press
from jaxtrachea.mechanics.press_contacts import press_contacts
from jaxtrachea.mechanics.press_in_time import press_in_time
from jaxtrachea.mechanics.skeleton import skeleton_response
from jaxtrachea.relaxation.filter import Relaxation
from jaxtrachea.relaxation.steps import Branches
from jaxtrachea.scene.assemble import make_scene
from jaxtrachea.scene.effects import EffectOptions
from jaxtrachea.scene.simulation import simulate
from jaxtrachea.scene.stage import Presses
from jaxtrachea.scene.sweep import sweep
from jaxtrachea.status import PressStatus, RingStatus
from jaxtrachea.trachea.geometry import table_1
from jaxtrachea.trachea.material import Material

#: What these models divide by.
NEVER_ZERO = {
    "press": ("EI_L", "GA_L"),
    "skeleton": ("EI_L", "EI_side", "k_M", "GA_L", "GA_side", "EI_C", "EA_L"),
}

pytestmark = pytest.mark.compiling

OK, OFF, BAD = PressStatus.OK, PressStatus.OFF_TUBE, PressStatus.BAD_MATERIAL


@functools.cache
def compiled(which):
    """Presses of one kind: status, force and compliance; arguments material and s_c."""
    g, inward = table_1(), np.array([0.0, -1.0, 0.0])
    more = {"local": "two-material", "shear": True}

    def one(values, s):
        m = Material(**{n: v for n, v in values.items() if n != "friction"})
        if which == "press":
            out = press(g, m, s, [0.0, 1.0, 3.0], Options(**more))
            return out.status, out.force, out.compliance
        if which == "oblique":
            out = press_oblique(g, m, s, 0.3, inward, ObliqueOptions(Options(**more)))
            return out.status, out.force, out.joints
        if which == "path":
            mu = Coulomb(values["friction"])
            out = press_path(g, m, s, 0.3, np.stack([inward, 2 * inward]), mu)
            return out.press.status, out.press.force, out.slip
        out = skeleton_response(g, m, s, 0.3, shear=True)
        return out.status, out.compliance, out.loads

    def summed(values, s):
        status, force, more = one(values, s)
        return jnp.sum(jnp.where(jnp.isfinite(force), force, 0)), (status, force, more)

    return jax.jit(jax.vmap(jax.value_and_grad(summed, (0, 1), has_aux=True), (0, 0)))


ALL = FULL | {"GA_L": 1.1, "k_1_ring": 0.9, "EI_side": 1.5, "GA_side": 1.3, "k_A": 1.0, "k_B": 2.0}
ALL["friction"] = 0.5
READ = {
    "press": ("EI_L", "k_M", "k_1", "GA_L", "k_1_ring"),
    "oblique": ("EI_L", "EI_side", "k_M", "k_1", "GA_L", "GA_side", "k_1_ring", "EI_C", "k_t",
                "EA_L", "k_A", "k_B"),
    "path": ("EI_L", "EI_side", "k_M", "k_1", "EI_C", "k_t", "EA_L", "k_A", "k_B",
             "friction"),
    "skeleton": ("EI_L", "EI_side", "k_M", "GA_L", "GA_side", "EI_C", "k_t", "EA_L", "k_A", "k_B"),
}  # fmt: skip


@pytest.mark.parametrize("which", ["press", *late("skeleton")])
def test_statuses_in_a_batch(which):
    """Off the tube and each negative stiffness in turn: NaN with a status of their own.

    So are those of zero that the model divides by; others of zero are solved.

    Good rows keep every bit, and all derivatives are finite: those of refused rows are 0. Values
    that the model does not read, and k_3, may be negative.
    """
    read, never = READ[which], NEVER_ZERO[which]
    zero = [*never, *(n for n in read if n not in never)]
    rows = [{}, *({n: -0.1} for n in read), *({n: 0.0} for n in zero), {"k_3": -1e-4}, {}, {}, {}]
    s = np.array([63.0] * (len(rows) - 3) + [-1e-9, 160.0001, 400.0])
    bad, good = len(read) + len(never), len(read) - len(never)
    refused = np.array([0, *[1] * bad, *[0] * good, 0, 1, 1, 1], bool)
    wanted = ["OK", *["BAD_MATERIAL"] * bad, *["OK"] * (good + 1), *["OFF_TUBE"] * 3]
    values = {n: np.array([row.get(n, v) for row in rows]) for n, v in ALL.items()}
    (_, (status, force, more)), slopes = compiled(which)(values, s)
    names = RingStatus if which == "skeleton" else PressStatus
    last = np.asarray(status).reshape(len(rows), -1)[:, -1]
    assert [names(int(k)).name for k in last] == wanted
    for out in (force, more):
        lost = ~np.isfinite(np.asarray(out)).reshape(len(rows), -1)
        np.testing.assert_array_equal(lost.all(axis=1), refused)
        np.testing.assert_array_equal(lost.any(axis=1), refused)
    for slope in jax.tree.leaves(slopes):
        assert np.all(np.isfinite(slope))
        assert np.all(slope[refused] == 0)
    alone = {n: np.repeat(v[:1], len(rows)) for n, v in values.items()}
    (_, (_, same, _)), others = compiled(which)(alone, np.full(len(rows), 63.0))
    np.testing.assert_array_equal(force[0], same[0])
    for a, b in zip(jax.tree.leaves(slopes), jax.tree.leaves(others), strict=True):
        np.testing.assert_array_equal(a[0], b[0])


def test_zero_limits():
    """A cut span, its stiffness to 0; no rings, k_M = 0: a beam between two clamps; both ends."""
    run = jax.jit(jax.vmap(lambda EI, k, s: press(table_1(), Material(EI, k, 0.3, 0.02), s, 1.0)))
    EI = np.full((4, 16), 1.862)
    EI[0, 3] = 1e-9
    out = run(EI, np.array([0.1, 0.0, 0.1, 0.1]), np.array([63.0, 80.0, 0.0, 160.0]))
    assert out.status.tolist() == [OK] * 4
    np.testing.assert_allclose(out.compliance[1:], [160.0**3 / (192 * 1.862), 0, 0], rtol=1e-12)


@pytest.mark.slow
def test_friction_that_is_no_number():
    """Without limit the tool sticks; negative is a bad material, as a stiffness is."""
    D = np.linspace(0, 1, 3)[:, None] * np.array([0.1, -1.0, 0.0])
    for mu, status in ((np.nan, PressStatus.NON_FINITE), (-0.1, BAD), (np.inf, OK)):
        found = press_path(table_1(), Material(**FULL), 40.0, 0.0, D, Coulomb(mu))
        assert found.press.status[-1] == status
        assert np.isfinite(found.press.force[-1]).all() == (status == OK)
        assert not found.sliding.any()


@pytest.mark.slow
def test_scenes_and_sweeps():
    """Rows off the tube, a negative stiffness or friction: their own status; the others keep it."""
    g, m = table_1(), Material(**FULL)
    path = Presses([40.0, 400.0, -1.0], [0.0] * 3, [[0, -1, 0]] * 3)
    none = {"want_surface": False, "want_joints": False, "want_ring_ends": False}
    run, swept_by = jax.jit(simulate), jax.jit(sweep)
    for effects in (
        EffectOptions(contact_point="per_step", **none),
        EffectOptions(contact_point="per_step", second_plane="on", **none),
    ):
        scene = make_scene(g, m, path, effects=effects)
        out = run(scene, m, path)
        assert out.status.tolist() == [OK, OFF, OFF]
        np.testing.assert_array_equal(np.isnan(out.force[:, 1]), [False, True, True])
        out = run(scene, Material(**FULL | {"k_M": -0.1}), path)
        assert out.status.tolist() == [BAD] * 3
        assert np.isnan(out.force[:, 1]).all()
    points = np.array([[40.0, 200, 50], [0, 0, 0], [1, 1, 1]])
    swept = swept_by(scene, m, *points)
    assert swept.status.tolist() == [OK, OFF, OK]
    assert np.isnan(swept.compliance).tolist() == [False, True, False]
    swept = swept_by(scene, Material(**FULL | {"k_1": -0.1}), *points)
    assert swept.status.tolist() == [BAD] * 3


def test_a_status_with_a_solution_says_so():
    """As its message does; no contact is a solution, too."""
    for status in PressStatus:
        assert status.solved == (status.message.startswith("solved") or status == 1), status


@pytest.mark.long
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_wall_beyond_the_axis_is_told(dtype):
    """The wall moves by what the tool presses beyond first touch: TOO_DEEP past the radius, solved.

    Along the normal, by a vector, along a path, at two places, in time. Another row is not touched,
    nor is a pull that finds no contact.
    """
    material = Material(EI_L=1.862, EI_C=13.07, EA_L=3.9, k_M=0.1, k_t=0.4, k_1=0.3, k_3=0.02)
    g, material = jax.tree.map(lambda v: jnp.asarray(v, dtype), (table_1(), material))
    onset = dtype(1.5)
    depth = np.array([1.0, 0.999 * 11.3 + 1.5, 1.001 * 11.3 + 1.5, 100.0, -30.0], dtype)
    told = [PressStatus.NO_CONTACT, OK, *[PressStatus.TOO_DEEP] * 2, PressStatus.NO_CONTACT]
    vector = depth[:, None] * np.array([0, -1, 0], dtype)
    relaxes = Relaxation(Branches(*np.array([[0.5], [1.0]], dtype)))
    motion = Motion(dtype(60), depth, onset=onset, time=np.arange(5, dtype=dtype))

    @jax.jit
    def all_of_them(D, v):
        one = press(g, material, dtype(60), D, onset=onset)
        oblique = press_oblique(g, material, dtype(60), dtype(0), v, onset=onset)
        path = press_path(g, material, dtype(60), dtype(0), v, Coulomb(dtype(0.5)), onset=onset)
        pair = jnp.stack([D, jnp.full_like(D, 2)], axis=1)
        two = press_contacts(
            g, material, np.array([20, 120], dtype), pair, onset=jnp.stack([onset, onset])
        )
        timed = press_in_time(g, material, motion, relaxes, Options(relaxation="uniform"))
        found = one.status, oblique.status, path.press.status, two.status[:, 0], timed.status
        return found, two.status[:, 1], one.force

    found, other, force = all_of_them(depth, vector)
    for status in found:
        np.testing.assert_array_equal(status, told)
    np.testing.assert_array_equal(other, [OK] * 5)
    assert np.isfinite(force).all()
