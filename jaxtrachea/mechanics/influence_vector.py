"""Contacts anywhere on the rings: how much each of them moves under a force at each other.

Every contact presses the strip of ligament on its own meridian, as a single one does (`skeleton`).
The forces in all strips and rings, each contact's as it makes them alone, are in equilibrium with
all contact forces, so that their complementary energy F C F / 2 gives the compliance (Castigliano):

    C_ij = sum_r P_r(i) . A_r(phi_i, phi_j) P_r(j) + kappa_ij S_ij.

P_r(j): load of strip j on ring r; A_r: motion of ring r at one angle per load at another
(`ring_influence`); S_ij: energy of bending and shear that the forces of both share, in components
of the inward normal and the circumference; kappa: the common part of two strips of the width
`STRIP`, max(0, 1 - |phi_i - phi_j| / STRIP). By virtual work S_ij is what strip j moves at contact
i beyond the motion of its rings. C is a Gram matrix times a kernel that is positive semi-definite:
so is C. On one meridian it is the Green's function of `influence`, for one contact that of
`skeleton_response`. Between meridians the wall follows the rings; that a strip stiffens the tube
for forces beside it is left out, or a second tool would change the first without a force.

A force along the tube stretches it. Rings move along as a whole (as in `skeleton`), so every
contact follows the rings on both sides of it, and the stretch of the own strip between them is
shared by kappa: C_ij = u_j(s_i) + kappa_ij b_ij, u_j linear between the rings, b the motion between
rings that are held.

Units: mm, N, mm/N, rad.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxtrachea._arguments import check_word
from jaxtrachea._numerics import product_of_rows
from jaxtrachea.mechanics import ring as _ring
from jaxtrachea.mechanics._matrix2 import apply, solve
from jaxtrachea.mechanics.axial import stretch
from jaxtrachea.mechanics.influence import sorted_places
from jaxtrachea.mechanics.skeleton import Rings, local_frame, needed, planes, turned_rings
from jaxtrachea.mechanics.spatial_beam import SpatialBeam, deflect
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import Material

#: Width of the strip of ligament under a contact, rad: the disc of A_L of Table 1 (2.8 mm) on its
#: rings of radius 11.3 mm.
STRIP = 2.8 / 11.3


class VectorInfluence(NamedTuple):
    """Everything that moves under a unit force at one of m contacts.

    The first axis is that of the f forces: the inward ones of all contacts, f = m; or inward, along
    (+s) and round the tube (+phi) of the first, of the second, ..., f = 3 m. A second axis is that
    of the meridian on which something moves. Vectors are x, y, z.

    Attributes:
        compliance: motion along force i per unit of force j, mm/N; symmetric and positive
            semi-definite; shape (f, f).
        contacts: displacement of each meridian's ligament at the places of all contacts, mm/N;
            shape (f, m, m, 3). Contact i is place i on meridian i.
        turns: its rotation there in y and z, rad/N; shape (f, m, m, 2).
        joints: displacement of the ligament at each ring, mm/N; shape (f, m, rings, 3).
        slopes: its rotation there, rad/N; shape (f, m, rings, 2).
        loads: load of the force's own strip on each ring, x: what passes it, as in `Skeleton`;
            shape (f, rings, 3).
        end_U: displacement of each ring's end at -alpha, mm/N; shape (f, rings, 3).
        end_V: that at +alpha.
        clamps: of the ends A and B of the tube on their axial springs, mm/N; shape (f, 2, 3).
    """

    compliance: Float[Array, "f f"]
    contacts: Float[Array, "f m m 3"]
    turns: Float[Array, "f m m 2"]
    joints: Float[Array, "f m rings 3"]
    slopes: Float[Array, "f m rings 2"]
    loads: Float[Array, "f rings 3"]
    end_U: Float[Array, "f rings 3"]
    end_V: Float[Array, "f rings 3"]
    clamps: Float[Array, "f 2 3"]


def influence_vector(
    geometry: Geometry,
    material: Material,
    s: Float[Array, " m"],
    phi: Float[Array, " m"],
    *,
    rings: Rings,
    shear: bool,
    tangential: bool = False,
    axial: bool = False,
) -> VectorInfluence:
    """Response of ligament and rings to unit forces at each of m points.

    Continuous in every argument; by phi it has a kink where two meridians meet (there derivatives
    are the mean of both sides) and where they are `STRIP` apart.

    Args:
        material: k_M, EI_L; `shear` needs GA_L, `arch2` EI_C and k_t, `axial` EA_L.
        s: positions of the contacts, mm, in [0, length], in any order; two may be equal.
        phi: their angles, rad, in [-alpha, alpha]; likewise.
        rings: `mat` or `arch2`, see `skeleton_response`. (An `arch` has no motion at another
            angle.)
        shear: the ligament also shears.
        tangential: forces along and round the tube, too; else inward ones alone.
        axial: of those the ones along the tube stretch it; else nothing moves along it.

    Raises:
        ValueError: an unknown level of `rings`, or a missing value of the material.
    """
    check_word("rings", rings, Rings)
    n, m = geometry.rings, s.shape[0]
    q = 2 if tangential else 1  # forces across the tube at each contact
    frames = jax.vmap(local_frame)(phi)[:, ::2, 1:]  # inward normal, circumference; columns y, z
    strips = _pressed(geometry, material, s, phi, rings, shear)
    A, ends = _ring_motions(geometry, material, phi, rings)
    A = _einsum("ipy,ijryz,jqz->ijrpq", frames, A, frames)
    kappa = jnp.maximum(0, 1 - jnp.abs(phi[:, None] - phi[None]) / STRIP)
    loads = strips.P[..., :q]
    moved = _einsum("ijrpq,jrqa->ijrpa", A, loads)  # of rings at i by the force at j
    C = _contacts(strips, moved, kappa)
    across = C[:, :, :q]
    across = (across + jnp.transpose(across, (1, 0, 3, 2))) / 2
    u, theta = _lines(strips, moved, kappa)

    def tube(v):
        """From the frames of the meridians to y and z, with the axes of the force first."""
        return _einsum("ij...pa,ipy->jai...y", v, frames)

    itself = jnp.eye(m, dtype=bool)[:, None, :, None, None]
    C = jnp.concatenate([across, C[:, :, q:]], 2)
    contacts = tube(jnp.where(itself, C[:, :, None], u[:, :, n:]))
    P = _einsum("jrpa,jpy->jary", loads, frames)
    U, V = (_widen(_einsum("jryz,jarz->jary", end, P)) for end in ends)
    found = {
        "contacts": _widen(contacts), "turns": tube(theta[:, :, n:]),
        "joints": _widen(tube(u[:, :, :n])), "slopes": tube(theta[:, :, :n]), "loads": _widen(P),
        "end_U": U, "end_V": V, "clamps": jnp.zeros((m, q, 2, 3), s.dtype),
    }  # fmt: skip
    compliance = jnp.transpose(across, (0, 2, 1, 3))
    if tangential:
        along, C_x = _along(geometry, material, s, kappa, axial)
        found = {k: jnp.concatenate([v[:, :1], along[k], v[:, 1:]], 1) for k, v in found.items()}
        compliance = jnp.zeros((m, 3, m, 3), s.dtype).at[:, ::2, :, ::2].set(compliance)
        compliance = compliance.at[:, 1, :, 1].set(C_x)
    f = m * len(found["loads"][0])
    forces = {name: v.reshape(f, *v.shape[2:]) for name, v in found.items()}
    return VectorInfluence(compliance=compliance.reshape(f, f), **forces)


def own_contacts(unit: VectorInfluence) -> Float[Array, "f m 3"]:
    """Displacement of every contact, each on its own meridian, per unit force, mm/N."""
    return jnp.stack([unit.contacts[:, i, i] for i in range(unit.contacts.shape[1])], axis=1)


def by_all(force: Float[Array, "*n f"], unit: Float[Array, "f ..."]) -> Array:
    """What all forces do together, of what a unit of each does; shape (*n, ...)."""
    rows = product_of_rows(force.reshape(-1, force.shape[-1]), unit.reshape(unit.shape[0], -1))
    return rows.reshape(*force.shape[:-1], *unit.shape[1:])


def _einsum(*given):
    return jnp.einsum(*given, precision="highest")


class _Strips(NamedTuple):
    """All strips, each pressed at its contact; components inward and round the tube.

    Places are the rings, then all contacts in their own order.

    Attributes:
        beams: the strips; a leading axis.
        s: of their contacts, mm.
        C: compliance of their rings, mm/N; shape (m, rings, 2, 2).
        order: of places along the tube.
        places: of rings and contacts in that order.
        w: motion of all places per component of the force; shape (m, places, 2, 2).
        theta: rotation there.
        P: loads on the rings; shape (m, rings, 2, 2).
    """

    beams: SpatialBeam
    s: Float[Array, " m"]
    C: Float[Array, "m rings 2 2"]
    order: Int[Array, " places"]
    places: Int[Array, " places"]
    w: Float[Array, "m places 2 2"]
    theta: Float[Array, "m places 2 2"]
    P: Float[Array, "m rings 2 2"]


def _pressed(geometry: Geometry, material: Material, s, phi, rings: Rings, shear: bool) -> _Strips:
    # Of contacts on a ring behind it.
    order, places = sorted_places(jnp.concatenate([geometry.ring_positions, s]))
    C = jax.vmap(lambda at: turned_rings(geometry, material, at, rings))(phi)
    beams = jax.vmap(lambda C: _strip(geometry, material, s, order, C, shear))(C)

    def press(beam, at):
        unit = jax.vmap(deflect, (None, None, 0), -1)(beam, at, jnp.eye(2, dtype=s.dtype))
        return tuple(v[places] for v in (unit.w, unit.theta, unit.reaction))

    w, theta, P = jax.vmap(press)(beams, s)
    return _Strips(beams, s, C, order, places, w, theta, P[:, : geometry.rings])


def _contacts(strips: _Strips, moved, kappa) -> Float[Array, "m m 2 q"]:
    """Motion of contact i, inward and round the tube, by the forces at j; mm/N."""
    P, q = strips.P, moved.shape[-1]
    alone = jnp.eye(kappa.shape[0], dtype=bool)[..., None, None]
    own = jnp.swapaxes(strips.w[:, P.shape[1] :, :, :q], 0, 1)
    shared = own - _einsum("irpa,jrpq,jrqb->ijab", P, strips.C, P[..., :q])
    by_rings = _einsum("irpa,ijrpb->ijab", P, moved)
    return jnp.where(alone, own, by_rings + kappa[..., None, None] * shared)


def _lines(strips: _Strips, moved, kappa):
    """Motion and rotation of strip i by the forces at j, at all places; (m, m, places, 2, q).

    A strip lies on rings that others move. Of what another bends by itself, beyond its rings, it
    has the common part.
    """
    m, q = kappa.shape[0], moved.shape[-1]
    alone = jnp.eye(m, dtype=bool)[..., None, None, None]

    def lie(beam, at, C, moved, own):
        load = jnp.where(own, moved, jax.vmap(_load)(C, moved))
        load = jnp.concatenate([load, jnp.zeros((m, 2), load.dtype)])[strips.order]
        found = deflect(beam, at, jnp.zeros(2, load.dtype), ring_load=load)
        return found.w[strips.places], found.theta[strips.places]

    # On its own rings by its own loads: those are known.
    given = jnp.where(alone, strips.P[..., :q], moved)
    over = jax.vmap(lie, (None, None, None, -1, None), -1)
    over = jax.vmap(jax.vmap(over, (None, None, None, 0, 0)))
    lying = over(strips.beams, strips.s, strips.C, given, alone[..., 0, 0, 0])

    def line(lying, own):
        rest = jnp.stack([lying[j, j] for j in range(m)])
        u = lying + kappa[..., None, None, None] * (own - rest)[None]
        return jnp.where(alone, own[None], u)

    return tuple(map(line, lying, (strips.w[..., :q], strips.theta[..., :q])))


def _along(geometry: Geometry, material: Material, s, kappa, axial: bool):
    """What unit forces along the tube do, as fields of `VectorInfluence` with axes (m, 1, ...).

    Returns:
        The fields, and the motion of contact i along the tube by the force at j, (m, m).
    """
    x, length, (m, n) = geometry.ring_positions, geometry.length, (s.shape[0], geometry.rings)
    places, rings, ends = (jnp.zeros(shape, s.dtype) for shape in ((m, m, m), (m, n), (m, 2)))
    passed, C = rings, places[..., 0]
    if axial:
        EA = jnp.broadcast_to(needed(material, "EA_L", "axial"), (n + 1,))
        springs = {"k_A": material.k_A, "k_B": material.k_B}
        unit = jax.vmap(lambda at: stretch(x, length, EA, at, jnp.ones_like(at), **springs))(s)
        rings, ends = unit.u, jnp.stack([unit.u_A, unit.u_B], 1)
        passed = jnp.where(x[None] <= s[:, None], unit.force_A[:, None], unit.force_B[:, None])
        bounds = jnp.concatenate([jnp.zeros_like(x[:1]), x, length[None]])
        span = jnp.clip(jnp.searchsorted(bounds, s, side="right") - 1, 0, n)
        low, high = bounds[span], bounds[span + 1]
        nodes = jnp.concatenate([ends[:, :1], rings, ends[:, 1:]], 1)
        share = ((s - low) / (high - low))[None]
        linear = nodes[:, span] * (1 - share) + nodes[:, span + 1] * share  # at place p by force j
        a, b = jnp.minimum(s[:, None], s[None]), jnp.maximum(s[:, None], s[None])
        between = (a - low[None]) * (high[None] - b) / ((high - low) * EA[span])[None]
        between = jnp.where(span[:, None] == span[None], between, 0)
        places = linear[:, None] + kappa[:, :, None] * between[:, None]  # force, line, place
        itself = jnp.eye(m, dtype=bool)
        places = jnp.where(itself[:, None] & itself[None], unit.u_C[:, None, None], places)
        C = jnp.stack([places[:, i, i] for i in range(m)])
        C = (C + C.T) / 2

    def vectors(v):
        return jnp.stack([v, jnp.zeros_like(v), jnp.zeros_like(v)], -1)[:, None]

    lines = jnp.broadcast_to(rings[:, None], (m, m, n))
    whole = vectors(rings)
    still = {"turns": (m, 1, m, m, 2), "slopes": (m, 1, m, n, 2)}
    return {
        "contacts": vectors(places), "joints": vectors(lines), "loads": vectors(passed),
        "end_U": whole, "end_V": whole, "clamps": vectors(ends),
        **{name: jnp.zeros(shape, s.dtype) for name, shape in still.items()},
    }, C  # fmt: skip


def _strip(geometry: Geometry, material: Material, s, order, C, shear: bool) -> SpatialBeam:
    """The ligament of one meridian, with all contacts among its rings as supports of no force."""
    m, n = s.shape[0], geometry.rings
    ring = order < n
    span = jnp.concatenate([jnp.zeros(1, int), jnp.cumsum(ring)])
    EI = planes(material.EI_L, material.EI_side, n + 1)[span]
    GA = None
    if shear:
        GA = planes(needed(material, "GA_L", "shear"), material.GA_side, n + 1)[span]
    marks = jnp.broadcast_to(jnp.eye(2, dtype=C.dtype), (m, 2, 2))
    x = jnp.concatenate([geometry.ring_positions, s])[order]
    C = jnp.concatenate([C, marks])[order]
    return SpatialBeam(x, geometry.length, EI, C, GA, ring.astype(C.dtype))


def _load(C, moved):
    """Force on a ring of this compliance that moves it so; of a rigid ring none."""
    return apply(solve(C, jnp.eye(2, dtype=C.dtype)), moved)


def _ring_motions(geometry: Geometry, material: Material, phi, rings: Rings):
    """Motion in y and z per load at phi_j: at all phi_i, and of the ends U and V.

    Returns:
        Shapes (m, m, rings, 2, 2), and twice (m, rings, 2, 2).
    """
    m, n = phi.shape[0], geometry.rings
    k_M = jnp.broadcast_to(material.k_M, (n,))
    if rings == "mat":
        A = jnp.eye(2, dtype=phi.dtype)[None] / k_M[:, None, None]
        A = jnp.broadcast_to(A, (m, m, n, 2, 2))
        return A, (A[0], A[0])
    EI, k_t = (needed(material, name, "rings='arch2'") for name in ("EI_C", "k_t"))
    alpha = geometry.half_angle
    at = jnp.concatenate([phi, jnp.stack([-alpha, alpha])])

    def one(k):
        ring = _ring.Ring(geometry.radius, alpha, EI, k, k_t)
        by = jax.vmap(lambda a, b: _ring.ring_influence(ring, a, b), (None, 0))
        return jax.vmap(by, (0, None))(at, phi)

    if material.k_M.ndim == 0:
        A = jnp.broadcast_to(one(material.k_M)[:, :, None], (m + 2, m, n, 2, 2))
    else:
        A = jnp.moveaxis(jax.lax.map(one, k_M), 0, 2)  # not vmap: see `skeleton`
    return A[:m], (A[m], A[m + 1])


def _widen(v):
    """With x = 0 before y and z."""
    return jnp.concatenate([jnp.zeros_like(v[..., :1]), v], -1)
