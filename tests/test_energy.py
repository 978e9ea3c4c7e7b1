"""The energy of a press, against the integral of its force over the depth at one place."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_scenes import MATERIAL, TUBE

from jaxtrachea import ObliqueOptions, Options, press_oblique
from jaxtrachea.mechanics.energy import StraightPress, gradient
from jaxtrachea.mechanics.skeleton import local_frame

#: On the rings the local law is stiffer; the side of the ligament bends otherwise; each ring its
#: own mat.
RICH = dataclasses.replace(
    MATERIAL, k_1_ring=jnp.array(0.6), k_3_ring=jnp.array(0.05), EI_side=jnp.array(1.1),
    k_M=jnp.linspace(0.08, 0.16, 15), GA_L=jnp.array(9.0),
)  # fmt: skip
TWO = Options(local="two-material")
NODES, WEIGHTS = (jnp.asarray(v) for v in np.polynomial.legendre.leggauss(12))
#: name -> (material, options, rings)
LEVELS = {
    "softening": (dataclasses.replace(MATERIAL, k_3=jnp.array(-0.004)), Options(), "arch2"),
    "bonded": (RICH, dataclasses.replace(TWO, contact="bonded"), "arch2"),
}


def energy(material, options, rings, inward, s, phi):
    """Integral of the normal force over the depth, 12 points of Gauss; after the first touch."""
    sharp = ObliqueOptions(dataclasses.replace(options, onset_width=0.0), rings)
    normal = local_frame(phi)[0]
    D = (inward * (1 + NODES) / 2)[:, None] * normal[None]
    force = press_oblique(TUBE, material, s, phi, D, sharp).force
    return jnp.sum(WEIGHTS * (force @ normal)) * inward / 2


def solved_press(material, options, rings, inward, s, phi):
    D = inward * local_frame(phi)[0]
    out = press_oblique(TUBE, material, s, phi, D, ObliqueOptions(options, rings))
    return StraightPress(s, phi, inward, out.force, out.depth, out.slope_C, out.loads)


#: Steps by inward way, position and angle: mm, mm, rad.
STEPS = jnp.array([1e-3, 1e-2, 1e-3])


def fourth_order(f, x):
    """Central differences of a function of three numbers by each."""
    times = jnp.array([1, -1, 2, -2.0])[:, None, None]
    near = x[None, None] + times * jnp.diag(STEPS)[None]
    up, down, up_2, down_2 = jax.vmap(f)(near.reshape(-1, 3)).reshape(4, 3)
    return (8 * (up - down) - (up_2 - down_2)) / (12 * STEPS)


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize("name", LEVELS)
def test_gradient_is_that_of_the_work_over_the_depth(name):
    """Between rings and close to one, on the midline and off it, up to 70 degrees.

    Differences: rounding 1e-16 E / h and h^4 E^(5) are below 1e-9 N.
    """
    material, options, rings = LEVELS[name]

    @jax.jit
    def both(x):
        solved = solved_press(material, options, rings, *x)
        by = gradient(TUBE, material, solved, options, rings=rings, axial=True)

        return jnp.stack(by), fourth_order(lambda x: energy(material, options, rings, *x), x)

    sign = -1.0 if options.contact == "bonded" else 1.0
    for place in ([2.0, 73.2, 0.0], [1.0, 80.3, 0.4], [2.5, 31.0, -0.9], [1.5, 6.0, 1.2]):
        mine, truth = both(jnp.asarray(place) * jnp.asarray([sign, 1.0, 1.0]))
        np.testing.assert_allclose(mine, truth, rtol=2e-7, atol=2e-9)
