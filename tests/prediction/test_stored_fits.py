"""Fits read from their files: everything comes back, or it is said why it cannot be read."""

import shutil

import h5py
import numpy as np
import pytest
from noisy_fits import DEPTHS

import jaxtrachea
from jaxtrachea.fitting.predictions import predictions
from jaxtrachea.results import stored
from jaxtrachea.results.hdf5 import read_hdf5


@pytest.mark.slow
@pytest.mark.compiling
def test_everything_comes_back_from_the_file(study, read):
    _, result = study
    assert np.array_equal(read.theta, result.theta)
    assert read.study.parameters == result.study.parameters
    assert read.study.model.options == result.study.model.options
    u = result.uncertainty
    se = np.sqrt(np.diag(read.covariance[3]))
    assert np.allclose(se, u.se[3], rtol=1e-12)
    assert np.allclose(read.covariance[3], u.correlation[3] * np.outer(se, se), rtol=1e-9)
    for mine, its in zip(
        read.curves, (c for lane in result.study.curves for c in lane), strict=True
    ):
        assert np.array_equal(mine.force, its.force)
        assert (mine.specimen, mine.trial, mine.s_c) == (its.specimen, its.trial, its.s_c)
    with h5py.File(read.path) as file:
        seen = predictions(result.study, result.theta)
        assert np.array_equal(file["data/residual"][: len(DEPTHS)], seen.force[0, 0])


def old(folder):
    """As schema 1 was written: no model, no data, no covariance."""
    with h5py.File(folder / "results.h5", "r+") as file:
        file.attrs["schema_version"] = 1
        del file["model"], file["data"], file["uncertainty/covariance"]


def cut(folder):
    path = folder / "results.h5"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def newer(folder):
    with h5py.File(folder / "results.h5", "r+") as file:
        file.attrs["schema_version"] = 4


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
        (old, "schema version 1 .* fit again with this version"),
        (cut, "damaged"),
        (newer, "schema version is 4, this program reads 3"),
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
        stored.read_results(tmp_path / "r")


def test_schema_1_serves_to_fit_failed_lanes_again(study, tmp_path):
    """What `--rerun-failed` needs is in it; the covariance follows from errors and correlation."""
    shutil.copytree(study[0], tmp_path / "r")
    old(tmp_path / "r")
    again = read_hdf5(tmp_path / "r" / "results.h5", study[1].study)
    assert np.array_equal(again.theta, study[1].theta)
    mine, its = again.uncertainty.covariance, study[1].uncertainty.covariance
    assert np.allclose(mine, its, rtol=1e-9)
