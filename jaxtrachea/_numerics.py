"""Small numerical pieces shared by every room: guarded functions and tiny linear solves.

Everything here keeps the dtype of its input, is smooth where it says so, and is guarded *before*
the singular operation, so that derivatives stay finite.
"""

import functools
from collections.abc import Callable, Iterable
from typing import NamedTuple, TypeVar, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Num

Function = TypeVar("Function", bound=Callable)


def epsilon(dtype) -> float:
    """Spacing of floating-point numbers at one for `dtype`."""
    return float(jnp.finfo(dtype).eps)


def full_precision(function: Function) -> Function:
    """The function, with its products of matrices in the precision of their dtype.

    A GPU multiplies float32 with 10 bits (TF32) by default: presses of deforming sections err by
    1e-4 then, or do not converge. It holds for what is traced inside; a rule for derivatives is
    traced later and needs it too.
    """

    @functools.wraps(function)
    def run(*arguments, **words):
        with jax.default_matmul_precision("highest"):
            return function(*arguments, **words)

    return cast(Function, run)


#: Entries up to which a reduction is written out, and most that one may have: of more, XLA for CPUs
#: makes a `reduce-window`, which fuses with nothing.
WRITTEN_OUT, ONE_REDUCTION = 8, 32


def added(terms: Iterable[Array]) -> Array:
    """The sum of at least one array, in order."""
    return functools.reduce(jnp.add, terms)


def total(x: Num[Array, "*rows n"]) -> Num[Array, "*rows"]:
    """Sum over the last axis, such that XLA for CPUs starts few kernels and vectorises them.

    The order of summation differs from that of `jnp.sum`, and whole numbers keep their dtype.

    Args:
        x: n >= 1 entries in each row.
    """
    return _reduced(functools.partial(jnp.sum, dtype=x.dtype), jnp.add, x)


def product(a: Float[Array, "*rows k"], b: Float[Array, "k ..."]) -> Float[Array, "..."]:
    """The product of small matrices (or of a matrix and a vector), written out.

    XLA for CPUs calls a library for `a @ b`: that takes longer than these few operations, and what
    is one kernel cannot do it (`_in_order.one_kernel`).

    Args:
        a: of shape (..., k), k small.
        b: of shape (k,) or (k, n).

    Raises:
        ValueError: the two differ in k.
    """
    if a.shape[-1] != b.shape[0]:
        raise ValueError(f"expected {a.shape[-1]} rows in b, found {b.shape[0]}")
    columns = [a[..., i] for i in range(b.shape[0])]
    if b.ndim == 2:
        columns = [v[..., None] for v in columns]
        b = b.reshape(b.shape[0], *[1] * (a.ndim - 1), b.shape[1])
    terms = [v * row for v, row in zip(columns, b, strict=True)]
    return added(terms)


def picked(values: Float[Array, "*rows n"], index: Int[Array, "*places"]) -> Float[Array, "..."]:
    """`values[..., index]`, as a sum of choices; 0 where there is no such place.

    Going back that is a choice again; of `values[index]` it is a scatter, which no single kernel
    can do (`_in_order.one_kernel`).
    """
    rows, n = values.shape[:-1], values.shape[-1]
    each = values.reshape(*rows, *[1] * index.ndim, n)
    place = jnp.arange(n).reshape([1] * (each.ndim - 1) + [n])
    chosen = index.reshape(*[1] * len(rows), *index.shape, 1) == place
    return total(jnp.where(chosen, each, 0))


def turned(
    matrices: Float[Array, "*many p p"], frame: Float[Array, "p q"]
) -> Float[Array, "*many q q"]:
    """frame^T M frame of each small matrix M, written out as `product` is."""
    half = product(jnp.matrix_transpose(product(matrices, frame)), frame)
    return jnp.matrix_transpose(half)


def largest(x: Float[Array, "*rows n"]) -> Float[Array, "*rows"]:
    """Largest entry along the last axis, NaN where there is one; see `total`.

    Args:
        x: n >= 1 entries in each row.
    """
    return _reduced(jnp.max, jnp.maximum, x)


