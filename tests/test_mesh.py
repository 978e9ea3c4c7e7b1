"""Rest meshes: the generated tube against closed forms, and files read back in any position."""

import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxtrachea.trachea.cleaning import Surface, clean
from jaxtrachea.trachea.geometry import Geometry, table_1
from jaxtrachea.trachea.imported import STEPS, Landmarks, read_mesh
from jaxtrachea.trachea.mesh import MeshError, edge_counts, place, volume
from jaxtrachea.trachea.rings import _check_row
from jaxtrachea.trachea.sections import Cells, contour
from jaxtrachea.trachea.tube import make_tube

ROOT = Path(__file__).parents[1]
REAL = ROOT.parent / "shared" / "data" / "meshes" / "hra_vh_male"
needs_real = pytest.mark.skipif(
    not REAL.is_dir(), reason="the Visible Human meshes (CC BY 4.0) are not beside the repository"
)
RINGS = np.array([12.0, 21.0, 31.0, 41.0, 50.0, 61.0, 70.0, 80.0])
GEOMETRY = Geometry.create(92.0, RINGS, radius=10.0)
TUBE = make_tube(GEOMETRY, around=32, along=120, flatten=0.0)
X, Y, Z = np.eye(3)


def rotation(seed=1):
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


ROTATION, SHIFT = rotation(), np.array([730.0, -1500.0, 412.0])
LARYNX, FRONT = Landmarks(larynx=ROTATION @ X), Landmarks(anterior=ROTATION @ Y)


def write(path, mesh=TUBE, scale=1.0, vertices=None, faces=None):
    vertices = np.asarray(mesh.vertices) if vertices is None else vertices
    faces = np.asarray(mesh.faces) if faces is None else faces
    moved = (vertices @ ROTATION.T + SHIFT) * scale
    trimesh.Trimesh(moved, faces, process=False).export(path)
    return path


def as_arrays(mesh):
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def test_default_tube_is_the_papers_size():
    mesh = make_tube(table_1("float64"))
    assert mesh.faces.shape == (6856, 3)
    assert mesh.vertices.shape == (3430, 3)
    assert mesh.vertices.dtype == mesh.phi.dtype == jnp.dtype("float64")
    assert mesh.faces.dtype == jnp.int32
    vertices, faces = as_arrays(mesh)
    edges, count = edge_counts(faces)
    assert np.all(count == 2)  # closed
    assert len(vertices) - len(edges) + len(faces) == 2  # one ball
    outside = trimesh.Trimesh(vertices, faces, process=False)
    assert outside.is_winding_consistent
    np.testing.assert_allclose(volume(vertices, faces), outside.volume, rtol=1e-5)
    assert outside.volume > 0
    np.testing.assert_allclose(mesh.straight, vertices, atol=1e-12)


def test_smooth_tube_is_a_prism():
    """Area and volume of the prism with 35 sides, and their limit, the cylinder."""
    n, r, length = 35, 12.6, 160.0
    vertices, faces = as_arrays(make_tube(table_1(), relief=0.0, flatten=0.0))
    polygon = n / 2 * math.sin(2 * math.pi / n) * r**2
    np.testing.assert_allclose(volume(vertices, faces), polygon * length, rtol=1e-12)
    area = trimesh.Trimesh(vertices, faces, process=False).area
    np.testing.assert_allclose(
        area, 2 * polygon + 2 * n * r * math.sin(math.pi / n) * length, rtol=1e-12
    )
    fine = as_arrays(make_tube(table_1(), around=400, relief=0.0, flatten=0.0))
    np.testing.assert_allclose(volume(*fine), math.pi * r**2 * length, rtol=1e-4)


def test_normals_point_outwards():
    mesh = jax.device_get(make_tube(table_1(), lids=False))
    radial = np.stack([0 * mesh.phi, np.cos(mesh.phi), np.sin(mesh.phi)], axis=1)
    assert np.min(np.sum(mesh.normals * radial, axis=1)) > 0.7
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, rtol=1e-12)
    _, count = edge_counts(np.asarray(mesh.faces))
    assert np.sum(count == 1) == 70  # two open ends


