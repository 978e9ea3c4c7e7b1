"""95 % intervals by profile contain the truth in 95 % of repetitions, where local ones do not.

The local interval at 1 % noise, where the model is nearly linear, is tested in test_fit.py.
"""

import functools

import numpy as np
import pytest
import synthetic

from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.inference.profile import profiles

CLEAR = np.array([300.0, 1.0, 0.5, 0.2])


@functools.cache
def covered(level, count):
    """Share of lanes whose local and whose profile interval contain the truth; (4,) each.

    An end that was not found counts as a miss.
    """
    truth = synthetic.draw(3, count, 1.3, CLEAR)
    force, _ = synthetic.forces(truth)
    noise = np.random.default_rng(4).normal(size=force.shape)
    force = force + level * np.abs(force).max((1, 2), keepdims=True) * noise
    changes = {n: {"value": float(v)} for n, v in zip(synthetic.NAMES, CLEAR, strict=True)}
    one = Settings(starts=1, verify=False)  # no one reads verdicts
    result = fit(synthetic.study(force, changes=changes), one)
    found = profiles(result, one, points=2)
    lanes = found.lane[::4]
    assert len(lanes) >= 0.99 * count

    def inside(low, high, at):
        return np.mean((low <= at) & (at <= high), axis=0)

    low, high = found.lower.reshape(-1, 4), found.upper.reshape(-1, 4)
    return inside(result.lower, result.upper, truth), inside(low, high, truth[lanes])


@pytest.mark.slow
@pytest.mark.compiling
def test_profiles_cover_where_local_errors_do_not():
    """3 % noise, relative errors of 10 to 22 %; four binomial standard deviations of the fits."""
    local, profile = covered(0.03, 600)
    assert np.all(np.abs(profile - 0.95) <= 4 * np.sqrt(0.95 * 0.05 / 600)), profile
    # EI_L: the valley is curved; measured 90 % with 5,000 fits.
    assert local[0] < 0.93
