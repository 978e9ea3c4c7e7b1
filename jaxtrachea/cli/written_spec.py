"""The text of a specification that `jaxtrachea init` writes: what was read, and the defaults."""

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxtrachea import __version__
from jaxtrachea.cli.sources import Sources

#: Keys of [model] that are shown, with their choices.
_MODEL = {
    "shear": "true: the ligament also deforms in shear",
    "local": '"two-material": rings have a local law of their own',
    "half_width": "of a flat tool along the tube: pi/4 of its radius; 0: a point",
    "skeleton": '"softening": presses deeper than a tenth of the radius; "sections": off the '
    "midline",
    "relaxation": '"uniform" (or "parts"): the force relaxes; needs loading = "record"',
    "contact": '"bonded": press or draw',
    "coupling": '"total": a sample without a tube under it, which needs no s',
}
_FIT = {
    "starts": "per specimen",
    "loss": '"huber", "soft_l1", "cauchy": outliers count less',
    "population": "mean and spread over specimens; left out: with five or more",
}


def specification_text(sources: Sources, out: Path, blocked: Mapping[str, str]) -> str:
    """The specification as TOML.

    Every line that begins with ``# key =`` holds the default: without its mark nothing changes.

    Args:
        sources: the files as read.
        out: where the specification will stand; its paths start from there.
        blocked: why it cannot be fitted as it is, by the section that the cure goes into.
    """
    lines = [
        f"# Written by jaxtrachea {__version__}. Lines that begin with # are not read; those of",
        "# the form '# key = value' show the default. All keys: docs/reference.md",
        f"title = {_quoted(_title(sources))}",
        "",
        *_data(sources, out, blocked.get("data")),
        "",
        *_trachea(blocked.get("trachea")),
        "",
        "[model]",
        *_marked(blocked.get("model")),
        *_defaults("ModelSection", _MODEL),
        "",
        "[parameters]",
        *_marked(blocked.get("parameters")),
        *_parameters(any(c.joint_displacement is not None for c in sources.measurements.curves)),
        "",
        "[noise]",
        *_marked(blocked.get("noise")),
        '# force = "estimate"        # or a standard deviation, as "0.01 N"',
        "",
        "[fit]",
        *_defaults("FitSection", _FIT),
    ]
    return "\n".join(lines) + "\n"


def paths_of(sources: Sources, folder: Path) -> list[str]:
    """Paths and patterns that name the files, from a folder on.

    A folder that was given becomes a pattern, if it finds the same files.
    """
    names: dict[str, None] = {}
    for given in sources.given:
        inside = [p for p in sources.files if given.is_dir() and p.parent == given]
        endings = dict.fromkeys("".join(p.suffixes[-2:] if p.suffix == ".gz" else [p.suffix])
                                for p in inside)  # fmt: skip
        for ending in endings:
            alike = [p for p in inside if p.name.endswith(ending)]
            found = sorted(p for p in given.glob(f"*{ending}") if p.is_file())
            if found == alike and not set("[]*?") & set(str(given)):
                names[_relative(given / f"*{ending}", folder)] = None
            else:
                names.update(dict.fromkeys(_relative(p, folder) for p in alike))
        if not inside:
            names[_relative(given, folder)] = None
    return list(names)


def _title(sources: Sources) -> str:
    """The name of the only argument, else of the folder of the first."""
    first = sources.given[0].absolute()
    alone = first.name if first.is_dir() else first.name.split(".")[0]
    return alone if len(sources.given) == 1 else first.parent.name


def _relative(path: Path, folder: Path) -> str:
    """The path from a folder on, with slashes; absolute where they share no more than the root."""
    path, folder = path.parent.resolve() / path.name, folder.resolve()
    if path.parts[:2] != folder.parts[:2]:
        return path.as_posix()
    return Path(os.path.relpath(path, folder)).as_posix()


def _data(sources: Sources, out: Path, blocked: str | None) -> Iterator[str]:
    names = paths_of(sources, out.parent)
    curves = sources.measurements.curves
    yield "[data]"
    if len(names) == 1:
        yield f"files = {_quoted(names[0])}"
    else:
        yield "files = ["
        yield from (f"    {_quoted(name)}," for name in names)
        yield "]"
    yield f"# {summary(curves)}"
    yield from (f"# {line}" for line in columns_read(sources))
    for key, value in sources.keys.items():
        guessed = key == "columns" and bool(sources.guessed)
        turned = key.endswith("_sign") and f"{key[:-5]}" in sources.turned
        yield f"{key} = {_value(value)}" + (
            f"   # guessed by the unit: {', '.join(sorted(sources.guessed))}" if guessed else
            "   # the file counts a press negative" if turned else ""
        )  # fmt: skip
    if blocked is not None:
        yield from _marked(blocked)
        yield '# s = "40 mm"'
    yield '# loading = "last"          # the last full loading; or "first", "all"'
    if any(c.time is not None for c in curves):
        yield '# e.g. loading = "record": all of it by its time, for a force that relaxes ([model])'
        yield "# e.g. samples = 400: about so many samples of such a record, by means of blocks"
    yield '# e.g. displacement_max = "6 mm": samples beyond are left out'
    if any(c.joint_displacement is not None for c in curves):
        yield '# e.g. tool_radius = "3 mm": markers nearer to the contact move with the tool'


