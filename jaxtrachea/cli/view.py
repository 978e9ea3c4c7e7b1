"""The commands for the page: view a scene, and write a simulation as a page that plays."""

import os
import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from jaxtrachea.cli.scene import SceneArgument
from jaxtrachea.cli.terminal import Stop, set_up_jax, to_stderr

PortOption = Annotated[
    int | None, typer.Option("--port", min=1, max=65535, help="Of 127.0.0.1; none: a free one.")
]
NoBrowser = Annotated[bool, typer.Option("--no-browser", help="Only print the address.")]
EXTRA = "needs the extra 'viewer': pip install 'jaxtrachea[viewer]'"


def view(scene: SceneArgument, port: PortOption = None, no_browser: NoBrowser = False) -> None:
    """Handle the trachea in the browser: mouse, keys, sliders."""
    if not scene.is_file():
        raise Stop(f"{scene}: there is no such file; name a scene (TOML)")
    try:
        from jaxtrachea.viewer.server import free_port
    except ModuleNotFoundError as error:
        raise Stop(f"jaxtrachea view {EXTRA} ({error.name} is missing)") from None
    try:
        port = free_port(port)
    except OSError as error:
        cure = "choose another, or leave --port out"
        raise Stop(f"--port: {port} cannot be used ({error.strerror}); {cure}") from None
    from jaxtrachea.viewer.page import serve

    def opened(address: str) -> None:
        Console().print(f"{escape(address)}  (Ctrl-C ends it)", highlight=False, soft_wrap=True)
        if not no_browser and not _open(address):
            to_stderr("no browser could be opened: open the address yourself, or use --no-browser")

    serve(scene, port, opened, set_up_jax)


def play(
    simulation: Annotated[Path, typer.Argument(help="simulation.h5 of `jaxtrachea simulate`.")],
    out_file: Annotated[
        Path | None, typer.Option("--out", help="HTML file; none: play.html beside it.")
    ] = None,
) -> None:
    """Write a simulation as one page that plays in any browser."""
    from jaxtrachea.files.atomic import write_text
    from jaxtrachea.viewer.play import PlayError, of_file

    path = out_file or simulation.with_name("play.html")
    try:
        write_text(path, of_file(simulation))
    except PlayError as error:
        raise Stop(str(error)) from None
    except OSError as error:
        raise Stop(f"{path}: cannot be written ({error.strerror}); choose another --out") from None
    Console().print(f"written to {escape(str(path))}", highlight=False, soft_wrap=True)


def _open(address: str) -> bool:
    """Open a browser window; False where there is no display."""
    import webbrowser

    if sys.platform.startswith("linux") and not {"DISPLAY", "WAYLAND_DISPLAY"} & {*os.environ}:
        return False
    return webbrowser.open(address)
