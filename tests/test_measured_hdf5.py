"""Measurements in our own HDF5: written, read, spoilt, and files that mean harm."""

import math
import re

import h5py
import numpy as np
import pytest
from full_curves import NAN, full, plain, same, stored
from measured_files import TIDY, put
from run_cli import run

from jaxtrachea.measurements import hdf5_writer
from jaxtrachea.measurements.read import (
    Curve,
    DataError,
    ReadOptions,
    read_measurements,
)
from jaxtrachea.measurements.readers.hdf5 import LIMITS
from jaxtrachea.measurements.readers.safe_hdf5 import Limits


def read(path, **options):
    return read_measurements([path], ReadOptions(**({"loading": "all"} | options)))


# --- written and read back ----------------------------------------------------------------------


def test_round_trip(tmp_path):
    alone = full("Ü %", "a/b", n=7, direction=(1.0, 0.0), end_V=None, joint_side_displacement=None)
    markers = {"joint_rings": np.array([4]), "joint_displacement": np.arange(40.0)[:, None]}
    given = (full(), plain(), alone, full("T01", "2", sigma=None, s_c=None, time=None, **{
        name: None for name in ("end_rings", "end_U", "end_V", "side_force")}),
        Curve("Z", ".", 1.0, -0.3, np.arange(40.0), np.arange(40.0), **markers))  # fmt: skip
    path = stored(tmp_path / "m.h5", *given, attrs={"licence": "CC0"})
    found = read(path)
    assert found.bad == ()
    by_name = {(c.specimen, c.trial): c for c in found.curves}
    assert len(by_name) == len(given)
    for curve in given:
        same(curve, by_name[curve.specimen, curve.trial])
    with h5py.File(path) as file:
        attrs = {"schema": "jaxtrachea-measurements", "schema_version": 2, "licence": "CC0"}
        assert dict(file.attrs) == attrs
    assert [p.name for p in tmp_path.iterdir()] == ["m.h5"]


def test_layout(tmp_path):
    with h5py.File(stored(tmp_path / "m.h5", full("µ"), plain(), full("A", "2"))) as file:
        assert file["curves/specimen"].asstr()[()].tolist() == ["µ", "T02", "A"]
        assert file["curves/trial"][()].tolist() == [b"1", b"1", b"2"]
        np.testing.assert_array_equal(file["curves/s_c"][()], [35.0, NAN, 35.0])
        assert file["offsets/force"][()].tolist() == [0, 3, 43, 46]
        assert file["offsets/end_U"][()].tolist() == [0, 18, 18, 36]
        assert file["samples/joint_ring_number"][()].tolist() == [3, 7, 3, 7]
        assert file["samples/force"][4] == (4.0 / 39) ** 1.5
        units = {name: file[f"samples/{name}"].attrs.get("unit") for name in file["samples"]}
        assert units == {
            "displacement": "mm", "force": "N", "sigma": "N", "time": "s", "side_force": "N",
            "joint_displacement": "mm", "joint_side_displacement": "mm", "end_U": "mm",
            "end_V": "mm", "joint_ring_number": None, "end_ring_number": None,
        }  # fmt: skip
        assert (file["curves/s_c"].attrs["unit"], file["curves/phi_c"].attrs["unit"]) == (
            "mm", "rad")  # fmt: skip
        for group in ("curves", "samples", "offsets"):
            for data in file[group].values():
                assert (data.compression, data.shuffle, data.fletcher32) == ("gzip", True, True)


def test_units(tmp_path):
    path = stored(tmp_path / "m.h5", full())
    units = {"force": "mN", "displacement": "cm", "end_U": "um", "time": "ms", "side_force": "kN"}
    with h5py.File(path, "r+") as file:
        for name, unit in units.items():
            file[f"samples/{name}"].attrs["unit"] = unit
        file["curves/phi_c"].attrs["unit"] = "deg"
        del file["samples/sigma"].attrs["unit"]
    (curve,) = read(path, units={"sigma": "mN"}).curves
    factors = {"force": 1e-3, "displacement": 10, "end_U": 1e-3, "time": 1e-3, "side_force": 1e3}
    for name, factor in (factors | {"sigma": 1e-3, "end_V": 1}).items():
        expected = factor * getattr(full(), name)
        np.testing.assert_allclose(getattr(curve, name), expected, rtol=1e-15)
    assert curve.phi_c == pytest.approx(math.radians(0.5), rel=1e-15)


