r"""Rings, spans, ends and contact together: residual, tangent and linear solution.

Unknowns z = (y, q_C, F): y = (q, psi) of every node (both ends of the tube and the rings), the
modes q_C of the section at the contact, and the contact's force. Residual:

    r_y = dU/dy + dW/dy - N^T B^T F,   r_q = q_C - N y - S B^T F,   r_F = v(q_C) - D e + give F

with B = dv/dq at q_C. The tangent is block tridiagonal in y, bordered by the contact. Ends: q = 0,
and psi is held by k_end C; they are scaled by 1 / sqrt(1 + k_end h), so that 0 and inf are ordinary
values of k_end.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxtrachea.mechanics.sections import block
from jaxtrachea.mechanics.sections.contact import Place
from jaxtrachea.mechanics.sections.section import Grid, Ring, Shape, energy, surface_motion
from jaxtrachea.mechanics.sections.section_tangent import ring_forces, ring_tangent
from jaxtrachea.mechanics.sections.span import Span, span_energy, span_forces, span_tangent


class State(NamedTuple):
    """The unknowns.

    Attributes:
        y: of each node, four modes q, mm, and three rotations psi, by parity; those of the ends
            are scaled.
        q_C: modes at the contact, mm.
        force: of the tool on the wall, inward and (off the midline) along the circumference, N.
    """

    y: Float[Array, "*s nodes parities 7"]
    q_C: Float[Array, "*s parities 4"]
    force: Float[Array, "*s directions"]


class System(NamedTuple):
    """All that a press depends on, but the tool's displacement.

    Attributes:
        shape: the cross-section.
        grid: its quadrature.
        rings: stacked.
        spans: stacked.
        scale: physical unknowns over y: 1, less for psi of the ends, 0 for their q.
        ends: stiffness of psi at both ends, scaled.
        place: of the contact.
        phi_c: its angle, rad.
        give: local compliance, inward and along the circumference, mm/N.
        direction: of the tool's displacement, likewise.
    """

    shape: Shape
    grid: Grid
    rings: Ring
    spans: Span
    scale: Float[Array, "nodes parities 7"]
    ends: Float[Array, "2 parities 3 3"]
    place: Place
    phi_c: Float[Array, ""]
    give: Float[Array, " directions"]
    direction: Float[Array, " directions"]


class Tangent(NamedTuple):
    """The residual's derivative, with the skeleton eliminated.

    Attributes:
        factors: of the skeleton's block-tridiagonal stiffness.
        border: N^T, scaled; (nodes, m, modes).
        moved: the skeleton's motion under it.
        compliance: at the contact, of skeleton and span, mm/N; (modes, modes).
        B: dv/dq; (directions, modes).
        H: d2(v F)/dq2.
        give: mm/N.
    """

    factors: block.Factors
    border: Float[Array, "nodes m modes"]
    moved: Float[Array, "nodes m modes"]
    compliance: Float[Array, "modes modes"]
    B: Float[Array, "directions modes"]
    H: Float[Array, "modes modes"]
    give: Float[Array, " directions"]


def at_rest(system: System) -> State:
    """The undeformed state."""
    zeros = jnp.zeros_like
    return State(zeros(system.scale), zeros(system.place.own), zeros(system.give))


def physical(state: State, system: System) -> Float[Array, "nodes parities 7"]:
    """Unknowns of the nodes, mm and rad."""
    return system.scale * state.y


def ring_modes(state: State, system: System) -> Float[Array, "rings modes"]:
    """Modes of each ring, mm; symmetric ones first."""
    q = physical(state, system)[1:-1, :, :4]
    return q.reshape(q.shape[0], -1)


def surface(q: Float[Array, " modes"], system: System) -> Float[Array, " directions"]:
    """Motion of the outer surface at the contact's angle, in the directions of the force."""
    moved = surface_motion(q, system.phi_c, system.grid, system.shape)
    return moved[: system.give.shape[0]]


