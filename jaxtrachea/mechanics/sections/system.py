r"""Rings, spans, ends and contact together: residual, tangent and linear solution.

Unknowns z = (y, q_C, F): y = (q, psi) of every node (both ends of the tube and the rings), the
modes q_C of the section at the contact, and the contact's force. A punch has two contacts, its
edges: N, S, q_C and F are those of both, and each takes its own share of the local compliance.
Residual:

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

from jaxtrachea.fusion import fuse
from jaxtrachea.mechanics.sections import block
from jaxtrachea.mechanics.sections.contact import Place
from jaxtrachea.mechanics.sections.section import Grid, Line, Ring, Shape, deform, line_energy
from jaxtrachea.mechanics.sections.section_tangent import (
    Surface,
    line_forces,
    line_tangent,
    surface_tangent,
)
from jaxtrachea.mechanics.sections.span import (
    WARPING,
    Span,
    selector,
    span_energy,
    span_forces,
    span_tangent,
)


class State(NamedTuple):
    """The unknowns.

    Attributes:
        y: of each node, four modes q, mm, and three rotations psi, by parity; those of the ends
            are scaled.
        q_C: modes at each contact, mm.
        force: of the tool on the wall, inward and (off the midline) along the circumference, N.
    """

    y: Float[Array, "*s nodes parities 7"]
    q_C: Float[Array, "*s contacts parities 4"]
    force: Float[Array, "*s contacts directions"]


class System(NamedTuple):
    """All that a press depends on, but the tool's displacement.

    Attributes:
        shape: the cross-section.
        grid: its quadrature.
        rings: stacked.
        spans: stacked.
        scale: physical unknowns over y: 1, less for psi of the ends, 0 for their q.
        ends: stiffness of psi at both ends, scaled.
        place: of the contacts.
        phi_c: their angle, rad.
        give: local compliance of the tool, inward and along the circumference, mm/N.
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
    """The residual's derivative, with the contact condensed into the skeleton and that eliminated.

    With M = B^T B / give - H, the contact's stiffness against q_C, and the span's own compliance S
    between, the nodes feel N^T E N, E = M (I + S M)^-1. Its stable states are minima: no block of
    K_T + N^T E N has a negative pivot there.

    Attributes:
        factors: of K_T + N^T E N, block tridiagonal.
        share: N, scaled, by unknown: each belongs to one mode only.
        own: S.
        stiffness: E, N/mm; between the modes at each contact.
        B: dv/dq.
        give: of one contact, mm/N.
        negative: negative pivots of I + S M.
    """

    factors: block.Factors
    share: Float[Array, "contacts nodes m"]
    own: Float[Array, "contacts contacts modes"]
    stiffness: Float[Array, "contacts modes contacts modes"]
    B: Float[Array, "contacts directions modes"]
    give: Float[Array, " directions"]
    negative: Int[Array, ""]


def at_rest(system: System) -> State:
    """The undeformed state."""
    own = system.place.own
    force = jnp.zeros((own.shape[0], *system.give.shape), own.dtype)
    return State(jnp.zeros_like(system.scale), jnp.zeros_like(own[0]), force)


def physical(state: State, system: System) -> Float[Array, "nodes parities 7"]:
    """Unknowns of the nodes, mm and rad."""
    return system.scale * state.y


def ring_modes(state: State, system: System) -> Float[Array, "rings modes"]:
    """Modes of each ring, mm; symmetric ones first."""
    q = physical(state, system)[1:-1, :, :4]
    return q.reshape(q.shape[0], -1)


def lines(state: State, system: System) -> Line:
    """The rings' mid-lines and, last, those of the sections at the contacts."""
    q_C = state.q_C.reshape(state.q_C.shape[0], -1)
    q = jnp.concatenate([ring_modes(state, system), q_C])
    return jax.vmap(deform, (0, None, None))(q, system.grid, system.shape)


def of_rings(line: Line, system: System) -> Line:
    """Those of `lines` that are rings."""
    return jax.tree.map(lambda v: v[: system.scale.shape[0] - 2], line)


