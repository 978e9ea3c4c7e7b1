"""Data goes one way: a module imports only from rooms above it, and importing costs nothing."""

import ast
import pathlib
import subprocess
import sys

import pytest

import jaxtrachea

PACKAGE = pathlib.Path(jaxtrachea.__file__).parent
ORDER = [
    {"units", "status", "_numerics", "_arguments", "webpage", "spreadsheet", "pictures"},
    {"spec_file"},
    {"config"},
    {"trachea"},
    {"admission"},
    {"contact"},
    {"mechanics"},
    {"skeleton"},
    {"surface"},
    {"model"},
    {"oblique"},
    {"identify"},
    {"scene"},
    {"selfcheck"},
    {"doubts"},
    {"report"},
    {"prediction_report"},
    {"plots", "sections", "viewer", "study"},
    {"tradeoff", "overview", "prediction_plots"},
    {"terminal_table"},
    {"terminal", "processes"},
    {"cli_load", "cli_predict_data", "cli_run"},
    {"cli_scene", "cli_compare", "cli_fit", "cli_predict", "cli_selfcheck", "cli_tradeoff"},
    {"cli"},
    {"__main__"},
]
#: Within `scene`, likewise: what is there, the program, files and pictures.
SCENE = [
    {"operations", "spec", "curve", "sizes", "wall_check"},
    {"plan"},
    {"rules"},
    {"stage"},
    {"ranges"},
    {"approach", "trail"},
    {"deform"},
    {"simulation"},
    {"seat"},
    {"session"},
    {"build", "results"},
    {"plots"},
]
#: Rooms that only read or write: they may be told of, but not tell, the physics.
HEAVY = ["matplotlib", "trimesh", "typer", "rich", "pydantic", "h5py"]
MODULES = sorted(p for p in PACKAGE.rglob("*.py") if p != PACKAGE / "__init__.py")


def level(room, order):
    found = [i for i, rooms in enumerate(order) if room in rooms]
    assert found, f"room {room!r} is not in the order of tests/test_layering.py"
    return found[0]


def imported(source, package):
    """Dotted names of everything that `source` imports, wherever it stands."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            stem = [*base, *(node.module.split(".") if node.module else [])]
            names = [".".join([*stem, alias.name]) for alias in node.names]
        else:
            continue
        yield from names


def faults(room, source, package=("jaxtrachea",), order=ORDER, within="jaxtrachea"):
    """Rooms of `within` that `room` may not import."""
    stem = within.split(".")
    names = [name.split(".") for name in imported(source, list(package))]
    below = {n[len(stem)] for n in names if n[: len(stem)] == stem and len(n) > len(stem)}
    mine = level(room, order)
    return sorted(r for r in below - {room, "__version__"} if level(r, order) >= mine)


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_only_from_above(path):
    inside = path.relative_to(PACKAGE).with_suffix("").parts
    package, source = ("jaxtrachea", *inside[:-1]), path.read_text()
    assert not faults(inside[0], source, package)
    if inside[0] == "scene" and inside[1] != "__init__":
        assert not faults(inside[1], source, package, SCENE, "jaxtrachea.scene")


@pytest.mark.parametrize(
    ("room", "source"),
    [
        ("mechanics", "from jaxtrachea.mechanics.press import press"),
        ("trachea", "def f():\n    import jaxtrachea.mechanics.beam as b"),
        ("model", "from jaxtrachea import identify"),
        ("surface", "from jaxtrachea.mechanics.press import press"),
        ("identify", "from jaxtrachea.scene.stage import Scene"),
        ("trachea", "from jaxtrachea.surface.regions import bind"),
        ("mechanics", "from jaxtrachea.surface import local"),
        ("_numerics", "from .trachea import geometry"),
    ],
)
def test_the_walk_sees_a_fault(room, source):
    assert faults(room, source)


def test_the_walk_sees_a_fault_within_the_scene():
    source = "from jaxtrachea.scene import simulation"
    assert faults("plan", source, order=SCENE, within="jaxtrachea.scene") == ["simulation"]
    assert not faults("plots", source, order=SCENE, within="jaxtrachea.scene")


def test_import_is_light():
    """Plots, meshes, the command line and file formats are loaded by those who use them."""
    code = (
        "import sys, jaxtrachea, jaxtrachea.mechanics.press, jaxtrachea.scene.simulation\n"
        "import jaxtrachea.surface.local, jaxtrachea.surface.regions, jaxtrachea.trachea.imported\n"
        f"print([m for m in {HEAVY!r} if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
