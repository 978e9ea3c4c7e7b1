"""A traced function with its products of matrices written out as sums.

XLA for CPUs hands `a @ b` to a library. For a few small matrices in a single call that takes longer
than the sum written out, and what is one kernel cannot do it (`fusion.fuse`); for many
lanes the library is quicker. So a part is written with `@`, and this turns it into sums where it is
called alone.
"""

import math

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Literal
from jaxtyping import Array, Num

from jaxtrachea._numerics import added, total

#: Terms of a sum up to which it is written out.
TERMS = 64
#: Operations that only call what they hold. Their derivatives are not asked for here.
CALLS = frozenset("jit pjit closed_call custom_jvp_call custom_vjp_call custom_vmap_call".split())


def written_out(closed: ClosedJaxpr) -> ClosedJaxpr:
    """The same function with its products of at most `TERMS` terms as sums.

    Loops and branches are kept. Calls are taken apart: with them go marks, and rules of derivatives
    (`custom_jvp`). Operations that hold functions of another kind (`_linear.linear`) stay as they
    are, with what products are in them.
    """
    return jax.make_jaxpr(lambda *values: _evaluate(closed, values))(*closed.in_avals)


def _is_short_product(eqn) -> bool:
    if eqn.primitive.name != "dot_general":
        return False
    (sum_a, _), _ = eqn.params["dimension_numbers"]
    return 0 < math.prod(eqn.invars[0].aval.shape[i] for i in sum_a) <= TERMS


def product_of(a: Num[Array, "..."], b: Num[Array, "..."], dimension_numbers) -> Num[Array, "..."]:
    """`jax.lax.dot_general` of two arrays of one dtype, written out."""
    (sum_a, sum_b), (both_a, both_b) = dimension_numbers
    own_a = [i for i in range(a.ndim) if i not in (*sum_a, *both_a)]
    own_b = [i for i in range(b.ndim) if i not in (*sum_b, *both_b)]
    both, rows = [a.shape[i] for i in both_a], [a.shape[i] for i in own_a]
    columns, terms = [b.shape[i] for i in own_b], math.prod(a.shape[i] for i in sum_a)
    a = a.transpose(*both_a, *own_a, *sum_a).reshape(*both, *rows, *[1] * len(columns), terms)
    b = b.transpose(*both_b, *sum_b, *own_b).reshape(*both, *[1] * len(rows), terms, *columns)
    if not columns:
        return total(a * b)
    along = len(both) + len(rows)
    return added(a[..., i] * jax.lax.index_in_dim(b, i, along, False) for i in range(terms))


def _evaluate(closed: ClosedJaxpr, values):
    known = dict(zip(closed.jaxpr.constvars, closed.consts, strict=True))
    known |= zip(closed.jaxpr.invars, values, strict=True)

    def read(v):
        return v.val if isinstance(v, Literal) else known[v]

    for eqn in closed.jaxpr.eqns:
        inputs, name = [read(v) for v in eqn.invars], eqn.primitive.name
        if _is_short_product(eqn):
            # The dtype of the result may be wider than that of either.
            a, b = (jnp.asarray(v, eqn.outvars[0].aval.dtype) for v in inputs)
            out = [product_of(a, b, eqn.params["dimension_numbers"])]
        elif name in CALLS:
            held = (v for v in eqn.params.values() if isinstance(v, ClosedJaxpr))
            out = _evaluate(next(held), inputs)
        else:
            params = {key: _rewritten(value) for key, value in eqn.params.items()}
            found = eqn.primitive.bind(*inputs, **params)
            out = found if eqn.primitive.multiple_results else [found]
        known |= zip(eqn.outvars, out, strict=True)
    return [read(v) for v in closed.jaxpr.outvars]


def _rewritten(parameter):
    """A parameter of an operation, its body and branches rewritten."""
    # A plain tuple: the named one of a linear solver holds functions of another kind.
    branches = type(parameter) is tuple and all(isinstance(v, ClosedJaxpr) for v in parameter)
    if branches:
        return tuple(map(written_out, parameter))
    return written_out(parameter) if isinstance(parameter, ClosedJaxpr) else parameter
