"""Verdicts and the products that are determined in place of single parameters."""

import numpy as np
import pytest
import scipy.linalg

from jaxtrachea.fitting.verdict import VERDICTS, verdict
from jaxtrachea.inference.weakest_direction import combinations, describe_weakest
from jaxtrachea.status import ProfileEnd

NAMES = ["EI_L", "GA_L", "k_M", "k_1"]


def unit(*v):
    return np.array(v) / np.linalg.norm(v)


CLOSED, BOUND, OPEN, FAILED = ProfileEnd


@pytest.mark.parametrize(
    ("error", "more", "word"),
    [
        (0.1, {}, "identifiable"),
        (0.3, {}, "weak"),
        (0.51, {}, "practically non-identifiable"),
        (np.inf, {}, "practically non-identifiable"),
        (np.nan, {"held": True}, "at bound"),
        (0.05, {"structural": True}, "structurally non-identifiable"),
        (np.nan, {"structural": True, "held": True}, "structurally non-identifiable"),
        (0.7, {"ends": (CLOSED, CLOSED)}, "practically non-identifiable"),
        (0.2, {"ends": (CLOSED, BOUND)}, "weak"),
        (0.05, {"ends": (CLOSED, OPEN)}, "practically non-identifiable"),
        (0.05, {"ends": (OPEN, FAILED)}, "practically non-identifiable"),
        (0.05, {"ends": (FAILED, CLOSED)}, "not shown"),
        (0.3, {"ends": (CLOSED, FAILED)}, "not shown"),
        (0.7, {"ends": (CLOSED, FAILED)}, "practically non-identifiable"),
        (0.05, {"unseen": True}, "not shown"),
        (0.7, {"unseen": True}, "practically non-identifiable"),
    ],
)
def test_words(error, more, word):
    assert verdict(error, **more) == word
    assert word in VERDICTS


def test_exponents_are_orthogonal_to_what_is_blind():
    """EI k_M^3 is left alone by d ln EI = 3, d ln k_M = -1; and two ways at once."""
    assert combinations(NAMES, unit(3, 0, -1, 0)[None]) == (["EI_L", "k_M"], ["EI_L k_M^3"])
    two = scipy.linalg.orth(np.array([[3.0, 0, -1, 0], [1.0, 2, 0, 0]]).T).T
    assert combinations(NAMES, two) == (["EI_L", "GA_L", "k_M"], ["EI_L GA_L^-0.5 k_M^3"])
    one = combinations(NAMES, unit(1, -1, 2, 0)[None])
    assert one == (["EI_L", "GA_L", "k_M"], ["EI_L k_M^-0.5", "GA_L k_M^0.5"])


def test_two_separate_pairs_stay_apart():
    blind = np.stack([unit(3, 0, -1, 0), unit(0, 1, 0, -1)])
    assert combinations(NAMES, blind)[1] == ["EI_L k_M^3", "GA_L k_1"]


@pytest.mark.parametrize(
    ("flat", "error", "text"),
    [
        ((3, 0, -1, 0), np.inf, "of EI_L and k_M only EI_L k_M^3 is known"),
        ((3, 0, -1, 0), 0.8, "of EI_L and k_M little more is known than EI_L k_M^3"),
        ((3, 0, -1, 0), 0.2, "least determined: EI_L +10 %, k_M -3.33 % together, known to 20 %"),
        ((0, 0, 0, 1), np.inf, "k_1 changes no curve at all"),
        ((0, 0, 0, 1), 0.8, "k_1 alone is known to 80 % only"),
        ((0, 0, 0, 1), 0.067, "least determined: k_1 alone, known to 6.7 %"),
        ((0, 0, 0, 0), 0.1, "no free parameter"),
    ],
)
def test_flat_direction_in_words(flat, error, text):
    v = np.array(flat, float)
    assert describe_weakest(NAMES, v / max(np.linalg.norm(v), 1), error) == text
