"""What the pages show is run, and what they name exists. The README's own: `test_readme.py`."""

import enum
import importlib
import importlib.util
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
import typer
from run_cli import run

import jaxtrachea
from jaxtrachea import config, status
from jaxtrachea.cli.main import app
from jaxtrachea.config import FitSpec
from jaxtrachea.fitting import verdict
from jaxtrachea.scene import spec, spec_parts
from jaxtrachea.scene.spec import SceneSpec
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.section import geometry_of

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
#: What a user reads, in this order.
PATH = ["install", "fit", "read_a_fit", "after_a_fit", "simulate", "view", "layer", "haptics"]
#: Commands that are shown without a placeholder, and the test that runs each.
RUN_BY = {
    "--version": "test_cli.py",
    "init my.csv": "test_init.py",
    "fit fit.toml": "test_init.py",
    "check my.csv": "test_init.py",
    "check fits/virtual_trachea/fit.toml": "test_docs.py",
    "fit fits/virtual_trachea/fit.toml": "test_fits.py",
    "fit fits/virtual_trachea/off_midline.toml": "test_off_midline.py",
    "fit fits/virtual_trachea/fit.toml --out out/virtual": "test_docs.py",
    "predict out/virtual --at s=75,D=0:0.1:0.02 --at 's=3.1 cm,D=100 um'": "test_docs.py",
    "predict out/virtual --data fits/virtual_trachea/fit.toml": "test_docs.py",
    "compare euler.toml shear.toml two_material.toml": "test_criteria.py",
    "plan configs/friction.toml": "test_configs.py",
    "simulate configs/friction.toml": "test_configs.py",
    "sweep configs/scan.toml": "test_configs.py",
}
#: What a block of Python finds there, by page and number of the block.
BEFORE = {
    ("measurements", 0): """
import pathlib
pathlib.Path("study.csv").write_text(
    "specimen,trial,s [mm],displacement [mm],force [N]\\nT01,1,35,0,0\\nT01,1,35,0.5,0.3\\n"
    "T01,1,35,1,0.8\\n"
)
""",
    ("contact", 0): """
import jax.numpy as jnp
from jaxtrachea.contact.pose import pose_from_vector
rotation, translation = jnp.zeros(3), jnp.array([0.0, 0.0, 3.0])
next_pose = pose_from_vector(rotation, translation + 0.01)
""",
    ("contact", 1): """
import jax.numpy as jnp, numpy as np
from jaxtrachea import table_1
from jaxtrachea.contact.pose import pose_from_vector
from jaxtrachea.contact.shapes import sphere
from jaxtrachea.trachea.tube import make_tube
mesh = make_tube(table_1(), around=12, along=40)
vertices, faces, s = mesh.vertices, mesh.faces, mesh.s
borders = np.linspace(0.0, 160.0, 17)
centres = np.stack([s, 0 * s, 0 * s], axis=1)
frames = np.tile(np.eye(3), (len(s), 1, 1))
tool, pose = sphere(2.0), pose_from_vector(jnp.zeros(3), jnp.array([75.0, 15.0, 0.0]))
""",
}
#: Printed after each block of Python.
END = "-- end of a block --"
#: Blocks that other tests run.
ELSEWHERE = {("README", 0): "test_readme.py", ("after_a_fit", 0): "test_docs.py"}


def blocks(page, language):
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(), re.S)


#: Pages with Python that no other test runs.
WITH_PYTHON = [page for page in PAGES[1:] if blocks(page, "python")]


def code_spans():
    """Every `word` of every page."""
    for page in PAGES:
        text = re.sub(r"```.*?```", "", page.read_text(), flags=re.S)
        for span in re.findall(r"(?<!`)`([^`\n]+)`(?!`)", text):
            yield page.name, span


