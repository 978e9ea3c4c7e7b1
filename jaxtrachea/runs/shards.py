"""A long fit in shards of lanes, each fitted and saved by itself, all joined at the end.

What a shard gives depends on its own lanes and on the settings alone, and all shards are as large
as each other (within one lane), so that one compiled program serves them. Hence the result does not
depend on when a run was stopped, nor on which process, device or thread fitted which shard.
"""

import contextlib
import io
import json
import os
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from jaxtrachea._threads import usable_cores
from jaxtrachea.files.atomic import write_whole
from jaxtrachea.fitting import lane
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.study import Study
from jaxtrachea.optimisation.batching import max_in_memory, max_slots
from jaxtrachea.results.arrays import arrays_of, result_of
from jaxtrachea.runs import manifest as manifests
from jaxtrachea.runs.manifest import Manifest

#: Lanes of a shard at most, and its residual entries times starts at most: about ten seconds of
#: one core.
MOST_LANES, MOST_ENTRIES = 4096, 4_000_000
#: Threads on the cores of a CPU at most, unless the user says; measured with two.
MOST_THREADS = 8
#: Key of the manifest in the file of a shard.
_MANIFEST = "journal"


def lanes_per_shard(study: Study, starts: int) -> int:
    """Lanes saved together, by the size of the study alone: the same on every machine.

    All of a joint study.
    """
    if study.joint:
        return len(study.curves)
    trials = study.lanes.s_c.shape[1]
    entries = trials * lane.size(study.lanes) * starts
    return max(1, min(MOST_LANES, MOST_ENTRIES // entries))


def divide(lanes: int, most: int) -> list[np.ndarray]:
    """Lanes of every shard: at most `most`, in order, as equal as can be."""
    return np.array_split(np.arange(lanes), -(-lanes // most))


def slots(study: Study, free: float) -> int:
    """Lanes to compute together at most, a power of two: as many as memory can hold.

    How many of these a CPU's cache can hold each solve asks for itself: of a few samples more.

    Args:
        free: memory of the device that is free, bytes.
    """
    fitting = max_in_memory(study.bytes_per_lane, free)
    return min(max_slots(), fitting)


def worker_devices(threads: int | None = None) -> list:
    """The device of each thread that fits shards: every device once, one CPU several times.

    XLA computes so small a batch on one core.

    Args:
        threads: on a CPU; None: as many as this process may use cores, at most `MOST_THREADS`.

    Raises:
        ValueError: `threads` where the devices are others, or several.
    """
    import jax

    devices = jax.local_devices()
    if len(devices) > 1 or devices[0].platform != "cpu":
        if threads is not None:
            kinds = f"{len(devices)} of kind {devices[0].platform}"
            raise ValueError(f"threads are for one CPU; the devices of this process are {kinds}")
        return devices
    if threads is None:
        threads = min(usable_cores(), MOST_THREADS)
    return devices * threads


def free_memory(workers: int) -> float:
    """Bytes free on the first device; of the machine's memory the share of one of the workers."""
    import jax

    device = jax.local_devices()[0]
    known = device.memory_stats() or {}
    if "bytes_limit" in known:
        return float(known["bytes_limit"] - known.get("bytes_in_use", 0))
    with contextlib.suppress(OSError, StopIteration):
        with open("/proc/meminfo", encoding="ascii") as stream:
            line = next(line for line in stream if line.startswith("MemAvailable"))
        return 1024 * int(line.split()[1]) / workers
    with contextlib.suppress(AttributeError, ValueError, OSError):
        pages = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        return pages / workers
    return np.inf


def join(study: Study, parts: Iterable[FitResult]) -> FitResult:
    """One result out of those of consecutive lanes; `study` holds all of them.

    Raises:
        ValueError: the parts are not those of all lanes.
    """
    arrays: dict[str, np.ndarray] = {}
    weighed, end = False, 0
    for part in parts:  # one after the other: together they are as large as the study
        weighed |= part.study.shares is not None
        start, end = end, end + part.lanes
        for name, values in arrays_of(part, weighed=True).items():
            if name not in arrays:
                arrays[name] = np.empty((len(study.curves), *values.shape[1:]), values.dtype)
            if values.shape[1:] != arrays[name].shape[1:]:
                raise ValueError(f"{name} has shape {values.shape} in lanes from {start}")
            arrays[name][start:end] = values
    if end != len(study.curves):
        raise ValueError(f"{end} lanes; expected {len(study.curves)}")
    names = [n for n in arrays if weighed or not n.startswith("shares.")]
    return result_of(study, {n: arrays[n] for n in names})


def replaced(result: FitResult, lanes: np.ndarray, by: FitResult) -> FitResult:
    """The same result with the rows `lanes` from `by` where it succeeded; the others untouched."""
    better = by.succeeded
    weighed = any(v.study.shares is not None for v in (result, by))
    arrays, new = (arrays_of(v, weighed=weighed) for v in (result, by))
    for name, array in arrays.items():
        arrays[name] = array.copy()
        arrays[name][lanes[better]] = new[name][better]
    return result_of(result.study, arrays)


def save(path: Path, manifest: Manifest, lanes: np.ndarray, result: FitResult) -> None:
    """Write a shard at once or not at all, and onto the disk.

    Args:
        path: file, replaced if it exists.
        manifest: of the run it belongs to; stored whole, for the case that the run's own is lost.
        lanes: that were fitted.
        result: of these lanes.
    """
    image = io.BytesIO()
    text = json.dumps(manifests.as_dict(manifest))
    arrays: dict[str, Any] = {"run": np.array(manifest.id), _MANIFEST: np.array(text)}
    arrays |= {"lanes": lanes} | arrays_of(result)
    np.savez(image, **arrays)
    write_whole(path, image.getvalue())


def read_manifest(path: Path) -> Manifest | None:
    """The manifest in a saved shard, or None where there is none to be read."""
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            return manifests.from_dict(json.loads(str(file[_MANIFEST])))
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def load(path: Path, run: str, lanes: np.ndarray, study: Study) -> FitResult | None:
    """A saved shard, or None where there is none, or a damaged one, or one of another run.

    Args:
        run: name of the run it must belong to.
        lanes: that it must hold.
        study: of these lanes.
    """
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        arrays.pop(_MANIFEST, None)
        mine = arrays.pop("run") == run and np.array_equal(arrays.pop("lanes"), lanes)
        return result_of(study, arrays) if mine else None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
