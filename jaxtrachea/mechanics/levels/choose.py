"""The one door: the level that options ask for."""

import functools
from collections.abc import Callable, Mapping

from jaxtrachea.mechanics.levels.level import Level
from jaxtrachea.mechanics.levels.line import Line
from jaxtrachea.mechanics.levels.options import Options
from jaxtrachea.mechanics.levels.sections import Sections

#: The level of each word of `Options.skeleton`.
LEVELS: Mapping[str, Callable[[Options], Level]] = {
    "linear": Line, "softening": Line, "sections": Sections,
}  # fmt: skip


@functools.lru_cache(maxsize=256)
def level_of(options: Options) -> Level:
    """The level that options ask for; equal where they are."""
    return LEVELS[options.skeleton](options)
