"""Convert the finite-element result files into the motion of the outer surface round four presses.

    python fits/virtual_trachea/convert_surface.py PATH/TO/midline.h5 PATH/TO/offmidline.h5

Writes surface.h5 beside this file: a group for each press with the outer surface's nodes within
25 mm of it along the tube, one in eight, and their displacement at D = 1 and 6 mm, in the frame of
the tube; those within 3.2 mm of the press, which the punch holds, are left out. Single precision.
"""

import sys
from pathlib import Path

import h5py
import numpy as np

OUT = Path(__file__).parent / "surface.h5"
TUBE = [0, 2, 1]  # the solver's x, y, z are s, lateral, anterior
CASES = ("mid_s022", "mid_s075", "off_s075_p30", "off_s075_p90")
DEPTHS, REACH, PUNCH, ONE_IN = (1.0, 6.0), 25.0, 3.2, 8


def press_of(case: h5py.Group) -> dict[str, np.ndarray]:
    """Columns of one press."""
    s_c, phi_c = case.attrs["s_c_mm"], np.radians(case.attrs["phi_c_deg"])
    field, D = case["field"], case["D"][()]
    s, phi, rest = (field[f"outer_{name}"][()] for name in ("s", "phi", "rest"))
    rest = rest[:, TUBE]
    radius = np.hypot(rest[:, 1], rest[:, 2])
    centre = np.array([s_c, radius[0] * np.cos(phi_c), radius[0] * np.sin(phi_c)])
    away = np.linalg.norm(rest - centre, axis=1)
    taken = np.flatnonzero((np.abs(s - s_c) < REACH) & (away > PUNCH))[::ONE_IN]
    rows = [int(np.argmin(np.abs(D - depth))) for depth in DEPTHS]
    moved = field["outer_disp"][()][rows][:, taken][:, :, TUBE]
    single = {
        "s": s[taken],
        "phi": np.radians(phi[taken]),
        "distance": radius[taken],
        "motion": moved,
    }
    columns = {name: np.asarray(v, np.float32) for name, v in single.items()}
    return columns | {"displacement": D[rows], "s_c": s_c, "phi_c": phi_c}


UNITS = {"phi": "rad", "phi_c": "rad"}


def main(*sources: Path) -> None:
    """Read the presses and write one group each."""
    with h5py.File(OUT, "w") as out:
        out.attrs["origin"] = "independent 3-D finite-element indentation, see SOURCE.md"
        out.attrs["licence"] = "Apache-2.0"
        out.attrs["axes"] = "x: along s, y: anterior, z: to the side of positive phi"
        for source in sources:
            with h5py.File(source) as file:
                for name in sorted(set(CASES) & set(file)):
                    for column, values in press_of(file[name]).items():
                        packed = {"compression": "gzip"} if np.ndim(values) > 1 else {}
                        data = out.create_dataset(f"{name}/{column}", data=values, **packed)
                        data.attrs["units"] = UNITS.get(column, "mm")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
