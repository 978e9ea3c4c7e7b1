"""Data files without a specification: check says what they are, init writes one that fits."""

import os
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from run_cli import GOOD, run
from specimens import DEPTHS, POSITIONS, press

from jaxtrachea.cli.specification import options_of, parameters_of
from jaxtrachea.cli.terminal import quiet_compiler
from jaxtrachea.config import FitSpec
from jaxtrachea.measurements.curve import ReadOptions
from jaxtrachea.measurements.guess import guess
from jaxtrachea.measurements.heads import head_of
from jaxtrachea.trachea.section import geometry_of

ROOT = Path(__file__).parents[1]
SHARED = ROOT.parent / "shared" / "data"
HDF5 = ROOT / "fits" / "virtual_trachea" / "small_strain.h5"
GERMAN = "Prüfung;A\nWeg [mm];Kraft [N];Zeit [s]\n0;0,01;0\n0,5;-0,31;1\n1,0;-0,66;2\n1,5;-1,08;3\n"
INSTRON = """Compression test;
Speed (mm/min): 10;
Time (s),Compression (mm),Load (N),Engineering Strain [-]
0.0,0.0,-0.009,0.0
0.1,0.5,0.31,0.01
0.2,1.0,0.66,0.02
0.3,1.5,1.08,0.03
"""
needs_shared = pytest.mark.skipif(
    not (SHARED / "ecoflex").is_dir(), reason="curves of others (CC BY, MIT) are not beside it"
)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "good.csv").write_text(GOOD)
    (tmp_path / "spec.toml").write_text('[data]\nfiles = "good.csv"\n')
    return tmp_path


def read(path="fit.toml"):
    return FitSpec.model_validate(tomllib.loads(Path(path).read_text()))


def line_of(out, column):
    """The row of a column in the table that check prints."""
    return " ".join(next(row for row in out.splitlines() if row.startswith(f" {column} ")).split())


def test_columns_units_and_roles_are_shown(folder, monkeypatch, capsys):
    table = GOOD.replace("force [N]", "force [N],time [s],joint_7 [um],T [C]")
    (folder / "my.csv").write_text(re.sub(r"(\n.+)", r"\1,1,5,20", table))
    code, out, err = run(monkeypatch, capsys, "check", "my.csv")
    assert code == 0
    for row in ("specimen – specimen", "s mm position s along the tube", "force N force",
                "displacement mm displacement of the tool", "time s time", "T C not used",
                "joint_7 um markers on rings 7"):  # fmt: skip
        assert line_of(out, row.split()[0]) == row
    assert "1 usable curves: T01" in out
    assert "Nothing is missing" in out
    assert out.rstrip().endswith("jaxtrachea init my.csv")
    assert "'T'; --column ROLE=NAME gives them one" in err
    assert not (folder / "fit.toml").exists()


def test_a_specification_is_checked_as_ever(folder, monkeypatch, capsys):
    code, out, _ = run(monkeypatch, capsys, "check", "spec.toml")
    assert (code, "Free parameters" in out) == (0, True)
    code, out, _ = run(monkeypatch, capsys, "check", "good.csv")
    assert (code, "Free parameters" in out) == (0, False)


def test_what_is_commented_is_the_default(folder, monkeypatch, capsys):
    """Without its mark every line `# key = value`, and `# [trachea]`, changes nothing."""
    assert run(monkeypatch, capsys, "init", "good.csv")[0] == 0
    text = (folder / "fit.toml").read_text()
    plain, lines = re.subn(r"^# (?=\[\w+\]$|\w+ = )", "", text, flags=re.M)
    assert lines > 15
    before, after = (FitSpec.model_validate(tomllib.loads(t)) for t in (text, plain))
    assert after.trachea.length == 160.0
    assert options_of(before) == options_of(after)
    tables = [parameters_of(spec, options_of(spec), joints=False) for spec in (before, after)]
    assert tables[0] == tables[1]
    assert len(after.parameters) == 4
    tubes = [geometry_of(spec.trachea) for spec in (before, after)]
    np.testing.assert_allclose(*(np.asarray(t.ring_positions) for t in tubes), rtol=1e-6)
    assert float(tubes[0].radius) == pytest.approx(float(tubes[1].radius), rel=1e-6)
    assert (before.noise, before.fit, before.data) == (after.noise, after.fit, after.data)


