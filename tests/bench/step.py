"""Latency of a `Session` step: two versions of the package in one run, with an empty jitted call.

    python step.py PACKAGE_FOLDER OTHER_PACKAGE_FOLDER      (tests/reference on PYTHONPATH)

Each version runs in a process of its own; they work in turns, 100 steps each, an empty call after
every step. A step ends with its force, gap and status read by numpy. A ball goes up and down on the
tube: straight, in one plane; a little aslant, forces only; so with friction; and with the deformed
surface of the generated trachea (6,856 triangles, dent of 16). Medians, 99 % and smallest in us,
and ratios.
"""

import os
import subprocess
import sys
import time

BLOCK, BLOCKS = 100, 100
KINDS = "plane", "forces", "friction", "surface"


def work(kind: str) -> None:
    """Steps in blocks, one for each line that comes in."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import jax.numpy as jnp
    import numpy as np
    from small_scenes import BALL, BARE, MATERIAL, OUTER, SPRINGS, TUBE, ball

    from jaxtrachea import EffectOptions, Session, Tool, make_scene
    from jaxtrachea.trachea.tube import make_tube

    aslant = float(kind != "plane")
    material = MATERIAL if aslant else SPRINGS
    how = {"contact_point": "fixed", "want_surface": kind == "surface"}
    if aslant:
        how |= {"rings": "arch2", "axial": "on", "second_plane": "on"}
    effects = EffectOptions(**{**vars(BARE), **how})
    mesh = make_tube(TUBE, around=36, along=160) if kind == "surface" else None
    start = ball([75, 1, 0], [75 + aslant, -2, aslant])
    tool = Tool(BALL, 0.3) if kind == "friction" else BALL
    if kind == "friction":
        effects = EffectOptions(**{**vars(effects), "friction": "on"})
    scene = make_scene(TUBE, material, start, tool=tool, mesh=mesh, effects=effects)
    session, empty, zero = Session(scene, material), jax.jit(jnp.negative), jnp.zeros(())
    turn, angle = np.eye(3), np.linspace(0, 2 * np.pi, BLOCK)
    down = np.maximum(0, 1.5 - 2 * np.cos(angle))
    way = np.stack([75 + 0.3 * aslant * down, OUTER + 5.5 - down, 0.2 * aslant * down], axis=1)

    def step(place):
        """What a loop reads: force, gap and status as numbers."""
        found = session.step(turn, place)
        return np.asarray(found.force), float(found.gap), int(found.status)

    def timed(call, *arguments):
        begin = time.perf_counter()
        jax.block_until_ready(call(*arguments))
        return time.perf_counter() - begin

    timed(empty, zero)
    print("ready", flush=True)
    for line in sys.stdin:
        taken = [(timed(step, p), timed(empty, zero)) for p in way]
        print(" ".join(f"{v:.3e}" for pair in taken for v in pair), flush=True)
        if line.strip() == "last":
            break


def main(folders: list[str]) -> None:
    import numpy as np

    for kind in KINDS:
        running = []
        for folder in folders:
            path = os.pathsep.join([folder, os.environ["PYTHONPATH"]])
            running.append(
                subprocess.Popen(
                    [sys.executable, __file__, "--work", kind], text=True, stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE, env=os.environ | {"PYTHONPATH": path},
                )
            )  # fmt: skip
        for one in running:
            assert one.stdout is not None
            assert one.stdout.readline() == "ready\n", "a worker failed"
        taken = [[] for _ in folders]
        for block in range(BLOCKS):
            for one, times in zip(running, taken, strict=True):
                assert one.stdin is not None
                assert one.stdout is not None
                one.stdin.write("last\n" if block == BLOCKS - 1 else "go\n")
                one.stdin.flush()
                times += map(float, one.stdout.readline().split())
        for one in running:
            one.wait()
        medians, least = [], []
        for folder, times in zip(folders, taken, strict=True):
            step, empty = 1e6 * np.array(times).reshape(-1, 2).T
            medians.append(np.median(step))
            least.append(step.min())
            print(
                f"{kind}: {folder}: {len(step)} steps, median {np.median(step):.0f} us, 99 % "
                f"{np.quantile(step, 0.99):.0f}, smallest {step.min():.0f}; empty call "
                f"{np.median(empty):.1f}, 99 % {np.quantile(empty, 0.99):.1f}"
            )
        ratio, of_least = medians[1] / medians[0], least[1] / least[0]
        print(f"{kind}: second over first {ratio:.3f}, smallest {of_least:.3f}", flush=True)


if __name__ == "__main__":
    if sys.argv[1] == "--work":
        work(sys.argv[2])
    else:
        main(sys.argv[1:])
