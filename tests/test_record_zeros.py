"""First touch, force offset and line that records show, against records of a beam of its own."""

import numpy as np
import pytest
from records import clean, force, recorded

from jaxtrachea.measurements import press_shape
from jaxtrachea.measurements.record_zeros import record_zeros


def test_shape_is_the_series_law_and_differentiates():
    """Against Newton steps on the law; the derivatives against differences."""
    x = np.linspace(0, 1, 41)[None]
    span, peak, k_1, k_3, c = 5.0, 4.0, 2.0, 3.0, 0.9
    logs = np.log([k_1 * span / peak, k_3 * span**3 / peak, c * peak / span])
    theta = np.array([[*logs, 0.0, 0.0, 0.0, 0.0]])
    got, _ = press_shape._shape(x, theta, None)
    np.testing.assert_allclose(peak * got[0], force(span * x[0], c, k_1, k_3), atol=1e-10)
    theta = np.array([[0.1, 1.0, -1.0, 0.1, 0.11, 0.05, -0.02]])
    _, J = press_shape._shape(x, theta, np.arange(7))
    for i, step in enumerate(1e-6 * np.eye(7)):
        up, down = (press_shape._shape(x, theta + s, None)[0] for s in (step, -step))
        np.testing.assert_allclose(J[..., i], (up - down) / 2e-6, atol=1e-8)


@pytest.mark.parametrize("samples", [10, 20, 60])
@pytest.mark.parametrize("soft", [False, True])
def test_records_from_first_touch_on_take_nothing(samples, soft):
    """At most 2 % of them, noise 0.2 to 5 % of the peak; seeds of no threshold's choice."""
    rng, wrong, count = np.random.default_rng(1000 + samples + soft), 0, 0
    for first in (0.0, 0.15):
        zeros = record_zeros(*clean(rng, 100, samples, soft=soft, first=first))
        wrong += np.sum(zeros.onset | zeros.force_offset | zeros.force_slope)
        count += 100
    assert wrong <= 0.02 * count
    exact = record_zeros(*clean(rng, 20, samples, soft=soft, noise=(1e-12, 1e-11)))
    assert not (exact.onset | exact.force_offset).any()


@pytest.mark.parametrize(
    ("fault", "onset", "offset"),
    [
        ({"air": 0.6}, 0.6, 0.0),
        ({"air": 0.1}, 0.1, 0.0),
        ({"preload": 0.15}, None, None),  # the record cannot tell: both
        ({"offset": 0.05}, None, None),
        ({"offset": -0.05}, 0.0, -0.05),  # no preload pulls
        ({"offset": 0.05, "k_1": 0.1, "k_3": 2.0}, 0.0, 0.05),  # here it can
        ({"air": 0.6, "offset": 0.05}, 0.6, 0.05),
        ({"air": 0.6, "k_1": 0.3, "k_3": 5.0}, 0.6, 0.0),
    ],
)
def test_faults_are_shown(fault, onset, offset):
    """Nine of ten records at least; where first touch is by a tenth of a millimetre."""
    _, D, F = recorded(np.random.default_rng(2000), 8, **fault)
    zeros = record_zeros(D, F)
    assert np.mean(zeros.onset == (onset != 0)) >= 0.9
    assert np.mean(zeros.force_offset == (offset != 0)) >= 0.75
    if onset is None:
        assert (zeros.touch < 0).all()
    else:
        np.testing.assert_allclose(np.median(zeros.touch), onset, atol=0.12)
    np.testing.assert_allclose(np.median(zeros.offset), offset or 0.0, atol=0.01)


def test_a_force_below_zero_is_an_offset_whatever_the_noise():
    """Of every record; four of ten had none, and a preload that pulls was found in them."""
    for offset in (-0.15, -0.06):
        _, D, F = recorded(np.random.default_rng(2002), 40, offset=offset, k_3=0.5)
        assert record_zeros(D, F).force_offset.all()


def test_lines_are_shown_where_there_is_air():
    """-0.05 N/mm over 6 samples is 5 standard errors; without air nobody can tell."""
    rng = np.random.default_rng(2001)
    zeros = record_zeros(*recorded(rng, 10, air=0.6, slope=-0.05)[1:])
    assert zeros.force_slope.mean() > 0.3
    np.testing.assert_allclose(np.median(zeros.slope), -0.05, atol=0.01)
    assert np.median(zeros.slope_error) == pytest.approx(0.012, rel=0.3)
    zeros = record_zeros(*recorded(rng, 10, slope=-0.05)[1:])
    assert not zeros.force_slope.any()
    assert np.isnan(zeros.slope).all()


@pytest.mark.parametrize("slope", [-0.3, -0.05, 0.03, 0.1, 0.15])
def test_lines_that_rise_are_shown_as_those_that_fall(slope):
    """Of a third of the record in air; none of a force that rises in air was taken for air."""
    _, D, F = recorded(np.random.default_rng(2003), 10, air=1.6, slope=slope, samples=100)
    zeros = record_zeros(D, F)
    assert (zeros.onset & zeros.force_offset & zeros.force_slope).mean() >= 0.95
    np.testing.assert_allclose(np.median(zeros.touch), 1.6, atol=0.1 if slope > -0.1 else 0.4)
    np.testing.assert_allclose(np.nanmedian(zeros.slope), slope, atol=0.005)


def test_a_line_is_told_by_its_force_at_no_displacement():
    """Of a record that begins at 5 mm: 0.5 N - 0.03 N/mm D in air, known to 1e-3 N at D = 0."""
    D = np.linspace(5, 11, 121)
    noise = 1e-3 * np.random.default_rng(4).normal(size=D.size)
    zeros = record_zeros([D], [0.5 - 0.03 * D + 2 * np.maximum(D - 8, 0) + noise])
    assert zeros.force_slope.all()
    np.testing.assert_allclose(zeros.slope, -0.03, atol=1e-3)
    np.testing.assert_allclose(zeros.offset, 0.5, atol=6e-3)


def test_records_that_no_press_explains_are_left_alone():
    """Hardening with the seventh power is no air: its force rises from the beginning, if little."""
    rng = np.random.default_rng(2002)
    D = [np.linspace(0, 20, 400)] * 20
    F = [d + 400 * (d / 20) ** 7 + 0.02 * rng.normal(size=400) for d in D]
    assert not record_zeros(D, F).onset.any()


def test_few_samples_and_given_noise():
    """Fewer than 6 samples say nothing; a given noise counts in place of a measured one."""
    D = [np.linspace(0, 1, 5)]
    assert not record_zeros(D, [np.array([1.0, 2, 3, 4, 5])]).onset.any()
    _, D, F = recorded(np.random.default_rng(3), 1, preload=0.05)
    assert record_zeros(D, F).onset.all()
    assert not record_zeros(D, F, np.full(len(D), 0.1)).onset.any()
