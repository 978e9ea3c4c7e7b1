"""Shards of a run: what is read back of them, their sizes, and the threads that fit them."""

import dataclasses
import os
import signal
import threading
import time

import jax
import numpy as np
import pytest
from interrupted import numbers
from run_cli import run
from stopped import FIT, load_peace

from jaxtrachea.fitting import fit
from jaxtrachea.fitting.cost import LaneCost
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.optimisation import levenberg_marquardt
from jaxtrachea.optimisation.programs import program
from jaxtrachea.results.read import NoResults, read_again
from jaxtrachea.runs import checkpoint, rerun, shards
from jaxtrachea.runs import folder as run_folder


@pytest.mark.long
def test_results_are_read_back_bit_for_bit(peace, tmp_path):
    """What write_hdf5 and save wrote comes back; damaged, foreign and truncated shards do not."""
    study = load_peace(peace)
    result = read_again(peace / "out" / "results.h5", study)
    lanes, path = np.arange(9), tmp_path / "0.npz"
    run_of_it = rerun.read_manifest(peace / "out" / "results.h5")
    shards.save(path, dataclasses.replace(run_of_it, id="me"), lanes, result)
    assert shards.read_manifest(path) == dataclasses.replace(run_of_it, id="me")
    found = shards.load(path, "me", lanes, study)
    assert found is not None
    expected = shards.arrays_of(result)
    for name, array in shards.arrays_of(found).items():
        assert array.dtype == expected[name].dtype
        assert array.tobytes() == expected[name].tobytes(), name
    parts = [shards.load(path, "me", lanes, study) for _ in range(2)]
    assert shards.join(study.take(np.tile(lanes, 2)), parts).lanes == 18
    with pytest.raises(ValueError, match="9 lanes; expected 18"):
        shards.join(study.take(np.tile(lanes, 2)), parts[:1])
    assert shards.load(path, "another", lanes, study) is None
    assert shards.load(path, "me", lanes[::-1], study) is None
    whole = path.read_bytes()
    for length in np.linspace(0, len(whole) - 1, 40).astype(int):
        path.write_bytes(whole[:length])
        assert shards.load(path, "me", lanes, study) is None
    # Within an array: a byte between them may be one that nobody reads.
    middle = whole.index(result.theta.tobytes()) + result.theta.nbytes // 2
    path.write_bytes(whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :])
    assert shards.load(path, "me", lanes, study) is None
    with pytest.raises(NoResults, match="another study"):
        read_again(peace / "out" / "results.h5", study.take(lanes[:8]))


def test_sizes_of_shards(peace):
    """Equal shards; fewer lanes together where lanes are long or memory is short."""
    assert [len(c) for c in shards.divide(10, 4)] == [4, 3, 3]
    assert np.array_equal(np.concatenate(shards.divide(1000, 7)), np.arange(1000))
    study = load_peace(peace)
    assert shards.lanes_per_shard(study, 2) == 4096
    long = dataclasses.replace(study, lanes=study.lanes._replace(force=np.zeros((1, 2, 100_000))))
    assert shards.lanes_per_shard(long, 4) == 5
    each = study.bytes_per_lane
    on_cpu = jax.default_backend() == "cpu"
    most = 128 if on_cpu else 1024
    assert [shards.slots(study, m) for m in (0.0, 2.1 * each, 65.0 * each, 1e12)] == [
        *(1, 1, 32, most)
    ]
    long = dataclasses.replace(study, lanes=study.lanes._replace(force=np.zeros((1, 2, 2000))))
    assert long.batch_size(1000, shards.slots(long, 1e12)) == (16 if on_cpu else most)
    assert long.batch_size(1000, 4) == 4
    assert dataclasses.replace(long, joint=True).batch_size(1000, 128) == 128
    assert shards.free_memory(1) > 1e6


@pytest.mark.slow
def test_memory_of_a_lane_is_what_xla_counts(peace):
    """The estimate bounds XLA's own figure, by at most a factor of 3."""
    study, count = load_peace(peace), 32
    lanes = jax.tree.map(lambda v: np.repeat(v[:1], count, axis=0), study.lanes)
    objective = LaneCost(study.model, lanes, np.ones((count, 2)))
    state = levenberg_marquardt._idle(objective, count, np.float64)
    step = program(
        levenberg_marquardt._advance, levenberg_marquardt.Tolerances(), 4, axes=None, donate=(3,)
    )
    starts = np.zeros((count, study.size))
    lowered = step.lower(objective, starts, np.ones(count, bool), state)
    used = lowered.compile().memory_analysis()
    total = used.temp_size_in_bytes + used.argument_size_in_bytes
    assert total / count <= study.bytes_per_lane <= 3 * total / count


