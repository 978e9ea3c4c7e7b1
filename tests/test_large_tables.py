"""Large tidy tables: what pyarrow reads is what the reader line by line makes of the same file.

The truth is the slow way (`csv.read`, which shares with the quick one only what comes after the
cells), the built-in float(), and for one file numbers that are known in advance.
"""

import dataclasses
import gzip
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from jaxtrachea.measurements import read
from jaxtrachea.measurements.curve import BadCurve, DataError, ReadOptions
from jaxtrachea.measurements.read import read_measurements
from jaxtrachea.measurements.readers import large
from jaxtrachea.measurements.readers.csv import TIDY
from jaxtrachea.measurements.readers.lines import read_bytes

HEAD = "specimen,trial,s [mm],displacement [mm],force [N]"
ROWS = [f"{a},{b},35.5,{0.1 * i!r},{0.3 * i + 0.01 * i * i!r}" for a in "AB" for b in "12"
        for i in range(8)]  # fmt: skip
TABLE = "\n".join([HEAD, *ROWS]) + "\n"


def with_row(row, at=5, table=TABLE):
    lines = table.split("\n")
    return "\n".join([*lines[:at], row, *lines[at + 1 :]])


def with_line(row, at=5):
    lines = TABLE.split("\n")
    return "\n".join([*lines[:at], row, *lines[at:]])


def column(name, cells):
    lines = TABLE.rstrip().split("\n")
    return "\n".join(
        [f"{lines[0]},{name}", *(f"{r},{c}" for r, c in zip(lines[1:], cells, strict=True))]
    )


def with_specimen(name):
    return TABLE.replace("\nB,", f"\n{name},")


GERMAN = TABLE.replace(",", ";").replace(".", ",")
MARKERS = column("joint_3 [mm]", [f"{0.05 * i}" if i % 3 else "" for i in range(32)])
ENDS = column("end_U_3_y [um]", range(32))
#: Micrometres from 0 to 1400 by hundreds, 1000 written 1.000, of two curves.
GROUPED = ["0", *[str(100 * i) for i in range(1, 10)], *[f"1.{i}00" for i in range(6)]]
THOUSANDS = "specimen;displacement [um];force [N]\n" + "".join(
    f"{who};{D};{i + 1}.5\n" for who in "AB" for i, D in enumerate(GROUPED)
)
NAMELESS = "\n".join(line.split(",", 2)[2] for line in TABLE.split("\n")[:9]) + "\n"

