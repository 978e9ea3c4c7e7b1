"""Curves of atomic force microscopes, as afmformats reads them."""

import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from measured_files import only_bad, put, read

from jaxtrachea.measurements.curve import DataError, ReadOptions
from jaxtrachea.measurements.heads import head_of

#: From the tests of afmformats (MIT, Paul Müller), fmt-jpk-fd_spot3-0192.
JPK = Path(__file__).parent / "reference" / "spot3.jpk-force"

DATA = Path(__file__).parents[2] / "shared" / "data"
needs_formats = pytest.mark.skipif(
    not (DATA / "formats").is_dir(), reason="afmformats samples are not beside the checkout"
)


def afm_file(path, spring=0.02, **columns):
    """Height 50, 40, 30 um, then back; deflection takes F/k = 0, 1, 2 um of the 10 um steps."""
    data = {
        "force": (np.array([1e-9, 21e-9, 41e-9, 0.0]), "N"),
        "height (measured)": (np.array([50e-6, 40e-6, 30e-6, 50e-6]), "m"),
        "segment": (np.array([0, 0, 0, 1], dtype=np.uint8), ""),
    } | columns
    with h5py.File(path, "w") as file:
        file.attrs["software"] = "afmformats"
        for number in ("10", "2"):
            for name, (values, unit) in data.items():
                file[f"{number}/{name}"] = values
                file[f"{number}/{name}"].attrs["unit"] = unit
            if spring is not None:
                file[number].attrs["spring constant"] = spring
    return path


def test_afm_cantilever_by_hand(tmp_path):
    found = read(afm_file(tmp_path / "cell.h5"))
    assert [(c.specimen, c.trial) for c in found.curves] == [("cell", "2"), ("cell", "10")]
    # 10 um fall minus 20 nN / 0.02 N/m = 1 um of bending, per step.
    np.testing.assert_allclose(found.curves[0].displacement, [0, 0.009, 0.018], rtol=1e-12)
    np.testing.assert_allclose(found.curves[0].force, [1e-9, 21e-9, 41e-9], rtol=1e-15)


def test_afm_all_segments(tmp_path):
    assert read(afm_file(tmp_path / "c.h5"), loading="all").curves[0].force.size == 4


def test_afm_named_column_is_not_replaced_by_another(tmp_path):
    found = read(afm_file(tmp_path / "c.h5"), columns={"displacement": "height (piezo)"})
    assert {b.kind for b in found.bad} == {"column_missing"}


def test_afm_tip_position_needs_no_spring(tmp_path):
    tip = (np.array([3e-6, 2e-6, 1e-6, 3e-6]), "m")
    path = afm_file(tmp_path / "c.h5", spring=None, **{"tip position": tip})
    np.testing.assert_allclose(read(path).curves[0].displacement, [0, 0.001, 0.002], rtol=1e-12)


@pytest.mark.parametrize(
    ("changes", "kind"),
    [
        ({"spring": None}, "metadata_missing"),
        ({"spring": 0.0}, "metadata_missing"),
        ({"force": (np.zeros(3), "N")}, "shape"),
        ({"force": (np.zeros(4), "V")}, "unit_unknown"),
        ({"height (measured)": (np.zeros(4), "N")}, "unit_unknown"),
    ],
)
def test_afm_bad_curves(tmp_path, changes, kind):
    assert {b.kind for b in read(afm_file(tmp_path / "c.h5", **changes)).bad} == {kind}


@needs_formats
def test_afm_sample_hdf5():
    path = DATA / "formats" / "fmt-hdf5-fd_version_0.13.3.h5"
    (got,) = read(path).curves
    with h5py.File(path) as file:
        group = file["0"]
        approach = group["segment"][()] == 0
        fall = group["height (measured)"][0] - group["height (measured)"][approach][-1]
        force = group["force"][approach]
    # Spring constant of the file, 0.02230065831827453 N/m; metres to millimetres.
    expected = 1000 * (fall - (force[-1] - force[0]) / 0.02230065831827453)
    assert got.displacement[-1] == pytest.approx(expected, rel=1e-12)
    # As h5dump prints it.
    assert got.force[0] == pytest.approx(-7.36223288e-10, rel=1e-8)
    assert got.force.size == approach.sum()
    assert got.source.endswith(":/0")


@needs_formats
def test_afm_sample_tab():
    (got,) = read(DATA / "formats" / "fmt-tab-fd_version_0.13.3.tab").curves
    # Rows printed in the file; the first hangs on the header without a line end.
    assert tuple(got.force[:2]) == (-6.7744671e-10, -6.8435897e-10)
    bend = (-6.8435897e-10 + 6.7744671e-10) / 0.02230065831827453
    step = 1000 * ((5.5198847e-05 - 5.5194395e-05) - bend)
    assert got.displacement[1] == pytest.approx(step, rel=1e-9)
    assert got.force.size == 3147


def test_afm_instrument(tmp_path):
    """A curve of a JPK instrument: the library's columns, its bending taken off by hand."""
    afmformats = pytest.importorskip("afmformats")
    path = tmp_path / "spot3.jpk-force"
    path.write_bytes(JPK.read_bytes())
    (got,) = read(path).curves
    assert (got.specimen, got.trial) == ("spot3", "0")
    (held,) = afmformats.load_data(path)
    approach = np.asarray(held["segment"]) == 0
    fall = held["height (measured)"][0] - held["height (measured)"][approach]
    bend = (held["force"][approach] - held["force"][0]) / 0.043493666407368466
    used = got.usage.used
    np.testing.assert_allclose(got.displacement, 1000 * (fall - bend)[-used:], atol=1e-15)
    np.testing.assert_array_equal(got.force, held["force"][approach][-used:])
    assert len(head_of(path, ReadOptions()).columns) == 5
    assert {b.kind for b in read(path, columns={"displacement": "height (none)"}).bad} == {
        "column_missing"
    }
    path.write_bytes(JPK.read_bytes()[:9000])
    with pytest.raises(DataError, match="afmformats cannot read it .*; export the curve as HDF5"):
        read(path)


def test_afm_instrument_without_the_library(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "afmformats", None)
    with pytest.raises(DataError, match=r"pip install 'jaxtrachea\[afm\]'"):
        read(put(tmp_path, b"PK", "x.jpk-force"))


@pytest.mark.parametrize("metadata", ["{", "[1]", '{"spring constant": "soft"}'])
def test_afm_tab_without_metadata(tmp_path, metadata):
    head = f"# BEGIN METADATA\n# {metadata}\n# END METADATA\n"
    text = head + "# force\theight (measured)\n0\t0\n1\t1\n"
    assert only_bad(read(put(tmp_path, text, "x.tab"))).kind == "metadata_missing"
