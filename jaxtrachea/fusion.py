"""A part of a program that XLA for CPUs runs as a single kernel.

XLA starts a kernel for each of its loops, which takes as long as some hundred operations. Of a
small loop it makes one function with all that is in it; an attribute of a call asks for the same.
The contact of a tool with a mesh is 800 kernels otherwise, and a whole update takes 1.4 times as
long (tests/bench/marks.py). One thread works through such a function, which calls no library and
holds no scatter: a product of small matrices is written as a sum (`_numerics.product`), the lowest
of many are found one by one (`_numerics.lowest`).
"""

import functools
import math
import os
import sys
from collections.abc import Callable

import jax
import jax.numpy as jnp
import jaxlib.version
from jax.custom_batching import custom_vmap
from jax.extend.core import Jaxpr, jaxpr_as_fun

#: Versions of jaxlib whose compiler was seen to do it right (tests/test_fusion.py). With others the
#: part is compiled as it stands: a compiler may refuse a program, or end the process. So it is with
#: `JAXTRACHEA_ONE_KERNEL=0` in the environment: for programs exported to another version.
SUPPORTED_JAXLIB = ("0.10.2", "0.11.2", "0.12.0.1")
#: Entries of one array up to which one thread is as good as many.
SMALL = 1 << 16
#: Entries of which a sum, a maximum ... may be taken: of 4,096 or more the compiler asks a library.
REDUCED = 4000
#: What calls a library or is a scatter.
ALIEN = ("dot_general", "scatter", "sort", "top_k", "cholesky", "triangular_solve", "eig", "lu")


def fuse(part: Callable, *, streams: bool = False) -> Callable:
    """The same function, compiled into a single kernel for one call at a time on a CPU.

    A batch (`vmap`), a derivative, another device, and a part that does not fit, is compiled as it
    stands. Values are the same but for rounding.

    Args:
        part: from arrays to arrays (or trees of them); closes over nothing that is traced.
        streams: whether arrays of any size are taken: of a loop whose rounds wait for each other,
            and each read a slice, there is nothing for a second thread to do.
    """
    if not _SUPPORTED:
        return part

    fused = functools.partial(_fused, part, sys.maxsize if streams else SMALL)

    @custom_vmap
    def alone(*given):
        return jax.lax.platform_dependent(*given, cpu=fused, default=part)

    @alone.def_vmap
    def _(count, has_lanes, *given):
        if count == 1:
            one = jax.tree.map(lambda v, own: v[0] if own else v, list(given), has_lanes)
            out = jax.tree.map(lambda v: v[None], alone(*one))
        else:
            axes = jax.tree.map(lambda own: 0 if own else None, tuple(has_lanes))
            out = jax.vmap(part, axes)(*given)
        return out, jax.tree.map(lambda _: True, out)

    call = jax.custom_jvp(alone)
    call.defjvp(lambda primals, tangents: jax.jvp(part, primals, tangents))
    return call


def _fused(part: Callable, most: int, *given):
    """The part as a call with the attribute, where it fits."""
    from jax.experimental.xla_metadata import set_xla_metadata  # not of all versions

    closed, shape = jax.make_jaxpr(part, return_shape=True)(*given)
    if not fits(closed.jaxpr, most):
        return part(*given)

    @jax.jit
    def kernel(*inputs):
        read = jnp.stack([jnp.ravel(v)[0].astype(jnp.float32) for v in inputs])
        return jaxpr_as_fun(closed)(*inputs), read

    # The compiler ends the process over an input that a kernel does not read: constants are hidden
    # from it, which it would write into the part, and every input is read.
    inputs = jax.lax.optimization_barrier(jax.tree.leaves(given))
    found, read = kernel(*inputs)
    marks = {"inlineable": "false", "xla_cpu_small_call": "true"}
    first, read = (set_xla_metadata(v, **marks) for v in (found[0], read))
    found[0] = jax.lax.optimization_barrier((first, read, *inputs))[0]
    return jax.tree.unflatten(jax.tree.structure(shape), found)


def fits(jaxpr: Jaxpr, most: int) -> bool:
    """Whether all that is computed can be in one kernel, and no array has more entries."""
    from jax.extend.core import jaxprs_in_params  # not of all versions

    return _small([*jaxpr.invars, *jaxpr.constvars], most) and all(
        not eqn.primitive.name.startswith(ALIEN)
        and _small(eqn.outvars, most)
        and (not eqn.primitive.name.startswith(("reduce_", "arg")) or _small(eqn.invars, REDUCED))
        and all(fits(sub, most) for sub in jaxprs_in_params(eqn.params))
        for eqn in jaxpr.eqns
    )


def _small(variables, most: int) -> bool:
    return all(0 < math.prod(v.aval.shape) <= most for v in variables)


_SUPPORTED = (
    jaxlib.version.__version__ in SUPPORTED_JAXLIB
    and os.environ.get("JAXTRACHEA_ONE_KERNEL") != "0"
)
