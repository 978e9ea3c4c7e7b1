"""The command convert: what goes in comes out, nothing is overwritten, what is left out is said."""

import dataclasses
import math

import h5py
import numpy as np
import pytest
from full_curves import ARRAYS, full, plain, same, stored
from run_cli import GOOD, run, tree

from jaxtrachea._errors import InputError
from jaxtrachea.measurements.read import ReadOptions, read_measurements
from jaxtrachea.measurements.tidy_writer import write_tidy

CYCLE = "displacement [mm],force [N]\n" + "".join(
    f"{d},{0.3 * d + 0.1}\n" for d in [*range(6), *range(4, -1, -1), *range(1, 9)]
)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "good.csv").write_text(GOOD)
    return tmp_path


def all_of(path, **options):
    found = read_measurements([path], ReadOptions(**({"loading": "all"} | options)))
    assert found.bad == ()
    return found.curves


CURVES = (
    full("T01"),
    full("=SUM(A1)", "a, b", n=5, joint_side_displacement=None),
    full('#"T"', "'=x", n=4, s_c=None, phi_c=-1 / 3),
    full("µ", "2", displacement=np.array([0.0, 1 / 3, 2e-17 + 1]), force=np.array([0.1, 0.2, 1e22])
         * 1e-18),
)  # fmt: skip


@pytest.mark.parametrize("way", [["a.h5"], ["a.csv"], ["a.csv", "b.h5", "c.CSV", "d.hdf5"]])
def test_round_trip(folder, monkeypatch, capsys, way):
    """From HDF5 by any way and back, bit by bit."""
    given = [dataclasses.replace(curve, joint_side_displacement=None) for curve in CURVES]
    stored(folder / "given.h5", *given)
    source = "given.h5"
    for target in way:
        code, out, err = run(monkeypatch, capsys, "convert", source, target)
        assert (code, err) == (0, "")
        assert "4 curves, 15 samples; 0 bad curves left out" in out
        source = target
    for a, b in zip(given, all_of(folder / source), strict=True):
        same(a, b)


def test_table_of_different_curves(folder):
    """What a curve lacks is empty in its rows, and comes back as not seen."""
    bare = full("T02", "1", **dict.fromkeys(ARRAYS[4:]))
    write_tidy(folder / "t.csv", [full(), bare])
    one, other = all_of(folder / "t.csv")
    same(full(), one)
    for name in ("side_force", "joint_displacement", "joint_side_displacement", "end_U", "end_V"):
        assert np.isnan(getattr(other, name)).all()
    np.testing.assert_array_equal(other.force, bare.force)


def test_from_a_table_to_hdf5(folder, monkeypatch, capsys):
    code, out, err = run(monkeypatch, capsys, "convert", "good.csv", "x.h5")
    assert (code, err) == (0, "")
    assert "written to x.h5" in out
    with h5py.File("x.h5") as file:
        assert file.attrs["schema_version"] == 2
        assert file.attrs["written_by"].startswith("jaxtrachea ")
        assert file["samples/force"][()].tolist() == [0.0, 0.31, 0.66, 1.08]
        assert file["curves/source"][0] == b"good.csv:2-5"


def test_every_sample_is_kept(folder, monkeypatch, capsys):
    """A record of two loadings is kept whole, unless the specification chooses one."""
    (folder / "c.csv").write_text(CYCLE)
    (folder / "plain.toml").write_text('[data]\nfiles = "elsewhere.csv"\n')
    for name in ([], ["--spec", "plain.toml"]):
        target = f"whole{len(name)}.h5"
        assert run(monkeypatch, capsys, "convert", "c.csv", target, *name)[0] == 0
        assert all_of(folder / target)[0].force.size == 19
    (folder / "last.toml").write_text('[data]\nfiles = "elsewhere.csv"\nloading = "last"\n')
    code, out, _ = run(monkeypatch, capsys, "convert", "c.csv", "cut.h5", "--spec", "last.toml")
    assert code == 0
    (curve,) = all_of(folder / "cut.h5")
    assert curve.displacement.tolist() == list(range(9))
    assert "c 1: 9 of 19 samples" in out
    assert "left out: earlier loadings 10" in out


def test_options_of_a_specification(folder, monkeypatch, capsys):
    (folder / "raw_A1.csv").write_text("way,load\n0,0\n1,-200\n2,-500\n")
    (folder / "spec.toml").write_text(
        '[data]\nfiles = "x"\nspecimen = "{specimen}_A{trial}"\nforce_sign = -1\ns = "3 cm"\n'
        'units = { displacement = "mm", force = "mN" }\n'
        'columns = { displacement = "way", force = "load" }\n'
    )
    code, _, err = run(monkeypatch, capsys, "convert", "raw_A1.csv", "x.h5", "--spec", "spec.toml")
    assert (code, err) == (0, "")
    (curve,) = all_of(folder / "x.h5")
    assert (curve.specimen, curve.trial, curve.s_c) == ("raw", "1", 30.0)
    assert curve.force.tolist() == [0.0, 0.2, 0.5]


