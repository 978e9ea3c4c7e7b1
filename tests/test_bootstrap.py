"""Bootstrap against closed forms of a linear model, with white and with correlated noise."""

import csv
import dataclasses
import inspect
import re
from pathlib import Path

import h5py
import numpy as np
import pytest
from run_cli import GOOD, run

from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.parameters import DEFAULTS
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.inference.bootstrap import Bootstrap, bootstrap, enlargement
from jaxtrachea.inference.cross_validation import leave_one_out
from jaxtrachea.inference.influence import influence
from jaxtrachea.inference.population import population
from jaxtrachea.inference.posterior import posterior
from jaxtrachea.inference.profile import profiles
from jaxtrachea.inference.repeats import leave_repeats_out
from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.press import Options
from jaxtrachea.trachea.geometry import table_1

ONE = Settings(starts=1, verify=False)
PAGES = Path(__file__).parents[1] / "docs"


def make_study(noises):
    """F = 1.3 D + 0.4 D^3 + noise, two curves of equal length for each specimen."""
    linear = {"scale": "linear", "lower": -100.0, "upper": 100.0, "step": 0.1}
    rows = [dataclasses.replace(DEFAULTS[n], **linear, value=1.0) for n in ("k_1", "k_3")]
    rows += [DEFAULTS[n] for n in ("onset", "force_offset")]
    depth = np.linspace(0.02, 2, noises.shape[-1])
    clean = 1.3 * depth + 0.4 * depth**3
    curves = [
        Curve(f"T{i}", f"t{j}", None, 0.0, depth, clean + noise)
        for i, specimen in enumerate(noises)
        for j, noise in enumerate(specimen)
    ]
    return build_study(curves, table_1(), Options(coupling="total", onset_width=0.0), rows)


@pytest.mark.slow
@pytest.mark.compiling
def test_white_noise_gives_the_standard_error_of_the_covariance():
    """1,000 replicates tell a standard deviation to 2.2 %; bar four of them; and 1.96 of it."""
    noise = 0.05 * np.random.default_rng(1).normal(size=(3, 2, 60))
    result = fit(make_study(noise), ONE)
    found = bootstrap(result, ONE, count=1000, kind="parametric")
    assert found.usable.all()
    np.testing.assert_allclose(found.standard_error, result.standard_error, rtol=0.09)
    # A 2.5 % quantile of 1,000 normal numbers is known to 0.085 standard deviations.
    slack = 0.34 * result.standard_error
    half = 1.96 * result.standard_error
    assert np.all(np.abs(found.lower - (result.value - half)) <= slack)
    assert np.all(np.abs(found.upper - (result.value + half)) <= slack)
    again = bootstrap(result, ONE, count=1000, kind="parametric")
    np.testing.assert_array_equal(again.theta, found.theta)


@pytest.mark.slow
@pytest.mark.compiling
def test_residuals_of_few_samples_are_enlarged_to_the_noise():
    """Six samples, two unknowns: the closed form of the linear model with residuals drawn anew.

    Residuals have sqrt(1 - 2 / 6) of the noise's spread; 1,000 replicates tell 2.2 %, bar four.
    """
    noise = 0.05 * np.random.default_rng(4).normal(size=(3, 2, 3))
    found = bootstrap(fit(make_study(noise), ONE), ONE, count=1000, kind="residual")
    depth = np.linspace(0.02, 2, 3)
    J = np.tile(np.stack([depth, depth**3], axis=1), (2, 1))
    solve = np.linalg.pinv(J)
    for specimen, error in zip(noise, found.standard_error, strict=True):
        r = (specimen.ravel() - J @ (solve @ specimen.ravel())).reshape(2, 3)
        drawn = np.var(r, axis=1).repeat(3) * 6 / (6 - 2)
        np.testing.assert_allclose(error, np.sqrt(solve**2 @ drawn), rtol=0.09)


@pytest.mark.slow
@pytest.mark.compiling
def test_blocks_see_correlated_noise():
    """AR(1) of 0.7: true error by the closed form of generalised least squares; median of 20."""
    n, r = 400, 0.7
    rng = np.random.default_rng(2)
    white = rng.normal(size=(20, 2, n))
    noise = np.zeros_like(white)
    for i in range(n):
        noise[..., i] = r * noise[..., i - 1] * (i > 0) + white[..., i]
    noise *= 0.05 * np.sqrt(1 - r * r)
    result = fit(make_study(noise), ONE)
    depth = np.linspace(0.02, 2, n)
    J = np.stack([depth, depth**3], axis=1)
    lag = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    pinv = np.linalg.inv(J.T @ J) @ J.T
    true = np.sqrt(np.diag(pinv @ (0.05**2 * r**lag) @ pinv.T) / 2)

    def share(block):
        return np.median(
            bootstrap(result, ONE, count=200, kind="residual", block=block).standard_error / true, 0
        )

    # Independent draws miss the factor sqrt((1 + r) / (1 - r)) = 2.4; blocks of 20 get most of it.
    assert np.all(share(1) < 0.5)
    assert np.all((share(20) > 0.8) & (share(20) < 1.1))


