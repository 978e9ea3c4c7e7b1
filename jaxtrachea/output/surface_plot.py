"""The picture of one row of a simulation: the tube under its tool, and two sections of it.

The three-dimensional view is an orthographic projection onto a plain axis, so that one scale holds
everywhere. Triangles are painted from the farthest to the nearest.
"""

import dataclasses
import textwrap
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PathCollection, PolyCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.path import Path

from jaxtrachea.files.pictures import plain
from jaxtrachea.output.solids import Triangles, crossings, tool_distance, tool_triangles
from jaxtrachea.scene.instruments import scene_of
from jaxtrachea.scene.simulation import Simulation, of_tool
from jaxtrachea.scene.stage import Poses, Presses, Scene
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.mesh import Mesh

#: Displacement: even in lightness, and read alike with and without colour blindness.
COLOURS = "cividis"
FORCE, TOOL, REST, RING = "#b4001e", "#d9782d", "0.45", "#5b8fd6"
#: Angle of the camera from the contact's normal, rad, and its turn towards the larynx.
ASIDE, TILT = np.radians(52), 0.4
#: The print of the tool is where the wall is so near to it, mm.
PRINT = 0.5
#: Length of the force's arrow, mm: it shows the direction alone.
ARROW = 13.0


@dataclasses.dataclass(frozen=True)
class Contact:
    """Where a row presses, in the frame of the mesh.

    Attributes:
        s: mm.
        phi: rad.
        axes: columns tangent, outward normal and their cross product at the contact.
        frame: columns tangent, anterior, lateral.
        centre: of the tube there, mm.
        tip: the point of the deformed surface, mm.
        force: on the tube, N.
    """

    s: float
    phi: float
    axes: np.ndarray
    frame: np.ndarray
    centre: np.ndarray
    tip: np.ndarray
    force: np.ndarray

    @property
    def pushed(self) -> bool:
        """Whether the force pushes the wall in."""
        return bool(self.force @ self.axes[:, 1] < 0)


def draw_surface(
    scene: Scene, path: Poses | Presses | Mapping[str, Poses | Presses], out: Simulation, row: int,
    title: str = "", span: float = 32.0,
) -> Figure:  # fmt: skip
    """The deformed tube under the tool from the contact's side, across and along.

    Of several tools all are shown; the section across is at the one that presses most.

    Args:
        scene: with a mesh.
        path: of the simulation.
        out: with vertices.
        row: of the path, solved.
        title: of the picture.
        span: length of tube shown to each side of the contact, mm.
    """
    mesh = scene.mesh
    assert mesh is not None
    assert out.vertices is not None
    rest, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces)
    vertices = np.asarray(out.vertices[row], float)
    along = np.asarray(mesh.s, float)
    shown = _of_each(scene, path, out)
    contacts = [_contact(mesh, vertices, own, row) for *_, own in shown]
    contacts.sort(key=lambda c: -float(np.linalg.norm(c.force)))  # the strongest leads the camera
    contact = contacts[0]
    low, high = min(c.s for c in contacts) - span, max(c.s for c in contacts) + span
    near = faces[((along[faces] > low) & (along[faces] < high)).all(axis=1)]
    tool = _joined([_tool(view, own, row) for view, own, _ in shown])
    moved = np.linalg.norm(vertices - rest, axis=1)
    top = max(float(np.nanmax(moved)), 0.01)
    rings = inside_rings(scene, mesh)

    figure = Figure(figsize=(9.6, 5.4), dpi=110)
    view = figure.add_axes((0.01, 0.2, 0.62, 0.7))
    across = figure.add_axes((0.70, 0.56, 0.28, 0.32))
    length = figure.add_axes((0.70, 0.12, 0.28, 0.28))
    wall = Triangles(vertices, near)
    prints = [_print(own, way, row, wall) for own, way, _ in shown]
    prints = [own for own in prints if own is not None]
    outline = np.concatenate(prints) if prints else None
    _draw_view(view, wall, rest, tool, contacts, moved / top, rings, outline)
    joints = out.joints is not None
    joints = joints and _draw_joints(view, scene, mesh, vertices, contact, (low, high))
    _draw_across(across, Triangles(vertices, near), rest, tool, contact)
    _draw_length(length, Triangles(vertices, near), rest, tool, contacts, along, rings)
    scale = figure.colorbar(
        ScalarMappable(Normalize(0, top), COLOURS), orientation="horizontal",
        cax=figure.add_axes((0.10, 0.155, 0.40, 0.02)),
    )  # fmt: skip
    scale.set_label("displacement of the wall [mm]", fontsize=8, labelpad=2)
    scale.ax.tick_params(labelsize=8)
    _legend(figure, tool is not None, outline, joints, contact)
    lines = [plain(line, 90) for line in textwrap.wrap(title, 88)[:2]]
    figure.text(0.015, 0.985, "\n".join(lines), ha="left", va="top", fontsize=11)
    figure.text(
        0.015, 0.985 - 0.04 * max(len(lines), 1) - 0.005, _words(scene, out, row, top), va="top",
        fontsize=8.5, color="0.3",
    )  # fmt: skip
    return figure


