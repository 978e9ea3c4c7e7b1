"""The lines on tube, model and onset: what they say, and where the tube is a warning."""

import dataclasses

import numpy as np
import pytest

from jaxtrachea.config import FitSpec
from jaxtrachea.fitting.parameters import defaults_of, in_model
from jaxtrachea.measurements.curve import Curve
from jaxtrachea.mechanics.press import Options
from jaxtrachea.report.understood import model_words, onset_words, tube_line
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
