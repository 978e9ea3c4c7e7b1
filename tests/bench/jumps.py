"""Jumps of the force: along 5,000 poses of a `Session`, across the midline and along the tube.

    python jumps.py session NAME        5,000 poses -> NAME.npz and a line per figure
    python jumps.py scan NAME           force against phi and s, a program made for each press
    python jumps.py loops NAME          work over closed loops
    python jumps.py plot OUT NAME...    all of them in one picture

Run it with the package to be measured on PYTHONPATH (an older version beside this one: the same
poses), and tests/reference. A jump is a change of force from one pose to the next; it is given over
stiffness times step, with the stiffest tangent of the local law at that depth, k_1 + 3 k_3 depth^2,
which no press exceeds while it holds its place.
"""

import dataclasses
import os
import sys

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_ENABLE_X64", "1")

import jax
import jax.numpy as jnp
import numpy as np
from small_scenes import BALL, BARE, MATERIAL, OUTER, TUBE, ball
from tool_ways import Way, closed_loop, random_way, step_lengths

from jaxtrachea import Presses, Session, make_scene, simulate
from jaxtrachea.status import PressStatus

POSES, LOOPS = 5000, 40
WISHES = dataclasses.replace(
    BARE, contact_point="fixed", rings="arch2", axial="on", second_plane="on", want_joints=False,
    want_ring_ends=False,
)  # fmt: skip
K_1, K_3 = float(MATERIAL.k_1), float(MATERIAL.k_3)


def session() -> Session:
    start = ball([75, 1, 0], [76, -2, 1])
    return Session(make_scene(TUBE, MATERIAL, start, tool=BALL, effects=WISHES), MATERIAL)


def follow(steps: Session, rotation, translation):
    """Force, gap, status and contact angle of every pose."""
    found = [
        (np.array(v.force), float(v.gap), int(v.status), float(v.phi))
        for v in map(steps.step, rotation, translation)
    ]
    return tuple(np.array(v) for v in zip(*found, strict=True))


def ratios(force, gap, way: Way) -> np.ndarray:
    """Jumps over stiffness times step, from each finite pose to the next; inf to or from NaN."""
    good = np.isfinite(way.translation).all(axis=1)
    force, gap = force[good], gap[good]
    step = step_lengths(way.translation[good], way.rotation[good])
    jump = np.linalg.norm(np.diff(force, axis=0), axis=1)
    depth = np.maximum(-np.minimum(gap[1:], gap[:-1]), 0)
    ratio = jump / ((K_1 + 3 * K_3 * depth**2) * np.maximum(step, 1e-9))
    return np.where(np.isfinite(jump), ratio, np.inf)


