"""The two doors: the level that options ask for, and its kind where a material alone is there."""

import functools
import operator
from collections.abc import Mapping

from jaxtrachea._arguments import check_word
from jaxtrachea.mechanics.levels.level import Level
from jaxtrachea.mechanics.levels.line import Line
from jaxtrachea.mechanics.levels.options import Options
from jaxtrachea.mechanics.levels.relaxing import Relaxing, RelaxingMaterial, long_run
from jaxtrachea.mechanics.levels.sections import Sections
from jaxtrachea.mechanics.sections.material import SectionMaterial
from jaxtrachea.trachea.material import OF_TIME, Declaration, Material

#: The level of each word of `Options.skeleton`.
LEVELS = {"linear": Line, "softening": Line, "sections": Sections}
#: What a scene can be of, before its options are chosen.
AnyMaterial = Material | SectionMaterial | RelaxingMaterial
#: The parameters of all levels, by name.
DECLARED: Mapping[str, Declaration] = functools.reduce(
    operator.or_, (*(kind.declares for kind in LEVELS.values()), OF_TIME)
)


@functools.lru_cache(maxsize=256)
def level_of(options: Options) -> Level:
    """The level that options ask for; equal where they are."""
    level = LEVELS[options.skeleton](options)
    return level if options.relaxation == "off" else Relaxing(level, options)


def level_type(material: AnyMaterial) -> type[Level]:
    """The kind of level whose values a material has, in the long run if it relaxes.

    Raises:
        ValueError: no level has such a material.
    """
    check_word("material", material, AnyMaterial)
    values = long_run(material)
    check_word("material", values, Material | SectionMaterial)
    return next(kind for kind in LEVELS.values() if isinstance(values, kind.material_type))
