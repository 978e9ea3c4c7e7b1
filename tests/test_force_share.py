"""Noise with a share of the force: found where it is, not where it is not."""

import dataclasses

import numpy as np
import pytest

from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.evaluate import evaluated
from jaxtrachea.fitting.force_share import (
    Levels,
    _most_likely,
    changed,
    with_found_shares,
    with_levels,
)
from jaxtrachea.fitting.lanes import Noise
from jaxtrachea.inference.analysis import AnalysisResults
from jaxtrachea.measurements.curve import Curve
from jaxtrachea.mechanics.press import Options
from jaxtrachea.results.arrays import arrays_of, result_of
from jaxtrachea.results.hdf5 import write_hdf5
from jaxtrachea.results.read import read_results
from jaxtrachea.runs.shards import join
from jaxtrachea.trachea.geometry import table_1

F = np.tile(np.linspace(0, 3, 60), 5)


def residuals(sigma, share, seed):
    return np.random.default_rng(seed).normal(size=F.shape) * np.hypot(sigma, share * F)


@pytest.mark.parametrize(("sigma", "share"), [(0.01, 0.02), (0.002, 0.01), (0.05, 0.2)])
def test_sigma_and_share_are_found(sigma, share):
    """By the noise that was drawn: within four standard errors of 300 samples."""
    found = [_most_likely(residuals(sigma, share, k), F, np.ones_like(F), False, None)
             for k in range(20)]  # fmt: skip
    for got, true in zip(np.median(found, axis=0), (sigma, share), strict=True):
        assert abs(got / true - 1) < 0.15
    one = _most_likely(residuals(sigma, share, 3), F, np.ones_like(F), False, share)
    assert one[1] == share
    assert abs(one[0] / sigma - 1) < 0.3
    given = _most_likely(residuals(sigma, share, 3), F, np.full_like(F, 1 / sigma), True, None)
    assert given[0] == 1
    assert abs(given[1] / share - 1) < 0.2


def test_even_noise_has_no_share():
    """In fewer than 1 of 100 fits."""
    shares = [_most_likely(residuals(0.02, 0, k), F, np.ones_like(F), False, None)[1]
              for k in range(300)]  # fmt: skip
    assert np.mean(np.array(shares) > 0) < 0.01


def study(noise, depth=6.0, options=Options(), parameters=None):
    D = np.linspace(0, depth, 20)
    curves = [Curve("A", f"{s}", s_c=s, phi_c=0.0, displacement=D, force=0.5 * D)
              for s in (40.0, 75.0)]  # fmt: skip
    return build_study(curves, table_1(), options, parameters, noise=noise)


def test_deep_presses_ask_for_a_share():
    """Beyond a tenth of the radius, sigma estimated, with a skeleton; or as it is said."""
    assert study(Noise()).force_share == "estimate"
    assert study(Noise(), depth=0.5).force_share is None
    assert study(Noise(force=0.01)).force_share is None
    assert study(Noise(force_share=0.0)).force_share is None
    assert study(Noise(force=0.01, force_share=0.02), depth=0.5).force_share == 0.02
    assert study(Noise(), options=Options(coupling="total")).force_share is None
    with pytest.raises(ValueError, match="force_share is 1.5; expected a share of 0 to 1"):
        Noise(force_share=1.5)


@pytest.mark.parametrize("sigma", [None, 0.01])
def test_weights_are_those_of_the_noise(sigma):
    """1 / sqrt(sigma^2 + (share F)^2), in units of sigma where it is estimated."""
    plain = study(Noise(force=sigma, force_share="estimate"))
    force = np.asarray(plain.lanes.force)
    level = Levels(np.array([0.02]), np.array([0.05]))
    scale = 1.0 if sigma else 0.02
    weighed = with_levels(plain, level, force)
    again = with_levels(weighed, level, force)  # not twice
    for got in (weighed, again):
        expected = scale / np.hypot(sigma or 0.02, 0.05 * force)
        np.testing.assert_allclose(got.lanes.precision, expected, rtol=1e-12)
    part = dataclasses.replace(weighed).take(np.array([0, 0]))
    assert part.shares is not None
    assert part.shares.share.tolist() == [0.05, 0.05]


def test_lanes_without_a_share_are_left_alone():
    none, some = np.array([0.0, 0.0]), np.array([0.0, 0.01])
    sigma = np.ones(2)
    assert changed(None, Levels(sigma, some)).tolist() == [1]
    assert changed(Levels(sigma, some), Levels(sigma * [3, 1.001], some)).tolist() == []
    assert changed(Levels(sigma, none), Levels(2 * sigma, some)).tolist() == [1]


def test_a_share_that_was_found_is_kept_with_the_fit(tmp_path):
    """In the arrays of a shard and in results.h5; once it was lost in both, with its weights."""
    held = {"k_1": {"fixed": True, "value": 0.5}}
    plain = study(Noise(), parameters={n: held["k_1"] for n in ("k_1", "k_3", "EI_L", "k_M")})
    weighed = with_levels(plain, Levels(np.array([0.02]), np.array([0.05])), plain.lanes.force)
    result = evaluated(weighed)
    write_hdf5(tmp_path / "results.h5", AnalysisResults(result), {})
    for back in (result_of(plain, arrays_of(result)), read_results(tmp_path)):
        assert back.force_share.tolist() == [0.05]
        np.testing.assert_array_equal(back.study.lanes.precision, weighed.lanes.precision)
        np.testing.assert_array_equal(back.study.shares.plain, plain.lanes.precision)
    none = evaluated(plain)
    both = join(plain.take(np.array([0, 0])), [none, result])
    assert both.force_share.tolist() == [0, 0.05]
    np.testing.assert_array_equal(both.study.lanes.precision[0], plain.lanes.precision[0])
    assert result_of(plain, arrays_of(none)).study.force_share is None  # no refit looks again


def test_lanes_that_were_fitted_again_bring_their_shares():
    """As if all had been found together; without any share none is looked for once more."""
    D = np.linspace(0, 6.0, 20)
    curves = [Curve(name, "1", s_c=75.0, phi_c=0.0, displacement=D, force=slope * D)
              for name, slope in (("A", 0.5), ("B", 0.7), ("C", 0.9))]  # fmt: skip
    whole, rows = build_study(curves, table_1(), noise=Noise(force_share="estimate")), np.array([1])
    force, sigma = np.asarray(whole.lanes.force), np.array([0.02, 0.03, 0.04])

    def found(study, of, share):
        return with_levels(study, Levels(sigma[of], np.array(share)), force[of])

    every = np.arange(3)
    before, part = found(whole, every, [0.01, 0.0, 0.02]), whole.take(rows)
    together = found(whole, every, [0.01, 0.05, 0.02])
    out = with_found_shares(whole, before, rows, found(part, rows, [0.05]))
    np.testing.assert_array_equal(out.lanes.precision, together.lanes.precision)
    for value, expected in zip(out.shares, together.shares, strict=True):
        np.testing.assert_array_equal(value, expected)

    none = dataclasses.replace(whole, force_share=None)
    out = with_found_shares(whole, before, rows, dataclasses.replace(part, force_share=None))
    np.testing.assert_array_equal(out.lanes.precision, before.lanes.precision)
    out = with_found_shares(whole, none, rows, found(part, rows, [0.05]))
    np.testing.assert_array_equal(out.shares.share, [0, 0.05, 0])
    np.testing.assert_array_equal(out.lanes.precision[[0, 2]], whole.lanes.precision[[0, 2]])
    out = with_found_shares(whole, none, rows, dataclasses.replace(part, force_share=None))
    assert (out.shares, out.force_share) == (None, None)
