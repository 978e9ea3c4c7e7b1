r"""Global shape: the motion of the skeleton's key points carried to every vertex (paper 2.4).

The key points lie on three lines along the tube: J at phi_c, and the ring ends U at -alpha and V at
+alpha; on each, at the clamp A, the rings and the clamp B (the nodes). The contact C splits the J
line. Along the tube a vertex lies in a patch between two nodes, round the tube in one of three
regions, U-J, J-V and the back V-U. The three lines are interpolated along s, then linearly in phi.

- `linear`: displacement vectors, linear between the key points.
- `hermite` (default): the same, but the transverse displacement of the J line is the beam's cubic,
  exact for a beam without shear flexibility.
- `phong`: as printed, magnitude and the angle to the outward normal are interpolated, linear
  between the key points. One angle does not fix a direction, so the azimuth is carried with it.

Vectors are along (tangent, anterior, lateral) of the centreline, in mm. `bind` is done once for a
mesh, `weigh` once for an angle of contact.
"""

import functools
import math
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float, Int

from jaxtrachea._numerics import epsilon
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.mesh import Mesh

Method = Literal["linear", "hermite", "phong"]

#: Least angle between the J line and the lines U and V, rad; see `weigh`.
NARROWEST = 0.05

#: Displacement below which `phong` fades to the normal direction, mm.
FADE = 1e-3


class Binding(eqx.Module):
    """Where every vertex stands among the nodes; depends on the rest state alone.

    Attributes:
        s: position along the centreline, mm; shape (vertices,).
        phi: angle round it, rad.
        patch: index of the node below each vertex.
        fraction: way to the node above, in [0, 1].
        nodes: A, rings, B, mm; shape (nodes,).
        half_angle: of the rings, rad.
    """

    s: Float[Array, " vertices"]
    phi: Float[Array, " vertices"]
    patch: Int[Array, " vertices"]
    fraction: Float[Array, " vertices"]
    nodes: Float[Array, " nodes"]
    half_angle: Float[Array, ""]


class Weights(eqx.Module):
    """Share of the lines U, J and V in the motion of every vertex; they add up to 1."""

    U: Float[Array, " vertices"]
    J: Float[Array, " vertices"]
    V: Float[Array, " vertices"]
    phi_c: Float[Array, ""]


class Keys(eqx.Module):
    """Motion of the key points; rows are A, the rings, B (see `clamped`).

    Attributes:
        s_c: contact position, mm.
        contact: displacement of C with the skeleton, mm; shape (3,).
        joints: displacement of the J line at the nodes, mm; shape (nodes, 3).
        U: displacement of the ring ends at -alpha, mm; shape (nodes, 3).
        V: displacement of the ring ends at +alpha, mm; shape (nodes, 3).
        slopes: d/ds of the (y, z) displacement of the J line at the nodes; shape (nodes, 2). Only
            `hermite` needs it.
        contact_slope: the same at C; shape (2,).
    """

    s_c: Float[Array, ""]
    contact: Float[Array, "3"]
    joints: Float[Array, "nodes 3"]
    U: Float[Array, "nodes 3"]
    V: Float[Array, "nodes 3"]
    slopes: Float[Array, "nodes 2"] | None = None
    contact_slope: Float[Array, "2"] | None = None


def clamped(
    s_c: Float[Array, ""],
    contact: Float[Array, "3"],
    joints: Float[Array, "rings 3"],
    U: Float[Array, "rings 3"],
    V: Float[Array, "rings 3"],
    slopes: Float[Array, "rings 2"] | None = None,
    contact_slope: Float[Array, "2"] | None = None,
    *,
    end_A: Float[Array, "3"] | None = None,
    end_B: Float[Array, "3"] | None = None,
) -> Keys:
    """Keys of a tube whose ends do not turn.

    Args:
        s_c: contact position, mm.
        contact: displacement of C, mm.
        joints: displacement of the joints J_i, mm; so for `U` and `V`.
        U: of the ring ends at -alpha.
        V: of the ring ends at +alpha.
        slopes: d/ds of (y, z) at the joints.
        contact_slope: the same at C.
        end_A: displacement of the end A as a whole, mm; None: held.
        end_B: the same of B.
    """
    held = jnp.zeros_like(contact)
    first, last = (held if end is None else end for end in (end_A, end_B))
    ends = lambda rows, a, b: jnp.concatenate([a[None], rows, b[None]])  # noqa: E731
    joints, U, V = (ends(rows, first, last) for rows in (joints, U, V))
    if slopes is not None:
        slopes = ends(slopes, held[:2], held[:2])
    return Keys(s_c, contact, joints, U, V, slopes, contact_slope)