def test_devices_share_the_work_and_its_end():
    """Each item once; an error on one device ends the others after the item they are at."""
    device, done = jax.local_devices()[0], []
    checkpoint._in_threads(lambda k, _: done.append(k), list(range(20)), [device] * 3)
    assert sorted(done) == list(range(20))

    def fail(k, _):
        done.append(k)
        time.sleep(0.01)
        if k == 3:
            raise OSError("full")

    done.clear()
    with pytest.raises(OSError, match="full"):
        checkpoint._in_threads(fail, list(range(100)), [device] * 3)
    assert len(done) < 20


def test_a_cpu_works_with_all_the_cores_it_may_use(monkeypatch):
    """At most 8 unless the user says; where the system does not tell, all there are."""
    cpu = jax.local_devices(backend="cpu")[:1]
    monkeypatch.setattr(jax, "local_devices", lambda: cpu)
    for cores, workers in ((1, 1), (3, 3), (64, 8)):
        monkeypatch.setattr(
            os, "sched_getaffinity", lambda _, n=cores: set(range(n)), raising=False
        )
        assert shards.worker_devices() == cpu * workers
    assert shards.worker_devices(12) == cpu * 12
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: 5)
    assert shards.worker_devices() == cpu * 5
    two = cpu * 2
    monkeypatch.setattr(jax, "local_devices", lambda: two)
    assert shards.worker_devices() == two
    with pytest.raises(ValueError, match="for one CPU; .* 2 of kind cpu"):
        shards.worker_devices(3)


def test_ctrl_c_ends_all_threads_and_waits_for_them():
    """Work under way is told and ends before the caller goes on, also when it comes twice."""
    device, under_way, ended = jax.local_devices()[0], threading.Barrier(3), []

    def work(k, told):
        under_way.wait()
        if k == 0:
            signal.raise_signal(signal.SIGINT)
        while not told.now:
            time.sleep(0.01)
        if k == 0:
            signal.raise_signal(signal.SIGINT)
        time.sleep(0.5)
        ended.append(k)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            checkpoint._in_threads(work, list(range(9)), [device] * 3)
    finally:
        signal.signal(signal.SIGINT, before)
    assert sorted(ended) == [0, 1, 2]


@pytest.mark.long
@pytest.mark.parametrize("threads", [1, 3])
def test_any_number_of_threads_gives_the_same_bits(threads, peace, study, monkeypatch, capsys):
    seen, real = set(), fit.fit

    def watched(*arguments):
        seen.add(threading.get_ident())
        time.sleep(0.2)  # for the other threads to take theirs
        return real(*arguments)

    monkeypatch.setattr("jaxtrachea.fitting.fit.fit", watched)
    code, _, err = run(monkeypatch, capsys, *FIT, "--threads", str(threads))
    assert code == 0, err
    assert len(seen) == threads
    assert numbers(study / "out") == numbers(peace / "out")


def test_what_a_thread_raises_ends_the_fit_under_way_in_the_others(peace, study, monkeypatch):
    """At its next step, long before its shard is done."""
    loaded, asked, left = load_peace(study), threading.Barrier(3), []

    def working(study, settings, progress):
        if asked.wait() == 0:
            raise OSError(28, "full")
        for _ in range(1000):
            time.sleep(0.01)
            try:
                progress(0, 1)
            except BaseException as error:
                left.append(type(error).__name__)
                raise

    monkeypatch.setattr("jaxtrachea.fitting.fit.fit", working)
    monkeypatch.setattr(checkpoint, "shards_of", lambda *_: np.arange(3)[:, None])
    monkeypatch.setattr(checkpoint, "fitted_lanes", lambda _, study: study)
    folder = object.__new__(run_folder.RunFolder)
    with pytest.raises(OSError, match="full"):
        checkpoint.fit_shards(
            folder, loaded, Settings(), [0, 1, 2], lambda *_: None, shards.worker_devices(3)
        )
    assert left == ["_Ended", "_Ended"]
