"""The output folder of a fit, safe against crashes: its files appear after one atomic rename.

    OUT/.jaxtrachea-lock                held while a run is at work (`run_lock`)
    OUT/.run/run.json, 00000.npz, ...   manifest and finished shards
    OUT/.unfinished/                    files being written
    OUT/.written/                       the same, complete, on their way into OUT

The one step that counts is the renaming of `.unfinished` to `.written`: whoever comes before it
finds the shards, whoever comes after it only moves files.
"""

import collections
import contextlib
import dataclasses
import hashlib
import os
import shutil
from collections.abc import Iterable
from pathlib import Path

from jaxtrachea.files.lock import Lock, take
from jaxtrachea.files.output import new_directory, refuse_full
from jaxtrachea.runs import manifest as manifests
from jaxtrachea.runs.manifest import Manifest
from jaxtrachea.runs.shards import read_manifest

#: Lanes fitted so far, written when the user stops a run; gone when it is finished.
SO_FAR = "summary_so_far.csv"


class NoRun(ValueError):
    """There is nothing to go on with, or it is something else."""


@dataclasses.dataclass(frozen=True)
class RunFolder:
    """A run and where it lies.

    Attributes:
        target: what the user calls the output folder.
        manifest: of the run.
        created: folders that did not exist before, innermost first; removed with a run of which
            nothing is kept.
        lock: of the folder; None: another process holds it, or the user wants none.
        note: what the user should know of how it was opened, or nothing.
    """

    target: Path
    manifest: Manifest
    created: tuple[Path, ...] = ()
    lock: Lock | None = None
    note: str = ""

    @property
    def checkpoint(self) -> Path:
        """Folder of the manifest and the shards."""
        return self.target / ".run"

    @property
    def staging(self) -> Path:
        """Folder of the files being written."""
        return self.target / ".unfinished"

    def shard(self, k: int) -> Path:
        """File of shard k."""
        return self.checkpoint / f"{k:05d}.npz"

    def release(self) -> None:
        """Let other runs into the folder."""
        if self.lock is not None:
            self.lock.release()


def saved_shards(target: Path) -> int:
    """Number of shards of an unfinished run that are saved."""
    return len(list((target / ".run").glob("*.npz")))


def claim(wanted: Path | None, default: Path, now: Manifest, *, locked: bool = True) -> RunFolder:
    """A new run in a new or empty folder.

    Args:
        wanted: as for `output.new_directory`.
        default: as for `output.new_directory`.
        now: manifest of the run.
        locked: keep other runs out until `RunFolder.release`.

    Raises:
        OutputExists: as `output.new_directory`.
        Busy, NoLocks: as `run_lock.take`.
    """
    created = [folder for folder in (wanted or default).parents if not folder.exists()]
    existed = wanted is not None and wanted.exists()
    target = new_directory(wanted, default)
    created = created if existed else [target, *created]
    lock = None
    try:
        lock = take(target) if locked else None
        # Another run may have come, and gone, since the folder was seen to be empty.
        refuse_full(target, held=locked)
    except BaseException:
        if lock is not None:
            lock.release()
        _remove_empty(created)
        raise
    run = RunFolder(target, now, tuple(created), lock)
    try:
        run.checkpoint.mkdir()
        manifests.write(run.checkpoint / "run.json", now)
    except BaseException:
        abandon(run)
        raise
    return run


def go_on(target: Path, now: Manifest, *, force: bool = False) -> RunFolder:
    """The unfinished run in `target`.

    Args:
        now: what would be run now.
        force: go on even if something has changed that decides the numbers.

    Raises:
        NoRun: there is none, or it is another one; the message says what differs.
    """
    if not (target / ".run").is_dir():
        raise NoRun(f"{target} holds no unfinished run; leave --resume out to start one")
    was, note = known_manifest(target)
    if was is None:
        if saved_shards(target):
            raise NoRun(f"{target}: {note}; choose another --out")
        was = now
    was = dataclasses.replace(
        was,
        options=sorted({*was.options, *now.options}),
        forced=[*was.forced, *_passed(target, was, now, force)],
    )
    for pattern in ("*.npz.*", "*run.json.*"):  # of processes that died while they wrote
        for path in (target / ".run").glob(pattern):
            path.unlink()
    manifests.write(target / ".run" / "run.json", was)
    return RunFolder(target, was, note=note)


