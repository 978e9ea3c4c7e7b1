"""Data goes one way: a module imports only from rooms above it, and importing costs nothing."""

import ast
import functools
import pathlib
import subprocess
import sys

import pytest

import jaxtrachea

PACKAGE = pathlib.Path(jaxtrachea.__file__).parent
#: Rooms from the bottom up; `fit` and `scene` are neighbours, neither knows the other.
ORDER = [
    {"_errors", "_linear", "_compiler", "_threads", "_memory"},
    {"units", "status", "_numerics", "_arguments", "_packed"},
    {"_written_out"},
    {"fusion"},
    {"files"},
    {"optimisation"},
    {"relaxation"},
    {"config"},
    {"trachea"},
    {"contact"},
    {"mechanics"},
    {"surface", "measurements"},
    {"trials"},
    {"fitting", "scene", "selfcheck"},
    {"inference"},
    {"results", "output"},
    {"prediction", "runs"},
    {"report"},
    {"tradeoff", "viewer", "notebook"},
    {"cli"},
    {"__main__"},
]
#: Neighbours that stand on different levels.
STRANGERS = [("output", {"fitting", "inference"}),
             ("scene", {"fitting", "inference", "results", "prediction", "runs"}),
             ("inference", {"scene"}), ("results", {"scene"}), ("prediction", {"scene", "runs"}),
             ("runs", {"scene"}),
             ("viewer", {"mechanics", "fitting", "inference", "results"}),
             ("measurements", {"contact", "mechanics", "trachea"}),
             ("inference/analyses", {"results", "report", "scene"})]  # fmt: skip
