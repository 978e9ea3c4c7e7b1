"""Public functions called without `jit`: one program each, compiled once and not at every call."""

import contextlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxtrachea as jt
from jaxtrachea.contact.distance import signed_distance, track
from jaxtrachea.contact.pose import pose_from_vector
from jaxtrachea.contact.shapes import box, sphere
from jaxtrachea.mechanics.press import compliance
from jaxtrachea.trachea.tube import make_tube

pytestmark = pytest.mark.compiling

TUBE = jt.table_1()
MATERIAL = jt.Material(EI_L=1.862, k_M=0.1, k_1=0.3, k_3=0.02, EA_L=3.9, EI_C=13.0, k_t=0.4)
BEAM = jt.Beam([11.0, 26.0, 33.0], 70.0, [1.9] * 4, [0.1] * 3)
ALONG = np.linspace(0, 1, 3)[:, None] * np.array([0.1, -1.0, 0.0])
BOX, BALL = box([4.0, 3.0, 1.0], 0.2), sphere(2.0)


def presses(x):
    return jt.Presses([40.0 + x], [0.0], [[0.0, -1.0, 0.0]])


def simulated(mesh):
    effects = jt.EffectOptions(want_surface=mesh is not None)
    scene = jt.make_scene(TUBE, MATERIAL, presses(0), mesh=mesh, effects=effects)
    return lambda x: jt.simulate(scene, MATERIAL, presses(x))


def swept():
    effects = jt.EffectOptions(want_surface=False)
    scene = jt.make_scene(TUBE, MATERIAL, presses(0), effects=effects)
    return lambda x: jt.sweep(scene, MATERIAL, [40.0 + x], [0.0], [1.0])


#: Of the ball beside the box, by x.
POSES = {
    x: pose_from_vector(jnp.array([0.1, 0.2, 0.3]), jnp.array([8.0 + x, 1.0, 1.0]))
    for x in (0.0, 0.5)
}

CALLS = {
    "press": lambda: lambda x: jt.press(TUBE, MATERIAL, 40.0 + x, [0.5, 1.0]),
    "press_oblique": lambda: lambda x: jt.press_oblique(TUBE, MATERIAL, 40.0 + x, 0.0, [0, -1, 0]),
    "press_path": lambda: (
        lambda x: jt.press_path(TUBE, MATERIAL, 40.0 + x, 0.0, ALONG, jt.Coulomb(0.3))
    ),
    "skeleton_response": lambda: lambda x: jt.skeleton_response(TUBE, MATERIAL, 40.0 + x, 0.0),
    "compliance": lambda: lambda x: compliance(TUBE, MATERIAL, [40.0 + x], jt.Options()),
    "deflect": lambda: lambda x: jt.deflect(BEAM, 30.0 + x, 1.0),
    "contact_compliance": lambda: lambda x: jt.contact_compliance(BEAM, [30.0 + x]),
    "signed_distance": lambda: lambda x: signed_distance(BOX, BALL, POSES[x]),
    "track": lambda: lambda x: track(BOX, BALL, POSES[x], jnp.array([1.0, 0.0, 0.0])),
    "simulate": lambda: simulated(None),
    "simulate, surface": lambda: simulated(make_tube(TUBE, around=9, along=40)),
    "sweep": swept,
}


@contextlib.contextmanager
def compilations():
    """Programs that XLA compiles meanwhile, one entry each."""
    names, under_way = [], [True]

    def note(event, _, **words):
        if event.endswith("backend_compile_duration") and under_way:
            names.append(words.get("fun_name"))

    jax.monitoring.register_event_duration_secs_listener(note)
    yield names
    under_way.clear()


#: The default suite has one that is solved and one that is not; the others take long to compile.
DEFAULT = ("press", "deflect")


@pytest.mark.parametrize(
    "name", [n if n in DEFAULT else pytest.param(n, marks=pytest.mark.slow) for n in CALLS]
)
def test_a_call_without_jit_is_one_program(name):
    """A first call of `press_oblique` compiled 361 programs, every other one 3."""
    call = CALLS[name]()
    with compilations() as first:
        call(0.0)
    assert len(first) <= 6, first  # with the conversions of plain numbers
    with compilations() as again:
        found = call(0.5)
    assert again == []
    numbers = [v for v in jax.tree.leaves(found) if np.issubdtype(v.dtype, np.floating)]
    assert all(np.isfinite(v).all() for v in numbers)


@pytest.mark.slow
@pytest.mark.parametrize("derivative", [jax.jacrev, jax.vmap])
def test_derivatives_and_batches_of_a_press_are_compiled_once(derivative):
    """But for the way back over the rings, whose `scan` JAX makes anew each time."""

    def force(s):
        return jt.press(TUBE, MATERIAL, s, 1.0).force

    at = np.array([30.0, 45.0]) if derivative is jax.vmap else 45.0
    whole = derivative(force)
    first = whole(at)
    with compilations() as again:
        second = whole(at)
    assert again == (["jit(scan)"] if derivative is jax.jacrev else [])
    np.testing.assert_allclose(first, jax.jit(whole)(at), rtol=1e-12, atol=1e-15)
    np.testing.assert_array_equal(first, second)
