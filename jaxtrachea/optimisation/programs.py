"""Programs for batches of problems: compiled once for equal functions, in few sizes and one dtype.

What is compiled is kept by value of the static arguments: the same functions of equal models share
their programs. JAX keeps apart what differs in shapes and dtypes.
"""

from collections.abc import Callable
from typing import Any

import jax

from jaxtrachea._threads import made_once
from jaxtrachea.files import traces
from jaxtrachea.files.traces import Traced


@made_once(maxsize=128)
def program(
    function: Callable,
    *static,
    axes: Any = 0,
    donate: tuple[int, ...] = (),
    unoptimised: bool = False,
) -> Any:
    """`function(*static, ...)`, compiled; the same object for equal arguments.

    Args:
        function: pure; a module's own, not one that is defined anew in every call.
        static: its first arguments, compared and hashed by value (`FitModel`, numbers, words).
        axes: of the other arguments, as `in_axes` of `jax.vmap`; None: no `vmap`.
        donate: of the other arguments, as `donate_argnums` of `jax.jit`.
        unoptimised: compiled without optimisation, in a third of the time: for little work.
    """
    return Traced(function, *static, axes=axes, donate=donate, unoptimised=unoptimised)


def forget() -> None:
    """Let go of all programs, 10 to 40 MB each, where a folder has them to be loaded again."""
    if traces.are_kept():
        program.cache_clear()


def cast(tree: Any, dtype) -> Any:
    """Floating-point numpy arrays of a tree in a dtype; others stay."""
    return jax.tree.map(lambda v: v.astype(dtype, copy=False) if v.dtype.kind == "f" else v, tree)
