"""Joint fits: against linear algebra in full, linear least squares, SciPy and one dense lane."""

import dataclasses
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import synthetic
from run_cli import GOOD, run
from scipy.optimize import least_squares

from jaxtrachea.cli import specification
from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.information import fixed_count, unknown_count
from jaxtrachea.fitting.lanes import Weighting
from jaxtrachea.fitting.parameters import DEFAULTS
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.inference import population as populations
from jaxtrachea.inference.analyses.population import POPULATION, population_rows
from jaxtrachea.inference.analysis import AnalysisResults
from jaxtrachea.inference.bootstrap import bootstrap
from jaxtrachea.inference.cross_validation import curves_to_leave_out
from jaxtrachea.inference.design.candidates import check
from jaxtrachea.inference.population import population, wanted
from jaxtrachea.inference.profile import profiles
from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.press import Options, press
from jaxtrachea.optimisation import schur
from jaxtrachea.optimisation.trust_region import Tolerances
from jaxtrachea.results.rows import lane_rows, parameter_rows
from jaxtrachea.runs import manifest
from jaxtrachea.status import FitStatus
from jaxtrachea.trachea.geometry import table_1
from jaxtrachea.trachea.material import Material

PAGE = (Path(__file__).parents[1] / "docs" / "results.md").read_text()
TOTAL = Options(coupling="total", contact="bonded")
LANES, DEPTH = 20, np.linspace(0.1, 2, 12)
ONE_START = Settings(starts=1, batch=16)
SAMPLE, HUBER = Weighting("sample"), Weighting(loss="huber")


def columns(trials):
    """Design matrix of one specimen, F = k_1 D + k_3 D^3 + offset of each trial: k_1, k_3, ..."""
    offsets = np.kron(np.eye(trials), np.ones((len(DEPTH), 1)))
    shape = np.stack([DEPTH, DEPTH**3], axis=1)
    return np.hstack([np.tile(shape, (trials, 1)), offsets])


def linear_curves(seed=0):
    """Specimens of one or two trials, own k_1 and offsets, one k_3 = 0.1."""
    rng = np.random.default_rng(seed)
    for i in range(LANES):
        k_1 = 1 + 0.1 * i
        for t in range(1 + i % 2):
            force = k_1 * DEPTH + 0.1 * DEPTH**3 + rng.normal(size=2) @ [[0.1], [0.0]]
            yield Curve(f"s{i:02d}", f"t{t}", None, 0.0, DEPTH, force + 0.03 * rng.normal(size=12))


def linear_study(curves=None, k_3=None, **settings):
    changes = {"k_3": {"scope": "shared"} | (k_3 or {}), "force_offset": {"fixed": False}}
    table = [
        dataclasses.replace(DEFAULTS[n], **changes.get(n, {}))
        for n in ("k_1", "k_3", "onset", "force_offset")
    ]
    curves = list(linear_curves()) if curves is None else curves
    settings = {"joint": True, "weighting": SAMPLE} | settings
    return build_study(curves, table_1(), TOTAL, table, **settings)


def linear_truth(study):
    """Dense least squares: value and standard error of (k_1, k_3, offsets) of every lane."""
    sizes = [1 + len(c) for c in study.curves]
    first = np.concatenate([[1], 1 + np.cumsum(sizes)])
    A, b, places = [], [], []
    for lane, at in zip(study.curves, first, strict=False):
        place = [at, 0, *range(at + 1, at + 1 + len(lane))]
        rows = np.zeros((12 * len(lane), first[-1]))
        rows[:, place] = columns(len(lane))
        A.append(rows)
        b.append(np.concatenate([c.force for c in lane]))
        places.append(place)
    A, b = np.concatenate(A), np.concatenate(b)
    x, squares, *_ = np.linalg.lstsq(A, b)
    se = np.sqrt(np.diagonal(np.linalg.inv(A.T @ A)) * squares[0] / (len(b) - len(x)))
    return [x[p] for p in places], [se[p] for p in places]


def agrees(result, lane, value, error, tolerance):
    n = len(value)
    np.testing.assert_allclose(result.value[lane, :n], value, rtol=tolerance, atol=tolerance)
    np.testing.assert_allclose(result.standard_error[lane, :n], error, rtol=tolerance)


@pytest.fixture(scope="module")
def linear():
    return fit(linear_study(), ONE_START)


