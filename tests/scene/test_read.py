"""simulation.h5: read back to the bit, dimensions with names, and what is refused."""

from typing import Any

import h5py
import jax
import numpy as np
import pytest
from small_scenes import BALL, MATERIAL, MESH, OUTER, TUBE, ball

import jaxtrachea as jt
from jaxtrachea.output.read import SimulationFileError
from jaxtrachea.output.results import plan_rows, write_simulation

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """A scene, its path, what came out and the file of it."""
    path = ball([75, 0, 0], [75, -3, 0], rows=3, top=OUTER)
    scene = jt.make_scene(TUBE, MATERIAL, path, mesh=MESH, tool=jt.Tool(BALL))
    out = jax.device_get(jax.jit(jt.simulate)(scene, MATERIAL, path))
    file = tmp_path_factory.mktemp("stored") / "simulation.h5"
    write_simulation(file, scene, MATERIAL, path, out, {"seconds": 1.5})
    return scene, path, out, file


def test_everything_comes_back(stored):
    scene, path, out, file = stored
    for place in (file, file.parent, str(file)):
        found = jt.read_simulation(place)
        for name, value in out._asdict().items():
            again = getattr(found.simulation, name)
            assert (again is None) == (value is None)
            if value is not None:
                assert type(again) is np.ndarray
                assert again.dtype == value.dtype
                np.testing.assert_array_equal(again, value)
    assert found.units["force"] == "N"
    assert found.units["phi"] == "rad"
    assert found.units.keys() == {n for n, v in out._asdict().items() if v is not None}
    assert found.plan == plan_rows(scene.plan, {})
    assert found.provenance == {"seconds": 1.5}
    for one, other in ((found.tool, scene.tool), (found.path, path)):
        jax.tree.map(np.testing.assert_array_equal, one, other)
    assert found.material["k_M"] == MATERIAL.k_M
    np.testing.assert_array_equal(found.rings["position"], TUBE.ring_positions)
    assert found.rest is not None
    np.testing.assert_array_equal(found.rest["faces"], MESH.faces)


def test_dimensions_have_names(stored):
    """As h5netcdf and netCDF-4 find them: by the scales of every series."""
    names = {"s": ["row"], "force": ["row", "xyz"], "joints": ["row", "ring", "xyz"],
             "vertices": ["row", "vertex", "xyz"]}  # fmt: skip
    with h5py.File(stored[-1]) as file:
        for series, expected in names.items():
            data: Any = file["series"][series]  # pyright: ignore
            scales = [dimension[0] for dimension in data.dims]
            assert [scale.name.split("/")[-1] for scale in scales] == expected
            assert tuple(scale.size for scale in scales) == data.shape
            assert all(scale.is_scale for scale in scales)


def test_xarray_reads_the_series(stored):
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf")
    out, file = stored[2:]
    with xarray.open_dataset(file, group="series", engine="h5netcdf") as found:
        assert found["vertices"].dims == ("row", "vertex", "xyz")
        assert found["force"].attrs["units"] == "N"
        np.testing.assert_array_equal(found["force"], out.force)


def _other_version(file):
    file.attrs["schema_version"] = 1


def _other_kind(file):
    file.attrs["schema"] = "jaxtrachea-results"


def _no_force(file):
    del file["series/force"]


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (_other_version, ["is of version 1", "expected 2", "simulate the scene again"]),
        (_other_kind, ["not a simulation", "name a simulation.h5"]),
        (_no_force, ["no series force", "simulate the scene again"]),
    ],
)
def test_other_files_are_refused(stored, tmp_path, damage, words):
    copy = tmp_path / "other.h5"
    copy.write_bytes(stored[-1].read_bytes())
    with h5py.File(copy, "r+") as file:
        damage(file)
    with pytest.raises(SimulationFileError) as caught:
        jt.read_simulation(copy)
    assert all(word in str(caught.value) for word in ["other.h5", *words])


def test_what_is_no_hdf5_is_refused(tmp_path):
    (tmp_path / "text.h5").write_text("s, phi\n")
    for name, words in (("text.h5", "no HDF5 file"), ("none.h5", "no such file")):
        with pytest.raises(SimulationFileError, match=words):
            jt.read_simulation(tmp_path / name)
