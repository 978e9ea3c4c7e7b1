"""What a file is, by its first bytes; what is no table of numbers is named, with the cure."""

import json
import zipfile
from collections.abc import Callable
from pathlib import Path

from jaxtrachea.measurements.curve import DataError
from jaxtrachea.measurements.readers.lines import GZIP, first_bytes, first_unpacked

HDF5 = b"\x89HDF\r\n\x1a\n"
#: Places where the signature of an HDF5 file may stand: at the start, or after a user block.
HDF5_PLACES = (0, 512, 1024, 2048)
#: Bytes that are looked at.
HEAD = 4096
#: Largest file that is parsed to see whether all of it is JSON.
MAX_JSON_BYTES = 16 * 2**20
EXPECTED = "expected a table of displacement and force as text (CSV), workbook (xlsx) or HDF5"

_UNPACK = "unpack it and list the file in it"
_AS_CSV = "save the sheet as CSV or xlsx"
_NUMBERS = "export the numbers as CSV"
_NUMPY = "write its columns as CSV (numpy.savetxt with a header and a delimiter)"
_SOURCE = "use the file with the numbers that it was made from"
_UTF8 = "save it as UTF-8"
#: First bytes, what such a file is, and the cure.
SIGNATURES: tuple[tuple[bytes, str, str], ...] = (
    (b"\xfd7zXZ\0", "an xz archive", _UNPACK + ", or pack it by gzip"),
    (b"\x28\xb5\x2f\xfd", "a Zstandard archive", _UNPACK + ", or pack it by gzip"),
    (b"\x04\x22\x4d\x18", "an lz4 archive", _UNPACK + ", or pack it by gzip"),
    (b"7z\xbc\xaf\x27\x1c", "a 7-zip archive", _UNPACK),
    (b"Rar!\x1a\x07", "a RAR archive", _UNPACK),
    (b"\x93NUMPY", "a NumPy array (npy)", _NUMPY),
    (b"MATLAB 7.3 MAT-file", "a MATLAB file (mat, version 7.3)", "write CSV with writetable"),
    (b"MATLAB 5.0 MAT-file", "a MATLAB file (mat, version 5)", "write CSV with writetable"),
    (b"PAR1\x15", "a Parquet table", "write it as CSV (to_csv of pandas or polars)"),
    (b"ARROW1\0\0", "an Arrow table (Feather)", "write it as CSV (to_csv of pandas)"),
    (b"%PDF-", "a PDF document", _SOURCE),
    (b"{\\rtf", "a text document (RTF)", "save it as plain text"),
    (b"\x89PNG\r\n\x1a\n", "a picture (PNG)", _SOURCE),
    (b"\xff\xd8\xff", "a picture (JPEG)", _SOURCE),
    (b"GIF87a", "a picture (GIF)", _SOURCE),
    (b"GIF89a", "a picture (GIF)", _SOURCE),
    (b"II*\0", "a picture (TIFF)", _SOURCE),
    (b"MM\0*", "a picture (TIFF)", _SOURCE),
    (b"SQLite format 3\0", "an SQLite database", _NUMBERS),
    (b"CDF\x01", "a NetCDF 3 file", _NUMBERS),
    (b"CDF\x02", "a NetCDF 3 file", _NUMBERS),
    (b"TDSm", "a LabVIEW file (TDMS)", _NUMBERS),
    (b"RDX2\n", "an R workspace", "write CSV with write.csv"),
    (b"RDX3\n", "an R workspace", "write CSV with write.csv"),
    (b"\x7fELF", "a program", _SOURCE),
    (b"MZ\x90\0", "a program", _SOURCE),
    (b"\xff\xfe\0\0", "text in UTF-32 (holds zero bytes)", _UTF8),
    (b"\0\0\xfe\xff", "text in UTF-32 (holds zero bytes)", _UTF8),
)
#: A member of a zip archive that tells what it is, and what it then is.
ZIPPED: tuple[tuple[str, str, str], ...] = (
    ("xl/workbook.bin", "a binary Excel workbook (xlsb)", _AS_CSV),
    ("word/document.xml", "a Word document (docx)", "save its table as CSV or xlsx"),
    ("ppt/presentation.xml", "a PowerPoint file (pptx)", _SOURCE),
    ("Index/Document.iwa", "a Numbers or Pages document", _AS_CSV),
    ("content.xml", "an OpenDocument file (ods, odt)", _AS_CSV),
)


def kind_of(path: Path) -> str:
    """What can be read of a file.

    Args:
        path: an existing file.

    Returns:
        "hdf5", "xlsx" or "text" (which may be packed by gzip).

    Raises:
        DataError: it cannot be read, or is something else, which the message names.
    """
    head = first_bytes(path, HEAD)
    if head.startswith(GZIP):
        found = _named(first_unpacked(path, HEAD))
        found = found and (f"packed by gzip and holds {found[0]}", f"unpack it, then {found[1]}")
    elif _is_hdf5(head):
        return "hdf5"
    elif zipfile.is_zipfile(path) and head[:2] == b"PK":
        found = _zipped(path)
        if found is None:
            return "xlsx"
    else:
        found = _named(head) or _json(path, head)
    if found is None:
        return "text"
    raise DataError(
        f"is {found[0]}; {EXPECTED}",
        place=str(path),
        cure=f"{found[1]}",
    )