def test_time_without_unit_is_left_alone(tmp_path):
    path = stored(tmp_path / "m.h5", full())
    with h5py.File(path, "r+") as file:
        del file["samples/time"].attrs["unit"]
    assert read(path).curves[0].time is None


def test_written_by_hand(tmp_path):
    """A file with no more than is needed: integers, single precision, no filters."""
    with h5py.File(tmp_path / "m.h5", "w") as file:
        file.attrs.update({"schema": "jaxtrachea-measurements", "schema_version": 2})
        file["curves/specimen"], file["curves/trial"] = (
            np.array([b"A", b"B"]),
            np.array([b"1", b"1"]),
        )
        for name, unit in (("displacement", "mm"), ("force", "N")):
            file[f"offsets/{name}"] = np.array([0, 2, 5], "u2")
            file[f"samples/{name}"] = np.array([0, 1, 0, 2, 5], "f4")
            file[f"samples/{name}"].attrs["units"] = unit
    a, b = read(tmp_path / "m.h5").curves
    assert (a.force.tolist(), b.force.tolist()) == ([0.0, 1.0], [0.0, 2.0, 5.0])
    assert (a.s_c, a.phi_c, a.direction, a.force.dtype) == (None, 0.0, (1.0, 0.0), np.float64)


def test_writing_refuses(tmp_path):
    path = stored(tmp_path / "m.h5", full())
    before = path.read_bytes()
    with pytest.raises(FileExistsError, match="overwrite=True"):
        stored(path, full())
    refused = {
        "comes twice": (full(), full()),
        "must have names": (full(""),),
        "unprintable": (full("T\x1b[31m"),),
        "longer than 1024 bytes": (full("µ" * 600),),
    }
    for message, curves in refused.items():
        with pytest.raises(ValueError, match=message):
            stored(path, *curves, overwrite=True)
    for key in ("schema", "schema_version"):
        with pytest.raises(ValueError, match="must not set schema"):
            stored(path, full(), overwrite=True, attrs={key: 1})
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["m.h5"]
    (found,) = read(stored(path, full("X"), overwrite=True)).curves
    assert found.specimen == "X"


@pytest.mark.parametrize(
    ("elements", "total", "says"),
    [(79, 1000, "displacement holds 80 numbers"), (80, 159, r"force holds 80 numbers \(160 with")],
)
def test_what_is_not_read_back_is_not_written(tmp_path, monkeypatch, elements, total, says):
    """Two curves of 40 samples: 80 displacements and as many forces."""
    for limits in (Limits(elements=elements, total=total), Limits(elements=80, total=160)):
        monkeypatch.setattr(hdf5_writer, "LIMITS", limits)
        if limits.total == 160:
            stored(tmp_path / "m.h5", plain("T1"), plain("T2"))
            continue
        with pytest.raises(ValueError, match=f"{says}.*split the study"):
            stored(tmp_path / "m.h5", plain("T1"), plain("T2"))
        assert not list(tmp_path.iterdir())


# --- one bad curve ------------------------------------------------------------------------------


def part(name, i, change):
    """Change the values of one curve in place."""

    def spoil(file):
        start, stop = file[f"offsets/{name}"][i : i + 2]
        values = file[f"samples/{name}"][start:stop]
        change(values)
        file[f"samples/{name}"][start:stop] = values

    return spoil


def moved(name, row, by):
    def spoil(file):
        file[f"offsets/{name}"][row] += by

    return spoil


