"""The model's error between positions: leaving out is refitting, noise is none, bands hold."""

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

import jaxtrachea
from jaxtrachea.cli.specification import settings_of, study_of
from jaxtrachea.config import load_fit_spec
from jaxtrachea.fitting.fit import fit
from jaxtrachea.measurements.data_files import read_data
from jaxtrachea.prediction import model_error
from jaxtrachea.prediction.held_out import compare
from jaxtrachea.prediction.model_error import model_errors
from jaxtrachea.prediction.pressed import pressed
from jaxtrachea.status import PredictionStatus

pytestmark = pytest.mark.long

VIRTUAL = Path(__file__).parents[2] / "fits" / "virtual_trachea"


@pytest.mark.parametrize("own", [False, True])
def test_leaving_out_is_refitting(own):
    """Of a linear model, by NumPy's least squares without the trial; one with a zero of its own."""
    rng = np.random.default_rng(3)
    trials, samples, markers, unknowns = 5, 12, 6, 3
    X = rng.normal(size=(trials, unknowns, samples + markers))
    if own:
        zero = np.zeros((trials, 1, samples + markers))
        zero[2, 0, :samples] = 1
        X = np.concatenate([X, zero], axis=1)
    y = rng.normal(size=(trials, samples + markers))
    A, b = np.moveaxis(X, 1, 2).reshape(y.size, -1), y.ravel()
    z = (A @ np.linalg.lstsq(A, b, rcond=None)[0] - b).reshape(y.shape)
    root = rng.uniform(1, 3, y.shape)
    left = model_error._LeftOut(z, X, root, samples)
    error, variance = left.predicted([2])
    others = np.arange(trials) != 2
    B = np.moveaxis(X[others][:, :unknowns], 1, 2).reshape(-1, unknowns)
    theta = np.linalg.lstsq(B, y[others].ravel(), rcond=None)[0]
    rows = X[2, :unknowns, :samples].T
    off = rows @ theta - y[2, :samples]
    off = off - np.mean(off) if own else off
    np.testing.assert_allclose(error[0], off / root[2, :samples], rtol=1e-9)
    spread = np.sum((rows @ np.linalg.inv(B.T @ B)) * rows, axis=1)
    np.testing.assert_allclose(variance[0], spread / root[2, :samples] ** 2, rtol=1e-9)


def test_a_position_that_alone_tells_an_unknown_cannot_be_left_out():
    rng = np.random.default_rng(4)
    X = rng.normal(size=(4, 2, 8))
    X[1:, 1] = X[1:, 0]  # but for the first, the sum of both
    left = model_error._LeftOut(rng.normal(size=(4, 8)), X, np.ones((4, 8)), 8)
    assert left.predicted([0]) is None
    assert left.predicted([1]) is not None


def test_noise_is_no_error_of_the_model(read):
    """24 specimens that the model describes: nothing is left, and the program reads it back."""
    found = model_errors(read, list(range(24)))
    shares = np.array([found[k].share.max() for k in range(24)])
    noise = 0.02 / max(c.force.max() for c in pressed(read).curves)
    assert np.median(shares) < 2 * noise
    assert {e.positions for e in found.values()} == {4}


def test_a_position_that_the_others_hardly_determine_counts_little():
    """Maximum of the likelihood by SciPy. The plain mean said 0.04, and in the second case 0."""
    for square, explained in (
        ([3e-4, 1e-4, 5e-4, 2e-4, 4e-4, 0.25], [1e-6] * 5 + [0.04]),
        ([1e-2, 2e-2, 5e-3, 1e-2, 3e-2, 1e-5], [1e-6] * 5 + [0.06]),
    ):
        y, v = np.array(square), np.array(explained)

        def twice(log, y=y, v=v):
            return np.sum(y / (np.exp(log) + v) + np.log(np.exp(log) + v))

        best = minimize_scalar(twice, bounds=(-20, 0), method="bounded", options={"xatol": 1e-9})
        found, telling = model_error._share(y[:, None], v[:, None])
        np.testing.assert_allclose(found, np.exp(best.x), rtol=1e-6)
        assert abs(telling[0] - 5) < 0.1
    less, _ = model_error._share(np.array([[0.5], [0.1]]), np.ones((2, 1)))
    np.testing.assert_allclose(less, -0.7)  # the mean, where all are known alike


def test_a_band_says_what_it_knows(read, monkeypatch):
    D = np.array([0.0, 2.0, 4.0])
    here, between = (
        jaxtrachea.predict(read, s=s, displacement=D, specimen="s0001") for s in (45.0, 61.0)
    )
    assert np.all(here.model_se == 0)
    assert "(4 left out in turn)" in between.message
    assert "left out" not in here.message
    np.testing.assert_allclose(
        between.high95 - between.force,
        np.hypot(
            between.half_width * np.hypot(between.se, between.sigma),
            between.model_quantile * between.model_se,
        ),
    )
    monkeypatch.setattr(model_error, "MIN_POSITIONS", 5)
    few = dataclasses.replace(read)
    unknown = jaxtrachea.predict(few, s=61.0, displacement=D, specimen="s0001")
    assert unknown.status == PredictionStatus.FEW_POSITIONS
    assert "4 of 5 positions" in unknown.message
    assert jaxtrachea.predict(few, s=45.0, displacement=D, specimen="s0001").status == 0


def test_standard_errors_grow_as_intervals_do(read):
    """Times the growth for alike residuals, at a position of the fit."""

    def errors(growth):
        grown = dataclasses.replace(read)
        effective = read.effective._replace(growth=np.full_like(read.effective.growth, growth))
        vars(grown)["effective"] = effective
        return jaxtrachea.predict(grown, s=45.0, displacement=[1.0, 4.0], specimen="s0001").se

    np.testing.assert_allclose(errors(3.0), 3 * errors(1.0), rtol=1e-9)


def left_out(name, size, count):
    """The finite-element specimen without some positions: what a fit says of these.

    Every choice is a specimen of its own, so that all are one study. Mirror images stay together.
    """
    spec = load_fit_spec(VIRTUAL / name)
    measured = read_data(spec, VIRTUAL)
    all_of = measured.curves
    mirror = {i for i, c in enumerate(all_of) if c.s_c in (35.0, 125.0)}
    choices = [t for t in itertools.combinations(range(10), size)
               if len(mirror.intersection(t)) != 1]  # fmt: skip
    chosen = np.random.default_rng(5).permutation(len(choices))[:count]
    kept, held = [], []
    for k in chosen:
        for i, curve in enumerate(all_of):
            (held if i in choices[k] else kept).append(dataclasses.replace(curve, specimen=f"{k}"))
    study = study_of(spec, dataclasses.replace(measured, curves=tuple(kept)))
    return compare(fit(study, settings_of(spec)), held)


@pytest.mark.slow
def test_bands_hold_positions_left_out():
    """Independent finite elements: 90 to 99 % of the samples with force; forces to 1.2 %."""
    found = left_out("fit.toml", 3, 16)
    inside = np.concatenate([c.covered[c.with_force] for c in found])
    assert 0.9 <= np.mean(inside) <= 0.99, np.mean(inside)
    peaks = [c.residual[c.with_force] / np.max(c.curve.force) for c in found]
    assert np.sqrt(np.mean(np.concatenate(peaks) ** 2)) <= 0.012
    first = [c.residual[1] / c.curve.force[1] for c in found]
    assert np.sqrt(np.mean(np.square(first))) <= 0.012
    assert not any(c.with_force[0] for c in found)
