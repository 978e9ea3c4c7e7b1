"""Functions that are not traced anew at every start: what is kept, and what must not be."""

import csv
import functools
import hashlib
import os
import pickle
import re
import subprocess
import sys
import threading
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilations import compilations

from jaxtrachea._compiler import quick_options
from jaxtrachea.files import kept_trace, traces
from jaxtrachea.files.lock import take
from jaxtrachea.files.traces import Traced, keep_traces
from jaxtrachea.optimisation import programs

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[1]
#: Names of the functions below each time that one is traced.
TRACES = []


class Pair(eqx.Module):
    """Arguments with a static field."""

    a: object
    b: object
    power: int = eqx.field(static=True, default=2)


def power_sum(scale, pair, x):
    """A dictionary of modules and arrays, some of them whole numbers or None."""
    TRACES.append("power_sum")
    both = scale * (pair.a**pair.power + x)
    return {"both": Pair(both, None, 7), "count": jnp.sum(pair.b), "positive": both > 0}


def add(state, x):
    TRACES.append("add")
    return state + x, jnp.sin(x)


def weak(x):
    TRACES.append("weak")
    return jnp.where(jnp.sum(x) > 0, 1.0, 2.0)


def draw(key):
    TRACES.append("draw")
    return jax.random.uniform(key)


