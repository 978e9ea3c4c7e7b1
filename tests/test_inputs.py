"""Packed texts and workbooks against the same CSV, files of other kinds, names that look alike."""

import datetime
import gzip
import importlib.util
import io
import re
import sys
import time
import zipfile

import numpy as np
import pytest
from run_cli import GOOD

from jaxtrachea.measurements.curve import BadCurve, Curve
from jaxtrachea.measurements.names import appearance, look_alikes
from jaxtrachea.measurements.read import DataError, ReadOptions, read_measurements
from jaxtrachea.measurements.readers import recognise, text_file

needs_openpyxl = pytest.mark.skipif(
    importlib.util.find_spec("openpyxl") is None, reason="openpyxl (extra 'xlsx') is not installed"
)
TWO = GOOD + GOOD.partition("\n")[2].replace("T01,1,35", "T02,a,40.5")
MACHINE = "Operator: A. N.\n\nTime (s),Compression (mm),Load (N)\n0,0,-0.01\n0.1,0.5,1\n0.2,1,2.5\n"


def put(folder, content, name="study.csv"):
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def read(path, **options):
    return read_measurements([path], ReadOptions(**options))


def assert_same(found, expected):
    assert (found.bad, len(found.curves)) == ((), len(expected.curves))
    for a, b in zip(found.curves, expected.curves, strict=True):
        assert (a.specimen, a.trial, a.s_c, a.phi_c) == (b.specimen, b.trial, b.s_c, b.phi_c)
        np.testing.assert_array_equal(a.displacement, b.displacement)
        np.testing.assert_array_equal(a.force, b.force)


# --- gzip ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["study.csv.gz", "study.gz", "study.csv"])
def test_packed_text_is_the_same(tmp_path, name):
    plain = read(put(tmp_path, TWO))
    data = TWO.replace("\n", "\r").encode("utf-16")
    assert_same(read(put(tmp_path, gzip.compress(data), name)), plain)
    # A file of several members, as `cat a.gz b.gz` makes, is one text.
    members = gzip.compress(TWO[:50].encode()) + gzip.compress(TWO[50:].encode())
    assert_same(read(put(tmp_path, members, name)), plain)


def test_names_of_packed_machine_files(tmp_path):
    path = put(tmp_path, gzip.compress(MACHINE.encode()), "EF_3.csv.gz")
    assert read(path).curves[0].specimen == "EF_3"
    (got,) = read(path, specimen="{specimen}_{trial}").curves
    assert (got.specimen, got.trial) == ("EF", "3")
    (got,) = read(path, specimen=r"(?P<specimen>EF)_\d\.csv\.gz$").curves
    assert got.specimen == "EF"


def test_a_bomb_is_refused_before_it_is_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(text_file, "MAX_TEXT_BYTES", 2**20)
    at_limit = GOOD.encode().ljust(2**20)
    assert len(read(put(tmp_path, gzip.compress(at_limit), "a.gz")).curves) == 1
    for content in (gzip.compress(at_limit + b" "), at_limit + b" "):
        with pytest.raises(DataError, match="more than 1048576 bytes of text"):
            read(put(tmp_path, content))


def test_a_file_that_is_not_text_is_not_read_as_such(tmp_path):
    # Every signature is refused with its cure, also within gzip; none is taken for text.
    for signature, what, cure in recognise.SIGNATURES[:-1]:  # the last is gzip itself
        for content in (signature + bytes(64), gzip.compress(signature + bytes(64))):
            with pytest.raises(DataError) as caught:
                read(put(tmp_path, content, "x.csv"))
            assert what in str(caught.value)
            assert str(caught.value).endswith(cure)


def test_words_that_only_begin_like_a_signature(tmp_path):
    for word in ("PAR1", "BZh", "MZ", "II", "RDX", "GIF", "CDF", "7z", "PK"):
        text = GOOD.replace("specimen,trial", f"{word},specimen,trial").replace("T01", "x,T01")
        assert len(read(put(tmp_path, text)).curves) == 1


