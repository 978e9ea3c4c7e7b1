"""Arguments of a wrong length or kind are refused by name; a number is the array it stands for."""

import functools
import inspect
import json
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from admitted import BEAM, FULL, VALUES

from jaxtrachea.mechanics import beam
from jaxtrachea.mechanics.friction import Coulomb
from jaxtrachea.mechanics.oblique import ObliqueOptions, press_oblique, press_path
from jaxtrachea.mechanics.press import press
from jaxtrachea.mechanics.skeleton import skeleton_response
from jaxtrachea.scene.assemble import make_scene
from jaxtrachea.scene.effects import EffectOptions
from jaxtrachea.scene.simulation import simulate
from jaxtrachea.scene.stage import Poses, Presses
from jaxtrachea.scene.sweep import sweep
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.geometry import Geometry, table_1
from jaxtrachea.trachea.material import Material

pytestmark = pytest.mark.compiling


@pytest.mark.slow
def test_python_numbers():
    """Numbers, integers, lists and numpy arrays are the arrays they stand for, in both dtypes."""
    run = jax.jit(lambda *arguments: press(*arguments))  # a cache of its own: counted below
    for dtype in (jnp.float64, jnp.float32):
        g = table_1(dtype=dtype)
        arrays = Material(**{n: jnp.asarray(v, dtype) for n, v in VALUES.items()})
        exact = run(g, arrays, jnp.asarray(40, dtype), jnp.asarray([1, 2], dtype))
        for s, D, onset in ((40.0, [1.0, 2.0], 0.0), (40, (1, 2), None), (np.int64(40), [1, 2], 0),
                            (np.float32(40), np.array([1, 2]), None)):  # fmt: skip
            m = Material(**VALUES)
            got = jax.eval_shape(functools.partial(press, g, m, s, D, onset=onset))
            assert (got.force.shape, got.force.dtype) == ((2,), dtype)
        got = jax.jit(lambda g=g: press(g, Material(**VALUES), 40, [1, 2]))()
        for a, b in zip(got, exact, strict=True):
            np.testing.assert_allclose(a, b, rtol=50 * jnp.finfo(dtype).eps)
    one = jax.jit(lambda: press(table_1(), Material(2, 1, 1, 0), 40, 2))()
    assert (one.force.shape, one.force.dtype) == ((), jnp.float64)
    for k in range(3):  # one program for every new number
        run(table_1(), Material(2.0 + k, 1.0, 1.0, 0.0), 40.0 + k, 2.0)
    assert run._cache_size() == 3
    path = functools.partial(
        press_path, table_1(), Material(**FULL), 40, 0, [[0, -1, 0]], Coulomb(1)
    )
    assert jax.eval_shape(path).press.force.shape == (1, 3)
    assert Geometry(160, [20, 40], 11, 2, 4).ring_positions.dtype == jnp.float64
    deflect = jax.jit(lambda: (beam.deflect(BEAM, 2, 1).w_C, beam.contact_compliance(BEAM, [2, 4])))
    w_C, compliance = deflect()
    np.testing.assert_allclose(compliance[0], w_C, rtol=1e-13)


PLAIN = {"s_c": 40.0, "displacement": 2.0}
WRONG = [
    ({"k_M": np.ones(14)}, PLAIN, "Material.k_M has 14 values; expected .* or 15 values .one for"),
    ({"EI_L": np.ones(15)}, PLAIN, "Material.EI_L has 15 values; .* 16 values .15 rings make 16"),
    ({"k_1": np.ones(15)}, PLAIN, "Material.k_1 has 15 values; expected no axis"),
    ({"GA_L": np.ones((2, 16))}, PLAIN, r"Material.GA_L has shape \(2, 16\); expected"),
    ({}, PLAIN | {"s_c": [1.0, 2.0]}, "s_c has 2 values; expected no axis .*jax.vmap"),
    ({}, PLAIN | {"onset": [1.0, 2.0]}, "onset has 2 values; expected no axis"),
    ({}, PLAIN | {"displacement": "2 mm"}, "displacement is '2 mm'; expected a number"),
    ({}, PLAIN | {"displacement": [[1.0], 2.0]}, "displacement is .* expected a number"),
    ({}, PLAIN | {"s_c": True}, "s_c is True; expected a number"),
]


