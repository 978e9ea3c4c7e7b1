"""Small numerical pieces shared by every room: guarded functions and tiny linear solves.

Everything here keeps the dtype of its input, is smooth where it says so, and is guarded *before*
the singular operation, so that derivatives stay finite.
"""

import functools
from collections.abc import Callable, Iterable
from typing import TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap
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
#: Entries up to which a maximum keeps a NaN, see `_greatest`.
BY_MAXIMUM = 4000


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
    is one kernel cannot do it (`fusion.fuse`).

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


@jax.custom_jvp
def scaled(factor: Float[Array, "..."], v: Float[Array, "..."]) -> Float[Array, "..."]:
    """Factor * v, of equal ranks; where a factor is no number it says nothing of v's derivative.

    A row without a solution is NaN, and 0 times NaN would be NaN in the derivative by a v that
    other rows share.
    """
    return factor * v


@scaled.defjvp
def _scaled_jvp(primals, tangents):
    (factor, v), (d_factor, d_v) = primals, tangents
    return factor * v, d_factor * v + jnp.where(jnp.isfinite(factor), factor, 0) * d_v


@jax.custom_jvp
def quotient(v: Float[Array, "..."], divisor: Float[Array, "..."]) -> Float[Array, "..."]:
    """V / divisor, of one shape; where v is no number it says nothing of the divisor: `scaled`."""
    return v / divisor


@quotient.defjvp
def _quotient_jvp(primals, tangents):
    (v, divisor), (d_v, d_divisor) = primals, tangents
    share = jnp.where(jnp.isfinite(v), v, 0) / divisor
    return v / divisor, (d_v - share * d_divisor) / divisor


@jax.custom_jvp
def product_of_rows(rows: Float[Array, "*rows k"], b: Float[Array, "k ..."]) -> Float[Array, "..."]:
    """`product`, of which rows that are no numbers say nothing of b's derivative: see `scaled`."""
    return product(rows, b)


@product_of_rows.defjvp
def _product_of_rows_jvp(primals, tangents):
    (rows, b), (d_rows, d_b) = primals, tangents
    known = jnp.where(jnp.isfinite(rows), rows, 0)
    return product(rows, b), product(d_rows, b) + product(known, d_b)


def picked(values: Float[Array, "*rows n"], index: Int[Array, "*places"]) -> Float[Array, "..."]:
    """`values[..., index]`, as a sum of choices; 0 where there is no such place.

    Going back that is a choice again; of `values[index]` it is a scatter, which no single kernel
    can do (`fusion.fuse`).
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

    `jnp.max` and `jnp.min` are for whole numbers, and for what holds no NaN: see `_greatest`.

    Args:
        x: n >= 1 entries in each row.
    """
    return _reduced(lambda x, axis: _greatest(x), jnp.maximum, x)


@jax.custom_jvp
def _greatest(x):
    """`jnp.max` along the last axis but one that keeps a NaN, of any number of entries and lanes.

    XLA for CPUs gives a maximum or minimum of 4,096 entries and more, those of all rows and lanes
    together, to a library that drops a NaN (jaxlib 0.10.2). A comparison it keeps to itself, but
    puts into no single kernel (`fusion.fuse`): so lanes are told of (`custom_vmap`).
    """
    return _greatest_in_lanes(x)


@_greatest.defjvp
def _greatest_jvp(primals, tangents):
    """As of `jnp.max`: equal entries share it."""
    (x,), (dx,) = primals, tangents
    top = _greatest(x)
    found = x == jnp.expand_dims(top, -2)
    count = jnp.sum(found, axis=-2, dtype=x.dtype)
    return top, jnp.sum(jnp.where(found, dx, 0), axis=-2) / count


@custom_vmap
def _greatest_in_lanes(x):
    if x.size <= BY_MAXIMUM:
        return jnp.max(x, axis=-2)

    def greater(a, b):
        return jnp.where((a >= b) | (a != a), a, b)

    return jax.lax.reduce(x, np.asarray(-np.inf, x.dtype), greater, (x.ndim - 2,))


@_greatest_in_lanes.def_vmap
def _(_, __, x):
    return _greatest_in_lanes(x), True


def every(x: Bool[Array, "*n"]) -> Bool[Array, ""]:
    """Whether all entries are true; as `largest`."""
    if x.size <= ONE_REDUCTION:
        return jnp.all(x)
    return _reduced(jnp.all, jnp.logical_and, x.reshape(-1))


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
    cannot be part of another (`fusion.fuse`). Not by `first_largest`, which may miss.

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