def test_init_overwrites_only_when_asked(folder, monkeypatch, capsys):
    (folder / "fit.toml").write_text("years of work")
    code, out, err = run(monkeypatch, capsys, "init", "good.csv")
    assert (code, out) == (2, "")
    assert "fit.toml: exists; nothing was written" in err
    assert "--overwrite" in err
    assert (folder / "fit.toml").read_text() == "years of work"
    assert run(monkeypatch, capsys, "init", "good.csv", "--overwrite")[0] == 0
    assert read().data.files == ["good.csv"]


def test_position_is_asked_for(folder, monkeypatch, capsys):
    (folder / "a.csv").write_text(INSTRON)
    code, out, err = run(monkeypatch, capsys, "check", "a.csv")
    assert code == 1
    assert "missing: the position s along the tube, of 1 of 1 curves (--s '40 mm'" in err
    assert out.rstrip().endswith("jaxtrachea init a.csv --s '40 mm'")
    code, out, err = run(monkeypatch, capsys, "init", "a.csv")
    assert code == 1
    assert "missing: the position s" in err
    assert "complete it, then: jaxtrachea fit fit.toml" in out
    text = (folder / "fit.toml").read_text()
    assert re.search(r'^# MISSING: the position s .*\n# s = "40 mm"$', text, re.M)
    code, _, err = run(monkeypatch, capsys, "fit", "fit.toml")
    assert (code, "no contact position" in err) == (2, True)
    # The cures, as printed: the line without its mark, or the option.
    (folder / "fit.toml").write_text(text.replace('# s = "40 mm"', 's = "40 mm"'))
    assert run(monkeypatch, capsys, "check", "fit.toml")[0] == 0
    assert run(monkeypatch, capsys, "init", "a.csv", "--s", "40 mm", "--out", "b.toml")[0] == 0
    assert read("b.toml").data == read().data


def test_position_of_the_names_of_files(folder, monkeypatch, capsys):
    """By the options that are printed where it is missing."""
    files = ["T1_s20.csv", "T1_s75.csv"]
    for name in files:
        (folder / name).write_text(INSTRON)
    _, _, err = run(monkeypatch, capsys, "check", *files)
    cure = shlex.split(re.search(r"T01_s40.csv (--specimen .*--unit s=mm)\)", err)[1])
    code, out, _ = run(monkeypatch, capsys, "init", *files, *cure)
    assert code == 0
    assert "2 curves of 1 specimen, 2 positions s from 20 to 75 mm" in out
    code, out, _ = run(monkeypatch, capsys, "check", "fit.toml")
    assert (code, "1 fit(s)" in out) == (0, True)


def test_columns_are_guessed_by_units_and_signs_by_the_curve(folder, monkeypatch, capsys):
    (folder / "k.csv").write_bytes(GERMAN.encode("latin-1"))
    code, out, err = run(monkeypatch, capsys, "check", "k.csv", "--s", "40 mm")
    assert code == 0
    assert line_of(out, "Kraft") == "Kraft N force (guessed)"
    assert "column 'Weg' is taken for the displacement" in err
    assert "the force counts negative where the tool presses: it is turned" in err
    assert run(monkeypatch, capsys, "init", "k.csv", "--s", "40 mm")[0] == 0
    data = read().data
    assert data.columns == {"force": "Kraft", "displacement": "Weg"}
    assert (data.force_sign, data.displacement_sign, data.s) == (-1, 1, "40 mm")
    code, out, _ = run(monkeypatch, capsys, "check", "fit.toml")
    assert (code, "0 … 1.5" in out, "… 1.08" in out) == (0, True, True)


