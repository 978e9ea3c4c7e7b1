"""The commands for scenes: plan, simulate, sweep. What is heavy is imported inside the commands."""

import time
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from jaxtrachea.cli.beside import beside, load_beside
from jaxtrachea.cli.options import OutOption
from jaxtrachea.cli.terminal import (
    Stages,
    Stop,
    interrupts,
    into,
    progress_bar,
    say,
    say_lost,
    say_written,
    set_up_jax,
)

SceneArgument = Annotated[Path, typer.Argument(help="Scene file (TOML).")]
TimeOption = Annotated[
    bool, typer.Option("--time", help="Measure the time on this machine; compiles the programs.")
]
#: Rows of a terminal table at most; the files hold all.
MANY = 40


def plan(scene: SceneArgument, timed: TimeOption = False) -> None:
    """Show which effects a scene needs, why, and their cost."""
    from concurrent.futures import ThreadPoolExecutor

    from jaxtrachea.files.table import words
    from jaxtrachea.files.traces import Traced
    from jaxtrachea.output.results import plan_rows
    from jaxtrachea.scene.simulation import simulate as run
    from jaxtrachea.tradeoff.shares import shares

    spec, staged = _staged(scene)
    swept = None if spec.sweep is None else _for_sweep(scene, spec, staged)[0]
    staged, choice = _chosen(scene, spec, staged)
    head = ["effect", "level", "chosen", "operations", "reason"]
    with ThreadPoolExecutor(1) as beside:
        # The program that `simulate` will load is compiled while the operations are counted.
        kept = beside.submit(Traced(run).compile, staged.scene, staged.material, staged.path)
        with progress_bar(transient=True) as bar:
            bar.add_task("counting operations", total=None)
            whole, found = shares(staged)
        say(words("Plan", head, plan_rows(staged.scene.plan, found), ("reason",)))
        say(f"{whole:,} operations for {_rows(staged)} rows")
        with progress_bar(transient=True) as bar:
            bar.add_task("compiling for simulate", total=None)
            kept.result()
    if timed:
        say(_timed(staged))
    if choice is not None:
        say(choice.sentence)
    if swept is not None:
        say(_levels_of(swept))
    say(*staged.notes)


def simulate(scene: SceneArgument, out_dir: OutOption = None) -> None:
    """Move the tool along its path: forces, deformed mesh, pictures."""
    import jax

    from jaxtrachea.files.provenance import write_provenance
    from jaxtrachea.files.traces import Traced
    from jaxtrachea.output.results import (
        last_solved,
        write_forces,
        write_simulation,
    )
    from jaxtrachea.scene.simulation import simulate as run

    clock = [time.perf_counter()]
    spec, staged = _staged(scene)
    if spec.output.play:
        from jaxtrachea.viewer.play import PlayError, three_js

        try:
            three_js()
        except PlayError as error:
            raise Stop(f"{scene}: output.play: {error}") from None
    staged, choice = _chosen(scene, spec, staged)
    clock.append(time.perf_counter())
    with into(out_dir, _default(scene)) as (folder, stop_if_asked):
        if spec.output.pictures:
            load_beside("jaxtrachea.output.surface_plot")
        with progress_bar(transient=True) as bar:
            stages = Stages(bar, stop_if_asked)
            stages.begin(f"pressing {_rows(staged)} rows; a new kind of scene is compiled first")
            out = jax.device_get(Traced(run)(staged.scene, staged.material, staged.path))
            clock.append(time.perf_counter())
            stop_if_asked()
            stages.begin("drawing and writing")
            title = spec.title or scene.stem
            with beside(_draw, folder, title, spec.output.pictures, staged, out) as drawing:
                _write_surface(folder, staged.scene, out)
                write_forces(folder / "forces.csv", out, staged.scene.names)
                made = _provenance(scene, staged, clock)
                motion = staged.material, staged.path
                write_simulation(folder / "simulation.h5", staged.scene, *motion, out, made)
                lost = _write_play(folder, title) if spec.output.play else {}
                if spec.output.vtk or spec.output.animation:
                    _write_recording(folder, spec.output)
                write_provenance(folder, made)
                lost |= drawing.result()
        say_lost(lost)
    _print_rows(out, staged.scene.names)
    _print_misses(out)
    failed = _print_failures(out.status, "row(s)")
    say(*staged.notes)
    if choice is not None:
        say(choice.sentence)
    if last_solved(out) is None:
        say("no row was solved: no mesh, no picture of the surface")
    say_written(folder.parent)
    raise typer.Exit(1 if failed else 0)


