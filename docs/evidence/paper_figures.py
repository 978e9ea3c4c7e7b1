"""Figures 6 and 7 of the paper, recomputed: the surface, joint loads and motions, ends of ring 6.

    python docs/evidence/paper_figures.py

Writes figures/fig_6a.png to 7c.png, and paper_figures.md (its text is in paper_figures.md.in).
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxtrachea.mechanics.oblique import ObliqueOptions, ObliquePress, press_oblique
from jaxtrachea.mechanics.press import Options
from jaxtrachea.output.surface_plot import draw_surface
from jaxtrachea.scene.build import stage
from jaxtrachea.scene.simulation import simulate
from jaxtrachea.scene.spec import load_scene_spec
from jaxtrachea.trachea.geometry import TABLE_1, disc_second_moment, table_1
from jaxtrachea.trachea.material import Material

HERE = Path(__file__).parent
S_C, RING = 60.0, 6  # on the sixth ring, counted from the carina
PULLS = {"normal": (0.0, -1.0, 0.0), "left-down": (-1.0, -1.0, 0.0), "right-down": (1.0, -1.0, 0.0)}
DEPTHS = np.linspace(0.0, 6.0, 25)  # mm, length of the tool's displacement


def material() -> Material:
    """Table 1 where it says something; k_M, k_t, k_1 and k_3 are ours, not the paper's."""
    cartilage = TABLE_1["A_C"] * TABLE_1["h_C"] ** 2 / 12  # a rectangle of height h_C
    return Material(
        EI_L=TABLE_1["E_L"] * disc_second_moment(TABLE_1["A_L"]),
        EA_L=TABLE_1["E_L"] * TABLE_1["A_L"],
        EI_C=TABLE_1["E_C"] * cartilage,
        k_M=0.1,
        k_t=0.4,
        k_1=0.3,
        k_3=0.02,
    )


def pulled(direction, rings="mat") -> ObliquePress:
    """The tool moves with the tube (paper 3: press or draw) along a direction, DEPTHS far."""
    unit = np.asarray(direction) / np.linalg.norm(direction)
    D = jnp.asarray(DEPTHS[:, None] * unit)
    at = jnp.asarray(S_C), jnp.asarray(0.0)
    options = ObliqueOptions(Options(contact="bonded"), rings=rings)
    return press_oblique(table_1(), material(), *at, D, options)


def facts() -> dict:
    """What the text of the page says, as numbers at the deepest press; `mat` unless named."""
    got = {name: pulled(direction) for name, direction in PULLS.items()}
    arch = {name: pulled(direction, "arch2") for name, direction in PULLS.items()}
    P, d = (np.asarray(getattr(got["right-down"], f))[-1] for f in ("loads", "joints"))
    ends = {name: (np.asarray(v.end_U), np.asarray(v.end_V)) for name, v in arch.items()}
    normal = got["normal"]
    return {
        "largest_load": {n: int(np.argmax(np.abs(v.loads[-1, :, 1]))) + 1 for n, v in got.items()},
        "largest_load_arch": int(np.argmax(np.abs(arch["normal"].loads[-1, :, 1]))) + 1,
        "P_6": float(-normal.loads[-1, RING - 1, 1]),
        "force": float(-normal.force[-1, 1]),
        "P_x_sides": (float(P[0, 0]), float(P[-1, 0])),
        "P_x_spread": float(max(np.ptp(P[:RING, 0]), np.ptp(P[RING:, 0])) / P[0, 0]),
        "d_x_bend": float(np.max(np.abs(np.diff(d[:RING, 0], 2))) / d[RING - 1, 0]),
        "d_y": [float(-normal.joints[-1, RING - 1 + i, 1]) for i in range(4)],
        "d_y_arch": [float(-arch["normal"].joints[-1, RING - 1 + i, 1]) for i in range(4)],
        "end_y": float(-ends["normal"][0][-1, RING - 1, 1]),
        "opening": float((ends["normal"][1] - ends["normal"][0])[-1, RING - 1, 2]),
    }


