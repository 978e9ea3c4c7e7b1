"""Tables of measurements, the checks that every curve passes, and what a study is read from."""

import hashlib
import math
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from measured_files import TIDY, only_bad, put, read, table

from jaxtrachea.measurements import read as door
from jaxtrachea.measurements import readers
from jaxtrachea.measurements.curve import RawCurve
from jaxtrachea.measurements.read import (
    DataError,
    ReadOptions,
    read_measurements,
)
from jaxtrachea.measurements.readers.reader import Reader
from jaxtrachea.units import UnitError

# --- tidy tables --------------------------------------------------------------------------------


def test_tidy_values_by_hand(tmp_path):
    path = put(tmp_path, TIDY)
    found = read(path)
    assert found.bad == ()
    assert found.files == (path,)
    first, second = found.curves
    assert (first.specimen, first.trial, first.s_c, first.phi_c) == ("T01", "1", 35.0, 0.0)
    np.testing.assert_array_equal(first.displacement, [0, 1, 2])
    np.testing.assert_array_equal(first.force, [0, 0.5, 1.2])
    np.testing.assert_array_equal(first.sigma, [0.01, 0.01, 0.01])
    # Ring number 3 in the file is index 2 in memory.
    np.testing.assert_array_equal(first.joint_rings, [2, 6])
    np.testing.assert_array_equal(
        first.joint_displacement, [[0, np.nan], [0.1, 0.02], [0.21, np.nan]]
    )
    assert first.source == f"{path}:3-5"
    assert second.phi_c == np.pi / 2
    assert second.trial == "a"
    assert all(a.dtype == np.float64 for a in (first.displacement, first.force, first.sigma))
    assert found.sha256() == {str(path): hashlib.sha256(TIDY.encode()).hexdigest()}


def test_columns_that_are_not_read_are_told(tmp_path):
    """`sgima` left the noise to a guess and `angle` the press on the midline, without a word."""
    says = "columns without a role are not read: {}; data.columns gives them one"
    head = "specimen,s [mm],angle [deg],displacement [mm],force [N],sgima [N],time [s]"
    text = head + ",note\nA,40,20,0,0,0.1,0,x\nA,40,20,1,2,0.1,1,\n"
    path = put(tmp_path, text)
    assert read(path).notes == (says.format("'angle', 'sgima', 'note'"),)
    found = read(path, columns={"phi": "angle", "sigma": "sgima"})
    assert found.notes == (says.format("'note'"),)
    assert found.curves[0].phi_c == pytest.approx(np.radians(20))
    many = "displacement [mm],force [N],s [mm]," + ",".join(f"c{i}" for i in range(12))
    (note,) = read(put(tmp_path, f"{many}\n0,0,40{',' * 12}\n1,2,40{',' * 12}\n")).notes
    assert "'c9' and 2 more;" in note
    assert read(put(tmp_path, TIDY)).notes == ()


@pytest.mark.parametrize(
    ("change", "encoding"),
    [
        (lambda t: t.replace("\n", "\r\n"), "utf-8"),
        (lambda t: t.replace("\n", "\r"), "utf-8"),
        (lambda t: t, "utf-8-sig"),
        (lambda t: t, "utf-16"),
        (lambda t: t.replace("um]", "µm]"), "utf-8"),
        (lambda t: t.replace("um]", "µm]"), "latin-1"),
        (lambda t: t + "\n\n  \n", "utf-8"),
        (lambda t: t.replace(",", "\t"), "utf-8"),
        (lambda t: t.replace(",", ";"), "utf-8"),
        (lambda t: t.replace(",", ";").replace(".", ","), "utf-8"),
        (lambda t: t.replace("T02,a", '"T02","a"'), "utf-8"),
        (lambda t: t.replace("\nT0", ",\nT0").replace("joint_7 [um],", "joint_7 [um]"), "utf-8"),
    ],
)
def test_the_same_table_in_other_clothes(tmp_path, change, encoding):
    plain = read(put(tmp_path, TIDY))
    found = read(put(tmp_path, change(TIDY), "other.csv", encoding))
    assert found.bad == ()
    for a, b in zip(plain.curves, found.curves, strict=True):
        assert (a.specimen, a.trial, a.s_c, a.phi_c) == (b.specimen, b.trial, b.s_c, b.phi_c)
        np.testing.assert_array_equal(a.displacement, b.displacement)
        np.testing.assert_array_equal(a.force, b.force)
        np.testing.assert_array_equal(a.joint_displacement, b.joint_displacement)


