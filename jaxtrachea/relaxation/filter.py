r"""A force that relaxes: branches, each a spring and a dashpot, beside an elastic force (Fung).

Of the elastic force e and branches b of strength gamma_b and time tau_b the whole force is

    F = e + sum_b h_b,   dh_b/dt = gamma_b de/dt - h_b / tau_b,

so that e is what lasts and (1 + sum_b gamma_b) e what a sudden press meets. If all parts of the
organ relax alike, its shape is the elastic one at every instant, and F is this filter of the
elastic force of the whole: of any law, skeleton, width or direction (quasi-linear, Fung). How the
tool came to the place does not matter, only the elastic force and the time.

A step is exact for an e that is linear in time between samples, for any dt >= 0 (dt = 0: a jump):

    h' = E h + P (e' - e),   E = exp(-x),   P = gamma (1 - E) / x,   x = dt / tau.

A unilateral contact does not pull: where F would be negative it is 0, the tool has left, and the
surface recovers by itself, e' = -B / A with A = 1 + sum P and B = sum (E h - P e).

Nothing here knows what the elastic force is of.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrachea.relaxation.steps import (
    Branches,
    bonded_filter,
    bonded_in_parallel,
    differentiable_in_lanes,
    fading,
    in_parallel,
    loop_with_derivatives,
    unilateral_filter,
)


class Relaxation(NamedTuple):
    """What relaxes.

    Attributes:
        local: branches of the local law; of the whole organ where the skeleton has none.
        skeleton: branches of the skeleton; None: all parts relax alike.
    """

    local: Branches
    skeleton: Branches | None = None


class Relaxed(NamedTuple):
    """A force in time.

    Attributes:
        force: N; (N,) or (N, 3) as the elastic force is.
        elastic: elastic force of the surface as it is, N: that of the tool's displacement, or where
            the tool has left what the surface itself still has.
    """

    force: Float[Array, " N *k"]
    elastic: Float[Array, " N *k"]

    @property
    def overload(self) -> Float[Array, " N *k"]:
        """What the branches carry beside the elastic force, N."""
        return self.force - self.elastic


class Derivatives(NamedTuple):
    """Derivatives of a `Relaxed`: first by the columns of the elastic force, then by the branches.

    Attributes:
        force: (C + K, N).
        elastic: (C + K, N); None where it was not asked for.
    """

    force: Float[Array, "CK N"]
    elastic: Float[Array, "CK N"] | None


def relax(
    time: Float[Array, " N"],
    elastic: Float[Array, " N *k"],
    branches: Branches,
    unilateral: bool = True,
) -> Relaxed:
    """The force of an elastic force that relaxes, from rest before the first sample.

    Derivatives of any order, in both modes, are those of the steps.

    Args:
        time: s, never falling. Padding repeats the last time and any finite elastic force, at the
            end: no sample feels a later one.
        elastic: what the displacement would meet in the long run, N; a vector (last axis) where the
            contact cannot let go. What is not finite leaves all later samples so.
        branches: see `Branches`.
        unilateral: the contact lets go where it would pull; else it is bonded (static).

    Raises:
        ValueError: vectors of a unilateral contact.
    """
    if elastic.ndim > 1:
        if unilateral:
            raise ValueError("a vector has no sign to let go at; expected unilateral=False")
        return jax.vmap(lambda e: relax(time, e, branches, False), -1, -1)(elastic)
    x, lost = fading(time, branches)
    if unilateral:
        return Relaxed(*unilateral_filter(x, lost, elastic, branches.gamma))

    def bonded(loop):
        return lambda: loop(x, lost, elastic, branches.gamma)

    # The loop is one kernel on a CPU; elsewhere each of its rounds would be several.
    force = jax.lax.platform_dependent(
        cpu=bonded(bonded_filter), default=bonded(bonded_in_parallel)
    )
    return Relaxed(force, elastic)


def relax_with_derivatives(
    time: Float[Array, " N"],
    elastic: Float[Array, " N"],
    columns: Float[Array, "C N"],
    branches: Branches,
    unilateral: bool = True,
    along: Branches | None = None,
    *,
    surface: bool = False,
) -> tuple[Relaxed, Derivatives]:
    """`relax` and its derivatives, carried beside it: a third of what `jax.jvp` of it takes.

    Args:
        time: s; as in `relax`.
        elastic: N.
        columns: derivatives of the elastic force by whatever it depends on.
        branches: see `Branches`.
        unilateral: as in `relax` (static).
        along: changes of gamma and tau in K directions, each (K, B), as `jax.jvp` of what makes the
            branches gives them; None: the 2 B of the logarithm of each gamma, then of each tau.
        surface: whether derivatives of `Relaxed.elastic` are asked for, which joints follow
            (static).

    Returns:
        The force, and its derivatives by the C columns and along the K directions.
    """
    if along is not None:
        # A branch that never relaxes has no change of log tau.
        log_tau = jnp.where(along.tau == 0, 0, along.tau / branches.tau[None])
        along = Branches(along.gamma.T, log_tau.T)
    x, lost = fading(time, branches)
    loop = functools.partial(loop_with_derivatives, unilateral=unilateral, surface=surface)
    # Samples and branches in front, as the loop reads them.
    force, of_surface, d_force, d_surface = differentiable_in_lanes(loop)(
        x, lost, elastic, columns.T, branches.gamma, along
    )
    d_surface = None if d_surface is None else d_surface.T
    return Relaxed(force, of_surface), Derivatives(d_force.T, d_surface)


def overloads(
    time: Float[Array, " N"], elastic: Float[Array, " N"], branches: Branches
) -> Float[Array, "N B"]:
    """What each branch carries, N, of the elastic force of the surface (`Relaxed.elastic`)."""
    x, lost = fading(time, branches)
    return in_parallel(x, lost, elastic, branches.gamma)