def first_largest(x: Float[Array, " n"]) -> Int[Array, ""]:
    """Index of the largest entry, of equal ones the first: as `jnp.argmax`.

    XLA for CPUs walks through an `argmax` entry by entry. With a NaN it is some index from 0 to
    n - 1: which one depends on n. A compiler may compute `x` twice, for the largest and to find it,
    and round differently: where no entry is equal, the first within 64 roundings of the largest is
    taken, and without such an entry n - 1. Where that would be a fault, use `jnp.argmax`.

    Args:
        x: n >= 1 entries.
    """
    n = x.shape[0]
    if n <= WRITTEN_OUT:
        return jnp.argmax(x)
    at, most = jnp.arange(n, dtype=jnp.int32), largest(x)
    close = x >= most - 64 * epsilon(x.dtype) * jnp.abs(most)
    first = _reduced(
        jnp.min, jnp.minimum, jnp.where(x == most, at, jnp.where(close, at + n, 2 * n))
    )
    return jnp.minimum(jnp.where(first < n, first, first - n), n - 1)


def lowest(x: Float[Array, " n"], count: int) -> tuple[Int[Array, " count"], Bool[Array, " n"]]:
    """Indices of the lowest entries, rising, and which entries are left.

    A few are found one by one: `jax.lax.top_k` is a kernel of its own, which takes longer and
    cannot be part of another (`_in_order.one_kernel`). Not by `first_largest`, which may miss.

    Args:
        x: no NaN, and at least `count` entries below infinity: else an index may come twice.
        count: of indices, 0 or more.
    """
    at = jnp.arange(x.shape[0], dtype=jnp.int32)
    if count == 0 or count > WRITTEN_OUT:
        found = jax.lax.top_k(-x, count)[1]
        return found, jnp.all(at[:, None] != found[None], axis=1)
    found, left = [], jnp.ones(x.shape, bool)
    for _ in range(count):
        found.append(jnp.argmax(jnp.where(left, -x, -jnp.inf)).astype(jnp.int32))
        left = left & (at != found[-1])
    return jnp.stack(found), left


