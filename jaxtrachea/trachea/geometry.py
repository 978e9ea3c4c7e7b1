"""What is there at rest: length, ring positions and cross-section of a ring-supported tube."""

import functools
import math
from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxtrachea._arguments import float_dtype, real
from jaxtrachea._errors import InputError


class Geometry(eqx.Module):
    """A straight tube held at both ends and supported by C-rings.

    Coordinates as in docs/model.md: `s` runs along the centreline from 0 (carina, end A) to
    `length` (larynx, end B); rings span |phi| <= `half_angle` about the anterior midline.

    Attributes:
        length: mm.
        ring_positions: s of each ring, mm, strictly increasing inside (0, length); shape (rings,).
        radius: radius of the ring line, mm.
        half_angle: half opening of the C-rings, rad.
        ring_height: extent of a ring along s, mm (sets where the local law is that of a ring).
    """

    length: Float[Array, ""] = eqx.field(converter=functools.partial(real, "length"))
    ring_positions: Float[Array, " rings"] = eqx.field(
        converter=functools.partial(real, "ring_positions")
    )
    radius: Float[Array, ""] = eqx.field(converter=functools.partial(real, "radius"))
    half_angle: Float[Array, ""] = eqx.field(converter=functools.partial(real, "half_angle"))
    ring_height: Float[Array, ""] = eqx.field(converter=functools.partial(real, "ring_height"))

    @property
    def rings(self) -> int:
        """Number of rings (static)."""
        return self.ring_positions.shape[0]

    @classmethod
    def create(
        cls,
        length: float,
        ring_positions: ArrayLike | Sequence[float],
        *,
        radius: float = 11.3,
        half_angle: float = 2 * math.pi / 3,
        ring_height: float = 4.0,
        dtype=None,
    ) -> "Geometry":
        """Build a geometry from Python numbers, checking it on the way.

        Args:
            length: mm, positive.
            ring_positions: s of each ring, mm; strictly increasing, inside (0, length).
            radius: mm, positive.
            half_angle: rad, in (pi/2, pi) for a ring open behind.
            ring_height: mm, positive.
            dtype: of every array; the default float type of JAX if None.

        Raises:
            InputError: naming the argument, what was found and what is expected.
        """
        length, radius = _number("length", length), _number("radius", radius)
        half_angle = _number("half_angle", half_angle)
        ring_height = _number("ring_height", ring_height)
        x = np.atleast_1d(_numbers("ring_positions", ring_positions))
        if x.ndim != 1:
            raise _refused("ring_positions", f"has shape {x.shape}", "one axis of s")
        if not math.isfinite(length) or length <= 0:
            raise _refused("length", f"is {length} mm", "a positive number")
        if x.size == 0:
            raise _refused("ring_positions", "is empty", "at least one ring")
        if not np.all(np.isfinite(x)) or np.any(np.diff(x) <= 0):
            found = ", ".join(f"{v:g}" for v in x[:12]) + (", ..." if x.size > 12 else "")
            raise _refused(
                "ring_positions", f"must be finite and strictly increasing; found {found}"
            )
        if x[0] <= 0 or x[-1] >= length:
            found = f"run from {x[0]:g} to {x[-1]:g} mm"
            raise _refused("ring_positions", found, f"all inside (0, {length:g}) mm")
        for name, value in (("radius", radius), ("ring_height", ring_height)):
            if not math.isfinite(value) or value <= 0:
                raise _refused(name, f"is {value} mm", "a positive number")
        if not math.pi / 2 < half_angle < math.pi:
            found = f"is {half_angle:.6g} rad"
            raise _refused("half_angle", found, "between pi/2 and pi, 90 and 180 deg")
        dtype = float_dtype(dtype)
        arrays = (np.asarray(v, dtype) for v in (length, x, radius, half_angle, ring_height))
        return cls(*arrays)


def _refused(argument: str, found: str, expected: str = "") -> InputError:
    return InputError(found, key=argument, expected=expected, joint=" ")


def _numbers(name: str, value: object) -> np.ndarray:
    try:
        return np.asarray(value, np.float64)
    except (TypeError, ValueError):
        raise _refused(name, f"is {value!r}", "numbers in mm or rad") from None


def _number(name: str, value: object) -> float:
    array = _numbers(name, value)
    if array.ndim:
        raise _refused(name, f"has shape {array.shape}", "a single number")
    return float(array)


def table_1(dtype=None) -> Geometry:
    """The trachea of the paper's Table 1: 160 mm long, 15 rings, inner diameter 20 mm, wall 2.6 mm.

    Ring positions are not printed in the paper; they are taken evenly, 10 mm apart. The ring line
    lies in the middle of the cartilage (inner radius + h_C / 2).
    """
    return Geometry.create(160.0, 10.0 * np.arange(1, 16), radius=10 + 2.6 / 2, dtype=dtype)


#: Table 1 of the paper: moduli in MPa, areas in mm^2, friction coefficient without unit.
TABLE_1 = {
    "E_C": 5.8,
    "E_L": 0.65,
    "A_C": 4.0,
    "A_L": 6.0,
    "h_C": 2.6,
    "h_M": 2.0,
    "inner_diameter": 20.0,
    "length": 160.0,
    "mass_g": 30.0,
    "friction": 0.66,
}


def disc_second_moment(area: float) -> float:
    """Second moment of area of a full disc, A^2 / (4 pi), mm^4 (paper: section of the ligament)."""
    return area**2 / (4 * math.pi)
