"""Bad input: one line says where, what and the cure; no traceback, nothing written."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import pytest
from run_cli import GOOD, run, tree

import jaxtrachea
from jaxtrachea.cli.terminal import into
from jaxtrachea.config import SpecError, load_fit_spec
from jaxtrachea.files import lock as run_lock
from jaxtrachea.files import output
from jaxtrachea.fitting import fit as fit_module
from jaxtrachea.runs import folder as run_folder
from jaxtrachea.runs import manifest

ROOT = Path(__file__).parents[1]
HEAD = "specimen,trial,s [mm],displacement [mm],force [N]\n"
DATA = '[data]\nfiles = "good.csv"\n'
TUBE = DATA + '[trachea]\nlength = "160 mm"\nrings = '
K1 = DATA + "[parameters]\nk_1 = "

#: name -> (specification, what stderr must say)
BAD_SPECS = {
    "empty": ("", ["data: missing"]),
    "syntax": ("[data\nfiles = 1", ["not valid TOML", "line 1"]),
    "key twice": (DATA + 'files = "b.csv"\n', ["not valid TOML", "line 3"]),
    "not UTF-8": (b'title = "\xff"\n', ["not UTF-8", "save it as UTF-8"]),
    "binary garbage": (bytes(range(128, 256)), ["not UTF-8"]),
    "deep nesting": (DATA + "a = " + "[" * 5000, ["nested too deeply"]),
    "endless integer": (DATA + "a = " + "9" * 5000, ["not valid TOML", "4300 digits"]),
    "unknown section": (DATA + "[modell]\nshear = true", ["modell: unknown key", "model"]),
    "unknown in data": (DATA + 'unit = "N"', ["data.unit: unknown key", "units"]),
    "unknown in trachea": (DATA + "[trachea]\nlen = 1", ["trachea.len: unknown", "length"]),
    "unknown in rings": (
        TUBE + '{ count = 2, first = "9 mm", last = "99 mm", step = 1 }',
        ["trachea.rings.step: unknown key; expected one of count, first, last"],
    ),
    "unknown in model": (DATA + "[model]\nsheer = true", ["model.sheer: unknown", "shear"]),
    "unknown in parameter": (K1 + "{ init = 1 }", ["parameters.k_1.init: unknown", "initial"]),
    "unknown in noise": (
        DATA + '[noise]\nF = "1 N"',
        ["noise.F: unknown", "force, force_share, joints"],
    ),
    "unknown in fit": (DATA + "[fit]\nstart = 4", ["fit.start: unknown", "starts"]),
    "section is a number": ("data = 3", ["data: expected a table", "found 3"]),
    "files missing": ('[data]\nformat = "auto"', ["data.files: missing"]),
    "files a number": ("[data]\nfiles = 7", ["data.files: expected a valid list (found 7)"]),
    "files empty": ("[data]\nfiles = []", ["data.files", "at least 1 item"]),
    "format unknown": (DATA + 'format = "xlsx"', ["data.format: expected 'auto'", "'xlsx'"]),
    "truth as text": (DATA + '[model]\nshear = "yes"', ["model.shear: expected", "'yes'"]),
    "coupling unknown": (DATA + '[model]\ncoupling = "serie"', ["model.coupling", "'series'"]),
    "starts a fraction": (DATA + "[fit]\nstarts = 1.5", ["fit.starts: expected", "1.5"]),
    "starts zero": (DATA + "[fit]\nstarts = 0", ["fit.starts", "greater than or equal to 1"]),
    "starts as text": (DATA + '[fit]\nstarts = "4"', ["fit.starts: expected a valid integer"]),
    "seed negative": (DATA + "[fit]\nseed = -1", ["fit.seed", "found -1"]),
    "batch huge": (DATA + f"[fit]\nbatch = {10**30}", ["fit.batch", "1000000"]),
    "tolerance nan": (DATA + "[fit]\ntolerance = nan", ["fit.tolerance", "nan"]),
    "tolerance zero": (DATA + "[fit]\ntolerance = 0", ["fit.tolerance", "greater than 0"]),
    "loss scale infinite": (DATA + "[fit]\nloss_scale = inf", ["fit.loss_scale", "finite"]),
    "length bare": (
        DATA + "[trachea]\nlength = 160\nrings = []",
        ["trachea.length: 160 has no unit", "160 mm"],
    ),
    "length in newton": (
        DATA + '[trachea]\nradius = "9 N"',
        ["trachea.radius", "'N' does not measure length", "mm"],
    ),
    "unit unknown": (DATA + '[trachea]\nradius = "9 mmm"', ["unknown unit 'mmm'", "mm"]),
    "radius negative": (DATA + '[trachea]\nradius = "-9 mm"', ["trachea.radius", "positive"]),
    "radius zero": (DATA + '[trachea]\nradius = "0 mm"', ["trachea.radius", "positive"]),
    "radius nan": (DATA + "[trachea]\nradius = nan", ["trachea.radius", "nan has no unit"]),
    "radius overflows": (DATA + '[trachea]\nradius = "1e308 m"', ["trachea.radius", "finite"]),
    "radius endless": (DATA + '[trachea]\nradius = "1e999 mm"', ["radius", "not a finite number"]),
    "angle too large": (DATA + '[trachea]\nhalf_angle = "200 deg"', ["trachea.half_angle", "pi"]),
    "rings alone": (DATA + '[trachea]\nrings = ["9 mm"]', ["trachea", "both length and rings"]),
    "preset and length": (
        TUBE + '["9 mm"]\npreset = "table-1"',
        ["trachea: preset and length exclude each other", "remove one"],
    ),
    "rings empty": (TUBE + "[]", ["trachea.rings", "at least one ring"]),
    "rings a number": (TUBE + "5", ["trachea.rings: expected a valid list (found 5)"]),
    "rings not increasing": (TUBE + '["9 mm", "8 mm"]', ["trachea.rings", "increasing"]),
    "rings outside": (TUBE + '["9 mm", "170 mm"]', ["trachea.rings", "inside (0, 160) mm"]),
    "rings count zero": (
        TUBE + '{ count = 0, first = "9 mm", last = "99 mm" }',
        ["trachea.rings.count", "found 0"],
    ),
    "rings reversed": (
        TUBE + '{ count = 3, first = "99 mm", last = "9 mm" }',
        ["trachea.rings", "increasing"],
    ),
    "parameter unknown": (DATA + "[parameters]\nk_2 = {}", ["parameters.k_2: not a parameter"]),
    "parameter not in model": (
        DATA + "[parameters]\nGA_L = {}",
        ["parameters.GA_L: not seen by this model; with shear = true in [model]", "EI_L"],
    ),
    "arch2": (DATA + '[model]\nrings = "arch2"', ["rings = 'arch2'", "k_M is the whole ring"]),
    "arch2 of sections": (
        DATA + '[model]\nrings = "arch2"\nskeleton = "sections"\ncontact = "bonded"',
        ["rings = 'arch2'", "rings bend as they are; leave it out"],
    ),
    "parameter of the arch": (
        DATA + "[parameters]\nEI_C = {}",
        ["parameters.EI_C: of a ring that bends", "skeleton = 'sections'"],
    ),
    "tie of the arch": (DATA + "[parameters]\nk_t = {}", ["parameters.k_t: of a ring that bends"]),
    "parameter a number": (K1 + "3", ["parameters.k_1: expected a table", "found 3"]),
    "bounds reversed": (K1 + "{ bounds = [9, 1] }", ["parameters.k_1: lower bound 9", "upper"]),
    "bounds one": (K1 + "{ bounds = [9] }", ["parameters.k_1.bounds"]),
    "bounds log zero": (
        K1 + "{ bounds = [0, 1] }",
        ["parameters.k_1: scale 'log'", "positive", "linear"],
    ),
    "bounds nan": (K1 + "{ bounds = [nan, 1] }", ["parameters.k_1", "finite"]),
    "initial outside": (
        K1 + "{ initial = 99, bounds = [1, 9] }",
        ["parameters.k_1: initial value 99 N/mm is outside its bounds [1, 9]"],
    ),
    "initial in mm": (K1 + '{ initial = "3 mm" }', ["parameters.k_1: initial", "stiffness"]),
    "initial huge": (K1 + f"{{ initial = {10**400} }}", ["parameters.k_1.initial", "finite"]),
    "initial infinite": (K1 + "{ initial = inf }", ["parameters.k_1", "finite"]),
    "fixed negative": (K1 + "{ fixed = -1 }", ["parameters.k_1: fixed: -1 N/mm", "more than 0"]),
    "fixed false": (K1 + "{ fixed = false }", ["parameters.k_1.fixed", "true, a number", "False"]),
    "fixed true and initial": (K1 + "{ fixed = true, initial = 1 }", ["parameters.k_1: fixed"]),
    "fixed and bounds": (K1 + "{ fixed = 1, scale = 'log' }", ["parameters.k_1: fixed excludes"]),
    "nothing free to be doubted": (
        K1 + "{ fixed = 1 }\nk_3 = { fixed = 0 }\nEI_L = { fixed = 1 }\nk_M = { fixed = 1 }\n"
        "[uncertainty]\nbootstrap = 40",
        ["uncertainty.bootstrap: no free parameter", "free a parameter"],
    ),
    "noise bare": (DATA + "[noise]\nforce = 0.1", ["noise.force: 0.1 has no unit", "0.1 N"]),
    "noise in mm": (DATA + '[noise]\nforce = "1 mm"', ["noise.force", "does not measure force"]),
    "noise zero": (DATA + '[noise]\njoints = "0 mm"', ["noise.joints", "positive length"]),
    "window reversed": (
        DATA + 'displacement_min = "2 mm"\ndisplacement_max = "1 mm"',
        ["data: displacement_min 2.0 mm must lie below"],
    ),
    "role unknown": (DATA + 'columns = { depth = "x" }', ["data: role 'depth'", "displacement"]),
    "pattern broken": (DATA + "specimen = '(?P<specimen'", ["data: specimen pattern", "regular"]),
    "tool negative": (DATA + 'tool_radius = "-1 mm"', ["data.tool_radius", "positive"]),
    "pressed ends of no tool": (
        DATA + "pressed_ends = false",
        ["data: pressed_ends = false needs tool_radius"],
    ),
    "no such file": ('[data]\nfiles = "god.csv"', ["data.files.0", "'god.csv'", "--data"]),
    "no match": ('[data]\nfiles = "x/*.csv"', ["data.files.0", "no file", "--data"]),
    "no absolute match": ('[data]\nfiles = "/nowhere/*.csv"', ["/nowhere/*.csv", "no file"]),
    "no match above": ('[data]\nfiles = "../nowhere*.csv"', ["../nowhere*.csv", "no file"]),
    "the root": ('[data]\nfiles = "/"', ["data.files.0", "folder"]),
    "a folder": ('[data]\nfiles = "folder"', ["a folder", "'folder/*.csv'"]),
    "no pattern": ('[data]\nfiles = ""', ["data.files.0", "no usable path"]),
    "wild pattern": ('[data]\nfiles = "a**b"', ["data.files.0", "no usable path"]),
    "long name": (f'[data]\nfiles = "{"x" * 400}"', ["data.files.0", "too long"]),
}

#: name -> (content of the only data file, what stderr must say)
BAD_DATA = {
    "empty": (b"", ["data.csv", "empty"]),
    "spaces": (b" \n\n", ["data.csv"]),
    "zero bytes": (b"\0" * 100, ["data.csv", "zero bytes", "export"]),
    "header only": (HEAD.encode(), ["data.csv", "no rows", "export it again"]),
    "no unit": (GOOD.replace(" [N]", "").encode(), ["data.csv", "force", "unit"]),
    "wrong unit": (GOOD.replace("[N]", "[mm]").encode(), ["force", "'mm'", "N"]),
    "no force": (GOOD.replace("force", "foo").encode(), ["force", "column"]),
    "ragged": ((GOOD + "T01,1\n").encode(), ["line 6 has 2 cells", "complete"]),
    "a number lost": (GOOD.replace("0.66", "O.66").encode(), ["T01 1", "O.66", "no usable curve"]),
    "nan": (GOOD.replace("0.66", "nan").encode(), ["T01 1", "non_finite", "no usable curve"]),
    "infinite": (GOOD.replace("0.66", "inf").encode(), ["T01 1", "non_finite"]),
    "falling": (
        GOOD.replace("0.0,", "9.0,").replace("0.5,", "8.0,").replace("1.0,", "7.0,").encode(),
        ["T01 1", "non_monotone", "counted the other way; set displacement_sign = -1"],
    ),
    "no signal": ((HEAD + "a,1,9,0,0\na,1,9,1,0\n").encode(), ["a 1", "no_signal"]),
    "one point": ((HEAD + "a,1,9,0,0\n").encode(), ["a 1", "too_few_points"]),
    "absurd": (GOOD.replace("1.5,", "1.5e9,").encode(), ["T01 1", "absurd_scale"]),
    "contact outside": (GOOD.replace(",35,", ",170,").encode(), ["s = 170 mm", "0 to 160 mm"]),
    "contact negative": (GOOD.replace(",35,", ",-1,").encode(), ["s = -1 mm", "0 to 160 mm"]),
    "contact unknown": (
        GOOD.replace(",s [mm]", "").replace(",35,", ",").encode(),
        ["'T01'", "no contact position", "give a column s"],
    ),
    "off the midline": (
        GOOD.replace("s [mm]", "s [mm],phi [deg]").replace(",35,", ",35,20,").encode(),
        ["phi = 20 deg", "midline"],
    ),
    "marker on no ring": (
        GOOD.replace("[N]\n", "[N],joint_16 [mm]\n").replace("T01,1", "T01,1").encode(),
        ["line 2 has 5 cells"],
    ),
    "ring 16 of 15": (
        b"\n".join(
            line + (b",joint_16 [mm]" if i == 0 else b",0.1")
            for i, line in enumerate(GOOD.encode().splitlines())
        ),
        ["marker on ring 16 of 15"],
    ),
    "HDF5 cut off": (b"\x89HDF\r\n\x1a\n" + b"\1" * 50, ["data.csv", "HDF5"]),
}


def complains(monkeypatch, capsys, folder, says, *arguments):
    """Run in `folder`; exit code 2, short, on stderr alone, without traceback; nothing written."""
    monkeypatch.chdir(folder)
    before = tree(folder)
    code, out, err = run(monkeypatch, capsys, *arguments)
    assert code == 2, err
    for words in says:
        assert words in err
    assert "Traceback" not in err
    assert len(err.splitlines()) <= 3
    assert max(map(len, err.splitlines())) < 700
    assert tree(folder) == before
    return out, err


@pytest.mark.parametrize("name", BAD_SPECS)
def test_bad_specification(name, tmp_path, monkeypatch, capsys):
    text, says = BAD_SPECS[name]
    (tmp_path / "good.csv").write_text(GOOD)
    (tmp_path / "folder").mkdir()
    spec = tmp_path / "spec.toml"
    spec.write_bytes(text if isinstance(text, bytes) else text.encode())
    out, err = complains(monkeypatch, capsys, tmp_path, [*says, "spec.toml"], "fit", spec)
    assert out == ""
    note = "note: 1 of 1 curves go to 1.5 mm"  # of the good data: a linear skeleton
    lines = [line for line in err.splitlines() if not line.startswith(note)]
    assert lines[0].startswith("error:")


@pytest.mark.parametrize("name", BAD_DATA)
def test_bad_only_data_file(name, tmp_path, monkeypatch, capsys):
    content, says = BAD_DATA[name]
    (tmp_path / "data.csv").write_bytes(content)
    (tmp_path / "spec.toml").write_text('[data]\nfiles = "data.csv"')
    out, _ = complains(monkeypatch, capsys, tmp_path, says, "fit", "spec.toml")
    assert out == ""


@pytest.fixture
def study(tmp_path):
    (tmp_path / "good.csv").write_text(GOOD)
    (tmp_path / "spec.toml").write_text(DATA + '[model]\ncoupling = "total"')
    return tmp_path


@pytest.mark.parametrize("old", ["good.csv", "spec.toml"])
def test_names_that_no_report_can_hold(old, study, monkeypatch, capsys):
    (study / "spec.toml").write_text(DATA.replace("good", "*"))
    name = os.fsdecode(b"g\xfcd" + Path(old).suffix.encode())
    try:
        (study / old).rename(study / name)
    except OSError:
        pytest.skip("this file system takes names in UTF-8 alone")
    if old == "good.csv":
        says = ["data.files.0", r"g\udcfcd.csv", "is not UTF-8", "rename it"]
        complains(monkeypatch, capsys, study, says, "fit", "spec.toml")
    else:
        with pytest.raises(SpecError, match="its name is not UTF-8; rename it"):
            load_fit_spec(study / name)


def test_output_that_exists_is_refused_before_fitting(study, monkeypatch, capsys):
    (study / "full").mkdir()
    (study / "full" / "thesis.txt").write_text("years of work")
    monkeypatch.setattr(fit_module, "fit", None)
    for out, says in (
        ("full", ["full exists and is not empty", "another --out"]),
        ("good.csv", ["good.csv exists", "another --out"]),
        ("good.csv/below", ["good.csv/below: cannot be written", "another --out"]),
        ("x" * 300, ["cannot be written (File name too long)"]),
    ):
        complains(monkeypatch, capsys, study, says, "fit", "spec.toml", "--out", out)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["fit"], ["Missing argument"]),
        (["fit", "nowhere.toml"], ["nowhere.toml: No such file", "TOML fit specification"]),
        (["fit", "."], ["Is a directory"]),
        (["fit", "spec.toml", "--outt", "x"], ["No such option"]),
        (["fitt"], ["No such command"]),
        (["check", "spec.toml", "--data", "nowhere"], ["data.files.0", "nowhere"]),
        (["fit", "spec.toml", "--leave-one-out"], ["--leave-one-out", "at least two curves"]),
    ],
)
def test_bad_arguments(arguments, says, study, monkeypatch, capsys):
    monkeypatch.setattr(fit_module, "fit", None)
    complains(monkeypatch, capsys, study, says, *arguments)


def test_leaving_out_needs_common_parameters(study, monkeypatch, capsys):
    (study / "good.csv").write_text(GOOD + GOOD.partition("\n")[2].replace("T01,1", "T01,2"))
    text = (study / "spec.toml").read_text() + '\n[parameters]\nk_1 = { scope = "trial" }'
    (study / "spec.toml").write_text(text)
    monkeypatch.setattr(fit_module, "fit", None)
    says = ["--leave-one-out", "k_1 belongs to single trials", "scope 'specimen'"]
    complains(monkeypatch, capsys, study, says, "fit", "spec.toml", "--leave-one-out")


@pytest.mark.parametrize("out", ["new", "a/b/new", "there"])
@pytest.mark.parametrize(
    ("error", "code"), [(KeyboardInterrupt(), 130), (RuntimeError("a bug"), None)]
)
def test_stopped_run_leaves_nothing(error, code, out, study, monkeypatch, capsys):
    def stop(*arguments):
        raise error

    (study / "there").mkdir()
    monkeypatch.chdir(study)
    monkeypatch.setattr("jaxtrachea.fitting.fit.fit", stop)
    before = tree(study)
    arguments = ("fit", "spec.toml", "--out", out)
    if code is None:
        with pytest.raises(RuntimeError, match="a bug"):
            run(monkeypatch, capsys, *arguments)
    else:
        assert run(monkeypatch, capsys, *arguments)[0] == code
    assert tree(study) == before


def jaxtrachea_command(*arguments, **kwargs):
    # A shell that starts the suite in the background lets it ignore interrupts.
    code = (
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "from jaxtrachea.cli.main import main; sys.exit(main())"
    )
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **kwargs,
    )


def test_interrupt_in_a_real_process(study):
    text = (study / "spec.toml").read_text()
    text += '\n[fit]\nmethod = "adam"\nmax_iterations = 1000000\ntolerance = 1e-300\n'
    (study / "spec.toml").write_text(text)
    before = tree(study)
    process = jaxtrachea_command("fit", "spec.toml", cwd=study)
    for _ in range(600):
        if (study / "out").exists() or process.poll() is not None:
            break
        time.sleep(0.05)
    assert process.poll() is None
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert "stopped; nothing was written" in err
    assert "Traceback" not in err
    assert tree(study) == before


@pytest.fixture
def ctrl_c(monkeypatch):
    """Lets one Ctrl-C come during a call of a function, before what it does or after."""

    def comes(owner, name, when):
        real = getattr(owner, name)

        def interrupted(*arguments, **options):
            monkeypatch.setattr(owner, name, real)
            if when == "before":
                signal.raise_signal(signal.SIGINT)
            result = real(*arguments, **options)
            if when == "after":
                signal.raise_signal(signal.SIGINT)
            return result

        monkeypatch.setattr(owner, name, interrupted)

    previous = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield comes
    signal.signal(signal.SIGINT, previous)


@pytest.mark.parametrize("out", [(), ("--out", "a/b/new"), ("--out", "there")])
@pytest.mark.parametrize("when", ["before", "after"])
@pytest.mark.parametrize(
    ("owner", "name"),
    [
        (run_folder, "new_directory"), (run_lock, "_sign"), (manifest, "write"),
        (run_folder, "stage"),
    ],
)  # fmt: skip
def test_interrupt_while_a_fit_makes_its_folders(
    owner, name, when, out, study, ctrl_c, monkeypatch, capsys
):
    (study / "there").mkdir()
    monkeypatch.chdir(study)
    monkeypatch.setattr("jaxtrachea.fitting.fit.fit", None)
    before = tree(study)
    ctrl_c(owner, name, when)
    code, _, err = run(monkeypatch, capsys, "fit", "spec.toml", *out)
    assert code == 130
    assert "stopped; nothing was written" in err
    assert tree(study) == before


def test_interrupt_while_the_files_of_a_fit_move(study, ctrl_c, monkeypatch, capsys):
    """The last ones are in place, the shards gone: it has ended, and says so."""
    monkeypatch.chdir(study)
    ctrl_c(run_folder, "commit", "after")
    code, _, err = run(monkeypatch, capsys, "fit", "spec.toml", "--out", "new")
    assert code in (0, 1)
    assert "nothing was written" not in err
    assert (study / "new" / "results.h5").is_file()


@pytest.mark.parametrize("when", ["before", "after"])
def test_interrupt_while_a_command_makes_its_folder(when, study, ctrl_c, monkeypatch):
    monkeypatch.chdir(study)
    before = tree(study)
    ctrl_c(output, "new_directory", when)
    with pytest.raises(KeyboardInterrupt), into(None, Path("out/a")):
        pytest.fail("went on after an interrupt")
    assert tree(study) == before


def test_interrupt_while_files_are_put_into_place(study, ctrl_c, monkeypatch):
    """All of them are there then: the command has ended."""
    monkeypatch.chdir(study)
    with into(None, Path("out/a")) as (folder, stop_if_asked):
        for name in "bc":
            (folder / name).write_text(name)
        ctrl_c(Path, "replace", "after")
    assert sorted(path.name for path in Path("out/a").iterdir()) == ["b", "c"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    with pytest.raises(KeyboardInterrupt):
        stop_if_asked()


def test_interrupt_that_was_swallowed(study, monkeypatch, capsys):
    """An exception raised in a callback of jax's garbage collector is printed and forgotten."""
    before = tree(study)

    class Dropped:
        def __del__(self):
            signal.raise_signal(signal.SIGINT)

    def fit(study, settings, progress):
        Dropped()
        progress(0, 1)
        pytest.fail("went on after an interrupt")

    monkeypatch.chdir(study)
    monkeypatch.setattr("jaxtrachea.fitting.fit.fit", fit)
    previous = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        code, _, err = run(monkeypatch, capsys, "fit", "spec.toml")
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, previous)
    assert code == 130
    assert "stopped; nothing was written" in err
    assert "Traceback" not in err
    assert tree(study) == before


