"""Records of a press on a viscoelastic tube, with known segments: holds, dips, cycles, noise.

Written for the tests; the records know nothing of the package (numpy only). The force follows from
the history of the displacement by quasi-linear viscoelasticity with two Prony branches,

    F(t) = int_0^t G(t - u) dF_e(D(u))/du du,   G(t) = 1 - sum_i g_i (1 - exp(-t / tau_i)),

F_e = k_1 D + k_3 D^3 in contact (D > 0), integrated by the exact recursion for F_e linear between
samples of a grid 20 times as fine as the record. What an elastic fit of the loading can find at
best is the least-squares line through (D, D^3) over the samples of the true loading without noise.

Run as a script it fits all records as they were used before and as they are used now, and prints
the table of docs/evidence/measured.md.
"""

from dataclasses import dataclass

import numpy as np

#: Kinds of records, in turn.
KINDS = (
    "ramp, hold",
    "rest, ramp, hold, unload",
    "dip in the approach, ramp, hold",
    "three cycles of 40 %, ramp, hold",
    "three full cycles, ramp, hold",
    "ramp, hold with drift, unload",
    "ramp",
)
#: Times finer the grid of integration is than the record.
_FINER = 20


@dataclass(frozen=True)
class Record:
    """One record and what is true of it.

    Attributes:
        kind: one of `KINDS`.
        time: (N,) s.
        displacement: (N,) mm, with noise.
        force: (N,) N, with noise.
        loading: (N,) samples of the last full loading, foot to peak.
        k_1: instantaneous, N/mm.
        best_k_1: of the least-squares fit to the loading without noise, N/mm.
        noise: standard deviation of the displacement, mm.
    """

    kind: str
    time: np.ndarray
    displacement: np.ndarray
    force: np.ndarray
    loading: np.ndarray
    k_1: float
    best_k_1: float
    noise: float


def path(kind, peak, speed, hold, rate):
    """Displacement (mm) over a fine grid of time, and the time the last loading begins and ends."""
    corners = [(0.0, 0.0)]

    def to(level, slower=1.0):
        time, last = corners[-1]
        corners.append((time + slower * max(abs(level - last) / speed, 1e-9), level))

    def wait(seconds, drift=0.0):
        time, last = corners[-1]
        corners.append((time + seconds, last + drift))

    if kind.startswith("rest"):
        wait(5.0)
    if kind.startswith("dip"):
        to(0.2)
        to(0.0)
    if kind.startswith("three"):
        for _ in range(3):
            to(peak if "full" in kind else 0.4 * peak)
            to(0.0)
    begin = corners[-1][0]
    to(peak)
    end = corners[-1][0]
    if "drift" in kind:
        wait(1.0, 0.005 * peak)
        wait(hold - 1.0, 0.01 * peak)
    elif "hold" in kind:
        wait(hold)
    if "unload" in kind:
        to(0.0)
    times, levels = np.array(corners).T
    fine = np.arange(0.0, times[-1] + 1e-9, 1 / (rate * _FINER))
    return fine, np.interp(fine, times, levels), begin, end


def relaxing(elastic, step, shares, taus):
    """Force of a history of elastic force, sampled every `step` s."""
    change = np.diff(elastic, prepend=0.0)
    force = (1 - sum(shares)) * elastic
    for share, tau in zip(shares, taus, strict=True):
        decay, branch = np.exp(-step / tau), 0.0
        gain = (1 - decay) * tau / step
        states = np.empty_like(elastic)
        for i, more in enumerate(change):
            branch = decay * branch + gain * more
            states[i] = branch
        force = force + share * states
    return force


def record(kind, rng):
    """One record with random law, speeds, noise and Prony branches."""
    k_1, k_3 = rng.uniform(0.5, 3.0), rng.uniform(0.005, 0.08)
    peak, ramp, rate = rng.uniform(2.5, 6.0), rng.uniform(2.0, 15.0), rng.uniform(10.0, 40.0)
    shares = rng.uniform(0.1, 0.25, 2)
    taus = np.array([rng.uniform(0.3, 1.0), rng.uniform(4.0, 20.0)])
    fine, travel, begin, end = path(kind, peak, peak / ramp, 10.0, rate)
    elastic = k_1 * travel + k_3 * travel**3
    force = relaxing(elastic, 1 / (rate * _FINER), shares, taus)
    time, travel, force = fine[::_FINER], travel[::_FINER], force[::_FINER]
    loading = (time >= begin - 1e-9) & (time <= end + 1e-9)
    inside = travel[loading]
    best, *_ = np.linalg.lstsq(np.stack([inside, inside**3], 1), force[loading], rcond=None)
    noise = rng.choice([0.0, 0.001, 0.005, 0.02]) * peak / 4
    return Record(
        kind=kind,
        time=time,
        displacement=travel + noise * rng.standard_normal(travel.size),
        force=force + 0.005 * force.max() * rng.standard_normal(travel.size),
        loading=loading,
        k_1=k_1,
        best_k_1=float(best[0]),
        noise=float(noise),
    )


