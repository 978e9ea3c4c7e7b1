"""How `jaxtrachea fit` begins, goes on and shares its work; the fitting is in the rooms below."""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import typer
from rich.markup import escape

from jaxtrachea.cli.options import FitOptions
from jaxtrachea.cli.terminal import (
    Interrupts,
    Kept,
    Stop,
    interrupts,
    set_up_jax,
    to_stderr,
)

#: Called with (jobs finished since the last call, jobs in all).
Progress = Callable[[int, int], None]


@dataclasses.dataclass(frozen=True)
class Run:
    """A run under way.

    Attributes:
        folder: where its files are written.
        options: to be done after the fit.
        manifest: as JSON.
        settings: of the solver.
        fit: as `fitting.fit.fit`, in shards.
        stop_if_asked: raises KeyboardInterrupt if Ctrl-C came.
    """

    folder: Path
    options: list[str]
    manifest: dict[str, object]
    settings: Any
    fit: Callable[[Any, Any, Progress], Any]
    stop_if_asked: Callable[[], None]


def check_options(options: FitOptions) -> None:
    """Refuse options that contradict each other."""
    if options.resume and options.rerun_failed:
        raise Stop("--resume and --rerun-failed exclude each other; an unfinished rerun is resumed")
    if options.continues and options.out_dir is None:
        raise Stop("say with --out which run to go on with")
    if options.force and not options.continues:
        raise Stop("--force goes with --resume or --rerun-failed")
    if options.scheduler is not None and options.threads is not None:
        raise Stop("--threads is of this process, and with --scheduler the workers fit")


def remembered(options: FitOptions) -> list[str]:
    """Options that the run to go on with was started with; none if there is none to be read."""
    from jaxtrachea.runs import folder as run_folder
    from jaxtrachea.runs import rerun

    if options.out_dir is None or not options.continues:
        return []
    manifest, _ = run_folder.known_manifest(options.out_dir)
    if manifest is not None:
        return manifest.options
    try:
        return rerun.read_manifest(options.out_dir / "results.h5").options
    except run_folder.NoRun:
        return []


def worker_devices(options: FitOptions) -> list:
    """The device of each thread that fits shards; `Stop` where `--threads` cannot be."""
    from jaxtrachea.runs import shards

    try:
        return shards.worker_devices(options.threads)
    except ValueError as error:
        raise Stop(f"--threads: {error}; leave it out") from None


