"""Predictions from finished fits: bands that cover, left-out curves, what cannot be predicted."""

import csv
import dataclasses
import functools
import json
import math
import re
import shutil
from pathlib import Path

import beam_fem
import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import synthetic
from hardening import TWO, pairs, stored_again, total_study
from run_cli import run, tree
from scipy.stats import t as student

import jaxtrachea
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.lanes import Noise
from jaxtrachea.fitting.predictions import predictions
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.fitting.study import build_study
from jaxtrachea.fitting.tested import deeper_than_tested
from jaxtrachea.inference.analysis import Findings
from jaxtrachea.inference.cross_validation import leave_one_out
from jaxtrachea.inference.labels import verdict_sentence
from jaxtrachea.measurements.presses import parse_presses
from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.press import Options
from jaxtrachea.prediction import held_out
from jaxtrachea.prediction import plots as prediction_plots
from jaxtrachea.prediction.core import Estimate, predicted
from jaxtrachea.prediction.predict import predict_sources
from jaxtrachea.prediction.sources import Source, source_of
from jaxtrachea.results import stored
from jaxtrachea.results.hdf5 import read_hdf5, write_hdf5
from jaxtrachea.results.rows import lane_rows
from jaxtrachea.status import FitStatus, PredictionStatus, PressStatus
from jaxtrachea.trachea.geometry import table_1

ROOT = Path(__file__).parents[1]
VIRTUAL = ROOT / "fits" / "virtual_trachea"
TRUTH = np.array([300.0, 1.0, 0.5, 0.2])
DEPTHS = np.linspace(0.1, 6.0, 25)
SEEN, UNSEEN = (22.0, 45.0, 75.0, 80.0), (61.0, 107.0)
LANES = 24
NOISE = 0.02
COLUMNS = ("specimen", "trial", "s [mm]", "phi [deg]", "tilt [deg]", "displacement [mm]",
           "force [N]", "predicted [N]", "low95 [N]", "high95 [N]")  # fmt: skip


def true_force(s, depths=DEPTHS):
    """Force from the finite-element beam and the local law, by bisection; shares nothing."""
    EI, k_M, k_1, k_3 = TRUTH
    x = np.asarray(table_1().ring_positions)
    c = float(beam_fem.solve(x, 160.0, [EI] * 16, [k_M] * 15, s, 1.0).w_C)

    def law(d):
        return k_1 * d + k_3 * d**3

    low, high = np.zeros_like(depths), depths.copy()
    for _ in range(80):
        middle = 0.5 * (low + high)
        deep = middle + c * law(middle) > depths
        low, high = np.where(deep, low, middle), np.where(deep, middle, high)
    return law(low)


def rows_of(path):
    with path.open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def write_curves(path, curves):
    """A tidy file of curves."""
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(["specimen", "trial", "s [mm]", "displacement [mm]", "force [N]"])
        for c in curves:
            for d, f in zip(c.displacement, c.force, strict=True):
                writer.writerow([c.specimen, c.trial, c.s_c, float(d), float(f)])
    return path


def noisy_study(folder, noise, lanes, seed):
    """Specimens of one truth with noise of their own, pressed at four places; stored."""
    rng = np.random.default_rng(seed)
    force = np.stack([true_force(s) for s in SEEN])
    force = force + noise * rng.normal(size=(lanes, *force.shape))
    changes = {n: {"value": float(v)} for n, v in zip(synthetic.NAMES, TRUTH, strict=True)}
    curves = synthetic.curves(force, np.array(SEEN), DEPTHS)
    table = synthetic.parameters(**changes)
    result = fit(
        build_study(curves, table_1(), synthetic.OPTIONS, table), Settings(starts=1, scrutiny=False)
    )
    write_hdf5(folder / "results.h5", Findings(result), {"inputs": {"a.csv": "0" * 64}})
    return result


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """Folder and result of 24 specimens."""
    folder = tmp_path_factory.mktemp("fit")
    return folder, noisy_study(folder, NOISE, LANES, 7)


@pytest.fixture(scope="module")
def read(study):
    return jaxtrachea.read_results(study[0])


def check_coverage(read, noise):
    """Curve band: the true curve; with noise: new noisy samples; 93 to 97 % over the depths."""
    rng, lanes = np.random.default_rng(8), len(read.specimens)
    sources = [source_of(read, name) for name in read.specimens]
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
@pytest.mark.parametrize("noise", [NOISE, 0.15])
def test_bands_cover_in_2000_fits(noise, tmp_path):
    """Truth from finite elements; parameters known to 1 to 3 % and to 10 to 24 %."""
    noisy_study(tmp_path, noise, 2000, 70)
    check_coverage(jaxtrachea.read_results(tmp_path), noise)


