"""Rows of tables by pandas: numbers bit by bit, odd cells, and files of many rows.

The truth is the built-in float(), and for one file numbers that are known in advance.
"""

import gzip
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from measured_files import put, read

from jaxtrachea.measurements.curve import BadCurve, Fault
from jaxtrachea.measurements.read import read_measurements
from jaxtrachea.measurements.readers.cells import numbers
from jaxtrachea.measurements.readers.table import Header, Text, rows_below

#: Cells that another notation, a slip or a spreadsheet leaves.
CELLS = (
    "", " ", "\xa0", "1 000", "1_000", "1,5", "1.5.", "--1", "+-1", "+ 1", "1e", "1e+", "e5", ".",
    "-", "+", "1d5", "0x10", "1.5 N", "nan", "-NaN", "nan(1)", "NAN()", "inf", "+Infinity",
    "infinit", "true", "True", "FALSE", "null", "NA", "None", "#N/A", "=A1", "'5", '"5"', "1.5",
    "\u0663", "\xbd", "1\x0c", "\x0b1", "1\x1f", "2024-05-01", "1e400", "-1e400", "1e-400",
    "4.9e-324", "2.4703282292062328e-324", "1" * 400, "0." + "0" * 400 + "1", "9007199254740993",
    "18446744073709551617", "1e23", "8.5e22", "(", "1.5\u2009", "+3", "007", "1.E-3", ".5", "5.",
)  # fmt: skip


def column(cells, delimiter):
    """The numbers of a column of these cells, beside one of names; the message if it is refused."""
    text = "".join(f"A{delimiter}{cell}\n" for cell in cells)
    header = Header(["specimen", "force"], [None, "N"], 0, delimiter, 1)
    table = rows_below(Text(Path("x.csv"), text.encode()), header)
    table.load([1], [0])
    try:
        return table.values("force", 1, slice(None), "N")
    except Fault as fault:
        return fault.message


@pytest.mark.parametrize("delimiter", [";", "\t", ","])
@pytest.mark.parametrize("cell", [cell for cell in CELLS if "," not in cell])
def test_any_cell_is_what_float_makes_of_it_or_refused(cell, delimiter):
    for others in (["0.5", "2"], ["7", "8"], ["x y"]):
        plain = cell[1:-1] if cell[:1] == '"' else cell
        try:
            expected = float("_" if "_" in plain else plain.strip() or "nan")
        except ValueError:
            expected = None
        found = column([*others, cell], delimiter)
        if expected is None or others == ["x y"]:
            assert "is not a number" in found
        else:
            assert struct.pack("<d", found[-1]) == struct.pack("<d", expected) or cell == "-NaN"


def test_two_decimal_signs_in_a_column():
    assert "'0,35' is not a number" in column(["0.5", "0,35"], ";")
    np.testing.assert_array_equal(column(["0,5", "0,35", "-1,5e-3"], ";"), [0.5, 0.35, -1.5e-3])
    assert "is not a number" in column(["0,5", "1.234,5"], ";")


def test_thousands_of_one_curve_among_others(tmp_path):
    """The decimals of one curve say nothing of another, which an instrument of its own wrote."""
    text = "specimen;displacement [um];force [N]\n"
    text += "".join(f"A;{i}.125;{i}.5\n" for i in range(9))
    text += "".join(f"B;{d};{i}.5\n" for i, d in enumerate(["0", "500", "900", "1.100"]))
    found = read(put(tmp_path, text))
    assert [curve.specimen for curve in found.curves] == ["A"]
    assert "may be a thousand times as large" in found.bad[0].message


def test_names_keep_their_zeros(tmp_path):
    text = "specimen,trial,displacement [mm],force [N]\n"
    text += "".join(f"007,{t},{i},{i}\n" for t in ("01", "1", "1.0") for i in range(3))
    found = [(curve.specimen, curve.trial) for curve in read(put(tmp_path, text)).curves]
    assert found == [("007", "01"), ("007", "1"), ("007", "1.0")]