def summary(curves: Sequence[Any]) -> str:
    """How many curves of how many specimens, and where they were pressed."""
    numbers = (len(curves), "curve"), (len({c.specimen for c in curves}), "specimen")
    counted = " of ".join(f"{n} {word}{'s' * (n != 1)}" for n, word in numbers)
    return f"{counted}, {span_of_s(curves)}"


def span_of_s(curves: Sequence[Any]) -> str:
    """Where the curves were pressed, in words."""
    known = sorted({c.s_c for c in curves if c.s_c is not None})
    if not known:
        return "no position s"
    without = sum(c.s_c is None for c in curves)
    places = f"s = {known[0]:g} mm" if len(known) == 1 else (
        f"{len(known)} positions s from {known[0]:g} to {known[-1]:g} mm"
    )  # fmt: skip
    return f"{places}{f', {without} curves without' if without else ''}"


def columns_read(sources: Sources) -> Iterator[str]:
    """What the columns of the first file are read as, and which are not, a line each."""
    head = next((h for h in sources.heads.values() if h.columns), None)
    if head is None:
        return
    read = [c for c in head.columns if c.role and not c.role.startswith(("joint", "end"))]
    rings = sum(c.role.startswith(("joint", "end")) for c in head.columns)
    shown = [f"{c.role} from {_plain(repr(c.name))}{f' [{_plain(c.unit)}]' if c.unit else ''}"
             for c in read]  # fmt: skip
    shown += [f"{rings} columns of markers or ring ends"] if rings else []
    yield f"read: {', '.join(shown)}"
    unused = [_plain(repr(c.name)) for c in head.columns if not c.role]
    if unused:
        more = f" and {len(unused) - 10} more" if len(unused) > 10 else ""
        yield f"not read: {', '.join(unused[:10])}{more}"


def _trachea(blocked: str | None) -> Iterator[str]:
    from jaxtrachea.config import TracheaSection
    from jaxtrachea.trachea.section import geometry_of

    tube = geometry_of(TracheaSection())
    rings = np.asarray(tube.ring_positions, float)
    yield "# The tube: left out, it is that of Table 1 of the paper, as it stands here. Of another"
    yield "# tube remove the # of these lines and write its own sizes."
    yield from _marked(blocked)
    yield "# [trachea]"
    yield f"# length = {_length(tube.length)}"
    yield (
        f"# rings = {{ count = {rings.size}, first = {_length(rings[0])}, "
        f"last = {_length(rings[-1])} }}   # or a list of positions"
    )
    yield f"# radius = {_length(tube.radius)}          # of the ring line"


def _length(value: Any) -> str:
    return f'"{float(value):.6g} mm"'


def _parameters(markers: bool) -> Iterator[str]:
    """A line of each parameter that the default model sees."""
    from jaxtrachea.fitting.parameters import DEFAULTS, OF_THE_PRESS, in_model
    from jaxtrachea.mechanics.press import Options

    yield "# Free, from these first guesses; { fixed = 0.0 } holds one. A scope is specimen, trial"
    yield "# or shared (one value for all)."
    for name in in_model(Options(), joints=markers):
        if name in OF_THE_PRESS:
            continue
        p = DEFAULTS[name]
        bounds = f"[{float(p.lower)!r}, {float(p.upper)!r}]"
        yield (
            f"# {name} = {{ initial = {float(p.value)!r}, bounds = {bounds}, "
            f'scale = "{p.scale}", scope = "{p.scope}" }}   # {p.unit}: {p.description}'
        )


def _defaults(section: str, shown: Mapping[str, str]) -> Iterator[str]:
    """Keys of a section with their defaults."""
    from jaxtrachea import config

    fields = getattr(config, section).model_fields
    for key, meaning in shown.items():
        default = fields[key].default
        if default is None:
            yield f"# e.g. {key} = true: {meaning}"
            continue
        value = f'"{default:g} mm"' if isinstance(default, float) else _value(default)
        yield f"# {key} = {value}".ljust(28) + f"# {meaning}"


def _marked(blocked: str | None) -> list[str]:
    """The lines that nobody overlooks."""
    return [] if blocked is None else [f"# MISSING: {_plain(blocked)}"]


def _value(value: Any) -> str:
    """A value as TOML."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{k} = {_quoted(v)}" for k, v in value.items()) + " }"
    return _quoted(value) if isinstance(value, str) else repr(value)


def _quoted(text: str) -> str:
    """A basic string of TOML, which escapes what JSON does, and DEL."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _plain(text: str) -> str:
    """Text for a comment: on one line, without control characters."""
    return "".join(c if c.isprintable() else " " for c in text)