#: Files that pyarrow reads, with options.
PLAIN = {
    "as written": (TABLE, {}),
    "tabs": (TABLE.replace(",", "\t"), {}),
    "semicolons": (TABLE.replace(",", ";"), {}),
    "decimal commas": (GERMAN, {}),
    "decimal commas and tabs": (GERMAN.replace(";", "\t"), {}),
    "CRLF": (TABLE.replace("\n", "\r\n"), {}),
    "no line end at the end": (TABLE.rstrip(), {}),
    "empty lines at the end": (TABLE + "\n\n", {}),
    "byte-order mark": ("\ufeff" + TABLE, {}),
    "comments above": ("# one\n\n  # two\n" + TABLE, {}),
    "what holds for the table": ('{"phi": "20 deg", "direction": [0.6, 0.8]}\n' + TABLE, {}),
    "latin-1 header": (TABLE.replace("[mm]", "[µm]").encode("latin-1"), {}),
    "names in UTF-8": (with_specimen("Trachée 木"), {}),
    "blanks around cells": (TABLE.replace(",", " , "), {}),
    "names in quotes": (TABLE.replace("\nA", '\n"A"').replace("\nB", '\n" B "'), {}),
    "name behind an apostrophe": (with_specimen("'=B"), {}),
    "commas in names": (TABLE.replace(",", "\t").replace("\nB", "\nB,1"), {}),
    "bracket in a name": (with_specimen("B (2)"), {}),
    "missing force": (with_row("A,1,35.5,0.4,"), {}),
    "NaN": (with_row("A,1,35.5,0.4,NaN"), {}),
    "infinite": (with_row("A,1,35.5,0.4,-inf"), {}),
    "too large": (with_row("A,1,35.5,0.4,1e999"), {}),
    "minus zero, plus, exponents": (with_row("A,1,+3.55e1,-0.0,1.E-3"), {}),
    "no position in a row": (with_row("A,1,,0.4,1.0"), {}),
    "position varies": (with_row("A,1,36.5,0.4,1.0"), {}),
    "position varies by rounding": (with_row("A,1,35.50000000001,0.4,1.0"), {}),
    "no position at all": (TABLE.replace("35.5", ""), {}),
    "markers, some unseen": (MARKERS, {}),
    "side of no marker": (MARKERS.replace("joint_3", "joint_3_side"), {}),
    "ends of rings": (ENDS, {}),
    "column that nobody reads": (column("operator", ["O. Else"] * 32), {}),
    "time with unit": (column("time [s]", range(32)), {}),
    "time falls": (column("time [s]", range(32, 0, -1)), {}),
    "time without unit": (column("time", ["10:00:00"] * 32), {}),
    "time with a unit of the options": (column("time", range(32)), {"units": {"time": "ms"}}),
    "time with a hole": (column("time [s]", ["", *range(31)]), {}),
    "other names": (
        TABLE.replace("force [N]", "P"),
        {"columns": {"force": "P"}, "units": {"force": "kN"}},
    ),
    "name by the file": (NAMELESS, {"format": "tidy"}),
    "sigma": (column("sigma [N]", ["0.1"] * 32), {}),
    "three decimals, some below 1": (
        THOUSANDS.replace(";0;", ";0.125;").replace(";100;", ";1.125;"),
        {},
    ),
    "two decimals": (THOUSANDS.replace("00;", "0;"), {}),
    "three decimals, few whole": (THOUSANDS.replace("00;", ";"), {}),
    "sigma below 0": (column("sigma [N]", ["-0.1"] * 32), {}),
}
#: Files that must be read line by line, or are refused so.
ODD = {
    "thousands after a point": (THOUSANDS, {}),
    "thousands after a comma": (THOUSANDS.replace(",", "").replace(".", ","), {}),
    "thousands, blanks around": (THOUSANDS.replace(";", " ; "), {}),
    "short row": (with_row("A,1,35.5,0.4"), {}),
    "long row": (with_row("A,1,35.5,0.4,1.0,7"), {}),
    "empty cells beyond the header": (with_row("A,1,35.5,0.4,1.0,,"), {}),
    "header with empty cells at the end": (TABLE.replace("\n", ",\n"), {}),
    "empty line": (with_line(""), {}),
    "two empty lines between curves": (with_line("\n", 9), {}),
    "empty line below the header": (with_line("", 1), {}),
    "blank line": (with_line("  \t"), {}),
    "row of empty cells": (with_line(",,,,"), {}),
    "row of empty cells without names": (NAMELESS + ",,\n", {"format": "tidy"}),
    "empty line without names": (NAMELESS.replace("\n", "\n\n", 3), {"format": "tidy"}),
    "comment": (with_line("# pause"), {}),
    "comment of as many cells": (with_line("#,1,35.5,0.4,1.0"), {}),
    "comment between curves": (with_line("#C,1,35.5,0.4,1.0", 9), {}),
    "old Mac line ends": (TABLE.replace("\n", "\r"), {}),
    "a line end of old Macs": (with_line("A,1,35.5,0.4,1.0\rA,1,35.5,0.4,1.0"), {}),
    "UTF-16": (TABLE.encode("utf-16"), {}),
    "zero byte": (TABLE.replace("B", "B\0"), {}),
    "zero byte where nobody reads": (column("operator", ["a\0b"] * 32), {}),
    "names in latin-1": (with_specimen("Trachée").encode("latin-1"), {}),
    "names that would pass for UTF-8": (
        column("operator", ["é"] * 32).encode("latin-1").replace(b"\nB", "\né".encode()), {}),
    "line end of old Macs in a comment": ("# by\rO. Else\n" + TABLE, {"format": "tidy"}),
    "mark before latin-1": (
        b"\xef\xbb\xbf" + TABLE.replace("[mm]", "[µm]").encode("latin-1"), {"format": "tidy"}),
    "two marks, tidy": ("\ufeff\ufeff" + TABLE, {"format": "tidy"}),
    "two marks": ("\ufeff\ufeff" + TABLE, {}),
    "mark in the first row": (TABLE.replace("\nA", "\n\ufeffA", 1), {}),
    "comma in quotes": (TABLE.replace("\nB", '\n"B,2"'), {}),
    "quote in quotes": (TABLE.replace("\nB", '\n"B""2"'), {}),
    "quote in a name": (with_specimen('B"2'), {}),
    "quote open": (with_row('"A,1,35.5,0.4,1.0'), {}),
    "quotes over lines": (with_row('"A\nA",1,35.5,0.4,1.0'), {}),
    "number in quotes": (with_row('A,1,35.5,0.4,"1.0"'), {}),
    "quotes in a column that nobody reads": (column("operator", ['"A, B"'] * 32), {}),
    "quote open in a column that nobody reads": (column("operator", ['"A'] * 32), {}),
    "empty name": (with_row(",1,35.5,0.4,1.0"), {}),
    "blank name": (with_row("  ,1,35.5,0.4,1.0"), {}),
    "unprintable name": (with_specimen("B\x07"), {}),
    "curves interleaved": (TABLE + ROWS[0] + "\n", {}),
    "column twice": (TABLE.replace("trial", "specimen", 1), {}),
    "no force": (TABLE.replace("force", "weight"), {}),
    "no unit": (TABLE.replace(" [N]", ""), {}),
    "unknown unit": (TABLE.replace("[N]", "[kips]"), {}),
    "header alone": (HEAD + "\n", {}),
    "no header": ("# nothing\n" * 300, {"format": "tidy"}),
    "header without names": (",,,\n1,2,3,4\n", {"format": "tidy"}),
    "comments for long": ("# nothing\n" * 300 + TABLE, {}),
    "what holds for the table, twice": ('{"s": "20 mm"}\n' + TABLE, {}),
    "JSON cut off": ('{"s": \n' + TABLE, {}),
    "decimal commas, points in names": (GERMAN.replace("\nB", "\nB.1"), {}),
    "decimal commas and points": (GERMAN.replace("35,5", "35.5"), {}),
    "decimal comma with nothing after it": (GERMAN.replace("35,5", "35,"), {}),
    "decimal comma with an exponent after it": (GERMAN.replace("35,5", "35,e0"), {}),
    "clock with unit": (column("time [s]", ["10:00:00"] * 32), {}),
    "one column for two roles": (TABLE, {"columns": {"trial": "s"}}),
    "a cell of 2 MB": (with_specimen("B" * 2**21), {}),
}  # fmt: skip
#: Cells that are put in the place of every cell of a row.
CELLS = (
    "", " ", "\t", "\xa0", "1 000", "1_000", "1,5", "1.5.", "--1", "+-1", "+ 1", "1e", "1e+", "e5",
    ".", "-", "+", "1d5", "0x10", "1.5 N", "nan", "-NaN", "nan(1)", "NAN()", "inf", "+Infinity",
    "infinit", "true", "null", "NA", "#N/A", "=A1", "'5", '"5"', '"', "٣", "½", "1\x0c", "\x0b1",
    "1\x1f", "2024-05-01", "1e400", "-1e400", "1e-400", "4.9e-324", "2.4703282292062328e-324",
    "1" * 400, "0." + "0" * 400 + "1", "9007199254740993", "1e23", "8.5e22", "(", "1.5\u2009",
)  # fmt: skip


