"""Onsets and offsets that a record hides and its fit asks for."""

import csv
import dataclasses

import jax
import numpy as np
import pytest
from run_cli import run
from scipy.signal import lfilter

from jaxtrachea.fitting import build, omitted_zeros
from jaxtrachea.fitting.assessment import assess
from jaxtrachea.fitting.build import build_study, with_zeros
from jaxtrachea.fitting.fit import fit, with_omitted_zeros
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.fitting.zero_messages import sentences_of_fits
from jaxtrachea.measurements.curve import Curve
from jaxtrachea.mechanics.press import Options
from jaxtrachea.results.arrays import arrays_of
from jaxtrachea.results.read import read_results
from jaxtrachea.trachea.geometry import table_1

pytestmark = pytest.mark.long

TOTAL, WAY, SAMPLES = Options(coupling="total"), 4.0, 60
TRUTH = {"k_1": 0.1, "k_3": 0.01, "k_5": 0.002}
K_5 = {"k_5": {"value": 0.001, "lower": 0.0}}


def soft(rng, name, air, *, noise=0.002, more=0.0):
    """A press of a soft beginning that touches after `air` mm; `more`: of the 7th power."""
    D = np.linspace(0, WAY, SAMPLES)
    u = np.maximum(D - air, 0)
    F = TRUTH["k_1"] * u + TRUTH["k_3"] * u**3 + TRUTH["k_5"] * u**5 + more * u**7
    return Curve(name, "1", None, 0.0, D, F + noise * F.max() * rng.normal(size=SAMPLES))


@pytest.fixture(scope="module")
def mixed():
    """Six curves with air, six without; their fit, and the fit without further zeros."""
    rng = np.random.default_rng(3)
    airs = [0.2, 0.25, 0.3, 0.33, 0.36, 0.4, *[0.0] * 6]
    curves = [soft(rng, f"T{i:02d}", air) for i, air in enumerate(airs)]
    study = build_study(curves, table_1(), TOTAL, K_5)
    every = np.arange(len(curves))
    plain = fit(study.take(every), Settings(starts=2))  # a changed study asks for nothing
    whole = dataclasses.replace(plain, study=study)
    return np.array(airs), plain, with_omitted_zeros(study, whole, Settings(starts=2))


def columns_of(result, lanes):
    return omitted_zeros._columns(result, lanes, result.theta[lanes], result.study.take(lanes))


def contains(result, lane, name):
    """Whether the interval of a parameter holds the truth, and its verdict."""
    i = [p.name for p, _, _ in result.study.unknowns[lane]].index(name)
    found = assess(result, lane, i)
    return found.low <= TRUTH[name] <= found.high, found.verdict


def test_air_that_records_hide_is_fitted(mixed):
    airs, plain, result = mixed
    hidden = [k for k in range(6) if len(plain.study.unknowns[k]) == 3]
    assert len(hidden) >= 4
    wrong = [k for k in hidden if not contains(plain, k, "k_1")[0]]
    assert len(wrong) >= 4  # without this: "identifiable", and the truth is outside
    for lane in hidden:
        names = [p.name for p, _, _ in result.study.unknowns[lane]]
        for name, truth in (("onset", airs[lane]), ("k_1", TRUTH["k_1"])):
            i = names.index(name)
            error = assess(result, lane, i).standard_error
            assert abs(result.value[lane, i] - truth) < 3.5 * error
    assert sum(contains(result, k, "k_1")[0] for k in hidden) >= len(hidden) - 1
    assert result.succeeded.all()


def test_curves_without_air_keep_their_fit(mixed):
    _, plain, result = mixed
    assert result.study.size > plain.study.size
    P = plain.study.size
    for lane in range(6, 12):
        assert result.study.unknowns[lane] == plain.study.unknowns[lane]
        for name in ("theta", "value", "standard_error", "lower", "upper", "relative_se"):
            np.testing.assert_array_equal(
                getattr(result, name)[lane, :P], getattr(plain, name)[lane], err_msg=name
            )
        assert result.status[lane] == plain.status[lane]
        np.testing.assert_array_equal(result.study.lanes.active[lane, P:], 0)
        np.testing.assert_allclose(
            result.residuals["force"][lane], plain.residuals["force"][lane], rtol=0, atol=1e-13
        )
    assert not np.isnan(result.table().rows[-1]["value"])


def test_lanes_without_zeros_are_fitted_as_by_themselves(mixed, monkeypatch):
    """Where others take zeros: by a model that has them, or by one without."""
    *_, result = mixed
    takes, settings = result.study.takes_zeros, Settings(starts=2)
    assert 0 < takes.sum() < len(takes)
    study = result.study.take(np.arange(len(takes)))
    together = fit(study, settings)
    monkeypatch.setattr("jaxtrachea.fitting.fit.MANY_WITHOUT", 1)
    apart = fit(study, settings)
    assert np.isnan(apart.uncertainty.dispersion[~takes, 3:]).all()  # a model without zeros
    for name in ("value", "standard_error", "evidence_low", "cost", "sigma", "status", "minima"):
        one, other = getattr(apart, name), getattr(together, name)
        np.testing.assert_allclose(one, other, rtol=1e-6, err_msg=name)


