"""Lines of a text file, packed or not: bounded reading, encoding, line ends."""

import gzip
import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import compress, repeat
from operator import contains
from pathlib import Path
from typing import NamedTuple, overload

from jaxtrachea.measurements.curve import DataError

MAX_TEXT_BYTES = 256 * 2**20
BLOCK = 2**20
GZIP = b"\x1f\x8b"
#: What spreadsheets write in place of a number; a line that starts so is no comment.
CELL_ERRORS = ("#N/A", "#NV", "#REF!", "#VALUE!", "#DIV/0!", "#NUM!", "#NAME?", "#NULL!")
_SEPARATOR = re.compile(r'\s*"?sep=.?"?\s*', re.IGNORECASE)


class Line(NamedTuple):
    """One line of a text file or row of a sheet, and its number, counted from 1."""

    number: int
    text: str


@dataclass(frozen=True)
class Lines(Sequence[Line]):
    """Lines, of which a file may have a million: two lists, each line made when it is asked for.

    Attributes:
        numbers: counted from 1, rising.
        texts: of each line.
    """

    numbers: Sequence[int]
    texts: Sequence[str]

    def __len__(self) -> int:
        """How many lines there are."""
        return len(self.texts)

    @overload
    def __getitem__(self, at: int) -> Line: ...
    @overload
    def __getitem__(self, at: slice) -> "Lines": ...
    def __getitem__(self, at: int | slice) -> "Line | Lines":
        """One line, or some of them."""
        if isinstance(at, slice):
            return Lines(self.numbers[at], self.texts[at])
        return Line(self.numbers[at], self.texts[at])

    def where(self, kept: Sequence[object]) -> "Lines":
        """Those whose `kept` is true."""
        if all(kept):
            return self
        return Lines([*compress(self.numbers, kept)], [*compress(self.texts, kept)])

    def without_comments(self) -> "Lines":
        """Those that are no comments."""
        begins = not self.texts or not is_comment(self.texts[0])
        if begins and not any(map(contains, self.texts, repeat("#"))):
            return self
        return self.where([not is_comment(text) for text in self.texts])


@dataclass(frozen=True)
class Text:
    """The lines of a text file, or the rows of a sheet as lines separated by tabs.

    Attributes:
        path: the file.
        lines: those that hold something.
        sheet: name of the sheet, None for a text file.
    """

    path: Path
    lines: Lines
    sheet: str | None = None

    @property
    def place(self) -> str:
        """The file, and the sheet if it has any, for messages."""
        return str(self.path) if self.sheet is None else f"{self.path} sheet {self.sheet!r}"

    @property
    def word(self) -> str:
        """What its lines are called."""
        return "line" if self.sheet is None else "row"


def first_bytes(path: Path, count: int) -> bytes:
    """The beginning of a file.

    Raises:
        DataError: it cannot be read.
    """
    try:
        with path.open("rb") as stream:
            return stream.read(count)
    except OSError as error:
        raise _unreadable(path, error) from None


def first_unpacked(path: Path, count: int) -> bytes:
    """The beginning of what a gzip file holds.

    Raises:
        DataError: it cannot be read, or is damaged.
    """
    try:
        with gzip.open(path) as stream:
            return stream.read(count)
    except (OSError, EOFError, zlib.error) as error:
        raise _damaged_gzip(path, error) from None


def read_lines(path: Path) -> Lines:
    """All lines of a text file that hold something; see `read_bytes` and `split_lines`.

    Raises:
        DataError: as these.
    """
    return split_lines(path, read_bytes(path))


def read_bytes(path: Path) -> bytes:
    """What a text file holds; one packed by gzip is unpacked in memory.

    Raises:
        DataError: the file is too large, packed or unpacked, or unreadable or damaged.
    """
    return _unpacked(path) if first_bytes(path, 2) == GZIP else _bytes(path)


def split_lines(path: Path, data: bytes) -> Lines:
    """All lines of a text that hold something, with their numbers.

    UTF-8 (with or without byte-order mark) and UTF-16 with one are decoded; other bytes are taken
    for Latin-1, in which many instruments write µ and °. Unix, DOS and old Mac line ends.

    Args:
        path: the file, for messages.
        data: the text.

    Raises:
        DataError: it holds zero bytes.
    """
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        text = data.decode("utf-16", errors="replace")
    else:
        try:
            text = data.decode("utf-8")
        except UnicodeDecodeError:
            text = data.decode("latin-1")
    text = text.lstrip("\ufeff")
    if "\0" in text:
        raise DataError(
            "holds zero bytes, so it is no text table",
            place=str(path),
            cure="export it as CSV or HDF5",
        )
    texts = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    return Lines(range(1, len(texts) + 1), texts).where([*map(str.strip, texts)])


def is_comment(text: str) -> bool:
    """Whether a line is a ``#`` comment, or only ``sep=;``, which a spreadsheet puts above a table.

    ``#N/A`` and the like are its cells.
    """
    text = text.lstrip()
    if text.startswith("#"):
        return not text.upper().startswith(CELL_ERRORS)
    return _SEPARATOR.fullmatch(text) is not None


def _bytes(path: Path) -> bytes:
    try:
        with path.open("rb") as stream:
            data = stream.read(MAX_TEXT_BYTES + 1)
    except OSError as error:
        raise _unreadable(path, error) from None
    if len(data) > MAX_TEXT_BYTES:
        raise DataError(
            f"more than {MAX_TEXT_BYTES} bytes of text, at most so many are read",
            place=str(path),
            cure="split it or use HDF5",
        )
    return data


def _unpacked(path: Path) -> bytes:
    """Content of a gzip file. It is unpacked twice: a bomb is refused before any of it is kept."""
    try:
        size = 0
        with gzip.open(path) as stream:
            while block := stream.read(BLOCK):
                size += len(block)
                if size > MAX_TEXT_BYTES:
                    raise DataError(
                        f"unpacks to more than {MAX_TEXT_BYTES} bytes of text, at most so "
                        "many are read",
                        place=str(path),
                        cure="unpack it and split it, or use HDF5",
                    )
        with gzip.open(path) as stream:
            return stream.read(size)
    except (OSError, EOFError, zlib.error) as error:
        raise _damaged_gzip(path, error) from None


def _unreadable(path: Path, error: OSError) -> DataError:
    return DataError(
        f"cannot be read ({error.strerror})",
        place=str(path),
        cure="check the permissions",
    )


def _damaged_gzip(path: Path, error: Exception) -> DataError:
    # BadGzipFile is an OSError, but its reason is in its text.
    return DataError(
        f"a gzip file, cut off or damaged ({str(error)[:80]})",
        place=str(path),
        cure="copy or pack it again",
    )