def _pairs(Y):
    """Unknowns of both ends of each span."""
    return jnp.concatenate([Y[:-1], Y[1:]], 2)


def _pinned(system: System):
    """Rows of unknowns that are held at zero."""
    return (system.scale == 0).astype(system.scale.dtype)


def _held_ends(y, system: System):
    """Forces on the ends' rotations, as an array of the shape of y."""
    pulled = jnp.einsum("epij,epj->epi", system.ends, y[jnp.array([0, -1]), :, 4:])
    return jnp.zeros_like(y).at[jnp.array([0, -1]), :, 4:].set(pulled)


def _assemble(span, ring, state: State, system: System, g):
    """r_y from the forces of spans and rings and the force g on the modes of the contact."""
    total = jnp.zeros_like(state.y).at[:-1].add(span[:, :, :7]).at[1:].add(span[:, :, 7:])
    total = total.at[1:-1, :, :4].add(ring.reshape(ring.shape[0], -1, 4))
    total = total - jnp.einsum("npkj,pk->npj", system.place.shares, g)
    own = _pinned(system) * state.y + _held_ends(state.y, system)
    return system.scale * total + own


def _contact(state: State, displacement, system: System, B):
    """r_q and r_F, and the force on the modes."""
    g = (B.T @ state.force).reshape(state.q_C.shape)
    follows = jnp.einsum("npkj,npj->pk", system.place.shares, physical(state, system))
    r_q = state.q_C - follows - system.place.own * g
    v = surface(state.q_C.ravel(), system)
    return r_q, v - displacement * system.direction + system.give * state.force, g


def _surface_slope(state: State, system: System):
    """B, by one pass back for each direction."""
    return jax.jacrev(lambda q: surface(q, system))(state.q_C.ravel())


def residual(state: State, displacement: Float[Array, ""], system: System) -> State:
    """What does not balance: N and N mm, mm, mm."""
    r_q, r_F, g = _contact(state, displacement, system, _surface_slope(state, system))
    span = jax.vmap(span_forces)(_pairs(physical(state, system)), system.spans)
    rings = jax.vmap(ring_forces, (0, 0, None, None))
    ring = rings(ring_modes(state, system), system.rings, system.grid, system.shape)
    return State(_assemble(span, ring, state, system, g), r_q, r_F)


def linearise(
    state: State, displacement: Float[Array, ""], system: System
) -> tuple[State, Tangent]:
    """The residual and its derivative."""
    q_C = state.q_C.ravel()
    B = _surface_slope(state, system)
    H = jax.hessian(lambda q: state.force @ surface(q, system))(q_C)
    r_q, r_F, g = _contact(state, displacement, system, B)
    span, of_span = jax.vmap(span_tangent)(_pairs(physical(state, system)), system.spans)
    rings = jax.vmap(ring_tangent, (0, 0, None, None))
    ring, of_ring = rings(ring_modes(state, system), system.rings, system.grid, system.shape)
    r = State(_assemble(span, ring, state, system, g), r_q, r_F)
    factors = block.factor(*stiffness(of_span, of_ring, system))
    shares = system.place.shares * system.scale[:, :, None]
    nodes, parities = shares.shape[:2]
    spread = jnp.eye(parities, dtype=q_C.dtype)[None, :, None, :, None]
    border = shares.transpose(0, 1, 3, 2)[:, :, :, None] * spread
    border = border.reshape(nodes, 7 * parities, 4 * parities)
    moved = block.solve(factors, border)
    compliance = jnp.einsum("nim,nik->mk", border, moved) + jnp.diag(system.place.own.ravel())
    return r, Tangent(factors, border, moved, compliance, B, H, system.give)


