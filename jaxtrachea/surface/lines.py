"""Weights of several lines of joints, each on the meridian of a contact of its own.

Round the tube the motion is linear between the ends U and V and all lines J between them. It is the
sum of what each line does by itself, so that `regions.interpolate` serves each in turn.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrachea._numerics import added, epsilon, product
from jaxtrachea.surface.regions import Binding, Weights, line_shares, weigh


def weigh_lines(binding: Binding, phi: Float[Array, " m"]) -> list[Weights]:
    """The weights of every line; U and V belong to the first of them.

    The share of a line is a sum of what it would be of each line between U and V alone, 1 on its
    own meridian and 0 on those of the others. Lines on one meridian share it: a ridge of sqrt(eps)
    keeps that solvable, and a step of refinement leaves the rest to rounding. As far as such lines
    are one they are met to sqrt(eps) of their motion.

    Args:
        binding: from `regions.bind`.
        phi: angles of the lines, rad, in [-alpha, alpha], in any order.
    """
    m, alpha = phi.shape[0], binding.half_angle
    alone = [weigh(binding, phi[k]) for k in range(m)]
    peaks = jnp.stack([line_shares(phi, phi[k], alpha)[1] for k in range(m)], axis=1)
    one = jnp.eye(m, dtype=phi.dtype)
    parts = jnp.linalg.inv(peaks + epsilon(phi.dtype) ** 0.5 * one)
    parts = product(parts, 2 * one - product(peaks, parts))
    lines = [added([alone[k].J * parts[k, i] for k in range(m)]) for i in range(m)]
    # U and V, linear between them, less what the lines take.
    at = (alpha - phi) / (2 * alpha)
    first = alone[0]
    U = first.U + at[0] * first.J - added([at[i] * lines[i] for i in range(m)])
    V = first.V + (1 - at[0]) * first.J - added([(1 - at[i]) * lines[i] for i in range(m)])
    none = jnp.zeros_like(U)
    ends = [(U, V), *[(none, none)] * (m - 1)]
    return [
        Weights(jnp.stack([a, J, b]), phi[i])
        for i, (J, (a, b)) in enumerate(zip(lines, ends, strict=True))
    ]
