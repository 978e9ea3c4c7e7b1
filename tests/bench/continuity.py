"""Is the force continuous in the contact's place? Largest jump over stiffness times step.

Presses of 2 mm and a ball on the generated mesh, against phi (-2 to 2 degrees by 0.01) and the ball
against s (70 to 90 mm by 0.02). "Former": rings are springs within 1e-4 rad of the midline and bend
beyond it, as the rules had it. Prints a table; draws the curves into the file that is named.

    PYTHONPATH=.:tests/reference python tests/bench/continuity.py continuity.png
"""

import dataclasses
import sys

import jax
import matplotlib as mpl
import numpy as np

jax.config.update("jax_enable_x64", True)
mpl.use("Agg")

import matplotlib.pyplot as plt  # noqa: E402
from small_scenes import MATERIAL, TUBE  # noqa: E402

from jaxtrachea import EffectOptions, Poses, Presses, make_scene, simulate  # noqa: E402
from jaxtrachea.contact.shapes import sphere  # noqa: E402
from jaxtrachea.trachea.tube import make_tube  # noqa: E402

#: No press is stiffer than its local law at this depth: k_1 + 3 k_3 d^2, N/mm.
DEPTH = 2.0
STIFFNESS = 0.3 + 3 * 0.02 * DEPTH**2
BARE = EffectOptions(
    want_surface=False, want_joints=False, want_ring_ends=False, contact_point="per_step"
)
run = jax.jit(simulate)


def force(path, rings="auto", **how):
    """Contact force of every row, N; all rows are solved."""
    scene = make_scene(TUBE, MATERIAL, path, effects=dataclasses.replace(BARE, rings=rings), **how)
    out = run(scene, MATERIAL, path)
    assert (np.asarray(out.status) == 0).all()
    return np.asarray(out.force)


def ball(s, phi):
    """Its centre on a circle round the axis, `DEPTH` under the touch of a crest."""
    up = TUBE.radius + 1.3 + 5 - DEPTH
    places = np.stack([s + 0 * phi, up * np.cos(phi), up * np.sin(phi)], axis=1)
    return Poses(np.broadcast_to(np.eye(3), (len(places), 3, 3)), places)


def curves():
    """Name -> (what it is drawn against, force, way of the tool in a step, mm)."""
    degrees = np.linspace(-2, 2, 401)
    phi, s = np.radians(degrees), np.linspace(70, 90, 1001)
    inward = np.stack([0 * phi, -np.cos(phi), -np.sin(phi)], axis=1)
    presses = Presses(np.full(401, 75.0), phi, DEPTH * inward)
    bent, springs = force(presses), force(presses, rings="mat")
    former = np.where(np.abs(phi)[:, None] <= 1e-4, springs, bent)
    mesh = {"tool": sphere(5.0), "mesh": make_tube(TUBE)}
    turn = np.radians(0.01)
    return {
        "presses, former": (degrees, former, DEPTH * turn),
        "presses": (degrees, bent, DEPTH * turn),
        "ball on the mesh, s = 75 mm": (degrees, force(ball(75.0, phi), **mesh), 15.6 * turn),
        "ball on the mesh, s = 80 mm": (degrees, force(ball(80.0, phi), **mesh), 15.6 * turn),
        "ball on the mesh, along s": (s, force(ball(s, 0 * s), **mesh), 0.02),
    }


def main():
    """Table and picture."""
    found = curves()
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.5), layout="constrained", sharey=True)
    print("| curve | force, N | largest jump, N | over stiffness times step |\n|---|---|---|---|")
    for name, (where, F, step) in found.items():
        size = np.linalg.norm(F, axis=1)
        jump = np.linalg.norm(np.diff(F, axis=0), axis=1).max()
        spread = f"{size.min():.4f} to {size.max():.4f}"
        print(f"| {name} | {spread} | {jump:.2g} | {jump / (STIFFNESS * step):.2g} |")
        axes[int(where[-1] > 10)].plot(where, size, label=name, lw=1)
    for axis, label in zip(axes, ("phi, degrees", "s, mm"), strict=True):
        axis.set(xlabel=label)
        axis.legend(fontsize=7)
    axes[0].set(ylabel="contact force, N")
    figure.savefig(sys.argv[1], dpi=150)


if __name__ == "__main__":
    main()
