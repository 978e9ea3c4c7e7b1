"""A batch through the command line: a bad file costs its own row and touches no other number."""

import csv
import json
import re
from contextlib import nullcontext
from dataclasses import replace

import h5py
import jax
import numpy as np
import pytest
from run_cli import run

from jaxtrachea._errors import InputError
from jaxtrachea.cli.specification import parameters_of, study_of, usable
from jaxtrachea.config import FitSpec, SpecError, TracheaSection, load_fit_spec
from jaxtrachea.fitting.build import build_study, default_parameters
from jaxtrachea.fitting.parameters import DEFAULTS, in_model
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.inference.design.candidates import candidates_of
from jaxtrachea.measurements.data_files import find_files, read_data
from jaxtrachea.measurements.read import Curve, DataError, Measurements, write_hdf5
from jaxtrachea.mechanics.press import Options
from jaxtrachea.prediction.predict import check_position
from jaxtrachea.trachea.geometry import Geometry, table_1
from jaxtrachea.trachea.section import geometry_of
from jaxtrachea.trachea.sizes import SizeError

SPEC = """
[data]
files = ["T*.csv", "T*.h5"]
[model]
coupling = "series"
[parameters]
EI_L = { fixed = 1400 }
[fit]
starts = 1
"""
N = 100


def curve(i):
    """Ten points of a hardening curve with a little scatter, different for every specimen."""
    rng = np.random.default_rng(i)
    k_1, k_3, compliance = rng.uniform(0.5, 2), rng.uniform(0.05, 0.2), rng.uniform(0.4, 0.8)
    depth = np.linspace(0, 2, 10)
    force = k_1 * depth + k_3 * depth**3
    return depth + compliance * force, force + 1e-3 * force[-1] * rng.standard_normal(10)


def text(displacement, force, unit=" [N]"):
    rows = [f"{d!r},{f!r}" for d, f in zip(displacement.tolist(), force.tolist(), strict=True)]
    return "\n".join([f"displacement [mm],force{unit}", *rows, ""])


def write_study(folder, bad):
    """100 specimens as files, CSV and HDF5 in turn; those in `bad` damaged, each in its own way."""
    damage = {
        "non_finite": lambda D, F: text(D, np.where(np.arange(10) == 4, np.nan, F)),
        "unit_missing": lambda D, F: text(D, F, ""),
        "empty": lambda D, F: "",
        "too_few_points": lambda D, F: text(D[:1], F[:1]),
        "non_monotone": lambda D, F: text(D[::-1], F[::-1]),
        "no_signal": lambda D, F: text(D, 0 * F),
        "absurd_scale": lambda D, F: text(1e6 * D, F),
    }
    for i in range(N):
        D, F = curve(i)
        kind = dict(zip(bad, damage, strict=True)).get(i) if bad else None
        if kind is not None:
            (folder / f"T{i:03d}.csv").write_text(damage[kind](D, F))
        elif i % 2:
            (folder / f"T{i:03d}.csv").write_text(text(D, F))
        else:
            one = Curve(f"T{i:03d}", "1", None, 0.0, D, F)
            write_hdf5(folder / f"T{i:03d}.h5", Measurements((one,), (), ()))
    (folder / "spec.toml").write_text(SPEC.replace("[data]", '[data]\ns = "75 mm"'))
    return list(damage)


def table(path):
    with path.open(newline="") as stream:
        return {row["specimen"]: row for row in csv.DictReader(stream)}


@pytest.fixture(scope="module")
def batch(tmp_path_factory):
    """Folder of the study with seven bad files, and the same without them; both fitted."""
    with pytest.MonkeyPatch.context() as patch:
        capsys = _Silent()
        bad = [3, 17, 31, 45, 59, 73, 99]
        ill, well = tmp_path_factory.mktemp("ill"), tmp_path_factory.mktemp("well")
        kinds = write_study(ill, bad)
        write_study(well, bad)
        for i in bad:
            (well / f"T{i:03d}.csv").unlink()
        codes = [
            run(patch, capsys, "fit", folder / "spec.toml", "--out", folder / "out")[0]
            for folder in (ill, well)
        ]
    return (
        ill / "out",
        well / "out",
        dict(zip([f"T{i:03d}" for i in bad], kinds, strict=True)),
        codes,
    )


