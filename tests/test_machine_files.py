"""Files of testing machines: written by hand, and published recordings."""

from pathlib import Path

import numpy as np
import pytest
from measured_files import only_bad, put, read

from jaxtrachea.measurements.read import (
    DataError,
    ReadOptions,
    read_measurements,
)

DATA = Path(__file__).parents[2] / "shared" / "data"
needs_ecoflex = pytest.mark.skipif(
    not (DATA / "ecoflex").is_dir(), reason="Ecoflex curves (CC BY 4.0) are not beside the checkout"
)

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


#: Two presses of one specimen at 35 and 75 mm, named by columns; the file names the specimen.
TABLE = """\
trial,s [mm],phi [deg],displacement [mm],force [N]
1,35,0,0.0,0.0
1,35,0,0.5,0.5
2,75,40,0.0,0.00
2,75,40,0.5,0.05
"""


def both(path, **options):
    found = read(path, **options).curves
    return [(c.specimen, c.trial, c.s_c, round(np.degrees(c.phi_c)), c.force[-1]) for c in found]


@pytest.mark.parametrize("above", ["", "# by hand\n", "sep=,\n", '"sep=,"\n'])
def test_columns_of_trial_and_position_make_a_table_without_specimens_tidy(tmp_path, above):
    """They were left unread: one curve of all rows, wherever `data.s` put it."""
    path = put(tmp_path, above + TABLE, "T7.csv")
    assert both(path) == [("T7", "1", 35.0, 0, 0.5), ("T7", "2", 75.0, 40, 0.05)]
    assert both(path) == both(path, format="tidy")
    refused = "s is 35 mm in the file but 50 mm in the options"
    assert refused in read(path, s="50 mm").bad[0].message


def test_columns_of_other_names_too(tmp_path):
    text = TABLE.replace("trial,s [mm],phi [deg]", "Versuch,pos [mm],angle [deg]")
    columns = {"trial": "Versuch", "s": "pos", "phi": "angle"}
    path = put(tmp_path, text, "T7.csv")
    assert both(path, columns=columns) == [("T7", "1", 35.0, 0, 0.5), ("T7", "2", 75.0, 40, 0.05)]
    bad = only_bad(read(path, format="machine", columns=columns))
    assert "'Versuch' (trial), 'pos' (s), 'angle' (phi), which a machine file" in bad.message


def test_columns_of_trial_and_position_below_other_lines_are_refused(tmp_path):
    path = put(tmp_path, "Compression test,\n" + TABLE, "T7.csv")
    bad = only_bad(read(path))
    assert "line 2 is the header of a table with 'trial' (trial), 's' (s), 'phi'" in bad.message
    (got,) = read(path, format="machine").curves
    assert (got.trial, got.s_c, got.phi_c) == ("1", None, 0.0)


def test_a_way_that_its_file_calls_s_is_no_position(tmp_path):
    text = TABLE.replace("trial,s [mm],phi [deg],displacement [mm]", "no,s [mm],angle,way [mm]")
    text = (
        text.replace("1,35,0,0.0", "1,34,0,0.0").replace("0.00\n", "0.60\n").replace("0.05", "0.7")
    )
    (got,) = read(put(tmp_path, text), columns={"displacement": "s"}).curves
    np.testing.assert_array_equal(got.displacement, [34, 35, 75, 75])
    assert got.s_c is None


PATTERN = r"(?P<specimen>T\d+)_s(?P<s>\d+)_p(?P<phi>\d+)"


@pytest.mark.parametrize(
    ("columns", "cells", "options", "found"),
    [
        ("trial,", "1,", {}, (35.0, 40)),
        ("phi [deg],", "40,", {}, (35.0, 40)),
        ("s [mm],", "35,", {}, (35.0, 40)),
        ("specimen,", "T7,", {}, (35.0, 40)),
        ("phi [deg],", "0,", {}, "phi is 0 rad in the table but 0.698132 rad in the name of the"),
        ("s [mm],", "75,", {}, "s is 75 mm in the table but 35 mm in the name of the file"),
        ("trial,", "1,", {"s": "75 mm"}, "s is 35 mm in the file but 75 mm in the options"),
        ("", "", {"format": "tidy"}, (35.0, 40)),
        ("", "", {}, (35.0, 40)),
    ],
)
def test_positions_of_a_file_name_hold_for_tables_too(tmp_path, columns, cells, options, found):
    """They were dropped where the table was tidy: a press at 40 degrees was one on the midline."""
    text = f"{columns}displacement [mm],force [N]\n{cells}0,0\n{cells}1,2\n"
    path = put(tmp_path, text, "T7_s35_p40.csv")
    got = read(path, specimen=PATTERN, units={"s": "mm", "phi": "deg"}, **options)
    if isinstance(found, str):
        assert found in only_bad(got).message
    else:
        (curve,) = got.curves
        assert (curve.specimen, curve.s_c, round(np.degrees(curve.phi_c))) == ("T7", *found)


def test_a_first_line_and_a_file_name_must_agree(tmp_path):
    text = '{"s": "75 mm"}\ntrial,displacement [mm],force [N]\n1,0,0\n1,1,2\n'
    path = put(tmp_path, text, "T7_s35.csv")
    pattern = r"(?P<specimen>T\d+)_s(?P<s>\d+)"
    bad = only_bad(read(path, specimen=pattern, units={"s": "mm"}))
    assert "s is 75 mm in the table but 35 mm in the name" in bad.message
    (got,) = read(
        put(tmp_path, text.replace("75", "35"), "T7_s35.csv"), specimen=pattern, units={"s": "mm"}
    ).curves
    assert got.s_c == 35


def test_a_time_called_s(tmp_path):
    """In the unit of a time it is no position; without a unit the cure says what to do."""
    text = "s [s],displacement [mm],force [N]\n0,0,0\n1,1,2\n"
    (got,) = read(put(tmp_path, text, "T7.csv")).curves
    assert (got.specimen, got.s_c) == ("T7", None)
    (got,) = read(put(tmp_path, text, "T7.csv"), columns={"time": "s"}).curves
    np.testing.assert_array_equal(got.time, [0, 1])
    with pytest.raises(DataError, match='no unit; .*no position, rename it, or set format = "mac'):
        read(put(tmp_path, text.replace("s [s]", "s"), "T7.csv"))


def test_a_row_of_units_in_a_table_of_trials(tmp_path):
    text = "trial,s,displacement,force\n,mm,(mm),(N)\n1,35,0,0\n1,35,1,2\n2,40,0,0\n2,40,2,3\n"
    found = both(put(tmp_path, text, "T7.csv"))
    assert found == [("T7", "1", 35.0, 0, 2.0), ("T7", "2", 40.0, 0, 3.0)]


def test_a_column_that_the_options_name_and_the_table_has_not(tmp_path):
    text = "displacement [mm],force [N]\n0,0\n1,2\n"
    bad = only_bad(read(put(tmp_path, text, "T7.csv"), columns={"s": "pos"}))
    assert "no column 'pos' for the s; the columns are 'displacement', 'force'" in bad.message


def test_a_specimen_called_sep(tmp_path):
    text = "# by hand\nspecimen,displacement [mm],force [N]\nsep=1,0,0\nsep=1,1,2\n"
    assert read(put(tmp_path, text)).curves[0].specimen == "sep=1"


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
