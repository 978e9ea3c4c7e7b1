"""How a fit is solved."""

import dataclasses
import functools
import sys
import warnings
from pathlib import Path
from typing import Literal

import jax
import numpy as np

from jaxtrachea._arguments import check_record
from jaxtrachea.optimisation.trust_region import Tolerances


@dataclasses.dataclass(frozen=True)
class Settings:
    """How to solve.

    Attributes:
        method: `levenberg-marquardt`, or optax's `lbfgs` / `adam` on the same cost.
        starts: starts per lane; the first is the initial guess, the others are drawn around it.
        decades: starts are drawn up to this many decades from the guess (log scale; with linear
            scale up to this many times 10 steps), inside the bounds.
        seed: of the drawn starts.
        more_starts: added to lanes in doubt: no start converged, or one of several alone came
            lowest. With them infeasible starts are drawn anew. 0: neither.
        batch: lanes computed together, at most: on a CPU fewer of long curves, which is quicker.
        tolerances: when a lane is done.
        float32: compute in single precision (results are float64 all the same); without it a fit
            warns once where JAX has no double precision (`jax_enable_x64` is off).
        verify: look for other minima and profile where an estimate gives cause; False: verdicts
            rest on structure and local standard errors alone (for refits of which no one reads
            the verdicts).
    """

    method: Literal["levenberg-marquardt", "lbfgs", "adam"] = "levenberg-marquardt"
    starts: int = 4
    decades: float = 1.0
    seed: int = 0
    more_starts: int = 8
    batch: int = 128
    tolerances: Tolerances = Tolerances()
    float32: bool = False
    verify: bool = True

    def __post_init__(self):
        """Refuse words and numbers that mean nothing (`ValueError`)."""
        check_record(self, starts=1.0, decades=0.0, seed=0.0, more_starts=0.0, batch=1.0)
        check_record(self.tolerances, cost=0.0, step=0.0, gradient=0.0, iterations=1.0)


def check_precision(settings: Settings) -> None:
    """Warn, once in a process, of a fit in single precision that nobody asked for."""
    single = jax.dtypes.canonicalize_dtype(np.float64) != np.float64
    if single and not settings.float32:
        _warn_of_single_precision()


@functools.cache
def _warn_of_single_precision() -> None:
    """Point at the first line outside of the package; a warning made an error comes again."""
    package, level = str(Path(__file__).parents[1]), 1
    frame = sys._getframe()
    while frame.f_back is not None and frame.f_code.co_filename.startswith(package):
        frame, level = frame.f_back, level + 1
    warnings.warn(
        "JAX computes in float32: estimates and errors of a fit are rough in it; before the first "
        'array is made, call jax.config.update("jax_enable_x64", True), or ask for it with '
        "Settings(float32=True)",
        stacklevel=level,
    )
