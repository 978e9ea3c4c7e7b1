r"""A tube that softens in pressing and stiffens in a draw: one ratio for the way of the tool.

The arch of the wall flattens under the tool, ring and ligament alike. Where small strain gives the
force F_0(D) of skeleton and local law in series, a press by D has

    F = r(D) F_0(D),   r(D) = 1 - e_1 D + e_2 D^2,

not odd: D > 0 is a press, D < 0 a draw. The ratio is of the whole way D, not of the skeleton's
part: a local law that stayed as stiff would take the more of the way the deeper the press, and make
places between rings soften less than rings; on a finite-element trachea they soften more
(docs/evidence/virtual_trachea.md). Motions are those of small strain at the same D.

Followed as far as D r(D) rises, up to the first zero of 1 - 2 e_1 D + 3 e_2 D^2 (none where
e_1^2 <= 3 e_2), and as the local law is followed; past it the status is PAST_FOLD.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxtrachea.mechanics.roots import first_positive_root


class Softening(NamedTuple):
    """How the stiffness of a press changes with its depth.

    Attributes:
        e_1: 1/mm; positive: a press softens.
        e_2: 1/mm^2.
    """

    e_1: Float[Array, "..."]
    e_2: Float[Array, "..."]

    def ratio(self, displacement: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Force over that of small strain."""
        return 1 + displacement * (self.e_2 * displacement - self.e_1)

    def slope(self, displacement: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Derivative of `ratio`, 1/mm."""
        return 2 * self.e_2 * displacement - self.e_1

    def past_peak(self, displacement: Float[Array, "*n"]) -> Bool[Array, "*n"]:
        """Whether a straight law would carry less there than before."""
        e_1, e_2 = jnp.asarray(self.e_1), jnp.asarray(self.e_2)
        e_1 = jnp.where(displacement < 0, -e_1, e_1)
        e_2 = jnp.broadcast_to(e_2, e_1.shape)
        peak = first_positive_root(jnp.ones_like(e_1), -2 * e_1, 3 * e_2)
        return jnp.abs(displacement) >= peak
