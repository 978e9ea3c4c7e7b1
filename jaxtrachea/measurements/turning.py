"""Turning points of a record, and the noise that decides what is one."""

import math

import numpy as np
from jaxtyping import Bool, Float64

#: Fewest samples from which the noise is estimated; below, there is said to be none.
_FEWEST = 16
#: A loading ends where the tool returns by more than this share of the way it came.
_RETURN = 0.5
#: Median of the absolute value of a standard normal variable.
_MEDIAN = 0.6745


def noise(values: Float64[np.ndarray, " n"], lag: int = 1) -> float:
    """Standard deviation of white noise on a smooth record.

    The differences of order 2, 3 and 4 of noise have sqrt(6), sqrt(20) and sqrt(70) times its
    standard deviation; medians of their sizes leave steps and turning points out of account, and
    the smallest of the three leaves out what a smooth curve adds.

    Args:
        values: the record, at least one sample.
        lag: samples between those that are subtracted; more than 1 sees slow wander as well.

    Returns:
        The estimate in the unit of `values`; 0 for less than 16 samples.
    """
    if values.size < _FEWEST * lag:
        return 0.0
    estimates, change = [], values
    for order in range(1, 5):
        change = change[lag:] - change[:-lag]
        if order > 1:
            size = math.sqrt(math.comb(2 * order, order))
            estimates.append(float(np.median(np.abs(change))) / (_MEDIAN * size))
    return min(estimates)


def white_noise(force: Float64[np.ndarray, " n"]) -> float:
    """Standard deviation of the noise of a record, N, of few samples by second differences."""
    if force.size >= 16:
        return noise(force)
    change = np.abs(np.diff(force, 2))
    return float(np.median(change)) / (0.6745 * 6**0.5) if change.size > 2 else 0.0


def rough_noise(force: Float64[np.ndarray, " s"], edges: np.ndarray) -> Float64[np.ndarray, " c"]:
    """Noise of each of many records; few jumps hardly change the roots of second differences."""
    second = np.zeros(force.shape)
    second[1:-1] = np.sqrt(np.abs(force[2:] - 2 * force[1:-1] + force[:-2]))
    second[edges[:-1]] = 0.0  # reaches into another record
    second[edges[1:] - 1] = 0.0
    inside = np.maximum(np.diff(edges) - 2, 1)
    # The mean root of a normal variable's size is 0.822 for a standard deviation of 1.
    return (np.add.reduceat(second, edges[:-1]) / inside / 0.8222) ** 2 / 6**0.5


def turning_points(values: Float64[np.ndarray, " n"], tolerance: float) -> list[int]:
    """Samples where a record turns back by more than a tolerance, with its first and last extreme.

    Minima and maxima alternate; of equal minima the last counts, of equal maxima the first.

    Args:
        tolerance: largest reversal that is none, in the unit of `values`.

    Returns:
        Indices in order; empty if the record never moves by more than the tolerance.
    """
    step = np.diff(values)
    moves = np.flatnonzero(step)
    up = step[moves] > 0
    # Extremes without a tolerance: where a move ends and the next one goes the other way.
    flips = np.flatnonzero(up[1:] != up[:-1])
    edges = np.unique(np.concatenate([[0], moves[flips] + 1, moves[flips + 1], [values.size - 1]]))
    heights = values[edges].tolist()
    points: list[int] = []
    low = high = extreme = 0
    rising: bool | None = None
    for i, height in enumerate(heights):
        if rising is None:
            low = i if height <= heights[low] else low
            high = i if height > heights[high] else high
            if height - heights[low] > tolerance or heights[high] - height > tolerance:
                rising = height - heights[low] > tolerance
                points.append(low if rising else high)
                extreme = i
        elif rising and height > heights[extreme] or not rising and height <= heights[extreme]:
            extreme = i
        elif abs(height - heights[extreme]) > tolerance:
            points.append(extreme)
            rising, extreme = not rising, i
    if rising is not None:
        points.append(extreme)
    return [int(edges[p]) for p in points]


def loadings(values: Float64[np.ndarray, " n"], points: list[int]) -> list[tuple[int, int]]:
    """Feet and peaks of the loadings between turning points, dips and partial returns within them.

    Returns:
        Pairs of samples (foot, peak) in order; none if the record only falls.
    """
    if len(points) > 1 and values[points[1]] < values[points[0]]:
        points = points[1:]
    found: list[tuple[int, int]] = []
    for foot, peak in zip(points[0::2], points[1::2], strict=False):
        if found:
            start, top = found[-1]
            if values[top] - values[foot] <= _RETURN * (values[top] - values[start]):
                found[-1] = (start, peak if values[peak] > values[top] else top)
                continue
        found.append((foot, peak))
    return found


def turned_back(values: Float64[np.ndarray, " n"], tolerance: float) -> Bool[np.ndarray, " n"]:
    """Samples of a rising record from where it turns back until it is where it was."""
    back = np.zeros(values.shape, dtype=bool)
    points = turning_points(values, tolerance)
    if len(points) > 1 and values[points[1]] < values[points[0]]:
        points = [points[0], *points]
    until = 0
    for peak, valley in zip(points[1::2], points[2::2], strict=False):
        if peak < until:
            continue
        again = np.flatnonzero(values[valley:] >= values[peak])
        until = valley + int(again[0]) if again.size else values.size
        still = peak + int(np.flatnonzero(values[peak:valley] >= values[peak])[-1])
        back[still + 1 : until] = True
    return back
