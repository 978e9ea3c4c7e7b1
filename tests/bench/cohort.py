"""A cohort of 10,000 specimens against scipy and lmfit. Run: python tests/bench/cohort.py.

As fitting.py (same model, same start, one core each), with five positions of 200 points; and what
the command `fit` takes for it from an HDF5 file to the last plot, four starts, in a process of its
own: seconds by phase and peak memory.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import common
import fitting
import numpy as np

from jaxtrachea.fitting import fit
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.measurements.read import Measurements, write_hdf5

SPECIMENS, SAMPLE, ROUNDS = 10_000, 20, 3
SPOTS, DEPTHS = np.array([15.0, 30.0, 45.0, 65.0, 80.0]), np.linspace(0.03, 6.0, 200)


def command(study) -> dict:
    """Seconds by phase and peak memory (MB) of `jaxtrachea fit` on the same data."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        curves = tuple(curve for lane in study.curves for curve in lane)
        write_hdf5(folder / "cohort.h5", Measurements(curves, (), ()))
        (folder / "spec.toml").write_text('[data]\nfiles = ["cohort.h5"]\n')
        code = "from jaxtrachea.cli.main import main; main()"
        run = [sys.executable, "-c", code, "fit", "spec.toml", "--out", "out"]
        begin = time.perf_counter()
        done = subprocess.run(run, cwd=folder, stdout=subprocess.DEVNULL)
        assert done.returncode in (0, 1)  # 1: some lane failed
        wall = time.perf_counter() - begin
        seconds = json.loads((folder / "out" / "provenance.json").read_text())["seconds"]
        size = sum(path.stat().st_size for path in (folder / "out").iterdir()) // 2**20
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss // 1024
    return {"seconds": seconds, "wall": wall, "peak_MB": peak, "output_MB": size}


def main() -> None:
    """Time all in turn and write the results."""
    out = common.Writer("cohort", "scipy", "lmfit")
    study, model, forces = fitting.make_study(SPECIMENS, SPOTS, DEPTHS)
    few = forces[:SAMPLE]
    errors = Settings(starts=1, verify=False)
    cases = {
        "jaxtrachea: fit with standard errors": lambda: fit.fit(study, errors),
        "jaxtrachea: fit, what is in doubt profiled": lambda: fit.fit(study, Settings(starts=1)),
        "scipy least_squares lm, numpy residual and Jacobian": fitting.one_by_one(
            model, few, lambda i: fitting.with_scipy(model.value, model.jacobian)
        ),
        "lmfit leastsq, numpy residual and Jacobian": fitting.one_by_one(
            model, few, lambda i: fitting.with_lmfit(model)
        ),
    }
    lanes = dict(zip(cases, (SPECIMENS, SPECIMENS, SAMPLE, SAMPLE), strict=True))
    samples = {name: [] for name in cases}
    for i in range(ROUNDS + 1):
        for name, call in cases.items():
            begin = time.perf_counter()
            call()
            if i:  # the first one compiles
                samples[name].append(time.perf_counter() - begin)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    for name, values in samples.items():
        more = {"peak_MB": peak} if lanes[name] == SPECIMENS else {}
        out.add("cohort", name, values, lanes=lanes[name], **more)
    if "XLA_FLAGS" in os.environ:
        del os.environ["XLA_FLAGS"]
    told = command(study)
    out.add("command", "jaxtrachea fit, four starts", [told.pop("wall")], lanes=SPECIMENS, **told)
    print(told)
    out.write()


if __name__ == "__main__":
    main()
