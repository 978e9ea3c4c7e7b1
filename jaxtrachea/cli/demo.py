"""The example that an installed package brings along: measured curves, a fit, a scene."""

import shutil
from pathlib import Path
from typing import Annotated

import typer

from jaxtrachea.cli.terminal import Stop

PACKAGE = Path(__file__).parents[1]
#: Files of the example, as they lie in the repository; in the wheel all are in `jaxtrachea/demo`.
FILES = (
    "fits/virtual_trachea/fit.toml",
    "fits/virtual_trachea/small_strain.h5",
    "fits/virtual_trachea/SOURCE.md",
    "configs/friction.toml",
)

FolderArgument = Annotated[Path, typer.Argument(help="New folder for the example.")]


def write_example(folder: Path) -> None:
    """Copy the example's files into a new folder; `Stop` where it exists or cannot be written."""
    packaged = PACKAGE / "demo"
    sources = [packaged / Path(name).name for name in FILES]
    if not packaged.is_dir():  # run from the repository
        sources = [PACKAGE.parent / name for name in FILES]
    try:
        folder.mkdir(parents=True)
        for source in sources:
            shutil.copyfile(source, folder / source.name)
    except FileExistsError:
        raise Stop(f"{folder} exists; name a new folder: jaxtrachea demo FOLDER") from None
    except OSError as error:
        raise Stop(f"{error.filename}: {error.strerror or error}") from None


def next_steps(folder: Path) -> list[str]:
    """What may be done with the example next, a line each."""
    scene = folder / "friction.toml"
    return [
        f"open {folder / 'fit' / 'report.html'}",
        f"jaxtrachea simulate {scene}",
        f"jaxtrachea view {scene}   (needs: pip install 'jaxtrachea[viewer]')",
    ]
