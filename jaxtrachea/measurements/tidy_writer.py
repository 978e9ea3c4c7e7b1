"""Writing curves as a tidy table (CSV), which the reader `tidy` takes back as it was."""

import io
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxtrachea._errors import InputError
from jaxtrachea.files.atomic import write_whole
from jaxtrachea.files.table import quoted
from jaxtrachea.measurements.curve import Curve
from jaxtrachea.measurements.observed import OBSERVED

#: Largest ring number of a column.
MOST_RINGS = 9999
_HDF5 = "write HDF5 (.h5) instead"


def write_tidy(path: Path, curves: Sequence[Curve]) -> None:
    """Write curves as one table in mm, N, rad and s; the file appears complete or not at all.

    Numbers are written in as many digits as bring them back bit by bit. What only some curves have
    is empty in the rows of the others.

    Args:
        path: the file, replaced if it exists.
        curves: what to write, in this order; at least one.

    Raises:
        InputError: what a tidy table cannot hold: several directions of the tool, standard
            deviations of some curves alone, ring numbers over 9999, a name that would be read
            otherwise.
        OSError: it cannot be written.
    """
    if not curves:
        raise InputError("there are no curves to write")
    directions = {tuple(curve.direction) for curve in curves}
    if len(directions) > 1:
        raise InputError(
            "the tool's direction is not the same in all curves, and a tidy table holds one",
            cure=_HDF5,
        )
    if 0 < sum(curve.sigma is None for curve in curves) < len(curves):
        raise InputError(
            "some curves have sigma and some have none, and a column cannot be empty", cure=_HDF5
        )
    columns = list(dict.fromkeys(name for curve in curves for name in _columns(curve)))
    text = io.StringIO()
    (direction,) = directions
    if direction != (1.0, 0.0):
        text.write(json.dumps({"direction": list(direction)}) + "\n")
    head = ["specimen", "trial", "s [mm]", "phi [rad]", "displacement [mm]", "force [N]", *columns]
    text.write(",".join(head) + "\n")
    for curve in curves:
        names = ",".join(_name(curve, role) for role in ("specimen", "trial"))
        where = "" if curve.s_c is None else repr(float(curve.s_c))
        start = f"{names},{where},{float(curve.phi_c)!r},"
        own = _columns(curve)
        empty = np.full(curve.force.shape, np.nan)
        values = [curve.displacement, curve.force, *(own.get(name, empty) for name in columns)]
        for row in zip(*(v.tolist() for v in values), strict=True):
            # NaN, the only number that differs from itself, is an empty cell.
            text.write(start + ",".join(repr(v) if v == v else "" for v in row) + "\n")
    write_whole(path, text.getvalue().encode())


def _columns(curve: Curve) -> dict[str, np.ndarray]:
    """Heads and values of what a curve holds beside displacement and force."""
    found = {}
    for q in OBSERVED:
        if (values := getattr(curve, q.name)) is None:
            continue
        if q.rings is None:
            heads = [q.role]
        else:
            numbers = _numbers(curve, getattr(curve, q.rings))
            heads = [role for ring in numbers for role in q.columns(ring)]
        columns = values.reshape(len(values), -1).T
        found |= {f"{h} [{q.unit}]": v for h, v in zip(heads, columns, strict=True)}
    return found


def _numbers(curve: Curve, rings: np.ndarray) -> list[int]:
    """Rings counted from 1."""
    found = [int(ring) + 1 for ring in rings]
    if max(found, default=0) > MOST_RINGS:
        what = f"specimen {curve.specimen!r} trial {curve.trial!r} has ring {max(found)}"
        raise InputError(f"{what}, and columns go up to {MOST_RINGS}", cure=_HDF5)
    return found


def _name(curve: Curve, role: str) -> str:
    """A cell of a name."""
    name = getattr(curve, role)
    if not name or not name.isprintable() or name != name.strip():
        raise InputError(
            f"{role} {name!a} is empty, begins or ends with a space, or holds unprintable"
            " characters, and would be read otherwise",
            cure=_HDF5,
        )
    cell = str(quoted(name))
    if cell.startswith("#") or any(c in cell for c in ',"'):
        return '"' + cell.replace('"', '""') + '"'
    return cell
