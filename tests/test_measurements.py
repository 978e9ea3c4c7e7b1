"""Readers against files written by hand, published recordings, and files that mean harm."""

import hashlib
import os
import re
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from jaxtrachea.measurements import read as door
from jaxtrachea.measurements import readers
from jaxtrachea.measurements.curve import RawCurve
from jaxtrachea.measurements.read import (
    Curve,
    DataError,
    Measurements,
    ReadOptions,
    read_measurements,
    write_hdf5,
)
from jaxtrachea.measurements.readers import safe_hdf5
from jaxtrachea.measurements.readers.reader import Reader
from jaxtrachea.units import UnitError

DATA = Path(__file__).parents[2] / "shared" / "data"
needs_ecoflex = pytest.mark.skipif(
    not (DATA / "ecoflex").is_dir(), reason="Ecoflex curves (CC BY 4.0) are not beside the checkout"
)
needs_formats = pytest.mark.skipif(
    not (DATA / "formats").is_dir(), reason="afmformats samples are not beside the checkout"
)

TIDY = """\
# a comment
specimen,trial,s [mm],phi [deg],displacement [mm],force [mN],sigma [mN],joint_3 [um],joint_7 [um]
T01,1,35,0,0,0,10,0,
T01,1,35,0,1,500,10,100,20
T01,1,35,0,2,1200,10,210,nan
T02,a,40,90,0,0,5,0,0
T02,a,40,90,0.5,300,5,7,8
"""


def put(folder, text, name="study.csv", encoding="utf-8"):
    path = folder / name
    path.write_bytes(text.encode(encoding) if isinstance(text, str) else text)
    return path


def read(path, **options):
    return read_measurements([path], ReadOptions(**options))


def only_bad(measurements):
    assert measurements.curves == ()
    (bad,) = measurements.bad
    assert "\n" not in bad.message + bad.cure
    assert bad.cure
    return bad


def curve(specimen="T01", trial="1", **changes):
    fields = {
        "s_c": 35.0,
        "phi_c": 0.5,
        "displacement": np.array([0.0, 1.0, 2.0]),
        "force": np.array([0.0, 0.5, 1.2]),
        "sigma": np.array([0.01, 0.02, 0.03]),
        "joint_rings": np.array([2, 6]),
        "joint_displacement": np.array([[0.0, np.nan], [0.1, 0.02], [0.21, 0.03]]),
        "source": "here",
    }
    return Curve(specimen, trial, **(fields | changes))


def table(rows, header="displacement [mm],force [N]"):
    return "\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n"


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
    ],
)
def test_bad_curve(tmp_path, rows, options, kind, message):
    bad = only_bad(read(put(tmp_path, table(rows)), **options))
    assert bad.kind == kind
    assert bad.specimen == "study"
    assert re.search(message, bad.message), bad.message


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


# --- machine files ------------------------------------------------------------------------------

MACHINE = """\
Compression test;
Operator: A. Nonymous, B. Else
Speed (mm/min): 10;

Time (s),Compression (mm),Load (N),Strain [-]
0.0,0.0,-0.01,0
0.1,0.5,1.0,-0.1
0.1,0.5,1.0,-0.1
0.2,1.0,2.5,-0.2
"""


def test_machine_file_by_hand(tmp_path):
    (got,) = read(put(tmp_path, MACHINE, "EF_3.csv"), specimen="{specimen}_{trial}").curves
    assert (got.specimen, got.trial, got.s_c, got.phi_c) == ("EF", "3", None, 0.0)
    np.testing.assert_array_equal(got.displacement, [0, 0.5, 0.5, 1])
    np.testing.assert_array_equal(got.force, [-0.01, 1, 1, 2.5])
    assert got.source.endswith("EF_3.csv:6-9")


def test_machine_position_in_file_name(tmp_path):
    path = put(tmp_path, MACHINE, "T1_s35.csv")
    (got,) = read(path, specimen=r"(?P<specimen>T\d)_s(?P<s>\d+)", units={"s": "mm"}).curves
    assert (got.specimen, got.s_c) == ("T1", 35.0)
    with pytest.raises(DataError, match="give its unit in units"):
        read(path, specimen=r"(?P<specimen>T\d)_s(?P<s>\d+)")


def test_machine_units_row_and_quoted_numbers(tmp_path):
    text = (
        "Report\nTime;Compressive extension;Compressive load\n(s);(cm);(mN)\n"
        '"0,0";"0,0";"1,5"\n"1,0";"0,1";"40"\n'
    )
    columns = {"displacement": "Compressive extension"}
    (got,) = read(put(tmp_path, text), columns=columns).curves
    np.testing.assert_array_equal(got.displacement, [0, 1])
    np.testing.assert_array_equal(got.force, [0.0015, 0.04])


