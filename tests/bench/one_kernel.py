"""Public functions by themselves and as one kernel. Run: python tests/bench/one_kernel.py.

A call and its reverse-mode gradient, timed in turn, and the same of 256 lanes; compilation (tracing
with it) once each. For docs/evidence/measured.md.
"""

import os
import time

import common
import jax
import jax.numpy as jnp
import numpy as np

from jaxtrachea import (
    Beam,
    Geometry,
    Material,
    ObliqueOptions,
    Options,
    deflect,
    fuse,
    press,
    press_oblique,
)
from jaxtrachea.mechanics.press import compliance

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_cpu_enable_async_dispatch", False)

LANES = 256


def tube(rings: int) -> Geometry:
    """Rings 10 mm apart."""
    x = jnp.arange(1, rings + 1) * 10.0
    return Geometry(*map(jnp.asarray, (10.0 * (rings + 1), x, 11.25, 2.0, 4.0)))


def cases():
    """Each from position (mm) and material to a number."""
    fifteen, many, depths = tube(15), tube(200), jnp.linspace(0.1, 2, 50)
    along = jnp.linspace(0.1, 1, 20)[:, None] * jnp.array([0.1, -1.0, 0.2])
    bonded = ObliqueOptions(Options(contact="bonded"))

    def beam(s, m):
        line = Beam(
            fifteen.ring_positions, fifteen.length, m.EI_L * jnp.ones(16), m.k_M * jnp.ones(15)
        )
        found = deflect(line, s, jnp.asarray(1.0))
        return found.w_C + jnp.sum(found.reaction)

    def oblique(s, m):
        return jnp.sum(press_oblique(fifteen, m, s, jnp.asarray(0.5), along, bonded).force)

    return {
        "`press`, one depth": lambda s, m: press(fifteen, m, s, jnp.asarray(2.0)).force,
        "`press`, 50 depths": lambda s, m: jnp.sum(press(fifteen, m, s, depths).force),
        "`press_oblique`, 20 rows": oblique,
        "`deflect`": beam,
        "`compliance`, 200 rings": lambda s, m: compliance(many, m, s, Options()),
    }


def ready(f, *at):
    """A compiled call that waits, and the seconds that it took to trace and to compile."""
    start = time.perf_counter()
    run = jax.jit(f).lower(*at).compile()
    return lambda: jax.block_until_ready(run(*at)), time.perf_counter() - start


def main() -> None:
    """Print the table."""
    names = "EI_L k_M k_1 k_3 EA_L EI_C k_t k_A k_B".split()
    values = (1.86, 0.1, 0.3, 0.02, 5.0, 100.0, 2.0, 1.0, 1.0)
    material = Material(**dict(zip(names, map(jnp.asarray, values), strict=True)))
    print(f"{common.cpu_model()}, commit {common.commit()}, load {os.getloadavg()[0]:.2f}")
    print("| | value µs | | gradient µs | | compiled s | | gradient of 256, µs a lane | |")
    print("|---|---|---|---|---|---|---|---|---|")
    for name, plain in cases().items():
        s = jnp.asarray(83.0)
        lanes = s + jnp.linspace(-3, 3, LANES)
        row = []
        timed, spent = {}, {}
        for kind, f in (("plain", plain), ("one", fuse(plain))):
            slope = jax.value_and_grad(f, (0, 1))
            timed["value", kind], _ = ready(f, s, material)
            timed["gradient", kind], spent[kind] = ready(slope, s, material)
            timed["lanes", kind], _ = ready(jax.vmap(slope, (0, None)), lanes, material)
        found = {
            what: jax.tree.leaves(timed[what, "one"]()) for what in ("value", "gradient", "lanes")
        }
        for what, ours in found.items():
            for a, b in zip(ours, jax.tree.leaves(timed[what, "plain"]()), strict=True):
                if np.any(b):
                    common.close(name, a, b, 1e-9)
        samples = common.interleaved(timed, rounds=60)
        for what, scale in (("value", 1e6), ("gradient", 1e6), ("compiled", 1), ("lanes", 1e6)):
            if what == "compiled":
                old, new = spent["plain"], spent["one"]
            else:
                old, new = (float(np.median(samples[what, k])) for k in ("plain", "one"))
            share = scale / LANES if what == "lanes" else scale
            row += [f"{old * share:.3g} / {new * share:.3g}", f"{new / old:.2f}"]
        print(f"| {name} | {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    main()
