"""Functions whose results tests compare: compiled, and back as NumPy arrays."""

import functools

import jax
import numpy as np


def jitted(function, **options):
    """`jax.jit` of the function, with NumPy arrays as results.

    An operation on a result of JAX outside of `jit` is a program of its own, compiled anew for each
    shape; one on a NumPy array is not. Inside of another transformation nothing is changed.
    """
    run = jax.jit(function, **options)

    @functools.wraps(function)
    def call(*given, **named):
        found = run(*given, **named)
        return jax.tree.map(lambda v: v if isinstance(v, jax.core.Tracer) else np.asarray(v), found)

    return call
