"""What several contacts move: the lines of joints of their skeleton, and the surface on them.

On the midline all contacts are nodes of one line; off it every contact has a line on its meridian.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrachea._numerics import added, product_of_rows
from jaxtrachea.mechanics.influence import Influence
from jaxtrachea.mechanics.influence_vector import VectorInfluence, by_all, own_contacts
from jaxtrachea.surface import regions
from jaxtrachea.surface.lines import weigh_lines


class Lines(NamedTuple):
    """Motion of the lines, row by row; mm, rad. Vectors are x, y, z, slopes y, z.

    Attributes:
        contacts: of every line at the places of all contacts; shape (rows, lines, places, 3).
        turns: rotation there; (rows, lines, places, 2).
        joints: of every line at the rings; (rows, lines, rings, 3).
        slopes: rotation there; (rows, lines, rings, 2).
        U: of the rings' ends at -alpha; (rows, rings, 3).
        V: at +alpha.
        clamps: of the ends A and B of the tube; (rows, 2, 3). None: they are held.
    """

    contacts: Float[Array, "rows lines places 3"]
    turns: Float[Array, "rows lines places 2"]
    joints: Float[Array, "rows lines rings 3"]
    slopes: Float[Array, "rows lines rings 2"]
    U: Float[Array, "rows rings 3"]
    V: Float[Array, "rows rings 3"]
    clamps: Float[Array, "rows 2 3"] | None = None


class Moved(NamedTuple):
    """What all forces do to the skeleton; fields as in `Simulation`, rows first."""

    skeleton: Float[Array, "rows m 3"]
    joints: Float[Array, "rows *lines rings 3"]
    loads: Float[Array, "rows *lines rings 3"]
    lines: Lines


def on_midline(unit: Influence, force: Float[Array, "rows m"], half: float) -> Moved:
    """Contacts on the midline, points or punches of half a width, mm; all move along y."""
    skeleton, joints, loads, slopes, turns = (
        product_of_rows(force, v)
        for v in (unit.compliance, unit.joints, unit.reactions, unit.slopes, unit.turns)
    )
    at, y = anterior(-skeleton), anterior(-joints)
    places = at if half == 0 else jnp.concatenate([at, at], axis=1)
    lines = Lines(places[:, None], _turn(turns)[:, None], y[:, None], _turn(slopes)[:, None], y, y)
    return Moved(at, y, anterior(-loads), lines)


def round_the_tube(
    unit: VectorInfluence, force: Float[Array, "rows m *k"], *, end_motion: bool = False
) -> Moved:
    """Contacts anywhere on the rings; inward forces, or (inward, along, round the tube)."""
    rows, m = force.shape[:2]
    force = force.reshape(rows, m, -1)
    flat = force.reshape(rows, -1)
    names = "contacts", "turns", "joints", "slopes", "end_U", "end_V"
    lines = Lines(*(by_all(flat, getattr(unit, name)) for name in names))
    if end_motion:
        lines = lines._replace(clamps=by_all(flat, unit.clamps))
    each = unit.loads.reshape(m, force.shape[2], *unit.loads.shape[1:])
    loads = added([force[:, :, k, None, None] * each[None, :, k] for k in range(each.shape[1])])
    return Moved(by_all(flat, own_contacts(unit)), lines.joints, loads, lines)


def anterior(v: Float[Array, "*n"]) -> Float[Array, "*n 3"]:
    """Vectors with only a y component."""
    return jnp.stack([jnp.zeros_like(v), v, jnp.zeros_like(v)], -1)


def _turn(v):
    """Rotation of a line that moves along y against v."""
    return jnp.stack([-v, jnp.zeros_like(v)], -1)


def weigh(binding: regions.Binding, phi: Float[Array, " m"], lines: int) -> list[regions.Weights]:
    """Weights of every line; one line is that of the midline."""
    if lines == 1:
        return [regions.weigh(binding, jnp.zeros_like(phi[0]))]
    return weigh_lines(binding, phi)


def interpolate(
    binding: regions.Binding,
    weights: list[regions.Weights],
    places: Float[Array, " places"],
    lines: Lines,
    method: regions.Method,
) -> Float[Array, "vertices 3"]:
    """Displacement of every vertex by the lines of one row, mm.

    Args:
        binding: of the mesh.
        weights: from `weigh`.
        places: of the contacts along the tube, mm, in any order.
        lines: of one row.
        method: see `regions`.
    """
    order = jnp.argsort(places)

    def line(i):
        keys = regions.clamped(
            places[order], lines.contacts[i][order], lines.joints[i], lines.U, lines.V,
            lines.slopes[i], lines.turns[i][order], clamps=lines.clamps,
        )  # fmt: skip
        return regions.interpolate(binding, weights[i], keys, method=method)

    return added([line(i) for i in range(len(weights))])
