"""A tool from a surface file: its corners, its unit, and bodies that are none."""

import json

import numpy as np
import pytest
import trimesh

from jaxtrachea.config import SpecError
from jaxtrachea.contact.shapes import box
from jaxtrachea.scene.build import stage
from jaxtrachea.scene.spec import SceneSpec, load_scene_spec
from jaxtrachea.scene.tool_file import MAX_CORNERS, read_tool
from jaxtrachea.trachea.mesh import MeshError

BOX = np.array([12.0, 6.0, 4.0])


@pytest.mark.parametrize("kind", ["stl", "ply", "obj"])
def test_a_box_has_its_corners(kind, tmp_path):
    """Subdivided, in cm and off its origin: eight corners in mm, where the file has them."""
    solid = trimesh.creation.box(BOX / 10).subdivide()
    solid.apply_translation([1.0, 0, 0])
    solid.export(tmp_path / f"box.{kind}")
    shape, note = read_tool(tmp_path / f"box.{kind}", "cm", 0.5)
    corners = np.array(np.meshgrid(*((-1, 1),) * 3)).reshape(3, -1).T * BOX / 2 + [10.0, 0, 0]
    found = np.asarray(shape.vertices).T
    order = np.lexsort(np.round(found, 3).T), np.lexsort(corners.T)
    np.testing.assert_allclose(found[order[0]], corners[order[1]], atol=1e-5)
    assert float(shape.radius) == 0.5
    assert note == "tool: 12 x 6 x 4 mm, 8 corners"


def test_a_round_body_keeps_the_corners_that_count(tmp_path):
    ball = trimesh.creation.icosphere(4, 5.0)
    ball.export(tmp_path / "ball.stl")
    shape, note = read_tool(tmp_path / "ball.stl", None, 0.0)
    found = np.asarray(shape.vertices).T
    assert len(found) <= MAX_CORNERS
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 5, rtol=1e-5)
    ways = np.random.default_rng(0).standard_normal((500, 3))
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    assert np.min(np.max(found @ ways.T, axis=0)) > 5 - 0.1
    assert "corners; those left out stand out of it by up to 0.08" in note


def jaws(*places, size=(2, 2, 10)):
    """Boxes with their middles on the x-axis."""
    made = [trimesh.creation.box(size) for _ in places]
    for jaw, x in zip(made, places, strict=True):
        jaw.apply_translation((x, 0, 0))
    return made


def joined(*solids):
    return trimesh.util.concatenate(list(solids))


def fork():
    """Two thin tines as long as a hand and what joins them, in one body."""
    outline = [[0, 0], [120, 0], [120, 1], [1, 1], [1, 11], [120, 11], [120, 12], [0, 12]]
    cap = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 7], [4, 5, 7], [5, 6, 7]]
    return trimesh.creation.extrude_triangulation(outline, cap, 1.0)


def inside_out():
    """A box with a box-shaped hole."""
    hole = trimesh.creation.box((1, 1, 1))
    hole.invert()
    return joined(trimesh.creation.box((4, 4, 4)), hole)


def test_bodies_apart_are_parts(tmp_path):
    """All corners are on the hull of both jaws, the gap between them is not."""
    joined(*jaws(3, -3)).export(tmp_path / "forceps.stl")
    shape, note = read_tool(tmp_path / "forceps.stl", None, 0.25)
    assert note == "tool: 8 x 2 x 10 mm, 2 convex parts, 16 corners"
    assert shape.vertices.shape == (2, 3, 8)
    np.testing.assert_array_equal(shape.radius, 0.25)
    middles = np.asarray(shape.vertices).mean(axis=2)
    np.testing.assert_allclose(middles[np.argsort(middles[:, 0])], [[-3, 0, 0], [3, 0, 0]])


def test_objects_that_touch_are_parts(tmp_path):
    """An L of two bricks by its objects, or all triangles in one."""
    foot, (leg,) = trimesh.creation.box((6, 2, 2)), jaws(2, size=(2, 6, 2))
    leg.apply_translation((0, 4, 0))
    trimesh.Scene({"foot": foot, "leg": leg}).export(tmp_path / "hook.glb")
    shape, note = read_tool(tmp_path / "hook.glb", None, 0.0)
    assert "2 convex parts" in note
    assert shape.vertices.shape == (2, 3, 8)
    joined(foot, leg).export(tmp_path / "hook.stl")
    soup, _ = read_tool(tmp_path / "hook.stl", None, 0.0)
    assert sorted(map(corners, soup.vertices)) == sorted(map(corners, shape.vertices))


def corners(part):
    return sorted(map(tuple, np.asarray(part).T.round(5).tolist()))


def test_bricks_that_share_faces_are_parts(tmp_path):
    """A T of four: the middle has faces in common with three others, also its diagonals."""
    places = np.array([[0, 0, 0], [-1, 0, 0], [1, 0, 0], [0, 1, 0]])
    bricks = [trimesh.creation.box((1, 1, 1)) for _ in places]
    for brick, place in zip(bricks, places, strict=True):
        brick.apply_translation(place)
    joined(*bricks).export(tmp_path / "tee.stl")
    shape, note = read_tool(tmp_path / "tee.stl", None, 0.0)
    assert "4 convex parts, 32 corners" in note
    expected = [corners(np.asarray(brick.vertices).T) for brick in bricks]
    assert sorted(map(corners, shape.vertices)) == sorted(expected)


