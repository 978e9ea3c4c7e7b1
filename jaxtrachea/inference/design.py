"""Where to press next: what a further curve would add to the information, at every candidate.

A candidate is a press at s up to a depth, on the midline or, of deforming cross-sections, at an
angle phi, on one of the specimens where several are fitted together. Its sensitivities come from
the residual of the fit itself, so that model, scales and scopes are the same; it observes the force
along the normal, and off the midline the side force where the study has one. Relative coordinates:
1 is a change of 100 %.

What is known is what the fit says, and would say with the press: the sandwich A^-1 B A^-1 of
`fitting.covariance` with the weights of all curves, the new one included. A press adds to A (bread)
and B (meat); with equal weights B = A, the Fisher information of normal noise (Fedorov 1972).
Bounds count as a weak prior, of the variance of a uniform distribution between them, so that
nothing is infinite where the data so far leave a combination undetermined.

Unknowns of single trials (an onset, an offset) are told apart from those that are sought: a new
press brings its own, about which nothing is known, and the measured curves keep theirs. Both are
marginalised, so that information, scores and errors are those of the other unknowns.
"""

import dataclasses
from collections.abc import Sequence
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxtrachea._arguments import check_word
from jaxtrachea.config import FitSpec, SpecError
from jaxtrachea.fitting.covariance import noise_factor
from jaxtrachea.fitting.information import Information, informations
from jaxtrachea.fitting.lanes import mean_lengths
from jaxtrachea.fitting.noise import normal_psi2
from jaxtrachea.fitting.onset import counted_from
from jaxtrachea.fitting.press_scale import relative_change
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.study import Study
from jaxtrachea.fitting.tested import depths, untested
from jaxtrachea.inference.bootstrap import Bootstrap
from jaxtrachea.inference.design_press import (
    Guess,
    Place,
    index_of_presses,
    marginal,
    of_a_new_press,
    press_informations,
)
from jaxtrachea.inference.labels import succeeded

Criterion = Literal["D", "A", "E"]
#: Candidates where the user does not say: of deforming cross-sections, and of a line of joints,
#: which cost next to nothing.
_FEW, _MANY = 250, 10_000
#: Numbers of the matrices that are inverted together.
_NUMBERS = 1 << 20
#: Estimates of a lane, out of its bootstrap replicates, that a design is averaged over.
_DRAWS = 16


class Candidates(NamedTuple):
    """Presses to choose from; C of them.

    Attributes:
        s: contact position, mm.
        depth: largest tool displacement from first touch, mm.
        phi: contact angle, rad; None: all on the midline.
        curve: a curve of the lane on whose specimen it is; None: the first.
    """

    s: Float[np.ndarray, " C"]
    depth: Float[np.ndarray, " C"]
    phi: Float[np.ndarray, " C"] | None = None
    curve: Int[np.ndarray, " C"] | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class Situation:
    """What is known before the next press, for G guesses of the truth (lanes, replicates).

    Attributes:
        study: the study.
        lane: lane of each guess; (G,).
        theta: guess, scaled coordinates; (G, P).
        relative: change of each scaled coordinate that makes a relative change of 1; (G, P).
        base: bread of the data so far, with the weights of the curves, and of the bounds, on the Q
            unknowns that are not of single trials, relative coordinates; (G, Q, Q).
        meat: likewise; times the factor kappa of the covariance; (G, Q, Q).
        weight: of the squared residuals of a new curve, as the fit will have it.
        factor: what a press adds to the meat over what it adds to the bread; (G,).
        sigma: of a force sample, N; (G,).
        samples: of a curve.
        kept: these unknowns; (G, Q).
        own: unknowns of the first trial alone, which stand for those of a new press; `theta` has
            the median of all trials there; (G, R).
        prior: information of the bounds on all unknowns, relative coordinates; (G, P).
        blend: rounded corner of a new curve, mm, see `Lane`; (G,); None where no onset is fitted.
        approach: how long before first touch the record of a new press begins, mm, by lane.
        reach: least and largest depth of the curves so far, see `reached`.
    """

    study: Study
    lane: Int[np.ndarray, " G"]
    theta: Float[np.ndarray, "G P"]
    relative: Float[np.ndarray, "G P"]
    base: Float[np.ndarray, "G Q Q"]
    meat: Float[np.ndarray, "G Q Q"]
    weight: Float[np.ndarray, " G"]
    factor: Float[np.ndarray, " G"]
    sigma: Float[np.ndarray, " G"]
    samples: int
    kept: Int[np.ndarray, "G Q"]
    own: Int[np.ndarray, "G R"]
    prior: Float[np.ndarray, "G P"]
    blend: Float[np.ndarray, " G"] | None
    approach: Float[np.ndarray, " lanes"]
    reach: tuple[float, float]

    def with_press(self, added: Float[np.ndarray, "G Q Q"]) -> "Situation":
        """The situation after a press that adds so much to the bread."""
        meat = self.meat + self.factor[:, None, None] * added
        return dataclasses.replace(self, base=self.base + added, meat=meat)