def test_rings_stand_out_and_the_back_is_flatter():
    geometry = Geometry.create(50.0, [20.0], radius=10.0)
    tube = make_tube(geometry, around=36, along=50, wall=2.0, relief=0.5, flatten=0.2)
    mesh = jax.device_get(tube)

    def at(s, phi):
        return float(mesh.distance[np.argmin(np.abs(mesh.s - s) + np.abs(mesh.phi - phi))])

    np.testing.assert_allclose([at(20, 0), at(10, 0)], [11.0, 10.5])
    np.testing.assert_allclose([at(20, math.pi), at(10, math.pi)], 0.8 * 10.5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"around": 2}, "around, along are 2, 97"),
        ({"relief": 20.0}, "leave a radius"),
        ({"flatten": 1.0}, "flatten is 1"),
    ],
)
def test_bad_tubes(changes, message):
    with pytest.raises(ValueError, match=message):
        make_tube(table_1(), **changes)


def test_contour_of_a_box():
    """Rays from inside a cube meet its faces at the distance plane geometry gives."""
    box = trimesh.creation.box((2, 2, 2))
    cells = Cells.of(box.vertices, box.faces)
    centre = np.array([0.1, 0, 0])
    radius = contour(cells.near(centre, X), centre, np.eye(3))
    angle = 2 * math.pi * (np.arange(72) + 0.5) / 72 - math.pi
    wanted = 1 / np.maximum(np.abs(np.cos(angle)), np.abs(np.sin(angle)))
    np.testing.assert_allclose(radius, wanted, rtol=1e-12)


def check(found, mesh, geometry, atol=0.35, scale=1.0):
    """Positions, angles and rings of the vertices, matched by place, not by order.

    Rings sit on rows 0.77 mm apart and sections 0.4 mm: 0.35 mm is what can be told of them.
    The crests draw the centroids forward, which tilts the line at its ends by up to 0.02 rad.
    """
    got = np.asarray(found.origin) + np.asarray(found.mesh.vertices) @ np.asarray(
        found.rotation
    ) / float(found.scale)
    wanted = (np.asarray(mesh.vertices) @ ROTATION.T + SHIFT) * scale
    assert len(got) == len(wanted)
    near = np.array([np.argmin(np.sum((got - p) ** 2, axis=1)) for p in wanted])
    assert np.max(np.abs(got[near] - wanted)) < 1e-3 * scale
    np.testing.assert_allclose(np.asarray(found.mesh.s)[near], mesh.s, atol=0.3)
    turn = np.asarray(found.mesh.phi)[near] - np.asarray(mesh.phi)
    turn = turn[np.asarray(mesh.distance) > 1]
    assert np.max(np.abs(np.angle(np.exp(1j * turn)))) < 0.05
    np.testing.assert_allclose(found.geometry.ring_positions, geometry.ring_positions, atol=atol)
    np.testing.assert_allclose(found.geometry.length, geometry.length, atol=0.2)


@pytest.mark.slow
@pytest.mark.compiling
def test_round_trip(tmp_path):
    path = write(tmp_path / "tube.obj", scale=0.1)
    found = read_mesh(path, LARYNX, unit="cm")
    check(found, TUBE, GEOMETRY, scale=0.1)
    np.testing.assert_allclose(found.scale, 10)
    np.testing.assert_allclose(found.geometry.half_angle, 2 * math.pi / 3, atol=0.2)
    vertices, faces = as_arrays(found.mesh)
    np.testing.assert_allclose(
        volume(vertices, faces), volume(*as_arrays(TUBE)), rtol=1e-4
    )  # the same handedness


def test_larynx_sets_the_direction(tmp_path):
    found = read_mesh(write(tmp_path / "t.stl"), Landmarks(larynx=-ROTATION @ X))
    np.testing.assert_allclose(found.geometry.ring_positions, 92 - RINGS[::-1], atol=0.35)


def test_the_wider_end_is_the_carina(tmp_path):
    vertices, _ = as_arrays(TUBE)
    wide = vertices * np.stack([np.ones(len(vertices))] + [1.3 - 0.5 * vertices[:, 0] / 92] * 2, 1)
    found = read_mesh(write(tmp_path / "t.stl", vertices=wide), FRONT)
    np.testing.assert_allclose(found.geometry.ring_positions, RINGS, atol=0.5)
    other = wide * [-1, 1, -1]
    found = read_mesh(write(tmp_path / "u.stl", vertices=other), FRONT)
    np.testing.assert_allclose(found.geometry.ring_positions, RINGS, atol=0.5)


