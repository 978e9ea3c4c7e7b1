"""The checks on whole arrays against those of one curve: the same curves, the same reasons.

The truth is `checks.finish`, which looks at each curve by itself and shares nothing with the whole
arrays but the last step for vectors; its own tests are in test_measurements.py.
"""

import dataclasses
import itertools

import numpy as np
import pytest

from jaxtrachea.measurements import batch_checks
from jaxtrachea.measurements.batch_checks import finish_all
from jaxtrachea.measurements.checks import bad, finish
from jaxtrachea.measurements.curve import BadCurve, Curve, Fault, RawCurve, ReadOptions
from jaxtrachea.measurements.holds import may_hold, rises_evenly

RAMP = np.linspace(0.0, 5.0, 30)


def raw(displacement=RAMP, force=None, **fields):
    force = 0.4 * displacement + 0.1 if force is None else force
    rows = 3 + np.arange(len(displacement))
    return RawCurve("T", "1", "x.csv:3-9", displacement, force, rows, **fields)


def with_(values, at, value):
    values = np.array(values, dtype=np.float64)
    values[at] = value
    return values


def ends(**changes):
    fields = {"end_rings": np.array([1, 4]), "end_U": np.ones((30, 2, 2)), "end_V": None}
    return fields | changes


MARKERS = {"joint_rings": np.array([2, 6]), "joint_displacement": np.ones((30, 2))}
FAST = np.sin(np.linspace(-1.5, 1.5, 200)) + 1  # slow at both ends
HOLDS = np.concatenate([RAMP, np.full(40, 5.0), RAMP[::-1]])
#: Records that only rise and pass every check.
PLAIN = {
    "ramp": raw(),
    "of two samples": raw(RAMP[:2]),
    "of three": raw(RAMP[:3]),
    "of seven, repeated rows": raw(np.array([0.0, 0, 1, 1, 2, 3, 4])),
    "with sigma": raw(sigma=0.1 + RAMP),
    "with even time": raw(time=0.1 * np.arange(30.0)),
    "with even time, much later": raw(time=1e6 + np.arange(30.0)),
    "with no time between": raw(time=np.full(30, 3.0)),
    "at a position": raw(s=35.0, phi=0.4),
    "at another direction": raw(direction=(0.6, 0.8)),
    "direction to be divided": raw(direction=(0.6004, 0.8)),
    "with side force": raw(side_force=with_(RAMP, 3, np.nan)),
    "with markers": raw(**MARKERS),
    "with ends": raw(**ends()),
    "beginning below 0": raw(RAMP - 2),
    "minus zero": raw(with_(RAMP, 0, -0.0), with_(RAMP, 0, -0.0)),
    "doubtful in kN": raw(force=1e-4 * RAMP),
    "doubtful in m": raw(1e-3 * RAMP, RAMP),
    "of a cantilever": raw(1e-6 * RAMP + 1, 1e-9 * RAMP),
    "force 1e-300": raw(force=1e-300 * RAMP),
}
#: Records that are cut, or bad, or nearly so.
ODD = {
    "much correlated the wrong way": raw(force=np.where(np.arange(30) % 2, 1.0, -1.0)),
    "clipped": raw(force=np.minimum(RAMP, 3.3)),
    "broken": raw(force=np.where(RAMP > 4, RAMP - 2, RAMP)),
    "hold and unloading": raw(HOLDS),
    "hold with time": raw(RAMP, time=with_(np.arange(30.0), slice(20, None), 90 + RAMP[:10])),
    "slow ends": raw(FAST),
    "two loadings": raw(np.concatenate([RAMP, RAMP[::-1], RAMP])),
    "turning back": raw(with_(RAMP, 10, 1.0)),
    "jitter": raw(with_(RAMP, 10, RAMP[9] - 1e-3)),
    "falling": raw(RAMP[::-1]),
    "drawn outward": raw(-RAMP, -RAMP),
    "drawn outward, rising": raw(RAMP - 6, RAMP[::-1]),
    "one sample": raw(RAMP[:1]),
    "none": raw(RAMP[:0]),
    "a table": raw(RAMP[:, None]),
    "a number": dataclasses.replace(raw(), displacement=np.array(1.0)),
    "force short": raw(force=RAMP[1:]),
    "sigma of integers": raw(sigma=np.ones(30, int)),
    "displacement nan": raw(with_(RAMP, 0, np.nan)),
    "displacement infinite": raw(with_(RAMP, 29, np.inf)),
    "force nan": raw(force=with_(RAMP, 29, np.nan)),
    "force minus infinite": raw(force=with_(RAMP, 5, -np.inf)),
    "displacement huge": raw(1e5 * RAMP),
    "force huge": raw(force=-1e6 * RAMP),
    "displacement constant": raw(np.ones(30), RAMP),
    "displacement tiny": raw(1e-8 * RAMP, RAMP),
    "force constant": raw(force=np.ones(30)),
    "force constant in a hold": raw(HOLDS, np.ones(100)),
    "force falls": raw(force=-RAMP),
    "correlation near -0.5": raw(force=with_(-RAMP, slice(0, 8), -4.2)),
    "sigma 0": raw(sigma=with_(RAMP, 0, 0.0)),
    "sigma nan": raw(sigma=with_(1 + RAMP, 4, np.nan)),
    "sigma infinite": raw(sigma=with_(1 + RAMP, 4, np.inf)),
    "sigma short": raw(sigma=1 + RAMP[1:]),
    "time falls": raw(time=with_(np.arange(30.0), 7, 3.0)),
    "time nan": raw(time=with_(np.arange(30.0), 7, np.nan)),
    "time short": raw(time=np.arange(29.0)),
    "time uneven": raw(time=with_(np.arange(30.0), 29, 100.0)),
    "ramp of milliseconds taken for seconds": raw(time=1e4 * np.arange(30.0)),
    "ramp of microseconds": raw(time=1e-6 * np.arange(30.0)),
    "s infinite": raw(s=np.inf),
    "s nan": raw(s=np.nan),
    "phi of degrees": raw(phi=30.0),
    "direction nan": raw(direction=(np.nan, 0.0)),
    "direction of three": raw(direction=(1.0, 0.0, 0.0)),
    "direction too long": raw(direction=(1.0, 1.0)),
    "direction outward": raw(direction=(-1.0, 0.0)),
    "ring twice": raw(**MARKERS | {"joint_rings": np.array([2, 2])}),
    "markers without rings": raw(joint_displacement=np.ones((30, 2))),
    "markers short": raw(**MARKERS | {"joint_displacement": np.ones((29, 2))}),
    "sides alone": raw(joint_side_displacement=np.ones((30, 2))),
    "ends infinite": raw(**ends(end_U=np.full((30, 2, 2), np.inf))),
    "ends too far": raw(**ends(end_V=np.full((30, 2, 2), 2e3))),
    "ends of no ring": raw(end_U=np.ones((30, 2, 2))),
    "rings of no end": raw(end_rings=np.array([1])),
    "side force huge": raw(side_force=1e6 * RAMP),
    "bad already": bad("T", "1", "x.csv", Fault("shape", "is wrong", "correct it")),
}
OPTIONS = {
    "as they are": {},
    "all": {"loading": "all"},
    "first": {"loading": "first"},
    "monotone": {"loading": "require-monotone"},
    "signs turned": {"force_sign": -1, "displacement_sign": -1},
    "force turned": {"force_sign": -1},
    "window": {"displacement_min": 0.5, "displacement_max": 4.0},
    "wide window": {"displacement_min": -10.0, "displacement_max": 10.0},
    "position": {"s": "35 mm", "phi": "0.4 rad"},
    "limits": {"min_points": 8, "max_displacement": 4.0, "min_range": 1e-3, "max_force": 8.0},
}


