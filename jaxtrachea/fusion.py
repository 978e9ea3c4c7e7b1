"""Parts of a program that XLA for CPUs is to run as a single kernel, or one lane after the other.

Starting a kernel takes as long as some hundred operations. What XLA makes of its own small loops
can be asked for: the whole part in one function, with loops and branches, `fuse`. That is for
parts whose arrays are small: one thread works through them. A kernel calls no library and holds no
scatter: a product of matrices is written as a sum (`_numerics.product`, `turned`; of a part that is
also called in batches by `_written_out`), a choice by place as a sum of choices (`picked`), the
lowest of many found one by one (`lowest`).

A mark stays where it makes a row of the mission 1.3 times as fast (tests/bench/marks.py).

With the environment variable `JAXTRACHEA_ONE_KERNEL` set to 0 there are no single kernels: for
programs that are exported to another version of jaxlib, or should a compiler refuse one.
"""

import contextlib
import dataclasses
import functools
import math
import os
import sys
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import jaxlib.version
from jax.core import Tracer
from jax.custom_batching import custom_vmap
from jax.custom_derivatives import SymbolicZero, zero_from_primal
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir

from jaxtrachea._linear import linear, over_lanes, replaced
from jaxtrachea._written_out import written_out

Out = TypeVar("Out")
#: Names of the operations that mark a call: no work, and what they give is the first operand.
MARKS = "one_kernel", "hidden"
#: Versions of jaxlib whose compiler was seen to do `fuse` right (tests/test_fusion.py). A
#: compiler that cannot put a part into one kernel refuses the program or ends the process: with
#: others the part is compiled as it stands.
SUPPORTED_JAXLIB = ("0.10.2", "0.11.2", "0.12.0.1")


def fuse(
    part: Callable[..., Out], *, products: bool = False, streams: bool = False
) -> Callable[..., Out]:
    """The same function, compiled into a single kernel: one call at a time, on a CPU.

    For programs of many small operations, whose time goes into starting kernels. It works where
    the call is traced (under `jit`); a batch (`vmap`), another device or another compiler than
    those of `SUPPORTED_JAXLIB` gets the function as it is. Not where it does what `FITTING` lacks
    (products of matrices, but see `products`; linear algebra, sorting with `top_k`, `.at[]`),
    reduces more than `REDUCED` entries, or has arrays that are not `SMALL` or not of numbers: that
    is compiled as it stands.
    So it is with its derivatives, each by itself. Values and derivatives are the same but for
    rounding. A derivative begins with the part once more: of a batch it takes somewhat longer than
    that of the function by itself, so mark what is called one at a time.

    Args:
        part: from arrays to arrays (or trees of them) of any dtype; pure, may close over traced
            ones. Its errors are passed on.
        products: whether products of matrices of at most 64 terms are written out as sums, so that
            they can be part of the kernel; a batch has the library's, which are quicker there.
            Twice backwards through a loop then only from JAX 0.11 on.
        streams: whether arrays of any size are taken: of a loop whose rounds wait for each other,
            and each read a slice, there is nothing for a second thread to do.
    """
    return _called(part, _kernel_of_products if products else _kernel, streams=streams)


def map_sequentially(part: Callable[..., Out]) -> Callable[..., Out]:
    """The same function; of many lanes (`vmap`), on a CPU, one lane after the other.

    For parts that are a large array and go through it several times: those of many lanes are out of
    the cache before they are read again. A lane, on a CPU, is then as if there were no other:
    `fuse` inside is what it says. Small arrays (`_linear.LARGE`) and other devices take all lanes
    together. Values and derivatives are the same but for rounding; derivatives begin with the part
    once more, and are taken in turn too; twice backwards through a loop only from JAX 0.11 on.

    Args:
        part: from arrays to arrays (or trees of them); may close over traced ones.
    """
    return _called(part, _in_turn)


