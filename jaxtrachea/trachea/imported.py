"""Real tracheas: a surface file made into a mesh bound to its skeleton.

STL, OBJ, PLY, GLB and what else trimesh reads, in any position and orientation. What is found in
the shape (unit, ends, centreline, anterior side, rings) can be given instead; what can be neither
is refused.
"""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from jaxtrachea._arguments import float_dtype
from jaxtrachea._errors import InputError
from jaxtrachea.trachea.centreline import (
    Line,
    Shape,
    check_turn,
    find_centreline,
    locate,
    turned,
)
from jaxtrachea.trachea.cleaning import Surface, clean, join_corners
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.holes import holes_of
from jaxtrachea.trachea.mesh import Mesh, MeshError, vertex_normals
from jaxtrachea.trachea.objects import check_left_out, joined
from jaxtrachea.trachea.rings import find_anterior, find_rings
from jaxtrachea.trachea.surface_file import (
    cartilage_of,
    parts_of,
    rings_named,
    scale_of,
    wall_of,
)

#: Steps of reading that take time: the file, its repair, centreline, sections, places of vertices.
STEPS = 5


class Imported(eqx.Module):
    """A trachea read from a file.

    Attributes:
        mesh: the surface in the tube frame.
        geometry: length along the centreline, rings; as radius the mean distance of the surface
            from the centreline over the rings' arc, which is not that of the ring line.
        rotation: rows are the axes of the tube frame in the file.
        origin: of the tube frame in the file, in the file's unit.
        scale: mm per unit of the file. File position = origin + rotation^T position / scale.
        ring_errors: standard error of each ring's position, mm, from how far the sectors of the
            front agree; infinite where too few show the ring, NaN where positions were given.
        ring_shares: share of the front that shows each ring; NaN where positions were given.
        notes: what was found, chosen or dropped, in words.
    """

    mesh: Mesh
    geometry: Geometry
    rotation: Float[Array, "3 3"]
    origin: Float[Array, "3"]
    ring_errors: Float[Array, " rings"]
    ring_shares: Float[Array, " rings"]
    scale: float = eqx.field(static=True)
    notes: tuple[str, ...] = eqx.field(static=True)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Landmarks:
    """What is known of the anatomy; None: found in the shape.

    Attributes:
        larynx: direction from carina to larynx, in file axes. None: the carina is the wider end.
        anterior: direction of the anterior side, in file axes. None: opposite the gap of the rings
            or the flat side of the wall.
        centreline: points from one end to the other, file unit; shape (points, 3).
        ring_positions: s of the rings, mm from the carina's end.
        half_angle: of the rings, rad.
    """

    larynx: Sequence[float] | np.ndarray | None = None
    anterior: Sequence[float] | np.ndarray | None = None
    centreline: np.ndarray | None = None
    ring_positions: Sequence[float] | np.ndarray | None = None
    half_angle: float | None = None


def read_mesh(
    path: str | Path,
    landmarks: Landmarks = Landmarks(),
    *,
    unit: str | None = None,
    part: str | None = None,
    rings: str | Path | None = None,
    dtype=None,
    progress: Callable[[int, int], None] | None = None,
) -> Imported:
    """Read a trachea from a surface file.

    Args:
        landmarks: what need not be found in the shape.
        unit: of the file, "mm" say. None: metres for GLB and glTF, as that format says; else the
            one of mm, cm, m, in that gives a plausible length, refused if there are two.
        part: name of the object that is the wall, if the file has several. None: the one with more
            than half of the area.
        rings: the cartilage: name of another object in the file, or another file of the same unit
            and position. None: an object whose name tells of cartilage or rings; without one the
            rings are looked for in the relief of the wall.
        dtype: of every array; the default float type of JAX if None.
        progress: called with (steps done since the last call, steps in all).

    Raises:
        MeshError: the file, what was found, what is expected, the cure.
    """
    path = Path(path)
    try:
        return _read(path, landmarks, unit, part, rings, dtype, progress)
    except MeshError as error:
        raise MeshError.like(error, place=path.name) from error.__cause__


