"""How `jaxtrachea fit` begins, goes on and shares its work; the fitting is in the rooms below."""

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape

from jaxtrachea.cli.terminal import Kept, Stages, Stop, interrupts, progress_bar, to_stderr
from jaxtrachea.runs import processes
from jaxtrachea.runs.processes import Lost, Meeting

ResumeOption = Annotated[bool, typer.Option("--resume", help="Go on where OUT stopped.")]
RerunOption = Annotated[
    bool, typer.Option("--rerun-failed", help="Fit the failed lanes of OUT again.")
]
ForceOption = Annotated[bool, typer.Option("--force", help="Go on though inputs have changed.")]
NoLockOption = Annotated[
    bool, typer.Option("--no-lock", help="Start where the file system has no locks.")
]
DistributedOption = Annotated[
    bool, typer.Option("--distributed", help="Share the work as the cluster says.")
]
CoordinatorOption = Annotated[
    str | None, typer.Option("--coordinator", help="HOST:PORT of process 0.")
]
ProcessesOption = Annotated[int | None, typer.Option("--processes", min=1, help="How many.")]
ProcessOption = Annotated[int | None, typer.Option("--process", min=0, help="Which is this.")]
PatienceOption = Annotated[
    float, typer.Option("--patience", min=1.0, help="Silent seconds till one is lost.")
]

#: Called with (jobs finished since the last call, jobs in all).
Progress = Callable[[int, int], None]


@dataclasses.dataclass(frozen=True)
class How:
    """What the user asks of a run.

    Attributes:
        out_dir: folder, or None.
        default: folder where none is named.
        resume: go on with an unfinished run.
        rerun_failed: fit the failed lanes of a finished run again.
        force: whatever has changed.
        meeting: who takes part.
        lock: keep other runs out of the folder.
    """

    out_dir: Path | None
    default: Path
    resume: bool
    rerun_failed: bool
    force: bool
    meeting: Meeting
    lock: bool = True


@dataclasses.dataclass(frozen=True)
class Run:
    """A run under way.

    Attributes:
        folder: where its files are written.
        options: to be done after the fit.
        journal: as JSON.
        settings: of the solver.
        fit: as `fitting.fit.fit`, in chunks.
        stop_if_asked: raises KeyboardInterrupt if Ctrl-C came, `Lost` if a process is gone.
    """

    folder: Path
    options: list[str]
    journal: dict[str, object]
    settings: Any
    fit: Callable[[Any, Any, Progress], Any]
    stop_if_asked: Callable[[], None]


def meet(
    distributed: bool,
    coordinator: str | None,
    count: int | None,
    process: int | None,
    patience: float,
) -> Meeting:
    """Wait for the other processes, if there are any; `Stop` if they cannot be found."""
    named = (coordinator, count, process)
    if not distributed and named == (None, None, None):
        return Meeting()
    if not distributed and None in named:
        raise Stop("--coordinator, --processes and --process go together, or use --distributed")
    try:
        return processes.meet(coordinator, count, process, patience)
    except Lost as error:
        cure = "give --coordinator, --processes and --process"
        raise Stop(f"--distributed: {error}; {cure}") from None


def check_options(how: How) -> None:
    """Refuse options that contradict each other."""
    if how.resume and how.rerun_failed:
        raise Stop("--resume and --rerun-failed exclude each other; an unfinished rerun is resumed")
    if (how.resume or how.rerun_failed) and how.out_dir is None:
        raise Stop("say with --out which run to go on with")
    if how.force and not (how.resume or how.rerun_failed):
        raise Stop("--force goes with --resume or --rerun-failed")
    if how.meeting.processes > 1 and how.out_dir is None:
        raise Stop("several processes need --out, a folder that all of them see")


def remembered(how: How) -> list[str]:
    """Options that the run to go on with was started with; none if there is none to be read."""
    from jaxtrachea.runs import folder as run_folder
    from jaxtrachea.runs import former

    if how.out_dir is None or not (how.resume or how.rerun_failed):
        return []
    journal, _ = run_folder.known_journal(how.out_dir)
    if journal is not None:
        return journal.options
    try:
        return former.read_journal(how.out_dir / "results.h5").options
    except run_folder.NoRun:
        return []


def describe(how: How, spec: Path, root: Path, loaded, measurements, study, options: list[str]):
    """The journal of what would be run now."""
    import jax

    from jaxtrachea.cli.specification import settings_of
    from jaxtrachea.runs import chunks, journal

    asked, settings = loaded.fit, settings_of(loaded)
    batch, every = asked.batch, "auto" if study.joint else asked.save_every
    return journal.describe(
        spec, root, measurements.sha256(), asked.precision, jax.local_devices()[0].device_kind,
        lanes=study.lanes.lower.shape[0],
        chunk=chunks.seats(study, chunks.free_memory()) if batch == "auto" else batch,
        save_every=chunks.lanes_per_chunk(study, settings.starts) if every == "auto" else every,
        options=options,
    )  # fmt: skip


