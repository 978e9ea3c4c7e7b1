"""The folder a run writes into: never over anything that exists, all of it or nothing."""

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path

from jaxtrachea.files.lock import LOCK, Busy, refuse_busy


class OutputExists(FileExistsError):
    """The output directory holds files already."""


class InUse(OutputExists):
    """Another command is at work in it."""


def new_directory(wanted: Path | None, default: Path) -> Path:
    """The directory to write into: `wanted` if it is new or empty, else a free numbered `default`.

    Raises:
        OutputExists: `wanted` exists and is not empty, or is a file.
    """
    if wanted is not None:
        if wanted.exists():
            refuse_full(wanted)
        wanted.mkdir(parents=True, exist_ok=True)
        return wanted
    for n in range(1, 10_000):
        path = default if n == 1 else default.with_name(f"{default.name}-{n}")
        try:
            path.mkdir(parents=True, exist_ok=False)
        except FileExistsError:
            continue
        return path
    raise OutputExists(f"{default} and its numbered successors exist; give --out")


def refuse_full(wanted: Path, *, held: bool = False) -> None:
    """Refuse a folder that holds anything but the lock of a run.

    Args:
        wanted: the folder.
        held: the lock is our own.

    Raises:
        OutputExists: it does, or is a file; `InUse`: a run is at work in it.
    """
    if wanted.is_dir() and not any(path.name != LOCK for path in wanted.iterdir()):
        return
    try:
        if not held:
            refuse_busy(wanted)
    except Busy as error:
        raise InUse(str(error)) from None
    raise OutputExists(
        f"{wanted} exists and is not empty; nothing was written. "
        "Choose another --out, or remove it yourself"
    )


@contextlib.contextmanager
def new_output(wanted: Path | None, default: Path) -> Iterator[Path]:
    """Claim an output folder at once and fill it all together or not at all.

    Yields:
        A folder to write into. Its files move to the claimed one (its parent) when the block ends;
        if the block raises, they and the folders made for them are removed.

    Raises:
        OutputExists: as `new_directory`.
    """
    made = [folder for folder in (wanted or default).parents if not folder.exists()]
    existed = wanted is not None and wanted.exists()
    target = new_directory(wanted, default)
    staging = target / ".unfinished"
    try:
        staging.mkdir()
    except FileExistsError:  # by another command, since the folder was seen to be empty
        raise InUse(f"{target}: another command is writing here; choose another --out") from None
    try:
        yield staging
        for path in sorted(staging.iterdir()):
            path.replace(target / path.name)
        staging.rmdir()
    except BaseException:
        shutil.rmtree(staging, ignore_errors=True)
        for folder in made if existed else [target, *made]:
            with contextlib.suppress(OSError):
                folder.rmdir()
        raise
