"""The command `tradeoff`: what every accuracy choice of a scene errs and costs."""

import time
from pathlib import Path
from typing import Annotated

import typer

from jaxtrachea.cli.options import OutOption
from jaxtrachea.cli.terminal import Stop, into, progress_bar, say, say_written

SceneArgument = Annotated[
    Path | None, typer.Argument(help="Scene file (default: a ball on the tube of Table 1).")
]
CallsOption = Annotated[int, typer.Option("--calls", min=10, help="Timed calls of each setting.")]
LanesOption = Annotated[
    int, typer.Option("--lanes", min=0, help="Poses in one batch; 0: no batch.")
]
QuickOption = Annotated[
    bool, typer.Option("--quick", help="Three settings of each kind, 100 calls, no batch.")
]
DataOption = Annotated[
    Path | None,
    typer.Option("--data", help="Fit specification: its measured curves are a truth, too."),
]


def tradeoff(
    scene: SceneArgument = None,
    out_dir: OutOption = None,
    calls: CallsOption = 1000,
    lanes: LanesOption = 256,
    quick: QuickOption = False,
    data: DataOption = None,
) -> None:
    """Measure error and time of every accuracy setting of a scene."""
    clock = [time.perf_counter()]
    name = "table-1" if scene is None else scene.stem
    full = _full(scene)
    curves, radius, inputs = measured_curves(data)
    from jaxtrachea.tradeoff.measure import Settings, measure

    settings = Settings(100, 0, 3) if quick else Settings(calls, lanes)
    clock.append(time.perf_counter())
    with into(out_dir, Path("out") / f"{name}-tradeoff") as (folder, stop_if_asked):
        with progress_bar() as bar:
            task = bar.add_task("starting", total=None)

            def report(text: str) -> None:
                stop_if_asked()
                bar.update(task, description=text, advance=1)

            try:
                rows = measure(name, full, settings, report, curves, radius)
            except ValueError as error:
                if not curves:
                    raise
                raise Stop(f"{data}: {error}") from None
        clock.append(time.perf_counter())
        _write(folder, rows, scene, inputs, clock)
    _print(rows)
    say_written(folder.parent)


def _full(scene: Path | None):
    """The scene at its finest; input errors become `Stop`."""
    import jax

    from jaxtrachea.config import SpecError
    from jaxtrachea.scene.spec import SceneSpec, load_scene_spec

    try:
        spec = None if scene is None else load_scene_spec(scene)
        jax.config.update("jax_enable_x64", True)
        jax.config.update("jax_enable_compilation_cache", False)  # compile times are measured
        jax.config.update("jax_cpu_enable_async_dispatch", False)  # no hand-over to a thread
        from jaxtrachea.scene.build import stage
        from jaxtrachea.scene.declare import PlanError
        from jaxtrachea.tradeoff.levels import BUILT_IN, full_scene

        spec = spec or SceneSpec.model_validate(BUILT_IN)
        try:
            staged = stage(spec, Path() if scene is None else scene.parent)
            return full_scene(spec, staged, coupling="series")
        except PlanError as error:
            raise SpecError.like(error, key=f"effects.{error.key}") from None
    except SpecError as error:
        raise Stop(str(SpecError.like(error, place=str(scene)))) from None


def measured_curves(data: Path | None):
    """Measured curves, the radius of the tool that made them, digests of their files."""
    if data is None:
        return (), -1.0, {}
    from jaxtrachea.cli.load import load

    spec, measurements, _ = load(data, None)
    radius = spec.data.tool_radius
    return measurements.curves, -1.0 if radius is None else radius, measurements.sha256()


def _write(folder: Path, rows, scene: Path | None, inputs, clock) -> None:
    import json

    from jaxtrachea.files.atomic import write_text
    from jaxtrachea.files.provenance import provenance, write_provenance
    from jaxtrachea.tradeoff.levels import BUILT_IN
    from jaxtrachea.tradeoff.table import measured_table

    if scene is None:
        scene = folder / "scene.json"
        write_text(scene, json.dumps(BUILT_IN, indent=2) + "\n")
    text = "".join(json.dumps(row, ensure_ascii=False) + "\n" for row in rows)
    write_text(folder / "tradeoff.jsonl", text)
    points = [row for row in rows if "left_out" not in row]
    measured_table(points).write_csv(folder / "tradeoff.csv")
    made = provenance(scene, inputs, "float64, float32", ("read", "compute"), clock)
    write_provenance(folder, made)


def _print(rows) -> None:
    from jaxtrachea.tradeoff.load import load_warning
    from jaxtrachea.tradeoff.table import KINDS, measured_table

    points = [row for row in rows if "left_out" not in row]
    for kind, title in KINDS.items():
        if of_kind := [point for point in points if point["kind"] == kind]:
            say(measured_table(of_kind, title))
    for row in rows:
        if "left_out" in row:
            say(f"left out: {row['ladder']}: {row['left_out']}")
    loads = [point["others"] for point in points if point["others"] is not None]
    say(*load_warning(max(loads, default=None)))