def test_each_page_is_listed_once_and_says_who_needs_it():
    listed = re.findall(r"\]\(docs/(\w+)\.md\)", (ROOT / "README.md").read_text().split("\n## ")[2])
    assert listed[: len(PATH)] == PATH
    pages = {page.stem for page in DOCS.glob("*.md")} - {"index"}  # of the site; here the README
    assert sorted(listed) == sorted(pages)
    site = re.findall(r'= "(\w+)\.md"', (ROOT / "zensical.toml").read_text())
    assert sorted(site) == sorted(pages | {"index"})
    pages = (DOCS / "evidence.md").read_text().partition("## The pages")[2]
    listed = re.findall(r"\]\(evidence/(\w+)\.md\)", pages)
    assert sorted(listed) == sorted(page.stem for page in (DOCS / "evidence").glob("*.md"))
    for page in PAGES[1:]:
        lines = page.read_text().splitlines()
        assert lines[0].startswith("# "), page
        assert re.match(r"\*For .*", lines[2]), page


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if target.startswith("https://"):
            continue
        path, _, anchor = target.partition("#")
        file = page.parent / path if path else page
        assert file.exists(), target
        if anchor:
            heads = re.findall(r"^#+ (.*)$", file.read_text(), re.M)
            slugs = [re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads]
            assert anchor in slugs, target


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize("page", WITH_PYTHON, ids=lambda p: p.stem)
def test_python_runs(page, tmp_path):
    """All blocks of a page in one process, each as if by itself."""
    code = {
        (page.stem, i): BEFORE.get((page.stem, i), "") + text
        for i, text in enumerate(blocks(page, "python"))
        if (page.stem, i) not in ELSEWHERE
    }
    (tmp_path / "fits").symlink_to(ROOT / "fits")
    each = (
        f"import jax\nfor code in {list(code.values())!r}:\n"
        "    jax.config.update('jax_enable_x64', False)\n"
        f"    exec(code, {{}})\n    print({END!r})"
    )
    done = subprocess.run(
        [sys.executable, "-c", each], capture_output=True, text=True, cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    for key, out in zip(code, done.stdout.split(f"{END}\n"), strict=False):
        if key in FINDS:
            FINDS[key](out)


def _press(out):
    """In series the skeleton alone, and the local law alone, would both be pressed harder."""
    force, compliance = map(float, re.match(r"(\S+) N, (\S+) mm/N", out).groups())
    assert 0 < force < 6.0 / compliance
    assert force < 20.0 * 6 + 0.5 * 6**3


def _at_three_places(out):
    """All are solved, and none is stiffer than the local law alone."""
    rows = re.findall(r"^(\S+) \[([^\]]*)\]$", out, re.M)
    assert [s for s, _ in rows] == ["40.0", "75.0", "110.0"]
    for _, text in rows:
        force = np.array(text.split(), float)
        assert (np.diff(force, prepend=0) > 0).all()
        assert force[-1] < 20.0 * 6 + 0.5 * 6**3


def _trained(out):
    """The weights that made the observed forces."""
    k_m, slope = map(float, re.match(r"(\S+) N/mm at 50 years, slope (\S+)", out).groups())
    assert k_m == pytest.approx(0.2, rel=1e-3)
    assert slope == pytest.approx(-0.4, rel=1e-3)


def _read(out):
    assert out.splitlines() == ["T01 1 35.0 3"]


def _stiffer(out):
    assert float(out) > 0  # a stiffer muscle: the wall stays higher


def _sensitivity(out):
    assert out.strip() == "(5, 10, 3)"  # unknowns, presses, samples of small_strain.h5


#: What a block must have printed.
def _at_rest(out):
    """The damping is that of a soft wall, and the wall carries what the hand pushes with."""
    damping = float(re.search(r"least damping (\S+) N s/m", out)[1])
    force = float(re.search(r"at rest: (\S+) N", out)[1])
    assert 0.01 < damping < 0.5
    assert force == pytest.approx(-0.3, rel=0.02)


def _learned(out):
    before, after = map(float, re.search(r"miss (\S+) to (\S+) N", out).groups())
    assert after < before / 4


def _one_is_lifted(out):
    """The middle tool has no force at 1 mm (LIFTED), and one at 4 mm."""
    numbers = [float(v) for v in re.findall(r"-?[0-9.]+(?:e-?[0-9]+)?", out)]
    assert numbers[5] == 0 < numbers[8]
    assert [int(v) for v in numbers[9:18]] == [0, 0, 1, 0, 0, 16, 0, 0, 0]


def _streamed(out):
    """Six presses, and estimates within 20 % of the specimen."""
    found = re.findall(r"^(\w+) ([0-9.]+) (\w+)$", out, re.M)
    truth = {"EI_L": 300.0, "k_M": 1.0, "k_1": 0.5, "k_3": 0.2}
    assert len(re.findall(r"^\d+ mm:", out, re.M)) == 6
    assert {name: pytest.approx(float(value), rel=0.2) for name, value, _ in found} == truth
    # Three positions and their mirror images: other skeletons may fit as well.
    assert {word for *_, word in found} <= {"inconclusive", "identifiable"}


FINDS = {
    ("after_a_fit", 1): _streamed,
    ("haptics", 1): _at_rest,
    ("haptics", 2): _learned,
    ("layer", 0): _press,
    ("layer", 1): _one_is_lifted,
    ("layer", 2): _at_three_places,
    ("layer", 3): _trained,
    ("layer", 4): _stiffer,
    ("layer", 6): _sensitivity,
    ("measurements", 0): _read,
}


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_tables_of_toml_are_valid(page):
    for text in blocks(page, "toml"):
        content = tomllib.loads(text)
        if "data" in content:
            read = FitSpec.model_validate(content)
            assert geometry_of(read.trachea).rings == 16
            assert read.parameters["EI_L"].scope == "shared"
        else:
            SceneSpec.model_validate(content)


def commands():
    """Every command of the pages, split into words: lines of their own, and in sentences."""
    for page in PAGES:
        text = page.read_text()
        lines = re.findall(r"^    (?:.*&& )?(?:\.venv/bin/)?jaxtrachea (\S.*)$", text, re.M)
        lines += [span[11:] for name, span in code_spans() if name == page.name
                  and span.startswith("jaxtrachea ")]  # fmt: skip
        for line in lines:
            yield page.name, shlex.split(line, comments=True)


def known_options():
    group = typer.main.get_command(app)
    names = {"": {"--help"}.union(*(option.opts for option in group.params))}
    for name, command in group.commands.items():
        names[name] = {"--help"}.union(
            *((*option.opts, *option.secondary_opts) for option in command.params)
        )
    return names


def test_commands_and_options_exist():
    known = known_options()
    for page, words in commands():
        name = words[0] if words[0] in known else ""
        assert name or words[0].startswith("--"), (page, words)
        for word in words:
            if word.startswith("--"):
                assert word in known[name], (page, words)
            elif "/" in word and not word.startswith("out/") and not word.isupper():
                assert (ROOT / word).exists(), (page, words)
    every = set().union(*known.values())
    for page, span in code_spans():
        if re.fullmatch(r"--[a-z][a-z-]*( .*)?", span) and page not in NOT_OURS:
            assert span.split()[0] in every, (page, span)


#: Pages that name what other programs know.
NOT_OURS = {"benchmarks.md", "developing.md"}


def test_commands_without_placeholder_are_run_by_a_test():
    for page, words in commands():
        if any(re.fullmatch(r"[A-Z:]+|\.\.\.", word) for word in words) or len(words) < 2:
            continue
        if words[0] in ("selfcheck",):
            continue  # test_selfcheck.py
        assert shlex.join(words) in RUN_BY, (page, shlex.join(words))
    assert {(Path(__file__).parent / name).exists() for name in RUN_BY.values()} == {True}


def test_check_of_the_page_runs(monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    code, out, _ = run(monkeypatch, capsys, "check", "fits/virtual_trachea/fit.toml")
    assert code == 0
    assert "10 usable curves" in out


@pytest.mark.slow
@pytest.mark.compiling
def test_page_on_predictions_runs(tmp_path):
    """Its three commands, then its Python: a folder of results and what it predicts."""
    (tmp_path / "fits").symlink_to(ROOT / "fits")
    section = (DOCS / "after_a_fit.md").read_text().split("\n## ")[1]
    lines = re.findall(r"^    jaxtrachea (.*)$", section, re.M)
    code = "import jaxtrachea\n" + blocks(DOCS / "after_a_fit.md", "python")[0]
    calls = [["-m", "jaxtrachea", *shlex.split(line)] for line in lines]
    for call in [*calls, ["-c", code]]:
        done = subprocess.run([sys.executable, *call], capture_output=True, text=True, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
    assert len(calls) == 3


def test_paths_exist():
    for page, span in code_spans():
        if re.match(r"(?:tests|configs|fits|docs|jaxtrachea|\.ci)/[\w.*/-]+$", span):
            assert list(ROOT.glob(span)), (page, span)


def test_keys_of_specifications_exist():
    for page, span in code_spans():
        found = re.match(r"\[(\w+)\] (\w+)", span)
        if found is None:
            continue
        kinds = [kind.model_fields for kind in (FitSpec, SceneSpec)]
        owners = [fields[found[1]] for fields in kinds if found[1] in fields]
        assert owners, (page, span)
        assert any(re.search(rf"\b{found[2]}\b", keys(field)) for field in owners), (page, span)


def keys(field):
    """The keys of all models in the annotation of a field."""
    kinds = [field.annotation, *getattr(field.annotation, "__args__", ())]
    return " ".join(" ".join(getattr(kind, "model_fields", ())) for kind in kinds)


FILES = r"\.(md|py|toml|csv|h5|png|html|jsonl?|in)$"


def test_names_of_the_package_exist():
    rooms = {path.stem for path in Path(jaxtrachea.__file__).parent.glob("*") if path.is_dir()}
    for page, span in code_spans():
        found = re.match(r"(?:jaxtrachea\.)?((\w+)(?:\.\w+)+)(?:\(.*\))?$", span)
        if found and found[2] in rooms and not re.search(FILES, span):
            assert resolve(f"jaxtrachea.{found[1]}"), (page, span)


def resolve(name):
    """Whether a dotted name is a module, or stands in one, or in a class of one."""
    parts = name.split(".")
    for i in range(len(parts), 0, -1):
        try:
            value = importlib.import_module(".".join(parts[:i]))
        except ImportError:
            continue
        for part in parts[i:]:
            if not hasattr(value, part):
                return False
            value = getattr(value, part)
        return True
    return False


def test_statuses_exist():
    members = {
        name
        for kind in vars(status).values()
        if isinstance(kind, type) and issubclass(kind, enum.Enum)
        for name in kind.__members__
    }
    for page, span in code_spans():
        if re.fullmatch(r"[A-Z]{2,}_[A-Z_]{3,}", span) and page not in NOT_OURS:
            assert span in members, (page, span)
    scenes = (DOCS / "simulate.md").read_text()
    listed = re.findall(r"^\| `([A-Z_]+)` \|", scenes, re.M)
    assert sorted(listed) == sorted(PressStatus.__members__)


def test_verdicts_of_the_page_are_those_of_a_fit():
    section = (DOCS / "read_a_fit.md").read_text().split("\n## ")[3]
    listed = re.findall(r"^\| `([a-z: -]+)` \|", section, re.M)
    assert listed == [*verdict.VERDICTS, "failed"]  # the last: there is no estimate


def test_the_reference_is_what_its_script_writes():
    """Every key of a specification with its type, default and meaning; every parameter."""
    loader = importlib.util.spec_from_file_location("reference", DOCS / "reference.py")
    assert loader is not None
    assert loader.loader is not None
    script = importlib.util.module_from_spec(loader)
    loader.loader.exec_module(script)
    page = script.PAGE.read_text("utf-8")
    assert page == script.document(), "run python docs/reference.py"
    listed = {model.__name__ for _, _, model in script.TABLES}
    shown = set(re.findall(r"^class (\w+Section|\w+Spec|EvenRings)\(", SOURCES, re.M))
    declared = {"MaterialSection", "SectionsSection", "EffectsSection"}  # lists of their own
    assert shown - listed == declared
    for model in (FitSpec, SceneSpec):
        for name in model.model_fields:
            assert f"[{name}" in page or name in ("title", "material", "sections"), name
    effects = page.partition("## Scene: [effects]")[2].partition("\n## ")[0]
    assert re.findall(r"^\| `(\w+)` \|", effects, re.M) == list(spec.EffectsSection.model_fields)


SOURCES = "\n".join(Path(kind.__file__ or "").read_text() for kind in (config, spec, spec_parts))


def test_pages_that_messages_name_exist():
    """Every page or picture of `docs` that the package, shipped files or tests name."""
    folders = [ROOT / name for name in ("jaxtrachea", "fits", "configs", "tests")]
    files = [p for folder in folders for p in folder.rglob("*") if p.suffix in TEXT]
    found = [(p, m) for p in files for m in re.findall(r"\bdocs/[\w/.]+\w", p.read_text("utf-8"))]
    assert len(found) > 80
    assert [(str(p), name) for p, name in found if not (ROOT / name).exists()] == []


#: Files that name pages.
TEXT = {".py", ".toml", ".md", ".in"}


def test_the_changelog_is_a_list_of_short_lines():
    """The newest version is the package's, and each change one line under a heading."""
    newest, *older = (ROOT / "CHANGELOG.md").read_text("utf-8").split("\n## ")[1:]
    assert newest.startswith(f"{jaxtrachea.__version__} (")
    headings = re.findall("^### (.*)", newest, re.M)
    assert headings == [h for h in ("Added", "Changed", "Fixed") if h in headings]
    for part in (newest, *older):
        assert not re.search(r"^- .*\n\n+- ", part, re.M), "a blank line within a list"
        lines = [line for line in part.splitlines()[1:] if line and not line.startswith("### ")]
        assert all(line.startswith("- ") and len(line) <= 160 for line in lines)


def test_extras_are_listed():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    listed = re.findall(r"^\| `(\w+)` \|", (DOCS / "install.md").read_text(), re.M)
    assert sorted(listed) == sorted(project["optional-dependencies"])
