"""Names of specimens and trials that a reader takes for the same, and a computer does not."""

import unicodedata
from collections.abc import Iterable

from jaxtrachea.measurements.curve import BadCurve, Curve


def appearance(name: str) -> str:
    """A name without upper case and without the several forms in which Unicode writes a letter."""
    return unicodedata.normalize("NFKC", unicodedata.normalize("NFKC", name).casefold())


def look_alikes(curves: Iterable[Curve | BadCurve]) -> list[str]:
    """One line for each group of names that look alike: specimens, then trials of a specimen.

    The names stay different. The cost is linear in the number of curves.
    """
    specimens: dict[str, dict[str, list[str]]] = {}
    trials: dict[tuple[str, str], dict[str, list[str]]] = {}
    for curve in curves:
        names = specimens.setdefault(appearance(curve.specimen), {})
        names.setdefault(curve.specimen, []).append(curve.source)
        names = trials.setdefault((curve.specimen, appearance(curve.trial)), {})
        names.setdefault(curve.trial, []).append(curve.source)
    lines = [_line("specimens", names) for names in specimens.values() if len(names) > 1]
    for (specimen, _), names in trials.items():
        if len(names) > 1:
            lines.append(_line(f"trials of specimen {specimen!r}", names))
    return lines


def _line(what: str, names: dict[str, list[str]]) -> str:
    """What looks alike, and what to do."""
    listed = [
        f"{_shown(name)} ({len(sources)} curve{'s' * (len(sources) > 1)}, first {sources[0]})"
        for name, sources in list(names.items())[:4]
    ]
    more = f" and {len(names) - 4} more" if len(names) > 4 else ""
    of_case = len({unicodedata.normalize("NFKC", name) for name in names}) > 1
    of_form = len({name.casefold() for name in names}) > 1
    differences = " and ".join(["Unicode form"] * of_form + ["case"] * of_case)
    return (
        f"{what} {', '.join(listed)}{more} differ by {differences} alone and are taken"
        " as different, also by the scopes of parameters; write them alike if they are one"
    )


def _shown(name: str) -> str:
    """A name in quotes; escaped where its form does not tell it from another."""
    return repr(name) if unicodedata.normalize("NFC", name) == name else ascii(name)
