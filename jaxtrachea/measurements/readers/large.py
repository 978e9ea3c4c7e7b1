"""Large text tables: the cells of all rows at once, by pyarrow, where no row is odd.

What is found odd is left to the slow way, which reads it or says what is wrong in which line. Every
test here is for what pyarrow would take in another way than `text.read_columns` and `text.numbers`;
what it refuses is odd, too. Both round decimal numbers to the nearest float64.
"""

import importlib
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxtrachea.measurements.readers.lines import Lines, is_comment
from jaxtrachea.measurements.readers.text import grouped

#: Smallest text that is read so, bytes: below, pyarrow takes as long to import as it saves.
MIN_BYTES = 2**20
#: Bytes from which the format of a text is told, and lines among which its header is looked for.
HEAD_BYTES, HEAD_LINES = 2**16, 200
_BOM = b"\xef\xbb\xbf"
_UTF16 = (b"\xff\xfe", b"\xfe\xff")
_NO_DIGIT_AFTER_COMMA = re.compile(rb",(?![0-9])")


class Opened(NamedTuple):
    """A large text, split below its header.

    Attributes:
        data: all of it, with Unix line ends and without mark.
        lines: the header, and the JSON object before it if there is one.
        begin: byte at which the rows begin.
    """

    data: bytes
    lines: Lines
    begin: int


def first_lines(data: bytes) -> Lines:
    """The first lines that hold something, of a text of at least `HEAD_BYTES`.

    Args:
        data: the text, in UTF-8 or Latin-1.

    Returns:
        The lines, to tell the format from; the last may be cut off.
    """
    text = data[:HEAD_BYTES].removeprefix(_BOM).decode("utf-8", errors="replace")
    texts = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    return Lines(range(1, len(texts) + 1), texts).where([*map(str.strip, texts)])


def opened(data: bytes) -> Opened | None:
    """Split a text below its header.

    Args:
        data: the text.

    Returns:
        None if it is odd: encoding, line ends, no header, no rows.
    """
    if data.startswith(_UTF16) or b"\0" in data:
        return None
    if b"\r" in data:
        if data.count(b"\r") != data.count(b"\r\n"):
            return None
        data = data.replace(b"\r\n", b"\n")
    try:
        if not data.isascii():
            data.decode()
        encoding = "utf-8"
    except UnicodeDecodeError:
        encoding = "latin-1"
    if data.startswith(_BOM):
        data = data[len(_BOM) :]
        if encoding == "latin-1" or data.startswith(_BOM):
            return None
    found = _header(data, encoding)
    if found is None or (encoding == "latin-1" and not data[found[1] :].isascii()):
        return None
    return Opened(data, *found)


def _header(data: bytes, encoding: str) -> tuple[Lines, int] | None:
    """The header, with the JSON object before it, and the byte after it."""
    numbers: list[int] = []
    texts: list[str] = []
    begin = 0
    for number in range(1, HEAD_LINES):
        end = data.find(b"\n", begin)
        if end < 0:
            return None
        text = data[begin:end].decode(encoding)
        begin = end + 1
        if text.strip() and not is_comment(text):
            numbers.append(number)
            texts.append(text)
            if len(texts) == 2 or not text.lstrip().startswith("{"):
                return Lines(numbers, texts), begin
    return None


def read_cells(
    found: Opened, width: int, delimiter: str, names: Sequence[int], numbers: Sequence[int]
) -> tuple[range, list[list[str] | np.ndarray]] | None:
    """Cells of some columns.

    Args:
        found: the text.
        width: columns of the header.
        delimiter: what separates cells.
        names: columns of text.
        numbers: columns of numbers, none of them in `names`.

    Returns:
        The number of each line, and by column cells without quotes and blanks around them, or
        float64 (N,), NaN where a cell is empty; others are empty lists. None if a row is odd or
        pyarrow is not there.
    """
    end = len(found.data)
    while end > found.begin and found.data[end - 1] == 10:  # line ends
        end -= 1
    decimal = _decimal_sign(found, end, delimiter)
    if decimal is None or _is_odd(found, end, width == len(names) + len(numbers)):
        return None
    rows = memoryview(found.data)[found.begin : end]
    table = _parsed(rows, width, delimiter, decimal, names, numbers)
    count = found.data.count(b"\n", found.begin, end) + 1
    if table is None or table.num_rows != count:
        return None
    columns: list[list[str] | np.ndarray] = [[] for _ in range(width)]
    for i in names:
        cells = _texts(table[str(i)].chunks)
        if cells is None:
            return None
        columns[i] = cells
    for i in numbers:
        columns[i] = values = table[str(i)].to_numpy()
        if _may_be_grouped(values):
            cells = _parsed(rows, width, delimiter, decimal, [i], [])[str(i)].to_pylist()
            if grouped([*map(str.strip, cells)]) is not None:
                return None
    # An empty line is a row of empty cells here, and would be left out. In a column of names it
    # has been found already.
    if not names and all(table[str(i)].null_count for i in numbers):
        return None
    if found.data.find(b"(", found.begin) >= 0:
        # pyarrow takes nan(...) for a number.
        if any(not np.isfinite(columns[i]).all() for i in numbers):
            return None
    first = found.lines.numbers[-1] + 1
    return range(first, first + count), columns