def test_elimination_is_the_dense_solution():
    """Random lanes, 3 own and 2 shared unknowns each, some held: step and sandwich in full."""
    rng = np.random.default_rng(1)
    L, P, k = 7, 5, 2
    J = rng.normal(size=(L, 9, P))
    shared = np.stack([rng.choice(P, k, replace=False) for _ in range(L)])
    own = np.array([[i for i in range(P) if i not in s] for s in shared])
    free = np.ones((L, P), bool)
    free[2, own[2, 0]] = False
    bread, g = np.einsum("lip,liq->lpq", J, J), rng.normal(size=(L, P))
    meat = np.einsum("lip,i,liq->lpq", J, rng.uniform(1, 2, 9), J)
    place = np.zeros((L, P), int)
    for i in range(L):
        place[i, shared[i]], place[i, own[i]] = [0, 1], 2 + 3 * i + np.arange(3)
    A, B, b = np.zeros((23, 23)), np.zeros((23, 23)), np.zeros(23)
    for i, p in enumerate(place):
        A[np.ix_(p, p)] += bread[i]
        B[np.ix_(p, p)] += meat[i]
        b[p] += g[i]
    keep = np.delete(np.arange(23), place[2, own[2, 0]])
    inverse = np.zeros((23, 23))
    inverse[np.ix_(keep, keep)] = np.linalg.inv(A[np.ix_(keep, keep)])
    reduced = schur.eliminate(g, bread, shared, free)
    step = -np.linalg.solve(reduced.hessian.sum(0), reduced.gradient.sum(0))
    moved = reduced.step + reduced.sensitivity @ step
    np.testing.assert_allclose(moved, -(inverse @ b)[place], atol=1e-12)
    a, m = schur.eliminate_others(bread, meat, shared, free)
    for i, p in enumerate(place):
        f = np.flatnonzero(free[i])
        block = np.linalg.inv(a[i][np.ix_(f, f)])
        found, dense = block @ m[i][np.ix_(f, f)] @ block, (inverse @ B @ inverse)[np.ix_(p, p)]
        np.testing.assert_allclose(block, inverse[np.ix_(p, p)][np.ix_(f, f)], atol=1e-12)
        np.testing.assert_allclose(found, dense[np.ix_(f, f)], atol=1e-12)


def test_an_unknown_that_is_best_at_infinity_stays_within_reach():
    """Its column is as good as nothing, yet a Newton step along it promises a fall.

    What is promised within reach is the fall of the quadratic; the shared unknown and the other
    lane know nothing of it.
    """
    tiny, rng = 1e-15, np.random.default_rng(0)
    J, residual = rng.normal(size=(2, 20, 3)), rng.normal(size=(2, 20))
    column = J[0, :, 2] - J[0, :, :2] @ np.linalg.lstsq(J[0, :, :2], J[0, :, 2], rcond=None)[0]
    residual[0] += column / np.linalg.norm(column)
    J[0, :, 2] = tiny * column
    g, H = np.einsum("lnp,ln->lp", J, residual), np.einsum("lnp,lnq->lpq", J, J)
    shared, free = np.zeros((2, 1), int), np.ones((2, 3), bool)
    found = schur.eliminate(g, H, shared, free, longest=20.0)
    assert np.abs(found.step).max() <= 20 * (1 + 1e-9)
    fall = 0.5 * np.sum(residual**2 - (residual + np.einsum("lnp,lp->ln", J, found.step)) ** 2, 1)
    np.testing.assert_allclose(found.predicted_decrease, fall, rtol=1e-9)
    without = schur.eliminate(g[:, :2], H[:, :2, :2], shared, free[:, :2])
    for name in ("gradient", "hessian", "predicted_decrease"):
        own, other = (getattr(v, name)[0] for v in (found, without))
        np.testing.assert_allclose(own, other, rtol=1e-9, err_msg=name)
    alone = schur.eliminate(g[1:], H[1:], shared[1:], free[1:])
    for name in schur.Reduced._fields:
        np.testing.assert_array_equal(getattr(found, name)[1], getattr(alone, name)[0])


def test_the_step_of_the_trust_region():
    """Inside: Newton's. On the sphere: (H + damping) step = -g with damping >= 0."""
    H, g = np.diag([1.0, 4.0, 0.0]), np.array([3.0, 4.0, 0.0])
    np.testing.assert_allclose(schur.trust_region_step(9.0, g, H), [-3, -1, 0], atol=1e-12)
    step = schur.trust_region_step(0.5, g, H)
    assert np.isclose(np.linalg.norm(step), 0.5)
    damping = (-g - H @ step)[:2] / step[:2]
    np.testing.assert_allclose(damping, damping[0])
    assert damping[0] > 0


