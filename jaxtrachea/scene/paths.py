"""The path of a scene, from its tables and from CSV files."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from jaxtrachea.config import SpecError
from jaxtrachea.scene.spec import SceneSpec
from jaxtrachea.scene.spec_parts import PathSection
from jaxtrachea.scene.stage import Poses, Presses
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.units import UnitError, column_unit, convert

#: Steps of a press or a line that names none.
STEPS = 10
#: Longest table of points or poses that is read.
MAX_BYTES = 64 * 2**20
#: A unit of each dimension that a table has, for messages.
EXAMPLE = {"length": "mm", "angle": "deg", "time": "s"}
#: Meshes that scenes of `configs/` name, and where they come from.
MESHES = {
    "meshes/trachea.glb": "3D Reference Organ for Trachea, Male v1.0 (GLB, CC BY 4.0), "
    "doi:10.48539/HBM969.WCCJ.636",
}


def path_of(
    spec: SceneSpec, folder: Path, files: list[Path], geometry: Geometry
) -> Poses | Presses | dict[str, Poses | Presses]:
    """The path of a scene; of several tools by name: legs of one tool follow one another.

    Args:
        folder: that relative file names start from.
        files: that were read; those of the path are added.
        geometry: of the tube that it presses.

    Raises:
        SpecError: a file or a value that cannot be used, with its key.
    """
    legs, given = dict(enumerate(spec.path)), (spec, folder, files, geometry)
    if not spec.names:
        return _path(legs, *given)
    return {
        name: _path({i: leg for i, leg in legs.items() if leg.tool == name}, *given)
        for name in spec.names
    }


def _path(
    legs: dict[int, PathSection], spec: SceneSpec, folder: Path, files: list[Path],
    geometry: Geometry,
) -> Poses | Presses:  # fmt: skip
    """The path of one tool; its legs by their place in the file."""
    if spec.path[0].kind == "press":
        reach = 0.0 if spec.effects.width == "point" else spec.model.half_width
        return _presses(legs, geometry, reach)
    from scipy.spatial.transform import Rotation  # presses do without it

    *found, own = zip(*(_leg(leg, i, folder, files) for i, leg in legs.items()), strict=True)
    translation, vectors = (np.concatenate(v) for v in found)
    time = _times(legs, [len(v) for v in found[0]], own)
    turn = Rotation.from_rotvec(vectors).as_matrix()
    return Poses(jnp.asarray(turn), jnp.asarray(translation), time)


def _times(
    legs: dict[int, PathSection], rows: list[int], own: Sequence[np.ndarray | None]
) -> np.ndarray | None:
    """Time of every row, s; None: no leg has any.

    Args:
        legs: by their place in the file.
        rows: of each leg.
        own: times that a file gives, from the end of the leg before on.
    """
    timed = [
        leg.duration is not None or t is not None for leg, t in zip(legs.values(), own, strict=True)
    ]
    if not any(timed):
        return None
    if not all(timed):
        i, other = ([*legs][timed.index(word)] for word in (False, True))
        raise SpecError(f"path.{i}: no duration; expected one, as path.{other} has its time")
    found, end = [], 0.0
    for (i, leg), count, t in zip(legs.items(), rows, own, strict=True):
        if t is not None and leg.duration is not None:
            raise SpecError(f"path.{i}.duration: its file has a column 't'; remove one of them")
        if t is None:
            assert leg.duration is not None
            share = np.linspace(0, 1, count) if count > 1 else np.ones(1)
            t = leg.duration * share
        found.append(end + t)
        end = float(found[-1][-1])
    return np.concatenate(found)


def _presses(legs: dict[int, PathSection], geometry: Geometry, reach: float) -> Presses:
    """Presses at places where all of the tool, which reaches so far along s, lies on the tube."""
    s, phi, D = [], [], []
    length, alpha = float(geometry.length), float(geometry.half_angle)
    low = reach if reach <= length / 2 else 0.0  # a wider one is refused as such
    width = f", where all of the tool (model.half_width {reach:g} mm) lies on it" if low else ""
    before = None
    for i, leg in legs.items():
        at, angle, steps = leg.s or 0.0, leg.phi or 0.0, leg.steps or STEPS
        if not low <= at <= length - low:
            raise SpecError(
                f"path.{i}.s: {at:g} mm; expected a place on the tube, {low:g} to {length - low:g} "
                f"mm{width}"
            )
        if abs(angle) > alpha:
            raise SpecError(
                f"path.{i}.phi: {np.degrees(angle):.4g} deg; expected within the rings, "
                f"-{np.degrees(alpha):.4g} to {np.degrees(alpha):.4g} deg"
            )
        s += [at] * steps
        phi += [angle] * steps
        whole = np.asarray(leg.displacement)
        if leg.duration is None:
            D += [whole * (k + 1) / steps for k in range(steps)]
        else:
            _check_steps(steps, i)
            same = before is not None and (leg.s, leg.phi) == (before.s, before.phi)
            D += list(np.linspace(D[-1] if same else 0 * whole, whole, steps))
        before = leg
    rows = [leg.steps or STEPS for leg in legs.values()]
    time = _times(legs, rows, [None] * len(legs))
    return Presses(np.array(s), np.array(phi), np.array(D), time)


def _leg(leg: PathSection, i: int, folder: Path, files: list[Path]):
    """Translations, rotation vectors and times of one leg; None: it has no times of its own."""
    if leg.kind == "file":
        return _leg_of_file(leg, f"path.{i}.file", folder, files)
    if leg.kind == "line":
        steps = leg.steps or STEPS
        _check_steps(steps, i)
        places = np.linspace(np.asarray(leg.start), np.asarray(leg.end), steps)
    else:
        places = np.asarray(leg.positions)
    turn = np.asarray(leg.rotation or [0.0, 0.0, 0.0])
    return places, np.broadcast_to(turn, places.shape), None


def _leg_of_file(leg: PathSection, key: str, folder: Path, files: list[Path]):
    """The same, of a CSV file."""
    path = named_file(folder, leg.file or "", key, files)
    angles = ("rx", "ry", "rz")
    found = read_table(path, key, ("x", "y", "z"), dict.fromkeys(angles, "angle") | {"t": "time"})
    zero, t = np.zeros_like(found["x"]), found.get("t")
    if t is not None and (np.diff(t, prepend=0) < 0).any():
        row = int(np.argmax(np.diff(t, prepend=0) < 0))
        before = f"{t[row - 1]:g} s in the row before" if row else "the beginning, 0 s"
        raise SpecError(
            f"{key}: {path.name}, column 't': {t[row]:g} s in row {row + 1} below the header, "
            f"after {before}; expected times that never fall"
        )
    places = np.stack([found[name] for name in "xyz"], axis=1)
    return places, np.stack([found.get(name, zero) for name in angles], axis=1), t


def _check_steps(steps: int, i: int) -> None:
    if steps < 2:
        raise SpecError(f"path.{i}.steps: {steps}; expected at least 2, the start and the end")


def named_file(folder: Path, name: str, key: str, files: list[Path]) -> Path:
    """The file that a key names, added to `files`.

    Raises:
        SpecError: there is none.
    """
    path = folder / name
    try:
        found = bool(name) and path.is_file()
    except (OSError, ValueError):
        found = False
    if not found:
        from_where = _source(name) if key == "trachea.file" else ""
        raise SpecError(
            f"{key}: there is no file {name!r} in the scene's folder; check the name{from_where}"
        )
    files.append(path)
    return path


def _source(name: str) -> str:
    """Where a mesh of `configs/` comes from, which the repository does not hold."""
    if name not in MESHES:
        return ""
    return f", or fetch it: {MESHES[name]}, and save it under this name (docs/simulate.md)"


def read_table(
    path: Path, key: str, needed: tuple[str, ...], optional: Mapping[str, str]
) -> dict[str, np.ndarray]:
    """Columns of a CSV file with units in its header, by name.

    Args:
        key: that names it.
        needed: lengths, mm.
        optional: dimension of those that may lack.

    Raises:
        SpecError: with the key that names the file.
    """
    if path.stat().st_size > MAX_BYTES:
        raise SpecError(f"{key}: {path.name} has more than {MAX_BYTES} bytes; thin it out")
    try:
        rows = [row for row in csv.reader(path.read_text("utf-8-sig").splitlines()) if row]
    except (UnicodeDecodeError, csv.Error, OSError):
        raise SpecError(f"{key}: {path.name} is not a CSV file in UTF-8; save it as one") from None
    heads = [column_unit(cell) for cell in rows[0]] if rows else []
    names = [name for name, _ in heads]
    expected = ", ".join(f"{name} [mm]" for name in needed)
    if missing := [name for name in needed if name not in names]:
        raise SpecError(
            f"{key}: {path.name} has no column {missing[0]!r}; expected a header {expected}"
        )
    if len(rows) < 2:
        raise SpecError(f"{key}: {path.name} has no rows; expected at least one")
    columns = {}
    for name, dimension in (dict.fromkeys(needed, "length") | dict(optional)).items():
        if name not in names:
            continue
        at = names.index(name)
        unit = heads[at][1]
        try:
            if unit is None:
                raise UnitError(f"no unit; write {name} [{EXAMPLE[dimension]}]")
            values = convert(np.array([_cell(row, at, i) for i, row in enumerate(rows[1:], 1)]),
                             unit, dimension)  # fmt: skip
        except ValueError as error:
            raise SpecError(f"{key}: {path.name}, column {name!r}: {error}") from None
        if not np.isfinite(values).all():
            raise SpecError(f"{key}: {path.name}, column {name!r}: expected finite numbers")
        columns[name] = values
    return columns


def _cell(row: list[str], at: int, number: int) -> float:
    """A number of the table."""
    if at >= len(row):
        raise ValueError(f"row {number} below the header has {len(row)} cells; complete it")
    try:
        return float(row[at])
    except ValueError:
        raise ValueError(
            f"{row[at]!r} in row {number} below the header; expected a number"
        ) from None
