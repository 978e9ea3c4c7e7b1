"""What a finished run left in its results.h5: its journal, and the lanes that failed."""

import json
from pathlib import Path

import h5py

from jaxtrachea.fitting.result import FitResult
from jaxtrachea.runs import journal as journals
from jaxtrachea.runs.folder import NoRun
from jaxtrachea.status import FitStatus


def read_journal(path: Path) -> journals.Journal:
    """The journal of the run that wrote a results.h5.

    Raises:
        NoRun: there is none.
    """
    try:
        with h5py.File(path) as file:
            return journals.from_dict(json.loads(str(file.attrs["provenance"]))["run"])
    except (OSError, KeyError, ValueError) as error:
        raise NoRun(f"{path} tells nothing of its run ({error})") from None


def failed_lanes(result: FitResult) -> list[int]:
    """Lanes that the solver failed at: where other starts may help."""
    hopeless = (FitStatus.BAD_DATA, FitStatus.TOO_FEW_DATA)
    statuses = [FitStatus(int(status)) for status in result.status]
    return [k for k, s in enumerate(statuses) if not s.succeeded and s not in hopeless]