@pytest.mark.slow
@pytest.mark.compiling
def test_everything_comes_back_from_the_file(study, read):
    _, result = study
    assert np.array_equal(read.theta, result.theta)
    assert read.study.parameters == result.study.parameters
    assert read.study.model.options == result.study.model.options
    u = result.uncertainty
    se = np.sqrt(np.diag(read.covariance[3]))
    assert np.allclose(se, u.se[3], rtol=1e-12)
    assert np.allclose(read.covariance[3], u.correlation[3] * np.outer(se, se), rtol=1e-9)
    for mine, its in zip(
        read.curves, (c for lane in result.study.curves for c in lane), strict=True
    ):
        assert np.array_equal(mine.force, its.force)
        assert (mine.specimen, mine.trial, mine.s_c) == (its.specimen, its.trial, its.s_c)
    with h5py.File(read.path) as file:
        seen = predictions(result.study, result.theta)
        assert np.array_equal(file["data/residual"][: len(DEPTHS)], seen.force[0, 0])


@pytest.mark.slow
@pytest.mark.compiling
def test_three_lines_of_python(study):
    results = jaxtrachea.read_results(study[0])
    curve = jaxtrachea.predict(results, s=61.0, displacement=[1.0, 2.0], specimen="s0003")
    assert np.all((curve.low95 < curve.curve_low95) & (curve.curve_high95 < curve.high95))
    assert np.isnan(curve.joint_sigma).all()  # this fit had no markers
    # Joints and reactions in equilibrium with each other: R = k_M w (paper 2.3).
    k_M = math.exp(results.theta[3, 1])
    assert np.allclose(curve.reactions, k_M * curve.joints, rtol=1e-12)
    EI = math.exp(results.theta[3, 0])
    x = np.asarray(table_1().ring_positions)
    fem = beam_fem.solve(x, 160.0, [EI] * 16, [k_M] * 15, 61.0, float(curve.force[1]))
    assert np.allclose(curve.joints[1], [float(w) for w in fem.w], rtol=1e-9, atol=1e-12)
    with pytest.raises(ValueError, match=f"{LANES} specimens .* give specimen="):
        jaxtrachea.predict(results, s=61.0, displacement=1.0)
    with pytest.raises(ValueError, match="expected one of 's0000'"):
        jaxtrachea.predict(results, s=61.0, displacement=1.0, specimen="x")
    with pytest.raises(ValueError, match=r"expected 0 to 160 mm"):
        jaxtrachea.predict(results, s=161.0, displacement=1.0, specimen="s0003")
    with pytest.raises(ValueError, match="finite"):
        jaxtrachea.predict(results, s=61.0, displacement=np.nan, specimen="s0003")
    with pytest.raises(ValueError, match="trial 'x'"):
        jaxtrachea.predict(results, s=61.0, displacement=1.0, specimen="s0003", trial="x")


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize("free", [True, False])
def test_residuals_and_bands_of_unequal_noise(free, tmp_path):
    """Sizes of residuals are in N and mm, bands of markers as wide as their own noise is."""
    measured = jaxtrachea.read_measurements(VIRTUAL / "small_strain.h5").curves[:2]
    weighed = [dataclasses.replace(c, sigma=0.01 * np.arange(1.0, len(c.force) + 1))
               for c in measured]  # fmt: skip
    noise = Noise(joints=5e-4, joints_share=0.06)
    values = {"k_3": 0.0, "EI_L": 300.0, "k_M": 1.0, "GA_L": 9.0}
    held = {name: {"fixed": True, "value": value} for name, value in values.items()}
    options = Options(contact="bonded", shear=True)
    changes = held | {"k_1": {} if free else {"fixed": True, "value": 2.0}}
    result = fit(build_study(weighed, table_1(), options, changes, noise=noise), TWO)
    write_hdf5(tmp_path / "r.h5", Findings(result), {})
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


def test_a_failed_lane_predicts_nothing(read):
    status = read.status.copy()
    status[3] = FitStatus.MAX_ITERATIONS
    failed = dataclasses.replace(read, status=status)
    source = source_of(failed, "s0003")
    assert source.status == PredictionStatus.NO_ESTIMATE
    (curve,) = predict_sources(failed, [source], [61.0], [DEPTHS])
    assert np.isnan(curve.force).all()
    assert np.isnan(curve.high95).all()
    assert FitStatus.MAX_ITERATIONS.message in curve.message


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
    source = source_of(read, "s0003")
    (curve,) = predict_sources(read, [source], [61.0], [np.array([3.0])])
    J = slope_at(read, source, 61.0)
    assert np.isclose(curve.se[0], np.sqrt(J @ read.covariance[3] @ J), rtol=1e-6)


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


def test_an_unknown_on_its_bound_is_said(read):
    held = np.zeros_like(read.at_bound)
    held[3, 2] = True
    source = source_of(dataclasses.replace(read, at_bound=held), "s0003")
    assert source.status == PredictionStatus.AT_BOUND
    assert "k_1 held" in source.message


