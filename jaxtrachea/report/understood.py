"""What a specification was understood to say: tube, model and rule of the onset, a line each."""

from collections.abc import Sequence

import numpy as np

from jaxtrachea.config import FitSpec
from jaxtrachea.fitting.parameters import Parameter
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.study import Study
from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.levels.choose import level_of
from jaxtrachea.mechanics.levels.options import Options
from jaxtrachea.mechanics.sections.material import TOOL_RADIUS, Wall, furthest_proportion
from jaxtrachea.trachea.geometry import Geometry

#: Share of the tube's length that measured positions leave free at an end, from which a tube that
#: nobody gave is doubtful.
FREE_END = 0.3
#: Positions that are so far from a grid, as a share of its pitch, are on it.
_ON_GRID = 0.05
#: Share of the curves whose markers must move most elsewhere than under the tool.
_MOST = 0.5
_CURE = "give [trachea] length and rings, or preset = 'table-1' if this is the tube"


def understood(spec: FitSpec, study: Study, result: FitResult | None = None) -> list[str]:
    """The lines that `check`, the terminal and the report show."""
    missed = 0 if result is None or not study.free else int(result.effective.misses.sum())
    options = study.model.options
    curves = [c for lane in study.curves for c in lane]
    return [
        tube_line(spec, study.model.geometry, options, curves, missed),
        f"Model: {model_words(options)}",
        f"Onset: {onset_words(study.parameters)}",
        *foreign_factors(spec, study),
    ]


def foreign_factors(spec: FitSpec, study: Study) -> list[str]:
    """That values are fixed at what the factors of another tube give: a line, or none."""
    taken = [p.name for p in study.parameters if p.foreign]
    if not taken:
        return []
    geometry = study.model.geometry
    wall = Wall() if spec.wall is None else Wall(**spec.wall.model_dump())
    tool_radius = spec.data.tool_radius or TOOL_RADIUS
    why = furthest_proportion(geometry, wall, tool_radius)
    why = why or "they were found with a tool that touches at a point"
    whose = "[wall]" if spec.wall is not None else "the wall of the virtual specimen (no [wall])"
    return [
        f"Warning: {', '.join(taken)} stay fixed at what {whose} and the factors of another "
        f"specimen give ({why}): presses unlike those fitted may be up to 30 % off; free them, or "
        "fix numbers of this tube"
    ]


def tube_line(
    spec: FitSpec,
    geometry: Geometry,
    options: Options,
    curves: Sequence[Curve],
    missed: int = 0,
) -> str:
    """The tube, and what contradicts it, where a warning stands first."""
    if options.coupling == "total":
        return "Tube: none, the local law takes all (coupling = 'total')"
    x = np.asarray(geometry.ring_positions, float)
    rings = f"{x.size} rings from {x[0]:g} to {x[-1]:g} mm" if x.size > 1 else f"a ring at {x[0]:g}"
    size = f"{float(geometry.length):g} mm long, {rings}, radius {float(geometry.radius):g} mm"
    if spec.trachea.preset is not None:
        source = "Table 1, as preset says"
    elif spec.trachea.length is not None:
        source = "as [trachea] says"
    elif "trachea" in spec.model_fields_set:
        source = "length and rings of Table 1, since [trachea] gives none"
    else:
        source = "Table 1, since [trachea] is left out"
    doubts = markers_elsewhere(geometry, curves)
    if "since" in source:
        doubts = [*positions_elsewhere(geometry, curves), *doubts]
        if missed and not doubts:
            doubts = [f"the model misses {missed} specimens: {_CURE}"]
    line = f"Tube: {size} ({source})"
    if not doubts:
        return line
    return f"Warning: {line[0].lower()}{line[1:]}; {'; '.join(doubts)}"


