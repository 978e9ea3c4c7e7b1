"""What a sample that relaxes costs, over an elastic press, side by side in one run.

    python tests/bench/relaxation.py [--rounds 25]

128 lanes of 200 samples, a ramp and a hold, float64, one core: nanoseconds a sample (least of all
rounds, which a busy machine moves least), and the ratio to the elastic press of the same law, of
values to values and of Jacobians (closed, as a fit takes them) to Jacobians.
"""

import argparse

import common
import jax
import jax.numpy as jnp
import numpy as np

from jaxtrachea.mechanics.equilibrium import press_series, sensitivity
from jaxtrachea.mechanics.force_law import Law
from jaxtrachea.mechanics.relaxation_parts import (
    Directions,
    relax_parts,
    relax_parts_with_derivatives,
)
from jaxtrachea.relaxation import laws as relaxation_laws
from jaxtrachea.relaxation.filter import relax, relax_with_derivatives
from jaxtrachea.relaxation.laws import Span
from jaxtrachea.relaxation.steps import Branches

LANES, SAMPLES = 128, 200
SPAN = Span(0.03, 30.0)


def elastic(theta, D, quintic):
    """Press of one lane."""
    c, k_1, k_3, k_5 = jnp.exp(theta[:4])
    law = Law(k_1, k_3, k_5 if quintic else None)
    return press_series(D, c, law), c, law


def elastic_jacobian(theta, D, quintic):
    """Force and its derivatives by the logarithms of c, k_1, k_3 (and k_5), as a fit takes them."""
    solved, c, law = elastic(theta, D, quintic)
    by = sensitivity(solved, c, law)[0]
    values = {"compliance": c} | law.coefficients()
    return solved.force, jnp.stack([v * by[name] for name, v in values.items()])


def branches(theta):
    """Two branches."""
    return Branches(jnp.exp(theta[4:6]), jnp.exp(theta[6:8]))


def cases(quintic: bool) -> dict:
    """Programs by name, of theta, displacement and time of one lane."""

    def value(theta, D, time):
        return elastic(theta, D, quintic)[0].force

    def uniform(theta, D, time, unilateral=True):
        return relax(time, value(theta, D, time), branches(theta), unilateral).force

    def jacobian(theta, D, time):
        return elastic_jacobian(theta, D, quintic)

    def uniform_jacobian(theta, D, time):
        force, columns = elastic_jacobian(theta, D, quintic)
        relaxed, by = relax_with_derivatives(time, force, columns, branches(theta))
        return relaxed.force, by.force

    def parts(theta, D, time):
        _, c, law = elastic(theta, D, quintic)
        return relax_parts(time, D, c, law, branches(theta), branches(theta)).force

    def parts_jacobian(theta, D, time):
        def read(theta):
            _, c, law = elastic(theta, D, quintic)
            return D, c, law, branches(theta), branches(theta)

        along = jax.vmap(lambda e: jax.jvp(read, (theta,), (e,))[1])(jnp.eye(theta.size))
        _, c, law, *both = read(theta)
        return relax_parts_with_derivatives(time, D, c, law, tuple(both), Directions(*along))[1]

    def power(theta, D, time):
        given = {"gamma": jnp.exp(theta[4]), "beta": jnp.exp(theta[6]) / 2}
        made = relaxation_laws.branches("power", given, SPAN)
        return relax(time, value(theta, D, time), made).force

    return {
        "elastic": value,
        "uniform, 2 branches": uniform,
        "uniform, power": power,
        "parts, 2 + 2 branches": parts,
        "uniform, 2 branches, bonded": lambda *v: uniform(*v, unilateral=False),
        "J elastic": jacobian,
        "J uniform, 2 branches": uniform_jacobian,
        "J parts, 2 + 2 branches": parts_jacobian,
    }


def main():
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--rounds", type=int, default=25)
    rounds = parser.parse_args().rounds
    rng = np.random.default_rng(0)
    t = np.r_[np.linspace(0, 2, 60), np.linspace(2.05, 30, SAMPLES - 60)]
    shape = rng.uniform(0.8, 1.2, (LANES, 1))
    D = jnp.asarray(np.interp(t, [0, 2, 30], [0, 4, 4]) * shape)
    time = jnp.asarray(np.broadcast_to(t, D.shape))
    typical = np.log([2.7, 0.3, 0.02, 0.003, 0.9, 0.5, 0.36, 4.3])
    theta = jnp.asarray(typical + 0.1 * rng.normal(size=(LANES, 8)))
    for law, quintic in (("cubic", False), ("quintic", True)):
        programs = {name: jax.jit(jax.vmap(f)) for name, f in cases(quintic).items()}

        def called(f):
            return lambda: jax.block_until_ready(f(theta, D, time))

        found = common.interleaved({n: called(f) for n, f in programs.items()}, rounds=rounds)
        least = {name: min(v) for name, v in found.items()}
        for name, v in least.items():
            base = least["J elastic" if name.startswith("J ") else "elastic"]
            each = v / (LANES * SAMPLES) * 1e9
            print(
                f"{law:8s} {name:32s} {each:8.1f} ns a sample {v / base:6.2f} x elastic", flush=True
            )


if __name__ == "__main__":
    main()
