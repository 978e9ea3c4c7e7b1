"""Values and attributes of an audited HDF5 file: `safe_hdf5` has walked through it before."""

from typing import Any

import numpy as np

from jaxtrachea.measurements.curve import Fault

#: What h5py raises for damaged bytes, whichever of them.
_DAMAGED = (OSError, RuntimeError, ValueError, TypeError)


def numeric(group: Any, name: str) -> np.ndarray:
    """Values of a dataset, as float64.

    Raises:
        Fault: no such dataset ("column_missing"), or its bytes are damaged ("unreadable").
    """
    dataset = group.get(name)
    if not hasattr(dataset, "shape"):
        raise Fault(
            "column_missing",
            f"no dataset {name!r}; there are {', '.join(map(repr, group)) or 'none'}",
            "store it, or correct its name",
        )
    if dataset.shape is None:
        raise Fault("shape", f"dataset {name!r} has no shape", "store a vector")
    try:
        return np.asarray(dataset[()], dtype=np.float64)
    except _DAMAGED as error:
        raise Fault(
            "unreadable", f"dataset {name!r} is damaged ({error})", "copy the file again"
        ) from None


def measured(group: Any, name: str) -> tuple[np.ndarray, str | None]:
    """Values of a dataset, as float64, and its unit.

    Raises:
        Fault: as `numeric` and `unit_of`.
    """
    return numeric(group, name), unit_of(group, name)


def unit_of(group: Any, name: str) -> str | None:
    """Text of the attribute ``unit`` (or ``units``) of a dataset; None if there is none.

    Raises:
        Fault: the attribute is no text, or the two differ.
    """
    dataset = group[name]
    texts = {text_attribute(dataset, key) for key in ("unit", "units")} - {None}
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
    value = attribute(holder, name)
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
    try:
        return holder.attrs[name] if name in holder.attrs else None
    except _DAMAGED as error:
        raise Fault(
            "unreadable", f"attribute {name!r} is damaged ({error})", "copy the file again"
        ) from None
