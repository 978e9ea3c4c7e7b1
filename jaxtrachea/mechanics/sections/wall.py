r"""The wall between the rings and round them: how every point of it moves.

Along the tube the modes follow the shape functions of each span, q(s) = N_L y_L + N_R y_R, and in
the span that holds the contact its own deflection under the force on the modes there comes on top,
p(s) = G(s, s_C) g (`contact`): q + p is q_C where the tool acts. Round the tube each section is the
closed arch of `section`, at any size of q. A point at the distance r from the axis goes with the
mid-line and turns with it, the normal stays normal:

    U(q) = u_line(s, phi; q) + (r - R) [n(phi + theta) - n(phi)].

The own deflection is mostly that of the third harmonic, which the mechanics cuts the series at: it
would go round the whole ring, where those left out cancel it. It is laid on the side of the contact
only, up to the harmonic's next crest at 60 degrees: with x = phi - phi_C,

    u = U(q) + cos^2(3 x / 2) [U(q + p) - U(q)] for |x| < 60 deg, else U(q),

which the finite element specimen bears out (tests/sections/test_wall.py). u is continuous
everywhere, with a kink along s at the rings (the wall shears). Nothing moves along the tube: the
warping is left out, as in `press`.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from jaxtrachea._numerics import cos_sin
from jaxtrachea.mechanics.sections.contact import (
    acting_place,
    end_shares,
    modal_stiffness,
    own_deflection,
    span_of,
)
from jaxtrachea.mechanics.sections.section import (
    A1,
    B1,
    BACK,
    FRONT,
    Grid,
    Shape,
    deform,
    make_grid,
    mean_weights,
    turn_shapes,
)
from jaxtrachea.mechanics.sections.span import Span, selector


class Points(eqx.Module):
    """Points of the wall at rest; those at one place along the tube share its section.

    Attributes:
        s: the places, mm; shape (places,).
        place: of each point.
        phi: angle from the anterior midline, rad, in [-pi, pi].
        distance: from the axis of the tube, mm.
    """

    s: Float[Array, " places"]
    place: Int[Array, " points"]
    phi: Float[Array, " points"]
    distance: Float[Array, " points"]


def gather_points(
    s: Float[Array, " points"], phi: Float[Array, " points"], distance: Float[Array, " points"]
) -> Points:
    """Points by their place along the tube (traced ones have each their own).

    Args:
        s: position along the tube, mm.
        phi: angle, rad.
        distance: from the axis, mm.
    """
    if isinstance(s, Tracer):
        return Points(s, jnp.arange(s.shape[0]), phi, distance)
    places, place = np.unique(np.asarray(s), return_inverse=True)
    return Points(jnp.asarray(places), jnp.asarray(place, jnp.int32), phi, distance)


class Contact(NamedTuple):
    """Where a tool acts, and with what force on the modes there.

    Attributes:
        s: position of the tool, mm.
        footprint: see `contact.effective_place`.
        pushed: force on the modes, N.
    """

    s: Float[Array, ""]
    footprint: Float[Array, ""]
    pushed: Float[Array, "parities 4"]


class WallModes(NamedTuple):
    """Modes of the sections at places along the tube, mm; 4 of a press on the midline, else 8.

    Attributes:
        carried: by the rings on both sides, q.
        own: deflection of the span that holds the contact, p; 0 in the others.
    """

    carried: Float[Array, "*n places modes"]
    own: Float[Array, "*n places modes"]


def modes_along(
    places: Float[Array, " places"],
    nodes: Float[Array, " nodes"],
    unknowns: Float[Array, "nodes parities 7"],
    spans: Span,
    contact: Contact,
) -> WallModes:
    """Modes of the section at each place, symmetric ones first.

    Args:
        places: positions along the tube, mm; beyond its ends those of the ends.
        nodes: ends of the tube and rings, mm.
        unknowns: q and psi of each node.
        spans: stacked.
    """
    acts, load = acting_place(nodes, contact.s, contact.footprint)
    E = jnp.asarray(selector(unknowns.shape[1], unknowns.dtype))

    def at(s):
        j = span_of(nodes, s)
        h, beam = spans.h[j], modal_stiffness(spans.shear[j], spans.axial[j])
        x = jnp.clip(s - nodes[j], 0, h)
        own = jnp.where(j == acts, own_deflection(x, load, h, beam), 0) * contact.pushed
        q = jnp.zeros_like(own)
        ends = zip(end_shares(x, h, beam), (unknowns[j], unknowns[j + 1]), strict=True)
        for (held, turned), y in ends:
            q = q + held * y[:, :4] + turned * jnp.sum(E * y[:, None, 4:], 2)
        return WallModes(q.ravel(), own.ravel())

    return jax.vmap(at)(places)


class _Sections(NamedTuple):
    """Deformed sections, place by place.

    Attributes:
        w: modes and multipliers.
        slopes: u_y' and u_z' at the points of the grid with phi > 0, then at their mirror images.
        shift: displacement of the mid-line at phi = 0, mm.
    """

    w: Float[Array, "places shapes"]
    slopes: Float[Array, "places 2 half 2"]
    shift: Float[Array, "places 2"]


def _sections(modes, grid: Grid, shape: Shape) -> _Sections:
    mean = -mean_weights(grid.phi, grid.weights)
    mirror = jnp.asarray([-1.0, 1.0], modes.dtype)

    def one(q):
        line = deform(q, grid, shape)
        slopes = jnp.stack([line.slope_y, line.slope_z], 1)
        shift = jnp.stack([line.w[A1], jnp.zeros_like(q[0]) if grid.midline else line.w[B1]])
        if grid.midline:
            slopes = jnp.stack([slopes, slopes * mirror[None]])
            return line.w, slopes, shift.at[0].add(mean @ line.slope_y)
        return line.w, slopes.reshape(2, -1, 2), shift + mean @ slopes

    return _Sections(*jax.vmap(one)(modes))


def running_integrals(count: int, x: Float[Array, " m"]) -> Float[Array, "m count"]:
    """Integrals on (0, x) of the polynomials that are 1 at one Gauss point of (0, 1), else 0.

    Args:
        count: of Gauss points, at least 2.
        x: upper limits, in [0, 1].
    """
    points, weights = np.polynomial.legendre.leggauss(count)
    n = np.arange(count)
    fit = (2 * n + 1)[:, None] / 2 * np.polynomial.legendre.legvander(points, count - 1).T * weights
    at = 2 * x - 1

    def step(carry, k):
        below, here = carry
        above = ((2 * k + 1) * at * here - k * below) / (k + 1)
        return (here, above), (above - below) / (2 * k + 1)

    orders = jnp.arange(1, count).astype(x.dtype)
    up = jax.lax.scan(step, (jnp.ones_like(at), at), orders)[1]
    up = jnp.concatenate([(at + 1)[None], up])
    return jnp.matmul(up.T, jnp.asarray(fit / 2, x.dtype), precision="highest")


class Around(NamedTuple):
    """What of its section moves each point; depends on the section at rest alone.

    Attributes:
        place: of each point, as in `Points`.
        phi: rad.
        side: 0 for phi >= 0, else 1.
        shares: of the slopes at the quadrature's points on that side.
        offset: from the mid-line outwards, mm.
    """

    place: Int[Array, "*n points"]
    phi: Float[Array, "*n points"]
    side: Int[Array, "*n points"]
    shares: Float[Array, "*n points half"]
    offset: Float[Array, "*n points"]


def around(points: Points, radius: Float[Array, ""], half_angle: Float[Array, ""]) -> Around:
    """Points on sections of this radius of the mid-line, mm, and half-angle, rad."""
    phi, rest = points.phi, jnp.pi - half_angle
    way, left = jnp.abs(phi), phi < 0
    front = half_angle * running_integrals(FRONT, jnp.clip(way / half_angle, 0, 1))
    back = rest * running_integrals(BACK, jnp.clip((way - half_angle) / rest, 0, 1))
    shares = jnp.concatenate([front, back], 1) * jnp.where(left, -1, 1)[:, None]
    offset = points.distance - radius
    return Around(points.place, phi, left.astype(jnp.int32), shares, offset)


def wall_motion(
    modes: WallModes,
    points: Around,
    phi_c: Float[Array, ""],
    radius: Float[Array, ""],
    half_angle: Float[Array, ""],
) -> Float[Array, "points 3"]:
    """Displacement of points of the wall, mm, along (x, y, z) of the tube; none along x.

    As accurate as the quadrature of the rings. NaN where a section cannot be closed.

    Args:
        modes: of the section at each of the places.
        points: of which section, and where on it; from `around` with the same radius and angle.
        phi_c: angle of the contact, rad.
        radius: of the wall's mid-line, mm.
        half_angle: of the cartilage, rad.
    """
    shape = Shape(radius, jnp.zeros_like(radius), half_angle)
    grid = make_grid(shape, midline=modes.own.shape[1] == 4)
    phi, at = points.phi, points.place
    shapes = turn_shapes(phi, radius, grid.midline)[0].T
    normal = jnp.stack(cos_sin(phi), 1)

    def moved(q):
        found = _sections(q, grid, shape)
        line = jnp.sum(points.shares[:, :, None] * found.slopes[at, points.side], 1)
        turned = jnp.stack(cos_sin(phi + jnp.sum(found.w[at] * shapes, 1)), 1)
        return found.shift[at] + line + points.offset[:, None] * (turned - normal)

    carried, pressed = jax.vmap(moved)(jnp.stack([modes.carried, modes.carried + modes.own]))
    u = carried + side_of_contact(phi - phi_c)[:, None] * (pressed - carried)
    return jnp.concatenate([0 * u[:, :1], u], 1)


def side_of_contact(angle: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """cos^2(3 x / 2) within 60 degrees of the contact, else 0, at any number of turns."""
    c = jnp.maximum(jnp.cos(angle), 0.5)
    return (c + 1) * (2 * c - 1) ** 2 / 2
