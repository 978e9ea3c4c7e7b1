"""Writes reference.md: every key of fit.toml and of a scene, every parameter. Run from the root.

    python docs/reference.py

Keys, types and defaults are those of the pydantic models, meanings the texts below their fields;
parameters are those that the package declares.
"""

import ast
import inspect
import math
import re
import textwrap
import types
from pathlib import Path
from typing import get_args

from pydantic import BaseModel

from jaxtrachea import config
from jaxtrachea.fitting.parameters import DECLARED
from jaxtrachea.relaxation.words import Word
from jaxtrachea.scene import spec, spec_parts
from jaxtrachea.scene.effects import EFFECTS
from jaxtrachea.trachea.material import OF_PRESS

PAGE = Path(__file__).with_name("reference.md")
HEAD = """# Reference

*For whoever writes a fit specification or a scene: every key, every parameter.*

Written by `docs/reference.py` from the models that read these files; do not edit. Both are TOML.
Lengths, forces and angles are texts with their unit (`"9 mm"`). A bare number is refused there, and
so is an unknown key. A default of *none* means that the key is left out.

- [Keys of a fit specification](#fit-top-level): `jaxtrachea init FILE` writes one,
  `jaxtrachea check SPEC` says what was understood. Only `data.files` is needed.
- [Keys of a scene](#scene-top-level): `jaxtrachea plan SCENE` says what was understood.
- [Parameters](#parameters): names, units, bounds and meanings.
"""
#: Headings of the tables, what stands above a table, and its model.
TABLES = (
    ("Fit: top level", "", config.FitSpec),
    ("Fit: [data]", "How files are read: [measurements.md](measurements.md).", config.DataSection),
    ("Fit: [trachea]", "Left out: 160 mm long, 15 rings 10 mm apart.", config.TracheaSection),
    ("Fit: trachea.rings", "", config.EvenRings),
    ("Fit: [model]", "Equations: [model.md](model.md).", config.ModelSection),
    (
        "Fit: [wall]",
        'With `skeleton = "sections"` only: what its parameters begin with, or keep where they are '
        "fixed, unless `[parameters]` says otherwise.",
        config.WallSection,
    ),
    (
        "Fit: [parameters.NAME]",
        "Numbers without a unit are in the parameter's unit. An empty table frees a parameter. The "
        "[parameters](#parameters) below say what holds for one that is not named.",
        config.ParameterSection,
    ),
    ("Fit: [noise]", "", config.NoiseSection),
    ("Fit: [fit]", "", config.FitSection),
    (
        "Fit: [uncertainty]",
        "What each does: [read_a_fit.md](read_a_fit.md#how-intervals-are-found).",
        config.UncertaintySection,
    ),
    ("Fit: [design]", "For `jaxtrachea design`.", config.DesignSection),
    ("Fit: [output]", "", config.FitOutputSection),
    (
        "Scene: top level",
        "`path` is needed, and `material`, or `sections` or `wall`.",
        spec.SceneSpec,
    ),
    (
        "Scene: [trachea]",
        "Left out: Table 1 of the paper. Of a file: [simulate.md](simulate.md#a-mesh-of-your-own).",
        spec_parts.SceneTracheaSection,
    ),
    (
        "Scene: [wall]",
        "The keys of [wall] of a fit, and:",
        spec_parts.SceneWallSection,
    ),
    (
        "Scene: [tool]",
        "A convex shape about its own origin, capsule and cylinder along z; or several parts.",
        spec_parts.ShapeSection,
    ),
    ("Scene: [tool], beside its shape", "", spec_parts.ToolSection),
    ("Scene: [[tool.parts]]", "The keys of a shape, and:", spec_parts.PartSection),
    (
        "Scene: [[path]]",
        "Presses (`s`, `displacement`), or motions of the tool (`start` and `end`, `positions`, or "
        "`file`). They do not mix.",
        spec_parts.PathSection,
    ),
    (
        "Scene: [relaxation]",
        "The numbers of its law, those of the skeleton where it relaxes apart (see "
        "[parameters](#parameters)), and:",
        spec_parts.RelaxationSection,
    ),
    ("Scene: [model]", "", spec.LawSection),
    ("Scene: [plan]", "", spec.PlanSection),
    ("Scene: [output]", "", spec.OutputSection),
    ("Scene: [sweep]", "", spec.SweepSection),
)
#: Words for the types of the models' fields, and the unit in which a default is held.
TYPES = {
    "PositiveLength": ("length", "mm"),
    "Length": ("length", "mm"),
    "Duration": ("time", "s"),
    "Stress": ("stress", "MPa"),
    "Bed": ("foundation stiffness", "N/mm^3"),
    "Angle": ("angle", "deg"),
    "Compliance": ("compliance, or table", ""),
    "ForceNoise": ("force, or word", ""),
    "ShareNoise": ("share, or word", ""),
    "LengthNoise": ("length, or word", ""),
    "Number": ("the parameter's", ""),
    "CountOrAuto": ("`auto`, or whole number", ""),
    "NumberOrTrue": ("the parameter's, or `true`", ""),
    "Rings": ("positions, or table", ""),
    "Direction": ("direction", ""),
    "Lengths3": ("three lengths", ""),
    "Sizes3": ("three lengths", ""),
    "Angles3": ("three angles", ""),
    "Word": (", ".join(f"`{word}`" for word in get_args(Word)), ""),
    "str": ("text", ""),
    "bool": ("true or false", ""),
    "int": ("whole number", ""),
    "float": ("number", ""),
    "list[str]": ("texts", ""),
    "Texts": ("texts", ""),
    "list[list[str]]": ("lists of texts", ""),
    "list[Direction]": ("points", ""),
    "dict[str, str]": ("table", ""),
    "list[Lengths3]": ("list of three lengths", ""),
    "tuple[Length, Length]": ("two lengths", ""),
    "tuple[PositiveLength, PositiveLength]": ("two lengths", ""),
    "tuple[Number, Number]": ("two numbers", ""),
    "tuple[Angle, ...]": ("angles", ""),
    "tuple[Speed, ...]": ("speeds", ""),
    "tuple[Duration, ...]": ("durations", ""),
    "dict[str, ParameterSection]": ("table of tables", ""),
    "list[PathSection]": ("tables", ""),
    "list[PartSection]": ("tables", ""),
    "Tools": ("table, or tables", ""),
}


