"""A function of one lane over many lanes, in batches of one size."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jaxtyping import Int

from jaxtrachea.fitting.study import Study
from jaxtrachea.optimisation.programs import cast, program


def map_lanes(
    function: Callable,
    study: Study,
    *arrays: np.ndarray,
    batch: int,
    rows: Int[np.ndarray, " n"] | None = None,
    static: tuple = (),
    dtype: Any = np.float64,
    progress: Callable[[int], None] | None = None,
    unoptimised: bool | None = None,
) -> Any:
    """`function(model, *static, array, lane, *arrays)` of many lanes.

    Args:
        function: pure, of one lane; a module's own, so that its program is kept (see `program`).
        study: whose model and lanes.
        arrays: of each row, leading axis n: what comes before the lane (mostly theta), and after.
        batch: lanes computed together, always as many: the last ones are filled up with the last
            lane, and one program serves all.
        rows: lane of each row; None: all lanes in order.
        static: arguments between model and arrays, by value.
        progress: called with the number of rows done since the last call.
        unoptimised: whether the program is compiled without optimisation; None: as for so many
            rows that are evaluated. Who calls many times with few rows, or solves, has to say.

    Returns:
        What the function returns, on the host with leading axis n; floating-point arrays in
        float64.
    """
    count = len(arrays[0])
    rows = np.arange(count) if rows is None else rows
    unoptimised = study.evaluates_few(count) if unoptimised is None else unoptimised
    run, out = program(function, study.model, *static, unoptimised=unoptimised), None
    for first in range(0, count, batch):
        here = np.minimum(np.arange(first, first + batch), count - 1)
        lane = jax.tree.map(lambda v, at=rows[here]: v[at], study.lanes)
        before, *after = cast([v[here] for v in arrays], dtype)
        part = run(before, cast(lane, dtype), *after)
        left = min(count - first, batch)
        part = jax.tree.map(_on_host, part)
        if out is None:  # all batches in their places: beside one another they were there twice
            out = jax.tree.map(lambda v: np.empty((count, *v.shape[1:]), v.dtype), part)
        for whole, some in zip(jax.tree.leaves(out), jax.tree.leaves(part), strict=True):
            whole[first : first + left] = some[:left]
        if progress is not None:
            progress(left)
    return out


def _on_host(value) -> np.ndarray:
    """A numpy array, in float64 if of floating point."""
    array = np.asarray(value)
    return array.astype(np.float64) if np.issubdtype(array.dtype, np.floating) else array