def test_real_process_says_what_is_wrong(study):
    (study / "spec.toml").write_text(DATA + "[model]\nsheer = true")
    process = jaxtrachea_command("check", "spec.toml", cwd=study)
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (2, "")
    assert "spec.toml: model.sheer: unknown key" in err


def test_version_and_help(monkeypatch, capsys):
    code, out, _ = run(monkeypatch, capsys, "--version")
    assert (code, out.strip()) == (0, jaxtrachea.__version__)
    for arguments in ([], ["--help"], *([c, "--help"] for c in ("fit", "check", "init", "design"))):
        code, out, _ = run(monkeypatch, capsys, *arguments)
        assert code == 0
        assert "Usage: jaxtrachea" in out
        assert max(map(len, out.splitlines())) <= 80
        assert "..." not in out.partition("Commands")[2]


def test_help_lists_the_commands_in_the_order_of_use(monkeypatch, capsys):
    code, out, _ = run(monkeypatch, capsys, "--help")
    assert code == 0
    lines = out.partition("Commands:\n")[2].rstrip().splitlines()
    assert [line.split()[0] for line in lines] == [
        "demo", "check", "init", "fit", "predict", "design", "compare", "convert", "plan",
        "simulate", "sweep", "view", "play", "tradeoff", "selfcheck", "cache",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("command", "path", "says"),
    [
        ("check", "configs/normal.toml", "it is a scene (commands plan, simulate, sweep)"),
        ("plan", "fits/ecoflex/fit.toml", "it is a fit specification (commands check, fit,"),
    ],
)
def test_a_scene_is_not_taken_for_a_specification(command, path, says, monkeypatch, capsys):
    root = Path(__file__).parents[1]
    code, _, err = run(monkeypatch, capsys, command, str(root / path))
    assert code == 2
    assert says in err
    assert len(err.splitlines()) == 1


