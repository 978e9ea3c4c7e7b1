"""The commands for pages: a scene under the hand, a fit as a stream, a simulation that plays."""

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from jaxtrachea._errors import InputError
from jaxtrachea.cli.terminal import Stop, say, say_written, set_up_jax, to_stderr

PortOption = Annotated[
    int | None, typer.Option("--port", min=1, max=65535, help="Of 127.0.0.1; none: a free one.")
]
NoBrowser = Annotated[bool, typer.Option("--no-browser", help="Only print the address.")]
EXTRA = "needs the extra 'viewer': pip install 'jaxtrachea[viewer]'"


def view(
    file: Annotated[Path, typer.Argument(help="Scene, or fit specification (TOML).")],
    port: PortOption = None,
    no_browser: NoBrowser = False,
) -> None:
    """Handle a scene in the browser, or see a fit sample by sample."""
    content = _content(file)
    try:
        from jaxtrachea.viewer.server import free_port
    except ModuleNotFoundError as error:
        raise Stop(f"jaxtrachea view {EXTRA} ({error.name} is missing)") from None
    try:
        port = free_port(port)
    except OSError as error:
        cure = "choose another, or leave --port out"
        raise Stop(f"--port: {port} cannot be used ({error.strerror}); {cure}") from None

    def opened(address: str) -> None:
        say(f"{address}  (Ctrl-C ends it)", wrap=False)
        if not no_browser and not _open(address):
            to_stderr("no browser could be opened: open the address yourself, or use --no-browser")

    if "data" in content:
        from jaxtrachea.viewer.stream_page import serve_stream

        serve_stream(file.name, lambda begin: _experiment(file, begin), port, opened)
    else:
        from jaxtrachea.viewer.page import serve_scene

        serve_scene(file, port, opened, set_up_jax)


def _content(file: Path) -> dict:
    """Tables of a scene or a fit."""
    from jaxtrachea.files.toml import SpecError, read_tables

    if not file.is_file():
        raise Stop(f"{file}: there is no such file; name a scene or a fit specification (TOML)")
    if file.suffix == ".h5":
        raise Stop(f"{file}: no scene; a simulation.h5 plays: jaxtrachea play {file}")
    try:
        content = read_tables(file, "scene")
    except SpecError as error:
        raise Stop(str(error)) from None
    for name in ("wall", "sections"):
        if name in content and "data" not in content:
            raise Stop(
                f"{file}: {name}: deforming cross-sections are not solved step by step, as a hand "
                f"needs it; give [material] in its place, or jaxtrachea simulate {file}"
            )
    return content


def _experiment(path: Path, begin: Callable[[str], None]):
    """The curves of a fit specification, and the `Online` that will take their samples."""
    from jaxtrachea.cli.load import load
    from jaxtrachea.inference.online import Online
    from jaxtrachea.viewer.stream import Experiment

    try:
        _, measurements, study = load(path, None)
    except Stop as stop:
        raise ValueError(str(stop)) from None
    curves, recipe = measurements.curves, study.recipe
    if len(specimens := sorted({c.specimen for c in curves})) > 1:
        raise ValueError(
            f"{path}: data: {len(specimens)} specimens ({specimens[0]}, {specimens[1]}, ...); a "
            "stream is of one: name its files alone in data.files"
        )
    assert recipe is not None
    places = {c.s_c for c in curves if c.s_c is not None}
    begin("compiling the fit of a sample")
    try:
        online = Online(
            recipe.geometry, recipe.options, recipe.parameters, noise=recipe.noise,
            depth=max(float(c.displacement.max()) for c in curves),
            candidates=sorted(places),
            samples=round(sum(len(c.force) for c in curves) / len(curves)),
        )  # fmt: skip
    except InputError as error:
        cure = f"jaxtrachea fit {path} takes its curves together"
        raise InputError.like(error, place=str(path), cure=cure) from None
    return Experiment(online, curves, {p.name: p.unit for p in recipe.parameters})


def play(
    simulation: Annotated[Path, typer.Argument(help="simulation.h5 of `jaxtrachea simulate`.")],
    out_file: Annotated[
        Path | None, typer.Option("--out", help="HTML file; none: play.html beside it.")
    ] = None,
) -> None:
    """Write a simulation as one page that plays in any browser."""
    from jaxtrachea.files.atomic import write_text
    from jaxtrachea.viewer.play import PlayError, of_file

    folder = simulation if simulation.is_dir() else simulation.parent
    path = out_file or folder / "play.html"
    try:
        write_text(path, of_file(simulation))
    except PlayError as error:
        raise Stop(str(error)) from None
    except OSError as error:
        raise Stop(f"{path}: cannot be written ({error.strerror}); choose another --out") from None
    say_written(path)


def _open(address: str) -> bool:
    """Open a browser window; False where there is no display."""
    import webbrowser

    if sys.platform.startswith("linux") and not {"DISPLAY", "WAYLAND_DISPLAY"} & {*os.environ}:
        return False
    return webbrowser.open(address)
