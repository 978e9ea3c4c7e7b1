"""Speed of the skeleton: one call, many lanes. Run: python tests/bench/skeleton.py [part].

15 rings 10 mm apart, k = 0.1 N/mm, EI = 1.86 N mm^2 (the test problem of docs/beam_accuracy.md).
OpenSees needs its own libraries: LD_LIBRARY_PATH=<site-packages>/openseespylinux/lib. Without it
the row is missing and the results say why.
"""

import ctypes
import subprocess
import sys
import tempfile
from pathlib import Path

import common
import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import solveh_banded
from scipy.linalg.lapack import dpbsv

from jaxtrachea.mechanics.beam import Beam, contact_compliance, deflect

# What jax does not deem cheap it hands to another thread: 7 to 9 us a call. Real-time loops, too,
# are better off without.
jax.config.update("jax_cpu_enable_async_dispatch", False)

K, EI, FORCE, PITCH = 0.1, 1.86, 0.1, 10.0
LANES = 4096


def beam(n: int = 15, length: float | None = None) -> Beam:
    """The test problem with n rings."""
    x = PITCH * jnp.arange(1, n + 1)
    length = PITCH * (n + 1) if length is None else length
    return Beam(x, jnp.asarray(length), jnp.full(n + 1, EI), jnp.full(n, K))


def wait(call):
    """The call with its result waited for."""
    return lambda: jax.block_until_ready(call())


class Banded:
    """Hermite beam elements on rings and the loaded point; upper banded storage, 3 off-diagonals.

    Springs, loads and clamps are written into kept arrays; assembly is five slices per solve.
    """

    def __init__(self, nodes, rings, loaded: int, clamped_end: bool):
        """Nodes (mm) without the first clamp; `rings`: node of each spring."""
        self.h = np.diff(nodes, prepend=0.0)
        self.count = len(nodes) - clamped_end
        self.rings, self.load = 2 * np.asarray(rings), 2 * loaded

    def solve(self, EI, k, F, solver):
        """Displacement at the load and reactions of the springs."""
        h, m = self.h, self.count
        EI_h = EI / h
        r = 6 * EI_h / h
        t = 2 * r / h
        band = np.zeros((4, 2 * m))
        band[3, 0::2] = t[:m]
        band[3, 0 : 2 * (len(h) - 1) : 2] += t[1:]
        band[3, 1::2] = 4 * EI_h[:m]
        band[3, 1 : 2 * (len(h) - 1) : 2] += 4 * EI_h[1:]
        band[3, self.rings] += k
        band[2, 1::2] = -r[:m]
        band[2, 1 : 2 * (len(h) - 1) : 2] += r[1:]
        band[1, 2::2] = -t[1:m]
        band[1, 3::2] = 2 * EI_h[1:m]
        band[2, 2::2] = -r[1:m]
        band[0, 3::2] = r[1:m]
        f = np.zeros(2 * m)
        f[self.load] = F
        u = solver(band, f)
        return u[self.load], k * u[self.rings]


def with_dpbsv(band, f):
    """LAPACK's banded Cholesky without scipy's checks."""
    return dpbsv(band, f, overwrite_ab=1, overwrite_b=1)[1]


def opensees(nodes, rings, loaded: int, clamped_end: bool):
    """The same frame in OpenSees, built once; returns a function reset + analyze + reactions."""
    import openseespy.opensees as ops

    ops.wipe()
    ops.model("basic", "-ndm", 2, "-ndf", 3)
    ops.geomTransf("Linear", 1)
    ops.node(1, 0.0, 0.0)
    ops.fix(1, 1, 1, 1)
    for i, x in enumerate(nodes):
        ops.node(i + 2, float(x), 0.0)
        ops.element("elasticBeamColumn", i + 1, i + 1, i + 2, 1e3, 1e3, EI / 1e3, 1)
    ops.fix(len(nodes) + 1, 1, int(clamped_end), int(clamped_end))
    ops.uniaxialMaterial("Elastic", 1, K)
    for i, node in enumerate(rings):
        ops.node(1000 + i, float(nodes[node]), 0.0)
        ops.fix(1000 + i, 1, 1, 1)
        pair = (1000 + i, int(node) + 2)
        ops.element("zeroLength", 1000 + i, *pair, "-mat", 1, "-dir", 2)
    ops.timeSeries("Constant", 1)
    ops.pattern("Plain", 1, 1)
    ops.load(loaded + 2, 0.0, FORCE, 0.0)
    ops.system("BandSPD")
    ops.numberer("RCM")
    ops.constraints("Plain")
    ops.integrator("LoadControl", 1.0)
    ops.algorithm("Linear")
    ops.analysis("Static")
    springs = range(1000, 1000 + len(rings))

    def call():
        ops.reset()
        assert ops.analyze(1) == 0
        ops.reactions()
        return ops.nodeDisp(loaded + 2, 2), [-ops.nodeReaction(i, 2) for i in springs]

    return call