def bind(mesh: Mesh, geometry: Geometry) -> Binding:
    """Find the patch of every vertex and the fraction of the way through it."""
    inner = geometry.ring_positions
    nodes = jnp.concatenate([jnp.zeros_like(inner[:1]), inner, geometry.length[None]])
    patch = jnp.searchsorted(inner, mesh.s, side="right").astype(jnp.int32)
    span = (nodes[1:] - nodes[:-1])[patch]
    fraction = jnp.clip((mesh.s - nodes[patch]) / span, 0, 1)
    s = jnp.clip(mesh.s, nodes[0], nodes[-1])
    return Binding(s, mesh.phi, patch, fraction, nodes, geometry.half_angle)


def weigh(binding: Binding, phi_c: Float[Array, ""]) -> Weights:
    """Angular shares of the lines U, J and V, linear in phi within each region.

    As phi_c comes closer than `NARROWEST` to an end of the rings, the line of that end steps back
    into the membrane to keep this distance: the motion stays continuous, its derivatives bounded
    and C itself exact, while the key at the ring end is met up to 0.05 rad off its place.

    Args:
        binding: from `bind`.
        phi_c: angle of contact, rad, in [-alpha, alpha].

    Returns:
        The weights; NaN if C lies behind the ends of the rings.
    """
    alpha, phi = binding.half_angle, binding.phi
    on = jnp.abs(phi_c) <= alpha * (1 + 8 * epsilon(phi.dtype))
    to_U = jnp.maximum(alpha, NARROWEST - phi_c)
    to_V = jnp.maximum(alpha, NARROWEST + phi_c)
    from_U = jnp.clip((phi + to_U) / (phi_c + to_U), 0, 1)
    from_V = jnp.clip((to_V - phi) / (to_V - phi_c), 0, 1)
    behind = jnp.maximum(phi - to_V, -phi - to_U) / (2 * math.pi - to_U - to_V)
    behind = jnp.clip(behind, 0, 1)
    U = (1 - from_U) * (1 - behind) + (1 - from_V) * behind
    V = (1 - from_V) * (1 - behind) + (1 - from_U) * behind
    hide = lambda weight: jnp.where(on, weight, jnp.nan)  # noqa: E731
    return Weights(hide(U), hide(from_U * from_V), hide(V), phi_c)


def interpolate(
    binding: Binding, weights: Weights, keys: Keys, *, method: Method = "hermite"
) -> Float[Array, "vertices 3"]:
    """Displacement of every vertex along (tangent, anterior, lateral), mm.

    Args:
        binding: from `bind`.
        weights: from `weigh`.
        keys: motion of the key points.
        method: see module docstring.

    Raises:
        ValueError: `hermite` without slopes, or keys for another number of rings.
    """
    if keys.joints.shape[0] != binding.nodes.shape[0]:
        raise ValueError(
            f"keys have {keys.joints.shape[0]} rows; expected {binding.nodes.shape[0]}, "
            "one for A, each ring and B (see `clamped`)"
        )
    if method == "phong":
        return _phong(binding, weights, keys)
    slopes = None
    if method == "hermite":
        if keys.slopes is None or keys.contact_slope is None:
            raise ValueError("method='hermite' needs slopes and contact_slope; or use 'linear'")
        slopes = keys.slopes, keys.contact_slope
    joints = _joint_line(binding, keys.s_c, keys.joints, keys.contact, slopes)
    ends = _between(binding, jnp.concatenate([keys.U, keys.V], axis=1))
    return _mix(weights, ends[:3], joints, ends[3:]).T


def _mix(weights: Weights, U, J, V):
    """Across the regions; rows are components."""
    u, j, v = (_spread(w, 3) for w in (weights.U, weights.J, weights.V))
    return u * U + j * J + v * V


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def _spread(v, rows: int):
    """The same row `rows` times.

    Its transpose adds the rows one to another. That of broadcasting is a reduction over three rows,
    which the compiler hands to a library that takes longer for it than the whole surface does.
    """
    return jnp.broadcast_to(v[None], (rows, *v.shape))


@functools.partial(_spread.defjvp, symbolic_zeros=True)
def _spread_jvp(rows, primals, tangents):
    (v,), (dv,) = primals, tangents
    value = _spread(v, rows)
    if isinstance(dv, SymbolicZero):
        return value, SymbolicZero(jax.typeof(value).to_tangent_aval())
    return value, jnp.stack([dv] * rows)


def _pick(rows, patch, weights):
    """Combine `rows` (k, patches, c) by `weights` (m, k) and give (m, c, vertices)."""
    k, patches, c = rows.shape
    weights = jnp.asarray(np.array(weights, float), rows.dtype)
    # A matrix product, because the compiler keeps its result: an elementwise table would be merged
    # into the gather below and computed again for every vertex, several times slower.
    table = jnp.matmul(weights, rows.reshape(k, -1), precision="highest")
    table = table.reshape(-1, patches, c).swapaxes(0, 1).reshape(patches, -1)
    picked = table.at[patch].get(mode="promise_in_bounds")
    return picked.T.reshape(-1, c, patch.shape[0])


def _between(binding: Binding, values):
    """Linear between the nodes, one row for each component; shape (components, vertices)."""
    low, rise = _pick(jnp.stack([values[:-1], values[1:]]), binding.patch, [[1, 0], [-1, 1]])
    return low + _spread(binding.fraction, low.shape[0]) * rise