def records(count=147, seed=10):
    """`count` records, all kinds in turn."""
    rng = np.random.default_rng(seed)
    return [record(KINDS[i % len(KINDS)], rng) for i in range(count)]


def formerly(displacement, loading):
    """Samples used before segments were looked for, or None where the record was refused.

    Jitter was 1 % of the range, whatever the noise; "loading" took what came before the first
    reversal beyond it, and "require-monotone" (the default) refused such a reversal.
    """
    back = np.maximum.accumulate(displacement) - displacement > 0.01 * np.ptp(displacement)
    keep = np.ones(displacement.shape, bool)
    if loading == "all" or not back.any():
        return keep
    if loading == "require-monotone":
        return None
    keep[int(np.argmax(displacement[: int(np.argmax(back))])) + 1 :] = False
    return keep


def least_squares(displacement, force):
    """k_1 of the least-squares fit of k_1 D + k_3 D^3, contact counted from zero."""
    contact = np.maximum(displacement, 0)
    solution, *_ = np.linalg.lstsq(np.stack([contact, contact**3], 1), force, rcond=None)
    return float(solution[0])


def fitted(chosen):
    """k_1 of every record by the package's own fit of the samples chosen; NaN where None."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from jaxtrachea.fitting.build import build_study, default_parameters
    from jaxtrachea.fitting.fit import fit
    from jaxtrachea.fitting.parameters import in_model
    from jaxtrachea.fitting.settings import Settings
    from jaxtrachea.measurements.read import Curve
    from jaxtrachea.mechanics.press import Options
    from jaxtrachea.trachea.geometry import table_1

    options = Options(coupling="total")
    trial = {"scope": "trial"}
    table = default_parameters(
        in_model(options, joints=False),
        {"k_1": trial, "k_3": trial | {"lower": -1.0, "upper": 10.0, "scale": "linear"}},
    )
    curves = [
        Curve(f"{i:03d}", "1", 80.0, 0.0, r.displacement[keep], r.force[keep])
        for i, (r, keep) in enumerate(chosen)
        if keep is not None
    ]
    result = fit(build_study(curves, table_1(), options, table), Settings(starts=1, more_starts=0))
    names = [p.name for p, _, _ in result.study.unknowns[0]]
    values = np.full(len(chosen), np.nan)
    for lane in range(result.lanes):
        values[int(result.study.lane_name(lane)[0])] = result.value[lane, names.index("k_1")]
    return values


def summary(used=fitted):
    """Rows of the table: rule, records used, samples, errors of k_1 in % (median, 90 %, worst)."""
    from jaxtrachea.measurements.segments import segment

    found = records()
    rules = {
        'before, "require-monotone" (the default)': lambda r: formerly(
            r.displacement, "require-monotone"
        ),
        'before, "loading"': lambda r: formerly(r.displacement, "loading"),
        "all samples": lambda r: formerly(r.displacement, "all"),
        "now, with time": lambda r: segment(r.displacement, r.force, r.time).keep,
        "now, without time": lambda r: segment(r.displacement, r.force).keep,
        "true loading": lambda r: r.loading,
    }
    best = np.array([r.best_k_1 for r in found])
    for name, rule in rules.items():
        chosen = [(r, rule(r)) for r in found]
        error = 100 * np.abs(used(chosen) / best - 1)
        error = error[np.isfinite(error)]
        share = [np.mean(keep) for _, keep in chosen if keep is not None]
        yield [name, error.size, 100 * np.median(share), *np.quantile(error, [0.5, 0.9, 1.0])]


def directly(chosen):
    """k_1 of every record by least squares; NaN where None."""
    return np.array(
        [np.nan if k is None else least_squares(r.displacement[k], r.force[k]) for r, k in chosen]
    )


if __name__ == "__main__":
    for row in summary():
        print("| " + " | ".join(v if isinstance(v, str) else f"{v:.3g}" for v in row) + " |")
