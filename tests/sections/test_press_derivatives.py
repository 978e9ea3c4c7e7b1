"""Derivatives of presses: forward = reverse = central differences, for every parameter."""

import functools

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrachea.mechanics.sections.material import SectionMaterial
from jaxtrachea.mechanics.sections.press import SectionOptions, press_sections
from jaxtrachea.trachea.geometry import Geometry

from .test_press import VALUES

pytestmark = pytest.mark.compiling

GEOMETRY = Geometry.create(41.0, [9.0, 19.0, 30.0], radius=11.7)
EACH = {"EI_C": np.array([24.0, 22.0, 25.0]), "Gt_L": np.array([20.0, 21.0, 22.0, 20.5])}
MATERIAL = SectionMaterial(**(VALUES | EACH))
#: s_c, phi_c, direction, and a path to 5 mm.
GIVEN = tuple(jnp.asarray(v) for v in (17.0, np.pi / 2, [1.0, 0.1], [2.0, 5.0]))
FLAT, UNRAVEL = jax.flatten_util.ravel_pytree((GEOMETRY, MATERIAL, GIVEN))


def force(flat):
    """Force at 5 mm, and what it stores."""
    geometry, material, (s_c, phi_c, direction, path) = UNRAVEL(flat)
    got = press_sections(geometry, material, s_c, phi_c, path, direction)
    return jnp.append(got.force[-1, 1:], got.energy[-1])


#: Value and slope along a direction: one program for the tests below.
ahead = jax.jit(lambda x, v: jax.jvp(force, (x,), (v,)))
#: All but `extrapolated`, a flag.
USED = np.flatnonzero(np.asarray(FLAT))
UNIT = jnp.eye(FLAT.size)[USED]


def central_differences():
    """The value, and steps of 1e-4 of each input: an error of 1e-8 from the third derivative."""
    h = 1e-4 * jnp.abs(FLAT[USED])
    up, down = (
        np.array([ahead(FLAT + step * v, v)[0] for step, v in zip(steps, UNIT, strict=True)])
        for steps in (h, -h)
    )
    return np.asarray(ahead(FLAT, UNIT[0])[0]), ((up - down) / (2 * np.asarray(h)[:, None])).T


@functools.cache
def forward():
    return np.stack([ahead(FLAT, v)[1] for v in UNIT], 1)


@pytest.mark.slow
def test_forward_is_central_differences():
    """Each parameter by itself."""
    value, differences = central_differences()
    size = np.abs(value)[:, None] / np.abs(FLAT[USED])[None]
    np.testing.assert_allclose(forward() / size, differences / size, rtol=1e-6, atol=1e-6)


@pytest.mark.slow
def test_reverse_is_forward():
    back = jax.jit(lambda x, w: jax.vjp(force, x)[1](w)[0])  # of one result
    reverse = np.stack([back(FLAT, w)[USED] for w in jnp.eye(3)])
    np.testing.assert_allclose(reverse, forward(), atol=1e-9 * np.abs(forward()).max())


def of_two(x):
    """Of bending and of the contact's cubic stiffness, on the midline of two rings."""
    material = SectionMaterial(**VALUES | {"EI_C": x[0], "c_n": x[1]})
    tube, path = Geometry.create(25.0, [8.0, 17.0], radius=11.7), jnp.asarray([1.0, 3.0])
    got = press_sections(tube, material, 12.0, 0.0, path, options=SectionOptions(midline=True))
    return jnp.sum(jnp.sin(got.force[:, 1]))


@pytest.mark.long
def test_second_derivatives_in_any_order_of_modes_are_traced():
    at = jnp.asarray([VALUES["EI_C"], VALUES["c_n"]])
    for twice in (jax.hessian, lambda f: jax.jacrev(jax.jacrev(f))):
        assert jax.eval_shape(twice(of_two), at).shape == (2, 2)


@pytest.mark.slow
def test_second_derivatives_are_differences_of_the_first():
    at = jnp.asarray([VALUES["EI_C"], VALUES["c_n"]])
    slope, h = jax.jit(jax.grad(of_two)), 1e-4 * at
    steps = [(slope(at + v) - slope(at - v)) / (2 * jnp.sum(v)) for v in jnp.diag(h)]
    found, scale = jax.jit(jax.hessian(of_two))(at), jnp.outer(at, at)
    np.testing.assert_allclose(found * scale, jnp.stack(steps) * scale, rtol=1e-5, atol=1e-7)
