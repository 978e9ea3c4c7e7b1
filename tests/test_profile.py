"""Profile likelihood against covariance where that is exact, scipy, and what cannot be known."""

import csv
import dataclasses
import re
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.stats
import synthetic
from run_cli import GOOD, run
from scipy.optimize import least_squares

from jaxtrachea.files.table import Column, Interval
from jaxtrachea.fitting.assessment import assess, limiting_bound
from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.lanes import Noise
from jaxtrachea.fitting.parameters import DEFAULTS
from jaxtrachea.fitting.profile_search import Sides
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.inference.analyses.profile import profile_rows
from jaxtrachea.inference.labels import verdict_sentence
from jaxtrachea.inference.profile import choose, profiles
from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.press import Options
from jaxtrachea.status import FitStatus, ProfileEnd
from jaxtrachea.trachea.geometry import table_1

pytestmark = pytest.mark.long

ONE = Settings(starts=1, verify=False)
PAGES = Path(__file__).parents[1] / "docs"
CLEAR = np.array([300.0, 1.0, 0.5, 0.2])


def linear_study(noise=Noise(), **table):  # noqa: B008 (frozen)
    """F = k_1 D + k_3 D^3 with noise, linear in both; curves of 30, 12 and 20 samples."""
    rng = np.random.default_rng(5)
    curves = []
    for i, (trial, n) in enumerate((("a", 30), ("b", 12), ("c", 20))):
        depth = np.linspace(0.2, 2, n)
        force = 1.3 * depth + 0.4 * depth**3 + 0.05 * rng.normal(size=n)
        curves.append(Curve("T1" if i < 2 else "T2", trial, None, 0.0, depth, force))
    linear = {"scale": "linear", "lower": -100.0, "upper": 100.0, "step": 0.1}
    names = ["k_1", "k_3", "onset", "force_offset"]
    change = {"k_1": linear | {"value": 1.0}, "k_3": linear} | table
    rows = [dataclasses.replace(DEFAULTS[n], **change.get(n, {})) for n in names]
    options = Options(coupling="total", onset_width=0.0)
    return build_study(curves, table_1(), options, rows, noise=noise)


@pytest.mark.parametrize("noise", [Noise(), Noise(force=0.05)], ids=["estimated", "given"])
def test_linear_model_has_the_interval_of_the_covariance(noise):
    """Exact for both kinds of noise, and with curves of unequal weight (the sandwich)."""
    result = fit(linear_study(noise), ONE)
    found = profiles(result, ONE, points=3)
    assert found.end.tolist() == [[ProfileEnd.CLOSED] * 2] * 4
    shape = (2, 2)
    # The ends are found to 1e-6 of the distance from the estimate.
    width = (result.upper - result.lower) / 2
    assert np.abs(found.lower.reshape(shape) - result.lower).max() <= 2e-6 * width.max()
    assert np.abs(found.upper.reshape(shape) - result.upper).max() <= 2e-6 * width.max()
    se = result.uncertainty.se.ravel()[:, None]
    at = (found.coordinate - result.theta.ravel()[:, None]) / se
    np.testing.assert_allclose(found.statistic, at**2, rtol=1e-5, atol=1e-6)
    assert not found.improved.any()


@pytest.mark.parametrize("profiled", [False, True], ids=["local", "profiled"])
def test_a_bound_of_the_user_within_the_interval_is_named(profiled):
    """Half a standard error beyond the estimate, in the linear model; the other side closes."""
    free = fit(linear_study(), ONE)
    bound = float(free.value[0, 0] - 0.5 * free.standard_error[0, 0])
    cut = fit(linear_study(k_1={"value": float(free.value[0, 0]), "lower": bound}), ONE)
    assert not cut.at_bound[0].any()
    found = profiles(cut, ONE, points=3) if profiled else None
    said = f"k_1 is limited by the lower bound {bound:.6g} N/mm: widen it before measuring more"
    assert said in verdict_sentence(cut, 0, found)
    word = "practically non-identifiable" if profiled else "identifiable"
    assert assess(cut, 0, 0, found).verdict == word
    assert "limited" not in verdict_sentence(free, 0)


