"""Predictions of other places, left-out curves and new specimens, and what is said of them."""

import dataclasses
import math
import re
from types import SimpleNamespace

import beam_fem
import numpy as np
import pytest
from hardening import TWO, pairs, stored_again, total_study
from late import late
from noisy_fits import DEPTHS, LANES, TRUTH, true_force
from scipy.stats import t as student
from synthetic import NAMES

import jaxtrachea
from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.lanes import Noise
from jaxtrachea.fitting.refusals import deeper_than_validated, depths
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.inference.analysis import AnalysisResults
from jaxtrachea.inference.cross_validation import leave_one_out
from jaxtrachea.inference.labels import verdict_sentence
from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.levels.choose import level_of
from jaxtrachea.mechanics.press import Options
from jaxtrachea.prediction import held_out
from jaxtrachea.prediction.curves import predict_sources
from jaxtrachea.prediction.sources import CurveParameters, source_of
from jaxtrachea.results.arrays import arrays_of, result_of
from jaxtrachea.results.hdf5 import write_hdf5
from jaxtrachea.results.rows import lane_rows
from jaxtrachea.status import FitStatus, PredictionStatus, PressStatus
from jaxtrachea.trachea.geometry import Geometry, table_1


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


@pytest.mark.long
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


def test_an_unknown_on_its_bound_is_said(read):
    held = np.zeros_like(read.at_bound)
    held[3, 2] = True
    source = source_of(dataclasses.replace(read, at_bound=held), "s0003")
    assert source.status == PredictionStatus.AT_BOUND
    assert "k_1 held" in source.message


#: No zero of a record is searched for: a curve left out fits its own.
AS_GIVEN = {"onset": {"fixed": True}, "force_offset": {"fixed": True}}


@pytest.mark.slow
@pytest.mark.compiling
def test_left_out_curve_is_that_of_leave_one_out(tmp_path):
    """Fit without a curve, written, read, predicted: the residual of `leave_one_out` to 1e-9."""
    curves = list(pairs())
    left = leave_one_out(fit(total_study(curves, AS_GIVEN), TWO), TWO)
    for row in (0, 3):
        out = left.study.curves[left.lane[row]][left.trial[row]]
        others = total_study([c for c in curves if c is not out], AS_GIVEN)
        read = stored_again(others, tmp_path / f"{row}")
        (found,) = held_out.compare(read, [out])
        assert np.allclose(found.residual, left.residual[row], rtol=0, atol=1e-9)
        assert found.in_fit == "no"


def only(read, lanes):
    """The same fit of the first lanes alone."""
    arrays = {name: v[:lanes] for name, v in arrays_of(read).items()}
    return result_of(read.study.take(np.arange(lanes)), arrays)


def test_unknown_specimens(read):
    """Own parameters of several specimens: no; of one, or all shared: yes, and it is said."""
    new = dataclasses.replace(read.study.curves[0][0], specimen="T9")
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
    write_hdf5(tmp_path / "r.h5", AnalysisResults(result), {})
    read = jaxtrachea.read_results(tmp_path / "r.h5")
    curve = jaxtrachea.predict(read, s=80.0, displacement=1.0, specimen="T1")
    assert curve.se == 0
    assert np.allclose(curve.high95 - 1.1, student.ppf(0.975, 60) * sigma)


def test_a_curve_with_its_signs_turned_is_not_compared(read):
    """As in a fit: compression counted negative is a pull to a tool that only touches."""
    good = Curve("s0001", "new", 61.0, 0.0, DEPTHS, true_force(61.0))
    turned = dataclasses.replace(good, trial="turned", force=-good.force)
    kept, (bad,) = held_out.pressable(read, [good, turned])
    assert kept == [good]
    assert (bad.trial, bad.kind) == ("turned", "sign")
    assert "pulls" in bad.reason


