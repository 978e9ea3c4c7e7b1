"""Derivatives of a flat punch on deforming cross-sections: forward = reverse = differences."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrachea.mechanics.sections.material import SectionMaterial
from jaxtrachea.mechanics.sections.press import SectionOptions, press_sections
from jaxtrachea.trachea.geometry import Geometry

from .test_press import VALUES

pytestmark = [pytest.mark.compiling, pytest.mark.slow]
TUBE = Geometry.create(30.0, [10.0, 20.0], radius=11.7)
#: One edge beside a ring, the other between two.
PUNCH = SectionOptions(half_width=2.4)
#: Displacement, mm, position, mm, angle; then material values.
NAMES = ("displacement", "s_c", "phi_c", "EI_C", "D_L", "bed_n", "c_W")
AT = np.array([3.0, 13.0, 0.6, *(VALUES[name] for name in NAMES[3:])])
#: Half of a central difference, as a share of each value.
STEP = 1e-4


def answer(x):
    """Force along y and z, N, and what is stored, N mm."""
    D, s_c, phi_c, *values = x
    material = SectionMaterial(**(VALUES | dict(zip(NAMES[3:], values, strict=True))))
    tube, material = jax.tree.map(lambda v: jnp.asarray(v, x.dtype), (TUBE, material))
    got = press_sections(tube, material, s_c, phi_c, D[None], options=PUNCH)
    return jnp.append(got.force[-1, 1:], got.energy[-1])


#: Value and slope along a direction: one program of each dtype.
ahead = jax.jit(lambda x, v: jax.jvp(answer, (x,), (v,)))


@functools.cache
def forward(dtype="float64"):
    """The value, and slopes by the logarithm of each number; (3,), (3, numbers)."""
    x = jnp.asarray(AT, dtype)
    rows = [ahead(x, v) for v in jnp.asarray(np.diag(AT), dtype)]
    return np.asarray(rows[0][0]), np.stack([slope for _, slope in rows], 1)


def test_forward_is_central_differences():
    """The third derivative leaves some 1e-8 of a value."""
    value, slopes = forward()
    up, down = (
        np.stack([ahead(jnp.asarray(AT + sign * STEP * v), jnp.asarray(v))[0] for v in np.diag(AT)])
        for sign in (1, -1)
    )
    size = np.abs(value)[:, None]
    assert np.all(np.abs(slopes / size).max(0) > 1e-3)
    np.testing.assert_allclose(slopes / size, ((up - down) / (2 * STEP)).T / size, atol=1e-6)


def test_reverse_is_forward():
    back = jax.jit(lambda x, w: jax.vjp(answer, x)[1](w)[0])  # of one result
    reverse = np.stack([back(jnp.asarray(AT), w) * AT for w in jnp.eye(3)])
    np.testing.assert_allclose(reverse, forward()[1], atol=1e-9 * np.abs(forward()[1]).max())