def test_a_band_that_the_model_bends_in_is_said(read):
    """A hundred times the standard errors: the ends of the linear band are off."""
    source = source_of(read, "s0003")
    wide = dataclasses.replace(source, covariance=1e4 * source.covariance)
    (curve,) = predict_sources(read, [wide], [61.0], [np.array([3.0])])
    assert curve.status == PredictionStatus.BENT


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
@pytest.mark.parametrize("given", [None, 0.02])
def test_linear_model_has_the_bands_of_the_text_book(given, tmp_path):
    """Least squares on D and D^3 (numpy): s^2 (X^T X)^-1, t or, with given noise, z."""
    curves = list(pairs())
    read = stored_again(total_study(curves, noise=Noise(force=given)), tmp_path / "r.h5")
    D, F = (np.concatenate([getattr(c, n) for c in curves[:2]]) for n in ("displacement", "force"))
    X = np.stack([D, D**3], axis=1)
    beta, rss, *_ = np.linalg.lstsq(X, F, rcond=None)
    s = given or np.sqrt(rss[0] / (len(D) - 2))
    half = 1.959963984540054 if given else student.ppf(0.975, len(D) - 2)
    at = np.array([0.5, 3.0])
    rows = np.stack([at, at**3], axis=1)
    error = s * np.sqrt(np.sum(rows @ np.linalg.inv(X.T @ X) * rows, axis=1))
    mine = jaxtrachea.predict(read, s=80.0, displacement=at, specimen="T1")
    assert np.allclose(mine.force, rows @ beta, rtol=1e-8)
    assert np.allclose(mine.curve_high95, rows @ beta + half * error, rtol=1e-7)
    assert np.allclose(mine.low95, rows @ beta - half * np.hypot(s, error), rtol=1e-7)
    assert "extrapolated" in mine.message
    assert np.isnan(mine.joints).all()
    # A sigma of the curve itself counts where the fit's noise was given, not where it is a weight.
    new = dataclasses.replace(curves[0], trial="c", sigma=np.full(30, 0.5))
    (found,) = held_out.compare(read, [new])
    assert np.allclose(found.prediction.sigma, 0.5 if given else s, rtol=1e-7)


@pytest.mark.slow
@pytest.mark.compiling
def test_left_out_curve_is_that_of_leave_one_out(tmp_path):
    """Fit without a curve, written, read, predicted: the residual of `leave_one_out` to 1e-9."""
    curves = list(pairs())
    study = total_study(curves)
    left = leave_one_out(fit(study, TWO), TWO)
    truth = predictions(study.take(left.lane), left.result.theta).force
    for row in (0, 3):
        lane, trial = left.lane[row], left.trial[row]
        out = study.curves[lane][trial]
        read = stored_again(total_study([c for c in curves if c is not out]), tmp_path / f"{row}")
        (found,) = held_out.compare(read, [out])
        assert np.allclose(found.residual, truth[row, trial], rtol=0, atol=1e-9)
        assert found.in_fit == "no"


def only(read, lanes):
    """The same fit of the first lanes alone."""
    fields = ("theta", "covariance", "null_space", "at_bound", "status", "sigma", "half_width",
              "lane_names")  # fmt: skip
    count = int(np.sum(read.curve_lane < lanes))
    cut = {name: getattr(read, name)[:lanes] for name in fields}
    study = dataclasses.replace(read.study, unknowns=read.study.unknowns[:lanes])
    curves = {name: getattr(read, name)[:count] for name in ("curves", "curve_lane", "blend")}
    return dataclasses.replace(read, study=study, **cut, **curves)


def test_unknown_specimens(read):
    """Own parameters of several specimens: no; of one, or all shared: yes, and it is said."""
    new = dataclasses.replace(read.curves[0], specimen="T9")
    (found,) = held_out.compare(read, [new])
    assert found.prediction.status == PredictionStatus.UNKNOWN_SPECIMEN
    assert f"k_1, k_3 belongs to each of {LANES} specimens" in found.prediction.message
    assert np.isnan(found.prediction.force).all()
    (known,) = held_out.compare(read, [dataclasses.replace(new, specimen="s0002")])
    (found,) = held_out.compare(read, [new], as_specimen="s0002")
    assert "predicted as specimen 's0002'" in found.prediction.message
    assert np.array_equal(found.prediction.force, known.prediction.force)

    def share(p):
        return dataclasses.replace(p, scope="specimen" if p.fixed else "shared")

    study = dataclasses.replace(
        read.study,
        parameters=tuple(map(share, read.study.parameters)),
        unknowns=tuple(
            tuple((share(p), "", "") for p, _, _ in lane) for lane in read.study.unknowns
        ),
    )
    for one in (only(read, 1), dataclasses.replace(read, study=study)):
        (found,) = held_out.compare(one, [new])
        assert "a new specimen" in found.prediction.message
        assert np.isfinite(found.prediction.high95).all()


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
def test_core_in_float32(read):
    """Jitted and batched as the command uses it in float64, which other tests check."""
    sources = [source_of(read, f"s{i:04d}") for i in range(3)]
    rows = [np.stack([getattr(s, n) for s in sources]) for n in Estimate._fields]
    estimate = Estimate(*(jnp.asarray(v, np.float32) for v in rows))
    place, depth = np.full(3, 61.0, np.float32), np.tile(np.float32([1.0, 4.0]), (3, 1))
    program = functools.partial(predicted, read.study.model)
    batch = jax.jit(jax.vmap(program))(estimate, jnp.asarray(place), jnp.asarray(depth))
    assert batch.value.force.dtype == batch.se.joints.dtype == np.float32
    exact = predict_sources(read, sources, [61.0] * 3, [np.array([1.0, 4.0])] * 3)
    for k, curve in enumerate(exact):
        assert np.allclose(batch.value.force[k], curve.force, rtol=2e-5)
        assert np.allclose(batch.se.force[k], curve.se, rtol=2e-3)
        assert np.allclose(batch.se.joints[k], curve.joints_se, rtol=1e-2, atol=1e-5)