def _read(path: Path, known: Landmarks, unit, part, rings, dtype, progress) -> Imported:
    """As `read_mesh`; its errors do not name the file."""

    def step():
        return None if progress is None else progress(1, STEPS)

    known = _checked(known)
    file = _surfaces(path, unit, part, rings, step)
    wall, cartilage, scale, notes = file
    given = None if known.centreline is None else known.centreline * scale
    line = find_centreline(wall.vertices, wall.faces, given)
    check_turn(line)
    step()
    shape = _from_the_carina(line, file, known.larynx)
    if given is None:
        shape.check_middle()
    step()
    shape = find_anterior(shape, known.anterior)
    holes = holes_of(wall, shape.line)
    if holes:
        many = (
            "1 hole in the wall,"
            if len(holes) == 1
            else f"{len(holes)} holes in the wall, the largest"
        )
        notes += (f"{many} {holes[0].words}",)
    if cartilage is not None:
        holes = holes_of(join_corners(cartilage)[0], shape.line)
    found = find_rings(shape, known.ring_positions, known.half_angle, holes)
    rotation, origin, arrays = _in_tube_frame(shape, wall)
    dtype = float_dtype(dtype)

    def cast(v):
        return jax.device_put(np.asarray(v, dtype))  # nothing is compiled

    vertices, *others = map(cast, arrays)
    mesh = Mesh(vertices, jax.device_put(np.asarray(wall.faces, np.int32)), *others)
    step()
    try:
        geometry = Geometry.create(
            shape.line.s[-1], found.positions, radius=found.radius, half_angle=found.half_angle,
            ring_height=found.height, dtype=dtype,
        )  # fmt: skip
    except InputError as error:
        name = "half_angle" if error.key == "half_angle" else "ring_positions"
        given = getattr(known, name) is not None
        source = "" if given else "; it was found from the arc with relief, which noise may widen"
        cure = f"give {{}}{source if name == 'half_angle' else ''}"
        raise MeshError.like(error, cure=cure, arguments=(name,)) from error
    return Imported(
        mesh=mesh, geometry=geometry, rotation=cast(rotation), origin=cast(origin / scale),
        ring_errors=cast(found.errors), ring_shares=cast(found.shares), scale=scale,
        notes=(*notes, *found.notes),
    )  # fmt: skip


def _checked(known: Landmarks) -> Landmarks:
    """The same with arrays of numbers; refuses what is none, and directions that are none."""
    arrays = {}
    for name in ("larynx", "anterior", "centreline", "ring_positions"):
        value = getattr(known, name)
        if value is None:
            continue
        try:
            array = arrays[name] = np.asarray(value, float)
        except (TypeError, ValueError):
            raise MeshError(f"{name}= is {value!r}; expected numbers") from None
        if name in ("larynx", "anterior") and not (
            array.shape == (3,) and np.isfinite(array).all() and array.any()
        ):
            raise MeshError(
                f"{name}= is {array.tolist()}, no direction; expected three finite numbers, not "
                "all 0"
            )
    return dataclasses.replace(known, **arrays)


class _File(NamedTuple):
    """What a file holds, mm: the wall, cleaned; the cartilage, if it has any of its own."""

    wall: Surface
    cartilage: Surface | None
    scale: float
    notes: tuple[str, ...]


def _surfaces(path: Path, unit, part, rings, step) -> _File:
    """Wall and cartilage among the objects of a file."""
    parts = parts_of(path)
    step()
    surfaces, surface_of = joined(parts)
    name = wall_of(surfaces, None if part is None else surface_of.get(part, part))
    pieces = [piece for piece in parts if surface_of[piece] == name and piece != name]
    notes = [f"wall: {', '.join([name, *pieces])}"] if len(parts) > 1 else []
    own = rings_named(parts, name, rings)
    of_rings = None if own is None else surface_of.get(own)
    check_left_out(surfaces, name, of_rings, part is not None, notes)
    surface, cleaned = clean(surfaces[name])
    step()
    scale = scale_of(surface, path, unit, notes)
    cartilage = cartilage_of(parts, own, path, scale, notes)
    return _File(Surface(surface.vertices * scale, surface.faces), cartilage, scale,
                 (*notes, *cleaned))  # fmt: skip


def _from_the_carina(line: Line, file: _File, larynx) -> Shape:
    """The shape along the line from the carina to the larynx."""

    def scan(line):
        return Shape.scan(line, file.wall.vertices, file.wall.faces, file.cartilage)

    if larynx is not None:
        return scan(turned(line) if _points_back(line, larynx) else line)
    shape = scan(line)
    return scan(turned(line)) if _carina_is_last(shape) else shape


def _in_tube_frame(shape: Shape, wall: Surface):
    """Axes and origin of the tube frame in the file, and the arrays of a `Mesh` but its faces."""
    line = shape.line
    where = locate(line, wall.vertices)
    rotation = _axes(line.points[-1] - line.points[0], line.frames[:, :, 1].mean(axis=0))
    origin = line.points[0]
    vertices = (wall.vertices - origin) @ rotation.T
    normals = vertex_normals(vertices, wall.faces)
    frames = rotation @ where.frames
    return rotation, origin, (vertices, normals, where.s, where.phi, where.distance, frames)


def _axes(along, anterior):
    """Rows: the unit vector `along`, the part of `anterior` across it, and their product."""
    x = along / np.linalg.norm(along)
    y = anterior - x * (x @ anterior)
    y = y / np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)])


def _points_back(line: Line, larynx) -> bool:
    along = line.points[-1] - line.points[0]
    cosine = along @ larynx / (np.linalg.norm(along) * np.linalg.norm(larynx))
    if abs(cosine) < 0.2:
        raise MeshError("larynx= points across the tube; expected a direction along it")
    return bool(cosine < 0)


def _carina_is_last(shape: Shape) -> bool:
    first, last = shape.end_radii()
    if max(first, last) < 1.1 * min(first, last):
        raise MeshError(
            f"both ends are alike (radius {first:.3g} and {last:.3g} mm): which one is the "
            "carina? Give larynx=, the direction from carina to larynx"
        )
    return last > first
