"""A part that takes many lanes one after the other: values and derivatives are those of the part.

The outside truth is the function without the mark, and calculus. Whether lanes are taken in turn is
read in the compiled program: a loop, and no array of the part for all lanes.
"""

import dataclasses
import itertools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrachea import (
    Material,
    Presses,
    _linear,
    make_scene,
    simulate,
    table_1,
)
from jaxtrachea._numerics import epsilon
from jaxtrachea.fusion import fuse, map_sequentially
from jaxtrachea.trachea.tube import make_tube

LANES, POINTS = 5, 3000


def wave(x, a):
    """A large array from few numbers; a tree of results, one of them without a derivative."""
    along = jnp.linspace(0, 1, POINTS, dtype=x.dtype)
    heights = jnp.sin(x[:, None] * along[None]) * jnp.sum(a**2)
    return {"heights": heights, "highest": jnp.argmax(heights)}


def total(f):
    return lambda x, a: jnp.mean(f(x, a)["heights"] ** 2)


def numbers(dtype, *shapes):
    rng = np.random.default_rng(11)
    return [jnp.asarray(rng.uniform(0.5, 1.5, s), dtype) for s in shapes]


def close(got, expected):
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        assert (a.dtype, a.shape) == (b.dtype, b.shape)
        atol = 64 * epsilon(b.dtype) * np.abs(b).max(initial=1) if b.dtype.kind == "f" else 0
        np.testing.assert_allclose(a, b, rtol=0, atol=atol)


WAYS = {
    "value": lambda f: f,
    "forward": lambda f: lambda x, a: jax.jvp(total(f), (x, a), (jnp.cos(x), a))[1],
    "reverse": lambda f: jax.value_and_grad(total(f), argnums=(0, 1)),
    "second": lambda f: jax.hessian(total(f), argnums=(0, 1)),
}


SLOW = [pytest.mark.slow, pytest.mark.compiling]
#: Of the default suite one, on the way back.
CASES = [
    ("reverse", 1),
    *(
        pytest.param(*v, marks=SLOW)
        for v in (("value", 1), ("forward", 10**9), ("second", _linear.LARGE))
    ),
]


@pytest.mark.parametrize(("way", "large"), CASES)
def test_it_is_the_part(way, large, monkeypatch):
    """Alone, with lanes of either argument or of both, within lanes, and a kernel inside."""
    monkeypatch.setattr(_linear, "LARGE", large)
    do = WAYS[way]
    x, a, xs, As = numbers("float64", (2,), (3,), (LANES, 2), (4, 3))
    both = jnp.stack([a] * LANES)
    marks = map_sequentially(wave), map_sequentially(fuse(wave))
    for axes, at in {
        None: (x, a),
        (0, None): (xs, a),
        (None, 0): (x, As),
        (0, 0): (xs, both),
        (0, (None, 0)): (xs, As),
    }.items():
        plain, *marked = (batched(do(f), axes) for f in (wave, *marks))
        expected = jax.jit(plain)(*at)
        for f in marked:
            close(jax.jit(f)(*at), expected)


def batched(f, axes):
    """Over lanes; with an axis of two entries over those of another argument within."""
    if axes is None:
        return f
    if isinstance(axes[1], tuple):
        return jax.vmap(jax.vmap(f, axes[1]), (0, None))
    return jax.vmap(f, axes)


