"""Presses on the skeleton of deforming cross-sections, at finite strain and anywhere on the rings.

Vectors are in the frame of the tube: x along s towards the larynx, y anterior, z to the side of
positive phi.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxtrachea._arguments import ArrayLike, check_record, shaped
from jaxtrachea._numerics import epsilon, full_precision, largest
from jaxtrachea.mechanics.ring import on_ring
from jaxtrachea.mechanics.sections import section, span, system
from jaxtrachea.mechanics.sections.contact import place_on
from jaxtrachea.mechanics.sections.material import (
    EACH_RING,
    EACH_SPAN,
    LEAST,
    POSITIVE,
    SectionMaterial,
    check_sections,
    ends_and_rings,
    ring_pitches,
)
from jaxtrachea.mechanics.sections.solve import Solved, solve_path
from jaxtrachea.mechanics.sections.system import State, System
from jaxtrachea.mechanics.sections.wall import Contact, WallModes, modes_along
from jaxtrachea.mechanics.skeleton import local_frame
from jaxtrachea.mechanics.validation import mask
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.geometry import Geometry

#: Presses were compared with finite elements within SIDE of the midline and END off the ends, rad.
SIDE, END = np.pi / 2, np.pi / 6


def validated_angle(half_angle: Float[Array, ""] | float) -> Float[Array, ""]:
    """Angle from the midline, rad, to which presses are right; NEAR_RING_END beyond.

    Nearer to its end a ring that is pressed bends its muscle over a length of (4 EI / k)^(1/4),
    some 3 mm, and its end turns under the tool. The modes carry muscle and end along in harmonics
    of order 3 at most: too stiff (docs/evidence/off_midline.md, by how much).

    Args:
        half_angle: of the rings, rad.
    """
    return jnp.minimum(SIDE, half_angle - END)


@dataclasses.dataclass(frozen=True)
class SectionOptions:
    """What a press on deforming cross-sections includes; static, it selects the program.

    Attributes:
        midline: phi_c = 0 and a normal direction only, a quarter of the work; other presses are
            OFF_PLAN in it.
        half_width: of a flat punch along the tube, mm: two forces, that far before and behind s_c,
            hold the wall level, as in `Options`. All of it has to lie on the tube, else OFF_TUBE.
            `SectionPress.skeleton` and `depth` are means of both edges. 0: the tool is a point.
    """

    midline: bool = False
    half_width: float = 0.0

    def __post_init__(self):
        """Refuse a width that none is (`ValueError`)."""
        check_record(self, half_width=0.0)


class SectionPress(NamedTuple):
    """A press on deforming cross-sections along a path of displacements; mm, N and N mm.

    Attributes:
        force: of the tool on the wall; no component along x. Shape (n, 3), like the next two.
        depth: local indentation: way of the tool less `skeleton`, in the plane of the section.
        skeleton: displacement of the outer surface at the contact.
        modes: q of each ring: a1, a2, a3, e, b0, b1, b2, b3; shape (n, rings, 8).
        joints: displacement of the outer surface of each ring at phi_c; x is 0, since the warping
            of the model is not what a finite element specimen shows. Shape (n, rings, 3).
        end_U: that at phi = -alpha.
        end_V: that at phi = +alpha.
        energy: stored, which is the work of the tool.
        imbalance: of the forces on the nodes over the contact's force.
        steps: Newton steps made.
        status: a `PressStatus` each.
        along: modes of the sections at `places`, as `wall.wall_motion` takes them; None: no places
            were given.
    """

    force: Float[Array, "n 3"]
    depth: Float[Array, "n 3"]
    skeleton: Float[Array, "n 3"]
    modes: Float[Array, "n rings 8"]
    joints: Float[Array, "n rings 3"]
    end_U: Float[Array, "n rings 3"]
    end_V: Float[Array, "n rings 3"]
    energy: Float[Array, " n"]
    imbalance: Float[Array, " n"]
    steps: Float[Array, " n"]
    status: Int[Array, " n"]
    along: WallModes | None = None


def press_sections(
    geometry: Geometry,
    material: SectionMaterial,
    s_c: ArrayLike,
    phi_c: ArrayLike,
    displacement: ArrayLike,
    direction: ArrayLike = (1.0, 0.0),
    *,
    options: SectionOptions = SectionOptions(),
    places: ArrayLike | None = None,
) -> SectionPress:
    """Press or draw the tool, stuck to the surface at (s_c, phi_c), along a path from rest.

    Equations: `section`, `span`, `contact`, `system`. Inextensible wall in seven modes a ring;
    tested against a three-dimensional finite element specimen up to D = 6 mm, half the radius, and
    numerically to 10 mm (tests/sections). No axial force: C does not move along x. The tool turns
    nothing: no moment. The first substep is taken from rest whatever the first displacement.

    Args:
        geometry: the tube at rest; `radius` is that of the wall's mid-line.
        material: stiffnesses, see `material.from_wall`.
        s_c: contact position, mm, in [0, length]; a scalar.
        phi_c: contact angle from the anterior midline, rad, in [-alpha, alpha].
        displacement: of the tool after first touch, mm, in the order in which it moves; shape (n,).
        direction: displacement per unit of that, along the inward normal and the circumference.
        options: a program for the midline alone, and the width of the tool.
        places: positions along the tube, mm, where the sections' modes are wanted; None: nowhere.

    Returns:
        The `SectionPress`. Rows that Newton's method does not solve or that are no minimum of the
        energy (and those after the latter) are NaN, PAST_FOLD; others are untouched. Rows whose
        wall moves further than the radius are TOO_DEEP, and those beyond `validated_angle`
        NEAR_RING_END, with their values; those of a material that is `extrapolated` are
        EXTRAPOLATED. Derivatives are those of the equilibrium, in either mode.

    Raises:
        ValueError: an argument that is no number, or an array of a length that does not fit.
    """
    dtype = geometry.length.dtype
    check_sections(geometry, material)
    displacement = shaped("displacement", displacement, ("any number of",), dtype=dtype)
    direction = shaped("direction", direction, (2,), dtype=dtype)
    phi_c = shaped("phi_c", phi_c, (), dtype=dtype)
    s_c = shaped("s_c", s_c, (), dtype=dtype, why="; use jax.vmap for many positions")
    if places is not None:
        places = shaped("places", places, ("any number of",), dtype=dtype)
    arrays = s_c, phi_c, displacement, direction, places
    return _press(geometry, material, *arrays, options)


# Inlined: the program is as without. But what calls it is traced through derivatives and maps from
# equations that are known, in all programs for the same shapes, and not through its Python again.
@functools.partial(jax.jit, static_argnames="options", inline=True)
@full_precision
def _press(
    geometry: Geometry,
    material: SectionMaterial,
    s_c: Float[Array, ""],
    phi_c: Float[Array, ""],
    displacement: Float[Array, " n"],
    direction: Float[Array, "2"],
    places: Float[Array, " k"] | None,
    options: SectionOptions,
) -> SectionPress:
    """`press_sections` of arrays."""
    midline, half_width = options.midline, options.half_width
    asked = _admit(geometry, material, s_c, phi_c, direction, midline, half_width)
    parts = build(geometry, *asked[:4], midline=midline, half_width=half_width)
    known = jnp.isfinite(displacement)
    path = jnp.where(known, displacement, 0)
    solved = solve_path(parts, path)
    status = jnp.where(known, _status(solved, path), PressStatus.NON_FINITE)
    status = jnp.where(asked.refused != PressStatus.OK, asked.refused, status).astype(jnp.int8)
    observe = jax.vmap(_observe, (0, 0, None))
    found = observe(solved.state, path, parts)
    if places is not None:
        nodes = ends_and_rings(geometry)
        footprint = asked.material.footprint.astype(displacement.dtype)
        along = jax.vmap(_along, (0, None, None, None, None))
        contact = _edges(asked.s_c, half_width), footprint
        found = found._replace(along=along(solved.state, places, nodes, contact, parts))
    found = found._replace(steps=solved.steps, status=status)
    valid = (status == PressStatus.OK) | (status == PressStatus.NO_CONTACT)
    hidden = jax.vmap(mask)(jnp.where(valid, PressStatus.OK, status), found)
    moved = jnp.sum(found.skeleton**2, axis=1)
    deep = (status == PressStatus.OK) & (moved > geometry.radius**2)
    status = jnp.where(deep, PressStatus.TOO_DEEP, status)
    # To rounding, as in `on_ring`.
    most = validated_angle(geometry.half_angle) * (1 + 8 * epsilon(phi_c.dtype))
    near = (status == PressStatus.OK) & (jnp.abs(phi_c) > most)
    status = jnp.where(near, PressStatus.NEAR_RING_END, status)
    unlike = (status == PressStatus.OK) & (material.extrapolated > 0)
    status = jnp.where(unlike, PressStatus.EXTRAPOLATED, status).astype(jnp.int8)
    return hidden._replace(steps=solved.steps, status=status)


class _Asked(NamedTuple):
    """What is computed, in place of what must be refused, and why it is."""

    material: SectionMaterial
    s_c: Float[Array, ""]
    phi_c: Float[Array, ""]
    direction: Float[Array, "2"]
    refused: Int[Array, ""]


def _admit(geometry, material, s_c, phi_c, direction, midline, half_width) -> _Asked:
    edges = s_c - half_width, s_c + half_width
    off_tube = ~((edges[0] >= 0) & (edges[1] <= geometry.length))
    on, phi = on_ring(geometry.half_angle, phi_c)
    material, bad, unknown = safe_values(material)
    place = jnp.isfinite(s_c) & jnp.isfinite(phi_c) & jnp.all(jnp.isfinite(direction))
    refused = jnp.where(bad, PressStatus.BAD_MATERIAL, PressStatus.OK)
    refused = jnp.where(on, refused, PressStatus.BEHIND_GAP)
    if midline:
        plain = (phi_c == 0) & (direction[1] == 0)
        refused = jnp.where(plain, refused, PressStatus.OFF_PLAN)
        phi = jnp.zeros_like(phi)
    refused = jnp.where(off_tube, PressStatus.OFF_TUBE, refused)
    refused = jnp.where(place & ~unknown, refused, PressStatus.NON_FINITE).astype(jnp.int8)
    direction = jnp.where(jnp.isfinite(direction), direction, 0)
    s_c = jnp.where(off_tube, geometry.length / 2, s_c)
    return _Asked(SectionMaterial(**material), s_c, phi, direction, refused)


def safe_values(material: SectionMaterial) -> tuple[dict[str, Any], Array, Array]:
    """Values with 1 for those that no press can have; whether any is too low, or not finite."""
    safe, bad, unknown = {}, jnp.zeros((), bool), jnp.zeros((), bool)
    for field in dataclasses.fields(material):
        value, name = getattr(material, field.name), field.name
        low = value <= 0 if name in POSITIVE else value < 0
        low = value < LEAST[name] if name in LEAST else low
        odd = jnp.isnan(value) | (jnp.isinf(value) & (name != "k_end") & ~low)
        safe[name] = jnp.where(low | odd, 1, value)
        bad, unknown = bad | jnp.any(low), unknown | jnp.any(odd)
    return safe, bad, unknown


def _edges(s_c: Float[Array, ""], half_width: float) -> Float[Array, " contacts"]:
    """Where the tool touches, mm: at one point, or with both edges of a punch."""
    if half_width == 0:
        return s_c[None]
    return s_c + half_width * jnp.asarray([-1.0, 1.0], s_c.dtype)


#: Names of the bed in the equations of a ring.
_OF_RING = {"bed_n": "k_n", "bed_t": "k_t"}


def build(
    geometry: Geometry,
    material: SectionMaterial,
    s_c: Float[Array, ""],
    phi_c: Float[Array, ""],
    direction: Float[Array, "2"],
    *,
    midline: bool,
    half_width: float = 0.0,
) -> System:
    """The system of a press, of arguments that are checked."""
    n, dtype = geometry.rings, geometry.length.dtype
    values = {f.name: getattr(material, f.name).astype(dtype) for f in dataclasses.fields(material)}
    shape = section.Shape(geometry.radius, values["offset"], geometry.half_angle)
    grid = section.make_grid(shape, midline=midline)
    per_ring = {_OF_RING.get(k, k): jnp.broadcast_to(values[k], (n,)) for k in EACH_RING}
    per_span = {k: jnp.broadcast_to(values[k], (n + 1,)) for k in EACH_SPAN}
    share = jnp.ones(n + 1, dtype).at[jnp.array([0, -1])].set(values["c_end"])
    per_span["c_W"] = per_span["c_W"] * share
    rings = section.Ring(pitch=ring_pitches(geometry), **per_ring)
    nodes = ends_and_rings(geometry)
    forms = span.make_forms(grid, shape)
    make = jax.vmap(span.make_span, (0, 0, None, None))
    spans = make(span.Wall(**per_span), jnp.diff(nodes), forms, shape)
    scale, ends = _hold_ends(spans, values["k_end"])
    place = place_on(nodes, _edges(s_c, half_width), spans, values["footprint"])
    mixed = values["c_t_ring"] + jnp.mean(place.weight) * (values["c_t"] - values["c_t_ring"])
    count = 1 if midline else 2
    give = jnp.stack([values["c_n"], mixed])[:count]
    return System(
        shape=shape,
        grid=grid,
        rings=rings,
        spans=spans,
        scale=scale,
        ends=ends,
        place=place,
        phi_c=phi_c,
        give=give,
        direction=direction[:count],
    )


def _hold_ends(spans: span.Span, k_end):
    """Scale of the unknowns, and the scaled stiffness k_end C of both ends."""
    count, parities = spans.shear.shape[:2]
    h = spans.h[jnp.array([0, -1])]
    clamped = jnp.isinf(k_end)
    k = jnp.where(clamped, 1, k_end)
    share = jnp.where(clamped, 0, 1 / jnp.sqrt(1 + k * h))
    stiff = jnp.where(clamped, 1 / h, k / (1 + k * h))
    row = jnp.asarray(np.repeat([0.0, 1.0], [4, 3]), h.dtype)
    ends = jnp.broadcast_to((share[:, None] * row[None])[:, None], (2, parities, 7))
    inner = jnp.ones((count - 1, parities, 7), h.dtype)
    scale = jnp.concatenate([ends[:1], inner, ends[1:]])
    return scale, stiff[:, None, None, None] * spans.axial[jnp.array([0, -1])]


def _status(solved: Solved, path):
    """Of each row."""
    status = jnp.where(path == 0, PressStatus.NO_CONTACT, PressStatus.OK)
    good = (solved.solved > 0) & (solved.stable > 0)
    return jnp.where(good, status, PressStatus.PAST_FOLD)


def _imbalance(line: section.Line, state: State, displacement, parts: System):
    """Largest residual of the nodes over the force."""
    line, state, displacement, parts = jax.lax.stop_gradient((line, state, displacement, parts))
    r = system.residual_of(line, state, displacement, parts)
    pushed = largest(jnp.abs(state.force).ravel())
    return largest(jnp.abs(r.y).ravel()) / jnp.where(pushed > 0, pushed, 1)


def _observe(state: State, displacement, parts: System) -> SectionPress:
    """What is read off a state."""
    frame = local_frame(parts.phi_c)[::2]  # inward normal and circumference

    def vector(v):
        return v @ frame[: v.shape[0]]

    line = system.lines(state, parts)
    v = jnp.mean(system.contact_surface(state, line, parts).motion, 0)
    modes = system.ring_modes(state, parts)
    alpha = parts.shape.half_angle
    angles = jnp.stack([parts.phi_c, -alpha, alpha])
    joints, end_U, end_V = _ring_motion(system.of_rings(line, parts), angles, parts)
    return SectionPress(
        force=vector(jnp.sum(state.force, 0)),
        depth=vector(displacement * parts.direction - v),
        skeleton=vector(v),
        modes=jnp.pad(modes, ((0, 0), (0, 8 - modes.shape[1]))),
        joints=joints,
        end_U=end_U,
        end_V=end_V,
        energy=system.stored_energy_of(line, state, parts),
        imbalance=_imbalance(line, state, displacement, parts),
        steps=jnp.zeros_like(displacement),
        status=jnp.zeros((), jnp.int8),
    )


def _along(state: State, places, nodes, contact, parts: System):
    """Modes of the sections at each place, for contacts (their positions, footprint)."""
    surface = system.contact_surface(state, system.lines(state, parts), parts)
    pushed = system.pushed_modes(surface, state).reshape(state.q_C.shape)
    unknowns = system.physical(state, parts)

    def moved(s, pushed):
        return modes_along(places, nodes, unknowns, parts.spans, Contact(s, contact[1], pushed))

    each = jax.vmap(moved)(contact[0], pushed)
    return WallModes(each.carried[0], jnp.sum(each.own, 0))


def _ring_motion(line: section.Line, angles, parts: System):
    """Displacement of the outer surface of every ring at each angle; (angles, rings, 3)."""

    def at(line, phi):
        moved = section.line_motion(line, phi, parts.grid, parts.shape)
        return moved @ local_frame(phi)[::2]

    return jax.vmap(lambda phi: jax.vmap(at, (0, None))(line, phi))(angles)