def sweep(scene: SceneArgument, out_dir: OutOption = None) -> None:
    """Press along the whole tube: maps of force and compliance."""
    import jax
    import numpy as np

    from jaxtrachea.files.pictures import save_each
    from jaxtrachea.files.provenance import write_provenance
    from jaxtrachea.files.traces import Traced
    from jaxtrachea.output.plots import draw_sweep
    from jaxtrachea.output.results import write_sweep
    from jaxtrachea.output.vtk_files import write_map
    from jaxtrachea.scene.sweep import sweep as run

    clock = [time.perf_counter()]
    spec, staged = _staged(scene)
    want = spec.sweep
    if want is None:
        raise Stop(f"{scene}: sweep: missing; give a table [sweep] with a depth")
    for name in ("s_count", "phi_count") if spec.output.vtk else ():
        if getattr(want, name) < 2:
            raise Stop(f"{scene}: sweep.{name}: 1; a map for ParaView (output.vtk) needs 2 or more")
    swept, s, phi = _for_sweep(scene, spec, staged)
    points = [v.ravel() for v in np.meshgrid(s, phi, indexing="ij")]
    clock.append(time.perf_counter())
    with into(out_dir, _default(scene, "-sweep")) as (folder, stop_if_asked):
        size, parts, total = want.chunk, [], len(points[0])
        compute = Traced(run, chunk=size)
        load_beside("jaxtrachea.output.plots")
        with progress_bar() as bar:
            task = bar.add_task("sweeping", total=total)
            for start in range(0, total, size):
                stop_if_asked()
                rows = [v[np.minimum(np.arange(start, start + size), total - 1)] for v in points]
                depth = np.full(size, want.depth)
                part = compute(swept, staged.material, *rows, depth)
                parts.append(jax.tree.map(lambda v, left=total - start: np.asarray(v)[:left], part))
                bar.update(task, completed=min(start + size, total))
        out = jax.tree.map(lambda *v: np.concatenate(v), *parts)
        clock.append(time.perf_counter())
        say_lost(save_each(folder, draw_sweep(s, phi, want.depth, out))[1])
        made = _provenance(scene, staged, clock)
        write_sweep(folder / "sweep.h5", swept, s, phi, want.depth, out, made)
        if spec.output.vtk and (mesh := staged.scene.mesh) is not None:
            write_map(folder / "sweep.vtp", mesh, s, phi, out)
        write_provenance(folder, made)
    unsolved = int(np.isnan(np.asarray(out.force)).sum())
    say(
        _levels_of(swept),
        f"{total} contact points, {unsolved} without a solution, "
        f"{clock[2] - clock[1]:.2f} s with compilation",
    )
    failed = _print_failures(out.status, "point(s)")
    say_written(folder.parent)
    raise typer.Exit(1 if failed else 0)


def _staged(path: Path):
    """Specification and scene; input errors become `Stop`."""
    from jaxtrachea.config import SpecError
    from jaxtrachea.scene.spec import load_scene_spec

    try:
        spec = load_scene_spec(path)
        set_up_jax()
        from jaxtrachea.scene.build import stage

        if spec.trachea.file is None:
            return spec, stage(spec, path.parent)
        with interrupts() as ctrl_c, progress_bar(transient=True) as bar:
            return spec, stage(spec, path.parent, Stages(bar, ctrl_c.stop_if_asked).begin)
    except SpecError as error:
        raise Stop(str(SpecError.like(error, place=str(path)))) from None


def _chosen(path: Path, spec, staged):
    """The scene with the plan within its tolerance, and that choice; as it is without tolerance."""
    if spec.plan is None:
        return staged, None
    from jaxtrachea.scene.declare import PlanError
    from jaxtrachea.tradeoff.choice import choose
    from jaxtrachea.tradeoff.levels import full_scene
    from jaxtrachea.tradeoff.load import load_warning

    try:
        full = full_scene(spec, staged)
    except PlanError as error:
        raise Stop(f"{path}: effects.{error}") from None
    requested = spec.plan
    with interrupts() as ctrl_c, progress_bar() as bar:
        task = bar.add_task("choosing", total=None)

        def report(text: str) -> None:
            ctrl_c.stop_if_asked()
            bar.update(task, description=f"choosing: {text}", advance=1)

        try:
            choice = choose(
                full, requested.tolerance, report, precision=requested.precision, by=requested.cost
            )
        except PlanError as error:
            raise Stop(f"{path}: {error}") from None
    chosen = {name: getattr(choice, name) for name in ("scene", "material", "path")}
    return staged._replace(**chosen, notes=(*staged.notes, *load_warning(choice.others))), choice


