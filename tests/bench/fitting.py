"""Speed of a batch of fits against scipy, lmfit and optimistix. Run: python tests/bench/fitting.py.

Each specimen: EI_L, k_M, k_1, k_3 from 4 contact positions x 50 points with noise of 0.5 % of the
peak force; truths log-normal (20 %) around (100, 1, 1, 0.01); every solver starts from the
library's default guess, about a decade away, in the same scaled coordinates, with its own default
tolerances. One core each.
"""

import dataclasses
import time

import common
import jax
import jax.numpy as jnp
import lmfit
import numpy as np
import optimistix
from scipy.optimize import least_squares

from jaxtrachea.fitting import fit
from jaxtrachea.fitting.build import build_study, default_parameters
from jaxtrachea.fitting.cost import LaneCost
from jaxtrachea.fitting.lane import Lane
from jaxtrachea.fitting.noise import first_sigma
from jaxtrachea.fitting.parameters import in_model
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.fitting.starts import draw_starts
from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.press import Options, press
from jaxtrachea.optimisation.levenberg_marquardt import Solved, levenberg_marquardt
from jaxtrachea.trachea.geometry import table_1
from jaxtrachea.trachea.material import Material

SPECIMENS, SAMPLE = 2000, 60
NAMES = ("EI_L", "k_M", "k_1", "k_3")
SPOTS = np.array([15.0, 40.0, 65.0, 80.0])  # on rings and between them
DEPTHS = np.linspace(0.12, 6.0, 50)
STEP_K_3 = 0.01


class Numpy:
    """The residual of one specimen in tight numpy, with its Jacobian by the implicit function rule.

    Compliance of a uniform clamped beam on equal springs, exactly and for all positions at once,
    from the spectral form of the flexibility, C = (f - sum p_i^2 / (lambda_i + EI/k)) / EI, with
    everything but the last sum prepared once. Depth from the hyperbolic root of the cubic. Value
    and Jacobian share what they can.
    """

    def __init__(self, rings, length: float, spots=SPOTS, depths=DEPTHS):
        """Spectrum of the flexibility of the unsupported beam (EI = 1)."""
        self.depths = depths

        def green(x, s):
            low, high = np.minimum(x, s), np.maximum(x, s)
            far = length - high
            return (far * low) ** 2 * (3 * high * length - low * (3 * high + far)) / (6 * length**3)

        eigenvalues, vectors = np.linalg.eigh(green(rings[:, None], rings[None]))
        self.eigenvalues = eigenvalues
        self.direct = green(spots, spots)
        self.squares = (green(spots[:, None], rings[None]) @ vectors) ** 2
        self.force, self.seen = None, None

    def load(self, force):
        """Take the measured forces of a specimen, (positions, points)."""
        self.force, self.seen = force, None

    def parts(self, theta):
        """Everything value and Jacobian have in common, kept for one theta."""
        key = theta.tobytes()
        if key == self.seen:
            return self.kept
        EI, k, k_1 = np.exp(theta[:3])
        k_3, rho = STEP_K_3 * theta[3], EI / k
        weight = 1 / (self.eigenvalues + rho)
        c = ((self.direct - self.squares @ weight) / EI)[:, None]
        by_k = (self.squares @ (weight * weight))[:, None] * (-rho / EI)
        stiffening, cubic = 1 + c * k_1, c * k_3
        p = np.sqrt(stiffening / (3 * abs(cubic)))
        q = (0.5 / (abs(cubic) * p**3)) * self.depths
        if k_3 > 0:
            d = 2 * p * np.sinh(np.arcsinh(q) / 3)
        else:
            d = 2 * p * np.sin(np.arcsin(np.minimum(q, 1.0)) / 3)
        d2 = d * d
        force = d * (k_1 + k_3 * d2)
        self.kept = c, by_k, d, d2, force, k_1, k_3
        self.seen = key
        return self.kept

    def value(self, theta):
        """Model - data, (positions * points,)."""
        return (self.parts(theta)[4] - self.force).ravel()

    def jacobian(self, theta):
        """(positions * points, 4)."""
        c, by_k, d, d2, force, k_1, k_3 = self.parts(theta)
        slope = k_1 + 3 * k_3 * d2
        share = 1 / (1 + c * slope)
        by_c = -slope * force * share
        J = np.empty((4, len(c), len(self.depths)))
        J[1] = by_c * by_k
        J[0] = -by_c * c - J[1]
        share *= d
        J[2] = k_1 * share
        J[3] = STEP_K_3 * (share * d2)
        return J.reshape(4, -1).T


