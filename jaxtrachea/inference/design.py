"""Where to press next: what a further curve would add to the information, at every candidate.

A candidate is a press at (s, phi = 0) up to a depth. Its sensitivities come from the residual of
the fit itself, so that model, scales and scopes are the same; its information adds to that of the
data (Fisher information of normal noise; Fedorov 1972). Relative coordinates: 1 is a change of
100 %. Bounds count as a weak prior, of the variance of a uniform distribution between them, so that
nothing is infinite where the data so far leave a combination undetermined.

Unknowns of single trials (an onset, an offset) are told apart from those that are sought: a new
press brings its own, about which nothing is known, and the measured curves keep theirs. Both are
marginalised, so that information, scores and errors are those of the other unknowns.
"""

import dataclasses
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxtrachea._arguments import check_word
from jaxtrachea.config import FitSpec, SpecError
from jaxtrachea.fitting.information import informations
from jaxtrachea.fitting.model import FitModel
from jaxtrachea.fitting.press_scale import relative_change
from jaxtrachea.fitting.residual import force_jacobian
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.study import Study
from jaxtrachea.inference.bootstrap import Bootstrap
from jaxtrachea.inference.design_press import marginal, of_a_new_press
from jaxtrachea.inference.labels import succeeded
from jaxtrachea.optimisation.programs import program

Criterion = Literal["D", "A", "E"]
#: Estimates of a lane, out of its bootstrap replicates, that a design is averaged over.
_DRAWS = 16


class Candidates(NamedTuple):
    """Presses to choose from; C of them.

    Attributes:
        s: contact position, mm.
        depth: largest tool displacement, mm.
    """

    s: Float[np.ndarray, " C"]
    depth: Float[np.ndarray, " C"]


@dataclasses.dataclass(frozen=True, eq=False)
class Situation:
    """What is known before the next press, for G guesses of the truth (lanes, replicates).

    Attributes:
        study: the study.
        lane: lane of each guess; (G,).
        theta: guess, scaled coordinates; (G, P).
        relative: change of each scaled coordinate that makes a relative change of 1; (G, P).
        base: information of the data so far and of the bounds on the Q unknowns that are not of
            single trials, relative coordinates; (G, Q, Q).
        sigma: of a force sample, N; (G,).
        samples: of a curve.
        kept: these unknowns; (G, Q).
        own: unknowns of the first trial alone, which stand for those of a new press; `theta` has
            the median of all trials there; (G, R).
        prior: information of the bounds on all unknowns, relative coordinates; (G, P).
        blend: rounded corner of a new curve, mm, see `Lane`; (G,); None where no onset is fitted.
    """

    study: Study
    lane: Int[np.ndarray, " G"]
    theta: Float[np.ndarray, "G P"]
    relative: Float[np.ndarray, "G P"]
    base: Float[np.ndarray, "G Q Q"]
    sigma: Float[np.ndarray, " G"]
    samples: int
    kept: Int[np.ndarray, "G Q"]
    own: Int[np.ndarray, "G R"]
    prior: Float[np.ndarray, "G P"]
    blend: Float[np.ndarray, " G"] | None


@dataclasses.dataclass(frozen=True, eq=False)
class Choice:
    """Points chosen one after the other.

    Attributes:
        chosen: candidate of each step; (n,).
        score: of every candidate at each step, mean over guesses, larger is better: mean log
            determinant (D), minus the log of the mean variance (A), log of the smallest eigenvalue
            (E); (n, C).
        error: relative standard error of every unknown before and after each step, root mean square
            over guesses; (n + 1, P).
    """

    chosen: Int[np.ndarray, " n"]
    score: Float[np.ndarray, "n C"]
    error: Float[np.ndarray, "m P"]