def test_help_is_quick_and_loads_nothing_heavy():
    """Bar: 1 s of processor time, measured 0.5 s; jax, h5py and matplotlib would take 2 s more."""
    code = (
        "import sys, jaxtrachea.cli.main\n"
        "heavy = ('h5py', 'matplotlib', 'pydantic', 'optax', 'scipy')\n"
        "print([m for m in heavy if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
    used = []
    for _ in range(3):
        before = os.times()
        process = jaxtrachea_command("--help")
        out, _ = process.communicate(timeout=60)
        after = os.times()
        assert process.returncode == 0
        assert "check" in out
        used.append(
            after.children_user
            + after.children_system
            - before.children_user
            - before.children_system
        )
    assert min(used) < 1.0


def test_check_reads_and_reports(study, monkeypatch, capsys):
    monkeypatch.chdir(study)
    before = tree(study)
    code, out, err = run(monkeypatch, capsys, "check", "spec.toml")
    assert (code, err) == (0, "")
    assert max(map(len, out.splitlines())) <= 80
    for words in ("1 usable curves", "T01", "[mm]", "0 … 1.5", "0 … 1.08", "k_1 [N/mm]", "scope"):
        assert words in out
    assert tree(study) == before


def test_commands_say_names_that_look_alike(study, monkeypatch, capsys):
    (study / "good.csv").write_text(GOOD + GOOD.partition("\n")[2].replace("T01", "t01"))
    code, _, err = run(monkeypatch, capsys, "check", study / "spec.toml")
    assert code == 0
    assert "note: specimens 'T01' (1 curve, first" in err
    assert "differ by case alone" in err
    # `fit` says it before it looks for the run to go on with, of which there is none.
    there = ("--resume", "--out", study / "none")
    code, _, err = run(monkeypatch, capsys, "fit", study / "spec.toml", *there)
    assert code == 2
    assert "differ by case alone" in err


def test_a_file_whose_name_looks_alike_is_named(study, monkeypatch, capsys):
    (study / "good.csv").rename(study / "Good.csv")
    if (study / "good.csv").exists():
        pytest.skip("this file system does not tell the two apart")
    code, _, err = run(monkeypatch, capsys, "check", study / "spec.toml")
    assert code == 2
    assert "'good.csv' matches" in err
    assert "'Good.csv', which looks alike, is there; write its name so" in err


def test_check_says_which_sheet(study, monkeypatch, capsys):
    openpyxl = pytest.importorskip("openpyxl", reason="openpyxl (extra 'xlsx') is not installed")
    book = openpyxl.Workbook()
    book.active.title = "Data"
    for line in GOOD.splitlines():
        cells = line.split(",")
        numbers = line[0] == "T"
        book.active.append([*cells[:2], *(map(float, cells[2:]) if numbers else cells[2:])])
    book.create_sheet("Notes")
    book.save(study / "good.xlsx")
    (study / "spec.toml").write_text('[data]\nfiles = "good.xlsx"\nsheet = "Data"\n')
    code, out, err = run(monkeypatch, capsys, "check", study / "spec.toml")
    assert code == 0
    assert "1 usable curves" in out
    assert "sheet 'Data' was read, not 'Notes'; data.sheet chooses another" in err


def test_hostile_hdf5_costs_its_own_row(study, monkeypatch, capsys):
    with h5py.File(study / "evil.h5", "w") as file:
        file.attrs["schema"], file.attrs["schema_version"] = "jaxtrachea-measurements", 2
        file["curves"] = h5py.ExternalLink("/etc/passwd", "/")
    (study / "spec.toml").write_text('[data]\nfiles = ["good.csv", "evil.h5"]')
    code, out, err = run(monkeypatch, capsys, "check", study / "spec.toml")
    assert code == 1
    assert "not usable: evil (all): unreadable" in err
    assert "evil.h5" in err
    assert "1 bad curves" in out


@pytest.mark.slow
@pytest.mark.compiling
def test_a_second_start_compiles_nothing(tmp_path):
    """Programs are kept in the user's cache; the second start adds none, with the same numbers."""
    scene = tmp_path / "scene.toml"
    scene.write_text((ROOT / "configs" / "no_surface.toml").read_text())
    kept = {"JAX_ENABLE_COMPILATION_CACHE": "true", "XDG_CACHE_HOME": str(tmp_path / "cache")}
    kept |= {"LOCALAPPDATA": str(tmp_path / "cache")}
    found = []
    for name in ("first", "second"):
        process = jaxtrachea_command(
            "simulate", scene, "--out", name, cwd=tmp_path, env=os.environ | kept
        )
        assert process.communicate()[1] == ""
        assert process.returncode == 0
        with h5py.File(tmp_path / name / "simulation.h5") as file:
            numbers = {k: v[()].tobytes() for k, v in file["series"].items()}
        programs = {p.name for p in (tmp_path / "cache" / "jaxtrachea").iterdir()}
        found.append((numbers, programs))
    assert found[0] == found[1]
    assert any("simulate" in name for name in found[0][1])