def test_flat_back_is_found_without_rings(tmp_path):
    smooth = make_tube(GEOMETRY, around=48, along=60, relief=0.0, flatten=0.2)
    path = write(tmp_path / "t.stl", smooth)
    found = read_mesh(path, Landmarks(larynx=ROTATION @ X, ring_positions=RINGS))
    np.testing.assert_allclose(np.asarray(found.rotation) @ (ROTATION @ Y), Y, atol=0.06)
    np.testing.assert_array_equal(found.geometry.ring_positions, RINGS)
    with pytest.raises(MeshError, match=r"t.stl: found \d rings in the relief .* ring_positions="):
        read_mesh(path, LARYNX)


def bent(vertices, radius=150.0):
    """The tube bent backwards to a circle of this radius in the plane of symmetry."""
    x, y, z = vertices.T
    turn = x / radius
    out = [(radius + y) * np.sin(turn), (radius + y) * np.cos(turn) - radius, z]
    return np.stack(out, axis=1)


def test_curved_double_walled_tube(tmp_path):
    """Arc length is s; frames carry a motion along the normal to the normal of the bend."""
    vertices, faces = as_arrays(TUBE)
    inner = vertices * [1, 0.8, 0.8]
    both = np.concatenate([bent(vertices), bent(inner)])
    faces = np.concatenate([faces, faces[:, ::-1] + len(vertices)])
    path = write(tmp_path / "t.ply", vertices=both, faces=faces)
    found = read_mesh(path, Landmarks(larynx=ROTATION @ X, anterior=ROTATION @ Y))
    np.testing.assert_allclose(found.geometry.length, 92, atol=0.6)
    np.testing.assert_allclose(found.geometry.ring_positions, RINGS, atol=0.6)
    mesh, phi = found.mesh, np.asarray(found.mesh.phi)
    assert mesh.frames is not None
    frames = np.asarray(mesh.frames)
    np.testing.assert_allclose(
        frames.mT @ frames, np.broadcast_to(np.eye(3), frames.shape), atol=1e-12
    )
    away = np.stack([0 * phi, np.cos(phi), np.sin(phi)], axis=1)
    moved = jax.jit(place)

    def unbent(vertices):
        back = np.asarray(found.origin) + np.asarray(vertices) @ np.asarray(found.rotation)
        x, y, z = ((back - SHIFT) @ ROTATION).T
        return np.stack([150 * np.arctan2(x, y + 150), np.hypot(x, y + 150) - 150, z], axis=1)

    rest = unbent(mesh.vertices)
    inside = (rest[:, 0] > 5) & (rest[:, 0] < 87)
    # 0.02 rad: the tilt of the centreline found, see `check`.
    outward = unbent(moved(mesh, away)) - rest
    np.testing.assert_allclose(outward[inside], away[inside], atol=0.05)
    forward = unbent(moved(mesh, np.broadcast_to(X, away.shape))) - rest
    forward[:, 0] *= (150 + rest[:, 1]) / 150
    np.testing.assert_allclose(
        forward[inside], np.broadcast_to(X, forward.shape)[inside], atol=0.05
    )


def test_rings_from_their_own_surface(tmp_path):
    smooth = make_tube(GEOMETRY, around=36, along=60, relief=0.0, flatten=0.0)
    write(tmp_path / "wall.stl", smooth)
    hoop = trimesh.creation.annulus(9.5, 10.5, 3.0, sections=64)
    keep = np.hypot(*hoop.triangles_center.T[:2]) > 0
    keep &= np.abs(np.arctan2(hoop.triangles_center[:, 1], hoop.triangles_center[:, 0])) < 2.0
    hoop.update_faces(keep)
    one = hoop.vertices[:, [2, 0, 1]]
    vertices = np.concatenate([one + [s, 0, 0] for s in RINGS])
    faces = np.concatenate([hoop.faces + i * len(one) for i in range(len(RINGS))])
    write(tmp_path / "hoops.stl", vertices=vertices, faces=faces)
    found = read_mesh(tmp_path / "wall.stl", LARYNX, rings="hoops.stl")
    check(found, smooth, GEOMETRY)
    np.testing.assert_allclose(found.geometry.half_angle, 2.0, atol=0.15)
    np.testing.assert_allclose(found.geometry.ring_height, 3.0, atol=0.5)


