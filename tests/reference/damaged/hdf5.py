"""Damaged HDF5 measurements: cut off, flipped bits, links that lead elsewhere, wrong shapes."""

import functools
import tempfile
from pathlib import Path

import h5py
import numpy as np

from damaged.case import OTHER, Case, flipped
from jaxtrachea.measurements.read import Curve, Measurements, write_hdf5

TRIAL = "specimens/T01/1"
BESIDE = '[data]\nfiles = ["data.h5", "good.csv"]\n[noise]\nforce = "0.01 N"\n'


@functools.lru_cache(maxsize=2)
def pristine(version=1) -> bytes:
    """A study of two specimens in the project's own schema."""
    line = np.linspace(0, 2, 12)
    markers = {"joint_rings": np.array([2, 6]), "joint_displacement": np.ones((12, 2))}
    curves = tuple(
        Curve(name, "1", 35.0, 0.0, line, line + 0.1 * line**3, np.full(12, 0.1), **markers)
        for name in ("T01", "T03")
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "m.h5"
        write_hdf5(path, Measurements(curves, (), ()), schema_version=version)
        return path.read_bytes()


def _beside(make, says, codes=(1,)):
    files = {"good.csv": OTHER, "spec.toml": BESIDE}
    return Case(("data.h5", *says), files, make, ("check", "spec.toml"), codes)


def of_bytes(change, *says, codes=(1,), version=1):
    def make(folder):
        (folder / "data.h5").write_bytes(change(pristine(version)))

    return _beside(make, says, codes)


def of_file(change, *says, version=1):
    def make(folder):
        (folder / "data.h5").write_bytes(pristine(version))
        with h5py.File(folder / "data.h5", "r+") as file:
            change(file)

    return _beside(make, says)


def replaced(name, data, unit="N"):
    """Put another dataset in the place of one."""

    def change(file):
        trial = file[TRIAL]
        if name in trial:
            del trial[name]
        if data is not None:
            trial[name] = data
            trial[name].attrs["unit"] = unit

    return change


def declared(shape):
    def change(file):
        del file[f"{TRIAL}/force"]
        data = file.create_dataset(f"{TRIAL}/force", shape, "f8", chunks=True, compression="gzip")
        data.attrs["unit"] = "N"

    return change


def attribute(name, value, at=f"{TRIAL}/force"):
    def change(file):
        if value is None:
            del file[at].attrs[name]
        else:
            file[at].attrs[name] = value

    return change


def linked(link):
    return lambda file: file.__setitem__("specimens/T09", link)


def virtual(file):
    layout = h5py.VirtualLayout((3,), "f8")
    layout[:] = h5py.VirtualSource("/etc/hostname", "x", (3,))
    file.create_virtual_dataset(f"{TRIAL}/v", layout)


def stored_outside(file):
    del file[f"{TRIAL}/force"]
    file.create_dataset(f"{TRIAL}/force", (12,), "f8", external=[("/dev/zero", 0, 96)])


def loop(file):
    file["specimens/T01/up"] = file["specimens"]


def soft_loop(file):
    file["a"], file["b"] = h5py.SoftLink("/b"), h5py.SoftLink("/a")


def many_in_sum(file):
    for i in range(11):
        file.create_dataset(f"h{i}", (10_000_000,), "f8", chunks=(1000,))


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
    "external link": of_file(linked(h5py.ExternalLink("/etc/passwd", "/")), "T09", "link"),
    "external link to a device": of_file(linked(h5py.ExternalLink("/dev/zero", "/x")), "T09"),
    "external link to itself": of_file(linked(h5py.ExternalLink("data.h5", "/")), "T09"),
    "soft link": of_file(linked(h5py.SoftLink("/specimens/T01")), "T09", "link"),
    "soft link to nowhere": of_file(linked(h5py.SoftLink("/nowhere")), "T09", "link"),
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
    "escape in a name": of_file(lambda f: f["specimens"].create_group("T\x1b[31m"), "control"),
    "schema of another": of_file(attribute("schema", "other", "/"), "schema"),
    "schema version 3": of_file(attribute("schema_version", 3, "/"), "schema_version"),
    "schema version 2 without its groups": of_file(attribute("schema_version", 2, "/"), "/curves"),
    "schema a number": of_file(attribute("schema", 5.0, "/"), "schema"),
    "schema removed": of_file(attribute("schema", None, "/"), "schema"),
    "specimens removed": of_file(lambda f: f.__delitem__("specimens")),
    "specimens a dataset": of_file(
        lambda f: (f.__delitem__("specimens"), f.__setitem__("specimens", np.arange(3.0)))
    ),
    "specimen a dataset": of_file(put("specimens/T09", np.arange(3.0)), "T09"),
    "specimen empty": of_file(lambda f: f["specimens"].create_group("T09"), "T09"),
    "trial a dataset": of_file(put("specimens/T01/2", np.arange(3.0)), "T01/2"),
    "trial empty": of_file(lambda f: f["specimens/T01"].create_group("2"), "T01/2"),
    "force removed": of_file(replaced("force", None), TRIAL, "'force'"),
    "displacement removed": of_file(replaced("displacement", None), TRIAL),
    "force a group": of_file(
        lambda f: (f.__delitem__(f"{TRIAL}/force"), f.create_group(f"{TRIAL}/force")), TRIAL
    ),
    "force a scalar": of_file(replaced("force", 1.0), TRIAL, "shape"),
    "force a matrix": of_file(replaced("force", np.ones((12, 2))), TRIAL, "shape"),
    "force short": of_file(replaced("force", np.ones(11)), TRIAL, "shape"),
    "force without samples": of_file(replaced("force", np.ones(0)), TRIAL),
    "force null": of_file(replaced("force", h5py.Empty("f8")), TRIAL, "shape"),
    "force nan": of_file(replaced("force", np.full(12, np.nan)), TRIAL, "NaN"),
    "force infinite": of_file(replaced("force", np.r_[np.ones(11), np.inf]), TRIAL),
    "force huge": of_file(replaced("force", np.full(12, 1e300)), TRIAL, "plausible"),
    "force complex": of_file(replaced("force", np.ones(12, complex)), "no plain numbers"),
    "force in mm": of_file(attribute("unit", "mm"), TRIAL, "'mm'"),
    "force in kips": of_file(attribute("unit", "kips"), TRIAL, "'kips'"),
    "force without unit": of_file(attribute("unit", None), TRIAL, "unit"),
    "force unit a number": of_file(attribute("unit", 3.0), TRIAL),
    "force with two units": of_file(attribute("units", "kN"), TRIAL, "two units"),
    "sigma short": of_file(replaced("sigma", np.ones(3)), TRIAL, "sigma"),
    "sigma negative": of_file(replaced("sigma", -np.ones(12)), TRIAL, "sigma"),
    "markers of another shape": of_file(
        replaced("joint_ring_number", [3, 7, 8], "1"), TRIAL, "joint"
    ),
    "ring 0": of_file(replaced("joint_ring_number", [0, 7], "1"), TRIAL, "ring"),
    "ring nan": of_file(replaced("joint_ring_number", [np.nan, 7.0], "1"), TRIAL),
    "ring 2.5": of_file(replaced("joint_ring_number", [2.5, 7.0], "1"), TRIAL),
    "ring 10^18": of_file(replaced("joint_ring_number", [3, 10**18], "1"), TRIAL, "ring"),
    "position a vector": of_file(attribute("s_c", [1.0, 2.0], TRIAL), TRIAL),
    "position nan": of_file(attribute("s_c", np.nan, TRIAL), TRIAL),
    "position text": of_file(attribute("s_c", "35", TRIAL), TRIAL),
    "position without unit": of_file(attribute("s_c_unit", None, TRIAL), TRIAL, "unit"),
    "position in newton": of_file(attribute("s_c_unit", "N", TRIAL), TRIAL, "'N'"),
    **{
        f"version 2, cut to {n} bytes": of_bytes(lambda data, n=n: data[:n], version=2)
        for n in (96, 1000, 4096)
    },
    **{
        f"version 2, bits flipped, seed {seed}": of_bytes(
            lambda data, seed=seed: flipped(data, seed, 1 + 7 * (seed % 3)),
            codes=(0, 1),
            version=2,
        )
        for seed in range(40)
    },
    "version 2, offsets fall": of_file(
        lambda f: f["offsets/force"].__setitem__(1, 30), "/offsets/force", "falls", version=2
    ),
    "version 2, offsets beyond": of_file(
        lambda f: f["offsets/force"].__setitem__(2, 30), "/offsets/force", "24", version=2
    ),
    "version 2, offsets 2^63": of_file(
        lambda f: f["offsets/force"].__setitem__(2, 2**63 - 1), "/offsets/force", version=2
    ),
    "version 2, force without unit": of_file(
        attribute("unit", None, "samples/force"), "/samples/force", "unit", version=2
    ),
    "version 2, force nan": of_file(
        lambda f: f["samples/force"].__setitem__(3, np.nan), "/curves[0]", "NaN", version=2
    ),
    "version 2, force removed": of_file(
        lambda f: f.__delitem__("samples/force"), "/samples/force", version=2
    ),
    "version 2, names of any length": of_file(
        lambda f: (f.__delitem__("curves/trial"), f.__setitem__("curves/trial", ["1", "1"])),
        "/curves/trial",
        version=2,
    ),
    "version 2, curves a dataset": of_file(
        lambda f: (f.__delitem__("curves"), f.__setitem__("curves", [1.0])), "/curves", version=2
    ),
}
