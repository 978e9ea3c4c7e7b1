"""What XLA makes of the contact, which runs at every pose: kernels, loops and `reduce-window`.

Counted in the optimised program, compiled with a user's flags: hence in a process of its own, since
conftest.py sets others. No time is measured. A kernel is an instruction that runs by itself; those
in the loop count once for each of its rounds.
"""

import json
import math
import os
import re
import subprocess
import sys
from importlib.metadata import version

import pytest
from kernels import ONE, computations, count_kernels

from jaxtrachea.fusion import SUPPORTED_JAXLIB

#: Kernels of a single contact, value and with gradient, jaxlib 0.10.2: of a ball on the round tube,
#: of a box on patches of 120 corners. Before sums were written out: 697, 716, 1,030 and 1,048. The
#: margin is for other versions of XLA and other processors.
MOST = {"round": (512, 531), "corners": (797, 822)}
MARGIN = 1.15
#: Largest array, in bytes, of programs that XLA for CPUs runs in order: with a larger one it keeps
#: a graph and a queue, and a contact on the round tube takes 1.5 times as long.
IN_ORDER = 512
#: Largest array of both programs of `MOST`, bytes: of the mesh one number (the height along a
#: direction) for each of the 120 corners of its 16 patches, in float64. Not all three coordinates.
LARGEST = {"round": IN_ORDER, "corners": 16 * 120 * 8}

PROGRAM = """
import json, sys
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_enable_x64", True)
from jaxtrachea.contact.patches import straight_patches, touch
from jaxtrachea.contact.pose import pose_from_vector
from jaxtrachea.contact.shapes import Shape, box, sphere
import dataclasses

borders = np.r_[0.0, np.arange(10, 151, 10), 160.0]
tube, near, tool = straight_patches(borders, 12.6), 2, sphere(5.0)
if sys.argv[1] == "corners":
    turn = np.arange(60) * (2 * np.pi / 60)
    ring = [np.tile(12 * f(turn), 2) for f in (np.cos, np.sin)]
    x = np.repeat(np.stack([borders[:-1], borders[1:]], 1), 60, axis=1)
    vertices = np.stack([np.stack([row, *ring]) for row in x])
    shapes = Shape(jnp.asarray(vertices), jnp.full(16, 0.6))
    tube, tool = dataclasses.replace(tube, shapes=shapes), box([2.0, 1.5, 4.0], 0.3)

def contact(v):
    seen = touch(tool, pose_from_vector(v[:3], v[3:]), tube, near=near)
    return seen.gap, seen

texts = []
for f in (contact, jax.value_and_grad(contact, has_aux=True)):
    texts.append(jax.jit(f).lower(jnp.asarray([0.1, 0.2, 0.3, 73, 15.6, 0])).compile().as_text())
print(json.dumps(texts))
"""


@pytest.mark.slow
@pytest.mark.parametrize("tube", list(MOST))
def test_the_contact_starts_few_kernels(tube):
    environment = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
    run = subprocess.run(
        [sys.executable, "-c", PROGRAM, tube], capture_output=True, text=True, env=environment
    )
    assert run.returncode == 0, run.stderr
    for text, most in zip(json.loads(run.stdout), MOST[tube], strict=True):
        # More than 32 entries in one reduction: it would fuse with nothing and run scalar.
        assert "reduce-window(" not in text
        started, loops = count_kernels(text)  # refuses a loop without a known number of rounds
        assert loops == text.count("known_trip_count") == 1
        # The count finds what it counts: twelve rounds of a loop are the larger part of it.
        assert started > 100
        assert started <= MARGIN * most, f"{started} kernels"
        assert largest_array(text) <= LARGEST[tube], f"{largest_array(text)} bytes"


UPDATE = """
import json
import jax, jax.numpy as jnp
jax.config.update("jax_enable_x64", True)
from jaxtrachea import EffectOptions, Material, Poses, make_scene, simulate, table_1
from jaxtrachea.contact.shapes import sphere
from jaxtrachea.trachea.tube import make_tube

geometry, material = table_1(), Material(EI_L=1.862, k_M=0.1, k_1=0.3, k_3=0.02)
material = jax.tree.map(jnp.asarray, material)
path = Poses(jnp.eye(3)[None], jnp.asarray([[73.0, 15.6, 0.0]]))
shown = EffectOptions(dent="16", want_surface=True)
scene = make_scene(
    geometry, material, path, tool=sphere(5.0), mesh=make_tube(geometry), effects=shown
)

def update(place):
    out = simulate(scene, material, Poses(path.rotation, place[None]))
    return out.force[0], out.vertices[0]

def moved(place):
    force, vertices = update(place)
    return force[1] + jnp.mean((vertices - scene.mesh.vertices) ** 2)

programs = update, jax.value_and_grad(moved)
print(json.dumps([jax.jit(f).lower(path.translation[0]).compile().as_text() for f in programs]))
"""


