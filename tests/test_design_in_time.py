"""The next press of a force that relaxes, against a ramp and hold in closed form."""

import dataclasses

import numpy as np
import pytest

from jaxtrachea.config import FitSpec, SpecError
from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.lanes import Noise
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.inference.analyses.design import Design, candidate_rows, choice_rows, draw_design
from jaxtrachea.inference.design.candidates import candidates_of, grid
from jaxtrachea.inference.design.choice import gains, next_points
from jaxtrachea.inference.design.identifiability import identifiability
from jaxtrachea.inference.design.situation import situation
from jaxtrachea.measurements.curve import Curve
from jaxtrachea.mechanics.levels.options import Options
from jaxtrachea.mechanics.press import press
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import Material

pytestmark = pytest.mark.long

TUBE = Geometry.create(160.0, list(np.arange(10.0, 151.0, 10.0)))
SOLID = Material(EI_L=20.0, k_M=0.3, k_1=0.6, k_3=0.0)
K_1, GAMMA, TAU, SIGMA = 0.6, 0.8, 2.0, 0.01
RELAXING = Options(relaxation="uniform", branches="prony-1")
TABLE = {
    **{n: {"fixed": True, "value": float(getattr(SOLID, n))} for n in ("EI_L", "k_M")},
    **{n: {"fixed": True, "value": 0.0} for n in ("k_3", "onset", "force_offset")},
    "k_1": {"value": K_1}, "gamma_1": {"value": GAMMA}, "tau_1": {"value": TAU},
}  # fmt: skip


def compliance(s):
    return float(press(TUBE, SOLID, s, 0.0).compliance)


def force(log, c, depth, speed, t):
    """Of a ramp from rest and what follows it; log: of k_1, gamma and tau."""
    k_1, gamma, tau = np.exp(log)
    top = depth / speed
    ramp, since = np.minimum(t, top), np.maximum(t - top, 0)
    carried = gamma * speed * tau * -np.expm1(-ramp / tau) * np.exp(-since / tau)
    return (speed * ramp + carried) / (c + 1 / k_1)


TRUTH = np.log([K_1, GAMMA, TAU])
#: Of the samples of a press on the ramp, and in its hold.
COUNT = 61


