"""Simulations for other programs, read back by them: VTK, trimesh."""

import json
import struct

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from jaxtrachea.contact.shapes import Shape, sphere
from jaxtrachea.output.gltf import write_glb
from jaxtrachea.output.read import StoredSimulation
from jaxtrachea.output.recording import NoSurface, recording_of
from jaxtrachea.output.vtk_files import write_map, write_vtk
from jaxtrachea.scene.simulation import Simulation
from jaxtrachea.scene.spec import OutputSection
from jaxtrachea.scene.stage import Poses
from jaxtrachea.scene.sweep import Sweep
from jaxtrachea.trachea.mesh import Mesh

ROWS = 4
TURNS = Rotation.from_euler("y", [[0], [100], [200], [300]], degrees=True).as_matrix()


def stored(time=None, solved=(True, True, False, True), **changes):
    """A tube of 12 x 16 vertices under a ball of 5 mm; row 3 has no solution."""
    x, phi = (
        v.ravel()
        for v in np.meshgrid(
            np.linspace(0, 44, 12), np.arange(16) * np.pi / 8 - np.pi, indexing="ij"
        )
    )
    rest = np.stack([x, 10 * np.cos(phi), 10 * np.sin(phi)], axis=1)
    i, j = (v.ravel() for v in np.meshgrid(np.arange(11), np.arange(16), indexing="ij"))
    a, b, c, d = (p * 16 + q % 16 for p, q in ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)))
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)])
    rows = np.arange(float(ROWS))
    dent = np.exp(-((x - 20) ** 2) / 30)[:, None] * rest * [0, -0.1, -0.1]
    moved = rest + rows[:, None, None] * dent
    moved[~np.asarray(solved)] = np.nan
    series = dict.fromkeys(Simulation._fields)
    series |= {"vertices": moved, "s": np.full(ROWS, 20.0), "phi": np.zeros(ROWS), "time": time,
               "force": rows[:, None] * [0, -0.3, 0.1], "status": np.zeros(ROWS, int)}  # fmt: skip
    path = Poses(TURNS, np.stack([np.full(ROWS, 20.0), 16 - rows, 0 * rows], axis=1))
    rings = {"position": np.array([20.0]), "height": 5.0, "half_angle": 2.0}
    kept = {"vertices": rest, "faces": faces, "s": x, "phi": phi, "distance": np.full(len(x), 10.0)}
    out = StoredSimulation(
        Simulation(**series), {}, [], {}, sphere(jnp.asarray(5.0)), path, {}, rings, kept
    )
    return out._replace(**changes)


def chunks(path):
    """JSON and arrays of a GLB."""
    data = path.read_bytes()
    assert struct.unpack("<4sII", data[:12]) == (b"glTF", 2, len(data))
    size = struct.unpack("<I", data[12:16])[0]
    return json.loads(data[20 : 20 + size]), data[28 + size :]


@pytest.fixture(scope="module")
def vtk():
    return pytest.importorskip("vtk", reason="vtk is not installed")


def points(data, convert):
    return convert.vtk_to_numpy(data.GetPoints().GetData())


def test_paraviews_files_are_read_by_vtk(vtk, tmp_path):
    """Every part of every row; the row without a solution has its tool alone."""
    from vtkmodules.util import numpy_support as convert

    given = stored(time=np.array([0.0, 0.5, 1.0, 2.0]))
    write_vtk(tmp_path, recording_of(given))
    names = sorted(p.name for p in (tmp_path / "vtk").iterdir())
    assert len(names) == 10
    assert [n for n in names if "0003" in n] == ["tool_0003.vtp"]
    reader = vtk.vtkXMLPolyDataReader()
    for part in ("wall", "tool", "contact"):
        reader.SetFileName(str(tmp_path / "vtk" / f"{part}_0002.vtp"))
        reader.Update()
        data = reader.GetOutput()
        if part == "wall":
            moved = np.asarray(given.simulation.vertices[1])
            np.testing.assert_allclose(points(data, convert), moved, atol=1e-5)
            assert data.GetNumberOfPolys() == len(given.rest["faces"])
            named = data.GetPointData()
            motion = convert.vtk_to_numpy(named.GetArray("displacement"))
            np.testing.assert_allclose(motion, moved - given.rest["vertices"], atol=1e-6)
            ring = convert.vtk_to_numpy(named.GetArray("ring"))
            assert set(given.rest["s"][ring == 1]) == {20.0}
        elif part == "tool":
            away = np.linalg.norm(
                points(data, convert) - np.asarray(given.path.translation[1]), axis=1
            )
            np.testing.assert_allclose(away, 5.0, atol=1e-5)
            assert data.GetNumberOfPolys() > 1000
        else:
            np.testing.assert_allclose(points(data, convert), [[20.0, 9.0, 0.0]], atol=1e-5)
            force = convert.vtk_to_numpy(data.GetPointData().GetArray("force"))
            np.testing.assert_allclose(force, [[0.0, -0.3, 0.1]], rtol=1e-6)
    index = (tmp_path / "simulation.pvd").read_text()
    assert index.count("<DataSet") == 10
    assert '<DataSet timestep="0.5" part="1" name="tool" file="vtk/tool_0002.vtp"/>' in index


