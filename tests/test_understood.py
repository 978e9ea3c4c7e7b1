"""The lines on tube, model and onset: what they say, and where the tube is a warning."""

import dataclasses

import numpy as np
import pytest

from jaxtrachea.config import FitSpec
from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.parameters import defaults_of, in_model
from jaxtrachea.measurements.curve import Curve
from jaxtrachea.mechanics.press import Options
from jaxtrachea.mechanics.sections.material import Wall
from jaxtrachea.report.understood import foreign_factors, model_words, onset_words, tube_line
from jaxtrachea.trachea.section import geometry_of

D = np.linspace(0, 1, 10)
GIVEN = {"length": "100 mm", "rings": {"count": 8, "first": "8 mm", "last": "92 mm"}}
#: Positions on the rings of a tube of 100 mm, its rings 12 mm apart.
SHORT = (32.0, 44.0, 56.0, 68.0)
WHOLE = (30.0, 60.0, 90.0, 120.0)


def curve(s, **more):
    return Curve("T", f"{s}", s, 0.0, D, D, **more)


def marked(s, moved_at, geometry):
    """Three markers, of which the one nearest to `moved_at` moves most."""
    x = np.asarray(geometry.ring_positions)
    moved = np.exp(-np.abs(x - moved_at) / 20)
    return curve(s, joint_rings=np.arange(x.size), joint_displacement=D[:, None] * moved)


def line(trachea, curves, **model):
    sections = {"data": {"files": "x.csv"}} | ({} if trachea is None else {"trachea": trachea})
    spec = FitSpec.model_validate(sections)
    return tube_line(spec, geometry_of(spec.trachea), Options(**model), curves)


@pytest.mark.parametrize(
    ("trachea", "positions", "begins", "says"),
    [
        (None, WHOLE, "Tube: 160 mm long, 15 rings from 10 to 150 mm", "since [trachea] is left"),
        ({"radius": "9 mm"}, WHOLE, "Tube: 160 mm", "length and rings of Table 1, since"),
        (None, SHORT, "Warning: tube: 160 mm", "all positions lie in 32 to 68 mm of these 160 mm"),
        (None, SHORT, "Warning", "positions are 12 mm apart, its rings 10 mm: give [trachea]"),
        (None, (26.0, 62.0, 98.0, 134.0), "Tube: 160", "left out)"),
        (None, (24.0, 36.0, 48.0, 120.0), "Warning", "12 mm apart"),
        (None, (130.0,), "Warning", "all positions lie at 130 mm"),
        ({"preset": "table-1"}, SHORT, "Tube: 160 mm", "(Table 1, as preset says)"),
        (GIVEN, SHORT, "Tube: 100 mm long, 8 rings from 8 to 92 mm", "(as [trachea] says)"),
    ],
)
def test_tube(trachea, positions, begins, says):
    text = line(trachea, [curve(s) for s in positions])
    assert text.startswith(begins)
    assert says in text


def test_markers_that_move_elsewhere():
    geometry = geometry_of(FitSpec.model_validate({"data": {"files": "x"}}).trachea)
    good = [marked(s, s, geometry) for s in WHOLE]
    assert line(None, good).startswith("Tube")
    off = [marked(s, s + 36.0, geometry) for s in (30.0, 60.0, 75.0, 112.0)]
    text = line({"preset": "table-1"}, off)
    assert text.startswith("Warning")
    assert "in 4 of 4 curves markers move most away from the tool" in text


def test_without_a_tube():
    assert line(None, [curve(None)], coupling="total").startswith("Tube: none")


def test_model_and_onset():
    options = Options(shear=True, local="two-material", contact="bonded", half_width=2.0)
    words = (
        "skeleton linear, with shear, indentation and skeleton in series, local law two-material"
    )
    assert model_words(options).startswith(words)
    assert model_words(options).endswith("a punch of half width 2 mm, bonded to the wall")
    geometry = geometry_of(FitSpec.model_validate({"data": {"files": "x"}}).trachea)
    defaults = defaults_of(Options(), geometry, None)
    table = [defaults[name] for name in in_model(Options(), joints=False)]
    held = [
        dataclasses.replace(p, fixed=True, auto=False) if p.name == "onset" else p for p in table
    ]
    assert "fixed at 0 mm" in onset_words(held)
    free = [dataclasses.replace(p, fixed=p.name != "onset", auto=False) for p in table]
    assert onset_words(free).startswith("fitted, one a trial; force offset: ")


#: The specimen of the factors, as a specification says it.
SPECIMEN = {"radius": "11.7 mm", "ring_height": "4 mm"}


def factors_line(trachea, wall=None, half_width=0.0, **fixed):
    """What is said of a fit with deforming cross-sections, and its warning's first words."""
    tables = {"trachea": SPECIMEN | trachea, "model": {"skeleton": "sections", "contact": "bonded"}}
    moduli = None if wall is None else {name: f"{v} MPa" for name, v in wall.items()}
    spec = FitSpec.model_validate({"data": {"files": "x.csv"}, "wall": moduli} | tables)
    geometry = geometry_of(spec.trachea)
    options = Options(skeleton="sections", contact="bonded", half_width=half_width)
    begun = defaults_of(options, geometry, None if wall is None else Wall(**wall))
    table = [dataclasses.replace(p, **fixed.get(p.name, {})) for p in begun.values()
             if p.name in in_model(options, joints=False)]  # fmt: skip
    return foreign_factors(spec, build_study([curve(75.0)], geometry, options, table))


def test_values_that_the_factors_of_another_tube_give_are_said():
    assert factors_line({}) == []
    (said,) = factors_line({"half_angle": "100 deg"})
    assert said.startswith("Warning: Et_M, Gt_L, k_end, footprint, c_t, c_t_ring stay fixed")
    assert "virtual specimen (no [wall])" in said
    assert "(half-angle of a ring in rad is 1.75, there 2.09)" in said
    (said,) = factors_line({}, {"E_C": 9.0})
    assert (
        "[wall] and the factors of another specimen give (E_C over E_L is 13.8, there 8.92)" in said
    )
    free, own = {"fixed": False}, {"value": 3.1}
    changed = {"Et_M": free, "Gt_L": own, "k_end": own, "c_t": own, "c_t_ring": own}
    (said,) = factors_line({}, {"E_C": 9.0}, **changed)
    assert said.startswith("Warning: footprint stay")
    assert factors_line({}, {"E_C": 9.0}, footprint=own, **changed) == []
    (said,) = factors_line({}, half_width=2.4)
    assert "(they were found with a tool that touches at a point)" in said


def test_a_line_of_joints_has_no_factors():
    spec = FitSpec.model_validate({"data": {"files": "x.csv"}})
    study = build_study([curve(75.0)], geometry_of(spec.trachea), Options())
    assert foreign_factors(spec, study) == []
