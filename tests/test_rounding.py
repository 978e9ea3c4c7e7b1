"""Forces rounded more coarsely than their noise: which are found, and that intervals hold them."""

import numpy as np
import pytest

from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.rounding import GROWTH, rounding
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.inference.analyses.effective import EFFECTIVE
from jaxtrachea.inference.analysis import AnalysisResults
from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.press import Options
from jaxtrachea.trachea.geometry import table_1

D = np.linspace(0.0, 3.0, 80)
STEP = 0.03
RNG = np.random.default_rng(2)


def step_of(force, truth):
    """Of one lane of curves, fitted exactly."""
    return rounding(force[None], (truth - force)[None])[0]


def presses(count=3):
    return np.stack([(0.5 + 0.2 * k) * D + 0.1 * D**3 for k in range(count)])


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_steps_are_found_where_they_are_more_than_the_noise(noise):
    truth = presses()
    force = STEP * np.round((truth + noise * STEP * RNG.normal(size=truth.shape)) / STEP)
    assert step_of(force, truth) == pytest.approx(STEP)
    padded, ends = (np.pad(v, [(0, 1), (0, 4)], constant_values=np.nan) for v in (force, truth))
    assert step_of(np.nan_to_num(padded), ends) == pytest.approx(STEP)
    assert step_of(-1e3 * force, -1e3 * truth) == pytest.approx(1e3 * STEP)


def test_what_is_not_rounded_coarsely_has_no_step():
    """Noise as large as a step; none rounded; an even row without noise; one curve of three."""
    truth = presses()
    noisy = truth + STEP * RNG.normal(size=truth.shape)
    assert np.isnan(step_of(STEP * np.round(noisy / STEP), truth))
    assert np.isnan(step_of(noisy, truth))
    even = np.tile(2.0 * D, (3, 1))
    assert np.isnan(step_of(even, even + 1e-9))
    one = noisy.copy()
    one[0] = STEP * np.round(truth[0] / STEP)
    assert np.isnan(step_of(one, truth))
    assert np.isnan(step_of(np.zeros((1, 80)), np.zeros((1, 80))))


@pytest.mark.long
def test_intervals_grow_and_it_is_told():
    """A plain spring: 2 N/mm, with 0.2 N of rounding."""
    force = 2.0 * D + 0.4 * D**3
    curves = [Curve("a", f"t{k}", 75.0, 0.0, D, f) for k, f in enumerate((force, 1.001 * force))]
    rounded = [
        Curve("a", c.trial, 75.0, 0.0, D, 0.2 * np.round(np.asarray(c.force) / 0.2)) for c in curves
    ]
    given = table_1(), Options(coupling="total", onset_width=0.0)
    result = fit(build_study(rounded, *given), Settings(starts=1, verify=False))
    assert result.effective.rounding == pytest.approx([0.2])
    assert result.effective.factor == pytest.approx([GROWTH], rel=0.1)
    (said,) = EFFECTIVE.section(AnalysisResults(result))
    assert "Forces are rounded to 0.2 N in 1 of 1 fits" in said
    for name, truth in {"k_1": 2.0, "k_3": 0.4}.items():
        i = [unknown.name for unknown in result.study.free].index(name)
        assert result.lower[0, i] < truth < result.upper[0, i]


@pytest.mark.long
def test_lanes_of_a_joint_fit_grow_together():
    """What they share has one interval, though one of them is rounded."""
    force = 2.0 * D + 0.4 * D**3
    curves = [
        Curve("a", "t", 75.0, 0.0, D, 0.2 * np.round(force / 0.2)),
        Curve("b", "t", 75.0, 0.0, D, force + 0.05 * RNG.normal(size=len(D))),
    ]
    changes = {"k_1": {"scope": "shared"}}
    total = Options(coupling="total", onset_width=0.0)
    study = build_study(curves, table_1(), total, changes, joint=True)
    found = fit(study, Settings(starts=1, verify=False)).effective
    assert found.rounding == pytest.approx([0.2, 0.2])
    assert found.factor[0] == found.factor[1] > 1.5
