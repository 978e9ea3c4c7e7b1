"""What both forms of the force method reach against the FEM; writes docs/evidence/beam_accuracy.md.

Run from the root of the repository: python tests/reference/beam_accuracy.py
"""

import functools
import pathlib

import beam_fem
import jax
import jax.numpy as jnp
import numpy as np

from jaxtrachea.mechanics.beam import Beam, deflect

EI = 1.862  # N mm^2, ligament of Table 1
DECADES = range(-9, 13)
TUBES = {
    "1 ring": (np.array([70.0]), 160.0),
    "15 rings": (10.0 * np.arange(1, 16), 160.0),
    "200 rings, 10 mm apart": (10.0 * np.arange(1, 201), 2010.0),
    "200 rings, 0.8 mm apart": (0.8 * np.arange(1, 201), 160.8),
}
QUANTITIES = ("w_C", "theta_C", "w", "theta", "reaction")


def tube(name):
    """Positions, length, contact positions, rounded to float32: the same numbers for all."""
    x, length = TUBES[name]
    x, length = np.float32(x), np.float32(length)
    m = len(x) // 2
    after = x[m + 1] if len(x) > 1 else length
    near = [(x[m] + after) / 2, x[m], x[0], x[-1], 0.3 * x[0], 1e-3, 3]
    far = [length - np.float32(v) for v in (1e-3, 3)]
    return x, length, np.array(near + far, np.float32)


@functools.cache
def exact(name):
    """{(k, s): Solution} over all decades of k (every third for 200 rings) and positions of C."""
    x, length, positions = tube(name)
    decades = DECADES if len(x) < 100 else DECADES[::3]
    bending = np.full(len(x) + 1, EI, np.float32)
    solved = {}
    for k in (np.float32(10.0**d) for d in decades):
        for s in positions:
            solved[k, s] = beam_fem.solve(x, length, bending, np.full(len(x), k), s, 1.0)
    return solved


def compare(got, solution):
    """Largest error of each quantity over its largest value (rotations share one scale)."""
    truth = {q: np.array(getattr(solution, q), dtype=object).astype(float) for q in QUANTITIES}
    peak = {q: np.max(np.abs(truth[q]), initial=0) for q in QUANTITIES}
    peak["theta"] = peak["theta_C"] = max(peak["theta"], peak["theta_C"])
    error = {q: np.max(np.abs(np.asarray(getattr(got, q), float) - truth[q])) for q in QUANTITIES}
    return {q: float(error[q] / peak[q]) for q in QUANTITIES}


@functools.cache
def _solver(form):
    def one(x, length, EI, k, s):
        return deflect(Beam(x, length, EI, k), s, jnp.ones_like(s), form=form)

    shared = (None, None, None)
    return jax.jit(jax.vmap(jax.vmap(one, (*shared, None, 0)), (*shared, 0, None)))


def cases(name, dtype, form="recursion"):
    """Yields k, position of C, errors as in `compare`, exact solution."""
    x, length, positions = tube(name)
    solved = exact(name)
    ks = sorted({k for k, _ in solved})
    stiffness = np.array(ks)[:, None] * np.ones(len(x), np.float32)
    bending = np.full(len(x) + 1, EI, np.float32)
    arrays = (jnp.asarray(v, dtype) for v in (x, length, bending, stiffness, positions))
    got = _solver(form)(*arrays)
    for i, k in enumerate(ks):
        for j, s in enumerate(positions):
            entry = jax.tree.map(lambda v: v[i, j], got)  # noqa: B023
            yield k, s, compare(entry, solved[k, s]), solved[k, s]


def measure(name, dtype, form="recursion"):
    """{quantity: {k: worst error over the positions of C}}."""
    worst = {q: {} for q in QUANTITIES}
    for k, _, errors, _ in cases(name, dtype, form):
        decade = float(f"{k:.0e}")
        for q, error in errors.items():
            worst[q][decade] = max(worst[q].get(decade, 0.0), error)
    return worst


