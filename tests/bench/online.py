"""`Online`: time of a sample, and samples to 5 % with proposed places against a fixed grid.

Run: python tests/bench/online.py [time] [places]. Prints; the page has the numbers.
"""

import os
import sys
import time

import common  # noqa: F401
import jax
import jax.numpy as jnp
import numpy as np

import jaxtrachea as jt

jax.config.update("jax_cpu_enable_async_dispatch", False)

NAMES = ("EI_L", "k_M", "k_1", "k_3")
MIDDLE = np.array([300.0, 1.0, 0.5, 0.2])
DEPTH, SAMPLES, NOISE = 6.0, 40, 0.05
DISPLACEMENT = np.linspace(DEPTH / SAMPLES, DEPTH, SAMPLES)
#: Places in turn: all along the tube, and without mirror images as far as its end; presses at most.
GRID, HALF, PRESSES = np.linspace(20.0, 140.0, 7), np.linspace(10.0, 75.0, 6), 30
#: Relative standard error of every unknown at which a specimen is done, and samples between looks.
GOAL, LOOK = 0.05, 10
HELD = {name: {"fixed": True, "value": 0.0} for name in ("onset", "force_offset")}


@jax.jit
def forces(truth, s):
    """One press, N."""
    material = jt.Material(*truth)
    return jax.vmap(lambda d: jt.press(jt.table_1(), material, s, d).force)(
        jnp.asarray(DISPLACEMENT)
    )


def online(criterion="D"):
    """With first guesses at the middle."""
    table = {name: {"value": float(v)} for name, v in zip(NAMES, MIDDLE, strict=True)}
    table["k_3"] |= {"scale": "log", "lower": 1e-4, "upper": 1e2}
    return jt.Online(
        jt.table_1(), jt.Options(), table | HELD, noise=jt.Noise(force=NOISE), depth=DEPTH,
        samples=SAMPLES, criterion=criterion,
    )  # fmt: skip


def times() -> None:
    """Latency of a sample: ten presses in turn over the grid."""
    rng, one = np.random.default_rng(0), online()
    taken, worked = [], []
    for k in range(10):
        s = GRID[k % len(GRID)]
        one.press(s)
        force = np.asarray(forces(MIDDLE, s)) + NOISE * rng.normal(size=SAMPLES)
        for d, f in zip(DISPLACEMENT, force, strict=True):
            begin, work = time.perf_counter(), time.process_time()
            one.add(d, f)
            taken.append(time.perf_counter() - begin)
            worked.append(time.process_time() - work)
    begin = time.perf_counter()
    one.settle()
    settled = 1e3 * (time.perf_counter() - begin)
    for name, v in (("wall", taken), ("processor", worked)):
        p10, p50, p99 = 1e3 * np.percentile(v, (10, 50, 99))
        print(f"{len(v)} samples, {name}: p10 {p10:.2f}, p50 {p50:.2f}, p99 {p99:.2f} ms")
    print(f"settle {settled:.0f} ms; load {os.getloadavg()[0]:.1f}")


def needed(truth, seed, place, criterion="D"):
    """Samples until all standard errors are below the goal, and the largest true error then."""
    rng, one = np.random.default_rng(seed), online(criterion)
    for k in range(PRESSES):
        s = place(k, one.state)
        one.press(s)
        force = np.asarray(forces(truth, s)) + NOISE * rng.normal(size=SAMPLES)
        for first in range(0, SAMPLES, LOOK):
            part = slice(first, first + LOOK)
            state = one.add(DISPLACEMENT[part], force[part])
            if np.all(state.relative_error <= GOAL):
                return state.samples, np.max(np.abs(state.value / truth - 1))
    return np.inf, np.max(np.abs(one.settle().value / truth - 1))


def places() -> None:
    """Twenty specimens, log-uniform within a factor of 2 about the middle."""
    rules = {
        "grid": (lambda k, state: GRID[k % len(GRID)], "D"),
        "half": (lambda k, state: HALF[k % len(HALF)], "D"),
        "D": (lambda k, state: state.next_point, "D"),
        "A": (lambda k, state: state.next_point, "A"),
    }
    found = {name: [] for name in rules}
    unit = np.random.default_rng(48).uniform(-1, 1, (20, 4))
    for seed, truth in enumerate(MIDDLE * 2**unit):
        for name, (place, criterion) in rules.items():
            found[name].append(needed(truth, seed, place, criterion))
        last = (f"{name} {rows[-1][0]:.0f}" for name, rows in found.items())
        print(f"specimen {seed}:", *last, flush=True)
    for name, rows in found.items():
        count, error = np.array(rows).T
        quartiles = np.percentile(count, (25, 50, 75), method="nearest")
        print(f"{name}: samples {quartiles} (quartiles), not reached {np.sum(np.isinf(count))}, "
              f"true error {100 * np.median(error):.1f} % (median), "
              f"{100 * error.max():.1f} % (largest)")  # fmt: skip


if __name__ == "__main__":
    for part in sys.argv[1:] or ["time", "places"]:
        {"time": times, "places": places}[part]()