def sources(module: types.ModuleType) -> dict[str, dict[str, tuple[ast.expr, str]]]:
    """Annotation and text below it, of each field of each class of a module."""
    found = {}
    for node in ast.parse(inspect.getsource(module)).body:
        if isinstance(node, ast.ClassDef):
            fields = found[node.name] = {}
            for field, below in zip(node.body, node.body[1:], strict=False):
                if (
                    isinstance(field, ast.AnnAssign)
                    and isinstance(field.target, ast.Name)
                    and isinstance(below, ast.Expr)
                    and isinstance(below.value, ast.Constant)
                ):
                    text = " ".join(str(below.value.value).split())
                    fields[field.target.id] = field.annotation, text
    return found


SOURCES = {module.__name__: sources(module) for module in (config, spec, spec_parts)}


def type_of(annotation: ast.expr) -> tuple[str, str]:
    """The words of a field's type, and the unit of its default.

    Raises:
        KeyError: a type without a word in `TYPES`.
    """
    if isinstance(annotation, ast.BinOp):  # X | None, or several
        ends = [type_of(side) for side in (annotation.left, annotation.right)]
        said = [end for end in ends if end[0]]
        return ", or ".join(dict.fromkeys(end[0] for end in said)), said[0][1]
    if isinstance(annotation, ast.Constant) and annotation.value is None:
        return "", ""
    if isinstance(annotation, ast.Subscript):
        head, inside = ast.unparse(annotation.value), annotation.slice
        if head == "Literal":
            values = inside.elts if isinstance(inside, ast.Tuple) else [inside]
            return ", ".join(f"`{ast.literal_eval(v)}`" for v in values), ""
        if head == "Annotated":
            assert isinstance(inside, ast.Tuple)
            if "dimensionless" in ast.unparse(annotation):
                return "share", ""
            return type_of(inside.elts[0])
    name = re.sub(r"Annotated\[(.*?), Field\([^)]*\)\]", r"\1", ast.unparse(annotation))
    return ("table", "") if name.endswith("Section") else TYPES[name]


