"""Small numerical pieces shared by every room: guarded functions and tiny linear solves.

Everything here keeps the dtype of its input, is smooth where it says so, and is guarded *before*
the singular operation, so that derivatives stay finite.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def epsilon(dtype) -> float:
    """Spacing of floating-point numbers at one for `dtype`."""
    return float(jnp.finfo(dtype).eps)


def positive_part(x: Float[Array, "*n"], width: Float[Array, ""]) -> Float[Array, "*n"]:
    r"""Smooth positive part: exactly 0 for `x <= 0`, exactly `x` for `x >= width`, C2 and rising.

    w t^3 (6 - 8 t + 3 t^2) with t = x / w inside the blend; `width = 0` gives `max(x, 0)`.

    Args:
        x: any shape.
        width: width of the blend, same unit as `x`, not negative.
    """
    sharp = width <= 0
    w = jnp.where(sharp, 1, width).astype(x.dtype)
    t = jnp.clip(x / w, 0, 1)
    blend = w * t**3 * (6 + t * (3 * t - 8))
    return jnp.where((x < w) & ~sharp, blend, jnp.maximum(x, 0))


@jax.custom_jvp
def cubic_ratio(u: Float[Array, "*n"]) -> Float[Array, "*n"]:
    r"""Root g of g + (4/27) u g^3 = 1 on the branch through g(0) = 1.

    The scaled form of a depressed cubic d + b d^3 = t with d = t g(u), u = 27/4 b t^2: one formula
    for a hardening (u > 0), linear (u = 0) and softening (u < 0) law, without the 0/0 of the
    hyperbolic closed form at b -> 0. The branch ends in a fold at u = -1, g = 3/2; below it the
    result is NaN.

    The derivative is implicit, dg/du = -(4/27) g^3 / (1 + (4/9) u g^2), to any order.
    """
    return _cubic_root(u)


def _cubic_root(u):
    beyond_fold = u <= -1
    v = jnp.where(beyond_fold, jnp.zeros_like(u), u)
    positive = jnp.maximum(v, 0)
    negative = jnp.minimum(v, 0)
    # Starts within a few per cent of the root; then Newton on the convex side.
    soft = jnp.sqrt(jnp.maximum(1 + negative, 0))
    start_negative = 1.5 - soft * (0.8164966 - 0.3164966 * soft)
    s = jnp.cbrt(1 + positive)
    start_positive = 1.8898816 / (s + 0.8898816)
    g = jnp.where(v < 0, start_negative, start_positive)
    for _ in range(4):
        residual = g + (4 / 27) * v * g**3 - 1
        slope = 1 + (4 / 9) * v * g**2
        curvature = (8 / 9) * v * g
        g = g - 2 * residual * slope / (2 * slope * slope - residual * curvature)
    return jnp.where(beyond_fold, jnp.nan, g)


@cubic_ratio.defjvp
def _cubic_ratio_jvp(primals, tangents):
    (u,), (du,) = primals, tangents
    g = cubic_ratio(u)
    return g, -(4 / 27) * g**3 / (1 + (4 / 9) * u * g * g) * du


def solve_2x2(
    a: Float[Array, ""],
    b: Float[Array, ""],
    c: Float[Array, ""],
    r1: Float[Array, ""],
    r2: Float[Array, ""],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Solve [[a, b], [b, c]] x = r for a symmetric positive definite matrix, by elimination."""
    pivot = b / a
    x2 = (r2 - pivot * r1) / (c - pivot * b)
    return (r1 - b * x2) / a, x2