def _timed(staged) -> str:
    """Time of the whole path in one call and of a pose a call, measured."""
    import numpy as np

    from jaxtrachea.tradeoff.calls import turn_medians
    from jaxtrachea.tradeoff.cost import WORDS, compiled
    from jaxtrachea.tradeoff.load import Load, load_warning

    arguments, calls = (staged.scene, staged.material, staged.path), []
    with interrupts() as ctrl_c, progress_bar(transient=True) as bar:
        task = bar.add_task("time", total=None)
        for by, what in WORDS.items():
            ctrl_c.stop_if_asked()
            bar.update(task, description=f"compiling: {what}", advance=1)
            calls.append(compiled(by, arguments))
        ctrl_c.stop_if_asked()
        bar.update(task, description="timing", advance=1)
        load = Load()
        seconds = np.median(turn_medians(calls), axis=1)
    times = zip(seconds, WORDS.values(), strict=True)
    each = ", ".join(f"{1e3 * v:.2g} ms for {what}" for v, what in times)
    return "\n".join((f"time measured on this machine: {each}", *load_warning(load.others())))


def _for_sweep(path: Path, spec, staged):
    """The scene with the program of its sweep, and the s and phi of the grid."""
    import numpy as np

    from jaxtrachea.config import SpecError
    from jaxtrachea.scene.build import stage_sweep

    want, geometry = spec.sweep, staged.scene.geometry
    alpha = float(geometry.half_angle)
    widest = alpha if want.phi_max is None else want.phi_max
    if not 0 <= widest <= alpha:
        raise Stop(
            f"{path}: sweep.phi_max: {np.degrees(widest):.4g} deg; expected 0 to "
            f"{np.degrees(alpha):.4g} deg, the ends of the rings"
        )
    length, share = float(geometry.length), (np.arange(want.s_count) + 0.5) / want.s_count
    phi = np.linspace(-widest, widest, want.phi_count) if want.phi_count > 1 else np.zeros(1)
    try:
        # The widest angle of the grid decides, wherever it is.
        scene = stage_sweep(spec, staged, np.full_like(phi, length * share[0]), phi)
    except SpecError as error:
        raise Stop(str(SpecError.like(error, place=str(path)))) from None
    low, high = scene.plan.options.places(length)
    return scene, low + share * (high - low), phi


def _levels_of(scene) -> str:
    """Which rings and which skeleton a sweep presses on, with which width, and why."""
    effects = {e.name: e for e in scene.plan.effects}
    width = ("width",) if scene.plan.options.half_width > 0 else ()
    return "\n".join(
        f"sweep: {name} {effects[name].level!r}, {effects[name].caveat or effects[name].reason}"
        for name in ("rings", "skeleton", *width)
    )


def _default(scene: Path, ending: str = "") -> Path:
    return Path("out") / f"{scene.stem}{ending}"


def _rows(staged) -> int:
    from jaxtrachea.scene.instruments import rows_of

    paths = staged.path.values() if staged.scene.instruments else [staged.path]
    return max(map(rows_of, paths))


def _draw(folder: Path, title: str, pictures: bool, staged, out) -> dict[str, str]:
    """Draw what is asked for; why a picture could not be drawn, by file name."""
    if not pictures:
        return {}
    from jaxtrachea.files.pictures import save_each
    from jaxtrachea.output.plots import draw_series, draw_tools
    from jaxtrachea.output.results import last_solved
    from jaxtrachea.output.surface_plot import draw_surface

    shown, names = (staged.scene, staged.path, out), staged.scene.names
    drawings = {"series.png": partial(draw_series, *shown)}
    if names:
        friction = [one.friction for one in staged.scene.instruments]
        drawings = {"series.png": partial(draw_tools, names, out, friction)}
    row = last_solved(out)
    if out.vertices is not None and row is not None:
        drawings["surface.png"] = partial(draw_surface, *shown, row, title)
    return save_each(folder, drawings)[1]


def _write_surface(folder: Path, scene, out) -> None:
    """The surface of the last solved row as meshes."""
    import numpy as np

    from jaxtrachea.output.gltf import write_meshes
    from jaxtrachea.output.results import last_solved

    row = last_solved(out)
    if out.vertices is not None and scene.mesh is not None and row is not None:
        write_meshes(folder, np.asarray(scene.mesh.faces), np.asarray(out.vertices[row], float))


