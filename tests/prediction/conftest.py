"""The fit that the tests of predictions begin from, made once for all files of this folder."""

import pytest
from noisy_fits import LANES, NOISE, noisy_study

import jaxtrachea


@pytest.fixture(scope="session")
def study(tmp_path_factory):
    """Folder and result of 24 specimens."""
    folder = tmp_path_factory.mktemp("fit")
    return folder, noisy_study(folder, NOISE, LANES, 7)


@pytest.fixture(scope="session")
def read(study):
    return jaxtrachea.read_results(study[0])