def test_a_default_bound_is_not_named():
    """The same interval, whose bound nobody has set."""
    result = fit(linear_study(k_1={"upper": DEFAULTS["k_1"].upper}), ONE)
    high = result.upper.copy()
    high[0, 0] = 2 * DEFAULTS["k_1"].upper
    wide = dataclasses.replace(result, upper=high)
    assert limiting_bound(wide, 0, 0) is None
    assert limiting_bound(dataclasses.replace(wide, upper=result.upper), 0, 0) is None


@pytest.fixture(scope="module")
def curved():
    force, _ = synthetic.forces(synthetic.draw(7, 3, 1.3, CLEAR))
    noise = np.random.default_rng(8).normal(size=force.shape)
    force = force + 0.02 * np.abs(force).max((1, 2), keepdims=True) * noise
    result = fit(synthetic.study(force), ONE)
    return force, result, profiles(result, ONE, points=4)


@pytest.mark.slow
@pytest.mark.compiling
def test_every_point_is_the_constrained_optimum_of_scipy(curved):
    """Two specimens, four parameters, nine points each: cost to 1e-6 (measured 1e-12)."""
    force, result, found = curved
    for k in range(8):
        lane, i = found.lane[k], found.unknown[k]
        others = np.arange(4) != i

        def residual(x, theta, lane=lane, others=others):
            theta = np.where(others, 0.0, theta)
            theta[others] = x
            model = synthetic.forces(np.exp(theta)[None])[0][0]
            return (model - force[lane]).ravel() / result.sigma[lane, 0]

        best = result.theta[lane]
        least = 0.5 * np.sum(residual(best[others], best) ** 2)
        for theta, statistic in zip(found.theta[k], found.statistic[k], strict=True):
            scipy = least_squares(
                residual, best[others], "3-point", method="lm", xtol=1e-13, ftol=1e-13,
                gtol=1e-13, args=(theta,),
            )  # fmt: skip
            assert np.isclose(least + statistic / 2, scipy.cost, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.compiling
def test_ends_lie_on_the_threshold_and_batch_equals_one(curved):
    _, result, found = curved
    assert np.all(found.end == ProfileEnd.CLOSED)
    edge = np.log(np.stack([found.lower, found.upper], axis=1))
    # With points=5 the fourth point of each side lies at 0.8 x 1.25 = 1 of the way to the end.
    alone = profiles(result, ONE, ["k_M"], points=5)
    assert alone.statistic[:, [1, 9]] == pytest.approx(
        np.repeat(alone.threshold[:, None], 2, axis=1), rel=1e-5
    )
    of = found.unknown == 1
    np.testing.assert_allclose(alone.lower, found.lower[of], rtol=1e-9)
    np.testing.assert_allclose(alone.coordinate[:, [1, 9]], edge[of], rtol=1e-9)


@pytest.mark.slow
@pytest.mark.compiling
def test_what_one_position_cannot_tell_is_open():
    """EI_L and k_M act through one number: flat up to the bounds, and said so."""
    force, _ = synthetic.forces(np.array([[100.0, 1.0, 2.0, 0.2]]), s_c=np.array([75.0]))
    force = force + 0.01 * force.max() * np.random.default_rng(0).normal(size=force.shape)
    data = synthetic.curves(force, s_c=np.array([75.0]))
    result = fit(
        build_study(data, synthetic.GEOMETRY, synthetic.OPTIONS, synthetic.parameters()),
        Settings(starts=2),
    )
    found = profiles(result, ONE)
    assert found.upper[0] == found.upper[1] == np.inf
    assert found.lower[1] == 0
    assert found.end[1].tolist() == [ProfileEnd.OPEN] * 2
    # EI_L downwards: flat until k_M can rise no more.
    assert found.end[0].tolist() == [ProfileEnd.BOUND, ProfileEnd.OPEN]
    flat = found.statistic[1]
    assert np.nanmax(np.abs(flat)) < 1e-3
    cell = Interval(found.lower[1], found.upper[1], log=True)
    assert Column("k_1").text({"k_1": cell}) == "anything"


def test_an_estimate_on_its_bound_has_the_other_side():
    """k_1 may not exceed 1.2 (optimum near 1.3): open above, and closed below."""
    table = {"lower": 0.0, "upper": 1.2, "value": 1.0, "scale": "linear", "step": 0.1}
    result = fit(linear_study(k_1=table), ONE)
    found = profiles(result, ONE, ["k_1"])
    lane = int(np.flatnonzero(result.at_bound[:, 0])[0])
    k = found.find(lane, 0)
    assert found.end[k].tolist() == [ProfileEnd.CLOSED, ProfileEnd.OPEN]
    assert found.upper[k] == np.inf
    assert 0 < found.lower[k] < 1.2
    assert found.find(lane, 1) is None


def test_a_worse_minimum_is_told_and_failed_lanes_are_left_out():
    result = fit(linear_study(), ONE)
    moved = dataclasses.replace(result, theta=result.theta + np.array([[0.0, 3.0], [0.0, 0.0]]))
    assert profiles(moved, ONE, ["k_1"]).improved.tolist() == [True, False]
    status = np.array([FitStatus.MAX_ITERATIONS, FitStatus.CONVERGED])
    assert set(choose(dataclasses.replace(result, status=status), None)[0]) == {1}
    nothing = profiles(dataclasses.replace(result, status=status[[0, 0]]), ONE)
    assert nothing.statistic.shape == (0, 21)
    with pytest.raises(ValueError, match=r"'k_M' is not fitted, only k_1, k_3 are"):
        choose(result, ["k_M"])


def columns(heading):
    text = (PAGES / "results.md").read_text()
    body = re.split(r"^## ", text.partition(heading)[2], maxsplit=1, flags=re.M)[0]
    return re.findall(r"^\| `([\w/]+)` \|", body, re.M)


@pytest.mark.slow
@pytest.mark.compiling
def test_command_writes_what_its_page_says(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("good.csv").write_text(GOOD)
    text = '[data]\nfiles = "good.csv"\n[model]\ncoupling = "total"\n[parameters]\nk_1 = {}\n'
    Path("spec.toml").write_text(text)
    code, out, _ = run(monkeypatch, capsys, "fit", "spec.toml", "--profile", "--out", "out")
    assert code == 0
    assert "Profile likelihood" in out
    assert max(map(len, out.splitlines())) <= 80
    with Path("out/profiles.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert list(rows[0]) == columns("## profiles.csv")
    with h5py.File("out/results.h5") as file:
        assert sorted(f"profiles/{n}" for n in file["profiles"]) == sorted(
            columns("## Group profiles")
        )
        assert file["profiles/lower"][0] == pytest.approx(float(first_row()["profile_low95"]))
    report = Path("out/report.md").read_text()
    assert "## Profile likelihood" in report
    assert "](profiles.png)" in report
    assert Path("out/profiles.png").read_bytes()[:4] == b"\x89PNG"
    assert len(rows) == 2 * 21
    Path("spec.toml").write_text(text + '[uncertainty]\nprofile = "EI_L"\n')
    code, _, err = run(monkeypatch, capsys, "fit", "spec.toml")
    assert code == 2
    assert "uncertainty.profile: 'EI_L' is not fitted" in err


def first_row():
    with Path("out/parameters.csv").open(newline="") as stream:
        return next(csv.DictReader(stream))


def test_rows_hold_the_points(curved):
    _, result, found = curved
    rows = list(profile_rows(found))
    assert len(rows) == 12 * 9
    middle = rows[4]
    assert middle["statistic"] == 0
    assert middle["at"] == pytest.approx(result.value[0, 0])


def test_a_point_in_a_worse_minimum_is_passed_by(monkeypatch, curved):
    """Refits beyond 0.8 of the way land far too high once each: the ends stay where they were."""
    _, result, found = curved
    seen = set()
    usual = Sides.refit

    def spoilt(self, side, distance, start):
        theta, statistic = usual(self, side, distance, start)
        for i, (s, d) in enumerate(zip(side.tolist(), distance.tolist(), strict=True)):
            if s not in seen and d > 0.8 * self.first[s]:
                seen.add(s)
                statistic[i] += 50
        return theta, statistic

    monkeypatch.setattr(Sides, "refit", spoilt)
    again = profiles(result, ONE, points=2)
    assert len(seen) == 24
    np.testing.assert_allclose(again.lower, found.lower, rtol=1e-6)
    np.testing.assert_allclose(again.upper, found.upper, rtol=1e-6)


def constrained(x, C):
    """95 % interval of x[0] by least squares with x[1] >= 0: ends of the profile, and the longer.

    Where the profile meets x[1] = 0 on its way, its side is as long as the local one, at most as
    chi^2 with two degrees of freedom would make that of a parabola.
    """
    H, (c1, c2) = np.linalg.inv(C), np.sqrt(scipy.stats.chi2.ppf(0.95, (1, 2)))
    inside = x[1] >= 0
    best = x[0] if inside else x[0] + H[0, 1] / H[0, 0] * x[1]
    least = 0.0 if inside else x[1] ** 2 / C[1, 1]
    ends, longer = [], []
    for sign in (-1, 1):
        # Off the bound: (x - x0)^2 / C00. On it: H00 d^2 - 2 H01 d x1 + H11 x1^2.
        end = x[0] + sign * np.sqrt(C[0, 0] * (c1**2 + least))
        bounded = x[1] + C[0, 1] / C[0, 0] * (end - x[0]) < 0
        if bounded:
            rest = H[1, 1] * x[1] ** 2 - c1**2 - least
            d = np.roots([H[0, 0], -2 * H[0, 1] * x[1], rest])
            end = x[0] + d[np.argmax(sign * d)]
        side = sign * (end - best)
        ends.append(end)
        if bounded and inside:
            side = min(max(side, c1 * C[0, 0] ** 0.5), c2 / c1 * side)
        longer.append(best + sign * side)
    return best, ends, longer


def test_a_bound_of_another_unknown_shortens_no_interval():
    """F = k_1 D + k_3 D^3, k_3 >= 0 and truly 0: the interval of k_1 in closed form.

    A profile that ends where k_3 is 0 does not cover as it says (Self and Liang 1987): of truths on
    the bound 6 % lie outside the ends of all profiles, 8 % where the estimate is off the bound.
    """
    D, sigma = np.linspace(1.5, 2, 30), 0.05  # k_1 and k_3 are correlated by -0.99
    X = np.stack([D, D**3], axis=1)
    C = sigma**2 * np.linalg.inv(X.T @ X)
    rng = np.random.default_rng(11)
    draws = rng.multivariate_normal([1.3, 0.0], C, size=4_000)
    found = [constrained(x, C)[1:] for x in draws]
    missed = np.array([[not low <= 1.3 <= high for low, high in both] for both in found])
    off = draws[:, 1] > 0
    assert 0.05 < missed[:, 0].mean() < 0.065
    assert 0.07 < missed[off, 0].mean() < 0.1
    assert 0.03 < missed[:, 1].mean() < 0.05
    curves = [
        Curve(f"T{i:02}", "a", None, 0.0, D, 1.3 * D + sigma * rng.normal(size=30))
        for i in range(24)
    ]
    linear = {"scale": "linear", "lower": -100.0, "upper": 100.0, "step": 0.1, "value": 1.0}
    change = {"k_1": linear, "k_3": linear | {"lower": 0.0, "value": 0.1}}
    names = ("k_1", "k_3", "onset", "force_offset")
    rows = [dataclasses.replace(DEFAULTS[n], **change.get(n, {})) for n in names]
    options = Options(coupling="total", onset_width=0.0)
    study = build_study(curves, table_1(), options, rows, noise=Noise(force=sigma))
    result = fit(study, ONE)
    profiled = profiles(result, ONE, ["k_1"], points=2)
    growth, bounded = result.effective.growth, 0
    for lane, curve in enumerate(curves):
        best, _, (low, high) = constrained(np.linalg.lstsq(X, curve.force)[0], C)
        assessed = assess(result, lane, 0, profiled)
        assert result.value[lane, 0] == pytest.approx(best, rel=1e-6)
        assert assessed.low == pytest.approx(best + growth[lane] * (low - best), rel=1e-5)
        assert assessed.high == pytest.approx(best + growth[lane] * (high - best), rel=1e-5)
        bounded += ProfileEnd.BOUND in profiled.end[profiled.find(lane, 0)]
    assert 5 < bounded < 24