@pytest.mark.slow
@pytest.mark.compiling
def test_fixed_specification_is_evaluated(tmp_path):
    """Nothing free: residuals, cost and noise by hand; predicted with a band of noise alone."""
    curves = list(pairs())
    fixed = {"k_1": {"value": 1.0, "fixed": True}, "k_3": {"value": 0.1, "fixed": True}}
    result = fit(total_study(curves, fixed))
    D, F = curves[0].displacement, np.concatenate([c.force for c in curves[:2]])
    residual = np.tile(D + 0.1 * D**3, 2) - F
    sigma = np.sqrt(np.mean(residual**2))
    assert result.lanes == 2
    assert np.isclose(result.rms[0, 0], sigma, rtol=1e-12)
    assert np.isclose(result.sigma[0, 0], sigma, rtol=1e-12)
    assert np.isclose(result.cost[0], 0.5 * 60)
    assert result.criteria.unknowns[0] == 1
    row = next(lane_rows(result))
    assert "nothing was fitted" in str(row["message"])
    assert "nothing was fitted" in verdict_sentence(result, 0)
    write_hdf5(tmp_path / "r.h5", Findings(result), {})
    read = jaxtrachea.read_results(tmp_path / "r.h5")
    curve = jaxtrachea.predict(read, s=80.0, displacement=1.0, specimen="T1")
    assert curve.se == 0
    assert np.allclose(curve.high95 - 1.1, student.ppf(0.975, 60) * sigma)


@pytest.mark.slow
@pytest.mark.compiling
def test_fixed_specification_on_the_command_line(tmp_path, monkeypatch, capsys):
    """It is evaluated, its results predict; what doubts an estimate says that there is none."""
    text = '[data]\nfiles = "a.csv"\n[model]\ncoupling = "total"\n[parameters]\n'
    text += "k_1 = { fixed = 1.0 }\nk_3 = { fixed = 0.1 }\n"
    spec, out = tmp_path / "spec.toml", tmp_path / "out"
    spec.write_text(text)
    write_curves(tmp_path / "a.csv", [dataclasses.replace(c, s_c=80.0) for c in pairs()])
    code, said, err = run(monkeypatch, capsys, "fit", spec, "--out", out)
    assert code == 0, err
    assert "nothing was fitted" in said
    names = {"results.h5", "summary.csv", "parameters.csv", "report.md", "report.html", "fit.png",
             "residuals.png", "provenance.json"}  # fmt: skip
    assert names <= set(tree(out))
    assert "correlation.png" not in tree(out)
    report = (out / "report.md").read_text()
    assert "None: every parameter is fixed" in report
    assert "What the data determine" not in report
    assert "standard errors" not in report + said
    assert "more, see" not in report
    assert [r["specimen"] for r in rows_of(out / "summary.csv")] == ["T1", "T2"]
    for option in ("--profile", "--leave-one-out", "--influence"):
        code, _, err = run(monkeypatch, capsys, "fit", spec, option)
        assert code == 2
        assert f"{option}: every parameter is fixed" in err
    code, _, err = run(monkeypatch, capsys, "design", spec)
    assert code == 2
    assert "design: every parameter is fixed" in err
    data = ["--data", tmp_path / "a.csv", "--out", tmp_path / "p"]
    code, _, err = run(monkeypatch, capsys, "predict", out, *data)
    assert code == 0, err
    fitted = {r["specimen"]: float(r["rms_force_N"]) for r in rows_of(out / "summary.csv")}
    errors = [r for r in rows_of(tmp_path / "p" / "errors.csv") if r["of"] == "curve"]
    assert {r["in_fit"] for r in errors} == {"yes"}
    for name, rms in fitted.items():
        mine = [float(r["rms [N]"]) for r in errors if r["specimen"] == name]
        assert np.isclose(np.sqrt(np.mean(np.square(mine))), rms, rtol=1e-9)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "expected s, D, phi, tilt, specimen or trial"),
        ("75", "expected s, D, phi, tilt, specimen or trial"),
        ("s=75", "no displacement D"),
        ("D=2", "no contact position s"),
        ("s=75,D=two", "neither a length nor a range"),
        ("s=75,D=2 N", "'N' does not measure length"),
        ("s=75,D=2,D=3", "D is given twice"),
        ("s=75,D=0:6:-1", "do not lead from 0 to 6"),
        ("s=75,D=0:6:0", "do not lead from 0 to 6"),
        ("s=75,D=0:1e9:1e-3", "more than 100000"),
        ("s=0:160:0.1,D=0:6:0.01", "more than 100000"),
        ("s=75,D=1e999", "finite"),
        ("s=75,D=2,q=1", "'q=1' is not understood"),
        ("s=75,D=2,phi=north", "phi:"),
        ("s=75,D=2,phi=1_0", "phi:"),
        ("s=75,D=2,phi=nan", "expected a finite angle"),
        ("s=75,D=2,tilt=90", "moves inwards; expected within 90 deg"),
        ("s=75,D=2,tilt=1 mm", "tilt:"),
    ],
)
def test_presses_that_make_no_sense(text, says):
    with pytest.raises(ValueError, match=says.replace("(", r"\(")):
        parse_presses(text, needs_position=True)


