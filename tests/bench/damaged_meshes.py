"""Damaged meshes: is every ring right, or is the mesh refused? Prints a table in Markdown.

    python tests/bench/damaged_meshes.py [--first SEED] [--count MESHES] [--data FOLDER] [--all]

The generated tube with one wall and with two (STL) and, where FOLDER has them, the Visible Human
male as GLB and as STL with its cartilage in a file of its own. Damage: triangles that are missing,
corners of triangles that lie apart (as in an STL whose corners were rounded each for itself),
noise of the vertices, holes, large holes, and all of these. Truth: the rings of the tube, and of
the undamaged import. Force: presses of 1.5 mm at five places of the tube as read, against those of
the true one.

The limits of `trachea.ring_checks` were chosen on seeds 0 to 199 and 1000 to 1199; the report is of
seeds from 2000 on.
"""

import argparse
import collections
import sys
import tempfile
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import trimesh  # noqa: E402

from jaxtrachea.mechanics.press import press  # noqa: E402
from jaxtrachea.trachea.geometry import Geometry, table_1  # noqa: E402
from jaxtrachea.trachea.imported import Landmarks, read_mesh  # noqa: E402
from jaxtrachea.trachea.material import Material  # noqa: E402
from jaxtrachea.trachea.mesh import MeshError  # noqa: E402
from jaxtrachea.trachea.tube import make_tube  # noqa: E402

DATA = Path(__file__).parents[3] / "shared" / "data" / "meshes" / "hra_vh_male"
MATERIAL = Material(EI_L=1.862, k_M=0.1, k_1=0.3, k_3=0.02)
KINDS = "missing", "apart", "noise", "hole", "large hole", "all"
#: A ring is that of the truth if it is nearer to it than this, mm.
NEAR = 2.0


def cracked(vertices, faces, rng, size):
    """Each triangle with corners of its own, up to `size` from where they were."""
    corners = vertices[faces].reshape(-1, 3)
    corners = corners + rng.uniform(-size, size, corners.shape)
    return corners, np.arange(len(corners)).reshape(-1, 3)


def damaged(vertices, faces, kind, rng):
    """One surface, mm, damaged; and in words how."""
    said = []
    middle = vertices[faces].mean(axis=1)
    if kind in ("noise", "all"):
        sigma = rng.uniform(0, 0.1 if kind == "noise" else 0.03)
        vertices = vertices + rng.normal(0, sigma, vertices.shape)
        said.append(f"noise {sigma:.3f} mm")
    if kind in ("missing", "all"):
        count = int(rng.integers(1, 51))
        gone = rng.choice(len(faces), count, replace=False)
        faces, middle = np.delete(faces, gone, axis=0), np.delete(middle, gone, axis=0)
        said.append(f"{count} triangles missing")
    if "hole" in kind or (kind == "all" and rng.uniform() < 0.5):
        wide = rng.uniform(2, 16, 2) if kind != "large hole" else rng.uniform(12, 50, 2)
        along = np.linalg.svd(middle - middle.mean(axis=0), full_matrices=False)[2][0]
        away = middle - middle[rng.integers(len(middle))]
        s = away @ along
        across = np.linalg.norm(away - s[:, None] * along, axis=1)
        hit = (np.abs(s) < wide[0] / 2) & (across < wide[1] / 2)
        axis = vertices.mean(axis=0)
        radial = middle - axis - ((middle - axis) @ along)[:, None] * along
        radial /= np.linalg.norm(radial, axis=1, keepdims=True)
        hit &= radial @ radial[np.argmin(s**2 + across**2)] > -0.5  # at most 240 degrees
        faces = faces[~hit]
        said.append(f"hole of {wide[0]:.0f} x {wide[1]:.0f} mm")
    if kind in ("apart", "all"):
        size = 10 ** rng.uniform(-9, -3)
        vertices, faces = cracked(vertices, faces, rng, size)
        said.append(f"corners {size:.0e} mm apart")
    return vertices, faces, ", ".join(said)


class Subject:
    """A mesh to damage: its parts by name, mm; how it is written and read; its rings."""

    def __init__(self, name, parts, given, geometry=None):
        """Read it undamaged, unless its geometry is known."""
        self.name, self.parts, self.given = name, parts, given
        self.geometry = geometry

    def write(self, folder, parts):
        """Write the parts as one file, or as one each; the path of the wall, and the rings."""
        meshes = {n: trimesh.Trimesh(*part, process=False) for n, part in parts.items()}
        if self.name == "GLB":
            scene = trimesh.Scene()
            for n, mesh in meshes.items():
                mesh.vertices = mesh.vertices / 1000
                scene.add_geometry(mesh, node_name=n, geom_name=n)
            scene.export(folder / "mesh.glb")
            return folder / "mesh.glb", None
        for n, mesh in meshes.items():
            mesh.export(folder / f"{n}.stl")
        return folder / "wall.stl", "cartilage.stl" if "cartilage" in meshes else None

    def read(self, parts):
        """What is read of these parts."""
        with tempfile.TemporaryDirectory() as folder:
            path, rings = self.write(Path(folder), parts)
            return read_mesh(path, self.given, rings=rings)