def test_a_shard_that_takes_no_zeros_has_a_model_without_them(mixed, monkeypatch):
    """Where other lanes of its study take some: all of one shard, none of the next."""
    *_, result = mixed
    takes, settings = result.study.takes_zeros, Settings(starts=2)
    study = result.study.take(np.flatnonzero(~takes))
    together = fit(study, settings)
    monkeypatch.setattr("jaxtrachea.fitting.fit.MANY_WITHOUT", 1)
    apart = fit(study, settings)
    assert np.isnan(apart.uncertainty.dispersion[:, 3:]).all()  # a model without zeros
    for name, one in arrays_of(apart).items():
        other = arrays_of(together)[name]
        assert one.shape == other.shape, name
        if name in ("value", "standard_error", "cost", "sigma", "status", "minima"):
            np.testing.assert_allclose(one, other, rtol=1e-6, err_msg=name)
    assert apart.study.size == result.study.size


def test_notes_name_curve_and_value(mixed):
    _, plain, result = mixed
    assert sentences_of_fits(plain.study, plain.value) == []
    text = "\n".join(sentences_of_fits(result.study, result.value))
    assert "onset of" in text
    assert "from its fit" in text or "from their fits" in text


def test_columns_are_the_derivatives_of_the_press(mixed):
    """In closed form: of the press F(D - onset) + offset without a skeleton."""
    _, plain, _ = mixed
    lanes = np.array([7, 9])
    columns = columns_of(plain, lanes)
    place = {p.name: i for i, (p, _, _) in enumerate(plain.study.unknowns[7])}
    for n, lane in enumerate(lanes):
        D, k = plain.study.lanes.displacement[lane], plain.value[lane]
        k = {name: k[place[name]] for name in TRUTH}
        slope = k["k_1"] + 3 * k["k_3"] * D**2 + 5 * k["k_5"] * D**4
        sigma = plain.sigma[lane, 0]
        by_onset, by_offset = columns.zeros[n]
        np.testing.assert_allclose(by_onset[0, 1:], -slope[0, 1:] / sigma, rtol=1e-3)
        np.testing.assert_allclose(by_offset, 1 / sigma, rtol=1e-12)
        F = k["k_1"] * D  # scale log: k_1 dF/dk_1
        np.testing.assert_allclose(columns.unknowns[n, place["k_1"]], F / sigma, rtol=1e-4)