def default_of(model: type[BaseModel], name: str, unit: str) -> str:
    """The default, as one writes it."""
    field = model.model_fields[name]
    if field.is_required():
        return "needed"
    value = field.default
    if field.default_factory is not None or isinstance(value, BaseModel) or value is None:
        return "none"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, str):
        return f'`"{value}"`'
    if isinstance(value, float) and unit:
        return f"`{math.degrees(value) if unit == 'deg' else value:g}` {unit}"
    return f"`{value:g}`" if isinstance(value, float) else f"`{value}`"


def table_of(model: type[BaseModel]) -> list[str]:
    """A row for each field that the model itself declares.

    Raises:
        KeyError: a field without a text.
    """
    rows = ["| key | type | default | meaning |", "|---|---|---|---|"]
    own = SOURCES[model.__module__][model.__name__]
    inherited = set(model.__mro__[1].model_fields)  # type: ignore[attr-defined]
    for name in model.model_fields:
        if name not in inherited:
            annotation, text = own[name]
            kind, unit = type_of(annotation)
            rows.append(f"| `{name}` | {kind} | {default_of(model, name, unit)} | {text} |")
    return rows


def effects() -> list[str]:
    """The keys of [effects] and their levels."""
    rows = ["| key | levels |", "|---|---|"]
    for effect in EFFECTS.values():
        levels = ", ".join(f"`{level}`" for level in effect.levels)
        rows.append(f"| `{effect.name}` | {levels} |")
    return rows


def parameters() -> list[str]:
    """A row for each parameter that the package declares."""
    rows = [
        "| name | unit | meaning | read with | if left out | an array: | fit: initial | bounds "
        "| scale | scope |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for p in DECLARED.values():
        fit = ["not fitted", "", "", ""]
        if p.fit is not None:
            notes = ["fixed"] * p.fit.fixed + ["if named"] * p.fit.if_named + ["auto"] * p.fit.auto
            fit = [
                ", ".join([f"{p.fit.value:g}", *notes[-1:]]),
                f"{p.fit.lower:g} … {p.fit.upper:g}",
                p.fit.scale,
                p.fit.scope,
            ]
        cells = [
            f"`{p.name}`",
            p.unit,
            p.description + (f" `{p.symbol}`" if p.symbol else ""),
            p.needs or "always",
            p.absent or ("0" if p.name in OF_PRESS else "needed"),
            f"each {p.varies_by}" if p.varies_by else "",
            *fit,
        ]
        rows.append("| " + " | ".join(cells) + " |")
    return rows


PARAMETERS = """
The names are those of `Material` (*sections*: of `SectionMaterial`) in Python, of
`[parameters.NAME]` in a fit and, but for the last three, of `[material]` (*sections*: of
`[sections]`) in a scene. Bare numbers in a fit are in the unit given here. Scenes want the unit,
and a positive value but for coefficients of the local law above `k_1`.

- *read with*: the option or effect without which a press does not read the value. `arch`: rings
  that bend; `second plane`: off the midline or oblique.
- *if left out* of a material: what then holds. In a fit the parameter is part of the model whenever
  the options read it, unless the table says *if named*: then only where the specification names it,
  `k_5 = {}`.
- *each span*, *each ring*: in Python an array may give each its own value.
- *fit*: first guess, bounds, scale and scope unless the specification says otherwise. *fixed*: the
  value, not fitted unless named. *auto*: the value, fitted to those curves whose own records show
  another ([fit.md](fit.md#what-a-record-shows)). The guesses are round numbers for a human-sized
  trachea; the paper gives none. A fit of sections begins with what `[wall]` gives.
"""


def document() -> str:
    """reference.md."""
    parts = [HEAD]
    for heading, intro, model in TABLES:
        above = [intro, ""] if intro else []
        parts.append("\n".join([f"## {heading}", "", *above, *table_of(model), ""]))
        if heading == "Scene: [model]":
            intro = "All are `auto` unless told: [simulate.md](simulate.md#which-effects-are-on)."
            parts.append("\n".join(["## Scene: [effects]", "", intro, "", *effects(), ""]))
    parts.append("\n".join(["## Parameters", textwrap.dedent(PARAMETERS), *parameters(), ""]))
    return "\n".join(parts)


if __name__ == "__main__":
    PAGE.write_text(document(), encoding="utf-8")
