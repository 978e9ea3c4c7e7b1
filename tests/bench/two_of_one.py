"""Two tools on the finite-element trachea, by linearity from its single presses, and by the model.

    python tests/bench/two_of_one.py

At 0.1 mm that trachea is linear: what two presses do together is a sum of what each does, and the
motion of one place by a force at another is that of the ring there. Forces and joints of
`press_contacts`, with the values of `fits/virtual_trachea/expected.json` for a punch, are held
against it for every pair of which one lies on a ring.
"""

import itertools
import json
from pathlib import Path

import common  # noqa: F401  (float64, one core)
import h5py
import numpy as np

from jaxtrachea import Material, Options, press_contacts, table_1

FOLDER = Path(__file__).parents[2] / "fits" / "virtual_trachea"
DEEP, LEAST, APART = 0.1, 6.0, 15.0  # mm: of both presses, and how far apart they are


def single_presses() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places, mm; way per force there, mm/N; motion of all rings per force, mm/N."""
    with h5py.File(FOLDER / "small_strain.h5") as file:
        places = file["curves/s_c"][:]
        ends = file["offsets/displacement"][1:] - 1
        force = file["samples/force"][:][ends]
        soft = file["samples/displacement"][:][ends] / force
        joints = file["samples/joint_displacement"][:].reshape(-1, 15)[ends]
    return places, soft, joints / force[:, None]


def main() -> None:
    """Print each pair, and the largest and median errors."""
    places, soft, joints = single_presses()
    rings, found = np.asarray(table_1().ring_positions), []
    fits = json.loads((FOLDER / "expected.json").read_text())["options"]
    fit = next(f for f in fits if f["shear"] and f["local"] == "two-material" and f["half_width"])
    values = {name: value["value"] for name, value in fit["parameters"].items()}
    material = Material(**values, k_3=0.0, k_3_ring=0.0)
    options = Options(
        contact="bonded", shear=True, local="two-material", half_width=fit["half_width"]
    )
    for a, b in itertools.combinations(range(len(places)), 2):
        on = {i: np.flatnonzero(np.abs(rings - places[i]) < 0.01) for i in (a, b)}
        seen = [joints[j][on[i][0]] for i, j in ((a, b), (b, a)) if len(on[i])]
        if not seen or abs(places[a] - places[b]) < LEAST:
            continue
        between = np.mean(seen)
        force = np.linalg.solve([[soft[a], between], [between, soft[b]]], [DEEP, DEEP])
        moved = force[0] * joints[a] + force[1] * joints[b]
        model = press_contacts(table_1(), material, places[[a, b]], [DEEP, DEEP], options)
        off = [
            np.abs(np.asarray(got) - true).max() / np.abs(true).max()
            for got, true in ((model.force, force), (model.joints, moved))
        ]
        found.append((abs(places[a] - places[b]), *off))
        print(f"{places[a]:5.0f} {places[b]:5.0f} mm: force {off[0]:.3f}, joints {off[1]:.3f}")
    apart, force, joint = np.array(found).T
    far = force[apart >= APART].max()
    print(f"{len(found)} pairs: force {np.median(force):.3f} in the median, {far:.3f} at most")
    print(f"from {APART:g} mm on, {force.max():.3f} below; joints {np.median(joint):.3f} in the")
    print(f"median, {joint.max():.3f} at most")


if __name__ == "__main__":
    main()
