"""Convert the finite-element result files into small-strain vectors, presses off the midline too.

    python fits/virtual_trachea/convert_vectors.py PATH/TO/midline.h5 PATH/TO/offmidline.h5

Writes vectors.h5 beside this file: per mm of inward displacement, the contact force and the motion
of the outer-surface markers at (s_i, phi_c) and at the ring ends U and V, in the frame of the tube.
"""

import sys
from pathlib import Path

import h5py
import numpy as np

OUT = Path(__file__).parent / "vectors.h5"
TUBE = [0, 2, 1]  # the solver's x, y, z are s, lateral, anterior


def main(*sources: Path) -> None:
    """Read every case and write one table."""
    rows = []
    for source in sources:
        with h5py.File(source) as file:
            for case in file.values():
                about, linear = case.attrs, case["linear"]
                force = linear["force_per_mm"][()] @ about["frame"]
                place = about["s_c_mm"], np.radians(about["phi_c_deg"])
                markers = linear["joint_disp_per_mm"][0]  # joint, U (+120 deg), V (-120 deg)
                rows.append((*place, force[TUBE], *markers[..., TUBE]))
    # In this project U lies at -120 deg and V at +120 deg.
    names = ("s_c", "phi_c", "force", "joints", "end_V", "end_U")
    units = ("mm", "rad", "N/mm", "1", "1", "1")
    with h5py.File(OUT, "w") as file:
        file.attrs["origin"] = "independent 3-D finite-element indentation, see SOURCE.md"
        file.attrs["licence"] = "Apache-2.0"
        file.attrs["axes"] = "x: along s, y: anterior, z: to the side of positive phi"
        for name, unit, column in zip(names, units, zip(*rows, strict=True), strict=True):
            file.create_dataset(name, data=np.array(column)).attrs["units"] = unit


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