def test_the_derivative_by_hand():
    """d/da of the mean of (sin(x t) a^2)^2 is 4 a^3 mean sin^2, of all lanes together too."""
    x, a = numbers("float64", (LANES, 1), (LANES, 1))
    sine = np.sin(np.asarray(x) * np.linspace(0, 1, POINTS)[None])
    expected = 4 * np.asarray(a) ** 3 * np.mean(sine**2, axis=1, keepdims=True)
    each = jax.vmap(jax.grad(total(map_sequentially(wave)), argnums=1))
    whole = jax.grad(lambda a: jnp.sum(jax.vmap(total(map_sequentially(wave)))(x, a)))
    for found in (jax.jit(each)(x, a), jax.jit(whole)(a)):
        np.testing.assert_allclose(found, expected, rtol=1e-13)


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.usefixtures("on_the_cpu")
@pytest.mark.parametrize("mode", [jax.jit, lambda f: jax.jit(jax.grad(lambda *v: jnp.sum(f(*v))))])
def test_large_lanes_are_in_a_loop_on_a_cpu(mode):
    """The largest of many running sums, which are no result: only what is marked has a loop."""
    xs, As = numbers("float64", (LANES, 2), (LANES, 3))
    found = {}
    for points, mark in itertools.product((POINTS, 3), (map_sequentially, lambda f: f)):

        def part(x, a, points=points):
            along = jnp.linspace(0, 1, points, dtype=x.dtype)
            return jnp.cumsum(jnp.sin(x[:, None] * along[None]) * jnp.sum(a), axis=1)

        one = mark(part)

        def loss(x, a, one=one):
            return jnp.sum(jnp.sort(one(x, a), axis=1)[:, -1])

        text = mode(jax.vmap(loss)).lower(xs, As).compile().as_text()
        loops = re.findall(r" while\(.*known_trip_count.*\"n\":\"" + str(LANES), text)
        found[points, mark is map_sequentially] = bool(loops)
    assert found == {(POINTS, True): True, (POINTS, False): False, (3, True): False,
                     (3, False): False}  # fmt: skip


def test_other_devices_take_all_lanes_together():
    xs, As = numbers("float64", (LANES, 2), (LANES, 3))
    f = jax.jit(jax.vmap(total(map_sequentially(wave))))
    texts = [
        jax.export.export(f, platforms=(device,))(xs, As).mlir_module()
        for device in ("cuda", "cpu")
    ]
    assert ["stablehlo.while" in t for t in texts] == [False, True]


@pytest.mark.parametrize("mark", [fuse, map_sequentially])
def test_what_is_not_read_is_not_computed(mark):
    """Of two results of a call, where a marked part reads one."""
    x = jnp.linspace(0, 1, 7)

    def run(x):
        return mark(lambda pair: 2 * pair[0])(fuse(lambda x: (jnp.sqrt(x), jnp.cos(x)))(x))

    compiled = jax.jit(run).lower(x).compile()
    np.testing.assert_allclose(compiled(x), 2 * np.sqrt(x), rtol=1e-6)
    assert "cosine(" not in compiled.as_text()


@pytest.mark.slow
@pytest.mark.usefixtures("on_the_cpu")
def test_surfaces_of_many_poses_keep_no_array_of_all():
    """Vertices and their cotangents are what 32 poses share the memory for, and little besides."""
    tube, lanes = table_1(), 32
    mesh, path = make_tube(tube, around=24, along=60), Presses([75.0], [0.0], [[0.0, -2.0, 0.0]])
    material = Material(EI_L=1.86, k_M=0.1, k_1=0.3, k_3=0.02)
    scene = make_scene(tube, material, path, mesh=mesh)

    def moved(k_M, depth):
        press = Presses([75.0], [0.0], jnp.stack([0 * depth, -depth, 0 * depth])[None])
        found = simulate(scene, dataclasses.replace(material, k_M=k_M), press)
        return jnp.mean((found.vertices[0] - mesh.vertices) ** 2)

    at = jnp.linspace(0.1, 0.2, lanes), jnp.linspace(1, 2, lanes)
    each = jax.grad(moved, argnums=(0, 1))
    program = jax.jit(jax.vmap(each)).lower(*at).compile()
    memory = program.memory_analysis().temp_size_in_bytes / (lanes * mesh.vertices.nbytes)
    assert memory < 3
    one = jax.jit(each)(*(v[7] for v in at))
    for got, expected in zip(program(*at), one, strict=True):
        np.testing.assert_allclose(got[7], expected, rtol=1e-11)