#: Modules within the larger rooms, from the bottom up.
WITHIN = {
    "scene": [
        {"curve", "sizes", "declare", "needs"},
        {"wall_check"},
        {"depth", "width"},
        {"wall", "effects"},
        {"plan", "spec_parts"},
        {"spec"},
        {"rules", "stage", "tool_file"},
        {"landing", "lumen", "ranges", "trail", "paths", "instruments"},
        {"approach"},
        {"facts", "refusals", "deform", "programs", "overlap"},
        {"configurational", "dents", "lines", "anchor"},
        {"in_time", "grip", "rows"},
        {"rub", "memory"},
        {"hold"},
        {"rub_together"},
        {"together"},
        {"deform_together"},
        {"assemble", "simulation", "sweep"},
        {"held_force", "one_row"},
        {"step_together"},
        {"step"},
        {"session"},
        {"build"},
    ],
    "output": [
        {"results", "solids"},
        {"plots", "read"},
        {"surface_plot", "recording"},
        {"gltf", "vtk_files"},
    ],
    "measurements": [
        {"presses", "turning", "plausible", "first_touch", "observed", "press_shape"},
        {"roles"},
        {"holds", "record_zeros"},
        {"parts"},
        {"segments"},
        {"returns"},
        {"record_faults"},
        {"usage"},
        {"curve"},
        {"whole_record"},
        {"loading", "names", "vectors", "columns", "tidy_writer", "file_names", "machine"},
        {"checks"},
        {"batch_checks"},
        {"readers"},
        {"heads", "hdf5_writer"},
        {"read"},
        {"data_files", "guess", "usage_tables"},
    ],
    "relaxation": [{"steps", "words"}, {"filter"}, {"laws"}],
    "mechanics/levels": [{"level", "options"}, {"line", "sections", "relaxing"}, {"choose"}],
    "mechanics/sections": [
        {"section", "block", "material"},
        {"section_tangent", "span"},
        {"contact"},
        {"system", "wall"},
        {"solve"},
        {"press"},
    ],
    "fitting": [
        {"parameters", "lane", "delta_method"},
        {"model", "curve_noise"},
        {"lanes", "refusals", "relaxing"},
        {"onset", "zeros"},
        {"study"},
        {"build", "map_lanes", "zero_messages", "press_scale", "forward_residual"},
        {"residual"},
        {"cost"},
        {"descent", "starts"},
        {"information", "predictions", "shared", "structure"},
        {"covariance", "noise", "stream"},
        {"criteria", "misfit", "settings", "verdict"},
        {"rounding", "glitches"},
        {"effective", "few_samples", "branch_times"},
        {"assessment"},
        {"result"},
        {"fitted_errors", "minima", "other_starts", "profile_search"},
        {"needs_review", "evaluate", "force_share"},
        {"verify", "omitted_zeros", "gauss_newton"},
        {"hidden_air"},
        {"fit"},
    ],
    "optimisation": [{"batching", "curvature", "programs", "schur"}, {"trust_region"},
                     {"levenberg_marquardt"}],
    "inference": [
        {"rows", "residuals", "chains", "holdout_groups", "weakest_direction", "estimate",
         "random_effects"},
        {"cross_validation", "bootstrap", "profile", "posterior_start"},
        {"labels", "population", "repeats", "relaxation_curves"},
        {"analysis", "comparison"},
        {"design", "influence", "posterior"},
        {"posterior_file", "online_model"},
        {"online"},
        {"analyses"},
    ],
    "inference/design": [{"press", "candidates"}, {"situation"}, {"choice"}, {"identifiability"}],
    "results": [{"arrays", "store"}, {"rows", "hdf5"}, {"read"}],
    "trials": [{"polynomials", "uneven_noise"}, {"differences"}, {"repeats"}],
    "prediction": [{"core", "pressed"}, {"model_error", "sources"}, {"profile"}, {"curves"},
                   {"predict"},
                   {"held_out"},
                   {"plots", "tables"}, {"report"}],
    "runs": [{"manifest"}, {"shards"}, {"folder"}, {"rerun", "checkpoint"}, {"cluster"}],
    "tradeoff": [
        {"calls", "errors", "levels", "load", "operations", "table"},
        {"ladders", "parts", "cost", "shares"},
        {"timing", "trial"},
        {"choice"},
        {"measure"},
    ],
    "viewer": [{"frame", "scene", "values", "worker"}, {"protocol", "stream"}, {"live", "play"},
               {"server"}, {"serve"}, {"page", "stream_page"}],
    "report": [{"captions", "small_multiples", "tables", "understood"}, {"shown"}, {"fit_pictures"},
               {"explorer", "plots"}, {"fit"}, {"overview"}],
    "cli": [{"terminal_table", "specification", "options", "beside"}, {"terminal"},
            {"file_options", "fit", "load", "predict_data", "run", "scene", "selfcheck"},
            {"sources"}, {"written_spec"},
            {"compare", "cache", "convert", "demo", "init", "predict", "tradeoff", "view"},
            {"main"}],
}  # fmt: skip
#: Rooms that only read or write: they may be told of, but not tell, the physics.
HEAVY = ["matplotlib", "trimesh", "typer", "rich", "pydantic", "h5py"]
#: Arguments that a function takes at most: more want a record that has a name of its own.
MOST_ARGUMENTS = 8
MODULES = sorted(p for p in PACKAGE.rglob("*.py") if p != PACKAGE / "__init__.py")


def level(room, order):
    found = [i for i, rooms in enumerate(order) if room in rooms]
    assert found, f"room {room!r} is not in the order of tests/test_layering.py"
    return found[0]


@functools.cache
def import_statements(source):
    """Wherever they stand."""
    statements = (ast.Import, ast.ImportFrom)
    return [node for node in ast.walk(ast.parse(source)) if isinstance(node, statements)]


def imported(source, package):
    """Dotted names of everything that `source` imports."""
    for node in import_statements(source):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            base = package[: len(package) - node.level + 1] if node.level else []
            stem = [*base, *(node.module.split(".") if node.module else [])]
            names = [".".join([*stem, alias.name]) for alias in node.names]
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
    for depth in range(1, len(inside)):
        room = "/".join(inside[:depth])
        if room in WITHIN and inside[depth] != "__init__":
            within = ".".join(["jaxtrachea", *inside[:depth]])
            assert not faults(inside[depth], source, package, WITHIN[room], within)


