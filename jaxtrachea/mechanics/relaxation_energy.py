r"""Energy of a press that relaxes: what its springs store, and what its dashpots have taken.

Of the elastic force e with the displacement D(e) of law and skeleton, and of branches whose springs
carry h_b = gamma_b (e - e_b),

    psi = W(e) + sum gamma_b [W*(e_b) - W*(e) - D(e) (e_b - e)],   W = e D - W*,
    taken: sum int gamma_b (e - e_b) (D(e) - D(e_b)) / tau_b dt,

W* the complementary energy, int D de. Of a law that nowhere softens no term is negative: no path
gives more work than was put in. The work of the tool is their sum.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxtrachea.mechanics.force_law import Law
from jaxtrachea.relaxation.filter import overloads
from jaxtrachea.relaxation.steps import Branches, fading, mean_kept

#: Places within a step, and their weights, for the integral of what is taken.
_PLACES, _WEIGHTS = np.polynomial.legendre.leggauss(5)


class Energy(NamedTuple):
    """Of every sample, N mm.

    Attributes:
        stored: in the springs.
        dissipated: by the dashpots since the first sample.
    """

    stored: Float[Array, " N"]
    dissipated: Float[Array, " N"]


def energy(
    time: Float[Array, " N"],
    elastic: Float[Array, " N"],
    branches: Branches,
    law: Law,
    compliance: Float[Array, ""],
) -> Energy:
    """The energy of a press in which all of the organ relaxes alike.

    What is taken is a sum over places within a step: of the right sign, and right where steps are
    no longer than the relaxation times (within 1e-3 of the peak where the law is steep, in the
    median of random paths 1e-11).

    Args:
        time: s, never falling.
        elastic: of the surface, N: `Relaxed.elastic`.
        branches: see `Branches`.
        law: local law, nowhere softening.
        compliance: of the skeleton, mm/N.
    """

    def depth(e):
        return law.root(e, jnp.ones_like(e), 0.0)

    def moved(e):
        return depth(e) + compliance * e

    def complementary(e):
        d = depth(e)
        return e * d - law.energy(d * d) + compliance * e * e / 2

    gamma = branches.gamma[None]
    strong = gamma > 0
    x, _ = fading(time, branches)
    h = overloads(time, elastic, branches)
    e = jnp.broadcast_to(elastic[:, None], h.shape)

    def behind(e, h):
        """Elastic force that the dashpots have reached."""
        return e - jnp.where(strong, h / jnp.where(strong, gamma, 1), 0)

    e_b = behind(e, h)
    held = gamma * (complementary(e_b) - complementary(e) - moved(e) * (e_b - e))
    stored = elastic * moved(elastic) - complementary(elastic) + jnp.sum(held, axis=-1)

    zero = jnp.zeros_like(h[:1])
    e_0, h_0 = (jnp.concatenate([zero, v[:-1]]) for v in (e, h))
    taken = jnp.zeros_like(h)
    for place, weight in zip(_PLACES, _WEIGHTS, strict=True):
        at = (1 + float(place)) / 2
        now = e_0 + at * (e - e_0)
        carried = jnp.exp(-at * x) * h_0 + gamma * mean_kept(at * x) * (now - e_0)
        lag = behind(now, carried)
        taken = taken + float(weight) / 2 * x * gamma * (now - lag) * (moved(now) - moved(lag))
    return Energy(stored, jnp.cumsum(jnp.sum(taken, axis=-1)))