def _write_recording(folder: Path, output) -> None:
    """The simulation for other programs; nothing where no row was solved, which is said anyway."""
    from jaxtrachea.output.gltf import write_glb
    from jaxtrachea.output.read import read_simulation
    from jaxtrachea.output.recording import NoSurface, recording_of
    from jaxtrachea.output.vtk_files import write_vtk

    try:
        recording = recording_of(read_simulation(folder / "simulation.h5"))
    except NoSurface:
        return
    if output.vtk:
        write_vtk(folder, recording)
    if output.animation:
        write_glb(folder / "simulation.glb", recording)


def _write_play(folder: Path, title: str) -> dict[str, str]:
    """Write play.html; why it could not be, by file name."""
    from jaxtrachea.files.atomic import write_text
    from jaxtrachea.viewer.play import PlayError, of_file

    try:
        page = of_file(folder / "simulation.h5", title)
    except PlayError as error:
        return {"play.html": error.found}
    write_text(folder / "play.html", page)
    return {}


def _provenance(scene: Path, staged, clock: list[float]) -> dict:
    import hashlib

    import jax

    from jaxtrachea.files.provenance import provenance

    inputs = {str(p): hashlib.sha256(p.read_bytes()).hexdigest() for p in staged.files}
    dtype = str(jax.tree.leaves(staged.material)[0].dtype)
    return provenance(scene, inputs, dtype, ("read", "compute"), clock)


def _print_misses(out) -> None:
    """That the tool comes nowhere near the wall, where it touches it in no row."""
    import numpy as np

    from jaxtrachea.status import PressStatus

    if out.gap is not None and np.all(np.asarray(out.status) == PressStatus.NO_CONTACT):
        say(f"no row touches the wall: the tool stays {float(np.min(out.gap)):.3g} mm away or more")


def _print_failures(status, what: str) -> int:
    """A line for each status beyond contact and none; the number of those that are a fault."""
    import numpy as np

    from jaxtrachea.status import PressStatus

    failed = np.asarray(status)
    failed = failed[failed > PressStatus.NO_CONTACT]
    for code, count in zip(*np.unique(failed, return_counts=True), strict=True):
        say(f"{count} {what}: {PressStatus(int(code)).message}")
    return int(np.sum(failed != PressStatus.LIFTED))


def _print_rows(out, names) -> None:
    """A table of the rows: of more than `MANY` some, evenly, which its title says.

    Of several tools a line for each of them.
    """
    import numpy as np

    from jaxtrachea.files.table import Column, Table
    from jaxtrachea.scene.simulation import of_tool
    from jaxtrachea.status import PressStatus

    count = len(out.s)
    pick = np.unique(np.linspace(0, count - 1, min(count, MANY)).round().astype(int))

    def row(i: int, out, name: str) -> dict[str, object]:
        def rounded(x) -> float:
            return float(np.round(x, 9) + 0.0)

        vectors = {"force {} [N]": out.force[i], "skeleton {} [mm]": out.skeleton[i]}
        cells: dict[str, object] = {
            "row": i + 1,
            **({"tool": name} if name else {}),
            "s [mm]": float(out.s[i]),
            "phi [deg]": rounded(np.degrees(out.phi[i])),
            "gap [mm]": None if out.gap is None else rounded(out.gap[i]),
            "status": PressStatus(int(out.status[i])).name.lower(),
            "depth/radius": float(out.depth_share[i]),
        }
        return cells | {
            name.format(axis): rounded(v)
            for name, vector in vectors.items()
            for axis, v in zip("xyz", np.asarray(vector), strict=True)
        }

    columns = [
        Column("row"), *([Column("tool", left=True)] if names else []), Column("s [mm]"),
        *(Column(name, digits=3) for name in ("phi [deg]", "gap [mm]")),
        *(Column(f"force {axis} [N]", digits=3) for axis in "xyz"), Column("status", left=True),
        Column("depth/radius", unit="%", decimals=0),
        *(Column(f"skeleton {axis} [mm]", digits=3) for axis in "xyz"),
    ]  # fmt: skip
    title = f"{count} rows"
    if len(pick) < count:
        title = f"{len(pick)} of {count} rows; all are in simulation.h5"
    each = [(of_tool(out, j), name) for j, name in enumerate(names)] or [(out, "")]
    lines = (row(i, *one) for i in pick.tolist() for one in each)
    say(Table(lines, columns, title=title))
