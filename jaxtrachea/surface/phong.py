"""A displacement as magnitude and two angles (for `regions`, method `phong`).

The pole is the normal at the contact C, inward for a press. The turn is the angle in the
cross-section from the pole, the rise the angle out of the cross-section. Seen from the normal at
phi, the turn is larger by phi - phi_C, which is linear in phi: so both are the printed angles to
the normal, linear between the key points, but none of them passes over its own half-turn on the
way round the tube, as angles counted from the normal of each key do on the back.
"""

import jax.numpy as jnp

#: Displacement below which `phong` fades to the direction of the pole, over the length of the tube:
#: 1e-3 mm on Table 1's.
FADE = 1e-3 / 160


def radial(phi, vector):
    """Outward part of a vector along (tangent, anterior, lateral), at the angle phi."""
    return jnp.cos(phi) * vector[1] + jnp.sin(phi) * vector[2]


def encode(vector, phi, pole, fade):
    """Magnitude, rise and turn; rows, as is `vector`.

    Args:
        vector: along (tangent, anterior, lateral), mm; shape (3, ...).
        phi: of the pole, rad: the angle of contact, for all key points.
        pole: -1: the pole is the inward normal there, 1: the outward one.
        fade: displacement below which the direction is that of the pole, mm.
    """
    normal = pole * radial(phi, vector)
    along, round_ = vector[0], jnp.cos(phi) * vector[2] - jnp.sin(phi) * vector[1]
    square = jnp.sum(vector**2, axis=0)
    size = jnp.sqrt(square + fade**2)
    normal = normal + fade**2 / size  # at rest the direction is the pole's
    across = normal**2 + round_**2
    none = across < fade**2 * 1e-12  # along the tube, or at rest against the fade: no turn
    rise = jnp.arctan2(along, jnp.sqrt(jnp.where(none, fade**2 * 1e-12, across)))
    turn = jnp.arctan2(jnp.where(none, 0, round_), jnp.where(none, 1, normal))
    return jnp.stack([square / size, rise, turn])


def decode(channels, phi, pole):
    """The vector again; rows. Arguments as for `encode`."""
    magnitude, rise, turn = channels
    across = magnitude * jnp.cos(rise)
    normal, round_ = pole * across * jnp.cos(turn), across * jnp.sin(turn)
    c, s = jnp.cos(phi), jnp.sin(phi)
    return jnp.stack([magnitude * jnp.sin(rise), c * normal - s * round_, s * normal + c * round_])