def outcome(path, options, monkeypatch, quick):
    """What a file gives through the door: curves and bad ones, or the error."""
    monkeypatch.setattr(read, "MIN_BYTES", 1 if quick else sys.maxsize)
    try:
        found = read_measurements([path], options)
    except DataError as error:
        return str(error)
    return found.curves + found.bad


def same(one, other):
    """Equal in every field, numbers bit by bit (but for the sign of NaN), of the same types."""
    if isinstance(one, str) or isinstance(other, str):
        assert one == other
        return
    assert len(one) == len(other)
    for a, b in zip(one, other, strict=True):
        assert type(a) is type(b)
        for field in dataclasses.fields(a):
            x, y = getattr(a, field.name), getattr(b, field.name)
            assert type(x) is type(y), field.name
            if isinstance(x, np.ndarray):
                np.testing.assert_array_equal(x, y, strict=True)
                seen = ~np.isnan(x)
                assert np.array_equal(np.signbit(x[seen]), np.signbit(y[seen]))
            else:
                assert x == y, field.name


def stored(folder, content):
    path = folder / "T7_2.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def check(path, options, monkeypatch):
    """Both ways give the same; whether the quick one was taken."""
    slow = outcome(path, options, monkeypatch, quick=False)
    same(outcome(path, options, monkeypatch, quick=True), slow)
    try:
        data = read_bytes(path)
    except DataError:
        return False
    return TIDY.read_large(path, data, options) is not None


@pytest.mark.parametrize("name", PLAIN)
def test_read_at_once(name, tmp_path, monkeypatch):
    content, options = PLAIN[name]
    assert check(stored(tmp_path, content), ReadOptions(**options), monkeypatch)


@pytest.mark.parametrize("name", ODD)
def test_read_line_by_line(name, tmp_path, monkeypatch):
    content, options = ODD[name]
    assert not check(stored(tmp_path, content), ReadOptions(**options), monkeypatch)


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
@pytest.mark.parametrize("place", range(5))
def test_any_cell(place, delimiter, tmp_path, monkeypatch):
    for cell in CELLS:
        row = TABLE.split("\n")[5].split(",")
        row[place] = cell
        table = with_row(delimiter.join(row), table=TABLE.replace(",", delimiter))
        check(stored(tmp_path, table), ReadOptions(), monkeypatch)