class _Silent:
    """`capsys` for a fixture that lives longer than one test."""

    out = err = ""

    def readouterr(self):
        return self


@pytest.mark.long
def test_every_specimen_has_a_row_and_bad_ones_a_reason(batch):
    ill, _, bad, codes = batch
    rows = table(ill / "summary.csv")
    assert codes == [1, 0]
    assert sorted(rows) == [f"T{i:03d}" for i in range(N)]
    failed = {name: row for name, row in rows.items() if row["status"] == "bad_data"}
    assert set(failed) == set(bad)
    for name, kind in bad.items():
        assert kind.replace("_", " ").split()[0] in failed[name]["message"].replace("_", " ")
        assert f"{name}.csv" in failed[name]["message"]
    assert (ill / "report.md").read_text().count("| T") >= 7


def test_good_rows_are_those_of_a_run_without_the_bad(batch):
    ill, well, bad, _ = batch
    for name in ("summary.csv", "parameters.csv"):
        mine, alone = table(ill / name), table(well / name)
        assert len(alone) == N - 7
        assert {k: v for k, v in mine.items() if k not in bad} == alone
    with h5py.File(ill / "results.h5") as a, h5py.File(well / "results.h5") as b:
        for name in ("unknowns/value", "unknowns/standard_error", "lanes/cost", "lanes/specimen"):
            np.testing.assert_array_equal(a[name][()], b[name][()])


def test_batch_finds_the_values_behind_the_curves(batch):
    """95 % intervals hold k_1 in 95 % of specimens, less three binomial deviations (2.3 %)."""
    held = []
    for name, row in table(batch[1] / "summary.csv").items():
        truth = np.random.default_rng(int(name[1:])).uniform(0.5, 2)
        held.append(float(row["k_1 low95"]) < truth < float(row["k_1 high95"]))
    assert np.mean(held) > 0.88


def test_provenance_names_every_input(batch):
    made = json.loads((batch[0] / "provenance.json").read_text())
    assert len(made["inputs"]) == N


@pytest.fixture
def two(tmp_path):
    D, F = curve(1)
    for name in "ab":
        (tmp_path / f"{name}.csv").write_text(text(D, F))
    (tmp_path / "spec.toml").write_text('[data]\nfiles = "*.csv"')
    return tmp_path


def test_same_specimen_in_two_files_is_refused(two):
    text_ = "specimen," + (two / "a.csv").read_text().replace("\n", "\nT01,").removesuffix("T01,")
    for name in "ab":
        (two / f"{name}.csv").write_text(text_)
    spec = load_fit_spec(two / "spec.toml")
    with pytest.raises(DataError, match=r"'T01' trial '1' was already in .*a\.csv.*; rename one"):
        read_data(spec, two)


def test_unreadable_file_stops_only_a_study_of_itself(two):
    (two / "b.csv").write_bytes(b"\0\0")
    spec = load_fit_spec(two / "spec.toml")
    measured = read_data(spec, two)
    assert [c.specimen for c in measured.curves] == ["a"]
    (bad,) = measured.bad
    assert (bad.specimen, bad.kind, bad.source) == ("b", "unreadable", str(two / "b.csv"))
    assert "zero bytes" in bad.message
    assert bad.cure.startswith("export")
    (two / "a.csv").unlink()
    with pytest.raises(DataError, match="zero bytes"):
        read_data(spec, two)


def test_files_come_once_sorted_and_by_their_own_name(two):
    (two / "c[1].csv").write_text("")
    spec = load_fit_spec(two / "spec.toml")

    def found(*files):
        data = spec.data.model_copy(update={"files": list(files)})
        paths = find_files(spec.model_copy(update={"data": data}), two)
        return [p.resolve().name for p in paths]

    assert found("b.csv", "*.csv") == ["b.csv", "a.csv", "c[1].csv"]
    assert found("c[1].csv") == ["c[1].csv"]
    assert found(f"{two}/*.csv", "a.csv") == ["a.csv", "b.csv", "c[1].csv"]
    assert found(f"../{two.name}/a.csv") == ["a.csv"]


def test_radius_counts_without_rings():
    section = TracheaSection.model_validate({"radius": "9 mm", "half_angle": "100 deg"})
    geometry = geometry_of(section)
    assert float(geometry.radius) == 9.0
    assert np.isclose(float(geometry.half_angle), np.radians(100))
    assert geometry.rings == 15