def test_a_fit_that_knows_no_position_has_no_range_of_them():
    """Spans of curves without a position begin at inf and end at -inf."""
    from jaxtrachea.prediction.curves import _beyond

    nowhere, here = np.array([0.0, 2.0, np.inf, -np.inf]), np.array([0.0, 2.0, 10.0, 20.0])
    deep = np.array([0.0, 3.0])
    assert _beyond(nowhere, 15.0, deep[:1]) == ""
    assert _beyond(nowhere, 15.0, deep) == "extrapolated from data at D = 0 to 2 mm"
    assert _beyond(here, 30.0, deep[:1]).endswith("s = 10 to 20 mm")


def test_an_angle_that_was_not_pressed_is_extrapolated():
    """Data at 0 to 30 deg along the normal; each angle is asked for by itself."""
    from jaxtrachea.prediction.curves import _beyond

    spans, angles = np.array([0.0, 2.0, 10.0, 20.0]), np.array([0.0, np.pi / 6])
    deep = np.array([0.0, 2.0])

    def words(phi, tilt):
        return _beyond(spans, 15.0, deep, [(angles, phi, "phi"), ((0.0, 0.0), tilt, "tilt")])

    assert words(np.pi / 6, 0.0) == ""
    assert words(-0.01, 0.0) == "extrapolated from data at phi = 0 to 30 deg"
    assert words(0.1, 0.1) == "extrapolated from data at tilt = 0 to 0 deg"
    assert words(1.0, -0.1).endswith("phi = 0 to 30 deg and tilt = 0 to 0 deg")


@pytest.mark.parametrize(("half_angle", "most"), [(120.0, 90.0), (105.0, 75.0)])
def test_an_angle_that_sections_were_not_tested_at_is_refused(half_angle, most):
    """Beyond 90 degrees from the midline, or within 30 of the ends of the rings."""
    from jaxtrachea.prediction.predict import check_off_midline

    geometry = Geometry.create(160.0, [40.0, 80.0], half_angle=np.radians(half_angle))
    options = Options(skeleton="sections", contact="bonded")
    model = SimpleNamespace(options=options, geometry=geometry, level=level_of(options))
    fit = object.__new__(FitResult)
    object.__setattr__(fit, "study", SimpleNamespace(model=model))
    for phi in (0.0, most, -most):
        check_off_midline(fit, np.radians(phi), (1.0, 0.0))
    for phi in (most + 0.1, -most - 0.1, half_angle):
        with pytest.raises(ValueError, match=f"too near to the ends .*{most:g} deg"):
            check_off_midline(fit, np.radians(phi), (1.0, 0.0))
    with pytest.raises(ValueError, match=f"not on the cartilage; .*{half_angle:g} deg"):
        check_off_midline(fit, np.radians(half_angle + 1), (1.0, 0.0))


def test_rows_where_the_wall_moves_further_than_the_radius_are_told():
    from jaxtrachea.prediction.curves import _verdict

    source = source_like(PredictionStatus.OK)
    force = np.array([0.1, 0.2, 0.3])
    value, se = {"force": force}, {"force": force / 9}
    presses = np.array([PressStatus.OK, PressStatus.TOO_DEEP, PressStatus.TOO_DEEP])
    status, message = _verdict(source, value, se, presses, 0.0)
    assert status == PredictionStatus.TOO_DEEP
    assert status.predicts
    assert "2 samples: solved, but the wall is pressed in" in message
    assert _verdict(source, value, se, 0 * presses, 0.0)[0] == PredictionStatus.OK
    # A row without a number is worse.
    lost = {"force": np.array([0.1, 0.2, np.nan])}
    presses[2] = PressStatus.PAST_FOLD
    status, message = _verdict(source, lost, se, presses, 0.0)
    assert status == PredictionStatus.NO_SOLUTION
    assert "1 samples: solved, but" in message


def source_like(status):
    none = np.zeros((0, 0))
    return CurveParameters(
        "a", "", 0, none[0:], none[0:], none, none, np.array(2.0), np.ones(2), (), status, ""
    )