def test_quoted_delimiter_and_name(tmp_path):
    text = 'specimen,"displacement [mm]",force [N]\n"T, left",0,0\n"T, left",1,1\n'
    assert read(put(tmp_path, text)).curves[0].specimen == "T, left"


def test_units_and_columns_from_options(tmp_path):
    text = "who,D,F\nT1,0,0\nT1,2,500\n"
    options = {
        "format": "tidy",
        "columns": {"specimen": "who", "displacement": "D", "force": "F"},
        "units": {"displacement": "cm", "force": "mN"},
        "s": "3 cm",
        "phi": "180 deg",
    }
    (got,) = read(put(tmp_path, text), **options).curves
    assert (got.s_c, got.phi_c, got.displacement[1], got.force[1]) == (30.0, np.pi, 20.0, 0.5)


def test_first_line_state(tmp_path):
    text = '{"specimen": "T03", "s": "17 mm", "operator": 4}\n' + table([(0, 0), (1, 2)])
    (got,) = read(put(tmp_path, text)).curves
    assert (got.specimen, got.trial, got.s_c) == ("T03", "1", 17.0)


@pytest.mark.parametrize("sign", [".", ","])
def test_a_column_that_may_have_thousands_separators_is_refused(tmp_path, sign):
    """After 900 comes 1.000: one micrometre, or a millimetre; the other columns tell nothing."""
    rows = [f"T;{v if v < 1000 else f'1{sign}{v - 1000:03d}'};{v}" for v in range(0, 1500, 100)]
    text = "specimen;displacement [um];force [mN]\n" + "\n".join(rows)
    (bad,) = read(put(tmp_path, text)).bad
    assert bad.kind == "unparsable"
    assert f"line 12: displacement '1{sign}000', among whole numbers" in bad.message
    assert "leave thousands separators out" in bad.cure
    (good,) = read(put(tmp_path, text.replace(sign, ""))).curves
    assert good.displacement[-1] == 1.4


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        ("", {"format": "tidy"}, "is empty"),
        ("specimen,displacement [mm],force [N]\n", {}, "no rows below the header"),
        ("specimen,displacement [mm]\nT,0\n", {}, "no column 'force'.*'specimen', 'displacement'"),
        (
            "specimen,displacement,force [N]\nT,0,0\n",
            {},
            "column 'displacement' has no unit; .*units",
        ),
        (
            "specimen,displacement [mm],force [kips]\nT,0,0\n",
            {},
            "unknown unit 'kips'.*accepted are N",
        ),
        ("specimen,displacement [N],force [N]\nT,0,0\n", {}, "does not measure length"),
        (TIDY, {"units": {"force": "N"}}, "is in mN but units.force says N"),
        (
            TIDY.replace("T02,a,40,90,0.5", "T02,a,40,0.5"),
            {},
            "line 7 has 8 cells, the header has 9",
        ),
        (TIDY.replace("500,", "0,5,0,"), {}, "line 4 has 11 cells.*decimal commas"),
        (
            TIDY.replace("T02,a,40,90,0.5", "T01,1,40,90,0.5"),
            {},
            "starts in line 3 and again in line 7",
        ),
        (TIDY.replace("T02,a,40,90,0,", ",a,40,90,0,"), {}, "line 6: specimen is empty; name it"),
        (TIDY.replace("joint_7", "joint_3"), {}, "column 'joint_3' is there twice"),
        (TIDY.replace("joint_7", "joint_0"), {}, "ring below 1"),
        (TIDY.replace("joint_3 [um]", "load [N]"), {}, "'force', 'load' can all be the force"),
        (TIDY.replace("T01,1,35,0,0", '"T01,1,35,0,0'), {}, "line 3: quotes do not match"),
        ('{"s": 17}\n' + TIDY, {}, "s stands in|17 has no unit"),
        ('{"s": "17 mm"}\n' + TIDY, {}, "s stands in the first line and in a column"),
        ('{"s": \n' + TIDY, {}, "line 1: not a JSON object"),
        ('{"s":' * 100_000 + "\n" + TIDY, {}, "line 1: not a JSON object"),
        (TIDY, {"columns": {"force": "kraft"}}, "no column 'kraft' for the force"),
        (b"specimen\0,displacement", {}, "zero bytes"),
    ],
)
def test_whole_table_refused(tmp_path, text, options, message):
    path = put(tmp_path, text)
    with pytest.raises(DataError, match=message) as caught:
        read(path, **options)
    assert str(path) in str(caught.value)


