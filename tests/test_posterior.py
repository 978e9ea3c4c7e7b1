"""Draws against closed forms of a linear model and quadrature of a strongly curved posterior."""

import csv
import dataclasses
import re
import sys
from pathlib import Path

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from run_cli import GOOD, run

from jaxtrachea.cli.run import poor
from jaxtrachea.fitting.build import build_study, default_parameters
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.lanes import Noise
from jaxtrachea.fitting.parameters import DEFAULTS, in_model
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.inference.analyses.posterior import POSTERIOR, posterior_table
from jaxtrachea.inference.analysis import AnalysisResults
from jaxtrachea.inference.estimate import lane_of
from jaxtrachea.inference.posterior import Posterior, log_density, posterior
from jaxtrachea.inference.posterior_file import write_posterior
from jaxtrachea.inference.posterior_start import around_the_fit, mode
from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.press import Options
from jaxtrachea.report.fit import report_text
from jaxtrachea.report.overview import overview
from jaxtrachea.results.rows import parameter_rows
from jaxtrachea.trachea.geometry import table_1

pytestmark = pytest.mark.long

ONE = Settings(starts=1, verify=False)
SPEC = '[data]\nfiles = "good.csv"\n[model]\ncoupling = "total"\n[uncertainty]\nposterior = 100\n'


def make_study(force, depth, noise=None, scale="linear"):
    """F = k_1 D + k_3 D^3, both free: linear, or their logarithms within narrow bounds."""
    bounds = {"lower": -1e3, "upper": 1e3} if scale == "linear" else {"lower": 0.1, "upper": 30.0}
    change = {"scale": scale, "value": 1.0, "step": 0.1} | bounds
    rows = [dataclasses.replace(DEFAULTS[n], **change) for n in ("k_1", "k_3")]
    rows += [DEFAULTS[n] for n in ("onset", "force_offset")]
    curve = Curve("T", "t", None, 0.0, depth, force)
    options = Options(coupling="total", onset_width=0.0)
    return build_study([curve], table_1(), options, rows, noise=Noise(force=noise))


@pytest.fixture
def blackjax():
    return pytest.importorskip("blackjax", reason="blackjax (extra 'bayes') is not installed")


def test_density_is_that_of_the_normal_noise():
    """Up to a constant: -n log sigma - S / 2 sigma^2 and the volume of the logistic map."""
    rng = np.random.default_rng(0)
    depth = np.linspace(0.1, 2, 12)
    force = 1.3 * depth + 0.4 * depth**3 + 0.1 * rng.normal(size=12)
    study = make_study(force, depth, scale="log")
    lane, sigma = lane_of(study, 0), jnp.array([0.2, 1.0])
    points = jnp.asarray(rng.normal(size=(20, 3)))

    def density(x):
        return log_density(study.model, (True, False), lane, sigma, x)

    found = np.asarray(jax.jit(jax.vmap(density))(points))
    share = 1 / (1 + np.exp(-np.asarray(points[:, :2])))
    k = np.exp(np.log(0.1) + np.log(300.0) * share)
    s = 0.2 * np.exp(np.asarray(points[:, 2]))
    rest = k[:, :1] * depth + k[:, 1:] * depth**3 - force
    expected = -12 * np.log(s) - np.sum(rest**2, axis=1) / (2 * s * s)
    expected += np.sum(np.log(share * (1 - share)), axis=1)
    np.testing.assert_allclose(found - found[0], expected - expected[0], rtol=1e-9, atol=1e-9)


def made(rhat, ess, lost):
    """A posterior of one unknown with these diagnostics."""
    result = fit(make_study(np.linspace(1, 3, 5), np.linspace(1, 3, 5)), ONE)
    theta, divergent = np.zeros((1, 2, 100, 2)), np.zeros((1, 2, 100), bool)
    divergent[0, 0, :lost] = True

    def pair(v):
        return np.array([[v, v]])

    zero = pair(0.0)
    return Posterior(
        result=result, theta=theta, sigma=np.ones((1, 2, 100, 2)), divergent=divergent,
        steps=np.array([100]), lost=divergent.mean(axis=(1, 2)), rhat=pair(rhat), ess=pair(ess),
        median=zero, lower=zero, upper=zero,
    )  # fmt: skip