def signed(displacement, force):
    """A press of 2 mm with 1 N/mm, recorded with these signs from this place on."""
    D = np.linspace(0.1, 2, 20)
    return Curve("A", "t", 75.0, 0.0, displacement(D), force(D))


@pytest.mark.parametrize(
    ("curve", "changes", "says"),
    [
        (signed(np.negative, np.negative), {}, "at or before the onset, 0 mm"),
        (signed(np.negative, np.negative), {"force_offset": {}}, "at or before the onset"),
        (signed(np.negative, np.negative), {"onset": {}}, "its largest force pulls"),
        (signed(np.copy, np.negative), {}, "its largest force pulls"),
        (signed(np.copy, lambda D: np.maximum(D, 1.2) - 1.8), {}, "its largest force pulls"),
        (signed(np.copy, lambda D: D - 0.6), {}, None),
        (signed(lambda D: D - 1.5, np.copy), {"onset": {"value": 0.6, "fixed": True}}, "0.6 mm"),
        (signed(lambda D: D - 2.0, np.copy), {}, None),  # its record shows the touch
        (signed(lambda D: D - 2.0, np.copy), {"onset": {"value": 0.0, "fixed": True}}, "before"),
        (signed(lambda D: D - 2.0, np.copy), {"onset": {}}, None),
        (signed(lambda D: D - 1.0, lambda D: np.maximum(D - 1, 0)), {}, None),
        (signed(np.negative, np.negative), {"onset": {}, "force_offset": {}}, None),
    ],
)
def test_a_curve_that_no_touch_explains_is_refused(curve, changes, says):
    """Both signs turned pass for a press of positive stiffness, of which a touch shows nothing."""
    options = Options(coupling="total")
    with nullcontext() if says is None else pytest.raises(InputError, match=says) as refused:
        build_study([curve], table_1(), options, changes)
    if refused is not None:
        assert "specimen 'A' trial 't'" in str(refused.value)
        assert "force_sign = -1 and displacement_sign = -1" in str(refused.value)
        bonded = Options(coupling="total", contact="bonded")
        assert build_study([curve], table_1(), bonded, changes).lanes.force.size == 20


def test_of_a_file_curves_that_no_touch_explains_are_bad(two):
    """Two of three presses recorded negative cost themselves, not the fit."""
    curves = [signed(np.copy, np.copy), *[signed(np.negative, np.negative)] * 2]
    curves = [replace(c, trial=str(i)) for i, c in enumerate(curves)]
    spec = FitSpec.model_validate({"data": {"files": "*.csv"}})
    found = usable(spec, Measurements(tuple(curves), (), ()))
    assert [c.trial for c in found.curves] == ["0"]
    assert [b.kind for b in found.bad] == ["sign", "sign"]
    with pytest.raises(SpecError, match="force_sign = -1"):
        usable(spec, Measurements(tuple(curves[1:]), (), ()))


@pytest.mark.parametrize(
    ("change", "fixed"),
    [({}, False), ({"scope": "trial"}, False), ({"value": 0.1}, False), ({"fixed": True}, True)],
)
def test_what_is_named_is_fitted_unless_fixed(change, fixed):
    """In Python as in a specification, where `onset = {}` frees it."""
    names = in_model(Options(), joints=False)
    table = {p.name: p for p in default_parameters(names, {"onset": change})}
    assert table["onset"].fixed is fixed
    assert table["force_offset"].fixed
    assert not table["k_1"].fixed


#: Usual sizes of tracheas: length, radius and height of a ring, mm.
TRACHEAS = {
    "mouse": (8.0, 0.6, 0.2),
    "rat": (30.0, 1.7, 0.6),
    "newborn": (40.0, 2.5, 1.5),
    "adult": (110.0, 9.0, 4.0),
    "cow": (650.0, 25.0, 10.0),
    "horse": (800.0, 30.0, 13.0),
}


