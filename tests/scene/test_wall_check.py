"""The wall that a tool touches: against closest points, at three spacings, and refused."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from small_scenes import BALL, MATERIAL, bend, poses

from jaxtrachea import Wishes, make_scene, table_1
from jaxtrachea.config import SpecError
from jaxtrachea.contact.patches import touch
from jaxtrachea.contact.pose import Pose
from jaxtrachea.contact.shapes import sphere
from jaxtrachea.scene import stage, wall_check
from jaxtrachea.scene.build import stage as read_scene
from jaxtrachea.scene.spec import load_scene_spec
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.mesh import MeshError
from jaxtrachea.trachea.tube import make_tube

TUBE = table_1()
MESHES = {k: make_tube(TUBE, around=35 * k, along=97 * k) for k in (1, 2, 4)}
BARE = Wishes(want_surface=False)
quick = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})


def gaps(mesh, centres, radius):
    """Of a ball, as a scene would find them; filled up so that all meshes share one program."""
    wall = stage._walls(TUBE, mesh)
    cores = np.asarray(wall.shapes.vertices)
    inside = np.repeat(cores.mean(axis=2, keepdims=True), stage.CORNERS - cores.shape[2], 2)
    shapes = dataclasses.replace(
        wall.shapes, vertices=jnp.asarray(np.concatenate([cores, inside], axis=2))
    )
    wall = dataclasses.replace(wall, shapes=shapes)
    return np.asarray(GAP(wall, jnp.asarray(centres), jnp.asarray(radius)))


@quick
@functools.partial(jax.vmap, in_axes=(None, 0, None))
def GAP(wall, centre, radius):
    return touch(sphere(radius), Pose(jnp.eye(3), centre), wall, near=3).gap


def test_a_finer_mesh_moves_the_gap_by_less_than_0_03_mm():
    """Along the front, where vertices of all three stand; between them a coarse mesh is flat."""
    s = np.linspace(70, 80, 41)
    at = np.stack([s, 0 * s + 18.5, 0 * s], axis=1)
    found = np.stack([gaps(mesh, at, 6.0) for mesh in MESHES.values()])
    assert np.ptp(found, axis=0).max() < 0.03
    # Between the vertices of the coarse mesh: its facets lie R (1 - cos(pi / 35)) deeper.
    half = np.pi / 35
    at = np.stack([s, 0 * s + 18.5 * np.cos(half), 0 * s + 18.5 * np.sin(half)], axis=1)
    found = np.stack([gaps(mesh, at, 6.0) for mesh in MESHES.values()])
    assert np.ptp(found, axis=0).max() < 0.03 + 12.6 * (1 - np.cos(half))


@pytest.mark.parametrize("along", [40, 97, 111])
def test_crests_of_the_rings_are_as_high_in_every_mesh(along):
    geometry = Geometry.create(93.0, [11.3, 20.1, 33.3, 41.9, 57.0, 71.7], radius=10.0)
    mesh = make_tube(geometry, around=9, along=along, wall=2.0, relief=0.5)
    front = np.asarray(mesh.phi) == 0
    for ring in np.asarray(geometry.ring_positions):
        height = np.asarray(mesh.distance)[front & (np.abs(np.asarray(mesh.s) - ring) < 1e-9)]
        np.testing.assert_allclose(height, 11.0, rtol=1e-12)


def test_the_measure_is_the_gap_of_touch():
    """The same balls by `touch`, which smooths by at most its bound."""
    wall = stage._walls(TUBE, MESHES[1])
    centres, _, radius = wall_check._balls(MESHES[1], TUBE, 41)
    seen = wall_check.measure(MESHES[1], TUBE, wall, 41)
    difference = gaps(MESHES[1], centres, radius) - (seen.gap + seen.error)
    assert difference.max() < 1e-3
    assert difference.min() > -0.09
    mesh = trimesh.Trimesh(MESHES[1].vertices, MESHES[1].faces, process=False)
    every = trimesh.triangles.closest_point(
        np.tile(mesh.triangles, (5, 1, 1)), np.repeat(centres[:5], len(mesh.faces), 0)
    ).reshape(5, -1, 3)
    distance = np.linalg.norm(every - centres[:5, None], axis=2).min(axis=1)
    np.testing.assert_allclose(seen.gap[:5], distance - radius, atol=1e-12)


def test_limit_is_the_sagitta_of_a_bridged_hollow():
    """Rings 10 mm apart, patches of 11 mm: that far apart a circle of 11.3 mm is this deep."""
    exact = 11.3 - np.sqrt(11.3**2 - 5.5**2)
    np.testing.assert_allclose(wall_check.limit_of(TUBE), exact, rtol=0.1)  # p^2 / 8R: 7 % less


def test_patches_beside_the_wall_are_refused():
    """A waist of 4 mm within one patch: a ball would touch where there is nothing."""
    mesh = bend(MESHES[1], 300.0)
    path = poses([75, 19, 0], [75, 17, 0])
    good = make_scene(TUBE, MATERIAL, path, tool=BALL, mesh=mesh, wishes=BARE)
    assert good.tube is not None
    assert wall_check.check(mesh, TUBE, good.tube).worst < wall_check.limit_of(TUBE)
    waist = 1 - 0.35 * np.exp(-(((np.asarray(MESHES[1].s) - 70) / 4) ** 2))
    thin = dataclasses.replace(MESHES[1], distance=MESHES[1].distance * waist)
    with pytest.raises(MeshError, match=r"gap is off by .* at worst \(at s = .* expected at most"):
        make_scene(TUBE, MATERIAL, path, tool=BALL, mesh=bend(thin, 300.0), wishes=BARE)


SCENE = """
[material]
EI_L = "1.862 N mm^2"
k_M = "0.1 N/mm"
k_1 = "0.3 N/mm"
k_3 = "0.02 N/mm^3"
[tool]
shape = "sphere"
radius = "6 mm"
[path]
start = ["75 mm", "25 mm", "0 mm"]
end = ["75 mm", "15 mm", "0 mm"]
[trachea]
file = "meshes/trachea.glb"
"""


def test_a_missing_mesh_names_its_source(tmp_path):
    (tmp_path / "scene.toml").write_text(SCENE)
    says = r"trachea.file: there is no file 'meshes/trachea.glb' .* doi:10.48539/HBM969.WCCJ.636"
    with pytest.raises(SpecError, match=says):
        read_scene(load_scene_spec(tmp_path / "scene.toml"), tmp_path)