def test_verdicts_say_why():
    cases = {(1.0, 900.0, 0): "good", (1.02, 900.0, 0): "doubtful", (1.0, 200.0, 0): "doubtful"}
    cases |= {(1.0, 900.0, 1): "doubtful", (1.2, 900.0, 0): "poor", (1.0, 20.0, 0): "poor"}
    cases |= {(1.0, 900.0, 50): "poor"}
    for numbers, word in cases.items():
        assert made(*numbers).verdict(0).startswith(f"{word}: R-hat")


def test_without_blackjax_nothing_is_fitted(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("good.csv").write_text(GOOD)
    Path("spec.toml").write_text(SPEC)
    monkeypatch.setitem(sys.modules, "blackjax", None)
    code, _, err = run(monkeypatch, capsys, "fit", "spec.toml", "--out", "out")
    assert code == 2
    assert "pip install 'jaxtrachea[bayes]'" in err
    assert not Path("out").exists()
    Path("spec.toml").write_text(SPEC.replace("100", "20"))
    code, _, err = run(monkeypatch, capsys, "fit", "spec.toml", "--out", "out")
    assert code == 2
    assert "100 draws" in err


@pytest.mark.slow
def test_linear_model_is_the_closed_form(blackjax):
    """Student's t: mean of least squares, covariance s^2 (J^T J)^-1 dof / (dof - 2)."""
    rng = np.random.default_rng(1)
    depth = np.linspace(0.1, 2, 24)
    force = 1.3 * depth + 0.4 * depth**3 + 0.05 * rng.normal(size=24)
    drawn = posterior(fit(make_study(force, depth), ONE), draws=2000, seed=3)
    assert drawn.verdict(0).startswith("good")
    J = np.stack([depth, depth**3], axis=1)
    best, squares, *_ = np.linalg.lstsq(J, force)
    covariance = squares[0] / 22 * np.linalg.inv(J.T @ J) * 22 / 20
    values = 0.1 * drawn.theta[0].reshape(-1, 2)
    sd = np.sqrt(np.diag(covariance))
    # Some 2,500 effective draws: a mean to 0.02 standard deviations, these to 1.5 %; bars of four.
    np.testing.assert_allclose(values.mean(axis=0), best, atol=0.08 * sd.min(), rtol=0.02)
    np.testing.assert_allclose(values.std(axis=0), sd, rtol=0.06)
    found = np.corrcoef(values.T)[0, 1]
    np.testing.assert_allclose(found, covariance[0, 1] / np.prod(sd), atol=0.02)
    # Of sigma^2: inverse chi-square of 22 degrees.
    np.testing.assert_allclose(np.mean(drawn.sigma[..., 0] ** 2), squares[0] / 20, rtol=0.05)


@pytest.mark.slow
def test_curved_posterior_is_that_of_quadrature(blackjax):
    """Logarithms of k_1 and k_3 from 5 poor samples: skewed, both cut by bounds."""
    depth = np.linspace(0.3, 1.2, 5)
    force = 1.0 * depth + 0.2 * depth**3 + 0.3 * np.array([0.5, -1, 0.8, 0.1, -0.4])
    drawn = posterior(fit(make_study(force, depth, 0.3, "log"), ONE), draws=4000, seed=1)
    assert not drawn.verdict(0).startswith("poor")
    grid = np.linspace(np.log(0.1), np.log(30.0), 1501)
    a, b = np.meshgrid(np.exp(grid), np.exp(grid), indexing="ij")
    rest = a[..., None] * depth + b[..., None] * depth**3 - force
    weight = np.exp(-np.sum(rest**2, axis=-1) / (2 * 0.09))
    weight /= weight.sum()
    for i, marginal in enumerate((weight.sum(axis=1), weight.sum(axis=0))):
        share = np.searchsorted(np.sort(drawn.theta[0, ..., i].ravel()), grid) / 16000
        # Kolmogorov's distance of 1,000 independent draws stays below 0.06 with 99.9 %.
        assert np.max(np.abs(share - np.cumsum(marginal))) < 0.06
        mean = np.sum(marginal * grid)
        sd = np.sqrt(np.sum(marginal * (grid - mean) ** 2))
        assert sd > 0.3  # nothing that a linear expansion could know
        assert abs(drawn.theta[0, ..., i].mean() - mean) < 4 * sd / np.sqrt(drawn.ess[0, i])


def default_study(truths, seed=0):
    """One curve of 40 samples per truth, parameters and bounds as users have them: k_3 in [0, 1e6].

    Coordinates: ln k_1, and k_3 in hundredths, of which the bounds are 1e8 apart.
    """
    rng, depth = np.random.default_rng(seed), np.linspace(0.1, 2, 40)
    curves = [
        Curve(f"T{i}", "t", None, 0.0, depth,
              k_1 * depth + k_3 * depth**3 + 0.02 * rng.normal(size=40))
        for i, (k_1, k_3) in enumerate(truths)
    ]  # fmt: skip
    options = Options(coupling="total", onset_width=0.0)
    table = default_parameters(in_model(options, joints=False), {})
    return build_study(curves, table_1(), options, table)


def quadrature(curve):
    """2.5, 50 and 97.5 % quantiles of k_1 and k_3; sigma integrated away: S^(-n/2) / k_1."""
    J = np.stack([curve.displacement, curve.displacement**3], axis=1)
    best, squares, *_ = np.linalg.lstsq(J, curve.force)
    sd = np.sqrt(np.diag(np.linalg.inv(J.T @ J)) * squares[0] / 38)
    axes = [
        np.linspace(max(b - 8 * d, 1e-9), b + 8 * d, 801) for b, d in zip(best, sd, strict=True)
    ]
    offset = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1) - best
    S = squares[0] + np.einsum("abi,ij,abj->ab", offset, J.T @ J, offset)
    weight = (S / squares[0]) ** -20 / axes[0][:, None]
    out = []
    for axis, other in ((0, 1), (1, 0)):
        share = np.cumsum(weight.sum(axis=other)) / weight.sum()
        out.append(np.interp([0.025, 0.5, 0.975], share, axes[axis]))
    return np.array(out).T