@pytest.mark.parametrize(
    ("change", "kind", "message"),
    [
        (("Load (N)", "Load"), "unit_missing", "column 'Load' has no unit"),
        (("Load (N)", "Load (kips)"), "unit_unknown", "unknown unit 'kips'"),
        (("Load (N)", "Kraft (N)"), "column_missing", "no header line names"),
        (("0.5,1.0,-0.1\n0.1", "0.5,1.0\n0.1"), "ragged", "line 7 has 3 cells, the header has 4"),
        (("0.5,1.0,-0.1\n0.1", "0.5,one,-0.1\n0.1"), "unparsable", "line 7: Load 'one'"),
        (("Strain [-]", "Force (N)"), "ambiguous", "'Load', 'Force' can all be the force"),
    ],
)
def test_bad_machine_file_costs_only_itself(tmp_path, change, kind, message):
    assert change[0] in MACHINE
    bad = only_bad(read(put(tmp_path, MACHINE.replace(*change), "M1.csv")))
    assert (bad.specimen, bad.kind) == ("M1", kind)
    assert message in bad.message


def test_empty_machine_file(tmp_path):
    assert only_bad(read(put(tmp_path, ""))).kind == "empty"


def test_file_name_off_the_pattern(tmp_path):
    with pytest.raises(DataError, match="does not fit the specimen pattern"):
        read(put(tmp_path, MACHINE), specimen=r"(?P<specimen>EF\d+)")


@needs_ecoflex
def test_ecoflex():
    paths = sorted((DATA / "ecoflex").glob("*.csv"))
    options = ReadOptions(specimen=r"(?P<specimen>EF\d+_\w+T)_A(?P<trial>\d)")
    found = read_measurements(paths, options)
    assert len(found.curves) == 70
    assert found.bad == ()
    assert len({c.specimen for c in found.curves}) == 14
    first = found.curves[0]
    assert (first.specimen, first.trial) == ("EF10_0T", "1")
    # The last rows of EF10_0T_A1 and EF30_50T_A5, as printed in the files.
    assert (first.displacement[0], first.displacement[-1]) == (0.0, 20.00004)
    assert (first.force[0], first.force[-1]) == (-0.00912, 499.32315)
    assert (found.curves[-1].displacement[-1], found.curves[-1].force[-1]) == (20.00006, 248.80219)
    assert {c.force.size for c in found.curves} == {1202}


@needs_ecoflex
def test_ecoflex_window():
    options = ReadOptions(displacement_min=1.0, displacement_max=5.0)
    (got,) = read_measurements([DATA / "ecoflex" / "EF30_0T_A1.csv"], options).curves
    assert 1 <= got.displacement.min() < 1.02
    assert 4.98 < got.displacement.max() <= 5


# --- our own HDF5 -------------------------------------------------------------------------------