BAD_CURVES = {
    "force nan": (part("force", 0, lambda v: v.__setitem__(1, NAN)), "non_finite", "sample 2"),
    "sigma 0": (part("sigma", 0, lambda v: v.__setitem__(2, 0)), "bad_sigma", "sample 3"),
    "displacement huge": (
        part("displacement", 0, lambda v: v.__setitem__(2, 2e3)), "absurd_scale", "2000 mm"),
    "ring twice": (part("joint_ring_number", 0, lambda v: v.__setitem__(1, 3)), "shape", "ring"),
    "ring 0": (part("end_ring_number", 0, lambda v: v.__setitem__(0, 0)), "shape", "ring"),
    "force short": (moved("force", 1, -1), "shape", "force (2,)"),
    "sigma long": (moved("sigma", 1, 1), "shape", "sigma (4,)"),
    "markers short": (moved("joint_displacement", 1, -1), "shape",
        "joint_displacement has 5 values, expected 3 x 2 (samples, rings of joint_ring_number)"),
    "ends long": (moved("end_U", 1, 1), "shape", "end_U has 19 values, expected 3 x 3 x 2"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_CURVES)
def test_bad_curve(tmp_path, name):
    spoil, kind, message = BAD_CURVES[name]
    path = stored(tmp_path / "m.h5", full(), full("T02", n=4), plain("T03"))
    with h5py.File(path, "r+") as file:
        spoil(file)
    found = read(path)
    bad = found.bad[0]
    assert (bad.specimen, bad.trial, bad.kind) == ("T01", "1", kind)
    assert f"{path}:/curves[0]" in bad.message
    assert message in bad.message
    assert bad.cure
    same(found.curves[-1], plain("T03"))
    # What moves the boundary of two curves spoils both.
    assert len(found.bad) == (2 if name.endswith(("short", "long")) else 1)


# --- a bad file ---------------------------------------------------------------------------------


def replaced(name, data, unit=None):
    def spoil(file):
        if name in file:
            del file[name]
        if data is not None:
            file[name] = data
            if unit:
                file[name].attrs["unit"] = unit

    return spoil


def attribute(name, key, value):
    def spoil(file):
        if value is None:
            del file[name].attrs[key]
        else:
            file[name].attrs[key] = value

    return spoil


BAD_FILES = {
    "offsets fall": (replaced("offsets/force", [0, 44, 43]), "offsets/force", "falls from 44"),
    "offsets below 0": (replaced("offsets/force", [0, -3, 43]), "offsets/force", "falls from 0"),
    "offsets beyond": (replaced("offsets/force", [0, 3, 44]), "offsets/force",
        "ends at 44, but samples/force has 43 values"),
    "offsets too few": (replaced("offsets/force", [0, 43]), "offsets/force", "2 rows, expected 3"),
    "offsets begin late": (replaced("offsets/force", [1, 3, 43]), "offsets/force", "begins at 1"),
    "offsets of floats": (replaced("offsets/force", [0.0, 3.0, 43.0]), "offsets/force",
        "float64 of shape (3,), expected a list of integers"),
    "offsets a table": (replaced("offsets/force", [[0, 3, 43]]), "offsets/force", "shape (1, 3)"),
    "offsets missing": (replaced("offsets/sigma", None), "offsets/sigma", "no such dataset"),
    "offsets alone": (replaced("samples/sigma", None), "samples/sigma", "no dataset 'sigma'"),
    "force missing": (replaced("samples/force", None), "samples/force", "no dataset 'force'"),
    "force and offsets missing": (
        lambda file: [file.__delitem__(f"{g}/force") for g in ("samples", "offsets")],
        "offsets/force", "no such dataset"),
    "force a table": (replaced("samples/force", np.ones((43, 2)), "N"), "samples/force", "(43, 2)"),
    "force short": (replaced("samples/force", np.ones(42), "N"), "offsets/force", "ends at 43"),
    "force complex": (replaced("samples/force", np.ones(43, complex), "N"), "samples/force",
        "no plain numbers"),
    "force text": (replaced("samples/force", np.full(43, b"1.0"), "N"), "samples/force",
        "no plain numbers"),
    "force null": (replaced("samples/force", h5py.Empty("f8"), "N"), "samples/force", "no shape"),
    "force without unit": (attribute("samples/force", "unit", None), "samples/force",
        "force has no unit"),
    "force in mm": (attribute("samples/force", "unit", "mm"), "samples/force", "'mm'"),
    "force with two units": (attribute("samples/force", "units", "kN"), "samples/force",
        "two units"),
    "force unit a number": (attribute("samples/force", "unit", 3.0), "samples/force", "text"),
    "s without unit": (attribute("curves/s_c", "unit", None), "curves/s_c", "s_c has no unit"),
    "s short": (replaced("curves/s_c", [1.0], "mm"), "curves/s_c", "1 rows, expected 2"),
    "s text": (replaced("curves/s_c", [b"35", b"36"], "mm"), "curves/s_c", "no plain numbers"),
    "phi in mm": (attribute("curves/phi_c", "unit", "mm"), "curves/phi_c", "'mm'"),
    "direction of three": (replaced("curves/direction", np.ones((2, 3))), "curves/direction",
        "(2, 3), expected (2, 2)"),
    "rings of halves": (replaced("samples/joint_ring_number", [3.5, 7.0]),
        "samples/joint_ring_number", "not whole"),
    "names missing": (replaced("curves/specimen", None), "curves/specimen", "no such dataset"),
    "names numbers": (replaced("curves/specimen", [1, 2]), "curves/specimen", "int64"),
    "names of any length": (replaced("curves/specimen", ["A", "B"]), "curves/specimen",
        "text of fixed length"),
    "names too long": (replaced("curves/specimen", np.array([b"A" * 2000, b"B"])),
        "curves/specimen", "at most 1024 bytes"),
    "names not UTF-8": (replaced("curves/specimen", np.array([b"T\xe901", b"B"])),
        "curves/specimen", "not text in UTF-8"),
    "name empty": (replaced("curves/specimen", np.array([b"A", b""])), "curves/specimen", "row 1"),
    "name unprintable": (replaced("curves/trial", np.array([b"T\x1b[31m", b"B"])), "curves/trial",
        "row 0: 'T\\x1b[31m'"),
    "trials short": (replaced("curves/trial", np.array([b"1"])), "curves/trial", "1 rows"),
    "no curves": (lambda f: [replaced(f"curves/{n}", np.zeros(0, "S1"))(f)
                             for n in ("specimen", "trial")], "curves/specimen", "no curves"),
    "no samples": (lambda file: file.__delitem__("samples"), "samples", "no such group"),
    "samples a dataset": (replaced("samples", [1.0]), "samples", "no such group"),
    "text elsewhere": (replaced("samples/notes", np.array([b"a"])), "samples/notes",
        "no plain numbers"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_FILES)
def test_bad_file(tmp_path, name):
    spoil, place, message = BAD_FILES[name]
    path = stored(tmp_path / "m.h5", full(), plain())
    with h5py.File(path, "r+") as file:
        spoil(file)
    with pytest.raises(DataError) as caught:
        read(path)
    text = str(caught.value)
    assert text.startswith(f"{path}:/{place}: ")
    assert message in text
    assert caught.value.remedy
    assert "\n" not in text
    assert "\x1b" not in text


def test_checksum(tmp_path):
    """A byte of any dataset that is read: the file is refused, and the dataset named."""
    path = stored(tmp_path / "m.h5", full(), plain())
    with h5py.File(path) as file:
        chunks = {
            f"{group}/{name}": data.id.get_chunk_info(0)
            for group in ("curves", "samples", "offsets")
            for name, data in file[group].items()
        }
    assert len(chunks) == 28
    del chunks["curves/source"]  # for people
    good = path.read_bytes()
    for name, chunk in chunks.items():
        for at in (2, chunk.size // 2, chunk.size - 1):  # packed numbers and checksum
            data = bytearray(good)
            data[chunk.byte_offset + at] ^= 0x10
            path.write_bytes(data)
            with pytest.raises(
                DataError, match=re.escape(f"{path}:/{name}: ") + ".*damaged .*copy"
            ):
                read(path)


def test_units_against_the_options(tmp_path):
    path = stored(tmp_path / "m.h5", full())
    with pytest.raises(DataError, match="samples/force.* is in N but units.force says kN"):
        read(path, units={"force": "kN"})


# --- another schema ---------------------------------------------------------------------------


@pytest.fixture
def study(tmp_path):
    """Two specimens in a file of ours, to be spoilt."""
    return stored(tmp_path / "m.h5", full(), plain())


@pytest.mark.parametrize(
    ("attrs", "message"),
    [
        ({"schema": "other"}, "schema is 'other', expected 'jaxtrachea-measurements'"),
        ({"schema_version": 3}, "schema_version is 3, this program reads 2; update"),
        ({"schema": 5.0}, "expected text"),
    ],
)
def test_other_schema(study, attrs, message):
    with h5py.File(study, "r+") as file:
        file.attrs.update(attrs)
    with pytest.raises(DataError, match=message):
        read(study)


@pytest.mark.parametrize(
    "words", ["check old.h5", "init old.h5", "fit spec.toml", "convert old.h5 new.h5"]
)
def test_version_1(tmp_path, monkeypatch, capsys, words):
    """A group per trial, as version 0.1.0 read it too: told what it is, and the cure."""
    monkeypatch.chdir(tmp_path)
    with h5py.File("old.h5", "w") as file:
        file.attrs.update({"schema": "jaxtrachea-measurements", "schema_version": 1})
        for name, unit in (("displacement", "mm"), ("force", "N")):
            file[f"specimens/T01/1/{name}"] = np.arange(9.0)
            file[f"specimens/T01/1/{name}"].attrs["unit"] = unit
    (tmp_path / "spec.toml").write_text('[data]\nfiles = "old.h5"\n')
    code, out, err = run(monkeypatch, capsys, *words.split())
    assert (code, out) == (2, "")
    assert (
        "old.h5: schema_version is 1, this program reads 2; convert it with jaxtrachea 0.1" in err
    )
    assert "jaxtrachea convert OLD.h5 NEW.h5" in err
    assert {p.name for p in tmp_path.iterdir()} == {"old.h5", "spec.toml"}


def test_hdf5_of_no_known_layout(tmp_path):
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file["x"] = 1.0
    with pytest.raises(DataError, match="no known layout"):
        read(tmp_path / "x.h5")


# --- HDF5 files that mean harm ------------------------------------------------------------------


def external_link(file, folder):
    with h5py.File(folder / "other.h5", "w") as other:
        other["x"] = np.arange(3.0)
    file["samples/extra"] = h5py.ExternalLink("other.h5", "/x")


def dangling_external_link(file, folder):
    file["samples/x"] = h5py.ExternalLink("/dev/zero", "/x")


def soft_link(file, folder):
    file["samples/x"] = h5py.SoftLink("/samples/force")


def virtual_dataset(file, folder):
    layout = h5py.VirtualLayout((3,), "f8")
    layout[:] = h5py.VirtualSource(str(folder / "secret.h5"), "x", (3,))
    file.create_virtual_dataset("samples/v", layout)


def external_storage(file, folder):
    secret = folder / "secret.bin"
    secret.write_bytes(np.arange(3.0).tobytes())
    del file["samples/force"]
    file.create_dataset("samples/force", (3,), "f8", external=[(str(secret), 0, 24)])


def huge_shape(file, folder):
    file.create_dataset("huge", (10**15,), "f8", chunks=(1000,), compression="gzip")


def huge_in_sum(file, folder):
    for i in range(4):
        file.create_dataset(f"h{i}", (LIMITS.elements,), "f8", chunks=(1000,))


def variable_length(file, folder):
    file.create_dataset("v", (2,), h5py.vlen_dtype("f8"))


def text_dataset(file, folder):
    file["t"] = ["a", "b"]


def reference(file, folder):
    file.create_dataset("r", (2,), h5py.ref_dtype)


def compound(file, folder):
    file["c"] = np.zeros(2, dtype=[("a", "f8"), ("b", "i4")])


def named_type(file, folder):
    file["n"] = np.dtype("f8")


def loop(file, folder):
    file["samples/up"] = file["samples"]


def control_characters(file, folder):
    file["samples"].create_group("T\x1b[31m")


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        (external_link, "soft or external link"),
        (dangling_external_link, "soft or external link"),
        (soft_link, "soft or external link"),
        (virtual_dataset, "virtual dataset"),
        (external_storage, "keeps its data in another file"),
        (huge_shape, "declares 1000000000000000 elements"),
        (huge_in_sum, r"4000\d+ in the file so far"),
        (variable_length, "no plain numbers"),
        (text_dataset, "no plain numbers"),
        (reference, "no plain numbers"),
        (compound, "no plain numbers"),
        (named_type, "neither group nor dataset"),
        (loop, "within itself"),
        (control_characters, "control characters"),
    ],
)
def test_hostile_file(study, tmp_path, harm, message):
    with h5py.File(study, "r+") as file:
        harm(file, tmp_path)
    with pytest.raises(DataError, match=message) as caught:
        read(study)
    assert str(study) in str(caught.value)
    assert "\x1b" not in str(caught.value)


@pytest.mark.parametrize("fraction", [0.0, 0.001, 0.1, 0.5, 0.99])
def test_truncated(study, fraction):
    data = study.read_bytes()
    study.write_bytes(data[: int(fraction * len(data))])
    with pytest.raises(DataError, match="truncated or damaged|no text table"):
        read(study)


def test_text_named_h5(tmp_path):
    with pytest.raises(DataError, match="not a readable HDF5 file"):
        read(put(tmp_path, TIDY, "x.h5"))