@pytest.mark.parametrize(
    ("rows", "turned"),
    [
        ("0,0\n1,0.5\n2,1.1\n", (1, 1)),
        ("0,0\n-1,-0.5\n-2,-1.1\n", (-1, -1)),
        ("0,0\n-1,0.5\n-2,1.1\n", (1, -1)),
    ],
)
def test_signs(rows, turned, folder, monkeypatch, capsys):
    (folder / "a.csv").write_text("displacement [mm],force [N]\n" + rows)
    assert run(monkeypatch, capsys, "init", "a.csv", "--s", "4 cm")[0] == 0
    assert (read().data.force_sign, read().data.displacement_sign) == turned


def test_units_that_differ_are_converted_and_said(folder, monkeypatch, capsys):
    (folder / "b.csv").write_text(
        GOOD.replace("T01", "T02").replace("force [N]", "force [mN]").replace("mm]", "cm]")
    )
    code, _, err = run(monkeypatch, capsys, "init", "good.csv", "b.csv")
    assert code == 1  # 35 cm is not on the tube
    assert "units of the force differ: N in good.csv, mN in b.csv" in err
    assert "a tube that holds all curves; Table 1's does not" in err
    assert re.search(r"^# MISSING: a tube .*\n# \[trachea\]$", Path("fit.toml").read_text(), re.M)


def test_a_folder_stands_for_its_data_files(folder, monkeypatch, capsys):
    (folder / "study").mkdir()
    (folder / "real" / "deep").mkdir(parents=True)
    (folder / "link").symlink_to("real/deep")
    for name in ("T01", "T02"):
        (folder / "study" / f"{name}.csv").write_text(GOOD.replace("T01", name))
    (folder / "study" / "notes.md").write_text("no data")
    assert run(monkeypatch, capsys, "init", "study", "--out", "link/x.toml")[0] == 0
    assert read("link/x.toml").data.files == ["../../study/*.csv"]
    code, out, _ = run(monkeypatch, capsys, "check", "link/x.toml")
    assert (code, "2 usable curves" in out) == (0, True)


def test_a_workbook_and_its_sheet(folder, monkeypatch, capsys):
    openpyxl = pytest.importorskip("openpyxl", reason="openpyxl (extra 'xlsx') is not installed")
    book = openpyxl.Workbook()
    page = book.create_sheet("Data")
    for row in (["F_z [N]", "Weg [mm]"], [0.0, 0.0], [0.3, 0.5], [0.7, 1.0]):
        page.append(row)
    book.save("a.xlsx")
    said = ("a.xlsx", "--sheet", "Data", "--s", "40 mm")
    assert run(monkeypatch, capsys, "init", *said)[0] == 0
    assert read().data.sheet == "Data"
    assert read().data.columns == {"force": "F_z", "displacement": "Weg"}
    assert run(monkeypatch, capsys, "check", "fit.toml")[0] == 0


AMBIGUOUS = "D [mm],Fx [N],Fy [N]\n0,1,2\n1,3,2\n"
#: arguments, what stderr must say; `@` stands for init and check
BAD = [
    ("@ nothing.csv", ["nothing.csv: no such file", "expected files of", "check the path"]),
    ("@ junk.csv", ["junk.csv: is not text", "expected a table", "export"]),
    ("@ empty", ["empty: a folder without data files (.csv,", "name the files"]),
    ("@ zero.csv", ["no usable curve: empty: zero.csv", "export it again"]),
    ("@ text.csv", ["no usable curve: column_missing: text.csv", "say --column displacement=NAME"]),
    ("@ two.csv", ["two.csv: which column is the force, 'Fx' or 'Fy'? Say --column force=NAME"]),
    ("@ bare.csv", ["bare.csv: column 'force' has no unit", "or give --unit force=UNIT"]),
    ("@ good.csv --unit force=mN", ["is in N but --unit force says mN; remove the wrong one"]),
    ("@ good.csv --column force=F", ["no column 'F' for the force", "say --column force=NAME"]),
    ("@ good.csv --column force", ["--column 'force': expected a role", "force=F_z"]),
    ("@ good.csv --column kraft=F", ["--column: role 'kraft'; expected one of specimen"]),
    ("@ good.csv --s 40", ["--s: '40' has no unit", '"40 mm"']),
    ("@ good.csv --s '40 mm'", ["s is 35 mm in the file but 40 mm in the options"]),
    ("@ good.csv --format csv", ["--format: expected 'auto', 'afmformats'"]),
    ("@ good.csv --force-sign 2", ["--force-sign must be one of 1, -1"]),
    ("@ good.csv --sheet a", ["--sheet: none of the files is a workbook"]),
    ("@ good.csv good.csv copy.csv", ["'T01' trial '1' was already in good.csv", "--specimen"]),
    ("@", ["Missing argument"]),
    ("init spec.toml", ["spec.toml: a specification (TOML)", "jaxtrachea check spec.toml"]),
    ("init good.csv --out a.csv", ["a.csv: expected a name that ends in .toml"]),
    ("init good.csv --out no/a.toml", ["no/a.toml: there is no folder no; make it"]),
    ("init good.csv --out d.toml", ["d.toml: a folder; expected a file to write"]),
    ("check spec.toml good.csv", ["spec.toml: a specification; expected it alone"]),
    ("check good.csv --data .", ["--data: for a specification alone"]),
    ("check spec.toml --s 4mm", ["--s: for data files alone; write it into [data] of spec.toml"]),
]  # fmt: skip


