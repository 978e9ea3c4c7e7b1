"""Exports as machines and their programs write them: read, or refused with a cure that works.

All hold the same press, D and F; a trial that is longer or another is said.
"""

import datetime
import re
import tomllib

import numpy as np
import pytest
from measured_files import put, read

D, F, T = [0.0, 0.5, 1.0, 1.5], [0.0, 0.31, 0.66, 1.08], [0.0, 1.0, 2.0, 3.0]


def rows(*columns, sep=",", end="\n", form="{}"):
    return "".join(
        sep.join(form.format(cell) for cell in row) + end for row in zip(*columns, strict=True)
    )


def comma(values):
    return [str(v).replace(".", ",") for v in values]


NUMBERS = rows(T, D, F)
TABBED = rows(T, D, F, sep="\t")
SEMI = rows(comma(T), comma(D), comma(F), sep=";")
BLUEHILL = '"Specimen 1"\n\n"Time","Extension","Load"\n"(s)","(mm)","(N)"\n'
MACH_1 = (
    "<Mach-1 File>\n<INFO>\nDate\t2026-05-01\nOperator\tA. N.\n<END INFO>\n"
    "<Find Contact>\nStage Axis:\tPosition (z)\n<DATA>\n"
    "Time, s\tPosition (z), mm\tFz, N\n" + TABBED + "<END DATA>\n"
)
MACH_ROLES = {"columns": {"displacement": "Position (z)", "force": "Fz"}}
LVM = (
    "LabVIEW Measurement\t\nWriter_Version\t2\nSeparator\tTab\nDecimal_Separator\t.\n"
    "Multi_Headings\tYes\nX_Columns\tOne\nTime_Pref\tRelative\nDate\t2026/05/01\n"
    "Time\t10:15:30.5\n***End_of_Header***\t\n\t\n"
)
LVM_TABLE = (
    "Channels\t2\t\t\nSamples\t4\t4\t\nDate\t2026/05/01\t2026/05/01\t\n"
    "Time\t10:15:30.5\t10:15:30.5\t\nY_Unit_Label\tmm\tN\t\nX_Dimension\tTime\tTime\t\n"
    "X0\t0.0\t0.0\t\nDelta_X\t1.0\t1.0\t\n***End_of_Header***\t\t\t\n"
    "X_Value\tDisplacement\tForce\tComment\n"
)
PAIRS = rows(D, F, D, [2 * f for f in F])
TWO = {"1": (D, F), "2": (D, [2 * f for f in F])}
ONE = {"1": (D, F)}

