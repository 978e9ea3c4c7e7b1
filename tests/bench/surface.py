"""Time of one surface update on one core: `taskset -c 1 python tests/bench/surface.py`.

Median and 5th percentile of repeated calls, in microseconds, with the call itself ("empty").
"""

import time

import jax
import jax.numpy as jnp
import numpy as np

from jaxtrachea.surface import local, regions
from jaxtrachea.trachea.geometry import table_1
from jaxtrachea.trachea.tube import make_tube

jax.config.update("jax_enable_x64", True)


def times(f, *args, calls=2000):
    """5th percentile and median of compiled calls, us."""
    run = jax.jit(f).lower(*args).compile()
    taken = []
    for _ in range(calls):
        start = time.perf_counter()
        jax.block_until_ready(run(*args))
        taken.append(time.perf_counter() - start)
    return "{:5.0f} / {:.0f}".format(*1e6 * np.percentile(taken, [5, 50]))


def rows(dtype):
    """What is timed, by name."""
    geometry = table_1(dtype)
    mesh = make_tube(geometry)
    binding, points = regions.bind(mesh, geometry), mesh.straight

    def draw(*shape):
        return jnp.asarray(np.random.default_rng(0).normal(size=shape), dtype)

    keys = regions.clamped(
        jnp.asarray(73, dtype), draw(3), draw(15, 3), draw(15, 3), draw(15, 3),
        draw(15, 2), draw(2),
    )  # fmt: skip
    phi_c, depth = jnp.asarray(0.4, dtype), jnp.asarray([0, -1, 0], dtype)
    weights = regions.weigh(binding, phi_c)

    def dent(count, phi_c, depth):
        def number(v):
            return jnp.asarray(v, dtype)

        at = local.centres(number(73), phi_c, number(12.6), number(1.5), count)
        wanted = local.targets(depth, jnp.zeros(count, dtype))
        return local.correction(local.fit(at, wanted, number(5)), points)

    def whole(keys, phi_c, depth):
        u = regions.interpolate(binding, regions.weigh(binding, phi_c), keys)
        return points + u + dent(16, phi_c, depth)

    yield "empty", times(lambda v: v + 1, phi_c)
    yield "weigh", times(lambda p: regions.weigh(binding, p), phi_c)
    for method in ("linear", "hermite", "phong"):

        def f(w, k, m=method):
            return regions.interpolate(binding, w, k, method=m)

        yield method, times(f, weights, keys)
    for count in local.CIRCLES:
        yield f"dent {count}", times(lambda p, d, n=count: dent(n, p, d), phi_c, depth)
    yield "weigh + hermite + dent 16", times(whole, keys, phi_c, depth)


if __name__ == "__main__":
    print("| part | float32 | float64 |\n|---|---|---|")
    for (name, single), (_, double) in zip(rows("float32"), rows("float64"), strict=True):
        print(f"| {name} | {single} | {double} |")
