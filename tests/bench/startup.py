"""Import and compile times. Run: python tests/bench/startup.py.

Every sample is a fresh process, so that nothing is cached. Compile time: first call less a later
one.
"""

import json
import subprocess
import sys

import common

HEAD = f"import sys; sys.path.insert(0, {str(common.FOLDER)!r}); import common; import time\n"
START = "begin = time.perf_counter()\n"
STOP = "print(json.dumps(time.perf_counter() - begin))\n"
MODEL = """
import jax, jax.numpy as jnp
from jaxtrachea.model import press
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
from jaxtrachea.identify import fit, solve
fitting.SPECIMENS = 256
p, *_ = fitting.study()
s = fit.Settings(starts=1)
args = (p, np.arange(256), fit.draw_starts(p, s), fit.first_sigma(p))
f = lambda *a: solve.levenberg_marquardt(*a).theta
"""
CASES = {
    "import jax (alone)": START + "import json, jax\n" + STOP,
    "import jaxtrachea": START + "import json, jaxtrachea\n" + STOP,
    "import jaxtrachea.model": START + "import json, jaxtrachea.model\n" + STOP,
    "import jaxtrachea.identify.fit": START + "import json, jaxtrachea.identify.fit\n" + STOP,
    "compile press, 50 displacements": "import json" + MODEL + "f = jax.jit(value)" + TIMED,
    "compile gradient of press, 5 arguments": "import json"
    + MODEL
    + "f = jax.jit(jax.grad(cost, argnums=(0, 1, 2, 3, 4)))"
    + TIMED,
    "compile Levenberg-Marquardt, 256 lanes": "import json" + FIT + TIMED,
}


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
    out.write()


if __name__ == "__main__":
    main()
