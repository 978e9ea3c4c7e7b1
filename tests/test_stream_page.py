"""The page of a fit: samples one by one, intervals that shrink; guarded as that of a scene."""

import time
from pathlib import Path

import numpy as np
import pytest
import synthetic

pytest.importorskip("nicegui", reason="the extra 'viewer' is not installed")
from browser import CHROMIUM, Browser
from page_server import Server

from jaxtrachea.cli.view import _experiment

#: An experiment: EI_L, k_M, k_1, k_3, and its specification.
TRUTH, DEPTHS = np.array([300.0, 1.0, 0.5, 0.2]), np.linspace(0.5, 6.0, 12)
FIT = """[data]
files = "curves.csv"
[noise]
force = "0.02 N"
[parameters]
onset = { fixed = 0.0 }
force_offset = { fixed = 0.0 }
"""


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
@pytest.mark.long
def test_a_fit_sample_by_sample(tmp_path):
    """It pauses, steps and settles; intervals shrink; the page is guarded as that of a scene."""
    force = synthetic.forces(TRUTH[None], displacement=DEPTHS)[0][0]
    force = force + 0.02 * np.random.default_rng(0).normal(size=force.shape)
    presses = enumerate(zip(synthetic.S_C, force, strict=True))
    rows = [f"T1,p{i},{s},{d},{f}" for i, (s, row) in presses
            for d, f in zip(DEPTHS, row, strict=True)]  # fmt: skip
    head = "specimen,trial,s_mm,displacement_mm,force_N"
    (tmp_path / "curves.csv").write_text("\n".join([head, *rows]) + "\n")
    (tmp_path / "fit.toml").write_text(FIT)
    server, window = Server("-m", "jaxtrachea", "view", tmp_path / "fit.toml", "--no-browser"), None
    try:
        window = Browser()
        window.go(server.address)
        window.wait("!!document.querySelector('#play')", 400)
        where = "document.querySelector('#where').innerText"
        assert window.run(where).startswith("0 samples, TOO_FEW_DATA; 4 presses are there")
        for n in (1, 2):
            window.run("document.querySelector('#step').click()")
            window.wait(f"{where}.startsWith('{n} samples')")
        window.run("document.querySelector('#play').click()")
        window.wait(f"parseInt({where}) > 30")
        window.run("document.querySelector('#play').click()")
        time.sleep(1)
        count = window.run(where)
        before = lengths(window)
        time.sleep(1)
        assert window.run(where) == count
        window.run("document.querySelector('#play').click()")
        window.wait(f"/settled/.test({where})", 60)
        after = lengths(window)
        assert list(after) == ["EI_L", "k_M", "k_1", "k_3"]
        assert all(after[name][1] < before[name][1] for name in after)
        inside = [low <= t <= high for t, (low, _, high) in zip(TRUTH, after.values(), strict=True)]
        assert sum(inside) >= 3
        assert not window.errors
        hosts = {a.split("/")[2] for a in window.requests if not a.startswith(("data:", "blob:"))}
        assert hosts == {f"127.0.0.1:{server.port}"}
        assert server.get("/")[0] == 403
        stranger = {"Origin": "http://evil.example"}
        assert server.get(f"/?token={server.token}", **stranger)[0] == 403
    finally:
        server.end()
        if window is not None:
            window.close()
    assert "Warning" not in "".join(server.lines)


def test_what_is_no_stream_is_said_in_words_of_the_command():
    fit = Path(__file__).parents[1] / "fits" / "virtual_trachea" / "fit.toml"
    with pytest.raises(ValueError, match=f"noise.joints is .*; jaxtrachea fit {fit} takes"):
        _experiment(fit, print)


def lengths(window):
    """Of every parameter of the table low end, length and high end of its interval."""
    rows = window.run("document.querySelector('#estimates').innerText").splitlines()[1:]
    cells = [row.split("\t") for row in rows]
    ends = {c[0]: [float(v) for v in c[2].split(" to ")] for c in cells}
    return {name: (low, high - low, high) for name, (low, high) in ends.items()}
