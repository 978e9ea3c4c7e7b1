"""The folder of a fit: chunks while it runs, files when it is done; at no moment neither.

    OUT/.run/run.json, 00000.npz, ...   journal and finished chunks
    OUT/.unfinished/                    files being written
    OUT/.written/                       the same, complete, on their way into OUT

The one step that counts is the renaming of `.unfinished` to `.written`: whoever comes before it
finds the chunks, whoever comes after it only moves files.
"""

import contextlib
import dataclasses
import hashlib
import os
import shutil
from pathlib import Path

from jaxtrachea.identify import journal as journals
from jaxtrachea.identify.journal import Journal
from jaxtrachea.identify.output import new_directory

#: Lanes fitted so far, written when the user stops a run; gone when it is finished.
SO_FAR = "summary_so_far.csv"


class NoRun(ValueError):
    """There is nothing to go on with, or it is something else."""


@dataclasses.dataclass(frozen=True)
class RunFolder:
    """A run and where it lies.

    Attributes:
        target: what the user calls the output folder.
        journal: of the run.
        made: folders that did not exist before, innermost first; removed with a run of which
            nothing is kept.
    """

    target: Path
    journal: Journal
    made: tuple[Path, ...] = ()

    @property
    def chunks(self) -> Path:
        """Folder of the journal and the chunks."""
        return self.target / ".run"

    @property
    def staging(self) -> Path:
        """Folder of the files being written."""
        return self.target / ".unfinished"

    def chunk(self, k: int) -> Path:
        """File of chunk k."""
        return self.chunks / f"{k:05d}.npz"

    def finished(self) -> int:
        """Number of chunks that are saved."""
        return len(list(self.chunks.glob("*.npz")))


def claim(wanted: Path | None, default: Path, now: Journal) -> RunFolder:
    """A new run in a new or empty folder.

    Raises:
        OutputExists: as `output.new_directory`.
    """
    made = [folder for folder in (wanted or default).parents if not folder.exists()]
    existed = wanted is not None and wanted.exists()
    target = new_directory(wanted, default)
    run = RunFolder(target, now, tuple(made if existed else [target, *made]))
    try:
        run.chunks.mkdir()
        journals.write(run.chunks / "run.json", now)
    except BaseException:
        abandon(run)
        raise
    return run


def go_on(target: Path, now: Journal, *, force: bool = False) -> RunFolder:
    """The unfinished run in `target`.

    Args:
        target: its folder.
        now: what would be run now.
        force: go on even if something has changed that decides the numbers.

    Raises:
        NoRun: there is none, or it is another one; the message says what differs.
    """
    if not (target / ".run").is_dir():
        raise NoRun(f"{target} holds no unfinished run; leave --resume out to start one")
    try:
        was = journals.read(target / ".run" / "run.json")
    except FileNotFoundError:  # stopped before the first word was written
        was = dataclasses.replace(now)
    except ValueError as error:
        raise NoRun(f"{target}: its journal cannot be read ({error}); start anew") from None
    was = dataclasses.replace(
        was,
        options=sorted({*was.options, *now.options}),
        forced=[*was.forced, *_passed(target, was, now, force)],
    )
    journals.write(target / ".run" / "run.json", was)
    return RunFolder(target, was)


def join(target: Path, now: Journal) -> RunFolder:
    """The run that another process has opened in `target`.

    Raises:
        NoRun: this process would run something else.
    """
    was = journals.read(target / ".run" / "run.json")
    changed = [line for line in journals.differences(was, now) if line not in was.forced]
    if changed:
        raise NoRun(f"{target}: seen from this process, {'; '.join(changed)}")
    return RunFolder(target, was)


def _passed(target: Path, was: Journal, now: Journal, force: bool) -> list[str]:
    """What differs, where the user forces it or has before.

    Raises:
        NoRun: something differs, and must not.
    """
    changed = [line for line in journals.differences(was, now) if line not in was.forced]
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


def again(target: Path, former: Journal, now: Journal, lanes: list[int]) -> RunFolder:
    """A new run over the failed lanes of a finished one.

    Args:
        target: folder of the finished run.
        former: its journal.
        now: what would be run now; its sizes are used.
        lanes: to fit again.
    """
    count = 1 if former.rerun is None else former.rerun.count + 1
    rerun = journals.Rerun(digest(target / "results.h5"), lanes, count)
    options = sorted({*former.options, *now.options})
    journal = dataclasses.replace(now, rerun=rerun, options=options, forced=former.forced)
    run = RunFolder(target, journal, ())
    run.chunks.mkdir()
    journals.write(run.chunks / "run.json", journal)
    return run


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
    """Replace the chunks, and the files of a former run, by what was staged."""
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
    shutil.rmtree(target / ".run", ignore_errors=True)
    shutil.rmtree(target / ".unfinished", ignore_errors=True)
    written.rmdir()
    return True


def abandon(run: RunFolder, *, shared: bool = False) -> bool:
    """Clear up after a run that was stopped; returns whether anything of it is kept.

    Args:
        run: that was stopped.
        shared: other processes may be at work in it.
    """
    shutil.rmtree(run.staging, ignore_errors=True)
    if shared or run.finished():
        return True
    shutil.rmtree(run.chunks, ignore_errors=True)
    for folder in run.made:
        with contextlib.suppress(OSError):
            folder.rmdir()
    return False
