"""Several contacts whose forces relax, all parts of the organ alike.

The shape is the elastic one, and each force F = A e + B the filter of its elastic force e
(`relaxation.filter`). A tool that would pull has let go: F = 0, so that its place has the elastic
force -B / A given, which moves the wall under the others. No e is less than that floor: a problem
of the same kind as the elastic one (`contacts.solve`) at every sample.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxtrachea.mechanics.contacts import solve
from jaxtrachea.mechanics.force_law import Law
from jaxtrachea.mechanics.press_history import History, Samples, counted, remembered, run
from jaxtrachea.mechanics.validation import has_solution
from jaxtrachea.relaxation.steps import Carried, advance
from jaxtrachea.status import PressStatus

#: Displacement of a tool that is not there, mm: clear of a wall wherever others move it.
AWAY = -1e3


class Relaxed(NamedTuple):
    """Contacts at every sample; NaN where there is no solution.

    Attributes:
        history: after the last sample; arrays of what each contact remembers.
        force: N.
        depth: local indentation, mm; where a tool has let go that of the wall by itself.
        elastic: elastic force, which the shape follows, N.
        status: a `PressStatus`.
    """

    history: History
    force: Float[Array, "N m"]
    depth: Float[Array, "N m"]
    elastic: Float[Array, "N m"]
    status: Int[Array, "N m"]


def solve_in_time(
    displacement: Float[Array, "N m"],
    compliance: Float[Array, "m m"],
    law: Law,
    samples: Samples,
    *,
    width: Float[Array, ""] | None = None,
    present: Bool[Array, "N m"] | None = None,
) -> Relaxed:
    """`contacts.solve` of forces that relax.

    After a sample without a solution the history of all contacts is unknown.

    Args:
        displacement: D of each tool, mm.
        compliance: C in the long run, mm/N.
        law: local laws in the long run, coefficients of shape (m,).
        samples: times, branches and what each contact remembers: one `History` with an axis of
            contacts first.
        width: see `solve`.
        present: contacts that are there; of others that are unilateral the wall recovers by itself.
    """
    there = jnp.ones(displacement.shape, bool) if present is None else present
    branches = samples.relaxation.local

    def step(history, sample):
        dt, D, there, own, skipped = sample
        before, floor = history.local, None

        def filtered(elastic, unilateral):
            each = lambda was, e: advance(was, dt, e, branches, unilateral)  # noqa: E731
            return jax.vmap(each)(before, elastic)

        if width is not None:
            floor = filtered(-jnp.ones_like(D), True)[0].elastic
            D, there = jnp.where(there, D, AWAY), jnp.ones_like(there)
        found = solve(
            D, compliance, law, width=width, present=there, start=before.elastic, floor=floor
        )
        failed = ~jnp.all(has_solution(found.status))
        own = jnp.where(failed & (own == PressStatus.OK), found.status[0], own)
        elastic, lost, skipped = counted(history, found.force, own, skipped, before.elastic)
        local, force = filtered(elastic, False)
        if floor is not None:
            force = jnp.where(elastic == floor, 0, force)
        hidden = skipped | (lost != PressStatus.OK)
        depth = found.depth if floor is None else jnp.maximum(found.depth, 0)
        numbers = (jnp.where(hidden, jnp.nan, v) for v in (force, depth, elastic))
        status = jnp.where(lost != PressStatus.OK, lost, found.status).astype(jnp.int8)
        return remembered(history, History(local, None, lost), skipped), (*numbers, status)

    none = jnp.zeros(displacement.shape[:1], jnp.int8)
    history, found = run(step, samples, displacement, there, none)
    return Relaxed(history, *found)


def each_at_rest(rest: History, contacts: int) -> History:
    """What each of several contacts remembers of nothing; `rest`: of one."""
    return History(
        Carried(*(jnp.broadcast_to(v, (contacts, *v.shape)) for v in rest.local)), None, rest.lost
    )
