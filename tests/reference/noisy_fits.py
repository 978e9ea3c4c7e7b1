"""Fits of noisy specimens of one known truth, pressed by an independent beam, and stored."""

import beam_fem
import numpy as np
import synthetic

from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.inference.analysis import AnalysisResults
from jaxtrachea.results.hdf5 import write_hdf5
from jaxtrachea.trachea.geometry import table_1

TRUTH = np.array([300.0, 1.0, 0.5, 0.2])
DEPTHS = np.linspace(0.1, 6.0, 25)
SEEN, UNSEEN = (22.0, 45.0, 75.0, 80.0), (61.0, 107.0)
LANES = 24
NOISE = 0.02


def true_force(s, depths=DEPTHS):
    """Force from the finite-element beam and the local law, by bisection; shares nothing."""
    EI, k_M, k_1, k_3 = TRUTH
    x = np.asarray(table_1().ring_positions)
    c = float(beam_fem.solve(x, 160.0, [EI] * 16, [k_M] * 15, s, 1.0).w_C)

    def law(d):
        return k_1 * d + k_3 * d**3

    low, high = np.zeros_like(depths), depths.copy()
    for _ in range(80):
        middle = 0.5 * (low + high)
        deep = middle + c * law(middle) > depths
        low, high = np.where(deep, low, middle), np.where(deep, middle, high)
    return law(low)


def noisy_study(folder, noise, lanes, seed):
    """Specimens of one truth with noise of their own, pressed at four places; stored."""
    rng = np.random.default_rng(seed)
    force = np.stack([true_force(s) for s in SEEN])
    force = force + noise * rng.normal(size=(lanes, *force.shape))
    changes = {n: {"value": float(v)} for n, v in zip(synthetic.NAMES, TRUTH, strict=True)}
    curves = synthetic.curves(force, np.array(SEEN), DEPTHS)
    table = synthetic.parameters(**changes)
    result = fit(
        build_study(curves, table_1(), synthetic.OPTIONS, table), Settings(starts=1, verify=False)
    )
    write_hdf5(folder / "results.h5", AnalysisResults(result), {"inputs": {"a.csv": "0" * 64}})
    return result
