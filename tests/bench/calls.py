"""Single calls of `press` and of its bound form, in turns in one process.

Run: python tests/bench/calls.py. Processor time and wall time of blocks of calls, one core, and the
ratio of bound to plain in the same turn: median over the turns and of the smallest samples.
"""

import os
import time

import common  # First: it pins the process before numpy and jax are loaded.

# isort: split
import jax
import jax.numpy as jnp
import numpy as np

import jaxtrachea as jt

jax.config.update("jax_cpu_enable_async_dispatch", False)

TURNS, CALLS = 101, 100
VALUES = {"EI_L": 1400.0, "k_M": 0.2, "k_1": 20.0, "k_3": 0.5, "GA_L": 9.0}


def calls(count: int) -> dict:
    """The forms of one press of `count` displacements; each ends with its numbers there."""
    tube, options = jt.table_1(), jt.Options(shear=True)
    material = jt.Material(**{k: jnp.asarray(v) for k, v in VALUES.items()})
    s, D = jnp.asarray(75.0), jnp.linspace(1.0, 6.0, count)
    every = jax.jit(jt.press, static_argnames="options")
    kept = jax.jit(lambda m, s, D: jt.press(tube, m, s, D, options))
    program = jt.bind(tube, material, s, D, options)
    numbers = program.pack(material, s, D)
    device = jax.device_put(numbers)
    common.close("force", program.result(program(numbers)).force, kept(material, s, D).force, 1e-12)
    empty = jax.jit(lambda v: v + 1)

    def to_numpy():
        return jax.tree.map(np.asarray, kept(material, s, D))

    return {
        "plain": lambda: jax.block_until_ready(every(tube, material, s, D, options=options)),
        "plain, tube kept": lambda: jax.block_until_ready(kept(material, s, D)),
        "plain, tube kept, to numpy": to_numpy,
        "bound, from the device": lambda: program(device),
        "bound, numpy to views": lambda: program.result(program(numbers)),
        "empty": lambda: empty(s).block_until_ready(),
    }


def main() -> None:
    """Measure and print."""
    for count in (1, 25):
        cases = calls(count)
        taken = {name: [] for name in cases}
        for call in cases.values():
            for _ in range(20):
                call()
        for _ in range(TURNS):
            for name, call in cases.items():
                call()
                begin = time.process_time(), time.perf_counter()
                for _ in range(CALLS):
                    call()
                end = time.process_time(), time.perf_counter()
                taken[name].append([1e6 * (b - a) / CALLS for a, b in zip(begin, end, strict=True)])
        times = {name: np.array(v).T for name, v in taken.items()}
        base, load = times["plain, tube kept, to numpy"][0], os.getloadavg()[0]
        print(f"{count} displacements, load {load:.1f}; processor time, wall time (us), ratios")
        for name, (cpu, wall) in times.items():
            ratio, least = np.median(cpu / base), cpu.min() / base.min()
            print(
                f"  {name:28} {np.median(cpu):6.1f} (smallest {cpu.min():5.1f})"
                f" {np.median(wall):6.1f} ({wall.min():5.1f})  {ratio:.2f}, of smallest {least:.2f}"
            )


if __name__ == "__main__":
    main()
