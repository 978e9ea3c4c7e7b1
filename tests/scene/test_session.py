"""Steps of a session are rows of the simulation of their path."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_scenes import BALL, BARE, DOWN, MATERIAL, MESH, OUTER, TUBE, ball, bend, on_arc, poses

from jaxtrachea import Poses, Session, Wishes, make_scene, press, simulate
from jaxtrachea.status import PressStatus

EYE = np.eye(3)
# Comes down slanting, presses, and goes on along the tube, still in contact: s, height, z.
WAY = np.array([[72, 3, 0], [73, 1, 0], [74, -1, 0], [74.5, -3, 0], [75, -4, 0.2], [74, -2, 0]])


def along(radius):
    """The way over the straight tube, or over one bent to an arc."""
    up = WAY[:, 1:] + [OUTER + 5, 0]
    places = np.column_stack([WAY[:, 0], up])
    if radius is not None:
        centre, frame = on_arc(WAY[:, 0], radius)
        places = centre + np.einsum("rij,rj->ri", frame[:, :, 1:], up)
    return Poses(np.broadcast_to(EYE, (6, 3, 3)), places)


def rows(session, path):
    """Every step, copied."""
    steps = zip(np.asarray(path.rotation), np.asarray(path.translation), strict=True)
    return [jax.tree.map(np.array, session.step(R, T)) for R, T in steps]


@pytest.mark.slow
@pytest.mark.parametrize("radius", [None, 200.0])
def test_steps_are_the_rows_of_one_simulation(radius):
    mesh, path = None if radius is None else bend(MESH, radius), along(radius)
    wishes = dataclasses.replace(BARE, want_surface=mesh is not None, seat="first")
    scene = make_scene(TUBE, MATERIAL, path, tool=BALL, mesh=mesh, wishes=wishes)
    whole = jax.jit(simulate)(scene, MATERIAL, path)
    touched = int(np.argmax(np.asarray(whole.gap) < 0))
    session = Session(scene, MATERIAL)
    found = rows(session, path)
    assert 0 < touched < 4
    for i, step in enumerate(found):
        for name, value in step._asdict().items():
            expected = getattr(whole, name)
            assert (value is None) == (expected is None), name
            if value is not None and (i >= touched or name in ("gap", "force", "status")):
                np.testing.assert_allclose(value, expected[i], atol=1e-9, err_msg=f"{name} {i}")
    session.reset()
    again = rows(session, path)
    for a, b in zip(found, again, strict=True):
        jax.tree.map(np.testing.assert_array_equal, a, b)


@pytest.mark.slow
def test_it_lets_go_and_touches_elsewhere():
    """Two presses with a way through the air between: each is a normal press where it stands."""
    path = ball([40, 1, 0], [40, -2, 0], rows=4), ball([90, 1, 0], [90, -3, 0], rows=5)
    wishes = dataclasses.replace(BARE, seat="first")
    session = Session(make_scene(TUBE, MATERIAL, path[0], tool=BALL, wishes=wishes), MATERIAL)
    for one, s, depth in zip(path, (40.0, 90.0), (2.0, 3.0), strict=True):
        last = rows(session, one)[-1]
        known = press(TUBE, MATERIAL, jnp.asarray(s), jnp.asarray(depth))
        # The smoothed contact sees the ball a little early.
        np.testing.assert_allclose(-last.force[1], known.force, rtol=0.02)
        np.testing.assert_allclose(last.s, s, atol=0.2)


def test_nothing_is_compiled_or_allocated_by_a_step():
    scene = make_scene(TUBE, MATERIAL, ball([75, 1, 0], [75, -2, 0]), tool=BALL, mesh=MESH)
    session = Session(scene, MATERIAL, keep=3)
    with pytest.raises(ValueError, match=r"expected \(3, 3\) and \(3,\)"):
        session.step(EYE, [1.0, 2.0])
    with pytest.raises(ValueError, match="no step"):
        session.latency()
    places = {session.step(EYE, [75, OUTER + 5 - 0.1 * k, 0]).vertices.unsafe_buffer_pointer()
              for k in range(5)}  # fmt: skip
    assert len(places) == 1
    held = session.step(EYE, [75, OUTER + 4, 0])
    session.step(EYE, [75, OUTER + 4, 0])
    with pytest.raises(RuntimeError, match="deleted"):
        np.asarray(held.vertices)
    told = session.latency(np.array([0.0, 1e-9, 10.0]))
    assert told.steps == 3
    assert told.counts.tolist() == [0, 3]
    assert 0 < told.median <= told.p99 <= told.worst < 10


def test_float32_and_states_by_status():
    tube, material, tool = jax.tree.map(lambda v: v.astype(np.float32), (TUBE, MATERIAL, BALL))
    start = jax.tree.map(lambda v: v.astype(np.float32), ball([75, 1, 0], [75, -2, 0]))
    session = Session(make_scene(tube, material, start, tool=tool, wishes=BARE), material)
    step = session.step(EYE, [163, OUTER + 3, 0])
    assert step.force.dtype == np.float32
    assert step.status == PressStatus.OFF_TUBE
    # It stays on the place beyond the end until it leaves the tube: dragged from there, no answer.
    assert np.isnan(session.step(EYE, [75, OUTER + 3, 0]).force[1])
    assert session.step(EYE, [75, OUTER + 6, 0]).force.tolist() == [0, 0, 0]
    step = session.step(EYE, [75, OUTER + 3, 0])
    assert step.status == PressStatus.OK
    assert step.force[1] < -0.1


def test_refusals():
    over = poses([70, OUTER + 4, 0], [76, OUTER + 3, 0])
    rubbing = make_scene(
        TUBE, MATERIAL, over, tool=BALL, friction=0.3,
        wishes=dataclasses.replace(BARE, seat="first"),
    )  # fmt: skip
    with pytest.raises(ValueError, match="friction"):
        Session(rubbing, MATERIAL)
    with pytest.raises(ValueError, match="no contact"):
        Session(make_scene(TUBE, MATERIAL, DOWN, wishes=Wishes(want_surface=False)), MATERIAL)
    with pytest.raises(ValueError, match="keep"):
        Session(rubbing, MATERIAL, keep=0)
