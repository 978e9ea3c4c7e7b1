"""Measurements in our own HDF5: written and read again, spoilt, and files that mean harm."""

import h5py
import numpy as np
import pytest
from measured_files import TIDY, curve, put, read

from jaxtrachea.measurements.read import (
    Curve,
    DataError,
    Measurements,
    read_measurements,
    write_hdf5,
)
from jaxtrachea.measurements.readers import safe_hdf5


def test_round_trip(tmp_path):
    plain = curve("T02", "a/b", s_c=None, sigma=None, joint_rings=None, joint_displacement=None)
    depths, forces = np.linspace(0, 5, 2000), np.linspace(0, 1, 2000)
    long = Curve("Z %", ".", 1.0, 0.0, depths, forces, source="µ")
    wrote = (curve("Z %", "1"), plain, curve("A", "2"), long)
    path = tmp_path / "m.h5"
    write_hdf5(path, Measurements(wrote, (), ()), attrs={"licence": "CC0"}, schema_version=1)
    found = read_measurements([path])
    assert found.bad == ()
    # Specimens in the order of their first curve.
    order = [wrote[0], wrote[3], wrote[1], wrote[2]]
    for a, b in zip(order, found.curves, strict=True):
        assert (a.specimen, a.trial, a.s_c, a.phi_c) == (b.specimen, b.trial, b.s_c, b.phi_c)
        for name in ("displacement", "force", "sigma", "joint_rings", "joint_displacement"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    with h5py.File(path) as file:
        assert file.attrs["schema"] == "jaxtrachea-measurements"
        assert file.attrs["schema_version"] == 1
        assert file.attrs["licence"] == "CC0"
        trial = file["specimens/A/2"]
        assert trial["force"].attrs["unit"] == "N"
        assert (trial.attrs["s_c"], trial.attrs["s_c_unit"]) == (35.0, "mm")
        assert list(trial["joint_ring_number"]) == [3, 7]
    assert [p.name for p in tmp_path.iterdir()] == ["m.h5"]


def test_writing_refuses(tmp_path):
    path = tmp_path / "m.h5"
    study = Measurements((curve(),), (), ())
    write_hdf5(path, study)
    before = path.read_bytes()
    with pytest.raises(FileExistsError, match="overwrite=True"):
        write_hdf5(path, study)
    with pytest.raises(ValueError, match="comes twice"):
        write_hdf5(path, Measurements((curve(), curve()), (), ()), overwrite=True)
    with pytest.raises(ValueError, match="schema"):
        write_hdf5(path, study, attrs={"schema": "mine"}, overwrite=True)
    with pytest.raises(ValueError, match="must have names"):
        write_hdf5(path, Measurements((curve(""),), (), ()), overwrite=True)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["m.h5"]
    write_hdf5(path, Measurements((curve("X"),), (), ()), overwrite=True)
    assert read(path).curves[0].specimen == "X"


@pytest.fixture
def study(tmp_path):
    """Two specimens in a file of ours, to be spoilt."""
    path = tmp_path / "m.h5"
    write_hdf5(path, Measurements((curve("T01"), curve("T02")), (), ()), schema_version=1)
    return path


def spoil_unit(t):
    del t["force"].attrs["unit"]


def spoil_unit_name(t):
    t["force"].attrs["unit"] = "kips"


def spoil_two_units(t):
    t["force"].attrs["units"] = "kN"


def spoil_unit_type(t):
    t["force"].attrs["unit"] = 3.0


def spoil_missing(t):
    del t["displacement"]


def spoil_shape(t):
    del t["sigma"]
    t["sigma"] = np.ones(2)
    t["sigma"].attrs["unit"] = "N"


def spoil_joints(t):
    del t["joint_ring_number"]
    t["joint_ring_number"] = [3, 7, 8]


def spoil_ring(t):
    t["joint_ring_number"][...] = [0, 7]


def spoil_null(t):
    del t["force"]
    t["force"] = h5py.Empty("f8")
    t["force"].attrs["unit"] = "N"


def spoil_position(t):
    t.attrs["s_c"] = [1.0, 2.0]


def spoil_position_unit(t):
    del t.attrs["s_c_unit"]


def spoil_force(t):
    t["force"][1] = np.nan


@pytest.mark.parametrize(
    ("spoil", "kind"),
    [
        (spoil_unit, "unit_missing"),
        (spoil_unit_name, "unit_unknown"),
        (spoil_two_units, "unit_unknown"),
        (spoil_unit_type, "shape"),
        (spoil_missing, "column_missing"),
        (spoil_shape, "shape"),
        (spoil_joints, "shape"),
        (spoil_ring, "shape"),
        (spoil_null, "shape"),
        (spoil_position, "position"),
        (spoil_position_unit, "unit_missing"),
        (spoil_force, "non_finite"),
    ],
)
def test_one_bad_trial_costs_only_itself(study, spoil, kind):
    with h5py.File(study, "r+") as file:
        spoil(file["specimens/T01/1"])
    found = read(study)
    assert [c.specimen for c in found.curves] == ["T02"]
    (bad,) = found.bad
    assert (bad.specimen, bad.kind) == ("T01", kind)
    assert "specimens/T01/1" in bad.message


def test_specimen_without_trials(study):
    with h5py.File(study, "r+") as file:
        file["specimens"].create_group("T03")
    assert read(study).bad[0].kind == "empty"


@pytest.mark.parametrize(
    ("attrs", "message"),
    [
        ({"schema": "other"}, "schema is 'other', expected 'jaxtrachea-measurements'"),
        ({"schema_version": 3}, "schema_version is 3, this program reads 1 and 2"),
        ({"schema_version": 2}, "/curves: no such group"),
        ({"schema": 5.0}, "expected text"),
    ],
)
def test_other_schema(study, attrs, message):
    with h5py.File(study, "r+") as file:
        file.attrs.update(attrs)
    with pytest.raises(DataError, match=message):
        read(study)


def test_hdf5_of_no_known_layout(tmp_path):
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file["x"] = 1.0
    with pytest.raises(DataError, match="no known layout"):
        read(tmp_path / "x.h5")


# --- HDF5 files that mean harm ------------------------------------------------------------------


def external_link(file, folder):
    with h5py.File(folder / "other.h5", "w") as other:
        other["x"] = np.arange(3.0)
    file["specimens/T01/1/extra"] = h5py.ExternalLink("other.h5", "/x")


def dangling_external_link(file, folder):
    file["specimens/T09"] = h5py.ExternalLink("/dev/zero", "/x")


def soft_link(file, folder):
    file["specimens/T09"] = h5py.SoftLink("/specimens/T01")


def virtual_dataset(file, folder):
    layout = h5py.VirtualLayout((3,), "f8")
    layout[:] = h5py.VirtualSource(str(folder / "secret.h5"), "x", (3,))
    file.create_virtual_dataset("specimens/T01/1/v", layout)


def external_storage(file, folder):
    secret = folder / "secret.bin"
    secret.write_bytes(np.arange(3.0).tobytes())
    del file["specimens/T01/1/force"]
    file.create_dataset("specimens/T01/1/force", (3,), "f8", external=[(str(secret), 0, 24)])


def huge_shape(file, folder):
    file.create_dataset("huge", (10**15,), "f8", chunks=(1000,), compression="gzip")


def huge_in_sum(file, folder):
    for i in range(11):
        file.create_dataset(f"h{i}", (safe_hdf5.MAX_ELEMENTS,), "f8", chunks=(1000,))


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
    file["specimens/T01/up"] = file["specimens"]


def control_characters(file, folder):
    file["specimens"].create_group("T\x1b[31m")


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        (external_link, "soft or external link"),
        (dangling_external_link, "soft or external link"),
        (soft_link, "soft or external link"),
        (virtual_dataset, "virtual dataset"),
        (external_storage, "keeps its data in another file"),
        (huge_shape, "declares 1000000000000000 elements"),
        (huge_in_sum, "110000000 in the file so far"),
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


def test_damaged_values_cost_their_curve(tmp_path):
    n = np.linspace(0, 5, 2000)
    study = tmp_path / "m.h5"
    pair = (
        Curve("T01", "1", None, 0.0, n, n**1.5),
        Curve("T02", "1", None, 0.0, n, n**1.5),
    )
    write_hdf5(study, Measurements(pair, (), ()), schema_version=1)
    with h5py.File(study) as file:
        offset = file["specimens/T01/1/force"].id.get_chunk_info(0).byte_offset
    data = bytearray(study.read_bytes())
    data[offset + 10] ^= 0xFF
    study.write_bytes(data)
    found = read(study)
    assert [c.specimen for c in found.curves] == ["T02"]
    assert found.bad[0].kind == "unreadable"
