"""What is measured of a press beside displacement and force: one row for each quantity.

Roles, readers, writers and checks loop over `OBSERVED`. A new quantity is a row here, a field of
`Curve` and `RawCurve`, and what a level of the model answers to it.
"""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Quantity:
    """A measured quantity.

    Attributes:
        name: field of a curve, and dataset of the project's own HDF5 files.
        role: what `ReadOptions.units` calls its columns.
        dimension: of its unit, see `units`.
        unit: that curves and written files have.
        words: what it is called in a sentence.
        names: of its column besides the role, in lower case.
        rings: field that numbers the rings (from 0) of which it has a value for every sample; None:
            it is one number for every sample.
        side: end of the role of a ring's column, ``"_side"`` of ``"joint_7_side"``.
        end: end of a ring that it is of, ``"U"`` of ``"end_U_7_y"``.
        components: of one value; of a column each.
        requires: field that has to be given with it.
        gaps: NaN stands for not observed; otherwise every sample needs it.
        turns: `ReadOptions.force_sign` turns it.
        largest: option of `ReadOptions` that bounds its size; None: it is not bounded.
        vector: only a model of presses in any direction reads it.
        fitted: field of a level's `Response` that a fit compares it with, alone or with others.
        odd: by symmetry 0 of a press along the normal on the midline, where no fit reads it.
    """

    name: str
    role: str
    dimension: str
    unit: str
    words: str
    names: tuple[str, ...] = ()
    rings: str | None = None
    side: str = ""
    end: str = ""
    components: tuple[str, ...] = ()
    requires: str | None = None
    gaps: bool = True
    turns: bool = False
    largest: str | None = None
    vector: bool = False
    fitted: str = ""
    odd: bool = False

    @property
    def short(self) -> str:
        """Begin of the names of what results have of it: "side" of `side_force`."""
        return self.role.removesuffix("_force") + self.side

    def columns(self, ring: int | str) -> list[str]:
        """Roles of the columns of a ring (counted from 1), one for each component."""
        head = "_".join(filter(None, (self.role, self.end, str(ring)))) + self.side
        return [f"{head}_{axis}" for axis in self.components] or [head]

    def shape(self, samples: int, rings: int) -> tuple[int, ...]:
        """Of its values in a curve."""
        if self.rings is None:
            return (samples,)
        return (samples, rings, *([len(self.components)] if self.components else []))


_MARKERS: dict[str, Any] = {
    "role": "joint",
    "dimension": "length",
    "unit": "mm",
    "rings": "joint_rings",
}
_ENDS: dict[str, Any] = {
    "role": "end", "dimension": "length", "unit": "mm", "rings": "end_rings",
    "components": ("y", "z"), "largest": "max_displacement", "vector": True, "fitted": "ends",
}  # fmt: skip

OBSERVED = (
    Quantity(
        "sigma", "sigma", "force", "N", "noise of the force",
        names=("force_sigma", "force_noise"), gaps=False,
    ),
    Quantity("time", "time", "time", "s", "time", gaps=False),
    Quantity(
        "side_force", "side_force", "force", "N", "side force",
        names=("side force",), turns=True, largest="max_force", vector=True,
        fitted="side_force", odd=True,
    ),
    # The size of the inward part of markers has never been bounded.
    Quantity("joint_displacement", words="motion of markers", fitted="joints", **_MARKERS),
    Quantity(
        "joint_side_displacement", words="sideward motion of markers", side="_side",
        requires="joint_displacement", largest="max_displacement", vector=True,
        fitted="joint_side", odd=True, **_MARKERS,
    ),
    Quantity("end_U", words="motion of ring ends U", end="U", **_ENDS),
    Quantity("end_V", words="motion of ring ends V", end="V", **_ENDS),
)  # fmt: skip

#: Fields that number rings, and the quantities of which each tells the rings.
RINGS = {
    field: tuple(q for q in OBSERVED if q.rings == field)
    for field in dict.fromkeys(q.rings for q in OBSERVED if q.rings is not None)
}
#: What a fit compares with a level's `Response`, by its field, in the order of the residual's row.
FITTED = {
    field: tuple(q for q in OBSERVED if q.fitted == field)
    for field in dict.fromkeys(q.fitted for q in OBSERVED if q.fitted)
}
# There are two noises: that of the force, and that of markers.
assert all(q.dimension == ("length" if q.rings else "force") for p in FITTED.values() for q in p)
#: Those of one number for every sample.
FITTED_NUMBERS = {name: parts[0] for name, parts in FITTED.items() if parts[0].rings is None}
#: Datasets and messages number rings from 1, under names of their own.
RING_NUMBERS = {"joint_rings": "joint_ring_number", "end_rings": "end_ring_number"}
#: Fields of a curve that one of displacement, force, noise and time does not have.
FURTHER_FIELDS = (*(q.name for q in OBSERVED if q.gaps), *RINGS)
#: Fields that a model of presses along the normal does not read, and changes that take them off.
VECTORS = {q.name: q.words for q in OBSERVED if q.vector}
WITHOUT_VECTORS: dict[str, None] = dict.fromkeys((*VECTORS, "end_rings"))
