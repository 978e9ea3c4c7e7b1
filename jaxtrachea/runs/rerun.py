"""Fitting the failed lanes of a finished run again."""

import dataclasses
import json
import shutil
from pathlib import Path

import h5py

from jaxtrachea.fitting.result import FitResult
from jaxtrachea.runs import manifest as manifests
from jaxtrachea.runs.folder import NoRun, RunFolder, digest
from jaxtrachea.status import FitStatus


def read_manifest(path: Path) -> manifests.Manifest:
    """The manifest of the run that wrote a results.h5.

    Raises:
        NoRun: there is none.
    """
    try:
        with h5py.File(path) as file:
            return manifests.from_dict(json.loads(str(file.attrs["provenance"]))["run"])
    except (OSError, KeyError, ValueError) as error:
        raise NoRun(f"{path} tells nothing of its run ({error})") from None


def failed_lanes(result: FitResult) -> list[int]:
    """Lanes that the solver failed at: where other starts may help."""
    hopeless = (FitStatus.BAD_DATA, FitStatus.TOO_FEW_DATA)
    statuses = [FitStatus(int(status)) for status in result.status]
    return [k for k, s in enumerate(statuses) if not s.succeeded and s not in hopeless]


def begin(
    target: Path, finished: manifests.Manifest, now: manifests.Manifest, lanes: list[int]
) -> RunFolder:
    """A new run over the failed lanes of a finished one.

    Args:
        target: folder of the finished run.
        now: what would be run now; its sizes are used.
        lanes: to fit again.
    """
    count = 1 if finished.rerun is None else finished.rerun.count + 1
    rerun = manifests.Rerun(digest(target / "results.h5"), lanes, count)
    options = sorted({*finished.options, *now.options})
    manifest = dataclasses.replace(now, rerun=rerun, options=options, forced=finished.forced)
    run = RunFolder(target, manifest)
    shutil.rmtree(run.staging, ignore_errors=True)
    # Renamed with its manifest inside: a .run without one must not stand beside finished files.
    run.staging.mkdir()
    try:
        manifests.write(run.staging / "run.json", manifest)
        run.staging.rename(run.checkpoint)
    except BaseException:
        shutil.rmtree(run.staging, ignore_errors=True)
        raise
    return run