def single(out: common.Writer) -> None:
    """One call with reactions against OpenSees and banded LAPACK, same problem, same outputs."""
    x = PITCH * np.arange(1, 16)
    problems = {
        # Contact between two rings of a tube clamped at both ends.
        "mid-tube": (np.sort(np.append(x, [83.0, 160.0])), [*range(8), *range(9, 16)], 8, True),
        # Loaded free end: rings up to 150, C = 155; the far beam is what the library always has.
        "cantilever": (np.append(x, 155.0), list(range(15)), 15, False),
    }
    for name, (nodes, rings, loaded, clamped) in problems.items():
        cases = {}
        if clamped:
            args = (*jax.tree.leaves(beam()), jnp.asarray(83.0), jnp.asarray(FORCE))
            run = jax.jit(two_outputs)
            everything = jax.jit(lambda x, L, EI, k, s, F: tuple(deflect(Beam(x, L, EI, k), s, F)))
            cases["jaxtrachea: w_C, reactions"] = wait(lambda r=run, a=args: r(*a))
            cases["jaxtrachea: all seven outputs"] = wait(lambda r=everything, a=args: r(*a))
            gradient = jax.jit(jax.value_and_grad(compliance_of, argnums=(2, 3, 4)))
            cases["jaxtrachea: w_C and gradient (k, EI, s_c)"] = wait(
                lambda r=gradient, a=args: r(*a[:5])
            )
            expected = [np.asarray(v) for v in run(*args)]
        else:
            # The library clamps both ends: beyond the tip follow a ring without stiffness and a
            # span that is 1e-10 times as stiff.
            tip, k, soft = jnp.asarray(155.0), jnp.full(16, K).at[15].set(0.0), 1e-10 * EI
            args = (jnp.append(beam().x, tip), jnp.asarray(1155.0))
            args = (*args, jnp.full(17, EI).at[16].set(soft), k, tip, jnp.asarray(FORCE))
            run = jax.jit(two_outputs)
            expected = [np.asarray(v) for v in run(*args)]
            expected[1] = expected[1][:15]
            cases["jaxtrachea: w_C, reactions"] = wait(lambda r=run, a=args: r(*a))
        kept = jax.jit(lambda s, F, a=args: two_outputs(*a[:4], s, F))
        cases["jaxtrachea: w_C, reactions, beam kept"] = wait(lambda r=kept, a=args: r(*a[4:]))
        floor = jax.jit(lambda x, L, EI, k, s, F: (x[0] + L, EI + k[0] + s + F))
        cases["a jitted call that computes nothing (6 in, 2 out)"] = wait(
            lambda f=floor, a=args: f(*a)
        )
        banded = Banded(nodes, rings, loaded, clamped)
        EIs, ks = np.full(len(nodes), EI), np.full(15, K)
        solvers = {"solveh_banded": solveh_banded, "dpbsv": with_dpbsv}
        for label, solver in solvers.items():
            cases[f"numpy + {label}"] = lambda b=banded, s=solver, e=EIs, k=ks: b.solve(
                e, k, FORCE, s
            )
        try:
            cases["OpenSees: reset + analyze + reactions"] = opensees(nodes, rings, loaded, clamped)
        except (ImportError, RuntimeError) as error:
            out.note("single", f"OpenSees could not be loaded: {error}")
        errors = {}
        for case, call in cases.items():
            if "numpy" in case or "OpenSees" in case:
                w, R = call()
                errors[case] = max(
                    common.close(case, w, expected[0]), common.close(case, R, expected[1])
                )
        found = common.interleaved(cases, rounds=51, target=0.004)
        for case, samples in found.items():
            out.add("single", case, samples, problem=name, error=errors.get(case))


def two_outputs(x, L, EI, k, s, F):
    """What OpenSees gives: deflection of C and the reactions."""
    d = deflect(Beam(x, L, EI, k), s, F)
    return d.w_C, d.reaction


def compliance_of(x, L, EI, k, s):
    """Deflection of C per newton."""
    return contact_compliance(Beam(x, L, EI, k), s)


def c_library() -> ctypes.CDLL:
    """sweep.c, compiled here."""
    target = Path(tempfile.mkdtemp()) / "sweep.so"
    source = common.FOLDER / "sweep.c"
    flags = ["-O3", "-march=native", "-shared", "-fPIC"]
    subprocess.run(["cc", *flags, "-o", str(target), str(source)], check=True)
    return ctypes.CDLL(str(target))


