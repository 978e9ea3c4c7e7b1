"""Strict settings for the whole suite: float64, no silent promotion, shapes checked."""

import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

# For the whole session: modules that a test imports later are checked as well.
install_import_hook("jaxtrachea", "beartype.beartype")