def test_unparsable_text_costs_only_its_specimen(tmp_path):
    found = read(put(tmp_path, TIDY.replace("T01,1,35,0,1,500", "T01,1,35,0,1,5oo")))
    assert [c.specimen for c in found.curves] == ["T02"]
    (bad,) = found.bad
    assert (bad.specimen, bad.kind) == ("T01", "unparsable")
    assert "line 4: force '5oo' is not a number" in bad.message


@pytest.mark.parametrize("cell", ["1.234,5", "1_0", "0x10"])
def test_no_number(tmp_path, cell):
    text = f"specimen;displacement [mm];force [N]\nT;0;0.5\nT;1;{cell}\n"
    assert only_bad(read(put(tmp_path, text))).kind == "unparsable"


def test_varying_position(tmp_path):
    assert (
        read(put(tmp_path, TIDY.replace("T01,1,35,0,1", "T01,1,36,0,1"))).bad[0].kind == "position"
    )


# --- the checks every curve passes --------------------------------------------------------------


@pytest.mark.parametrize(
    ("rows", "options", "kind", "message"),
    [
        ([], {}, "empty", "no samples"),
        ([(0, 0)], {}, "too_few_points", "1 samples, expected at least 2"),
        ([(0, 0), (1, 1), (2, 2)], {"min_points": 4}, "too_few_points", "expected at least 4"),
        ([(0, 0), (1, 1), (2, 2)], {"displacement_min": 1.5}, "too_few_points", "1 samples of 3"),
        ([(0, 0), (1, "nan"), (2, "")], {}, "non_finite", "force is .* in lines 3, 4"),
        ([(0, 0), ("inf", 1)], {}, "non_finite", "displacement is .* in line 3"),
        ([(0, 0), (1, 0), (2, 0)], {}, "no_signal", "force is 0 N in every sample"),
        ([(0, 0), (1, -1), (2, -2)], {}, "sign", "force falls while displacement grows"),
        ([(0, 0), (2000, 1)], {}, "absurd_scale", "2000 mm in line 3; at most 1000 mm"),
        ([(0, 0), (1, 2e5)], {}, "absurd_scale", "2e\\+05 N in line 3"),
        ([(0, 0), (1e-7, 1)], {}, "absurd_scale", "covers 1e-07 mm"),
        ([(1, 0), (1, 1)], {}, "absurd_scale", "covers 0 mm"),
        (
            [(0, 0), (2, 2), (1, 1), (3, 3)],
            {"loading": "require-monotone"},
            "non_monotone",
            "turns back by 1 mm, first in line 4",
        ),
        (
            [(i, i) for i in range(10)] + [(9, 9 - 0.1 * i) for i in range(30)],
            {"loading": "require-monotone"},
            "non_monotone",
            "stands still at its peak for 30 samples, from line 12 on; the force falls by 3",
        ),
        ([(2, 2), (1, 1), (0, 0)], {}, "non_monotone", "an unloading branch"),
        ([(10, 0), (9, 1), (7, 2)], {}, "non_monotone", "while the force rises"),
    ],
)
def test_bad_curve(tmp_path, rows, options, kind, message):
    bad = only_bad(read(put(tmp_path, table(rows)), **options))
    assert bad.kind == kind
    assert bad.specimen == "study"
    assert re.search(message, bad.message), bad.message


@pytest.mark.parametrize("loading", ["last", "first", "record", "all", "require-monotone"])
def test_a_record_that_is_all_hold_covers_nothing(tmp_path, loading):
    """Its times uneven, as a logarithmic clock's: it was "an unloading branch", from 4 to 4 mm."""
    rows = [(0.02 * 1.1**i, 4, 2 + math.exp(-i / 10)) for i in range(60)]
    text = table(rows, "time [s],displacement [mm],force [N]")
    bad = only_bad(read(put(tmp_path, text), loading=loading))
    assert bad.kind == "absurd_scale"
    assert "displacement covers 0 mm" in bad.message


def test_non_finite_lists_the_first_rows(tmp_path):
    bad = only_bad(read(put(tmp_path, table([(i, "nan") for i in range(9)]))))
    assert "lines 2, 3, 4, 5, 6 and 4 more" in bad.message


