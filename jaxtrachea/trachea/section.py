"""The tube of a [trachea] section."""

import numpy as np

from jaxtrachea._errors import InputError
from jaxtrachea.config import EvenRings, SpecError, TracheaSection
from jaxtrachea.trachea.geometry import Geometry, table_1
from jaxtrachea.trachea.sizes import check_geometry


def geometry_of(section: TracheaSection) -> Geometry:
    """The tube of a [trachea] section.

    Raises:
        SpecError: impossible dimensions, or those of another unit most likely, with the key.
    """
    preset = table_1()
    length = float(preset.length) if section.length is None else section.length
    rings = section.rings
    if rings is None:
        rings = np.asarray(preset.ring_positions, np.float64)
    if isinstance(rings, EvenRings):
        rings = np.linspace(rings.first, rings.last, rings.count)
    try:
        geometry = Geometry.create(
            length,
            rings,
            radius=section.radius,
            half_angle=section.half_angle,
            ring_height=section.ring_height,
        )
        check_geometry(geometry)
        return geometry
    except InputError as error:
        named = error.renamed({"ring_positions": "rings"})
        key = named.key.removeprefix("geometry.")
        raise SpecError.like(named, key=f"trachea.{key}") from None
