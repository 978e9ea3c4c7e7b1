"""A fit saved as it goes on: finished shards are read from the folder, missing ones are fitted."""

import contextlib
import dataclasses
import itertools
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import numpy as np

from jaxtrachea._memory import give_back
from jaxtrachea.files.table import Table
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.fitting.study import Study
from jaxtrachea.inference.analyses import widened
from jaxtrachea.optimisation.programs import forget
from jaxtrachea.results.read import read_again
from jaxtrachea.results.rows import summary_rows
from jaxtrachea.runs.folder import NoRun, RunFolder, digest
from jaxtrachea.runs.shards import divide, join, load, replaced, save

#: A rerun of failed lanes has so many times more starts.
MORE_STARTS = 4
#: Shards after which their programs are let go: those of few lanes come to 200 MB in so many, and
#: what all lanes want is loaded again in a second.
SHARDS = 12
#: Seconds between two looks at the threads.
LOOK = 0.02


def fitted_lanes(run: RunFolder, study: Study) -> Study:
    """What a run fits: the study, or its failed lanes."""
    return study if run.manifest.rerun is None else study.take(np.array(run.manifest.rerun.lanes))


def settings_for(run: RunFolder, settings: Settings) -> Settings:
    """Settings of a run: a rerun has more and other starts."""
    settings = dataclasses.replace(settings, batch=run.manifest.batch)
    if run.manifest.rerun is None:
        return settings
    starts, seed = MORE_STARTS * settings.starts, settings.seed + run.manifest.rerun.count
    return dataclasses.replace(settings, starts=starts, seed=seed)


def missing(run: RunFolder, study: Study) -> tuple[list[int], list[int]]:
    """Shards that are still to be fitted, and those among them whose file cannot be used."""
    part, todo, damaged = fitted_lanes(run, study), [], []
    for k, lanes in enumerate(shards_of(run, part)):
        if _read(run, k, part.take(lanes), lanes) is None:
            todo.append(k)
            if run.shard(k).exists():
                damaged.append(k)
    return todo, damaged


def fit_shards(
    run: RunFolder,
    study: Study,
    settings: Settings,
    todo: list[int],
    progress: Callable[[int, int], None],
    devices: list,
) -> None:
    """Fit shards and save each as soon as it is done, a thread for each device.

    Args:
        settings: of the run, as `settings_for` gives them.
        todo: shards, as `missing` gives them.
        progress: as for `fit.fit`, called by one thread at a time; what it raises ends the work.
        devices: of the threads, as `shards.worker_devices` gives them.
    """
    from jaxtrachea.fitting.fit import fit

    part = fitted_lanes(run, study)
    shards, saved = shards_of(run, part), itertools.count(1)
    jobs, telling = settings.starts * sum(len(shards[k]) for k in todo), threading.Lock()

    def one(k: int, end: _End) -> None:
        def tell(done: int, of: int) -> None:
            with telling:
                if end.now:
                    raise _Ended
                progress(done, jobs)

        result = fit(part.take(shards[k]), settings, tell)
        save(run.shard(k), run.manifest, shards[k], result)
        if next(saved) % SHARDS == 0:
            forget()
        give_back()

    _in_threads(one, todo, devices)
    if len(todo) > 1:
        forget()
        give_back()


class _Ended(Exception):
    """Another thread has failed, or was told to stop."""


class _End:
    """Whether the threads are to end: a plain field, since Ctrl-C may come inside any lock."""

    now = False


def _in_threads(work: Callable[[int, _End], None], items: list[int], devices: list) -> None:
    """Do the work for every item, a thread for each device named.

    The first error, or Ctrl-C, ends all: the others are told by what the work is given.
    """
    devices = devices[: len(items)]
    end = _End()
    if len(devices) < 2:
        for item in items:
            work(item, end)
        return
    waiting, lock, several = iter(items), threading.Lock(), len(set(devices)) > 1
    failures: list[BaseException] = []

    def on(device) -> None:
        # A device that is named has programs of its own: not where there is but one.
        try:
            with jax.default_device(device) if several else contextlib.nullcontext():
                while not end.now:
                    with lock:
                        item = next(waiting, None)
                    if item is None:
                        return
                    work(item, end)
        except BaseException as error:
            failures.append(error)
            end.now = True

    threads = [threading.Thread(target=on, args=(device,)) for device in devices]
    try:
        for thread in threads:
            thread.start()
        _wait_for(threads)
    except BaseException:
        end.now = True
        while _at_work(threads):  # whoever is told that all has ended may put the folder away
            with contextlib.suppress(KeyboardInterrupt):
                _wait_for(threads)
        raise
    if failures:
        raise failures[0]


def _wait_for(threads: list[threading.Thread]) -> None:
    """Until all have ended; in short sleeps, since some systems hold Ctrl-C back in a long one."""
    while _at_work(threads):
        time.sleep(LOOK)


def _at_work(threads: list[threading.Thread]) -> bool:
    return any(thread.is_alive() for thread in threads)


def collect(run: RunFolder, study: Study) -> FitResult:
    """The result of the whole study, out of the shards and, in a rerun, of the result before it.

    Raises:
        NoRun: a shard cannot be read back, or the result before the rerun has changed.
    """
    part = fitted_lanes(run, study)
    result = join(part, _every_shard(run, part))
    again = run.manifest.rerun
    if again is None:
        return result
    path = run.target / "results.h5"
    if digest(path) != again.results:
        raise NoRun(f"{path} has changed since its failed lanes were fitted again")
    return replaced(read_again(path, study), np.array(again.lanes), result)


def _every_shard(run: RunFolder, part: Study) -> Iterator[FitResult]:
    """The results of all shards, one after the other."""
    for k, lanes in enumerate(shards_of(run, part)):
        if (found := _read(run, k, part.take(lanes), lanes)) is None:
            raise NoRun(f"{run.shard(k)} cannot be read")
        yield found


def write_so_far(path: Path, run: RunFolder, study: Study) -> None:
    """Write the rows of summary.csv of the lanes that are fitted."""
    rows = []
    for k, lanes in enumerate(shards_of(run, study)):
        part = _read(run, k, study.take(lanes), lanes)
        if part is not None:
            rows += summary_rows(widened(part))
    try:
        Table(rows).write_csv(path)
    except OSError:
        path.unlink(missing_ok=True)  # not half a table
        raise


def count(run: RunFolder, study: Study) -> int:
    """Shards of a run."""
    return len(shards_of(run, fitted_lanes(run, study)))


def shards_of(run: RunFolder, part: Study) -> list[np.ndarray]:
    """Lanes of every shard of what a run fits."""
    return divide(part.lanes.lower.shape[0], run.manifest.save_every)


def _read(run: RunFolder, k: int, part: Study, lanes: np.ndarray) -> FitResult | None:
    return load(run.shard(k), run.manifest.id, lanes, part)