def start():
    """As a process starts: nothing is known of sources and settings."""
    traces._surroundings.cache_clear()


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder for traces, and this module taken for one whose code the digest tells.

    Sources that were edited since pytest began do not count.
    """
    monkeypatch.setattr(traces, "_KNOWN", traces._KNOWN | {__name__.split(".")[0]})
    monkeypatch.setattr(traces, "_start", np.inf)
    monkeypatch.setattr(traces, "_found_unoptimised", [])
    TRACES.clear()
    start()
    keep_traces(tmp_path)
    yield tmp_path
    keep_traces(None)
    start()


def pair(dtype=np.float64, size=3, power=2):
    return Pair(np.arange(1.0, 1.0 + size, dtype=dtype), np.arange(size), power)


def kept(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_next_start_does_not_trace(folder, dtype):
    """A new object stands for a new process. Values by hand: 3 (a^2 + x)."""
    x = jnp.asarray([0.5, -20.0, 1.0], dtype)
    for _ in range(2):
        out = Traced(power_sum, 3.0)(pair(dtype), x)
        np.testing.assert_array_equal(out["both"].a, [4.5, -48.0, 30.0])
        assert out["both"].a.dtype == dtype
        assert (out["both"].b, out["both"].power) == (None, 7)
        assert out["count"] == 3
        assert out["count"].dtype == np.int64
        np.testing.assert_array_equal(out["positive"], [True, False, True])
    assert TRACES == ["power_sum"]
    assert len(kept(folder)) == 1


def test_over_lanes(folder):
    lanes = np.arange(6.0).reshape(2, 3)
    for _ in range(2):
        out, sine = Traced(add, axes=(0, None))(lanes, np.ones(3))
        np.testing.assert_array_equal(out, lanes + 1)
        np.testing.assert_allclose(sine, np.full((2, 3), np.sin(1.0)), rtol=1e-15)
    assert TRACES == ["add"]


def test_arguments_by_name(folder):
    """Over lanes as well; another name is another trace."""
    lanes = np.arange(6.0).reshape(2, 3)
    for _ in range(2):
        out, _ = Traced(add, axes=0, donate=(0,))(lanes, x=np.ones((2, 3)))
        np.testing.assert_array_equal(out, lanes + 1)
        np.testing.assert_array_equal(Traced(add)(x=lanes, state=np.ones((2, 3)))[0], lanes + 1)
    assert TRACES == ["add", "add"]


def test_what_is_compiled_ahead_is_not_traced_again(folder):
    """As `plan` does for `simulate`; without a folder nothing is done."""
    given = np.zeros(3), np.ones(3)
    assert Traced(add).compile(*given) is None
    start()
    np.testing.assert_array_equal(Traced(add)(*given)[0], 1)
    assert TRACES == ["add"]
    assert len(kept(folder)) == 1
    keep_traces(None)
    assert Traced(add).compile(*given) is None
    assert TRACES == ["add"]


def test_what_is_lowered_is_not_kept(folder):
    text = Traced(add).lower(np.zeros(3), np.ones(3)).as_text()
    assert "sine" in text
    assert kept(folder) == []


def test_without_optimisation_the_trace_is_the_same(folder):
    """One file serves both; compiled are two programs."""
    x = np.linspace(0.1, 2.0, 5)
    for unoptimised in (False, True):
        start()
        run = Traced(add, unoptimised=unoptimised)
        with compilations() as seen:
            out = run(np.full(5, 0.5), x)
        assert len(seen) >= 1
        np.testing.assert_allclose(out[0], 0.5 + x, rtol=1e-15)
        np.testing.assert_allclose(out[1], np.sin(x), rtol=1e-14)
        assert (traces._found_unoptimised != []) is unoptimised
    assert TRACES == ["add"]
    assert len(list(folder.iterdir())) == 1


def test_a_program_that_is_used_again_is_optimised_afterwards(folder, monkeypatch):
    """First and second start compile without optimisation; the third after it was seen to."""
    x, options = np.linspace(0.1, 2.0, 5), []
    monkeypatch.setattr(traces, "quick_options", lambda: options.append(1) or quick_options())
    begun = []
    monkeypatch.setattr(kept_trace, "optimise_afterwards", lambda paths: begun.append([*paths]))
    for unoptimised_so_far, given_over in ((1, 0), (2, 1), (2, 1)):
        start()
        state = np.full(5, 0.5)
        out = Traced(add, donate=(0,), unoptimised=True)(state, x)
        np.testing.assert_allclose(out[1], np.sin(x), rtol=1e-14)
        traces.optimise_afterwards()
        assert (len(options), len(begun)) == (unoptimised_so_far, given_over)
        for paths in begun:
            kept_trace.optimise(paths)
            assert kept_trace.read(paths[0]).optimised
    assert TRACES == ["add"]


def test_one_process_optimises_at_a_time(folder):
    Traced(add, unoptimised=True)(np.zeros(3), np.ones(3))
    (path,) = folder.iterdir()
    lock = take(folder)
    kept_trace.optimise([path])
    assert not kept_trace.read(path).optimised
    lock.release()
    kept_trace.optimise([folder / "gone", path])
    assert kept_trace.read(path).optimised
    assert kept(folder) == [path.name]


def test_outputs_go_in_again_and_compile_nothing(folder):
    """As the state of a solver does, whose memory is given away."""
    run, state, x = Traced(add, donate=(0,)), np.zeros(3), np.ones(3)
    state, _ = run(state, x)
    with compilations() as seen:
        for _ in range(3):
            given = state
            state, _ = run(given, x)
            assert given.is_deleted()
    assert seen == []
    np.testing.assert_array_equal(state, [4.0, 4.0, 4.0])


CHANGES = {
    "static argument": lambda run: run(scale=2.0),
    "static field": lambda run: run(pair(power=3)),
    "shape": lambda run: run(pair(size=1)),
    "dtype": lambda run: run(pair(np.float32), np.ones(3, np.float32)),
    "weak type": lambda run: run(x=1.0),
    "no array": lambda run: run(Pair(np.ones(3), 1)),
    "lanes": lambda run: run(axes=(None, 0)),
    "given away": lambda run: run(donate=(1,)),
}


@pytest.mark.parametrize("change", CHANGES)
def test_what_differs_is_traced_anew(folder, change):
    def run(both=None, x=None, *, scale=3.0, **how):
        x = jnp.ones(3) if x is None else x
        Traced(power_sum, scale, **how)(pair() if both is None else both, x)
        return len(TRACES)

    assert [run(), run()] == [1, 1]
    assert CHANGES[change](run) == 2
    assert CHANGES[change](run) == 2
    assert run() == 2


def test_surroundings_that_differ_are_traced_anew(folder, monkeypatch):
    """Settings, the package's switches, sources and versions."""

    def run():
        start()
        Traced(power_sum, 3.0)(pair(), jnp.ones(3))
        return len(TRACES)

    assert [run(), run()] == [1, 1]
    with jax.default_matmul_precision("highest"):
        assert run() == 2
    with monkeypatch.context() as patch:
        patch.setenv("JAXTRACHEA_ONE_KERNEL", "0")
        assert run() == 3
    with monkeypatch.context() as patch:
        patch.setattr(traces, "source_digest", lambda: "other sources")
        assert run() == 4
    for name in ("jax", "blackjax"):
        with monkeypatch.context() as patch:
            patch.setattr(traces, "installed", lambda n, name=name: "99" if n == name else "1")
            run()
    assert len(TRACES) == 6
    assert run() == 6


def test_sources_that_were_edited_keep_nothing(folder, monkeypatch):
    """What a process has read is then not what lies on the disk."""
    monkeypatch.setattr(traces, "_start", 0.0)
    for _ in range(2):
        assert Traced(add)(np.zeros(3), np.ones(3))[0].sum() == 3
    assert kept(folder) == []


def test_weak_types_are_not_kept(folder):
    """A trace would make them strong, and what they meet another dtype."""
    for _ in range(2):
        out = Traced(weak)(np.ones(3, np.float32))
        assert out.weak_type
    assert kept(folder) == []


