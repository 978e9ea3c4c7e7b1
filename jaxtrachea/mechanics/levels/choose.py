"""The one door: the level that options ask for."""

import functools
import operator
from collections.abc import Mapping

from jaxtrachea.mechanics.levels.level import Level
from jaxtrachea.mechanics.levels.line import Line
from jaxtrachea.mechanics.levels.options import Options
from jaxtrachea.mechanics.levels.sections import Sections
from jaxtrachea.trachea.material import Declaration

#: The level of each word of `Options.skeleton`.
LEVELS = {"linear": Line, "softening": Line, "sections": Sections}
#: The parameters of all levels, by name.
DECLARED: Mapping[str, Declaration] = functools.reduce(
    operator.or_, (kind.declares for kind in LEVELS.values())
)


@functools.lru_cache(maxsize=256)
def level_of(options: Options) -> Level:
    """The level that options ask for; equal where they are."""
    return LEVELS[options.skeleton](options)
