"""The example that an installed package brings along."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from jaxtrachea.cli import demo
from jaxtrachea.cli.terminal import Stop

ROOT = Path(__file__).parents[1]


def test_the_wheel_holds_what_the_example_copies():
    """An editable install has no `jaxtrachea/demo`: what the wheel is told is what there is."""
    build = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]
    included = build["targets"]["wheel"]["force-include"]
    assert included == {name: f"jaxtrachea/demo/{Path(name).name}" for name in demo.FILES}


def test_the_example_is_that_of_the_repository(tmp_path):
    """Its specification names the data as they lie beside it; a folder that is there is left."""
    folder = tmp_path / "new" / "example"
    demo.write_example(folder)
    for name in demo.FILES:
        assert (folder / Path(name).name).read_bytes() == (ROOT / name).read_bytes()
    spec = tomllib.loads((folder / "fit.toml").read_text())
    assert (folder / spec["data"]["files"]).is_file()
    assert all((folder / "friction.toml").name in line for line in demo.next_steps(folder)[1:])
    with pytest.raises(Stop, match="exists; name a new folder"):
        demo.write_example(folder)


def test_a_folder_that_cannot_be_made_is_a_message(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(Stop, match="file"):
        demo.write_example(tmp_path / "file" / "example")


@pytest.mark.slow
def test_the_command_fits_and_says_what_next(tmp_path):
    command = [sys.executable, "-m", "jaxtrachea", "demo"]
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert "identifiable: GA_L, k_M, k_1" in run.stdout
    assert "jaxtrachea view jaxtrachea-demo/friction.toml" in run.stdout
    assert (tmp_path / "jaxtrachea-demo" / "fit" / "report.html").is_file()
