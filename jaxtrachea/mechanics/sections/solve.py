"""Equilibria along a path of the tool: Newton's method, path following, implicit derivatives.

One loop for each displacement of the path: every turn is one Newton step, after which the state is
accepted (and the next substep predicted by the secant of the last two), corrected further, or given
up (and tried again from the last state with half the substep). Lanes of a `vmap` go each their way.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxtrachea._numerics import epsilon
from jaxtrachea.mechanics.sections import system as _system
from jaxtrachea.mechanics.sections.system import State, System

#: Longest substep over the radius, Newton steps of one substep, halvings, and steps in all.
REACH, STEPS, HALVINGS, IN_ALL = 0.15, 10, 10, 2000


class Solved(NamedTuple):
    """States along a path.

    Attributes:
        state: one for each displacement; at rest where there is none.
        solved: 1 where Newton's method converged, else 0.
        stable: 1 where this state and all before it are minima of the energy, else 0.
        steps: Newton steps made for it.
    """

    state: State
    solved: Float[Array, " m"]
    stable: Float[Array, " m"]
    steps: Float[Array, " m"]


class _Way(NamedTuple):
    """Where the path following stands.

    `there`, `before`: the last two states and their displacements; `state`: under correction for
    the displacement `tried`; `count`: Newton steps of this substep, `total` of all; `reach`:
    substep allowed; `lost`: given up; `stable`: no state so far that is no minimum of the energy.
    """

    there: State
    before: State
    at: Float[Array, ""]
    at_before: Float[Array, ""]
    state: State
    tried: Float[Array, ""]
    reach: Float[Array, ""]
    count: Int[Array, ""]
    total: Int[Array, ""]
    lost: Bool[Array, ""]
    stable: Bool[Array, ""]


def _choose(condition, a, b):
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)


def _predict(way: _Way, target) -> _Way:
    """Next substep: at most `reach` on, from the secant of the last two states."""
    tried = way.at + jnp.clip(target - way.at, -way.reach, way.reach)
    tried = jnp.where(jnp.abs(target - tried) <= 0.01 * way.reach, target, tried)
    past = way.at - way.at_before
    ratio = jnp.where(past == 0, 0, (tried - way.at) / jnp.where(past == 0, 1, past))
    state = jax.tree.map(lambda x, y: x + ratio * (x - y), way.there, way.before)
    return way._replace(state=state, tried=tried, count=jnp.zeros_like(way.count))


def _size(step: State):
    """Largest change of a mode, mm."""
    return jnp.maximum(jnp.max(jnp.abs(step.y[:, :, :4])), jnp.max(jnp.abs(step.q_C)))


def _advance(way: _Way, target, system: System) -> _Way:
    """One Newton step, and what follows from it."""
    longest = REACH * system.shape.radius
    r, tangent = _system.linearise(way.state, way.tried, system)
    step = _system.solve_linear(tangent, r)
    state = jax.tree.map(lambda x, y: x - y, way.state, step)
    size = _size(step)
    finite = jnp.isfinite(size + jnp.sum(state.force) + jnp.sum(state.y))
    scale = jnp.maximum(jnp.abs(way.tried), jnp.abs(way.tried - way.at))
    settled = finite & (size <= epsilon(size.dtype) ** 0.5 * scale)
    count, total = way.count + 1, way.total + 1
    failed = ~finite | (size > 3 * system.shape.radius) | ((count >= STEPS) & ~settled)
    on = way._replace(state=state, count=count, total=total)
    # The tangent is that before the last step, which was small.
    stable = way.stable & (_system.excess_negative(tangent) == 0)
    quick = jnp.where(count <= 5, 2 * way.reach, way.reach)
    accepted = _predict(
        on._replace(
            there=state,
            before=way.there,
            at=way.tried,
            at_before=way.at,
            reach=jnp.minimum(quick, longest),
            stable=stable,
        ),
        target,
    )
    shorter = jnp.minimum(way.reach, jnp.abs(way.tried - way.at)) / 2
    back = _predict(way._replace(reach=shorter, total=total), target)
    given_up = (shorter < longest / 2**HALVINGS) | (total >= IN_ALL)
    back = back._replace(lost=given_up)
    return _choose(settled, accepted, _choose(failed, back, on))


def _follow(system: System, displacement) -> Solved:
    """States along the path, without derivatives."""
    rest = _system.at_rest(system)
    zero = jnp.zeros_like(system.phi_c)
    count = jnp.zeros((), jnp.int32)
    reach = REACH * system.shape.radius
    no = jnp.zeros((), bool)
    begin = _Way(rest, rest, zero, zero, rest, zero, reach, count, count, no, ~no)

    def press_on(way, target):
        # No displacement is the state of rest, and that exactly.
        way = _choose(target == 0, begin._replace(stable=way.stable), way)
        way = _predict(way._replace(total=count, lost=no, reach=reach), target)

        def goes(way):
            return (way.at != target) & ~way.lost

        way = jax.lax.while_loop(goes, lambda w: _advance(w, target, system), way)
        state = _choose(way.lost, rest, way.there)
        told = (~way.lost, way.stable, way.total)
        return way, Solved(state, *(v.astype(target.dtype) for v in told))

    return jax.lax.scan(press_on, begin, displacement)[1]


@jax.custom_jvp
def solve_path(system: System, displacement: Float[Array, " m"]) -> Solved:
    """Equilibria along a path of displacements that begins at rest.

    Args:
        system: what is pressed, and where.
        displacement: of the tool along `system.direction`, mm, in the order in which it moves.

    Returns:
        The states. Derivatives are those of the equilibrium (implicit function theorem), in either
        mode and to any order; rows that are not solved have none that means anything.
    """
    return _follow(system, displacement)


@solve_path.defjvp
def _solve_path_jvp(primals, tangents):
    system, displacement = primals
    found = solve_path(system, displacement)

    def one(state, D, D_grown):
        def off(D, system):
            return _system.residual(state, D, system)

        _, grown = jax.jvp(off, (D, system), (D_grown, tangents[0]))
        _, tangent = _system.linearise(state, D, system)
        return jax.tree.map(jnp.negative, _system.solve_linear(tangent, grown))

    grown = jax.vmap(one)(found.state, displacement, tangents[1])
    none = jnp.zeros_like(found.solved)
    return found, Solved(grown, none, none, none)