@pytest.mark.parametrize("animal", TRACHEAS)
def test_tracheas_of_all_animals_are_taken_and_no_other_unit(animal):
    """A fit took 1,000 times their size without a word."""
    found = dict(zip(("length", "radius", "ring_height"), TRACHEAS[animal], strict=True))
    length = found["length"]
    rings = {"count": 8, "first": f"{0.1 * length} mm", "last": f"{0.9 * length} mm"}
    given = {name: f"{value} mm" for name, value in found.items()} | {"rings": rings}
    geometry = geometry_of(TracheaSection.model_validate(given))
    assert [float(getattr(geometry, name)) for name in found] == list(found.values())
    for name, value in found.items():
        for unit in ("m", "um"):
            other = given | {name: f"{value} {unit}"}
            if name == "length":
                other["rings"] = {"count": 8, "first": f"{0.1 * value} {unit}",
                                  "last": f"{0.9 * value} {unit}"}  # fmt: skip
            with pytest.raises(SpecError, match=f"^trachea.{name} is .* is the unit wrong"):
                geometry_of(TracheaSection.model_validate(other))


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"onset_width": 1.2}, r"onset_width is 1.2 mm; expected 0 to 1.13 mm; .* unit wrong"),
        ({"onset_width": 1000.0}, r"onset_width is 1000 mm; expected 0 to 1.13 mm"),
        ({"transition": 5000.0}, r"transition is 5000 mm; expected 0.02 to 160 mm"),
        ({"transition": 0.005}, r"transition is 0.005 mm; .* It would be 5 mm"),
    ],
)
def test_lengths_of_the_model_in_another_unit_are_refused(options, says):
    """From Python, and in a specification with the key; the error says what it may be instead."""
    with pytest.raises(SizeError, match=f"^{says}"):
        build_study([signed(np.copy, np.copy)], table_1(), Options(**options))
    model = {name: f"{value} mm" for name, value in options.items()}
    spec = FitSpec.model_validate({"data": {"files": "x"}, "model": model})
    with pytest.raises(SpecError, match=f"^model.{says}"):
        study_of(spec, Measurements((signed(np.copy, np.copy),), (), ()))


def test_tools_and_walls_in_another_unit_are_refused():
    curves = [signed(np.copy, np.copy)]
    with pytest.raises(SizeError, match=r"^tool_radius is 3000 mm; .* It would be 3 mm"):
        build_study(curves, table_1(), Options(), tool_radius=3000.0)
    sections = {"skeleton": "sections", "contact": "bonded"}
    for more, says in (
        ({"data": {"files": "x", "tool_radius": "3 m"}}, "data.tool_radius is 3000 mm"),
        ({"model": sections, "wall": {"h": "2.6 m"}}, "wall.h is 2600 mm; expected 0.005 to 50 mm"),
        ({"model": sections, "wall": {"h_M": "2 um"}}, "wall.h_M is 0.002 mm"),
    ):
        spec = FitSpec.model_validate({"data": {"files": "x"}, **more})
        with pytest.raises(SpecError, match=f"^{says}.* is the unit wrong"):
            study_of(spec, Measurements(tuple(curves), (), ()))


def test_a_tube_in_metres_is_refused_in_python():
    tube = Geometry.create(0.16, [0.05, 0.1], radius=0.0113, ring_height=0.004)
    with pytest.raises(SizeError, match=r"^geometry.length is 0.16 mm; .* It would be 160 mm"):
        build_study([signed(np.copy, np.copy)], tube, Options())


@pytest.mark.parametrize(("count", "last"), [(1, 6), (2, 114), (16, 114)])
def test_even_rings(count, last):
    rings = {"count": count, "first": "6 mm", "last": f"{last} mm"}
    section = TracheaSection.model_validate({"length": "120 mm", "rings": rings})
    assert np.allclose(geometry_of(section).ring_positions, np.linspace(6, last, count), rtol=1e-15)


def test_one_ring_has_one_place():
    """The second was dropped without a word."""
    rings = {"count": 1, "first": "6 mm", "last": "114 mm"}
    with pytest.raises(ValueError, match="1 ring cannot stand at 6 and at 114 mm; expected the sa"):
        TracheaSection.model_validate({"length": "120 mm", "rings": rings})


def parameters(two, toml, options=Options()):  # noqa: B008
    (two / "spec.toml").write_text(f'[data]\nfiles = "*.csv"\n[parameters]\n{toml}')
    table = parameters_of(load_fit_spec(two / "spec.toml"), options, joints=False)
    return {p.name: p for p in table}


