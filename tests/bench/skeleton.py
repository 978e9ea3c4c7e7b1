"""Speed of the skeleton: one call, many lanes. Run: python tests/bench/skeleton.py [part].

15 rings 10 mm apart, k = 0.1 N/mm, EI = 1.86 N mm^2 (the test problem of
docs/evidence/beam_accuracy.md). If OpenSees cannot be loaded its row is missing and the
results say why.
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
from frames import Banded, Frame, opensees, with_dpbsv
from scipy.linalg import solveh_banded

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


def mid_tube() -> tuple[Frame, tuple]:
    """Contact between two rings of a tube clamped at both ends; the frame and our arguments."""
    nodes = np.sort(np.append(beam().x, [83.0, 160.0]))
    frame = Frame(nodes, [*range(8), *range(9, 16)], 8, True)
    return frame, (*jax.tree.leaves(beam()), jnp.asarray(83.0), jnp.asarray(FORCE))


def cantilever() -> tuple[Frame, tuple]:
    """Loaded free end: rings up to 150, C = 155; the frame and our arguments.

    The library clamps both ends: beyond the tip follow a ring without stiffness and a span that is
    1e-10 times as stiff.
    """
    frame = Frame(np.append(beam().x, 155.0), list(range(15)), 15, False)
    tip, k, soft = jnp.asarray(155.0), jnp.full(16, K).at[15].set(0.0), 1e-10 * EI
    args = (jnp.append(beam().x, tip), jnp.asarray(1155.0), jnp.full(17, EI).at[16].set(soft), k)
    return frame, (*args, tip, jnp.asarray(FORCE))


def of_frame(frame: Frame) -> tuple:
    """EI of every element, k of every spring and the force, for the programs in frames.py."""
    return np.full(len(frame.nodes), EI), np.full(len(frame.rings), K), FORCE


def our_calls(args: tuple) -> dict:
    """Ours with everything read at every call, and with the beam as constants of the program."""
    run, kept = jax.jit(two_outputs), jax.jit(lambda s, F: two_outputs(*args[:4], s, F))
    return {
        "jaxtrachea: w_C, reactions": wait(lambda: run(*args)),
        "jaxtrachea: w_C, reactions, beam kept": wait(lambda: kept(*args[4:])),
    }


def more_calls(args: tuple) -> dict:
    """Ours with more outputs."""
    everything = jax.jit(lambda x, L, EI, k, s, F: tuple(deflect(Beam(x, L, EI, k), s, F)))
    gradient = jax.jit(jax.value_and_grad(compliance_of, argnums=(2, 3, 4)))
    return {
        "jaxtrachea: all seven outputs": wait(lambda: everything(*args)),
        "jaxtrachea: w_C and gradient (k, EI, s_c)": wait(lambda: gradient(*args[:5])),
    }


def numpy_calls(frame: Frame) -> dict:
    """The banded matrix by scipy and by LAPACK alone."""
    banded, given = Banded(frame), of_frame(frame)
    return {
        "numpy + solveh_banded": lambda: banded.solve(*given, solveh_banded),
        "numpy + dpbsv": lambda: banded.solve(*given, with_dpbsv),
    }


def differs(name: str, found, expected) -> float:
    """Of deflection and reactions, the one that differs more; of our reactions the first count."""
    (w, R), (w_C, reactions) = found, expected
    error = common.close(name, w, w_C), common.close(name, R, np.asarray(reactions)[: len(R)])
    return max(error)


def single(out: common.Writer) -> None:
    """One call with reactions against OpenSees and banded LAPACK, same problem, same outputs."""
    for problem, (frame, args) in {"mid-tube": mid_tube(), "cantilever": cantilever()}.items():
        cases = our_calls(args)
        expected = cases["jaxtrachea: w_C, reactions"]()
        cases |= more_calls(args) if frame.clamped_end else {}
        floor = jax.jit(lambda x, L, EI, k, s, F: (x[0] + L, EI + k[0] + s + F))
        cases["a jitted call that computes nothing (6 in, 2 out)"] = wait(
            lambda f=floor, a=args: f(*a)
        )
        rivals = numpy_calls(frame)
        try:
            rivals["OpenSees: reset + analyze + reactions"] = opensees(frame, *of_frame(frame))
        except ImportError as error:
            out.note("single", f"{error}")
        errors = {case: differs(case, call(), expected) for case, call in rivals.items()}
        found = common.interleaved(cases | rivals, rounds=51, target=0.004)
        for case, samples in found.items():
            out.add("single", case, samples, problem=problem, error=errors.get(case))


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

    def new(*shape):
        return np.zeros((lanes, *shape))

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


def values_differ(c_outputs, outputs) -> float:
    """The largest difference of all outputs between the C loop and ours."""
    w_C, theta_C, w, theta, R, force_A, moment_A = outputs
    expected = np.stack([w_C, theta_C, force_A, moment_A], 1), w, theta, R
    pairs = zip(("tip", "w", "theta", "R"), c_outputs[:4], expected, strict=True)
    return max(common.close(f"C {name}", a, b) for name, a, b in pairs)


def gradients_differ(c_outputs, outputs) -> float:
    """The largest difference of w_C and its gradient between the C loop and ours."""
    value, (dEI, dk, ds) = outputs
    pairs = zip(("w_C", "dk", "dEI", "ds"), c_outputs[:4], (value, dk, dEI, ds), strict=True)
    return max(common.close(f"C {name}", a, b) for name, a, b in pairs)


def lanes(out: common.Writer) -> None:
    """4096 lanes: ours, the dense form, a scalar C loop."""
    ours, dense = jax_calls(15, LANES), jax_calls(15, LANES, "reactions")
    c_value, c_gradient = c_calls(15, LANES)
    (*_, R, _, _), (_, (_, dk, _)) = ours["value"](), ours["gradient"]()
    errors = {
        "C: all outputs": values_differ(c_value(), ours["value"]()),
        "C: w_C and gradient": gradients_differ(c_gradient(), ours["gradient"]()),
    }
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