def tangential(force, phi) -> np.ndarray:
    """Force along the surface over that along the inward normal."""
    inward = -np.stack([0 * phi, np.cos(phi), np.sin(phi)], axis=1)
    normal = np.sum(force * inward, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.linalg.norm(force - normal[:, None] * inward, axis=1) / normal


def run_session(name: str) -> None:
    way = random_way(POSES, OUTER)
    force, gap, status, phi = follow(session(), *way)
    ratio = ratios(force, gap, way)
    finite = ratio[np.isfinite(ratio)]
    good = np.isfinite(way.translation).all(axis=1)
    lost = good & ~np.isfinite(force).all(axis=1)
    counts = {PressStatus(k).name: int((status == k).sum()) for k in np.unique(status)}
    print(f"{name}: {counts}; poses not finite {int((~good).sum())}")
    print(f"  no force at a finite pose: {int(lost.sum())}")
    high = finite.max(), np.quantile(finite, 0.99)
    print(f"  jump over stiffness x step: largest {high[0]:.3g}, 99 % {high[1]:.3g}")
    print(f"  above 1: {int((finite > 1).sum())}, above 2: {int((finite > 2).sum())}")
    aside = tangential(force, phi)[status == PressStatus.OK]
    print(f"  tangential over normal force: median {np.median(aside):.2g}, 95 % "
          f"{np.quantile(aside, 0.95):.2g}, largest {aside.max():.2g}")  # fmt: skip
    np.savez(f"{name}_session.npz", ratio=ratio, force=force, gap=gap, status=status)


def run_loops(name: str) -> None:
    """Work by the trapezoidal rule in N and 2 N steps, and the elastic energy that goes round."""
    steps, rows, lost = session(), [], 0
    for seed in range(LOOPS):
        work = []
        for count in (400, 800):
            steps.reset()
            path = closed_loop(seed, count, OUTER)
            force = follow(steps, np.broadcast_to(np.eye(3), (count + 1, 3, 3)), path)[0]
            part = np.sum((force[1:] + force[:-1]) / 2 * np.diff(path, axis=0), axis=1)
            work.append(np.nansum(part))
            lost += int(np.isnan(part).sum())
            moved = np.nansum(np.maximum(part, 0))
        rows.append([*work, moved])
    rows = np.array(rows)
    less, work, put_in = rows.T
    print(f"{name}: work over {LOOPS} closed loops, N mm: least {work.min():.4g} (400 steps: "
          f"{less.min():.4g}), below zero {int((work < 0).sum())}, median {np.median(work):.3g}; "
          f"put in at most {put_in.max():.3g}; steps without a force {lost}")  # fmt: skip
    np.savez(f"{name}_loops.npz", rows=rows)


def run_scan(name: str) -> None:
    """A press of 2 mm straight in, its program made for it alone."""
    effects = dataclasses.replace(BARE, want_joints=False, want_ring_ends=False)
    run = jax.jit(simulate)

    def press(s, phi):
        D = [[0, -2 * np.cos(phi), -2 * np.sin(phi)]]
        path = Presses(jnp.asarray([s]), jnp.asarray([phi]), jnp.asarray(D))
        scene = make_scene(TUBE, MATERIAL, path, effects=effects)
        return np.array(run(scene, MATERIAL, path).force[0])

    degrees, s = np.arange(-200, 201) / 100, np.arange(60, 90.001, 0.05)
    out = {}
    for label, at, length, force in (
        ("phi", degrees, np.deg2rad(0.01) * OUTER, [press(75.0, v) for v in np.deg2rad(degrees)]),
        ("s", s, 0.05, [press(v, 0.0) for v in s]),
    ):
        force = np.array(force)
        jump = np.linalg.norm(np.diff(force, axis=0), axis=1)
        ratio = jump / ((K_1 + 12 * K_3) * length)
        size = np.linalg.norm(force, axis=1)
        print(f"{name}: against {label}: {size.min():.4f} to {size.max():.4f} N, largest jump "
              f"{jump.max():.3g} N, over stiffness x step {ratio.max():.3g}")  # fmt: skip
        out |= {label: at, f"force_{label}": size}
    np.savez(f"{name}_scan.npz", **out)


def plot(out: str, names: list[str]) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    _, axes = plt.subplots(2, 2, figsize=(10, 7), layout="constrained")
    for name in names:
        ratio = np.load(f"{name}_session.npz")["ratio"]
        lost = int(np.isinf(ratio).sum())
        finite = np.maximum(ratio[np.isfinite(ratio)], 1e-6)
        label = f"{name} (to or from NaN: {lost})"
        axes[0, 0].semilogy(finite, ".", ms=2, label=label)
        axes[0, 1].loglog(np.sort(finite)[::-1], np.arange(1, len(finite) + 1), label=name)
        scan = np.load(f"{name}_scan.npz")
        axes[1, 0].plot(scan["phi"], scan["force_phi"], label=name)
        axes[1, 1].plot(scan["s"], scan["force_s"], label=name)
    for axis, x, y in (
        (axes[0, 0], "pose", "jump / (stiffness x step)"),
        (axes[0, 1], "jump / (stiffness x step)", "poses above"),
        (axes[1, 0], "phi / deg", "force / N"), (axes[1, 1], "s / mm", "force / N"),
    ):  # fmt: skip
        axis.set(xlabel=x, ylabel=y)
        axis.legend(fontsize=8)
    plt.savefig(out, dpi=120)


if __name__ == "__main__":
    kind, *rest = sys.argv[1:]
    if kind == "plot":
        plot(rest[0], rest[1:])
    else:
        {"session": run_session, "loops": run_loops, "scan": run_scan}[kind](*rest)
