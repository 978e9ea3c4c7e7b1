"""Onset, force offset and line of single curves: in a study, a fit and predictions."""

import dataclasses

import jax
import numpy as np
import pytest
from records import compliance, recorded

from jaxtrachea._errors import InputError
from jaxtrachea.cli.specification import parameters_of, usable
from jaxtrachea.config import FitSpec, SpecError
from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.fitting.structure import structure
from jaxtrachea.fitting.zero_messages import cells, sentences
from jaxtrachea.inference.design.press import index_of_presses, of_a_new_press
from jaxtrachea.measurements.read import Curve, Measurements
from jaxtrachea.measurements.record_zeros import record_zeros
from jaxtrachea.mechanics.press import Options, press
from jaxtrachea.prediction.held_out import compare
from jaxtrachea.prediction.sources import source_of
from jaxtrachea.trachea.geometry import table_1
from jaxtrachea.trachea.material import Material

AIR, SIGMA = 0.6, 0.005
HELD = {"onset": {"fixed": True, "value": 0.0}, "force_offset": {"fixed": True, "value": 0.0}}
TOTAL = Options(coupling="total")


def curves(seed, specimens=1, **fault):
    """Curves of `records.recorded`, four a specimen."""
    rows = zip(*recorded(np.random.default_rng(seed), specimens, **fault), strict=True)
    return [Curve(f"T{i // 4}", f"{s:g}", s, 0.0, D, F) for i, (s, D, F) in enumerate(rows)]


def mixed(seed=1):
    """One specimen whose second curve begins in air."""
    return [*curves(seed)[:1], *curves(seed, air=AIR)[1:2], *curves(seed)[2:]]


def hardening(seed, air=(0.0, AIR), slope=0.0):
    """Presses of 2 d + 0.1 d^3 without a skeleton, one a trial, from so much air on."""
    rng = np.random.default_rng(seed)
    out = []
    for i, before in enumerate(air):
        D = np.linspace(0, 5, 50)
        d = np.maximum(D - before, 0)
        F = 2 * d + 0.1 * d**3 + slope * D + SIGMA * rng.normal(size=50)
        out.append(Curve("T", f"{i}", None, 0.0, D, F))
    return out


def test_the_beam_of_the_records_is_that_of_the_model():
    """Of these tests' truth: Hermite elements on springs."""
    from jaxtrachea.mechanics.press import compliance as of_model
    from jaxtrachea.trachea.material import Material

    material = Material(900.0, 0.3, 8.0, 20.0)
    for s in (40.0, 47.0):
        got = of_model(table_1(), material, s, Options())
        np.testing.assert_allclose(got, compliance(900.0, 0.3, s), rtol=1e-8)


