"""Words and numbers of records: a misspelt or impossible one is refused wherever it is given."""

import ast
import dataclasses
import importlib
import inspect
import math
import pathlib
import typing

import numpy as np
import pytest
from admitted import BEAM, FULL

import jaxtrachea
from jaxtrachea.fitting.descent import Descent
from jaxtrachea.fitting.lane import Lane
from jaxtrachea.fitting.lanes import Noise, Weighting
from jaxtrachea.fitting.parameters import DEFAULTS, Parameter
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.mechanics.oblique import ObliqueOptions
from jaxtrachea.mechanics.press import Options
from jaxtrachea.optimisation.trust_region import Tolerances
from jaxtrachea.scene.effects import EffectOptions
from jaxtrachea.trachea.geometry import table_1
from jaxtrachea.trachea.material import Material

pytestmark = pytest.mark.compiling

PACKAGE = pathlib.Path(jaxtrachea.__file__).parent


def bare(kind, start=None, **changes):
    """Make a record as users do, who have no checker of annotations in front of it."""
    record, kinds = object.__new__(kind), typing.get_type_hints(kind)
    for field in dataclasses.fields(kind):
        value = getattr(start, field.name, None if start else field.default)
        if value is dataclasses.MISSING and dataclasses.is_dataclass(inner := kinds[field.name]):
            value = object.__new__(inner)
        object.__setattr__(record, field.name, changes.get(field.name, value))
    if not start and kind is Parameter:
        return bare(kind, DEFAULTS["k_1"], **changes)
    if hasattr(record, "effects"):  # a `Plan`
        for field, word in (
            ("contact_point", "fixed"),
            ("rings", "mat"),
            ("dent", 0),
            ("surface", None),
            ("options", Options()),
        ):
            object.__setattr__(record, field, changes.get(field, word))
        for field in ("contact", "curved", "friction", "second_plane", "axial", "end_motion",
                      "joints", "ring_ends"):  # fmt: skip
            object.__setattr__(record, field, False)
    record.__post_init__()
    return record


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"split": "indep"}, "split is 'indep'; expected 'continuous' or 'independent'"),
        ({"form": "x"}, "form is 'x'; expected 'recursion' or 'reactions'"),
        ({"contact": "bond"}, "contact is 'bond'; expected 'unilateral' or 'bonded'"),
        ({"coupling": "serie"}, "coupling is 'serie'; expected 'series' or 'total'"),
        ({"local": "two"}, "local is 'two'; expected 'uniform' or 'two-material'"),
        ({"shear": "off"}, "shear is 'off'; expected True or False"),
        ({"onset_width": -1}, "onset_width is -1; expected a finite number, 0 or more"),
        ({"onset_width": math.nan}, "onset_width is nan; expected a finite number, 0 or more"),
        ({"transition": 0.0}, "transition is 0 mm; expected more than 0, or None"),
    ],
)
def test_options(change, says):
    with pytest.raises(ValueError, match=f"^{says}"):
        bare(Options, **change)
    assert bare(Options, transition=np.float64(2), onset_width=0, shear=True)


def test_other_records():
    """Numbers and words of every other record that is made by hand."""
    for kind, change in (
        (Settings, {"method": "lm"}),
        (Settings, {"starts": 0}),
        (Settings, {"starts": 1.5}),
        (Settings, {"decades": math.nan}),
        (Settings, {"tolerances": Tolerances(iterations=0)}),
        (Settings, {"tolerances": Tolerances(cost=-1.0)}),
        (Noise, {"force": 0.0}),
        (Noise, {"joints": math.inf}),
        (Weighting, {"balance": "curves"}),
        (Weighting, {"loss": "square"}),
        (Weighting, {"loss_scale": 0.0}),
        (Weighting, {"loss_scale": math.inf}),
        (ObliqueOptions, {"axial": "on"}),
        (Descent, {"method": "sgd"}),
        (Descent, {"learning_rate": math.nan}),
        (EffectOptions, {"contact_point": "every"}),
        (EffectOptions, {"onset_width": -1.0}),
        (EffectOptions, {"want_joints": "no"}),
        (Parameter, {"scale": "ln"}),
        (Parameter, {"scope": "specimens"}),
        (Parameter, {"step": 0.0}),
    ):
        with pytest.raises(ValueError, match="expected"):
            bare(kind, **change)
        bare(kind)