def test_a_map_on_the_wall_is_read_by_vtk(vtk, tmp_path):
    """Linear between the points of the grid, nothing beyond it."""
    from vtkmodules.util import numpy_support as convert

    rest = stored().rest
    s, phi = np.linspace(10.0, 30.0, 5), np.linspace(-1.0, 1.0, 3)
    force = (0.1 + 0.02 * s[:, None] + 0.3 * phi).ravel()
    deep = np.where(force > 0.6, 3, 0)
    out = Sweep(force, force, np.where(force > 0.6, np.nan, 1.0), force, deep)
    names = ("vertices", "faces", "s", "phi", "distance")
    wall = Mesh(**{k: jnp.asarray(rest[k]) for k in names}, normals=jnp.asarray(rest["vertices"]))
    write_map(tmp_path / "sweep.vtp", wall, s, phi, out)
    reader = vtk.vtkXMLPolyDataReader()
    reader.SetFileName(str(tmp_path / "sweep.vtp"))
    reader.Update()
    named = reader.GetOutput().GetPointData()
    status = convert.vtk_to_numpy(named.GetArray("status"))
    assert (
        status[~((rest["s"] >= 10) & (rest["s"] <= 30) & (np.abs(rest["phi"]) <= 1))] == -1
    ).all()
    assert set(status) == {-1, 0, 3}
    got = convert.vtk_to_numpy(named.GetArray("force"))
    inside = (rest["s"] >= 10) & (rest["s"] <= 30) & (np.abs(rest["phi"]) <= 1)
    assert inside.sum() > 20
    expected = 0.1 + 0.02 * rest["s"] + 0.3 * rest["phi"]
    np.testing.assert_allclose(got[inside], expected[inside], rtol=1e-6)
    assert np.isnan(got[~inside]).all()
    lost = np.isnan(convert.vtk_to_numpy(named.GetArray("compliance")))
    assert lost[expected > 0.8].all()
    assert not lost[inside & (expected < 0.3)].any()


def test_the_animation_plays_in_vtk(vtk, tmp_path):
    """At the time of each solved row its wall and its tool, and the mean of two between them."""
    from vtkmodules.util import numpy_support as convert

    given = stored(time=np.array([1.0, 1.5, 2.0, 3.0]))
    write_glb(tmp_path / "a.glb", recording_of(given))
    reader = vtk.vtkGLTFReader()
    reader.SetFileName(str(tmp_path / "a.glb"))
    reader.ApplyDeformationsToGeometryOn()
    reader.UpdateInformation()
    assert reader.GetNumberOfAnimations() == 1
    assert reader.GetAnimationDuration(0) == 2.0
    reader.EnableAnimation(0)
    vertices, place = (
        np.asarray(given.simulation.vertices) / 1e3,
        np.asarray(given.path.translation) / 1e3,
    )
    for time, wall, at in (
        (0.0, vertices[0], place[0]),
        (0.5, vertices[1], place[1]),
        (1.25, (vertices[1] + vertices[3]) / 2, (place[1] + place[3]) / 2),
        (2.0, vertices[3], place[3]),
    ):
        reader.GetOutputInformation(0).Set(
            vtk.vtkStreamingDemandDrivenPipeline.UPDATE_TIME_STEP(), time
        )
        reader.Modified()
        reader.UpdateTimeStep(time)
        sizes = {}
        walk = reader.GetOutput().NewIterator()
        while not walk.IsDoneWithTraversal():
            data = walk.GetCurrentDataObject()
            sizes[data.GetNumberOfPoints()] = points(data, convert)
            walk.GoToNextItem()
        np.testing.assert_allclose(sizes.pop(len(wall)), wall, atol=1e-7)
        (tool,) = sizes.values()
        np.testing.assert_allclose(np.linalg.norm(tool - at, axis=1), 5e-3, atol=1e-7)


def test_trimesh_shows_the_animations_first_shape(tmp_path):
    """It reads no animation: the wall at rest, in metres, and the tool where it begins."""
    given = stored()
    write_glb(tmp_path / "a.glb", recording_of(given))
    scene = trimesh.load(tmp_path / "a.glb", process=False)
    wall = scene.geometry["trachea"]
    np.testing.assert_allclose(wall.vertices, given.rest["vertices"] / 1e3, atol=1e-8)
    np.testing.assert_array_equal(wall.faces, given.rest["faces"])
    (placed,) = [scene.graph.get("tool")[0]]
    np.testing.assert_allclose(placed[:3, 3], [20e-3, 16e-3, 0], atol=1e-9)


