"""A part of a program that XLA for CPUs runs as a single kernel.

XLA starts a kernel for each of its loops, which takes as long as some hundred operations. Of a
small loop it makes one function with all that is in it; an attribute of a call asks for the same.
The contact of a tool with a mesh is 800 kernels otherwise, and a whole update takes 1.4 times as
long (tests/bench/marks.py). One thread works through such a function, which calls no library and
holds no scatter: a product of small matrices is written as a sum (`_numerics.product`, or of a part
that is also called in batches by `_written_out`), the lowest of many are found one by one
(`_numerics.lowest`).
"""

import functools
import math
import os
import sys
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jaxlib.version
from jax.custom_batching import custom_vmap
from jax.extend.core import ClosedJaxpr, Jaxpr, jaxpr_as_fun

from jaxtrachea._written_out import written_out

#: Versions of jaxlib whose compiler was seen to do it right (tests/test_fusion.py). With others the
#: part is compiled as it stands: a compiler may refuse a program, or end the process. So it is with
#: `JAXTRACHEA_ONE_KERNEL=0` in the environment: for programs exported to another version.
SUPPORTED_JAXLIB = ("0.10.2", "0.11.2", "0.12.0.1")
#: Entries of one array up to which one thread is as good as many.
SMALL = 1 << 16
#: Entries of which a sum, a maximum ... may be taken: of 4,096 or more the compiler asks a library.
REDUCED = 4000
#: What the compiler puts into one kernel: loops, branches and what works entry by entry. It ends
#: the process over others: what calls a library, a scatter.
FITTING = frozenset(
    """abs add add_any and argmax argmin atan2 bitcast_convert_type broadcast_in_dim ceil clamp
    closed_call concatenate cond convert_element_type copy cos cumsum custom_jvp_call
    custom_vjp_call custom_vmap_call div dynamic_slice dynamic_update_slice eq erf erf_inv exp
    exp2 expm1 floor gather ge gt integer_pow iota is_finite jit le le_to linear log log1p
    logistic lt max min mul ne neg nextafter not optimization_barrier or pad pjit platform_index
    pow reduce_and reduce_max reduce_min reduce_or reduce_prod reduce_sum rem reshape rev round
    rsqrt scan select_n sign sin slice split sqrt square squeeze stack stop_gradient sub tan
    tanh transpose unstack while xla_metadata_value xor""".split()
)


def fuse(part: Callable, *, products: bool = False, streams: bool = False) -> Callable:
    """The same function, compiled into a single kernel for one call at a time on a CPU.

    A batch (`vmap`), a derivative, another device, and a part that does not fit, is compiled as it
    stands. Values are the same but for rounding.

    Args:
        part: from arrays to arrays (or trees of them); closes over nothing that is traced.
        products: whether products of matrices of at most 64 terms are written out as sums there, so
            that they can be part of the kernel, which has no marked part in it then; a batch has
            the library's, which are quicker.
        streams: whether arrays of any size are taken: of a loop whose rounds wait for each other,
            and each read a slice, there is nothing for a second thread to do.
    """
    if not _SUPPORTED:
        return part

    most = sys.maxsize if streams else SMALL

    @custom_vmap
    def alone(*given):
        from jax.interpreters.partial_eval import dce_jaxpr  # not of all versions

        closed, shape = jax.make_jaxpr(part, return_shape=True)(*given)
        # What is not read is not asked for: another kernel would compute it.
        jaxpr, read = dce_jaxpr(closed.jaxpr, [True] * len(closed.jaxpr.outvars))
        plain = ClosedJaxpr(jaxpr, closed.consts)
        sums = written_out(plain) if products else plain
        inputs = [v for v, own in zip(jax.tree.leaves(given), read, strict=True) if own]
        found = jaxpr_as_fun(plain)
        if inputs and fits(sums.jaxpr, most):
            marked = functools.partial(_marked, jaxpr_as_fun(sums))
            found = functools.partial(jax.lax.platform_dependent, cpu=marked, default=found)
        return jax.tree.unflatten(jax.tree.structure(shape), found(*inputs))

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

    @call.defjvp
    def _(primals, tangents):
        out, slopes = jax.jvp(part, primals, tangents)
        # Each lane of a batch has all that `alone` gives, what no lane changes too.
        read = [jnp.ravel(v)[0] for v in jax.tree.leaves(primals)]
        lane = functools.reduce(jnp.logical_or, [v == v for v in read])
        return jax.tree.map(lambda v: jnp.where(lane, v, v), out), slopes

    return call


def one_by_one(part: Callable, *rows: Any) -> Any:
    """`jax.vmap(part)(*rows)`; on a CPU row after row, and going back each once more.

    For parts that go through a large array several times: those of many rows are out of the cache
    before they are read again, and fill the memory.
    """
    if len(jax.tree.leaves(rows)[0]) == 1:
        # Without an axis of one: of many slices it would make gathers.
        found = part(*jax.tree.map(lambda v: v[0], rows))
        return jax.tree.map(lambda v: v[None], found)
    again = jax.checkpoint(part)
    return jax.lax.platform_dependent(
        *rows, cpu=lambda *v: jax.lax.map(lambda row: again(*row), v), default=jax.vmap(part)
    )


def _marked(part: Callable, *inputs) -> list:
    """The part as a call with the attribute."""
    from jax.experimental.xla_metadata import set_xla_metadata  # not of all versions

    @jax.jit
    def kernel(*inputs):
        read = jnp.stack([jnp.ravel(v)[0].astype(jnp.float32) for v in inputs])
        return part(*inputs), read

    # The compiler ends the process over an input that a kernel does not read: constants are hidden
    # from it, which it would write into the part, and every input is read.
    inputs = jax.lax.optimization_barrier(inputs)
    found, read = kernel(*inputs)
    marks = {"inlineable": "false", "xla_cpu_small_call": "true"}
    first, read = (set_xla_metadata(v, **marks) for v in (found[0], read))
    found[0] = jax.lax.optimization_barrier((first, read, *inputs))[0]
    return found


def fits(jaxpr: Jaxpr, most: int) -> bool:
    """Whether all that is computed can be in one kernel, and no array has more entries."""
    from jax.extend.core import jaxprs_in_params  # not of all versions

    return _small([*jaxpr.invars, *jaxpr.constvars], most) and all(
        eqn.primitive.name in FITTING
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