def has_words(hint):
    """Whether a `Literal` stands anywhere in a hint."""
    if typing.get_origin(hint) is typing.Literal:
        return any(isinstance(word, str) for word in typing.get_args(hint))
    return any(map(has_words, typing.get_args(hint)))


#: Imported by some modules for their annotations only.
FOR_TYPES = {"Lane": Lane}


def takes_words():
    """Public functions of the package with an argument that is a `Literal`."""
    for path in sorted(PACKAGE.rglob("*.py")):
        name = ".".join(["jaxtrachea", *path.relative_to(PACKAGE).with_suffix("").parts])
        if "__" in name or "cli" in name:
            continue
        functions = [n for n in ast.parse(path.read_text()).body if isinstance(n, ast.FunctionDef)]
        for node in functions:
            if not node.name.startswith("_"):
                function = inspect.unwrap(getattr(importlib.import_module(name), node.name))
                for argument, hint in typing.get_type_hints(function, localns=FOR_TYPES).items():
                    if argument != "return" and has_words(hint):
                        yield f"{name.removeprefix('jaxtrachea.')}.{node.name}", argument


def any_words(function, argument):
    """Call a function with a word that there is not; all else is never looked at."""
    signature = inspect.signature(function)
    filled = {
        n: None if p.default is p.empty else p.default for n, p in signature.parameters.items()
    }
    known = {"geometry": table_1(), "material": Material(**FULL), "s_c": 40.0, "phi_c": 0.0,
             "displacement": np.zeros((1, 3)), "force": 1.0, "count": 100,
             "block": 1, "options": Options(), "beam": BEAM}  # fmt: skip
    filled |= {n: v for n, v in known.items() if n in filled}
    return function(**filled | {argument: "no such word"})


#: Called by what checks the word, with its own word; never from outside.
INNER = {
    "mechanics.compliance.divide_load", "mechanics.reactions.deflect_dense",
    "mechanics.beam.deflect_on",
    "mechanics.skeleton.respond", "mechanics.skeleton.read_values",
    "mechanics.energy.gradient", "mechanics.skeleton.turned_rings", "fitting.noise.normal_psi2",
    "scene.lines.interpolate",
}  # fmt: skip


def test_no_function_runs_a_misspelt_word():
    """Any argument of any public function that is one of several words."""
    seen = set()
    for name, argument in takes_words():
        module, _, function = f"jaxtrachea.{name}".rpartition(".")
        seen.add(name)
        if name in INNER:
            continue
        real = inspect.unwrap(getattr(importlib.import_module(module), function))
        with pytest.raises(ValueError, match="'no such word'.*expected"):
            any_words(real, argument)
    assert seen >= INNER | {
        "mechanics.beam.deflect",
        "mechanics.skeleton.skeleton_response",
    }


def test_no_record_keeps_a_misspelt_word():
    """Any field of any dataclass that is one of several words (specifications: pydantic)."""
    seen = set()
    for path in sorted(PACKAGE.rglob("*.py")):
        name = ".".join(["jaxtrachea", *path.relative_to(PACKAGE).with_suffix("").parts])
        if "__" in name or "cli" in name:
            continue
        for node in ast.parse(path.read_text()).body:
            kind = isinstance(node, ast.ClassDef) and getattr(
                importlib.import_module(name), node.name
            )
            if not (kind and dataclasses.is_dataclass(kind)) or node.name in RESULTS:
                continue
            for field, hint in typing.get_type_hints(kind).items():
                if has_words(hint):
                    seen.add(node.name)
                    with pytest.raises(ValueError, match="'no such word'; expected"):
                        bare(kind, **{field: "no such word"})
    assert seen >= {
        "Options", "EffectOptions", "Plan", "Settings", "Parameter", "Levels", "Weighting",
        "Descent", "ObliqueOptions",
    }  # fmt: skip


#: Made by the package out of words that were checked.
RESULTS = {"Instrument", "Bootstrap", "Request", "Study", "Situation", "Choice", "Ladder"}