#: Hermite's cubic c_0 + t (c_1 + t (c_2 + t c_3)) from its values and slopes at both ends.
HERMITE = [[1, 0, 0, 0], [0, 0, 1, 0], [-3, 3, -2, -1], [2, -2, 1, 1]]


def _joint_line(binding: Binding, s_c, joints, contact, slopes: tuple[Array, Array] | None = None):
    """The J line, with C as one more node; shape (components, vertices).

    Linear between the nodes; where `slopes` are given (nodes, C), the last components are cubic.
    """
    below = jnp.sum(binding.nodes[1:-1] <= s_c)
    nodes, values = _insert(binding.nodes, s_c, below), _insert(joints, contact, below)
    span, low, high = jnp.diff(nodes)[:, None], values[:-1], values[1:]
    leave = land = high - low
    if slopes is not None:
        turn = _insert(slopes[0], slopes[1], below)
        straight = leave[:, : leave.shape[1] - turn.shape[1]]
        leave, land = (jnp.concatenate([straight, span * v], 1) for v in (turn[:-1], turn[1:]))
    # Where a patch begins, and one over its length, travel with the values as two more columns.
    place = jnp.concatenate([nodes[:-1, None], 1 / jnp.where(span > 0, span, jnp.inf)], axis=1)
    more = jnp.zeros_like(place)
    low = jnp.concatenate([low, place], axis=1)
    high, leave, land = (jnp.concatenate([v, more], axis=1) for v in (high, leave, land))
    patch = binding.patch + (binding.s >= s_c).astype(binding.patch.dtype)
    c = _pick(jnp.stack([low, high, leave, land]), patch, HERMITE)
    c_0, c_1, c_2, c_3 = c[:, :-2]
    t = _spread((binding.s - c[0, -2]) * c[0, -1], c_0.shape[0])
    return c_0 + t * (c_1 + t * (c_2 + t * c_3))


def _insert(rows, row, below):
    """`rows` with `row` after the index `below`."""
    order = jnp.arange(rows.shape[0] + 1).reshape((-1,) + (1,) * (rows.ndim - 1))
    before, after = jnp.concatenate([rows, rows[-1:]]), jnp.concatenate([rows[:1], rows])
    return jnp.where(order <= below, before, jnp.where(order == below + 1, row[None], after))


def _phong(binding: Binding, weights: Weights, keys: Keys):
    """Interpolate (magnitude, angle and azimuth to the normal), linear between the key points."""
    # Angles are counted from the inward normal for a press, else from the outward one; the
    # azimuth is undefined at the opposite pole only, far from where the displacements are.
    alpha = binding.half_angle
    drawn = _radial(weights.phi_c, keys.contact) > 0
    pole = jnp.where(drawn, 1, -1).astype(alpha.dtype)
    encode = lambda v, phi: _encode(v, phi, pole)  # noqa: E731
    joints, contact = encode(keys.joints.T, weights.phi_c).T, encode(keys.contact, weights.phi_c)
    line = _joint_line(binding, keys.s_c, joints, contact)
    both = jnp.concatenate([encode(keys.U.T, -alpha).T, encode(keys.V.T, alpha).T], axis=1)
    ends = _between(binding, both)
    return _decode(_mix(weights, ends[:3], line, ends[3:]), binding.phi, pole).T


def _radial(phi, vector):
    return jnp.cos(phi) * vector[1] + jnp.sin(phi) * vector[2]


def _encode(vector, phi, pole):
    """Magnitude, and angle to the pole times (cos, sin) of the azimuth; rows, as is `vector`."""
    normal = pole * _radial(phi, vector)
    along, round_ = vector[0], jnp.cos(phi) * vector[2] - jnp.sin(phi) * vector[1]
    square = jnp.sum(vector**2, axis=0)
    size = jnp.sqrt(square + FADE**2)
    normal = normal + FADE**2 / size  # at rest the direction is the pole's
    side = along**2 + round_**2
    close = side <= (1e-4 * normal) ** 2
    sideways = jnp.sqrt(jnp.where(close, 1, side))
    per_length = jnp.where(
        close & (normal > 0),
        1 / jnp.where(normal > 0, normal, 1),
        jnp.arctan2(sideways, normal) / sideways,
    )
    return jnp.stack([square / size, per_length * along, per_length * round_])


def _decode(channels, phi, pole):
    magnitude, a, b = channels
    square = a * a + b * b
    small = square < 1e-8
    angle = jnp.sqrt(jnp.where(small, 1, square))
    sinc = jnp.where(small, 1 - square / 6, jnp.sin(angle) / angle)
    normal = pole * magnitude * jnp.where(small, 1 - square / 2, jnp.cos(angle))
    round_ = magnitude * sinc * b
    c, s = jnp.cos(phi), jnp.sin(phi)
    return jnp.stack([magnitude * sinc * a, c * normal - s * round_, s * normal + c * round_])
