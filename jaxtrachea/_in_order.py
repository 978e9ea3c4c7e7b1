"""Small parts of a large program, which XLA for CPUs is to run in order.

It runs a computation in order where every array has at most 512 bytes, or where there are at most
eight kernels. Else it keeps a graph and a queue of what is ready: for hundreds of small kernels
that takes half as long again as they do. One large array (a surface) is enough for that, unless the
small part is a computation of its own.
"""

from collections.abc import Callable
from typing import TypeVar

import jax
from jax.core import Tracer
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

Out = TypeVar("Out")


def in_order(part: Callable[..., Out]) -> Callable[..., Out]:
    """The same function, compiled as a computation of its own: one pose at a time, on a CPU.

    Many lanes at once, or on another device, it is compiled into the program around it as if this
    were not here. Values and derivatives are the same.

    Args:
        part: from arrays to arrays (or trees of them); may close over traced ones.
    """

    def run(*arguments):
        if not any(isinstance(v, Tracer) for v in jax.tree.leaves(arguments)):
            return part(*arguments)
        leaves, tree = jax.tree.flatten(jax.jit(part)(*arguments))
        # One result is enough: what is marked is the call that it comes from.
        return jax.tree.unflatten(tree, [_not_inlined_p.bind(leaves[0]), *leaves[1:]])

    return run


#: The identity, that marks what its argument comes from.
_not_inlined_p = Primitive("not_inlined")
_not_inlined_p.def_impl(lambda x: x)
_not_inlined_p.def_abstract_eval(lambda x: x)


def _jvp(primals, tangents):
    return _not_inlined_p.bind(*primals), tangents[0]


def _lanes(arguments, axes):
    (x,), (axis,) = arguments, axes
    return (_not_inlined_p.bind(x) if x.shape[axis] == 1 else x), axis


ad.primitive_jvps[_not_inlined_p] = _jvp
batching.primitive_batchers[_not_inlined_p] = _lanes
_mark = mlir.lower_fun(lambda x: set_xla_metadata(x, inlineable="false"), multiple_results=False)
# Not cacheable: a function of its own would not see where its argument comes from.
mlir.register_lowering(_not_inlined_p, _mark, platform="cpu", cacheable=False)
mlir.register_lowering(_not_inlined_p, lambda _, x: [x])