def test_cell_errors_are_no_comments(tmp_path):
    text = "displacement [mm],force [N]\n# a comment\n0,0\n#N/A,0.3\n1,0.7\n"
    (bad,) = read(put(tmp_path, text, "T1.csv")).bad
    assert (bad.kind, "line 4: displacement '#N/A'" in bad.message) == ("unparsable", True)


# --- workbooks ----------------------------------------------------------------------------------


def cell(text):
    try:
        return float(text) if "." in text else int(text)
    except ValueError:
        return text or None


def book(text, title="Data"):
    """A workbook with the cells of a CSV."""
    import openpyxl

    made = openpyxl.Workbook()
    made.active.title = title
    for line in text.splitlines():
        made.active.append([cell(text) for text in line.split(",")])
    return made


def keep(folder, made, name="study.xlsx"):
    made.save(folder / name)
    return folder / name


@needs_openpyxl
@pytest.mark.parametrize("text", [TWO, MACHINE, "# a\n\n" + TWO, TWO.replace("T01", 'a "b", c')])
def test_a_workbook_is_the_same_as_its_csv(tmp_path, text):
    plain = read(put(tmp_path, text if '"' not in text else TWO))
    found = read(keep(tmp_path, book(text.replace('"b", c', '"b" c'))))
    if '"' in text:
        assert found.curves[0].specimen == 'a "b" c'
        found = read(keep(tmp_path, book(TWO)))
    assert_same(found, plain)
    assert found.notes == ()
    assert "study.xlsx sheet 'Data':" in found.curves[0].source


@needs_openpyxl
def test_rows_columns_and_sheet_are_named(tmp_path):
    made = book(TWO)
    made.active["E4"] = "0.66 N"
    made.active["E8"] = datetime.datetime(2026, 5, 1)
    one, two = read(keep(tmp_path, made)).bad
    assert "sheet 'Data':2-5: row 4: force '0.66 N' is not a number" in one.message
    assert "row 8: force '2026-05-01' is not a number" in two.message
    assert "took it for a date" in two.cure
    made = book(TWO)
    made.active["G3"] = "see notebook"
    with pytest.raises(DataError, match="row 3 has 7 cells, the header has 5; clear the cells"):
        read(keep(tmp_path, made))
    made = book(TWO)
    made.active["E1"] = "force [kips]"
    with pytest.raises(DataError, match="sheet 'Data': column 'force': unknown unit"):
        read(keep(tmp_path, made))


@needs_openpyxl
def test_formulas(tmp_path):
    made = book(TWO)
    made.active["E4"] = "=E3*2"
    made.active["H1"] = "=1+1"  # beside the table; without a value, so it is seen
    made.active["H1"] = None
    one = read(keep(tmp_path, made))
    assert [c.specimen for c in one.curves] == ["T02"]
    assert "row 4: force '=E3*2' is not a number" in one.bad[0].message
    assert "open the file in a spreadsheet program" in one.bad[0].cure
    # Stored values count: as a spreadsheet program leaves them.
    stored = io.BytesIO()
    with zipfile.ZipFile(tmp_path / "study.xlsx") as old, zipfile.ZipFile(stored, "w") as new:
        for name in old.namelist():
            data = old.read(name)
            if name.endswith("sheet1.xml"):
                # openpyxl writes the empty value in three ways, with lxml and without.
                empty = rb"<f>E3\*2</f><v(?: ?/>|></v>)"
                data, count = re.subn(empty, b"<f>E3*2</f><v>0.66</v>", data)
                assert count == 1
            new.writestr(name, data)
    assert_same(read(put(tmp_path, stored.getvalue(), "stored.xlsx")), read(put(tmp_path, TWO)))
    made.active["A3"] = "=A2"
    with pytest.raises(DataError, match="row 3: specimen '=A2' is a formula without a stored"):
        read(keep(tmp_path, made))