@pytest.mark.parametrize("cell", CELLS)
def test_any_cell_with_decimal_comma(cell, tmp_path, monkeypatch):
    cells = [cell.replace(".", ","), *"01234567"]
    table = "specimen;displacement [mm];force [N]\n" + "".join(f"A;{c};{c}\n" for c in cells)
    check(stored(tmp_path, table), ReadOptions(), monkeypatch)


def decimals():
    """Numbers of all sizes as decimals of up to 800 digits, among them halves between two."""
    rng = np.random.default_rng(7)
    numbers = rng.integers(0, 2**63, 3000, dtype=np.uint64).view(np.float64)
    numbers = numbers[np.isfinite(numbers)].tolist()
    texts = [form.format(x) for x in numbers for form in ("{!r}", "{:.16e}", "{:.3e}", "{:.25g}")]
    texts += [f"{x:.{k % 24}f}" for k, x in enumerate(rng.uniform(-99, 99, 3000))]
    for x in numbers[:300]:
        # Exponent one lower: the middle of two neighbours is a sum that Python's integers take.
        a, b = x.as_integer_ratio(), np.nextafter(x, np.inf).item().as_integer_ratio()
        if max(a[1], b[1]) < 2**200 and max(abs(a[0]), abs(b[0])) < 2**200:
            twice = 2 * a[1] * b[1]
            power = twice.bit_length() - 1
            middle = (a[0] * b[1] + b[0] * a[1]) * 5**power
            texts.append(f"{middle}e-{power}")
    return texts


def test_numbers_bit_by_bit(tmp_path):
    texts = decimals()
    table = "specimen,displacement [mm],force [N]\n" + "".join(f"A,0,{t}\n" for t in texts)
    path = stored(tmp_path, table)
    (record,) = TIDY.read_large(path, read_bytes(path), ReadOptions())
    expected = [struct.pack("<d", float(text)) for text in texts]
    assert record.force.astype("<f8").tobytes() == b"".join(expected)


def study(curves, samples):
    """A table with known numbers: displacement i / 100 and force (i + curve) / 8."""
    lines = ["specimen,trial,s [mm],displacement [mm],force [N]"]
    for c in range(curves):
        lines += [f"T{c // 5},{c % 5 + 1},17.5,{i / 100},{(i + c) / 8}" for i in range(samples)]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("packed", [False, True])
def test_large_file_takes_the_quick_way(packed, tmp_path, monkeypatch):
    text = study(300, 200).encode()
    assert len(text) > large.MIN_BYTES
    path = stored(tmp_path, gzip.compress(text, 1) if packed else text)
    monkeypatch.setattr(read, "split_lines", lambda *args: pytest.fail("read line by line"))
    found = read_measurements([path])
    assert (len(found.curves), found.bad) == (300, ())
    for c in (0, 7, 299):
        curve = found.curves[c]
        assert (curve.specimen, curve.trial, curve.s_c) == (f"T{c // 5}", str(c % 5 + 1), 17.5)
        np.testing.assert_array_equal(curve.displacement, np.arange(200) / 100)
        np.testing.assert_array_equal(curve.force, (np.arange(200) + c) / 8)
        assert curve.source == f"{path}:{2 + 200 * c}-{201 + 200 * c}"


def test_message_names_the_line_of_a_large_file(tmp_path):
    lines = study(300, 200).split("\n")
    lines[40_000] = "T39,5,17.5,1.98,1.2.5"
    found = read_measurements([stored(tmp_path, "\n".join(lines))])
    assert len(found.curves) == 299
    (bad,) = found.bad
    assert isinstance(bad, BadCurve)
    assert bad.kind == "unparsable"
    assert "line 40001: force '1.2.5' is not a number" in bad.message


@pytest.mark.parametrize(("curves", "imported"), [(5, False), (300, True)])
def test_pyarrow_is_imported_for_large_files_alone(curves, imported, tmp_path):
    path = stored(tmp_path, study(curves, 200))
    code = (
        "import sys\nfrom jaxtrachea.measurements.read import read_measurements\n"
        f"read_measurements({str(path)!r})\nprint('pyarrow' in sys.modules)"
    )
    root = Path(__file__).parents[1]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True)
    assert done.stdout == f"{imported}\n", done.stderr


def test_without_pyarrow_files_are_read_line_by_line(tmp_path, monkeypatch):
    path = stored(tmp_path, study(300, 200))
    quick = read_measurements([path])
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert TIDY.read_large(path, read_bytes(path), ReadOptions()) is None
    same(read_measurements([path]).curves, quick.curves)