def make_study(specimens=SPECIMENS, spots=SPOTS, depths=DEPTHS):
    """The study of the library, and the forces (specimens, positions, points)."""
    rng = np.random.default_rng(11)
    geometry = table_1(np.float64)
    truths = np.array([100.0, 1.0, 1.0, 0.01]) * np.exp(0.2 * rng.standard_normal((specimens, 4)))
    model, shape = (
        Numpy(np.asarray(geometry.ring_positions), 160.0, spots, depths),
        (len(spots), len(depths)),
    )
    model.load(np.zeros(shape))
    curves = []
    forces = np.zeros((specimens, *shape))
    for i, truth in enumerate(truths):
        theta = np.append(np.log(truth[:3]), truth[3] / STEP_K_3)
        clean = model.value(theta).reshape(shape)
        peak = clean.max(axis=1, keepdims=True)
        forces[i] = clean + 0.005 * peak * rng.standard_normal(shape)
        for spot, force in zip(spots, forces[i], strict=True):
            curves.append(Curve(f"s{i:05d}", f"{spot:g}", spot, 0.0, depths, force))
    options = Options()
    parameters = default_parameters(in_model(options, joints=False), {})
    return build_study(curves, geometry, options, parameters), model, forces


def standard_errors(J, r):
    """What the others give with the estimate."""
    covariance = np.linalg.inv(J.T @ J) * (r @ r / (len(r) - J.shape[1]))
    return np.sqrt(np.diag(covariance))


def start():
    """The default guess in scaled coordinates."""
    return np.array([np.log(10.0), np.log(0.1), 0.0, 1.0])


def with_scipy(value, jacobian):
    """One fit by MINPACK through scipy; theta, cost, residual evaluations, standard errors."""
    found = least_squares(value, start(), jac=jacobian, method="lm")
    return found.x, found.cost, found.nfev, standard_errors(found.jac, found.fun)


def with_lmfit(model):
    """One fit by lmfit's leastsq, its own standard errors."""
    parameters = lmfit.Parameters()
    for name, value in zip(NAMES, start(), strict=True):
        parameters.add(name, value=value)

    def unpack(p):
        return np.array([p[name].value for name in NAMES])

    found = lmfit.Minimizer(lambda p: model.value(unpack(p)), parameters).leastsq(
        Dfun=lambda p: model.jacobian(unpack(p)), col_deriv=False
    )
    theta = unpack(found.params)
    errors = [found.params[name].stderr for name in NAMES]
    return theta, 0.5 * found.chisqr, found.nfev, errors


def lane_residual(study, theta, lane: Lane):
    """Our model's residual alone, for solvers that differentiate it themselves."""
    geometry = jax.tree.map(jnp.asarray, study.model.geometry)
    EI_L, k_M, k_1 = jnp.exp(theta[:3])
    material = Material(EI_L=EI_L, k_M=k_M, k_1=k_1, k_3=STEP_K_3 * theta[3])

    def one(s, d):
        return press(geometry, material, s, d, study.model.options).force

    return (jax.vmap(one)(lane.s_c, lane.displacement) - lane.force).ravel()


def optimistix_batch(study, count: int):
    """`count` specimens by optimistix, vmapped in chunks of 256; theta, cost, steps."""
    solver = optimistix.LevenbergMarquardt(rtol=1e-8, atol=1e-8)

    def one(lane):
        def residual(theta, lane):
            return lane_residual(study, theta, lane)

        found = optimistix.least_squares(
            residual, solver, jnp.asarray(start()), args=lane, throw=False, max_steps=100
        )
        r = residual(found.value, lane)
        return found.value, 0.5 * jnp.sum(r * r), found.stats["num_steps"]

    run = jax.jit(jax.vmap(one))

    def part(i):
        return jax.tree.map(lambda v: v[i : i + 256], study.lanes)

    chunks = [part(i) for i in range(0, count, 256)]
    chunks = jax.device_put(chunks)

    def call():
        parts = [jax.block_until_ready(run(chunk)) for chunk in chunks]
        return [np.concatenate([np.asarray(p[i]) for p in parts])[:count] for i in range(3)]

    return call


def jitted_residual(study):
    """Our residual and Jacobian of one specimen, jitted, behind two numpy functions."""

    def value(theta, lane):
        return lane_residual(study, theta, lane)

    both = jax.jit(lambda theta, lane: (value(theta, lane), jax.jacfwd(value)(theta, lane)))
    lanes = [
        jax.device_put(jax.tree.map(lambda v: v[i], study.lanes))  # noqa: B023
        for i in range(SAMPLE)
    ]

    def one(i):
        kept = {}

        def at(theta):
            key = theta.tobytes()
            if key not in kept:
                kept.clear()
                kept[key] = [np.asarray(v) for v in both(theta, lanes[i])]
            return kept[key]

        return with_scipy(lambda t: at(t)[0], lambda t: at(t)[1])

    return one


