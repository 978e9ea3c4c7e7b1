"""What a surface file holds: its objects, which of them is the wall, its unit, the cartilage.

STL, OBJ, PLY, GLB and what else trimesh reads.
"""

from pathlib import Path
from typing import Any

import numpy as np

from jaxtrachea.trachea.cleaning import Surface
from jaxtrachea.trachea.mesh import MeshError
from jaxtrachea.trachea.objects import area_of, combined
from jaxtrachea.units import UnitError, unit_factor

#: Length of a trachea with its wall, infant to adult, mm: what a guess of the unit goes by.
PLAUSIBLE = 40.0, 250.0
#: Length of anything this can be used for, mm: a unit that says more or less is a mistake.
POSSIBLE = 1.0, 5000.0


def parts_of(path: Path) -> dict[str, Surface]:
    """Objects of a file by name, in the file's common frame, file unit.

    Raises:
        MeshError: no such file, one that cannot be read, or no triangles in it.
    """
    import trimesh  # only those who read meshes wait for it

    if not path.is_file():
        raise MeshError("there is no such file")
    # An OBJ by its objects, not by its materials (`split_object`: the name until trimesh 5).
    by_object: dict[str, Any] = {}
    if path.suffix.lower() == ".obj":
        by_object = {"group_material": False, "split_object": True, "split_objects": True}
    try:
        scene = trimesh.load_scene(path, process=False, **by_object)
        nodes = [(node, *scene.graph[node]) for node in scene.graph.nodes_geometry]
        objects = [
            (_object_of(scene, node, name), scene.geometry[name], frame)
            for node, frame, name in nodes
        ]
    except Exception as error:  # trimesh raises whatever its many readers raise
        said = "" if isinstance(error, ImportError) else str(error).split("\n")[0][:200]
        raise MeshError(
            "could not be read as a surface, damaged or of another format"
            f"{f' ({said})' if said else ''}; expected STL, OBJ, PLY or GLB with triangles"
        ) from error
    pieces: dict[str, list[Surface]] = {}
    for name, part, frame in objects:
        if isinstance(part, trimesh.Trimesh) and len(part.faces):
            vertices = np.asarray(part.vertices, float) @ frame[:3, :3].T + frame[:3, 3]
            surface = Surface(vertices, np.asarray(part.faces, np.int64))
            pieces.setdefault(name, []).append(surface)
    parts = {name: combined(of) for name, of in pieces.items()}
    if not parts:
        raise MeshError("there are no triangles in it; expected a surface, not points or lines")
    if any(not np.all(np.isfinite(part.vertices)) for part in parts.values()):
        raise MeshError("a vertex is not finite; export the surface again")
    if any(
        part.faces.min() < 0 or part.faces.max() >= len(part.vertices) for part in parts.values()
    ):
        raise MeshError("a triangle names a vertex that is not there; export the surface again")
    return parts


def _object_of(scene, node, name) -> str:
    """The object that a node draws: a mesh of several materials has a node below for each."""
    piece = scene.geometry[name].metadata.get("from_gltf_primitive")
    return str(scene.graph.transforms.parents.get(node, node) if piece else node)


def wall_of(parts: dict[str, Surface], part: str | None) -> str:
    """Name of the object that is the wall: `part`, or the one with more than half of the area.

    Raises:
        MeshError: there is none of this name, or no such one.
    """
    names = ", ".join(sorted(parts))
    if part is not None:
        if part not in parts:
            raise MeshError(f"there is no object {part!r} in it; expected one of {names}")
        return part
    areas = {name: area_of(surface) for name, surface in parts.items()}
    largest = max(areas, key=lambda name: areas[name])
    if not areas[largest] > 0:
        raise MeshError("all vertices lie in one point or line; expected the surface of a trachea")
    if areas[largest] <= 0.5 * sum(areas.values()):
        raise MeshError(f"which of the objects {names} is the wall?", cure="give part=")
    return largest


def scale_of(surface: Surface, path: Path, unit: str | None, notes: list[str]) -> float:
    """Millimetres per unit of the file; a unit that was guessed is noted.

    Raises:
        MeshError: no unit, or several, make a trachea of it, or the one that is given does not.
    """
    size = float(np.linalg.norm(np.ptp(surface.vertices, axis=0)))
    if unit is not None:
        try:
            scale = float(unit_factor(unit, "length"))
        except UnitError as error:
            raise MeshError.like(error, key="") from error
        if not POSSIBLE[0] <= size * scale <= POSSIBLE[1]:
            raise MeshError(f"unit={unit!r} makes it {size * scale:.4g} mm long; correct unit=")
        return scale
    if path.suffix.lower() in (".glb", ".gltf"):
        if not POSSIBLE[0] <= size * 1000 <= POSSIBLE[1]:
            raise MeshError(
                f"it is {size * 1000:.4g} mm long in metres, the unit of {path.suffix} by "
                "definition; give unit= if it was written in another"
            )
        notes.append("unit taken as m")
        return 1000.0
    names = "mm", "cm", "in", "m"
    low, high = PLAUSIBLE
    fits = [name for name in names if low <= size * float(unit_factor(name, "length")) <= high]
    if len(fits) != 1:
        found = f"may be in {' or '.join(fits)}" if fits else f"is no trachea in {', '.join(names)}"
        raise MeshError(
            f"its size of {size:.4g} {found} (expected {low:g} to {high:g} mm); give unit="
        )
    notes.append(f"unit taken as {fits[0]}")
    return float(unit_factor(fits[0], "length"))


def rings_named(parts: dict[str, Surface], wall: str, rings) -> str | None:
    """The rings' own surface as it is named: an object or a file; None: there is none.

    Raises:
        MeshError: several objects may be the rings.
    """
    if rings is not None:
        return str(rings)
    named = [n for n in parts if n != wall and ("cartilage" in n.lower() or "ring" in n.lower())]
    if len(named) > 1:
        found = f"which of the objects {', '.join(named)} are the rings?"
        raise MeshError(found, cure="give {}", arguments=("rings=",))
    return named[0] if named else None


def cartilage_of(parts, rings: str | None, path, scale, notes) -> Surface | None:
    """The rings' own surface, mm, or None.

    Raises:
        MeshError: the file of the rings cannot be read.
    """
    if rings is None:
        return None
    if rings in parts:
        found = [parts[rings]]
    else:
        other = path.parent / rings
        try:
            found = list(parts_of(other).values())
        except MeshError as error:
            found = f"{rings!r}: {error}"
            raise MeshError(found, key="rings", joint="=") from error
    notes.append(f"rings: {rings}")
    whole = combined(found)
    return Surface(whole.vertices * scale, whole.faces)