#: Name: text, options, the trials that are read.
READ = {
    "Bluehill, units below": (BLUEHILL + rows(T, D, F, form='"{}"'), {}, ONE),
    "Instron, specimen above": (
        '"Specimen","T1"\n"Rate","1 mm/s"\n\nTime (s),Extension (mm),Load (N)\n' + NUMBERS,
        {}, ONE),
    "Bluehill, compressive": (
        "Time(s),Compressive extension(mm),Compressive load(N)\n" + NUMBERS, {}, ONE),
    "TestXpert, decimal commas": ("Prüfzeit;x\n\nTime;Extension;Load\ns;mm;N\n" + SEMI, {}, ONE),
    "Trapezium, stroke": ("Name,A\n\nTime,Stroke,Force\nsec,mm,N\n" + NUMBERS, {}, ONE),
    "MTS, crosshead": ("Crosshead\tLoad\tTime\nmm\tN\ts\n" + rows(D, F, T, sep="\t"), {}, ONE),
    "NEXYGEN, deflection": ("Load (N),Deflection (mm)\n" + rows(F, D), {}, ONE),
    "position": ("Time [s],Position [mm],Force [N]\n" + NUMBERS, {}, ONE),
    "position beside displacement": (
        "Position [mm],Displacement [mm],Force [N]\n" + rows([9, 8, 7, 6], D, F), {}, ONE),
    "texture analyser, grams": (
        "Time (sec),Distance (mm),Force (g)\n"
        + rows(T, D, [f / 9.80665e-3 for f in F]), {}, ONE),
    "texture analyser, kilograms": (
        "Force (kg),Distance (mm)\n" + rows([f / 9.80665 for f in F], D), {}, ONE),
    "unit after a comma": ("Time, s\tPosition, mm\tLoad, N\n" + TABBED, {}, ONE),
    "unit after a blank": ("Time s;Extension mm;Load N\n" + SEMI, {}, ONE),
    "unit after a slash": ("Time / s,Stroke / mm,Load / kN\n"
                           + rows(T, D, [f / 1000 for f in F]), {}, ONE),
    "one unit above, one below": ("Displacement [mm],Force\n,N\n" + rows(D, F), {}, ONE),
    "units with one unknown": ("Time,Displacement,Force,Phase\ns,mm,N,turns/x\n"
                               + rows(T, D, F, T), {}, ONE),
    "blanks, numpy": ("# displacement [mm] force [N]\n" + rows(D, F, sep=" "), {}, ONE),
    "blanks, aligned": (
        "  Time [s]   Displacement [mm]   Force [N]\n"
        + "".join(f"{t:10.3f} {d:12.4f} {f:12.4f}\n" for t, d, f in zip(T, D, F, strict=True)),
        {}, ONE),
    "blanks, two words": (
        "Run 7\nElapsed Time (s)  Compressive extension (mm)  Compressive load (N)\n"
        + rows(T, D, F, sep="  "), {}, ONE),
    "blanks, decimal commas": (
        "Displacement [mm]  Force [N]\n" + rows(comma(D), comma(F), sep="   "), {}, ONE),
    "header a comment": ("# rig 3\n#time [s],displacement [mm],force [N]\n" + NUMBERS, {}, ONE),
    "header a comment, tabs": ("#Displacement (mm)\tForce (N)\n" + rows(D, F, sep="\t"), {}, ONE),
    "quoted decimal commas": (
        "Displacement [mm],Force [N]\n" + rows(comma(D), comma(F), form='"{}"'), {}, ONE),
    "quoted thousands": (
        "Displacement [um],Force [mN]\n"
        + rows(["0.0", "500.0", "1,000.0", "1,500.0"], ["0.0", "310.0", "660.0", "1,080.0"],
               form='"{}"'), {}, ONE),
    "minus of a typesetter": (
        "Displacement [mm],Force [N]\n" + rows(["\u22120.5", *D[1:]], F), {},
        {"1": ([-0.5, *D[1:]], F)}),
    "times of day": (
        "Time,Displacement [mm],Force [N]\n"
        + rows([f"10:59:{58 + t:04.1f}" if t < 2 else f"11:00:{t - 2:04.1f}" for t in T], D, F),
        {}, ONE),
    "date and time of day": (
        "Time,Displacement [mm],Force [N]\n"
        + rows([f"2026-05-01 10:15:0{t}" for t in T], D, F), {}, ONE),
    "times in minutes": (
        "Time (mm:ss),Displacement [mm],Force [N]\n" + rows([f"00:0{t}" for t in T], D, F), {},
        ONE),
    "no header": (
        NUMBERS,
        {"columns": {"displacement": "2", "force": "3"},
         "units": {"displacement": "mm", "force": "N"}}, ONE),
    "no header, blanks": (
        rows([0, 1, 2], [0, 2, 4], sep=" "),
        {"columns": {"displacement": "1", "force": "2"},
         "units": {"displacement": "mm", "force": "N"}}, {"1": ([0, 1, 2], [0, 2, 4])}),
    "pairs side by side": (
        "Displacement [mm],Force [N],Displacement [mm],Force [N]\n" + PAIRS, {}, TWO),
    "pairs with titles": (
        "left,,right,\nExtension,Load,Extension,Load\nmm,N,mm,N\n" + PAIRS, {},
        {"left": TWO["1"], "right": TWO["2"]}),
    "pairs with numbers": (
        "Time [s],Stroke 1 [mm],Load 1 [N],Stroke 2 [mm],Load 2 [N]\n"
        + rows(T, D, F, D, TWO["2"][1]), {}, TWO),
    "pairs of other lengths": (
        "Stroke [mm],Load [N],Stroke [mm],Load [N]\n" + PAIRS + ",,2.0,3.0\n", {},
        {"1": (D, F), "2": ([*D, 2.0], [*TWO["2"][1], 3.0])}),
    "Mach-1": (MACH_1, MACH_ROLES, ONE),
    "Mach-1, two blocks": (
        MACH_1 + "<DIVIDER>\n<Stress Relaxation>\n<DATA>\nTime, s\tPosition (z), mm\tFz, N\n"
        + rows(T, D, TWO["2"][1], sep="\t") + "<END DATA>\n", MACH_ROLES, TWO),
    "words below": (
        "Displacement [mm],Force [N]\n" + rows(D, F) + "\nMaximum load,reached\nEnd of test\n",
        {}, ONE),
    "a mean below": (
        "Time [s],Displacement [mm],Force [N]\n" + NUMBERS + "Mean,0.75,0.5125\n", {}, ONE),
    "LabVIEW": (LVM + LVM_TABLE + TABBED, {}, ONE),
    "LabVIEW, decimal commas": (
        LVM + LVM_TABLE + rows(comma(T), comma(D), comma(F), sep="\t"), {}, ONE),
    "LabVIEW, two segments": (
        LVM + LVM_TABLE + TABBED + "\t\n" + LVM_TABLE + rows(T, D, TWO["2"][1], sep="\t"), {}, TWO),
    "Hysitron, volts beside": (
        "Displacement (nm)\tLoad (µN)\tTime (s)\tDisplacement (V)\tLoad (V)\n"
        + rows([1e6 * d for d in D], [1e6 * f for f in F], T, T, T, sep="\t"), {}, ONE),
    "TestSuite, Sec": (
        "Data Header:\tTime:\t1.1\tSec\n\nTime\tAxial Displacement\tAxial Force\nSec\tmm\tN\n"
        + TABBED,
        {"columns": {"displacement": "Axial Displacement", "force": "Axial Force"}}, ONE),
    "WinTest, points": (
        "WinTest\nTest,EF_1\nPoints,Elapsed Time,Disp,Load\n,Sec,mm,N\n" + rows(T, T, D, F),
        {"columns": {"displacement": "Disp"}}, ONE),
    "Trapezium, tests side by side": (
        '"","T_1","","","T_2","",""\n"","Time","Force","Stroke","Time","Force","Stroke"\n'
        '"","sec","N","mm","sec","N","mm"\n'
        + "".join("," + line + "\n" for line in rows(T, F, D, T, TWO["2"][1], D).split()),
        {"columns": {"time": "Time"}}, {"T_1": TWO["1"], "T_2": TWO["2"]}),
    "TestXpert in German": (
        "Prüfer;M.\n\nPrüfzeit;Standardweg;Standardkraft\ns;mm;N\n" + SEMI,
        {"columns": {"displacement": "Standardweg", "force": "Standardkraft"}}, ONE),
    "delimiter at the end": (
        "Displacement [mm];Force [N];\n" + rows(D, F, sep=";", end=";\n"), {}, ONE),
}  # fmt: skip

