"""Compliance of the rig: what it gives way under the force is no displacement of the tool."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from jaxtrachea.measurements.curve import DataError, Fault, ReadOptions, fits


def without_machine(displacement: np.ndarray, force: np.ndarray, compliance: float) -> np.ndarray:
    """Displacement of the tool where it touches: that recorded less what the rig gives way.

    Args:
        displacement: (N,) mm, at the crosshead.
        force: (N,) N, with the sign of the displacement.
        compliance: of the rig, mm/N.

    Raises:
        Fault: the rig alone would give way by more than was recorded.
    """
    if compliance == 0:
        return displacement
    low, high = int(np.argmin(force)), int(np.argmax(force))
    way, rise = float(displacement[high] - displacement[low]), float(force[high] - force[low])
    if 0 < way <= compliance * rise:  # one that falls has a sign to be set right first
        raise Fault(
            "absurd_scale",
            f"machine_compliance is {compliance:g} mm/N, but force and displacement grow by "
            f"{rise:.4g} N and {way:.4g} mm, {way / rise:.4g} mm/N in all",
            "measure it against a rigid stop, and check its unit",
        )
    return displacement - compliance * force


def check_machine_files(files: Sequence[Path], options: ReadOptions) -> None:
    """Hold the table `machine_compliance`, if it is one, against the files.

    Raises:
        DataError: it leaves a file out, or a name in it fits none.
    """
    if not isinstance(options.machine_compliance, Mapping):
        return
    for path in files:
        options.of_file(path)
    for name in options.machine_compliance:
        if not any(fits(name, path) for path in files):
            raise DataError(
                f"machine_compliance names {name!r}, which none of the {len(files)} files fits",
                cure="correct the name, or remove it",
            )
