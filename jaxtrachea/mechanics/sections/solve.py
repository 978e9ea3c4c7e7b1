"""Equilibria along a path of the tool: Newton's method, path following, implicit derivatives.

One loop for each displacement of the path: every turn is one Newton step, after which the state is
accepted (and the next substep predicted from the last two and their derivatives by the tool's
displacement, which the tangent gives with the step), corrected further, or given up (and tried
again from the last state with half the substep). Lanes of a `vmap` go each their way.
"""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Float, Int

from jaxtrachea._linear import replaced
from jaxtrachea._numerics import epsilon, full_precision
from jaxtrachea.fusion import fuse
from jaxtrachea.mechanics.sections import system as _system
from jaxtrachea.mechanics.sections.system import State, System

#: Longest substep over the radius, Newton steps of one substep, halvings, and steps in all.
REACH, STEPS, HALVINGS, IN_ALL = 0.15, 10, 10, 2000
#: Error of a state that is accepted, over the displacement; epsilon where that is more.
ERROR = 1e-13


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
    """Where the path following stands; few arrays, since each costs a turn of the loop a copy.

    Attributes:
        known: the last two states and their derivatives by the tool's displacement, flat: THERE,
            BEFORE, SLOPE, SLOPE_BEFORE.
        z: under correction for the displacement TRIED, flat.
        places: AT and AT_BEFORE of the two states, TRIED, and REACH: the substep allowed; mm.
        converging: size of the last Newton step of this substep, mm, and the curvature: the size of
            a step over the square of the one before, 1/mm, when last seen; infinite before.
        steps: of Newton's method, of this substep and of all.
        lost: given up.
        stable: no state so far that is no minimum of the energy.
    """

    known: Float[Array, "4 n"]
    z: Float[Array, " n"]
    places: Float[Array, "4"]
    converging: Float[Array, "2"]
    steps: Int[Array, "2"]
    lost: Bool[Array, ""]
    stable: Bool[Array, ""]


THERE, BEFORE, SLOPE, SLOPE_BEFORE = range(4)
AT, AT_BEFORE, TRIED, REACH_NOW = range(4)


def _flat(state: State):
    return jnp.concatenate([v.ravel() for v in state])


def _state(z, system: System) -> State:
    """The state of a flat array."""
    rest = jax.eval_shape(_system.at_rest, system)
    end, count = math.prod(rest.y.shape), math.prod(rest.force.shape)
    parts = z[:end], z[end:-count], z[-count:]
    return State(*(v.reshape(like.shape) for v, like in zip(parts, rest, strict=True)))


def _choose(condition, a, b):
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)


def _predict(known, places, target):
    """Next substep, at most `reach` on: state and places.

    Hermite's cubic through both states; along the tangent where it would reach far beyond them.
    """
    at, before, _, reach = places
    tried = at + jnp.clip(target - at, -reach, reach)
    tried = jnp.where(jnp.abs(target - tried) <= 0.01 * reach, target, tried)
    past, on = at - before, tried - at
    cubic = (past != 0) & (jnp.abs(on) <= 2 * jnp.abs(past))
    x = jnp.where(cubic, on / jnp.where(past == 0, 1, past), 0)
    own = jnp.where(cubic, x * (1 + x) ** 2 * past, on)
    back, back_slope = x * x * (3 + 2 * x), x * x * (1 + x) * past
    z = known[THERE] + back * (known[BEFORE] - known[THERE])
    z = z + own * known[SLOPE] + back_slope * known[SLOPE_BEFORE]
    return z, jnp.stack([at, before, tried, reach])


def _size(step, system: System):
    """Largest change of a mode, mm; a NaN may be lost (`_numerics.largest`), which z keeps."""
    step = _state(step, system)
    return jnp.maximum(jnp.max(jnp.abs(step.y[:, :, :4])), jnp.max(jnp.abs(step.q_C)))


def _newton(z, displacement, system: System):
    """Newton's step from z, the derivative of the solution by the displacement, and stability."""
    r, tangent = _system.linearise(_state(z, system), displacement, system)
    along = jax.tree.map(jnp.zeros_like, r)._replace(
        force=jnp.broadcast_to(system.direction, r.force.shape)
    )
    both = jax.tree.map(lambda x, y: jnp.stack([x, y]), r, along)
    both = fuse(_system.solve_several, products=True)(tangent, both)
    step, slope = jax.vmap(_flat)(both)
    return step, slope, _system.excess_negative(tangent) == 0


