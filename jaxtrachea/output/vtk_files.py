"""A simulation for ParaView: a surface in VTK's XML format for each row, and their times.

Format: VTK file formats, https://docs.vtk.org/en/latest/vtk_file_formats/vtkxml_file_format.html.
"""

import base64
from collections.abc import Mapping
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from jaxtrachea.files.atomic import write_text
from jaxtrachea.output.recording import Recording
from jaxtrachea.scene.sweep import Sweep
from jaxtrachea.trachea.mesh import Mesh

#: VTK's name of a dtype, and the dtype that is written.
_KINDS = {"f": ("Float32", "<f4"), "i": ("Int32", "<i4"), "u": ("UInt8", "u1")}


def write_vtk(folder: Path, recording: Recording) -> None:
    """Write `simulation.pvd`, and below `vtk/` wall, tools and contact points for each row.

    Lengths are in mm, times in s, or numbers of rows where the path has no time. A row without a
    solution has its tools alone. The wall has `displacement` (mm) and `ring` (1 on a ring), the
    contact point `force` (N), `s` (mm) and `phi` (rad).

    Raises:
        OSError: a file cannot be written.
    """
    (folder / "vtk").mkdir()
    sets = []
    names = [("tool", "contact")]
    if len(recording.tools) > 1:  # names may hold what files cannot
        names = [(f"tool_{i + 1}", f"contact_{i + 1}") for i in range(len(recording.tools))]

    def add(row: int, part: int, name: str, text: str) -> None:
        path = f"vtk/{name}_{row + 1:04d}.vtp"
        write_text(folder / path, text)
        time = f"{recording.times[row]:.9g}"
        sets.append(f'<DataSet timestep="{time}" part="{part}" name="{name}" file="{path}"/>')

    for row in range(len(recording.times)):
        if (wall := recording.walls[row]) is not None:
            point = {"displacement": wall - recording.rest, "ring": recording.ring.astype(np.uint8)}
            add(row, 0, "wall", _surface(wall, recording.faces, point))
        for part, tool in enumerate(recording.tools):
            if tool.triangles is not None:
                corners, faces = tool.triangles
                placed = corners @ tool.rotation[row].T + tool.translation[row]
                add(row, 1 + 2 * part, names[part][0], _surface(placed, faces, {}))
            if wall is not None:
                at = {name: v[row : row + 1] for name, v in tool.at_contact.items()}
                point = wall[tool.nearest[row]][None]
                add(row, 2 + 2 * part, names[part][1], _surface(point, None, at))
    body = "\n".join(sets)
    write_text(
        folder / "simulation.pvd", _file("Collection", f"<Collection>\n{body}\n</Collection>")
    )


def write_map(path: Path, mesh: Mesh, s: np.ndarray, phi: np.ndarray, out: Sweep) -> None:
    """Write the wall at rest with a sweep's force (N), compliance (mm/N) and the others.

    Linear between the points of the grid; NaN beyond it, and beside a point without a solution.
    `status` is the `PressStatus` of the nearest point, -1 beyond the grid.

    Args:
        path: of a .vtp file.
        s: of the grid, mm; 2 or more.
        phi: of the grid, rad; 2 or more.
        out: of its points, s by s.

    Raises:
        OSError: the file cannot be written.
    """
    from scipy.interpolate import RegularGridInterpolator

    places = np.stack([np.asarray(mesh.s, float), np.asarray(mesh.phi, float)], axis=1)

    def on_wall(name, v):
        grid = np.asarray(v, float).reshape(len(s), len(phi))
        if name != "status":
            return RegularGridInterpolator((s, phi), grid, bounds_error=False)(places)
        near = RegularGridInterpolator((s, phi), grid, "nearest", False, -1)
        return near(places).astype(np.int32)

    values = {name: on_wall(name, v) for name, v in out._asdict().items()}
    write_text(path, _surface(np.asarray(mesh.vertices, float), np.asarray(mesh.faces), values))


def _surface(points, faces, at_points: Mapping[str, np.ndarray]) -> str:
    """A file of triangles, or of single points, with values at the points."""
    cells, size = ("Verts", 1) if faces is None else ("Polys", 3)
    corners = np.arange(len(points)) if faces is None else np.asarray(faces)
    count = corners.size // size
    ends = size * np.arange(1, count + 1)
    values = "".join(_array(name, v) for name, v in at_points.items())
    parts = [
        f"<PointData>{values}</PointData>",
        f"<Points>{_array('points', points)}</Points>",
        f"<{cells}>{_array('connectivity', corners.ravel())}{_array('offsets', ends)}</{cells}>",
    ]
    counts = f'NumberOfPoints="{len(points)}" NumberOf{cells}="{count}"'
    return _file("PolyData", f"<PolyData><Piece {counts}>{''.join(parts)}</Piece></PolyData>")


def _array(name: str, values) -> str:
    """Values in base64 behind their number of bytes."""
    values = np.asarray(values)
    kind, dtype = _KINDS[values.dtype.kind]
    data = values.astype(dtype).tobytes()
    text = base64.b64encode(np.uint64(len(data)).astype("<u8").tobytes() + data).decode()
    components = values.shape[1] if values.ndim == 2 else 1
    head = f'type="{kind}" Name={quoteattr(name)} NumberOfComponents="{components}"'
    return f'<DataArray {head} format="binary">{text}</DataArray>'


def _file(kind: str, body: str) -> str:
    head = f'type="{kind}" version="1.0" byte_order="LittleEndian" header_type="UInt64"'
    return f'<?xml version="1.0"?>\n<VTKFile {head}>\n{body}\n</VTKFile>\n'
