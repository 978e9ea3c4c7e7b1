"""Several contacts that feel one another, against one contact alone, in lanes.

    python tests/bench/contacts.py [--lanes 64] [--rounds 40] [--scene configs/two_fingers.toml]

Skeleton and forces of m tools (`press_contacts`), and the skeleton alone (`influence`), over one
`deflect` and one `press`, each on tubes of other stiffness. Compilation is that of one call, once.
With --scene instead steps of a session of all its tools, over those of its first tool alone.
"""

import argparse
import dataclasses
import statistics
import time
from pathlib import Path

import common  # noqa: F401  (pins one core, before numpy and jax)
import jax
import jax.numpy as jnp
import numpy as np

from jaxtrachea import Session
from jaxtrachea.mechanics.beam import deflect
from jaxtrachea.mechanics.influence import influence
from jaxtrachea.mechanics.levels.options import Options
from jaxtrachea.mechanics.press import ligament_beam, press
from jaxtrachea.mechanics.press_contacts import press_contacts
from jaxtrachea.scene.build import stage
from jaxtrachea.scene.instruments import scene_of
from jaxtrachea.scene.spec import load_scene_spec
from jaxtrachea.trachea.geometry import table_1
from jaxtrachea.trachea.material import Material

TUBE, OPTIONS = table_1(), Options()


def material(k_M):
    """The ligament and the local law of every lane, on rings of its own."""
    values = (jnp.asarray(v, k_M.dtype) for v in (1400.0, 20.0, 0.5))
    EI_L, k_1, k_3 = values
    return Material(EI_L=EI_L, k_M=k_M, k_1=k_1, k_3=k_3)


def beam(k_M):
    """The same, as a beam."""
    return ligament_beam(TUBE, material(k_M), OPTIONS)


def compiled(function, *given):
    """A batch of the function that waits for its result, and seconds to trace and compile it."""
    start = time.perf_counter()
    run = jax.jit(jax.vmap(function)).lower(*given).compile()
    seconds = time.perf_counter() - start
    return lambda: jax.block_until_ready(run(*given)), seconds


def sessions(file: Path, rounds: int) -> None:
    """Steps along the paths of a scene, in turns; seconds of the processor to compile."""
    staged = stage(load_scene_spec(file), file.parent)
    scene, paths = staged.scene, staged.path
    assert isinstance(paths, dict)
    first, rows = scene.instruments[0], max(len(p.translation) for p in paths.values())
    plan = dataclasses.replace(scene.plan, tools="one")
    alone = dataclasses.replace(scene_of(scene, first), plan=plan)
    taken, made = {}, {}
    for name, of in (("one", alone), ("all", scene)):
        start = time.process_time()
        made[name], taken[name] = Session(of, staged.material), []
        print(f"{name}: compiled in {time.process_time() - start:.0f} s of processor time")

    def pose(path, row):
        return tuple(np.asarray(v[min(row, len(v) - 1)]) for v in (path.rotation, path.translation))

    for _ in range(rounds):
        for row in range(rows):
            one, every = pose(paths[first.name], row), {n: pose(p, row) for n, p in paths.items()}
            for name, given in (("one", one), ("all", (every,))):
                start = time.perf_counter()
                made[name].step(*given)
                taken[name].append(time.perf_counter() - start)
    for name, times in taken.items():
        median, late = np.quantile(times[rows:], (0.5, 0.99))
        ratio = median / np.median(taken["one"][rows:])
        print(f"{name}: {1e6 * median:.0f} us, {ratio:.2f} x one; p99 {late / median:.1f} medians")


def main():
    """Print ratios of medians."""
    parser = argparse.ArgumentParser(description="Several contacts against one")
    parser.add_argument("--lanes", type=int, default=64)
    parser.add_argument("--rounds", type=int, default=40)
    parser.add_argument("--scene", type=Path)
    asked = parser.parse_args()
    if asked.scene:
        sessions(asked.scene, asked.rounds)
        return
    rng, lanes = np.random.default_rng(0), asked.lanes
    k_M, s, D = (rng.uniform(*r, lanes) for r in ((0.1, 0.3), (5, 155), (0, 6)))
    compiled(lambda k, s: deflect(beam(k), s, jnp.ones_like(s)), k_M, s)  # what is done once
    cases = {
        "deflect": compiled(lambda k, s: deflect(beam(k), s, jnp.ones_like(s)), k_M, s),
        "press": compiled(lambda k, s, D: press(TUBE, material(k), s, D, OPTIONS), k_M, s, D),
    }
    for m in (1, 2, 4, 8, 16):
        s, D = rng.uniform(5, 155, (lanes, m)), rng.uniform(-1, 6, (lanes, m))
        cases[f"influence {m}"] = compiled(lambda k, s: influence(beam(k), s), k_M, s)
        cases[f"press_contacts {m}"] = compiled(
            lambda k, s, D: press_contacts(TUBE, material(k), s, D, OPTIONS), k_M, s, D
        )
    samples = common.interleaved({n: run for n, (run, _) in cases.items()}, rounds=asked.rounds)
    one, first = statistics.median(samples["deflect"]), cases["deflect"][1]
    print(f"deflect of {lanes} lanes: {one * 1e6:.1f} us, compiled in {first:.2f} s")
    for name, (_, seconds) in cases.items():
        ratio = statistics.median(samples[name]) / one
        print(f"{name:20} run {ratio:6.2f} x, compile {seconds / first:5.2f} x one deflect")


if __name__ == "__main__":
    main()
