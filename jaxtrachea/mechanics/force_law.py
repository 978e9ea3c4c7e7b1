"""The local contact law (paper eq. 1, quasi-static Duffing oscillator) and where it applies.

|F| = m_0 |omega_0^2 d + 3/4 beta_0^2 eps d^3| = k_1 d + k_3 d^3. Only k_1 and k_3 can be
identified; m_0 merely scales. The paper gives no values for them.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float


class Law(NamedTuple):
    """Coefficients of the local law at one contact point: k_1 in N/mm, k_3 in N/mm^3."""

    k_1: Float[Array, ""]
    k_3: Float[Array, ""]


def from_duffing(m_0, omega_0_squared, beta_0_squared_epsilon) -> Law:
    """The law from the paper's symbols: k_1 = m_0 omega_0^2, k_3 = 3/4 m_0 beta_0^2 eps.

    Args:
        m_0: mass of the virtual tool, in tonnes (so that tonne mm/s^2 = N).
        omega_0_squared: 1/s^2.
        beta_0_squared_epsilon: 1/(s^2 mm^2).
    """
    return Law(m_0 * omega_0_squared, 0.75 * m_0 * beta_0_squared_epsilon)


def duffing(depth: Float[Array, "*n"], law: Law) -> Float[Array, "*n"]:
    """Contact force k_1 d + k_3 d^3, N, for a local indentation d, mm (odd in d)."""
    return depth * (law.k_1 + law.k_3 * depth * depth)


def fold_depth(law: Law) -> Float[Array, ""]:
    """Depth at which a softening law peaks: sqrt(k_1 / (-3 k_3)), mm; inf for k_3 >= 0."""
    softening = law.k_3 < 0
    cubic = jnp.where(softening, -3 * law.k_3, 1)
    return jnp.where(softening, jnp.sqrt(jnp.maximum(law.k_1, 0) / cubic), jnp.inf)


def ring_weight(
    s_c: Float[Array, ""], ring_positions: Float[Array, " n"], transition: Float[Array, ""]
) -> Float[Array, ""]:
    """How much the contact rests on a ring: 1 on a ring's centre, 0 beyond `transition`, C2 in s_c.

    1 - prod_i (1 - (1 - t_i^2)^3), t_i = min(|s_c - x_i| / transition, 1): smooth also where the
    neighbourhoods of two rings overlap.

    Args:
        s_c: contact position, mm.
        ring_positions: mm; shape (n,).
        transition: distance from a ring's centre at which the ligament's law is reached, mm.
    """
    t = jnp.clip((s_c - ring_positions) / transition, -1, 1)
    return 1 - jnp.prod(1 - (1 - t * t) ** 3)


def blend(ligament: Law, ring: Law, weight: Float[Array, ""]) -> Law:
    """Two-material law: coefficients of ring and ligament mixed by `ring_weight`."""
    mix = lambda on_ligament, on_ring: on_ligament + weight * (on_ring - on_ligament)  # noqa: E731
    return Law(mix(ligament.k_1, ring.k_1), mix(ligament.k_3, ring.k_3))