def test_the_animations_numbers_are_those_of_the_format(tmp_path):
    """Bounds hold the values, views lie in the buffer, turns go the short way."""
    write_glb(tmp_path / "a.glb", recording_of(stored()))
    document, data = chunks(tmp_path / "a.glb")
    assert (
        document["buffers"][0]["byteLength"] <= len(data) < document["buffers"][0]["byteLength"] + 4
    )
    sizes = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
    arrays = []
    for accessor in document["accessors"]:
        view = document["bufferViews"][accessor["bufferView"]]
        whole = accessor["componentType"] == 5125
        raw = data[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        values = np.frombuffer(raw, "<u4" if whole else "<f4").reshape(-1, sizes[accessor["type"]])
        assert len(values) == accessor["count"]
        if "min" in accessor:
            np.testing.assert_allclose(values.min(axis=0), accessor["min"], rtol=1e-6)
            np.testing.assert_allclose(values.max(axis=0), accessor["max"], rtol=1e-6)
        arrays.append(values)
    (animation,) = document["animations"]
    moves = {
        c["target"]["path"]: animation["samplers"][c["sampler"]] for c in animation["channels"]
    }
    np.testing.assert_allclose(
        arrays[moves["weights"]["input"]].ravel(), [0.0, 0.1, 0.3], rtol=1e-6
    )
    np.testing.assert_array_equal(arrays[moves["weights"]["output"]].reshape(3, 3), np.eye(3))
    turns = arrays[moves["rotation"]["output"]]
    np.testing.assert_allclose(np.linalg.norm(turns, axis=1), 1, rtol=1e-6)
    assert (np.sum(turns[1:] * turns[:-1], axis=1) >= 0).all()
    found = Rotation.from_quat(turns).as_matrix()
    np.testing.assert_allclose(found, TURNS[[0, 1, 3]], atol=1e-6)
    primitive = document["meshes"][0]["primitives"][0]
    normals = arrays[primitive["attributes"]["NORMAL"]]
    outward = np.asarray(stored().rest["vertices"]) * [0, 0.1, 0.1]
    inner = slice(16, -16)  # the ends of the tube have triangles on one side alone
    assert (np.sum(normals[inner] * outward[inner], axis=1) > 0.99).all()


def test_a_long_path_has_few_shapes_and_one_row_is_enough(tmp_path):
    """Evenly thinned, first and last among them."""
    rows = 250
    given = recording_of(stored())
    wall = given.walls[1]
    long = given._replace(
        times=np.arange(float(rows)), walls=[wall] * rows, tools=[],
    )  # fmt: skip
    write_glb(tmp_path / "long.glb", long)
    document, _ = chunks(tmp_path / "long.glb")
    assert len(document["meshes"][0]["primitives"][0]["targets"]) == 100
    clock = document["accessors"][document["animations"][0]["samplers"][0]["input"]]
    assert (clock["min"], clock["max"]) == ([0.0], [pytest.approx(24.9)])
    assert [node["name"] for node in document["nodes"]] == ["trachea"]
    write_glb(tmp_path / "one.glb", recording_of(stored(solved=(False, True, False, False))))
    assert len(trimesh.load(tmp_path / "one.glb", process=False).geometry) == 2


def test_several_tools_move_by_themselves(tmp_path):
    """Each its own node, file and contact point; one of them presses at points and is not seen."""
    one = stored()
    series, short = one.simulation, Poses(TURNS[:2], np.asarray(one.path.translation)[:2])
    both = {"left": short, "right": one.path}
    twice = {n: np.stack([getattr(series, n)] * 2, axis=1) for n in ("s", "phi", "force")}
    twice["s"][:, 1] = 36.0
    given = one._replace(
        simulation=series._replace(**twice), path=both, tool={"left": one.tool, "right": None}
    )
    recording = recording_of(given)
    write_glb(tmp_path / "a.glb", recording)
    document, _ = chunks(tmp_path / "a.glb")
    assert [node["name"] for node in document["nodes"]] == ["trachea", "left"]
    write_vtk(tmp_path, recording)
    np.testing.assert_array_equal(recording.tools[0].rotation, TURNS[[0, 1, 1, 1]])
    names = {p.name.rpartition("_")[0] for p in (tmp_path / "vtk").iterdir()}
    assert names == {"wall", "tool_1", "contact_1", "contact_2"}
    assert [given.rest["s"][tool.nearest[1]] for tool in recording.tools] == [20.0, 36.0]


def test_a_tool_without_a_volume_is_drawn_thin(tmp_path):
    """A plate of four corners has no hull of its own."""
    corners = np.array([[-2.0, -2, 2, 2], [0, 0, 0, 0], [-3, 3, -3, 3]])
    plate = Shape(jnp.asarray(corners), jnp.asarray(0.0))
    recording = recording_of(stored(tool=plate))
    vertices = recording.tools[0].triangles.vertices
    np.testing.assert_allclose(np.ptp(vertices, axis=0), [4.1, 0.1, 6.1], atol=1e-9)
    write_glb(tmp_path / "a.glb", recording)
    assert len(trimesh.load(tmp_path / "a.glb", process=False).geometry) == 2


def test_what_has_no_surface_is_refused():
    with pytest.raises(NoSurface, match=r"has no surface; .*surface = true"):
        recording_of(stored(rest=None))
    with pytest.raises(NoSurface, match="no solved row"):
        recording_of(stored(solved=(False,) * ROWS))
    with pytest.raises(ValueError, match="vtk needs surface = true"):
        OutputSection(vtk=True, surface=False)