def _converging(size, scale, way: _Way):
    """Whether a Newton step of this size was the last that is needed, and `converging` after it.

    The next one would be about the square of it times the curvature: if that is negligible, it need
    not be made.
    """
    last, curvature = way.converging
    eps = epsilon(size.dtype)
    # A step of the size of rounding says nothing about the curvature.
    seen = (way.steps[0] > 0) & (size > 1e3 * eps * scale)
    curvature = jnp.where(seen, size / last**2, curvature)
    settled = size <= eps**0.5 * scale
    settled |= curvature * size**2 <= max(eps, ERROR) * scale
    return settled, jnp.stack([size, curvature])


def _advance(way: _Way, target, system: System) -> _Way:
    """One Newton step, and what follows from it."""
    longest = REACH * system.shape.radius
    at, before, tried, reach = way.places
    step, slope, minimum = _newton(way.z, tried, system)
    z = way.z - step
    size = _size(step, system)
    finite = jnp.all(jnp.isfinite(z))
    scale = jnp.maximum(jnp.abs(tried), jnp.abs(tried - at))
    settled, converging = _converging(size, scale, way)
    settled &= finite
    count, total = way.steps + 1
    failed = ~finite | (size > 3 * system.shape.radius) | ((count >= STEPS) & ~settled)
    # The first step of all is from rest, whose derivative nothing else tells.
    at_rest = (at == before) & (way.steps[0] == 0)
    known = jnp.where(at_rest, way.known.at[SLOPE].set(slope), way.known)
    on = way._replace(known=known, z=z, converging=converging, steps=way.steps + 1)
    # Settled: slope and stability are those before the last step, which was small.
    quick = jnp.minimum(jnp.where(count <= 5, 2 * reach, reach), longest)
    grown = jnp.stack([z, known[THERE], slope, known[SLOPE]])
    ahead = jnp.stack([tried, at, tried, quick])
    shorter = jnp.minimum(reach, jnp.abs(tried - at)) / 2
    given_up = failed & ((shorter < longest / 2**HALVINGS) | (total >= IN_ALL))
    # Accepted, or back with a shorter substep; both begin from a prediction.
    known = jnp.where(settled, grown, way.known)
    places = jnp.where(settled, ahead, jnp.stack([at, before, tried, shorter]))
    z, places = _predict(known, places, target)
    again = _Way(
        known=known,
        z=z,
        places=places,
        converging=converging,
        steps=jnp.stack([jnp.zeros_like(total), total]),
        lost=given_up,
        stable=way.stable & (minimum | ~settled),
    )
    return _choose(settled | failed, again, on)


def _follow(system: System, displacement) -> Solved:
    """States along the path, without derivatives."""
    rest = _flat(_system.at_rest(system))
    reach = REACH * system.shape.radius
    no = jnp.zeros((), bool)
    none = jnp.zeros_like(reach)
    begin = _Way(
        known=jnp.zeros((4, rest.size), rest.dtype),
        z=rest,
        places=jnp.stack([none, none, none, reach]),
        converging=jnp.stack([none, none + jnp.inf]),
        steps=jnp.zeros(2, jnp.int32),
        lost=no,
        stable=~no,
    )

    def press_on(way, target):
        # No displacement is the state of rest, and that exactly.
        way = _choose(target == 0, begin._replace(stable=way.stable), way)
        z, places = _predict(way.known, way.places.at[REACH_NOW].set(reach), target)
        way = way._replace(z=z, places=places, steps=jnp.zeros_like(way.steps), lost=no)

        def goes(way):
            return (way.places[AT] != target) & ~way.lost

        way = jax.lax.while_loop(goes, lambda w: _advance(w, target, system), way)
        state = _state(jnp.where(way.lost, rest, way.known[THERE]), system)
        told = (~way.lost, way.stable, way.steps[1])
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


@functools.partial(solve_path.defjvp, symbolic_zeros=True)
@full_precision
def _solve_path_jvp(primals, tangents):
    system, displacement = primals
    found = solve_path(system, displacement)
    values, tree = jax.tree.flatten(system)
    grown = jax.tree.leaves(tangents[0])
    moving = [i for i, v in enumerate(grown) if not isinstance(v, SymbolicZero)]
    given = [values[i] for i in moving], [grown[i] for i in moving]
    still = isinstance(tangents[1], SymbolicZero)
    way = jnp.zeros_like(displacement) if still else tangents[1]

    def one(state, D, D_grown):
        def off(D, moved):
            return _system.residual(state, D, tree.unflatten(replaced(values, moving, moved)))

        _, grown = jax.jvp(off, (D, given[0]), (D_grown, given[1]))
        _, tangent = _system.linearise(state, D, system)
        return jax.tree.map(jnp.negative, _system.solve_linear(tangent, grown))

    grown = jax.vmap(one)(found.state, displacement, way)
    none = jnp.zeros_like(found.solved)
    return found, Solved(grown, none, none, none)
