"""The recorded errors off the midline are those of the model, and the page tells them."""

import importlib.util
import json
from pathlib import Path

import h5py
import jax.numpy as jnp
import numpy as np
import pytest
from run_cli import run

from jaxtrachea.config import load_fit_spec

ROOT = Path(__file__).parents[1]
VIRTUAL = ROOT / "fits" / "virtual_trachea"
RECORD = json.loads((VIRTUAL / "off_midline.json").read_text())


def load(path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


script = load(VIRTUAL / "off_midline.py")


def of(rings, fitted):
    return next(r for r in RECORD if (r["rings"], r["fitted"]) == (rings, fitted))


@pytest.mark.slow
@pytest.mark.compiling
def test_errors_are_the_recorded_ones():
    """Parameters as recorded, everything else computed: forces, side forces, joints, ends."""
    rings = "arch2"
    known = of(rings, "midline")
    found = script.summary(rings, "midline", known["parameters"], script.read())
    for one, two in zip(found["off"], known["off"], strict=True):
        for name, value in two.items():
            np.testing.assert_allclose(one[name], value, atol=1e-5, err_msg=name)
    for name, value in known["midline"].items():
        np.testing.assert_allclose(found["midline"][name], value, atol=1e-5)


def test_what_the_page_claims():
    """The sentences with numbers in docs/evidence/off_midline.md."""
    mat, arch, arch2 = (of(rings, "midline") for rings in ("mat", "arch", "arch2"))

    def at(r, phi):
        return [e for e in r["off"] if e["phi_c"] == phi]

    assert max(abs(e["compliance"]) for e in at(mat, 30)) < 0.025
    assert all(-0.15 < e["compliance"] < -0.13 for e in at(mat, 90))
    assert all(0.075 < e["compliance"] < 0.105 for e in at(arch2, 30))
    assert all(0.42 < e["compliance"] < 0.45 for e in at(arch2, 90))
    assert all(0.38 < e["side_force"] < 0.42 for e in at(arch2, 30))
    assert all(e["ends"] < 0.03 for e in at(arch2, 30))
    assert min(e["compliance"] for e in arch["off"]) > 0.6
    assert arch2["midline"]["ends"] < 0.013
    assert all(e["compliance"] > 0.23 for e in at(of("arch2", "all"), 90))


def test_the_page_begins_with_the_skeleton_for_it():
    """Its first paragraph names the option and a command; its verdicts are of a line of joints."""
    page = (ROOT / "docs" / "evidence" / "off_midline.md").read_text(encoding="utf-8")
    first = page.split("\n\n")[2]
    assert '`skeleton = "sections"`' in first
    assert "](../fit.md)" in first
    assert "jaxtrachea fit fits/virtual_trachea/off_midline.toml" in page.split("\n\n")[3]
    assert load_fit_spec(VIRTUAL / "off_midline.toml").model.skeleton == "sections"
    for words in ("No level is right", "fits of this model"):
        assert words not in page


@pytest.mark.slow
@pytest.mark.compiling
def test_the_fit_of_sections_errs_as_the_page_says(tmp_path, monkeypatch, capsys):
    """The command of the page, its force, side force, joints and ends against finite elements."""
    spec, out = VIRTUAL / "off_midline.toml", tmp_path / "out"
    assert run(monkeypatch, capsys, "fit", spec, "--out", out)[0] == 0
    with h5py.File(out / "results.h5") as file:
        data = {name: values[()] for name, values in file["data"].items()}
    most = largest_errors(data)
    # As on the page and in docs/evidence/measured.md.
    page = {"30 deg": 2.87, "90 deg": 3.57, "0 deg": 1.93, "s = 22": 2.44}
    for name, percent in page.items():
        assert 100 * most[name] == pytest.approx(percent, abs=0.1), name
    assert most["side"] < 0.07
    assert 100 * max(most[n] for n in most if n.endswith("residual")) < 4.45


def largest_errors(data):
    """Normal force over its peak by place, side over normal force, rms of markers over D."""
    most = {}
    for s_c, phi, rows in zip(data["s_c"], np.rad2deg(data["phi_c"]), slices(data), strict=True):
        curve = {n: v[rows] for n, v in data.items() if len(v) == data["samples"].sum()}
        force, normal, D = (curve[n] for n in ("force", "predicted", "displacement"))
        place = "s = 22" if round(s_c) == 22 else f"{round(phi)} deg"
        found = {place: np.abs(normal - force).max() / force.max()}
        if round(phi):
            deep = D >= 0.5
            side, measured = (curve[n][deep] for n in ("side_predicted", "side_force"))
            found["side"] = np.abs(side / normal[deep] - measured / force[deep]).max()
        else:
            curve["joint_side_residual"] = np.zeros(len(D))  # 0 by symmetry, not measured
        for name in ("joint_residual", "joint_side_residual", "end_residual"):
            error = curve[name].reshape(len(D), -1)[D > 0] / D[D > 0, None]
            found[name] = np.sqrt(np.nanmean(error**2, axis=1)).max()
        most = {name: max(most.get(name, 0), found.get(name, 0)) for name in most | found}
    return most


def slices(data):
    """Rows of each curve."""
    ends = np.cumsum(data["samples"])
    return [slice(end - count, end) for end, count in zip(ends, data["samples"], strict=True)]


def test_page_holds_the_recorded_numbers():
    page = (ROOT / "docs" / "evidence" / "off_midline.md").read_text(encoding="utf-8")
    assert page == script.document(RECORD)


def test_frame_of_the_data():
    """Mirror symmetry of the midline data: no side force, U and V alike; y inward is negative."""
    data = script.read()
    middle = data["phi_c"] == 0
    np.testing.assert_allclose(data["force"][middle][:, 2], 0, atol=1e-6)
    flip = np.array([1, 1, -1])
    np.testing.assert_allclose(data["end_U"][middle], data["end_V"][middle] * flip, atol=1e-9)
    assert np.all(data["force"][middle][:, 1] < 0)
    force = script.measured(data)[0]
    assert np.all(force[:, 0] > 0.5)
    assert jnp.asarray(force).dtype == jnp.float64
