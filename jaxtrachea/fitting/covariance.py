"""What the data say about each unknown: standard errors, correlation, weakest direction.

Everything is local, from the Jacobian at the estimate (Gauss-Newton information matrix); profile
likelihood and bootstrap, which are not, are separate. With curve weights or a robust loss the
covariance is the sandwich kappa A^-1 B A^-1 (Huber 1981, ch. 7); otherwise it reduces to the usual
s^2 (J^T J)^-1.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxtrachea.fitting.information import Information
from jaxtrachea.fitting.structure import leaving_alone

#: Smallest ratio of singular values of the scaled Jacobian that float64 can tell from zero.
SINGULAR = 1e-7
#: 97.5 % quantile of the normal distribution.
NORMAL = 1.959963984540054


class Uncertainty(NamedTuple):
    """Local uncertainty of the unknowns of all lanes; NaN where an unknown is held on a bound.

    Attributes:
        se: standard error in scaled coordinates; inf where undetermined; (lanes, P).
        correlation: (lanes, P, P).
        condition: ratio of the largest to the smallest singular value of the Jacobian in relative
            coordinates (a change of 1 = 100 %); inf if singular; (lanes,).
        weakest_direction: unit vector, in relative coordinates, of the least determined
            combination; (lanes, P).
        weakest_se: its standard error (relative); (lanes,).
        structural_null_space: directions that the structure leaves open (`structure`), relative
            coordinates, orthonormal rows; the other rows are 0; (lanes, P, P).
        half_width: of the 95 % interval, in standard errors (Student's t); (lanes,).
        conditional_direction: how all unknowns move where one is moved and the others follow in
            the least costly way, to first order, scaled coordinates; row i: by a unit change of
            unknown i; (lanes, P, P).
        dispersion: of twice the rise of the cost along each unknown: where the cost is a
            likelihood s^2, else such that its curvature gives `se` (Kent 1982,
            doi:10.1093/biomet/69.1.19); (lanes, P).
        covariance: of the estimates, scaled coordinates; 0 for held unknowns, and without the
            `null_space`, along which it is infinite; (lanes, P, P).
        null_space: all directions that change no residual at the estimate, whatever the cause,
            scaled coordinates, rows; the other rows are 0; (lanes, P, P).
    """

    se: Float[np.ndarray, "lanes P"]
    correlation: Float[np.ndarray, "lanes P P"]
    condition: Float[np.ndarray, " lanes"]
    weakest_direction: Float[np.ndarray, "lanes P"]
    weakest_se: Float[np.ndarray, " lanes"]
    structural_null_space: Float[np.ndarray, "lanes P P"]
    half_width: Float[np.ndarray, " lanes"]
    conditional_direction: Float[np.ndarray, "lanes P P"]
    dispersion: Float[np.ndarray, "lanes P"]
    covariance: Float[np.ndarray, "lanes P P"]
    null_space: Float[np.ndarray, "lanes P P"]


def analyse(
    info: Information,
    relative: np.ndarray,
    held: np.ndarray,
    *,
    noise_given: tuple[bool, bool],
    noise_known: Bool[np.ndarray, " lanes"],
    least: float | None = None,
    unknowns: int | None = None,
    structural: np.ndarray | None = None,
) -> Uncertainty:
    """Turn the information of all lanes into standard errors and directions.

    Args:
        info: numpy, leading axis = lanes.
        relative: change of each scaled coordinate that makes a relative change of 1; (lanes, P).
        held: unknowns that are absent or on a bound; (lanes, P).
        noise_given: whether sigma of (force, markers) is known, so that their residuals do not
            scale the covariance.
        noise_known: lanes of which that holds for all that they observe; (lanes,).
        least: with a robust loss: mean psi^2 of normal noise of a sigma that is known, which it is
            taken for at least (`noise.normal_psi2`); None: linear loss.
        unknowns: estimated from the `counts`, if more than those of one lane.
        structural: directions that the structure leaves open, relative coordinates, orthonormal
            rows, the others 0; (lanes, P, P).
    """
    free = ~held
    total = np.sum(info.counts, axis=1)
    dof = total - (np.sum(free, axis=1) if unknowns is None else unknowns)
    half = half_widths(dof, noise_known=noise_known)
    usable = np.isfinite(info.bread).all(axis=(1, 2)) & (dof >= 0)
    free = free & usable[:, None]
    kappa = noise_factor(info, dof, noise_given=noise_given, least=least)
    dpsi = _mean_slope(info)
    unit = relative * free
    structural = np.zeros_like(info.bread) if structural is None else structural
    bread = _without(_scaled(np.asarray(info.bread), unit), structural, free)
    values, vectors = _spectrum(bread, free)
    inverse = np.einsum("lpk,lk,lqk->lpq", vectors, 1 / values, vectors)
    meat = _scaled(np.asarray(info.meat), unit) * kappa[:, None, None]
    covariance = inverse @ meat @ inverse
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    unseen = np.any((np.abs(vectors) > 1e-3) & np.isinf(values)[:, None], axis=2)
    with np.errstate(invalid="ignore", divide="ignore"):
        root = np.sqrt(variance)
        correlation = covariance / root[:, :, None] / root[:, None]
    se = np.where(free, np.where(unseen, np.inf, np.sqrt(variance)) * relative, np.nan)
    both = free[:, :, None] & free[:, None]
    condition, weakest, weakest_se = _weakest(values, vectors, free, covariance, usable)
    correlation = np.where(both, correlation, np.nan)
    conditional = _conditional_directions(values, vectors, free)
    whole = [np.trace(_scaled(np.asarray(m), relative), axis1=1, axis2=2) for m in info[:2]]
    dispersion = dpsi[:, None] * _ratio(conditional, meat, bread, whole[1] * kappa, whole[0])
    conditional = conditional * relative[:, None] / relative[:, :, None]
    covariance = covariance * relative[:, :, None] * relative[:, None]
    lost = np.isinf(values) & (np.sum(vectors**2 * free[:, :, None], axis=1) > 0.5)
    null_space = np.swapaxes(vectors, 1, 2) * lost[:, :, None] * (free * relative)[:, None]
    return Uncertainty(
        se=se, correlation=correlation, condition=condition, weakest_direction=weakest,
        weakest_se=weakest_se, structural_null_space=structural, half_width=half,
        conditional_direction=conditional, dispersion=dispersion, covariance=covariance,
        null_space=null_space,
    )  # fmt: skip


def noise_factor(
    info: Information,
    dof: np.ndarray,
    *,
    noise_given: tuple[bool, bool],
    least: float | None = None,
) -> Float[np.ndarray, " lanes"]:
    """Factor kappa of the sandwich: of the residuals, unless their noise is given, and of the loss.

    Forces and markers count by their numbers, each in units of its own sigma: residuals of a kind
    whose sigma is given say nothing of the noise of the other.

    Args:
        info: numpy, leading axis = lanes.
        dof: observed entries less the unknowns; (lanes,).
        noise_given: as for `analyse`.
        least: likewise.
    """
    total = np.sum(info.counts, axis=1)
    squares = np.asarray(info.psi2) * (total / np.maximum(dof, 1))[:, None]
    given = np.ones_like(squares) if least is None else np.maximum(squares, least)
    squares = np.where(np.array(noise_given), given, squares)
    return np.sum(squares * info.counts, axis=1) / np.maximum(total, 1) / _mean_slope(info) ** 2


def _mean_slope(info: Information) -> np.ndarray:
    """Mean of psi' of every lane, not 0."""
    return np.maximum(info.dpsi, 1e-3)


def half_widths(
    dof: np.ndarray, *, noise_known: Bool[np.ndarray, " lanes"]
) -> Float[np.ndarray, " lanes"]:
    """Of 95 % intervals in standard errors: normal with known noise, else Student's t; (lanes,)."""
    from scipy.special import stdtrit

    half = np.full(len(dof), NORMAL)
    if noise_known.all():
        return half
    different, which = np.unique(np.maximum(dof, 1), return_inverse=True)
    of_t = stdtrit(different, 0.975)[which.reshape(-1)]
    return np.where((dof > 0) & ~noise_known, of_t, half)


def _conditional_directions(values, vectors, free) -> np.ndarray:
    """Columns of the inverse over their diagonal, in relative coordinates; singular ones too."""
    largest = np.max(np.where(np.isfinite(values), values, 0), axis=1, keepdims=True)
    floor = SINGULAR**2 * np.where(largest > 0, largest, 1)
    own = np.sum(vectors**2 * free[:, :, None], axis=1) > 0.5
    weight = np.where(own, 1 / np.where(np.isfinite(values), values, floor), 0)
    inverse = np.einsum("lpk,lk,lqk->lpq", vectors, weight, vectors)
    both = free[:, :, None] & free[:, None]
    diagonal = np.where(free, np.diagonal(inverse, axis1=1, axis2=2), 1)
    return np.where(both, inverse / diagonal[:, :, None], np.eye(values.shape[1]))


def _ratio(directions, meat, bread, meat_trace, bread_trace) -> np.ndarray:
    """What the meat is of the bread along each row, or in the mean where both vanish.

    The traces are of the whole matrices: those of all unknowns, held ones too.
    """

    def form(m):
        return np.einsum("lip,lpq,liq->li", directions, m, directions)

    with np.errstate(invalid="ignore", divide="ignore"):
        return (form(meat) + 1e-12 * meat_trace[:, None]) / (
            form(bread) + 1e-12 * bread_trace[:, None]
        )


def _without(matrix: np.ndarray, directions: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Matrices without what rounding has left in open directions of the free unknowns."""
    matrix = matrix.copy()
    for k in np.flatnonzero(directions.any(axis=(1, 2))):
        rows = directions[k][directions[k].any(axis=1)]
        for i in np.flatnonzero(~free[k]):
            rows = leaving_alone(rows, int(i))
        keep = np.eye(matrix.shape[1]) - rows.T @ rows
        matrix[k] = keep @ matrix[k] @ keep
    return matrix


def _scaled(matrix: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Matrices in relative coordinates; rows and columns of held unknowns are zero."""
    product = unit[:, :, None] * unit[:, None]
    return np.where(product != 0, matrix, 0) * product


def _spectrum(matrix: np.ndarray, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues and vectors of the free block; inf for a held direction or a singular one.

    Held unknowns get a diagonal entry within the spectrum of the others, so that they neither mix
    with them nor set its ends.
    """
    top = np.max(np.diagonal(matrix, axis1=1, axis2=2), axis=1)
    top = np.where(top > 0, top, 1)[:, None]
    eye = np.eye(matrix.shape[1])
    values, vectors = np.linalg.eigh(matrix + eye * (~free * top)[:, :, None])
    own = np.sum(vectors**2 * free[:, :, None], axis=1) > 0.5
    largest = np.max(np.where(own, values, 0), axis=1, keepdims=True)
    keep = own & (values > SINGULAR**2 * largest)
    return np.where(keep, values, np.inf), vectors


def _weakest(values, vectors, free, covariance, usable):
    """Condition number, least determined direction and its standard error, of all lanes.

    Where every unknown is held nothing is left undetermined: 1, no direction, no error.
    """
    lanes = np.arange(len(values))
    own = np.sum(vectors**2 * free[:, :, None], axis=1) > 0.5
    singular = np.any(np.isinf(values) & own, axis=1) | ~usable
    nothing = usable & ~free.any(axis=1)
    order = np.where(own, np.where(np.isinf(values), -1, values), np.inf)
    weakest = np.argmin(order, axis=1)
    v = vectors[lanes, :, weakest] * free
    sign = np.sign(v[lanes, np.argmax(np.abs(v), axis=1)])
    direction = v * sign[:, None]
    variance = np.einsum("lp,lpq,lq->l", direction, covariance, direction)
    largest = np.max(np.where(own & np.isfinite(values), values, 0), axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        condition = np.sqrt(largest / values[lanes, weakest])
    weakest_se = np.where(singular, np.inf, np.sqrt(np.maximum(variance, 0)))
    condition = np.where(nothing, 1, np.where(singular, np.inf, condition))
    return condition, np.where(nothing[:, None], 0, direction), np.where(nothing, 0, weakest_se)
