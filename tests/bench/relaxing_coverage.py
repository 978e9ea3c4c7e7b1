"""How often intervals of a relaxation hold, and what is told where they cannot.

    python tests/bench/relaxing_coverage.py [--records 200] [--only coverage,parts,short]

Records by a differential equation (`tests/reference/relaxing_records.py`): a rest, a ramp of 2 s
to 4 mm, a hold of 28 s, an unloading of 2 s; 200 samples, noise 0.3 % of the peak; k_1, k_3, k_5
and two branches log-normal (10 %) about 0.3, 0.02, 0.003; gamma 0.9 and 0.5, tau 0.36 and 4.3 s.

coverage: one position each, k_1, k_3, k_5 and the four numbers of the relaxation fitted by
    `uniform`: of the truths how many the 95 % intervals hold.
parts: two positions each; the local law alone relaxes, or the skeleton alone, fitted by `uniform`
    (with the noise given): of how many records the misfit is told.
short: records that end before tau_2 (20 s; 8 s recorded): how often gamma_2 and tau_2 are called
    identifiable.
"""

import argparse
import dataclasses
import sys
import time
from collections import Counter
from pathlib import Path

import common  # noqa: F401  (pins one core, before numpy and jax)
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "reference"))
import beam_fem
import relaxing_records

from jaxtrachea.fitting.assessment import assess
from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.lanes import Noise
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.measurements.curve import Curve
from jaxtrachea.mechanics.levels.options import Options
from jaxtrachea.trachea.geometry import Geometry

RINGS, LENGTH, EI, K_M = np.arange(10.0, 151.0, 10.0), 160.0, 20.0, 0.3
TUBE = Geometry.create(LENGTH, RINGS.tolist())
NOISE, SPREAD, DEPTH = 0.003, 0.1, 4.0
LAW, GAMMA, TAU = np.array([0.3, 0.02, 0.003]), np.array([0.9, 0.5]), np.array([0.36, 4.3])
#: Places in the middle, between two rings, and near the end: 2.5 and 0.7 mm/N.
PLACES = (75.0, 5.0)
#: Onset and offset of the records are 0; the skeleton is known.
KNOWN = {
    "EI_L": {"fixed": True, "value": EI}, "k_M": {"fixed": True, "value": K_M},
    "onset": {"fixed": True, "value": 0.0}, "force_offset": {"fixed": True, "value": 0.0},
}  # fmt: skip
FREE = {name: {"value": v} for name, v in zip(("k_1", "k_3", "k_5"), LAW, strict=True)}
UNIFORM = Options(relaxation="uniform")


def compliance(place):
    """Of the skeleton, by the finite-element beam, mm/N."""
    solved = beam_fem.solve(
        RINGS.tolist(), LENGTH, [EI] * (len(RINGS) + 1), [K_M] * len(RINGS), place, 1.0
    )
    return float(solved.w_C)


def record(name, place, c, truth, hold, rng, parts=(True, True)):
    """One record; `parts`: whether the local law relaxes, and the skeleton."""
    corners = (
        np.cumsum([0.0, 1.0, 2.0, hold, 2.0]),
        np.array([-0.5, 0.0, DEPTH, DEPTH, 0.5 * DEPTH]),
    )
    t = np.unique(np.concatenate([
        np.linspace(0, 3, 80), 3 + np.geomspace(0.02, hold, 80),
        np.linspace(*corners[0][-2:], 40),
    ]))  # fmt: skip
    branches = truth["gamma"], truth["tau"]
    none = np.zeros(2), branches[1]
    force, _ = relaxing_records.press(
        t, corners, c, truth["law"], *(branches if p else none for p in parts), accuracy=1e-7
    )
    sigma = NOISE * force.max()
    noisy = force + rng.normal(0, sigma, len(t))
    D = np.interp(t, *corners)
    return Curve(name, "1", place, 0.0, D, noisy, time=t, rise=(0, 80)), sigma


def truth_of(rng, tau_2=None):
    """Numbers of one specimen."""

    def around(v):
        return v * np.exp(SPREAD * rng.standard_normal(v.shape))

    tau = around(TAU)
    if tau_2 is not None:
        tau[1] = tau_2
    return {"law": around(LAW), "gamma": around(GAMMA), "tau": tau}


