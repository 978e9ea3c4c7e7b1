"""A study fitted in peace, once for all files of this folder; the same not yet fitted."""

import shutil

import pytest
from interrupted import write_study
from stopped import FIT

from jaxtrachea.cli import main as cli


@pytest.fixture(scope="session")
def peace(tmp_path_factory):
    """A study of 9 lanes in 3 shards, fitted without interruption; all its files, as text."""
    folder = tmp_path_factory.mktemp("peace")
    write_study(folder, 9, 3)
    with pytest.MonkeyPatch.context() as patch:
        quietly(patch, folder)
        patch.setattr("sys.argv", ["jaxtrachea", *FIT])
        with pytest.raises(SystemExit) as stop:
            cli.main()
    assert stop.value.code == 0
    return folder


def quietly(patch, folder):
    """Work in `folder`, without plots."""
    patch.chdir(folder)
    patch.setattr("jaxtrachea.report.plots.draw_all", lambda *_: ([], {}))
    patch.setattr("jaxtrachea.files.html.page", lambda *_, **more: "")


@pytest.fixture
def study(peace, tmp_path, monkeypatch):
    """The same study, not yet fitted."""
    for name in ("curves.csv", "spec.toml"):
        shutil.copy(peace / name, tmp_path)
    quietly(monkeypatch, tmp_path)
    return tmp_path
