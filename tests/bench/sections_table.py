"""Errors of `sections` from moduli alone, by case of `tests/reference/sections_fem.json`.

    python tests/bench/sections_table.py

prints a row a case: normal force at small strain, largest error over the peak, largest error of
side over normal force, and the worst status. The table of docs/evidence/off_midline.md is of these
rows. Two minutes, most of them compilation.
"""

import os
import sys
from pathlib import Path

os.environ.setdefault("JAX_ENABLE_X64", "1")
sys.path.insert(0, str(Path(__file__).parents[1]))

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from sections.test_finite_elements import CASES, DEPTHS, Tube, model, stacked  # noqa: E402

from jaxtrachea.mechanics.sections.press import press_sections  # noqa: E402
from jaxtrachea.status import PressStatus  # noqa: E402


def rows(place):
    """Name, three errors and status of each case on a ring or between rings."""
    cases = {name: case for name, case in CASES.items() if name.split(":")[1] == place}
    tubes = [Tube(**case["tube"]) for case in cases.values()]
    built = [model(tube, place) for tube in tubes]
    phi = np.radians([float(name.split(":")[2]) for name in cases])
    depth, wanted = [], []
    for tube, case in zip(tubes, cases.values(), strict=True):
        at = [int(np.argmin(np.abs(np.array(case["depth"]) - d * tube.inner))) for d in DEPTHS]
        depth.append([1e-3, *np.array(case["depth"])[at]])
        wanted.append(np.vstack([1e-3 * np.array(case["linear"]), np.array(case["force"])[at]]))
    geometry, material = (stacked([b[i] for b in built]) for i in (0, 1))
    arrays = (jnp.asarray(v) for v in ([b[2] for b in built], phi, depth))
    quick = {"xla_backend_optimization_level": 0}
    got = jax.jit(jax.vmap(press_sections), compiler_options=quick)(geometry, material, *arrays)
    axes = np.array([[-np.cos(phi), -np.sin(phi)], [-np.sin(phi), np.cos(phi)]])
    found = np.einsum("acp,pnc->pna", axes, np.asarray(got.force)[..., 1:])
    for name, f, w, status in zip(cases, found, wanted, got.status, strict=True):
        off = np.abs(f - w)[:, 0].max() / w[:, 0].max()
        aside = np.abs(f[:, 1] / f[:, 0] - w[:, 1] / w[:, 0]).max()
        yield name, f[0, 0] / w[0, 0] - 1, off, aside, PressStatus(int(np.max(status))).name


def order(row):
    """By tube, place and angle."""
    tube, place, angle = row[0].split(":")
    return tube, place, float(angle)


if __name__ == "__main__":
    print("case | small strain | over the peak | side over normal | status")
    for name, small, off, aside, status in sorted([*rows("ring"), *rows("span")], key=order):
        print(f"{name} | {small:+.1%} | {off:.1%} | {aside:.3f} | {status}")
