"""Pictures of a scene: solids against closed forms, and what a figure says against its numbers."""

import itertools
import pathlib
import re

import numpy as np
import pytest
from matplotlib.text import Text

from jaxtrachea.contact.shapes import box, capsule, sphere
from jaxtrachea.notebook import of_scene, of_simulation
from jaxtrachea.output.plots import draw_series
from jaxtrachea.output.solids import crossings, tool_distance, tool_triangles
from jaxtrachea.output.surface_plot import draw_rest, draw_surface
from jaxtrachea.scene.build import stage
from jaxtrachea.scene.simulation import Simulation
from jaxtrachea.scene.spec import load_scene_spec
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.mesh import volume

pytestmark = pytest.mark.long

CONFIGS = pathlib.Path(__file__).parents[2] / "configs"
R, H = 5.0, 10.0
SOLIDS = {
    "sphere": (sphere(R), 4 / 3 * np.pi * R**3),
    "capsule": (capsule(H, R), 4 / 3 * np.pi * R**3 + np.pi * R**2 * 2 * H),
    "box": (box([2.0, 3.0, 4.0]), 8 * 24.0),
}


@pytest.mark.parametrize("name", SOLIDS)
def test_tool_is_its_solid(name):
    shape, exact = SOLIDS[name]
    mesh = tool_triangles(shape)
    # Inside the ball by 1 - cos(half the angle between 600 directions): 0.5 % of its volume.
    assert exact * 0.98 < volume(*mesh) <= exact * (1 + 1e-12)
    # On the surface of its own distance.
    assert np.abs(tool_distance(shape, mesh.vertices)).max() < 0.02


def test_distance_from_a_box():
    x = np.array([[5.0, 0, 0], [0, 0, -9.0], [5, 7, 0], [0, 2, 0]])
    expected = [3.0, 5.0, 5.0, -1.0]
    np.testing.assert_allclose(tool_distance(SOLIDS["box"][0], x), expected, atol=0.05)


def test_a_section_of_a_ball_is_a_circle():
    mesh = tool_triangles(sphere(R), 5000)
    cut = crossings(mesh.faces, mesh.vertices[:, 2], 3.0).at(mesh.vertices)
    np.testing.assert_allclose(cut[..., 2], 3.0, atol=1e-12)
    np.testing.assert_allclose(np.hypot(cut[..., 0], cut[..., 1]), 4.0, atol=0.02)
    length = np.linalg.norm(cut[:, 1] - cut[:, 0], axis=1).sum()
    assert length == pytest.approx(2 * np.pi * 4, rel=5e-3)


@pytest.fixture(scope="module", params=["normal", "off_midline"])
def shown(request):
    """A scene, its path, and a simulation made by hand: all of the surface moved by 2 mm."""
    path = CONFIGS / f"{request.param}.toml"
    scene, _, motion, _, _ = stage(load_scene_spec(path), path.parent)
    rows, phi = 3, 0.0 if request.param == "normal" else 0.698
    zero, inward = np.zeros((rows, 3)), np.array([0, -np.cos(phi), -np.sin(phi)])
    size = np.array([0.0, 0.2, 0.4])[:, None]
    assert scene.mesh is not None
    lift = np.array([0.0, 0.0, 2.0])[:, None, None] * inward
    out = Simulation(
        s=np.full(rows, 75.0), phi=np.full(rows, phi), gap=np.array([1.0, -1, -3]),
        displacement=zero, force=size * inward, moment=None, depth=2 * size * inward,
        skeleton=5 * size * inward, joints=np.zeros((rows, 15, 3)), loads=None, end_U=None,
        end_V=None, slip=None, dissipated=None, frame=None,
        vertices=np.asarray(scene.mesh.vertices) + lift, depth_share=np.zeros(rows),
        contact_share=None, status=np.array([1, 0, 0]),
    )  # fmt: skip
    if hasattr(motion, "translation"):
        motion = type(motion)(motion.rotation[-rows:], motion.translation[-rows:])
    else:
        motion = type(motion)(motion.s[:rows], motion.phi[:rows], motion.displacement[:rows])
    return scene, motion, out


def texts(figure):
    return [t for t in figure.findobj(Text) if t.get_text().strip()]


def test_picture_says_force_unit_and_scale(shown):
    figure = draw_surface(*shown, 2, "A press")
    figure.draw_without_rendering()
    words = [t.get_text() for t in texts(figure)]
    for expected in ("0.4 N", "10 mm", "to the larynx", "anterior", "displacement of the wall [mm]",
                     "contact point", "rings", "A press"):  # fmt: skip
        assert expected in words, expected
    # On the midline, which is hidden behind a tube that is pressed at its side.
    assert ("joints" in words) == (abs(float(shown[2].phi[2])) < 0.5)
    assert any("row 3 of 3: 0.4 N; the wall has moved by up to 2 mm" in w for w in words)
    assert ("tool" in words) == (shown[0].tool is not None)
    for axis in figure.axes[1:3]:
        assert "[mm]" in axis.get_xlabel()
        assert "[mm]" in axis.get_ylabel()
    scale = figure.axes[3].get_xlim()
    np.testing.assert_allclose(scale, (0, 2))


def test_nothing_overlaps(shown):
    for figure in (draw_surface(*shown, 2, "A press"), draw_series(*shown)):
        figure.draw_without_rendering()
        boxes = [
            (t.get_text(), t.get_window_extent().padded(-1))
            for t in texts(figure)
            if t.get_visible() and not re.fullmatch(r"[−\d.]+", t.get_text())  # no numbers of axes
        ]
        for (a, first), (b, second) in itertools.combinations(boxes, 2):
            assert not first.overlaps(second), (a, b)


def test_a_notebook_shows_a_scene_and_its_forces(shown):
    """The plan with its reasons and the tube at rest; normal force over the rows."""
    scene, _, out = shown
    figure = draw_rest(scene)
    figure.draw_without_rendering()
    words = [t.get_text() for t in texts(figure)]
    assert {"10 mm", "to the larynx", "anterior"} <= set(words)
    text = of_scene(scene)
    assert "<td>skeleton</td>" in text
    for page in (text, of_simulation(out)):
        assert page.count('<img src="data:image/png;base64,') == 1


def test_no_contact_is_told_in_words(shown):
    figure = draw_surface(*shown, 0, "Nothing touches")
    words = [t.get_text() for t in texts(figure)]
    assert any("does not touch, so there is no force" in w for w in words)
    assert not any(re.search(r"\d N$", w) for w in words)


def test_series_marks_rows_by_status(shown):
    scene, path, out = shown
    status = np.array([1, 0, int(PressStatus.OFF_TUBE)])
    force = np.where(status[:, None] == PressStatus.OFF_TUBE, np.nan, out.force)
    figure = draw_series(scene, path, out._replace(status=status, force=force))
    words = [t.get_text() for t in figure.axes[0].get_legend().get_texts()]
    assert {"ok (1 rows)", "no contact (1 rows)", "off tube (1 rows)"} <= set(words)
    assert all(a.get_xlabel().endswith("[mm]") for a in figure.axes)
