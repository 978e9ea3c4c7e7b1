"""A function of one lane over many: any number of lanes compiles one program."""

import jax
import jax.monitoring
import jax.numpy as jnp
import numpy as np
import pytest
import synthetic
from compilations import compilations

from jaxtrachea._compiler import quick_options
from jaxtrachea.fitting import other_starts
from jaxtrachea.fitting.information import informations
from jaxtrachea.fitting.map_lanes import map_lanes
from jaxtrachea.fitting.predictions import predictions
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.optimisation.batching import batch_size


@pytest.fixture(scope="module")
def study():
    """40 lanes: no multiple of 16; without the programs that other files have compiled."""
    jax.clear_caches()
    truth = synthetic.draw(3, 40, 1.5)
    return synthetic.study(synthetic.forces(truth)[0])


@pytest.fixture
def compiled():
    """Programs compiled so far, by XLA's own events; options are tried once in a process."""
    quick_options()
    with compilations() as seen:
        yield seen


def peak(model, factor, theta, lane, offset):
    return {"peak": factor * jnp.max(lane.force) + offset, "scaled": theta * theta}


def test_any_number_of_lanes_compiles_one_program(study, compiled):
    """Against the same in numpy; equal models share the program, other dtypes do not."""
    theta = np.arange(160.0).reshape(40, 4)
    offset = np.arange(40.0)
    rows = np.arange(40)[::-1]
    done = []
    found = map_lanes(peak, study, theta, offset, rows=rows, static=(3.0,), batch=16,
                      progress=done.append)  # fmt: skip
    assert len(compiled) == 1
    assert done == [16, 16, 8]
    np.testing.assert_allclose(found["scaled"], theta**2)
    largest = study.lanes.force.max(axis=(1, 2))[rows]
    np.testing.assert_allclose(found["peak"], 3 * largest + offset)
    again = study.take(np.arange(23))
    map_lanes(peak, again, theta[:23], offset[:23], static=(3.0,), batch=16)
    assert len(compiled) == 1
    single = map_lanes(peak, study, theta, offset, static=(3.0,), batch=16, dtype=np.float32)
    assert len(compiled) == 2
    assert single["peak"].dtype == np.float64
    exact = 3 * study.lanes.force.max(axis=(1, 2)) + offset
    np.testing.assert_allclose(single["peak"], exact, rtol=1e-6)


def guess(study):
    return np.tile([p.to_scaled(p.value) for p, _, _ in study.unknowns[0]], (40, 1))


@pytest.mark.parametrize("loop", ["predictions", "informations"])
def test_loops_over_lanes_compile_once(study, compiled, loop):
    """40 lanes, 16 at a time: the last 8 are filled up."""
    theta, sigma = guess(study), np.ones((40, 2))
    if loop == "predictions":
        assert predictions(study, theta, 16)["force"].shape == (40, 4, 50)
    else:
        assert informations(study, np.arange(40), theta, sigma, 16).bread.shape == (40, 4, 4)
    assert len(compiled) == 1


SIZES = {"cpu": {1: 1, 2: 4, 8: 4, 15: 4, 16: 16, 17: 16, 100: 64, 5000: 128},
         "gpu": {1: 1, 2: 16, 17: 32, 100: 128, 5000: 128}}  # fmt: skip


@pytest.mark.parametrize("device", SIZES)
def test_few_sizes(device, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: device)
    for total, size in SIZES[device].items():
        assert batch_size(total, 128) == size
        assert batch_size(total, 3) == min(size, 3)


def test_less_than_half_of_a_batch_is_nobodys(monkeypatch):
    """Of four lanes or more, on a CPU; of large batches a quarter at most."""
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    for total in range(4, 3000):
        size = batch_size(total, 128)
        computed = -(-total // size) * size
        assert computed < 2 * total
        assert total < 1000 or computed < 1.25 * total


@pytest.mark.parametrize(("lanes", "quick"), [(40, True), (257, False)])
def test_compliances_of_other_skeletons_are_quick_for_few_lanes_only(lanes, quick, monkeypatch):
    """They are looked for lane by lane: how many there are in all decides, not one lane's rows."""
    truth = synthetic.draw(3, lanes, 1.5)
    study = synthetic.study(synthetic.forces(truth)[0])
    seen = []

    def watched(function, study, theta, *, batch, rows, unoptimised):
        seen.append(unoptimised)
        return np.ones((len(theta), 4))

    monkeypatch.setattr(other_starts, "map_lanes", watched)
    result = object.__new__(FitResult)  # what is read of one
    vars(result).update(study=study, theta=np.log(truth), status=np.zeros(lanes, int))
    other_starts.twins(result, np.arange(2))
    assert seen == [quick] * 2