def test_bad_curves_are_named(folder, monkeypatch, capsys):
    (folder / "bad.csv").write_text(GOOD.replace("T01", "T02").replace("0.66", "x"))
    (folder / "broken.h5").write_bytes(b"\x89HDF\r\n\x1a\n")
    code, out, err = run(monkeypatch, capsys, "convert", "good.csv", "bad.csv", "broken.h5", "x.h5")
    assert code == 1
    assert "1 curves, 4 samples; 2 bad curves left out" in out
    assert "not usable: T02 1: unparsable: bad.csv:2-5: " in err
    assert "not usable: broken (all): unreadable: " in err
    assert [c.specimen for c in all_of(folder / "x.h5")] == ["T01"]


REFUSED = {
    "one name": (["good.csv"], "expected SOURCE... TARGET"),
    "target exists": (["good.csv", "there.h5"], "there.h5: exists; nothing was written"),
    "target is the source": (["good.csv", "good.csv"], "good.csv: exists"),
    "target a link": (["good.csv", "link.h5"], "link.h5: exists"),
    "target of no known kind": (["good.csv", "x.xlsx"], "ends in .h5, .hdf5 or .csv"),
    "no folder": (["good.csv", "no/x.h5"], "there is no folder no; make it"),
    "no source": (["no.csv", "x.h5"], "no.csv: no such file"),
    "source a folder": (["sub", "x.h5"], "sub: is no file"),
    "no usable curve": (["bad.csv", "x.h5"], "x.h5: no usable curve; nothing was written"),
    "the only one unreadable": (["broken.h5", "x.h5"], "broken.h5: not a readable HDF5 file"),
    "the same curve twice": (["good.csv", "again.csv", "x.h5"], "'T01' trial '1' was already in"),
    "no specification": (["good.csv", "x.h5", "--spec", "no.toml"], "no.toml: No such file"),
    "a bad option": (["good.csv", "x.h5", "--spec", "bad.toml"], "bad.toml: data: s: unit 'N'"),
    "several directions": (["two.h5", "x.csv"], "x.csv: the tool's direction is not the same"),
    "sigma of some": (["some.h5", "x.csv"], "some curves have sigma and some have none"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refuses(folder, monkeypatch, capsys, name):
    (folder / "there.h5").write_text("years of work")
    (folder / "link.h5").symlink_to("nowhere.h5")
    (folder / "sub").mkdir()
    (folder / "bad.csv").write_text(GOOD.replace("0.66", "x"))
    (folder / "broken.h5").write_bytes(b"\x89HDF\r\n\x1a\n")
    (folder / "again.csv").write_text(GOOD)
    (folder / "bad.toml").write_text('[data]\nfiles = "x"\ns = "3 N"\n')
    stored(folder / "two.h5", full("A"), full("B", direction=(1.0, 0.0)))
    stored(folder / "some.h5", full("A", direction=(1.0, 0.0)), plain("B"))
    arguments, message = REFUSED[name]
    before = tree(folder)
    code, out, err = run(monkeypatch, capsys, "convert", *arguments)
    assert (code, out) == (2, "")
    assert message in err
    assert tree(folder) == before


def test_full_disk(folder, monkeypatch, capsys):
    def full_disk(path, data):
        raise OSError(28, "No space left on device")

    for room in ("hdf5_writer", "tidy_writer"):
        monkeypatch.setattr(f"jaxtrachea.measurements.{room}.write_whole", full_disk)
    for target in ("x.h5", "x.csv"):
        code, _, err = run(monkeypatch, capsys, "convert", "good.csv", target)
        assert code == 2
        assert f"{target}: cannot be written (No space left on device)" in err


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"specimen": " T"}, "begins or ends with a space"),
        ({"trial": "1\n2"}, "unprintable"),
        ({"joint_rings": np.array([2, 9999])}, "ring 10000, and columns go up to 9999"),
    ],
)
def test_tables_cannot_hold(folder, changes, message):
    with pytest.raises(InputError, match=message):
        write_tidy(folder / "x.csv", [dataclasses.replace(full(), **changes)])
    assert not (folder / "x.csv").exists()


def test_no_curves(folder):
    with pytest.raises(InputError, match="no curves"):
        write_tidy(folder / "x.csv", [])


def test_numbers_of_a_table_are_exact(folder):
    rng = np.random.default_rng(0)
    odd = rng.normal(size=200) * 10.0 ** rng.integers(-30, 3, 200)
    curve = plain(n=200)
    write_tidy(folder / "x.csv", [dataclasses.replace(curve, force=curve.force + odd)])
    (found,) = all_of(folder / "x.csv")
    np.testing.assert_array_equal(found.force, curve.force + odd, strict=True)
    assert math.isclose(found.displacement[-1], 4.0, rel_tol=0)