def _reduced(reduce, pair, x):
    """A reduction along the last axis in columns, which the processor takes several at a time.

    Along a row it takes one entry after the other: their order is part of the result. Entries that
    fill no row are paired with the columns' results: rows filled up would be asked for every entry
    whether it is one, and no longer be taken several at a time.
    """
    while x.shape[-1] > WRITTEN_OUT:
        width = WRITTEN_OUT * -(-x.shape[-1] // (WRITTEN_OUT * ONE_REDUCTION))
        rows = x[..., : x.shape[-1] // width * width].reshape(*x.shape[:-1], -1, width)
        columns = reduce(rows, axis=-2) if rows.shape[-2] > 1 else rows[..., 0, :]
        left = x.shape[-1] % width
        if left:
            ends = pair(columns[..., :left], x[..., -left:])
            columns = jnp.concatenate([ends, columns[..., left:]], axis=-1)
        x = columns
    return _in_pairs(pair, x)


def _in_pairs(pair, x):
    """The entries of the last axis by pairs, the results likewise, down to one."""
    terms = [x[..., i] for i in range(x.shape[-1])]
    while len(terms) > 1:
        rest = terms[len(terms) // 2 * 2 :]
        terms = [pair(a, b) for a, b in zip(terms[::2], terms[1::2], strict=False)] + rest
    return terms[0]


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


def centred_hinge(x: Float[Array, "*n"], width: Float[Array, ""]) -> Float[Array, "*n"]:
    r"""`max(x, 0)` with its corner rounded on both sides, and with the same integral.

    0 for `x <= -width`, `x` for `x >= width`, C2; between, with t = x / w,
    w (5/64 + t/2 + 45/64 t^2 - 25/64 t^4 + 7/64 t^6): `max(x, 0)` averaged over |t| <= 1 with the
    fourth-order kernel 15/32 (1 - t^2) (3 - 7 t^2), whose second moment vanishes. Hence sums over
    samples that lie closer than `width` keep their value, where a one-sided blend (`positive_part`)
    makes them smaller. At most 0.078 w too large (at x = 0), 0.019 w too small (negative before 0).

    Args:
        x: any shape.
        width: half the width of the rounded part, same unit as `x`; 0 or less: `max(x, 0)`.
    """
    sharp = width <= 0
    w = jnp.where(sharp, 1, width).astype(x.dtype)
    t = jnp.clip(x / w, -1, 1)
    t2 = t * t
    blend = w * (5 / 64 + t / 2 + t2 * (45 / 64 + t2 * (-25 / 64 + t2 * (7 / 64))))
    return jnp.where((jnp.abs(x) < w) & ~sharp, blend, jnp.maximum(x, 0))


#: Parts of pi / 2 with few bits each, so that their products with small integers are exact.
_QUARTERS = {
    8: (1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21),
    4: (1.5703125, 4.837512969970703125e-4, 7.54978995489188216e-8),
}
#: Coefficients of (sin r / r - 1) / r^2 and (cos r - 1 + r^2 / 2) / r^4 in r^2 for |r| <= pi / 4.
_SINE = (
    -1.66666666666666324348e-01,
    8.33333333332248946124e-03,
    -1.98412698298579493134e-04,
    2.75573137070700676789e-06,
    -2.50507602534068634195e-08,
    1.58969099521155010221e-10,
)
_COSINE = (
    4.16666666666666019037e-02,
    -1.38888888888741095749e-03,
    2.48015872894767294178e-05,
    -2.75573143513906633035e-07,
    2.08757232129817482790e-09,
    -1.13596475577881948265e-11,
)


@jax.custom_jvp
def cos_sin(x: Float[Array, "*n"]) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Cosine and sine of moderate angles by polynomials: in batches eight times as quick.

    XLA calls the C library for each element; this is arithmetic alone, which it vectorises.

    Args:
        x: rad; exact to two units in the last place for |x| < 1e4 (float32: 1e2).
    """
    turns = jnp.round(x * (2 / jnp.pi))
    r = x
    for part in _QUARTERS[x.dtype.itemsize]:
        r = r - turns * part
    z = r * r
    sine, cosine = (functools.reduce(lambda v, k: v * z + k, p[::-1]) for p in (_SINE, _COSINE))
    sine, cosine = r + r * z * sine, 1 - z / 2 + z * z * cosine
    quadrant = turns - 4 * jnp.floor(turns / 4)
    odd = (quadrant == 1) | (quadrant == 3)
    c, s = jnp.where(odd, sine, cosine), jnp.where(odd, cosine, sine)
    c = jnp.where((quadrant == 1) | (quadrant == 2), -c, c)
    # A polynomial is cheap enough for XLA to compute it again for every use.
    return jax.lax.optimization_barrier((c, jnp.where(quadrant >= 2, -s, s)))


@cos_sin.defjvp
def _cos_sin_jvp(primals, tangents):
    c, s = cos_sin(*primals)
    return (c, s), (-s * tangents[0], c * tangents[0])


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
    x = jax.lax.while_loop(lambda state: ~_all(state[1]), in_bracket, begin)[0]
    return jnp.where(free.solvable, x, jnp.nan)


def _all(x):
    """Whether all entries are true."""
    if x.size <= ONE_REDUCTION:
        return jnp.all(x)
    return _reduced(jnp.all, jnp.logical_and, x.reshape(-1))


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
        return ~_all(~moving(x, step)) & (count < 68)

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


def solve_spd(matrix: Float[Array, "n n"], rhs: Float[Array, " n"]) -> Float[Array, " n"]:
    """Solve a symmetric positive definite system by Cholesky factors.

    Up to 8 unknowns the elimination is written out: under `vmap` it is then one elementwise program
    over all lanes, where a library call would be made per lane. A matrix that is not positive
    definite gives NaN.
    """
    n = rhs.shape[0]
    if n > 8:
        return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(matrix, lower=True), rhs)
    rows: list[list[Array]] = []
    y: list[Array] = []
    for i in range(n):
        row: list[Array] = []
        for j in range(i):
            rest = matrix[i, j] - sum(
                (row[m] * rows[j][m] for m in range(j)), jnp.zeros_like(rhs[0])
            )
            row.append(rest * rows[j][j])
        pivot = matrix[i, i] - sum((v * v for v in row), jnp.zeros_like(rhs[0]))
        row.append(1 / jnp.sqrt(pivot))  # on the diagonal the inverse, which is all that is needed
        y.append((rhs[i] - sum((row[m] * y[m] for m in range(i)), jnp.zeros_like(rhs[0]))) * row[i])
        rows.append(row)
    x: list[Array] = [rhs[0]] * n
    for i in reversed(range(n)):
        below = sum((rows[m][i] * x[m] for m in range(i + 1, n)), jnp.zeros_like(rhs[0]))
        x[i] = (y[i] - below) * rows[i][i]
    return jnp.stack(x)