def test_wrong_lengths():
    """Before anything is traced: the argument, its length and the expected one."""
    for values, arguments, says in WRONG:
        with pytest.raises(ValueError, match=f"^{says}"):
            press(table_1(), Material(**VALUES | values), **arguments)
    with pytest.raises(ValueError, match="k_M has 14 values"):
        jax.jit(press)(table_1(), Material(**VALUES | {"k_M": jnp.ones(14)}), 1.0, 1.0)


def test_wrong_lengths_elsewhere():
    g, m = table_1(), Material(**FULL)
    bad = Material(**FULL | {"EA_L": np.ones(3)})
    D = np.zeros((2, 3))
    path = Presses([40.0, 50.0], [0.0, 0.0], [[0, -1, 0], [0, -2, 0]])
    scene = make_scene(g, m, path, effects=EffectOptions(want_surface=False))
    flat = jnp.zeros((2, 2))
    short = eqx.tree_at(lambda p: p.phi, path, jnp.zeros(3))
    narrow = eqx.tree_at(lambda p: p.displacement, path, flat)
    one_turn = eqx.tree_at(lambda p: p.rotation, Poses(np.zeros((2, 3, 3)), D), jnp.ones((1, 3, 3)))
    for says, call in {
        r"displacement has 2 values; expected shape \(..., 3\)":
            lambda: press_oblique(g, m, 40, 0, [1, 2]),
        r"displacement has 3 values; expected shape \(steps, 3\)":
            lambda: press_path(g, m, 40, 0, [0, 1, 2], Coulomb(0.5)),
        "phi_c has 2 values": lambda: press_oblique(g, m, 40, [0, 1], D),
        "friction is 'a'": lambda: press_path(g, m, 40, 0, D, Coulomb("a")),
        "rounding is -1": lambda: Coulomb(0.5, rounding=-1.0),
        "Material.EA_L has 3 values; expected .*16": lambda: skeleton_response(g, bad, 40, 0),
        "s_c has 3 values": lambda: skeleton_response(g, m, [1, 2, 3], 0),
        "path.phi has 3 values; expected 2":
            lambda: make_scene(g, m, short, effects=EffectOptions(want_surface=False)),
        "path.rotation has": lambda: make_scene(g, m, one_turn),
        "path.displacement has": lambda: simulate(scene, m, narrow),
        "Material.EA_L has 3 ": lambda: simulate(scene, bad, path),
        "phi has 1 value; expected 2 values .as s": lambda: sweep(scene, m, [1, 2], [0], [1, 1]),
        "k_M is 'soft'; expected a number": lambda: Material(1.0, "soft", 1.0, 0.0),
        "length is 'long'; expected numbers":
            lambda: inspect.unwrap(Geometry.create.__func__)(Geometry, "long", [1.0]),
        "ring_positions has shape": lambda: Geometry.create(9.0, np.ones((1, 2))),
        r"radius has shape \(2,\)":
            lambda: inspect.unwrap(Geometry.create.__func__)(Geometry, 9.0, [1.0], radius=[1, 2]),
        "s_c has shape": lambda: beam.contact_compliance(BEAM, np.ones((2, 2))),
        "ring_load has 2 values": lambda: beam.deflect(BEAM, 1, 1, ring_load=[1, 2]),
    }.items():  # fmt: skip
        with pytest.raises(ValueError, match=f"^{says}"):
            # Traced, what comes before the refusal is not compiled; a scene needs numbers.
            call() if says.startswith("path.") else jax.eval_shape(call)