def draw_rest(scene: Scene) -> Figure:
    """The tube at rest with its rings, from the front and the side; its colour has no meaning."""
    mesh = scene.mesh
    assert mesh is not None
    wall = Triangles(np.asarray(mesh.vertices, float), np.asarray(mesh.faces))
    frame = np.eye(3)
    if mesh.frames is not None:
        frame = np.asarray(mesh.frames[np.argmin(np.abs(mesh.s - scene.geometry.length / 2))])
    camera = _camera(frame)
    figure = Figure(figsize=(9.0, 4.4), dpi=90)
    axis = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    pale = np.full(len(wall.vertices), 0.6)
    ends = _draw_solids(axis, camera, wall, None, pale, inside_rings(scene, mesh))
    _frame_view(axis, camera, frame, *ends)
    return figure


def _of_each(scene: Scene, path: Any, out: Simulation):
    """Scene, path and result of every tool."""
    if not scene.instruments:
        return [(scene, path, out)]
    return [
        (scene_of(scene, instrument), path[instrument.name], of_tool(out, j))
        for j, instrument in enumerate(scene.instruments)
    ]


def _joined(tools: list[Triangles | None]) -> Triangles | None:
    """All tools as one surface."""
    there = [tool for tool in tools if tool is not None]
    if not there:
        return None
    first = np.cumsum([0, *(len(tool.vertices) for tool in there[:-1])])
    faces = [tool.faces + i for tool, i in zip(there, first, strict=True)]
    return Triangles(np.concatenate([tool.vertices for tool in there]), np.concatenate(faces))


def _words(scene: Scene, out: Simulation, row: int, top: float) -> str:
    """Row, status, force and largest motion."""
    count = len(out.s)
    which = f"row {row + 1} of {count}" + ("" if row == count - 1 else ", the last solved one")
    if scene.instruments:
        forces = np.linalg.norm(np.asarray(out.force[row], float), axis=-1)
        each = zip(scene.names, forces, np.asarray(out.status[row]), strict=True)
        words = ", ".join(
            f"{name} {size:.3g} N" + ("" if status == PressStatus.OK else
                                      f" ({PressStatus(int(status)).name})")
            for name, size, status in each
        )  # fmt: skip
        return f"{which}: {words}; the wall has moved by up to {top:.3g} mm; true scale"
    status = PressStatus(int(out.status[row]))
    if status == PressStatus.NO_CONTACT:
        return f"{which}: the tool does not touch, so there is no force"
    size = float(np.linalg.norm(np.asarray(out.force[row], float)))
    name = "" if status == PressStatus.OK else f", {status.name}"
    return f"{which}{name}: {size:.3g} N; the wall has moved by up to {top:.3g} mm; true scale"