#: Name: text, what the message says; the cure as it is printed then reads it.
REFUSED = {
    "German names": (
        "Standardweg [mm];Standardkraft [N]\n" + rows(comma(D), comma(F), sep=";"),
        "the columns of line 1 are 'Standardweg', 'Standardkraft'"),
    "depth, and volts beside": (
        "Depth (nm)\tLoad (µN)\tDepth (V)\tLoad (V)\n"
        + rows([1e6 * d for d in D], [1e6 * f for f in F], T, T, sep="\t"),
        "the columns of line 1 are 'Depth', 'Load', 'Depth', 'Load'"),
    "axes of a load cell": (MACH_1, "the columns of line 9 are 'Time', 'Position (z)', 'Fz'"),
    "no header": (rows(D, F), "the table begins with numbers in line 1, in columns 1 to 2"),
    "no unit of force": ("Displacement [mm],Force\n" + rows(D, F), "column 'Force' has no unit"),
    "a position beside a depth": (
        "Position [mm],Depth [mm],Force [N]\n" + rows([35, 35, 75, 75], D, F),
        "the columns of line 1 are 'Position', 'Depth', 'Force'"),
    "two travels": (
        "Extension [mm],Compressive extension [mm],Load [N]\n" + rows([-d for d in D], D, F),
        "'Extension', 'Compressive extension' can all be the displacement"),
}  # fmt: skip