def one_by_one(model, forces, one):
    """A function that fits the specimens of `forces` one after the other by `one(i)`."""

    def call():
        results = []
        for i, force in enumerate(forces):
            model.load(force)
            results.append(one(i))
        return results

    return call


def check(study, model, forces) -> None:
    """Our residual and the numpy one are the same function, Jacobian included."""
    theta = np.array([np.log(80.0), np.log(0.7), 0.1, 1.2])
    lane = jax.tree.map(lambda v: jnp.asarray(v[0]), study.lanes)

    def value(theta):
        return lane_residual(study, theta, lane)

    model.load(forces[0])
    common.close("residual", model.value(theta), value(theta))
    common.close("jacobian", model.jacobian(theta), jax.jacfwd(value)(jnp.asarray(theta)))


def main() -> None:
    """Time all solvers in turn and write the results."""
    out = common.Writer("fitting", "scipy", "lmfit", "optimistix")
    study, model, forces = make_study()
    check(study, model, forces)
    settings = Settings(starts=1)
    sigma = first_sigma(study)
    starts = draw_starts(study, settings)
    first = {}

    def ours():
        return fit.fit(study, dataclasses.replace(settings, verify=False))

    def scrutinised():
        return fit.fit(study, settings)

    def solve_only():
        return levenberg_marquardt(LaneCost(study.model, study.lanes, sigma), starts)

    through_jax = jitted_residual(study)
    count = {
        "jaxtrachea: fit with standard errors": SPECIMENS,
        "jaxtrachea: Levenberg-Marquardt alone": SPECIMENS,
        "jaxtrachea: fit, what is in doubt profiled": SPECIMENS,
        "optimistix LevenbergMarquardt, vmap (no standard errors)": 512,
        "scipy least_squares lm, numpy residual and Jacobian": SAMPLE,
        "lmfit leastsq, numpy residual and Jacobian": SAMPLE,
        "scipy least_squares lm, jitted JAX residual and Jacobian": SAMPLE,
    }
    few = forces[:SAMPLE]
    calls = (
        ours,
        solve_only,
        scrutinised,
        optimistix_batch(study, 512),
        one_by_one(model, few, lambda i: with_scipy(model.value, model.jacobian)),
        one_by_one(model, few, lambda i: with_lmfit(model)),
        one_by_one(model, few, through_jax),
    )
    cases = dict(zip(count, calls, strict=True))
    results = {}
    for name, call in cases.items():
        begin = time.perf_counter()
        results[name] = call()
        first[name] = time.perf_counter() - begin
    first["jaxtrachea: Levenberg-Marquardt alone"] = None  # compiled by the case before
    statistics = agreement(results, count)
    samples = {name: [] for name in cases}
    for _ in range(9):
        for name, call in cases.items():
            begin = time.perf_counter()
            call()
            samples[name].append(time.perf_counter() - begin)
    for name, values in samples.items():
        fields = {"first_call": first[name]} | statistics[name]
        out.add("fits", name, values, lanes=count[name], **fields)
        print(f"    {count[name] / np.median(values):9.0f} fits/s {fields}")
    out.write()


def agreement(results, count) -> dict[str, dict]:
    """Cost of every solver against the lowest found for the specimen, and evaluations."""
    costs, evaluations = {}, {}
    for name, found in results.items():
        if isinstance(found, FitResult):
            # Cost is in units of the estimated sigma; recompute it from the residuals.
            total = found.rms[:, 0] ** 2 * found.samples / 2
            costs[name], evaluations[name] = total, found.iterations
        elif isinstance(found, Solved):
            costs[name] = None
            evaluations[name] = found.iterations
        elif isinstance(found[0], np.ndarray):
            costs[name], evaluations[name] = found[1], found[2]
        else:
            costs[name] = np.array([row[1] for row in found])
            evaluations[name] = np.array([row[2] for row in found])
    best = np.min([c[:SAMPLE] for c in costs.values() if c is not None], axis=0)
    statistics = {}
    for name in count:
        c = costs[name]
        excess = None if c is None else c[:SAMPLE] / best - 1
        missed = 0 if excess is None else int(np.sum(excess > 1e-6))
        statistics[name] = {
            "evaluations": float(np.median(evaluations[name])),
            "most_evaluations": int(np.max(evaluations[name])),
            "missed": missed,
            "worst_excess": None if excess is None else float(np.max(excess)),
        }
    return statistics


if __name__ == "__main__":
    main()