def late_study(onset, offset, late=(10.0, 10.3), zero=0.0):
    """Two records from 2 mm before their touch at `late` mm to 3 mm; all but the press is held."""
    curves = []
    for i, (s, at) in enumerate(zip((61.0, 75.0), late, strict=True)):
        D = at + np.linspace(-2.0, 1.0, 61)
        force = zero + true_force(s, np.maximum(D - at, 0))
        curves.append(Curve("T1", f"t{i}", s, 0.0, D, force))
    held = {n: {"fixed": True, "value": float(v)} for n, v in zip(NAMES, TRUTH, strict=True)}
    table = held | {"onset": onset, "force_offset": offset}
    return build_study(curves, table_1(), Options(), table, noise=Noise(force=0.01))


@pytest.mark.slow
@pytest.mark.compiling
def test_extrapolated_and_tested_are_depths_from_first_touch(tmp_path):
    """Presses of 1 mm, recorded from 8 to 11 mm; what was said was held against these 11 mm."""
    late = (10.0, 10.3)
    result = fit(late_study({}, {}, late), Settings(starts=1, verify=False))
    write_hdf5(tmp_path / "r.h5", AnalysisResults(result), {})
    beyond = "extrapolated from data at D = 0 to 1 mm from first touch"
    for results in (result, jaxtrachea.read_results(tmp_path / "r.h5")):

        def said(trial, depth, results=results):
            k = int(trial[1])
            at = {"s": (61.0, 75.0)[k], "displacement": [0.0, depth + late[k]]}
            return jaxtrachea.predict(results, **at, trial=trial).message

        for trial in ("t0", "t1"):
            assert "extrapolated" not in said(trial, 0.99)
            assert "tested" not in said(trial, 0.99)
            assert beyond in said(trial, 1.02)
            assert "tested" not in said(trial, 1.02)
            assert "the model was tested to D = 1.13 mm from first touch" in said(trial, 1.2)
    new = jaxtrachea.predict(result, s=61.0, displacement=11.0)  # it begins at its touch
    assert beyond in new.message
    assert "the model was tested to D = 1.13 mm from first touch" in new.message


def recorded_study(scope):
    """Two records of the law 1.2 D + 0.1 D^3 that touch at 0.5 mm under a load cell at 0.3 N."""
    D = np.linspace(0, 3, 61)
    force = 0.3 + law(np.maximum(D - 0.5, 0))
    curves = [Curve("T1", name, None, 0.0, D, force) for name in ("a", "b")]
    zeros = {"onset": 0.5, "force_offset": 0.3}
    if scope == "fixed":
        more = {n: {"fixed": True, "value": v} for n, v in zeros.items()}
    else:
        more = {n: {"fixed": False, "scope": scope} for n in zeros}
    return total_study(curves, more, noise=Noise(force=0.01))


def law(d):
    return 1.2 * d + 0.1 * d**3


def law_error(scope, D):
    """Standard error of the law at depths D from 61 samples each of two records, by numpy."""
    d = np.maximum(np.linspace(0, 3, 61) - 0.5, 0)
    own = np.stack([-(1.2 + 0.3 * d**2) * (d > 0), np.ones(61)])
    rows = np.tile([d, d**3], 2)
    if scope in ("specimen", "shared"):
        rows = np.concatenate([rows, np.tile(own, 2)])
    if scope == "trial":
        rows = np.concatenate([rows, np.kron(np.eye(2), own)])
    covariance = np.linalg.inv(rows @ rows.T / 0.01**2)[:2, :2]
    x = np.stack([D, D**3])
    return np.sqrt(np.einsum("in,ij,jn->n", x, covariance, x))


