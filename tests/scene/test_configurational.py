"""The force of a tool whose contact point wanders does the work that the wall stores."""

import dataclasses
import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_scenes import BALL, BARE, MATERIAL, OUTER, TUBE, ball
from tool_ways import closed_loop, placed, turn

from jaxtrachea import Poses, Session, make_scene, press_oblique, simulate
from jaxtrachea.contact.shapes import capsule
from jaxtrachea.mechanics.energy import Gradient
from jaxtrachea.mechanics.oblique import ObliqueOptions
from jaxtrachea.mechanics.skeleton import local_frame
from jaxtrachea.scene import configurational
from jaxtrachea.scene.approach import Approach
from jaxtrachea.scene.programs import Moved
from jaxtrachea.scene.stage import Presses, touch_tube
from jaxtrachea.status import PressStatus

pytestmark = pytest.mark.compiling

EACH = dataclasses.replace(
    BARE, contact_point="per_step", want_joints=False, want_ring_ends=False
)  # fmt: skip
START = ball([75, 1, 0], [76, -2, 1])
NODES, WEIGHTS = (jnp.asarray(v) for v in np.polynomial.legendre.leggauss(12))
simulated = jax.jit(simulate)
#: Rows in one run: one program serves paths of any length.
ROWS = 128


def run(scene, material, path):
    """Every row by itself, as `simulate` does it here; the last run is filled up by its last row.

    That rows know nothing of each other, `test_steps_rows_and_precisions_agree` holds.
    """
    count, parts = len(path.translation), []
    for first in range(0, count, ROWS):
        rows = np.minimum(np.arange(first, first + ROWS), count - 1)
        poses = Poses(np.asarray(path.rotation)[rows], np.asarray(path.translation)[rows])
        parts.append(simulated(scene, material, poses))
    return SimpleNamespace(**{
        name: np.concatenate([getattr(part, name) for part in parts])[:count]
        for name in ("status", "force", "moment")
    })  # fmt: skip


def scene_of(tool=BALL, material=MATERIAL, **effects):
    effects = dataclasses.replace(EACH, **effects)
    return make_scene(TUBE, material, START, tool=tool, effects=effects)


def led(translation, rotation=None):
    rows = len(translation)
    eye = np.broadcast_to(np.eye(3), (rows, 3, 3))
    return Poses(eye if rotation is None else rotation, jnp.asarray(translation))


def stored(scene, material, path):
    """Energy of every row: the work of a press at its place, by 12 points of Gauss."""
    seen = touch_tube(scene, path)
    options = ObliqueOptions(rings=scene.plan.rings, axial=False)

    def one(s, phi, depth):
        normal = local_frame(phi)[0]
        D = (depth * (1 + NODES) / 2)[:, None] * normal[None]
        force = press_oblique(TUBE, material, s, phi, D, options).force
        return jnp.sum(WEIGHTS * (force @ normal)) * depth / 2

    return jax.vmap(one)(seen.s, seen.phi, -seen.gap)


@pytest.mark.slow
def test_force_and_moment_are_what_changes_the_stored_energy():
    """Six directions of each pose, by central differences of the energy.

    The depths of the quadrature pass through the smooth touch (1e-3 mm) only with its first points:
    1e-6 N mm, the same at neighbouring poses; differences of fourth order leave 1e-7.
    """
    tool = capsule(3.0, 6.0)
    scene, lower = scene_of(tool), 2.0
    places = np.array([[73.3, 0.02, 2.0], [81.0, 0.45, 1.2], [44.5, -0.7, 2.6]])
    at = placed(places, OUTER - lower)
    turned = np.stack([turn(v) for v in ([0, 0, 0.05], [0.3, 1.5, 0.1], [0.1, 0.2, -0.1])])
    h = 1e-3
    shifts, turns = [], []
    for R, T in zip(turned, at, strict=True):
        for way in np.eye(6):
            for k in (h, -h, 2 * h, -2 * h):
                shifts.append(T + k * way[:3])
                turns.append(turn(k * way[3:]) @ R)
    near = led(shifts, np.array(turns))
    E = np.asarray(jax.jit(stored)(scene, MATERIAL, near)).reshape(3, 6, 4)
    truth = (8 * (E[..., 0] - E[..., 1]) - (E[..., 2] - E[..., 3])) / (12 * h)
    out = run(scene, MATERIAL, led(at, turned))
    assert (np.asarray(out.status) == PressStatus.OK).all()
    np.testing.assert_allclose(out.force, truth[:, :3], atol=3e-6)
    np.testing.assert_allclose(out.moment, truth[:, 3:], atol=2e-5)
    along = out.force[:, 0]
    assert np.abs(along).max() > 0.005  # there is something to find