def describe(options: FitOptions, loaded, measurements, study, analyses: list[str], devices: list):
    """The manifest of what would be run now, its shards on these devices."""
    import jax

    from jaxtrachea.cli.specification import settings_of
    from jaxtrachea.runs import manifest, shards

    asked, settings = loaded.fit, settings_of(loaded)
    device = jax.local_devices()[0].device_kind
    root = options.spec.parent if options.data is None else options.data
    batch, every = asked.batch, "auto" if study.joint else asked.save_every
    if every == "auto":
        every = shards.lanes_per_shard(study, settings.starts)
    lanes = study.lanes.lower.shape[0]
    if batch == "auto":
        workers = min(len(devices), -(-lanes // every))
        batch = shards.slots(study, shards.free_memory(workers))
    else:
        batch = min(batch, study.max_batch)
    return manifest.describe(
        options.spec, root, measurements.sha256(), asked.precision, device,
        lanes=lanes, batch=batch, save_every=every, options=analyses,
    )  # fmt: skip


def open_run(options: FitOptions, now, study):
    """New, resumed or rerun, as the user asks; ends the command where there is nothing to do.

    The folder is locked until `RunFolder.release`.
    """
    from jaxtrachea.files.lock import take

    target, lock, going_on = options.out_dir, None, options.continues
    if target is not None and not options.no_lock:
        written, unfinished = ((target / name).is_dir() for name in (".written", ".run"))
        again = options.rerun_failed and (target / "results.h5").exists()
        if written or (going_on and unfinished) or again:
            lock = take(target)
    try:
        run = _opened(options, now, study)
    except BaseException:
        if lock is not None:
            lock.release()
        raise
    return run if lock is None else dataclasses.replace(run, lock=lock)


def _opened(options: FitOptions, now, study):
    """As `open_run`; a folder that is there is locked already."""
    from jaxtrachea.files.output import InUse, OutputExists
    from jaxtrachea.runs import folder as run_folder

    target = options.out_dir
    if target is not None and target.is_dir() and run_folder.complete(target):
        to_stderr(
            f"the files of a run that was stopped as it ended are now in {escape(str(target))}"
        )
    if target is None or not options.continues:
        try:
            return run_folder.claim(target, options.default_folder, now, locked=not options.no_lock)
        except OutputExists as error:
            hint = target is not None and (target / ".run").is_dir()
            hint = hint and not isinstance(error, InUse)
            raise Stop(f"{error}" + (", or go on with --resume" if hint else "")) from None
    unfinished = (target / ".run").is_dir()
    if not unfinished and (target / "results.h5").exists():
        return _finished(options, target, now, study)
    run = run_folder.go_on(target, now, force=options.force)
    if options.rerun_failed and run.manifest.rerun is None:
        raise Stop(f"{target} is not finished; use --resume first")
    return run


def _finished(options: FitOptions, target: Path, now, study):
    """A rerun of the failed lanes of a finished run, if that is asked for."""
    from jaxtrachea.results.read import read_again
    from jaxtrachea.runs import manifest, rerun

    was = rerun.read_manifest(target / "results.h5")
    changed = list(manifest.differences(was, now))
    if changed and not (options.force and was.lanes == now.lanes):
        raise Stop(f"{target} is finished, and {'; '.join(changed)}; choose another --out")
    if options.resume:
        to_stderr(f"{escape(str(target))} is finished; there is nothing to go on with")
        raise typer.Exit(0)
    if study.joint:
        raise Stop(
            "--rerun-failed: specimens of a joint fit are fitted together; change [fit] starts"
        )
    result = read_again(target / "results.h5", study)
    failed = rerun.failed_lanes(result)
    if not failed:
        to_stderr(f"no lane of {escape(str(target))} failed; there is nothing to fit again")
        raise typer.Exit(0)
    return rerun.begin(target, was, now, failed)


@contextlib.contextmanager
def running(options: FitOptions, now, study, settings, devices: list) -> Iterator[Run]:
    """The run, opened, and put into place at the end; or what is kept is said."""
    from jaxtrachea.runs import checkpoint, cluster, manifest
    from jaxtrachea.runs import folder as run_folder

    with (
        _failures_as_messages(options),
        _cluster(options.scheduler) as client,
        interrupts() as ctrl_c,
    ):
        ctrl_c.hold()
        run = open_run(options, now, study)
        try:
            ctrl_c.let_through()
            todo, damaged = checkpoint.missing(run, study)
            _say_what_is_there(run, study, todo, damaged)

            def fit(_, settings, progress):
                if client is None:
                    _fit_shards(run, study, settings, todo, progress, devices, ctrl_c)
                else:
                    asked = checkpoint.settings_for(run, settings)
                    cluster.fit_shards(run, study, asked, todo, progress, client, set_up_jax)
                return checkpoint.collect(run, study)

            settings = dataclasses.replace(settings, batch=run.manifest.batch)
            staged, asked = run_folder.stage(run), run.manifest.options
            written = manifest.as_dict(run.manifest)
            yield Run(staged, asked, written, settings, fit, ctrl_c.stop_if_asked)
            ctrl_c.stop_if_asked()
            ctrl_c.hold()
            run_folder.commit(run)
        except BaseException as error:
            ctrl_c.hold()
            kept = run_folder.abandon(run)
            if kept and isinstance(error, KeyboardInterrupt | cluster.Lost | OSError):
                raise _kept(run, study, error) from None
            raise
        finally:
            run.release()


def _fit_shards(
    run, study, settings, todo: list[int], progress: Progress, devices: list, ctrl_c: Interrupts
) -> None:
    """Fit shards and save them; several threads raise Ctrl-C at their next step, and end first.

    One thread is interrupted where it is.
    """
    from jaxtrachea.runs import checkpoint

    settings = checkpoint.settings_for(run, settings)
    several = min(len(devices), len(todo)) > 1
    if several:
        ctrl_c.hold()
    try:
        checkpoint.fit_shards(run, study, settings, todo, progress, devices)
    finally:
        if several:
            ctrl_c.let_through()


@contextlib.contextmanager
def _cluster(address: str | None) -> Iterator[Any]:
    """The cluster at an address; `Stop` where there is none to be used."""
    if address is None:
        yield None
        return
    from jaxtrachea.runs import cluster

    try:
        with cluster.connected(address) as client:
            yield client
    except cluster.NoCluster as error:
        raise Stop(f"--scheduler: {error}") from None


@contextlib.contextmanager
def _failures_as_messages(options: FitOptions) -> Iterator[None]:
    """Failures to open or write a run become messages."""
    from jaxtrachea.files.lock import Busy, NoLocks
    from jaxtrachea.results.read import NoResults
    from jaxtrachea.runs.cluster import Lost
    from jaxtrachea.runs.folder import NoRun

    try:
        yield
    except (NoRun, NoResults, Busy, NoLocks) as error:
        raise Stop(str(error)) from None
    except Lost as error:
        raise Kept(f"error: {error}", 3) from None
    except OSError as error:
        raise Stop(_unwritable(options, error)) from None


def _unwritable(options: FitOptions, error: OSError) -> str:
    """What is said of a folder that a run could not even be opened in, or that keeps nothing."""
    from jaxtrachea.files.atomic import cure
    from jaxtrachea.runs.folder import saved_shards

    where, reason = options.folder, error.strerror or str(error)
    text = f"{where}: cannot be written ({reason}); "
    if not options.continues:
        return f"{text}choose another --out"
    kept = saved_shards(where)
    if kept:
        text += f"{kept} finished shard{'s are' if kept > 1 else ' is'} kept there; "
    return f"{text}{cure(error)}, then give the same command again"


def _say_what_is_there(run, study, todo: list[int], damaged: list[int]) -> None:
    from jaxtrachea.runs import checkpoint

    count = checkpoint.count(run, study)
    if run.note:
        to_stderr(f"[yellow]note:[/] {escape(f'{run.target}: {run.note}')}")
    if damaged:
        names = ", ".join(run.shard(k).name for k in damaged)
        to_stderr(f"damaged, fitted again: {escape(names)}")
    if len(todo) < count:
        where = escape(str(run.target))
        to_stderr(f"going on in {where}: {count - len(todo)} of {count} shards are there")


def _kept(run, study, error: BaseException) -> Kept:
    """What is kept of a run that was stopped, and how to go on; writes the lanes so far."""
    from jaxtrachea.files.atomic import cure
    from jaxtrachea.runs import checkpoint
    from jaxtrachea.runs import folder as run_folder
    from jaxtrachea.runs.cluster import Lost

    done, count = run_folder.saved_shards(run.target), checkpoint.count(run, study)
    text = f"{done} of {count} shards are kept in {run.target}"
    if run.manifest.rerun is None and done:
        with contextlib.suppress(OSError):
            checkpoint.write_so_far(run.target / run_folder.SO_FAR, run, study)
            text += f", their fits in {run_folder.SO_FAR}"
    first = f"{cure(error)}, then " if isinstance(error, OSError) else ""
    text = escape(f"{text}; {first}go on with --out {run.target} --resume")
    if isinstance(error, KeyboardInterrupt):
        return Kept(f"stopped; {text}")
    reason = (isinstance(error, OSError) and error.strerror) or str(error)
    return Kept(
        f"[bold red]error:[/] {escape(reason)}; {text}", 3 if isinstance(error, Lost) else 2
    )