@needs_openpyxl
def test_merged_cells_and_columns_without_names(tmp_path):
    made = book(TWO)
    made.active.merge_cells("A2:A5")
    with pytest.raises(DataError, match="row 3: specimen is empty; .*unmerge and fill down"):
        read(keep(tmp_path, made))
    spaced = "\n".join(line.replace(",", ",,,", 1) for line in TWO.splitlines())
    assert_same(read(keep(tmp_path, book(spaced))), read(put(tmp_path, TWO)))


@needs_openpyxl
def test_which_sheet(tmp_path):
    made = book("Operator,A. N.", title="Notes")
    for title, text in {"Hidden": "x", "Data": TWO}.items():
        page = made.create_sheet(title)
        for line in text.splitlines():
            page.append([cell(text) for text in line.split(",")])
    made["Hidden"].sheet_state = "hidden"
    path = keep(tmp_path, made)
    found = read(path, sheet="Data")
    assert_same(found, read(put(tmp_path, TWO)))
    assert found.notes == (
        f"{path}: sheet 'Data' was read, not 'Notes', 'Hidden'; data.sheet chooses another",
    )
    (bad,) = read(path).bad
    assert (bad.kind, "sheet 'Notes'" in bad.message) == ("column_missing", True)
    assert "choose another sheet with data.sheet ('Hidden', 'Data')" in bad.cure
    with pytest.raises(DataError, match="no sheet 'data'; its sheets are 'Notes', 'Hidden', 'D"):
        read(path, sheet="data")
    made["Notes"].sheet_state = "hidden"
    assert_same(read(keep(tmp_path, made)), found)


@needs_openpyxl
def test_a_csv_in_the_first_column_and_rows_far_apart(tmp_path):
    made = book("")
    for number, line in enumerate(TWO.splitlines(), 1):
        made.active.cell(number * 1000, 1, line)
    assert_same(read(keep(tmp_path, made)), read(put(tmp_path, TWO)))


def test_without_openpyxl(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "openpyxl", None)
    with zipfile.ZipFile(tmp_path / "a.xlsx", "w") as archive:
        archive.writestr("xl/workbook.xml", "<workbook/>")
    with pytest.raises(DataError, match=r"openpyxl.*pip install 'jaxtrachea\[xlsx\]'.*as CSV"):
        read(tmp_path / "a.xlsx")


# --- names --------------------------------------------------------------------------------------


def curve(specimen, trial="1"):
    return Curve(specimen, trial, None, 0.0, np.arange(2.0), np.arange(2.0), source="f.csv:2-9")


@pytest.mark.parametrize(
    ("other", "difference"),
    [
        ("t\xfcbe-1", "case"),
        ("Tu\u0308be-1", "Unicode form"),
        ("\uff34\xfcbe-1", "Unicode form"),
        ("tu\u0308be-1", "Unicode form and case"),
    ],
)
def test_names_that_look_alike(other, difference):
    (line,) = look_alikes([curve("T\xfcbe-1"), curve(other), curve("T\xfcbe-2"), curve("U")])
    assert f"differ by {difference} alone" in line
    assert line.startswith("specimens 'T\xfcbe-1' (1 curve, first f.csv:2-9), ")
    assert repr(other) in line or ascii(other) in line


def test_trials_look_alike_within_a_specimen_only():
    assert look_alikes([curve("T1", "a"), curve("T2", "A")]) == []
    (line,) = look_alikes([curve("T1", "a"), curve("T1", "A"), curve("T2", "A")])
    assert line.startswith("trials of specimen 'T1' 'a' (1 curve, first f.csv:2-9), 'A'")


def test_look_alikes_of_many_names():
    names = [f"S\xfc{i:06d}" for i in range(3_000)]
    curves = [BadCurve(name, "1", "f.csv", "empty", "none", "cure") for name in names]
    began = time.process_time()
    assert look_alikes(curves) == []
    assert time.process_time() - began < 5  # 0.1 s; comparing pairs would take a minute
    assert len({appearance(name) for name in names}) == len(names)
