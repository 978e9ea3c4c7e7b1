"""What contact points and markers can tell at all, against an independent beam and by counting."""

import dataclasses

import beam_fem
import numpy as np
import pytest

from jaxtrachea.fitting.build import build_study, default_parameters
from jaxtrachea.fitting.parameters import in_model
from jaxtrachea.fitting.structure import null_spaces, pins, structure, suspicious
from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.press import Options
from jaxtrachea.trachea.geometry import table_1

GEOMETRY = table_1()
RINGS = np.asarray(GEOMETRY.ring_positions)
FIXED_K_3 = {"k_3": {"fixed": True, "value": 0.0}}
DEPTHS = np.linspace(0.1, 3, 6)


def make_study(positions, markers=False, joint=False, changes=None):
    """One specimen for every tuple of positions; what is measured does not matter."""
    curves = []
    for i, of_specimen in enumerate(positions):
        for t, s in enumerate(of_specimen):
            curve = Curve(f"s{i}", f"t{t}", s, 0.0, DEPTHS, DEPTHS)
            if markers:
                motion = np.zeros((len(DEPTHS), 3))
                curve = dataclasses.replace(
                    curve, joint_rings=np.array([3, 7, 9]), joint_displacement=motion
                )
            curves.append(curve)
    parameters = default_parameters(in_model(Options(), joints=markers), changes or {})
    return build_study(curves, GEOMETRY, Options(), parameters, joint=joint)


#: Positions of specimens, changes of parameters, and the unknowns left open in each specimen: as
#: many equations (compliances, or slopes of a linear law) as unknowns, or fewer.
CASES = [
    (
        [(75.0, 75.0), (40.0, 120.0), (75.0, 22.0)],
        {},
        [{"EI_L", "k_M"}, {"EI_L", "k_M"}, set()],
    ),
    (
        [(75.0, 75.0), (75.0, 22.0)],
        FIXED_K_3,
        [{"EI_L", "k_M", "k_1"}, {"EI_L", "k_M", "k_1"}],
    ),
    (
        [(75.0, 22.0)],
        FIXED_K_3 | {"EI_L": {"fixed": True, "value": 10.0}, "onset": {"fixed": False},
                     "force_offset": {"fixed": False}},
        [{"onset", "force_offset"}],
    ),
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize(("positions", "changes", "left_open"), CASES, ids=["law", "line", "zero"])
def test_unknowns_left_open(positions, changes, left_open):
    study = make_study(positions, changes=changes)
    found = structure(study)
    names = [[p.name for p, _, _ in u] for u in study.unknowns]
    told = [{n for n, open_ in zip(u, row, strict=False) if open_}
            for u, row in zip(names, found.undetermined, strict=True)]  # fmt: skip
    assert told == left_open
    # A count of positions must not pass over what the rank finds.
    assert np.all(suspicious(study) | (found.nullity == 0))
    np.testing.assert_array_equal(found.pinned.sum(axis=1), found.nullity)


LINE = {"EI_L", "k_M", "k_1"}


@pytest.mark.parametrize(
    ("changes", "open_"),
    [({}, [{"EI_L", "k_M"}, set()]), (FIXED_K_3, [LINE, LINE])],
    ids=["law", "line"],
)
def test_what_one_curve_tells_of_a_tube_that_softens(changes, open_):
    """F = (1 - e_1 D + e_2 D^2) F_0(D): the ratio, and what the small-strain force F_0 has.

    That of a line is D / (c + 1 / k_1), one number of each position for three unknowns.
    """
    options = Options(skeleton="softening")
    curves = [[Curve(f"s{i}", f"t{t}", s, 0.0, DEPTHS, DEPTHS) for t, s in enumerate(of_specimen)]
              for i, of_specimen in enumerate([(75.0, 75.0), (75.0, 22.0)])]  # fmt: skip
    parameters = default_parameters(in_model(options, joints=False), changes)
    study = build_study(sum(curves, []), GEOMETRY, options, parameters)
    found = structure(study)
    names = [p.name for p, _, _ in study.unknowns[0]]
    assert {"e_1", "e_2"} <= set(names)
    told = [{n for n, lost in zip(names, row, strict=False) if lost}
            for row in found.undetermined]  # fmt: skip
    assert told == open_
    assert np.all(suspicious(study) | (found.nullity == 0))


def test_markers_tell_the_skeleton_from_one_position():
    assert not structure(make_study([(75.0,)], markers=True)).nullity.any()


def test_shared_skeleton_is_told_by_specimens_together():
    shared = {name: {"scope": "shared"} for name in ("EI_L", "k_M")}
    together = structure(make_study([(75.0,), (22.0,)], joint=True, changes=shared))
    assert not together.nullity.any()
    alike = structure(make_study([(75.0,), (75.0,)], joint=True, changes=shared))
    assert alike.nullity.tolist() == [1, 1]
    assert alike.undetermined[:, :2].all()


def test_direction_left_open_by_an_independent_beam():
    """At two truths: along it the compliance of the finite-element beam stays (to 1e-5)."""
    study = make_study([(75.0,)])
    for EI, k in ((900.0, 0.7), (30.0, 0.2)):
        theta = np.log([[EI, k, 1.0, 1.0]])
        theta[0, 3] = 1.0
        (direction,) = null_spaces(study, np.array([0]), theta)[0]

        def compliance(step, EI=EI, k=k, direction=direction):
            moved = np.exp(np.log([EI, k]) + step * direction[:2])
            beam = beam_fem.solve(RINGS, 160.0, [moved[0]] * 16, [moved[1]] * 15, 75.0, 1.0)
            return float(beam.w_C)

        change = np.log(compliance(1e-3) / compliance(-1e-3)) / 2e-3
        assert abs(change) <= 1e-5
        assert np.abs(direction[2:]).max() <= 1e-9


def test_pins_leave_nothing_open():
    """Random null spaces of four unknowns: with the pinned ones held no direction is left."""
    rng = np.random.default_rng(0)
    for nullity in (1, 2, 3):
        rows = np.linalg.qr(rng.normal(size=(4, nullity)))[0].T
        held = pins(["EI_L", "k_M", "k_1", "k_3"], rows)
        assert held.sum() == nullity
        assert np.linalg.matrix_rank(rows[:, held], tol=1e-3) == nullity
    assert pins(["EI_L", "k_M"], np.array([[0.9, -0.4]])).tolist() == [False, True]
