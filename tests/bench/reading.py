"""Reading measurements: HDF5 and tidy tables. Run: python tests/bench/reading.py.

Curves of 200 samples with noise of their own, as of a testing machine, from a file that is in the
cache of the system: ms per curve from the file to records, for the checks one by one and together,
and bytes per curve. A tidy table of 10^6 rows, and a machine file of 300,000. Then HDF5 with
10^5 curves of 200 samples and 10^6 of 10, from the file to usable curves, in a process of its own:
seconds and peak memory.
"""

import importlib
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import common
import numpy as np

from jaxtrachea.measurements.batch_checks import finish_all
from jaxtrachea.measurements.checks import finish
from jaxtrachea.measurements.curve import Curve, RawCurve, ReadOptions
from jaxtrachea.measurements.read import Measurements, read_measurements, write_hdf5
from jaxtrachea.measurements.readers import hdf5
from jaxtrachea.measurements.tidy_writer import write_tidy

CURVES, SAMPLES, TRIALS, ROUNDS = 1000, 200, 5, 5
#: Curves of the tidy table of 10^6 rows, and its rounds.
TABLE_CURVES, TABLE_ROUNDS = 5000, 3
MACHINE_ROWS = 300_000
#: Of the large studies: curves and samples of each.
LARGE = ((100_000, 200), (1_000_000, 10))
ALONE = """
import json, resource, sys, time
from jaxtrachea.measurements.read import read_measurements
begin = time.perf_counter()
found = read_measurements([sys.argv[1]])
seconds = time.perf_counter() - begin
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
print(json.dumps([seconds, peak, len(found.curves)]))
"""


def study(curves: int, samples: int) -> Measurements:
    """Presses of five positions a specimen; displacement and force as a machine rounds them."""
    rng = np.random.default_rng(0)
    depth = np.round(np.linspace(0.0, 6.0, samples), 4)
    force = 0.3 * depth + 0.02 * depth**3
    return Measurements(
        tuple(
            Curve(
                specimen=f"T{i // TRIALS:06d}",
                trial=str(i % TRIALS + 1),
                s_c=20.0 + 10.0 * (i % TRIALS),
                phi_c=0.0,
                displacement=depth,
                force=np.round(force + rng.normal(0.0, 0.01, samples), 5),
                source=f"machine/T{i // TRIALS:06d}_{i % TRIALS + 1}.csv",
            )
            for i in range(curves)
        ),
        (),
        (),
    )


def small(out: common.Writer, folder: Path) -> None:
    """HDF5 and a table side by side."""
    measured = study(CURVES, SAMPLES)
    own, tidy = folder / "m.h5", folder / "t.csv"
    write_hdf5(own, measured)
    write_tidy(tidy, measured.curves)
    options = ReadOptions()
    raws = [raw for raw in hdf5.read(own, options) if isinstance(raw, RawCurve)]
    cases = {
        "HDF5, records": lambda: hdf5.read(own, options),
        "checks one by one": lambda: [finish(raw, options) for raw in raws],
        "checks together": lambda: finish_all(raws, options),
        "HDF5, usable curves": lambda: read_measurements([own]),
        "tidy table, usable curves": lambda: read_measurements([tidy]),
    }
    sizes = {name: None for name in cases}
    for name, path in (("HDF5", own), ("tidy", tidy)):
        size = path.stat().st_size / CURVES
        sizes |= {case: size for case in cases if name in case}
    samples = common.interleaved(cases, rounds=ROUNDS)
    out.table("reading", samples, lanes=CURVES, bytes_per_curve=sizes)
    for case, size in sizes.items():
        print(f"{case:40} {size and round(size)} bytes per curve")


def tables(out: common.Writer, folder: Path) -> None:
    """A tidy table of 10^6 rows, and one of 300,000 with a single curve as a machine writes it."""
    path, machine = folder / "large.csv", folder / "machine.csv"
    write_tidy(path, study(TABLE_CURVES, SAMPLES).curves)
    depth = np.linspace(0.0, 6.0, MACHINE_ROWS).tolist()
    rows = (f"{0.01 * i:.2f},{d:.6f},{0.3 * d + 0.02 * d**3:.6f}" for i, d in enumerate(depth))
    head = "Test 1\n\nTime (s),Displacement (mm),Force (N)\n"
    machine.write_text(head + "\n".join(rows) + "\n")
    importlib.import_module("pandas")
    cases = {
        "10^6 rows, tidy": lambda: read_measurements([path]),
        "300,000 rows, machine": lambda: read_measurements([machine]),
    }
    out.table("tables", common.interleaved(cases, rounds=TABLE_ROUNDS))


def large(out: common.Writer, folder: Path) -> None:
    """Many curves, HDF5."""
    for curves, samples in LARGE:
        path = folder / f"{curves}.h5"
        write_hdf5(path, study(curves, samples))
        run = [sys.executable, "-c", ALONE, str(path)]
        done = subprocess.run(run, capture_output=True, text=True, check=True)
        seconds, peak, count = json.loads(done.stdout)
        assert count == curves
        name = f"HDF5, {curves} curves of {samples} samples"
        megabytes = path.stat().st_size // 2**20
        out.add("large", name, [seconds], lanes=curves, peak_MB=peak, file_MB=megabytes)
        print(f"{seconds:.1f} s, {peak} MB, file of {megabytes} MB")


def main() -> None:
    """Time all in turn and write the results."""
    out = common.Writer("reading", "h5py", "pandas")
    with tempfile.TemporaryDirectory() as name:
        small(out, Path(name))
        tables(out, Path(name))
        large(out, Path(name))
    out.write()


if __name__ == "__main__":
    main()
