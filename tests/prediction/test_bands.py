"""Bands of predictions: they cover, are those of the text book, and end where knowledge does."""

import dataclasses
import math
import shutil
from pathlib import Path

import beam_fem
import h5py
import numpy as np
import pytest
import synthetic
from hardening import TWO, pairs, stored_again, total_study
from noisy_fits import DEPTHS, NOISE, UNSEEN, noisy_study, true_force
from scipy.optimize import least_squares
from scipy.stats import t as student

import jaxtrachea
from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.lanes import Noise
from jaxtrachea.inference.analysis import AnalysisResults
from jaxtrachea.mechanics.press import Options
from jaxtrachea.prediction import held_out
from jaxtrachea.prediction.curves import predict_sources
from jaxtrachea.prediction.model_error import model_errors
from jaxtrachea.prediction.pressed import pressed
from jaxtrachea.prediction.sources import source_of
from jaxtrachea.results.hdf5 import write_hdf5
from jaxtrachea.status import PredictionStatus
from jaxtrachea.trachea.geometry import table_1

pytestmark = pytest.mark.long

VIRTUAL = Path(__file__).parents[2] / "fits" / "virtual_trachea"


@pytest.mark.slow
@pytest.mark.compiling
def test_bands_cover_in_500_fits(tmp_path):
    """Curve band: the true curve; with noise: new noisy samples; 93 to 97 % over the depths.

    Truth from finite elements; parameters known to 10 to 24 %.
    """
    noise, lanes, rng = 0.15, 500, np.random.default_rng(8)
    noisy_study(tmp_path, noise, lanes, 70)
    read = jaxtrachea.read_results(tmp_path)
    sources = [source_of(read, name) for name in pressed(read).specimens]
    for s in UNSEEN:
        found = predict_sources(read, sources, [s] * lanes, [DEPTHS] * lanes, batch=8)
        truth = true_force(s)
        sample = truth + noise * rng.normal(size=(lanes, len(DEPTHS)))
        inside = np.array([(p.curve_low95 <= truth) & (truth <= p.curve_high95) for p in found])
        pairs = zip(found, sample, strict=True)
        new = np.array([(p.low95 <= y) & (y <= p.high95) for p, y in pairs])
        for covered in (inside, new):
            assert 0.93 <= np.mean(covered) <= 0.97, np.mean(covered)
            miss = np.max(np.abs(np.mean(covered, axis=0) - 0.95))
            assert miss < 4 * math.sqrt(0.95 * 0.05 / lanes), miss


@pytest.mark.slow
@pytest.mark.compiling
def test_residuals_and_bands_of_unequal_noise(tmp_path):
    """Sizes of residuals are in N and mm, bands of markers as wide as their own noise is."""
    measured = jaxtrachea.read_measurements(VIRTUAL / "small_strain.h5").curves[:2]
    weighed = [dataclasses.replace(c, sigma=0.01 * np.arange(1.0, len(c.force) + 1))
               for c in measured]  # fmt: skip
    noise = Noise(joints=5e-4, joints_share=0.06)
    values = {"k_3": 0.0, "EI_L": 300.0, "k_M": 1.0, "GA_L": 9.0}
    held = {name: {"fixed": True, "value": value} for name, value in values.items()}
    options = Options(contact="bonded", shear=True)
    result = fit(build_study(weighed, table_1(), options, held | {"k_1": {}}, noise=noise), TWO)
    write_hdf5(tmp_path / "r.h5", AnalysisResults(result), {})
    read = jaxtrachea.read_results(tmp_path / "r.h5")
    off, aside = [], []
    for curve in measured:
        D = curve.displacement
        found = jaxtrachea.predict(read, s=curve.s_c, displacement=D)
        off.append(found.force - curve.force)
        aside.append((found.joints[:, curve.joint_rings] - curve.joint_displacement).ravel())
        np.testing.assert_allclose(found.joint_sigma, np.sqrt(5e-4**2 + (0.06 * D) ** 2))
    sizes = [np.sqrt(np.mean(np.concatenate(v) ** 2)) for v in (off, aside)]
    np.testing.assert_allclose(result.rms[0], sizes, rtol=1e-9)


def force_at(read, source, s):
    """Force of a source at 3 mm."""
    return predict_sources(read, [source], [s], [np.array([3.0])])[0].force[0]


def slope_at(read, source, s):
    """Its derivative by the estimates, by central differences; (4,)."""
    steps = 1e-4 * np.eye(4)
    ends = [[dataclasses.replace(source, free=source.free + sign * h) for sign in (1, -1)]
            for h in steps]  # fmt: skip
    return np.array([force_at(read, a, s) - force_at(read, b, s) for a, b in ends]) / 2e-4


