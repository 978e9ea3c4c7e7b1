"""Damaged CSV tables: cut off, flipped bits, dialects, encodings, values, units."""

import dataclasses

from damaged.case import GOOD, HEAD, OTHER, ROWS, SPEC, Case, flipped

LONG = GOOD.replace("T01,1,35", '"T01",1,35')


def alone(content, *says, spec=SPEC):
    """The only data file is spoilt: nothing is left to fit."""
    return Case(("data.csv", *says), {"data.csv": content, "spec.toml": spec})


def beside(content, *says, spec=""):
    """One of two files is spoilt: the other stands."""
    files = {"data.csv": content, "good.csv": OTHER}
    files["spec.toml"] = '[data]\nfiles = ["data.csv", "good.csv"]\n' + spec
    return Case(("data.csv", *says), files, command=("check", "spec.toml"), codes=(1,))


def changed(old, new, *says):
    assert old in GOOD
    return beside(GOOD.replace(old, new, 1), *says)


def with_column(name, *values):
    """The good table with one more column."""
    lines = GOOD.splitlines()
    return "\n".join(f"{line},{v}" for line, v in zip(lines, (name, *values), strict=True)) + "\n"


CUT = {f"cut after {n} bytes": alone(LONG[:n]) for n in (0, 1, 9, 30, 48, 50, 51, 55, 60, 70)}
FLIPPED = {
    f"bits flipped, seed {seed}": Case(
        ("data.csv",), beside(flipped(GOOD.encode(), seed, 1 + seed % 4)).files,
        command=("check", "spec.toml"), codes=(0, 1),
    )
    for seed in range(30)
}  # fmt: skip
DIALECT = {
    "a cell lost": changed("T01,1,35,1,0.66", "T01,1,35,1", "line 4 has 4 cells"),
    "a cell too many": changed("1,0.66", "1,0.66,7", "line 4 has 6 cells"),
    "quote never closed": changed("T01,1,35,1,", '"T01,1,35,1,', "line 4", "quote"),
    "text after a quote": changed("T01,1,35,1,", '"T01"x,1,35,1,', "line 4", "quote"),
    "decimal commas": changed("0.5,0.31", "0,5,0,31", "line 3", "decimal commas"),
    "header lost": alone(GOOD.removeprefix(HEAD), "displacement", "force"),
    "header twice": beside(HEAD + GOOD, "line 2"),
    "header in the middle": changed("T01,1,35,1,0.66\n", HEAD, "line 2", "line 5"),
    "header of numbers": alone("1,2,3\n4,5,6\n", "force"),
    "two decimal signs": beside(
        GOOD.replace(",", ";").replace("0.5", "0,5"), "line 3", "decimal sign"
    ),
    "thousands": beside(GOOD.replace(",", ";").replace("1.08", "1,234.5"), "line 5", "thousands"),
    "bars": alone(GOOD.replace(",", "|"), "displacement"),
    "mixed delimiters": changed("T01,1,35,1,", "T01;1;35;1;", "line 4 has 1 cells"),
    "one column": alone("force [N]\n1\n2\n3\n", "displacement"),
    "column named twice": alone(GOOD.replace("s [mm]", "force [N]"), "'force'", "twice"),
    "two forces": alone(GOOD.replace("s [mm]", "load [N]"), "'load'", "columns.force"),
    "column without name": alone(GOOD.replace("displacement [mm]", ""), "displacement"),
    "no displacement": alone(GOOD.replace("displacement", "depth"), "displacement", "'depth"),
    "no rows": alone(HEAD, "no rows"),
    "comments only": alone("# a\n# b\n", "empty"),
    "lines above a tidy table": alone("Lab 3\nMay\n" + GOOD, "line 3", "begin them with #"),
    "header of a million blanks": alone(
        "specimen,a" + " " * 10**6 + "b\n1,2\n", "displacement"
    ),
    "line of dashes": changed("T01,1,35,0,0\n", "-----\n", "line 2 has 1 cells"),
    "total below": beside(GOOD + "Total,,,,2.05\n", "line 6"),
    "specimen lost": changed("T01,1,35,1,", ",1,35,1,", "line 4", "specimen"),
    "curve in two blocks": beside(GOOD + "T09,1,35,0,0\nT01,1,35,2,3\n", "again in line 7"),
    "bell in a name": changed("T01,1,35,1,", "T\a1,1,35,1,", "line 4", "unprintable"),
    "JSON line broken": alone('{"s": "17 mm"\n' + GOOD, "line 1", "JSON"),
    "JSON line a list": alone('[1, 2]\n' + GOOD),
    "JSON line nested": alone('{"a":' * 9000 + "\n" + GOOD, "line 1", "JSON"),
    "JSON position in newton": alone('{"s": "17 N"}\n' + GOOD, "line 1", "s:"),
    "JSON position a list": alone('{"s": [1]}\n' + GOOD, "line 1", "s:"),
    "line of a million cells": changed("1,0.66", "1,0.66" + ",0" * 10**6, "line 4"),
    "one endless line": alone("x" * 10**6, "displacement"),
}  # fmt: skip
ENCODING = {
    "UTF-16 without mark": alone(GOOD.encode("utf-16-le"), "zero bytes"),
    "UTF-16 cut in a character": beside(GOOD.encode("utf-16")[:-3], "line 5"),
    "UTF-16 of odd bytes": beside(b"\xff\xfe" + GOOD.encode(), "data.csv"),
    "UTF-32": alone(GOOD.encode("utf-32-le"), "zero bytes"),
    "UTF-7": alone(GOOD.encode("utf-7").replace(b"[", b"+AFs-"), "displacement"),
    "EBCDIC": alone(GOOD.encode("cp500"), "displacement"),
    "Latin-1 header": alone(GOOD.replace("force", "Kraft ä").encode("latin-1"), "force", "ä"),
    "Latin-1 unit": alone(GOOD.replace("[N]", "[µN²]").encode("latin-1"), "unit"),
    "NUL in a cell": changed("0.66", "0.6\x006", "zero bytes"),
    "NUL padding": alone(GOOD.encode() + bytes(512), "zero bytes"),
}
VALUES = {
    **{
        f"force {text}": changed("0.66", text, "line 4", word)
        for text, word in {
            "nan": "NaN", "inf": "infinite", "-Infinity": "infinite", "1e400": "infinite",
            "": "empty", "1e9": "plausible", "-1e308": "plausible", "0x1p3": "number",
            "1_000": "number", "1+2j": "number", "#N/A": "number", "O.66": "number",
            "0.66 N": "number", "=A1*2": "number", "1e": "number", "--1": "number",
        }.items()
    },
    "displacement nan": changed("1,0.66", "nan,0.66", "line 4", "displacement"),
    # Not refused: check says how much of the curve is used (tests/test_segments.py).
    "displacement falls": dataclasses.replace(changed("1,0.66", "0.2,0.66"), codes=(0,)),
    "displacement must not fall": beside(
        GOOD.replace("1,0.66", "0.2,0.66"), "line 4", spec='loading = "require-monotone"\n'
    ),
    "displacement in km": changed("1.5,1.08", "1.5e6,1.08", "line 5", "unit"),
    "displacement tiny": beside(
        HEAD + "".join(f"T01,1,35,{i}e-9,{i}\n" for i in range(4)), "covers", "unit"
    ),
    "displacement constant": beside(
        HEAD + "".join(f"T01,1,35,1,{i}\n" for i in range(4)), "covers"
    ),
    "force constant": beside(HEAD + "".join(f"T01,1,35,{i},2\n" for i in range(4)), "force is 2"),
    "upside down": beside(HEAD + "".join(f"T01,1,35,{i},-{i}\n" for i in range(4)), "force_sign"),
    "unloading": beside(HEAD + "".join(f"T01,1,35,{3 - i},{i}\n" for i in range(4))),
    "one sample": beside(HEAD + f"T01,1,35,{ROWS[3]}\n", "samples"),
    "position changes": changed("T01,1,35,1,", "T01,1,36,1,", "s varies"),
    "position nan": changed("T01,1,35,1,", "T01,1,nan,1,", "line 4", "s is empty"),
    "position infinite": beside(GOOD.replace(",35,", ",inf,"), "position"),
    "position 1e9": beside(GOOD.replace(",35,", ",1e9,"), "position"),
    "position beyond the tube": beside(GOOD.replace(",35,", ",161,"), "0 to 160 mm"),
    "position before the tube": beside(GOOD.replace(",35,", ",-0.1,"), "0 to 160 mm"),
    "angle 400 deg": beside(
        GOOD.replace("s [mm]", "s [mm],phi [deg]").replace(",35,", ",35,400,"), "turn"
    ),
    "angle off the midline": beside(
        GOOD.replace("s [mm]", "s [mm],phi [deg]").replace(",35,", ",35,30,"), "midline"
    ),
    "sigma zero": beside(with_column("sigma [N]", 0, 0, 0, 0), "sigma is not positive"),
    "sigma negative": beside(with_column("sigma [N]", 1, -1, 1, 1), "sigma", "line 3"),
    "sigma nan": beside(with_column("sigma [N]", 1, 1, "nan", 1), "sigma", "line 4"),
    "marker infinite": beside(with_column("joint_3 [mm]", 1, 1, "inf", 1), "markers", "line 4"),
    "marker on ring 0": alone(with_column("joint_0 [mm]", 1, 1, 1, 1), "joint_0", "from 1"),
    "marker on ring 16": beside(with_column("joint_16 [mm]", 0, 1, 2, 3), "ring 16 of 15"),
    "marker on ring 9999": beside(with_column("joint_9999 [mm]", 0, 1, 2, 3), "ring"),
}  # fmt: skip
UNITS = {
    "no unit of force": alone(GOOD.replace(" [N]", ""), "force", "units.force"),
    "no unit of displacement": alone(GOOD.replace("displacement [mm]", "displacement"), "unit"),
    "force in mm": alone(GOOD.replace("[N]", "[mm]"), "'mm'", "force"),
    "force in kips": alone(GOOD.replace("[N]", "[kips]"), "'kips'", "accepted"),
    "force in N/m": alone(GOOD.replace("[N]", "[N/m]"), "'N/m'"),
    "displacement in s": alone(GOOD.replace("displacement [mm]", "displacement [s]"), "'s'"),
    "empty brackets": alone(GOOD.replace("[N]", "[]"), "force"),
    "bracket open": alone(GOOD.replace("[N]", "[N"), "force"),
    "unit contradicted": alone(
        GOOD, "mm", "units.displacement", spec=SPEC + 'units = { displacement = "um" }'
    ),
    "column of the specification missing": alone(
        GOOD, "'Kraft'", "columns.force", spec=SPEC + 'columns = { force = "Kraft" }'
    ),
    "machine format asked of a tidy table": alone(GOOD, spec=SPEC + 'format = "machine"'),
    "tidy format asked of HDF5": alone(
        b"\x89HDF\r\n\x1a\n" + bytes(99), "is HDF5", "'tidy'", spec=SPEC + 'format = "tidy"'
    ),
    "afmformats asked of a tidy table": alone(GOOD, spec=SPEC + 'format = "afmformats"'),
}
CASES = CUT | FLIPPED | DIALECT | ENCODING | VALUES | UNITS