@pytest.mark.long
def test_linear_model_is_linear_least_squares(linear):
    value, error = linear_truth(linear.study)
    assert linear.lanes == LANES
    assert np.all(linear.status == FitStatus.CONVERGED)
    for lane in range(LANES):
        agrees(linear, lane, value[lane], error[lane], 1e-8)
    # The joint knowledge of k_3 correlates a specimen's k_1 with it, as in the dense covariance.
    np.testing.assert_allclose(linear.sigma[:, 0], 0.03, rtol=0.1)
    assert np.ptp(linear.sigma[:, 0]) == 0


def test_a_lane_that_cannot_be_evaluated_costs_itself(linear):
    study = linear_study()
    study.lanes.force[3, 0, 2] = np.nan
    result = fit(study, ONE_START)
    rest = np.delete(np.arange(LANES), 3)
    assert result.status[3] == FitStatus.INFEASIBLE_START
    assert np.all(result.status[rest] == FitStatus.CONVERGED)
    without = [c for c in linear_curves() if c.specimen != "s03"]
    value, error = linear_truth(linear_study(without))
    for i, lane in enumerate(rest):
        agrees(result, lane, value[i], error[i], 1e-8)
    study.lanes.force[:] = np.nan
    assert np.all(fit(study, ONE_START).status == FitStatus.INFEASIBLE_START)


@pytest.mark.slow
@pytest.mark.compiling
def test_result_does_not_depend_on_chunks_nor_much_on_precision(linear):
    other = fit(linear_study(), dataclasses.replace(ONE_START, batch=7, starts=2))
    np.testing.assert_allclose(other.theta, linear.theta, rtol=1e-9, atol=1e-9)
    assert np.all(other.converged_starts == 2)
    single = fit(linear_study(), dataclasses.replace(ONE_START, float32=True))
    assert np.all(single.status == FitStatus.CONVERGED)
    shift = (single.value - linear.value) / linear.standard_error
    assert np.nanmax(np.abs(shift)) < 1e-2
    np.testing.assert_allclose(single.standard_error, linear.standard_error, rtol=1e-3)


def test_bounds_of_shared_and_of_own_unknowns():
    """A bound on k_3 takes it out: the others are least squares with k_3 there."""
    curves = list(linear_curves())
    result = fit(linear_study(curves, {"upper": 0.05, "value": 0.01}), ONE_START)
    assert np.all(result.status == FitStatus.AT_BOUND)
    assert np.all(result.value[:, 1] == 0.05)
    assert np.isnan(result.standard_error[:, 1]).all()
    at, squares = np.delete(columns(2), 1, axis=1), 0.0
    force = np.concatenate([c.force - 0.05 * DEPTH**3 for c in result.study.curves[1]])
    np.testing.assert_allclose(
        np.delete(result.value[1], 1), np.linalg.lstsq(at, force)[0], rtol=1e-7
    )
    for lane in result.study.curves:
        force = np.concatenate([c.force - 0.05 * DEPTH**3 for c in lane])
        squares += np.linalg.lstsq(np.delete(columns(len(lane)), 1, axis=1), force)[1][0]
    dof = sum(12 * len(c) - 1 - len(c) for c in result.study.curves)
    np.testing.assert_allclose(result.sigma[0, 0], np.sqrt(squares / dof), rtol=0.01)


def test_rows_name_what_is_shared_once(linear):
    rows = list(parameter_rows(AnalysisResults(linear, ((POPULATION, population(linear)),))))
    shared = [r for r in rows if r["parameter"] == "k_3"]
    assert [r["specimen"] for r in shared] == ["(all)"]
    own = [r for r in rows if r["parameter"] == "k_1"]
    assert [r["specimen"] for r in own] == [f"s{i:02d}" for i in range(LANES)]
    assert all(abs(r["shrunk"] - r["value"]) < 3 * r["se"] for r in own)
    assert "shrunk" not in shared[0]
    summary = list(lane_rows(linear))
    assert len({r["k_3 [N/mm^3]"] for r in summary}) == 1
    assert len({r["k_1 [N/mm]"] for r in summary}) == LANES
    known = linear.effective.share  # of all samples of the study, was of each lane's: above 1
    assert np.all(known[np.isfinite(known)] <= 1)