def samples(depth, speed, hold):
    """Times of the samples of a press, s."""
    top, ramp = depth / speed, COUNT - COUNT // 2 if hold else COUNT
    still = hold * np.geomspace(1e-3, 1, COUNT // 2 + 1)[1:] if hold else []
    return np.r_[top * np.arange(1, ramp + 1) / ramp, top + np.asarray(still)]


def information(s, depth, speed, hold, h=1e-5):
    """By central differences; of k_1, gamma and tau, relative."""
    c, t = compliance(s), samples(depth, speed, hold)
    J = [
        (force(TRUTH + e, c, depth, speed, t) - force(TRUTH - e, c, depth, speed, t)) / (2 * h)
        for e in h * np.eye(3)
    ]
    return np.array(J) @ np.array(J).T / SIGMA**2


@pytest.fixture(scope="module")
def result():
    """One fast record without a hold, which tells gamma and tau as a product at best."""
    t = 2.0 / 8.0 * np.linspace(0, 1, COUNT)
    F = force(TRUTH, compliance(28.0), 2.0, 8.0, t)
    curve = Curve("T", "a", 28.0, 0.0, 8.0 * t, F, time=t, rise=(0, COUNT))
    study = build_study([curve], TUBE, RELAXING, TABLE, noise=Noise(force=SIGMA))
    return fit(study, Settings(starts=1, verify=False))


AT = grid((28.0, 62.0), (1.0, 2.0), 60, pace=[(v, t) for v in (0.5, 8.0) for t in (0.0, 1.0, 20.0)])


def test_gains_are_those_of_a_ramp_and_hold_in_closed_form(result):
    """Of every candidate, and so the best press is that of the matrices by hand."""
    known = situation(result)
    assert (known.weight, known.samples) == (1.0, COUNT)
    assert len(AT.s) == 60
    found = gains(known, AT)[0]
    want = np.array(
        [information(*at) for at in zip(AT.s, AT.depth, AT.speed, AT.hold, strict=True)]
    )
    names = [p.name for p, _, _ in result.study.unknowns[0]]
    assert names == ["k_1", "gamma_1", "tau_1"]
    np.testing.assert_allclose(found, want, rtol=2e-5, atol=2e-5 * np.abs(want).max())
    choice = next_points(known, AT, 2)
    base, chosen = known.base[0], []
    for _ in range(2):
        chosen.append(int(np.argmax(np.linalg.slogdet(base + want)[1])))
        base = base + want[chosen[-1]]
    assert choice.chosen.tolist() == chosen
    # A hold of many relaxation times tells the branch from what lasts.
    assert AT.hold[chosen[0]] == 20.0


def test_tables_and_picture_name_speed_and_hold(result):
    known = situation(result)
    added = gains(known, AT)
    choice = next_points(known, AT, 1, added=added)
    k = int(choice.chosen[0])
    pace = float(AT.speed[k]), float(AT.hold[k])
    chart = identifiability(known, np.unique(AT.s), 2.0, pace=pace)
    design = Design(known, AT, added, choice, [chart], ["k_1", "gamma_1", "tau_1"])
    before, after = choice_rows(design)
    assert (after["speed_mm_s"], after["hold_s"]) == pace
    assert before["speed_mm_s"] is None
    assert "extrapolated from records of at most 0.25 s" in after["message"]
    row = next(candidate_rows(known, added, AT))
    assert list(row)[:5] == ["specimen", "s_mm", "depth_mm", "speed_mm_s", "hold_s"]
    legend = draw_design(design).axes[2].get_legend()
    words = f"{pace[0]:.3g} mm/s, {pace[1]:.3g} s"
    assert [text.get_text().endswith(words) for text in legend.get_texts()] == [True] * 5


def of_spec(study, **section):
    data = {"data": {"files": "a.csv"}, "design": section}
    return candidates_of(FitSpec.model_validate(data), study)


def test_candidates_are_of_every_speed_and_hold(result):
    at = of_spec(result.study, speed=["0.06 m/min", "5 mm/s"], hold=["0 s", "1 min"], candidates=40)
    assert {*zip(at.speed, at.hold, strict=True)} == {(1, 0), (1, 60), (5, 0), (5, 60)}
    usual = of_spec(result.study)
    np.testing.assert_allclose(np.unique(usual.speed), 8.0)
    assert np.unique(usual.hold).tolist() == [0.0]


def test_speeds_and_holds_that_cannot_be_are_refused(result):
    with pytest.raises(SpecError, match=r"design.hold: -1 s; expected 0 s or more"):
        of_spec(result.study, hold=["-1 s"])
    with pytest.raises(ValueError, match="expected a positive velocity"):
        of_spec(result.study, speed=["0 mm/s"])
    with pytest.raises(ValueError, match=r"design.speed.*mm/s|velocity"):
        of_spec(result.study, speed=["5 mm"])
    (curve,) = result.study.curves[0]
    table = {n: v for n, v in TABLE.items() if n not in ("gamma_1", "tau_1")}
    elastic = build_study([curve], TUBE, Options(), table)
    for section in ({"speed": ["5 mm/s"]}, {"hold": ["1 s"]}):
        with pytest.raises(SpecError, match="its force knows no time; leave it out"):
            of_spec(elastic, **section)
    first = {n: getattr(curve, n)[:4] for n in ("displacement", "force", "time")}
    short = dataclasses.replace(curve, rise=(0, 4), **first)
    with pytest.raises(SpecError, match=r"design.speed: no record tells its speed; give one"):
        of_spec(build_study([short], TUBE, RELAXING, TABLE))
    known = situation(result)
    with pytest.raises(ValueError, match="a speed and a hold where the force relaxes"):
        gains(known, grid((28.0, 62.0), (1.0, 2.0), 10))