def amplification(x, length, EI, k, GA, s, solution):
    """What a rounding of the force that passes a ring does to the joints, over the largest joint.

    From C to either clamp the force and moment (V, M) on the rest of the beam are carried from ring
    to ring. Their entries are rounded at every ring, to first order relative to |T'| |(V, M)| (a
    moment may cancel), and each of these errors moves that ring and those behind it by the
    compliance G of the rest. Where a soft part hangs on a stiff one this is a large motion.

    GA may be None; `solution` is exact, under any force at s. Returns {"w", "reaction", "theta"}:
    the largest over rings and sources.
    """
    spans, m = np.diff([0, *x, length]), np.searchsorted(x, s)
    softness = [1 / np.asarray(EI, float), np.zeros(len(EI)) if GA is None else 1 / np.asarray(GA)]
    rotations = [*solution.theta, solution.theta_C]
    peaks = [max(abs(float(v)) for v in of) for of in (solution.w, rotations, solution.reaction)]
    worst = np.zeros(3)
    for turn, count in ((1, m), (-1, len(x) - m)):
        if count:
            parts = [np.asarray(v, float)[::turn] for v in (spans, k, *softness)]
            last = float(s - x[m - 1] if turn > 0 else x[m] - s)
            tip = np.array([solution.w_C, turn * solution.theta_C], float)
            worst = np.maximum(worst, _errors(*parts, count, last, tip) / np.array(peaks))
    return dict(zip(("w", "theta", "reaction"), worst, strict=True))


def _span(h, a, b):
    """Transfer of motions over a span, and its compliance as a cantilever."""
    bending = a * np.array([[h**3 / 3, h**2 / 2], [h**2 / 2, h]])
    return np.array([[1, h], [0, 1]]), bending + np.array([[b * h, 0], [0, 0]])


def _errors(spans, k, a, b, count, last, tip):
    """Of w, theta and reactions of one side of C, seen from its clamp, per rounding."""
    G, with_ring, passed, transfer = np.zeros((2, 2)), [], [], []
    for h, stiffness, *soft in zip(spans[:count], k[:count], a[:count], b[:count], strict=True):
        T, own = _span(h, *soft)
        G = T @ G @ T.T + own
        share = 1 / (1 + stiffness * G[0, 0])
        passed.append(np.array([[share, -stiffness * share * G[0, 1]], [0, 1]]))
        G = G - stiffness * share * np.outer(G[0], G[0])
        with_ring.append(G)
        transfer.append(T.T)
    T, own = _span(last, a[count], b[count])
    force = np.linalg.solve(T @ G @ T.T + own, tip)
    worst, errors, step = np.zeros(3), np.zeros((2, 0)), T.T
    for G, through, inner, stiffness in zip(
        with_ring[::-1], passed[::-1], transfer[::-1], k[:count][::-1], strict=True
    ):
        rounded = np.abs(step) @ np.abs(force)
        errors = np.concatenate([step @ errors, np.diag(rounded)], axis=1)
        w, theta = np.abs(G @ errors).reshape(2, -1, 2).sum(2).max(1)
        worst = np.maximum(worst, [w, theta, stiffness * w])
        force, errors, step = through @ step @ force, through @ errors, inner
    return worst


HEAD = """# Accuracy of the ligament beam

*For developers: rounding errors of the two forms of the force method.*

Written by `tests/reference/beam_accuracy.py`. Largest error over the largest value of the quantity
(w: joint deflections, R: reactions, c: deflection of C, theta: all rotations), against a Hermite
finite-element solution in 80 digits, over nine contact positions: mid-span, on three rings, 3 mm
and 0.001 mm from either end, in the first span. All inputs are float32 numbers. EI = 1.862 N mm^2.

`recursion` holds everywhere. `reactions`, the paper's dense system, keeps its joint values but
loses the contact point itself once rings are stiff and C lies on one: the tip deflection is then a
difference of numbers many orders of magnitude larger.
"""


def main():
    """Write the table."""
    jax.config.update("jax_enable_x64", True)
    lines = [HEAD]
    for name, (x, _) in TUBES.items():
        forms = ("recursion", "reactions") if len(x) < 100 else ("recursion",)
        for form in forms:
            results = [measure(name, dtype, form) for dtype in ("float64", "float32")]
            lines.append(f"\n## {name}, `{form}`\n")
            lines.append(
                "| k, N/mm | w 64 | R 64 | c 64 | theta 64 | w 32 | R 32 | c 32 | theta 32 |"
            )
            lines.append("|---|---|---|---|---|---|---|---|---|")
            for k in results[0]["w"]:
                cells = [f"{k:.0e}"]
                for r in results:
                    rotation = max(r["theta"][k], r["theta_C"][k])
                    values = (r["w"][k], r["reaction"][k], r["w_C"][k], rotation)
                    cells += [f"{v:.0e}" for v in values]
                lines.append("| " + " | ".join(cells) + " |")
    path = pathlib.Path(__file__).parents[2] / "docs" / "evidence" / "beam_accuracy.md"
    path.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
