"""Blocks of vertices against plain indexing, and the surface with and without them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrachea.surface import regions
from jaxtrachea.surface.blocks import LEAST, WIDEST, in_blocks, to_blocks, to_vertices
from jaxtrachea.trachea.geometry import table_1
from jaxtrachea.trachea.tube import make_tube

QUICK = {"xla_backend_optimization_level": 0}


def drawn(vertices, patches, seed=0):
    """Patches of very different size, one of them empty, in any order."""
    share = np.random.default_rng(seed).uniform(0, 1, patches) ** 3
    share[patches // 2] = 0
    return np.random.default_rng(seed).choice(patches, vertices, p=share / share.sum())


def grouped(patch, patches):
    """Blocks of vertices that lie anywhere in their patches; traced ones are the same."""
    s = jnp.asarray(patch + np.random.default_rng(5).uniform(0, 0.99, len(patch)))
    blocks = in_blocks(s, jnp.asarray(patch), patches)
    traced = jax.jit(in_blocks, static_argnums=2)(s, jnp.asarray(patch), patches)
    for a, b in zip(jax.tree.leaves(blocks), jax.tree.leaves(traced), strict=True):
        np.testing.assert_array_equal(a, b)
    return blocks


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize(("vertices", "patches"), [(997, 3), (64, 8)])
def test_a_block_holds_vertices_of_one_patch(vertices, patches):
    patch = drawn(vertices, patches)
    blocks = grouped(patch, patches)
    count, width = blocks.vertex.shape
    assert 2 <= width <= WIDEST
    assert count * width <= vertices * (1 + 1 / LEAST)
    rows = np.asarray(to_blocks(jnp.asarray(patch), blocks))
    assert (rows == rows[:, :1]).all()
    at = np.asarray(blocks.vertex)
    assert sorted(at[at < vertices]) == list(range(vertices))
    assert len(np.unique(at)) == at.size
    values = np.random.default_rng(1).normal(size=vertices)
    there = to_blocks(jnp.asarray(values), blocks)
    back = to_vertices(jnp.stack([there, -there], axis=1), blocks)
    np.testing.assert_array_equal(back, np.stack([values, -values], axis=1))


def test_the_shape_depends_on_the_counts_alone():
    zero = jnp.zeros(1000)
    shapes = {grouped(drawn(1000, 16, k), 16).vertex.shape for k in range(3)}
    shapes.add(in_blocks(zero, zero.astype(int), 16).vertex.shape)
    assert len(shapes) == 1


def test_few_vertices_stand_alone():
    patch = jnp.asarray(drawn(100, 16))
    assert in_blocks(patch.astype(float), patch, 16) is None
    assert to_blocks(patch, None).shape == (100, 1)


def test_derivatives_of_the_way_back():
    """Forward and reverse, single and in lanes, against indexing by numpy."""
    blocks = grouped(drawn(300, 5), 5)
    place, shape = np.asarray(blocks.place), blocks.vertex.shape
    draw = np.random.default_rng(2).normal
    x, dx = (jnp.asarray(draw(size=(2, shape[0], 3, shape[1])), "float64") for _ in range(2))
    weight = jnp.asarray(draw(size=(2, 300, 3)), "float64")
    of = jax.vmap(lambda v: to_vertices(v, blocks))

    def rows(v):
        return np.asarray(v).swapaxes(2, 3).reshape(2, -1, 3)

    out, ahead = jax.jit(lambda x, dx: jax.jvp(of, (x,), (dx,)))(x, dx)
    assert out.dtype == jnp.dtype("float64")
    np.testing.assert_array_equal(out, rows(x)[:, place])
    np.testing.assert_array_equal(ahead, rows(dx)[:, place])
    back = jax.jit(jax.grad(lambda x: jnp.sum(of(x) * weight)))(x)
    expected = np.zeros((2, shape[0] * shape[1], 3), "float64")
    expected[:, place] = weight
    np.testing.assert_array_equal(rows(back), expected)


GEOMETRY, TUBE = table_1(), make_tube(table_1())


def draw(*n):
    return jnp.asarray(np.random.default_rng(len(n)).normal(size=n))


def keys_at(s_c):
    lines = draw(15, 3), 2 * draw(15, 3), -draw(15, 3)
    return regions.clamped(jnp.asarray(s_c), draw(3), *lines, draw(15, 2), draw(2))


def alone(mesh, geometry):
    """The binding without blocks."""
    grouped = regions.bind(mesh, geometry)

    def of(v):
        return to_vertices(v[:, None], grouped.blocks)

    s, phi, fraction = (of(v) for v in (grouped.s, grouped.phi, grouped.fraction))
    patch = jnp.searchsorted(geometry.ring_positions, mesh.s, side="right")
    return regions.Binding(s, phi, fraction, patch, grouped.nodes, grouped.half_angle)


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize("method", ["hermite", "phong"])
def test_a_surface_in_blocks_is_that_of_its_vertices(method):
    """Values and gradients; C in mid-patch (a block is split) and on a node."""
    order = np.random.default_rng(3).permutation(len(TUBE.s))
    shuffled = jax.tree.map(lambda v: v[order] if len(v) == len(order) else v, TUBE)
    weight = draw(len(order), 3)

    def answer(binding, weight, phi_c, keys):
        def moved(*x):
            return regions.interpolate(binding, regions.weigh(binding, x[0]), x[1], method=method)

        out, back = jax.vjp(moved, phi_c, keys)
        return out, back(weight)

    run = jax.jit(answer, compiler_options=QUICK)
    for s_c in (73.4, float(GEOMETRY.ring_positions[7])):
        given = jnp.asarray(0.4), keys_at(s_c)
        out, slopes = run(regions.bind(shuffled, GEOMETRY), weight[order], *given)
        one, each = run(alone(TUBE, GEOMETRY), weight, *given)
        np.testing.assert_allclose(out, one[order], atol=1e-13)
        for a, b in zip(jax.tree.leaves(slopes), jax.tree.leaves(each), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-9)


@pytest.mark.slow
@pytest.mark.compiling
def test_bound_to_other_rings():
    """Rings that moved, traced, with the order known: the same as bound anew, slopes too."""
    known = regions.bind(TUBE, GEOMETRY)
    keys, weight = keys_at(73.4), draw(len(TUBE.s), 3)

    def answer(known, x):
        binding = regions.bind(TUBE, eqx.tree_at(lambda g: g.ring_positions, GEOMETRY, x), known)
        assert jax.tree.structure(binding) == jax.tree.structure(regions.bind(TUBE, GEOMETRY))
        u = regions.interpolate(binding, regions.weigh(binding, jnp.asarray(0.4)), keys)
        return jnp.sum(weight * u)

    x = GEOMETRY.ring_positions + 3 * jnp.sin(jnp.arange(15.0))
    total = jax.jit(jax.value_and_grad(answer, argnums=1), compiler_options=QUICK)
    value, slope = total(known, x)
    binding = alone(TUBE, eqx.tree_at(lambda g: g.ring_positions, GEOMETRY, x))
    u = regions.interpolate(binding, regions.weigh(binding, jnp.asarray(0.4)), keys)
    np.testing.assert_allclose(value, jnp.sum(weight * u), rtol=1e-12)
    step = jnp.zeros(15).at[3].set(1e-6)
    (up, _), (down, _) = total(known, x + step), total(known, x - step)
    np.testing.assert_allclose((up - down) / 2e-6, slope[3], rtol=1e-6)


@pytest.mark.slow
@pytest.mark.compiling
def test_second_derivatives():
    """Of the rule for derivatives: both orders of forward and reverse, and difference quotients."""
    binding, keys, weight = regions.bind(TUBE, GEOMETRY), keys_at(73.4), draw(len(TUBE.s), 3)

    def total(x):
        moved = eqx.tree_at(lambda k: k.s_c, keys, keys.s_c + x[1])
        u = regions.interpolate(binding, regions.weigh(binding, 0.4 + x[0]), moved)
        return jnp.sum(weight * u * u)

    def compiled(f):
        return jax.jit(f, compiler_options=QUICK)

    zero, slope = jnp.zeros(2), compiled(jax.grad(total))
    one = compiled(jax.jacfwd(jax.grad(total)))(zero)
    other = compiled(jax.jacrev(jax.jacfwd(total)))(zero)
    np.testing.assert_allclose(one, other, rtol=1e-10)
    step = 1e-5 * jnp.eye(2)
    numeric = [(slope(h) - slope(-h)) / 2e-5 for h in step]
    np.testing.assert_allclose(one, numeric, rtol=1e-5)
