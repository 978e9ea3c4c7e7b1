"""The explorer of report.html: its numbers against real refits, its page in a real browser."""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest

from jaxtrachea.cli.specification import settings_of, study_of, usable
from jaxtrachea.config import load_fit_spec
from jaxtrachea.files.html import page
from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.parameters import DEFAULTS
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.inference.influence import influence
from jaxtrachea.measurements.data_files import read_data
from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.press import Options
from jaxtrachea.report.explorer import explorer
from jaxtrachea.trachea.geometry import table_1

VIRTUAL = Path(__file__).parents[1] / "fits" / "virtual_trachea"
DEPTH = np.linspace(0.1, 2, 12)
ONE = Settings(starts=1, more_starts=0)
#: A specimen whose name would run a script if it were markup.
HOSTILE = "<img src=x onerror=alert(1)></script>"


def study_without(*gone):
    """Two specimens with four presses each on a linear law; without the trials `gone`."""
    free = {"lower": -1e3, "scale": "linear", "scope": "specimen", "value": 1.0}
    table = [dataclasses.replace(DEFAULTS[n], **free) for n in ("k_1", "k_3")]
    curves = []
    for i, specimen in enumerate((HOSTILE, "T2")):
        for t in range(4):
            noise = 0.05 * np.random.default_rng(10 * i + t).normal(size=DEPTH.size)
            force = (1 + 0.1 * t) * DEPTH + 0.1 * DEPTH**3 + noise
            curves.append(Curve(specimen, f"s{20 + 30 * t}", 20.0 + 30 * t, 0.0, DEPTH, force))
    curves = [c for c in curves if c.trial not in gone]
    options = Options(coupling="total", contact="bonded", onset_width=0.0)
    rest = [DEFAULTS[n] for n in ("onset", "force_offset")]
    return build_study(curves, table_1(), options, [*table, *rest])


@pytest.fixture(scope="module")
def found():
    return influence(fit(study_without(), ONE))


@pytest.fixture(scope="module")
def section(found):
    return explorer(found, "jaxtrachea fit 'a b.toml'", ["T9/s1"])


def data_of(section):
    (text,) = re.findall(r'id="explorer-data">(.*?)</script>', section, re.S)
    return json.loads(text)


def moved(data, lane, trial):
    """Estimates of the page where a curve is left out, by label."""
    curve = next(c for c in data["curves"] if c["lane"] == lane and c["name"].endswith(f"/{trial}"))
    return {
        u["label"]: u["value"] * np.exp(m * u["se"]) if u["log"] else u["value"] + m * u["se"]
        for u, m in zip(data["unknowns"][lane], curve["moves"], strict=True)
        if m is not None
    }


@pytest.mark.long
@pytest.mark.parametrize("trial", ["s20", "s80"])
def test_estimates_of_a_linear_fit_are_those_of_a_refit(section, trial):
    """One Newton step is exact where the model is linear; the page has five digits."""
    data, refit = data_of(section), fit(study_without(trial), ONE)
    for lane, name in enumerate(data["lanes"]):
        row = [c[0].specimen for c in refit.study.curves].index(name)
        said = moved(data, lane, trial)
        se = [u["se"] for u in data["unknowns"][lane]]
        np.testing.assert_allclose(list(said.values()), refit.value[row], atol=2e-4 * max(se))
        change = [abs(said[u["label"]] - u["value"]) / u["se"] for u in data["unknowns"][lane]]
        assert max(change) > 0.1  # it does move


@pytest.mark.slow
@pytest.mark.compiling
def test_estimates_of_a_skeleton_are_near_those_of_a_refit(virtual):
    """Within half a standard error of a fit with data.exclude."""
    (data, spec), trial = virtual, "s022.0"
    said = moved(data, 0, trial)
    left = spec.data.model_copy(update={"exclude": [f"virtual/{trial}"]})
    refit = fitted(spec.model_copy(update={"data": left}))
    for i, (p, _, _) in enumerate(refit.study.unknowns[0]):
        unknown = next(u for u in data["unknowns"][0] if u["label"] == p.name)
        if p.name in said:
            off = np.log(said[p.name] / refit.value[0, i]) / unknown["se"]
            assert abs(off) < 0.5, (p.name, off)
    assert {"EI_L", "GA_L", "k_M", "k_1"} <= set(said)


