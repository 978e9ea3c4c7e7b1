"""Where to press next: what a further curve would add to the information, at every candidate.

A candidate is a press at s up to a depth, on the midline or, of deforming cross-sections, at an
angle phi. Its sensitivities come from the residual of the fit itself, so that model, scales and
scopes are the same; its information adds to that of the data (Fisher information of normal noise;
Fedorov 1972). It observes the force along the normal, and off the midline the side force where the
study has one. Relative coordinates: 1 is a change of 100 %. Bounds count as a weak prior, of the
variance of a uniform distribution between them, so that nothing is infinite where the data so far
leave a combination undetermined.

Unknowns of single trials (an onset, an offset) are told apart from those that are sought: a new
press brings its own, about which nothing is known, and the measured curves keep theirs. Both are
marginalised, so that information, scores and errors are those of the other unknowns.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxtrachea._arguments import check_word
from jaxtrachea._numerics import full_precision
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
#: Candidates of deforming cross-sections: in all where the user does not say, and at a time.
_FEW, _TOGETHER = 250, 16
#: Those of a line of joints, which cost next to nothing.
_MANY = 10_000
#: Estimates of a lane, out of its bootstrap replicates, that a design is averaged over.
_DRAWS = 16


class Candidates(NamedTuple):
    """Presses to choose from; C of them.

    Attributes:
        s: contact position, mm.
        depth: largest tool displacement, mm.
        phi: contact angle, rad; None: all on the midline.
    """

    s: Float[np.ndarray, " C"]
    depth: Float[np.ndarray, " C"]
    phi: Float[np.ndarray, " C"] | None = None


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


def grid(
    s: tuple[float, float],
    depth: tuple[float, float],
    count: int = 10_000,
    phi: Sequence[float] = (0.0,),
) -> Candidates:
    """About `count` candidates in a reachable region, five depths at even positions.

    Args:
        s: first and last position, mm.
        depth: least and largest, mm.
        count: of all candidates.
        phi: angles, rad; each at every position and depth.
    """
    depths = np.linspace(*depth, 5) if depth[1] > depth[0] else np.array([depth[0]])
    positions = np.linspace(*s, max(count // (len(depths) * len(phi)), 1))
    turned, at, down = np.meshgrid(phi, positions, depths, indexing="ij")
    angles = turned.ravel() if np.any(turned) else None
    return Candidates(at.ravel(), down.ravel(), angles)


def check(study: Study) -> None:
    """Refuse a study whose unknowns a new curve would not share.

    Raises:
        ValueError: naming the parameters; or a joint study.
    """
    study.refuse_joint("a design")
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

    In relative coordinates; what the press has of its own is eliminated. A candidate without
    equilibrium at some sample tells nothing: zeros.

    Raises:
        ValueError: angles for a skeleton that is pressed on the midline alone.
    """
    study = known.study
    if candidates.phi is not None and not study.model.options.deforms_sections:
        raise ValueError("presses off the midline need the skeleton 'sections'; leave phi out")
    parts = []
    for g, k in enumerate(known.lane):
        lanes = study.lanes
        blend = None if known.blend is None else jnp.asarray(known.blend[g])
        guess = _Guess(jnp.asarray(known.theta[g]), lanes.value[k, 0], lanes.index[k, 0], blend)
        matrix = _of_all(study, known.samples, guess, candidates)
        matrix = np.nan_to_num(matrix / known.sigma[g] ** 2, posinf=0.0, neginf=0.0)
        parts.append(matrix * known.relative[g][:, None] * known.relative[g])
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


class _Guess(NamedTuple):
    """Unknowns of a guess, and the trial that a press is like.

    `value` and `index`: its rows, see `Lane`; `blend`: as `force_jacobian`.
    """

    theta: Float[Array, " P"]
    value: Any
    index: Any
    blend: Float[Array, ""] | None


class _Place(NamedTuple):
    """A candidate, or with a leading axis many; see `Candidates`."""

    s: Any
    depth: Any
    phi: Any


def _of_all(study: Study, samples: int, guess: _Guess, candidates: Candidates) -> np.ndarray:
    """`_information` of every candidate; of deforming cross-sections so many at a time; (C, P, P).

    Each is a path of its own there, and all together would take the memory.
    """
    sides = study.lanes.side_force is not None
    run = program(_information, study.model, samples, sides, axes=(None, 0))
    count = len(candidates.s)
    together = _TOGETHER if study.model.options.deforms_sections else count
    parts = []
    for first in range(0, count, together):
        row = np.minimum(np.arange(first, first + together), count - 1)
        place = _Place(*(None if v is None else jnp.asarray(v[row]) for v in candidates))
        parts.append(np.array(run(guess, place))[: count - first])
    return np.concatenate(parts)


