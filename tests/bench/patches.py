"""Time of `touch` by the number of patches searched; writes the table in docs/evidence/contact.md.

Run by hand on a quiet machine: `python tests/bench/patches.py`. A rounded box beside a straight
tube of 16 patches, float64; times are the best of several runs, errors against all patches
searched over all directions.
"""

import pathlib
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

ROOT = pathlib.Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))
jax.config.update("jax_enable_x64", True)

from jaxtrachea.contact.patches import straight_patches, touch  # noqa: E402
from jaxtrachea.contact.pose import pose_from_vector  # noqa: E402
from jaxtrachea.contact.shapes import box  # noqa: E402

BEGIN, END = "<!-- table by tests/bench/patches.py -->\n", "<!-- end of patches -->"
LANES = 256
BORDERS = np.r_[0.0, np.arange(10, 151, 10), 160.0]
#: Words, patches searched, over all directions.
ROWS = [("1", 1, False), ("2 (default)", 2, False), ("3", 3, False), ("16", 16, False),
        ("16, all directions", 16, True)]  # fmt: skip


def poses():
    """Rotations and translations of the tool, 0 to 12 mm off the wall or a little pressed in."""
    rng = np.random.default_rng(0)
    s, phi = rng.uniform(5, 155, LANES), rng.uniform(-np.pi, np.pi, LANES)
    away = rng.uniform(12, 26, LANES)
    at = np.stack([s, away * np.cos(phi), away * np.sin(phi)], axis=1)
    return jnp.asarray(rng.normal(size=(LANES, 3))), jnp.asarray(at)


def best(call, runs):
    """Shortest time of a call, in microseconds."""
    jax.block_until_ready(call())
    times = []
    for _ in range(runs):
        start = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - start)
    return min(times) * 1e6


def main():
    """Measure and write."""
    tube, tool, (turn, at) = straight_patches(BORDERS, 12.0), box([2.0, 1.5, 4.0], 0.3), poses()
    found = []
    for _, near, search in ROWS:

        def one(turn, at, near=near, search=search):
            return touch(tool, pose_from_vector(turn, at), tube, near=near, search=search)

        single, lanes = jax.jit(one), jax.jit(jax.vmap(one))
        gap = lanes(turn, at).gap
        complete = lanes(turn, at).complete
        alone = best(lambda: single(turn[0], at[0]), 200)  # noqa: B023
        many = best(lambda: lanes(turn, at), 10) / LANES  # noqa: B023
        found.append((np.asarray(gap), np.asarray(complete), alone, many))
    lines = ["| patches searched | one call, us | per lane, us | gap off at most, mm | complete |",
             "|---|---|---|---|---|"]  # fmt: skip
    for (words, *_), (gap, complete, alone, many) in zip(ROWS, found, strict=True):
        off = np.abs(gap - found[-1][0]).max()
        lines.append(f"| {words} | {alone:.3g} | {many:.3g} | {off:.1g} | {complete.mean():.1%} |")
    document = ROOT / "docs" / "evidence" / "contact.md"
    before, _, rest = document.read_text().partition(BEGIN)
    document.write_text(before + BEGIN + "\n".join(lines) + "\n" + END + rest.partition(END)[2])


if __name__ == "__main__":
    main()