def test_presses_in_units_and_ranges():
    found = parse_presses("s = 7.5 cm, D=0:2000:500 um, specimen=a,b, trial=x", needs_position=True)
    assert np.allclose(found.s, [75.0])
    assert np.allclose(found.displacement, [0, 0.5, 1, 1.5, 2])
    assert (found.specimen, found.trial) == ("a,b", "x")
    assert np.allclose(
        parse_presses("D=1:-0.5:-0.5", needs_position=False).displacement, [1, 0.5, 0, -0.5]
    )


def test_a_range_ends_within_its_end():
    """Whole steps: the end is a value where one ends on it; without a step 20 lead to it."""
    for text, values in (
        ("D=0:1:0.3", [0, 0.3, 0.6, 0.9]),
        ("D=0:0.9:0.3", [0, 0.3, 0.6, 0.9]),
        ("D=0:1", np.linspace(0, 1, 21)),
    ):
        found = parse_presses(text, needs_position=False)
        np.testing.assert_allclose(found.displacement, values, atol=1e-12)
    for text in ("D=two", "D=0:1:-0.3"):
        with pytest.raises(ValueError, match="whole steps from START, none beyond STOP"):
            parse_presses(text, needs_position=False)
    page = (Path(__file__).parents[1] / "docs/predict.md").read_text()
    assert "0:1:0.3" in page
    assert "the end is included" not in page


def test_presses_aside_in_degrees_or_a_unit():
    """Tan 45 deg is 1; growing phi is positive."""
    found = parse_presses("s=75,D=2,phi=-30,tilt=0.25 rad", needs_position=True)
    assert np.isclose(found.phi, -np.pi / 6, rtol=1e-15)
    assert np.isclose(found.direction[1] / found.direction[0], np.tan(0.25), rtol=1e-15)
    plain = parse_presses("s=75,D=2,phi=0", needs_position=True)
    assert (plain.phi, plain.direction) == (0.0, (1.0, 0.0))


@pytest.mark.parametrize("aside", ["phi=30 deg", "tilt=10"])
def test_a_line_of_joints_is_pressed_on_the_midline(study, tmp_path, monkeypatch, capsys, aside):
    at = ("--at", f"s=75,D=2,{aside}", "--out", tmp_path / "a")
    code, _, err = run(monkeypatch, capsys, "predict", study[0], *at)
    assert code == 2
    assert "anterior midline" in err
    assert "skeleton = 'sections'" in " ".join(err.split())
    assert not (tmp_path / "a").exists()


def test_a_curve_with_its_signs_turned_is_not_compared(read):
    """As in a fit: compression counted negative is a pull to a tool that only touches."""
    good = Curve("s0001", "new", 61.0, 0.0, DEPTHS, true_force(61.0))
    turned = dataclasses.replace(good, trial="turned", force=-good.force)
    kept, (bad,) = held_out.pressable(read, [good, turned])
    assert kept == [good]
    assert (bad.trial, bad.kind) == ("turned", "sign")
    assert "pulls" in bad.reason


def test_command_writes_what_the_page_says(study, tmp_path, monkeypatch, capsys):
    data = [Curve("s0001", "new", 61.0, 0.0, DEPTHS, true_force(61.0)),
            Curve("s0002", "off", 200.0, 0.0, DEPTHS, true_force(61.0)),
            Curve("$T9 $x", "new", 61.0, 0.0, DEPTHS, true_force(61.0))]  # fmt: skip
    file = write_curves(tmp_path / "new.csv", data)
    code, out, err = run(
        monkeypatch, capsys, "predict", study[0], "--data", file, "--out", tmp_path / "a"
    )
    assert code == 1
    assert "position" in err
    assert "unknown" in out
    rows = rows_of(tmp_path / "a" / "predictions.csv")
    assert tuple(rows[0]) == COLUMNS
    assert len(rows) == 2 * len(DEPTHS)
    good = [r for r in rows if r["specimen"] == "s0001"]
    miss = [abs(float(r["force [N]"]) - float(r["predicted [N]"])) for r in good]
    errors = rows_of(tmp_path / "a" / "errors.csv")
    one = next(r for r in errors if r["specimen"] == "s0001")
    assert np.isclose(float(one["rms [N]"]), np.sqrt(np.mean(np.square(miss))))
    assert np.isclose(abs(float(one["worst [N]"])), max(miss))
    assert one["coverage95"] == "1.0"
    assert {r["status"] for r in errors if r["of"] == "curve"} == {
        "ok",
        "unknown_specimen",
        "bad_data",
    }
    assert [r["of"] for r in errors] == ["curve", "curve", "position", "all", "curve"]
    names = {"predictions.csv", "bands.csv", "joints.csv", "errors.csv", "report.md", "curves.png",
             "measured_predicted.png"}  # fmt: skip
    assert set(tree(tmp_path / "a")) == names
    code, out, err = run(
        monkeypatch, capsys, "predict", study[0] / "results.h5", "--at",
        "s=6.1 cm,D=0:6:2,specimen=s0001", "--out", tmp_path / "b",
    )  # fmt: skip
    assert (code, err) == (0, "")
    page = (ROOT / "docs" / "predict.md").read_text()
    for path in (*(tmp_path / "a").iterdir(), *(tmp_path / "b").iterdir()):
        assert f"`{path.name}`" in page
        if path.suffix == ".csv":
            assert all(f"`{name}`" in page for name in rows_of(path)[0]), path
    joints = rows_of(tmp_path / "b" / "joints.csv")
    assert len(joints) == 4 * 15
    assert float(joints[-8]["reaction_low95 [N]"]) < float(joints[-8]["reaction [N]"])


