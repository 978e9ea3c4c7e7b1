"""Values and attributes of an audited HDF5 file, by the lower level of h5py where they are plain.

What is not plain (another type or shape, damage) is left to h5py's own way. `safe_hdf5` has walked
through the file before.
"""

from typing import Any, NamedTuple

import numpy as np

from jaxtrachea.measurements.curve import Fault

# Text of any length, as h5py marks it.
_TEXT = np.dtype("O", metadata={"vlen": str})
#: In the place of an attribute that must be read by the longer way.
_ODD = object()


def _library() -> Any:
    """h5py, imported when first used; what is called of its lower level has no types."""
    import h5py

    return h5py


def numeric(group: Any, name: str) -> np.ndarray:
    """Values of a dataset in an audited file, as float64.

    Raises:
        Fault: no such dataset ("column_missing"), or its bytes are damaged ("unreadable").
    """
    return _values(_dataset(group, name), name)


def measured(group: Any, name: str) -> tuple[np.ndarray, str | None]:
    """Values of a dataset in an audited file, as float64, and its unit; see `unit_of`.

    Raises:
        Fault: as `numeric` and `unit_of`.
    """
    dataset = _dataset(group, name)
    return _values(dataset, name), _unit(dataset, name)


def _dataset(group: Any, name: str) -> Any:
    """Identifier of a dataset of a group, opened in one step: far cheaper than `group.get`."""
    h5 = _library()
    try:
        identifier = h5.h5o.open(group.id, name.encode())
    except KeyError:
        identifier = None
    if not isinstance(identifier, h5.h5d.DatasetID):
        raise Fault(
            "column_missing",
            f"no dataset {name!r}; there are {', '.join(map(repr, group)) or 'none'}",
            "store it, or correct its name",
        )
    return identifier


def _values(dataset: Any, name: str) -> np.ndarray:
    """Values of a dataset by its identifier."""
    h5 = _library()
    space = dataset.get_space()
    if space.get_simple_extent_type() == h5.h5s.NULL:
        raise Fault("shape", f"dataset {name!r} has no shape", "store a vector")
    if dataset.get_type().equal(h5.h5t.NATIVE_DOUBLE):
        values = np.empty(space.get_simple_extent_dims())
        try:
            dataset.read(h5.h5s.ALL, h5.h5s.ALL, values, mtype=h5.h5t.NATIVE_DOUBLE)
            return values
        except (OSError, RuntimeError, ValueError, TypeError):
            pass  # The longer way says what is wrong.
    try:
        return np.asarray(h5.Dataset(dataset)[()], dtype=np.float64)
    except (OSError, RuntimeError, ValueError, TypeError) as error:
        raise Fault(
            "unreadable", f"dataset {name!r} is damaged ({error})", "copy the file again"
        ) from None


def unit_of(group: Any, name: str) -> str | None:
    """Text of the attribute ``unit`` (or ``units``) of a dataset; None if there is none.

    Raises:
        Fault: the attribute is no text, or the two differ.
    """
    return _unit(group[name].id, name)


def _unit(dataset: Any, name: str) -> str | None:
    texts = {_text(dataset, key) for key in ("unit", "units")} - {None}
    if len(texts) > 1:
        raise Fault(
            "unit_unknown", f"{name!r} has two units, {sorted(map(str, texts))}", "remove one"
        )
    return texts.pop() if texts else None


def text_attribute(holder: Any, name: str) -> str | None:
    """A text attribute; None if there is none.

    Raises:
        Fault: it is no text.
    """
    return _text(holder.id, name)


def _text(holder: Any, name: str) -> str | None:
    value = _plain_text(holder, name)
    if value is None:
        return None
    if isinstance(value, bytes):
        return value.decode("utf-8", "surrogateescape")
    value = _attribute(holder, name)
    if isinstance(value, bytes):
        value = value.decode("utf-8", "replace")
    if value is not None and not isinstance(value, str):
        raise Fault(
            "shape", f"attribute {name!r} is {value!r}, expected text", "store it as a string"
        )
    return value


def attribute(holder: Any, name: str) -> Any:
    """An attribute of a group or dataset; None if there is none.

    Raises:
        Fault: its bytes are damaged ("unreadable").
    """
    return _attribute(holder.id, name)


def _attribute(holder: Any, name: str) -> Any:
    """An attribute of what has this identifier."""
    h5 = _library()
    try:
        # Far cheaper than the exception behind `attrs.get`.
        if not h5.h5a.exists(holder, name.encode()):
            return None
        return h5.AttributeManager(_Holder(holder))[name]
    except (OSError, RuntimeError, ValueError, TypeError) as error:
        raise Fault(
            "unreadable", f"attribute {name!r} is damaged ({error})", "copy the file again"
        ) from None


class _Holder(NamedTuple):
    """What the library's manager of attributes asks of a group or dataset."""

    id: Any


def _plain_text(holder: Any, name: str) -> Any:
    """A text by itself, far cheaper than by `attrs`.

    Returns:
        Bytes; None if there is none, `_ODD` if it is of another kind or shape, or damaged.
    """
    h5 = _library()
    key = name.encode()
    try:
        if not h5.h5a.exists(holder, key):
            return None
        stored = h5.h5a.open(holder, key)
        # Without this a list of one would be taken for its value, and nothing for some value.
        if stored.get_space().get_simple_extent_type() != h5.h5s.SCALAR:
            return _ODD
        value = np.empty((), _TEXT)
        stored.read(value)  # The library refuses to make text of numbers or of fixed length.
        return value[()]
    except (OSError, RuntimeError, ValueError, TypeError):
        return _ODD
