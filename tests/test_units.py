"""Units: published conversion factors, refusals that say what is accepted, round trips."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxtrachea.units import (
    ACCEPTED,
    DIMENSIONS,
    UnitError,
    column_unit,
    convert,
    is_unit,
    parse_quantity,
    unit_factor,
)

# Exact by definition: SI prefixes; inch, pound-force, standard gravity (NIST SP 811, appendix B).
FACTORS = [
    ("length", "m", 1000.0),
    ("length", "um", 1e-3),
    ("length", "µm", 1e-3),
    ("length", "μm", 1e-3),
    ("length", "in", 25.4),
    ("area", "cm^2", 100.0),
    ("area", "cm²", 100.0),
    ("force", "mN", 1e-3),
    ("force", "nN", 1e-9),
    ("force", "kgf", 9.80665),
    ("force", "lbf", 4.4482216152605),
    ("moment", "N m", 1000.0),
    ("moment", "N·mm", 1.0),
    ("angle", "deg", math.pi / 180),
    ("angle", "°", math.pi / 180),
    ("time", "min", 60.0),
    ("velocity", "mm/min", 1 / 60),
    ("frequency", "Hz", 1.0),
    ("frequency", "1/s", 1.0),
    ("mass", "kg", 1e-3),
    ("density", "kg/m^3", 1e-12),
    ("stress", "kPa", 1e-3),
    ("stress", "N/mm2", 1.0),
    ("stress", "psi", 6.894757293168361e-3),
    ("stress", "cmH2O", 9.80665e-5),
    ("stress", "mmHg", 1.33322387415e-4),
    ("stiffness", "N/m", 1e-3),
    ("stiffness", "nN/um", 1e-6),
    ("cubic_stiffness", "N/m^3", 1e-9),
    ("cubic_stiffness", "N mm⁻³", 1.0),
    ("rotational_stiffness", "N m/rad", 1000.0),
    ("bending_stiffness", "MPa mm^4", 1.0),
    ("damping", "N s/m", 1e-3),
    ("dimensionless", "%", 0.01),
]


@pytest.mark.parametrize(("dimension", "unit", "factor"), FACTORS)
def test_factor(dimension, unit, factor):
    assert convert(1.0, unit, dimension) == pytest.approx(factor, rel=4e-16)


@pytest.mark.parametrize("dimension", DIMENSIONS)
def test_what_messages_propose_is_accepted(dimension):
    for unit in ACCEPTED[dimension]:
        assert unit_factor(unit, dimension) > 0
    assert unit_factor(ACCEPTED[dimension][0], dimension) == 1


def test_unknown_unit_lists_accepted_ones():
    with pytest.raises(UnitError, match=r"unknown unit 'furlong' for length: accepted are mm, m,"):
        convert(1.0, "furlong", "length")


def test_wrong_case_is_refused_with_candidates():
    with pytest.raises(UnitError, match="did you mean mPa or MPa"):
        convert(1.0, "mpa", "stress")


@pytest.mark.parametrize("unit", ["N", "N//mm", "/mm", "mm^99", "mm^0", "N**mm", "", "mm" * 100])
def test_not_a_length(unit):
    with pytest.raises(UnitError, match="accepted are"):
        convert(1.0, unit, "length")


def test_unknown_dimension_is_the_callers_slip():
    with pytest.raises(ValueError, match="dimension 'luminance' is none of"):
        convert(1.0, "mm", "luminance")


def test_arrays_are_converted_into_new_float64():
    values = np.array([[1, 2], [3, 4]])
    got = convert(values, "m", "length")
    assert got.dtype == np.float64
    np.testing.assert_array_equal(got, [[1000.0, 2000.0], [3000.0, 4000.0]])
    same = np.ones(3)
    assert convert(same, "mm", "length") is not same
    assert isinstance(convert(2, "mm", "length"), float)


@settings(database=None)
@given(
    value=st.floats(-1e9, 1e9),
    pair=st.sampled_from([(d, u) for d, units in ACCEPTED.items() for u in units]),
)
def test_round_trip(value, pair):
    dimension, unit = pair
    # Two roundings going in and one coming back: at most 3 half-ulps, 3.4e-16.
    back = convert(value, unit, dimension) / float(unit_factor(unit, dimension))
    assert back == pytest.approx(value, rel=4e-16, abs=1e-290)


@pytest.mark.parametrize(
    ("text", "dimension", "value"),
    [
        ("9 mm", "length", 9.0),
        ("0.03 N", "force", 0.03),
        ("10 kPa", "stress", 0.01),
        ("-2.5e-3N/mm^3", "cubic_stiffness", -0.0025),
        (" 90° ", "angle", math.pi / 2),
        ("5 %", "dimensionless", 0.05),
        ("0.45", "dimensionless", 0.45),
        (0.45, "dimensionless", 0.45),
        (1, "dimensionless", 1.0),
    ],
)
def test_quantity(text, dimension, value):
    assert parse_quantity(text, dimension) == value


@pytest.mark.parametrize("text", ["9", 9, 9.0])
def test_bare_number_is_refused_with_a_cure(text):
    with pytest.raises(UnitError, match='has no unit: write it with one, as in "9(.0)? mm"'):
        parse_quantity(text, "length")


def test_the_example_of_an_angle_is_in_degrees():
    """Who writes 20 for a rotation means degrees; "20 rad" would be taken and be wrong."""
    for text in ("20", 20):
        with pytest.raises(UnitError, match='as in "20 deg"'):
            parse_quantity(text, "angle")


@pytest.mark.parametrize("text", ["", "mm", "9,5 mm", "nan mm", "inf mm", "1e999 mm", "9 mm 3"])
def test_no_quantity(text):
    with pytest.raises(UnitError):
        parse_quantity(text, "length")


@pytest.mark.parametrize(
    ("header", "name", "unit"),
    [
        ("force [N]", "force", "N"),
        ("Load (N)", "Load", "N"),
        ("force_N", "force", "N"),
        ("force / mN", "force", "mN"),
        ("Engineering Strain [-]", "Engineering Strain", "-"),
        ("joint_7 [mm]", "joint_7", "mm"),
        ("joint_7", "joint_7", None),
        ("joint_7 / mm", "joint_7", "mm"),
        ("stiffness_N / mm", "stiffness", "N / mm"),
        ("phi_c", "phi_c", None),
        ("load (kgs)", "load", "kgs"),
        ("force", "force", None),
        ("[N]", "[N]", None),
    ],
)
def test_column_header(header, name, unit):
    assert column_unit(header) == (name, unit)


def test_is_unit():
    assert is_unit("N/mm")
    assert not is_unit("")
    assert not is_unit("N/thumb")
