"""Batched Levenberg-Marquardt: many starts in one compiled program, refilled as they finish.

A batch of starts takes a few iterations at a time (`trust_region.iterate`); those that are done
leave their slots and waiting ones take them, so that a slow start holds up nobody and one program
serves any number. Each start is computed from its own data alone.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtrachea.optimisation.batching import batch_size
from jaxtrachea.optimisation.curvature import Rest
from jaxtrachea.optimisation.programs import cast, program
from jaxtrachea.optimisation.trust_region import (
    FIRST_RADIUS,
    RUNNING,
    Box,
    Objective,
    State,
    Tolerances,
    bound_rounding,
    iterate,
)
from jaxtrachea.status import FitStatus

#: Iterations of a batch between two looks at which are done.
ROUNDS = 4


class Solved(NamedTuple):
    """Outcome of many starts, numpy, leading axis = starts in the order given.

    Attributes:
        theta: unknowns in scaled coordinates; (starts, P).
        cost: half the weighted sum of rho(residual^2); (starts,).
        status: `FitStatus`; (starts,).
        iterations: (starts,).
    """

    theta: np.ndarray
    cost: np.ndarray
    status: np.ndarray
    iterations: np.ndarray


def _advance(tolerances, rounds, objective, start, refill, state):
    """Put fresh starts where asked, then up to `rounds` iterations of the whole batch."""

    def put(new, old):
        return jnp.where(refill.reshape(-1, *[1] * (old.ndim - 1)), new, old)

    # Iteration 0 marks a fresh start: its point is evaluated before it is used.
    state = State(
        theta=put(start, state.theta),
        point=state.point,
        radius=put(FIRST_RADIUS, state.radius),
        iteration=put(0, state.iteration),
        status=put(jnp.int8(RUNNING), state.status),
        rest=state.rest,  # forgotten by the first iteration
    )
    one = jax.vmap(functools.partial(iterate, tolerances))

    def body(carry):
        i, state = carry
        return i + 1, one(objective, state)

    def go(carry):
        i, state = carry
        return (i < rounds) & jnp.any(state.status == RUNNING)

    return jax.lax.while_loop(go, body, (0, state))[1]


def levenberg_marquardt(
    objective: Objective,
    starts: np.ndarray,
    rows: np.ndarray | None = None,
    *,
    tolerances: Tolerances = Tolerances(),
    batch: int = 128,
    progress: Callable[[int], None] | None = None,
    dtype=np.float64,
    unoptimised: bool = False,
) -> Solved:
    """Minimise from every start.

    Args:
        objective: of all lanes: numpy arrays with a leading axis.
        starts: scaled coordinates; (starts, P). One outside of the box begins on its bounds.
        rows: lane of each start, int; (starts,); None: one start of each lane.
        tolerances: when a start is done.
        batch: starts computed together at most; one alone takes a place among a few, unless this
            is 1, since compiling for another size takes longer.
        progress: called with the number of starts that finished since the last call.
        unoptimised: the program is compiled without optimisation (see `program`).

    Returns:
        The `Solved` starts, in order. Failed ones are rows with a status; they touch no other row.
    """
    total, unknowns = starts.shape
    rows = np.arange(total) if rows is None else rows
    batch = batch_size(max(total, 2), batch)
    exact, objective = objective, cast(objective, dtype)
    given = np.clip(cast(starts, dtype), objective.lower[rows], objective.upper[rows])
    advance = program(_advance, tolerances, ROUNDS, axes=None, donate=(3,), unoptimised=unoptimised)
    state = _idle(objective, batch, dtype)
    # What the slots of the batch compute with; rewritten only where a start takes its place.
    slots = jax.tree.map(lambda v: np.repeat(v[:1], batch, axis=0), (objective, given))
    out = Solved(
        np.zeros((total, unknowns)), np.full(total, np.inf), np.zeros(total, int),
        np.zeros(total, int),
    )  # fmt: skip
    owner = np.full(batch, -1)
    waiting = 0
    while True:
        refill = owner < 0
        empty = np.flatnonzero(refill)[: total - waiting]
        owner[empty] = np.arange(waiting, waiting + len(empty))
        waiting += len(empty)
        refill &= owner >= 0
        if np.all(owner < 0):
            return out
        new = owner[empty]
        arrivals = jax.tree.map(lambda v, of=rows[new]: v[of], objective), given[new]
        for slot, arrival in zip(jax.tree.leaves(slots), jax.tree.leaves(arrivals), strict=True):
            slot[empty] = arrival
        state = advance(*slots, refill, state)
        status = np.asarray(state.status)
        done = (owner >= 0) & (status != RUNNING)
        finished = owner[done]
        if len(finished):
            theta = np.asarray(state.theta)[done]
            out.theta[finished] = _on_bounds(theta, exact, rows[finished])
            out.cost[finished] = np.asarray(state.point.cost)[done]
            out.status[finished] = status[done]
            out.iterations[finished] = np.asarray(state.iteration)[done]
            owner[done] = -1
        if progress is not None:
            progress(len(finished))


def _on_bounds(theta, box: Box, rows) -> np.ndarray:
    """Unknowns of the lanes `rows` in the box, on its bounds where rounding alone parts them."""
    lower, upper = box.lower[rows], box.upper[rows]
    inside = np.clip(np.asarray(theta, np.float64), lower, upper)
    inside = np.where(inside - lower <= bound_rounding(lower, theta.dtype), lower, inside)
    return np.where(upper - inside <= bound_rounding(upper, theta.dtype), upper, inside)


def _idle(objective: Objective, batch: int, dtype) -> State:
    """A batch of slots nobody works at."""
    one: Any = jax.tree.map(lambda v: v[0], objective)

    def full(value, dtype, *shape):
        return jnp.asarray(np.full((batch, *shape), value, dtype), dtype)  # nothing is compiled

    def zeros(*shape):
        return full(0, dtype, *shape)

    point = jax.tree.map(lambda v: zeros(*v.shape), one.blank())
    done = full(FitStatus.CONVERGED, np.int8)
    unknowns = one.lower.shape
    rest = Rest(zeros(*unknowns, *unknowns), full(False, np.bool_))
    return State(zeros(*unknowns), point, zeros(), full(0, np.int32), done, rest)