def _contact(mesh: Mesh, vertices: np.ndarray, out: Simulation, row: int) -> Contact:
    """The contact of a row; the surface is interpolated between the nearest vertices."""
    s, phi = float(out.s[row]), float(out.phi[row])
    which, weight = _nearest(mesh, s, phi)
    frame = np.eye(3)
    if mesh.frames is not None:
        frame = np.asarray(mesh.frames[which[0]], float)
    if out.frame is not None:
        frame = np.asarray(out.frame[row], float)
    normal = frame @ (0.0, np.cos(phi), np.sin(phi))
    on_rest = weight @ np.asarray(mesh.vertices, float)[which]
    return Contact(
        s=s, phi=phi, frame=frame,
        axes=np.stack([frame[:, 0], normal, np.cross(frame[:, 0], normal)], axis=1),
        centre=on_rest - float(weight @ np.asarray(mesh.distance, float)[which]) * normal,
        tip=weight @ vertices[which],
        force=frame @ np.asarray(out.force[row], float),
    )  # fmt: skip


def _nearest(mesh: Mesh, s: float, phi: float) -> tuple[np.ndarray, np.ndarray]:
    """The four outer vertices nearest to (s, phi) on the unrolled tube, and their weights."""
    turn = np.angle(np.exp(1j * (np.asarray(mesh.phi, float) - phi)))
    distance = np.asarray(mesh.distance, float)
    away = np.hypot(np.asarray(mesh.s, float) - s, distance * turn)
    near = np.argsort(away)[:16]
    which = near[distance[near] > 0.9 * distance[near].max()][:4]  # none of an inner wall
    weight = 1 / np.maximum(away[which], 1e-6) ** 2
    return which, weight / weight.sum()


def _tool(scene: Scene, path: Poses | Presses, row: int) -> Triangles | None:
    """The tool where it stands; None: a press at a point, or a tool without a volume."""
    if scene.tool is None or not isinstance(path, Poses):
        return None
    own = tool_triangles(scene.tool)
    turn, place = np.asarray(path.rotation[row], float), np.asarray(path.translation[row], float)
    return own._replace(vertices=own.vertices @ turn.T + place)


def _print(scene: Scene, path: Poses | Presses, row: int, wall: Triangles) -> np.ndarray | None:
    """Segments round the part of the wall that lies at the tool; shape (segments, 2, 3)."""
    if scene.tool is None or not isinstance(path, Poses):
        return None
    turn, place = np.asarray(path.rotation[row], float), np.asarray(path.translation[row], float)
    used, faces = np.unique(wall.faces, return_inverse=True)
    points = wall.vertices[used]
    away = tool_distance(scene.tool, (points - place) @ turn)
    segments = crossings(faces.reshape(-1, 3), away, PRINT).at(points)
    return segments if len(segments) else None


def inside_rings(scene: Scene, mesh: Mesh) -> np.ndarray:
    """How far inside the edge of a ring each vertex lies, mm; negative outside; (vertices,)."""
    places = np.asarray(scene.geometry.ring_positions, float)
    away = np.abs(np.asarray(mesh.s, float)[:, None] - places).min(axis=1)
    height, half = float(scene.geometry.ring_height), float(scene.geometry.half_angle)
    beyond = float(scene.geometry.radius) * (half - np.abs(np.asarray(mesh.phi, float)))
    return np.minimum(height / 2 - away, beyond)


def _camera(axes: np.ndarray) -> np.ndarray:
    """Rows right, up and towards the viewer: the larynx is right, the contact's normal is up."""
    along, normal, aside = axes.T
    towards = np.cos(ASIDE) * normal + np.sin(ASIDE) * aside + TILT * along
    towards /= np.linalg.norm(towards)
    up = normal - (normal @ towards) * towards
    up /= np.linalg.norm(up)
    return np.stack([np.cross(up, towards), up, towards])


def _turned(triangles: np.ndarray) -> np.ndarray:
    """Normals of projected triangles; towards the viewer where the last component is positive."""
    return np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])


