"""Roots of functions that rise within a bracket, and of the polynomials of the force laws.

Guarded *before* the singular operation; derivatives are implicit, so that they hold at awkward
points too.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxtrachea._numerics import epsilon, every


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
    """Root of `cubic_ratio`: a start within 5 %, then two steps of fourth order (Householder)."""
    beyond_fold = u <= -1
    v = jnp.where(beyond_fold, 0, u)
    positive = jnp.maximum(v, 0)
    # g^-3 = 1 + 4u/9 + ... at zero and 4u/27 + ... at infinity; within 3 % between.
    near = jnp.minimum(positive, 1e12)
    bend = (1 + 0.0194247 * near) / (1 + near * (0.121133 + 4.08816e-5 * near))
    start_hard = _rough_inverse_cbrt(1 + (4 * positive + 8 * near * bend) / 27)
    e = jnp.sqrt(jnp.maximum(1 + jnp.minimum(v, 0), 0))
    tail = 0.65760339 + e * (-0.48829214 + e * (0.2662296 - 0.06957457 * e))
    start_soft = 1.5 - e * (0.8660254 - e * tail)
    f_3 = (4 / 27) * v

    def improve(_, g):
        f_2 = 3 * f_3 * g
        f_1 = 1 + f_2 * g
        f = g * (1 + f_3 * g * g) - 1
        return g - f * (f_1 * f_1 - f * f_2) / (f_1 * (f_1 * f_1 - 2 * f * f_2) + f * f * f_3)

    # A loop, and not two steps written out: its result is stored, where XLA would otherwise compute
    # the root anew inside whatever uses it.
    g = jax.lax.fori_loop(0, 2, improve, jnp.where(v < 0, start_soft, start_hard))
    return jnp.where(beyond_fold, jnp.nan, g)


def _rough_inverse_cbrt(x):
    """x^(-1/3) within 3.5 % for x >= 1: a logarithm and an exponential read off the bits.

    The bits of a floating-point number, taken as an integer, are a piecewise linear log2.
    """
    integer, mantissa, bias = {4: (jnp.int32, 23, 127), 8: (jnp.int64, 52, 1023)}[x.dtype.itemsize]
    log = jax.lax.bitcast_convert_type(x, integer).astype(x.dtype)
    third = log * (-1 / 3) + 4 / 3 * (bias - 0.049622) * 2.0**mantissa
    return jax.lax.bitcast_convert_type(third.astype(integer), x.dtype)


@cubic_ratio.defjvp
def _cubic_ratio_jvp(primals, tangents):
    (u,), (du,) = primals, tangents
    g = cubic_ratio(u)
    return g, -(4 / 27) * g**3 / (1 + (4 / 9) * u * g * g) * du


def first_positive_root(
    a: Float[Array, "*n"], b: Float[Array, "*n"], e: Float[Array, "*n"]
) -> Float[Array, "*n"]:
    """Smallest q > 0 (q >= 0 for a = 0) with a + b q + e q^2 = 0, for a >= 0; inf where none is.

    No difference of near numbers but the discriminant; scaled, so that no square overflows.
    """
    size = jnp.maximum(jnp.maximum(a, jnp.abs(b)), jnp.abs(e))
    size = jnp.where(size > 0, size, 1)
    a, b, e = a / size, b / size, e / size
    square = b * b - 4 * a * e
    falls = b < 0
    there = (square >= 0) & (falls | (e < 0))
    root = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)
    above = jnp.where(falls, 2 * a, b + root)
    below = jnp.where(falls, root - b, -2 * e)
    return jnp.where(there, above / jnp.where(there, below, 1), jnp.inf)


def newton_tolerance(dtype) -> float:
    """Relative step that ends Newton's method: the error that a step leaves is its square."""
    return epsilon(dtype) ** 0.6


class Rising(NamedTuple):
    """Functions of one unknown each, which rise within a bracket.

    Attributes:
        value_and_slope: of the functions at x, entry by entry: none knows of its neighbours.
        least_step: at x, the size from which on a step is the last.
        start: of the steps.
        low: where the functions are not positive.
        high: where they are not negative.
        solvable: which functions have a root in their bracket.
    """

    value_and_slope: Callable[[Array], tuple[Array, Array]]
    least_step: Callable[[Array], Array]
    start: Float[Array, "*n"]
    low: Float[Array, "*n"]
    high: Float[Array, "*n"]
    solvable: Bool[Array, "*n"]


def rising_root(
    problem: Callable[..., Rising], *arguments: Float[Array, "..."], steps: int
) -> Array:
    """Roots of functions that rise, NaN where there is none, by Newton steps.

    First a few that every entry takes, none waited for: most need no others. A loop that keeps to
    the bracket takes several times as long, and is for those that still moved or left the bracket.
    Callers give the derivatives of the root, none is taken through the loop.

    Args:
        problem: of the arguments; also called with 0 in place of those of entries that are found.
        arguments: broadcast against each other, one of each for an entry.
        steps: that all take; enough for all but rare entries.
    """
    free = problem(*arguments)

    def newton(x):
        value, slope = free.value_and_slope(x)
        return x - value / slope

    last = jax.lax.fori_loop(0, steps - 1, lambda _, x: newton(x), free.start)
    x = newton(last)
    found = (jnp.abs(x - last) <= free.least_step(last)) & (x >= free.low) & (x <= free.high)

    def in_bracket(state):
        x, found = state
        # Not of the arguments as they are: a compiler would take what never changes out of this
        # loop, and compute it also where all are found.
        left = (jnp.where(found, 0, v) for v in arguments)
        return jnp.where(found, x, _root_in_bracket(problem(*left))), jnp.ones_like(found)

    begin = x, found | ~free.solvable
    x = jax.lax.while_loop(lambda state: ~every(state[1]), in_bracket, begin)[0]
    return jnp.where(free.solvable, x, jnp.nan)


