"""Functions that are not traced anew at every start: what is kept, and what must not be."""

import functools
import os
import re
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrachea.files import traces
from jaxtrachea.files.traces import Traced

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


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder for traces, and this module taken for one whose code the digest tells."""
    monkeypatch.setattr(traces, "_folder", lambda settings: tmp_path)
    monkeypatch.setattr(traces, "_KNOWN", traces._KNOWN | {__name__.split(".")[0]})
    TRACES.clear()
    return tmp_path


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


def test_outputs_go_in_again_and_compile_nothing(folder):
    """As the state of a solver does, whose memory is given away."""
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda name, duration, **_: compiled.append(name) if "backend_compile" in name else None
    )
    run, state, x = Traced(add, donate=(0,)), np.zeros(3), np.ones(3)
    state, _ = run(state, x)
    del compiled[:]
    for _ in range(3):
        given = state
        state, _ = run(given, x)
        assert given.is_deleted()
    assert compiled == []
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
    def run():
        Traced(power_sum, 3.0)(pair(), jnp.ones(3))
        return len(TRACES)

    assert run() == 1
    with jax.default_matmul_precision("highest"):
        assert run() == 2
    with monkeypatch.context() as patch:
        patch.setenv("JAXTRACHEA_ONE_KERNEL", "0")
        assert run() == 3
    with monkeypatch.context() as patch:
        patch.setattr(traces, "source_digest", lambda: "other sources")
        patch.setattr(traces, "_sources", traces._sources.__wrapped__)
        assert run() == 4
    with monkeypatch.context() as patch:
        patch.setattr(jax, "__version__", "99.0")
        patch.setattr(traces, "_sources", traces._sources.__wrapped__)
        assert run() == 5
    assert run() == 5


def test_settings_that_change_meanwhile_are_seen(folder):
    """Of one object: a `with`, and settings of the whole process."""
    run = Traced(power_sum, 3.0)
    run(pair(), jnp.ones(3))
    with jax.default_matmul_precision("highest"):
        run(pair(), jnp.ones(3))
    assert len(TRACES) == 2
    jax.config.update("jax_softmax_custom_jvp", True)
    try:
        run(pair(), jnp.ones(3))
    finally:
        jax.config.update("jax_softmax_custom_jvp", False)
    assert len(TRACES) == 3


def test_settings_for_debugging_keep_nothing(folder):
    with jax.disable_jit():
        out, _ = Traced(add)(np.zeros(3), np.ones(3))
    with jax.debug_nans(True), pytest.raises(FloatingPointError):
        Traced(add)(np.zeros(3), np.full(3, np.inf))
    np.testing.assert_array_equal(out, np.ones(3))
    assert kept(folder) == []


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
        assert traces._read(path) is not None
    assert len(TRACES) == 4


def test_where_nothing_can_be_written(folder, monkeypatch):
    (folder / "file").touch()
    monkeypatch.setattr(traces, "_folder", lambda settings: folder / "file" / "folder")
    assert Traced(add)(np.zeros(3), np.ones(3))[0].sum() == 3
    monkeypatch.setattr(traces, "_folder", lambda settings: folder / "new" / "folder")
    assert Traced(add)(np.zeros(3), np.ones(3))[0].sum() == 3
    assert len(kept(folder / "new" / "folder")) == 1


def test_without_a_folder_nothing_is_kept(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert Traced(add)(np.zeros(3), np.ones(3))[0].sum() == 3
    assert kept(tmp_path) == []


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


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize(
    ("command", "main"),
    [
        (["fit", "fits/virtual_trachea/fit.toml"], {"_advance", "information", "residual_value"}),
        (["simulate", "configs/cross_sections.toml"], {"simulate"}),
        (["sweep", "configs/scan.toml"], {"sweep"}),
    ],
    ids=lambda v: Path(v[1]).stem if isinstance(v, list) else "",
)
def test_warm_commands_trace_none_of_their_programs(command, main, tmp_path):
    """The same numbers; another seed of Python's hashes, as every process has by itself."""
    said, made = [], []
    for seed in ("1", "2"):
        environment = os.environ | {
            "JAX_ENABLE_COMPILATION_CACHE": "true",
            "JAX_COMPILATION_CACHE_DIR": str(tmp_path / "kept"),
            "PYTHONHASHSEED": seed,
        }
        done = subprocess.run(
            [sys.executable, "-c", COUNTED, *command, "--out", str(tmp_path / seed)],
            capture_output=True, text=True, check=True, env=environment, cwd=ROOT,
        )  # fmt: skip
        said.append(re.findall(r"traced (\w+)", done.stderr))
        made.append({p.relative_to(tmp_path / seed): p.read_bytes()
                     for p in (tmp_path / seed).rglob("*.csv")})  # fmt: skip
    assert main <= set(said[0])
    assert said[1] == []
    assert made[0] == made[1]