def test_round_trip(tmp_path):
    plain = curve("T02", "a/b", s_c=None, sigma=None, joint_rings=None, joint_displacement=None)
    depths, forces = np.linspace(0, 5, 2000), np.linspace(0, 1, 2000)
    long = Curve("Z %", ".", 1.0, 0.0, depths, forces, source="µ")
    wrote = (curve("Z %", "1"), plain, curve("A", "2"), long)
    path = tmp_path / "m.h5"
    write_hdf5(path, Measurements(wrote, (), ()), attrs={"licence": "CC0"}, schema_version=1)
    found = read_measurements([path])
    assert found.bad == ()
    # Specimens in the order of their first curve.
    order = [wrote[0], wrote[3], wrote[1], wrote[2]]
    for a, b in zip(order, found.curves, strict=True):
        assert (a.specimen, a.trial, a.s_c, a.phi_c) == (b.specimen, b.trial, b.s_c, b.phi_c)
        for name in ("displacement", "force", "sigma", "joint_rings", "joint_displacement"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    with h5py.File(path) as file:
        assert file.attrs["schema"] == "jaxtrachea-measurements"
        assert file.attrs["schema_version"] == 1
        assert file.attrs["licence"] == "CC0"
        trial = file["specimens/A/2"]
        assert trial["force"].attrs["unit"] == "N"
        assert (trial.attrs["s_c"], trial.attrs["s_c_unit"]) == (35.0, "mm")
        assert list(trial["joint_ring_number"]) == [3, 7]
    assert [p.name for p in tmp_path.iterdir()] == ["m.h5"]


def test_writing_refuses(tmp_path):
    path = tmp_path / "m.h5"
    study = Measurements((curve(),), (), ())
    write_hdf5(path, study)
    before = path.read_bytes()
    with pytest.raises(FileExistsError, match="overwrite=True"):
        write_hdf5(path, study)
    with pytest.raises(ValueError, match="comes twice"):
        write_hdf5(path, Measurements((curve(), curve()), (), ()), overwrite=True)
    with pytest.raises(ValueError, match="schema"):
        write_hdf5(path, study, attrs={"schema": "mine"}, overwrite=True)
    with pytest.raises(ValueError, match="must have names"):
        write_hdf5(path, Measurements((curve(""),), (), ()), overwrite=True)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["m.h5"]
    write_hdf5(path, Measurements((curve("X"),), (), ()), overwrite=True)
    assert read(path).curves[0].specimen == "X"


@pytest.fixture
def study(tmp_path):
    """Two specimens in a file of ours, to be spoilt."""
    path = tmp_path / "m.h5"
    write_hdf5(path, Measurements((curve("T01"), curve("T02")), (), ()), schema_version=1)
    return path


def spoil_unit(t):
    del t["force"].attrs["unit"]


def spoil_unit_name(t):
    t["force"].attrs["unit"] = "kips"


def spoil_two_units(t):
    t["force"].attrs["units"] = "kN"


def spoil_unit_type(t):
    t["force"].attrs["unit"] = 3.0


def spoil_missing(t):
    del t["displacement"]


def spoil_shape(t):
    del t["sigma"]
    t["sigma"] = np.ones(2)
    t["sigma"].attrs["unit"] = "N"


def spoil_joints(t):
    del t["joint_ring_number"]
    t["joint_ring_number"] = [3, 7, 8]


def spoil_ring(t):
    t["joint_ring_number"][...] = [0, 7]


def spoil_null(t):
    del t["force"]
    t["force"] = h5py.Empty("f8")
    t["force"].attrs["unit"] = "N"


def spoil_position(t):
    t.attrs["s_c"] = [1.0, 2.0]


def spoil_position_unit(t):
    del t.attrs["s_c_unit"]


def spoil_force(t):
    t["force"][1] = np.nan


@pytest.mark.parametrize(
    ("spoil", "kind"),
    [
        (spoil_unit, "unit_missing"),
        (spoil_unit_name, "unit_unknown"),
        (spoil_two_units, "unit_unknown"),
        (spoil_unit_type, "shape"),
        (spoil_missing, "column_missing"),
        (spoil_shape, "shape"),
        (spoil_joints, "shape"),
        (spoil_ring, "shape"),
        (spoil_null, "shape"),
        (spoil_position, "position"),
        (spoil_position_unit, "unit_missing"),
        (spoil_force, "non_finite"),
    ],
)
def test_one_bad_trial_costs_only_itself(study, spoil, kind):
    with h5py.File(study, "r+") as file:
        spoil(file["specimens/T01/1"])
    found = read(study)
    assert [c.specimen for c in found.curves] == ["T02"]
    (bad,) = found.bad
    assert (bad.specimen, bad.kind) == ("T01", kind)
    assert "specimens/T01/1" in bad.message


def test_specimen_without_trials(study):
    with h5py.File(study, "r+") as file:
        file["specimens"].create_group("T03")
    assert read(study).bad[0].kind == "empty"


@pytest.mark.parametrize(
    ("attrs", "message"),
    [
        ({"schema": "other"}, "schema is 'other', expected 'jaxtrachea-measurements'"),
        ({"schema_version": 3}, "schema_version is 3, this program reads 1 and 2"),
        ({"schema_version": 2}, "/curves: no such group"),
        ({"schema": 5.0}, "expected text"),
    ],
)
def test_other_schema(study, attrs, message):
    with h5py.File(study, "r+") as file:
        file.attrs.update(attrs)
    with pytest.raises(DataError, match=message):
        read(study)


def test_hdf5_of_no_known_layout(tmp_path):
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file["x"] = 1.0
    with pytest.raises(DataError, match="no known layout"):
        read(tmp_path / "x.h5")


# --- HDF5 files that mean harm ------------------------------------------------------------------


def external_link(file, folder):
    with h5py.File(folder / "other.h5", "w") as other:
        other["x"] = np.arange(3.0)
    file["specimens/T01/1/extra"] = h5py.ExternalLink("other.h5", "/x")


def dangling_external_link(file, folder):
    file["specimens/T09"] = h5py.ExternalLink("/dev/zero", "/x")


def soft_link(file, folder):
    file["specimens/T09"] = h5py.SoftLink("/specimens/T01")


def virtual_dataset(file, folder):
    layout = h5py.VirtualLayout((3,), "f8")
    layout[:] = h5py.VirtualSource(str(folder / "secret.h5"), "x", (3,))
    file.create_virtual_dataset("specimens/T01/1/v", layout)


def external_storage(file, folder):
    secret = folder / "secret.bin"
    secret.write_bytes(np.arange(3.0).tobytes())
    del file["specimens/T01/1/force"]
    file.create_dataset("specimens/T01/1/force", (3,), "f8", external=[(str(secret), 0, 24)])


def huge_shape(file, folder):
    file.create_dataset("huge", (10**15,), "f8", chunks=(1000,), compression="gzip")


def huge_in_sum(file, folder):
    for i in range(11):
        file.create_dataset(f"h{i}", (safe_hdf5.MAX_ELEMENTS,), "f8", chunks=(1000,))


def variable_length(file, folder):
    file.create_dataset("v", (2,), h5py.vlen_dtype("f8"))


def text_dataset(file, folder):
    file["t"] = ["a", "b"]


def reference(file, folder):
    file.create_dataset("r", (2,), h5py.ref_dtype)


def reference_attribute(file, folder):
    file.attrs["r"] = file["specimens"].ref


def compound(file, folder):
    file["c"] = np.zeros(2, dtype=[("a", "f8"), ("b", "i4")])


def named_type(file, folder):
    file["n"] = np.dtype("f8")


def loop(file, folder):
    file["specimens/T01/up"] = file["specimens"]


def deep(file, folder):
    file.create_group("/".join("abcdefghijkl"))


def control_characters(file, folder):
    file["specimens"].create_group("T\x1b[31m")


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        (external_link, "soft or external link"),
        (dangling_external_link, "soft or external link"),
        (soft_link, "soft or external link"),
        (virtual_dataset, "virtual dataset"),
        (external_storage, "keeps its data in another file"),
        (huge_shape, "declares 1000000000000000 elements"),
        (huge_in_sum, "110000000 in the file so far"),
        (variable_length, "no plain numbers"),
        (text_dataset, "no plain numbers"),
        (reference, "no plain numbers"),
        (reference_attribute, "neither number nor text"),
        (compound, "no plain numbers"),
        (named_type, "neither group nor dataset"),
        (loop, "within itself"),
        (deep, "nested deeper"),
        (control_characters, "control characters"),
    ],
)
def test_hostile_file(study, tmp_path, harm, message):
    with h5py.File(study, "r+") as file:
        harm(file, tmp_path)
    with pytest.raises(DataError, match=message) as caught:
        read(study)
    assert str(study) in str(caught.value)
    assert "\x1b" not in str(caught.value)


