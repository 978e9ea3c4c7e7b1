"""Several contacts on one ligament: how much each of them moves under a force at each other.

Two sweeps over rings and contacts together, one from each clamp, serve all contacts. From every
contact one back-substitution follows: O((n + m) m) for n rings and m contacts, and no matrix of the
skeleton is formed. Virtual work makes the result symmetric (Maxwell and Betti).

Units: mm, N, mm/N.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxtrachea._numerics import epsilon, picked
from jaxtrachea.mechanics.beam import Side, both_sides, sweep
from jaxtrachea.mechanics.compliance import Beam, Compliance, join, sides
from jaxtrachea.mechanics.marks import with_marks, without_marks


class Influence(NamedTuple):
    """Everything that moves under a unit force at one of m contacts.

    Attributes:
        compliance: deflection of contact i per unit force at contact j, mm/N; symmetric and
            positive semi-definite; shape (m, m).
        joints: deflection of the ligament at each ring per unit force at contact j, mm/N; shape
            (m, rings).
        reactions: force of each ring against the load per unit force at contact j; (m, rings).
        slopes: rotation of the ligament at each ring per unit force at contact j, rad/N; shape
            (m, rings).
        turns: rotation of the ligament at every contact (of punches: at the edges towards A of all,
            then at those towards B) per unit force at contact j, rad/N; shape (m, points).
    """

    compliance: Float[Array, "m m"]
    joints: Float[Array, "m rings"]
    reactions: Float[Array, "m rings"]
    slopes: Float[Array, "m rings"]
    turns: Float[Array, "m points"]


def influence(beam: Beam, s: Float[Array, " m"]) -> Influence:
    """Response of the beam to a unit normal force at each of m points.

    Args:
        beam: the beam and its n supports.
        s: positions of the contacts, mm, in [0, length], in any order; two may be equal.

    Returns:
        The `Influence`; differentiable in every argument. Deflection and rotation agree on both
        sides of a contact (the `continuous` split of `beam`).
    """
    order, place = sorted_places(s)
    marked, passed, marks = with_marks(beam, picked(s, order))
    marks = marks[place]  # in the order of s
    m, supports = s.shape[0], marked.x.shape[0]
    both = both_sides(marked)
    _, nodes, past = jax.vmap(sweep)(both)
    at = jnp.stack([marks, supports - 1 - marks])  # seen from A, and from B
    tips = jax.tree.map(lambda v: jax.vmap(picked)(v, at), nodes.g)
    joint = jax.vmap(lambda tip: join(*sides(tip)), in_axes=1)(tips)
    w, theta = jax.vmap(_back_substitute)(both, nodes.g, past, at, joint.V.T, joint.M.T)
    in_A = jnp.arange(supports)[:, None] <= marks[None]
    w = jnp.where(in_A, w[0], w[1][::-1])
    theta = jnp.where(in_A, theta[0], -theta[1][::-1])
    C = w[marks]
    C = jnp.where(jnp.eye(m, dtype=bool), joint.w[:, None], (C + C.T) / 2)
    joints, slopes = (without_marks(v, passed, m).T for v in (w, theta))
    return Influence(C, joints, joints * beam.k[None], slopes, theta[marks].T)


def _back_substitute(
    side: Side, tips: Compliance, past, at, V, M
) -> tuple[Float[Array, "supports m"], Float[Array, "supports m"]]:
    """From m loads (V, M), each at its mark, back to the clamp: motion and rotation of supports.

    Nothing moves beyond a mark here: that is for the other side.
    """

    def step(load, support):
        index, h, k, past, (a, b, c, _) = support
        begins = index == at
        M_here = jnp.where(begins, M, load[1] + h * load[0])
        V_here = jnp.where(begins, V, load[0])
        moved = a * V_here + b * M_here, b * V_here + c * M_here
        return (past * V_here - k * b * M_here, M_here), moved

    supports = (jnp.arange(side.k.shape[0]), side.h[1:], side.k, past, tips)
    return jax.lax.scan(step, (jnp.zeros_like(V), jnp.zeros_like(M)), supports, reverse=True)[1]


def level_influence(beam: Beam, s: Float[Array, " m"], half_width: float) -> Influence:
    """As `influence`, of flat punches that hold the ligament level over twice `half_width`.

    Each punch is two points, half a width before and behind s_j, that move alike (`punch`). The
    moments that keep the punches level are eliminated from the (2 m) x (2 m) compliance of the
    points, one after the other. A moment that others hold already, as that of a second punch on one
    and the same place, does nothing. NaN where a punch is so narrow that its two points differ by
    rounding alone.

    Args:
        beam: the beam and its n supports.
        s: middles of the punches, mm; half a width off both ends of the beam.
        half_width: mm, more than 0.
    """
    m = s.shape[0]
    points = jnp.concatenate([s - half_width, s + half_width])
    found = influence(beam, jnp.clip(points, 0, beam.length))

    def turned(v):
        """Rows of the points to those of the sums of their forces, then of their moments."""
        return jnp.concatenate([(v[:m] + v[m:]) / 2, v[:m] - v[m:]])

    C = turned(turned(found.compliance).T).T
    rest = [turned(v) for v in (found.joints, found.reactions, found.slopes, found.turns)]
    size = (jnp.diag(found.compliance)[:m] + jnp.diag(found.compliance)[m:])[:, None]
    tiny = 100 * epsilon(C.dtype) * size[:, 0]
    narrow = jnp.any((jnp.diag(C)[m:] <= tiny) & (tiny > 0))
    for j in range(m):
        pivot, row = C[m + j, m + j], C[m + j]
        known = pivot > tiny[j]
        share = jnp.where(known, row / jnp.where(known, pivot, 1), 0)[:, None]
        C = C - share * row[None]
        rest = [v - share * v[m + j][None] for v in rest]
    C = jnp.where(narrow, jnp.nan, C[:m, :m])
    joints, reactions, slopes, turns = (v[:m] for v in rest)
    return Influence((C + C.T) / 2, joints, reactions, slopes, turns)


def sorted_places(s: Float[Array, " m"]) -> tuple[Int[Array, " m"], Int[Array, " m"]]:
    """Indices that sort s, and the place of each entry in that order; equal ones keep theirs."""
    own = jnp.arange(s.shape[0])
    before = (s[None] < s[:, None]) | ((s[None] == s[:, None]) & (own[None] < own[:, None]))
    place = jnp.sum(before, axis=1)
    order = jnp.sum(jnp.where(place[None] == own[:, None], own[None], 0), axis=1)
    return order, place
