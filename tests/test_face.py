"""The package from Python: public names, a fit, its table, its dataset, its predictions."""

import dataclasses
import importlib
import re
import subprocess
import sys
import warnings
from pathlib import Path

import jax
import numpy as np
import pytest
from synthetic import DEPTHS, GEOMETRY, OPTIONS, curves, draw, forces, parameters

import jaxtrachea as jt
from jaxtrachea.fitting import settings as how
from jaxtrachea.fitting.parameters import DEFAULTS, Parameter
from jaxtrachea.measurements.curve import BadCurve
from jaxtrachea.measurements.read import Measurements

STUB = Path(jt.__file__).with_suffix(".pyi").read_text()
NAMES = re.findall(r"^from \.([\w.]+) import (\w+) as \2$", STUB, re.M)
TRUTH = draw(3, 2, 3)
#: One that holds what lanes fitted to data without noise tell; the onset stays known.
SETTINGS = jt.Settings(starts=2, batch=4)


@pytest.fixture(scope="module")
def result():
    """Two specimens, the first with a name that is markup; data without noise."""
    force, _ = forces(TRUTH)
    named = [
        dataclasses.replace(c, specimen="<b>") if c.specimen == "s0000" else c
        for c in curves(force)
    ]
    return jt.fit(jt.build_study(named, GEOMETRY, OPTIONS, parameters()), SETTINGS)


def test_public_names_stand_once_and_are_there():
    assert len(NAMES) > 30
    assert len({name for _, name in NAMES}) == len(NAMES)
    for module, name in NAMES:
        found = getattr(importlib.import_module(f"jaxtrachea.{module}"), name)
        assert getattr(jt, name) is found
    assert {name for _, name in NAMES} <= set(dir(jt))
    assert (Path(jt.__file__).parent / "py.typed").exists()
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = jt.no_such_name