@pytest.mark.parametrize(
    ("n", "block", "lost"),
    [(60, 1, 1.0), (60, 6, 0.957), (22, 8, 0.832), (22, 20, 0.724), (1, 1, 1.0)],
)
def test_what_blocks_lose_is_that_of_their_sums(n, block, lost):
    """White residuals that sum to zero: b of n have the variance b (1 - b / n); half at most."""
    assert 1 / enlargement(n, block) == pytest.approx(lost, abs=6e-4)


def test_few_blocks_are_said():
    noise = np.random.default_rng(1).normal(size=(1, 2, 22))
    result = fit(make_study(noise), ONE)
    nothing = np.full((1, 2), np.nan)

    def note(block):
        drawn, lost = np.zeros((1, 40, 2)), np.zeros((1, 40), bool)
        return Bootstrap(result, "residual", block, drawn, lost, nothing, nothing, nothing).note

    assert note(1) == note(2) == ""
    assert "only 2.8 go to the shortest curve (22 samples)" in note(8)
    assert "about 0.83 of the true ones" in note(8)
    assert note(8).endswith("Better are blocks of 2 or less")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"count": 10}, "count is 10; expected at least 40"),
        ({"block": 3}, "block is 3"),
        ({"kind": "residual", "block": 0}, "block is 0"),
        ({"kind": "residual", "block": 13}, "block is 13; expected no more than the 12 samples"),
    ],
)
def test_impossible_settings_are_refused(change, says):
    result = fit(make_study(np.random.default_rng(1).normal(size=(1, 2, 12))), ONE)
    with pytest.raises(ValueError, match=says):
        bootstrap(result, ONE, **change)


@pytest.mark.parametrize(
    ("analysis", "given", "says"),
    [
        (bootstrap, ("result", 200), "settings is 200; expected Settings"),
        (bootstrap, (200,), "result is 200; expected FitResult"),
        (profiles, ("result", ["k_1"]), r"settings is \['k_1'\]; expected Settings"),
        (profiles, (None,), "result is None; expected FitResult"),
        (influence, (ONE,), "result is Settings.*; expected FitResult"),
        (influence, ("result", ONE), "batch is Settings.*; expected a whole number"),
        (leave_one_out, ("result", 4), "settings is 4; expected Settings"),
        (leave_one_out, ("study", ONE), "whole is .*; expected FitResult"),
        (leave_repeats_out, ("study", ONE), "whole is .*; expected FitResult"),
        (posterior, ("study",), "result is .*; expected FitResult"),
        (population, ("study",), "result is .*; expected FitResult"),
        (population, ("result", 3), "profiles is 3; expected Profiles or None"),
    ],
)
def test_another_record_is_a_clear_error(analysis, given, says):
    result = fit(make_study(np.random.default_rng(1).normal(size=(1, 2, 12))), ONE)
    records = {"result": result, "study": result.study}
    with pytest.raises(ValueError, match=says):
        inspect.unwrap(analysis)(*(records.get(v, v) if isinstance(v, str) else v for v in given))


def columns(heading):
    text = (PAGES / "results.md").read_text()
    body = re.split(r"^## ", text.partition(heading)[2], maxsplit=1, flags=re.M)[0]
    return re.findall(r"^\| `([\w/]+)` \|", body, re.M)


@pytest.mark.slow
@pytest.mark.compiling
def test_command_writes_what_its_page_says(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("good.csv").write_text(GOOD)
    text = '[data]\nfiles = "good.csv"\n[model]\ncoupling = "total"\n[uncertainty]\n'
    Path("spec.toml").write_text(text + 'bootstrap = 50\nkind = "residual"\nblock = 2\n')
    code, out, _ = run(monkeypatch, capsys, "fit", "spec.toml", "--out", "out")
    assert code == 0
    assert "Bootstrap" in out
    assert max(map(len, out.splitlines())) <= 80
    with h5py.File("out/results.h5") as file:
        group = file["bootstrap"]
        assert sorted(f"bootstrap/{n}" for n in group) == sorted(columns("## Group bootstrap"))
        assert (group.attrs["kind"], group.attrs["block"]) == ("residual", 2)
        low = group["lower"][0, 0]
    with Path("out/parameters.csv").open(newline="") as stream:
        assert float(next(csv.DictReader(stream))["bootstrap_low95"]) == low
    assert "residual in blocks of 2 samples" in Path("out/report.md").read_text()
    assert "a lane with fewer than 40 others has no interval" in Path("out/report.md").read_text()
    wide = 'bootstrap = 50\nkind = "residual"\nblock = 500'
    for bad, says in (
        ("bootstrap = 10", "40 replicates"),
        ("block = 2", "kind = 'residual'"),
        (wide, "block is 500; expected no more than the"),
    ):
        Path("spec.toml").write_text(text + bad)
        code, _, err = run(monkeypatch, capsys, "fit", "spec.toml")
        assert code == 2
        assert says in err
