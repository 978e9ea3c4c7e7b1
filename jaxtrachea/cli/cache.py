"""The command cache: where compiled programs are kept, and how much they take; the time model."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from jaxtrachea.cli.terminal import Stop, cache_folder, programs_folder
from jaxtrachea.files.programs import MOST_BYTES, MOST_DAYS, TIME_MODEL, delete, programs

ClearOption = Annotated[bool, typer.Option("--clear", help="Delete all that is kept.")]


def cache(clear: ClearOption = False) -> None:
    """Say where compiled programs are kept; --clear deletes them."""
    folder = programs_folder()
    if folder is None:
        raise Stop(
            "cache: no compiled programs are kept: JAX_ENABLE_COMPILATION_CACHE is false, or the "
            "user's cache folder cannot be written; set XDG_CACHE_HOME to one that can"
        )
    kept = list(programs(folder))
    if clear:
        gone = sum(delete(program) for program in kept)
        text = f"{gone} of {len(kept)} programs deleted from {folder}"
        if (folder / TIME_MODEL).exists():
            (folder / TIME_MODEL).unlink()
            text += "\nmodel of time deleted"
    else:
        size = sum(program.size for program in kept) / 2**20
        text = f"{len(kept)} programs, {size:.1f} MiB, in {folder}"
        if folder == cache_folder():
            text += f"\nat most {MOST_BYTES // 2**20} MiB, and none unused for {MOST_DAYS:g} days"
        if (folder / TIME_MODEL).exists():
            text += f"\n{_of_time(folder)}"
    Console().print(text, markup=False, highlight=False, soft_wrap=True)


def _of_time(folder: Path) -> str:
    """The kept model of time in words."""
    from jaxtrachea.tradeoff.time_model import Uncalibrated, kept

    try:
        model = kept(folder)
    except Uncalibrated as error:
        return f"model of time: not read: {error}"
    if model is None:
        return "model of time: of another machine or damaged; the next choice measures it anew"
    return f"model of time: {model.sentence}"