def _called(
    part: Callable[..., Out], how: Callable, *, streams: bool = False
) -> Callable[..., Out]:
    """The part as a call of its own, made by `how`; as it is where a kernel cannot hold it."""

    def run(*arguments):
        kernel = how is not _in_turn
        if (kernel and _one_kernel_p is None) or not _traced(arguments):
            return part(*arguments)
        closed, shape = jax.make_jaxpr(part, return_shape=True)(*arguments)
        if not closed.jaxpr.outvars:
            return part(*arguments)
        own = [i for i, v in enumerate(closed.consts) if isinstance(v, Tracer)]
        given = [*(closed.consts[i] for i in own), *jax.tree.leaves(arguments)]

        # Without what is traced, which would be kept for as long as the derivatives are. From JAX
        # 0.11 on a `Jaxpr` holds its constants itself.
        kept = replaced(closed.consts, own, [None] * len(own))
        jaxpr = ClosedJaxpr(closed.jaxpr, kept).jaxpr
        # What is not read is not asked for: another call would compute it.
        variables = [*(jaxpr.constvars[i] for i in own), *jaxpr.invars]
        used = _read(jaxpr)
        read = [i for i, v in enumerate(variables) if v in used]
        if not read:
            return part(*arguments)

        def plain(*inputs):
            values = replaced([None] * len(variables), read, inputs)
            consts = replaced(kept, own, values[: len(own)])
            return jaxpr_as_fun(ClosedJaxpr(jaxpr, consts))(*values[len(own) :])

        def changing(moving):
            return _changing(jaxpr, {variables[read[i]] for i in moving})

        inputs = [given[i] for i in read]
        if kernel:
            products = how is _kernel_of_products
            alone = written_out(jax.make_jaxpr(plain)(*inputs)).jaxpr if products else jaxpr
            if not fits_one_kernel(alone, sys.maxsize if streams else SMALL):
                return part(*arguments)
        found = _differentiable(plain, changing, how)(*inputs)
        return jax.tree.unflatten(jax.tree.structure(shape), found)

    return run


def _read(jaxpr: Jaxpr) -> set:
    """The variables that an operation or a result reads."""
    used = [*(v for eqn in jaxpr.eqns for v in eqn.invars), *jaxpr.outvars]
    return {v for v in used if not isinstance(v, Literal)}


def _inexact(variable) -> bool:
    return jnp.issubdtype(variable.aval.dtype, jnp.inexact)


def _changing(jaxpr: Jaxpr, moving: set) -> list[int]:
    """Which results change with some of the variables; those of whole numbers do not."""
    for eqn in jaxpr.eqns:
        if any(not isinstance(v, Literal) and v in moving for v in eqn.invars):
            moving = moving | {v for v in eqn.outvars if _inexact(v)}
    results = enumerate(jaxpr.outvars)
    return [i for i, v in results if not isinstance(v, Literal) and v in moving]


def _differentiable(plain: Callable, changing_with: Callable, how: Callable) -> Callable:
    """`plain` as a call; its derivatives, there and back, are calls too.

    Args:
        plain: from arrays to a list of arrays; what it closes over is not traced.
        changing_with: from the places of arrays to those of the results that change with them.
        how: `_kernel`, `_kernel_of_products` or `_in_turn`; so are its derivatives then, if they
            can be.
    """

    @jax.custom_jvp
    def call(*inputs):
        return how(plain, inputs)

    def derivatives(inputs, tangents):
        moving = [i for i, t in enumerate(tangents) if not isinstance(t, SymbolicZero)]
        out = call(*inputs)
        changing = changing_with(moving)

        def along(inputs, shown):
            def part(*moved):
                found = plain(*replaced(inputs, moving, moved))
                return [found[i] for i in shown]

            return part, [inputs[i] for i in moving]

        def push(inputs, tangents):
            part, at = along(inputs, changing)
            return jax.jvp(part, at, list(tangents))[1]

        def pull(inputs, cotangents):
            given = {i: v for i, v in zip(changing, cotangents, strict=True) if v is not None}
            part, at = along(inputs, given)
            return list(jax.vjp(part, *at)[1](list(given.values())))

        change = []
        if changing:
            # Lanes of a linear part are taken in turn already.
            ways = (push, pull) if how is _in_turn else (_called(push, how), _called(pull, how))
            like = [out[i] for i in changing]
            change = linear(*ways, inputs, [tangents[i] for i in moving], like)
        return out, replaced(zero_from_primal(out, symbolic_zeros=True), changing, change)

    call.defjvp(derivatives, symbolic_zeros=True)
    return call


@dataclasses.dataclass(frozen=True, eq=False)
class _Way:
    """What a part does, and whether it is a kernel or compiled into the program around it."""

    closed: ClosedJaxpr
    kernel: bool

    def plain(self, *inputs) -> list:
        return jaxpr_as_fun(self.closed)(*inputs)


def _kernel(plain: Callable, inputs) -> list:
    return _part_p.bind(*inputs, way=_Way(jax.make_jaxpr(plain)(*inputs), kernel=True))


def _marked(*inputs, way: _Way) -> list:
    """What a part is lowered to on a CPU: a call with a mark on its first result."""

    def whole(*inputs):
        read = [jnp.ravel(v)[0] for v in inputs]
        return list(way.plain(*inputs)), jnp.stack([jnp.asarray(v, jnp.float32) for v in read])

    # The compiler ends the process over an input that a kernel does not read: constants are
    # hidden from it, which it would write into the part, and every input is read.
    assert _hidden_p is not None
    assert _one_kernel_p is not None
    leaves, read = jax.jit(whole)(*(_hidden_p.bind(v, *inputs) for v in inputs))
    leaves[0] = _one_kernel_p.bind(leaves[0], read, *inputs)
    return leaves