def stiffness(
    of_span: Float[Array, "spans a a"], of_ring: Float[Array, "rings b b"], system: System
) -> tuple[Float[Array, "nodes m m"], Float[Array, "nodes m m"]]:
    """Blocks of the skeleton's stiffness on and above the diagonal."""
    nodes, parities, _ = system.scale.shape
    m = 7 * parities
    ends = of_span.reshape(-1, parities, 2, 7, parities, 2, 7)

    def part(i, j):
        return ends[:, :, i, :, :, j].reshape(-1, m, m)

    s = system.scale.reshape(nodes, m)
    diagonal = jnp.zeros((nodes, m, m), s.dtype).at[:-1].add(part(0, 0)).at[1:].add(part(1, 1))
    q = np.concatenate([7 * p + np.arange(4) for p in range(parities)])
    diagonal = diagonal.at[1:-1, q[:, None], q[None]].add(of_ring)
    diagonal = diagonal * s[:, :, None] * s[:, None]
    diagonal = diagonal + jnp.eye(m, dtype=s.dtype)[None] * _pinned(system).reshape(nodes, 1, m)
    for p in range(parities):
        psi = 7 * p + 4 + np.arange(3)
        place = jnp.array([0, -1])[:, None, None], psi[None, :, None], psi[None, None]
        diagonal = diagonal.at[place].add(system.ends[:, p])
    upper = part(0, 1) * s[:-1, :, None] * s[1:, None]
    return diagonal, jnp.concatenate([upper, jnp.zeros_like(upper[:1])])


def solve_linear(tangent: Tangent, r: State) -> State:
    """J^-1 r."""
    nodes, m, modes = tangent.border.shape
    free = block.solve(tangent.factors, r.y.reshape(nodes, m, 1))[:, :, 0]
    C, B = tangent.compliance, tangent.B
    upper = jnp.concatenate([jnp.eye(modes, dtype=C.dtype) - C @ tangent.H, -C @ B.T], 1)
    J = jnp.concatenate([upper, jnp.concatenate([B, jnp.diag(tangent.give)], 1)])
    at_contact = r.q_C.ravel() + jnp.einsum("nim,ni->m", tangent.border, free)
    local = jnp.linalg.solve(J, jnp.concatenate([at_contact, r.force]))
    q, force = local[:modes], local[modes:]
    y = free + tangent.moved @ (tangent.H @ q + B.T @ force)
    return State(y.reshape(r.y.shape), q.reshape(r.q_C.shape), force)


def excess_negative(tangent: Tangent) -> Int[Array, ""]:
    """Number of directions in which the held state is not a minimum of the energy.

    The forces within the span and of the tool are multipliers: of the symmetric form of the
    tangent in (y, their values, q_C) a minimum has as many negative eigenvalues as there are
    multipliers. That number is taken off; 0: stable while the tool is held.
    """
    C, B, H = tangent.compliance, tangent.B, tangent.H
    size = jnp.sqrt(jnp.trace(C) / C.shape[0])  # mm and N to units of like size
    size = jnp.where(size > 0, size, 1)
    eye, none = jnp.eye(C.shape[0], dtype=C.dtype), jnp.zeros_like(B)
    S = jnp.block([
        [-C / size**2, eye, none.T],
        [eye, -H * size**2, -B.T],
        [none, -B, -jnp.diag(tangent.give) / size**2],
    ])  # fmt: skip
    values = jnp.linalg.eigvalsh((S + S.T) / 2)
    multipliers = C.shape[0] + B.shape[0]
    return tangent.factors.negative + jnp.sum(values < 0) - multipliers


def stored_energy(state: State, system: System) -> Float[Array, ""]:
    """Energy of rings, spans, ends and the contact's own compliances, N mm."""
    modes = ring_modes(state, system)
    rings = jax.vmap(energy, (0, 0, None, None))(modes, system.rings, system.grid, system.shape)
    spans = jax.vmap(span_energy)(_pairs(physical(state, system)), system.spans)
    ends = jnp.sum(state.y * _held_ends(state.y, system)) / 2
    g = (_surface_slope(state, system).T @ state.force).reshape(state.q_C.shape)
    own = jnp.sum(system.place.own * g * g) + jnp.sum(system.give * state.force**2)
    return jnp.sum(rings) + jnp.sum(spans) + ends + own / 2