@pytest.mark.long
def test_the_moment_is_the_work_of_small_turns(monkeypatch):
    """Of an energy that is linear in the matrix of the pose, by differences over 1e-5 rad."""
    rng, rows, h = np.random.default_rng(5), 3, 1e-5
    R = np.stack([turn(v) for v in rng.normal(size=(rows, 3))])
    by, pushed = rng.normal(size=(rows, 3, 3)), rng.normal(size=(rows, 3))
    monkeypatch.setattr(
        configurational, "gradient", lambda tube, material, press, *_, **__: Gradient(*press[2::-1])
    )
    none = jnp.zeros((rows, 3))
    moved = Moved(*[None] * 10)._replace(
        force=none, depth=none, slope_C=none[:, 1:], loads=jnp.zeros((rows, TUBE.rings, 3))
    )
    made = Approach(*[None] * 7, pull=lambda _: (Poses(by, pushed),))._replace(inward=none)
    used = Presses(none[:, 0], none[:, 0], none)
    got = configurational.force_by_pose(scene_of(), MATERIAL, Poses(R, none), used, moved, made)

    def energy(way):
        return np.einsum("rij,rij->r", by, turn(way) @ R)

    truth = [(energy(h * way) - energy(-h * way)) / (2 * h) for way in np.eye(3)]
    np.testing.assert_allclose(got[0], pushed, rtol=1e-12)
    np.testing.assert_allclose(got[1], np.stack(truth, 1), atol=1e-8)


def work(scene, material, seed, steps):
    """Over a loop that begins and ends in the air; the largest part of it that was put in.

    For every number of steps: the coarse way goes through every so many places of the finest.
    """
    finest = closed_loop(seed, steps[-1], OUTER)
    out = run(scene, material, led(finest))
    assert np.isin(out.status, [PressStatus.OK, PressStatus.NO_CONTACT]).all()
    found = []
    for count in steps:
        every = slice(None, None, steps[-1] // count)
        way, force = finest[every], out.force[every]
        part = np.sum((force[1:] + force[:-1]) / 2 * np.diff(way, axis=0), axis=1)
        found.append((part.sum(), np.maximum(part, 0).sum()))
    return found


@pytest.mark.slow
def test_loops_do_no_work():
    """It was -0.13 to 0.25 N mm, less than zero in 19 of 40 loops.

    The trapezoidal rule is of second order: a quarter of the error with twice the steps (the first
    touch, 1e-3 mm, is not resolved). 4e-5 of what is put in, at most.
    """
    scene = scene_of(material=MATERIAL, second_plane="on")
    found = np.array([work(scene, MATERIAL, seed, (200, 1600)) for seed in range(12)])
    share = np.abs(found[..., 0]) / found[..., 1]
    assert share[:, 1].max() < 1e-4
    assert np.median(share[:, 1]) < np.median(share[:, 0]) / 16
    assert found[:, 1, 0].min() > -2e-5


@pytest.mark.slow
def test_steps_rows_and_precisions_agree():
    """A session step is the row of `simulate`, and float32 the same within its roundings."""
    scene = scene_of()
    way = closed_loop(3, 60, OUTER)
    out = run(scene, MATERIAL, led(way))
    session = Session(scene, MATERIAL)
    for i in (10, 30, 50):
        step = session.step(np.eye(3), way[i])
        np.testing.assert_allclose(step.force, out.force[i], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(step.moment, out.moment[i], rtol=1e-9, atol=1e-9)

    def single(tree):
        def cast(v):
            real = np.issubdtype(np.asarray(v).dtype, np.floating)
            return jnp.asarray(np.asarray(v, np.float32), np.float32) if real else v

        return jax.tree.map(cast, tree)

    short = simulated(*single((scene, MATERIAL, led(way))))
    assert short.force.dtype == short.moment.dtype == jnp.float32
    np.testing.assert_allclose(short.force, out.force, atol=3e-4)


@pytest.mark.slow
def test_derivatives_of_the_force():
    """Forward = reverse = differences, by the pose and by the material."""
    scene = scene_of()
    at = placed(np.array([[73.3, 0.2, 2.0], [81.0, 0.45, 1.2]]), OUTER)

    def f(x):
        m = dataclasses.replace(
            MATERIAL, k_1=MATERIAL.k_1 * jnp.exp(x[6]), k_M=MATERIAL.k_M * jnp.exp(x[7])
        )
        out = simulate(scene, m, led(jnp.asarray(at) + x[:6].reshape(2, 3)))
        return jnp.concatenate([out.force.ravel(), out.moment.ravel()])

    zero = jnp.zeros(8)
    quick = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
    ahead = quick(lambda x, v: jax.jvp(f, (x,), (v,)))  # value and slope: one program
    forward = np.stack([ahead(zero, v)[1] for v in jnp.eye(8)], 1)
    back = quick(lambda x, w: jax.vjp(f, x)[1](w)[0])  # of one result
    reverse = np.stack([back(zero, w) for w in jnp.eye(len(forward))])
    np.testing.assert_allclose(forward, reverse, rtol=1e-8, atol=1e-9)
    h = 1e-4
    steps = np.stack([(ahead(h * v, v)[0] - ahead(-h * v, v)[0]) / (2 * h) for v in jnp.eye(8)], 1)
    np.testing.assert_allclose(forward, steps, atol=1e-6)
    # The stiffness by the pose is the second derivative of an energy: symmetric.
    for i in (0, 3):
        K = np.asarray(forward)[i : i + 3, i : i + 3]
        np.testing.assert_allclose(K, K.T, atol=1e-9)