def same(a, b):
    """Two results are equal in every field, bit by bit, and of the same types."""
    assert type(a) is type(b)
    if isinstance(a, BadCurve):
        assert a == b
        return
    for field in dataclasses.fields(Curve):
        one, other = getattr(a, field.name), getattr(b, field.name)
        assert type(one) is type(other), field.name
        if isinstance(one, np.ndarray):
            np.testing.assert_array_equal(one, other, strict=True)
            assert np.array_equal(np.signbit(one), np.signbit(other))
            assert one.base is None or one.base.size == one.size
        else:
            assert one == other, field.name


@pytest.mark.parametrize("name", OPTIONS)
@pytest.mark.parametrize("block", [1, 100, batch_checks.BLOCK])
def test_same_as_one_by_one(name, block, monkeypatch):
    monkeypatch.setattr(batch_checks, "BLOCK", block)
    options = ReadOptions(**OPTIONS[name])
    records = [*PLAIN.values(), *ODD.values(), *PLAIN.values()]
    found = finish_all(records, options)
    expected = [r if isinstance(r, BadCurve) else finish(r, options) for r in records]
    for a, b in zip(found, expected, strict=True):
        same(a, b)


def test_same_for_records_at_random():
    """Ramps with noise, pauses, uneven clocks and reversals of all sizes, and holes in them."""
    rng = np.random.default_rng(0)
    records = []
    for _ in range(100):
        n = int(rng.integers(2, 120))
        steps = rng.exponential(1.0, n) * (rng.random(n) > rng.choice([0.0, 0.1, 0.6]))
        steps -= rng.choice([0.0, 0.0, 0.3]) * rng.random(n)
        travel = np.cumsum(steps) * 10.0 ** rng.integers(-7, 4) - rng.choice([0.0, 3.0])
        force = rng.choice([1.0, -1.0, 0.0]) * travel + rng.normal(0, rng.choice([0, 1, 5]), n)
        clock = np.cumsum(rng.exponential(1.0, n) ** rng.choice([0.01, 1, 3]))
        fields = {
            "sigma": None if rng.random() < 0.5 else rng.normal(1.0, 0.3, n),
            "time": None if rng.random() < 0.5 else clock,
        }
        if rng.random() < 0.1:
            force[rng.integers(n)] = rng.choice([np.nan, np.inf])
        records.append(raw(travel, force, **fields))
    for loading in ("last", "all"):
        options = ReadOptions(loading=loading)
        for a, record in zip(finish_all(records, options), records, strict=True):
            same(a, finish(record, options))


