"""Hardening curves F = k_1 D + k_3 D^3 of a model that is linear in both, and their stored fits."""

import dataclasses

import numpy as np

import jaxtrachea
from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.parameters import DEFAULTS
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.inference.analysis import AnalysisResults
from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.press import Options
from jaxtrachea.results.hdf5 import write_hdf5
from jaxtrachea.trachea.geometry import table_1

TOTAL = Options(coupling="total", onset_width=0.0)


def pairs(onset=0.0):
    """Two trials of two specimens, k_1 D + 0.1 D^3 with noise; trial b 2 % stiffer."""
    rng = np.random.default_rng(5)
    depth = np.linspace(0.05, 2, 30)
    for i, name in enumerate(("T1", "T2")):
        for trial, factor in (("a", 1.0), ("b", 1.02)):
            d = np.maximum(depth - onset, 0)
            force = factor * ((1.0 + i) * d + 0.1 * d**3) + 0.01 * rng.normal(size=30)
            yield Curve(name, trial, None, 0.0, depth, force)


def total_study(curves, more=None, **settings):
    """F = k_1 D + k_3 D^3, linear in both."""
    straight = {"scale": "linear", "lower": 0.0}
    changes = {"k_1": straight, "k_3": straight} | (more or {})
    names = ["k_1", "k_3", "onset", "force_offset"]
    named = {n: {"auto": False} | change for n, change in changes.items()}
    table = [dataclasses.replace(DEFAULTS[n], **named.get(n, {})) for n in names]
    return build_study(list(curves), table_1(), TOTAL, table, **settings)


#: Always two lanes at once, so that one program serves.
TWO = Settings(starts=1, batch=2, verify=False)


def stored_again(study, path):
    """A fit of a study, written and read."""
    result = fit(study, TWO)
    write_hdf5(path, AnalysisResults(result), {})
    return jaxtrachea.read_results(path)
