"""A traced function with its products of matrices written out as sums.

XLA for CPUs hands `a @ b` to a library. For a few small matrices in a single call that takes longer
than the sum written out, and what is one kernel cannot do it (`_in_order.one_kernel`); for many
lanes the library is quicker. So a part is written with `@`, and this turns it into sums where it is
called alone.
"""

import math

import jax
from jax.extend.core import ClosedJaxpr, Literal
from jaxtyping import Array, Float

from jaxtrachea._numerics import ONE_REDUCTION, added, total

#: Operations that only call what they hold. Their derivatives are not asked for here.
CALLS = frozenset("jit pjit closed_call custom_jvp_call custom_vjp_call custom_vmap_call".split())


def written_out(closed: ClosedJaxpr) -> ClosedJaxpr:
    """The same function without `dot_general`; calls are taken apart, loops and branches kept.

    Args:
        closed: a function; derivatives of the result are those of the operations, so that rules of
            its own (`custom_jvp`) are lost.
    """
    return jax.make_jaxpr(lambda *values: _evaluate(closed, values))(*closed.in_avals)


def is_small_product(eqn) -> bool:
    """Whether an operation is a product of matrices that are small enough to be written out."""
    if eqn.primitive.name != "dot_general":
        return False
    (sum_a, _), _ = eqn.params["dimension_numbers"]
    return 0 < math.prod(eqn.invars[0].aval.shape[i] for i in sum_a) <= ONE_REDUCTION


def product_of(
    a: Float[Array, "..."], b: Float[Array, "..."], dimension_numbers
) -> Float[Array, "..."]:
    """`jax.lax.dot_general`, written out."""
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
        if name == "dot_general":
            out = [product_of(*inputs, eqn.params["dimension_numbers"])]
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
    branches = isinstance(parameter, tuple) and all(isinstance(v, ClosedJaxpr) for v in parameter)
    if branches:
        return tuple(map(written_out, parameter))
    return written_out(parameter) if isinstance(parameter, ClosedJaxpr) else parameter