def read_optional(found: Opened, width: int, delimiter: str, column: int) -> np.ndarray | None:
    """A column that nothing needs, where its cells are numbers throughout; None: they are not."""
    end = len(found.data.rstrip(b"\n"))
    decimal = _decimal_sign(found, end, delimiter)
    rows = memoryview(found.data)[found.begin : end]
    table = None if decimal is None else _parsed(rows, width, delimiter, decimal, [], [column])
    values = None if table is None else table[str(column)].to_numpy()
    return values if values is not None and np.isfinite(values).all() else None


def _may_be_grouped(values: np.ndarray) -> bool:
    """Whether `grouped` may find thousands separators in the cells of a column, by its numbers."""
    size = np.abs(values[np.isfinite(values)])
    whole = size == np.floor(size)
    thousands = 1e3 * size[~whole]
    return bool(
        np.any(size[whole] >= 100)
        and np.all(size < 1000)
        and np.all(thousands >= 1e3)
        and np.all(np.abs(thousands - np.round(thousands)) < 1e-6)
    )


def _is_odd(found: Opened, end: int, all_read: bool) -> bool:
    """Whether there are no rows, perhaps comments, or quotes in columns that nobody reads."""
    data, begin = found.data, found.begin
    return (
        end == begin
        or data.find(b"#", begin) >= 0
        or data.find(_BOM, begin) >= 0
        or (not all_read and data.find(b'"', begin) >= 0)
    )


def _decimal_sign(found: Opened, end: int, delimiter: str) -> str | None:
    """Point or comma; None if pyarrow would take a comma with no digit after it.

    Where rows have points and commas, numbers with commas are refused by pyarrow, and so odd.
    """
    data, begin = found.data, found.begin
    if delimiter == "," or data.find(b",", begin) < 0 or data.find(b".", begin) >= 0:
        return "."
    return None if _NO_DIGIT_AFTER_COMMA.search(data, begin, end) else ","


def _parsed(
    rows: memoryview,
    width: int,
    delimiter: str,
    decimal: str,
    names: Sequence[int],
    numbers: Sequence[int],
) -> Any:
    """The table of pyarrow, columns by their place; None if it refuses a row or a cell."""
    try:
        pa = importlib.import_module("pyarrow")
        csv = importlib.import_module("pyarrow.csv")
    except ImportError:
        return None
    kinds = dict.fromkeys(map(str, names), pa.dictionary(pa.int32(), pa.string()))
    kinds |= dict.fromkeys(map(str, numbers), pa.float64())
    try:
        return csv.read_csv(
            pa.py_buffer(rows),
            read_options=csv.ReadOptions(column_names=[*map(str, range(width))], use_threads=False),
            parse_options=csv.ParseOptions(
                delimiter=delimiter, quote_char=False, ignore_empty_lines=False
            ),
            convert_options=csv.ConvertOptions(
                column_types=kinds,
                include_columns=[*kinds],
                null_values=[""],
                decimal_point=decimal,
            ),  # fmt: skip
        )
    except pa.ArrowException:
        return None


def _texts(chunks: Sequence) -> list[str] | None:
    """Cells of a column of text, of which few differ; None if one is empty or its quotes odd."""
    cells: list[str] = []
    for chunk in chunks:
        distinct = [_unquoted(cell) for cell in chunk.dictionary.to_pylist()]
        if not all(distinct):
            return None
        cells += np.array(distinct, dtype=object)[chunk.indices.to_numpy()].tolist()
    return cells


def _unquoted(cell: str) -> str:
    """A cell without quotes around it; empty if it is odd."""
    if '"' in cell:
        inner = cell[1:-1]
        if '"' in inner or cell != f'"{inner}"':
            return ""
        cell = inner
    return cell.strip()
