"""Six tubes in three-dimensional finite elements, by stiffnesses from their moduli alone.

`tests/reference/sections_fem.json` (tests/bench/sections_fem.py): the specimen of the factors, and
tubes unlike it by 4 %, by a tenth (two) and by more (two). What is OK is right within 5 % of the
peak of the force; where the level errs by more, beyond the tested angle and on tubes unlike the
specimen, the status says so, and docs/evidence/off_midline.md by how much.
"""

import json
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrachea.mechanics.sections.material import Wall, from_wall, neutral_radius
from jaxtrachea.mechanics.sections.press import press_sections
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.geometry import Geometry

sys.path.insert(0, str(Path(__file__).parents[1] / "bench"))
from sections_fem import DEPTHS, Tube  # noqa: E402

pytestmark = [pytest.mark.compiling, pytest.mark.slow]
CASES = json.loads((Path(__file__).parents[1] / "reference" / "sections_fem.json").read_text())
#: Largest error of the force over its peak, and of side over normal force, to 90 degrees.
LIMITS = {
    "ring": {
        "near": (0.06, 0.07),
        "closer": (0.07, 0.07),
        "farther": (0.05, 0.07),
        "narrow": (0.11, 0.07),
        "wide": (0.17, 0.14),
    },
    "span": {"near": (0.05, 0.07), "narrow": (0.20, 0.09), "wide": (0.16, 0.14)},
}


def model(tube: Tube, place: str):
    """Geometry, stiffnesses and contact position."""
    beside = (0 if place == "ring" else tube.pitch / 2) + tube.pitch * np.arange(tube.rings)
    rings, middle = np.unique(np.concatenate([-beside, beside])), beside[-1] + tube.pitch
    wall = Wall(
        E_C=tube.E_C, E_L=tube.E_L, E_M=tube.E_M, nu=tube.nu, h=tube.h, h_C=tube.h * tube.share,
        h_M=tube.h_M, bed_n=tube.bed_n, bed_t=tube.bed_t,
    )  # fmt: skip
    geometry = Geometry.create(
        2 * middle,
        rings + middle,
        radius=neutral_radius(tube.inner, wall),
        half_angle=np.radians(tube.alpha),
        ring_height=tube.height,
    )
    return geometry, from_wall(geometry, wall, tool_radius=tube.punch), middle


def stacked(trees):
    """Lanes of one tree; what is a scalar in one and an array in another is an array."""

    def stack(*leaves):
        shape = np.broadcast_shapes(*(leaf.shape for leaf in leaves))
        return jnp.stack([jnp.broadcast_to(leaf, shape) for leaf in leaves])

    return jax.tree.map(stack, *trees)


@pytest.mark.parametrize("place", ["ring", "span"])
def test_tubes(place):
    """Presses to 0.6 of the inner radius; the small one is the linear solution."""
    cases = {name: case for name, case in CASES.items() if name.split(":")[1] == place}
    tubes = [Tube(**case["tube"]) for case in cases.values()]
    phi = np.radians([float(name.split(":")[2]) for name in cases])
    depth, wanted = [], []
    for tube, case in zip(tubes, cases.values(), strict=True):
        rows = [int(np.argmin(np.abs(np.array(case["depth"]) - d * tube.inner))) for d in DEPTHS]
        depth.append([1e-3, *np.array(case["depth"])[rows]])
        wanted.append(np.vstack([1e-3 * np.array(case["linear"]), np.array(case["force"])[rows]]))
    built = [model(tube, place) for tube in tubes]
    geometry, material, s_c = (
        stacked([b[0] for b in built]), stacked([b[1] for b in built]), [b[2] for b in built]
    )  # fmt: skip
    arrays = map(jnp.asarray, (s_c, phi, depth))
    got = jax.jit(jax.vmap(press_sections))(geometry, material, *arrays)
    axes = np.array([[-np.cos(phi), -np.sin(phi)], [-np.sin(phi), np.cos(phi)]])
    found = np.einsum("acp,pnc->pna", axes, np.asarray(got.force)[..., 1:])
    wanted = np.array(wanted)
    off = np.abs(found - wanted)[..., 0].max(1) / wanted[..., 0].max(1)
    aside = np.abs(found[..., 1] / found[..., 0] - wanted[..., 1] / wanted[..., 0]).max(1)
    far = np.abs(phi) > np.pi / 2 + 1e-9
    assert far.any()
    for name, beyond, status, force, side in zip(cases, far, got.status, off, aside, strict=True):
        most = LIMITS[place].get(name.split(":")[0])
        unlike = PressStatus.OK if most is None else PressStatus.EXTRAPOLATED
        assert np.all(status == (PressStatus.NEAR_RING_END if beyond else unlike)), name
        most = (0.05, 0.07) if most is None else most
        assert beyond or (force < most[0] and side < most[1]), (name, force, side)