def test_records_from_first_touch_on_cost_nothing():
    """Model, columns and arrays are those of a study that holds both at 0."""
    study, held = (
        build_study(curves(1), table_1()),
        build_study(curves(1), table_1(), Options(), HELD),
    )
    assert study.model == held.model
    assert study.record_zeros is None
    assert not sentences(study)
    for a, b in zip(jax.tree.leaves(study.lanes), jax.tree.leaves(held.lanes), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_curve_in_air_has_an_onset_and_the_others_have_none():
    study = build_study(mixed(), table_1())
    assert [p.name for p in study.free] == ["EI_L", "k_M", "k_1", "k_3", "onset"]
    assert [(p.name, trial) for p, _, trial in study.unknowns[0]][-1] == ("onset", "60")
    column = [p.name for p in study.parameters].index("onset")
    np.testing.assert_array_equal(study.lanes.index[0, :, column], [-1, 4, -1, -1])
    assert study.model.common == "beam"  # not "all": one onset is no onset of all curves
    np.testing.assert_array_equal(study.first_touch[0][[0, 2, 3]], 0.0)
    np.testing.assert_allclose(study.first_touch[0, 1], AIR, atol=0.02)
    assert study.lanes.blend[0, 1] > 0
    np.testing.assert_array_equal(study.lanes.blend[0][[0, 2, 3]], 0.0)
    (said,) = sentences(study)
    assert said.startswith("onset of T0 60: 0.6")
    assert "from its record (no force over its first 12 %)" in said
    (cell,) = cells(study).items()
    assert cell[0] == ("T0", "60")
    assert cell[1].keys() == {"onset_from_record"}
    assert not structure(study).undetermined.any()


def test_words_of_records_under_load_and_of_many():
    (said,) = sentences(build_study(curves(2, preload=0.15), table_1()))
    assert said.startswith("4 of 4 curves begin under load: T0 40 with 0.1")
    assert "times its noise" in said
    cure = {"onset": {"fixed": True, "value": 0.0}}  # as the sentence says
    other = build_study(curves(2, preload=0.15), table_1(), Options(), cure)
    assert "force_offset" in [p.name for p in other.free]
    assert sentences(other)[0].startswith("force_offset of T0 40: 0.1")  # was "0 N"
    (many,) = sentences(build_study(curves(3, 3, air=AIR), table_1()))
    assert many.startswith("onset of 12 of 12 curves, from their records: T0 40 0.")
    assert many.endswith("and 8 more (curves.csv)")
    (held,) = sentences(build_study(curves(3, air=AIR), table_1(), Options(), HELD))
    assert held.startswith("onset is held at 0, where the record of T0 40 shows 0.6")


@pytest.mark.parametrize(
    ("options", "changes"),
    [
        (Options(contact="bonded"), {}),
        (Options(), HELD),
        (Options(), dict.fromkeys(("onset",), {})),
    ],
)
def test_what_is_fixed_or_free_or_bonded_stays_so(options, changes):
    """`auto` is off where contact is bonded: a record of it shows no first touch."""
    study = build_study(mixed(), table_1(), options, changes)
    onset = next(p for p in study.parameters if p.name == "onset")
    assert onset.fixed == ("onset" not in changes or changes is HELD)
    assert study.record_zeros is None
    assert len(study.unknowns[0]) == 4 if onset.fixed else 8


def test_where_everything_is_fixed_nothing_is_taken():
    names = ("EI_L", "k_M", "k_1", "k_3")
    fixed = {
        n: {"fixed": True, "value": v} for n, v in zip(names, (900.0, 0.3, 8.0, 20.0), strict=True)
    }
    assert build_study(mixed(), table_1(), Options(), fixed).size == 0


def test_lines_are_of_all_curves_of_a_specimen_that_shows_one():
    """A line of one curve in four is beyond doubt: the rig is the same for all of them."""
    study = build_study(curves(4, 2, air=AIR, slope=-0.05), table_1())
    assert {"onset", "force_offset", "force_slope"} <= {p.name for p in study.free}
    assert sum(p.name == "force_slope" for p, _, _ in study.unknowns[0]) == 4
    assert "set data.baseline = 'none'" in sentences(study)[-1]
    none = {"force_slope": {"fixed": True, "value": 0.0}}
    left = build_study(curves(4, 2, air=AIR, slope=-0.05), table_1(), Options(), none)
    assert "force_slope" not in [p.name for p in left.parameters]
    with pytest.raises(InputError, match=r"no line can be fitted .* 0 samples lie before it"):
        build_study(curves(4), table_1(), Options(), {"force_slope": {}})


def test_baseline_of_a_specification():
    """`slope` costs curves without air themselves alone; it excludes the parameter."""
    spec = FitSpec.model_validate({"data": {"files": ["x.csv"], "baseline": "slope"}})
    found = usable(spec, Measurements(tuple(mixed()), (), ()))
    assert [c.trial for c in found.curves] == ["60"]
    assert {b.kind for b in found.bad} == {"baseline"}
    assert "5 or more" in found.bad[0].message
    assert "baseline = 'auto'" in found.bad[0].cure
    table = parameters_of(spec, Options(), joints=False)
    assert [p.name for p in table if not p.fixed][-1] == "force_slope"
    none = spec.model_copy(update={"data": spec.data.model_copy(update={"baseline": "none"})})
    assert parameters_of(none, Options(), joints=False)[-1].fixed
    both = {"data": {"files": ["x.csv"], "baseline": "slope"}, "parameters": {"force_slope": {}}}
    with pytest.raises(SpecError, match="leave one of them out"):
        parameters_of(FitSpec.model_validate(both), Options(), joints=False)
    bonded = both | {"parameters": {}, "model": {"contact": "bonded"}}
    with pytest.raises(SpecError, match=r"parameters\.force_slope|data\.baseline"):
        usable(FitSpec.model_validate(bonded), Measurements(tuple(mixed()), (), ()))


def test_a_new_press_begins_at_its_touch():
    """Of a design: it shares the stiffnesses, and has no unknown of its own."""
    study = build_study(mixed(), table_1())
    kept, own, _ = of_a_new_press(study, np.array([0]), np.zeros((1, study.size)))
    assert kept.tolist() == [[0, 1, 2, 3]]
    assert own.shape == (1, 0)
    assert index_of_presses(study, 0, np.array([1]))[0, -2:].tolist() == [-1, -1]


@pytest.fixture(scope="module")
def fitted():
    """Two curves of one law, the second from 0.6 mm of air on; without a skeleton."""
    study = build_study(hardening(5), table_1(), TOTAL)
    return fit(study, Settings(starts=2, more_starts=0))


@pytest.mark.long
@pytest.mark.compiling
def test_fit_of_a_mixed_study(fitted):
    """Truth within three standard errors; the first curve's residual knows no onset."""
    assert fitted.succeeded.all()
    truth = np.array([2.0, 0.1, AIR])
    np.testing.assert_array_less(abs(fitted.value[0] - truth), 3 * fitted.standard_error[0])
    assert fitted.standard_error[0, 2] < 0.01
    np.testing.assert_allclose(fitted.first_touch[0], [0.0, fitted.value[0, 2]])
    np.testing.assert_allclose(fitted.rms[0, 0], SIGMA, rtol=0.2)


@pytest.mark.slow
@pytest.mark.compiling
def test_predictions_of_a_mixed_fit(fitted):
    """The fit's own trials, a new press, and new records: each with the zeros of its own record."""
    assert source_of(fitted, "T", "0").own == ()
    new = [*hardening(6, air=(0.0, 0.3)), *hardening(7, air=(1.0,))]
    new = [dataclasses.replace(c, trial=f"n{i}") for i, c in enumerate(new)]
    found = compare(fitted, new)
    own = ["onset fitted" in f.prediction.message for f in found]
    assert own == [False, True, True]
    for f in found:
        assert np.std(f.residual) < 1.5 * SIGMA
    clean = build_study(hardening(8, air=(0.0, 0.0)), table_1(), TOTAL)
    assert not any(p.name == "onset" for p in clean.free)
    stored = fit(clean, Settings(starts=2, more_starts=0))
    (only,) = compare(stored, new[2:])
    assert "onset fitted" in only.prediction.message
    assert np.std(only.residual) < 1.5 * SIGMA


@pytest.mark.long
@pytest.mark.compiling
def test_a_line_is_fitted_with_its_error():
    """-0.1 N/mm below a press from 1 mm of air on; the line's error is that of the air or less."""
    study = build_study(hardening(9, air=(1.0, 1.0), slope=-0.1), table_1(), TOTAL)
    result = fit(study, Settings(starts=2, more_starts=0))
    assert not result.undetermined.any()
    for i, (p, _, _) in enumerate(study.unknowns[0]):
        truth = {"k_1": 2.0, "k_3": 0.1, "onset": 1.0, "force_offset": 0.0, "force_slope": -0.1}
        error = result.standard_error[0, i]
        assert abs(result.value[0, i] - truth[p.name]) < 3.5 * error, p.name
        if p.name == "force_slope":
            assert 0.2 < error / (SIGMA / np.sqrt(10 * 1.0 / 12)) < 1.5


@pytest.mark.long
@pytest.mark.compiling
def test_a_rising_line_is_of_all_curves_and_the_fit_finds_the_truth():
    """Some records hide it, or their touch in it; k_1 was at its bound, or the model missed."""
    found = curves(13, air=0.8, slope=0.1)
    own = record_zeros([c.displacement for c in found], [c.force for c in found])
    assert own.onset.tolist() == [False, True, True, False]
    study = build_study(found, table_1())
    assert sum(p.name == "force_slope" for p, _, _ in study.unknowns[0]) == len(found)
    result = fit(study)
    assert result.succeeded.all()
    truth = {"EI_L": 900.0, "k_M": 0.3, "k_1": 8.0, "k_3": 20.0, "onset": 0.8,
             "force_offset": 0.0, "force_slope": 0.1}  # fmt: skip
    for i, (p, _, _) in enumerate(study.unknowns[0]):
        low, high = result.lower[0, i], result.upper[0, i]
        assert low - (high - low) <= truth[p.name] <= high + (high - low), p.name


@pytest.mark.slow
def test_lines_of_seven_presses_end_in_the_right_minimum():
    """1 mm of air and 0.02 N/mm: two of three specimens ended at EI_L 15, no start near 1400."""
    material = Material(EI_L=1400.0, k_M=0.2, k_1=0.5, k_3=0.05)
    D, rng = np.linspace(0, 6, 121), np.random.default_rng(5)
    found = []
    for specimen in range(3):
        for s in (20.0, 35.0, 50.0, 66.0, 75.0, 92.0, 110.0):
            F = np.asarray(press(table_1(), material, s, np.maximum(D - 1, 0)).force)
            F = np.where(D > 1, F, 0) + 0.02 * D + 0.003 * rng.normal(size=D.size)
            found.append(Curve(f"{specimen}", f"{s:g}", s, 0.0, D, F))
    result = fit(build_study(found, table_1()))
    assert result.succeeded.all()
    truth = [material.EI_L, material.k_M, material.k_1, material.k_3]
    half = (result.upper - result.lower)[:, :4]
    assert (np.abs(result.value[:, :4] - truth) < half).all()
