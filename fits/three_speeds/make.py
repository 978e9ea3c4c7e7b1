"""Writes records.csv: a soft tube pressed at three places and speeds, by a differential equation.

    python fits/three_speeds/make.py

The skeleton is a finite-element beam on springs (`tests/reference/beam_fem.py`), in series with the
local law; all of it relaxes alike, by two branches (`tests/reference/relaxing_records.py`, scipy's
Radau). Nothing of the package is used.
"""

import csv
import sys
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parents[1] / "tests" / "reference"))
import beam_fem  # noqa: E402
import relaxing_records  # noqa: E402

RINGS, LENGTH = np.arange(10.0, 151.0, 10.0), 160.0
TRUTH = {
    "EI_L": 60.0, "k_M": 0.3, "k_1": 1.2, "k_3": 0.05,
    "gamma_1": 0.9, "gamma_2": 0.5, "tau_1": 0.36, "tau_ratio_2": 12.0,
}  # fmt: skip
PLACES, SPEEDS, DEPTH, HOLD = (25.0, 75.0, 80.0), (0.3, 1.5, 6.0), 4.0, 20.0
#: Of the largest force of the record.
NOISE = 0.003


def record(place, speed, rng):
    """Time, displacement and force: rest, ramp, hold, unloading at the same speed."""
    solved = beam_fem.solve(
        RINGS.tolist(), LENGTH, [TRUTH["EI_L"]] * (len(RINGS) + 1), [TRUTH["k_M"]] * len(RINGS),
        place, 1.0,
    )  # fmt: skip
    ramp = DEPTH / speed
    knots = np.cumsum([0.0, 1.0, ramp, HOLD, ramp])
    ways = np.array([-0.2, 0.0, DEPTH, DEPTH, 0.0])
    times = np.unique(np.concatenate([
        np.linspace(0, knots[1], 8), np.linspace(knots[1], knots[2], 60),
        knots[2] + np.geomspace(0.05, HOLD, 40), np.linspace(knots[3], knots[4], 30),
    ]))  # fmt: skip
    tau = np.array([1.0, TRUTH["tau_ratio_2"]]) * TRUTH["tau_1"]
    branches = np.array([TRUTH["gamma_1"], TRUTH["gamma_2"]]), tau
    law = TRUTH["k_1"], TRUTH["k_3"], 0.0
    force, _ = relaxing_records.press(
        times, (knots, ways), float(solved.w_C), law, branches, branches
    )
    force = force + rng.normal(0, NOISE * force.max(), len(times))
    return times, np.interp(times, knots, ways), force


def main():
    """Write the table."""
    rng = np.random.default_rng(46)
    with (HERE / "records.csv").open("w", newline="") as stream:
        table = csv.writer(stream, lineterminator="\n")
        table.writerow(
            ["specimen", "trial", "s_c [mm]", "time [s]", "displacement [mm]", "force [N]"]
        )
        for place in PLACES:
            for speed in SPEEDS:
                rows = zip(*record(place, speed, rng), strict=True)
                trial = f"{place:g} mm {speed:g} mm per s"
                table.writerows(
                    ["tube", trial, f"{place:g}", *(f"{v:.6g}" for v in row)] for row in rows
                )


if __name__ == "__main__":
    main()
