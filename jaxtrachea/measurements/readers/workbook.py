"""Sheets of an Excel workbook (xlsx) as text with tabs, so that all rules of CSV hold for them.

pandas and openpyxl (extra `xlsx`) do the reading.
"""

import datetime
import fnmatch
import importlib
import itertools
import re
import warnings
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import ParseError

from jaxtrachea.measurements.curve import DataError
from jaxtrachea.measurements.readers.table import Text

#: What openpyxl and the modules below it raise for damaged parts, whichever of them.
_ERRORS = (
    OSError, EOFError, ValueError, TypeError, AttributeError, LookupError, ArithmeticError,
    RuntimeError, NotImplementedError, AssertionError, ParseError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
_FORMULA = re.compile(rb"<(?:\w+:)?f[ />]")
_BLANKS = re.compile(r"[\t\r\n\v\f]+")


def read_sheets(path: Path, sheet: str | Sequence[str] | None) -> tuple[list[Text], list[str]]:
    """Sheets of a workbook as text.

    Numbers keep all their digits; dates are written as ``2026-05-01``; a formula whose value the
    file does not store stands as its text, ``=B2*2``, which is no number.

    Args:
        sheet: name or pattern of the sheets, or several; None: the first that is not hidden.

    Returns:
        The sheets that are meant, and the names of all.

    Raises:
        DataError: openpyxl is missing, there is no such sheet, or the workbook is damaged.
    """
    try:
        importlib.import_module("openpyxl")
    except ImportError:
        raise DataError(
            "is an Excel workbook (xlsx), and openpyxl, which reads it, is not installed",
            place=str(path),
            cure="run pip install 'jaxtrachea[xlsx]', or save the sheet as CSV",
        ) from None
    pandas = importlib.import_module("pandas")
    try:
        with warnings.catch_warnings():
            # openpyxl warns of what it leaves out: pictures, styles, rules of validation.
            warnings.simplefilter("ignore")
            with pandas.ExcelFile(path, engine="openpyxl") as book:
                pages = {page.title: page.sheet_state for page in book.book.worksheets}
                chosen = _chosen(path, pages, sheet)
                values = {name: _cells(book, name) for name in chosen}
            if _has_formulas(path):
                formulas = {"data_only": False}
                with pandas.ExcelFile(path, engine="openpyxl", engine_kwargs=formulas) as book:
                    for name, rows in values.items():
                        values[name] = _with_formulas(rows, _cells(book, name))
    except DataError:
        raise
    except _ERRORS as error:
        reason = "it has a password" if "password" in str(error) else str(error)
        reason = " ".join(reason.split())[:80] or type(error).__name__
        raise DataError(
            f"not a readable workbook, truncated or damaged ({reason!a})",
            place=str(path),
            cure="save it again without a password, or save the sheet as CSV",
        ) from None
    several = len(chosen) > 1
    texts = [
        Text(path, _text(rows), name, name if several else "1") for name, rows in values.items()
    ]
    return texts, [*pages]


def _cells(book: Any, name: str) -> list[tuple]:
    """Rows of a sheet; an empty cell is an empty text."""
    frame = book.parse(name, header=None, dtype=object, na_filter=False, keep_default_na=False)
    return [*frame.itertuples(index=False, name=None)]


def _chosen(path: Path, pages: dict[str, str], sheet: str | Sequence[str] | None) -> list[str]:
    """Names of the sheets that are meant, in the order of the workbook."""
    if not pages:
        raise DataError(
            "has no sheet with cells",
            place=str(path),
            cure="save the table as CSV",
        )
    if sheet is None:
        return [next((name for name, state in pages.items() if state == "visible"), [*pages][0])]
    chosen: set[str] = set()
    for wanted in [sheet] if isinstance(sheet, str) else sheet:
        found = [n for n in pages if n == wanted] or fnmatch.filter(pages, wanted)
        if not found:
            raise DataError(
                f"has no sheet {wanted!r}; its sheets are {listed([*pages])}",
                place=str(path),
                cure="correct data.sheet",
            )
        chosen.update(found)
    return [name for name in pages if name in chosen]


def listed(names: Sequence[str]) -> str:
    """Names in quotes, ten at most."""
    more = f" and {len(names) - 10} more" if len(names) > 10 else ""
    return ", ".join(map(repr, names[:10])) + more


def _has_formulas(path: Path) -> bool:
    with zipfile.ZipFile(path) as archive:
        sheets = [n for n in archive.namelist() if n.startswith("xl/worksheets/")]
        return any(_FORMULA.search(archive.read(name)) for name in sheets)


def _with_formulas(values: list[tuple], written: list[tuple]) -> list[tuple]:
    """The text of a formula where its value is missing."""
    return [
        tuple(
            _formula(formula) if value in ("", None) and formula else value
            for value, formula in itertools.zip_longest(*rows)
        )
        for rows in itertools.zip_longest(values, written, fillvalue=())
    ]


def _formula(cell: Any) -> str:
    text = str(getattr(cell, "text", cell))
    return text if text.startswith("=") else f"={text}"


def _text(rows: list[tuple]) -> bytes:
    """Rows as lines; a cell that stands alone is written as it is, as JSON may be."""
    lines = []
    for row in rows:
        texts = [_cell(value) for value in row]
        if sum(map(bool, texts)) > 1:
            texts = ['"' + t.replace('"', '""') + '"' if '"' in t else t for t in texts]
        lines.append("\t".join(texts))
    return "\n".join(lines).encode(errors="replace")


def _cell(value: Any) -> str:
    if value is None or value != value:
        return ""
    if isinstance(value, datetime.date | datetime.time):
        text = value.isoformat()
        return text.removesuffix("T00:00:00")
    if isinstance(value, float):
        return repr(value)
    return _BLANKS.sub(" ", str(value)).strip()