@pytest.mark.parametrize("sigma", ["0", "-1"])
def test_sigma_must_be_positive(tmp_path, sigma):
    text = table([(0, 0, 1), (1, 1, sigma)], "displacement [mm],force [N],sigma [N]")
    assert only_bad(read(put(tmp_path, text))).kind == "bad_sigma"


def test_jitter_and_repeated_rows_pass(tmp_path):
    # Range 10 mm: a reversal of 0.09 mm is below 1 %, one of 0.11 mm is not.
    rows = [(0, 0), (5, 5), (5, 5), (4.91, 5), (10, 10)]
    for loading in ("last", "require-monotone"):
        assert len(read(put(tmp_path, table(rows)), loading=loading).curves[0].force) == 5
    rows[3] = (4.89, 5)
    path = put(tmp_path, table(rows))
    assert only_bad(read(path, loading="require-monotone")).kind == "non_monotone"
    np.testing.assert_array_equal(read(path).curves[0].displacement, [0, 5, 5, 10])


def test_narrow_window_does_not_tighten_the_jitter(tmp_path):
    rows = [(0, 0), (1, 1), (0.95, 1), (1.1, 1.2), (10, 10)]
    (got,) = read(put(tmp_path, table(rows)), displacement_min=0.9, displacement_max=1.2).curves
    np.testing.assert_array_equal(got.displacement, [1, 0.95, 1.1])


CYCLES = [(0, 0), (1, 2), (2, 5), (1, 1), (0, 0), (2, 4), (4, 9), (0, 0)]


@pytest.mark.parametrize("loading", ["last", "first", "loading"])
def test_full_loading_of_cycles(tmp_path, loading):
    """The first branch reaches half of the second: only the second is full."""
    (got,) = read(put(tmp_path, table(CYCLES)), loading=loading).curves
    np.testing.assert_array_equal(got.displacement, [0, 2, 4])
    np.testing.assert_array_equal(got.force, [0, 4, 9])
    assert (got.usage.used, got.usage.recorded) == (3, 8)


def test_all_samples(tmp_path):
    assert read(put(tmp_path, table(CYCLES)), loading="all").curves[0].force.size == 8


def test_drawing_outward_is_a_loading_branch(tmp_path):
    rows = [(0, 0), (-1, -1), (-2, -3), (-1, -1)]
    (got,) = read(put(tmp_path, table(rows)), loading="loading").curves
    np.testing.assert_array_equal(got.displacement, [0, -1, -2])


def test_signs(tmp_path):
    rows = [(0, 0), (-1, -1), (-2, -3)]
    (got,) = read(put(tmp_path, table(rows)), force_sign=-1, displacement_sign=-1).curves
    np.testing.assert_array_equal(got.displacement, [0, 1, 2])
    np.testing.assert_array_equal(got.force, [0, 1, 3])


def test_position_in_file_and_options_must_agree(tmp_path):
    found = read(put(tmp_path, TIDY), s="35 mm")
    assert [c.specimen for c in found.curves] == ["T01"]
    assert found.bad[0].kind == "position"
    assert "40 mm in the file but 35 mm in the options" in found.bad[0].message


def test_angle_in_degrees_taken_for_radians(tmp_path):
    assert "deg, not rad" in read(put(tmp_path, TIDY.replace("[deg]", "[rad]"))).bad[0].cure


@pytest.mark.parametrize(("jitter", "fits"), [(0.001, True), (0.2, False)])
def test_stage_that_jitters_along_the_tube(tmp_path, jitter, fits):
    """A micrometre in s is the stage; 0.2 mm are two positions."""
    rows = [("T1", 35 + (i % 2) * jitter, i, i) for i in range(4)]
    head = "specimen,s [mm],displacement [mm],force [N]"
    found = read(put(tmp_path, table(rows, head)))
    if fits:
        assert found.curves[0].s_c == pytest.approx(35 + jitter / 2, rel=1e-12)
    else:
        assert only_bad(found).kind == "position"


def test_time_that_falls(tmp_path):
    rows = [(0, 0, 0), (1, 1, 1), (0.5, 2, 2), (3, 3, 3)]
    text = table(rows, "time [s],displacement [mm],force [N]")
    bad = only_bad(read(put(tmp_path, text)))
    assert bad.kind == "time"
    assert "from 1 to 0.5 s in line 4" in bad.message
    assert len(read(put(tmp_path, text), loading="all").curves[0].force) == 4
    assert len(read(put(tmp_path, text.replace(" [s]", ""))).curves[0].force) == 4


