"""Fits read from their files: everything comes back, or it is said why it cannot be read."""

import dataclasses
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from noisy_fits import DEPTHS

import jaxtrachea
from jaxtrachea.fitting.predictions import predictions
from jaxtrachea.results.hdf5 import SCHEMA, VERSION


def assert_same(mine, its, where=""):
    """Everything of two records is the same to the bit, but how curves were read."""
    if dataclasses.is_dataclass(its) or hasattr(its, "_fields"):
        names = [f.name for f in dataclasses.fields(its)] if dataclasses.is_dataclass(its) else (
            its._fields
        )  # fmt: skip
        for name in set(names) - {"origin", "stored_residuals", "usage", "source"}:
            assert_same(getattr(mine, name), getattr(its, name), f"{where}.{name}")
    elif isinstance(its, tuple | list):
        assert len(mine) == len(its), where
        for i, (a, b) in enumerate(zip(mine, its, strict=True)):
            assert_same(a, b, f"{where}[{i}]")
    elif isinstance(its, np.ndarray):
        assert mine.dtype == its.dtype, where
        np.testing.assert_array_equal(mine, its, err_msg=where)
    else:
        assert mine == its, where


@pytest.mark.slow
@pytest.mark.compiling
def test_everything_comes_back_from_the_file(study, read):
    """Study, lanes, estimates and uncertainty to the bit, and what follows from them."""
    _, result = study
    assert_same(read, result)
    assert_same(read.effective, result.effective)
    assert_same(read.residuals, result.residuals)
    assert [f.name for f in dataclasses.fields(read)] == [
        f.name for f in dataclasses.fields(result)
    ]
    with h5py.File(read.origin.path) as file:
        seen = predictions(result.study, result.theta)
        assert np.array_equal(file["data/residual"][: len(DEPTHS)], seen["force"][0, 0])


def old(folder):
    """Of a version that kept less."""
    with h5py.File(folder / "results.h5", "r+") as file:
        file.attrs["schema_version"] = VERSION - 1
        del file["study"]


def cut(folder):
    path = folder / "results.h5"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def newer(folder):
    with h5py.File(folder / "results.h5", "r+") as file:
        file.attrs["schema_version"] = VERSION + 1


def other(folder):
    with h5py.File(folder / "results.h5", "r+") as file:
        file.attrs["schema"] = "jaxtrachea-simulation"


def without_model(folder):
    with h5py.File(folder / "results.h5", "r+") as file:
        del file["model/description"]


def not_json(folder):
    with h5py.File(folder / "results.h5", "r+") as file:
        file["model/description"][3] = 0


def wrong_shape(folder):
    with h5py.File(folder / "results.h5", "r+") as file:
        del file["lanes/sigma"]
        file["lanes/sigma"] = np.ones(3)


def linked(folder):
    with h5py.File(folder / "results.h5", "r+") as file:
        del file["data/force"]
        file["data/force"] = h5py.ExternalLink("/etc/passwd", "/x")


def gone(folder):
    (folder / "results.h5").unlink()


def unfinished(folder):
    gone(folder)
    (folder / ".run").mkdir()


@pytest.mark.parametrize(
    ("harm", "says"),
    [
        (old, f"schema version {VERSION - 1} does not keep .* fit again with this version"),
        (cut, "damaged"),
        (newer, f"schema version is {VERSION + 1}, this program reads {VERSION}"),
        (other, "expected 'jaxtrachea-results'"),
        (without_model, "no dataset 'description'"),
        (not_json, "damaged or not written by this program"),
        (wrong_shape, r"sigma has shape \(3,\)"),
        (linked, "soft or external link"),
        (gone, "no results.h5 in this folder"),
        (unfinished, "--resume"),
    ],
)
def test_results_that_cannot_be_read(harm, says, study, tmp_path):
    shutil.copytree(study[0], tmp_path / "r")
    harm(tmp_path / "r")
    with pytest.raises(jaxtrachea.NoResults, match=says):
        jaxtrachea.read_results(tmp_path / "r")


def test_the_page_names_the_version_that_is_written():
    page = (Path(__file__).parents[2] / "docs" / "results.md").read_text(encoding="utf-8")
    assert f"`{SCHEMA}`, version {VERSION}" in page
