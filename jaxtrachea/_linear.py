"""A linear part of a program together with its transpose, both written by hand.

JAX derives the way back (reverse mode) from the way there, operation by operation. Where both are
known in a better form they are given together: rules for derivatives stay rules for both modes.
"""

import functools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

#: Numbers of a lane from which on lanes are taken in turn on a CPU: together they would be in fresh
#: memory at every call, and out of the cache.
LARGE = 2048
#: From what is fixed and what it is linear in, to results; lists of arrays.
Linear = Callable[[Sequence[Array], Sequence[Array]], Sequence[Array]]


def linear(
    push: Linear, pull: Linear, fixed: Sequence[Array], tangents: Sequence[Array]
) -> list[Array]:
    """`push(fixed, tangents)`, which is transposed into `pull(fixed, cotangents)`.

    Both are differentiated again as they are written, by `fixed` too, and take lanes (`vmap`).

    Args:
        push: linear in its second argument; what it closes over is not traced.
        pull: from cotangents of what `push` gives to those of `tangents`, of the same shapes.
        fixed: what both depend on besides.
        tangents: of floating-point numbers.
    """
    return _bind(push, pull, list(fixed), list(tangents))


def _bind(push: Linear, pull: Linear, fixed: list, tangents: list) -> list:
    closed = jax.make_jaxpr(lambda fixed, t: list(push(fixed, t)))(fixed, tangents)
    # Traced once more where it is transposed only.
    return _linear_p.bind(*fixed, *tangents, closed=closed, pull=pull, split=len(fixed))


def _evaluate(*operands, closed, **_):
    return jaxpr_as_fun(closed)(*operands)


def _pushed(closed) -> Linear:
    return lambda fixed, tangents: jaxpr_as_fun(closed)(*fixed, *tangents)


def _jvp(primals, changes, *, closed, pull, split):
    push, fixed, tangents = _pushed(closed), list(primals[:split]), list(primals[split:])
    moving = [i for i in range(split) if type(changes[i]) is not ad.Zero]
    out, total = _bind(push, pull, fixed, tangents), []
    if any(type(v) is not ad.Zero for v in changes[split:]):
        total.append(_bind(push, pull, fixed, [ad.instantiate_zeros(v) for v in changes[split:]]))
    if moving:
        of = functools.partial(replaced, fixed, moving)
        along = [changes[i] for i in moving]
        total.append(
            jax.jvp(lambda v: push(of(v), tangents), ([fixed[i] for i in moving],), (along,))[1]
        )
    return out, total[0] if len(total) == 1 else list(map(jnp.add, *total))


def replaced(values: Sequence, at: Sequence[int], new: Sequence) -> list:
    """The values, those at some places by new ones."""
    out = list(values)
    for i, v in zip(at, new, strict=True):
        out[i] = v
    return out


def _transpose(cotangents, *operands, closed, pull, split):
    fixed, tangents = list(operands[:split]), operands[split:]
    cotangents = [ad.instantiate_zeros(v) for v in cotangents]
    found = _bind(pull, _pushed(closed), fixed, cotangents)
    shapes = [[(v.shape, v.dtype) for v in part] for part in (found, (t.aval for t in tangents))]
    if shapes[0] != shapes[1]:
        raise TypeError(f"pull gives {shapes[0]}; expected {shapes[1]}, as of the tangents")
    return [None] * split + found


def _lanes(operands, axes, *, closed, pull, split):
    shared = [a is None for a in axes]
    count = next(v.shape[a] for v, a in zip(operands, axes, strict=True) if a is not None)
    operands = [
        v if a is None else jnp.moveaxis(v, a, 0) for v, a in zip(operands, axes, strict=True)
    ]
    large = (
        sum(v.size for v, of_all in zip(operands, shared, strict=True) if not of_all)
        >= LARGE * count
    )
    # Of tangents what all lanes share is repeated: going back, what is repeated adds up.
    tangents = [
        jnp.broadcast_to(v, (count, *v.shape)) if of_all else v
        for v, of_all in zip(operands[split:], shared[split:], strict=True)
    ]
    own = [i for i in range(split) if not shared[i]]

    def over(f: Linear) -> Linear:
        def many(fixed, tangents):
            def one(lane):
                return list(f(replaced(fixed, own, lane[0]), lane[1]))

            lanes = [fixed[i] for i in own], list(tangents)
            if not large:
                return jax.vmap(one)(lanes)
            return jax.lax.platform_dependent(
                lanes, cpu=lambda v: jax.lax.map(one, v), default=jax.vmap(one)
            )

        return many

    out = _bind(over(_pushed(closed)), over(pull), operands[:split], tangents)
    return out, [0] * len(out)


_linear_p = Primitive("linear")
_linear_p.multiple_results = True
_linear_p.def_impl(_evaluate)
_linear_p.def_abstract_eval(
    lambda *_, closed, **__: [ShapedArray(v.shape, v.dtype) for v in closed.out_avals]
)
ad.primitive_jvps[_linear_p] = _jvp
ad.primitive_transposes[_linear_p] = _transpose
batching.primitive_batchers[_linear_p] = _lanes
mlir.register_lowering(_linear_p, mlir.lower_fun(_evaluate, multiple_results=True))
