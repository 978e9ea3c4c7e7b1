"""What each mark of `jaxtrachea.fusion` gives: rows of the mission with and without it, in turns.

    PYTHONPATH=tests/reference python tests/bench/marks.py [SITE ...]

A site is a call of `fuse` in one module. It alone is taken off (the part is compiled as it stands)
and the rows that it can reach are timed against the package as it is: two processes in turns,
blocks of calls. Given is the ratio of medians, without over with: 1.3 means that the mark makes the
row 1.3 times as fast.
"""

import argparse
import importlib
import json
import os
import subprocess
import sys
import time

#: By site: module, kinds of rows it reaches.
SITES = {
    "none": ("", ()),
    "contact": ("scene.stage", ("step", "session")),
    "row": ("scene.one_row", ("session",)),
    "relaxation": ("relaxation.steps", ("relaxing",)),
}
BLOCKS = 12


def strike(site: str) -> None:
    """Take one mark off."""
    module = SITES[site][0]
    if module:
        importlib.import_module(f"jaxtrachea.{module}").fuse = lambda part, **_: part


def rows(kind: str) -> dict:
    """Calls of one kind, by name; each gives what to wait for."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    if kind in ("step", "session"):
        import gradient
        import update

        made, material = update.scenes(jnp.float64)
        scene = made["whole, dent of 16; patches of the mesh"]
        if kind == "session":
            from jaxtrachea import Session

            session = Session(scene, material)
            turn, place = np.eye(3), np.asarray(update.at(jnp.float64).translation[0])
            ways = [place + [0.1 * i, 0.02 * i, 0] for i in range(5)]

            def walk():
                for way in ways:
                    found = session.step(turn, way)
                return found.force, found.vertices

            bare = Session(made["contact, skeleton; patches of the mesh"], material)

            def forces():
                for way in ways:
                    found = bare.step(turn, way)
                return found.force

            return {"five session steps": walk, "five session steps, forces": forces}
        value = gradient.scalar_of(scene)
        one = gradient.arguments(jnp.float64, material, 1)
        many = gradient.arguments(jnp.float64, material, 32)
        grad = jax.value_and_grad(value)
        return {
            "update": gradient.wait(value, *one),
            "update, gradient": gradient.wait(grad, *one),
            "32 updates": gradient.wait(jax.vmap(value), *many),
        }
    if kind == "relaxing":
        import gradient
        import relaxing_cost

        from jaxtrachea.fitting.cost import evaluate

        study = relaxing_cost.study_of(16)
        free = jnp.zeros((16, len(study.model.free)))

        def cost(free, lane):
            return evaluate(study.model, free, lane, jnp.ones(2))

        return {"16 relaxing residuals": gradient.wait(jax.vmap(cost), free, study.lanes)}
    raise ValueError(kind)


def work(site: str, kind: str) -> None:
    """Blocks of calls, one for each line that comes in."""
    import jax

    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    strike(site)
    calls = rows(kind)
    counts = {}
    for name, call in calls.items():
        for _ in range(3):
            jax.block_until_ready(call())
        begin = time.perf_counter()
        jax.block_until_ready(call())
        counts[name] = max(1, int(0.12 / (time.perf_counter() - begin)))
    print("ready", flush=True)
    for line in sys.stdin:
        found = {}
        for name, call in calls.items():
            begin = time.perf_counter()
            for _ in range(counts[name]):
                jax.block_until_ready(call())
            found[name] = (time.perf_counter() - begin) / counts[name]
        print(json.dumps(found), flush=True)
        if line.strip() == "last":
            break


def main() -> None:
    """Every site asked for, against the package as it is."""
    parser = argparse.ArgumentParser()
    parser.add_argument("sites", nargs="*", default=[])
    parser.add_argument("--kinds", default="", help="some of those of SITES, with commas")
    asked = parser.parse_args()
    import statistics

    for site in asked.sites or [s for s in SITES if s != "none"]:
        for kind in asked.kinds.split(",") if asked.kinds else SITES[site][1]:
            running = [
                subprocess.Popen(
                    [sys.executable, __file__, "--work", name, kind], text=True,
                    stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=os.environ,
                )
                for name in ("none", site)
            ]  # fmt: skip
            taken = [{}, {}]
            for one in running:
                if one.stdout.readline() != "ready\n":
                    raise SystemExit(f"{site}, {kind}: a worker failed")
            for block in range(BLOCKS):
                for one, times in zip(running, taken, strict=True):
                    one.stdin.write("last\n" if block == BLOCKS - 1 else "go\n")
                    one.stdin.flush()
                    for name, seconds in json.loads(one.stdout.readline()).items():
                        times.setdefault(name, []).append(seconds)
            for name in taken[0]:
                with_, without = (statistics.median(t[name]) for t in taken)
                print(
                    f"{site}: {name}: {1e6 * with_:.0f} us with, {1e6 * without:.0f} without, "
                    f"ratio {without / with_:.2f}", flush=True,
                )  # fmt: skip


if __name__ == "__main__":
    if sys.argv[1:2] == ["--work"]:
        work(*sys.argv[2:4])
    else:
        main()
