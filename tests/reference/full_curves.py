"""Curves that hold all that a curve can, written and compared."""

import math

import numpy as np

from jaxtrachea.measurements.read import Curve, Measurements, write_hdf5

NAN = math.nan
ARRAYS = (
    "displacement", "force", "sigma", "time", "side_force", "joint_rings", "joint_displacement",
    "joint_side_displacement", "end_rings", "end_U", "end_V",
)  # fmt: skip


def full(specimen="T01", trial="1", n=3, **changes):
    """A curve with every field, all numbers different."""
    row = np.arange(float(n))
    fields = {
        "s_c": 35.0,
        "phi_c": 0.5,
        "displacement": row,
        "force": 0.5 * row + 0.1 * row**2,
        "sigma": 0.01 + row / 7,
        "time": 0.1 * row,
        "joint_rings": np.array([2, 6]),
        "joint_displacement": np.stack([0.1 * row, np.where(row > 0, row / 3, NAN)], axis=1),
        "direction": (0.6, 0.8),
        "side_force": np.where(row == 1, NAN, -row / 3),
        "joint_side_displacement": np.stack([row / 11, row / 13], axis=1),
        "end_rings": np.array([1, 8, 4]),
        "end_U": 0.1 + 0.01 * row[:, None, None] * np.array([[1, 2], [3, NAN], [5, 6]]),
        "end_V": -0.7 + 0.03 * row[:, None, None] * np.array([[1, 2], [3, 4], [5, 6]]),
    }
    return Curve(specimen, trial, **(fields | changes))


def plain(specimen="T02", trial="1", n=40):
    row = np.linspace(0.0, 4.0, n)
    return Curve(specimen, trial, None, 0.0, row, row**1.5)


def stored(path, *curves, **options):
    write_hdf5(path, Measurements(curves, (), ()), **options)
    return path


def same(a, b):
    """Every field of two curves is the same, bit by bit; where they came from is not looked at."""
    assert (a.specimen, a.trial, a.s_c, a.phi_c) == (b.specimen, b.trial, b.s_c, b.phi_c)
    assert a.direction == b.direction
    for name in ARRAYS:
        one, other = getattr(a, name), getattr(b, name)
        assert (one is None) == (other is None), name
        if one is not None:
            np.testing.assert_array_equal(one, other, strict=True)