def test_parameters_take_quantities_bounds_and_scales(two):
    made = parameters(
        two,
        'k_1 = { initial = "2 kN/m", bounds = [0.5, "4 N/mm"] }\nk_M = { bounds = [3, 5] }\n'
        'k_3 = { scale = "log" }\nEI_L = { fixed = "1 N m^2" }\nonset = {}',
    )
    k_1 = made["k_1"]
    assert (k_1.value, k_1.lower, k_1.upper, k_1.fixed) == (2.0, 0.5, 4.0, False)
    assert made["k_M"].value == 3.0
    assert made["k_3"].lower == 1e-9
    assert (made["EI_L"].value, made["EI_L"].fixed) == (1e6, True)
    assert not made["onset"].fixed
    assert DEFAULTS["onset"].fixed


@pytest.mark.parametrize(
    ("noise", "says"),
    [
        ('joints_share = "6 %"', r"noise\.joints_share needs joints, .*; give joints as a length"),
        ('joints = "0.1 mm"\njoints_share = -0.1', r"noise\.joints_share is -0\.1; expected 0 or"),
    ],
)
def test_a_share_without_meaning_is_refused_with_its_key(two, noise, says):
    (two / "spec.toml").write_text(f'[data]\nfiles = "*.csv"\n[noise]\n{noise}\n')
    spec = load_fit_spec(two / "spec.toml")
    with pytest.raises(SpecError, match=says):
        study_of(spec, read_data(spec, two))


def test_fixed_is_a_number_or_true_where_a_value_is_known(two):
    made = parameters(two, "k_M = { fixed = 1 }\nonset = { fixed = true }")
    assert made["onset"] == replace(DEFAULTS["onset"], auto=False)
    with pytest.raises(SpecError, match=r"k_1: fixed: true would hold the first guess, 1 N/mm;"):
        parameters(two, "k_1 = { fixed = true }")
    assert (made["k_M"].value, made["k_M"].fixed) == (1.0, True)  # 1 is a number, not true


def test_ring_hardening_is_free_only_if_named(two):
    options = Options(local="two-material")
    assert "k_3_ring" not in parameters(two, "k_1 = {}", options)
    assert "k_3_ring" in parameters(two, "k_3_ring = {}", options)
    with pytest.raises(SpecError, match=r"parameters\.k_3_ring: not seen by this model"):
        parameters(two, "k_3_ring = {}")


def test_a_curve_outside_the_tube_costs_only_itself():
    line = np.linspace(0, 1, 5)
    curves = [Curve("T1", "1", 75.0, 0.0, line, line), Curve("T2", "1", 900.0, 0.0, line, line)]
    spec = FitSpec.model_validate({"data": {"files": ["x.csv"]}})
    left = usable(spec, Measurements(tuple(curves), (), ()))
    assert [c.specimen for c in left.curves] == ["T1"]
    (bad,) = left.bad
    assert (bad.specimen, bad.kind) == ("T2", "position")
    assert "900" in bad.message
    with pytest.raises(SpecError, match="T2"):
        usable(spec, Measurements((curves[1],), (), ()))


@pytest.mark.parametrize(
    ("half_width", "s", "says"),
    [
        (3.0, 2.0, "expected s from 3 to 157 mm; leave the curve out"),
        (3.0, 157.5, "expected s from 3 to 157 mm; leave the curve out"),
        (90.0, 80.0, "expected a tool no wider than the tube is long, 160 mm"),
    ],
)
def test_a_tool_beyond_an_end_of_the_tube(half_width, s, says):
    """The curve is named, with the width and the places for it; others of the batch are fitted."""
    D, F = curve(0)
    options, tube = Options(half_width=half_width), table_1()
    bad, good = Curve("T01", "a", s, 0.0, D, F, source="f.csv"), Curve("T01", "b", 75.0, 0.0, D, F)
    start = (
        f"specimen 'T01' trial 'a': contact at s = {s:g} mm, where a tool of half_width "
        f"{half_width:g} mm reaches beyond an end of the tube; {says}"
    )
    with pytest.raises(InputError, match=re.escape(start)):
        build_study([bad, good], tube, options)
    assert build_study([good, bad], tube, Options()).curves
    spec = FitSpec.model_validate(
        {"data": {"files": ["f.csv"]}, "model": {"half_width": f"{half_width} mm"}}
    )
    with pytest.raises(SpecError, match=re.escape(says)):
        usable(spec, Measurements((bad,), (), ()))
    if half_width < 80:
        left = usable(spec, Measurements((bad, good), (), ()))
        assert left.curves == (good,)
        assert "half_width" in left.bad[0].reason


