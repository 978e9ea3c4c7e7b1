"""Convert the finite-element result files into presses with vectors, off the midline too.

    python fits/virtual_trachea/convert_off_midline.py PATH/TO/midline.h5 PATH/TO/offmidline.h5

Writes off_midline.h5 beside this file, in the project's measurement schema: the finite-strain
solution, D = 0 ... 6 mm along the inward normal, with the force along the normal and along the
circumference, and the motion of the outer surface at the contact angle (normal and side) and at
the ends U and V of every ring.
"""

import sys
from pathlib import Path

import h5py
import numpy as np

from jaxtrachea.measurements.read import Curve, Measurements, write_hdf5

OUT = Path(__file__).parent / "off_midline.h5"
ATTRS = {
    "origin": "independent 3-D finite-element indentation of a C-ringed tube, see SOURCE.md",
    "licence": "Apache-2.0",
}
#: Components y (anterior) and z (to the side of positive phi) among the solver's x, y, z.
TUBE = [2, 1]


def side_of(case, marker: int) -> float:
    """Angle at which a marker of the outer surface lies at rest, deg."""
    _, y, z = case["joint_rest"][0, marker, 0]
    return float(np.degrees(np.arctan2(y, z)))


def curve(case) -> Curve:
    """One case; markers of the solver: at the contact angle, at +120 and at -120 deg."""
    s, phi = float(case.attrs["s_c_mm"]), float(case.attrs["phi_c_deg"])
    normal, _, side = case.attrs["frame"]  # rows: inward normal, axial, circumferential
    joints, plus, minus = np.moveaxis(case["joint_disp"][:, 0], 1, 0)
    # In this project U lies at -120 deg and V at +120 deg.
    assert np.allclose([side_of(case, m) for m in range(3)], [phi, 120, -120])
    return Curve(
        specimen="virtual",
        trial=f"s{s:05.1f} phi{phi:02.0f}",
        s_c=s,
        phi_c=float(np.radians(phi)),
        displacement=case["D"][()],
        force=case["force"][:, 0],
        joint_rings=np.arange(joints.shape[1]),
        joint_displacement=joints @ normal,
        source=case.name.strip("/"),
        side_force=case["force"][:, 2],
        joint_side_displacement=joints @ side,
        end_rings=np.arange(joints.shape[1]),
        end_U=minus[..., TUBE],
        end_V=plus[..., TUBE],
    )


def main(*sources: Path) -> None:
    """Read every case and write one file."""
    curves = []
    for source in sources:
        with h5py.File(source) as file:
            curves += [curve(case) for case in file.values()]
    measured = Measurements(tuple(curves), (), ())
    write_hdf5(OUT, measured, attrs=ATTRS, overwrite=True)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
