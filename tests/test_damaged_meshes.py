"""Damaged and unusual meshes: every ring is right, or the place is named (numpy and trimesh)."""

import json
import re
import struct

import numpy as np
import pytest
import trimesh

from jaxtrachea.scene import build
from jaxtrachea.scene.spec_parts import SceneTracheaSection
from jaxtrachea.trachea.cleaning import Surface, clean
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.imported import Landmarks, read_mesh
from jaxtrachea.trachea.mesh import MeshError, edge_counts
from jaxtrachea.trachea.rings import _check_row
from jaxtrachea.trachea.tube import _grid, make_tube

RINGS = np.array([12.0, 21.0, 31.0, 41.0, 50.0, 61.0, 70.0, 80.0])
TUBE = make_tube(Geometry.create(92.0, RINGS, radius=10.0), around=32, along=92, flatten=0.0)
VERTICES, FACES = np.asarray(TUBE.vertices), np.asarray(TUBE.faces)
MIDDLES = VERTICES[FACES].mean(axis=1)
#: Distance from the anterior midline along the wall, mm.
ASIDE = 11.3 * np.abs(np.arctan2(MIDDLES[:, 2], MIDDLES[:, 1]))
X, Y = [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]
LARYNX = Landmarks(larynx=X)
FRONT = Landmarks(larynx=X, anterior=Y)


def read(folder, vertices=VERTICES, faces=FACES, landmarks=LARYNX):
    """What is read of a surface in an STL file."""
    trimesh.Trimesh(vertices, faces, process=False).export(folder / "t.stl")
    return read_mesh(folder / "t.stl", landmarks)


def error(found, rings=RINGS):
    """Largest error of a ring's position, mm."""
    positions = np.asarray(found.geometry.ring_positions)
    assert positions.shape == np.shape(rings), positions
    return np.abs(positions - rings).max()


@pytest.mark.parametrize("count", [1, 50])
def test_missing_triangles_cost_no_ring(tmp_path, count):
    """One ray that hit nothing blanked a whole station: rings were lost, others invented.

    The undamaged tube is read within 0.13 mm: its crests tilt the centreline.
    """
    gone = np.random.default_rng(count).choice(len(FACES), count, replace=False)
    found = read(tmp_path, faces=np.delete(FACES, gone, axis=0))
    assert error(found) < 0.15
    assert found.ring_errors.shape == found.ring_shares.shape == RINGS.shape
    assert np.all(np.asarray(found.ring_shares) > 0.7)


@pytest.mark.parametrize("size", [1e-9, 1e-6, 1e-3])
def test_corners_beside_each_other_are_one(size):
    rng = np.random.default_rng(0)
    corners = VERTICES[FACES].reshape(-1, 3)
    corners = corners + rng.uniform(-size, size, corners.shape)
    surface, _ = clean(Surface(corners, np.arange(len(corners)).reshape(-1, 3)))
    assert surface.vertices.shape == VERTICES.shape
    assert surface.faces.shape == FACES.shape
    assert np.all(edge_counts(surface.faces)[1] == 2)  # closed


def test_noise_moves_rings_little(tmp_path):
    """0.05 mm: rows of the mesh stand 0.77 mm apart, and crests 0.6 mm out."""
    noise = np.random.default_rng(0).normal(0, 0.05, VERTICES.shape)
    assert error(read(tmp_path, VERTICES + noise)) < 0.3


@pytest.mark.parametrize("walls", [1, 2])
def test_a_hole_in_front_is_named(tmp_path, walls):
    """Rings are read from beside it; through it the rays met the inner wall, or nothing."""
    faces = FACES[(np.abs(MIDDLES[:, 0] - 50) > 8) | (ASIDE > 5)]
    vertices = VERTICES
    if walls == 2:
        vertices = np.concatenate([VERTICES, VERTICES * [1, 0.8, 0.8]])
        faces = np.concatenate([faces, FACES[:, ::-1] + len(VERTICES)])
    found = read(tmp_path, vertices, faces)
    assert error(found) < 0.15
    (note,) = (note for note in found.notes if "hole" in note)
    place = r"a hole of 16 x 8\.5 mm at s = 4[12]\.\d to 58\.1 mm, phi = -23 to 23 degrees"
    assert re.search(place, note), note


@pytest.mark.parametrize(("low", "high"), [(42, 58), (-1, 17)])
def test_a_hole_that_hides_a_ring_is_refused(tmp_path, low, high):
    """Its place is said; at an end as well."""
    between = (MIDDLES[:, 0] > low) & (MIDDLES[:, 0] < high)
    with pytest.raises(MeshError, match=r"front is not there at s = .*hole of .*ring_positions="):
        read(tmp_path, faces=FACES[~between | (ASIDE > 12)], landmarks=FRONT)


def straight(length):
    """What is known of a tube along x."""
    line = np.array([[0.0, 0, 0], [length, 0, 0]])
    return Landmarks(larynx=X, anterior=Y, centreline=line, half_angle=2.0)


