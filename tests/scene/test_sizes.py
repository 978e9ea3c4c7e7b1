"""A tube of any size: a scene and the same one ten times smaller; a wall that is no tube."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_scenes import BALL, SPRINGS, TUBE, ball, bend, on_arc, poses

from jaxtrachea import EffectOptions, Poses, make_scene, simulate
from jaxtrachea.config import SpecError
from jaxtrachea.contact.shapes import sphere
from jaxtrachea.scene import wall
from jaxtrachea.scene.build import stage
from jaxtrachea.scene.spec import SceneSpec
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.mesh import MeshError
from jaxtrachea.trachea.tube import make_tube

SMALL = 0.1
#: Powers of a length in the values of `SPRINGS`, where forces are as its square.
POWERS = {"EI_L": 4, "EA_L": 2, "k_M": 1, "k_1": 1, "k_3": -1}
run = jax.jit(simulate, compiler_options={"xla_backend_optimization_level": 0})


def pressed(size):
    """Table 1 times `size`, bent, and all with it, under a ball: the scene and the result."""
    lengths = {n: size * getattr(TUBE, n) for n in ("length", "ring_positions", "radius")}
    tube = dataclasses.replace(TUBE, ring_height=size * TUBE.ring_height, **lengths)
    values = {n: size**power * getattr(SPRINGS, n) for n, power in POWERS.items()}
    material = dataclasses.replace(SPRINGS, **values)
    mesh = bend(make_tube(tube, around=24, along=60, wall=2.6 * size), 300 * size)
    tube = dataclasses.replace(tube, radius=tube.radius + 1.3 * size)
    path = ball([75, 0.5, 0], [75, -2.5, 0], 3)
    (centre, frame), off = on_arc(75.0, 300.0), np.asarray(path.translation) - [75, 0, 0]
    path = Poses(np.tile(frame, (3, 1, 1)), centre + off @ frame.T)
    path = dataclasses.replace(path, translation=size * path.translation)
    effects = EffectOptions(
        onset_width=1e-3 * size, want_joints=False, want_ring_ends=False, dent="16"
    )
    tool = sphere(5.0 * size)
    scene = make_scene(tube, material, path, tool=tool, mesh=mesh, effects=effects)
    return scene, run(scene, material, path)


@pytest.mark.slow
@pytest.mark.compiling
def test_a_small_tube_is_pressed_as_a_large_one():
    """By similarity: forces as the square of a length, all lengths as a length.

    An EI in N mm^2 goes as its fourth power, k_3 as its inverse. In float64; roundings of patches,
    which are cut anew, are the most that is left.
    """
    (scene, one), (scaled, small) = (pressed(size) for size in (1.0, SMALL))
    assert one.status.tolist() == [PressStatus.NO_CONTACT, PressStatus.OK, PressStatus.OK]
    np.testing.assert_array_equal(small.status, one.status)
    assert np.abs(one.force[-1, 1]) > 0.1
    np.testing.assert_allclose(small.force / SMALL**2, one.force, rtol=0, atol=1e-7)
    for name in ("gap", "depth", "s"):
        np.testing.assert_allclose(
            getattr(small, name) / SMALL, getattr(one, name), rtol=0, atol=1e-6, err_msg=name
        )
    np.testing.assert_allclose(scaled.footprint / SMALL, scene.footprint, rtol=1e-12)
    np.testing.assert_allclose(scaled.radius / SMALL, scene.radius, rtol=1e-12)
    assert scene.plan.dent == 16
    np.testing.assert_allclose(small.vertices / SMALL, one.vertices, rtol=0, atol=1e-6)


@pytest.mark.long
def test_table_1_has_its_own_lengths():
    """Those that every size had before."""
    scene = make_scene(TUBE, SPRINGS, poses([75, 19, 0], [75, 17, 0]), tool=BALL,
                       effects=EffectOptions(want_surface=False))  # fmt: skip
    assert float(scene.footprint) == 4.0
    assert float(scene.radius) == 11.3 + 1.3
    assert wall.wall_check.overlap_of(TUBE) == 0.5
    same = make_tube(TUBE, relief=0.6)
    np.testing.assert_array_equal(make_tube(TUBE).vertices, same.vertices)
    lying = np.asarray(make_tube(TUBE, wall=1.3, flatten=0.0).distance)
    np.testing.assert_allclose([lying.min(), lying.max()], [11.65, 11.95], rtol=1e-12)


#: A newborn mouse's, by a scene file.
MOUSE = {
    "trachea": {
        "length": "8 mm", "rings": {"count": 8, "first": "0.5 mm", "last": "7.5 mm"},
        "radius": "0.6 mm", "ring_height": "0.5 mm", "wall": "0.1 mm",
    },
    "material": {"EI_L": "0.01 N mm^2", "k_M": "0.1 N/mm", "k_1": "0.3 N/mm", "k_3": "0.02 N/mm^3"},
    "tool": {"shape": "sphere", "radius": "0.4 mm"},
    "path": {"start": ["4 mm", "1.6 mm", "0 mm"], "end": ["4 mm", "0.9 mm", "0 mm"]},
    "output": {"surface": False},
}  # fmt: skip


def mouse(**keys):
    """The scene with keys of [trachea]."""
    return stage(SceneSpec.model_validate(MOUSE | {"trachea": MOUSE["trachea"] | keys}), Path())


@pytest.mark.slow
def test_a_mouse_has_a_tube():
    """Rings of 0.6 mm on a wall of 0.1 mm left radii of 0.04 to 0.65 mm, contacts 0.46 mm off."""
    staged = mouse()
    tube = staged.scene.geometry
    far = np.asarray(make_tube(tube, wall=0.1).distance)
    assert far.min() > 0.85 * 0.6  # the flat back
    assert far.max() == pytest.approx(0.65, rel=1e-12)
    (told,) = [note for note in staged.notes if note.startswith("contact gap")]
    assert "worst 0.012 mm (limit 0.075 mm)" in told
    smooth = mouse(relief="0 mm")
    assert float(smooth.scene.tube.filled.max()) < 1e-3


@pytest.mark.long
def test_a_wall_that_a_tool_would_not_touch_is_refused():
    """As that of an imported mesh, also from Python: rows were OK."""
    says = (
        r"^trachea: the tube: a tool would not touch it where it is: .* expected at most 0.019 and "
        r"0.075 mm .*; make trachea.relief smaller, so that its rings stand out less$"
    )
    with pytest.raises(SpecError, match=says):
        mouse(relief="0.6 mm")
    tube = Geometry.create(8.0, np.linspace(0.5, 7.5, 8), radius=0.6, ring_height=0.5)
    mesh, path = make_tube(tube, wall=0.1, relief=0.6), poses([4, 1.6, 0], [4, 0.9, 0])
    with pytest.raises(MeshError, match="^the tube: a tool would not .* make relief smaller"):
        make_scene(tube, SPRINGS, path, tool=sphere(0.4), mesh=mesh)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"trachea": MOUSE["trachea"] | {"relief": "-1 mm"}}, "relief"),
        ({"trachea": {"file": "a.stl", "relief": "1 mm"}}, "file excludes relief; remove one side"),
        (
            {"material": None, "wall": {}, "trachea": {"radius": "11.7 mm", "relief": "0 mm"}},
            "trachea.relief: the outside of deforming cross-sections is round; remove it",
        ),
    ],
)
def test_a_relief_that_cannot_be(change, says):
    with pytest.raises(ValueError, match=says):
        SceneSpec.model_validate(MOUSE | change)


@pytest.mark.slow
def test_a_tool_of_another_dtype_takes_that_of_the_tube():
    """A float64 tool made a float32 scene's results float64, on a mesh's wall a loop's fault."""
    path = ball([75, 0.5, 0], [75, -2.5, 0], 3)
    skeleton, material, path = jax.tree.map(
        lambda v: jnp.asarray(v, "float32"), (TUBE, SPRINGS, path)
    )
    mesh = make_tube(skeleton, around=9, along=40)
    scene = make_scene(skeleton, material, path, tool=sphere(5.0, "float64"), mesh=mesh)
    found = jax.eval_shape(simulate, scene, material, path)
    kinds = {v.dtype for v in jax.tree.leaves(found) if jnp.issubdtype(v.dtype, jnp.floating)}
    assert kinds == {jnp.dtype("float32")}