def test_pictures_say_what_they_leave_out_and_cost_themselves_only(read, tmp_path, monkeypatch):
    """13 specimens, one of 11 curves, names that matplotlib would read; a picture that fails."""
    at = {"s": 61.0, "displacement": DEPTHS}
    one = jaxtrachea.predict(read, specimen="s0003", **at)
    names = ["$T9 $x", "_hidden", *(f"s{i}" for i in range(11))]
    many = [dataclasses.replace(one, specimen=name, trial="$a_$") for name in names]
    titles = [axis.get_title() for axis in prediction_plots._panels(many_pairs(many)).axes]
    assert titles[:2] == [r"\$T9 \$x", " _hidden"]
    title = prediction_plots._panels(many_pairs(many)).get_suptitle()
    assert title == "the first 12 of 13 specimens; all: predictions.csv"
    figure = prediction_plots._panels(many_pairs([one] * 11))
    assert figure.axes[0].get_title() == "s0003 (the first 10 of 11 curves)"
    assert figure.get_suptitle() == "all: predictions.csv"
    curve = dataclasses.replace(read.curves[0], displacement=DEPTHS)
    compared = [held_out.Compared(curve, p, "no") for p in many[:2]]

    def fail(*_):
        raise ValueError("no room")

    with monkeypatch.context() as patch:
        patch.setattr(prediction_plots, "_panels", fail)
        lost = prediction_plots.draw_compared(tmp_path, compared)
    assert lost == {"curves.png": "ValueError: no room"}
    assert list(tree(tmp_path)) == ["measured_predicted.png"]
    assert prediction_plots.draw_predictions(tmp_path, many[:2]) == {}


def many_pairs(curves):
    return [(curve, None) for curve in curves]


def old(folder):
    """As schema 1 was written: no model, no data, no covariance."""
    with h5py.File(folder / "results.h5", "r+") as file:
        file.attrs["schema_version"] = 1
        del file["model"], file["data"], file["uncertainty/covariance"]


def cut(folder):
    path = folder / "results.h5"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def newer(folder):
    with h5py.File(folder / "results.h5", "r+") as file:
        file.attrs["schema_version"] = 3


def other(folder):
    with h5py.File(folder / "results.h5", "r+") as file:
        file.attrs["schema"] = "jaxtrachea-simulation"


def without_model(folder):
    with h5py.File(folder / "results.h5", "r+") as file:
        del file["model/description"]


def not_json(folder):
    with h5py.File(folder / "results.h5", "r+") as file:
        file["model/description"][3] = 0


def wrong_shape(folder):
    with h5py.File(folder / "results.h5", "r+") as file:
        del file["lanes/sigma"]
        file["lanes/sigma"] = np.ones(3)


def linked(folder):
    with h5py.File(folder / "results.h5", "r+") as file:
        del file["data/force"]
        file["data/force"] = h5py.ExternalLink("/etc/passwd", "/x")


def gone(folder):
    (folder / "results.h5").unlink()


def unfinished(folder):
    gone(folder)
    (folder / ".run").mkdir()


@pytest.mark.parametrize(
    ("harm", "says"),
    [
        (old, "schema version 1 .* fit again with this version"),
        (cut, "damaged"),
        (newer, "schema version is 3, this program reads 2"),
        (other, "expected 'jaxtrachea-results'"),
        (without_model, "no dataset 'description'"),
        (not_json, "damaged or not written by this program"),
        (wrong_shape, r"sigma has shape \(3,\)"),
        (linked, "soft or external link"),
        (gone, "no results.h5 in this folder"),
        (unfinished, "--resume"),
    ],
)
def test_results_that_cannot_be_read(harm, says, study, tmp_path):
    shutil.copytree(study[0], tmp_path / "r")
    harm(tmp_path / "r")
    with pytest.raises(jaxtrachea.NoResults, match=says):
        stored.read_results(tmp_path / "r")


