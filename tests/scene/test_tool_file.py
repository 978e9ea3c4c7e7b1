"""A tool from a surface file: its corners, its unit, and bodies that are none."""

import numpy as np
import pytest
import trimesh

from jaxtrachea.config import SpecError
from jaxtrachea.contact.shapes import box
from jaxtrachea.scene.build import stage
from jaxtrachea.scene.spec import SceneSpec
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


def forceps():
    """Two jaws: all corners are on the hull, the gap between them is not."""
    jaws = [trimesh.creation.box((2, 2, 10)) for _ in range(2)]
    for jaw, x in zip(jaws, (3, -3), strict=True):
        jaw.apply_translation((x, 0, 0))
    return trimesh.util.concatenate(jaws)


@pytest.mark.parametrize(
    ("solid", "says"),
    [
        (forceps, "it is not convex: its surface lies .* mm and more inside of its hull"),
        (lambda: trimesh.creation.annulus(3, 5, 2), "cut it into convex parts"),
        (lambda: trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]), "it is flat"),
    ],
)
def test_what_is_no_convex_body(solid, says, tmp_path):
    solid().export(tmp_path / "tool.stl")
    with pytest.raises(MeshError, match=says):
        read_tool(tmp_path / "tool.stl", None, 0.0)


SCENE = {
    "title": "a probe",
    "material": {"EI_L": "10 N mm^2", "k_M": "0.1 N/mm", "k_1": "1 N/mm", "k_3": "0.01 N/mm^3"},
    "path": [{"start": ["75 mm", "30 mm", "0 mm"], "end": ["75 mm", "14 mm", "0 mm"], "steps": 3}],
}


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
