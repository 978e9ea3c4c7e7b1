"""Where other programs for relaxation go wrong: holds alone, the unit of time, a first sample at 0.

Records are closed forms of a ramp of T and a hold, one branch beside a spring.
"""

import numpy as np
import pytest

from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.measurements.curve import Curve
from jaxtrachea.mechanics.levels.options import Options
from jaxtrachea.trachea.geometry import table_1

K, GAMMA, TAU, RAMP, HOLD, TOP = 0.8, 0.9, 1.5, 1.5, 12.0, 3.0
OPTIONS = Options(coupling="total", relaxation="uniform", branches="prony-1")
KNOWN = {name: {"fixed": True, "value": 0.0} for name in ("k_3", "onset", "force_offset")}


def record(times, scale=1.0):
    """Force at times from the start of the ramp; all times over `scale`."""
    t, tau, ramp = times / scale, TAU, RAMP
    risen = np.minimum(t, ramp)
    decay = np.exp(-(t - risen) / tau) - np.exp(-t / tau)
    return K * TOP / ramp * (risen + GAMMA * tau * decay)


def estimates(time, displacement, force):
    curve = Curve("a", "1", 80.0, 0.0, displacement, force, time=time, rise=(0, len(time)))
    study = build_study([curve], table_1(), OPTIONS, KNOWN)
    result = fit(study, Settings(verify=False))
    names = [p.name for p, _, _ in study.unknowns[0]]
    return dict(zip(names, result.value[0], strict=True))


@pytest.mark.long
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_the_unit_of_time_scales_tau_alone(scale):
    """The first sample is at 0."""
    time = scale * np.linspace(0, RAMP + HOLD, 200)
    way = TOP * np.minimum(time / (scale * RAMP), 1)
    found = estimates(time, way, record(time, scale))
    expected = {"k_1": K, "gamma_1": GAMMA, "tau_1": scale * TAU}
    assert found == pytest.approx(expected, rel=1e-3)  # 22 samples in the ramp


@pytest.mark.long
@pytest.mark.parametrize("clock", ["end of the ramp", "start of the ramp"])
def test_a_hold_fitted_alone_has_the_right_tau_and_a_wrong_gamma(clock):
    """By the factors of the closed form, 0.63 and 1.72 where the ramp lasts as long as tau."""
    ends = clock == "end of the ramp"
    t = np.linspace(0, HOLD, 200)
    force = record(RAMP + t)
    x = RAMP / TAU
    factor = (1 - np.exp(-x)) / x if ends else (np.exp(x) - 1) / x
    # On the clock of the ramp's start the tool jumped then, and is seen from the end of the ramp.
    time = t if ends else np.append(0.0, RAMP + t)
    seen = force if ends else np.append(K * TOP * (1 + GAMMA * factor), force)
    found = estimates(time, np.full(len(time), TOP), seen)
    assert found["tau_1"] == pytest.approx(TAU, rel=1e-6)
    assert found["gamma_1"] == pytest.approx(GAMMA * factor, rel=1e-6)
    assert factor == pytest.approx(0.632 if ends else 1.718, abs=1e-3)
