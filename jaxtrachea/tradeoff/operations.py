"""How much a program computes: its operations, counted in the traced program.

One operation is one element of one result; a product of matrices counts two for each term. The body
of a loop counts as often as it runs. What does not reach a result is not counted, as the compiler
would drop it.
"""

import math
from collections.abc import Callable
from typing import Any

import jax

#: Moves of data, not operations.
FREE = {"reshape", "broadcast_in_dim", "squeeze", "stack", "transpose", "slice", "concatenate",
        "copy", "convert_element_type", "stop_gradient", "iota", "rev", "pad", "split",
        "expand_dims"}  # fmt: skip


def count_operations(function: Callable, *arguments: Any) -> int:
    """Operations of `function` for arguments of these shapes.

    A `while` loop without a fixed number of turns counts as one turn.
    """
    closed = jax.make_jaxpr(function)(*arguments)
    return _count(closed.jaxpr, [True] * len(closed.jaxpr.outvars))[0]


def _count(jaxpr, wanted: list[bool]) -> tuple[int, list[bool]]:
    """Operations that the wanted results need, and which inputs they read."""
    live = {v for v, want in zip(jaxpr.outvars, wanted, strict=True) if want and _is_variable(v)}
    total = 0
    for equation in reversed(jaxpr.eqns):
        out = [v in live for v in equation.outvars]
        if not any(out) and not equation.effects:
            continue
        cost, reads = _equation(equation, out)
        total += cost
        live |= {v for v, r in zip(equation.invars, reads, strict=True) if r and _is_variable(v)}
    return total, [v in live for v in jaxpr.invars]


def _is_variable(atom) -> bool:
    return not hasattr(atom, "val")


def _equation(equation, out: list[bool]) -> tuple[int, list[bool]]:
    name, parameters = equation.primitive.name, equation.params
    everything = [True] * len(equation.invars)
    inner = None if name == "reduce" else _inner(parameters)  # how two entries become one
    if name == "cond":
        return max(_count(b.jaxpr, out)[0] for b in parameters["branches"]), everything
    if name == "scan":
        body = parameters["jaxpr"].jaxpr
        return parameters["length"] * _count(body, [True] * len(body.outvars))[0], everything
    if name == "while":
        body = parameters["body_jaxpr"].jaxpr
        return _count(body, [True] * len(body.outvars))[0], everything
    if inner is not None and len(inner.outvars) == len(out):
        cost, reads = _count(inner, out)
        return cost, reads if len(reads) == len(everything) else everything
    if name in FREE:
        return 0, everything
    size = sum(math.prod(v.aval.shape) for v in equation.outvars)
    if name == "dot_general":
        (contracted, _), _ = parameters["dimension_numbers"]
        size *= 2 * math.prod(equation.invars[0].aval.shape[i] for i in contracted)
    return size, everything


def _inner(parameters: dict):
    """The program that a call contains, or None."""
    if "way" in parameters:  # of a linear part
        return parameters["way"].closed.jaxpr
    for key in ("jaxpr", "call_jaxpr", "fun_jaxpr", "call"):
        if key in parameters:
            return getattr(parameters[key], "jaxpr", parameters[key])
    return None