def _shade(triangles: np.ndarray, camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lightness of projected triangles, 0.5 to 1, and whether they face the viewer."""
    normal = _turned(triangles)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    light = np.array([-0.3, 0.65, 0.7]) / np.linalg.norm([-0.3, 0.65, 0.7])
    return 0.5 + 0.5 * np.clip(np.abs(normal @ light), 0, 1), normal[:, 2] > 0


def _draw_view(axis: Any, wall, rest, tool, contacts, share, rings, outline) -> None:
    """The tube, its tools and their forces, projected."""
    contact = contacts[0]
    camera = _camera(contact.axes)
    low, high = _draw_solids(axis, camera, wall, tool, share, rings)
    _draw_rest(axis, rest @ camera.T, wall.faces, share)
    if outline is not None:
        print_ = outline @ camera.T
        axis.add_collection(_segments(print_[:, :, :2], "k", linewidths=1.1))
    tips = np.stack([camera @ own.tip for own in contacts])[:, 0]
    sides = [1 if tip >= tips.mean() else -1 for tip in tips] if len(tips) > 1 else [None]
    ends = np.concatenate(
        [_draw_force(axis, camera, *one) for one in zip(contacts, sides, strict=True)]
    )
    low, high = np.minimum(low, ends.min(axis=0)), np.maximum(high, ends.max(axis=0))
    _frame_view(axis, camera, contact.frame, low, high)


def _draw_solids(axis: Any, camera: np.ndarray, wall, tool, share, rings):
    """Wall with the edges of its rings, and tool, projected; corners of what is drawn."""
    seen = wall.vertices @ camera.T
    triangles = seen[wall.faces]
    light, front = _shade(triangles, camera)
    colour = colormaps[COLOURS](share[wall.faces].mean(axis=1))
    pale = 0.5 * np.clip(rings[wall.faces].mean(axis=1), 0, 1)[:, None]
    colour[:, :3] = (1 - pale) * colour[:, :3] + pale * np.array([0.86, 0.92, 1.0])
    colour[:, :3] *= np.where(front, light, 0.45 * light)[:, None]
    corners, faced = [triangles], [colour]
    if tool is not None:
        solid = (tool.vertices @ camera.T)[tool.faces]
        light, front = _shade(solid, camera)
        paint = np.array([0.851, 0.471, 0.176, 0.38]) * np.ones((len(solid), 1))
        paint[:, :3] *= light[:, None]
        corners.append(solid[front])
        faced.append(paint[front])
    solids: Any = np.concatenate(corners)
    order = np.argsort(solids[:, :, 2].mean(axis=1))
    solids, faced = solids[order, :, :2], np.concatenate(faced)[order]
    edges = np.where(faced[:, 3:] == 1, faced, 0)
    axis.add_collection(PolyCollection(solids, facecolors=faced, edgecolors=edges, linewidths=0.3))
    edge = crossings(wall.faces[_turned(triangles)[:, 2] > 0], rings).at(seen)
    axis.add_collection(_segments(edge[:, :, :2], RING, linewidths=0.7))
    points = triangles.reshape(-1, 3)[:, :2]
    if tool is not None:
        points = np.concatenate([points, (tool.vertices @ camera.T)[:, :2]])
    return points.min(axis=0), points.max(axis=0)


def _frame_view(axis: Any, camera: np.ndarray, frame: np.ndarray, low, high) -> None:
    """Limits with room for the scale bar and the directions."""
    low = low - (2, 15)
    axis.set(xlim=(low[0], high[0] + 2), ylim=(low[1], high[1] + 3), aspect="equal")
    axis.set_axis_off()
    _draw_scale(axis, camera, frame, low, high)


def _segments(ends: np.ndarray, colour: str, zorder: float = 2.0, **style: Any) -> PathCollection:
    """Segments of shape (segments, 2, 2) as one path: thousands of paths take a while."""
    path = Path(ends.reshape(-1, 2), np.tile([Path.MOVETO, Path.LINETO], len(ends)))
    return PathCollection([path], facecolors="none", edgecolors=colour, zorder=zorder, **style)


def _draw_rest(axis: Any, seen: np.ndarray, faces: np.ndarray, share: np.ndarray) -> None:
    """Edges of the surface at rest where it has moved most."""
    faces = faces[(share[faces] > 0.12).all(axis=1)]
    front = _turned(seen[faces])[:, 2] > 0
    edges = np.unique(np.sort(faces[front][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    axis.add_collection(_segments(seen[edges][:, :, :2], REST, linewidths=0.35, alpha=0.45))


def _draw_force(axis: Any, camera: np.ndarray, contact: Contact, side: int | None) -> np.ndarray:
    """The force as an arrow with its number, and the contact point; the ends of the arrow.

    The number is right (1) or left (-1) of the arrow; None: where that leans.
    """
    tip = (camera @ contact.tip)[:2]
    axis.plot(*tip, "o", color=FORCE, ms=4.5, mec="w", mew=0.8, zorder=6)
    size = float(np.linalg.norm(contact.force))
    if not size > 0:
        return tip[None]
    way = contact.force / size
    far = (camera @ (contact.tip + (-ARROW if contact.pushed else ARROW) * way))[:2]
    start, end = (far, tip) if contact.pushed else (tip, far)
    arrow = {"arrowstyle": "-|>,head_width=0.28,head_length=0.6", "color": FORCE, "lw": 2.2}
    arrow |= {"shrinkA": 0, "shrinkB": 0}
    axis.annotate("", end, start, arrowprops=arrow, zorder=7)
    if side is None:
        side = 1 if (far - tip)[0] >= 0 else -1
    axis.text(
        *(far + (1.2 * side, 0.6)), f"{size:.3g} N", color=FORCE, fontsize=11, zorder=8,
        ha="left" if side > 0 else "right", va="bottom",
    )  # fmt: skip
    return np.stack([tip, far + (0, 5)])


def _draw_scale(axis: Any, camera: np.ndarray, frame: np.ndarray, low, high) -> None:
    """A bar of 10 mm, and the directions of the tube by name."""
    x, y = low[0] + 2, low[1] + 3.5
    axis.plot([x, x + 10], [y, y], "k", lw=3, solid_capstyle="butt")
    axis.text(x + 5, y - 1, "10 mm", ha="center", va="top", fontsize=8)
    ways = 6 * (camera[:2] @ frame).T
    origin = np.array([high[0] - 14, low[1] + 3.5 - min(0.0, ways[:, 1].min())])
    arrow = {"arrowstyle": "->", "color": "0.25", "lw": 1.1, "shrinkA": 0, "shrinkB": 0}
    for name, way in zip(("to the larynx", "anterior", "lateral (z)"), ways, strict=True):
        axis.annotate("", origin + way, origin, zorder=6, arrowprops=arrow)
        end = origin + way * (1 + 1.5 / max(np.linalg.norm(way), 1.5))
        ha = "left" if way[0] > -0.1 else "right"  # of two steep ones each has its side
        va = "center" if abs(way[0]) > 1.5 else ("bottom" if way[1] > 0 else "top")
        axis.text(*end, name, fontsize=7.5, color="0.25", ha=ha, va=va)


def _draw_joints(axis: Any, scene: Scene, mesh: Mesh, vertices, contact, ends) -> bool:
    """Joints on the anterior midline, where it faces the viewer; whether it does."""
    camera = _camera(contact.axes)
    if camera[2] @ contact.frame[:, 1] < 0.05:
        return False
    for s in np.asarray(scene.geometry.ring_positions, float):
        if ends[0] < s < ends[1]:
            which, weight = _nearest(mesh, s, 0.0)
            place = camera @ (weight @ vertices[which])
            axis.plot(*place[:2], "D", color="w", mec="k", mew=0.7, ms=3.2, zorder=5)
    return True


def _section(surface: Triangles, point: np.ndarray, normal: np.ndarray, axes: np.ndarray):
    """Crossings with a plane, and both ends of each in it; shape (segments, 2, 2)."""
    off = surface.vertices - point
    found = crossings(surface.faces, off @ normal)
    return found, found.at(off @ axes)


def _draw_across(axis: Any, wall: Triangles, rest, tool, contact: Contact) -> None:
    """The cross-section at the contact, seen from the carina: z to the right."""
    axes = contact.frame[:, [2, 1]]
    normal = contact.frame[:, 0]
    point = contact.centre
    _lines(axis, wall, rest, tool, point, normal, axes)
    tip, force = (contact.tip - point) @ axes, contact.force @ axes
    _flat_force(axis, tip, force, contact)
    axis.set(
        aspect="equal", xlabel="lateral z [mm]", ylabel="anterior y [mm]",
    )  # fmt: skip
    axis.set_title(f"across, at s = {contact.s:.4g} mm, from the carina", fontsize=8.5)
    _frame(axis)


def _draw_length(axis: Any, wall: Triangles, rest, tool, contacts, along, rings) -> None:
    """The section along the tube through the contact."""
    contact = contacts[0]
    axes = contact.axes[:, :2]
    point = contact.centre - contact.s * axes[:, 0]
    found, ends = _lines(axis, wall, rest, tool, point, contact.axes[:, 2], axes)
    on = found.at(rings).mean(axis=1) > 0
    axis.add_collection(_segments(ends[on], RING, linewidths=3.2, zorder=2.5))
    for own in contacts:
        _flat_force(axis, (own.tip - point) @ axes, own.force @ axes, own)
    axis.set(aspect="equal", xlabel="s [mm], carina to larynx", ylabel="to the contact [mm]")
    axis.set_title(f"along, at phi = {round(np.degrees(contact.phi), 1) + 0.0:g} deg", fontsize=8.5)
    _frame(axis)


def _frame(axis: Any) -> None:
    axis.tick_params(labelsize=7)
    axis.xaxis.label.set_size(8)
    axis.yaxis.label.set_size(8)
    axis.spines[["top", "right"]].set_visible(False)
    axis.margins(0.06)
    axis.autoscale_view()


def _lines(axis: Any, wall: Triangles, rest, tool, point, normal, axes):
    """Wall, wall at rest and tool, cut by a plane; the wall's crossings and their ends."""
    _, still = _section(Triangles(rest, wall.faces), point, normal, axes)
    axis.add_collection(_segments(still, REST, linewidths=0.9, linestyles="--"))
    found, ends = _section(wall, point, normal, axes)
    axis.add_collection(_segments(ends, "k", linewidths=1.3))
    if tool is not None:
        _, cut = _section(tool, point, normal, axes)
        axis.add_collection(_segments(cut, TOOL, linewidths=1.4, zorder=3.0))
    return found, ends


def _flat_force(axis: Any, tip: np.ndarray, way: np.ndarray, contact: Contact) -> None:
    """The part of the force in the plane, as long as its share of the whole."""
    axis.plot(*tip, "o", color=FORCE, ms=3.5, mec="w", mew=0.6, zorder=6)
    size = float(np.linalg.norm(contact.force))
    if not np.linalg.norm(way) > 1e-3 * size:
        return
    way = 0.6 * ARROW * way / size
    start, end = (tip - way, tip) if contact.pushed else (tip, tip + way)
    axis.annotate("", end, start, zorder=5, arrowprops={
        "arrowstyle": "-|>", "color": FORCE, "lw": 1.5, "shrinkA": 0, "shrinkB": 0})  # fmt: skip
    axis.update_datalim([start, end])


def _legend(figure: Figure, tool: bool, outline, joints: bool, contact: Contact) -> None:
    """What each line and colour is."""
    marks: list[Any] = []
    pressed = np.linalg.norm(contact.force) > 0
    point = "contact point" if pressed else "nearest point"
    if pressed:
        marks.append(Line2D([], [], color=FORCE, lw=2, label="force on the tube (direction)"))
    marks.append(Line2D([], [], color=FORCE, marker="o", lw=0, ms=4, label=point))
    if tool:
        marks.append(Patch(color=TOOL, alpha=0.6, label="tool"))
    if outline is not None:
        marks.append(Line2D([], [], color="k", lw=1.1, label=f"wall within {PRINT} mm of the tool"))
    marks.append(Line2D([], [], color=REST, ls="--", lw=0.9, label="at rest (also the net)"))
    marks.append(Patch(color=RING, alpha=0.8, label="rings"))
    if joints:
        marks.append(Line2D([], [], color="w", marker="D", mec="k", lw=0, ms=3.5, label="joints"))
    figure.legend(
        handles=marks, loc="lower left", bbox_to_anchor=(0.005, 0.0), ncols=4, frameon=False,
        fontsize=7.5, columnspacing=1.2, handlelength=1.6,
    )  # fmt: skip