def contact_surface(state: State, line: Line, system: System) -> Surface:
    """Motion of the outer surface at each contact, from `lines`."""
    line = jax.tree.map(lambda v: v[system.scale.shape[0] - 2 :], line)
    surface = jax.vmap(surface_tangent, (0, None, 0, None, None))
    return surface(line, system.phi_c, state.force, system.grid, system.shape)


def _mode_of(parities: int) -> np.ndarray:
    """The mode to which each unknown of a node belongs."""
    one = [np.array([*range(4), *places]) for places in WARPING[:parities]]
    return np.concatenate([4 * p + modes for p, modes in enumerate(one)])


def _share(system: System):
    """N by unknown, (contacts, nodes, m): no unknown moves two modes."""
    shares = jnp.sum(system.place.shares, 3) * system.scale[None]
    return shares.reshape(*shares.shape[:2], -1)


def _gather(share, y):
    """N y of scaled unknowns (nodes, m); (contacts, modes)."""
    moved = jnp.sum(share * y[None], 1).reshape(share.shape[0], -1, 7)
    E = jnp.asarray(selector(moved.shape[1], moved.dtype))
    return (moved[..., :4] + jnp.sum(E[None] * moved[:, :, None, 4:], 3)).reshape(
        share.shape[0], -1
    )