def test_the_promise_is_the_fall_of_the_sum_of_squares(mixed):
    """Of an offset, which is linear, by the normal equations of NumPy."""
    _, plain, _ = mixed
    lane = 8
    columns = columns_of(plain, np.array([lane]))
    J = columns.unknowns[0].reshape(3, -1)
    c, r = columns.zeros[0, 1].ravel(), columns.residual[0].ravel()
    left = c - J.T @ np.linalg.solve(J @ J.T, J @ c)
    gram = np.array([[c @ left]])
    fall, value = omitted_zeros._promise(gram, np.array([left @ r]), gram, [])
    A = np.column_stack([*J, c])
    _, without, *_ = np.linalg.lstsq(A[:, :3], -r)
    step, within, *_ = np.linalg.lstsq(A, -r)
    np.testing.assert_allclose(fall[0], without[0] - within[0], rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(value[0], step[3], rtol=1e-5)


def test_lanes_that_are_not_looked_at_one_by_one_would_ask_for_nothing(mixed):
    _, plain, _ = mixed
    lanes = np.arange(plain.lanes)
    columns, able = columns_of(plain, lanes), np.ones((plain.lanes, 2, 1), bool)
    chosen = [bool(omitted_zeros._chosen(plain, columns, n, able[n])) for n in lanes.tolist()]
    may = omitted_zeros._may_ask(plain, columns, able)
    assert any(chosen)
    assert not may.all()
    assert may[chosen].all()


def test_lanes_looked_at_a_few_at_a_time_ask_for_the_same(mixed, monkeypatch):
    _, plain, result = mixed
    every = np.arange(plain.lanes)
    found = omitted_zeros.asked_for(plain, every)
    assert found.names == {k: v for k, v in result.study.recipe.asked.items() if v}
    monkeypatch.setattr(omitted_zeros, "TOGETHER", 5)
    assert omitted_zeros.asked_for(plain, every) == found


def test_a_study_with_further_zeros_is_as_built_from_its_records():
    """What its records show is not looked for again; displacements and forces are not copied."""
    rng = np.random.default_rng(3)
    curves = [soft(rng, name, air) for name, air in (("T01", 0.2), ("T00", 0.2), ("T01", 1.5))]
    curves[2] = dataclasses.replace(curves[2], trial="2")
    study = build_study(curves, table_1(), TOTAL, K_5)
    asked = {("T00", "1"): {"onset"}}
    found = with_zeros(study, asked)
    assert np.shares_memory(found.lanes.force, study.lanes.force)
    anew = dataclasses.replace(study.recipe, asked=asked, zeros=None)
    expected = build._built([c for lane in study.curves for c in lane], anew)
    assert found.unknowns == expected.unknowns
    assert [lane[-1][0].name for lane in found.unknowns] == ["onset", "onset"]
    jax.tree.map(np.testing.assert_array_equal, found.lanes, expected.lanes)
    np.testing.assert_array_equal(found.record_zeros, expected.record_zeros)


def test_a_model_that_misses_the_curve_asks_for_nothing():
    """Forces of the 7th power and no air: correlated residuals are the model's, not a zero's."""
    rng = np.random.default_rng(5)
    curves = [soft(rng, f"T{i:02d}", 0.0, more=m) for i, m in enumerate([1e-4, 3e-4, 1e-3] * 4)]
    result = fit(build_study(curves, table_1(), TOTAL, K_5), Settings(starts=2))
    assert result.study.recipe is not None
    assert not any(result.study.recipe.asked.values())


@pytest.mark.slow
def test_air_of_one_curve_in_four_is_found_where_the_model_seemed_to_miss():
    """Coefficients that all curves share leave correlated residuals; with the onset none."""
    rng = np.random.default_rng(3)
    curves = [soft(rng, "T", air) for air in (0.25, 0.0, 0.0, 0.0)]
    curves = [dataclasses.replace(c, trial=str(t)) for t, c in enumerate(curves)]
    study = build_study(curves, table_1(), TOTAL, K_5)
    assert study.record_zeros is None
    result = fit(study, Settings(starts=2))
    assert result.study.recipe is not None
    assert result.study.recipe.asked == {("T", "0"): {"onset"}}
    assert contains(result, 0, "k_1") == (True, "identifiable")
    np.testing.assert_allclose(result.value[0, -1], 0.25, atol=0.005)


@pytest.mark.slow
def test_the_command_says_what_a_relaxing_record_hides(tmp_path, monkeypatch, capsys):
    """0.3 mm of air before a ramp and hold: k_1 was 0.074 +- 0.0024, "identifiable"."""
    step, speed, taus, shares = 0.0025, 0.5, (1.0, 20.0), (1.0, 1.5)
    time = np.arange(0, 4.3 / speed + 60, step)
    D = np.minimum(time * speed, 4.3)
    u = np.maximum(D - 0.3, 0)
    elastic = TRUTH["k_1"] * u + TRUTH["k_3"] * u**3 + TRUTH["k_5"] * u**5
    F = elastic.copy()
    for share, tau in zip(shares, taus, strict=True):  # exact for a straight piece
        fade = np.exp(-step / tau)
        gain = share * tau / step * (1 - fade)
        F += lfilter([gain], [1, -fade], np.diff(elastic, prepend=0.0))
    F = F[::20] + 0.002 * F.max() * np.random.default_rng(11).normal(size=len(F[::20]))
    rows = zip(time[::20], D[::20], F, strict=True)
    text = "".join(f"{t:.4f},{d:.5f},{f:.6f}\n" for t, d, f in rows)
    (tmp_path / "r07.csv").write_text("Time [s],Displacement [mm],Force [N]\n" + text)
    (tmp_path / "fit.toml").write_text(
        "[data]\nfiles = 'r07.csv'\nloading = 'record'\nsamples = 400\n"
        "[model]\ncoupling = 'total'\nrelaxation = 'uniform'\nbranches = 'prony-2'\n"
        "[parameters]\nk_5 = { initial = 0.001 }\n"
    )
    out = tmp_path / "out"
    code, _, err = run(monkeypatch, capsys, "fit", tmp_path / "fit.toml", "--out", out)
    assert code == 0
    assert "from its fit" in " ".join(err.split())
    assert "from its fit" in (out / "report.md").read_text()
    with (out / "parameters.csv").open(newline="") as stream:
        found = {row["parameter"]: row for row in csv.DictReader(stream)}
    for name, truth in {"onset": 0.3, **TRUTH}.items():
        assert abs(float(found[name]["value"]) - truth) < 3.5 * float(found[name]["se"])
    assert read_results(out).study.unknowns[0][-1][0].name in ("onset", "force_offset")


def test_short_curves_beside_long_ones_ask_by_chance_alone():
    """Each curve weighs the same, and one of 12 samples is as noisy as one of 400: a third asked.

    With three standard errors on each side a zero is asked for in 0.3 %.
    """
    rng, lengths = np.random.default_rng(8), (12, 40, 400)
    curves = []
    for i in range(60):
        for n in lengths:
            D = np.linspace(0, WAY, n)
            F = 0.3 * D + 0.02 * D**3 + 0.01 * rng.normal(size=n)
            curves.append(Curve(f"T{i:02d}", str(n), 75.0, 0.0, D, F))
    study = build_study(curves, table_1(), TOTAL)
    assert not study.takes_zeros.any()
    every = np.arange(60)
    plain = fit(study.take(every), Settings(starts=1, verify=False))
    found = omitted_zeros.asked_for(plain, every)
    assert len(found.names) <= 3
    columns, able = columns_of(plain, every), omitted_zeros.able_zeros(plain)
    asks = [bool(omitted_zeros._chosen(plain, columns, n, able[n])) for n in every.tolist()]
    assert omitted_zeros._may_ask(plain, columns, able)[asks].all()
