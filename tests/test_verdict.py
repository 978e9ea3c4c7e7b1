"""Verdicts and the products that are determined in place of single parameters."""

import numpy as np
import pytest
import scipy.linalg

from jaxtrachea.fitting.verdict import VERDICTS, verdict
from jaxtrachea.inference.weakest_direction import (
    Direction,
    combinations,
    describe_weakest,
    next_weakest,
)
from jaxtrachea.status import ProfileEnd

NAMES = ["EI_L", "GA_L", "k_M", "k_1"]
NEAR = "near this estimate EI_L k_M^3"


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
        (0.05, {"ends": (FAILED, CLOSED)}, "inconclusive"),
        (0.3, {"ends": (CLOSED, FAILED)}, "inconclusive"),
        (0.7, {"ends": (CLOSED, FAILED)}, "practically non-identifiable"),
        (0.05, {"unseen": True}, "inconclusive"),
        (0.7, {"unseen": True}, "practically non-identifiable"),
        (0.01, {"misses": True}, "inconclusive: the model misses the curve"),
        (np.nan, {"misses": True, "held": True}, "inconclusive: the model misses the curve"),
        (0.01, {"misses": True, "structural": True}, "structurally non-identifiable"),
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
        ((3, 0, -1, 0), np.inf, f"of EI_L and k_M only one combination is known, {NEAR}"),
        ((3, 0, -1, 0), 0.8, f"of EI_L and k_M little more than one combination is known, {NEAR}"),
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


ALONG = Direction(unit(1, 0, 3, 0.0), 0.8)


@pytest.mark.parametrize(
    ("left", "end"),
    [
        (ALONG._replace(se=0.5), f"is known, {NEAR}"),
        (
            ALONG,
            f"can be told, {NEAR}; then least determined: k_M +10 %, EI_L +3.33 % together, "
            "known to 80 %",
        ),
        (ALONG._replace(se=np.inf), f"can be told, {NEAR}; what is left is not determined, either"),
    ],
)
def test_a_combination_is_known_only_if_what_is_left_is(left, end):
    for error, little in ((np.inf, "only"), (0.8, "little more than")):
        words = describe_weakest(NAMES, unit(3, 0, -1, 0), error, left=left)
        assert words == f"of EI_L and k_M {little} one combination {end}"


def test_what_is_left_of_an_onset_has_its_unit():
    left = Direction(unit(0, 0, 0, 1.0), 0.8)
    flat, press = unit(3, 0, -1, 0), {3: (5.0, "mm")}
    words = describe_weakest([*NAMES[:3], "onset"], flat, np.inf, press=press, left=left)
    assert words.endswith(f"told, {NEAR}; then least determined: onset alone, known to 4 mm")


def test_two_combinations_are_two():
    words = describe_weakest(NAMES, unit(1, -1, 2, 0), np.inf)
    assert words == (
        "of EI_L, GA_L and k_M only 2 combinations are known, near this estimate EI_L k_M^-0.5 and "
        "GA_L k_M^0.5"
    )


def test_the_next_direction_is_the_largest_error_beside_the_open_ones():
    """Errors 0.7 along (1, 3) / sqrt(10) of EI_L and k_M, 0.2 of k_1, none of GA_L."""
    a, b = unit(1, 0, 3, 0), unit(0, 0, 0, 1)
    covariance = 0.7**2 * np.outer(a, a) + 0.2**2 * np.outer(b, b)
    flat, none = unit(3, 0, -1, 0)[None], np.zeros((4, 4))
    found = next_weakest(covariance, none, flat)
    assert found.se == pytest.approx(0.7, rel=1e-12)
    assert abs(found.vector @ a) == pytest.approx(1, rel=1e-12)
    # A weak direction that is named itself does not count, nor does one of the null space in it.
    wide = covariance + 9.0 * np.outer(flat, flat)
    assert next_weakest(wide, flat, flat).se == pytest.approx(0.7, rel=1e-9)
    silent = np.stack([flat[0], unit(0, 1, 0, 0)])
    assert next_weakest(covariance, silent, flat).se == np.inf