def lane_inputs(n: int, lanes: int):
    """Rings, then per lane EI, k, s_c, F, all different."""
    rng = np.random.default_rng(7)
    b = beam(n)
    EIs = EI * np.exp(0.2 * rng.standard_normal((lanes, n + 1)))
    ks = K * np.exp(0.2 * rng.standard_normal((lanes, n)))
    s = rng.uniform(0.02, 0.98, lanes) * float(b.length)
    F = FORCE * np.exp(0.2 * rng.standard_normal(lanes))
    return np.asarray(b.x), float(b.length), EIs, ks, s, F


def address(v):
    """Pointer for ctypes."""
    return v.ctypes.data_as(ctypes.c_void_p)


def c_calls(n: int, lanes: int):
    """C value and gradient on the inputs of `lane_inputs`; each returns its output arrays."""
    library = c_library()
    x, L, EIs, ks, s, F = lane_inputs(n, lanes)
    new = lambda *shape: np.zeros((lanes, *shape))  # noqa: E731
    tip, w, theta, R = new(4), new(n), new(n), new(n)
    w_C, dk, dEI, ds = new(), new(n), new(n + 1), new()
    head = [ctypes.c_int(lanes), ctypes.c_int(n), address(x), ctypes.c_double(L)]
    head += [address(v) for v in (EIs, ks, s, F)]
    keep = (x, EIs, ks, s, F)
    value_args = [*head, *map(address, (tip, w, theta, R))]
    grad_args = [*head, *map(address, (w_C, dk, dEI, ds))]

    def value():
        library.values(*value_args)
        return tip, w, theta, R, keep

    def gradient():
        library.gradients(*grad_args)
        return w_C, dk, dEI, ds, keep

    return value, gradient


def jax_calls(n: int, lanes: int, form: str = "recursion"):
    """Our programs on the inputs of `lane_inputs`, as name: jitted call without arguments."""
    inputs = tuple(map(jnp.asarray, lane_inputs(n, lanes)))

    def value(x, L, EI, k, s, F):
        return tuple(deflect(Beam(x, L, EI, k), s, F, form=form))

    def w_C(x, L, EI, k, s, F):
        if form == "recursion":
            return F * contact_compliance(Beam(x, L, EI, k), s)
        return value(x, L, EI, k, s, F)[0]

    programs = {
        "value": value,
        "w_C": w_C,
        "gradient": jax.value_and_grad(w_C, argnums=(2, 3, 4)),
    }
    batched = {
        name: jax.jit(jax.vmap(f, in_axes=(None, None, 0, 0, 0, 0))) for name, f in programs.items()
    }
    return {name: wait(lambda f=f: f(*inputs)) for name, f in batched.items()}


def lanes(out: common.Writer) -> None:
    """4096 lanes: ours, the dense form, a scalar C loop."""
    ours, dense = jax_calls(15, LANES), jax_calls(15, LANES, "reactions")
    c_value, c_gradient = c_calls(15, LANES)
    w_C, theta_C, w, theta, R, force_A, moment_A = ours["value"]()
    tip = np.stack([w_C, theta_C, force_A, moment_A], 1)
    errors = {}
    pairs = zip(("tip", "w", "theta", "R"), c_value()[:4], (tip, w, theta, R), strict=True)
    errors["C: all outputs"] = max(common.close(f"C {name}", a, b) for name, a, b in pairs)
    value, (dEI, dk, ds) = ours["gradient"]()
    pairs = zip(("w_C", "dk", "dEI", "ds"), c_gradient()[:4], (value, dk, dEI, ds), strict=True)
    errors["C: w_C and gradient"] = max(common.close(f"C {name}", a, b) for name, a, b in pairs)
    errors["dense: w_C"] = common.close("dense", dense["w_C"](), ours["w_C"]())
    errors["dense: all outputs"] = common.close("dense", dense["value"]()[4], R)
    dense_gradient = dense["gradient"]()
    errors["dense: w_C and gradient"] = common.close("dense", dense_gradient[1][1], dk)
    cases = {
        "jaxtrachea: w_C": ours["w_C"],
        "jaxtrachea: all outputs": ours["value"],
        "jaxtrachea: w_C and gradient": ours["gradient"],
        "C: all outputs": c_value,
        "C: w_C and gradient": c_gradient,
        "dense: w_C": dense["w_C"],
        "dense: all outputs": dense["value"],
        "dense: w_C and gradient": dense["gradient"],
    }
    every = {case: errors.get(case) for case in cases}
    found = common.interleaved(cases, rounds=25, target=0.002)
    out.table("lanes", found, lanes=LANES, error=every)


if __name__ == "__main__":
    writer = common.Writer("skeleton", "scipy", "openseespy")
    parts = {"single": single, "lanes": lanes}
    for part in sys.argv[1:] or parts:
        parts[part](writer)
    if not sys.argv[1:]:
        writer.write()
