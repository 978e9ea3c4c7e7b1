"""Fits of records that relax, against scipy's `least_squares` on the same records.

    python tests/bench/relaxing_cost.py [--records 64] [--scipy 6]

The records of `relaxing_coverage.py` without the unloading, where the tool could let go, at samples
of one step, as `scipy.signal.lfilter` needs them. Fitted are k_1, k_3, k_5 and two branches, from
one start, the same for both; the scipy model is an elastic press by Newton and one filter a branch,
with the differences that `least_squares` takes. Also the working memory of the compiled residual
and Jacobian of a batch, over that of the elastic one.
"""

import argparse
import sys
import time
from pathlib import Path

import common  # noqa: F401  (pins one core, before numpy and jax)
import jax
import numpy as np
from relaxing_coverage import FREE, KNOWN, LAW, NOISE, TAU, TUBE, UNIFORM, compliance, truth_of
from scipy.optimize import least_squares
from scipy.signal import lfilter

sys.path.insert(0, str(Path(__file__).parents[1] / "reference"))
import relaxing_records

from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.cost import evaluate
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.measurements.curve import Curve
from jaxtrachea.mechanics.levels.options import Options

STEP, COUNT, PLACE = 0.05, 200, 75.0
TIMES = STEP * np.arange(COUNT)
BEGUN = {"gamma_1": {"value": 0.5}, "gamma_2": {"value": 0.5}, "tau_1": {"value": TAU[0]},
         "tau_ratio_2": {"value": TAU[1] / TAU[0]}}  # fmt: skip
CORNERS = np.array([0.0, 2.0, TIMES[-1]]), np.array([0.0, 4.0, 4.0])
WAY = np.interp(TIMES, *CORNERS)


def pressed(law, c):
    """Elastic force by Newton."""
    k_1, k_3, k_5 = law
    d = WAY / (1 + c * k_1)
    for _ in range(30):
        slope = 1 + c * (k_1 + 3 * k_3 * d**2 + 5 * k_5 * d**4)
        change = (d + c * (k_1 * d + k_3 * d**3 + k_5 * d**5) - WAY) / slope
        d = d - change
        if np.abs(change).max() < 1e-12:
            break
    return k_1 * d + k_3 * d**3 + k_5 * d**5


def model(theta, c):
    """Force: an elastic press and a filter for each branch."""
    elastic = pressed(np.exp(theta[:3]), c)
    force, moved = elastic, np.diff(elastic, prepend=0.0)
    for gamma, tau in zip(np.exp(theta[3:5]), np.exp(theta[5:7]), strict=True):
        kept = np.exp(-STEP / tau)
        force = force + lfilter([gamma * (1 - kept) * tau / STEP], [1, -kept], moved)
    return force


def by_scipy(force, c):
    """Logarithms of k_1, k_3, k_5, gamma and tau, and the sum of squares."""
    start = np.log(np.concatenate([LAW, [0.5, 0.5], TAU]))
    found = least_squares(lambda v: (model(v, c) - force) / force.max(), start)
    return found.x, np.sum((model(found.x, c) - force) ** 2)


def made(count, c):
    """Forces with noise, and the curves."""
    forces, curves = [], []
    for index in range(count):
        rng = np.random.default_rng(30_000 + index)
        truth = truth_of(rng)
        branches = truth["gamma"], truth["tau"]
        force, _ = relaxing_records.press(
            TIMES, CORNERS, c, truth["law"], branches, branches, accuracy=1e-7
        )
        forces.append(force + rng.normal(0, NOISE * force.max(), COUNT))
        curves.append(
            Curve(f"T{index:04d}", "1", PLACE, 0.0, WAY, forces[-1], time=TIMES, rise=(0, 41))
        )
    return forces, curves


def study_of(count):
    """The study of so many records."""
    return build_study(made(count, compliance(PLACE))[1], TUBE, UNIFORM, KNOWN | FREE | BEGUN)


def memory(study):
    """Bytes that residual and Jacobian of all lanes work in."""
    free = jax.numpy.zeros((len(study.lanes.s_c), len(study.model.free)))

    def of(free, lane):
        return evaluate(study.model, free, lane, jax.numpy.ones(2))

    compiled = jax.jit(jax.vmap(of)).lower(free, study.lanes).compile()
    return compiled.memory_analysis().temp_size_in_bytes


def main():
    """Print both."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--records", type=int, default=64)
    parser.add_argument("--scipy", type=int, default=6)
    asked = parser.parse_args()
    c = compliance(PLACE)
    forces, curves = made(asked.records, c)
    study = build_study(curves, TUBE, UNIFORM, KNOWN | FREE | BEGUN)
    settings = Settings(starts=1, more_starts=0, verify=False)
    seconds = []
    for _ in range(4):
        start = time.perf_counter()
        result = fit(study, settings)
        seconds.append(time.perf_counter() - start)
    ours = asked.records / min(seconds[1:])
    start = time.perf_counter()
    theirs = [by_scipy(force, c) for force in forces[: asked.scipy]]
    scipys = asked.scipy / (time.perf_counter() - start)
    names = [p.name for p, _, _ in study.unknowns[0]]
    cost = [
        float(np.sum((model(_theta(names, result.value[i]), c) - forces[i]) ** 2)) / theirs[i][1]
        for i in range(asked.scipy)
    ]
    print(f"{ours:.0f} fits a second, scipy {scipys:.2f}: {ours / scipys:.1f} x")
    print(f"sum of squares over that of scipy: {min(cost):.6f} to {max(cost):.6f}")
    elastic = build_study(curves, TUBE, Options(), KNOWN | FREE)
    print(f"working memory {memory(study)} bytes, elastic {memory(elastic)}")


def _theta(names, values):
    """Our numbers as those of the scipy model."""
    v = dict(zip(names, values, strict=True))
    tau = v["tau_1"], v["tau_1"] * v["tau_ratio_2"]
    return np.log([v["k_1"], v["k_3"], v["k_5"], v["gamma_1"], v["gamma_2"], *tau])


if __name__ == "__main__":
    main()
