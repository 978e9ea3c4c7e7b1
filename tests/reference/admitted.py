"""Values that every press takes; tests of what is refused change one of them."""

import jax.numpy as jnp

from jaxtrachea.mechanics import beam

VALUES = {"EI_L": 1.862, "k_M": 0.1, "k_1": 0.3, "k_3": 0.02}
FULL = VALUES | {"EA_L": 3.9, "EI_C": 13.0, "k_t": 0.4}
BEAM = beam.Beam(jnp.array([3.0]), jnp.array(9.0), jnp.ones(2), jnp.ones(1))