def test_standard_errors_are_those_of_the_delta_method(read):
    """At a pressed position widened by alike residuals, else beside the model's error there."""
    source = source_of(read, "s0003")
    widened = model_errors(read, [3])[3].growth  # 100 samples of white noise: close to 1
    assert 1 <= widened < 1.3
    for s, factor in ((45.0, widened), (61.0, 1.0)):
        (curve,) = predict_sources(read, [source], [s], [np.array([3.0])])
        J = slope_at(read, source, s)
        C = read.uncertainty.covariance[3]
        assert np.isclose(curve.se[0], factor * np.sqrt(J @ C @ J), rtol=1e-6)


def test_an_undetermined_direction_makes_bands_infinite_where_it_acts(read):
    """EI_L against k_M as one position leaves them: the same press stays known, others do not."""
    source = source_of(read, "s0003")
    J = slope_at(read, source, 75.0)
    null_space = np.zeros_like(source.null_space)
    null_space[0, :2] = np.array([-J[1], J[0]]) / np.hypot(J[0], J[1])
    lost = dataclasses.replace(source, null_space=null_space)
    places = [75.0, 31.0]
    same, other = predict_sources(read, [lost, lost], places, [np.array([3.0])] * 2)
    assert np.isfinite(same.high95).all()
    assert same.status == PredictionStatus.OK
    assert np.isinf(other.high95).all()
    assert other.status == PredictionStatus.UNDETERMINED


def test_a_band_that_the_model_bends_in_is_said(read):
    """A hundred times the standard errors: the ends of the linear band are off."""
    source = source_of(read, "s0003")
    wide = dataclasses.replace(source, covariance=1e4 * source.covariance)
    (curve,) = predict_sources(read, [wide], [61.0], [np.array([3.0])])
    assert curve.status == PredictionStatus.BENT


def rise_at(read, lane, s, target):
    """Twice the rise of the cost where the force at s is held at `target`; an independent beam."""
    x, curves = np.asarray(table_1().ring_positions), read.study.curves[lane]
    data = np.concatenate([c.force for c in curves]), float(read.sigma[lane, 0])

    def forces(theta, places, depths):
        EI, k_M, k_1, k_3 = np.exp(theta)
        out = []
        for at in places:
            c = float(beam_fem.solve(x, 160.0, [EI] * 16, [k_M] * 15, at, 1.0).w_C)
            d = depths.copy()
            for _ in range(60):  # Newton, from above a convex function's root
                F = k_1 * d + k_3 * d**3
                d -= (d + c * F - depths) / (1 + c * (k_1 + 3 * k_3 * d**2))
            out.append(k_1 * d + k_3 * d**3)
        return np.concatenate(out)

    def off(theta):
        return (forces(theta, [c.s_c for c in curves], DEPTHS) - data[0]) / data[1]

    def held(theta):
        at = forces(theta, [s], DEPTHS[-1:]) - target
        return np.concatenate([off(theta), 1e5 * at])

    theta = np.log(read.value[lane])
    found = least_squares(held, theta, method="lm", xtol=1e-12, ftol=1e-12)
    return np.sum(off(found.x) ** 2) - np.sum(off(theta) ** 2)


@pytest.mark.slow
@pytest.mark.compiling
def test_bent_is_what_the_profile_of_the_force_says(tmp_path, monkeypatch):
    """Noise of a sixth of the force: a straight walk leaves the valley and calls most bent."""
    lanes = 12
    noisy_study(tmp_path, 0.5, lanes, 7)
    read = jaxtrachea.read_results(tmp_path)
    sources = [source_of(read, name) for name in pressed(read).specimens]

    def statuses():
        found = predict_sources(read, sources, [75.0] * lanes, [DEPTHS] * lanes)
        return found, np.array([p.status == PredictionStatus.BENT for p in found])

    found, bent = statuses()
    for lane in np.flatnonzero(~bent)[:4]:
        p, half = found[lane], found[lane].half_width * read.effective.growth[lane]
        ends = p.force[-1] + np.array([1, -1]) * p.half_width * p.se[-1]
        rises = np.array([rise_at(read, lane, 75.0, end) for end in ends])
        assert np.max(np.abs(half / np.sqrt(rises) - 1)) < 0.5
    monkeypatch.setattr("jaxtrachea.prediction.profile._has_profile", lambda _: False)
    _, straight = statuses()
    assert np.sum(straight) >= 8
    assert np.sum(bent) <= 4
    assert straight[bent].all()


def test_without_a_sample_to_spare_the_noise_band_is_infinite(study, tmp_path):
    """As many samples as unknowns: the residual is 0, which says nothing of the noise."""
    shutil.copy(study[0] / "results.h5", tmp_path)
    with h5py.File(tmp_path / "results.h5", "r+") as file:
        file["uncertainty/half_width"][3] = 1.959963984540054
    read = jaxtrachea.read_results(tmp_path)
    curve = jaxtrachea.predict(read, s=61.0, displacement=3.0, specimen="s0003")
    assert curve.status == PredictionStatus.UNDETERMINED
    assert np.isinf(curve.high95).all()