def _kernel_of_products(plain: Callable, inputs) -> list:
    @custom_vmap
    def alone(*inputs):
        sums = written_out(jax.make_jaxpr(plain)(*inputs))
        return _kernel(jaxpr_as_fun(sums), inputs)

    @alone.def_vmap
    def _(count, has_lanes, *inputs):
        if count == 1:
            one = [v[0] if lanes else v for v, lanes in zip(inputs, has_lanes, strict=True)]
            out = [v[None] for v in alone(*one)]
        else:
            out = jax.vmap(plain, [0 if lanes else None for lanes in has_lanes])(*inputs)
        return out, [True] * len(out)

    return alone(*inputs)


def _in_turn(plain: Callable, inputs) -> list:
    @custom_vmap
    def call(*inputs):
        return list(plain(*inputs))

    @call.def_vmap
    def _(count, has_lanes, *inputs):
        own = [i for i, lanes in enumerate(has_lanes) if lanes]

        def one(f):
            return lambda lane: list(f(*replaced(inputs, own, lane)))

        # A lane may itself be of many: of those that are taken in turn the next `vmap` is told.
        out = over_lanes(one(call), one(plain), [inputs[i] for i in own], count, like)
        return out, [True] * len(out)

    like = jax.eval_shape(call, *inputs)
    return call(*inputs)


def _traced(arguments) -> bool:
    return any(isinstance(v, Tracer) for v in jax.tree.leaves(arguments))


#: What the compiler puts into one kernel; besides loops, branches and what works entry by entry.
FITTING = frozenset(
    """abs add add_any and argmax argmin atan2 bitcast_convert_type broadcast_in_dim ceil clamp
    closed_call concatenate cond convert_element_type copy cos cumsum custom_jvp_call
    custom_vjp_call custom_vmap_call div dynamic_slice dynamic_update_slice eq erf erf_inv exp
    exp2 expm1 floor gather ge gt integer_pow iota is_finite jit le le_to linear log log1p
    logistic lt max min mul ne neg nextafter not optimization_barrier or pad part pjit pow
    reduce_and reduce_max reduce_min reduce_or reduce_prod reduce_sum rem reshape rev round
    rsqrt scan select_n sign sin slice split sqrt square squeeze stack stop_gradient sub tan
    tanh transpose unstack while xor""".split()
)
#: Entries of one array, also between two operations, up to which one thread is as good as many.
SMALL = 1 << 16
#: Entries of which a sum, a maximum ... may be taken. The compiler gives those of 4,096 or more to
#: a library, also by rows, and then refuses the kernel they are in.
REDUCED = 4000


def fits_one_kernel(jaxpr: Jaxpr, most: int = SMALL) -> bool:
    """Whether all that is computed can be in one kernel, and no array has more entries."""
    results = [v for eqn in jaxpr.eqns for v in eqn.outvars]
    arrays = (*jaxpr.invars, *jaxpr.constvars, *jaxpr.outvars, *results)
    if not all(_entries(v) <= most for v in arrays):
        return False
    return all(
        eqn.primitive.name in FITTING
        and (not _reduces(eqn) or all(_entries(v) <= REDUCED for v in eqn.invars))
        and all(fits_one_kernel(sub, most) for sub in _inside(eqn))
        for eqn in jaxpr.eqns
    )


def _inside(eqn) -> list[Jaxpr]:
    from jax.extend.core import jaxprs_in_params  # not of all versions

    way = eqn.params.get("way")  # of `linear`
    return [way.closed.jaxpr] if way else list(jaxprs_in_params(eqn.params))


def _reduces(eqn) -> bool:
    return eqn.primitive.name.startswith(("reduce_", "arg"))


def _entries(variable) -> float:
    """How many numbers an array has; infinite where it has none, or is of something else."""
    shape, dtype = variable.aval.shape, variable.aval.dtype
    # float0: what JAX puts where whole numbers have no derivative; nothing reads it.
    kinds = jnp.bool_, jnp.integer, jnp.floating, jax.dtypes.float0
    numbers = any(jnp.issubdtype(dtype, kind) for kind in kinds)
    return float(math.prod(shape)) if numbers and math.prod(shape) else math.inf