def test_dirt_is_cleaned_and_told(tmp_path):
    """Slivers, collapsed triangles, a loose fragment, an inside-out surface."""
    vertices, faces = as_arrays(TUBE)
    a, b, _ = faces[0]
    extra = np.array([[a, a, b], [b, b, b]])
    dust = np.array([[0.0, 30, 0], [1, 30, 0], [0, 31, 0], [0, 30, 1]])
    bits = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]) + len(vertices)
    path = write(
        tmp_path / "t.ply",
        vertices=np.concatenate([vertices, dust]),
        faces=np.concatenate([faces, faces[:1], extra, bits])[:, ::-1],
    )
    found = read_mesh(path, LARYNX)
    check(found, TUBE, GEOMETRY)
    assert volume(*as_arrays(found.mesh)) > 0
    told = " ".join(found.notes)
    for words in ("3 collapsed", "4 triangles of small loose", "inside out", "unit taken as mm"):
        assert words in told


def test_much_dust(tmp_path):
    """20,000 loose pieces, as a scan has: each was looked for in all triangles."""
    vertices, faces = as_arrays(TUBE)
    rng = np.random.default_rng(0)
    bits = rng.uniform(-40, 40, (20_000, 1, 3)) + rng.uniform(0, 0.1, (20_000, 3, 3))
    extra = np.arange(60_000).reshape(-1, 3) + len(vertices)
    surface, notes = clean(
        Surface(np.concatenate([vertices, bits.reshape(-1, 3)]), np.concatenate([faces, extra]))
    )
    assert "20000 triangles of small loose fragments dropped" in notes
    np.testing.assert_array_equal(surface.faces.shape, faces.shape)
    np.testing.assert_allclose(np.sort(surface.vertices, 0), np.sort(vertices, 0), atol=1e-12)


def test_progress_comes_to_its_end(tmp_path):
    seen = []
    path = write(tmp_path / "t.stl")
    read_mesh(path, LARYNX, progress=lambda done, of: seen.append((done, of)))
    assert seen == [(1, len(seen))] * len(seen)
    assert len(seen) == STEPS


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize(
    ("angle", "message"),
    [
        (180, r"its centreline turns by 1\d\d degrees, expected at most 100"),
        (120, r"centreline found runs 1\.\d mm beside the middle of its cross-sections"),
    ],
)
def test_a_u_bend_is_refused(tmp_path, angle, message):
    """With its rings and front given it was read: straight, and of another length."""
    given = {"anterior": ROTATION @ Z, "ring_positions": RINGS}
    vertices, faces = as_arrays(TUBE)
    radius = 92 / math.radians(angle)
    around = bent(vertices * [1, -1, 1], radius)
    path = write(tmp_path / "t.stl", vertices=around, faces=faces[:, ::-1])
    with pytest.raises(MeshError, match=message):
        read_mesh(path, Landmarks(larynx=ROTATION @ X, **given))
    s = np.linspace(0, 92, 60)
    line = bent(np.stack([s, 0 * s, 0 * s], axis=1), radius) @ ROTATION.T + SHIFT
    with pytest.raises(MeshError, match=r"its centreline turns by 1[127]\d degrees"):
        read_mesh(path, Landmarks(centreline=line, **given))


def test_open_tube(tmp_path):
    mesh = make_tube(GEOMETRY, around=32, along=120, flatten=0.0, lids=False)
    found = read_mesh(write(tmp_path / "t.stl", mesh), LARYNX)
    check(found, mesh, GEOMETRY)
    assert "64 open edges" in found.notes


