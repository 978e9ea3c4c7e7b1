"""Damaged HDF5 measurements: cut off, flipped bits, links that lead elsewhere, wrong shapes."""

import functools
import tempfile
from pathlib import Path

import h5py
import numpy as np

from damaged.case import OTHER, Case, flipped
from jaxtrachea.measurements.read import Curve, Measurements, write_hdf5

FORCE, RINGS = "/samples/force", "/samples/joint_ring_number"
GROUPS = ("curves", "offsets", "samples")
BESIDE = '[data]\nfiles = ["data.h5", "good.csv"]\n[noise]\nforce = "0.01 N"\n'


@functools.lru_cache(maxsize=1)
def pristine() -> bytes:
    """A study of two specimens in the project's own schema."""
    line = np.linspace(0, 2, 12)
    markers = {"joint_rings": np.array([2, 6]), "joint_displacement": np.ones((12, 2))}
    curves = tuple(
        Curve(name, "1", 35.0, 0.0, line, line + 0.1 * line**3, np.full(12, 0.1), **markers)
        for name in ("T01", "T03")
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "m.h5"
        write_hdf5(path, Measurements(curves, (), ()))
        return path.read_bytes()


def _beside(make, says, codes=(1,)):
    files = {"good.csv": OTHER, "spec.toml": BESIDE}
    return Case(("data.h5", *says), files, make, ("check", "spec.toml"), codes)


def of_bytes(change, *says, codes=(1,)):
    def make(folder):
        (folder / "data.h5").write_bytes(change(pristine()))

    return _beside(make, says, codes)


def of_file(change, *says):
    def make(folder):
        (folder / "data.h5").write_bytes(pristine())
        with h5py.File(folder / "data.h5", "r+") as file:
            change(file)

    return _beside(make, says)


def removed(name):
    return lambda file: file.__delitem__(name)


def replaced(name, data, unit="N"):
    """Put another dataset in the place of one."""

    def change(file):
        if name in file:
            del file[name]
        file[name] = data
        if unit:
            file[name].attrs["unit"] = unit

    return change


def part(name, i, value):
    """Another value in place of one."""
    return lambda file: file[name].__setitem__(i, value)


def declared(shape):
    def change(file):
        del file[FORCE]
        data = file.create_dataset(FORCE, shape, "f8", chunks=True, compression="gzip")
        data.attrs["unit"] = "N"

    return change


def attribute(name, value, at=FORCE):
    def change(file):
        if value is None:
            del file[at].attrs[name]
        else:
            file[at].attrs[name] = value

    return change


def linked(link):
    return lambda file: file.__setitem__("samples/x", link)


def virtual(file):
    layout = h5py.VirtualLayout((3,), "f8")
    layout[:] = h5py.VirtualSource("/etc/hostname", "x", (3,))
    file.create_virtual_dataset("samples/x", layout)


def stored_outside(file):
    del file[FORCE]
    file.create_dataset(FORCE, (24,), "f8", external=[("/dev/zero", 0, 192)])


def loop(file):
    file["samples/up"] = file["/"]


def soft_loop(file):
    file["a"], file["b"] = h5py.SoftLink("/b"), h5py.SoftLink("/a")


def many_in_sum(file):
    for i in range(5):
        file.create_dataset(f"h{i}", (100_000_000,), "f8", chunks=(1000,))


def put(name, value):
    return lambda file: file.__setitem__(name, value)


#: Of a curve that is spoilt, the file and its place in it are named.
CASES = {
    **{
        f"cut to {n} bytes": of_bytes(lambda data, n=n: data[:n])
        for n in (0, 1, 8, 48, 96, 512, 1000, 2048, 4096)
    },
    "cut by one byte": of_bytes(lambda data: data[:-1]),
    "bytes swapped": of_bytes(lambda data: data[::-1]),
    "first half twice": of_bytes(lambda data: data[: len(data) // 2] * 2),
    "zeros from the middle": of_bytes(
        lambda data: data[: len(data) // 2] + bytes(len(data) - len(data) // 2)
    ),
    "text": of_bytes(lambda _: OTHER.encode()),
    **{
        f"bits flipped, seed {seed}": of_bytes(
            lambda data, seed=seed: flipped(data, seed, 1 + 7 * (seed % 3)), codes=(0, 1)
        )
        for seed in range(40)
    },
    "external link": of_file(linked(h5py.ExternalLink("/etc/passwd", "/")), "/samples/x", "link"),
    "external link to a device": of_file(linked(h5py.ExternalLink("/dev/zero", "/x")), "link"),
    "external link to itself": of_file(linked(h5py.ExternalLink("data.h5", "/")), "link"),
    "soft link": of_file(linked(h5py.SoftLink("/samples/force")), "/samples/x", "link"),
    "soft link to nowhere": of_file(linked(h5py.SoftLink("/nowhere")), "/samples/x", "link"),
    "soft links in a circle": of_file(soft_loop, "link"),
    "group within itself": of_file(loop, "within itself"),
    "virtual dataset": of_file(virtual, "virtual"),
    "data in another file": of_file(stored_outside, "another file"),
    "10^15 declared": of_file(declared((10**15,)), "declares 1000000000000000"),
    "10^6 x 10^6 declared": of_file(declared((10**6, 10**6)), "declares"),
    "many large ones": of_file(many_in_sum, "in the file so far"),
    "text in a dataset": of_file(put("t", ["a", "b"]), "no plain numbers"),
    "compound": of_file(put("c", np.zeros(2, [("a", "f8"), ("b", "i4")])), "no plain numbers"),
    "ragged rows": of_file(lambda f: f.create_dataset("v", (2,), h5py.vlen_dtype("f8"))),
    "named type": of_file(put("n", np.dtype("f8")), "neither group nor dataset"),
    "escape in a name": of_file(lambda f: f["samples"].create_group("T\x1b[31m"), "control"),
    "schema of another": of_file(attribute("schema", "other", "/"), "schema"),
    "schema version 3": of_file(attribute("schema_version", 3, "/"), "schema_version is 3"),
    "schema version 1": of_file(attribute("schema_version", 1, "/"), "convert it"),
    "schema a number": of_file(attribute("schema", 5.0, "/"), "schema"),
    "schema removed": of_file(attribute("schema", None, "/"), "schema"),
    **{f"{name} removed": of_file(removed(name), f"/{name}") for name in GROUPS},
    **{f"{name} a dataset": of_file(replaced(name, [1.0], None), f"/{name}") for name in GROUPS},
    "names of any length": of_file(replaced("curves/trial", ["1", "1"], None), "/curves/trial"),
    "force removed": of_file(removed(FORCE), FORCE, "'force'"),
    "displacement removed": of_file(removed("samples/displacement"), "/samples/displacement"),
    "force a group": of_file(lambda f: (f.__delitem__(FORCE), f.create_group(FORCE)), FORCE),
    "force a scalar": of_file(replaced(FORCE, 1.0), FORCE, "shape"),
    "force a matrix": of_file(replaced(FORCE, np.ones((12, 2))), FORCE, "shape"),
    "force short": of_file(replaced(FORCE, np.ones(23)), "/offsets/force", "23"),
    "force without samples": of_file(replaced(FORCE, np.ones(0)), "/offsets/force"),
    "force null": of_file(replaced(FORCE, h5py.Empty("f8")), FORCE, "shape"),
    "force nan": of_file(part(FORCE, 3, np.nan), "/curves[0]", "NaN"),
    "force infinite": of_file(part(FORCE, 23, np.inf), "/curves[1]"),
    "force huge": of_file(part(FORCE, slice(12), 1e300), "/curves[0]", "plausible"),
    "force complex": of_file(replaced(FORCE, np.ones(24, complex)), "no plain numbers"),
    "force in mm": of_file(attribute("unit", "mm"), FORCE, "'mm'"),
    "force in kips": of_file(attribute("unit", "kips"), FORCE, "'kips'"),
    "force without unit": of_file(attribute("unit", None), FORCE, "unit"),
    "force unit a number": of_file(attribute("unit", 3.0), FORCE),
    "force with two units": of_file(attribute("units", "kN"), FORCE, "two units"),
    "offsets fall": of_file(part("offsets/force", 1, 30), "/offsets/force", "falls"),
    "offsets beyond": of_file(part("offsets/force", 2, 30), "/offsets/force", "24"),
    "offsets 2^63": of_file(part("offsets/force", 2, 2**63 - 1), "/offsets/force"),
    "sigma short": of_file(part("offsets/sigma", 1, 3), "/curves[0]", "sigma"),
    "sigma negative": of_file(part("samples/sigma", slice(12), -1.0), "/curves[0]", "sigma"),
    "markers of another shape": of_file(
        part("offsets/joint_ring_number", 1, 1), "/curves[0]", "joint"
    ),
    "ring 0": of_file(part(RINGS, 0, 0), "/curves[0]", "ring"),
    "ring nan": of_file(replaced(RINGS, [np.nan, 7.0, 3.0, 7.0], None), RINGS),
    "ring 2.5": of_file(replaced(RINGS, [2.5, 7.0, 3.0, 7.0], None), RINGS),
    "ring 10^18": of_file(part(RINGS, 1, 10**18), "/curves[0]", "ring"),
    "position a matrix": of_file(replaced("curves/s_c", np.ones((2, 2)), "mm"), "/curves/s_c"),
    "position infinite": of_file(part("curves/s_c", 0, np.inf), "/curves[0]"),
    "position text": of_file(replaced("curves/s_c", np.array([b"35", b"4"])), "/curves/s_c"),
    "position without unit": of_file(attribute("unit", None, "curves/s_c"), "unit"),
    "position in newton": of_file(attribute("unit", "N", "curves/s_c"), "'N'"),
}