#: Calls with what is no record of the right kind, and what is named.
NO_RECORDS = {
    "jt.press(None, m, 40.0, 1.0)": "geometry is None; expected Geometry",
    "jt.press(g, None, 40.0, 1.0)": "material is None; expected Material",
    "jt.press(g, {}, 40.0, 1.0)": "material is {}; expected Material",
    "jt.press(g, g, 40.0, 1.0)": "expected Material",
    "jt.press_oblique('x', m, 40.0, 0.0, [0, -1, 0])": "geometry is 'x'; expected Geometry",
    "jt.press_path(None, m, 40.0, 0.0, [[0, -1, 0]], jt.Coulomb(0.5))": "geometry is None",
    "jt.deflect(None, 40.0, 1.0)": "beam is None; expected Beam",
    "jt.contact_compliance(None, 40.0)": "beam is None; expected Beam",
    "jt.deflect(jt.Beam([], 9.0, [1.0], []), 4.0, 1.0)": "Beam.x has no values",
    "jt.make_scene(None, m, path)": "geometry is None",
    "jt.make_scene(g, None, path)": "material is None",
    "jt.make_scene(g, m, None)": "path is None; expected Presses or Poses",
    "jt.make_scene(g, m, path, tool='x')": "tool is 'x'; expected Tool or Shape or None",
    "jt.make_scene(g, m, path, mesh='x')": "mesh is 'x'; expected Mesh or None",
    "jt.make_scene(g, m, path, effects=None)": "effects is None; expected EffectOptions",
    "jt.Tool('x')": "tool.shape is 'x'; expected Shape or None",
    "make_tube(g, wall=None)": "wall is None; expected a finite number",
    "make_tube(g, relief='x')": "relief is 'x'; expected a finite number or None",
    "make_tube(g, around=3.5)": "around is 3.5; expected a whole number",
    "jt.simulate(None, m, path)": "scene is None; expected Scene",
    "jt.simulate(scene, m, 'x')": "path is 'x'; expected Presses or Poses",
    "jt.simulate(scene, None, path)": "material is None",
    "jt.sweep(None, m, [40.0], [0.0], [1.0])": "scene is None; expected Scene",
    "jt.sweep(scene, None, [40.0], [0.0], [1.0])": "material is None",
    "jt.sweep(scene, m, [40.0], [0.0], [1.0], chunk=0)": "chunk is 0; expected a whole number",
    "jt.sweep(scene, m, [40.0], [0.0], [1.0], chunk='x')": "chunk is 'x'; expected a whole number",
}


def test_what_is_no_record_is_named():
    """As users call, who have no checker of annotations in front of it."""
    code = """
import json, sys
import jaxtrachea as jt
from jaxtrachea.trachea.tube import make_tube
g, m = jt.table_1(), jt.Material(1.862, 0.1, 0.3, 0.02, EA_L=3.9, EI_C=13.0, k_t=0.4)
path = jt.Presses([40.0], [0.0], [[0, -1, 0]])
scene = jt.make_scene(g, m, path, effects=jt.EffectOptions(want_surface=False))
said = []
for call in json.load(sys.stdin):
    try:
        eval(call)
    except Exception as error:
        said.append(f"{type(error).__name__}: {error}")
    else:
        said.append("nothing")
print(json.dumps(said))
"""
    done = subprocess.run(
        [sys.executable, "-c", code], input=json.dumps(list(NO_RECORDS)),
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    for call, said in zip(NO_RECORDS, json.loads(done.stdout), strict=True):
        assert said.startswith(("ValueError: ", "InputError: ")), (call, said)
        assert NO_RECORDS[call] in said, (call, said)


@pytest.mark.slow
def test_a_value_that_would_be_ignored_is_refused():
    """Whatever presses: with the value that it needs it is taken, without it is an error."""
    name, other = "k_3_ring", "k_1_ring"
    given = {"EI_L": 1.9, "k_M": 0.1, "k_1": 0.3, "k_3": 0.02, name: 0.5}
    g, D = table_1(), [0.0, -1.0, 0.0]
    path = Presses(jnp.full(1, 40.0), jnp.zeros(1), jnp.asarray([D]))
    plain = Material(**{k: v for k, v in given.items() if k != name})
    scene = make_scene(g, plain, path, effects=EffectOptions(want_surface=False))
    alone = Material(**given)
    for run in (
        lambda m: press(g, m, 40.0, 1.0),
        lambda m: press_oblique(g, m, 40.0, 0.0, D, ObliqueOptions(rings="mat", axial=False)),
        lambda m: make_scene(g, m, path, effects=EffectOptions(want_surface=False)),
        lambda m: simulate(scene, m, path),
        lambda m: sweep(scene, m, [40.0], [0.0], [1.0]),
    ):
        with pytest.raises(ValueError, match=f"Material.{name}: given without Material.{other}"):
            run(alone)
    assert press(g, Material(**given, **{other: 0.9}), 40.0, 1.0).status == PressStatus.OK