@pytest.mark.parametrize(
    ("solid", "says"),
    [
        (lambda: trimesh.creation.annulus(3, 5, 2), "^it is not convex: .*cut it into convex"),
        (fork, "^it is not convex: its volume is .* mm.3, that of its hull"),
        (
            lambda: joined(trimesh.creation.annulus(3, 5, 2), *jaws(9)),
            "body 0 is not convex: its surface lies .* mm and more inside of its hull",
        ),
        (inside_out, "body 1 is inside out, other bodies are not"),
        (lambda: joined(*jaws(*range(0, 132, 4))), "33 bodies; expected at most 32 convex parts"),
        (lambda: trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]), "it is flat"),
    ],
)  # fmt: skip
def test_what_is_no_tool(solid, says, tmp_path):
    solid().export(tmp_path / "tool.stl")
    with pytest.raises(MeshError, match=says):
        read_tool(tmp_path / "tool.stl", None, 0.0)


SCENE = {
    "title": "a probe",
    "material": {"EI_L": "10 N mm^2", "k_M": "0.1 N/mm", "k_1": "1 N/mm", "k_3": "0.01 N/mm^3"},
    "path": [{"start": ["75 mm", "30 mm", "0 mm"], "end": ["75 mm", "14 mm", "0 mm"], "steps": 3}],
}


@pytest.mark.long
def test_a_scene_takes_it(tmp_path):
    trimesh.creation.box(BOX).export(tmp_path / "probe.stl")
    tool = {"shape": "mesh", "file": "probe.stl"}
    staged = stage(SceneSpec.model_validate(SCENE | {"tool": tool}), tmp_path)
    found, expected = (np.asarray(v.vertices) for v in (staged.scene.tool, box(BOX / 2)))
    np.testing.assert_array_equal(found[:, np.lexsort(found)], expected[:, np.lexsort(expected)])
    assert "tool: 12 x 6 x 4 mm, 8 corners" in staged.notes
    assert tmp_path / "probe.stl" in staged.files


@pytest.mark.parametrize(
    ("tool", "says"),
    [
        ({"file": "none.stl"}, "^tool.file"),
        ({"file": "probe.stl", "unit": "kg"}, "^tool.unit"),
    ],
)
def test_a_bad_key_is_named(tool, says, tmp_path):
    trimesh.creation.box(BOX).export(tmp_path / "probe.stl")
    spec = SceneSpec.model_validate(SCENE | {"tool": {"shape": "mesh"} | tool})
    with pytest.raises(SpecError, match=says):
        stage(spec, tmp_path)


@pytest.mark.long
def test_parts_stand_where_the_scene_says(tmp_path):
    """A ball and a box from a file, turned by 90 degrees about x: its z is the tool's -y."""
    trimesh.creation.box(BOX).export(tmp_path / "probe.stl")
    ball = {"shape": "sphere", "radius": "2 mm", "position": ["-9 mm", "0 mm", "0 mm"]}
    turned = {"rotation": ["90 deg", "0 deg", "0 deg"], "position": ["0 mm", "1 mm", "0 mm"]}
    parts = [ball, {"shape": "mesh", "file": "probe.stl"} | turned]
    staged = stage(SceneSpec.model_validate(SCENE | {"tool": {"parts": parts}}), tmp_path)
    tool = staged.scene.tool
    np.testing.assert_array_equal(tool.radius, [2, 0])
    np.testing.assert_array_equal(tool.counts.sum(axis=1), [1, 8])
    np.testing.assert_array_equal(tool.vertices[0], np.tile([[-9.0], [0], [0]], 8))
    reach = np.asarray(tool.vertices[1])
    np.testing.assert_allclose(reach.max(axis=1), [6, 3, 3], atol=1e-12)
    np.testing.assert_allclose(reach.min(axis=1), [-6, -1, -3], atol=1e-12)
    assert "tool: 12 x 6 x 4 mm, 8 corners" in staged.notes


BALL = {"shape": "sphere", "radius": "2 mm"}


def toml(value):
    """A value on one line."""
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{k} = {toml(v)}' for k, v in value.items())} }}"
    if isinstance(value, list):
        return f"[{', '.join(map(toml, value))}]"
    return json.dumps(value)


@pytest.mark.parametrize(
    ("tool", "says"),
    [
        ({}, "tool: shape: missing; expected one of sphere, .*, or parts"),
        ({"parts": []}, "tool.parts: expected at least 1 item"),
        ({"parts": [BALL] * 33}, "tool.parts: expected at most 32 items"),
        ({"parts": [BALL], "shape": "sphere", "radius": "1 mm"}, "parts: not together with shape"),
        ({"parts": [BALL], "radius": "1 mm"}, "tool: radius: of a shape, and parts have their own"),
        ({"parts": [BALL, {}]}, "tool.parts.1: shape: missing"),
        ({"parts": [BALL | {"friction": 0.3}]}, "tool.parts.0.friction: unknown key"),
        ({"parts": [BALL | {"position": ["1 mm"]}]}, "tool.parts.0.position: .* 3 items"),
    ],
)
def test_bad_parts_are_named(tool, says, tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text("\n".join(f"{k} = {toml(v)}" for k, v in (SCENE | {"tool": tool}).items()))
    with pytest.raises(SpecError, match=says):
        load_scene_spec(path)


def test_a_bad_file_of_a_part_is_named(tmp_path):
    parts = [BALL, {"shape": "mesh", "file": "none.stl"}]
    with pytest.raises(SpecError, match=r"^tool\.parts\.1\.file"):
        stage(SceneSpec.model_validate(SCENE | {"tool": {"parts": parts}}), tmp_path)