def numbers(truth):
    """By the names of the fit."""
    return {
        **dict(zip(("k_1", "k_3", "k_5"), truth["law"], strict=True)),
        "gamma_1": truth["gamma"][0], "gamma_2": truth["gamma"][1],
        "tau_1": truth["tau"][0], "tau_ratio_2": truth["tau"][1] / truth["tau"][0],
    }  # fmt: skip


def fitted(curves, noise=Noise()):
    """Fit of all records in one study."""
    start = time.perf_counter()
    study = build_study(curves, TUBE, UNIFORM, KNOWN | FREE, noise=noise)
    result = fit(study, Settings(starts=2))
    print(f"  {result.lanes} fits in {time.perf_counter() - start:.0f} s", flush=True)
    return result


def intervals(result, truths):
    """Intervals that hold the truth, and all, by name; verdicts by name."""
    held, verdicts = Counter(), Counter()
    for lane in range(result.lanes):
        true = numbers(truths[result.study.lane_name(lane)[0]])
        for i, (p, _, _) in enumerate(result.study.unknowns[lane]):
            found = assess(result, lane, i)
            held[p.name, bool(found.low <= true[p.name] <= found.high)] += 1
            verdicts[p.name, found.verdict] += 1
    return held, verdicts


def coverage(count, c):
    """Print how many intervals hold, by parameter."""
    truths, curves = {}, []
    for index in range(count):
        rng = np.random.default_rng(index)
        name = f"T{index:04d}"
        truths[name] = truth_of(rng)
        curves.append(record(name, PLACES[0], c[0], truths[name], 28.0, rng)[0])
    result = fitted(curves)
    held, verdicts = intervals(result, truths)
    print(f"coverage, {count} records; status {Counter(map(int, result.status))}")
    for p, _, _ in result.study.unknowns[0]:
        words = {word: n for (name, word), n in verdicts.items() if name == p.name}
        print(f"  {p.name:12s} held {100 * held[p.name, True] / count:5.1f} %  {words}", flush=True)


def apart(count, c):
    """Print how often the misfit of records with one relaxing part is told."""
    for part, relaxes in (("local law", (True, False)), ("skeleton", (False, True))):
        curves = []
        for index in range(count):
            rng = np.random.default_rng(10_000 + index)
            truth = truth_of(rng)
            for k, place in enumerate(PLACES):
                curve, own = record(f"T{index:04d}", place, c[k], truth, 28.0, rng, relaxes)
                curves.append(dataclasses.replace(curve, sigma=np.full(len(curve.time), own)))
        result = fitted(curves)
        by_noise, by_shape = result.misfit.flagged[:, 0], result.effective.misses
        told = by_noise | by_shape
        print(
            f"parts, {part} alone relaxes, {result.lanes} specimens: "
            f"told {100 * told.mean():.1f} % "
            f"(by the noise given {100 * by_noise.mean():.1f}, by correlation "
            f"{100 * by_shape.mean():.1f}); residuals over noise, median "
            f"{np.median(result.misfit.ratio[:, 0]):.2g}",
            flush=True,
        )


def short(count, c):
    """Print verdicts on the second branch of records that end before its time."""
    truths, curves = {}, []
    for index in range(count):
        rng = np.random.default_rng(20_000 + index)
        name = f"T{index:04d}"
        truths[name] = truth_of(rng, tau_2=20.0)
        curves.append(record(name, PLACES[0], c[0], truths[name], 5.0, rng)[0])
    result = fitted(curves)
    held, verdicts = intervals(result, truths)
    print(f"short, {count} records of 10 s, tau_2 20 s")
    for name in ("k_1", "gamma_1", "tau_1", "gamma_2", "tau_ratio_2"):
        words = {word: n for (p, word), n in verdicts.items() if p == name}
        print(f"  {name:12s} held {100 * held[name, True] / count:5.1f} %  {words}", flush=True)


def main():
    """Print what was asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--records", type=int, default=200)
    parser.add_argument("--only", default="coverage,parts,short")
    asked = parser.parse_args()
    c = [compliance(place) for place in PLACES]
    print("compliances", c)
    for name, run in (("coverage", coverage), ("parts", apart), ("short", short)):
        if name in asked.only.split(","):
            run(asked.records, c)


if __name__ == "__main__":
    main()