@full_precision
def _information(model: FitModel, samples: int, sides: bool, guess: _Guess, place: _Place):
    """Information of one press with noise of 1 N on the unknowns; (P, P).

    `sides`: whether it observes the side force.
    """
    theta, value, index, blend = guess
    displacement = place.depth * jnp.arange(1, samples + 1, dtype=theta.dtype) / samples
    index = index[jnp.array(model.free_columns)]
    free = jnp.where(index >= 0, theta[jnp.maximum(index, 0)], 0)
    J = force_jacobian(model, free, value, place.s, displacement, blend, place.phi)
    J = J if sides else J[:, :samples]
    at = jnp.where(index >= 0, index, len(theta))
    zero = jnp.zeros((len(theta), len(theta)), theta.dtype)
    gram = jnp.einsum("im,jm->ij", J, J)
    return zero.at[at[:, None], at[None]].add(gram, mode="drop")


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
    known: Situation,
    candidates: Candidates,
    count: int = 1,
    criterion: Criterion = "D",
    added: Float[np.ndarray, "G C Q Q"] | None = None,
) -> Choice:
    """Choose presses one by one, each the best after those before it; one may come twice.

    Args:
        known: from `situation`.
        candidates: reachable presses.
        count: how many to choose.
        criterion: D (volume of the error ellipsoid), A (mean variance) or E (worst combination).
        added: the `gains`, where they are known; None: computed.
    """
    check_word("criterion", criterion, Criterion)
    added = gains(known, candidates) if added is None else added
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
        phi: of all presses, rad.
        condition: after a press at s on top of the data; of the scaled Jacobian, as in a fit; (n,).
        weakest: unit vector of the least determined combination then, relative; (n, P).
        pairs: condition of a press at s and one at s', without any data; (n, n).
    """

    s: Float[np.ndarray, " n"]
    phi: float
    condition: Float[np.ndarray, " n"]
    weakest: Float[np.ndarray, "n P"]
    pairs: Float[np.ndarray, "n n"]


def identifiability(
    known: Situation, s: Float[np.ndarray, " n"], depth: float, phi: float = 0.0
) -> Map:
    """Condition and weakest direction of presses to `depth` (mm) at every position (mm).

    At one angle (rad). Conditions are geometric means over the guesses, directions those of the
    first guess.
    """
    angles = np.full(len(s), phi) if phi else None
    added = gains(known, Candidates(s, np.full(len(s), depth), angles))
    values, vectors = np.linalg.eigh(known.base[:, None] + added)
    condition = np.exp(np.mean(0.5 * np.log(values[..., -1] / values[..., 0]), axis=0))
    weakest = vectors[0, :, :, 0]
    largest = np.take_along_axis(weakest, np.argmax(np.abs(weakest), axis=1)[:, None], axis=1)
    total = 0.0
    for matrix in added:
        values = np.linalg.eigvalsh(matrix[:, None] + matrix[None])
        low = np.maximum(values[..., 0], 1e-14 * values[..., -1])
        nothing = values[..., -1] <= 0  # neither press tells anything
        ratio = values[..., -1] / np.where(nothing, 1, low)
        total = total + np.where(nothing, np.inf, 0.5 * np.log(np.where(nothing, 1, ratio)))
    return Map(s, phi, condition, weakest * np.sign(largest), np.exp(total / len(added)))


def candidates_of(spec: FitSpec, study: Study) -> Candidates:
    """The presses of the [design] section; left out: first to last ring, half to full depth.

    From ring to ring as far as all of the tool lies on the tube; of deforming cross-sections at
    every angle that was measured.

    Raises:
        SpecError: positions outside the tube or where the tool reaches beyond its ends, angles or
            depths that the model does not have, or unknowns that a new curve would not share.
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
    sections = study.model.options.deforms_sections
    radius = float(study.model.geometry.radius)
    if sections and depth[1] > radius:
        raise SpecError(
            f"design.depth: {depth[1]:g} mm, this model presses no deeper than the radius, "
            f"{radius:g} mm; give less"
        )
    count = (_FEW if sections else _MANY) if section.candidates is None else section.candidates
    return grid(s, depth, count, _angles(section.phi, study))


def _angles(asked: tuple[float, ...] | None, study: Study) -> list[float]:
    """Angles of the candidates, rad, each once.

    Raises:
        SpecError: one that the model does not press.
    """
    if not study.model.options.deforms_sections:
        if asked is not None:
            raise SpecError(
                "design.phi: this model presses on the midline alone; leave it out, or choose "
                "skeleton = 'sections'"
            )
        return [0.0]
    if asked is None:
        measured = (c.phi_c for curves in study.curves for c in curves)
        return sorted({round(float(phi), 9) + 0.0 for phi in measured})
    reach = float(study.model.geometry.half_angle)
    for phi in asked:
        if not abs(phi) <= reach:
            raise SpecError(
                f"design.phi: {np.degrees(phi):.4g} deg, the rings reach "
                f"{np.degrees(reach):.4g} deg to both sides; give angles on them"
            )
    return sorted(set(asked))