@pytest.mark.parametrize(("room", "others"), STRANGERS)
def test_neighbours_do_not_know_each_other(room, others):
    for path in (PACKAGE / room).rglob("*.py"):
        names = imported(path.read_text(), ["jaxtrachea", *path.relative_to(PACKAGE).parts[:-1]])
        rooms = {name.split(".")[1] for name in names if name.startswith("jaxtrachea.")}
        assert not rooms & others, path


def test_no_room_in_the_lists_that_does_not_exist():
    def there(folder):
        return {p.stem for p in folder.iterdir() if p.suffix == ".py" or p.is_dir()}

    assert set().union(*ORDER) <= there(PACKAGE)
    for room, order in WITHIN.items():
        assert set().union(*order) <= there(PACKAGE / room), room


def test_no_room_holds_too_much_of_the_package():
    lines = {p: len(p.read_text().splitlines()) for p in PACKAGE.rglob("*.py")}
    rooms = {p.relative_to(PACKAGE).parts[0] for p in lines}
    share = {r: sum(n for p, n in lines.items() if p.relative_to(PACKAGE).parts[0] == r)
             for r in rooms}  # fmt: skip
    assert max(share.values()) <= 0.15 * sum(lines.values())


def argument_counts(source):
    """Name and number of arguments of every function, `self` and `cls` not counted."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            args = node.args
            names = [arg.arg for arg in (*args.posonlyargs, *args.args, *args.kwonlyargs)]
            own = names[:1] in (["self"], ["cls"])
            yield getattr(node, "name", "lambda"), len(names) - own


def test_no_function_takes_too_many_arguments():
    counts = [
        (str(path.relative_to(PACKAGE)), name, count)
        for path in PACKAGE.rglob("*.py")
        for name, count in argument_counts(path.read_text())
    ]
    assert len(counts) > 1000  # it has looked
    assert not [row for row in counts if row[2] > MOST_ARGUMENTS]


def test_an_observed_quantity_is_named_in_four_files():
    """Its row, its field of a curve, that of a response, and its level; all others loop."""
    files = [path for path in PACKAGE.rglob("*.py") if "side_force" in path.read_text()]
    assert sorted(str(path.relative_to(PACKAGE)) for path in files) == [
        "measurements/curve.py", "measurements/observed.py",
        "mechanics/levels/level.py", "mechanics/levels/sections.py",
    ]  # fmt: skip


def test_arguments_are_counted():
    source = "class C:\n    async def m(self, a, /, b, *rest, c=1, **more): return lambda x, y=0: x"
    assert dict(argument_counts(source)) == {"m": 3, "lambda": 2}


@pytest.mark.parametrize(
    ("room", "source"),
    [
        ("mechanics", "from jaxtrachea.surface import phong"),
        ("trachea", "def f():\n    import jaxtrachea.mechanics.beam as b"),
        ("trachea", "from jaxtrachea import fitting"),
        ("surface", "from jaxtrachea.fitting.fit import fit"),
        ("fitting", "from jaxtrachea.scene.stage import Scene"),
        ("trachea", "from jaxtrachea.surface.regions import bind"),
        ("mechanics", "from jaxtrachea.surface import local"),
        ("_numerics", "from .trachea import geometry"),
    ],
)
def test_the_walk_sees_a_fault(room, source):
    assert faults(room, source)


def test_only_the_press_and_the_wall_of_the_sections_are_known_outside():
    """The other parts of the mechanics stand beside the sections; none is made of them."""
    for path in set(PACKAGE.rglob("*.py")) - set((PACKAGE / "mechanics" / "sections").glob("*.py")):
        names = imported(path.read_text(), ["jaxtrachea", *path.relative_to(PACKAGE).parts[:-1]])
        own = [n for n in names if n.startswith("jaxtrachea.mechanics.sections")]
        if path.parent == PACKAGE / "mechanics":
            assert not own, path
        parts = ("press", "material", "wall")
        allowed = tuple(f"jaxtrachea.mechanics.sections.{part}" for part in parts)
        assert all(n.startswith(allowed) for n in own), path


def test_the_walk_sees_a_fault_within_the_scene():
    source = "from jaxtrachea.scene import simulation"
    assert faults("plan", source, order=WITHIN["scene"], within="jaxtrachea.scene") == [
        "simulation"
    ]
    assert not faults("session", source, order=WITHIN["scene"], within="jaxtrachea.scene")


def test_import_is_light():
    """Plots, meshes, the command line and file formats are loaded by those who use them.

    Analyses as well draw, and read and write files, only when they are asked.
    """
    code = (
        "import sys, jaxtrachea, jaxtrachea.mechanics.press, jaxtrachea.scene.simulation\n"
        "import jaxtrachea.surface.local, jaxtrachea.surface.regions, jaxtrachea.trachea.imported\n"
        f"print([m for m in {HEAVY!r} if m in sys.modules])\n"
        "import jaxtrachea.inference.analyses\n"
        "print([m for m in ('matplotlib', 'h5py', 'blackjax') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["[]", "[]"]


def test_an_analysis_knows_no_other():
    """Each is a file of its own; one may use what another has found, by its name."""
    folder = PACKAGE / "inference" / "analyses"
    for path in set(folder.glob("*.py")) - {folder / "__init__.py"}:
        names = imported(path.read_text(), ["jaxtrachea", "inference", "analyses"])
        assert not [n for n in names if n.startswith("jaxtrachea.inference.analyses")], path


#: Modules that take a tenth of a second or more to load, beside those of `HEAVY`.
SLOW = {*HEAVY, "jax", "equinox", "optax", "pandas", "openpyxl", "afmformats", "distributed",
        "xarray", "blackjax", "PIL", "scipy", "scipy.integrate", "scipy.interpolate",
        "scipy.optimize", "scipy.spatial", "scipy.special", "scipy.stats"}  # fmt: skip
SHOWS = {"typer", "rich", "pydantic"}
READS = {"jax", "equinox", "h5py"} | SHOWS
FIT, SCENE = (
    PACKAGE.parent / "fits/virtual_trachea/fit.toml",
    PACKAGE.parent / "configs/normal.toml",
)
#: Commands, and which of those they may load.
LOADS = {
    "--version": (["--version"], SHOWS),
    "init": (["init", FIT.with_name("small_strain.h5")], READS),
    "check": (["check", FIT], READS),
    # JAX itself takes LAPACK from scipy.
    "plan": (["plan", SCENE], READS | {"scipy"}),
    "fit": (["fit", FIT], READS | {"scipy", "scipy.special", "matplotlib", "PIL"}),
    "simulate": (["simulate", SCENE], READS | {"scipy", "matplotlib", "PIL"}),
}


@pytest.mark.long
@pytest.mark.parametrize(
    "names",
    [
        ("--version", "init", "check", "plan"),
        *(pytest.param((n,), marks=pytest.mark.slow) for n in ("fit", "simulate")),
    ],
    ids=" ".join,
)
def test_a_command_loads_what_it_needs(names, tmp_path):
    """In one process one after the other, since a later one may load all that those before may."""
    code = (
        "import sys\n"
        "from jaxtrachea.cli.main import main\n"
        f"for words in {[list(map(str, LOADS[n][0])) for n in names]!r}:\n"
        "    sys.argv = ['jaxtrachea', *words]\n"
        "    try:\n        main()\n"
        "    except SystemExit as end:\n        assert not end.code, end.code\n"
        f"    print('loaded', *sorted(m for m in {SLOW!r} if m in sys.modules))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path
    )
    found = [line.split()[1:] for line in done.stdout.splitlines() if line.startswith("loaded ")]
    for name, loaded in zip(names, found, strict=True):
        assert set(loaded) <= LOADS[name][1], (name, set(loaded) - LOADS[name][1])
    for name, other in zip(names, names[1:], strict=False):
        assert LOADS[name][1] <= LOADS[other][1]
