"""Curves with an onset and a force offset of their own: left out, predicted, fitted again."""

import dataclasses
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
from hardening import TWO, pairs, stored_again, total_study
from scipy.optimize import least_squares

import jaxtrachea
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.model import columns_of
from jaxtrachea.fitting.predictions import predictions
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.inference.cross_validation import leave_one_out, with_own_onset
from jaxtrachea.measurements.read import Curve
from jaxtrachea.prediction import held_out
from jaxtrachea.prediction.pressed import pressed
from jaxtrachea.prediction.sources import CurveParameters
from jaxtrachea.results.read import NoResults, read_again
from jaxtrachea.status import FitStatus, PredictionStatus


def touching(onsets=(0.3, 0.7, 1.1), reach=6.0, specimens=("T1", "T2")):
    """Presses whose first touch lies among the samples, each with an offset of its own."""
    rng = np.random.default_rng(9)
    for i, name in enumerate(specimens):
        for j, onset in enumerate(onsets):
            D = np.linspace(0, reach, 61)
            h = np.maximum(D - onset, 0)
            force = (1.0 + 0.3 * i) * h + 0.1 * h**3 + 0.1 * j + 0.05 * rng.normal(size=61)
            yield Curve(name, f"t{j}", 80.0, 0.0, D, force)


def stiffness(read, lane):
    """k_1 and k_3 in their units."""
    pairs = zip(read.study.free[:2], read.theta[lane, :2], strict=True)
    return [p.from_scaled(v) for p, v in pairs]


OWN = {"onset": {"fixed": False}, "force_offset": {"fixed": False}}


@pytest.fixture(scope="module")
def touched(tmp_path_factory):
    """Three presses of two specimens, onset and offset of each its own: study and stored fit."""
    study = total_study(touching(), OWN)
    path = tmp_path_factory.mktemp("touched") / "r.h5"
    return study, stored_again(study, path)


@pytest.mark.slow
@pytest.mark.compiling
def test_used_curves_come_back_with_the_corner_of_the_fit(touched):
    """What the fit stored as predicted, to 1e-9 N: the same rounded corner."""
    _, read = touched
    with h5py.File(read.origin.path) as file:
        stored_force = np.split(file["data/predicted"][()], 6)
    found = held_out.compare(read, pressed(read).curves)
    assert {c.in_fit for c in found} == {"yes"}
    for c, force in zip(found, stored_force, strict=True):
        assert np.allclose(c.prediction.force, force, rtol=0, atol=1e-9)
    # As a press that is asked for: with the trial its corner, else a sharp one at 0.
    at = {"s": 80.0, "displacement": pressed(read).curves[1].displacement, "specimen": "T1"}
    same = jaxtrachea.predict(read, trial="t1", **at)
    assert np.allclose(same.force, stored_force[1], rtol=0, atol=1e-9)
    new = jaxtrachea.predict(read, **at)
    k_1, k_3 = stiffness(read, 0)
    D = at["displacement"]
    assert np.allclose(new.force, k_1 * D + k_3 * D**3, rtol=1e-9)


def left_out_pairs(study, changes, rows, folder):
    """Curves left out: as `leave_one_out` predicts them, and as a stored fit of the others does."""
    left = leave_one_out(fit(study, TWO), TWO)
    assert left.result.succeeded.all()
    held = np.zeros(study.take(left.lane).lanes.s_c.shape, bool)
    held[np.arange(len(held)), left.trial] = True
    chosen = study.take(left.lane)
    truth = predictions(chosen, with_own_onset(chosen, held, left.result.theta, TWO).theta)["force"]
    for row in rows:
        lane, trial = left.lane[row], left.trial[row]
        out = study.curves[lane][trial]
        others = [c for curves in study.curves for c in curves if c is not out]
        read = stored_again(total_study(others, changes), folder / f"{row}")
        (found,) = held_out.compare(read, [out])
        assert found.in_fit == "no"
        peak = np.max(np.abs(out.force))
        assert np.allclose(found.residual, truth[row, trial], rtol=0, atol=1e-6 * peak)
        rms = np.sqrt(np.mean(found.residual**2)) / peak
        assert abs(rms - left.force[row]) < 1e-6
        yield found, read, lane


@pytest.mark.slow
@pytest.mark.compiling
def test_left_out_curve_with_its_own_onset_is_that_of_leave_one_out(touched, tmp_path):
    """Fit without a curve, written, read, predicted: every sample to 1e-6 of the peak."""
    for found, read, lane in left_out_pairs(touched[0], OWN, (1, 5), tmp_path):
        assert "onset, force_offset fitted to this curve" in found.prediction.message
        _, sharp = least_touch(read, lane, found.curve)
        peak = np.max(found.curve.force)
        assert np.max(np.abs(found.prediction.force - sharp)) < 0.02 * peak


@pytest.mark.slow
@pytest.mark.compiling
def test_left_out_curve_with_one_number_of_its_own(tmp_path):
    """The other one, 20 N, is the specimen's; the corner and the start know of it."""
    changes = {n: {"fixed": False, "scope": "specimen"} for n in OWN}
    changes["onset"] = {"fixed": False}
    curves = [dataclasses.replace(c, force=c.force + 20.0) for c in touching((0.3, 0.7, 1.1))]
    for found, _, _ in left_out_pairs(total_study(curves, changes), changes, (1,), tmp_path):
        assert "onset fitted to this curve" in found.prediction.message


