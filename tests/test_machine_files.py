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