@pytest.mark.slow
@pytest.mark.compiling
def test_linear_model_has_the_bands_of_the_text_book(tmp_path):
    """Least squares on D and D^3 (numpy): s^2 (X^T X)^-1, t.

    The trials differ by 2 %: residuals are alike, and errors are longer by the growth for it.
    """
    curves = list(pairs())
    no_zeros = dict.fromkeys(("onset", "force_offset"), {"auto": False})
    study = total_study(curves, no_zeros)
    read = stored_again(study, tmp_path / "r.h5")
    D, F = (np.concatenate([getattr(c, n) for c in curves[:2]]) for n in ("displacement", "force"))
    X = np.stack([D, D**3], axis=1)
    beta, rss, *_ = np.linalg.lstsq(X, F, rcond=None)
    s = np.sqrt(rss[0] / (len(D) - 2))
    half = student.ppf(0.975, len(D) - 2)
    at = np.array([0.5, 3.0])
    rows = np.stack([at, at**3], axis=1)
    growth = read.effective.growth[0]
    assert 1 < growth < 4
    error = growth * s * np.sqrt(np.sum(rows @ np.linalg.inv(X.T @ X) * rows, axis=1))
    mine = jaxtrachea.predict(read, s=80.0, displacement=at, specimen="T1")
    assert np.allclose(mine.force, rows @ beta, rtol=1e-8)
    assert np.allclose(mine.curve_high95, rows @ beta + half * error, rtol=1e-7)
    assert np.allclose(mine.low95, rows @ beta - half * np.hypot(s, error), rtol=1e-7)
    assert "extrapolated" in mine.message
    assert np.isnan(mine.joints).all()
    # A sigma of the curve itself is a weight where the fit's noise was estimated.
    new = dataclasses.replace(curves[0], trial="c", sigma=np.full(30, 0.5))
    (found,) = held_out.compare(read, [new])
    assert np.allclose(found.prediction.sigma, s, rtol=1e-7)


@pytest.mark.slow
@pytest.mark.compiling
def test_joint_fit_predicts_as_one_dense_lane(tmp_path):
    """A shared parameter: joint lanes carry the whole covariance, the common error included."""
    at = []
    for joint in (True, False):
        study = total_study(pairs(), {"k_3": {"scope": "shared"}}, joint=joint)
        read = stored_again(study, tmp_path / f"{joint}.h5")
        assert read.study.joint == joint
        at.append(jaxtrachea.predict(read, s=80.0, displacement=[1.0, 2.0], specimen="T2"))
    assert np.allclose(at[0].force, at[1].force, rtol=1e-7)
    assert np.allclose(at[0].se, at[1].se, rtol=1e-5)
    assert np.allclose(at[0].half_width, at[1].half_width)


@pytest.mark.slow
@pytest.mark.compiling
def test_a_lane_with_one_place_predicts_that_place(study, tmp_path):
    """k_M too small to be seen in one press: the press itself is known, one elsewhere is not."""
    truth = true_force(75.0)
    rng = np.random.default_rng(3)
    force = truth + NOISE * rng.normal(size=(1, 1, len(DEPTHS)))
    curves = synthetic.curves(force, np.array([75.0]), DEPTHS)
    result = fit(build_study(curves, table_1(), synthetic.OPTIONS, synthetic.parameters()), TWO)
    write_hdf5(tmp_path / "results.h5", AnalysisResults(result), {"inputs": {"a.csv": "0" * 64}})
    read = jaxtrachea.read_results(tmp_path)
    source = source_of(read, pressed(read).specimens[0])
    # EI_L on its upper bound: k_M is a direction by itself, whose slope is 1e-8 of the others'.
    free, null_space = source.free.copy(), np.zeros_like(source.null_space)
    free[:2], null_space[0, 1] = [np.log(1e7), np.log(1e-4)], 1.0
    covariance = np.zeros((4, 4))
    covariance[2, 2] = 1e-4
    lost = dataclasses.replace(source, free=free, null_space=null_space, covariance=covariance)
    near, far, deep = predict_sources(
        read, [lost] * 3, [75.0, 61.0, 75.0], [DEPTHS, DEPTHS, 2 * DEPTHS]
    )
    assert np.isfinite(near.high95).all()
    assert near.status < PredictionStatus.UNDETERMINED
    assert np.isinf(far.se).any()
    assert np.isinf(deep.se[DEPTHS > 3.001]).all()
    # As the fit leaves it: a finite band of its own press, which covers it.
    (own,) = predict_sources(read, [source], [75.0], [DEPTHS])
    assert np.isfinite(own.high95).all()
    inside = (own.low95 <= force[0, 0]) & (force[0, 0] <= own.high95)
    assert np.mean(inside) >= 0.85
    bent = dataclasses.replace(source, null_space=0 * null_space, covariance=1e12 * np.eye(4))
    (worst,) = predict_sources(read, [bent], [75.0], [DEPTHS])
    assert worst.status == PredictionStatus.BENT
    assert " inf " not in worst.message