def test_own_parameters_follow_those_that_are_kept():
    """Of a linear model: NumPy's fit of the own one, moved by each that is kept, and its noise."""
    rng = np.random.default_rng(8)
    slopes, sigma, force = rng.normal(size=(3, 20)), rng.uniform(0.1, 0.3, 20), rng.normal(size=20)
    kept, moving = slopes[:2], slopes[2:]
    root = rng.normal(size=(2, 2))
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = root @ root.T
    blank = CurveParameters(
        "T1", "", 0, np.zeros(3), np.zeros(3), covariance, np.zeros((1, 3)), np.array(1.96),
        np.ones(2), (2,), PredictionStatus.OK, "",
    )  # fmt: skip
    own = held_out._Own(
        (2,), np.zeros(1), FitStatus.CONVERGED, np.zeros(1, bool), slopes, sigma
    )  # fmt: skip
    free = [SimpleNamespace(name=name) for name in "abc"]
    names = object.__new__(FitResult)  # no more of it is read
    object.__setattr__(names, "study", SimpleNamespace(free=free))
    got = held_out._merged(names, blank, own).covariance

    def fitted(values):
        A, y = (moving / sigma).T, (force - values @ kept) / sigma
        return np.linalg.lstsq(A, y, rcond=None)[0][0]

    by = np.array([fitted(way) - fitted(np.zeros(2)) for way in np.eye(2)])
    noise = 1 / np.sum((moving / sigma) ** 2)
    np.testing.assert_allclose(got[2, :2], covariance[:2, :2] @ by, rtol=1e-9)
    np.testing.assert_allclose(got[2, 2], by @ covariance[:2, :2] @ by + noise, rtol=1e-9)


def least_touch(read, lane, curve):
    """Onset and offset of a curve by SciPy with a sharp corner, k_1 and k_3 kept; its force."""
    k_1, k_3 = stiffness(read, lane)

    def force(x):
        h = np.maximum(curve.displacement - x[0], 0)
        return k_1 * h + k_3 * h**3 + x[1]

    found = least_squares(lambda x: force(x) - curve.force, [0.5, 0.0], x_scale="jac")
    return found.x, force(found.x)


def rounded(x, width):
    """`max(x, 0)` averaged with the kernel 15/32 (1 - t^2) (3 - 7 t^2) over `width`, by Gauss."""
    t, weight = np.polynomial.legendre.leggauss(40)
    # The kernel on either side of the corner by itself, where the integrand is a polynomial.
    low = np.clip(x / width, -1, 1)[:, None]
    u = (low + 1) / 2 * t - (1 - low) / 2  # from -1 to the corner: x - width u > 0
    kernel = 15 / 32 * (1 - u * u) * (3 - 7 * u * u)
    return np.sum(weight * kernel * (x[:, None] - width * u), axis=1) * (low[:, 0] + 1) / 2


@pytest.mark.slow
@pytest.mark.compiling
def test_own_onset_is_fitted_and_its_band_is_that_of_least_squares(tmp_path):
    """A new curve's own onset, k_1 and k_3 kept; band by the law of errors."""
    curves = list(pairs(onset=0.1))
    read = stored_again(total_study(curves, {"onset": {"fixed": False}}), tmp_path / "r.h5")
    depth = np.linspace(0.0, 2, 41)
    rng = np.random.default_rng(6)
    touched = np.maximum(depth - 0.3, 0)
    new = Curve(
        "T1", "c", None, 0.0, depth, touched + 0.1 * touched**3 + 0.01 * rng.normal(size=41)
    )
    (found,) = held_out.compare(read, [new])
    (width,) = held_out.measured_corners(read, [new], [np.zeros(41)])
    assert 0.001 < width < 0.05
    k_1, k_3 = stiffness(read, 0)

    def force(values):
        d = rounded(depth - values[2], width)
        return values[0] * d + values[1] * d**3

    alone = least_squares(
        lambda o: force([k_1, k_3, o[0]]) - new.force, [0.25], xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    at = np.array([k_1, k_3, alone.x[0]])
    assert np.allclose(found.prediction.force, force(at), atol=1e-6)
    assert "onset fitted to this curve" in found.prediction.message
    steps = np.eye(3) * 1e-6
    J = np.stack([(force(at + h) - force(at - h)) / 2e-6 for h in steps], axis=1)
    unit = np.diag([1.0, 0.01])
    C = unit @ read.uncertainty.covariance[0][:2, :2] @ unit
    sigma = read.observed_sigma[0, 0]
    kept = J[:, :2] - np.outer(J[:, 2], J[:, 2] @ J[:, :2]) / (J[:, 2] @ J[:, 2])
    variance = np.sum(kept @ C * kept, axis=1) + sigma**2 * J[:, 2] ** 2 / (J[:, 2] @ J[:, 2])
    assert np.allclose(found.prediction.se, np.sqrt(variance), rtol=1e-4, atol=1e-6)
    (same,) = held_out.compare(read, [curves[0]])
    assert same.in_fit == "yes"
    assert "fitted to this" not in same.prediction.message
    (changed,) = held_out.compare(
        read, [dataclasses.replace(curves[0], force=curves[0].force * 1.1)]
    )
    assert changed.in_fit == "changed"


@pytest.mark.slow
@pytest.mark.compiling
def test_a_former_fit_with_other_steps_is_refused(touched):
    """Its lanes would keep scaled coordinates that mean other numbers here."""
    study, read = touched
    assert read_again(read.origin.path, study).succeeded.all()
    other = [dataclasses.replace(p, step=7 * p.step) if p.name == "onset" else p
             for p in study.parameters]  # fmt: skip
    model = dataclasses.replace(study.model, columns=columns_of(other))
    study = dataclasses.replace(study, model=model, parameters=tuple(other))
    with pytest.raises(NoResults, match="other values, bounds or steps; fit again"):
        read_again(read.origin.path, study)
