"""Whole commands against an earlier checkout.

Run: python tests/bench/against.py FOLDER [COMMAND ...].
Both on the same specification (that of the earlier one) and the same measurements, in turns, each
command in a process of its own. Cold: with an empty folder for compiled programs; warm: with what
the cold start left. Measurements lie in the version of the HDF5 schema that each reads: 1
then, 2 now. COMMAND: fit, simulate, cohort, selfcheck; all unless told otherwise.
"""

import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import common
import fitting
import h5py
from cohort import DEPTHS, SPECIMENS, SPOTS

from jaxtrachea.measurements.read import Curve, Measurements, write_hdf5

NOW = common.FOLDER.parents[1]
#: Turns and starts of each command.
COMMANDS = {
    "fit": (3, ("cold", "warm")),
    "simulate": (3, ("cold", "warm")),
    "cohort": (1, ("",)),
    "selfcheck": (1, ("cold",)),
}


def run(checkout: Path, words: list[str], cache: Path, place: Path) -> dict[str, float]:
    """Wall and processor seconds of `jaxtrachea` from this checkout, run in the folder `place`."""
    where = {"JAX_COMPILATION_CACHE_DIR": str(cache), "PYTHONPATH": str(checkout)}
    place.mkdir(parents=True)
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "jaxtrachea", *words],
        capture_output=True, text=True, cwd=place, env=os.environ | where,
    )  # fmt: skip
    wall, after = time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
    assert done.returncode in (0, 1), done.stderr  # 1: some lane failed
    processor = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    print(
        f"{checkout.name:10} {' '.join(words)[:60]:60} {wall:7.1f} s, processor {processor:.1f} s"
    )
    return {"wall": wall, "processor": processor}


def write_version_1(path: Path, curves: Sequence[Curve]) -> None:
    """The file that the earlier one reads: a group per trial."""
    with h5py.File(path, "w") as file:
        file.attrs.update({"schema": "jaxtrachea-measurements", "schema_version": 1})
        for curve in curves:
            group = file.create_group(f"specimens/{curve.specimen}/{curve.trial}")
            group.attrs.update({"s_c": curve.s_c, "s_c_unit": "mm"})
            for name, unit in (("displacement", "mm"), ("force", "N")):
                group[name] = getattr(curve, name)
                group[name].attrs["unit"] = unit


def cohort(earlier: Path, base: Path) -> dict[Path, list[str]]:
    """Words of a fit of 10,000 specimens by checkout, each with its file."""
    study, *_ = fitting.make_study(SPECIMENS, SPOTS, DEPTHS)
    curves = tuple(curve for lane in study.curves for curve in lane)
    write_version_1(base / "1.h5", curves)
    write_hdf5(base / "2.h5", Measurements(curves, (), ()))
    for version in (1, 2):
        (base / f"{version}.toml").write_text(f'[data]\nfiles = ["{version}.h5"]\n')
    return {
        checkout: ["fit", str(base / f"{version}.toml"), "--out", "out"]
        for checkout, version in ((earlier, 1), (NOW, 2))
    }


def shipped(earlier: Path, base: Path) -> dict[Path, list[str]]:
    """Words of the shipped fit as the earlier one specifies it, each with its own file of data."""
    folder = Path("fits", "virtual_trachea")
    shutil.copy(earlier / folder / "fit.toml", base)
    shutil.copy(NOW / folder / "small_strain.h5", base)
    places = {earlier: earlier / folder, NOW: base}
    return {c: ["fit", str(place / "fit.toml"), "--out", "out"] for c, place in places.items()}


def words_of(command: str, earlier: Path, base: Path) -> dict[Path, list[str]]:
    """Words of a command by checkout."""
    if command == "cohort":
        return cohort(earlier, base)
    if command == "fit":
        return shipped(earlier, base)
    words = {
        "simulate": ["simulate", str(earlier / "configs" / "normal.toml"), "--out", "out"],
        "selfcheck": ["selfcheck"],
    }
    return dict.fromkeys((earlier, NOW), words[command])


def main() -> None:
    """Time all in turns and write the results."""
    earlier, asked = Path(sys.argv[1]).resolve(), sys.argv[2:]
    out = common.Writer("against")
    log = ["git", "-C", str(earlier), "log", "-1", "--format=%h"]
    out.rows[0]["earlier"] = subprocess.check_output(log, text=True).strip()
    with tempfile.TemporaryDirectory() as folder:
        base = Path(folder)
        for command in asked or COMMANDS:
            turns, starts = COMMANDS[command]
            words = words_of(command, earlier, base)
            found: dict[tuple[str, str], list[dict[str, float]]] = {}
            for turn in range(turns):
                for checkout, said in words.items():
                    which = "now" if checkout == NOW else "earlier"
                    cache = base / f"{command}_{which}_{turn}"
                    for start in starts:
                        place = base / f"{command}_{which}_{turn}_{start}_out"
                        taken = run(checkout, said, cache, place)
                        found.setdefault((start, which), []).append(taken)
            for (start, which), taken in found.items():
                name = {"cohort": "fit, 10,000 specimens"}.get(command, command)
                case = f"jaxtrachea {name}" + f", {start}" * bool(start)
                wall, processor = ([t[k] for t in taken] for k in ("wall", "processor"))
                out.add(which, case, wall, processor=[round(s, 2) for s in processor])
            out.write()


if __name__ == "__main__":
    main()