def surface(s, radius):
    """A tube open at both ends: `radius` of s and phi."""
    turn = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    s, phi = np.meshgrid(s, np.angle(np.exp(1j * turn)), indexing="ij")
    r = radius(s, phi)
    vertices = np.stack([s, r * np.cos(phi), r * np.sin(phi)], axis=-1).reshape(-1, 3)
    return vertices, _grid(48, len(s) - 1)


def test_a_thread_is_no_row_of_rings(tmp_path):
    """A helical hose was 19 flat rings."""
    hose = surface(
        np.linspace(0, 56, 113), lambda s, phi: 12 + 0.6 * np.cos(2 * np.pi * s / 8 - phi)
    )
    with pytest.raises(MeshError, match=r"by 1 of their distance at each turn, and lean by 8 deg"):
        read(tmp_path, *hose, straight(56.0))


def test_rings_that_lean_are_measured(tmp_path):
    def radius(s, phi):
        along = s - 12 * np.tan(np.radians(6)) * np.sin(phi)
        return 12 + 0.6 * (np.abs(phi) < 2.1) * np.cos(2 * np.pi * along / 8).clip(0)

    found = read(tmp_path, *surface(np.linspace(0, 56, 113), radius), straight(56.0))
    assert error(found, np.arange(8, 49, 8)) < 0.15
    assert any("the rings lean by 6 degrees to the side and 0" in note for note in found.notes)


def test_a_graft_of_narrow_pitch(tmp_path):
    """2.5 mm: rings were off by 0.4 mm, the distance of two stations."""
    rings = np.arange(1.5, 39, 2.5)
    graft = surface(
        np.linspace(0, 40, 201), lambda s, phi: 10 + 0.4 * np.cos(2 * np.pi * (s - 1.5) / 2.5)
    )
    assert error(read(tmp_path, *graft, straight(40.0)), rings) < 0.05


def test_a_short_phantom_and_its_centreline_in_a_scene(tmp_path):
    """66 x 37 mm: it was "not longer than wide", and a scene could not give a centreline."""
    rings = np.arange(8.0, 60, 8)
    tube = make_tube(Geometry.create(66.0, rings, radius=17.2), around=36, along=132, lids=False)
    assert error(read(tmp_path, tube.vertices, tube.faces), rings) < 0.3
    section = SceneTracheaSection(
        file="t.stl", unit="mm", larynx=X, centreline=[[0, 0, 0], [66, 0, 0]]
    )
    geometry, _, _ = build._trachea(section, tmp_path, [], lambda _: None)
    np.testing.assert_allclose(geometry.ring_positions, rings, atol=0.06)


def piece_of(which):
    """Vertices and faces of a part of the tube."""
    used, faces = np.unique(FACES[which], return_inverse=True)
    return VERTICES[used], faces.reshape(-1, 3)


def write_obj(path, objects, materials):
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in VERTICES]
    for piece in np.unique(objects):
        lines.append(f"o part{piece}")
        for material in np.unique(materials):
            lines.append(f"usemtl m{material}")
            of = (objects == piece) & (materials == material)
            lines += [f"f {a} {b} {c}" for a, b, c in FACES[of] + 1]
    path.write_text("\n".join(lines) + "\n")


def write_glb(path, objects, materials):
    """A GLB: a mesh for each object, a primitive for each material; metres."""
    body, views, accessors, meshes = b"", [], [], []
    for piece in np.unique(objects):
        primitives = []
        for material in np.unique(materials[objects == piece]):
            vertices, faces = piece_of((objects == piece) & (materials == material))
            points = (vertices / 1000).astype("<f4")
            limits = {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()}
            for data, kind, number in (
                (points, {"type": "VEC3", "componentType": 5126, **limits}, len(points)),
                (faces.astype("<u4"), {"type": "SCALAR", "componentType": 5125}, faces.size),
            ):
                view = {"buffer": 0, "byteOffset": len(body), "byteLength": data.nbytes}
                accessors.append({"bufferView": len(views), "count": number, **kind})
                views.append(view)
                body += data.tobytes()
            at = len(accessors)
            primitives.append({"attributes": {"POSITION": at - 2}, "indices": at - 1})
        meshes.append({"name": f"part{piece}", "primitives": primitives})
    nodes = [{"name": mesh["name"], "mesh": i} for i, mesh in enumerate(meshes)]
    text = json.dumps({
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": nodes, "meshes": meshes, "accessors": accessors, "bufferViews": views,
        "buffers": [{"byteLength": len(body)}],
    }).encode()  # fmt: skip
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(body), b"BIN\0") + body
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def write_stl(path, objects, _):
    text = ""
    for i in np.unique(objects):
        solid = trimesh.Trimesh(*piece_of(objects == i), process=False)
        text += str(solid.export(file_type="stl_ascii")).replace("solid ", f"solid part{i}")
    path.write_text(text)


