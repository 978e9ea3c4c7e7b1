"""The force for a device: finite after any step, with the status that says why it is held."""

import numpy as np
import pytest

from jaxtrachea.scene.held_force import held_force, next_force, no_force
from jaxtrachea.scene.simulation import Simulation
from jaxtrachea.status import PressStatus

OK, GAP, NO = PressStatus.OK, PressStatus.BEHIND_GAP, PressStatus.NO_CONTACT


def step(force, status, frame=None):
    given = {"force": np.asarray(force, float), "status": np.int8(status), "frame": frame}
    return Simulation(**(dict.fromkeys(Simulation._fields) | given))


def after(*steps):
    """What is held after each of the steps."""
    found, held = [], no_force(np.float64)
    for one in steps:
        held = next_force(held, one)
        found.append(held_force(held))
    return found


def test_the_last_good_force_is_held():
    lost = [np.nan, np.inf, 1.0]
    found = after(
        step(lost, GAP), step([0, -0.2, 0], OK), step(lost, GAP), step(lost, GAP),
        step([0, 0, 0], NO), step([0, -0.3, 0], PressStatus.CONTACT_UNCERTAIN),
    )  # fmt: skip
    forces = [[0, 0, 0], [0, -0.2, 0], [0, -0.2, 0], [0, -0.2, 0], [0, 0, 0], [0, -0.3, 0]]
    np.testing.assert_array_equal([one.force for one in found], forces)
    assert [one.status for one in found] == [GAP, OK, GAP, GAP, NO, PressStatus.CONTACT_UNCERTAIN]
    assert [one.held for one in found] == [1, 0, 1, 2, 0, 0]
    assert found[0].status.message == GAP.message


LOST = [[np.nan, 1, 1], [1, np.nan, 1], [1, 1, np.inf], [np.inf, -np.inf, 1]]


@pytest.mark.parametrize("lost", LOST)
def test_one_component_that_is_no_number_holds_all(lost):
    np.testing.assert_array_equal(after(step([1, 2, 3], OK), step(lost, OK))[-1].force, [1, 2, 3])


def test_it_is_in_the_frame_of_the_poses():
    """A quarter turn about x, and a row that is lost in another frame."""
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    found = after(step([0, -0.2, 0], OK, turn), step([np.nan] * 3, GAP, np.eye(3)))
    np.testing.assert_array_equal(found[0].force, [0, 0, -0.2])
    np.testing.assert_array_equal(found[1].force, [0, 0, -0.2])