def grid(s: tuple[float, float], depth: tuple[float, float], count: int = 10_000) -> Candidates:
    """About `count` candidates in a reachable region, five depths at even positions."""
    depths = np.linspace(*depth, 5) if depth[1] > depth[0] else np.array([depth[0]])
    positions = np.linspace(*s, max(count // len(depths), 1))
    at, down = np.meshgrid(positions, depths, indexing="ij")
    return Candidates(at.ravel(), down.ravel())


def check(study: Study) -> None:
    """Refuse a study whose unknowns a new curve would not share.

    Raises:
        ValueError: naming the parameters; or a joint study, or one of deforming cross-sections.
    """
    study.refuse_joint("a design")
    study.refuse_sections("a design")
    own = [p.name for p in study.free if p.scope == "trial"]
    if len(own) == len(study.free):
        raise ValueError(
            f"{', '.join(own)}: every free parameter belongs to single trials, so that a further "
            "press tells nothing of them; give one the scope 'specimen' or 'shared'"
        )


def situation(
    result: FitResult,
    resampled: Bootstrap | None = None,
    *,
    samples: int | None = None,
    with_data: bool = True,
) -> Situation:
    """What a fit knows, with every curve and sample at its own weight 1 / sigma^2.

    Args:
        result: the fit; its succeeded lanes are the guesses.
        resampled: if given, up to 16 replicates of each lane are the guesses.
        samples: of the next curve; None: as the longest measured.
        with_data: False: as before any measurement, with the bounds alone.

    Raises:
        ValueError: no lane succeeded, or as `check`.
    """
    study = result.study
    check(study)
    lanes = np.array([k for k in range(result.lanes) if succeeded(result, k)], int)
    if len(lanes) == 0:
        raise ValueError("no lane has an estimate; nothing to design from")
    lane, theta = lanes, result.theta[lanes]
    if resampled is not None:
        found = [resampled.theta[k][resampled.usable[k]][:_DRAWS] for k in lanes]
        lane = np.repeat(lanes, [len(rows) for rows in found])
        theta = np.concatenate(found)
    kept, own, theta = of_a_new_press(study, lane, theta)
    relative = relative_change(study.take(lane), theta)
    absent = study.lanes.active[lane] == 0
    relative = np.where(absent, 1.0, relative)
    width = (study.lanes.upper - study.lanes.lower)[lane] / relative
    prior = 12 / np.where(width > 0, width, 1) ** 2
    base = np.eye(study.size) * prior[:, :, None]
    if with_data:
        even = study.lanes._replace(balance=np.ones_like(study.lanes.balance))
        weighed = dataclasses.replace(study, lanes=even)
        info = informations(weighed, lane, theta, result.whitened_sigma[lane])
        base = base + info.bread * relative[:, :, None] * relative[:, None]
    n = study.lanes.force.shape[-1] if samples is None else samples
    blends, counts = study.lanes.blend, [len(c) for c in study.curves]
    blend = None
    if blends is not None:
        blend = np.array([np.median(blends[k, : counts[k]]) for k in lane])
    return Situation(
        study=study, lane=lane, theta=theta, relative=relative,
        base=marginal(base, kept), sigma=result.sigma[lane, 0], samples=n,
        kept=kept, own=own, prior=prior, blend=blend,
    )  # fmt: skip


def gains(known: Situation, candidates: Candidates) -> Float[np.ndarray, "G C Q Q"]:
    """Information of a press at every candidate on the unknowns it shares, for every guess.

    In relative coordinates; what the press has of its own is eliminated.
    """
    study = known.study
    run = program(_information, study.model, known.samples, axes=(*[None] * 4, 0, 0))
    place = jnp.asarray(candidates.s), jnp.asarray(candidates.depth)
    parts = []
    for g, k in enumerate(known.lane):
        lanes = study.lanes
        blend = None if known.blend is None else jnp.asarray(known.blend[g])
        rows = lanes.value[k, 0], lanes.index[k, 0], blend
        matrix = run(jnp.asarray(known.theta[g]), *rows, *place) / known.sigma[g] ** 2
        parts.append(np.asarray(matrix) * known.relative[g][:, None] * known.relative[g])
    added = np.stack(parts)
    if known.own.shape[1] == 0:
        return added
    # What a press brings of its own is known no better than its bounds say.
    for matrix, own, prior in zip(added, known.own, known.prior, strict=True):
        matrix[:, own, own] += prior[own]
    rows = np.concatenate([known.kept, known.own], axis=1)
    of_press = np.stack([m[:, r[:, None], r[None]] for m, r in zip(added, rows, strict=True)])
    shared = np.tile(np.arange(known.kept.shape[1]), (len(rows), 1))
    return marginal(of_press, shared)


def _information(model: FitModel, samples: int, theta, value, index, blend, s, depth):
    """Information of one press with noise of 1 N on the unknowns; (P, P).

    `value` and `index`: rows of the trial it is like, see `Lane`; `blend`: as `force_jacobian`.
    """
    displacement = depth * jnp.arange(1, samples + 1, dtype=theta.dtype) / samples
    index = index[jnp.array(model.free_columns)]
    free = jnp.where(index >= 0, theta[jnp.maximum(index, 0)], 0)
    J = force_jacobian(model, free, value, s, displacement, blend)
    place = jnp.where(index >= 0, index, len(theta))
    zero = jnp.zeros((len(theta), len(theta)), theta.dtype)
    gram = jnp.einsum("im,jm->ij", J, J)
    return zero.at[place[:, None], place[None]].add(gram, mode="drop")


def scores(information: Float[np.ndarray, "G C P P"], criterion: Criterion):
    """Mean over guesses of what is to be made large, see `Choice.score`; (C,)."""
    check_word("criterion", criterion, Criterion)
    values = np.maximum(np.linalg.eigvalsh(information), 1e-300)
    if criterion == "D":
        return np.mean(np.sum(np.log(values), axis=-1), axis=0)
    if criterion == "A":
        return -np.log(np.mean(np.mean(1 / values, axis=-1), axis=0))
    return np.mean(np.log(values[..., 0]), axis=0)


def next_points(
    known: Situation, candidates: Candidates, count: int = 1, criterion: Criterion = "D"
) -> Choice:
    """Choose presses one by one, each the best after those before it; one may come twice.

    Args:
        known: from `situation`.
        candidates: reachable presses.
        count: how many to choose.
        criterion: D (volume of the error ellipsoid), A (mean variance) or E (worst combination).
    """
    check_word("criterion", criterion, Criterion)
    added = gains(known, candidates)
    base, chosen, table = known.base, [], []
    errors = [_errors(base)]
    for _ in range(count):
        table.append(scores(base[:, None] + added, criterion))
        chosen.append(int(np.argmax(table[-1])))
        base = base + added[:, chosen[-1]]
        errors.append(_errors(base))
    return Choice(np.array(chosen), np.stack(table), np.stack(errors))


def _errors(information) -> np.ndarray:
    variance = np.diagonal(np.linalg.inv(information), axis1=-2, axis2=-1)
    return np.sqrt(np.mean(variance, axis=0))


class Map(NamedTuple):
    """How well curves at given positions tell the unknowns apart; means over guesses.

    Attributes:
        s: mm; (n,).
        condition: after a press at s on top of the data; of the scaled Jacobian, as in a fit; (n,).
        weakest: unit vector of the least determined combination then, relative; (n, P).
        pairs: condition of a press at s and one at s', without any data; (n, n).
    """

    s: Float[np.ndarray, " n"]
    condition: Float[np.ndarray, " n"]
    weakest: Float[np.ndarray, "n P"]
    pairs: Float[np.ndarray, "n n"]


def identifiability(known: Situation, s: Float[np.ndarray, " n"], depth: float) -> Map:
    """Condition and weakest direction of presses to `depth` (mm) at every position (mm).

    Conditions are geometric means over the guesses, directions those of the first guess.
    """
    added = gains(known, Candidates(s, np.full(len(s), depth)))
    values, vectors = np.linalg.eigh(known.base[:, None] + added)
    condition = np.exp(np.mean(0.5 * np.log(values[..., -1] / values[..., 0]), axis=0))
    weakest = vectors[0, :, :, 0]
    largest = np.take_along_axis(weakest, np.argmax(np.abs(weakest), axis=1)[:, None], axis=1)
    total = 0.0
    for matrix in added:
        values = np.linalg.eigvalsh(matrix[:, None] + matrix[None])
        low = np.maximum(values[..., 0], 1e-14 * values[..., -1])
        total = total + 0.5 * np.log(values[..., -1] / low)
    return Map(s, condition, weakest * np.sign(largest), np.exp(total / len(added)))


def candidates_of(spec: FitSpec, study: Study) -> Candidates:
    """The presses of the [design] section; left out: first to last ring, half to full depth.

    From ring to ring as far as all of the tool lies on the tube.

    Raises:
        SpecError: positions outside the tube or where the tool reaches beyond its ends, or unknowns
            that a new curve would not share.
    """
    try:
        check(study)
    except ValueError as error:
        raise SpecError(f"parameters: {error}") from None
    section, length = spec.design, float(study.model.geometry.length)
    deepest = float(np.max(study.lanes.displacement))
    rings = study.model.geometry.ring_positions
    low, high = study.model.options.places(length)
    s = (max(float(rings[0]), low), min(float(rings[-1]), high)) if section.s is None else section.s
    if s[0] < low or s[1] > high:
        tool = f", the tool (half_width {low:g} mm) fits from {low:g} to {high:g} mm"
        raise SpecError(
            f"design.s: {s[0]:g} to {s[1]:g} mm, tube spans 0 to {length:g} mm"
            f"{tool if low > 0 else ''}; give places on it"
        )
    depth = (0.5 * deepest, deepest) if section.depth is None else section.depth
    return grid(s, depth, section.candidates)
