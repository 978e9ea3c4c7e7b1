"""Force over displacement along the tube, of a tool with a width and of a point.

    python fits/virtual_trachea/width.py

Writes docs/evidence/figures/width.png: the options of expected.json at 0.1 mm steps, the ten
measured presses, and what mixing stiffnesses in place of compliances gave (values fitted that way).
"""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np

from jaxtrachea.measurements.read import read_measurements
from jaxtrachea.mechanics.force_law import ring_weight
from jaxtrachea.mechanics.press import Options, compliance, press
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import Material

HERE = Path(__file__).parent
FIGURE = HERE.parents[1] / "docs" / "evidence" / "figures" / "width.png"
TUBE = Geometry.create(160.0, 10.0 * np.arange(1, 16), radius=11.8)
#: Fitted to the same presses when stiffnesses were mixed.
MIXED_STIFFNESS = Material(1402.36, 0.215850, 23.3814, 0.0, GA_L=9.31113, k_1_ring=1e6)


def secant(option: dict, s: jax.Array) -> jax.Array:
    """F / D of an option of expected.json."""
    values = {name: p["value"] for name, p in option["parameters"].items()}
    material = Material(**{"k_3": 0.0} | values)
    options = Options(
        shear=True, local="two-material", contact="bonded", half_width=option["half_width"]
    )
    return jax.vmap(lambda s: press(TUBE, material, s, 1.0, options).force)(s)


def with_stiffnesses(s: jax.Array) -> jax.Array:
    """F / D with the local stiffness mixed by weight."""
    material = MIXED_STIFFNESS
    c = compliance(TUBE, material, s, Options(shear=True))
    weight = jax.vmap(lambda s: ring_weight(s, TUBE.ring_positions, jnp.asarray(5.0)))(s)
    return 1 / (c + 1 / (material.k_1 + weight * (material.k_1_ring - material.k_1)))


def main() -> None:
    """Draw."""
    jax.config.update("jax_enable_x64", True)
    mpl.use("Agg")
    from matplotlib import pyplot as plt

    s = jnp.arange(15.0, 145.01, 0.1)
    point, punch = json.loads((HERE / "expected.json").read_text())["options"][-2:]
    lines = {
        "two forces, 2.36 mm to each side": (secant(punch, s), "C0", 1.8),
        "point, compliances mixed": (secant(point, s), "C1", 1.0),
        "point, stiffnesses mixed": (with_stiffnesses(s), "0.6", 1.0),
    }
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), width_ratios=(2, 1), layout="constrained")
    curves = read_measurements(HERE / "small_strain.h5").curves
    places = [c.s_c for c in curves]
    measured = [c.force[-1] / c.displacement[-1] for c in curves]
    for ax in axes:
        for name, (line, colour, width) in lines.items():
            ax.plot(s, line, color=colour, lw=width, label=name)
        ax.plot(places, measured, "k.", label="finite elements")
        ax.set_xlabel("s [mm]")
    axes[0].set_ylabel("F / D [N/mm]")
    axes[0].legend(frameon=False, loc="upper center")
    axes[1].set_xlim(69, 81)
    axes[1].set_ylim(0.63, 0.74)
    axes[1].set_title("around mid-span", fontsize="medium")
    FIGURE.parent.mkdir(exist_ok=True)
    figure.savefig(FIGURE, dpi=110)


if __name__ == "__main__":
    main()
