"""Strict settings for the whole suite: float64, no silent promotion, shapes checked."""

import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")
# Also for the commands that tests start: nothing is written beside the tests.
os.environ["JAX_ENABLE_COMPILATION_CACHE"] = "false"

import jax
import pytest
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

# For the whole session: modules that a test imports later are checked as well.
install_import_hook("jaxtrachea", "beartype.beartype")


@pytest.fixture(scope="module", autouse=True)
def _forget_programs():
    """Compiled programs of a file are dropped with it; together they would take gigabytes."""
    yield
    jax.clear_caches()
