"""Columns of tables by pandas, against the csv module row by row."""

import csv
import io
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxtrachea.measurements.curve import Fault
from jaxtrachea.measurements.read import DataError, read_measurements
from jaxtrachea.measurements.readers.cells import numbers
from jaxtrachea.measurements.readers.table import Header, Text, rows_below

CELLS = st.sampled_from(["T1", "0.5", "", " 2 ", "-1e-3", '"a b"', "\u00a03", "=1", "#N/A", "# no"])
DELIMITERS = st.sampled_from([",", ";", "\t"])


def read_columns(texts, width, delimiter):
    """Numbers of the rows below a header in line 1, and the cells of the columns."""
    text = Text(Path("x.csv"), "\n".join(["header", *texts]).encode())
    header = Header([str(i) for i in range(width)], [None] * width, 1, delimiter, 2)
    table = rows_below(text, header)
    table.load([], range(width))
    found = [table.names_of(i) for i in range(width)]
    return table.lines.tolist(), [[names[k] for k in codes] for codes, names in found]


def by_csv(texts, width, delimiter):
    """Numbers and cells of the rows that count, by the rules of docs/measurements.md."""
    found = []
    for number, text in enumerate(texts, 2):
        if text.lstrip().startswith("#") and not text.lstrip().upper().startswith("#N/A"):
            continue
        reader = csv.reader(io.StringIO(text), delimiter=delimiter, skipinitialspace=True)
        cells = [cell.strip() for cell in next(reader, [])]
        if any(cells):
            assert len(cells) == width
            found.append((number, cells))
    return found


@settings(max_examples=300, deadline=None)
@given(st.data(), st.integers(2, 4), DELIMITERS)
def test_columns_are_those_of_csv(data, width, delimiter):
    rows = data.draw(st.lists(st.lists(CELLS, min_size=width, max_size=width), max_size=8))
    texts = [delimiter.join(row) for row in rows]
    expected = by_csv(texts, width, delimiter)
    found, columns = read_columns(texts, width, delimiter)
    assert [*found] == [number for number, _ in expected]
    assert [[*row] for row in zip(*columns, strict=True)] == [cells for _, cells in expected]
    assert len(columns) == width


@pytest.mark.parametrize("texts", [["1,2", "3,4,5"], ["1,2", "3"], ["1,2,3"], ['1,"2', "3,4"]])
def test_a_row_of_another_width_is_named(texts):
    with pytest.raises(Fault, match="line [23]"):
        read_columns(texts, 2, ",")


@settings(max_examples=200, deadline=None)
@given(st.lists(st.floats(width=64), min_size=1, max_size=9), st.booleans())
def test_numbers_come_back_bit_by_bit(values, gap):
    cells = [*map(repr, values), *([""] if gap else [])]
    found = numbers(cells, range(len(cells)), "force", ";")
    np.testing.assert_array_equal(found, [*values, *([math.nan] if gap else [])])


@pytest.mark.parametrize("cell", ["1_000", "1,5,2", "1.5 N", "--1"])
def test_what_is_no_number_is_named(cell):
    with pytest.raises(Fault, match="line 8"):
        numbers(["0.5", cell], [7, 8], "force", ";")


def test_empty_rows_are_left_out():
    found, columns = read_columns(["T1,2", " ,", ",\u00a0", "T2,3"], 2, ",")
    assert [*found] == [2, 5]
    assert columns == [["T1", "T2"], ["2", "3"]]


HEAD = "specimen,trial,s [mm],displacement [mm],force [N]\n"


def test_curves_are_blocks_of_rows(tmp_path):
    """A name behind an apostrophe is the same name; a curve that comes again is refused."""
    path = tmp_path / "study.csv"
    rows = [f"{name},{trial},35,{d},{d * d + 0.1}" for name, trial in
            (("=a", "1"), ("=a", "2"), ("b", "2")) for d in (0.0, 0.5, 1.0, 1.5)]  # fmt: skip
    rows[1] = "'" + rows[1]
    path.write_text(HEAD + "\n".join(rows))
    found = read_measurements([path]).curves
    assert [(c.specimen, c.trial, len(c.force)) for c in found] == [
        ("=a", "1", 4), ("=a", "2", 4), ("b", "2", 4)]  # fmt: skip
    assert [c.source.rpartition(":")[2] for c in found] == ["2-5", "6-9", "10-13"]
    path.write_text(HEAD + "\n".join([*rows, rows[0]]))
    with pytest.raises(DataError, match="starts in line 2 and again in line 14"):
        read_measurements([path])