def test_population_and_its_page(linear):
    """Mean and spread of k_1 = 1 ... 2.9 in logarithms; columns as documented."""
    rows = list(population_rows(population(linear)))
    assert list(rows[0]) == re.findall(
        r"^\| `(\w+)`", PAGE.partition("## population.csv")[2].split("\n## ")[0], re.M
    )
    assert [r["parameter"] for r in rows] == ["k_1"]
    truth = np.log(1 + 0.1 * np.arange(LANES))
    np.testing.assert_allclose(np.log(rows[0]["mean"]), truth.mean(), atol=0.02)
    np.testing.assert_allclose(rows[0]["sd_scaled"], truth.std(ddof=1), atol=0.02)
    assert not wanted(False, linear.study)
    assert wanted(None, linear.study)


def test_population_knows_what_errors_have_in_common(linear, monkeypatch):
    """Errors of k_1 at given k_3 and how k_1 follows it, by least squares of each specimen."""
    seen, real = [], populations.random_effects

    def keep(*given):
        return (seen.append(given), real(*given))[1]

    monkeypatch.setattr(populations, "random_effects", keep)
    population(linear)
    (_, covariance, _, common), scale = seen[0], linear.standard_error[:, 0] / linear.value[:, 0]
    sigma, k_1, i = linear.sigma[0, 0], linear.value[:, 0], linear.study.shared[0, 0]
    step = linear.study.unknowns[0][i][0].step
    for lane, curves in enumerate(linear.study.curves):
        X = columns(len(curves))
        own, shared = np.delete(X, 1, axis=1), X[:, 1]
        error = sigma * np.sqrt(np.linalg.inv(own.T @ own)[0, 0]) / k_1[lane]
        np.testing.assert_allclose(covariance[lane, 0, 0], error**2, rtol=1e-5)
        follow = -np.linalg.lstsq(own, shared)[0][0] * step / k_1[lane]
        np.testing.assert_allclose(common.follow[lane, 0, 0], follow, rtol=1e-5)
        whole = error**2 + follow**2 * common.covariance[0, 0]
        np.testing.assert_allclose(whole, scale[lane] ** 2, rtol=1e-5)


def test_command_line_fits_jointly_what_is_shared(tmp_path, monkeypatch, capsys):
    text = GOOD + GOOD.partition("\n")[2].replace("T01", "T02")
    (tmp_path / "data.csv").write_text(text)
    spec = '[data]\nfiles = "data.csv"\n[parameters]\nk_M = { scope = "shared" }\n'
    (tmp_path / "spec.toml").write_text(spec)
    monkeypatch.chdir(tmp_path)
    code, out, _ = run(monkeypatch, capsys, "check", "spec.toml")
    assert (code, "2 fit(s), fitted jointly of up to 4" in out) == (0, True)
    monkeypatch.setattr(specification, "MOST_DENSE", 6)
    code, _, err = run(monkeypatch, capsys, "fit", "spec.toml", "--profile")
    assert code == 2
    assert "parameters.k_M: shared, so that 7 unknowns" in err
    was = manifest.describe(
        tmp_path / "spec.toml", tmp_path, {}, "float64", "cpu",
        lanes=1, batch=1, save_every=1, options=["influence"],
    )  # fmt: skip
    (tmp_path / "out" / ".run").mkdir(parents=True)
    manifest.write(tmp_path / "out" / ".run" / "run.json", was)
    code, _, err = run(monkeypatch, capsys, "fit", "spec.toml", "--out", "out", "--resume")
    assert (code, "so that 7 unknowns" in err) == (2, True), err  # it was one lane, and is again
    now = dataclasses.replace(was, lanes=2, options=[])
    assert list(manifest.differences(now, was)) == [
        "lanes was 2 and is 1 (--influence of a joint fit needs one lane)"
    ]


def test_what_refits_single_lanes_is_refused(linear):
    for call in (
        lambda: profiles(linear),
        lambda: bootstrap(linear),
        lambda: curves_to_leave_out(linear.study),
        lambda: check(linear.study),
    ):
        with pytest.raises(ValueError, match="joint=False"):
            call()
    with pytest.raises(ValueError, match="levenberg-marquardt"):
        fit(linear.study, Settings(method="adam"))


