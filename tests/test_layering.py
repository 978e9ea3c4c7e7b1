"""Data goes one way: a module imports only from rooms above it, and importing costs nothing."""

import ast
import pathlib
import subprocess
import sys

import pytest

import jaxtrachea

PACKAGE = pathlib.Path(jaxtrachea.__file__).parent
ORDER = [
    {"units", "status", "_numerics"},
    {"config"},
    {"config_scene"},
    {"trachea"},
    {"contact"},
    {"mechanics"},
    {"skeleton"},
    {"surface"},
    {"model"},
    {"oblique"},
    {"operations", "scene"},
    {"stage"},
    {"simulation"},
    {"identify"},
    {"scene_study", "scene_results"},
    {"report"},
    {"plots", "viewer", "study", "scene_plots"},
    {"terminal"},
    {"cli_scene"},
    {"cli"},
    {"__main__"},
]
#: Rooms that only read or write: they may be told of, but not tell, the physics.
HEAVY = ["matplotlib", "trimesh", "typer", "rich", "pydantic", "h5py"]
MODULES = sorted(p for p in PACKAGE.rglob("*.py") if p != PACKAGE / "__init__.py")


def level(room):
    found = [i for i, rooms in enumerate(ORDER) if room in rooms]
    assert found, f"room {room!r} is not in the order of tests/test_layering.py"
    return found[0]


def imported_rooms(source, package):
    """First names below jaxtrachea of everything that `source` imports, wherever it stands."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            stem = [*base, *(node.module.split(".") if node.module else [])]
            names = [".".join([*stem, alias.name]) for alias in node.names]
        else:
            continue
        yield from (n.split(".")[1] for n in names if n.startswith("jaxtrachea."))


def faults(room, source, package=("jaxtrachea",)):
    below = {r for r in imported_rooms(source, list(package)) if r != "__version__"}
    return sorted(r for r in below - {room} if level(r) >= level(room))


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_only_from_above(path):
    inside = path.relative_to(PACKAGE).with_suffix("").parts
    assert not faults(inside[0], path.read_text(), ("jaxtrachea", *inside[:-1]))


@pytest.mark.parametrize(
    ("room", "source"),
    [
        ("mechanics", "from jaxtrachea.model import press"),
        ("trachea", "def f():\n    import jaxtrachea.mechanics.beam as b"),
        ("model", "from jaxtrachea import identify"),
        ("surface", "from jaxtrachea.model import press"),
        ("scene", "from jaxtrachea.stage import Scene"),
        ("stage", "from jaxtrachea import simulation"),
        ("simulation", "from jaxtrachea.scene_study import stage"),
        ("trachea", "from jaxtrachea.surface.regions import bind"),
        ("mechanics", "from jaxtrachea.surface import local"),
        ("_numerics", "from .trachea import geometry"),
    ],
)
def test_the_walk_sees_a_fault(room, source):
    assert faults(room, source)


def test_import_is_light():
    """Plots, meshes, the command line and file formats are loaded by those who use them."""
    code = (
        "import sys, jaxtrachea, jaxtrachea.model, jaxtrachea.simulation, jaxtrachea.stage\n"
        "import jaxtrachea.surface.local, jaxtrachea.surface.regions, jaxtrachea.trachea.imported\n"
        f"print([m for m in {HEAVY!r} if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
