"""What a file is, by its first bytes; what is often dropped in by mistake is named, with a cure."""

import zipfile
from pathlib import Path

from jaxtrachea.measurements.curve import DataError
from jaxtrachea.measurements.readers.text_file import GZIP, first_bytes, first_unpacked

HDF5 = b"\x89HDF\r\n\x1a\n"
#: Names of the files of atomic force microscopes that the library afmformats reads.
AFM = (".jpk-force", ".jpk-force-map", ".jpk-qi-data", ".jpk-qi-series", ".ibw")
#: Places where the signature of an HDF5 file may stand: at the start, or after a user block.
HDF5_PLACES = (0, 512, 1024, 2048)
#: Bytes that are looked at.
HEAD = 4096
EXPECTED = "expected a table of displacement and force as text (CSV), workbook (xlsx) or HDF5"

_UNPACK = "unpack it and list the file in it"
#: First bytes, what such a file is, and the cure.
SIGNATURES: tuple[tuple[bytes, str, str], ...] = (
    (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "an old Excel workbook (xls), or one with a password",
     "save the sheet as CSV or xlsx (without a password)"),
    (b"\x93NUMPY", "a NumPy array (npy)",
     "write its columns as CSV (numpy.savetxt with a header and a delimiter)"),
    (b"MATLAB 7.3 MAT-file", "a MATLAB file (mat, version 7.3)", "write CSV with writetable"),
    (b"MATLAB 5.0 MAT-file", "a MATLAB file (mat, version 5)", "write CSV with writetable"),
    (b"PAR1\x15", "a Parquet table", "write it as CSV (to_csv of pandas or polars)"),
    (b"%PDF-", "a PDF document", "use the file with the numbers that it was made from"),
    (b"PK\3\4", "a zip archive", _UNPACK),
    (b"PK\5\6", "a zip archive with nothing in it", _UNPACK),
    (GZIP, "another file packed by gzip", _UNPACK),
)  # fmt: skip


def kind_of(path: Path) -> str:
    """What can be read of a file.

    Returns:
        "hdf5", "xlsx", "afm" or "text" (which may be packed by gzip).

    Raises:
        DataError: it cannot be read, or is something else, which the message names.
    """
    head = first_bytes(path, HEAD)
    if path.suffix.lower() in AFM:
        return "afm"
    if head.startswith(GZIP):
        found = _named(first_unpacked(path, HEAD))
        found = found and (f"packed by gzip and holds {found[0]}", f"unpack it, then {found[1]}")
    elif _is_hdf5(head):
        return "hdf5"
    elif head.startswith(b"PK") and _is_workbook(path):
        return "xlsx"
    else:
        found = _named(head)
    if found is None:
        return "text"
    raise DataError(f"is {found[0]}; {EXPECTED}", place=str(path), cure=found[1])


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


def _is_workbook(path: Path) -> bool:
    """Whether a zip archive holds the parts of a workbook (xlsx)."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except (OSError, ValueError, zipfile.BadZipFile, NotImplementedError):
        return False
    return "xl/workbook.xml" in names


def _named(head: bytes) -> tuple[str, str] | None:
    """What it is and the cure, by the first bytes; None for text."""
    for signature, what, cure in SIGNATURES:
        if head.startswith(signature):
            return what, cure
    if head[:2] in (b"\xff\xfe", b"\xfe\xff") and head[2:4] != b"\0\0":  # UTF-16 with its mark
        return None
    control = sum(head.count(c) for c in range(32) if c not in b"\t\n\r\f\v\x1a")
    if control > 0.05 * max(32, len(head)):
        what = "not text (it holds zero bytes or control characters)"
        return what, "export the numbers as CSV in UTF-8"
    return None