@pytest.mark.long
def test_no_name_is_hidden_by_a_room():
    """`jt.fit` is the function, also after a module of its room was imported."""
    code = (
        "import jaxtrachea as jt\n"
        + "".join(f"import jaxtrachea.{module}\n" for module in sorted({m for m, _ in NAMES}))
        + f"for m, n in {NAMES!r}:\n"
        "    v = getattr(jt, n)\n"
        "    assert not isinstance(v, type(jt)), n\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.compiling
def test_table_holds_the_truth_with_units(result):
    table = result.table()
    assert len(table) == 8
    assert table.column("parameter") == ["EI_L", "k_M", "k_1", "k_3"] * 2
    assert table.column("unit") == ["N mm^2", "N/mm", "N/mm", "N/mm^3"] * 2
    np.testing.assert_allclose(table.column("value"), TRUTH.ravel(), rtol=1e-5)
    assert set(table.column("verdict")) == {"identifiable"}
    for row in table:
        assert row["low95"] <= row["value"] <= row["high95"]
    assert table.column("specimen") == ["<b>"] * 4 + ["s0001"] * 4
    assert [row["parameter"] for row in table[1:3]] == ["k_M", "k_1"]
    with pytest.raises(KeyError, match="verdict"):
        table.column("colour")


@pytest.mark.long
def test_table_prints_aligned_and_escaped(result):
    lines = repr(result.table()).splitlines()
    assert len(lines) == 9
    assert lines[0].split() == ["specimen", "trial", "parameter", "unit", "value", "se", "low95",
                                "high95", "relative_se", "verdict"]  # fmt: skip
    place = lines[0].index("value") + len("value")
    for line, truth in zip(lines[1:], TRUTH.ravel(), strict=True):
        assert float(line[:place].split()[-1]) == pytest.approx(truth, rel=1e-3)
    page = result.table()._repr_html_()
    assert "&lt;b&gt;" in page
    assert "<b>" not in page
    assert page.count("<tr>") == 9


@pytest.mark.long
def test_dataset_has_the_same_numbers(result):
    data = result.to_dataset()
    assert dict(data.sizes) == {"lane": 2, "unknown": 4, "kind": 2}
    at = data.sel(unknown="k_M")
    np.testing.assert_allclose(at.value, TRUTH[:, 1], rtol=1e-5)
    assert list(data.specimen.values) == ["<b>", "s0001"]
    assert set(data.status.values) == {"converged"}
    table = result.table()
    for name, column in (("low95", "low95"), ("high95", "high95"), ("verdict", "verdict")):
        assert data[name].values.ravel().tolist() == table.column(column)


@pytest.mark.long
def test_dataset_takes_profiles_as_the_table_does():
    """With a bound at 0.8 of the true k_M the estimate lies on it: no error, and no local interval.

    The profile gives the interval on the one side where it may move, in both.
    """
    force = forces(TRUTH[:1])[0]
    noise = np.random.default_rng(1).normal(size=force.shape)
    bound = float(0.8 * TRUTH[0, 1])
    table = [
        dataclasses.replace(p, upper=bound, value=bound / 2) if p.name == "k_M" else p
        for p in parameters()
    ]
    noisy = curves(force + 1e-3 * force.max() * noise)
    plain = dataclasses.replace(SETTINGS, verify=False)
    result = jt.fit(jt.build_study(noisy, GEOMETRY, OPTIONS, table), plain)
    profiles = jt.profiles(result, SETTINGS, ["k_M"], points=2)
    for given in (None, profiles):
        data, rows = result.to_dataset(given), result.table(given)
        assert data.status.values.tolist() == ["at_bound"]
        assert data.at_bound.values.tolist() == [[False, True, False, False]]
        for name, column in (("standard_error", "se"), ("low95", "low95"), ("high95", "high95")):
            np.testing.assert_array_equal(data[name].values.ravel(), rows.column(column))
        assert data.verdict.values.ravel().tolist() == rows.column("verdict")
        k_m = data.sel(unknown="k_M")
        assert k_m.verdict == "at bound"
        assert np.isnan(k_m.standard_error)
        assert k_m.value == bound
        ends = [np.nan] * 2 if given is None else [profiles.lower[0], bound]
        np.testing.assert_array_equal([k_m.low95[0], k_m.high95[0]], ends)
    assert profiles.lower[0] < bound


@pytest.mark.long
def test_noise_of_markers_that_are_not_there_is_no_number(result):
    assert np.isnan(result.to_dataset().sigma.sel(kind="joints")).all()


def test_a_number_is_not_taken_for_a_switch():
    """`fixed = 2.0` of a specification means its value; here it would have kept the default."""
    # Past the checker of annotations, which users do not have.
    given = dataclasses.asdict(DEFAULTS["k_1"]) | {"fixed": 2.0}
    record = object.__new__(Parameter)
    for name, value in given.items():
        object.__setattr__(record, name, value)
    with pytest.raises(ValueError, match="k_1.*fixed is 2.0.*give the number as value"):
        record.__post_init__()
    held = {"k_1": {"fixed": True, "value": 2.0}}
    study = jt.build_study(curves(forces(TRUTH)[0]), GEOMETRY, OPTIONS, held)
    assert [p.value for p in study.parameters if p.name == "k_1"] == [2.0]


def test_dataset_says_what_is_missing(result, monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(ImportError, match=r"jaxtrachea\[dataset\]"):
        result.to_dataset()


@pytest.mark.slow
@pytest.mark.compiling
def test_a_fit_predicts_what_the_model_says(result):
    """At a position that was not pressed; the truth is the model at the true parameters."""
    wanted = forces(TRUTH, np.array([60.0]))[0][1, 0]
    curve = jt.predict(result, s=60.0, displacement=DEPTHS, specimen="s0001")
    np.testing.assert_allclose(curve.force, wanted, rtol=1e-5)
    with pytest.raises(ValueError, match="specimen"):
        jt.predict(result, s=60.0, displacement=1.0)


def test_one_file_and_its_curves_are_a_study():
    """A path by itself; what cannot be used is said in a warning, never left out in silence."""
    path = Path(__file__).parents[1] / "fits" / "virtual_trachea" / "small_strain.h5"
    read = jt.read_measurements(path)
    assert len(read.curves) == 10
    study = jt.build_study(read, jt.table_1(), jt.Options(contact="bonded"), tool_radius=3.0)
    assert [p.name for p in study.free] == ["EI_L", "k_M", "k_1", "k_3"]
    bad = BadCurve("T01", "9", "a.csv", "unreadable", "no force column", "add one")
    with pytest.warns(UserWarning, match="T01 9: .*no force column"):
        jt.build_study(Measurements(read.curves, (bad,), ()), jt.table_1(), jt.Options())


@pytest.mark.slow
@pytest.mark.compiling
def test_a_fit_in_single_precision_is_said_once():
    """With the cure, at the user's line; not where float32 was asked for, nor in float64."""
    study = jt.build_study(curves(forces(TRUTH[:1])[0]), GEOMETRY, OPTIONS, parameters())
    plain = jt.Settings(starts=1, more_starts=0, verify=False)

    def warned(call):
        how._warn_of_single_precision.cache_clear()
        with warnings.catch_warnings(record=True) as seen:
            warnings.simplefilter("always")
            found = [call(), call()][0]
        cure = 'jax.config.update("jax_enable_x64", True)'
        ours = [w for w in seen if cure in str(w.message)]
        # Of a line outside: here the checker of annotations may stand before the user's.
        assert not any(w.filename.startswith(str(Path(jt.__file__).parent)) for w in ours)
        assert all(w.category is UserWarning for w in ours)
        return found, len(ours)

    with jax.enable_x64(False):
        result, count = warned(lambda: jt.fit(study, plain))
        assert count == 1
        assert warned(lambda: jt.profiles(result, plain, ["k_M"], points=2))[1] == 1
        assert warned(lambda: jt.bootstrap(result, plain, count=40))[1] == 1
        deliberate = dataclasses.replace(plain, float32=True)
        assert warned(lambda: jt.fit(study, deliberate))[1] == 0
    assert warned(lambda: jt.fit(study, plain))[1] == 0
