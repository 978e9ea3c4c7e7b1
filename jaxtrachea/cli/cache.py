"""The command cache: where compiled programs are kept, and how much they take."""

from typing import Annotated

import typer

from jaxtrachea.cli.terminal import Stop, cache_folder, programs_folder, say
from jaxtrachea.files.programs import (
    MOST_BYTES,
    MOST_DAYS,
    TRACED,
    Uses,
    delete,
    last_uses,
    programs,
)

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
        text = f"{gone} of {len(kept)} programs and traces deleted from {folder}"
    else:
        size = sum(program.size for program in kept) / 2**20
        traced = sum(TRACED in program.path.name for program in kept)
        text = f"{len(kept) - traced} compiled programs and {traced} traces, {size:.1f} MiB, "
        text += f"in {folder}"
        if folder == cache_folder():
            text += f"\nat most {MOST_BYTES // 2**20} MiB, and none unused for {MOST_DAYS:g} days"
            uses = last_uses(folder)
            text += "" if uses is None else f"\n{_last_run(uses)}"
    say(text, wrap=False)


def _last_run(uses: Uses) -> str:
    """How many programs the last command loaded and compiled, and what a refusal means."""
    text = f"the last command loaded {uses.loaded} programs and compiled {uses.compiled}"
    if uses.refused:
        text += (
            f"; {uses.refused} of these were kept, but refused: damaged, or compiled with another "
            "processor's tuning; --clear, and the next command keeps them anew"
        )
    return text
