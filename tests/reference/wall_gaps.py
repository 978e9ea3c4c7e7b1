"""Contact gaps against the closest points of meshes, by trimesh; and what is refused as a mesh.

    PYTHONPATH=. python tests/reference/wall_gaps.py [MALE.glb WALL.stl CARTILAGE.stl FEMALE.glb]

Without files only generated tubes. Needs rtree (for `trimesh.proximity`).
Balls stand beside the outer wall between the first and the last ring, drawn by area, up to a tenth
of the radius off or in it. Their gap as a scene finds it (`touch`, the smoothed gap of the patches)
is compared with trimesh's distance less their radius.
The meshes of the Visible Human (CC BY 4.0) are not in the repository: docs/simulate.md.
"""

import functools
import sys
import tempfile
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import trimesh  # noqa: E402

from jaxtrachea import table_1  # noqa: E402
from jaxtrachea.contact.patches import touch  # noqa: E402
from jaxtrachea.contact.pose import Pose  # noqa: E402
from jaxtrachea.contact.shapes import sphere  # noqa: E402
from jaxtrachea.scene import wall as walls_of_scene  # noqa: E402
from jaxtrachea.scene import wall_check  # noqa: E402
from jaxtrachea.trachea.imported import Landmarks, read_mesh  # noqa: E402
from jaxtrachea.trachea.mesh import MeshError  # noqa: E402
from jaxtrachea.trachea.tube import make_tube  # noqa: E402

BALLS = 2000


@functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
@functools.partial(jax.vmap, in_axes=(None, 0, None))
def gap_of(tube, centre, radius):
    """Of a ball, as a scene finds it."""
    return touch(sphere(radius), Pose(jnp.eye(3), centre), tube, near=3).gap


def gaps(mesh, geometry):
    """Gaps of the balls: of the mesh, and of the patches less that; limit of a scene."""
    tube = walls_of_scene.patches_of_wall(geometry, mesh)
    centres, _, radius = wall_check._balls(mesh, geometry, BALLS)
    surface = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    true = trimesh.proximity.closest_point(surface, centres)[1] - radius
    if surface.is_watertight:
        inside = trimesh.proximity.signed_distance(surface, centres) > 0
        assert not inside.any()  # the centres are outside, so that the distance is the signed one
    found = np.asarray(gap_of(tube, jnp.asarray(centres), jnp.asarray(radius)))
    return true, found - true, wall_check.limit_of(geometry)


def row(name, mesh, geometry):
    """One row of the table."""
    true, error, limit = gaps(mesh, geometry)
    size = np.abs(error)
    false, missed = ((true > 0) & (true + error < 0)).sum(), ((true < 0) & (true + error > 0)).sum()
    numbers = f"{np.median(size):.3f} | {np.percentile(size, 99):.2f} | {size.max():.2f}"
    print(f"| {name} | {numbers} | {false} / {missed} | {limit:.2f} |", flush=True)


def bent(vertices, radius):
    """The same tube along an arc, to the front, and wider at its first end."""
    x, y, z = np.asarray(vertices).T
    y, z = np.stack([y, z]) * (1 + 0.3 * np.exp(-x / 12))
    turn = x / radius
    return np.stack([(radius - y) * np.sin(turn), radius - (radius - y) * np.cos(turn), z], axis=1)


def lumens():
    """Closed inner surfaces: smooth, wider in places, and with as many waves as there are rings."""
    smooth = make_tube(table_1(), relief=0.0, along=388)
    s = np.asarray(smooth.s)
    for name, places in (
        ("smooth", []), ("2 bulges", [40, 95]), ("5 bulges", [30, 42, 53, 90, 120]),
        ("4 waves 25 mm apart", [40, 65, 90, 115]),
    ):  # fmt: skip
        wide = 0.8 * (1 + sum(0.1 * np.exp(-(((s - p) / 3) ** 2)) for p in places) + 0 * s)
        yield name, np.asarray(smooth.vertices) * np.stack([0 * s + 1, wide, wide], 1), smooth.faces


def wrong_meshes():
    """Name, vertices, faces and what of it is told to `read_mesh`."""
    front, rings = {"anterior": [0, 1, 0]}, {"ring_positions": np.arange(20.0, 121, 10)}
    along, side = {"larynx": [1, 0, 0]}, {"anterior": [0, 0, 1]}
    box = trimesh.creation.box((100, 100, 100))
    for _ in range(4):
        box = box.subdivide()
    yield "cube", box.vertices, box.faces, along
    ball = trimesh.creation.icosphere(4, 50)
    yield "sphere", ball.vertices, ball.faces, along
    rng, blob = np.random.default_rng(0), ball.vertices / 50
    waves, phase = rng.normal(size=(12, 3)) * 3, rng.uniform(0, 6, 12)
    long = blob * [70, 15, 13] * (1 + np.mean(np.cos(blob @ waves.T + phase), axis=1))[:, None]
    yield "blob", long, ball.faces, along
    yield "blob, anterior given", long, ball.faces, along | front
    yield "blob, anterior and rings given", long, ball.faces, along | front | rings
    for name, vertices, faces in lumens():
        yield f"lumen, {name}", vertices, faces, along
        yield f"lumen, {name}, anterior given", vertices, faces, along | front
    tube = make_tube(table_1(), along=194)
    for name, angle in (("U-bend", 180), ("U-bend of 270 degrees", 270)):
        vertices = bent(tube.vertices, 160 / np.radians(angle))
        yield name, vertices, tube.faces, {}
        yield f"{name}, anterior and rings given", vertices, tube.faces, side | rings
    waist = np.asarray(tube.vertices) * np.stack(
        [1 + 0 * tube.s, *[1 - 0.3 * np.exp(-(((tube.s - 70) / 3) ** 2))] * 2], axis=1
    )
    yield "tube with a waist 6 mm long", waist, tube.faces, along
    yield "quarter circle (to be read)", bent(tube.vertices, 320 / np.pi), tube.faces, {}


def main(files):
    """Print both tables."""
    print("| mesh | median [mm] | 99 % | worst | false / missed touches | limit |")
    print("|---|---|---|---|---|---|")
    for k in (1, 2, 4):
        row(
            f"generated, spacing 1/{k}",
            make_tube(table_1(), around=35 * k, along=97 * k),
            table_1(),
        )
    if files:
        male, wall, hoops, female = files
        up = {"larynx": [0, 1, 0]}
        for name, read in (
            ("male, GLB", read_mesh(male)),
            ("male, STL", read_mesh(wall, rings=hoops)),
            ("female, GLB", read_mesh(female, Landmarks(**up))),
        ):
            row(f"{name}, {read.geometry.rings} rings", read.mesh, read.geometry)
    print("\n| surface | answer |\n|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for name, vertices, faces, given in wrong_meshes():
            path = Path(folder) / "surface.stl"
            trimesh.Trimesh(vertices, np.asarray(faces), process=False).export(path)
            try:
                read = read_mesh(path, Landmarks(**given))
                tube = walls_of_scene.checked_walls(read.geometry, read.mesh)
                seen = wall_check.measure(read.mesh, read.geometry, tube)
                answer = f"**read**: {read.notes[-1]}; {seen.sentence}"
            except (MeshError, ValueError) as error:
                answer = f"{type(error).__name__}: {error}"
            print(f"| {name} | {answer} |", flush=True)


if __name__ == "__main__":
    main([str(Path(name).resolve()) for name in sys.argv[1:]])
