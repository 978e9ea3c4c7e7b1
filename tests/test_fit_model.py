"""The model of a fit apart from its data: compared by value, one program for equal models."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import synthetic

from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.model import FitModel
from jaxtrachea.mechanics.press import Options
from jaxtrachea.trachea.geometry import Geometry

FORCE = np.broadcast_to(synthetic.DEPTHS, (2, 3, len(synthetic.DEPTHS)))


def test_equal_models_are_equal_and_hash_alike():
    """Other data, values and bounds make no other model."""
    one = synthetic.study(FORCE).model
    changes = {"k_1": {"value": 3.0, "upper": 50.0}}
    other = synthetic.study(2 * FORCE[:1], changes=changes).model
    assert one == other
    assert hash(one) == hash(other)
    assert {one: "program"}[other] == "program"


@pytest.mark.parametrize(
    "change",
    [
        {"loss": "huber"},
        {"loss_scale": 2.0},
        {"common": "beam"},
        {"options": Options(shear=True)},
        {"columns": ()},
        {"tube": (161.0, (10.0, 20.0), 11.3, 2.0, 4.0)},
    ],
)
def test_any_field_makes_another_model(change):
    model = synthetic.study(FORCE).model
    assert dataclasses.replace(model, **change) != model


def test_geometry_goes_in_and_comes_out_as_numbers():
    """The arrays of a float32 tube come back as float64 with the same values."""
    tube = Geometry.create(100.0, [20.0, 40.5, 80.0], half_angle=2.0, dtype=jnp.float32)
    study = build_study(synthetic.curves(FORCE, s_c=(10.0, 30.0, 50.0)), tube)
    again = study.model.geometry
    for field in dataclasses.fields(Geometry):
        value = getattr(again, field.name)
        assert isinstance(value, np.ndarray)
        assert value.dtype == np.float64
        np.testing.assert_array_equal(value, np.asarray(getattr(tube, field.name), np.float64))
    assert all(isinstance(v, float | tuple) for v in study.model.tube)


HELD = {"fixed": True, "value": 1.0}


def test_parameters_by_default_and_by_what_differs():
    """A table left out is that of the options; changes to single parameters keep the others."""
    curves = synthetic.curves(FORCE)
    plain = build_study(curves, synthetic.GEOMETRY)
    assert [p.name for p in plain.free] == ["EI_L", "k_M", "k_1", "k_3"]
    fixed = build_study(
        curves, synthetic.GEOMETRY, parameters={"k_M": HELD, "onset": {"fixed": True}}
    )
    assert [p.name for p in fixed.free] == ["EI_L", "k_1", "k_3"]
    says = r"parameters\.k_M: fixed: true would hold the first guess, 0.1 N/mm; expected a value"
    with pytest.raises(ValueError, match=says):
        build_study(curves, synthetic.GEOMETRY, parameters={"k_M": {"fixed": True}})
    rings = build_study(curves, synthetic.GEOMETRY, Options(local="two-material", shear=True))
    assert [p.name for p in rings.free] == ["EI_L", "GA_L", "k_M", "k_1", "k_3", "k_1_ring"]
    with pytest.raises(ValueError, match=r"parameters\.k_1_ring: not part of this model"):
        build_study(curves, synthetic.GEOMETRY, parameters={"k_1_ring": {"value": 2.0}})
    with pytest.raises(ValueError, match=r"parameters\.k_1: 'valeu'.*expected"):
        build_study(curves, synthetic.GEOMETRY, parameters={"k_1": {"valeu": 2.0}})


def test_a_model_and_another_table_are_refused():
    study = synthetic.study(FORCE)
    assert isinstance(study.model, FitModel)
    fixed = tuple(dataclasses.replace(p, fixed=True) for p in study.parameters)
    with pytest.raises(ValueError, match="replace both together"):
        dataclasses.replace(study, parameters=fixed)