@pytest.mark.long
@pytest.mark.compiling
@pytest.mark.parametrize("scope", ["specimen", *late("trial")])
def test_a_new_press_counts_from_first_touch_whatever_the_fit_has(scope, tmp_path):
    """Closed form. A zero that is held, or of a specimen, was taken for that of the new press."""
    read = stored_again(recorded_study(scope), tmp_path / "r.h5")
    D = np.array([0.5, 1.0, 2.0])
    # Where the onset is sought the corner is rounded, over the noise: less than it is known to.
    near = 1e-9 if scope == "fixed" else 0.1 * law_error(scope, D).min()
    new = jaxtrachea.predict(read, s=80.0, displacement=D)
    np.testing.assert_allclose(new.force, law(D), rtol=0, atol=near)
    # Residuals here are roundings, which are alike as it happens, and widen the bands.
    wide = float(read.effective.growth[0])
    np.testing.assert_allclose(new.se, wide * law_error(scope, D), rtol=0.02)
    assert new.status == PredictionStatus.OK
    assert "D from first touch, force without offset" in new.message
    named = jaxtrachea.predict(read, s=80.0, displacement=D + 0.5, trial="b")
    np.testing.assert_allclose(named.force, 0.3 + law(D), rtol=0, atol=2 * near)
    assert "D and force as trial 'b' records them" in named.message
    # A measured curve is recorded as those of the fit were, or has its own zeros fitted to it.
    again = dataclasses.replace(read.study.curves[0][0], trial="c")
    (found,) = held_out.compare(read, [again])
    np.testing.assert_allclose(found.prediction.force[1:], again.force[1:], rtol=0, atol=0.01)
    assert np.all(np.abs(found.residual[again.displacement > 0.6]) < 2 * near + 1e-9)


def test_change_points_serve_before_a_fit_and_numbers_that_are_held_as_they_are():
    for onset, offset in (({}, {}), ({"fixed": True, "value": 10.2}, {})):
        study = late_study(onset, offset)
        found = study.first_touch
        expected = [10.2, 10.2] if onset else [10.0, 10.3]
        np.testing.assert_allclose(found.ravel(), expected, atol=0 if onset else 0.03)
    bonded = dataclasses.replace(Options(), contact="bonded")
    np.testing.assert_array_equal(depths(np.array([1.0, 3.0]), 2.0, bonded), [-1, 1])
    np.testing.assert_array_equal(depths(np.array([1.0, 3.0]), 2.0, Options()), [0, 1])


def test_curves_are_as_deep_as_they_press():
    """Records to 13 mm that touch at 10.0 and 12.2 mm: one goes 3 mm deep, one 0.8."""
    curves = [Curve("a", "", 50.0, 0.0, np.linspace(8, 13, 5), np.ones(5))] * 2
    says = deeper_than_validated(curves, Options(), 12.0, [10.0, 12.2], " from first touch")
    assert says is not None
    assert says.startswith("1 of 2 curves go to 3 mm from first touch; skeleton = 'linear' was")
    assert deeper_than_validated(curves, Options(skeleton="softening"), 12.0, [10.0, 12.2]) is None


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
    sentence = deeper_than_validated(curves, options, 12.0)
    assert sentence is None if says is None else re.search(says, sentence)


def test_a_record_with_air_is_not_ok_where_the_fit_holds_the_onset(read):
    """Its displacement counts from elsewhere: 0.6 mm of air, as the fit would have named it."""
    rng = np.random.default_rng(4)
    way = np.linspace(0.0, 4.0, 80)
    depth = np.maximum(way - 0.6, 0)
    force = np.where(depth > 0, true_force(75.0, np.maximum(depth, 1e-9)), 0.0)
    curves = [
        Curve("s0003", name, 75.0, 0.0, D, F + 0.01 * rng.normal(size=80))
        for name, D, F in (("air", way, force), ("none", way, true_force(75.0, way + 1e-9)))
    ]
    air, none = (c.prediction for c in held_out.compare(read, curves))
    assert air.status == PredictionStatus.OTHER_ZERO
    shown = air.message.split("onset is held at 0 in the fit, where this record shows ")[1]
    assert abs(float(shown.split()[0]) - 0.6) < 0.03
    assert none.status == PredictionStatus.OK