@pytest.mark.parametrize("fraction", [0.0, 0.001, 0.1, 0.5, 0.99])
def test_truncated(study, fraction):
    data = study.read_bytes()
    study.write_bytes(data[: int(fraction * len(data))])
    with pytest.raises(DataError, match="truncated or damaged|no text table"):
        read(study)


def test_text_named_h5(tmp_path):
    with pytest.raises(DataError, match="not a readable HDF5 file"):
        read(put(tmp_path, TIDY, "x.h5"))


def test_damaged_heap_does_not_trap_the_library(study):
    # A free-space object of size 0 in the chain that holds text attributes (section III.E of the
    # HDF5 file format): the library would step by 0 bytes for ever.
    data = bytearray(study.read_bytes())
    heap = data.find(b"GCOL")
    assert heap > 0
    data[heap + 16 : heap + 32] = bytes(16)
    study.write_bytes(data)
    with pytest.raises(DataError, match="global heap at byte"):
        read(study)


def test_damaged_values_cost_their_curve(tmp_path):
    n = np.linspace(0, 5, 2000)
    study = tmp_path / "m.h5"
    pair = (
        Curve("T01", "1", None, 0.0, n, n**1.5),
        Curve("T02", "1", None, 0.0, n, n**1.5),
    )
    write_hdf5(study, Measurements(pair, (), ()), schema_version=1)
    with h5py.File(study) as file:
        offset = file["specimens/T01/1/force"].id.get_chunk_info(0).byte_offset
    data = bytearray(study.read_bytes())
    data[offset + 10] ^= 0xFF
    study.write_bytes(data)
    found = read(study)
    assert [c.specimen for c in found.curves] == ["T02"]
    assert found.bad[0].kind == "unreadable"


# --- afmformats ---------------------------------------------------------------------------------


