"""Names of specimens and trials that a reader takes for the same, and a computer does not."""

import unicodedata
from collections.abc import Callable, Iterable

from jaxtrachea.measurements.curve import BadCurve, Curve

#: The minus sign, which is no dash to Unicode.
_MINUS = "\u2212"


def _plain_dashes(text: str) -> str:
    return "".join("-" if c == _MINUS or unicodedata.category(c) == "Pd" else c for c in text)


def _visible(text: str) -> str:
    return "".join(c for c in text if unicodedata.category(c) not in ("Cf", "Cc") or c.isspace())


def _compatible(text: str) -> str:
    # The parts of an accented letter first: what is invisible may stand between them.
    return unicodedata.normalize("NFKC", text)


def _no_spaces(text: str) -> str:
    return "".join(text.split())


#: In what names can differ without looking different, in the order in which it is taken away.
DIFFERENCES: dict[str, Callable[[str], str]] = {
    "dashes": _plain_dashes,
    "invisible characters": _visible,
    "spaces": _no_spaces,
    "Unicode form": _compatible,
    "case": str.casefold,
}


def appearance(name: str, without: str = "") -> str:
    """A name reduced to what a reader sees.

    Args:
        name: the name.
        without: a key of `DIFFERENCES` that is not taken away.

    Returns:
        The same text for names that differ by nothing else.
    """
    if not without and name.isascii() and name.isprintable():  # most names, ten times as fast
        return _no_spaces(name).casefold()
    for _ in range(2):  # what one step leaves may be work for another: full-width blanks, cases
        for difference, take_away in DIFFERENCES.items():
            if difference != without:
                name = take_away(name)
    return name


def look_alikes(curves: Iterable[Curve | BadCurve]) -> list[str]:
    """One line for each group of names that look alike: specimens, then trials of a specimen.

    The names stay different. The cost is linear in the number of curves.

    Args:
        curves: usable or not.

    Returns:
        Lines with the names, in what they differ, how many curves each has, and the cure.
    """
    specimens: dict[str, dict[str, list[str]]] = {}
    trials: dict[tuple[str, str], dict[str, list[str]]] = {}
    looks: dict[str, str] = {}
    for curve in curves:
        for name in (curve.specimen, curve.trial):
            if name not in looks:
                looks[name] = appearance(name)
        names = specimens.setdefault(looks[curve.specimen], {})
        names.setdefault(curve.specimen, []).append(curve.source)
        names = trials.setdefault((curve.specimen, looks[curve.trial]), {})
        names.setdefault(curve.trial, []).append(curve.source)
    lines = [_line("specimens", names) for names in specimens.values() if len(names) > 1]
    for (specimen, _), names in trials.items():
        if len(names) > 1:
            lines.append(_line(f"trials of specimen {_shown(specimen)}", names))
    return lines


def _line(what: str, names: dict[str, list[str]]) -> str:
    """What looks alike, and what to do."""
    listed = [
        f"{_shown(name)} ({len(sources)} curve{'s' * (len(sources) > 1)}, first {sources[0]})"
        for name, sources in list(names.items())[:4]
    ]
    more = f" and {len(names) - 4} more" if len(names) > 4 else ""
    return (
        f"{what} {', '.join(listed)}{more} differ by {_difference(list(names))} alone and are taken"
        " as different, also by the scopes of parameters; write them alike if they are one"
    )


def _difference(names: list[str]) -> str:
    """In what names that look alike differ."""
    needed = [d for d in DIFFERENCES if len({appearance(name, d) for name in names}) > 1]
    alone = (d for d, take in DIFFERENCES.items() if len(set(map(take, names))) == 1)
    return " and ".join(needed) or next(alone, "their characters")


def _shown(name: str) -> str:
    """A name in quotes; escaped where its characters do not tell it from another."""
    usual = unicodedata.normalize("NFC", name) == name and name.isprintable()
    dashes = any(unicodedata.category(c) == "Pd" or c == _MINUS for c in name.replace("-", ""))
    return repr(name) if usual and not dashes else ascii(name)
