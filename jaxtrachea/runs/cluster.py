"""Shards of a fit as tasks of a dask cluster: this process reads and writes, the workers fit.

A worker needs this version of the package and nothing else: data and results travel by the
scheduler. No more shards are sent out than the workers have threads, so that none waits on a
worker that dies; a shard whose worker is lost goes to another one.
"""

import contextlib
import logging
import socket
import time
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from typing import Any

import numpy as np

from jaxtrachea.fitting.settings import Settings
from jaxtrachea.fitting.study import Study
from jaxtrachea.results.arrays import arrays_of, result_of
from jaxtrachea.runs.checkpoint import fitted_lanes, shards_of
from jaxtrachea.runs.folder import RunFolder
from jaxtrachea.runs.manifest import versions
from jaxtrachea.runs.shards import save

#: Workers that a shard may lose before it is taken for the cause.
MOST_LOST = 3
#: Seconds to find the scheduler and a worker, and to wait without any.
PATIENCE = 30.0
#: Seconds between two looks at the cluster.
LOOK = 1.0


class NoCluster(ValueError):
    """There is no cluster that could take the work."""


class Lost(Exception):
    """The cluster is gone."""


@contextlib.contextmanager
def connected(address: str) -> Iterator[Any]:
    """A cluster with at least one worker.

    Raises:
        NoCluster: dask is not installed, nothing answers, or there is no worker.
    """
    try:
        from distributed import Client

        logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # what matters is raised
    except ImportError:
        cure = "run pip install 'jaxtrachea[cluster]'"
        raise NoCluster(f"dask.distributed is not installed; {cure}") from None
    try:
        client = Client(address, timeout=PATIENCE)
    except (OSError, ValueError) as error:
        cure = "start one with 'dask scheduler' and give its address, HOST:PORT"
        raise NoCluster(f"no scheduler answers at {address} ({error}); {cure}") from None
    with client:
        try:
            client.wait_for_workers(1, timeout=PATIENCE)
        except TimeoutError:
            cure = f"start workers with 'dask worker {address}'"
            raise NoCluster(f"the scheduler at {address} has no worker; {cure}") from None
        yield client


def fit_shards(
    run: RunFolder,
    study: Study,
    settings: Settings,
    todo: list[int],
    progress: Callable[[int, int], None],
    client: Any,
    prepare: Callable[[], None],
) -> None:
    """Fit shards on a cluster and save each as soon as it is there.

    Args:
        settings: of the run, as `checkpoint.settings_for` gives them.
        todo: shards, as `checkpoint.missing` gives them.
        progress: as for `fit.fit`; what it raises ends the work.
        prepare: called in a worker before it fits.

    Raises:
        Lost: the scheduler is gone, no worker is left, or one shard has lost several.
        NoCluster: a worker would give other numbers, whenever it came.
    """
    from distributed import KilledWorker, wait

    part = fitted_lanes(run, study)
    shards = shards_of(run, part)
    jobs = settings.starts * sum(len(shards[k]) for k in todo)
    waiting, lost, under_way = list(reversed(todo)), dict.fromkeys(todo, 0), {}
    seen, software = time.monotonic(), computes_with()
    try:
        while waiting or under_way:
            threads = _threads(client)
            seen = time.monotonic() if threads else seen
            if time.monotonic() - seen > PATIENCE:
                raise Lost(f"the cluster has had no worker for {PATIENCE:g} s")
            while waiting and len(under_way) < threads:
                k = waiting.pop()
                arguments = part.take(shards[k]), settings, prepare, software
                key = f"{run.manifest.id}-{k}-{lost[k]}"
                under_way[client.submit(_fit_shard, *arguments, key=key, retries=0)] = k
            if under_way:
                with contextlib.suppress(TimeoutError):
                    with _answering():
                        wait(list(under_way), timeout=LOOK, return_when="FIRST_COMPLETED")
            else:
                time.sleep(LOOK)
            for future in [f for f in under_way if f.done()]:
                k = under_way.pop(future)
                try:
                    with _answering():
                        arrays = future.result()
                except KilledWorker:
                    lost[k] += 1
                    if lost[k] >= MOST_LOST:
                        raise Lost(f"shard {k} has lost {MOST_LOST} workers") from None
                    waiting.append(k)
                    continue
                save(run.shard(k), run.manifest, shards[k], result_of(part.take(shards[k]), arrays))
                progress(settings.starts * len(shards[k]), jobs)
            progress(0, jobs)
    finally:
        with contextlib.suppress(OSError, CancelledError):
            client.cancel(list(under_way))


def _threads(client: Any) -> int:
    """Threads of all workers of a cluster.

    Raises:
        Lost: its scheduler is gone.
    """
    with _answering():
        threads: Any = client.nthreads()
    return sum(threads.values())


@contextlib.contextmanager
def _answering() -> Iterator[None]:
    """Calls to a scheduler, each of which says in its own way that it is gone."""
    try:
        yield
    except TimeoutError:
        raise
    except (OSError, CancelledError):
        raise Lost("the scheduler is gone") from None


def computes_with() -> dict[str, str]:
    """Versions of what computes here, and the kind of device."""
    import jax

    return versions() | {"device": jax.local_devices()[0].device_kind}


def refuse_other(expected: dict[str, str]) -> None:
    """Refuse to compute with anything else, as another worker's numbers would be others.

    Raises:
        NoCluster: with what is otherwise here.
    """
    other = [f"{name} {v}" for name, v in computes_with().items() if expected.get(name) != v]
    if other:
        cure = "install on all what the command has"
        raise NoCluster(f"a worker on {socket.gethostname()} has {', '.join(other)}; {cure}")


def _fit_shard(
    part: Study, settings: Settings, prepare: Callable[[], None], expected: dict[str, str]
) -> dict[str, np.ndarray]:
    """Fit in a worker; arrays of the result.

    Raises:
        NoCluster: as `refuse_other`.
    """
    from jaxtrachea.fitting.fit import fit

    prepare()
    refuse_other(expected)
    return arrays_of(fit(part, settings, lambda done, of: None))
