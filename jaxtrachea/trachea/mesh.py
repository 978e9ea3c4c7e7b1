"""The surface at rest: triangles, and where each vertex stands on the skeleton.

Tube frame: x from the carina (A) towards the larynx (B), y anterior, z lateral. A straight tube has
its centreline on the x-axis; a curved one keeps its shape and carries, for each vertex, the frame
(tangent, anterior, lateral) of the centreline there, so that motions computed on the straight
skeleton can be laid onto it.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxtrachea._errors import InputError


class MeshError(InputError):
    """A mesh that cannot be used: which file, what was found, what is expected, the cure."""


class Mesh(eqx.Module):
    """A triangle mesh bound to the skeleton of a tube.

    Attributes:
        vertices: rest positions in the tube frame, mm; shape (vertices, 3).
        faces: three vertices of each triangle, counter-clockwise seen from outside.
        normals: outward unit normals of the vertices (on an inner wall towards the lumen).
        s: position along the centreline, mm; shape (vertices,).
        phi: angle round the centreline from the anterior midline, rad, in (-pi, pi].
        distance: from the centreline, mm.
        frames: columns tangent, anterior, lateral of the centreline at each vertex, in the tube
            frame; None: straight tube (identity).
    """

    vertices: Float[Array, "vertices 3"]
    faces: Int[Array, "faces 3"]
    normals: Float[Array, "vertices 3"]
    s: Float[Array, " vertices"]
    phi: Float[Array, " vertices"]
    distance: Float[Array, " vertices"]
    frames: Float[Array, "vertices 3 3"] | None = None

    @property
    def straight(self) -> Float[Array, "vertices 3"]:
        """Vertices of the tube bent straight, (s, distance cos phi, distance sin phi), mm."""
        across = self.distance * jnp.cos(self.phi), self.distance * jnp.sin(self.phi)
        return jnp.stack([self.s, *across], axis=1)


def place(mesh: Mesh, displacement: Float[Array, "vertices 3"]) -> Float[Array, "vertices 3"]:
    """Deformed vertices in the tube frame, mm.

    Args:
        mesh: the mesh at rest.
        displacement: of each vertex along (tangent, anterior, lateral), mm, as from `surface`.
    """
    if mesh.frames is None:
        return mesh.vertices + displacement
    return mesh.vertices + jnp.sum(mesh.frames * displacement[:, None, :], axis=2)


def face_vectors(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Normals of the triangles, each as long as twice its area."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return np.cross(b - a, c - a)


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals of the vertices, weighted by area; zero where all triangles are degenerate."""
    vectors = face_vectors(vertices, faces)
    total = np.stack(
        [np.bincount(faces.ravel(), np.repeat(v, 3), len(vertices)) for v in vectors.T], axis=1
    )
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return total / np.where(length > 0, length, 1)


def volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Volume inside a closed mesh, mm^3; negative if its triangles face inwards."""
    middle = vertices.mean(axis=0)
    corners = (vertices[faces] - middle).transpose(1, 0, 2)
    return float(np.sum(corners[0] * np.cross(corners[1], corners[2])) / 6)


def edge_counts(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every edge once, as a sorted pair, and the number of triangles on it."""
    pairs = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    first, same = unique_rows(pairs)
    return pairs[first], np.bincount(same)


def unique_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First of each of the different rows, in rising order, and which of these each row is.

    As `np.unique` along an axis, ten times as fast.
    """
    order = np.lexsort(rows.T[::-1])
    new = np.ones(len(rows), bool)
    new[1:] = (rows[order[1:]] != rows[order[:-1]]).any(axis=1)
    same = np.empty(len(rows), int)
    same[order] = np.cumsum(new) - 1
    return order[new], same