def decimals():
    """Numbers of all sizes as decimals of up to 800 digits, among them halves between two."""
    rng = np.random.default_rng(7)
    values = rng.integers(0, 2**63, 3000, dtype=np.uint64).view(np.float64)
    values = values[np.isfinite(values)].tolist()
    texts = [form.format(x) for x in values for form in ("{!r}", "{:.16e}", "{:.3e}", "{:.25g}")]
    texts += [f"{x:.{k % 24}f}" for k, x in enumerate(rng.uniform(-99, 99, 3000))]
    for x in values[:300]:
        # Exponent one lower: the middle of two neighbours is a sum that Python's integers take.
        a, b = x.as_integer_ratio(), np.nextafter(x, np.inf).item().as_integer_ratio()
        if max(a[1], b[1]) < 2**200 and max(abs(a[0]), abs(b[0])) < 2**200:
            twice = 2 * a[1] * b[1]
            power = twice.bit_length() - 1
            middle = (a[0] * b[1] + b[0] * a[1]) * 5**power
            texts.append(f"{middle}e-{power}")
    return texts


@pytest.mark.parametrize("comma", [False, True])
def test_numbers_bit_by_bit(comma):
    texts = decimals()
    expected = b"".join(struct.pack("<d", float(text)) for text in texts)
    cells = [text.replace(".", ",") for text in texts] if comma else texts
    assert column(cells, ";").astype("<f8").tobytes() == expected
    assert numbers(cells, range(len(cells)), "force", ";").astype("<f8").tobytes() == expected


def study(curves, samples):
    """A table with known numbers: displacement i / 100 and force (i + curve) / 8."""
    lines = ["specimen,trial,s [mm],displacement [mm],force [N]"]
    for c in range(curves):
        lines += [f"T{c // 5},{c % 5 + 1},17.5,{i / 100},{(i + c) / 8}" for i in range(samples)]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("packed", [False, True])
def test_many_rows(packed, tmp_path):
    text = study(300, 200).encode()
    path = put(tmp_path, gzip.compress(text, 1) if packed else text)
    found = read(path)
    assert (len(found.curves), found.bad) == (300, ())
    for c in (0, 7, 299):
        curve = found.curves[c]
        assert (curve.specimen, curve.trial, curve.s_c) == (f"T{c // 5}", str(c % 5 + 1), 17.5)
        np.testing.assert_array_equal(curve.displacement, np.arange(200) / 100)
        np.testing.assert_array_equal(curve.force, (np.arange(200) + c) / 8)
        assert curve.source == f"{path}:{2 + 200 * c}-{201 + 200 * c}"


def test_message_names_the_line_among_many(tmp_path):
    lines = study(300, 200).split("\n")
    lines[40_000] = "T39,5,17.5,1.98,1.2.5"
    lines[100] = "# a pause"
    lines[200] = ""
    found = read(put(tmp_path, "\n".join(lines)))
    assert len(found.curves) == 299
    (bad,) = found.bad
    assert isinstance(bad, BadCurve)
    assert bad.kind == "unparsable"
    assert "line 40001: force '1.2.5' is not a number" in bad.message
    assert [curve.force.size for curve in found.curves[:2]] == [198, 200]


def test_pandas_is_imported_for_tables_alone(tmp_path):
    from jaxtrachea.measurements.read import write_hdf5

    path = put(tmp_path, study(2, 9))
    write_hdf5(tmp_path / "m.h5", read_measurements([path]))
    code = (
        "import sys\nfrom jaxtrachea.measurements.read import read_measurements\n"
        f"read_measurements({str(tmp_path / 'm.h5')!r})\nprint('pandas' in sys.modules)\n"
        f"read_measurements({str(path)!r})\nprint('pandas' in sys.modules)"
    )
    root = Path(__file__).parents[1]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True)
    assert done.stdout == "False\nTrue\n", done.stderr