def subjects(data):
    """The generated tube, and the imports where their files are."""
    tube = make_tube(table_1())
    surface = np.asarray(tube.vertices), np.asarray(tube.faces)
    yield Subject("tube", {"wall": surface}, Landmarks(larynx=[1, 0, 0]), table_1())
    inner = surface[0] * [1, 0.8, 0.8], surface[1][:, ::-1]
    both = (
        np.concatenate([surface[0], inner[0]]),
        np.concatenate([surface[1], inner[1] + len(surface[0])]),
    )
    yield Subject("double wall", {"wall": both}, Landmarks(larynx=[1, 0, 0]), table_1())
    if not data.is_dir():
        return
    scene = trimesh.load_scene(data / "3d-vh-m-trachea.glb", process=False)
    parts = {}
    for node in scene.graph.nodes_geometry:
        frame, name = scene.graph[node]
        part = scene.geometry[name]
        vertices = part.vertices @ frame[:3, :3].T + frame[:3, 3]
        part = trimesh.Trimesh(vertices * 1000, part.faces)  # joins the corners of its seams
        parts[name] = np.asarray(part.vertices), np.asarray(part.faces)
    yield Subject("GLB", parts, Landmarks(larynx=[0, 1, 0]))
    parts = {}
    for name, file in (("wall", "wall_mm.stl"), ("cartilage", "cartilage_rings_mm.stl")):
        part = trimesh.load_mesh(data / file, process=True)
        parts[name] = np.asarray(part.vertices), np.asarray(part.faces)
    yield Subject("STL", parts, Landmarks(larynx=[0, 0, 1]))


@jax.jit
@jax.vmap
def force(geometry, s):
    """Of a press of 1.5 mm, N."""
    return press(geometry, MATERIAL, s, 1.5).force


def compare(found: Geometry, true: Geometry):
    """Rings that are lost, invented, largest error of a position, mm, and of a force, share."""
    a, b = (np.asarray(g.ring_positions, float) for g in (found, true))
    lost = sum(np.abs(a - p).min() > NEAR for p in b)
    extra = len(a) - len(b) + lost
    if lost or extra:
        return lost, extra, np.nan, np.nan
    s = jnp.linspace(0.25, 0.65, 5) * true.length
    lanes = [jax.tree.map(lambda v: jnp.broadcast_to(v, (5, *v.shape)), g) for g in (found, true)]
    pressed, right = (np.asarray(force(lane, s)) for lane in lanes)
    return 0, 0, np.abs(a - b).max(), np.abs(pressed / right - 1).max()


def main(first, count, data, every):
    """Damage, read, compare, print."""
    rows = collections.defaultdict(list)
    everything = list(subjects(data))
    for subject in everything:
        subject.geometry = subject.geometry or subject.read(subject.parts).geometry
    for i in range(count):
        seed = first + i
        rng = np.random.default_rng(seed)
        subject, kind = everything[i % len(everything)], KINDS[i // len(everything) % len(KINDS)]
        parts, words = dict(subject.parts), []
        for name in parts:
            if name == "VH_M_carina":
                continue
            *parts[name], said = damaged(*parts[name], kind, rng)
            words.append(said)
        said = "; ".join(words)
        try:
            read = subject.read(parts)
        except MeshError as error:
            rows[subject.name, kind].append(("refused",))
            print(f"{seed} {subject.name} {said}: refused: {error}", file=sys.stderr)
            continue
        lost, extra, position, newton = compare(read.geometry, subject.geometry)
        wrong = bool(lost or extra)
        rows[subject.name, kind].append(("WRONG" if wrong else "right", position, newton))
        if every or wrong:
            print(
                f"{seed} {subject.name} {said}: lost {lost}, invented {extra}, position "
                f"{position:.3f} mm, force {100 * newton:.2f} %: {read.notes}",
                file=sys.stderr,
            )
    print("| mesh | damage | right | refused | wrong | position [mm] | force [%] |")
    print("|---|---|---|---|---|---|---|")
    for (name, kind), of in rows.items():
        words = [row[0] for row in of]
        numbers = np.array([row[1:] for row in of if row[0] == "right"]).reshape(-1, 2)
        most = [f"{v:.3f}" for v in numbers.max(axis=0, initial=0.0) * [1, 100]]
        counts = " | ".join(str(words.count(w)) for w in ("right", "refused", "WRONG"))
        print(f"| {name} | {kind} | {counts} | {most[0]} | {most[1]} |")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first", type=int, default=2000)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--all", action="store_true", help="say every mesh, not only the wrong")
    given = parser.parse_args()
    main(given.first, given.count, given.data, given.all)