@pytest.mark.parametrize(("line", "says"), BAD, ids=[line for line, _ in BAD])
def test_bad_input(line, says, folder, monkeypatch, capsys):
    (folder / "junk.csv").write_bytes(bytes(range(256)) * 20)
    (folder / "zero.csv").write_text("")
    (folder / "text.csv").write_text("a,b\nx,y\n")
    (folder / "two.csv").write_text(AMBIGUOUS)
    (folder / "bare.csv").write_text(GOOD.replace("force [N]", "force"))
    (folder / "copy.csv").write_text(GOOD)
    for name in ("empty", "d.toml"):
        (folder / name).mkdir()
    before = sorted(folder.iterdir())
    for command in ("init", "check") if line[0] == "@" else ("",):
        words = re.findall(r"'[^']+'|\S+", line.replace("@", command))
        code, out, err = run(monkeypatch, capsys, *(word.strip("'") for word in words))
        assert code == 2, err
        for part in says:
            assert part in err
        assert "Traceback" not in err + out
        assert sorted(folder.iterdir()) == before


def test_an_equal_guess_is_none(folder):
    """Only one column may fit, in all tables alike; names decide among several."""

    def of(*headers):
        for i, header in enumerate(headers):
            row = ",".join(["1"] * (header.count(",") + 1))
            (folder / f"{i}.csv").write_text(f"{header}\n{row}\n")
        return guess([head_of(folder / f"{i}.csv", ReadOptions()) for i in range(len(headers))])

    assert of("D [um],P [mN]").columns == {"force": "P", "displacement": "D"}
    assert of("x [mm],depth [mm],P [N]").columns["displacement"] == "depth"
    assert of("x [mm],y [mm],P [N]").open == {"displacement": ("x", "y")}
    assert of("force [N],load cell [N],weg [mm]").columns == {"displacement": "weg"}
    assert of("D [mm],P [N]", "D [mm],Q [N]").columns == {"displacement": "D"}
    assert of("T [C],p [kPa]") == ({}, {})


def four_positions(path):
    """A table of one specimen at four places, by an independent beam; its truth."""
    truth = np.array([[900.0, 0.3, 8.0, 0.1]])
    solved = press(truth, np.arange(10.0, 160.0, 10.0), 160.0, POSITIONS, DEPTHS[::4])
    rows = [
        f"A,{s:g},{s:g},{d!r},{f!r}"
        for s, forces in zip(POSITIONS, solved.force[0].tolist(), strict=True)
        for d, f in zip(DEPTHS[::4].tolist(), forces, strict=True)
    ]
    head = "specimen,trial,s [mm],displacement [mm],force [N]"
    path.write_text("\n".join([head, *rows]) + "\n")
    return dict(zip(("EI_L", "k_M", "k_1", "k_3"), truth[0].tolist(), strict=True))


