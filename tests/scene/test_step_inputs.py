"""What `Session.step` and `step` of several tools refuse."""

import numpy as np
import pytest

from jaxtrachea.scene.step_together import placed

NAMES, STANDS = ["left", "right"], (np.zeros((2, 3, 3)), np.zeros((2, 3)), [True, True])


@pytest.mark.parametrize(
    ("poses", "translation", "present", "says"),
    [
        ({}, 0.1, {}, "give dt by its name"),  # step({...}, 0.1)
        ({}, None, True, "present is True; expected a mapping"),
        ({}, None, ["left"], "expected a mapping of names"),
        ({}, None, {"left": 2}, "present of 'left' is 2; expected True or False"),
        ({}, None, {"left": "no"}, "present of 'left' is 'no'"),
        ({}, None, {"up": False}, "there is no tool 'up'; expected 'left', 'right'"),
        (np.eye(3), np.zeros(3), {}, "one pose, and the scene has the tools 'left', 'right'"),
    ],
)
def test_bad_input_is_named(poses, translation, present, says):
    with pytest.raises(ValueError, match=says):
        placed(NAMES, STANDS, poses, translation, present, lambda *given: given[:2])


@pytest.mark.parametrize("no", [False, np.bool_(False), np.array(False)])
def test_a_tool_is_taken_away(no):
    there = placed(NAMES, STANDS, {}, None, {"right": no}, lambda *given: given[:2])[2]
    assert [bool(v) for v in there] == [True, False]