def test_keys_of_random_numbers(folder):
    """As in draws from the posterior; the same numbers as without traces."""
    keys = jax.random.split(jax.random.key(0), 3)
    for _ in range(2):
        np.testing.assert_array_equal(
            Traced(draw, axes=0)(keys), [jax.random.uniform(key) for key in keys]
        )
    assert TRACES == ["draw"]


DEVICES = """
import threading, jax, numpy as np
from jaxtrachea.files import kept_trace, traces
from jaxtrachea.files.lock import take
from test_traces import add
import pathlib, sys
traces._KNOWN.add("test_traces")
traces._start = float("inf")
traces.keep_traces(pathlib.Path(sys.argv[1]))
run, made = traces.Traced(add, donate=(0,)), traces.Traced._by_trace
counted = []
traces.Traced._by_trace = lambda *a: counted.append(1) or made(*a)
def work(device, x):
    with jax.default_device(device):
        state = np.zeros(3)
        for _ in range(50):
            state, _ = run(state, x)
        assert state.devices() == {device}, state.devices()
        np.testing.assert_array_equal(state, 50 * x)
threads = [threading.Thread(target=work, args=(d, np.full(3, 1.0 + i)))
           for i, d in enumerate(jax.devices())]
failed = []
threading.excepthook = lambda args: failed.append(args.exc_value)
for t in threads: t.start()
for t in threads: t.join()
assert not failed, failed
print(len(jax.devices()), len(counted), len(list(pathlib.Path(sys.argv[1]).iterdir())))
"""


