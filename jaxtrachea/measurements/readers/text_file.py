"""Text of a file, packed or not: bounded reading, encoding, line ends."""

import gzip
import zlib
from pathlib import Path

from jaxtrachea.measurements.curve import DataError

MAX_TEXT_BYTES = 256 * 2**20
GZIP = b"\x1f\x8b"
_MARKS = (b"\xff\xfe", b"\xfe\xff")


def first_bytes(path: Path, count: int) -> bytes:
    """The beginning of a file.

    Raises:
        DataError: it cannot be read.
    """
    try:
        with path.open("rb") as stream:
            return stream.read(count)
    except OSError as error:
        raise DataError(
            f"cannot be read ({error.strerror})", place=str(path), cure="check the permissions"
        ) from None


def first_unpacked(path: Path, count: int) -> bytes:
    """The beginning of what a gzip file holds.

    Raises:
        DataError: it cannot be read, or is damaged.
    """
    try:
        with gzip.open(path) as stream:
            return stream.read(count)
    except (OSError, EOFError, zlib.error) as error:
        # BadGzipFile is an OSError, but its reason is in its text.
        raise DataError(
            f"a gzip file, cut off or damaged ({str(error)[:80]})",
            place=str(path),
            cure="copy or pack it again",
        ) from None


def read_bytes(path: Path) -> bytes:
    """Bytes of a text file; one packed by gzip is unpacked in memory, within the same bound.

    Raises:
        DataError: the file is too large, packed or unpacked, or unreadable or damaged.
    """
    packed = first_bytes(path, 2) == GZIP
    data = (first_unpacked if packed else first_bytes)(path, MAX_TEXT_BYTES + 1)
    if len(data) <= MAX_TEXT_BYTES:
        return data
    more = "unpacks to more" if packed else "more"
    raise DataError(
        f"{more} than {MAX_TEXT_BYTES} bytes of text, at most so many are read",
        place=str(path),
        cure="unpack it and split it, or use HDF5" if packed else "split it or use HDF5",
    )


def to_utf8(path: Path, data: bytes) -> bytes:
    """A text in UTF-8 with Unix line ends and without a byte-order mark.

    UTF-8 (with or without mark) and UTF-16 with one are decoded; other bytes are taken for Latin-1,
    in which many instruments write µ and °. Line ends may be those of Unix, DOS or old Macs.

    Raises:
        DataError: it holds zero bytes.
    """
    if data.startswith(_MARKS):
        data = data.decode("utf-16", errors="replace").encode("utf-8", errors="replace")
    elif not data.isascii():
        try:
            data.decode("utf-8")
        except UnicodeDecodeError:
            data = data.decode("latin-1").encode("utf-8")
    while data.startswith(b"\xef\xbb\xbf"):
        data = data[3:]
    if b"\0" in data:
        raise DataError(
            "holds zero bytes, so it is no text table",
            place=str(path),
            cure="export it as CSV in UTF-8, or as HDF5",
        )
    return data.replace(b"\r\n", b"\n").replace(b"\r", b"\n") if b"\r" in data else data
