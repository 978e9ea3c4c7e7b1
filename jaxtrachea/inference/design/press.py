"""A further press: its unknowns, shared with the curves at hand or its own, and its information."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxtrachea._numerics import full_precision
from jaxtrachea.fitting.lane import forces
from jaxtrachea.fitting.model import FitModel, values_of
from jaxtrachea.fitting.residual import force_jacobian
from jaxtrachea.fitting.study import Study
from jaxtrachea.measurements.presses import HOLD_BEGINS
from jaxtrachea.mechanics.levels.level import Motion
from jaxtrachea.optimisation.batching import PATHS
from jaxtrachea.optimisation.programs import program


def of_a_new_press(
    study: Study, lane: Int[np.ndarray, " G"], theta: Float[np.ndarray, "G P"]
) -> tuple[Int[np.ndarray, "G Q"], Int[np.ndarray, "G R"], Float[np.ndarray, "G P"]]:
    """Unknowns that a new press shares, its own ones, and theta with typical values of these.

    Its own stand where the first trial has them.
    """
    scopes = [[p.scope for p, _, _ in u] + ["specimen"] * (study.size - len(u))
              for u in study.unknowns]  # fmt: skip
    shared = np.array(scopes)[lane] != "trial"
    if shared.all():
        return (
            np.tile(np.arange(study.size), (len(lane), 1)),
            np.zeros((len(lane), 0), int),
            theta,
        )
    theta = theta.copy()
    columns = own_columns(study)
    own = np.asarray(study.lanes.index)[lane, 0][:, columns]
    for g, k in enumerate(lane):
        for i, j in zip(own[g], columns, strict=True):
            every = study.lanes.index[k, : len(study.curves[k]), j]
            theta[g, i] = np.median(theta[g, every])
    return np.stack([np.flatnonzero(row) for row in _as_many(shared)]), own, theta


def own_columns(study: Study) -> list[int]:
    """Columns of which a new press has an unknown of its own.

    Those of single trials; a press that is yet to be made begins at its touch with force 0 unless
    all the measured ones have unknowns for that (`Parameter.auto`).
    """
    trial = (j for j in study.free_columns if study.parameters[j].scope == "trial")
    return [j for j in trial if not study.parameters[j].auto]


def _as_many(shared: np.ndarray) -> np.ndarray:
    """Rows of a mask with as many entries as the first: padding beyond it does not count."""
    most = int(np.min(np.sum(shared, axis=1)))
    return shared & (np.cumsum(shared, axis=1) <= most)


def marginal(
    bread: Float[np.ndarray, "G *c P P"],
    meat: Float[np.ndarray, "G *c P P"],
    kept: Int[np.ndarray, "G Q"],
) -> tuple[Float[np.ndarray, "G *c Q Q"], Float[np.ndarray, "G *c Q Q"]]:
    """Bread and meat of the unknowns `kept`, all others eliminated: the same covariance of them.

    The bread is the Schur complement A - C^T D^-1 C, the meat T B T^T with T = (1, -C^T D^-1).
    """
    size = bread.shape[-1]
    if kept.shape[1] == size:
        return bread, meat
    parts = []
    for A, B, rows in zip(bread, meat, kept, strict=True):
        others = np.setdiff1d(np.arange(size), rows)
        order = np.concatenate([rows, others])
        cross = A[..., others[:, None], rows[None]]
        inner = np.linalg.solve(A[..., others[:, None], others[None]], cross)
        inner = np.swapaxes(inner, -1, -2)
        one = np.broadcast_to(np.eye(len(rows)), (*inner.shape[:-1], len(rows)))
        T = np.concatenate([one, -inner], axis=-1)
        outer = T @ B[..., order[:, None], order[None]] @ np.swapaxes(T, -1, -2)
        parts.append((A[..., rows[:, None], rows[None]] - inner @ cross, outer))
    return np.stack([A for A, _ in parts]), np.stack([B for _, B in parts])


def index_of_presses(study: Study, lane: int, curve: Int[np.ndarray, " C"]):
    """Which unknowns presses on the specimens of some curves read; (C, J).

    Their own are those of the first trial, as in `of_a_new_press`.
    """
    index = np.array(study.lanes.index[lane])[curve]
    trial = [j for j in study.free_columns if study.parameters[j].scope == "trial"]
    index[:, trial] = -1
    own = own_columns(study)
    index[:, own] = np.asarray(study.lanes.index[lane, 0])[own]
    return index


class Guess(NamedTuple):
    """Unknowns of a guess, and what a press has beside them.

    Attributes:
        theta: scaled coordinates; (P,).
        value: of all parameters, see `Lane`; (J,).
        blend: see `Lane`; ().
        approach: how long before first touch the record begins, mm.
    """

    theta: Any
    value: Any
    blend: Any
    approach: Any


class Place(NamedTuple):
    """A press, or with a leading axis many.

    Attributes:
        s: contact position, mm.
        depth: largest tool displacement from first touch, mm.
        phi: contact angle, rad; None: on the midline.
        index: which unknown every parameter reads, see `Lane`; (J,).
        speed: of the tool, mm/s; None: the force knows no time.
        hold: how long it then stays, s; with `speed`.
    """

    s: Any
    depth: Any
    phi: Any
    index: Any
    speed: Any = None
    hold: Any = None


def press_informations(
    study: Study, samples: int, guess: Guess, places: Place
) -> Float[np.ndarray, "C P P"]:
    """Information of presses with noise of 1 N; of a level that iterates so many at a time.

    Each is a path of its own there, and all together would take the memory.
    """
    names = tuple(kind.name for kind in forces(study.lanes)[1:])
    run = program(_information, study.model, samples, names, axes=(None, 0))
    count = len(places.s)
    together = PATHS if study.model.level.iterates else count
    parts = []
    for first in range(0, count, together):
        row = np.minimum(np.arange(first, first + together), count - 1)
        place = Place(*(None if v is None else v[row] for v in places))
        parts.append(np.array(run(guess, place))[: count - first])
    return np.concatenate(parts)


@full_precision
def _information(model: FitModel, samples: int, names: tuple[str, ...], guess: Guess, place: Place):
    """Information of one press with noise of 1 N on the unknowns; (P, P).

    `names`: what it observes beside the force.
    """
    theta, value, blend, approach = guess
    index = place.index[jnp.array(model.free_columns)]
    free = jnp.where(index >= 0, theta[jnp.maximum(index, 0)], 0)
    share, still = jnp.arange(1, samples + 1, dtype=theta.dtype) / samples, None
    if place.speed is not None:
        share, still = _ramp_and_hold(samples, place.hold)
    touch = values_of(model, free, value)["onset"]
    displacement = touch + share * place.depth - (1 - share) * approach
    time = None if still is None else share * (place.depth + approach) / place.speed + still
    motion = Motion(place.s, displacement, blend=blend, phi_c=place.phi, time=time)
    if place.phi is not None:
        motion = motion._replace(direction=jnp.asarray([1.0, 0.0], theta.dtype))
    J = force_jacobian(model, free, value, motion, names)
    if time is not None:  # the first sample is that of rest
        J = J.reshape(len(J), -1, samples + 1)[:, :, 1:].reshape(len(J), -1)
    at = jnp.where(index >= 0, index, len(theta))
    zero = jnp.zeros((len(theta), len(theta)), theta.dtype)
    gram = jnp.einsum("im,jm->ij", J, J)
    return zero.at[at[:, None], at[None]].add(gram, mode="drop")


def _ramp_and_hold(
    samples: int, hold: Float[Array, ""]
) -> tuple[Float[Array, " N"], Float[Array, " N"]]:
    """Share of the way and time since its end, s, of rest and so many samples after it.

    Half of them lie evenly on the ramp and half in the hold, there evenly in the logarithm of the
    time, as records are averaged; without a hold all lie on the ramp.
    """
    k = jnp.arange(samples + 1, dtype=hold.dtype)
    ramp = jnp.where(hold > 0, samples - samples // 2, samples)
    later = (k - ramp) / jnp.maximum(samples - ramp, 1)
    still = jnp.where(k > ramp, hold * HOLD_BEGINS ** (1 - later), 0)
    return jnp.minimum(k / ramp, 1), still
