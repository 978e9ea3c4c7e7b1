"""Several contacts in equilibrium with one skeleton: forces and local indentations together.

Contact j has its own law f_j and its own tool displacement D_j; the skeleton moves it by the forces
of all. Unknown are the local indentations d_j (negative: a gap) with

    d + C f(d) = D,   f_j = F_j(positive part of d_j) of a unilateral contact.

With d = D - C g this is where the energy

    E(g) = g C g / 2 + sum_j U_j(D_j - (C g)_j),   U_j' = f_j

is least. C is positive semi-definite and no f_j falls, so that E, as a function of the skeleton's
motion, is strictly convex: one solution, whichever contacts touch, also for a singular C (two tools
on one place) or rigid laws. The local law in series with a skeleton (`equilibrium`) is m = 1.

Units: mm, N, N/mm, mm/N.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxtrachea._numerics import epsilon, every, largest, positive_part, product
from jaxtrachea.mechanics.force_law import Law, fold_depth
from jaxtrachea.status import PressStatus

#: Newton steps at most; 1,000 random scenes of six contacts take 8 in the median, 20 at most.
STEPS = 40
#: Steps of false position along one Newton step.
SEARCH = 8
#: Largest difference of a force from that of the law at its indentation, over the largest force. In
#: float32, of k_3 = 1e10 N/mm^3, forces were right to 1e-5 below it; above 0.01 some were off by 15
#: times their size.
UNLIKE = 2e-3


class ContactForces(NamedTuple):
    """Solved contacts, one entry for each.

    Attributes:
        depth: local indentation, mm; negative where there is a gap between tool and wall.
        force: contact force, N.
        status: a `PressStatus` as int8.
        steps: Newton steps taken.
    """

    depth: Float[Array, " m"]
    force: Float[Array, " m"]
    status: Int[Array, " m"]
    steps: Int[Array, ""]


class _Contacts(NamedTuple):
    """The laws of m contacts, as functions of the local indentation.

    Attributes:
        law: coefficients of shape (m,).
        peak: indentation at which a law that softens stops rising, mm; inf where none does.
        width: of the smooth first touch, mm; None: bonded contacts.
        floor: elastic force that is there where nothing presses, N; None: none.
        bonded: contacts that are glued beside others that are not; None: none.
    """

    law: Law
    peak: Float[Array, " m"]
    width: Float[Array, ""] | None
    floor: Float[Array, " m"] | None = None
    bonded: Bool[Array, " m"] | None = None

    def pressed(self, depth):
        """Indentation that enters the law, and its derivative by the depth."""
        if self.width is None:
            return depth, jnp.ones_like(depth)
        width, one = self.width, jnp.ones_like(depth)
        inward, slope = jax.jvp(lambda d: positive_part(d, width), (depth,), (one,))
        if self.bonded is None:
            return inward, slope
        return jnp.where(self.bonded, depth, inward), jnp.where(self.bonded, one, slope)

    def pressing(self, D):
        """The part of each displacement that presses, or pulls where it may, mm."""
        inward = D if self.width is None else jnp.maximum(D, 0)
        return inward if self.bonded is None else jnp.where(self.bonded, D, inward)

    def force(self, depth):
        """Force, N. Beyond its peak a law that softens goes on level, so that none falls."""
        inside = jnp.clip(self.pressed(depth)[0], -self.peak, self.peak)
        force = self.law.force(inside)
        return force if self.floor is None else jnp.maximum(force, self.floor)

    def tangent(self, depth):
        """Derivative of `force`, N/mm; not negative."""
        pressed, slope = self.pressed(depth)
        rising = jnp.abs(pressed) < self.peak
        if self.floor is not None:
            rising = rising & (self.law.force(jnp.where(rising, pressed, 0)) > self.floor)
        return jnp.where(rising, slope * self.law.tangent(jnp.where(rising, pressed, 0)), 0)


def solve(
    displacement: Float[Array, " m"],
    compliance: Float[Array, "m m"],
    law: Law,
    *,
    width: Float[Array, ""] | None = None,
    present: Bool[Array, " m"] | None = None,
    start: Float[Array, " m"] | None = None,
    floor: Float[Array, " m"] | None = None,
    bonded: Bool[Array, " m"] | None = None,
) -> ContactForces:
    """Series coupling of m contacts: d + C F = D, each with its own law.

    Newton's method with a search along each step, in float32 as in float64. Unique for laws that
    nowhere soften. One with k_3 < 0 or k_5 < 0 is followed from the stiff side up to its own peak,
    where F' = 0; beyond it no contact has a number and all have the status PAST_FOLD. (`press`, of
    one contact, goes on from there to the fold of law and skeleton in series.) Derivatives are
    those of the equilibrium, forward and reverse, to any order.

    Args:
        displacement: D of each tool after first touch, mm; negative before it.
        compliance: C, deflection of contact i per unit force at j, mm/N, symmetric and positive
            semi-definite.
        law: local laws, coefficients of shape (m,); k_1 > 0.
        width: of the smooth first touch, mm: the positive part of d is rounded from d = 0 to
            there. None: the contacts are bonded, and pull where d < 0.
        present: contacts that are there; the others have no force, whatever their displacement.
        start: forces to begin with, N, say of the row before; they change the number of steps, and
            the result by rounding alone.
        floor: of unilateral contacts, elastic force that the wall has where its tool has let go,
            not negative (`contacts_in_time`), with the depth under it; 0 if None.
        bonded: contacts that are glued although there is a `width` for others. Not with a `floor`.

    Returns:
        The `ContactForces`. LIFTED: alone it would touch, but another tool moves the wall away.
        NOT_CONVERGED: the numbers are too stiff against each other for their precision (k C near
        1 / epsilon); no contact has a number then, nor where one input is not finite.
    """
    m = displacement.shape[0]
    there = jnp.ones(m, bool) if present is None else present
    D = jnp.where(there, displacement, 0)
    C = jnp.where(there[:, None] & there[None], compliance, 0)
    law = law._replace(**{n: jnp.where(there, k, 1) for n, k in law.coefficients().items()})
    known = jnp.isfinite(jnp.sum(D) + jnp.sum(C) + sum(map(jnp.sum, law.coefficients().values())))
    D, C = jnp.where(known, D, 0), jnp.where(known, C, 0)
    law = law._replace(**{n: jnp.where(known, k, 1) for n, k in law.coefficients().items()})

    contacts = _Contacts(law, fold_depth(law), width, floor, bonded)
    kept = jnp.zeros_like(D) if floor is None else floor
    own = kept if floor is None else law.root(kept, jnp.ones_like(kept), 0.0)
    alone = contacts.pressing(D) * law.k_1 / (1 + jnp.diag(C) * law.k_1)
    if start is not None:
        alone = jnp.where(there & jnp.isfinite(start), start, alone)
    depth, force, steps, missed = _newton(*jax.lax.stop_gradient((D, C, contacts, alone)))
    depth, force = _follow(D, C, contacts, depth, force)

    past = ~every(jnp.abs(contacts.pressed(depth)[0]) < contacts.peak)
    eps = epsilon(D.dtype)
    # Indentations below the rounding of D, or of motions that cancel: neither is known.
    stiffness = largest(jnp.maximum(contacts.tangent(depth), law.k_1) * jnp.diag(C))
    moved = largest(product(jnp.abs(C), jnp.abs(force)))
    free = own + jnp.diag(C) * kept
    known_motion = moved * eps <= 1e-4 * largest(jnp.maximum(jnp.abs(contacts.pressing(D)), free))
    # A law so stiff that its force is not that of the indentation knows neither.
    unlike = largest(jnp.abs(contacts.force(depth) - force))
    balanced = (missed <= 64 * eps) & (stiffness * eps < 0.1) & known_motion
    balanced = balanced & (unlike <= UNLIKE * largest(jnp.abs(force)))
    lifted = there & (D > free) & (width is not None)
    lifted = lifted if bonded is None else lifted & ~bonded
    status = jnp.where(lifted, PressStatus.LIFTED, PressStatus.NO_CONTACT)
    status = jnp.where(there & (force != kept), PressStatus.OK, status)
    status = jnp.where(balanced, status, PressStatus.NOT_CONVERGED)
    status = jnp.where(past, PressStatus.PAST_FOLD, status)
    status = jnp.where(known, status, PressStatus.NON_FINITE).astype(jnp.int8)
    solved = known & balanced & ~past
    depth = depth if floor is None else jnp.where(force == floor, own, depth)
    depth, force = (jnp.where(solved, v, jnp.nan) for v in (depth, force))
    return ContactForces(depth, force, status, steps)


def stick(
    displacement: Float[Array, "n m"],
    compliance: Float[Array, "m m"],
    law: Law,
    width: Float[Array, ""],
    glued: Bool[Array, " m"],
    stuck: Bool[Array, " m"],
    present: Bool[Array, "n m"] | None = None,
) -> ContactForces:
    """Rows of tools of which some are glued from where they meet the wall, as others hold it.

    Args:
        displacement: see `solve`, as for all others.
        compliance: -
        law: -
        width: -
        glued: tools that stick where they touch.
        stuck: those of them that do so before the first row.
        present: tools that are there; one that is taken away lets go.
    """
    present = jnp.ones(displacement.shape, bool) if present is None else present

    def row(stuck, given):
        D, there = given
        loose = solve(D, compliance, law, width=width, present=there, bonded=stuck)
        stuck = (stuck | (glued & (loose.force > 0))) & there
        return stuck, solve(D, compliance, law, width=width, present=there, bonded=stuck)

    return jax.lax.scan(row, stuck, (displacement, present))[1]


def _newton(D, C, contacts: _Contacts, start):
    """Indentations, forces, steps, and how far the last one went, as a share of all motions.

    A step is F = f(d) + (E^-1 + C)^-1 (D - C f(d) - d), E = f'(d), at d = D - C g: the forces of
    the laws made straight at d. It subtracts nothing that is large, however stiff a law, so that
    the last one also restores the digits which f(d) has lost. The first step goes from no force
    towards `start`, as far as the energy falls: forces of contacts that do not know each other may
    lift the wall far beyond all tools.
    """
    size = largest(jnp.abs(contacts.pressing(D)))

    def step(state):
        count, g, _, _, _ = state
        u = product(C, g)
        d = D - u
        f = contacts.force(d)
        root = _root(contacts.tangent(d))
        y = _eliminate(_stiffened(C, root), (root * (u - product(C, f)))[:, None])[:, 0]
        force = f + root * y
        first = count == 0
        change = jnp.where(first, start, force - g)
        move = product(C, change)
        # Where the slope is 0 the law is straight, and level: the skeleton's motion remains.
        depth = jnp.where(root > 0, d + y / jnp.where(root > 0, root, 1), d - move)
        new = g + _length(contacts, d, g, change, move) * change
        whole = jnp.maximum(size, largest(product(jnp.abs(C), jnp.abs(force))))
        missed = largest(jnp.abs(move)) / jnp.where(whole > 0, whole, 1)
        return count + 1, new, force, depth, jnp.where(first, jnp.inf, missed)

    def goes(state):
        return (state[0] < STEPS) & ~(state[-1] <= 16 * epsilon(D.dtype))

    none = jnp.zeros_like(start)
    begin = jnp.zeros((), int), none, none, D, jnp.full_like(size, jnp.inf)
    count, _, force, depth, missed = jax.lax.while_loop(goes, step, begin)
    least = 0 if contacts.floor is None else contacts.floor
    if contacts.width is not None:
        none_pulls = jnp.maximum(force, least)  # not -1e-17
        held = contacts.bonded
        force = none_pulls if held is None else jnp.where(held, force, none_pulls)
    return depth, force, count, missed


def _length(contacts: _Contacts, d, g, change, move):
    """How much of a step to take: all, or up to where the energy along it is least.

    dE/dt rises along a step, with corners where contacts touch or let go, so that its zero stays in
    a bracket; the part up to the lower end of that never raises the energy.
    """
    constant, linear = jnp.sum(move * g), jnp.sum(move * change)

    def slope(t):
        return constant + t * linear - jnp.sum(move * contacts.force(d - t * move))

    none, all_of_it = jnp.zeros_like(constant), jnp.ones_like(constant)
    first, last = slope(none), slope(all_of_it)

    def narrow(_, bracket):
        low, at_low, high, at_high = bracket
        wide, rise = high - low, at_high - at_low
        t = low - at_low * wide / jnp.where(rise > 0, rise, 1)
        t = jnp.clip(t, low + 0.1 * wide, high - 0.1 * wide)
        here = slope(t)
        left = here <= 0
        low, at_low = jnp.where(left, t, low), jnp.where(left, here, at_low)
        return low, at_low, jnp.where(left, high, t), jnp.where(left, at_high, here)

    bracket = none, jnp.minimum(first, 0), all_of_it, last
    low, _, high, _ = jax.lax.fori_loop(0, SEARCH, narrow, bracket)
    return jnp.where(last > 0.5 * jnp.abs(first), jnp.where(low > 0, low, high), all_of_it)


@jax.custom_jvp
def _follow(D, C, contacts: _Contacts, depth, force):
    """The solution, with the derivatives of the equilibrium by D, C and the law."""
    return depth, force


@_follow.defjvp
def _follow_jvp(primals, tangents):
    """(1 + E C) F' = own + E given and (1 + C E) d' = given - C own.

    `own`: growth of the forces at fixed d; `given`: what moves the contacts at fixed forces. In
    sqrt(E) both are one symmetric system in which nothing cancels.
    """
    D, C, contacts, *_ = primals
    d_D, d_C, d_contacts, *_ = tangents
    depth, force = _follow(*primals)
    known = jnp.isfinite(jnp.sum(force))
    at, F = (jnp.where(known, v, 0) for v in (depth, force))
    pressed = contacts.pressed(at)[0]
    root = _root(contacts.tangent(at))
    on = root > 0
    own = pressed * d_contacts.law.secant(pressed * pressed)
    own, let_go = jnp.where(on, own, 0), jnp.zeros_like(own)
    if contacts.floor is not None:
        let_go = jnp.where(F == contacts.floor, d_contacts.floor, 0)
    given = d_D - product(d_C, F) - product(C, let_go)
    over = jnp.where(on, own / jnp.where(on, root, 1), 0)
    rows = jnp.stack([over + root * given, root * (given - product(C, own))], axis=1)
    z, y = _eliminate(_stiffened(C, root), rows).T
    d_force = root * z
    d_depth = jnp.where(on, y / jnp.where(on, root, 1), given - product(C, d_force))
    return (depth, force), (d_depth, d_force + let_go)


def _root(tangent):
    return jnp.where(tangent > 0, jnp.sqrt(jnp.where(tangent > 0, tangent, 1)), 0)


def _stiffened(C, root):
    """1 + sqrt(E) C sqrt(E): positive definite, no eigenvalue below 1."""
    return jnp.eye(root.shape[0], dtype=C.dtype) + root[:, None] * C * root[None]


def _eliminate(matrix: Float[Array, "m m"], rhs: Float[Array, "m r"]) -> Float[Array, "m r"]:
    """Solve a symmetric system without eigenvalues below 1, all lanes at once (Gauss and Jordan).

    No pivot is below 1 either; punches on one place that are too stiff for their digits, where
    rounding could make it so, are NOT_CONVERGED in `solve`. A loop: written out, XLA for CPUs makes
    one kernel of all steps and computes each anew for the next.
    """
    m = rhs.shape[0]
    rows = jnp.arange(m)[:, None]

    def step(i, system):
        matrix, rhs = system
        row, given = (jax.lax.dynamic_index_in_dim(v, i) for v in (matrix, rhs))
        factor = jax.lax.dynamic_index_in_dim(matrix, i, axis=1)
        own = jax.lax.dynamic_index_in_dim(row, i, axis=1)
        row, given = row / own, given / own
        return (
            jnp.where(rows == i, row, matrix - factor * row),
            jnp.where(rows == i, given, rhs - factor * given),
        )

    return jax.lax.fori_loop(0, m, step, (matrix, rhs))[1]