def test_schema_1_serves_to_fit_failed_lanes_again(study, tmp_path):
    """What `--rerun-failed` needs is in it; the covariance follows from errors and correlation."""
    shutil.copytree(study[0], tmp_path / "r")
    old(tmp_path / "r")
    again = read_hdf5(tmp_path / "r" / "results.h5", study[1].study)
    assert np.array_equal(again.theta, study[1].theta)
    mine, its = again.uncertainty.covariance, study[1].uncertainty.covariance
    assert np.allclose(mine, its, rtol=1e-9)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["RESULTS"], "give either --at"),
        (["RESULTS", "--at", "s=1,D=1", "--data", "x.csv"], "give either --at"),
        (["RESULTS", "x.csv"], "come after --data"),
        (["nowhere", "--at", "s=75,D=1"], "no such folder or file"),
        (["RESULTS", "--at", "s=75"], "no displacement D"),
        (["RESULTS", "--at", "s=175,D=1"], "expected 0 to 160 mm"),
        (["RESULTS", "--at", "s=75,D=1,specimen=x"], "specimen 'x' is not in this fit"),
        (["RESULTS", "--at", "s=75,D=1,specimen=s0001,trial=x"], "trial 'x' is not in this fit"),
        (["RESULTS", "--data", "nowhere.csv"], "no file"),
        (["RESULTS", "--data", "nowhere.toml"], "nowhere.toml"),
        (["RESULTS", "--data", "results.h5"], "holds the results of a fit"),
        (["RESULTS", "--data", "off.csv"], "no usable curve"),
        (["RESULTS", "--data", "off.csv", "--as", "x"], "specimen 'x' is not in this fit"),
        (["RESULTS", "--data", "tube.toml"], "120 mm with 2 rings, but the fit's is 160 mm"),
        (["RESULTS", "--data", "model.toml"], "model: not that of the fit"),
        (
            ["RESULTS", "--at", "s=75,D=1,specimen=s0001", "--out", "full"],
            "exists and is not empty",
        ),
        (["RESULTS", "--at", "s=75,D=1,specimen=s0001", "--out", "off.csv/x"], "off.csv"),
    ],
)
def test_bad_input_ends_with_a_cure(arguments, says, study, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_curves(tmp_path / "off.csv", [Curve("s0001", "a", 200.0, 0.0, DEPTHS, DEPTHS)])
    shutil.copy(study[0] / "results.h5", tmp_path)
    tube = '[trachea]\nlength = "120 mm"\nrings = ["30 mm", "60 mm"]\n'
    (tmp_path / "tube.toml").write_text(f'[data]\nfiles = "off.csv"\n{tube}')
    (tmp_path / "model.toml").write_text('[data]\nfiles = "off.csv"\n[model]\nshear = true\n')
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "x").touch()
    before = tree(tmp_path)
    names = [str(study[0]) if a == "RESULTS" else a for a in arguments]
    code, _, err = run(monkeypatch, capsys, "predict", *names)
    assert code == 2
    assert says in " ".join(err.split())
    assert "Traceback" not in err
    assert tree(tmp_path) == before


@pytest.mark.slow
@pytest.mark.compiling
def test_virtual_trachea_ten_positions_by_the_command(tmp_path, monkeypatch, capsys):
    """The command on fits of nine positions predicts the tenth as `--leave-one-out` does.

    Ten specimens of nine curves in one file: each is a fit of its own.
    """
    from jaxtrachea.cli.specification import settings_of, study_of
    from jaxtrachea.config import load_fit_spec
    from jaxtrachea.measurements.data_files import read_data
    from jaxtrachea.measurements.read import Measurements, write_hdf5

    spec = load_fit_spec(VIRTUAL / "fit.toml")
    measured = read_data(spec, VIRTUAL)
    study = study_of(spec, measured, refits=True)
    left = leave_one_out(fit(study, settings_of(spec)), settings_of(spec))
    truth = predictions(study.take(left.lane), left.result.theta).force
    out = [study.curves[lane][trial] for lane, trial in zip(left.lane, left.trial, strict=True)]
    assert len(out) == 10
    parts = {"nine": [], "tenth": []}
    for tenth in out:
        for c in measured.curves:
            name = "tenth" if c.trial == tenth.trial else "nine"
            parts[name].append(dataclasses.replace(c, specimen=f"without {tenth.trial}"))
    for name, curves in parts.items():
        write_hdf5(tmp_path / f"{name}.h5", Measurements(tuple(curves), (), ()))
    text = (VIRTUAL / "fit.toml").read_text()
    (tmp_path / "fit.toml").write_text(text.replace("small_strain.h5", "nine.h5"))
    code, _, err = run(monkeypatch, capsys, "fit", tmp_path / "fit.toml", "--out", tmp_path / "f")
    assert code == 0, err
    code, _, err = run(
        monkeypatch, capsys, "predict", tmp_path / "f", "--data", tmp_path / "tenth.h5",
        "--out", tmp_path / "p",
    )  # fmt: skip
    assert code == 0, err
    rows = rows_of(tmp_path / "p" / "predictions.csv")
    for k, (trial, tenth) in enumerate(zip(left.trial, out, strict=True)):
        own = [r for r in rows if r["specimen"] == f"without {tenth.trial}"]
        assert {r["trial"] for r in own} == {tenth.trial}
        assert len(own) > 1
        mine = [float(r["predicted [N]"]) - float(r["force [N]"]) for r in own]
        assert np.allclose(mine, truth[k, trial][: len(own)], rtol=0, atol=1e-9), k
    assert json.loads((tmp_path / "f" / "provenance.json").read_text())["inputs"]