@pytest.mark.slow
def test_the_whole_update_of_one_pose():
    """Contact, skeleton, surface and dent: no `reduce-window`, small parts as one kernel each.

    So it is with the gradient, in which what goes back is a call of its own.
    """
    environment = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
    run = subprocess.run(
        [sys.executable, "-c", UPDATE], capture_output=True, text=True, env=environment
    )
    assert run.returncode == 0, run.stderr
    value, gradient = json.loads(run.stdout)
    assert "reduce-window(" not in value
    called, back = (
        [v for v in text.split("\n") if " call(" in v and 'inlineable="false"' in v]
        for text in (value, gradient)
    )
    # The contact, the skeleton, and where the dent reaches, which has no derivatives.
    assert len(called) == 3
    assert len(back) == 3 + 2
    if version("jaxlib") in SUPPORTED_JAXLIB:
        assert sum(ONE in v for v in called) == 3
        # Without one kernel for a part 1,163, and with the gradient 1,834; with one for each of
        # the parts that gained less than 1.3 by it (docs/evidence/measured.md) 45 and 182.
        assert count_kernels(value, inside=False)[0] <= MARGIN * 83
        assert count_kernels(gradient, inside=False)[0] <= MARGIN * 433


STEP = """
import json
import jax
jax.config.update("jax_enable_x64", True)
from pathlib import Path
from jaxtrachea.scene.build import stage
from jaxtrachea.scene.session import Session
from jaxtrachea.scene.spec import SceneSpec
from jaxtrachea.tradeoff.levels import BUILT_IN, full_scene

spec = SceneSpec.model_validate(BUILT_IN)
full = full_scene(spec, stage(spec, Path()), coupling="series")
print(json.dumps(Session(full.scene, full.material)._program._run.as_text()))
"""


@pytest.mark.slow
def test_a_step_of_a_session_is_one_kernel_but_for_the_surface():
    """Contact, anchor, skeleton, force, what is packed: 1,042 kernels with the surface before."""
    environment = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
    run = subprocess.run(
        [sys.executable, "-c", STEP], capture_output=True, text=True, env=environment
    )
    assert run.returncode == 0, run.stderr
    text = json.loads(run.stdout)
    if version("jaxlib") in SUPPORTED_JAXLIB:
        assert count_kernels(text, inside=False)[0] <= MARGIN * 43


def largest_array(text: str) -> int:
    """Bytes of the largest array that an instruction outside of a fusion gives."""
    bodies = computations(text)[1]
    outside = [line for name, body in bodies.items() if "fused" not in name for _, line in body]
    found = re.findall(r"= \(?[a-z]+(\d*)\[([\d,]*)\]", "\n".join(outside))
    assert len(found) == len(outside)
    shapes = [(int(bits or 8), [int(v) for v in shape.split(",") if v]) for bits, shape in found]
    return max(math.prod(shape) * bits // 8 for bits, shape in shapes)


@pytest.mark.slow
def test_the_count_of_kernels():
    """By hand: 2 + 3 rounds of (1 + 1) + the reduction in a call."""
    text = """
%step (p: f64[2]) -> f64[2] {
  %p = f64[2]{0} parameter(0)
  ROOT %f = f64[2]{0} fusion(%p), kind=kLoop, calls=%c
}

%ahead (p: f64[2]) -> pred[] {
  ROOT %w = pred[] fusion(%p), kind=kLoop, calls=%c
}

%inner (p: f64[2]) -> f64[] {
  ROOT %r = f64[] reduce(%p, %z), dimensions={0}, to_apply=%add
}

ENTRY %main (v: f64[2]) -> f64[] {
  %v = f64[2]{0} parameter(0)
  %a = f64[2]{0} fusion(%v), kind=kLoop, calls=%c
  %b = f64[2]{0} copy(%a)
  %l = (f64[2], /*i*/f64[]) while(%b), condition=%ahead, body=%step, known_trip_count":{"n":"3"}
  ROOT %o = f64[] call(%l), to_apply=%inner
}
"""
    assert count_kernels(text) == (2 + 3 * 2 + 1, 1)
    # Where the call is one kernel the count is the same, unless what is inside does not count.
    text = text.replace("/*i*/", "").replace("ROOT %r", "%s = f64[2]{0} copy(%p)\n  ROOT %r")
    text = text.replace(
        "to_apply=%inner", 'to_apply=%inner, attributes={xla_cpu_small_call="true"}'
    )
    assert count_kernels(text) == (2 + 3 * 2 + 2, 1)
    assert count_kernels(text, inside=False) == (2 + 3 * 2 + 1, 1)


@pytest.mark.slow
def test_branches_and_a_loop_without_a_count():
    """Five rounds of (1 + 1), and the longer of two branches; without the five no number."""
    text = """
%step (p: f64[]) -> f64[] {
  ROOT %f = f64[] fusion(%p), kind=kLoop, calls=%c
}

%two (p: f64[]) -> f64[] {
  %g = f64[] fusion(%p), kind=kLoop, calls=%c
  ROOT %f = f64[] fusion(%g), kind=kLoop, calls=%c
}

ENTRY %main (v: f64[]) -> f64[] {
  %v = f64[] parameter(0)
  %l = f64[] while(%v), condition=%step, body=%step, known_trip_count":{"n":"5"}
  ROOT %o = f64[] conditional(%i, %l, %v), branch_computations={%step, %two}
}
"""
    assert count_kernels(text) == (5 * 2 + 2, 1)
    with pytest.raises(ValueError, match="loops without a fixed number of rounds"):
        count_kernels(text.replace("known_trip_count", ""))
    with pytest.raises(ValueError, match="no ENTRY"):
        count_kernels("nothing")
