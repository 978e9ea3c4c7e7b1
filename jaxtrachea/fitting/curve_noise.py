"""Curves of a lane weighed by their own noise, where its size is estimated all the same."""

from collections.abc import Sequence

import numpy as np

from jaxtrachea._errors import InputError
from jaxtrachea.fitting.lane import Lane, forces, with_observed
from jaxtrachea.measurements.read import Curve
from jaxtrachea.trials.uneven_noise import noise_to_weigh


def weighed_by_curve(lanes: Lane, groups: Sequence[Sequence[Curve]], *, joint: bool) -> Lane:
    """The lanes with forces weighed by the noise of their curves against each other.

    Precisions are relative to the root mean square noise of the lane's samples (joint: of all), so
    that the standard deviation that a fit estimates is that noise where the model follows.

    Args:
        lanes: with a precision of 1 where a force is observed.
        groups: curves of each lane.
        joint: whether lanes share unknowns.

    Raises:
        InputError: a curve has a sigma of its own; specimen and trial are its place.
    """
    for c in (c for curves in groups for c in curves):
        if c.sigma is not None:
            raise InputError(
                "it has a sigma of its own, beside noise.force = 'estimate per curve'",
                place=f"specimen {c.specimen!r} trial {c.trial!r}",
                cure="leave out one of them",
            )
    sigma = np.ones(lanes.s_c.shape)
    for row, curves in zip(sigma, groups, strict=True):
        row[: len(curves)] = noise_to_weigh(curves)
    count = np.sum(lanes.precision > 0, axis=2)
    square, total = (np.sum(v, axis=1, keepdims=True) for v in (count * sigma**2, count))
    if joint:
        square, total = (np.sum(v, axis=0, keepdims=True) for v in (square, total))
    factor = (np.sqrt(square / np.maximum(total, 1)) / sigma)[..., None]
    weighed = {kind.name: kind.precision * factor for kind in forces(lanes)}
    return with_observed(lanes, precision=weighed)