def _root_in_bracket(problem: Rising):
    """Up to 68 Newton steps; a step that leaves the bracket goes to its middle instead."""
    value_and_slope, least_step, start, low, high, solvable = problem

    def moving(x, step):
        return jnp.abs(step) > least_step(x)

    def newton_where_moving(state):
        x, low, high, step, count = state
        value, slope = value_and_slope(x)
        low, high = jnp.where(value < 0, x, low), jnp.where(value < 0, high, x)
        new, within = x - value / slope, least_step(x)
        # By rounding a good step may end beside the bracket; a middle could pass for the last one.
        inside = (new >= low - within) & (new <= high + within)
        new = jnp.where(inside, jnp.clip(new, low, high), (low + high) / 2)
        # What has settled stays, whatever the others do: no row knows of its neighbours.
        goes = moving(x, step)
        return jnp.where(goes, new, x), low, high, jnp.where(goes, new - x, step), count + 1

    def unsettled(state):
        x, _, _, step, count = state
        return ~every(~moving(x, step)) & (count < 68)

    x = jnp.clip(start, low, high)
    begin = x, low, high, jnp.where(solvable, jnp.inf, 0), jnp.zeros((), jnp.int32)
    return jax.lax.while_loop(unsettled, newton_where_moving, begin)[0]


@jax.custom_jvp
def quintic_ratio(u: Float[Array, "*n"], v: Float[Array, "*n"]) -> Float[Array, "*n"]:
    r"""Root g of g + u g^3 + v g^5 = 1 on the branch through g = 1 at u = v = 0.

    The scaled form of d + b d^3 + e d^5 = t with d = t g, u = b t^2, v = e t^4. Newton steps, kept
    in a bracket that ends at the fold (the first zero of 1 + 3 u g^2 + 5 v g^4): on it the left
    side rises, so that there is one root or, past the fold, none. Past it, and where an argument
    is not finite, the result is NaN.

    The derivative is implicit, -(g^3 du + g^5 dv) / (1 + 3 u g^2 + 5 v g^4), to any order.
    """
    return _quintic_root(*jnp.broadcast_arrays(u, v))


def quintic_past_fold(u: Float[Array, "*n"], v: Float[Array, "*n"]) -> Bool[Array, "*n"]:
    """Whether `quintic_ratio` has no root because it lies past the fold."""
    folds, top = _quintic_fold(u, v)
    return folds & (_quintic(u, v, top) < 0)


def _quintic(u, v, g):
    q = g * g
    return g * (1 + q * (u + v * q)) - 1


def _quintic_fold(u, v):
    """Whether there is a fold, and a bound of the root: the fold, or else 9/4.

    Without a fold 9 u^2 < 20 v where u < 0, so that 1 + u g^2 + v g^4 is 4/9 at least.
    """
    squared = first_positive_root(jnp.ones_like(u), 3 * u, 5 * v)
    folds = jnp.isfinite(squared)
    return folds, jnp.where(folds, jnp.sqrt(jnp.where(folds, squared, 1)), 2.25)


def _quintic_start(u, v, folds, top):
    """A start for each shape: the part that is hardest alone, or the parabola below the fold."""
    hard = jnp.minimum(jnp.maximum(u, 1) ** (-1 / 3), jnp.maximum(v, 1) ** (-1 / 5))
    hard = jnp.minimum(hard, top)
    over, curved = _quintic(u, v, top), -top * (6 * u + 20 * v * (top * top))
    bent = folds & (curved > 0) & (over > 0)
    soft = top - jnp.sqrt(jnp.where(bent, 2 * over / jnp.where(bent, curved, 1), 1))
    soft = jnp.where(bent & (soft > 0), soft, hard)
    return jnp.where(jnp.abs(_quintic(u, v, soft)) < jnp.abs(_quintic(u, v, hard)), soft, hard)


def _quintic_root(u, v):
    """Root of `quintic_ratio`: 4 to 6 Newton steps, up to 74 within some 1e-6 of the fold."""
    known = jnp.isfinite(u + v)
    g = rising_root(_quintic_problem, jnp.where(known, u, 0), jnp.where(known, v, 0), steps=6)
    return jnp.where(known, g, jnp.nan)


def _quintic_problem(u, v) -> Rising:
    """The equation of `quintic_ratio`."""
    folds, top = _quintic_fold(u, v)

    def value_and_slope(g):
        return _quintic(u, v, g), 1 + g * g * (3 * u + 5 * v * (g * g))

    return Rising(
        value_and_slope,
        least_step=lambda g: newton_tolerance(g.dtype) * g,
        start=_quintic_start(u, v, folds, top),
        low=jnp.zeros_like(u),
        high=top,
        solvable=~(folds & (_quintic(u, v, top) < 0)),
    )


@quintic_ratio.defjvp
def _quintic_ratio_jvp(primals, tangents):
    (u, v), (du, dv) = primals, tangents
    g = quintic_ratio(u, v)
    q = g * g
    return g, -q * g * (du + q * dv) / (1 + q * (3 * u + 5 * v * q))
