"""A fit whose finished chunks lie in a folder: what is missing is fitted, what is there is read."""

import dataclasses
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import numpy as np

from jaxtrachea.files.tables import write_csv
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.fitting.study import Study
from jaxtrachea.inference.analyses.effective import widened
from jaxtrachea.results.hdf5 import read_hdf5
from jaxtrachea.results.rows import summary_rows
from jaxtrachea.runs.chunks import divide, join, load, replaced, save
from jaxtrachea.runs.folder import NoRun, RunFolder, digest

#: A rerun of failed lanes has so many times more starts.
MORE_STARTS = 4


def fitted_lanes(run: RunFolder, study: Study) -> Study:
    """What a run fits: the study, or its failed lanes."""
    return study if run.journal.rerun is None else study.take(np.array(run.journal.rerun.lanes))


def settings_for(run: RunFolder, settings: Settings) -> Settings:
    """Settings of a run: a rerun has more and other starts."""
    settings = dataclasses.replace(settings, batch=run.journal.chunk)
    if run.journal.rerun is None:
        return settings
    starts, seed = MORE_STARTS * settings.starts, settings.seed + run.journal.rerun.count
    return dataclasses.replace(settings, starts=starts, seed=seed)


def missing(run: RunFolder, study: Study) -> tuple[list[int], list[int]]:
    """Chunks that are still to be fitted, and those among them whose file cannot be used."""
    part, todo, damaged = fitted_lanes(run, study), [], []
    for k, lanes in enumerate(_chunks(run, part)):
        if _read(run, k, part.take(lanes), lanes) is None:
            todo.append(k)
            if run.chunk(k).exists():
                damaged.append(k)
    return todo, damaged


def fit_chunks(
    run: RunFolder,
    study: Study,
    settings: Settings,
    todo: list[int],
    progress: Callable[[int, int], None],
) -> None:
    """Fit chunks and save each as soon as it is done, on all devices of this process.

    Args:
        run: where to.
        study: the whole study.
        settings: of the run, as `settings_for` gives them.
        todo: chunks, as `missing` gives them.
        progress: as for `fit.fit`; what it raises ends the work.
    """
    from jaxtrachea.fitting.fit import fit

    part = fitted_lanes(run, study)
    chunks = _chunks(run, part)
    jobs = settings.starts * sum(len(chunks[k]) for k in todo)

    def one(k: int) -> None:
        lanes = chunks[k]
        result = fit(part.take(lanes), settings, lambda done, of: progress(done, jobs))
        save(run.chunk(k), run.journal, lanes, result)

    _on_devices(one, todo, jax.local_devices())


def _on_devices(work: Callable[[int], None], items: list[int], devices: list) -> None:
    """Do the work for every item, one at a time on each device; the first error ends it."""
    if len(devices) == 1 or len(items) < 2:
        for item in items:
            work(item)
        return
    waiting, failed, lock = iter(items), threading.Event(), threading.Lock()

    def on(device) -> None:
        with jax.default_device(device):
            while not failed.is_set():
                with lock:
                    item = next(waiting, None)
                if item is None:
                    return
                try:
                    work(item)
                except BaseException:
                    failed.set()
                    raise

    with ThreadPoolExecutor(len(devices)) as pool:
        for done in [pool.submit(on, device) for device in devices]:
            done.result()


def collect(run: RunFolder, study: Study) -> FitResult:
    """The result of the whole study, out of the chunks and, in a rerun, of the former result.

    Raises:
        NoRun: a chunk cannot be read back, or the former result is not what it was.
    """
    part = fitted_lanes(run, study)
    found = [_read(run, k, part.take(lanes), lanes) for k, lanes in enumerate(_chunks(run, part))]
    if any(result is None for result in found):
        k = next(k for k, result in enumerate(found) if result is None)
        raise NoRun(f"{run.chunk(k)} cannot be read; do all processes share this folder?")
    result = join(part, [result for result in found if result is not None])
    again = run.journal.rerun
    if again is None:
        return dataclasses.replace(result, study=study)
    path = run.target / "results.h5"
    if digest(path) != again.former:
        raise NoRun(f"{path} has changed since its failed lanes were fitted again")
    return replaced(read_hdf5(path, study), np.array(again.lanes), result)


def write_so_far(path: Path, run: RunFolder, study: Study) -> None:
    """Write the rows of summary.csv of the lanes that are fitted."""
    rows = []
    for k, lanes in enumerate(_chunks(run, study)):
        part = _read(run, k, study.take(lanes), lanes)
        if part is not None:
            rows += summary_rows(widened(part))
    try:
        write_csv(path, rows)
    except OSError:
        path.unlink(missing_ok=True)  # not half a table
        raise


def count(run: RunFolder, study: Study) -> int:
    """Chunks of a run."""
    return len(_chunks(run, fitted_lanes(run, study)))


def _chunks(run: RunFolder, part: Study) -> list[np.ndarray]:
    return divide(part.lanes.lower.shape[0], run.journal.save_every)


def _read(run: RunFolder, k: int, part: Study, lanes: np.ndarray) -> FitResult | None:
    return load(run.chunk(k), run.journal.id, lanes, part)