@pytest.mark.slow
def test_threads_on_two_devices(tmp_path):
    """As shards of a study: one trace, compiled once for each device."""
    environment = os.environ | {
        "XLA_FLAGS": os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=2",
        "PYTHONPATH": os.pathsep.join([str(ROOT / "tests"), str(ROOT / "tests" / "reference")]),
        "JAX_ENABLE_X64": "1",
        "JAX_PLATFORMS": "cpu",
    }
    done = subprocess.run(
        [sys.executable, "-c", DEVICES, str(tmp_path)],
        capture_output=True, text=True, env=environment, cwd=ROOT,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["2", "2", "1"]


@pytest.mark.parametrize("keeping", [True, False])
def test_threads_share_what_is_compiled(keeping, folder):
    """As shards on the cores of a CPU: one object for equal arguments, traced and compiled once."""
    if not keeping:
        keep_traces(None)
    together, found = threading.Barrier(8), []

    def work(i):
        together.wait()
        run = programs.program(power_sum, 2.0, axes=None)
        count = run(pair(), np.full(3, float(i)))["count"]
        found.append((id(run), float(count)))

    programs.program.__wrapped__.cache_clear()
    threads = [threading.Thread(target=work, args=(i,)) for i in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 8
    assert len(set(found)) == 1
    assert TRACES == ["power_sum"]


def test_code_from_elsewhere_is_not_kept(folder, monkeypatch):
    """It may change while the digest stays."""
    local = functools.wraps(add)(lambda state, x: add(state, x))
    assert Traced(local)(np.zeros(3), np.ones(3))[0].sum() == 3
    monkeypatch.setattr(traces, "_KNOWN", traces._KNOWN - {__name__.split(".")[0]})
    for _ in range(2):
        assert Traced(add)(np.zeros(3), np.ones(3))[0].sum() == 3
        assert Traced(power_sum, 3.0)(pair(), jnp.ones(3))["count"] == 3
    assert kept(folder) == []


def test_traced_arguments_are_not_kept(folder):
    run = Traced(add)
    _, slope = jax.jvp(lambda x: run(np.zeros(3), x)[1], (jnp.zeros(3),), (jnp.ones(3),))
    np.testing.assert_array_equal(slope, np.ones(3))
    np.testing.assert_array_equal(jax.jit(run)(np.zeros(3), np.ones(3))[0], np.ones(3))
    assert kept(folder) == []


def test_a_damaged_trace_is_made_anew(folder):
    Traced(add)(np.zeros(3), np.ones(3))
    (path,) = folder.iterdir()
    whole = path.read_bytes()
    for damaged in (whole[:-1], b"", whole[:200] + bytes([whole[200] ^ 1]) + whole[201:]):
        path.write_bytes(damaged)
        assert Traced(add)(np.zeros(3), np.ones(3))[0].sum() == 3
        assert kept_trace.read(path) is not None
    assert len(TRACES) == 4


def test_a_trace_that_cannot_be_read_is_no_fault(folder):
    """Whole, and yet of no use: it is traced as ever."""
    Traced(add)(np.zeros(3), np.ones(3))
    (path,) = folder.iterdir()
    for content in (
        b"",
        b"no pickle",
        pickle.dumps(("add", b"no trace", 0, ())),
        b"cno_module\nx\n.",
    ):
        path.write_bytes(hashlib.sha256(content).digest() + content)
        assert Traced(add)(np.zeros(3), np.ones(3))[0].sum() == 3


def test_where_nothing_can_be_written(folder):
    (folder / "file").touch()
    keep_traces(folder / "file" / "folder")
    assert Traced(add)(np.zeros(3), np.ones(3))[0].sum() == 3
    keep_traces(folder / "new" / "folder")
    assert Traced(add)(np.zeros(3), np.ones(3))[0].sum() == 3
    assert len(kept(folder / "new" / "folder")) == 1


@pytest.mark.parametrize("where", [None, Path("gs://bucket/programs")])
def test_nowhere(folder, monkeypatch, where):
    """Neither in no folder nor in one of another machine, which JAX can write."""
    monkeypatch.chdir(folder)
    keep_traces(where)
    assert Traced(add)(np.zeros(3), np.ones(3))[0].sum() == 3
    assert kept(folder) == []


def test_members_of_a_set_are_said_in_order():
    """Ten thousand words: in two sets of equal content, made in two orders."""
    words = [f"word {i}" for i in range(10_000)]
    said = {traces._said({"a": frozenset(v)}) for v in (words, words[::-1])}
    assert len(said) == 1
    assert said != {traces._said({"a": frozenset(words[1:])})}
    assert traces._said({1, 2}) != traces._said(frozenset({1, 2}))


def test_a_function_that_fails_says_so(folder):
    """As without traces: the message is of the function, not of what keeps it."""
    with pytest.raises(TypeError, match="add got incompatible shapes"):
        Traced(add)(np.zeros(3), np.ones(2))
    assert kept(folder) == []


COUNTED = """
import sys
from jaxtrachea.cli.main import main
from jaxtrachea.files.traces import Traced
made = Traced._traced
def count(self, *arguments):
    print("traced", self._name, file=sys.stderr)
    return made(self, *arguments)
Traced._traced = count
sys.exit(main())
"""


def started(command, folder, seed):
    """A command in a process of its own: what it traces, and its tables.

    Another seed of Python's hashes, as every process has by itself.
    """
    environment = os.environ | {
        "JAX_ENABLE_COMPILATION_CACHE": "true",
        "JAX_COMPILATION_CACHE_DIR": str(folder / "kept"),
        "PYTHONHASHSEED": seed,
    }
    out = folder / seed
    done = subprocess.run(
        [sys.executable, "-c", COUNTED, *command, "--out", str(out)],
        capture_output=True, text=True, check=True, env=environment, cwd=ROOT,
    )  # fmt: skip
    tables = {path.relative_to(out): path.read_text() for path in out.rglob("*.csv")}
    return re.findall(r"traced (\w+)", done.stderr), tables


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize(
    ("command", "main"),
    [
        (["simulate", "configs/cross_sections.toml"], "simulate"),
    ],
    ids=lambda v: Path(v[1]).stem if isinstance(v, list) else "",
)
def test_warm_commands_trace_none_of_their_programs(command, main, tmp_path):
    """The same numbers."""
    (cold, made), (warm, again) = (started(command, tmp_path, seed) for seed in ("1", "2"))
    assert main in cold
    assert warm == []
    assert made == again


@pytest.mark.slow
@pytest.mark.compiling
def test_the_third_fit_finds_its_programs_optimised(tmp_path):
    """The second traces nothing, and has them optimised: the third gives the same but for rounding.

    The third compiles nothing: no program is new.
    """

    def programs():
        return {path.name for path in (tmp_path / "kept").glob("*-cache")}

    command = ["fit", "fits/virtual_trachea/fit.toml"]
    cold, made = started(command, tmp_path, "1")
    unoptimised = programs()
    warm, again = started(command, tmp_path, "2")
    assert {"_advance", "information", "residual_value"} <= set(cold)
    assert warm == []
    assert made == again

    traced, end = [*(tmp_path / "kept").glob("*-traced")], time.monotonic() + 300
    while not all(kept_trace.read(path).optimised for path in traced):
        assert time.monotonic() < end
        time.sleep(0.5)
    optimised = programs()
    assert optimised > unoptimised
    third, last = started(command, tmp_path, "3")
    assert third == []
    assert programs() == optimised
    estimates = [
        [float(row["value"]) for row in csv.DictReader(tables[Path("parameters.csv")].splitlines())]
        for tables in (made, last)
    ]
    np.testing.assert_allclose(*estimates, rtol=1e-6)
