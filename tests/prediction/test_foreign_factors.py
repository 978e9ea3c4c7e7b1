"""Predictions of fits whose fixed values come from the factors of another tube."""

import dataclasses

import numpy as np
import pytest

import jaxtrachea
from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.lanes import Noise
from jaxtrachea.fitting.parameters import defaults_of
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.inference.analysis import AnalysisResults
from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.press import Options
from jaxtrachea.mechanics.sections.material import FROM_FACTORS
from jaxtrachea.results.hdf5 import write_hdf5
from jaxtrachea.status import PredictionStatus
from jaxtrachea.trachea.geometry import Geometry

pytestmark = pytest.mark.compiling
#: Of one ring: pitch over radius 1.28, of the specimen of the factors 0.85.
TUBE = Geometry.create(30.0, [10.0, 20.0], radius=7.8)
SECTIONS = Options(skeleton="sections", contact="bonded")
FIXED = ("bed_n", "bed_t", "Et_L", "D_L", "c_W")


def table(**more):
    return {name: {"fixed": True} for name in FIXED} | more


def study(**more):
    D = np.linspace(0.5, 2.0, 4)
    curve = Curve("one", "a", 15.0, 0.0, D, 0.4 * D)
    return build_study([curve], TUBE, SECTIONS, table(**more), noise=Noise(force=0.01))


def test_values_at_what_foreign_factors_give_are_known():
    """Not those that are free, or fixed at numbers of this tube."""
    assert [p.name for p in study().parameters if p.foreign] == sorted(
        FROM_FACTORS, key=[p.name for p in study().parameters].index
    )
    own = {name: {"fixed": True, "value": 1.5} for name in FROM_FACTORS[1:]}
    some = study(Et_M={"fixed": False}, **own)
    assert not [p.name for p in some.parameters if p.foreign]
    specimen = Geometry.create(160.0, 10.0 * np.arange(1, 16), radius=11.7, ring_height=4.0)
    assert not [p for p in defaults_of(SECTIONS, specimen).values() if p.foreign]
    wide = dataclasses.replace(SECTIONS, half_width=2.4)
    assert {n for n, p in defaults_of(wide, specimen).items() if p.foreign} == set(FROM_FACTORS)


@pytest.mark.slow
def test_a_press_unlike_those_of_the_fit_is_extrapolated(tmp_path):
    """At the place of the fit no deeper than there it is not; of a stored fit."""
    once = Settings(starts=1, more_starts=0, verify=False)
    result = fit(study(), once)
    write_hdf5(tmp_path / "r.h5", AnalysisResults(result), {})
    read = jaxtrachea.read_results(tmp_path / "r.h5")
    for s, D, expected in ((15.0, 2.0, False), (15.0, 2.5, True), (12.0, 1.0, True)):
        got = jaxtrachea.predict(read, s=s, displacement=[D / 2, D])
        assert (got.status == PredictionStatus.EXTRAPOLATED) == expected, (s, D, got.message)
        assert ("fixed: Et_M, Gt_L" in got.message) == expected, (s, D)