def _mark(name: str, lowering: Callable) -> Any:
    """The identity of its first operand, with a lowering of its own; only in what is lowered.

    Args:
        name: of the operation.
        lowering: of all operands.

    Returns:
        None where this JAX does not offer what it takes (0.6).
    """
    try:
        from jax.extend.core import Primitive
        from jax.interpreters import mlir

        one = jax.ShapeDtypeStruct((), "float32")
        jax.eval_shape(lowering, one, one)
        primitive = Primitive(name)
        primitive.def_impl(lambda x, *_: x)
        primitive.def_abstract_eval(lambda x, *_: x)

        lower = mlir.lower_fun(lowering, multiple_results=False)
        # Not cacheable: a function of its own would not see where its argument comes from.
        mlir.register_lowering(primitive, lower, cacheable=False)
    except (ImportError, AttributeError, TypeError):
        return None
    return primitive


def _evaluated(*inputs, way: _Way) -> list:
    return list(jax.jit(way.plain)(*inputs))


def _lowered(context, *inputs, way: _Way):
    on_cpu = tuple(context.module_context.platforms) == ("cpu",)
    if not (on_cpu and way.kernel):
        return mlir.lower_fun(way.plain, multiple_results=True)(context, *inputs)
    call = functools.partial(_marked, way=way)
    return mlir.lower_fun(call, multiple_results=True)(context, *inputs)


def _lanes(inputs, axes, *, way: _Way):
    """Of one lane the part itself; many are compiled into the program around them.

    All results have lanes then, also those that are the same in all of them: their derivatives have
    lanes, and under `jit` JAX takes it for granted that the two are alike.
    """
    count = next(v.shape[i] for v, i in zip(inputs, axes, strict=True) if i is not None)
    if count == 1:
        one = [v if i is None else jnp.squeeze(v, i) for v, i in zip(inputs, axes, strict=True)]
        found = [v[None] for v in _part_p.bind(*one, way=way)]
    else:
        closed = jax.make_jaxpr(jax.vmap(way.plain, in_axes=axes))(*inputs)
        found = _part_p.bind(*inputs, way=_Way(closed, kernel=False))
    return found, [0] * len(found)


def _jvp(primals, tangents, *, way: _Way):
    """For JAX before 0.11, which drops the rule of the call in reverse mode of loops."""
    moving = [i for i, t in enumerate(tangents) if type(t) is not ad.Zero]

    def of(*moved):
        return way.plain(*replaced(primals, moving, moved))

    at, along = ([v[i] for i in moving] for v in (primals, tangents))
    found, changes = jax.jvp(of, at, along)
    return found, [
        t if jnp.issubdtype(v.dtype, jnp.inexact) else ad.Zero(jax.typeof(v).to_tangent_aval())
        for v, t in zip(found, changes, strict=True)
    ]


def _without_unread(used: list[bool], *rest):
    """Of a part whose results are not all read: the part of those that are, if JAX asks for it."""
    from jax.interpreters.partial_eval import dce_jaxpr

    eqn = rest[-1]
    way = eqn.params["way"]
    if not any(used):
        return [False] * len(eqn.invars), None
    jaxpr, reads = dce_jaxpr(way.closed.jaxpr, used)
    return reads, eqn.replace(
        invars=[v for v, read in zip(eqn.invars, reads, strict=True) if read],
        outvars=[v for v, read in zip(eqn.outvars, used, strict=True) if read],
        params={"way": _Way(ClosedJaxpr(jaxpr, way.closed.consts), way.kernel)},
    )


#: A part as one operation, which JAX does not look into where it takes programs apart: not where it
#: moves what a loop has in common out of it, say.
_part_p = Primitive("part")
_part_p.multiple_results = True
_part_p.def_impl(_evaluated)
_part_p.def_abstract_eval(lambda *_, way: way.closed.out_avals)
ad.primitive_jvps[_part_p] = _jvp
batching.primitive_batchers[_part_p] = _lanes
mlir.register_lowering(_part_p, _lowered)
with contextlib.suppress(ImportError, AttributeError):
    from jax.interpreters.partial_eval import dce_rules

    dce_rules[_part_p] = _without_unread


def _told(**metadata: str) -> Callable:
    """Tells the compiler something about the call that its first operand comes from."""

    def lowering(x, *_):
        from jax.experimental.xla_metadata import set_xla_metadata

        return set_xla_metadata(x, **metadata)

    return lowering


def _all_read(x, *rest):
    """x, once the rest is computed too."""
    return jax.lax.optimization_barrier((x, *rest))[0]


_one_kernel_p = _hidden_p = None
if (
    jaxlib.version.__version__ in SUPPORTED_JAXLIB
    and os.environ.get("JAXTRACHEA_ONE_KERNEL") != "0"
):
    _small_call = _told(inlineable="false", xla_cpu_small_call="true")
    _one_kernel_p = _mark(
        MARKS[0], lambda x, read, *_: _all_read(_small_call(x), _small_call(read))
    )
    _hidden_p = _mark(MARKS[1], lambda x, *_: jax.lax.optimization_barrier(x))
