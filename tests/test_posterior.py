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

from jaxtrachea.identify.estimate import lane_of
from jaxtrachea.identify.fit import Settings, fit
from jaxtrachea.identify.measurements import Curve
from jaxtrachea.identify.parameters import DEFAULTS
from jaxtrachea.identify.posterior import Posterior, log_density, posterior
from jaxtrachea.identify.problem import Noise, build
from jaxtrachea.model import Options
from jaxtrachea.trachea.geometry import table_1

ONE = Settings(starts=1)
SPEC = '[data]\nfiles = "good.csv"\n[model]\ncoupling = "total"\n[uncertainty]\nposterior = 100\n'


def study(force, depth, noise=None, scale="linear"):
    """F = k_1 D + k_3 D^3, both free: linear, or their logarithms within narrow bounds."""
    bounds = {"lower": -1e3, "upper": 1e3} if scale == "linear" else {"lower": 0.1, "upper": 30.0}
    change = {"scale": scale, "value": 1.0, "step": 0.1} | bounds
    rows = [dataclasses.replace(DEFAULTS[n], **change) for n in ("k_1", "k_3")]
    rows += [DEFAULTS[n] for n in ("onset", "force_offset")]
    curve = Curve("T", "t", None, 0.0, depth, force)
    options = Options(coupling="total", onset_width=0.0)
    return build([curve], table_1(), options, rows, noise=Noise(force=noise))


@pytest.fixture
def blackjax():
    return pytest.importorskip("blackjax", reason="blackjax (extra 'bayes') is not installed")


def test_density_is_that_of_the_normal_noise():
    """Up to a constant: -n log sigma - S / 2 sigma^2 and the volume of the logistic map."""
    rng = np.random.default_rng(0)
    depth = np.linspace(0.1, 2, 12)
    force = 1.3 * depth + 0.4 * depth**3 + 0.1 * rng.normal(size=12)
    problem = study(force, depth, scale="log")
    lane, sigma = lane_of(problem, 0), jnp.array([0.2, 1.0])
    points = jnp.asarray(rng.normal(size=(20, 3)))
    density = lambda x: log_density(problem, (True, False), lane, sigma, x)  # noqa: E731
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
    result = fit(study(np.linspace(1, 3, 5), np.linspace(1, 3, 5)), ONE)
    theta, divergent = np.zeros((1, 2, 100, 2)), np.zeros((1, 2, 100), bool)
    divergent[0, 0, :lost] = True
    pair = lambda v: np.array([[v, v]])  # noqa: E731
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
    drawn = posterior(fit(study(force, depth), ONE), draws=2000, seed=3)
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
    drawn = posterior(fit(study(force, depth, 0.3, "log"), ONE), draws=4000, seed=1)
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
    assert "4 chains of 100 draws" in Path("out/report.md").read_text()
