"""Blocks of vertices against plain indexing, and the surface with and without them."""

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


@pytest.mark.parametrize(("vertices", "patches"), [(1000, 16), (997, 3), (64, 8), (5000, 2)])
def test_a_block_holds_vertices_of_one_patch(vertices, patches):
    patch = drawn(vertices, patches)
    blocks = in_blocks(jnp.asarray(patch), patches)
    count, width = blocks.vertex.shape
    assert 2 <= width <= WIDEST
    assert count * width <= vertices * (1 + 1 / LEAST) + width
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
    shapes = {in_blocks(jnp.asarray(drawn(1000, 16, k)), 16).vertex.shape for k in range(5)}
    shapes.add(in_blocks(jnp.zeros(1000, int), 16).vertex.shape)
    assert len(shapes) == 1


def test_few_or_traced_vertices_stand_alone():
    patch = jnp.asarray(drawn(1000, 16))
    assert in_blocks(patch[:20], 16) is None
    assert jax.jit(lambda p: to_blocks(p, in_blocks(p, 16)))(patch).shape == (1000, 1)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_derivatives_of_the_way_back(dtype):
    """Forward and reverse, single and in lanes, against indexing by numpy."""
    blocks = in_blocks(jnp.asarray(drawn(300, 5)), 5)
    place, shape = np.asarray(blocks.place), blocks.vertex.shape
    draw = np.random.default_rng(2).normal
    x, dx = (jnp.asarray(draw(size=(2, shape[0], 3, shape[1])), dtype) for _ in range(2))
    weight = jnp.asarray(draw(size=(2, 300, 3)), dtype)
    of = jax.vmap(lambda v: to_vertices(v, blocks))
    rows = lambda v: np.asarray(v).swapaxes(2, 3).reshape(2, -1, 3)  # noqa: E731
    out, ahead = jax.jit(lambda x, dx: jax.jvp(of, (x,), (dx,)))(x, dx)
    assert out.dtype == jnp.dtype(dtype)
    np.testing.assert_array_equal(out, rows(x)[:, place])
    np.testing.assert_array_equal(ahead, rows(dx)[:, place])
    back = jax.jit(jax.grad(lambda x: jnp.sum(of(x) * weight)))(x)
    expected = np.zeros((2, shape[0] * shape[1], 3), dtype)
    expected[:, place] = weight
    np.testing.assert_array_equal(rows(back), expected)


@pytest.mark.parametrize("method", ["linear", "hermite", "phong"])
def test_a_surface_in_blocks_is_that_of_its_vertices(method):
    """Values and gradient; C within a patch that several blocks share, two of them mixed."""
    geometry = table_1()
    tube = make_tube(geometry)
    order = np.random.default_rng(3).permutation(len(tube.s))
    shuffled = jax.tree.map(lambda v: v[order] if len(v) == len(order) else v, tube)
    draw = lambda *n: jnp.asarray(np.random.default_rng(len(n)).normal(size=n))  # noqa: E731
    weight = draw(len(order), 3)
    keys = regions.clamped(
        jnp.asarray(73.4), draw(3), draw(15, 3), 2 * draw(15, 3), -draw(15, 3), draw(15, 2), draw(2)
    )

    def answer(binding, weight, phi_c, keys):
        moved = lambda *x: regions.interpolate(  # noqa: E731
            binding, regions.weigh(binding, x[0]), x[1], method=method
        )
        out, back = jax.vjp(moved, phi_c, keys)
        return out, back(weight)

    grouped = regions.bind(shuffled, geometry)
    assert grouped.blocks is not None
    alone = jax.jit(lambda mesh: regions.bind(mesh, geometry))(tube)
    assert alone.blocks is None
    run = jax.jit(answer, compiler_options=QUICK)
    out, slopes = run(grouped, weight[order], jnp.asarray(0.4), keys)
    one, each = run(alone, weight, jnp.asarray(0.4), keys)
    np.testing.assert_allclose(out, one[order], atol=1e-13)
    for a, b in zip(jax.tree.leaves(slopes), jax.tree.leaves(each), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9)