@pytest.mark.slow
@pytest.mark.compiling
def test_the_first_two_commands_of_a_user(folder, monkeypatch, capsys):
    """`init my.csv`, `fit fit.toml`: estimates are those that an independent beam was made with."""
    truth = four_positions(folder / "my.csv")
    assert run(monkeypatch, capsys, "init", "my.csv")[0] == 0
    code, _, err = run(monkeypatch, capsys, "fit", "fit.toml", "--out", "done")
    assert code == 0, err
    lines = (folder / "done" / "parameters.csv").read_text().splitlines()
    head, *rows = (line.split(",") for line in lines)
    name = head.index("parameter")
    found = {row[name]: float(row[head.index("value")]) for row in rows}
    for parameter, value in truth.items():
        assert found[parameter] == pytest.approx(value, rel=1e-3), parameter


@needs_shared
def test_files_of_others_are_read(folder, monkeypatch, capsys):
    code, out, _ = run(monkeypatch, capsys, "check", *SHARED.glob("ecoflex/EF10_0T_A?.csv"))
    assert (code, "5 usable curves" in out) == (1, True)  # no position
    assert line_of(out, "Load") == "Load N force"
    for ending, kind in (("tab", "tab"), ("h5", "hdf5")):
        path = SHARED / "formats" / f"fmt-{kind}-fd_version_0.13.3.{ending}"
        code, out, _ = run(monkeypatch, capsys, "check", path, "--s", "75 mm")
        assert code == 0
        assert line_of(out, "force") == "force N force"
        assert line_of(out, "height (measured)").endswith("m displacement of the tool")
        assert line_of(out, "height (piezo)").endswith("m not used")


@pytest.mark.slow
@pytest.mark.compiling
def test_a_shipped_file_is_fitted_as_written(folder, monkeypatch, capsys):
    assert run(monkeypatch, capsys, "init", HDF5)[0] == 0
    code, _, err = run(monkeypatch, capsys, "fit", "fit.toml", "--out", "done")
    assert code == 0, err
    assert (folder / "done" / "report.html").is_file()


def test_commands_keep_the_log_of_the_compiler_off_the_terminal(monkeypatch):
    """Before JAX is imported, which reads the level; never against the user's own."""
    code = (
        "import os, sys, jaxtrachea.cli.main as m\n"
        "try: sys.argv = ['x', '--version']; m.main()\n"
        "except SystemExit: print('jax' in sys.modules, os.environ['TF_CPP_MIN_LOG_LEVEL'])"
    )
    monkeypatch.delenv("TF_CPP_MIN_LOG_LEVEL", raising=False)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split()[-2:] == ["False", "3"]
    monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", "0")
    quiet_compiler()
    assert os.environ["TF_CPP_MIN_LOG_LEVEL"] == "0"


@pytest.mark.slow
def test_a_slow_compilation_says_nothing():
    """XLA's alarm at a constant that takes seconds to fold: the one of "Very slow compile?", too.

    That one sounds after two minutes only; both are a `SlowOperationAlarm`.
    """
    slow = (
        "import jax, jax.numpy as jnp\n"
        "f = lambda: jax.lax.reduce_window(jnp.arange(2500.0), -jnp.inf, jax.lax.max, (2500,), "
        "(1,), 'SAME')\n"
        "jax.jit(f).lower().compile()"
    )
    first = "from jaxtrachea.cli.terminal import quiet_compiler\nquiet_compiler()\n"
    dropped = ("TF_CPP_MIN_LOG_LEVEL", "XLA_FLAGS", "JAX_LOGGING_LEVEL")
    plain = {k: v for k, v in os.environ.items() if k not in dropped}
    heard = [
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=plain)
        for code in (slow, first + slow)
    ]
    assert [done.returncode for done in heard] == [0, 0]
    if "slow_operation_alarm" not in heard[0].stderr:
        pytest.skip("this machine, or this XLA, folds the constant too quickly for the alarm")
    assert heard[1].stderr == ""