@pytest.fixture(scope="module")
def of_ply(tmp_path_factory):
    path = tmp_path_factory.mktemp("ply") / "t.ply"
    trimesh.Trimesh(VERTICES, FACES, process=False).export(path)
    return read_mesh(path, LARYNX)


@pytest.mark.parametrize(
    ("write", "suffix"), [(write_obj, "obj"), (write_glb, "glb"), (write_stl, "stl")]
)
@pytest.mark.parametrize("objects", [1, 3])
def test_objects_and_materials_of_one_surface(tmp_path, of_ply, write, suffix, objects):
    """Of an OBJ with two materials a third was lost: a part for each material."""
    thirds = np.digitize(MIDDLES[:, 0], [31, 62]) if objects == 3 else np.zeros(len(FACES), int)
    write(tmp_path / f"t.{suffix}", thirds, (MIDDLES[:, 0] > 60).astype(int))
    found = read_mesh(tmp_path / f"t.{suffix}", LARYNX)
    assert found.mesh.faces.shape == FACES.shape
    assert error(found, np.asarray(of_ply.geometry.ring_positions)) < 1e-4


def test_an_object_that_may_be_wall_is_not_left_out(tmp_path):
    """A third of the wall that does not meet the rest: named with its share, unless chosen so."""
    scene = trimesh.Scene()
    for i, of in enumerate([MIDDLES[:, 0] < 62, MIDDLES[:, 0] > 62]):
        vertices, faces = piece_of(of)
        moved = (vertices + [3 * i, 0, 0]) / 1000
        scene.add_geometry(trimesh.Trimesh(moved, faces, process=False), node_name=f"part{i}")
    scene.export(tmp_path / "t.glb")
    with pytest.raises(MeshError, match=r"'part1' has 3\d\.\d % of the area .*'part0'.*part="):
        read_mesh(tmp_path / "t.glb", LARYNX)
    found = read_mesh(tmp_path / "t.glb", LARYNX, part="part0")
    assert any(note.startswith("left out: part1 (3") for note in found.notes)


def test_loose_pieces_are_more_than_dust(tmp_path):
    """A patch of 20 x 12 mm that stands 3 mm off."""
    patch = (np.abs(MIDDLES[:, 0] - 50) < 10) & (ASIDE < 6)
    wall, loose = piece_of(~patch), piece_of(patch)
    vertices = np.concatenate([wall[0], loose[0] + [0, 3, 0]])
    faces = np.concatenate([wall[1], loose[1] + len(wall[0])])
    with pytest.raises(
        MeshError, match=r"loose pieces have 3\.\d % of its area \(their middle: 49"
    ):
        read(tmp_path, vertices, faces)


def test_glb_is_in_metres(tmp_path):
    """36 mm is then no question of the unit (it was refused), nor is 92 m."""
    for scale in (0.4e-3, 1.0):
        trimesh.Trimesh(VERTICES * scale, FACES, process=False).export(tmp_path / f"{scale}.glb")
    assert error(read_mesh(tmp_path / "0.0004.glb", FRONT), 0.4 * RINGS) < 0.1
    with pytest.raises(MeshError, match=r"9\.\d+e\+04 mm long in metres.*by definition.*unit="):
        read_mesh(tmp_path / "1.0.glb", LARYNX)


def test_the_cure_for_cartilage_is_not_cartilage():
    """Own cartilage in plates: the cure printed was to give it."""
    with pytest.raises(MeshError, match=r"not so from 30\.0 to 55\.0 mm.*give ring_positions=$"):
        _check_row(np.array([10.0, 20, 30, 55, 65]), "the cartilage", 10.0, 92.0, True)


def test_a_hole_in_cartilage_is_refused(tmp_path):
    """The outside of one hoop of eight, over 12 mm."""
    smooth = make_tube(Geometry.create(92.0, RINGS, radius=10.0), around=36, along=60, relief=0.0)
    trimesh.Trimesh(smooth.vertices, smooth.faces, process=False).export(tmp_path / "wall.stl")
    hoop = trimesh.creation.annulus(9.5, 10.5, 3.0, sections=64)
    one = hoop.vertices[:, [2, 0, 1]]
    vertices = np.concatenate([one + [s, 0, 0] for s in RINGS])
    faces = np.concatenate([hoop.faces + i * len(one) for i in range(len(RINGS))])
    middle = vertices[faces].mean(axis=1)
    pierced = (np.abs(middle[:, 0] - 41) < 3) & (np.abs(middle[:, 2]) < 6) & (middle[:, 1] > 10.3)
    trimesh.Trimesh(vertices, faces[~pierced], process=False).export(tmp_path / "hoops.stl")
    with pytest.raises(MeshError, match=r"the cartilage has a hole of .* at s = .*ring_positions="):
        read_mesh(tmp_path / "wall.stl", FRONT, rings="hoops.stl")