def test_plain_curves_are_not_looked_at_one_by_one(monkeypatch):
    def refuse(record, options):
        raise AssertionError(record)

    monkeypatch.setattr(batch_checks, "finish", refuse)
    found = finish_all(list(PLAIN.values()), ReadOptions())
    assert all(isinstance(curve, Curve) for curve in found)


def test_arrays_belong_to_their_curve():
    first, second = finish_all([raw(), raw()], ReadOptions())
    first.displacement[:] = -1.0
    np.testing.assert_array_equal(second.displacement, RAMP)
    np.testing.assert_array_equal(raw().displacement, RAMP)


def test_dead_load_cell_in_a_hold():
    """Where the force never moves there is no scatter to divide by."""
    (found,) = finish_all([ODD["force constant in a hold"]], ReadOptions())
    assert isinstance(found, BadCurve)
    assert found.kind == "no_signal"


def test_nothing_to_do():
    assert finish_all([], ReadOptions()) == []
    odd = ODD["bad already"]
    assert finish_all([odd], ReadOptions()) == [odd]


@pytest.mark.parametrize("seed", range(3))
def test_holds_of_many(seed):
    """The look for holds against that at one record, with a pause of every length in it."""
    rng = np.random.default_rng(seed)
    records = [
        np.cumsum(np.concatenate([np.ones(n), np.full(pause, slow), np.ones(n)]))
        for n, pause, slow in itertools.product(rng.integers(1, 60, 6), range(12), (0.0, 0.2, 1.0))
    ]
    edges = np.concatenate([[0], np.cumsum([len(r) for r in records])])
    found = rises_evenly(np.concatenate(records), edges)
    np.testing.assert_array_equal(found, [not may_hold(r) for r in records])
    assert 0 < found.sum() < len(records)
