"""Convert the finite-element result files into the project's measurement schema.

    python fits/virtual_trachea/convert.py PATH/TO/midline.h5

Writes small_strain.h5 (the linear solution per mm, sampled at 0, 0.05 and 0.1 mm) and
finite_strain.h5 (the finite-strain solution, pressing only) beside this file. Markers: outer
surface at the contact angle, one per ring, displacement along the inward normal.
"""

import sys
from pathlib import Path

import h5py
import numpy as np

from jaxtrachea.measurements.read import Curve, Measurements, write_hdf5

HERE = Path(__file__).parent
ATTRS = {
    "origin": "independent 3-D finite-element indentation of a C-ringed tube, see SOURCE.md",
    "licence": "Apache-2.0",
}


def curve(name, case, displacement, force, joints):
    """One case as a curve; joints (n, rings) along the inward normal."""
    return Curve(
        specimen="virtual",
        trial=f"s{case.attrs['s_c_mm']:05.1f}",
        s_c=float(case.attrs["s_c_mm"]),
        phi_c=float(np.radians(case.attrs["phi_c_deg"])),
        displacement=displacement,
        force=force,
        joint_rings=np.arange(joints.shape[1]),
        joint_displacement=joints,
        source=name,
    )


def main(source: Path) -> None:
    """Read the cases and write both files."""
    small, finite = [], []
    with h5py.File(source) as file:
        for name, case in file.items():
            inward = case.attrs["frame"][0]
            linear = case["linear"]
            D = np.array([0.0, 0.05, 0.1])
            per_mm = linear["joint_disp_per_mm"][0, 0] @ inward
            F = D * linear["force_per_mm"][0]
            small.append(curve(name, case, D, F, D[:, None] * per_mm[None]))
            joints = case["joint_disp"][:, 0, 0] @ inward
            finite.append(curve(name, case, case["D"][()], case["force"][:, 0], joints))
    for stem, curves in (("small_strain", small), ("finite_strain", finite)):
        measured = Measurements(tuple(curves), (), ())
        write_hdf5(HERE / f"{stem}.h5", measured, attrs=ATTRS, overwrite=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