def test_a_given_centreline_is_taken(tmp_path):
    """Then s and phi are exact to rounding, also for the default tube with its flat back."""
    mesh = make_tube(GEOMETRY)
    line = np.array([[0.0, 0, 0], [92, 0, 0]]) @ ROTATION.T + SHIFT
    landmarks = Landmarks(larynx=ROTATION @ X, anterior=ROTATION @ Y, centreline=line)
    found = read_mesh(write(tmp_path / "t.ply", mesh), landmarks)
    np.testing.assert_allclose(np.sort(found.mesh.s), np.sort(mesh.s), atol=1e-3)
    np.testing.assert_allclose(found.rotation @ ROTATION, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(np.sort(found.mesh.phi)[3:], np.sort(mesh.phi)[3:], atol=2e-3)


def _sphere(path):
    trimesh.creation.icosphere(3, 40).export(path)


def _far_too_long(path):
    write(path, scale=30.0)


def _flipped(path):
    vertices, faces = as_arrays(TUBE)
    faces = faces.copy()
    faces[:200] = faces[:200, ::-1]
    write(path, vertices=vertices, faces=faces)


def _fin(path):
    vertices, faces = as_arrays(TUBE)
    a, b, _ = faces[0]
    write(path, vertices=np.concatenate([vertices, [[40.0, 40, 0]]]),
          faces=np.concatenate([faces, [[a, b, len(vertices)]]]))  # fmt: skip


def _points(path):
    trimesh.PointCloud(np.eye(3)).export(path)


def _text(path):
    path.write_text("no surface")


def _gutter(path):
    mesh = make_tube(GEOMETRY, lids=False)
    write(
        path, mesh, faces=np.asarray(mesh.faces)[np.asarray(mesh.vertices)[mesh.faces[:, 0], 2] > 0]
    )


#: Lines along the axis of the tube, beyond its end; and along the tube, 5 mm outside its wall.
OFF_END = np.array([[150.0, 0, 0], [250, 0, 0]]) @ ROTATION.T + SHIFT
BESIDE = np.array([[0.0, 0, 18], [92, 0, 18]]) @ ROTATION.T + SHIFT


def known(**landmarks):
    return {"landmarks": Landmarks(**landmarks)}


@pytest.mark.parametrize(
    ("make", "given", "message"),
    [
        (lambda path: None, {}, r"bad.ply: there is no such file"),
        (_text, {}, r"bad.ply: could not be read as a surface"),
        (_points, {}, r"no triangles in it"),
        (_sphere, {}, r"not longer than wide.*centreline="),
        (_gutter, {}, r"cross-sections close round the axis"),
        (_far_too_long, {}, r"is no trachea in mm, cm, in, m .*give unit="),
        (lambda path: write(path, scale=0.05), {}, r"may be in cm or in .*give unit="),
        (write, {"unit": "N"}, r"does not measure length"),
        (write, {}, r"both ends are alike .*larynx="),
        (write, known(larynx=ROTATION @ Y), r"larynx= points across"),
        (write, known(larynx=ROTATION @ X, anterior=ROTATION @ X), r"anterior= points along"),
        (write, known(larynx=ROTATION @ X, ring_positions=[3.0, 400.0]), r"inside \(0, "),
        (write, known(larynx=(math.nan, 0.0, 0.0)), r"larynx= is \[nan, .* finite numbers, not"),
        (write, known(larynx=(1.0, 0.0)), r"larynx= is \[1.0, 0.0\], no direction"),
        (write, known(larynx=np.array(["up"])), r"larynx= is .*up.*; expected numbers"),
        (write, known(anterior=(math.inf, 0.0, 0.0)), r"anterior= is \[inf, .* finite numbers"),
        (write, known(centreline=OFF_END), r"centreline, lengthened .* before the mesh .*centrel"),
        (write, known(centreline=BESIDE), r"centreline runs outside the mesh over 100 % .*centrel"),
        (write, {"part": "lung"}, r"no object 'lung' in it; expected one of"),
        (write, {"rings": "absent.stl"}, r"rings='absent.stl': there is no such file"),
        (write, known(centreline=np.zeros((3, 2))), r"centreline has shape \(3, 2\)"),
        (_flipped, {}, r"face opposite ways"),
        (_fin, {}, r"edges belong to more than two triangles"),
    ],
)  # fmt: skip
def test_bad_files(tmp_path, make, given, message):
    make(tmp_path / "bad.ply")
    with pytest.raises(MeshError, match=message):
        read_mesh(tmp_path / "bad.ply", **given)


def lumen(bulges, height=0.1):
    """A closed lumen: smooth, and wider in some places (s and half-length of each, mm)."""
    vertices, faces = as_arrays(make_tube(GEOMETRY, around=32, along=100, relief=0.0, flatten=0.2))
    away = np.array([(vertices[:, 0] - s) / half for s, half in bulges])
    wide = 1 + height * np.sum(np.cos(np.pi / 2 * np.clip(away, -1, 1)) ** 2, axis=0)
    return vertices * np.stack([np.ones_like(wide), wide, wide], 1), faces


@pytest.mark.parametrize(
    ("bulges", "message"),
    [
        ([(30, 4), (60, 4)], "found 2 rings .* expected at least 4"),
        ([(20, 4), (27, 4), (34, 4), (60, 4), (70, 4)], "found 5 rings .* expected them even"),
        ([(20, 3), (27, 3), (34, 3), (41, 3)], "found 4 rings .* on 40 % of its 92.04 mm"),
    ],
)
def test_bulges_of_a_lumen_are_no_rings(tmp_path, bulges, message):
    """The first was a trachea of two rings, with patches half its length."""
    vertices, faces = lumen(bulges)
    with pytest.raises(MeshError, match=message):
        read_mesh(write(tmp_path / "t.stl", vertices=vertices, faces=faces), LARYNX)


def test_crests_too_far_apart_are_no_rings():
    """25 mm on a tube of 10 mm radius: waves of a lumen, or of breathing."""
    with pytest.raises(MeshError, match="found 4 rings .* expected them 2 to 20 mm apart"):
        _check_row(np.array([10.0, 35, 60, 85]), "the relief", 10.0, 92.0, False)


@pytest.mark.parametrize("end", [2.0, 4.0])
def test_rings_near_the_ends_are_rings(tmp_path, end):
    """14 rings, the first and last 2 or 4 mm from the ends: less than half the radius."""
    rings = end + 6.5 * np.arange(14)
    geometry = Geometry.create(rings[-1] + end, rings, radius=9.0)
    mesh = make_tube(geometry, around=24, along=2 * int(rings[-1] + end))
    found = read_mesh(write(tmp_path / "t.stl", mesh), LARYNX)
    np.testing.assert_allclose(found.geometry.ring_positions, rings, atol=0.35)


def test_a_round_smooth_tube_has_no_front(tmp_path):
    smooth = make_tube(GEOMETRY, around=40, along=60, relief=0.0, flatten=0.0)
    with pytest.raises(MeshError, match="which side is anterior"):
        read_mesh(write(tmp_path / "t.stl", smooth), LARYNX)


def test_two_walls_are_asked_about(tmp_path):
    scene = trimesh.Scene()
    vertices, faces = as_arrays(TUBE)
    for name in ("left", "right"):
        scene.add_geometry(trimesh.Trimesh(vertices / 1000, faces), node_name=name)
    scene.export(tmp_path / "two.glb")
    with pytest.raises(MeshError, match=r"which of the objects left, right is the wall"):
        read_mesh(tmp_path / "two.glb")


@pytest.fixture(scope="module")
def real():
    return read_mesh(REAL / "3d-vh-m-trachea.glb")


@needs_real
def test_real_trachea(real):
    """Rings from the cartilage in the same file; by eye 16, two of them forked."""
    assert 14 <= real.geometry.rings <= 17
    assert 120 < real.geometry.length < 150
    assert 8 < real.geometry.radius < 12
    assert 1.7 < real.geometry.half_angle < 2.3
    # glTF: +Y up, +Z to the front; the larynx is up, the rings are in front.
    assert real.rotation[0, 1] > 0.8
    assert real.rotation[1, 2] > 0.8


@pytest.mark.long
@needs_real
def test_real_trachea_from_another_format(real):
    """STL: millimetres, other axes, the rings in a file of their own."""
    other = read_mesh(REAL / "wall_mm.stl", rings="cartilage_rings_mm.stl")
    np.testing.assert_allclose(
        other.geometry.ring_positions, real.geometry.ring_positions, atol=1e-3
    )
    np.testing.assert_allclose(other.geometry.length, real.geometry.length, rtol=1e-5)
    a, b = (np.asarray(v.mesh.vertices) for v in (real, other))
    assert a.shape == b.shape
    near = [np.argmin(np.sum((a - p) ** 2, axis=1)) for p in b[::50]]
    np.testing.assert_allclose(a[near], b[::50], atol=1e-3)
    np.testing.assert_allclose(real.mesh.s[np.array(near)], other.mesh.s[::50], atol=1e-3)
    np.testing.assert_allclose(real.mesh.phi[np.array(near)], other.mesh.phi[::50], atol=1e-3)


@needs_real
def test_the_real_wall_alone_shows_no_rings():
    with pytest.raises(MeshError, match="or rings="):
        read_mesh(REAL / "wall_mm.stl")