def fitted(spec):
    study = study_of(spec, usable(spec, read_data(spec, VIRTUAL)), refits=True)
    return fit(study, settings_of(spec))


@pytest.fixture(scope="module")
def virtual():
    spec = load_fit_spec(VIRTUAL / "fit.toml")
    return data_of(explorer(influence(fitted(spec)), "")), spec


def test_lanes_of_one_curve_have_no_explorer(found):
    study = found.result.study
    alone = dataclasses.replace(study, curves=tuple(lane[:1] for lane in study.curves))
    result = dataclasses.replace(found.result, study=alone)
    assert explorer(dataclasses.replace(found, result=result), "") == ""


def test_of_many_curves_the_worst_fits_stand_in_it(found, monkeypatch):
    monkeypatch.setattr("jaxtrachea.report.explorer.CURVES", 4)
    section = explorer(found, "")
    assert len(data_of(section)["curves"]) == 4
    assert "The 1 worst fits, and 1 more in the file." in section


def test_the_page_in_a_browser(section, tmp_path):
    """A curve lights up everywhere; a click leaves it out; nothing is asked for, names are text."""
    pytest.importorskip("websockets")
    from browser import CHROMIUM, Browser

    if CHROMIUM is None:
        pytest.skip("no Chromium here")
    escaped = HOSTILE.replace("<", "\\<")
    table = f"| specimen | curve |\n| --- | --- |\n| {escaped} | s50 |\n| T2 | s50 |\n"
    text = f"# T\n\n✓ Fine.\n\n## Estimates\n\n{table}"
    (tmp_path / "report.html").write_text(page(text, {}, {}, explorer=section))
    data = data_of(section)
    lane = data["lanes"].index("T2")
    window = Browser()
    try:
        window.go((tmp_path / "report.html").as_uri())
        window.wait("document.querySelectorAll('#explorer g.curve').length == 8")
        window.run(
            f"(c => {{ c.value = {lane}; c.dispatchEvent(new Event('change')); }})"
            "(document.getElementById('explorer-choice'))"
        )
        assert len(data["lanes"]) == 2
        point = "document.querySelectorAll('#explorer g.curve')[1].dispatchEvent"
        window.run(f"{point}(new PointerEvent('pointerenter'))")
        # Force, residual, row of the explorer, row of the report.
        assert window.run("document.querySelectorAll('.lit').length") == 4
        assert window.run("document.getElementById('explorer-name').textContent") == "T2 s50"
        window.run(f"{point}(new PointerEvent('pointerleave'))")
        assert window.run("document.querySelectorAll('.lit').length") == 0
        window.run("document.querySelectorAll('#explorer g.curve')[1].dispatchEvent"
                   "(new MouseEvent('click'))")  # fmt: skip
        assert window.run("document.querySelectorAll('tr.out').length") == 2
        cells = window.run(
            "[...document.querySelectorAll('#explorer-estimates tbody tr')]"
            ".map(row => Number(row.cells[2].textContent))"
        )
        assert cells == [float(f"{v:.4g}") for v in moved(data, lane, "s50").values()]
        line = window.run("document.getElementById('explorer-toml').textContent")
        assert 'exclude = ["T9/s1", "T2/s50"]' in line
        assert line.endswith("jaxtrachea fit 'a b.toml'")
        window.run("document.querySelectorAll('#explorer tbody input')[1].click()")
        assert "Click a curve" in window.run("document.getElementById('explorer-toml').textContent")
        assert window.run("document.querySelectorAll('.out').length") == 0
        assert window.errors == []
        assert all(r.startswith(("file:", "data:")) for r in window.requests)
        assert window.run("document.querySelectorAll('main img').length") == 0
        assert window.run("document.querySelector('p.good').textContent") == "✓ Fine."
    finally:
        window.close()
