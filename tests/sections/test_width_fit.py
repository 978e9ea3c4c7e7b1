"""A fit and a scene with a flat punch on deforming cross-sections.

Records are of `press_sections`, whose punch is the line of joints' where rings are rigid
(test_press.py), with noise.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrachea import EffectOptions, Presses, make_scene, simulate
from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.lanes import Noise
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.press import Options
from jaxtrachea.mechanics.sections.material import SECTION_VALUES, from_wall
from jaxtrachea.mechanics.sections.press import SectionOptions, press_sections
from jaxtrachea.status import FitStatus, PressStatus
from jaxtrachea.trachea.geometry import Geometry

pytestmark = [pytest.mark.compiling, pytest.mark.slow]
TUBE = Geometry.create(30.0, [10.0, 20.0], radius=11.7)
HALF, SIGMA = 2.4, 0.01
TRUTH = {"EI_C": 31.0, "bed_n": 0.013}
WALL = from_wall(TUBE, half_width=HALF)
TRUE = dataclasses.replace(WALL, **{k: jnp.asarray(v) for k, v in TRUTH.items()})
PLACES = jnp.asarray([15.0, 8.0, 11.0])
PATH = np.linspace(0.5, 3.0, 6)


@pytest.fixture(scope="module")
def pressed():
    """Force along the inward normal of a punch at each of the places; (3, 6)."""
    options = SectionOptions(midline=True, half_width=HALF)

    def one(s):
        return press_sections(TUBE, TRUE, s, 0.0, jnp.asarray(PATH), options=options).force

    return -np.asarray(jax.jit(jax.vmap(one))(PLACES))[..., 1]


def test_estimates_of_a_fit_with_the_width_are_within_their_intervals(pressed):
    rng = np.random.default_rng(4)
    curves = [
        Curve("one", f"{s:g}", float(s), 0.0, PATH, force + SIGMA * rng.normal(size=len(PATH)))
        for s, force in zip(PLACES, pressed, strict=True)
    ]
    table = {
        name: {"fixed": True, "value": float(np.median(getattr(WALL, name)))}
        for name in SECTION_VALUES
        if name not in TRUTH
    }
    options = Options(skeleton="sections", contact="bonded", half_width=HALF)
    study = build_study(curves, TUBE, options, table, noise=Noise(force=SIGMA))
    result = fit(study, Settings(starts=1, more_starts=0, verify=False))
    assert result.status.tolist() == [FitStatus.CONVERGED]
    names = [p.name for p in study.free]
    assert names == list(TRUTH)
    truth = list(TRUTH.values())
    assert np.all((result.lower[0] < truth) & (truth < result.upper[0]))
    assert abs(result.value[0, 0] / truth[0] - 1) < 0.01


def test_rows_of_a_scene_are_presses_of_the_punch(pressed):
    depth = PATH[[1, 3, 5]]
    D = np.stack([0 * depth, -depth, 0 * depth], 1)
    path = Presses(np.asarray(PLACES), 0 * depth, D)
    effects = EffectOptions(want_surface=False, contact="bonded", half_width=HALF)
    scene = make_scene(TUBE, TRUE, path, effects=effects)
    out = jax.jit(simulate)(scene, TRUE, path)
    # Its factors were found with a point: the rows say so.
    assert out.status.tolist() == [PressStatus.EXTRAPOLATED] * 3
    np.testing.assert_allclose(-out.force[:, 1], pressed[np.arange(3), [1, 3, 5]], rtol=1e-9)