def open_run(how: How, now, study):
    """New, resumed or rerun, as the user asks; ends the command where there is nothing to do.

    The folder is locked until `RunFolder.release`.
    """
    from jaxtrachea.files.lock import take

    target, lock, going_on = how.out_dir, None, how.resume or how.rerun_failed
    if target is not None and how.lock:
        written, unfinished = ((target / name).is_dir() for name in (".written", ".run"))
        again = how.rerun_failed and (target / "results.h5").exists()
        if written or (going_on and unfinished) or again:
            lock = take(target)
    try:
        run = _opened(how, now, study)
    except BaseException:
        if lock is not None:
            lock.release()
        raise
    return run if lock is None else dataclasses.replace(run, lock=lock)


def _opened(how: How, now, study):
    """As `open_run`; a folder that is there is locked already."""
    from jaxtrachea.files.output import InUse, OutputExists
    from jaxtrachea.runs import folder as run_folder

    target = how.out_dir
    if target is not None and target.is_dir() and run_folder.complete(target):
        to_stderr(
            f"the files of a run that was stopped as it ended are now in {escape(str(target))}"
        )
    if target is None or not (how.resume or how.rerun_failed):
        try:
            return run_folder.claim(target, how.default, now, locked=how.lock)
        except OutputExists as error:
            hint = target is not None and (target / ".run").is_dir()
            hint = hint and not isinstance(error, InUse)
            raise Stop(f"{error}" + (", or go on with --resume" if hint else "")) from None
    unfinished = (target / ".run").is_dir()
    if not unfinished and (target / "results.h5").exists():
        return _finished(how, target, now, study)
    run = run_folder.go_on(target, now, force=how.force)
    if how.rerun_failed and run.journal.rerun is None:
        raise Stop(f"{target} is not finished; use --resume first")
    return run


def _finished(how: How, target: Path, now, study):
    """A rerun of the failed lanes of a finished run, if that is asked for."""
    from jaxtrachea.results.hdf5 import read_hdf5
    from jaxtrachea.runs import folder as run_folder
    from jaxtrachea.runs import former, journal

    was = former.read_journal(target / "results.h5")
    changed = list(journal.differences(was, now))
    if changed and not (how.force and was.lanes == now.lanes):
        raise Stop(f"{target} is finished, and {'; '.join(changed)}; choose another --out")
    if how.resume:
        to_stderr(f"{escape(str(target))} is finished; there is nothing to go on with")
        raise typer.Exit(0)
    if study.joint:
        raise Stop(
            "--rerun-failed: specimens of a joint fit are fitted together; change [fit] starts"
        )
    result = read_hdf5(target / "results.h5", study)
    failed = former.failed_lanes(result)
    if not failed:
        to_stderr(f"no lane of {escape(str(target))} failed; there is nothing to fit again")
        raise typer.Exit(0)
    return run_folder.again(target, was, now, failed)


@contextlib.contextmanager
def running(how: How, now, study, settings) -> Iterator[Run]:
    """The run, opened, watched over, and put into place at the end; or what is kept is said.

    Args:
        how: what the user asks.
        now: journal of what would be run now.
        study: the study.
        settings: of the solver.
    """
    from jaxtrachea.runs import folder as run_folder
    from jaxtrachea.runs import in_chunks, journal

    with _said(how), interrupts() as stop_if_asked:
        run = open_run(how, now, study)
        try:
            todo, damaged = in_chunks.missing(run, study)
            _say_what_is_there(run, study, todo, damaged)
            watch = processes.Watch(run.chunks, how.meeting)
            with _watched(watch, todo=todo):

                def check() -> None:
                    stop_if_asked()
                    watch.check()

                def fit(_, settings, progress):
                    mine = todo[0 :: how.meeting.processes]
                    in_chunks.fit_chunks(
                        run, study, in_chunks.settings_for(run, settings), mine, progress
                    )
                    watch.wait_for_others()
                    return in_chunks.collect(run, study)

                settings = dataclasses.replace(settings, batch=run.journal.chunk)
                staged, options = run_folder.stage(run), run.journal.options
                yield Run(staged, options, journal.as_dict(run.journal), settings, fit, check)
                check()
            run_folder.commit(run)
        except BaseException as error:
            kept = run_folder.abandon(run, shared=how.meeting.processes > 1)
            if kept and isinstance(error, KeyboardInterrupt | Lost | OSError):
                raise _kept(how, run, study, error) from None
            raise
        finally:
            run.release()