def afm_file(path, spring=0.02, **columns):
    """Height 50, 40, 30 um, then back; deflection takes F/k = 0, 1, 2 um of the 10 um steps."""
    data = {
        "force": (np.array([1e-9, 21e-9, 41e-9, 0.0]), "N"),
        "height (measured)": (np.array([50e-6, 40e-6, 30e-6, 50e-6]), "m"),
        "segment": (np.array([0, 0, 0, 1], dtype=np.uint8), ""),
    } | columns
    with h5py.File(path, "w") as file:
        file.attrs["software"] = "afmformats"
        for number in ("10", "2"):
            for name, (values, unit) in data.items():
                file[f"{number}/{name}"] = values
                file[f"{number}/{name}"].attrs["unit"] = unit
            if spring is not None:
                file[number].attrs["spring constant"] = spring
    return path


def test_afm_cantilever_by_hand(tmp_path):
    found = read(afm_file(tmp_path / "cell.h5"))
    assert [(c.specimen, c.trial) for c in found.curves] == [("cell", "2"), ("cell", "10")]
    # 10 um fall minus 20 nN / 0.02 N/m = 1 um of bending, per step.
    np.testing.assert_allclose(found.curves[0].displacement, [0, 0.009, 0.018], rtol=1e-12)
    np.testing.assert_allclose(found.curves[0].force, [1e-9, 21e-9, 41e-9], rtol=1e-15)


def test_afm_all_segments(tmp_path):
    assert read(afm_file(tmp_path / "c.h5"), loading="all").curves[0].force.size == 4


def test_afm_named_column_is_not_replaced_by_another(tmp_path):
    found = read(afm_file(tmp_path / "c.h5"), columns={"displacement": "height (piezo)"})
    assert {b.kind for b in found.bad} == {"column_missing"}


def test_afm_tip_position_needs_no_spring(tmp_path):
    tip = (np.array([3e-6, 2e-6, 1e-6, 3e-6]), "m")
    path = afm_file(tmp_path / "c.h5", spring=None, **{"tip position": tip})
    np.testing.assert_allclose(read(path).curves[0].displacement, [0, 0.001, 0.002], rtol=1e-12)


@pytest.mark.parametrize(
    ("changes", "kind"),
    [
        ({"spring": None}, "metadata_missing"),
        ({"spring": 0.0}, "metadata_missing"),
        ({"force": (np.zeros(3), "N")}, "shape"),
        ({"force": (np.zeros(4), "V")}, "unit_unknown"),
        ({"height (measured)": (np.zeros(4), "N")}, "unit_unknown"),
    ],
)
def test_afm_bad_curves(tmp_path, changes, kind):
    assert {b.kind for b in read(afm_file(tmp_path / "c.h5", **changes)).bad} == {kind}


@needs_formats
def test_afm_sample_hdf5():
    path = DATA / "formats" / "fmt-hdf5-fd_version_0.13.3.h5"
    (got,) = read(path).curves
    with h5py.File(path) as file:
        group = file["0"]
        approach = group["segment"][()] == 0
        fall = group["height (measured)"][0] - group["height (measured)"][approach][-1]
        force = group["force"][approach]
    # Spring constant of the file, 0.02230065831827453 N/m; metres to millimetres.
    expected = 1000 * (fall - (force[-1] - force[0]) / 0.02230065831827453)
    assert got.displacement[-1] == pytest.approx(expected, rel=1e-12)
    # As h5dump prints it.
    assert got.force[0] == pytest.approx(-7.36223288e-10, rel=1e-8)
    assert got.force.size == approach.sum()
    assert got.source.endswith(":/0")


@needs_formats
def test_afm_sample_tab():
    (got,) = read(DATA / "formats" / "fmt-tab-fd_version_0.13.3.tab").curves
    # Rows printed in the file; the first hangs on the header without a line end.
    assert tuple(got.force[:2]) == (-6.7744671e-10, -6.8435897e-10)
    bend = (-6.8435897e-10 + 6.7744671e-10) / 0.02230065831827453
    step = 1000 * ((5.5198847e-05 - 5.5194395e-05) - bend)
    assert got.displacement[1] == pytest.approx(step, rel=1e-9)
    assert got.force.size == 3147


@pytest.mark.parametrize("metadata", ["{", "[1]", '{"spring constant": "soft"}'])
def test_afm_tab_without_metadata(tmp_path, metadata):
    head = f"# BEGIN METADATA\n# {metadata}\n# END METADATA\n"
    text = head + "# force\theight (measured)\n0\t0\n1\t1\n"
    assert only_bad(read(put(tmp_path, text, "x.tab"))).kind == "metadata_missing"
