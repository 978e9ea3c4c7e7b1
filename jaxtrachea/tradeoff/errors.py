"""How far two simulations of one path are apart."""

from typing import NamedTuple

import numpy as np

from jaxtrachea.scene.simulation import Simulation
from jaxtrachea.scene.stage import Scene
from jaxtrachea.trachea.mesh import Mesh


class Errors(NamedTuple):
    """Largest difference over the path, against the largest value of the reference. None: no such.

    A row that one of the two has not solved counts as infinitely wrong.

    Attributes:
        force: of the contact force's vector.
        joints: of the joints' displacements.
        surface: of the vertices' displacements.
        surface_mm: the same in mm.
        contact_mm: of the gap in rows that touch, mm.
        gradient: of d force / d log parameter.
    """

    force: float
    joints: float | None = None
    surface: float | None = None
    surface_mm: float | None = None
    contact_mm: float | None = None
    gradient: float | None = None

    @property
    def worst(self) -> float:
        """Largest of force, joints and surface."""
        return max(v for v in (self.force, self.joints, self.surface) if v is not None)


def compare(
    found: Simulation,
    reference: Simulation,
    scenes: tuple[Scene, Scene],
    gradients: tuple[np.ndarray, np.ndarray] | None = None,
) -> Errors:
    """Errors of a simulation against a reference of the same path.

    Rings that were left out are put on the straight line between their neighbours, displacements of
    another mesh are interpolated at the reference's vertices.
    """
    scene, fine = scenes
    joints = surface = millimetres = None
    if reference.joints is not None and found.joints is not None:
        x, at = (np.asarray(s.geometry.ring_positions, float) for s in scenes)
        moved = spread(np.asarray(found.joints, float), x, at, float(fine.geometry.length))
        joints = relative(moved, reference.joints)
    if reference.vertices is not None:
        expected = _moved(reference, fine)
        here = expected * 0 if found.vertices is None else _moved(found, scene)
        if here.shape != expected.shape:
            assert scene.mesh is not None
            assert fine.mesh is not None
            here = remesh(here, scene.mesh, fine.mesh)
        surface = relative(here, expected)
        millimetres = surface * largest(expected)
    gradient = None if gradients is None else relative(*(np.swapaxes(g, -1, -2) for g in gradients))
    return Errors(
        force=relative(found.force, reference.force), joints=joints, surface=surface,
        surface_mm=millimetres, contact_mm=_gaps(found, reference), gradient=gradient,
    )  # fmt: skip


def largest(v) -> float:
    """Length of the longest finite vector (last axis)."""
    length = np.linalg.norm(np.asarray(v, float), axis=-1)
    return float(length[np.isfinite(length)].max(initial=0))


def relative(found, expected) -> float:
    """Longest difference of vectors over the longest expected one; rows NaN in both are skipped."""
    found, expected = np.asarray(found, float), np.asarray(expected, float)
    both = np.isnan(found) & np.isnan(expected)
    off = np.linalg.norm(np.where(both, 0, found - expected), axis=-1)
    if not np.isfinite(off).all():
        return float("inf")
    error, scale = float(off.max(initial=0)), largest(expected)
    return error / scale if scale > 0 else (0.0 if error == 0 else float("inf"))


def spread(joints: np.ndarray, x: np.ndarray, at: np.ndarray, length: float) -> np.ndarray:
    """Displacements of rings at x (rows, rings, 3), at all rings; straight lines, ends held."""
    if len(x) == len(at):
        return joints
    ends = np.r_[0.0, x, length]
    padded = np.pad(joints, ((0, 0), (1, 1), (0, 0)))

    def line(v):
        return np.interp(at, ends, v)

    return np.apply_along_axis(line, 1, padded)


def remesh(moved: np.ndarray, mesh: Mesh, fine: Mesh) -> np.ndarray:
    """Displacements on a made tube's grid, bilinear at the vertices of another; (rows, n, 3)."""
    from scipy.interpolate import RegularGridInterpolator

    s, phi = (np.asarray(v, float) for v in (mesh.s, mesh.phi))
    lines = np.unique(s)
    around = len(s) // len(lines)
    turn = 2 * np.pi * np.arange(around + 1) / around
    assert np.allclose(np.cos(phi[:around]), np.cos(turn[:-1]))
    grid = moved.reshape(len(moved), len(lines), around, 3).transpose(1, 2, 0, 3)
    grid = np.concatenate([grid, grid[:, :1]], axis=1)
    there = np.stack([np.asarray(fine.s), np.asarray(fine.phi) % (2 * np.pi)], axis=1)
    return RegularGridInterpolator((lines, turn), grid)(there).transpose(1, 0, 2)


def _moved(out: Simulation, scene: Scene) -> np.ndarray:
    assert scene.mesh is not None
    assert out.vertices is not None
    return np.asarray(out.vertices, float) - np.asarray(scene.mesh.vertices, float)


def _gaps(found: Simulation, reference: Simulation) -> float | None:
    if found.gap is None or reference.gap is None:
        return None
    gap, expected = (np.asarray(v.gap, float) for v in (found, reference))
    return float(np.abs(gap - expected)[expected < 0].max(initial=0))