def test_offsets_stay(tmp_path):
    rows = [(0.3, -0.07), (1, 0.2), (2, 0.6)]
    (got,) = read(put(tmp_path, table(rows))).curves
    assert (got.displacement[0], got.force[0]) == (0.3, -0.07)


# --- the study ----------------------------------------------------------------------------------


def test_order_and_one_bad_file_among_good_ones(tmp_path):
    good = table([(0, 0), (1, 1)])
    texts = {"b": good, "a": good, "c": table([(0, 0)]), "d": good}
    paths = [put(tmp_path, text, f"{name}.csv") for name, text in texts.items()]
    found = read_measurements(paths)
    assert [c.specimen for c in found.curves] == ["b", "a", "d"]
    assert [b.specimen for b in found.bad] == ["c"]


def test_same_curve_twice(tmp_path):
    (tmp_path / "x").mkdir()
    paths = [put(tmp_path, TIDY), put(tmp_path / "x", TIDY)]
    with pytest.raises(DataError, match="specimen 'T01' trial '1' was already in"):
        read_measurements(paths)


@pytest.mark.parametrize("format", ["auto", "toy"])
def test_a_format_of_its_own_is_known_by_its_first_bytes(format, tmp_path, monkeypatch):
    """A toy: four bytes, then displacement and force in turns, as float64."""

    def read_toy(path, options):
        values = np.frombuffer(path.read_bytes()[4:]).reshape(-1, 2)
        rows = np.arange(len(values))
        return [RawCurve("T", "1", str(path), values[:, 0], values[:, 1], rows, "sample", s=35.0)]

    toy = Reader("toy", read=read_toy, is_file=lambda head: head.startswith(b"TOY\0"))
    for module in (readers, door):
        monkeypatch.setattr(module, "READERS", (toy, *readers.READERS))
    wanted = np.array([[0.0, 0.0], [1.0, 0.3], [2.0, 0.8]])
    path = tmp_path / "a.toy"
    path.write_bytes(b"TOY\0" + wanted.tobytes())
    curve = read(path, format=format).curves[0]
    np.testing.assert_array_equal(curve.force, wanted[:, 1])
    with pytest.raises(DataError):
        read(path, format="tidy")


def test_missing_file_folder_and_nothing(tmp_path):
    with pytest.raises(DataError, match="no such file"):
        read(tmp_path / "gone.csv")
    with pytest.raises(DataError, match="is no file"):
        read(tmp_path)
    with pytest.raises(DataError, match="at least one file"):
        read_measurements([])
    with pytest.raises(ValueError, match="format: expected 'auto', .*'tidy'.* .found 'xls'"):
        read(tmp_path / "gone.csv", format="xls")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"loading": "both"}, "loading must be one of"),
        ({"force_sign": 0}, "force_sign must be one of 1, -1"),
        ({"columns": {"weight": "w"}}, "role 'weight' in columns; expected one of"),
        ({"columns": {"joint": "w"}}, "which ring"),
        ({"units": {"trial": "mm"}}, "has no unit; remove"),
        ({"min_points": 1}, "at least 2"),
        ({"displacement_min": 2.0, "displacement_max": 1.0}, "must lie below"),
        ({"max_force": 0.0}, "must be positive"),
        ({"specimen": "EF10"}, "names no specimen"),
        ({"specimen": "(?P<specimen>["}, "no regular expression"),
    ],
)
def test_options_refused(options, message):
    with pytest.raises(ValueError, match=message):
        ReadOptions(**options)


@pytest.mark.parametrize("options", [{"units": {"force": "kips"}}, {"s": "35"}, {"phi": "1 mm"}])
def test_options_with_wrong_units(options):
    with pytest.raises(UnitError):
        ReadOptions(**options)


def test_import_is_light():
    code = (
        "import sys, jaxtrachea.measurements.read;"
        "sys.exit(bool({'jax', 'h5py', 'pandas', 'scipy'} & set(sys.modules)))"
    )
    root = str(Path(__file__).parents[1])
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=root, env=os.environ | {"PYTHONPATH": root}
    )
    assert done.returncode == 0
