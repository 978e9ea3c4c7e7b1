"""One record of ramp and hold, fitted whole, and its hold alone by pyvisco and rheojax.

    pip install --no-deps pyvisco; pip install rheojax; python tests/bench/relaxing_peer.py

(rheojax 0.7 needs Python 3.12; what is not installed is left out with a word.)

The record is by a differential equation (`tests/reference/relaxing_records.py`): a linear law, two
branches, a ramp of 0.5 s, a hold of 100 s. Both take the hold for an ideal step: alpha of pyvisco
is turned into gamma = alpha / (1 - sum alpha), and both by what the ramp has relaxed already,
(tau / T) (1 - exp(-T / tau)). The tau of pyvisco may be 1 / (2 pi) of the hold at most.
"""

import numpy as np
from relaxing_coverage import GAMMA, KNOWN, PLACES, TAU, TUBE, UNIFORM, compliance, relaxing_records

from jaxtrachea.fitting.assessment import assess
from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.measurements.curve import Curve

RAMP, HOLD, NOISE = 0.5, 100.0, 0.003


def by_pyvisco(t, force):
    """tau, and gamma as if the hold were a step; t since its begin."""
    import pandas as pd
    import pyvisco

    frame = pd.DataFrame({"t": t, "E_relax_filt": force, "f": 1 / t, "omega": 2 * np.pi / t})
    frame.RefT, frame.domain, frame.modul = 0.0, "time", "E"
    terms = pyvisco.prony.discretize(frame, window="min", nprony=2)
    found = pyvisco.prony.fit_time(terms, frame, opt=True)["df_terms"].sort_values("tau_i")
    alpha, tau = found["alpha_i"].to_numpy(), found["tau_i"].to_numpy()
    return tau, alpha / (1 - alpha.sum())


def by_rheojax(t, force):
    """The same by its generalised Maxwell model."""
    from rheojax.models import GeneralizedMaxwell

    model = GeneralizedMaxwell(n_modes=2)
    model.fit(t, force, test_mode="relaxation")
    found = model.parameters
    tau, G = (
        np.array([found.get_value(f"{name}_{i}") for i in (1, 2)], float) for name in ("tau", "G")
    )
    return tau, G / found.get_value("G_inf")


def main():
    """Print the truth, pyvisco's numbers, and ours with their 95 % intervals."""
    time = np.concatenate([np.linspace(0, RAMP, 40), RAMP + np.geomspace(1e-3, HOLD, 160)])
    corners = np.array([0, RAMP, RAMP + HOLD]), np.array([0.0, 4.0, 4.0])
    parts, c = (GAMMA, TAU), compliance(PLACES[0])
    clean, _ = relaxing_records.press(time, corners, c, (0.3, 0.0, 0.0), parts, parts)
    noise = np.random.default_rng(5).normal(0, NOISE * clean.max(), len(time))
    records = {"clean": clean, "noisy": clean + noise}
    way = np.interp(time, *corners)
    curves = [
        Curve(name, "1", PLACES[0], 0.0, way, force, time=time, rise=(0, 40))
        for name, force in records.items()
    ]
    free = {"k_1": {"value": 0.3}, "k_3": {"fixed": True, "value": 0.0}}
    result = fit(build_study(curves, TUBE, UNIFORM, KNOWN | free), Settings(starts=2))
    print("truth: tau", TAU, "gamma", GAMMA, "tau_ratio_2", TAU[1] / TAU[0])
    for lane in range(result.lanes):
        name = result.study.lane_name(lane)[0]
        held = time > RAMP
        for program, by in {"pyvisco": by_pyvisco, "rheojax": by_rheojax}.items():
            try:
                tau, of_hold = by(time[held] - RAMP, records[name][held])
            except ImportError as missing:
                print(f"{program} left out: {missing}")
                continue
            gamma = of_hold / (tau / RAMP * -np.expm1(-RAMP / tau))
            print(f"{name}, {program}: tau {tau}, gamma {gamma} (without the ramp {of_hold})")
        for i, (p, _, _) in enumerate(result.study.unknowns[lane]):
            found = assess(result, lane, i)
            print(f"{name}, ours: {p.name} {found.low:.9g} to {found.high:.9g}")


if __name__ == "__main__":
    main()