@dataclasses.dataclass(frozen=True, eq=False)
class Choice:
    """Points chosen one after the other.

    Attributes:
        chosen: candidate of each step; (n,).
        score: of every candidate at each step, mean over guesses, larger is better; see `scores`;
            (n, C).
        error: relative standard error of every unknown before and after each step, as the fit has
            it and a refit would have it, root mean square over guesses; (n + 1, P).
    """

    chosen: Int[np.ndarray, " n"]
    score: Float[np.ndarray, "n C"]
    error: Float[np.ndarray, "m P"]


def grid(
    s: tuple[float, float],
    depth: tuple[float, float],
    count: int = 10_000,
    phi: Sequence[float] = (0.0,),
    curve: Sequence[int] = (0,),
) -> Candidates:
    """About `count` candidates in a reachable region, five depths at even positions.

    Args:
        s: first and last position, mm.
        depth: least and largest, mm.
        count: of all candidates.
        phi: angles, rad; each at every position and depth.
        curve: see `Candidates`; all of it on each of these.
    """
    depths = np.linspace(*depth, 5) if depth[1] > depth[0] else np.array([depth[0]])
    positions = np.linspace(*s, max(count // (len(depths) * len(phi) * len(curve)), 1))
    of, turned, at, down = np.meshgrid(curve, phi, positions, depths, indexing="ij")
    angles = turned.ravel() if np.any(turned) else None
    curves = of.ravel().astype(int) if np.any(of) else None
    return Candidates(at.ravel(), down.ravel(), angles, curves)


def pressed_curves(study: Study) -> list[int]:
    """First curve of every specimen that has unknowns of its own; the first alone elsewhere.

    Where every specimen is a lane a press is one on each of them.
    """
    if len(study.lanes.s_c) > 1:
        return [0]
    columns = [j for j in study.free_columns if study.parameters[j].scope != "trial"]
    rows = study.lanes.index[0, : len(study.curves[0])][:, columns]
    return np.sort(np.unique(rows, axis=0, return_index=True)[1]).tolist()


def pressed_specimen(study: Study, curve: int = 0) -> str:
    """Name of the specimen of a press; "(each)" of several lanes, "(any)" where all are alike."""
    names = {c.specimen for curves in study.curves for c in curves}
    if len(names) > 1 and len(study.lanes.s_c) > 1:
        return "(each)"
    if len(names) > 1 and len(pressed_curves(study)) == 1:
        return "(any)"
    return study.curves[0][curve].specimen


def reached(study: Study, touch: Float[np.ndarray, "lanes T"] | None = None) -> tuple[float, float]:
    """Least and largest depth of the curves, mm from first touch.

    Args:
        study: the study.
        touch: as `FitResult.first_touch`; None: as `Study.first_touch` has it before a fit.
    """
    options = study.model.options
    touch = study.first_touch if touch is None else touch
    pressed = [
        depths(c.displacement, at, options)
        for row, curves in zip(touch, study.curves, strict=True)
        for at, c in zip(row[: len(curves)].tolist(), curves, strict=True)
        if np.isfinite(at)  # a lane without an estimate
    ]
    return float(min(map(np.min, pressed))), float(max(map(np.max, pressed)))


def extrapolation(study: Study, depth: float, reach: tuple[float, float] | None = None) -> str:
    """What of a press goes deeper than the curves did, or the model was tested; "" if nothing.

    Args:
        study: the study.
        depth: mm from first touch.
        reach: of the curves, as `reached` has it of the fit; None: as before a fit.
    """
    low, high = reached(study) if reach is None else reach
    counted, model = counted_from(study.parameters), study.model
    beyond = depth > high + 1e-9
    known = f"extrapolated from data at D = {low:.3g} to {high:.3g} mm{counted}" if beyond else ""
    tested = untested(model.options, float(model.geometry.radius), depth, counted)
    return "; ".join(filter(None, [known, tested]))


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
    """What a fit knows, with the weights that it gives to curves and samples.

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
    sigma = result.whitened_sigma
    info = informations(study, lane, theta, sigma[lane])
    at_estimate = info
    if resampled is not None:
        at_estimate = informations(study, lanes, result.theta[lanes], sigma[lanes])
    kappa = _kappa(result, lanes, at_estimate)[np.searchsorted(lanes, lane)]
    relative, prior = _prior(study, lane, theta)
    base = np.eye(study.size) * prior[:, :, None]
    meat = base
    if with_data:
        unit = relative[:, :, None] * relative[:, None]
        meat = base + kappa[:, None, None] * info.meat * unit
        base = base + info.bread * unit
    kept, own, theta = of_a_new_press(study, lane, theta)
    base, meat = marginal(base, meat, kept)
    relative, prior = _prior(study, lane, theta)
    n = study.lanes.force.shape[-1] if samples is None else samples
    weight = np.ones(len(lane))
    if study.balance == "curve":
        weight = mean_lengths(study.curves, joint=False)[lane] / n
    blends, counts = study.lanes.blend, [len(c) for c in study.curves]
    blend = None
    if blends is not None:
        blend = np.array([np.median(blends[k, : counts[k]]) for k in lane])
    return Situation(
        study=study, lane=lane, theta=theta, relative=relative,
        base=base, meat=meat, weight=weight, factor=kappa * weight,
        sigma=result.sigma[lane, 0], samples=n, kept=kept, own=own, prior=prior, blend=blend,
        approach=_approaches(result), reach=reached(study, result.first_touch),
    )  # fmt: skip


def _approaches(result: FitResult) -> Float[np.ndarray, " lanes"]:
    """How long before first touch the records of each lane begin, median of its curves, mm."""
    rows = zip(result.first_touch, result.study.curves, strict=True)
    before = (
        [max(at - c.displacement.min(), 0.0) for at, c in zip(row.tolist(), curves, strict=False)]
        for row, curves in rows
    )
    return np.array([np.median(lane) for lane in before])


def _kappa(result: FitResult, lanes: Int[np.ndarray, " L"], info: Information) -> np.ndarray:
    """The factor of the covariance of these lanes at their estimates, as the fit has it; (L,)."""
    study = result.study
    held = result.at_bound | (study.lanes.active == 0)
    dof = np.sum(info.counts, axis=1) - np.sum(~held[lanes], axis=1)
    least = normal_psi2(study.model.loss, study.model.loss_scale)
    return noise_factor(info, dof, noise_given=study.noise_given, least=least)


def _prior(study: Study, lane: Int[np.ndarray, " G"], theta: Float[np.ndarray, "G P"]):
    """Change that makes a relative change of 1, and information of the bounds, of guesses."""
    absent = study.lanes.active[lane] == 0
    relative = np.where(absent, 1.0, relative_change(study.take(lane), theta))
    width = (study.lanes.upper - study.lanes.lower)[lane] / relative
    return relative, 12 / np.where(width > 0, width, 1) ** 2


def gains(known: Situation, candidates: Candidates) -> Float[np.ndarray, "G C Q Q"]:
    """What a press at every candidate adds to the bread of what it shares, for every guess.

    Its information times the weight of its curve, in relative coordinates; what the press has of
    its own is eliminated. A candidate without equilibrium at some sample tells nothing: zeros.

    Raises:
        ValueError: angles for a skeleton that is pressed on the midline alone.
    """
    study = known.study
    if candidates.phi is not None and not study.model.options.deforms_sections:
        raise ValueError("presses off the midline need the skeleton 'sections'; leave phi out")
    parts = []
    curve = np.zeros(len(candidates.s), int) if candidates.curve is None else candidates.curve
    for g, k in enumerate(known.lane):
        blend = None if known.blend is None else jnp.asarray(known.blend[g])
        theta, approach = jnp.asarray(known.theta[g]), jnp.asarray(known.approach[k])
        guess = Guess(theta, study.lanes.value[k, 0], blend, approach)
        index = index_of_presses(study, int(k), curve)
        place = Place(candidates.s, candidates.depth, candidates.phi, index)
        matrix = press_informations(study, known.samples, guess, place)
        matrix = matrix * (known.weight[g] / known.sigma[g] ** 2)
        matrix = np.nan_to_num(matrix, posinf=0.0, neginf=0.0)
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
    return marginal(of_press, of_press, shared)[0]


def scores(
    bread: Float[np.ndarray, "G C P P"], meat: Float[np.ndarray, "G C P P"], criterion: Criterion
) -> Float[np.ndarray, " C"]:
    """What is to be made large, of the covariance V = bread^-1 meat bread^-1 of the estimates.

    Minus its mean log determinant over guesses (D), minus the log of its mean variance (A), minus
    the mean log of its largest eigenvalue (E).
    """
    check_word("criterion", criterion, Criterion)
    if criterion == "D":
        logs = 2 * np.linalg.slogdet(bread)[1] - np.linalg.slogdet(meat)[1]
        return np.mean(logs, axis=0)
    variance = covariance(bread, meat)
    if criterion == "A":
        mean = np.mean(np.diagonal(variance, axis1=-2, axis2=-1), axis=-1)
        return -np.log(np.mean(mean, axis=0))
    return -np.mean(np.log(np.linalg.eigvalsh(variance)[..., -1]), axis=0)


def covariance(bread: np.ndarray, meat: np.ndarray) -> np.ndarray:
    """The sandwich, of many matrices (..., P, P)."""
    inverse = np.linalg.inv(bread)
    return inverse @ meat @ inverse


def scores_after(
    known: Situation, added: Float[np.ndarray, "G C Q Q"], criterion: Criterion
) -> Float[np.ndarray, " C"]:
    """`scores` after a press at every candidate, so many at a time that they take no memory."""
    check_word("criterion", criterion, Criterion)
    guesses, count, size, _ = added.shape
    together = max(_NUMBERS // max(guesses * size * size, 1), 1)
    parts = []
    for first in range(0, count, together):
        part = added[:, first : first + together]
        meat = known.meat[:, None] + known.factor[:, None, None, None] * part
        parts.append(scores(known.base[:, None] + part, meat, criterion))
    return np.concatenate(parts)


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
    # A press that tells nothing takes nothing away either, where weights let others do so.
    telling = np.any(np.diagonal(added, axis1=-2, axis2=-1) > 0, axis=(0, 2))
    telling = np.asarray(telling if np.any(telling) else ~telling, bool)
    chosen, table, errors = [], [], [_errors(known)]
    for _ in range(count):
        table.append(scores_after(known, added, criterion))
        chosen.append(int(np.argmax(np.where(telling, table[-1], -np.inf))))
        known = known.with_press(added[:, chosen[-1]])
        errors.append(_errors(known))
    return Choice(np.array(chosen), np.stack(table), np.stack(errors))


def _errors(known: Situation) -> np.ndarray:
    variance = np.diagonal(covariance(known.base, known.meat), axis1=-2, axis2=-1)
    return np.sqrt(np.mean(variance, axis=0))


class Map(NamedTuple):
    """How well curves at given positions tell the unknowns apart; means over guesses.

    Attributes:
        s: mm; (n,).
        phi: of all presses, rad.
        condition: after a press at s on top of the data; of the scaled Jacobian, as in a fit; (n,).
        weakest: unit vector of the least determined combination then, relative; (n, P).
        pairs: condition of a press at s and one at s', without any data, of the unknowns of the
            specimen that is pressed; (n, n).
        curve: a curve of that specimen, see `Candidates`.
    """

    s: Float[np.ndarray, " n"]
    phi: float
    condition: Float[np.ndarray, " n"]
    weakest: Float[np.ndarray, "n P"]
    pairs: Float[np.ndarray, "n n"]
    curve: int = 0


def identifiability(
    known: Situation, s: Float[np.ndarray, " n"], depth: float, phi: float = 0.0, curve: int = 0
) -> Map:
    """Condition and weakest direction of presses to `depth` (mm) at every position (mm).

    At one angle (rad), on the specimen of a curve (see `Candidates`). Conditions are geometric
    means over the guesses, directions those of the first guess.
    """
    angles = np.full(len(s), phi) if phi else None
    curves = np.full(len(s), curve) if curve else None
    added = gains(known, Candidates(s, np.full(len(s), depth), angles, curves))
    values, vectors = np.linalg.eigh(known.base[:, None] + added)
    condition = np.exp(np.mean(0.5 * np.log(values[..., -1] / values[..., 0]), axis=0))
    weakest = vectors[0, :, :, 0]
    largest = np.take_along_axis(weakest, np.argmax(np.abs(weakest), axis=1)[:, None], axis=1)
    total = 0.0
    index = known.study.lanes.index
    for matrix, kept, k in zip(added, known.kept, known.lane, strict=True):
        read = np.flatnonzero(np.isin(kept, index[k, curve]))
        matrix = matrix[:, read[:, None], read[None]]
        values = np.linalg.eigvalsh(matrix[:, None] + matrix[None])
        low = np.maximum(values[..., 0], 1e-14 * values[..., -1])
        nothing = values[..., -1] <= 0  # neither press tells anything
        ratio = values[..., -1] / np.where(nothing, 1, low)
        total = total + np.where(nothing, np.inf, 0.5 * np.log(np.where(nothing, 1, ratio)))
    return Map(s, phi, condition, weakest * np.sign(largest), np.exp(total / len(added)), curve)


def candidates_of(
    spec: FitSpec, study: Study, reach: tuple[float, float] | None = None
) -> Candidates:
    """The presses of the [design] section; left out: first to last ring, half to full depth.

    From ring to ring as far as all of the tool lies on the tube; of deforming cross-sections at
    every angle that was measured; on every specimen that has unknowns of its own.

    Args:
        spec: the specification.
        study: the study.
        reach: as in `extrapolation`.

    Raises:
        SpecError: positions outside the tube or where the tool reaches beyond its ends, depths of
            more than its radius, angles that the model does not have, or unknowns that a new curve
            would not share.
    """
    try:
        check(study)
    except ValueError as error:
        raise SpecError(f"parameters: {error}") from None
    section, length = spec.design, float(study.model.geometry.length)
    deepest = (reached(study) if reach is None else reach)[1]
    rings = study.model.geometry.ring_positions
    low, high = study.model.options.places(length)
    s = (max(float(rings[0]), low), min(float(rings[-1]), high)) if section.s is None else section.s
    if s[0] < low or s[1] > high:
        tool = f", the tool (half_width {low:g} mm) fits from {low:g} to {high:g} mm"
        raise SpecError(
            f"design.s: {s[0]:g} to {s[1]:g} mm, tube spans 0 to {length:g} mm"
            f"{tool if low > 0 else ''}; give places on it"
        )
    sections = study.model.options.deforms_sections
    radius = float(study.model.geometry.radius)
    if sections:
        deepest = min(deepest, radius)
    depth = (0.5 * deepest, deepest) if section.depth is None else section.depth
    # Without a skeleton the specimen need not be a tube.
    limited = sections or study.model.options.coupling == "series"
    if section.depth is not None and limited and depth[1] > radius:
        raise SpecError(
            f"design.depth: {depth[1]:g} mm, a tube is pressed no deeper than its radius, expected "
            f"at most {radius:g} mm; give less (trachea.radius is that of the tube)"
        )
    count = (_FEW if sections else _MANY) if section.candidates is None else section.candidates
    return grid(s, depth, count, _angles(section.phi, study), pressed_curves(study))


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
