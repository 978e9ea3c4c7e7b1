"""A linear part of a program together with its transpose, both written by hand.

JAX derives the way back (reverse mode) from the way there, operation by operation. Where both are
known in a better form they are given together: rules for derivatives stay rules for both modes.
"""

import functools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

#: From what is fixed and what it is linear in, to results; lists of arrays.
Linear = Callable[[Sequence, Sequence], Sequence[Array]]


def linear(
    push: Linear, pull: Linear, fixed: Sequence, tangents: Sequence, like: Sequence
) -> list[Array]:
    """`push(fixed, tangents)`, which is transposed into `pull(fixed, cotangents)`.

    Both are differentiated again as they are written, by `fixed` too, and take lanes (`vmap`). What
    is not used is not traced: of a gradient `push`, of a derivative forward `pull`.

    Args:
        push: linear in its second argument; what it closes over is not traced.
        pull: from cotangents of what `push` gives (None for those that are 0) to those of
            `tangents`, of the same shapes.
        fixed: arrays that both depend on besides.
        tangents: arrays of floating-point numbers.
        like: arrays of the shapes and dtypes of what `push` gives.
    """
    way = _Way(push, [_shown(v) for v in (*fixed, *tangents)], len(fixed))
    shown = tuple(_shown(v).strip_weak_type() for v in like)
    return _linear_p.bind(*fixed, *tangents, way=way, pull=pull, shown=shown)


def _shown(v) -> ShapedArray:
    return v if isinstance(v, ShapedArray) else jax.typeof(v)


class _Way:
    """What `push` does with arrays like these, traced when it is asked for."""

    def __init__(self, push: Linear, given: list, split: int):
        self.push, self.given, self.split = push, given, split

    @functools.cached_property
    def closed(self) -> ClosedJaxpr:
        def flat(*operands):
            return list(self.push(operands[: self.split], operands[self.split :]))

        return jax.make_jaxpr(flat)(*self.given)


def _evaluate(*operands, way, **_):
    return jaxpr_as_fun(way.closed)(*operands)


def _parts(operands, way) -> tuple[list, list]:
    return list(operands[: way.split]), list(operands[way.split :])


def _jvp(primals, changes, *, way, pull, shown):
    (fixed, tangents), (of_fixed, of_tangents) = _parts(primals, way), _parts(changes, way)
    moving = [i for i, v in enumerate(of_fixed) if type(v) is not ad.Zero]
    out, terms = linear(way.push, pull, fixed, tangents, shown), []
    if any(type(v) is not ad.Zero for v in of_tangents):
        along = [ad.instantiate_zeros(v) for v in of_tangents]
        terms.append(linear(way.push, pull, fixed, along, shown))
    if moving:
        at, along = ([v[i] for i in moving] for v in (fixed, of_fixed))

        def of(*moved):
            return list(way.push(replaced(fixed, moving, moved), tangents))

        terms.append(jax.jvp(of, at, along)[1])
    return out, terms[0] if len(terms) == 1 else list(map(jnp.add, *terms))


def replaced(values: Sequence, at: Sequence[int], new: Sequence) -> list:
    """The values, those at some places by new ones."""
    out = list(values)
    for i, v in zip(at, new, strict=True):
        out[i] = v
    return out


def _transpose(cotangents, *operands, way, pull, shown):
    fixed, tangents = _parts(operands, way)
    # Those that are 0 stay out: times a slope without bound they would not be.
    given = [i for i, v in enumerate(cotangents) if type(v) is not ad.Zero]
    count, like = len(cotangents), [v.aval for v in tangents]

    def back(fixed, some):
        found = list(pull(fixed, replaced([None] * count, given, some)))
        shapes = [[v.shape for v in part] for part in (found, like)]
        if shapes[0] != shapes[1]:
            raise TypeError(f"pull gives shapes {shapes[0]}; expected {shapes[1]}, as of tangents")
        return [v.astype(t.dtype) for v, t in zip(found, like, strict=True)]

    def there(fixed, tangents):
        found = way.push(fixed, tangents)
        return [found[i] for i in given]

    found = linear(back, there, fixed, [cotangents[i] for i in given], like)
    return [None] * way.split + found


def _lanes(operands, axes, *, way, pull, shown):
    count = next(v.shape[a] for v, a in zip(operands, axes, strict=True) if a is not None)
    in_front = [
        v if a is None else jnp.moveaxis(v, a, 0) for v, a in zip(operands, axes, strict=True)
    ]
    fixed, tangents = _parts(in_front, way)
    # Of tangents what all lanes share is repeated: going back, what is repeated adds up.
    tangents = [
        jnp.broadcast_to(v, (count, *v.shape)) if a is None else v
        for v, a in zip(tangents, axes[way.split :], strict=True)
    ]
    of_lane = [i for i, a in enumerate(axes[: way.split]) if a is not None]

    def over(f: Linear) -> Linear:
        def many(fixed, tangents):
            def one(own, tangents):
                return list(f(replaced(fixed, of_lane, own), tangents))

            return jax.vmap(one)([fixed[i] for i in of_lane], list(tangents))

        return many

    like = [ShapedArray((count, *v.shape), v.dtype) for v in shown]
    out = linear(over(way.push), over(pull), fixed, tangents, like)
    return out, [0] * len(out)


_linear_p = Primitive("linear")
_linear_p.multiple_results = True
_linear_p.def_impl(_evaluate)
_linear_p.def_abstract_eval(lambda *_, shown, **__: list(shown))
ad.primitive_jvps[_linear_p] = _jvp
ad.primitive_transposes[_linear_p] = _transpose
batching.primitive_batchers[_linear_p] = _lanes
mlir.register_lowering(_linear_p, mlir.lower_fun(_evaluate, multiple_results=True))