@pytest.mark.slow
@pytest.mark.compiling
def test_a_lane_with_one_place_predicts_that_place(study, tmp_path):
    """k_M too small to be seen in one press: the press itself is known, one elsewhere is not."""
    truth = true_force(75.0)
    rng = np.random.default_rng(3)
    force = truth + NOISE * rng.normal(size=(1, 1, len(DEPTHS)))
    curves = synthetic.curves(force, np.array([75.0]), DEPTHS)
    result = fit(build_study(curves, table_1(), synthetic.OPTIONS, synthetic.parameters()), TWO)
    write_hdf5(tmp_path / "results.h5", Findings(result), {"inputs": {"a.csv": "0" * 64}})
    read = jaxtrachea.read_results(tmp_path)
    source = source_of(read, read.specimens[0])
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


def test_a_fit_that_knows_no_position_has_no_range_of_them():
    """Spans of curves without a position begin at inf and end at -inf."""
    from jaxtrachea.prediction.predict import _beyond

    nowhere, here = np.array([0.0, 2.0, np.inf, -np.inf]), np.array([0.0, 2.0, 10.0, 20.0])
    deep = np.array([0.0, 3.0])
    assert _beyond(nowhere, 15.0, deep[:1]) == ""
    assert _beyond(nowhere, 15.0, deep) == "extrapolated from data at D = 0 to 2 mm"
    assert _beyond(here, 30.0, deep[:1]).endswith("s = 10 to 20 mm")


def test_an_angle_that_was_not_pressed_is_extrapolated():
    """Data at 0 to 30 deg along the normal; each angle is asked for by itself."""
    from jaxtrachea.prediction.predict import _beyond

    spans, angles = np.array([0.0, 2.0, 10.0, 20.0]), np.array([0.0, np.pi / 6])
    deep = np.array([0.0, 2.0])

    def words(phi, tilt):
        return _beyond(spans, 15.0, deep, [(angles, phi, "phi"), ((0.0, 0.0), tilt, "tilt")])

    assert words(np.pi / 6, 0.0) == ""
    assert words(-0.01, 0.0) == "extrapolated from data at phi = 0 to 30 deg"
    assert words(0.1, 0.1) == "extrapolated from data at tilt = 0 to 0 deg"
    assert words(1.0, -0.1).endswith("phi = 0 to 30 deg and tilt = 0 to 0 deg")


def test_rows_where_the_wall_moves_further_than_the_radius_are_told():
    from jaxtrachea.prediction.core import Response
    from jaxtrachea.prediction.predict import _verdict

    source = source_like(PredictionStatus.OK)
    force = np.array([0.1, 0.2, 0.3])
    value, se = Response(force, force[:, None], None), Response(force / 9, force[:, None], None)
    presses = np.array([PressStatus.OK, PressStatus.TOO_DEEP, PressStatus.TOO_DEEP])
    status, message = _verdict(source, value, se, presses, 0.0)
    assert status == PredictionStatus.TOO_DEEP
    assert status.predicts
    assert "2 samples: solved, but the wall is pressed in" in message
    assert _verdict(source, value, se, 0 * presses, 0.0)[0] == PredictionStatus.OK
    # A row without a number is worse.
    lost = value._replace(force=np.array([0.1, 0.2, np.nan]))
    presses[2] = PressStatus.PAST_FOLD
    status, message = _verdict(source, lost, se, presses, 0.0)
    assert status == PredictionStatus.NO_SOLUTION
    assert "1 samples: solved, but" in message


def source_like(status):
    none = np.zeros((0, 0))
    return Source(
        "a", "", 0, none[0:], none[0:], none, none, np.array(2.0), np.ones(2), (), status, ""
    )


@pytest.mark.parametrize(
    ("options", "depths", "says"),
    [
        # A tenth of 12 mm, a half of it; without a skeleton nothing yields but the contact.
        (Options(), (1.0, 1.2), None),
        (Options(), (1.3, 0.5), "1 of 2 curves go to 1.3 mm; .*'linear' was tested to 1.2 mm"),
        (Options(skeleton="softening"), (6.0, 1.0), None),
        (Options(skeleton="softening"), (7.0, 6.5), "2 of 2 curves go to 7 mm; .* to 6 mm"),
        (Options(coupling="total"), (20.0, 1.0), None),
    ],
)
def test_curves_deeper_than_a_skeleton_was_tested(options, depths, says):
    curves = [Curve("a", "", 50.0, 0.0, d * np.linspace(0, 1, 5), np.ones(5)) for d in depths]
    sentence = deeper_than_tested(curves, options, 12.0)
    assert sentence is None if says is None else re.search(says, sentence)
