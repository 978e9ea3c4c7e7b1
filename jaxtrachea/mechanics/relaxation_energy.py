r"""Energy of a press that relaxes: what its springs store, and what its dashpots have taken.

Of the elastic force e with the displacement D(e) of law and skeleton, and of branches whose springs
carry h_b = gamma_b (e - e_b),

    psi = W(e) + sum gamma_b [W*(e_b) - W*(e) - D(e) (e_b - e)],   W = e D - W*,
    taken: sum int gamma_b (e - e_b) (D(e) - D(e_b)) / tau_b dt,

W* the complementary energy, int D de. Of a law that nowhere softens no term is negative: no path
gives more work than was put in. The work of the tool is their sum.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxtrachea.mechanics.force_law import Law
from jaxtrachea.relaxation.filter import overloads
from jaxtrachea.relaxation.steps import Branches, Carried, fading, mean_kept

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

    What is taken is a sum over places within a step: of the right sign. Of a linear law it is right
    within 1e-8 in steps as long as a relaxation time, 4e-4 in ten times longer ones and 2 % in a
    hundred times longer ones; where the law is steep within 1e-3 of the peak.

    Args:
        time: s, never falling.
        elastic: of the surface, N: `Relaxed.elastic`.
        branches: see `Branches`.
        law: local law, nowhere softening.
        compliance: of the skeleton, mm/N.
    """

    def moved(e):
        return law.under(e) + compliance * e

    def complementary(e):
        d = law.under(e)
        return e * d - law.energy(d * d) + compliance * e * e / 2

    gamma = branches.gamma[None]
    x, _ = fading(time, branches)
    h = overloads(time, elastic, branches)
    e = jnp.broadcast_to(elastic[:, None], h.shape)
    e_b = _behind(e, h, gamma)
    held = gamma * (complementary(e_b) - complementary(e) - moved(e) * (e_b - e))
    stored = elastic * moved(elastic) - complementary(elastic) + jnp.sum(held, axis=-1)

    def step(x, overload, before, elastic):
        return taken(x, branches.gamma, Carried(overload, before), elastic, moved)

    h_0, e_0 = (jnp.concatenate([jnp.zeros_like(v[:1]), v[:-1]]) for v in (h, elastic))
    return Energy(stored, jnp.cumsum(jax.vmap(step)(x, h_0, e_0, elastic)))


def taken(
    x: Float[Array, " B"],
    gamma: Float[Array, " B"],
    before: Carried,
    elastic: Float[Array, "*k"],
    moved: Callable[[Array], Array],
) -> Float[Array, ""]:
    """What the dashpots take in one step, N mm; see `energy`.

    Args:
        x: the step over the relaxation times.
        gamma: strengths of the branches.
        before: what they carried, and the elastic force before the step; of vectors (3,).
        elastic: elastic force after it, N: of the surface.
        moved: displacement under an elastic force, mm; of any leading shape.
    """
    ones = [1] * elastic.ndim
    x, gamma = (v.reshape(1, -1, *ones) for v in (x, gamma))
    share, weights = (jnp.asarray(v, x.dtype).reshape(-1, 1, *ones) for v in (_PLACES, _WEIGHTS))
    # Places lie closer where a long step begins, as what was carried fades there.
    size = jnp.log1p(x)
    passed = jnp.expm1(size * ((1 + share) / 2))
    some = x > jnp.finfo(x.dtype).eps
    at = jnp.where(some, passed / jnp.where(some, x, 1), (1 + share) / 2)
    taken_there = weights / 2 * size * (1 + passed) * gamma
    h, start = before.overload[None], before.elastic[None, None]
    moved_on = at * (elastic - before.elastic)[None, None]
    now = start + moved_on
    carried = jnp.exp(-passed) * h + gamma * mean_kept(passed) * moved_on
    lag = _behind(now, carried, gamma)
    return jnp.sum(taken_there * (now - lag) * (moved(now) - moved(lag)))


def _behind(e, h, gamma):
    """Elastic force that the dashpots have reached."""
    strong = gamma > 0
    return e - jnp.where(strong, h / jnp.where(strong, gamma, 1), 0)