def _watched(watch: processes.Watch, **content):
    """Nobody to watch: no file, no thread."""
    return watch.watching(**content) if watch.meeting.processes > 1 else contextlib.nullcontext()


@contextlib.contextmanager
def _said(how: How) -> Iterator[None]:
    """Failures to open or write a run become messages."""
    from jaxtrachea.files.lock import Busy, NoLocks
    from jaxtrachea.results.stored import NoResults
    from jaxtrachea.runs.folder import NoRun

    try:
        yield
    except (NoRun, NoResults, Busy, NoLocks) as error:
        raise Stop(str(error)) from None
    except Lost as error:
        raise Kept(f"error: {error}", 3) from None
    except OSError as error:
        raise Stop(_unwritable(how, error)) from None


def _unwritable(how: How, error: OSError) -> str:
    """What is said of a folder that a run could not even be opened in, or that keeps nothing."""
    from jaxtrachea.files.atomic import cure
    from jaxtrachea.runs.folder import saved_chunks

    where, reason = how.out_dir or how.default, error.strerror or str(error)
    text = f"{where}: cannot be written ({reason}); "
    if not (how.resume or how.rerun_failed):
        return f"{text}choose another --out"
    kept = saved_chunks(where)
    if kept:
        text += f"{kept} finished chunk{'s are' if kept > 1 else ' is'} kept there; "
    return f"{text}{cure(error)}, then give the same command again"


def _say_what_is_there(run, study, todo: list[int], damaged: list[int]) -> None:
    from jaxtrachea.runs import in_chunks

    count = in_chunks.count(run, study)
    if run.note:
        to_stderr(f"[yellow]note:[/] {escape(f'{run.target}: {run.note}')}")
    if damaged:
        names = ", ".join(run.chunk(k).name for k in damaged)
        to_stderr(f"damaged, fitted again: {escape(names)}")
    if len(todo) < count:
        where = escape(str(run.target))
        to_stderr(f"going on in {where}: {count - len(todo)} of {count} chunks are there")


def _kept(how: How, run, study, error: BaseException) -> Kept:
    """What is kept of a run that was stopped, and how to go on; writes the lanes so far."""
    from jaxtrachea.files.atomic import cure
    from jaxtrachea.runs import folder as run_folder
    from jaxtrachea.runs import in_chunks

    done, count = run.finished(), in_chunks.count(run, study)
    text = f"{done} of {count} chunks are kept in {run.target}"
    if run.journal.rerun is None and how.meeting.process == 0 and done:
        with contextlib.suppress(OSError):
            in_chunks.write_so_far(run.target / run_folder.SO_FAR, run, study)
            text += f", their lanes in {run_folder.SO_FAR}"
    first = f"{cure(error)}, then " if isinstance(error, OSError) else ""
    text = escape(f"{text}; {first}go on with --out {run.target} --resume")
    if isinstance(error, KeyboardInterrupt):
        return Kept(f"stopped; {text}")
    reason = (isinstance(error, OSError) and error.strerror) or str(error)
    return Kept(
        f"[bold red]error:[/] {escape(reason)}; {text}", 3 if isinstance(error, Lost) else 2
    )


def help_out(how: How, now, study, settings) -> None:
    """Fit this process's chunks of a run that process 0 has opened, and wait for its end."""
    from jaxtrachea.runs import folder as run_folder
    from jaxtrachea.runs import in_chunks

    target, me = how.out_dir or how.default, how.meeting
    with _said(how), interrupts() as stop_if_asked:
        end = time.monotonic() + me.patience
        while (said := processes.opened(target / ".run", me)) is None:
            stop_if_asked()
            if how.resume and (target / "results.h5").exists() and not (target / ".run").is_dir():
                to_stderr(f"{escape(str(target))} is finished; there is nothing to go on with")
                return
            if time.monotonic() > end:
                raise Lost(f"process 0 has not opened {target} in {me.patience:g} s")
            time.sleep(processes.LOOK)
        run = run_folder.join(target, now)
        watch = processes.Watch(run.chunks, me)
        try:
            with watch.watching(), progress_bar() as bar:

                def look():
                    stop_if_asked()
                    watch.check()

                stages = Stages(bar, look)
                progress = stages.begin(f"fitting ({me.process} of {me.processes})")
                settings = in_chunks.settings_for(run, settings)
                mine = said["todo"][me.process :: me.processes]
                in_chunks.fit_chunks(run, study, settings, mine, progress)
                stages.close()
                watch.done()
                watch.wait_for(0)
        except (KeyboardInterrupt, Lost, OSError) as error:
            raise _kept(how, run, study, error) from None