def draw() -> None:
    """The three figures."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    got = {name: pulled(direction, "arch2") for name, direction in PULLS.items()}
    joints = np.arange(1, 16)
    for letter, field, unit in (
        ("a", "loads", "joint load [N]"),
        ("b", "joints", "displacement [mm]"),
    ):
        figure, axes = plt.subplots(2, 3, figsize=(8, 4), sharex=True, sharey="row")
        for column, (name, press) in zip(axes.T, got.items(), strict=True):
            column[0].set_title(name)
            for ax, axis, sign in zip(column, (0, 1), (1, -1), strict=True):
                for step in (6, 12, 18, 24):
                    value = sign * np.asarray(getattr(press, field))[step, :, axis]
                    ax.plot(joints, value, ".-", lw=0.8, label=f"{DEPTHS[step]:g} mm")
                ax.axvline(RING, color="0.8", lw=0.5, zorder=0)
            column[1].set_xlabel("joint")
        axes[0, 0].set_ylabel(f"x {unit}")
        axes[1, 0].set_ylabel(f"y, inward {unit}")
        axes[0, 0].legend(fontsize=6)
        figure.tight_layout()
        figure.savefig(HERE / "figures" / f"fig_7{letter}.png", dpi=80)
    figure, axes = plt.subplots(1, 2, figsize=(8, 2.8))
    for name, press in got.items():
        for end, style in (("end_U", "-"), ("end_V", "--")):
            moved = np.asarray(getattr(press, end))[:, RING - 1]
            axes[0].plot(DEPTHS, -moved[:, 1], style, label=f"{name}, {end[-1]}")
            axes[1].plot(DEPTHS, moved[:, 2], style)
    axes[0].set_ylabel("ends of ring 6: y, inward [mm]")
    axes[1].set_ylabel("z, to the side [mm]")
    axes[0].legend(fontsize=6)
    for ax in axes:
        ax.set_xlabel("tool displacement [mm]")
    figure.tight_layout()
    figure.savefig(HERE / "figures" / "fig_7c.png", dpi=80)


def pressed(name: str):
    """The scene configs/NAME.toml, its path and its simulation."""
    spec = load_scene_spec(HERE.parents[1] / "configs" / f"{name}.toml")
    scene, material, path, _, _ = stage(spec, HERE)
    out = jax.jit(simulate)(scene, material, path)
    return spec.title, scene, path, out


def draw_surfaces() -> None:
    """Figure 6."""
    for letter, name in zip("abc", ("normal", "left_down", "right_down"), strict=True):
        title, scene, path, out = pressed(name)
        figure = draw_surface(scene, path, out, len(out.s) - 1, title)
        figure.savefig(HERE / "figures" / f"fig_6{letter}.png", dpi=90)


def document() -> str:
    """paper_figures.md."""
    f = facts()
    text = (HERE / "paper_figures.md.in").read_text(encoding="utf-8")
    words = {
        "P_6": f"{f['P_6']:.3f}",
        "FORCE": f"{f['force']:.3f}",
        "P_X": f"{f['P_x_sides'][0]:.4f} N and {f['P_x_sides'][1]:.4f} N",
        "D_Y": ", ".join(f"{v:.2f}" for v in f["d_y"]),
        "D_ARCH": ", ".join(f"{v:.2f}" for v in f["d_y_arch"]),
        "END": f"{f['end_y']:.2f}",
        "OPENING": f"{f['opening']:.2f}",
    }
    for name, value in words.items():
        text = text.replace(f"@{name}@", value)
    return text


def main() -> None:
    """Draw and write."""
    jax.config.update("jax_enable_x64", True)
    draw()
    draw_surfaces()
    (HERE / "paper_figures.md").write_text(document(), encoding="utf-8")
    print(facts())


if __name__ == "__main__":
    main()