def test_chains_start_where_the_estimate_is():
    """k_3 = 0.4 within [0, 1e6]: the centre of the chains was 1000, out of reach of a warm-up."""
    result = fit(default_study([(1.3, 0.4), (0.5, 1.0)]), ONE)
    for lane in range(2):
        start = around_the_fit(result, lane, (True, False), 200, 0)
        x = start.centre + start.y @ start.root.T
        share = 1 / (1 + np.exp(-x[:, :2]))
        low, high = result.study.lanes.lower[lane], result.study.lanes.upper[lane]
        theta = low + (high - low) * share
        se = result.uncertainty.se[lane]
        np.testing.assert_allclose(theta.mean(axis=0), result.theta[lane], atol=0.3 * se.max())
        np.testing.assert_allclose(theta.std(axis=0), se, rtol=0.15)
        found = np.corrcoef(theta.T)[0, 1]
        np.testing.assert_allclose(found, result.uncertainty.correlation[lane, 0, 1], atol=0.02)


@pytest.mark.slow
def test_chains_start_at_the_mode_of_the_posterior():
    """Curves of 30 and 10 samples that disagree: the fit weighs curves, the posterior samples."""
    rng = np.random.default_rng(1)
    curves = []
    for t, n, k in (("a", 30, 1.0), ("b", 10, 1.5)):
        depth = np.linspace(0.1, 2, n)
        curves.append(Curve("T", t, None, 0.0, depth, k * depth + 0.01 * rng.normal(size=n)))
    rows = [dataclasses.replace(DEFAULTS["k_1"], scale="linear", value=1.0)]
    zero = {"lower": -1.0, "value": 0.0, "fixed": True}
    rows += [dataclasses.replace(DEFAULTS[n], **zero) for n in ("k_3", "onset", "force_offset")]
    study = build_study(curves, table_1(), Options(coupling="total", onset_width=0.0), rows)
    result = fit(study, ONE)
    D, F = (np.concatenate([getattr(c, n) for c in curves]) for n in ("displacement", "force"))
    best = (D @ F) / (D @ D)
    assert abs(result.value[0, 0] - best) > 0.03
    np.testing.assert_allclose(mode(result).theta[0, 0], best, rtol=1e-6)