def known_manifest(target: Path) -> tuple[Manifest | None, str]:
    """The manifest of the unfinished run in `target`: run.json, or what its shards say.

    Every shard holds the manifest of its run, so that a damaged run.json costs none of them.

    Returns:
        The manifest, None where there is none to be read; and what the user should know of that.
    """
    folder = target / ".run"
    try:
        return manifests.read(folder / "run.json"), ""
    except (OSError, ValueError) as error:
        lost = f"its run.json cannot be read ({_reason(error)})"
    told = [j for path in sorted(folder.glob("*.npz")) if (j := read_manifest(path)) is not None]
    shards = len(told)
    with contextlib.suppress(OSError, ValueError):
        told.append(manifests.read(manifests.previous(folder / "run.json")))
    if not told:
        if not (count := saved_shards(target)):
            return None, f"{lost}; nothing was saved yet"
        return None, (
            f"{lost}, and none of its {count} shards says which specification, inputs and settings "
            "it belongs to, so that they cannot be verified"
        )
    name = collections.Counter(j.id for j in told).most_common(1)[0][0]
    told = [j for j in told if j.id == name]
    manifest = dataclasses.replace(
        max(told, key=lambda j: len(j.forced)),
        options=sorted({option for j in told for option in j.options}),
    )
    source = f"its {shards} shards" if shards else manifests.previous(folder / "run.json").name
    return manifest, f"{lost}; it was rebuilt from {source}"


def _reason(error: Exception) -> str:
    return (isinstance(error, OSError) and error.strerror) or str(error)


def _passed(target: Path, was: Manifest, now: Manifest, force: bool) -> list[str]:
    """What differs, where the user forces it or has before."""
    changed = [line for line in manifests.differences(was, now) if line not in was.forced]
    if was.lanes != now.lanes:
        raise NoRun(
            f"{target}: {'; '.join(changed)}; the run there is of another study, "
            "choose another --out"
        )
    if changed and not force:
        raise NoRun(
            f"{target}: {'; '.join(changed)}; undo that, or choose another --out, "
            "or mix old and new with --force"
        )
    return changed


def digest(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def stage(run: RunFolder) -> Path:
    """An empty folder for the files of the finished run."""
    shutil.rmtree(run.staging, ignore_errors=True)
    run.staging.mkdir()
    return run.staging


def commit(run: RunFolder) -> None:
    """Replace the shards, and the files of an earlier run, by what was staged."""
    for path in run.staging.iterdir():
        with path.open("rb+") as stream:
            os.fsync(stream.fileno())
    run.staging.rename(run.target / ".written")
    complete(run.target)


def complete(target: Path) -> bool:
    """Bring a run to its end that was stopped while its files moved; returns whether one was."""
    written = target / ".written"
    if not written.is_dir():
        return False
    for path in sorted(written.iterdir()):
        path.replace(target / path.name)
    (target / SO_FAR).unlink(missing_ok=True)
    for folder in (".unfinished", ".run"):
        shutil.rmtree(target / folder, ignore_errors=True)
    written.rmdir()
    return True


def abandon(run: RunFolder) -> bool:
    """Clear up after a run that was stopped; returns whether anything of it is kept."""
    shutil.rmtree(run.staging, ignore_errors=True)
    if saved_shards(run.target):
        return True
    shutil.rmtree(run.checkpoint, ignore_errors=True)
    run.release()
    _remove_empty(run.created)
    return False


def _remove_empty(folders: Iterable[Path]) -> None:
    for folder in folders:
        with contextlib.suppress(OSError):
            folder.rmdir()
