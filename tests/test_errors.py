"""Errors of input are fields: their text follows from them, and they pass between rooms whole."""

import pickle

import numpy as np
import pytest

from jaxtrachea import Geometry
from jaxtrachea._errors import InputError
from jaxtrachea.config import SpecError, TracheaSection
from jaxtrachea.measurements.curve import DataError
from jaxtrachea.scene.declare import PlanError, SceneFacts
from jaxtrachea.scene.effects import EffectOptions
from jaxtrachea.scene.rules import make_plan
from jaxtrachea.scene.sizes import check_sizes
from jaxtrachea.trachea.mesh import MeshError
from jaxtrachea.trachea.section import geometry_of
from jaxtrachea.trachea.sizes import SizeError


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (InputError("it is wrong"), "it is wrong"),
        (
            InputError("is 3", key="length", expected="more", joint=" "),
            "length is 3; expected more",
        ),
        (
            InputError("3", place="a.toml", key="k", expected="4", cure="write 4"),
            "a.toml: k: 3; expected 4; write 4",
        ),
        (InputError("is it {a}?", cure="give {}", arguments=("b=",)), "is it {a}? Give b="),
        (InputError("is it?"), "is it?"),
        (InputError("a; b", cure="c {}"), "a; b; c {}"),
    ],
)
def test_text(error, text):
    assert str(error) == text
    assert str(pickle.loads(pickle.dumps(error))) == text


def test_another_kind_keeps_the_fields():
    error = PlanError("axial", "'on'", "EA_L is not given", "give it")
    other = SpecError.like(error, key=f"effects.{error.key}")
    assert type(other) is SpecError
    assert str(other) == "effects.axial: 'on', but EA_L is not given; give it"
    assert (error.key, error.why) == ("axial", "EA_L is not given")
    again = pickle.loads(pickle.dumps(error))
    assert (type(again), str(again), again.why) == (PlanError, str(error), error.why)


def test_arguments_are_renamed_and_nothing_else():
    """A file that is named like an argument stays what it is."""
    error = MeshError("no rings in rings=.stl", cure="give {}", arguments=("rings=",))
    named = error.renamed({"rings=": "cartilage="})
    assert str(named) == "no rings in rings=.stl; give cartilage="
    assert str(error).endswith("give rings=")


def test_what_was_refused_is_in_the_fields():
    with pytest.raises(InputError) as caught:
        Geometry.create(10.0, [5.0, 4.0])
    assert caught.value.key == "ring_positions"
    with pytest.raises(SpecError) as caught:
        geometry_of(TracheaSection.model_construct(length=10.0, rings=[5.0, 20.0]))
    assert caught.value.key == "trachea.rings"
    assert str(caught.value) == (
        "trachea.rings run from 5 to 20 mm; expected all inside (0, 10) mm"
    )
    with pytest.raises(SizeError) as caught:
        check_sizes(Geometry.create(5000.0, np.array([40.0])), 11.3, None)
    assert (caught.value.key, caught.value.found) == ("geometry.length", "is 5000 mm")
    with pytest.raises(PlanError) as caught:
        make_plan(SceneFacts(), EffectOptions(axial="on"))
    assert (caught.value.key, caught.value.why) == ("axial", "EA_L is not given")


def test_a_semicolon_in_a_message_does_not_move_its_cure():
    error = DataError("row 'a; b' is no number", place="x.csv", cure="correct it")
    assert (error.problem, error.remedy) == ("row 'a; b' is no number", "correct it")


def test_an_error_shows_its_text_wherever_it_goes():
    """`args` and `repr` as of any exception, also after pickling and renaming."""
    error = InputError("is 3", place="a.toml", key="fit.k", expected="2", cure="write 2")
    text = "a.toml: fit.k: is 3; expected 2; write 2"
    for shown in (error, pickle.loads(pickle.dumps(error)), error.like(error)):
        assert shown.args == (text,)
        assert repr(shown) == f"InputError({text!r})"
    assert "fit.m" in error.renamed({"fit.k": "fit.m"}).args[0]
