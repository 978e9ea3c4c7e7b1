"""Files of other kinds in the place of a table: each is named as what it is."""

import bz2
import gzip
import io
import json
import lzma
import pickle
import tarfile
import zipfile

import numpy as np

from damaged.case import GOOD, OTHER, SPEC, Case

SHEET = "xl/worksheets/sheet1.xml"
PNG = b"\x89PNG\r\n\x1a\n" + bytes(range(256))
NUMBERS = np.arange(40.0).reshape(10, 4)


def alone(content, *says, spec=SPEC):
    return Case(("data.csv", *says), {"data.csv": content, "spec.toml": spec})


def beside(content, *says):
    """One of two files is foreign: the other stands."""
    files = {"data.csv": content, "good.csv": OTHER}
    files["spec.toml"] = '[data]\nfiles = ["data.csv", "good.csv"]\n'
    return Case(("data.csv", *says), files, command=("check", "spec.toml"), codes=(1,))


def zipped(**members):
    """A zip archive; `__` in a name stands for a slash, `_dot_` for a point."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name.replace("__", "/").replace("_dot_", "."), content)
    return out.getvalue()


def part(name, content):
    """A workbook of this part alone."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("xl/workbook.xml", "<workbook/>")
        archive.writestr(name, content)
    return out.getvalue()


def saved(save, *content, **named):
    out = io.BytesIO()
    save(out, *content, **named)
    return out.getvalue()


def tar():
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w") as archive:
        member = tarfile.TarInfo("data.csv")
        member.size = len(GOOD)
        archive.addfile(member, io.BytesIO(GOOD.encode()))
    return out.getvalue()


def packed(data):
    return gzip.compress(data, mtime=0)


KINDS = {
    "workbook with nothing in it": alone(zipped(xl__workbook_dot_xml=GOOD), "workbook"),
    "workbook cut off": alone(part(SHEET, "<x/>" * 99)[:150], "zip archive"),
    "old workbook": alone(b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(999), "xls", "password"),
    "Word document": beside(zipped(word__document_dot_xml="x"), "zip archive"),
    "zip of CSV": alone(zipped(a_dot_csv=GOOD), "zip archive", "unpack"),
    "zip of nothing": alone(zipped(), "zip archive"),
    "bzip2": beside(bz2.compress(GOOD.encode()), "not text"),
    "tar": alone(tar(), "not text"),
    "gzip cut off": alone(packed(GOOD.encode())[:-9], "gzip", "cut off"),
    "gzip with a wrong sum": alone(packed(GOOD.encode())[:-8] + bytes(8), "gzip", "damaged"),
    "gzip of a picture": alone(packed(PNG), "packed by gzip", "not text"),
    "gzip of gzip": alone(packed(packed(GOOD.encode())), "packed by gzip", "unpack"),
    "gzip of tar": alone(packed(tar()), "packed by gzip", "not text"),
    "gzip of 300 MB of blanks": alone(packed(b" " * 2**20) * 300, "unpacks to more than"),
    "gzip of a broken table": alone(packed(GOOD.replace("0.66", "x").encode()), "line 4", "'x'"),
    "npy": beside(saved(np.save, NUMBERS), "npy", "savetxt"),
    "npz": alone(saved(np.savez, a=NUMBERS), "zip archive"),
    "MATLAB 5": alone(b"MATLAB 5.0 MAT-file, Platform: GLNXA64".ljust(128) + PNG, "version 5"),
    "MATLAB 7.3": alone(
        b"MATLAB 7.3 MAT-file, Platform: PCWIN64".ljust(512) + b"\x89HDF\r\n\x1a\n" + bytes(99),
        "version 7.3", "writetable",
    ),
    "Parquet": alone(b"PAR1\x15\x04" + PNG + b"PAR1", "Parquet", "to_csv"),
    "pickle": alone(pickle.dumps(NUMBERS), "not text", "CSV"),
    "PDF": alone(b"%PDF-1.7\n%\xe2\xe3\xcf\xd3\n" + PNG, "PDF"),
    "PNG": beside(PNG, "not text", "numbers"),
    "xz": alone(lzma.compress(GOOD.encode() * 9), "not text"),
    "SQLite": alone(b"SQLite format 3\0" + PNG, "not text"),
    "web page": alone("<!DOCTYPE html>\n<html>sign in</html>\n", "displacement"),
    "XML": alone("<?xml version='1.0'?>\n<a/>\n", "displacement"),
    "JSON": alone(json.dumps({"force": list(range(99))}), "header"),
    "JSON indented": alone(json.dumps({"force": [1, 2]}, indent=1), "line 1", "JSON"),
    "UTF-16 named": alone(GOOD.encode("utf-16-le"), "not text", "UTF-8"),
    "UTF-16 big-endian": alone(GOOD.encode("utf-16-be"), "not text", "UTF-8"),
    "UTF-32 with mark": alone(GOOD.encode("utf-32"), "not text", "UTF-8"),
    "bytes of no format": alone(bytes(range(256)) * 9, "not text"),
    "afmformats asked of a workbook": alone(
        part(SHEET, "<x/>"), "workbook", "data.format", spec=SPEC + 'format = "afmformats"'
    ),
}  # fmt: skip
CASES = KINDS
