"""Fits that are stopped inside the test process, and stand-ins for them."""

import h5py
import jax
import numpy as np
from run_cli import run

from jaxtrachea.cli.specification import study_of
from jaxtrachea.cli.terminal import set_up_jax
from jaxtrachea.config import load_fit_spec
from jaxtrachea.fitting import fit
from jaxtrachea.measurements.data_files import read_data
from jaxtrachea.results.read import read_again
from jaxtrachea.runs import shards

FIT = ("fit", "spec.toml", "--out", "out")


def stop_at(patch, k, error=KeyboardInterrupt):
    """Let fits before the k-th through, one after the other, stop that one; counts them."""
    asked, real = [], fit.fit
    patch.setattr(shards, "worker_devices", lambda _: jax.local_devices()[:1])

    def stopping(study, settings, progress):
        asked.append(study.lanes.lower.shape[0])
        if len(asked) == k:
            raise error
        return real(study, settings, progress)

    patch.setattr("jaxtrachea.fitting.fit.fit", stopping)
    return asked


def begun(peace, study, monkeypatch, capsys):
    """Stop the study in its third shard; two are saved."""
    with monkeypatch.context() as patch:
        stop_at(patch, 3)
        assert run(patch, capsys, *FIT)[0] == 130


def set_failed(path, lanes):
    """Let a results.h5 say that lanes did not converge."""
    with h5py.File(path, "r+") as file:
        file["lanes/status"][lanes] = 3
        file["unknowns/value"][lanes] = 7.0


def load_peace(peace):
    set_up_jax()
    spec = load_fit_spec(peace / "spec.toml")
    return study_of(spec, read_data(spec, peace))


def from_peace(folder):
    """Stand in for `fit.fit`: the same numbers, read back."""
    whole = read_again(folder / "out" / "results.h5", load_peace(folder))
    names = [curves[0].specimen for curves in whole.study.curves]
    arrays = shards.arrays_of(whole)

    def fitted(study, settings, progress):
        rows = np.array([names.index(curves[0].specimen) for curves in study.curves])
        return shards.result_of(study, {name: v[rows] for name, v in arrays.items()})

    return fitted