def test_places_of_a_tool_with_a_width():
    """Predictions and designs leave half a width at both ends, as the fit does."""
    D, F = curve(0)
    study = build_study([Curve("T01", "a", 75.0, 0.0, D, F)], table_1(), Options(half_width=12.0))
    stored = object.__new__(FitResult)  # of which only the study is read
    object.__setattr__(stored, "study", study)
    for s in (12.0, 80.0, 148.0):
        check_position(stored, s)
    for s in (0.0, 11.9, 148.1, 160.0):
        with pytest.raises(ValueError, match="half_width 12 mm.*; expected 12 to 148 mm"):
            check_position(stored, s)
    for s, says in (
        (None, ""),
        (["12 mm", "148 mm"], ""),
        (["11 mm", "148 mm"], "half_width 12 mm"),
        (["12 mm", "149 mm"], "fits from 12 to 148 mm"),
    ):
        spec = FitSpec.model_validate(
            {"data": {"files": ["f.csv"]}, "design": {"s": s, "depth": ["1 mm", "2 mm"]}}
        )
        if says:
            with pytest.raises(SpecError, match=says):
                candidates_of(spec, study)
        else:
            at = candidates_of(spec, study).s
            assert (at.min(), at.max()) == (12.0, 148.0)


def test_little_work_is_compiled_without_optimisation(monkeypatch):
    """Few lanes of few samples, on a CPU; not of deforming cross-sections, nor jointly fitted."""
    D = np.linspace(0.1, 2, 20)
    study = build_study([Curve("A", "t", 75.0, 0.0, D, D)], table_1(), Options(contact="bonded"))
    on_cpu = jax.default_backend() == "cpu"
    assert [study.unoptimised(n) for n in (1, 16, 256, 257, 10_000)] == [on_cpu] * 3 + [False] * 2
    assert [study.evaluates_few(n) for n in (1, 4096, 4097)] == [on_cpu] * 2 + [False]
    long = study.lanes._replace(force=np.zeros((1, 1, 200_000)))
    assert not replace(study, lanes=long).unoptimised(1)
    assert not replace(study, joint=True).unoptimised(1)
    options = replace(study.model.options, skeleton="sections")
    assert not replace(study, model=replace(study.model, options=options)).unoptimised(1)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert not study.unoptimised(1)


def without(folder, names):
    """Data of a specification that excludes these curves."""
    (folder / "spec.toml").write_text(f'[data]\nfiles = "*.csv"\nexclude = {json.dumps(names)}')
    return read_data(load_fit_spec(folder / "spec.toml"), folder)


def test_excluded_curves_are_left_out_and_named(two):
    """Usable or not; the others are as they would be without their files."""
    (two / "c.csv").write_bytes(b"\0\0")
    found = without(two, ["a/1", "c/(all)"])
    (left,) = found.curves
    assert (left.specimen, found.bad) == ("b", ())
    np.testing.assert_array_equal(left.force, curve(1)[1])
    assert found.notes[-1] == "left out by data.exclude: a/1, c/(all)"
    assert "a.csv" in str(found.files)


@pytest.mark.parametrize(
    ("names", "says"),
    [
        (["a/2"], r"data.exclude.0: no curve is called 'a/2'; expected specimen/trial, one of"),
        (["a"], r"no curve is called 'a'; expected specimen/trial, one of 'a/1'"),
        (["zzz"], r"no curve is called 'zzz'.*one of 'a/1', 'b/1'$"),
        (["b/1", "a/1", "b/1"], r"data.exclude.2: 'b/1' stands twice; name each curve once"),
    ],
)  # fmt: skip
def test_a_name_that_excludes_no_curve_is_refused_with_those_that_are_there(two, names, says):
    with pytest.raises(SpecError, match=says):
        without(two, names)


def test_a_name_that_two_curves_have_is_refused(two):
    for file, specimen, trial in (("a", "x/y", "z"), ("b", "x", "y/z")):
        body = (two / f"{file}.csv").read_text().splitlines()
        rows = [f"specimen,trial,{body[0]}", *(f"{specimen},{trial},{row}" for row in body[1:])]
        (two / f"{file}.csv").write_text("\n".join(rows))
    with pytest.raises(SpecError, match="'x/y/z' are 2 curves, for their names have a slash"):
        without(two, ["x/y/z"])