def is_workbook(path: Path) -> bool:
    """Whether a file is an Excel workbook (xlsx); False for what cannot be read."""
    try:
        return kind_of(path) == "xlsx"
    except DataError:
        return False


def _is_hdf5(head: bytes) -> bool:
    """MATLAB 7.3 is HDF5, too, after a text of its own."""
    signed = any(head[at : at + len(HDF5)] == HDF5 for at in HDF5_PLACES)
    return signed and not head.startswith(b"MATLAB")


def _named(head: bytes) -> tuple[str, str] | None:
    """What it is and the cure, by the first bytes; None for text."""
    for signature, what, cure in SIGNATURES:
        if head.startswith(signature):
            return what, cure
    tests: tuple[Callable[[bytes], tuple[str, str] | None], ...] = (
        _ole, _archive, _pickle, _markup, _utf16, _binary,
    )  # fmt: skip
    return next((found for test in tests if (found := test(head))), None)


def _ole(head: bytes) -> tuple[str, str] | None:
    if head.startswith(b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1"):
        cure = f"{_AS_CSV} (without a password)"
        return "an old Excel workbook (xls), or one with a password", cure
    return None


def _archive(head: bytes) -> tuple[str, str] | None:
    if head[:3] == b"BZh" and head[4:10] == b"1AY&SY":
        return "a bzip2 archive", _UNPACK + ", or pack it by gzip"
    if head.startswith(GZIP):
        return "another file packed by gzip", _UNPACK
    if _is_hdf5(head):
        return "an HDF5 file", "list it"
    if head[257:262] == b"ustar":
        return "a tar archive", _UNPACK
    return ("a zip archive or a damaged one", "copy it again") if head[:4] == b"PK\3\4" else None


def _pickle(head: bytes) -> tuple[str, str] | None:
    """Protocols 2 to 5; from 4 on a frame follows."""
    if head[:1] == b"\x80" and head[1:2] in (b"\2", b"\3", b"\4", b"\5"):
        cure = "write its numbers as CSV"
        return "a Python pickle, which can hold programs and is never opened", cure
    return None


def _markup(head: bytes) -> tuple[str, str] | None:
    start = head.lstrip(b"\xef\xbb\xbf \t\r\n")[:64].lower()
    if start.startswith((b"<!doctype html", b"<html", b"<head", b"<body")):
        return "a web page (HTML)", "download the file itself, or save its table as CSV"
    if start.startswith((b"<?xml", b"<svg", b"<workbook")):
        return "an XML file", "save it as CSV or xlsx"
    return None


def _utf16(head: bytes) -> tuple[str, str] | None:
    """UTF-16 without a mark: every other byte of plain text is zero."""
    if len(head) < 8 or head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return None
    even, odd = head[0::2], head[1::2]
    for zeros, rest in ((even, odd), (odd, even)):
        if zeros.count(0) > 0.9 * len(zeros) and rest.count(0) < 0.1 * len(rest):
            what = "text in UTF-16 without a byte-order mark (holds zero bytes)"
            return what, _UTF8 + ", or with its mark"
    return None


def _binary(head: bytes) -> tuple[str, str] | None:
    """Control characters, as no text has so many; zero bytes alone are told later."""
    if head[:2] in (b"\xff\xfe", b"\xfe\xff") or len(head) < 32:
        return None
    control = sum(head.count(c) for c in range(32) if c not in b"\t\n\r\f\v\x1a\0")
    if control > 0.05 * len(head) or (control and head.count(0) > 0.1 * len(head)):
        return "binary of no known format (holds control characters or zero bytes)", _NUMBERS
    return None


def _zipped(path: Path) -> tuple[str, str] | None:
    """What a zip archive is; None for a workbook (xlsx)."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = set(archive.namelist())
    except (OSError, ValueError, zipfile.BadZipFile, NotImplementedError):
        return "a zip archive, cut off or damaged", "copy it again"
    for member, what, cure in ZIPPED:
        if member in names:
            return what, cure
    if any(name.startswith("xl/") for name in names):
        return None
    if names and all(name.endswith(".npy") for name in names):
        return "NumPy arrays (npz)", _NUMPY
    return "a zip archive", _UNPACK


def _json(path: Path, head: bytes) -> tuple[str, str] | None:
    """A file that is JSON as a whole, or line by line; one line before a table is none of both."""
    start = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    if start[:1] not in (b"{", b"["):
        return None
    lines = [line.strip() for line in start.splitlines() if line.strip()]
    cure = "write its numbers as CSV with a header"
    if len(lines) > 1 and all(line.startswith(b"{") for line in lines[:-1]):
        if lines[1].startswith(b"{"):
            return "a list of JSON objects", cure
    data = first_bytes(path, MAX_JSON_BYTES + 1)
    if len(data) > MAX_JSON_BYTES:
        return None
    try:
        content = json.loads(data.decode("utf-8-sig"))
    except (ValueError, RecursionError):
        return None
    # One object on one line may still be what holds for a table whose rows are missing.
    one_line = isinstance(content, dict) and len(lines) == 1
    return None if one_line and len(data) < 200 else ("JSON", cure)
