"""Import and compile times. Run: python tests/bench/startup.py.

Every sample is a fresh process, so that nothing is cached. Compile time: first call less a later
one. Commands: wall time of the whole process, with an empty folder for compiled programs (cold) and
with the one that the cold start left (warm).
"""

import json
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import common

HEAD = f"import sys; sys.path.insert(0, {str(common.FOLDER)!r}); import common; import time\n"
START = "begin = time.perf_counter()\n"
STOP = "print(json.dumps(time.perf_counter() - begin))\n"
MODEL = """
import jax, jax.numpy as jnp
from jaxtrachea.mechanics.press import press
from jaxtrachea.trachea.geometry import table_1
from jaxtrachea.trachea.material import Material
g, D = table_1(), jnp.linspace(0.0, 6.0, 50)
def value(EI, k, k_1, k_3, s):
    p = press(g, Material(EI, k, k_1, k_3), s, D)
    return p.force, p.skeleton, p.joints, p.reactions
def cost(*a):
    return jnp.sum(value(*a)[0])
args = [jnp.asarray(v) for v in (100.0, 1.0, 1.0, 0.01, 83.0)]
"""
TIMED = """
begin = time.perf_counter(); jax.block_until_ready(f(*args)); first = time.perf_counter() - begin
begin = time.perf_counter(); jax.block_until_ready(f(*args)); later = time.perf_counter() - begin
print(json.dumps(first - later))
"""
FIT = """
import fitting, jax, numpy as np
from jaxtrachea.fitting.cost import LaneCost
from jaxtrachea.optimisation.levenberg_marquardt import levenberg_marquardt
from jaxtrachea.fitting.noise import first_sigma
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.fitting.starts import draw_starts
fitting.SPECIMENS = 256
p, *_ = fitting.make_study()
s = Settings(starts=1)
args = (LaneCost(p.model, p.lanes, first_sigma(p)), draw_starts(p, s))
f = lambda *a: levenberg_marquardt(*a).theta
"""
CASES = {
    "import jax (alone)": START + "import json, jax\n" + STOP,
    "import jaxtrachea": START + "import json, jaxtrachea\n" + STOP,
    "import jaxtrachea.mechanics.press": START + "import json, jaxtrachea.mechanics.press\n" + STOP,
    "import jaxtrachea.fitting.fit": START + "import json, jaxtrachea.fitting.fit\n" + STOP,
    "compile press, 50 displacements": "import json" + MODEL + "f = jax.jit(value)" + TIMED,
    "compile gradient of press, 5 arguments": "import json"
    + MODEL
    + "f = jax.jit(jax.grad(cost, argnums=(0, 1, 2, 3, 4)))"
    + TIMED,
    "compile Levenberg-Marquardt, 256 lanes": "import json" + FIT + TIMED,
}


ROOT = common.FOLDER.parents[1]
COMMANDS = {
    "fit": ["fit", str(ROOT / "fits" / "virtual_trachea" / "fit.toml")],
    "simulate": ["simulate", str(ROOT / "configs" / "normal.toml")],
}
#: The command with a count of the programs asked for and of those found in the cache.
COUNTED = """
import collections, sys, jax
seen = collections.Counter()
jax.monitoring.register_event_listener(lambda name, **_: seen.update([name.rsplit("/")[-1]]))
from jaxtrachea.cli.main import main
try:
    sys.exit(main())
finally:
    print("counted", seen["cache_hits"], seen["compile_requests_use_cache"], file=sys.stderr)
"""


def command(arguments, cache: Path, out: Path | None = None, how=("-m", "jaxtrachea")):
    """Wall seconds of a fresh `jaxtrachea` with compiled programs in `cache`, and its messages."""
    where = [] if out is None else ["--out", str(out)]
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(cache)}
    begin = time.perf_counter()
    done = subprocess.run(
        [sys.executable, *how, *arguments, *where],
        capture_output=True, text=True, check=True, env=environment,
    )  # fmt: skip
    return time.perf_counter() - begin, done.stderr


def programs(cache: Path) -> set[str]:
    """Names of the compiled programs in the folder."""
    return {path.name for path in cache.iterdir() if not path.name.endswith("-atime")}


def commands(out: common.Writer) -> None:
    """Cold and warm start of the command line; asserts that a warm one compiles nothing."""
    quick = {"jaxtrachea --help": ["--help"], "jaxtrachea --version": ["--version"]}
    samples = {name: [] for name in quick}
    kept, added = {}, {}
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as base:
        for i in range(3):
            for name, arguments in quick.items():
                samples[name].append(command(arguments, Path(base))[0])
            for name, arguments in COMMANDS.items():
                cache = Path(base) / f"{name}_cache_{i}"
                cache.mkdir()
                for start in ("cold", "warm"):
                    before = programs(cache)
                    taken, _ = command(arguments, cache, Path(base) / f"{name}_{start}_{i}")
                    samples.setdefault(f"jaxtrachea {name}, {start}", []).append(taken)
                kept[name], added[name] = len(before), len(programs(cache) - before)
        for name, arguments in COMMANDS.items():
            cache = Path(base) / f"{name}_cache_2"  # the last one
            _, said = command(arguments, cache, Path(base) / f"{name}_more", ("-c", COUNTED))
            hits, asked = map(int, re.findall(r"counted (\d+) (\d+)", said)[-1])
            assert hits == asked > 0, f"{name}: {hits} of {asked} programs were kept"
            assert not added[name], f"{name}: the warm start added {added[name]} programs"
            counts = {"kept": kept[name], "added": added[name], "hits": hits, "asked": asked}
            out.rows.append({"kind": "cache", "table": "cache", "case": name} | counts)
            print(out.rows[-1], flush=True)
    out.table("commands", samples)


def main() -> None:
    """Three fresh processes each, in turn."""
    out = common.Writer("startup", "equinox")
    samples = {name: [] for name in CASES}
    for _ in range(3):
        for name, code in CASES.items():
            done = subprocess.run(
                [sys.executable, "-c", HEAD + code], capture_output=True, text=True, check=True
            )
            samples[name].append(json.loads(done.stdout.splitlines()[-1]))
    out.table("startup", samples)
    commands(out)
    out.write()


if __name__ == "__main__":
    main()