def test_poor_chains_are_said_beside_the_estimates():
    """No interval in report and table, a sentence under the estimates, empty cells, exit code 1."""
    drawn = made(1.55, 8.0, 0)
    found = AnalysisResults(drawn.result, ((POSTERIOR, drawn),))
    text = report_text("T", found, [])
    estimates = text.partition("## Estimates")[2].partition("## What")[0]
    assert "The posterior of 1 of 1 fits is not to be trusted" in estimates
    assert "poor: R-hat 1.550, 8 effective draws" in estimates
    assert [row[2:4] + row[-1:] for row in posterior_table(drawn, [0]).cells] == [
        ["–", "–", "poor"]
    ] * 2
    rows = list(parameter_rows(found))
    assert rows[0]["posterior_low95"] is rows[0]["posterior_median"] is None
    said = [item for item in overview(found) if isinstance(item, str)]
    assert any("not to be trusted" in text for text in said)
    assert poor(found)
    assert not poor(AnalysisResults(drawn.result, ((POSTERIOR, made(1.0, 900.0, 0)),)))


def test_arviz_and_xarray_read_the_draws(tmp_path):
    """Every draw in its unit, by chain, draw and specimen; units and divergences with them."""
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf", reason="h5netcdf is not installed")
    drawn = made(1.0, 900.0, 3)
    theta = np.random.default_rng(1).normal(size=drawn.theta.shape)
    drawn = dataclasses.replace(drawn, theta=theta)
    write_posterior(drawn, tmp_path / "posterior.nc")
    given = {"engine": "h5netcdf", "group": "posterior"}
    with xarray.open_dataset(tmp_path / "posterior.nc", **given) as read:
        assert dict(read.sizes) == {"chain": 2, "draw": 100, "specimen": 1}
        assert read.specimen.values.tolist() == ["T t"]
        for i, (p, _, _) in enumerate(drawn.result.study.unknowns[0]):
            found = read[p.name].transpose("specimen", "chain", "draw")
            expected = [[[p.from_scaled(v) for v in row] for row in theta[0, ..., i]]]
            np.testing.assert_allclose(found.values, expected, rtol=1e-12)
            assert found.attrs["units"] == p.unit
    given["group"] = "sample_stats"
    with xarray.open_dataset(tmp_path / "posterior.nc", **given) as read:
        assert read.diverging.dtype == bool
        assert int(read.diverging.sum()) == 3


@pytest.mark.slow
def test_well_conditioned_lanes_are_those_of_quadrature(blackjax):
    """Conditions 5 to 14, bounds and numbers of draws as users have them; 200 asked, more drawn."""
    result = fit(default_study([(1.3, 0.4), (0.5, 1.0), (1.0, 0.6)]), ONE)
    assert max(result.uncertainty.condition) < 20
    drawn = posterior(result, draws=200)
    for lane in range(3):
        assert drawn.rhat[lane].max() < 1.01
        assert drawn.ess[lane].min() > 400
        low, _, high = quadrature(result.study.curves[lane][0])
        width = high - low
        assert np.all(np.abs(drawn.lower[lane] - low) < 0.1 * width)
        assert np.all(np.abs(drawn.upper[lane] - high) < 0.1 * width)
        np.testing.assert_allclose(drawn.upper[lane] - drawn.lower[lane], width, rtol=0.1)
    assert drawn.steps.max() > 200


@pytest.mark.slow
def test_command_writes_what_its_page_says(tmp_path, monkeypatch, capsys, blackjax):
    monkeypatch.chdir(tmp_path)
    Path("good.csv").write_text(GOOD)
    Path("spec.toml").write_text(SPEC)
    code, _, _ = run(monkeypatch, capsys, "fit", "spec.toml", "--out", "out")
    assert code == 0
    text = (Path(__file__).parents[1] / "docs" / "results.md").read_text()
    body = re.split(r"^## ", text.partition("## Group posterior")[2], maxsplit=1, flags=re.M)[0]
    with h5py.File("out/results.h5") as file:
        names = sorted(f"posterior/{n}" for n in file["posterior"])
        assert names == sorted(re.findall(r"^\| `([\w/]+)` \|", body, re.M))
        low = file["posterior/lower"][0, 0]
    with Path("out/parameters.csv").open(newline="") as stream:
        assert float(next(csv.DictReader(stream))["posterior_low95"]) == low
    assert Path("out/posterior.nc").is_file()
    assert "4 chains of 100 draws" in Path("out/report.md").read_text()