def same(found, trials):
    assert found.bad == ()
    assert [curve.trial for curve in found.curves] == [*trials]
    for curve in found.curves:
        displacement, force = trials[curve.trial]
        np.testing.assert_allclose(curve.displacement, displacement, rtol=1e-14, atol=1e-14)
        np.testing.assert_allclose(curve.force, force, rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("name", READ)
def test_read(name, tmp_path):
    text, options, trials = READ[name]
    same(read(put(tmp_path, text, "export.txt"), **options), trials)


@pytest.mark.parametrize("name", READ)
def test_time(name, tmp_path):
    """The time of an export that has one is that of its samples."""
    text, options, _ = READ[name]
    if "ime" in text.replace("Time_Pref", "").replace("times", "") and "mm:ss" not in text:
        for curve in read(put(tmp_path, text, "export.txt"), **options).curves:
            np.testing.assert_allclose(curve.time, T, atol=1e-12)


@pytest.mark.parametrize("name", REFUSED)
def test_refused_with_a_cure_that_works(name, tmp_path):
    text, says = REFUSED[name]
    path = put(tmp_path, text, "export.txt")
    found = read(path)
    assert found.curves == ()
    (bad,) = found.bad
    assert says in bad.message
    written = "\n".join(re.findall(r"(?:columns|units) = \{[^}]*\}", bad.cure))
    options = tomllib.loads(written)
    if role := re.search(r"(?:data\.)?(columns|units)\.(\w+)", bad.cure if not options else ""):
        options = {role[1]: {role[2]: "N" if role[1] == "units" else "Compressive extension"}}
    same(read(path, **options), ONE)


def test_grams_and_lines_left_out_are_said(tmp_path):
    (note,) = read(put(tmp_path, READ["texture analyser, grams"][0])).notes
    assert "column 'Force' is in g: it is read as gf" in note
    (note,) = read(put(tmp_path, READ["words below"][0])).notes
    assert "lines 7 to 8 below the table are not read ('Maximum load,reached')" in note


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("Displacement [mm],Force [N]\n0,0\n0.5\n1.0,0.66\n", "line 3 has 1 cells"),
        ("Displacement [mm],Force [N]\n0,0\n0.5,0.31\n1.0\n", "line 4 has 1 cells"),
        ("Displacement [mm],Force [N]\n0,0\nbreak,\n1.0,0.66\n", "line 3: Displacement 'break'"),
        ("Displacement [mm],Force [N]\n0,0\n1,2\nDisplacement [um],Force [N]\n0,0\n9,2\n",
         "line 4: Displacement is in um, and in mm in line 1"),
        ("Displacement [mm],Force [N]\n0,0\n1,2\nDisplacement [mm],Force [N],Time [s]\n0,0,0\n",
         "line 4 has 3 cells, the header has 2"),
        ("A\nLoad (N),Extension (mm)\n5.2,3.1\n\nTime (s),Extension (mm),Load (N)\n0,0,0\n1,2,3\n",
         "line 5 is the header of another table than line 2"),
        ("#specimen,displacement [mm],force [N]\nT1,0,0\nT1,1,2\n",
         "line 1 is the header of a table with 'specimen' (specimen), but is a comment"),
        ("Displacement [mm],Force [N],Force [N]\n0,0,0\n1,2,3\n", "can all be the force"),
        ("Stroke [mm],Load [mN],Load [N]\n0,0,0\n1,2,3\n", "'Load [mN]', 'Load [N]' can all"),
        ('Displacement [mm],Force [N]\n0,"1,4,3"\n1,2\n', "Force '1,4,3' is not a number"),
        ('Displacement [mm],Force [N]\n0,"1,234"\n1,"2,345"\n', "'1,234' is not a number"),
        ('Displacement [mm],Force [N]\n0,0.5\n1,"1,234"\n', "'1,234' is not a number"),
        ('Displacement [um],Force [N]\n0,1\n"900",2\n"1,100",3\n', "a thousand times as large"),
    ],
)  # fmt: skip
def test_what_may_be_two_things_is_refused(text, message, tmp_path):
    """A row in the middle or cut off, other units in a second block, thousands or decimals."""
    found = read(put(tmp_path, text))
    assert found.curves == ()
    assert message in found.bad[0].message


def book(folder, sheets):
    openpyxl = pytest.importorskip("openpyxl")
    made = openpyxl.Workbook()
    made.remove(made.active)
    for title, force in sheets.items():
        page = made.create_sheet(title)
        page.append(["Extension", "Load", "Time"])
        page.append(["mm", "N", "s"])
        for row in zip(D, force, T, strict=True):
            page.append([*row[:2], datetime.time(10, 15, int(row[2]))])
    made.save(folder / "export.xlsx")
    return folder / "export.xlsx"


@pytest.mark.parametrize("sheet", ["Trial *", ["Trial 1", "Trial 2"]])
def test_sheets_are_trials(sheet, tmp_path):
    path = book(tmp_path, {"Notes": F, "Trial 1": F, "Trial 2": TWO["2"][1]})
    found = read(path, sheet=sheet)
    same(found, {"Trial 1": TWO["1"], "Trial 2": TWO["2"]})
    np.testing.assert_array_equal(found.curves[0].time, T)
    same(read(path, sheet="Trial 2"), {"1": TWO["2"]})


def test_there_are_many_exports():
    assert len(READ) + len(REFUSED) >= 45
