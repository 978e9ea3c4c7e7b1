"""Pictures of simulations and sweeps (matplotlib without a global backend)."""

import textwrap
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from jaxtrachea.files.pictures import plain
from jaxtrachea.scene.simulation import Simulation
from jaxtrachea.scene.stage import Scene
from jaxtrachea.scene.sweep import Sweep

#: Unit vector towards the light, over the viewer's shoulder.
LIGHT = np.array([0.25, -0.55, 0.8]) / np.sqrt(0.25**2 + 0.55**2 + 0.8**2)


def draw_surface(scene: Scene, vertices: np.ndarray, title: str = "", span: float = 45.0) -> Figure:
    """The deformed surface round the largest motion, coloured by it, in the manner of Fig. 6.

    Args:
        scene: with a mesh.
        vertices: deformed, mm.
        title: of the picture.
        span: length of tube shown to each side, mm.
    """
    assert scene.mesh is not None
    rest, faces = np.asarray(scene.mesh.vertices, float), np.asarray(scene.mesh.faces)
    moved = np.linalg.norm(vertices - rest, axis=1)
    middle = rest[np.argmax(moved)]
    keep = (np.abs(rest[faces][:, :, 0] - middle[0]) < span).all(axis=1)
    # x to the right, z towards the viewer, y up: turned, not mirrored.
    corners = vertices[faces[keep]][:, :, [0, 2, 1]] * [1, -1, 1]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    light = 0.3 + 0.7 * np.clip(normals @ LIGHT, 0, 1)
    figure = Figure(figsize=(6, 3), dpi=110)
    axis: Any = figure.add_subplot(projection="3d")
    size = moved[faces[keep]].mean(axis=1)
    top = max(float(moved.max()), 1e-9)
    colour = colormaps["viridis"](size / top)
    colour[:, :3] *= light[:, None]
    wall = Poly3DCollection(corners, facecolors=colour, edgecolors=colour, linewidths=0.2)
    wall.set_clip_on(False)  # the axes are a square in the middle of the picture
    axis.add_collection3d(wall)
    low, high = corners.reshape(-1, 3).min(axis=0), corners.reshape(-1, 3).max(axis=0)
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axis.set_box_aspect(high - low, zoom=1.8)
    axis.view_init(elev=24, azim=-72)
    axis.set_axis_off()
    axis.set_position((0, 0, 0.86, 0.95))
    scale = ScalarMappable(Normalize(0, top), "viridis")
    figure.colorbar(scale, cax=figure.add_axes((0.88, 0.2, 0.02, 0.6)), label="displacement [mm]")
    lines = [plain(line, 56) for line in textwrap.wrap(title, 55)[:3]]
    figure.text(0.43, 0.93, "\n".join(lines), ha="center", fontsize=10)
    return figure


def draw_series(out: Simulation) -> Figure:
    """Force and motions along the path."""
    figure = Figure(figsize=(7, 2.6), dpi=110)
    left, right = figure.subplots(1, 2)
    rows = np.arange(1, len(out.s) + 1)
    for i, name in enumerate("xyz"):
        left.plot(rows, np.asarray(out.force)[:, i], ".-", lw=0.8, label=name)
        right.plot(rows, np.asarray(out.skeleton)[:, i], ".-", lw=0.8, label=name)
    left.set(xlabel="row", ylabel="force on the tube [N]")
    right.set(xlabel="row", ylabel="skeleton at the contact [mm]")
    left.legend(frameon=False, fontsize=7)
    figure.tight_layout()
    return figure


def draw_map(s, phi, values: np.ndarray, label: str) -> Figure:
    """Values over the unrolled surface.

    Args:
        s: mm.
        phi: rad.
        values: shape (s, phi).
        label: with its unit.
    """
    figure = Figure(figsize=(7, 2.8), dpi=110)
    axis = figure.subplots()
    image = axis.pcolormesh(s, np.degrees(phi), values.T, shading="nearest")
    axis.set(xlabel="s [mm], carina to larynx", ylabel="phi [deg]")
    figure.colorbar(image, ax=axis, label=label)
    figure.tight_layout()
    return figure


def draw_sweep(s, phi, out: Sweep) -> dict[str, Callable[[], Figure]]:
    """What draws maps of force and compliance, by file name."""

    def grid(v):
        return np.asarray(v).reshape(len(s), len(phi))

    return {
        "force.png": partial(draw_map, s, phi, grid(out.force), "force [N]"),
        "compliance.png": partial(draw_map, s, phi, grid(out.compliance), "compliance [mm/N]"),
    }
