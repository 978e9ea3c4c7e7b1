"""A displacement as magnitude, and angle and azimuth to the normal (for `regions`, `phong`)."""

import jax.numpy as jnp

#: Displacement below which `phong` fades to the normal direction, mm.
FADE = 1e-3


def radial(phi, vector):
    """Outward part of a vector along (tangent, anterior, lateral), at the angle phi."""
    return jnp.cos(phi) * vector[1] + jnp.sin(phi) * vector[2]


def encode(vector, phi, pole):
    """Magnitude, and angle to the pole times (cos, sin) of the azimuth; rows, as is `vector`."""
    normal = pole * radial(phi, vector)
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


def decode(channels, phi, pole):
    """The vector again; rows."""
    magnitude, a, b = channels
    square = a * a + b * b
    small = square < 1e-8
    angle = jnp.sqrt(jnp.where(small, 1, square))
    sinc = jnp.where(small, 1 - square / 6, jnp.sin(angle) / angle)
    normal = pole * magnitude * jnp.where(small, 1 - square / 2, jnp.cos(angle))
    round_ = magnitude * sinc * b
    c, s = jnp.cos(phi), jnp.sin(phi)
    return jnp.stack([magnitude * sinc * a, c * normal - s * round_, s * normal + c * round_])
