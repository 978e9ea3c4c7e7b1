"""Small parts of a large program, which XLA for CPUs is to run in order.

It runs a computation in order where every array has at most 512 bytes, or where there are at most
eight kernels. Else it keeps a graph and a queue of what is ready: for hundreds of small kernels
that takes half as long again as they do. One large array (a surface) is enough for that, unless the
small part is a computation of its own.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
from jax.core import Tracer

Out = TypeVar("Out")
#: Name of the operation that marks a call: no work, and reads its first operand alone.
MARK = "not_inlined"


def in_order(part: Callable[..., Out]) -> Callable[..., Out]:
    """The same function, compiled as a computation of its own: one pose at a time, on a CPU.

    Many lanes at once (`vmap` over an argument, or what gives the first result), on another device,
    or with a JAX that cannot mark a call, it is compiled into the program around it as if this were
    not here; so too where the first result is not used. Values and derivatives are the same, but
    for rounding.

    Args:
        part: from arrays to arrays (or trees of them); may close over traced ones.
    """

    def run(*arguments):
        inputs = jax.tree.leaves(arguments)
        if _not_inlined_p is None or not any(isinstance(v, Tracer) for v in inputs):
            return part(*arguments)
        leaves, tree = jax.tree.flatten(jax.jit(part)(*arguments))
        if leaves:  # one that is used is enough: what is marked is the call that it comes from
            leaves[0] = _not_inlined_p.bind(leaves[0], *inputs)
        return jax.tree.unflatten(tree, leaves)

    return run


def _jvp(primals, tangents):
    return _not_inlined_p.bind(*primals), tangents[0]


def _lanes(operands, axes):
    x, axis = operands[0], axes[0]
    lanes = [v.shape[i] for v, i in zip(operands, axes, strict=True) if i is not None]
    return (x if max(lanes) > 1 else _not_inlined_p.bind(*operands)), axis


def _mark() -> Any:
    """The identity of its first operand, which marks the call that this comes from.

    The others, what goes into the call, tell how many lanes there are: the result may have none.

    Returns:
        None where this JAX does not offer what it takes (0.6).
    """
    try:
        from jax.experimental.xla_metadata import set_xla_metadata
        from jax.extend.core import Primitive
        from jax.interpreters import ad, batching, mlir

        def mark(x, *_):
            return set_xla_metadata(x, inlineable="false")

        jax.eval_shape(mark, jax.ShapeDtypeStruct((), "float32"))
        primitive = Primitive(MARK)
        primitive.def_impl(lambda x, *_: x)
        primitive.def_abstract_eval(lambda x, *_: x)
        ad.primitive_jvps[primitive] = _jvp
        ad.primitive_transposes[primitive] = lambda cotangent, x, *inputs: (
            [cotangent if ad.is_undefined_primal(x) else None, *[None] * len(inputs)]
        )
        batching.primitive_batchers[primitive] = _lanes
        lowered = mlir.lower_fun(mark, multiple_results=False)
        # Not cacheable: a function of its own would not see where its argument comes from.
        mlir.register_lowering(primitive, lowered, platform="cpu", cacheable=False)
        mlir.register_lowering(primitive, lambda _, x, *inputs: [x])
    except (ImportError, AttributeError, TypeError):
        return None
    return primitive


_not_inlined_p = _mark()