def positions_elsewhere(geometry: Geometry, curves: Sequence[Curve]) -> list[str]:
    """That positions lie in a part of a tube that nobody gave, or are spaced otherwise."""
    s = np.unique(np.round([c.s_c for c in curves if c.s_c is not None], 2))
    x, length = np.asarray(geometry.ring_positions, float), float(geometry.length)
    if not s.size:
        return []
    found = []
    if s[-1] < (1 - FREE_END) * length or s[0] > FREE_END * length:
        where = f"in {s[0]:g} to {s[-1]:g} mm" if s.size > 1 else f"at {s[0]:g} mm"
        found.append(f"all positions lie {where} of these {length:g} mm")
    pitch = float(np.diff(s).min(initial=np.inf))
    steps, usual = np.diff(s) / pitch, float(np.median(np.diff(x))) if x.size > 1 else np.inf
    on_grid = s.size > 2 and np.all(np.abs(steps - np.round(steps)) < _ON_GRID)
    halves = 2 * pitch / usual
    near = 0.25 * usual < pitch < 2 * usual  # wider steps are chosen for the length of the tube
    if on_grid and near and abs(halves - round(halves)) > _ON_GRID:
        found.append(f"positions are {pitch:.4g} mm apart, its rings {usual:.4g} mm")
    if found:
        found[-1] += f": {_CURE}"
    return found


def markers_elsewhere(geometry: Geometry, curves: Sequence[Curve]) -> list[str]:
    """That markers move most on rings which do not lie at the tool."""
    x = np.asarray(geometry.ring_positions, float)
    spacing = float(np.median(np.diff(x))) if x.size > 1 else np.inf
    looked, away = 0, []
    for c in curves:
        if c.s_c is None or c.joint_rings is None or c.joint_displacement is None:
            continue
        moved = np.abs(c.joint_displacement[int(np.argmax(np.abs(c.displacement)))])
        seen = np.isfinite(moved)
        at = x[np.asarray(c.joint_rings)[seen]]
        if at.size < 3 or not at.min() <= c.s_c <= at.max():
            continue
        looked += 1
        most = int(np.argmax(moved[seen]))
        off = float(np.abs(at - c.s_c)[most])
        if off > 1.5 * spacing and np.sum(np.abs(at - c.s_c) < off) > 2:
            away.append((off, int(np.asarray(c.joint_rings)[seen][most]) + 1, float(at[most]), c))
    if not away or len(away) <= _MOST * looked:
        return []
    _, ring, place, c = max(away, key=lambda found: found[0])
    return [
        f"in {len(away)} of {looked} curves markers move most away from the tool ({c.specimen} "
        f"{c.trial}: ring {ring} at {place:g} mm, pressed at {c.s_c:g} mm): correct the numbers of "
        "the rings, or [trachea]"
    ]


def model_words(options: Options) -> str:
    """Skeleton, shear, local law, coupling and tool in words."""
    if options.coupling == "total":
        parts = ["no skeleton (coupling = 'total')"]
    else:
        parts = [f"skeleton {options.skeleton}"]
        parts += level_of(options).parts
        parts.append("indentation and skeleton in series")
    parts.append("local law two-material" if options.local == "two-material" else
                 "one local law everywhere")  # fmt: skip
    width = f"a punch of half width {options.half_width:g} mm" if options.half_width > 0 else (
        "a tool that touches at a point"
    )  # fmt: skip
    hold = "and only pushes" if options.contact == "unilateral" else "bonded to the wall"
    return ", ".join([*parts, f"{width}, {hold}" if options.half_width else f"{width} {hold}"])


def onset_words(parameters: Sequence[Parameter]) -> str:
    """How first touch and the zero of the force are found, by the table of parameters."""
    onset, offset = (
        next(p for p in parameters if p.name == name) for name in ("onset", "force_offset")
    )
    rules = _rule(onset), _rule(offset)
    text = f"{rules[0]}; force offset: {rules[1]}"
    if rules[0].startswith("fixed") and onset.value == 0:
        text += " (records are taken to begin at first touch)"
    return text


def _rule(p: Parameter) -> str:
    """``auto``, ``fixed at 0 mm`` or ``fitted, one a trial``."""
    if getattr(p, "auto", False):
        return "auto (each curve by its own record)"
    if p.fixed:
        return f"fixed at {p.value:g} {p.unit}"
    scopes = {"trial": "one a trial", "specimen": "one a specimen", "shared": "one for all"}
    return f"fitted, {scopes[p.scope]}"