def skeleton_study(count, joint=True, **settings):
    """EI_L and k_M of all specimens one and the same, k_1 and k_3 their own."""
    truth = synthetic.draw(7, count, 1.3, np.array([300.0, 1.0, 0.5, 0.2]))
    truth[:, :2] = [300.0, 1.0]
    force, _ = synthetic.forces(truth)
    sigma = 0.01 * np.abs(force).max((1, 2), keepdims=True)
    force = force + sigma * np.random.default_rng(8).normal(size=force.shape)
    changes = {name: {"scope": "shared"} for name in ("EI_L", "k_M")}
    return force, synthetic.study(force, changes=changes, joint=joint, **settings)


def dense_reference(force):
    """SciPy on the full dense residual in logarithms: theta and standard error, (2 + 2 n,)."""

    def model(t):
        at = Material(*jnp.exp(t))
        depth, options = jnp.asarray(synthetic.DEPTHS), synthetic.OPTIONS

        def go(s):
            return press(synthetic.GEOMETRY, at, s, depth, options).force

        return jax.vmap(go)(jnp.asarray(synthetic.S_C)).ravel()

    both = jax.jit(jax.vmap(lambda t: (model(t), jax.jacfwd(model)(t))))
    n, m = len(force), force[0].size

    def spread(x):
        return np.concatenate([np.tile(x[:2], (n, 1)), x[2:].reshape(n, 2)], axis=1)

    def jacobian(x):
        J, dense = np.asarray(both(spread(x))[1]), np.zeros((n, m, len(x)))
        dense[:, :, :2] = J[:, :, :2]
        for i in range(n):
            dense[i, :, 2 + 2 * i : 4 + 2 * i] = J[i, :, 2:]
        return dense.reshape(n * m, -1)

    def residual(x):
        return (np.asarray(both(spread(x))[0]) - force.reshape(n, m)).ravel()

    start = np.log(np.concatenate([[200.0, 1.2], np.tile([0.6, 0.15], n)]))
    ends = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15}
    found = least_squares(residual, start, jac=jacobian, method="lm", **ends)
    variance = 2 * found.cost / (n * m - len(start))
    return found.x, np.sqrt(np.diagonal(np.linalg.inv(found.jac.T @ found.jac)) * variance)


@pytest.mark.slow
@pytest.mark.compiling
def test_twenty_specimens_are_the_dense_fit_of_scipy():
    """Estimates and standard errors within 1e-6 (relative)."""
    force, study = skeleton_study(20)
    result = fit(study, dataclasses.replace(ONE_START, batch=32))
    x, se = dense_reference(force)
    value = np.exp(np.concatenate([np.tile(x[:2], (20, 1)), x[2:].reshape(20, 2)], axis=1))
    error = np.concatenate([np.tile(se[:2], (20, 1)), se[2:].reshape(20, 2)], axis=1)
    np.testing.assert_allclose(result.value, value, rtol=1e-6)
    np.testing.assert_allclose(result.standard_error, error * value, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.compiling
def test_twenty_specimens_are_one_dense_lane():
    """Sandwich covariance and robust loss: as the path without Schur complements."""
    _, study = skeleton_study(20, weighting=HUBER)
    _, dense = skeleton_study(20, joint=False, weighting=HUBER)
    # As exact as rounding lets them: at the usual 1e-10 of the cost each may stop 1e-6 off.
    exact = Settings(starts=1, tolerances=Tolerances(cost=1e-14))
    found, expected = fit(study, exact), fit(dense, exact)
    places = {(p.name, s): i for i, (p, s, _) in enumerate(dense.unknowns[0])}
    for lane, unknowns in enumerate(study.unknowns):
        at = [places[p.name, s] for p, s, _ in unknowns]
        for name in ("value", "standard_error", "lower", "upper"):
            np.testing.assert_allclose(
                getattr(found, name)[lane], getattr(expected, name)[0, at], rtol=1e-6
            )


def test_held_unknowns_are_counted_once():
    study = linear_study()
    held = np.zeros(study.lanes.lower.shape, bool)
    held[np.arange(LANES), study.shared[:, 0]] = True
    held[4, 0] = True
    everyone = np.ones(LANES, bool)
    assert fixed_count(study, held, everyone) == 2
    # k_3, 20 k_1, and an offset of each of 30 curves.
    assert unknown_count(study, everyone) == 51
