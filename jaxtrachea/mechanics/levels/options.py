"""What a model includes: its skeleton, its local law, the contact and the tool."""

import dataclasses
from typing import Literal

from jaxtrachea._arguments import check_record, check_word
from jaxtrachea.mechanics import beam as _beam
from jaxtrachea.relaxation import laws as relaxation_laws

#: Words of the skeletons; `levels.choose` has the level of each.
Skeleton = Literal["linear", "softening", "sections"]


@dataclasses.dataclass(frozen=True)
class Options:
    """What the model includes; static, it selects the program that is compiled.

    Attributes:
        coupling: `series` (tool displacement = local indentation + skeleton deflection) or `total`
            (as printed: the local law takes the whole displacement).
        split: `continuous` (deflection and rotation agree at C) or `independent` (paper eq. 3).
        form: `recursion`, or `reactions` for the paper's dense force method.
        shear: the ligament also deforms in shear (needs `Material.GA_L`).
        local: one law everywhere (`uniform`), or `two-material`: a law of its own on the rings
            (needs `Material.k_1_ring`; `k_3_ring` and `k_5_ring` where they differ there too).
        contact: `unilateral` (no force before first touch, and no pull: PULLS) or `bonded` (press
            or draw, odd law).
        onset_width: width of the smooth first touch, mm; no force before touch, none changed after.
        transition: distance from a ring's centre at which the ligament's own local law is reached,
            mm; None: half the smallest distance between two rings, of one ring that to the nearer
            end of the tube.
        half_width: of a flat punch along s, mm, which holds the ligament level over twice that and
            whose local law is the mean over it (pi/4 of the radius of a cylinder's end; needs
            `recursion` and `continuous`). All of it has to lie on the tube, else OFF_TUBE. 0: the
            tool touches at a point.
        skeleton: `linear`, or `softening` for deep presses: it yields more the further it moves
            (needs `Material.e_1` and `e_2`, and `series`); or `sections`, in fits: deforming
            cross-sections, anywhere on the rings and at finite strain (`bonded`; no other option
            but `half_width` applies). `press_sections` presses that one.
        relaxation: `off`, or how the force relaxes in time: `uniform`, the whole organ alike, or
            `parts`, local law and skeleton apart (needs `series`, and no `sections`).
        branches: the law of relaxation, see `relaxation.laws`.
        shortest: step of the records, s, from which on `power` is one.
        longest: of the records, s, up to which it is.
    """

    coupling: Literal["series", "total"] = "series"
    split: _beam.Split = "continuous"
    form: _beam.Form = "recursion"
    shear: bool = False
    local: Literal["uniform", "two-material"] = "uniform"
    contact: Literal["unilateral", "bonded"] = "unilateral"
    onset_width: float = 1e-3
    transition: float | None = None
    half_width: float = 0.0
    skeleton: Skeleton = "linear"
    relaxation: Literal["off", "uniform", "parts"] = "off"
    branches: relaxation_laws.Word = "prony-2"
    shortest: float = 1e-3
    longest: float = 1e3

    def __post_init__(self):
        """Refuse words and numbers that no model has, and options that exclude each other.

        Raises:
            ValueError: naming the option, what was found and what is expected.
        """
        check_record(self, onset_width=0.0, half_width=0.0)
        if self.transition is not None and self.transition <= 0:
            raise ValueError(f"transition is {self.transition:g} mm; expected more than 0, or None")
        if self.half_width > 0 and (self.form, self.split) != ("recursion", "continuous"):
            raise ValueError(
                f"half_width is {self.half_width:g} mm; a tool with a width needs "
                "form='recursion' and split='continuous'"
            )
        if self.skeleton == "softening" and self.coupling != "series":
            raise ValueError(
                "skeleton='softening' needs coupling='series': with 'total' the force does not "
                "depend on the skeleton"
            )
        if not 0 < self.shortest <= self.longest:
            raise ValueError(
                f"shortest is {self.shortest:g} s, longest {self.longest:g} s; expected "
                "0 < shortest <= longest"
            )
        if self.relaxation == "parts":
            self._check_parts()
        for name, only in _ONLY.get(self.skeleton, {}).items():
            if (value := getattr(self, name)) != only:
                why = "the tool sticks to the wall" if name == "contact" else _NO_OTHER
                raise ValueError(
                    f"skeleton={self.skeleton!r} needs {name}={only!r}, found {value!r}: {why}"
                )

    def _check_parts(self):
        if self.coupling != "series":
            raise ValueError(
                "relaxation='parts' needs coupling='series': with 'total' the force does not "
                "depend on the skeleton; choose 'uniform'"
            )
        if self.skeleton in _ONLY:
            raise ValueError(
                f"relaxation='parts' is not derived for skeleton={self.skeleton!r}, whose wall has "
                "no compliance of its own; choose 'uniform'"
            )

    @property
    def span(self) -> relaxation_laws.Span:
        """Times of the records."""
        return relaxation_laws.Span(self.shortest, self.longest)

    def places(self, length: float) -> tuple[float, float]:
        """Lowest and highest contact position, mm, at which all of the tool lies on the tube."""
        return self.half_width, length - self.half_width


#: Options that a skeleton which is no line of joints has no choice of; no others apply to it.
_ONLY = {
    "sections": {
        "coupling": "series", "split": "continuous", "form": "recursion", "shear": False,
        "local": "uniform", "transition": None, "contact": "bonded",
        "onset_width": 1e-3,
    },
}  # fmt: skip
_NO_OTHER = "no other applies to it"


def check_line(options: Options, what: str, *, timed: bool = False) -> None:
    """Refuse a skeleton of deforming cross-sections where a line of joints is pressed.

    Args:
        what: was called.
        timed: whether time enters there; else a force that relaxes is refused.

    Raises:
        ValueError: naming what was called and the cure; or no `Options`.
    """
    check_word("options", options, Options)
    if options.skeleton in _ONLY:
        raise ValueError(
            f"{what} presses a line of joints, not skeleton={options.skeleton!r}; "
            "use press_sections"
        )
    if options.relaxation != "off" and not timed:
        raise ValueError(
            f"{what} knows no time, and options.relaxation is {options.relaxation!r}; use "
            "press_in_time, or relaxation='off'"
        )
