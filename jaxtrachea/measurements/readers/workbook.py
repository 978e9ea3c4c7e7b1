"""A sheet of an Excel workbook (xlsx) as lines of text, so that all rules of CSV hold for it.

openpyxl (extra `xlsx`) does the reading. A workbook is a zip archive of XML: what it would unpack
to is bounded before anything is, and document types, with which XML defines entities, are refused.
"""

import datetime
import importlib
import itertools
import re
import warnings
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import ParseError

from jaxtrachea.measurements.curve import DataError
from jaxtrachea.measurements.readers.lines import BLOCK, Lines, Text

#: Bounds of a workbook: members of the archive, unpacked bytes of its sheets together, of its
#: table of texts, and of each further part that is read.
MAX_MEMBERS = 10_000
MAX_SHEET_BYTES = 512 * 2**20
MAX_TEXTS_BYTES = 64 * 2**20
MAX_PART_BYTES = 8 * 2**20
#: Rows and columns of a sheet in Excel, and cells that are read (about 50 s).
MAX_ROWS = 2**20
MAX_COLUMNS = 2**14
MAX_CELLS = 5_000_000
#: What openpyxl and the modules below it raise for damaged parts, whichever of them.
_ERRORS = (
    OSError, EOFError, ValueError, TypeError, AttributeError, LookupError, ArithmeticError,
    RuntimeError, NotImplementedError, AssertionError, ParseError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
_FORMULA = re.compile(rb"<(?:\w+:)?f[ />]")
_BLANKS = re.compile(r"[\t\r\n\v\f]+")


def read_sheet(path: Path, sheet: str | None) -> tuple[Text, list[str]]:
    """One sheet of a workbook as lines.

    Numbers keep all their digits; dates are written as ``2026-05-01``; a formula whose value the
    file does not store stands as its text, ``=B2*2``, which is no number. A line is as long as the
    widest row, its cells separated by tabs.

    Args:
        path: the workbook.
        sheet: name of the sheet; None: the first that is not hidden.

    Returns:
        The rows that hold something, and the names of all sheets.

    Raises:
        DataError: openpyxl is missing, there is no such sheet, or the workbook is damaged,
            hostile or too large.
    """
    formulas = _audit(path)
    with _opened(path, values=True) as book:
        names = [page.title for page in book.worksheets]
        page = _sheet(path, book, sheet)
        rows = _rows(path, page)
        if formulas:
            with _opened(path, values=False) as written:
                _put_formulas(rows, _rows(path, written[page.title]))
    width = max((len(row) for row in rows.values()), default=0)
    numbers = sorted(rows)
    lines = Lines(numbers, [_line(rows[number], width) for number in numbers])
    return Text(path, lines.where([*map(str.strip, lines.texts)]), page.title), names


@contextmanager
def _opened(path: Path, *, values: bool) -> Iterator[Any]:
    """The workbook with the values of its formulas, or with their texts."""
    try:
        openpyxl = importlib.import_module("openpyxl")
    except ImportError:
        raise DataError(
            "is an Excel workbook (xlsx), and openpyxl, which reads it, is not installed",
            place=str(path),
            cure="run pip install 'jaxtrachea[xlsx]', or save the sheet as CSV",
        ) from None
    try:
        with path.open("rb") as stream, warnings.catch_warnings():
            # openpyxl warns of what it leaves out: pictures, styles, rules of validation.
            warnings.simplefilter("ignore")
            book = openpyxl.load_workbook(
                stream, read_only=True, data_only=values, keep_links=False
            )
            yield book
    except DataError:
        raise
    except _ERRORS as error:
        reason = " ".join(str(error).split())[:80] or type(error).__name__
        raise DataError(
            f"not a readable workbook, truncated or damaged ({reason!a})",
            place=str(path),
            cure="save it again, or save the sheet as CSV",
        ) from None


def _audit(path: Path) -> bool:
    """Refuse what no workbook of measurements is; whether any sheet holds formulas."""
    formulas = False
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            _check_sizes(path, members)
            for member in members:
                if not member.filename.endswith((".xml", ".rels")):
                    continue
                with archive.open(member) as stream:
                    formulas |= _scan(path, member.filename, stream)
    except DataError:
        raise
    except _ERRORS as error:
        reason = "it has a password" if "password" in str(error) else str(error)[:80]
        raise DataError(
            f"not a readable workbook, truncated or damaged ({reason!a})",
            place=str(path),
            cure="save it again without a password, or save the sheet as CSV",
        ) from None
    return formulas


def _check_sizes(path: Path, members: Sequence[zipfile.ZipInfo]) -> None:
    """`zipfile` reads no more of a member than it declares, so the declared sizes are bounds."""
    if len(members) > MAX_MEMBERS:
        raise DataError(
            f"more than {MAX_MEMBERS} parts",
            place=str(path),
            cure="save the sheet as CSV",
        )
    sheets = 0
    for member in members:
        limit = MAX_PART_BYTES
        if member.filename.startswith("xl/worksheets/"):
            sheets += member.file_size
            limit = MAX_SHEET_BYTES
        elif member.filename == "xl/sharedStrings.xml":
            limit = MAX_TEXTS_BYTES
        elif not member.filename.endswith((".xml", ".rels")):
            continue  # pictures and macros, which nobody opens
        if member.file_size > limit or sheets > MAX_SHEET_BYTES:
            raise DataError(
                f"{member.filename!a} unpacks to {member.file_size} bytes, at most {limit} "
                "are read",
                place=str(path),
                cure="save the sheet alone as CSV",
            )


def _scan(path: Path, name: str, stream: Any) -> bool:
    """Whether a part holds formulas; it must be XML in UTF-8 without document types."""
    formulas, tail = False, b""
    while block := stream.read(BLOCK):
        data = tail + block
        if b"<!DOCTYPE" in data or b"<!ENTITY" in data or b"\0" in data:
            raise DataError(
                f"{name!a} defines entities or is not UTF-8, as no spreadsheet program writes it",
                place=str(path),
                cure="save the sheet as CSV",
            )
        formulas = formulas or ("worksheets/" in name and bool(_FORMULA.search(data)))
        tail = data[-16:]
    return formulas


def _sheet(path: Path, book: Any, name: str | None) -> Any:
    """The sheet of that name, or the first that is not hidden."""
    pages = book.worksheets
    if not pages:
        raise DataError(
            "has no sheet with cells",
            place=str(path),
            cure="save the table as CSV",
        )
    if name is None:
        return next((page for page in pages if page.sheet_state == "visible"), pages[0])
    found = [page for page in pages if page.title == name]
    if not found:
        raise DataError(
            f"has no sheet {name!r}; its sheets are {listed([p.title for p in pages])}",
            place=str(path),
            cure="correct data.sheet",
        )
    return found[0]


def listed(names: Sequence[str]) -> str:
    """Names in quotes, ten at most."""
    more = f" and {len(names) - 10} more" if len(names) > 10 else ""
    return ", ".join(map(repr, names[:10])) + more


def _rows(path: Path, page: Any) -> dict[int, tuple]:
    """Cells of the rows that hold any, by number of the row."""
    page.reset_dimensions()  # what the file says of its size is often wrong
    rows: dict[int, tuple] = {}
    cells = 0
    for number, row in enumerate(page.iter_rows(values_only=True), 1):
        if number > MAX_ROWS or len(row) > MAX_COLUMNS:
            raise DataError(
                f"sheet {page.title!r} has cells beyond row {MAX_ROWS} or column {MAX_COLUMNS}",
                place=str(path),
                cure="save it as CSV",
            )
        if any(cell is not None for cell in row):
            rows[number] = row
            cells += len(row)
        if cells > MAX_CELLS:
            raise DataError(
                f"sheet {page.title!r} has more than {MAX_CELLS} cells (row {number})",
                place=str(path),
                cure="save it as CSV",
            )
    return rows


def _put_formulas(rows: dict[int, tuple], written: dict[int, tuple]) -> None:
    """Put the text of a formula where its value is missing."""
    for number, formulas in written.items():
        values = rows.get(number, ())
        rows[number] = tuple(
            _formula(formula) if value is None and formula is not None else value
            for value, formula in itertools.zip_longest(values, formulas)
        )


def _formula(cell: Any) -> str:
    text = str(getattr(cell, "text", cell))
    return text if text.startswith("=") else f"={text}"


def _line(row: tuple, width: int) -> str:
    """Cells separated by tabs; a cell that stands alone is written as it is, as JSON may be."""
    texts = [_cell(value) for value in row]
    if sum(map(bool, texts)) > 1:
        texts = ['"' + text.replace('"', '""') + '"' if '"' in text else text for text in texts]
    return "\t".join(texts + [""] * (width - len(texts)))


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, datetime.date | datetime.time):
        text = value.isoformat()
        return text.removesuffix("T00:00:00")
    if isinstance(value, float):
        return repr(value)
    return _BLANKS.sub(" ", str(value)).strip()