def _spread(share, g):
    """N^T g, scaled; (nodes, m)."""
    return jnp.sum(share * g[:, None, _mode_of(share.shape[2] // 7)], 0)


def _own_part(own, g):
    """S g; (contacts, modes)."""
    return jnp.sum(own * g[None], 1)


def _by_modes(own):
    """S with the modes of both parities in one row; (contacts, contacts, modes)."""
    return own.reshape(*own.shape[:2], -1)


def _pairs(Y):
    """Unknowns of both ends of each span."""
    return jnp.concatenate([Y[:-1], Y[1:]], 2)


def _pinned(system: System):
    """Rows of unknowns that are held at zero."""
    return (system.scale == 0).astype(system.scale.dtype)


def _held_ends(y, system: System):
    """Forces on the ends' rotations, as an array of the shape of y."""
    turned = jnp.stack([y[0], y[-1]])[:, :, 4:]
    pulled = jnp.einsum("epij,epj->epi", system.ends, turned)
    pulled = jnp.pad(pulled, ((0, 0), (0, 0), (4, 0)))
    return jnp.concatenate([pulled[:1], jnp.zeros_like(y[1:-1]), pulled[1:]])


def _assemble(span, ring, state: State, system: System, g):
    """r_y from the forces of spans and rings and the force g on the modes of the contact."""
    total = jnp.pad(span[:, :, :7], ((0, 1), (0, 0), (0, 0)))
    total = total + jnp.pad(span[:, :, 7:], ((1, 0), (0, 0), (0, 0)))
    total = total + jnp.pad(ring.reshape(ring.shape[0], -1, 4), ((1, 1), (0, 0), (0, 3)))
    own = _pinned(system) * state.y + _held_ends(state.y, system)
    pushed = _spread(_share(system), g).reshape(total.shape)
    return system.scale * total - pushed + own


def _contact(state: State, displacement, system: System, surface: Surface):
    """r_q and r_F, and the force on the modes at each contact."""
    g = pushed_modes(surface, state)
    nodes = system.scale.shape[0]
    follows = _gather(_share(system), state.y.reshape(nodes, -1))
    r_q = state.q_C.reshape(g.shape) - follows - _own_part(_by_modes(system.place.own), g)
    way = displacement * system.direction
    r_F = surface.motion - way[None] + _give_each(system)[None] * state.force
    return r_q.reshape(state.q_C.shape), r_F, g


def pushed_modes(surface: Surface, state: State) -> Float[Array, "contacts modes"]:
    """B^T F, the force on the modes at each contact, N."""
    return jnp.sum(surface.slope * state.force[:, :, None], 1)


def _give_each(system: System):
    """Local compliance of one contact: alike under all, they are the tool's together."""
    return system.give * system.place.own.shape[0]


def residual(state: State, displacement: Float[Array, ""], system: System) -> State:
    """What does not balance: N and N mm, mm, mm."""
    return residual_of(lines(state, system), state, displacement, system)


def residual_of(line: Line, state: State, displacement: Float[Array, ""], system: System) -> State:
    """`residual` where the mid-lines are known."""
    surface = contact_surface(state, line, system)
    r_q, r_F, g = _contact(state, displacement, system, surface)
    span = jax.vmap(span_forces)(_pairs(physical(state, system)), system.spans)
    rings = jax.vmap(line_forces, (0, 0, None, None))
    ring = rings(of_rings(line, system), system.rings, system.grid, system.shape)
    return State(_assemble(span, ring, state, system, g), r_q, r_F)


class Elements(NamedTuple):
    """Rings and spans in a state.

    Attributes:
        line: of `lines`.
        span: forces on the unknowns of both ends of each span.
        of_span: their derivatives.
        ring: forces on the modes of each ring, N.
        of_ring: their derivatives, N/mm.
    """

    line: Line
    span: Float[Array, "spans parities 14"]
    of_span: Float[Array, "spans a a"]
    ring: Float[Array, "rings modes"]
    of_ring: Float[Array, "rings modes modes"]


def elements(line: Line, state: State, system: System) -> Elements:
    """Forces and stiffness of rings and spans, where the mid-lines are known."""
    spans = jax.vmap(span_tangent)(_pairs(physical(state, system)), system.spans)
    rings = jax.vmap(line_tangent, (0, 0, None, None))
    ring = rings(of_rings(line, system), system.rings, system.grid, system.shape)
    return Elements(line, *spans, *ring)


def linearise(
    state: State, displacement: Float[Array, ""], system: System
) -> tuple[State, Tangent]:
    """The residual and its derivative, in parts that are a kernel each where called alone."""
    close = fuse(lines, products=True)
    found = elements(close(state, system), state, system)
    # With blocks of 14 x 14 the library is quicker.
    whole = fuse(assemble, products=True) if system.grid.midline else assemble
    return whole(found, state, displacement, system)


def assemble(
    found: Elements, state: State, displacement: Float[Array, ""], system: System
) -> tuple[State, Tangent]:
    """`linearise` where rings and spans are known."""
    surface = contact_surface(state, found.line, system)
    r_q, r_F, g = _contact(state, displacement, system, surface)
    r = State(_assemble(found.span, found.ring, state, system, g), r_q, r_F)
    B, own, share = surface.slope, _by_modes(system.place.own), _share(system)
    give = _give_each(system)
    E, negative = _contact_stiffness(B, own, surface.curved, give)
    diagonal, upper = stiffness(found.of_span, found.of_ring, system)
    mode = _mode_of(system.scale.shape[1])
    after = jnp.pad(share[:, 1:], ((0, 0), (0, 1), (0, 0)))
    # Contacts in two spans do not meet in E: whatever is not next to each other stays so.
    for i, j in np.ndindex(own.shape[:2]):
        felt = E[i, :, j][mode[:, None], mode[None]][None] * share[i][:, :, None]
        diagonal, upper = diagonal + felt * share[j][:, None], upper + felt * after[j][:, None]
    factors = block.factor(diagonal, upper)
    return r, Tangent(factors, share, own, E, B, give, negative)


def _contact_stiffness(B, own, curved, give):
    """E = M (I + S M)^-1 with M = B^T B / give - H of each contact; negative pivots of I + S M."""
    count, modes = own.shape[1:]
    M = [(b.T / give[None]) @ b - h for b, h in zip(B, curved, strict=True)]
    rows = [[own[i, j][:, None] * M[j] for j in range(count)] for i in range(count)]
    matrix = jnp.eye(count * modes, dtype=own.dtype) + jnp.block(rows)
    inverse, negative = block.invert(matrix)
    parts = inverse.reshape(count, modes, -1)
    E = jnp.stack([m @ part for m, part in zip(M, parts, strict=True)])
    return E.reshape(count, modes, count, modes), negative


def stiffness(
    of_span: Float[Array, "spans a a"], of_ring: Float[Array, "rings b b"], system: System
) -> tuple[Float[Array, "nodes m m"], Float[Array, "nodes m m"]]:
    """Blocks of the skeleton's stiffness on and above the diagonal."""
    nodes, parities, _ = system.scale.shape
    m = 7 * parities
    ends = of_span.reshape(-1, parities, 2, 7, parities, 2, 7)

    def part(i, j):
        return ends[:, :, i, :, :, j].reshape(-1, m, m)

    def padded(v, before, after):
        return jnp.pad(v, ((before, after), (0, 0), (0, 0)))

    s = system.scale.reshape(nodes, m)
    rings = of_ring.reshape(-1, parities, 4, parities, 4)
    rings = jnp.pad(rings, ((1, 1), (0, 0), (0, 3), (0, 0), (0, 3))).reshape(nodes, m, m)
    diagonal = padded(part(0, 0), 0, 1) + padded(part(1, 1), 1, 0) + rings
    diagonal = diagonal * s[:, :, None] * s[:, None]
    diagonal = diagonal + jnp.eye(m, dtype=s.dtype)[None] * _pinned(system).reshape(nodes, 1, m)
    held = jnp.pad(system.ends, ((0, 0), (0, 0), (4, 0), (4, 0)))
    held = held[:, :, :, None] * jnp.eye(parities, dtype=s.dtype)[None, :, None, :, None]
    held = held.reshape(2, m, m)
    none = jnp.zeros((nodes - 2, m, m), s.dtype)
    diagonal = diagonal + jnp.concatenate([held[:1], none, held[1:]])
    return diagonal, padded(part(0, 1) * s[:-1, :, None] * s[1:, None], 0, 1)


def solve_linear(tangent: Tangent, r: State) -> State:
    """J^-1 r."""
    found = solve_several(tangent, jax.tree.map(lambda v: v[None], r))
    return jax.tree.map(lambda v: v[0], found)


def solve_several(tangent: Tangent, r: State) -> State:
    """J^-1 r of several r, stacked."""
    share, own, E = tangent.share, tangent.own, tangent.stiffness

    def condense(r):
        b = jnp.sum(tangent.B * (r.force / tangent.give[None])[:, :, None], 1)
        fixed = r.q_C.reshape(b.shape) + _own_part(own, b)
        return r.y.reshape(share.shape[1:]) + _spread(share, b - felt(fixed)), fixed

    def felt(q):
        return (E.reshape(q.size, -1) @ q.ravel()).reshape(q.shape)

    def expand(r, y, fixed):
        moved = _gather(share, y) + fixed
        q = moved - _own_part(own, felt(moved))
        force = (r.force - jnp.sum(tangent.B * q[:, None], 2)) / tangent.give[None]
        return State(y.reshape(r.y.shape), q.reshape(r.q_C.shape), force)

    rhs, fixed = jax.vmap(condense, out_axes=(2, 0))(r)
    y = block.solve(tangent.factors, rhs)
    return jax.vmap(expand, (0, 2, 0))(r, y, fixed)


def excess_negative(tangent: Tangent) -> Int[Array, ""]:
    """Number of directions in which the held state is not a minimum of the energy.

    The forces within the span and of the tool are multipliers: of the symmetric form of the
    tangent in (y, their values, q_C) a minimum has as many negative eigenvalues as there are
    multipliers. That number is taken off; 0: stable while the tool is held.

    Eliminated in the order F, (g, q_C), y: of F all pivots are negative, of [[-S, I], [I, M]] as
    many as it has modes and those of I + S M, and what is left for y is K_T + N^T E N.
    """
    return tangent.factors.negative + tangent.negative


def stored_energy_of(line: Line, state: State, system: System) -> Float[Array, ""]:
    """Energy of rings, spans, ends and the contact's own compliances, N mm; mid-lines given."""
    rings = jax.vmap(line_energy, (0, 0, None, None))
    in_rings = rings(of_rings(line, system), system.rings, system.grid, system.shape)
    spans = jax.vmap(span_energy)(_pairs(physical(state, system)), system.spans)
    ends = jnp.sum(state.y * _held_ends(state.y, system)) / 2
    g = pushed_modes(contact_surface(state, line, system), state)
    own = jnp.sum(g * _own_part(_by_modes(system.place.own), g))
    own = own + jnp.sum(_give_each(system)[None] * state.force**2)
    return jnp.sum(in_rings) + jnp.sum(spans) + ends + own / 2
