"""Short ways into HDF5 against h5py's own: values and attributes of every kind and shape."""

import h5py
import numpy as np
import pytest

from jaxtrachea.measurements.curve import Fault
from jaxtrachea.measurements.readers.hdf5_values import (
    attribute,
    numeric,
    text_attribute,
)

ANY_LENGTH = h5py.string_dtype()
TEXTS = {
    "text": ("mm", ANY_LENGTH),
    "other letters": ("µm", ANY_LENGTH),
    "ASCII": ("mm", h5py.string_dtype("ascii")),
    "empty": ("", ANY_LENGTH),
    "fixed length": (b"mm", "S2"),
    "of longer fixed length": (b"mm", "S8"),
}
NO_TEXTS = {
    "list of one": (["mm"], ANY_LENGTH),
    "number": (1.5, "f8"),
    "nothing": (h5py.Empty(ANY_LENGTH), None),
    "truth value": (True, None),
}
OTHERS = {
    "number": (1.1, ">f8"),
    "list of one": ([1.5], "f8"),
    "two": ([1.5, 2.5], "f8"),
    "text": ("1.5", ANY_LENGTH),
    "nothing": (h5py.Empty("f8"), None),
    "truth value": (True, None),
}


@pytest.fixture
def file():
    with h5py.File("x", "w", driver="core", backing_store=False) as file:
        yield file


def stored(file, case):
    value, dtype = case
    file.attrs.create("x", value, dtype=dtype)
    return file.attrs["x"]


@pytest.mark.parametrize("name", TEXTS)
def test_text(file, name):
    expected = stored(file, TEXTS[name])
    expected = expected.decode() if isinstance(expected, bytes) else expected
    assert text_attribute(file, "x") == expected
    assert text_attribute(file, "absent") is None


@pytest.mark.parametrize("name", NO_TEXTS)
def test_no_text(file, name):
    stored(file, NO_TEXTS[name])
    with pytest.raises(Fault, match="expected text"):
        text_attribute(file, "x")


@pytest.mark.parametrize("name", OTHERS)
def test_other_attributes_are_left_as_they_are(file, name):
    expected = stored(file, OTHERS[name])
    found = attribute(file, "x")
    assert type(found) is type(expected)
    assert np.shape(found) == np.shape(expected)
    assert isinstance(expected, h5py.Empty) or np.array_equal(found, expected)
    assert attribute(file, "absent") is None


@pytest.mark.parametrize("dtype", ["<f8", ">f8", "f4", "f2", "i8", "u1", "?"])
@pytest.mark.parametrize("shape", [(), (0,), (1,), (5,), (3, 2)])
@pytest.mark.parametrize("packed", [False, True])
def test_values(file, dtype, shape, packed):
    values = np.arange(np.prod(shape, dtype=int)).reshape(shape).astype(dtype)
    how = {"compression": "gzip", "fletcher32": True} if packed and values.size else {}
    if how and not shape:
        how = {}
    file.create_dataset("v", data=values, **how)
    found = numeric(file, "v")
    assert found.dtype == np.float64
    np.testing.assert_array_equal(found, file["v"][()].astype(np.float64), strict=True)


def test_values_never_written_are_the_fill_value(file):
    file.create_dataset("v", (4,), "f8", chunks=(2,), fillvalue=7.5)
    np.testing.assert_array_equal(numeric(file, "v"), np.full(4, 7.5))


def test_no_values(file):
    file["v"] = h5py.Empty("f8")
    with pytest.raises(Fault, match="no shape"):
        numeric(file, "v")
