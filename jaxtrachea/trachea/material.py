"""The mechanical parameters of a trachea as one pytree."""

import functools

import equinox as eqx
from jaxtyping import Array, Float

from jaxtrachea._arguments import real


def _array(name: str):
    """A field whose Python numbers become arrays (one door, so that jit does not retrace)."""
    return eqx.field(converter=functools.partial(real, name))


def _optional(name: str):
    """As `_array`, or None."""
    return eqx.field(default=None, converter=lambda v: None if v is None else real(name, v))


class Material(eqx.Module):
    """Stiffness of ligament, rings and local contact: everything that is identified.

    A scalar holds for all spans or rings; an array gives each its own. None: not part of the model
    (no shear flexibility; the ring's local law is that of the ligament).

    Attributes:
        EI_L: bending stiffness E_L I_L of the ligament, N mm^2; scalar or (rings + 1,).
        k_M: stiffness of the muscular mat under each ring, N/mm; scalar or (rings,).
        k_1: linear local contact stiffness m_0 omega_0^2, N/mm.
        k_3: cubic local contact stiffness 3/4 m_0 beta_0^2 eps, N/mm^3.
        GA_L: shear stiffness kappa G A of the ligament, N; scalar or (rings + 1,), or None.
        k_1_ring: `k_1` where the tool rests on a ring, N/mm, or None.
        k_3_ring: `k_3` where the tool rests on a ring, N/mm^3, or None.
        EA_L: axial stiffness E_L A_L, N; scalar or (rings + 1,), or None.
        k_A: axial spring of the carina end, N/mm; None: rigid.
        k_B: axial spring of the larynx end, N/mm; None: rigid.
        EI_C: bending stiffness E_C I_C of the cartilage in the plane of a ring, N mm^2, or None.
        k_t: stiffness of the muscular bar between the ends of a ring, N/mm, or None.
        EI_side: `EI_L` for bending along the circumference, off the midline sideways; None: EI_L.
        GA_side: `GA_L` likewise; None: GA_L.
    """

    EI_L: Float[Array, "..."] = _array("EI_L")
    k_M: Float[Array, "..."] = _array("k_M")
    k_1: Float[Array, ""] = _array("k_1")
    k_3: Float[Array, ""] = _array("k_3")
    GA_L: Float[Array, "..."] | None = _optional("GA_L")
    k_1_ring: Float[Array, ""] | None = _optional("k_1_ring")
    k_3_ring: Float[Array, ""] | None = _optional("k_3_ring")
    EA_L: Float[Array, "..."] | None = _optional("EA_L")
    k_A: Float[Array, ""] | None = _optional("k_A")
    k_B: Float[Array, ""] | None = _optional("k_B")
    EI_C: Float[Array, ""] | None = _optional("EI_C")
    k_t: Float[Array, ""] | None = _optional("k_t")
    EI_side: Float[Array, "..."] | None = _optional("EI_side")
    GA_side: Float[Array, "..."] | None = _optional("GA_side")
