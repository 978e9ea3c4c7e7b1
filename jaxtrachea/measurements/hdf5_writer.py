"""Writing the project's own HDF5 schema; see `readers.hdf5` for its layout."""

import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxtrachea.files.atomic import write_whole
from jaxtrachea.measurements.curve import Curve
from jaxtrachea.measurements.readers.hdf5 import (
    FIELDS,
    LIMITS,
    NAMES,
    QUANTITIES,
    SCHEMA,
    VERSION,
)
from jaxtrachea.measurements.readers.safe_hdf5 import MAX_TEXT_BYTES

#: Numbers that are packed together: 512 KiB.
CHUNK = 65_536


def write_curves(
    path: Path,
    curves: Sequence[Curve],
    attrs: Mapping[str, str | int | float],
    overwrite: bool,
) -> None:
    """Write curves in the schema; the file appears complete or not at all.

    Args:
        path: the file to write, in an existing folder.
        curves: what to write, in this order, in mm, N, rad and s.
        attrs: further root attributes (licence, source, ...).
        overwrite: replace an existing file.

    Raises:
        FileExistsError: `path` exists and `overwrite` is False.
        ValueError: `attrs` touches schema or schema_version; a name is empty, unprintable or longer
            than 1024 bytes; a (specimen, trial) comes twice; there are more numbers than are read
            back.
    """
    import h5py

    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists; choose another name or pass overwrite=True")
    if {"schema", "schema_version"} & set(attrs):
        raise ValueError("attrs must not set schema or schema_version; they are fixed")
    _check_names(curves)
    _check_sizes(curves)
    image = io.BytesIO()  # as files.atomic says why
    with h5py.File(image, "w") as file:
        file.attrs.update({**attrs, "schema": SCHEMA, "schema_version": VERSION})
        _write(file, curves)
    write_whole(path, image.getvalue())


def _write(file: Any, curves: Sequence[Curve]) -> None:
    """Write all curves into an open, empty file."""
    tables = file.create_group("curves")
    for name in NAMES:
        _text(tables, name, [getattr(curve, name).encode() for curve in curves])
    _text(tables, "source", [_short(curve.source) for curve in curves])
    where = [np.nan if curve.s_c is None else curve.s_c for curve in curves]
    _packed(tables, "s_c", np.array(where, dtype=np.float64), "mm")
    angles = np.array([curve.phi_c for curve in curves], dtype=np.float64)
    _packed(tables, "phi_c", angles, "rad")
    if any(tuple(curve.direction) != (1.0, 0.0) for curve in curves):
        found = np.array([curve.direction for curve in curves], dtype=np.float64)
        _packed(tables, "direction", found, None)
    samples, offsets = file.create_group("samples"), file.create_group("offsets")
    for name, (role, unit) in QUANTITIES.items():
        kept = [getattr(curve, FIELDS.get(name, name)) for curve in curves]
        needed = name in ("displacement", "force")
        if not needed and all(values is None for values in kept):
            continue
        sizes = [0 if values is None else values.size for values in kept]
        _packed(offsets, name, np.concatenate([[0], np.cumsum(sizes, dtype=np.int64)]), None)
        flat = [np.ravel(values) for values in kept if values is not None]
        together = np.concatenate(flat) if flat else np.zeros(0)
        _packed(samples, name, together + 1 if role is None else together, unit)


def _check_names(curves: Iterable[Curve]) -> None:
    seen = set()
    for curve in curves:
        key = (curve.specimen, curve.trial)
        if not all(key):
            raise ValueError("specimen and trial must have names")
        for name in key:
            if not name.isprintable() or len(name.encode(errors="replace")) > MAX_TEXT_BYTES:
                raise ValueError(
                    f"the name {name[:80]!a} holds unprintable characters, or is longer than "
                    f"{MAX_TEXT_BYTES} bytes; rename it"
                )
        if key in seen:
            raise ValueError(f"specimen {key[0]!r} trial {key[1]!r} comes twice; rename one")
        seen.add(key)


def _check_sizes(curves: Sequence[Curve]) -> None:
    """Refuse what no reader would take back."""
    total = 0
    for name in QUANTITIES:
        kept = (getattr(curve, FIELDS.get(name, name)) for curve in curves)
        size = sum(values.size for values in kept if values is not None)
        total += size
        if size > LIMITS.elements or total > LIMITS.total:
            raise ValueError(
                f"{name} holds {size} numbers ({total} with those before), at most "
                f"{LIMITS.elements} ({LIMITS.total} a file) are read back; split the study into "
                "several files"
            )


def _short(source: str) -> bytes:
    """Where a curve came from; of a long place its end."""
    text = source.encode(errors="replace").replace(b"\0", b"?")
    return text[-MAX_TEXT_BYTES:].decode(errors="ignore").encode()


def _text(group: Any, name: str, texts: Sequence[bytes]) -> None:
    """Text of fixed length: as long as the longest, filled with zero bytes."""
    import h5py

    longest = max(1, max(map(len, texts), default=1))
    _packed(group, name, np.array(texts, dtype=h5py.string_dtype("utf-8", longest)), None)


def _packed(group: Any, name: str, values: np.ndarray, unit: str | None) -> None:
    """A dataset in chunks, packed, with a checksum of each."""
    how = {}
    if values.size:
        rows = max(1, CHUNK // max(1, values.dtype.itemsize // 8))
        chunks = (min(rows, len(values)), *values.shape[1:])
        how = {"chunks": chunks, "compression": "gzip", "shuffle": True, "fletcher32": True}
    dataset = group.create_dataset(name, data=values, **how)
    if unit:
        dataset.attrs["unit"] = unit
