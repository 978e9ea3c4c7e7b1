"""The specification and its page say the same; defaults and quantities are what they claim."""

import math
import re
from pathlib import Path

import pytest

from jaxtrachea.config import SpecError, load_fit_spec
from jaxtrachea.measurements.readers import READERS

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "reference.md").read_text()


def test_page_lists_every_format():
    row = re.search(r"^\| `format` \| .*$", PAGE, re.M)
    assert row is not None
    listed = set(re.findall(r"`(\w+)`", row[0])) - {"format", "auto"}
    assert listed == {reader.name for reader in READERS}


def test_quantities_come_in_internal_units(tmp_path):
    path = tmp_path / "spec.toml"
    path.write_text(
        '[data]\nfiles = "a.csv"\ndisplacement_max = "0.9 cm"\n'
        '[trachea]\nlength = "0.16 m"\nrings = ["1 cm", "20 mm"]\nhalf_angle = "100 deg"\n'
        '[noise]\nforce = "2 mN"\n[parameters]\nk_1 = { bounds = [1, "2 kN/m"] }\n'
    )
    spec = load_fit_spec(path)
    assert spec.data.files == ["a.csv"]
    assert spec.data.displacement_max == 9.0
    assert (spec.trachea.length, spec.trachea.rings) == (160.0, [10.0, 20.0])
    assert math.isclose(spec.trachea.half_angle, math.radians(100))
    assert (spec.noise.force, spec.noise.joints) == (0.002, "estimate")
    assert spec.parameters["k_1"].bounds == (1, "2 kN/m")


def test_a_share_of_the_displacement(tmp_path):
    file = tmp_path / "fit.toml"
    file.write_text('[data]\nfiles = "x.csv"\n[noise]\njoints = "0.1 mm"\njoints_share = "6 %"\n')
    assert load_fit_spec(file).noise.joints_share == 0.06


def test_every_problem_is_reported_at_once(tmp_path):
    path = tmp_path / "spec.toml"
    path.write_text('x = 1\n[data]\nfiles = 3\n[trachea]\nradius = "1 N"\n')
    with pytest.raises(SpecError) as error:
        load_fit_spec(path)
    lines = str(error.value).splitlines()
    assert len(lines) == 3
    assert all(line.startswith(f"{path}: ") for line in lines)


SHIPPED = sorted(p for p in (ROOT / "fits").glob("*/*.toml") if p.name != "scene.toml")


@pytest.mark.parametrize("path", SHIPPED, ids=lambda p: p.name)
def test_shipped_specifications_load(path):
    assert load_fit_spec(path).title


def test_a_data_file_in_the_place_of_a_specification_is_told(tmp_path):
    data = tmp_path / "pressed.csv"
    data.write_text("displacement,force\n0,0\n1,2\n")
    with pytest.raises(SpecError, match=r"a data file.*jaxtrachea init .*pressed\.csv"):
        load_fit_spec(data)
