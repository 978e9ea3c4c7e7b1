"""Noise of single curves against each other: very different ones should not weigh the same."""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

from jaxtrachea.measurements.curve import Curve
from jaxtrachea.measurements.turning import noise, rough_noise

#: Factor between the noise of curves of a specimen from which it is said, samples of a curve from
#: which its noise is known well enough, and the share of its force that the larger noise has.
UNEVEN, KNOWN, MATTERS = 4.0, 24, 0.003
#: A curve counts for no better than this share of its largest force: no model follows closer.
FLOOR = 0.002
#: Curves that are looked at together.
_BLOCK = 1000


def noise_of_curves(curves: Sequence[Curve]) -> Float[np.ndarray, " C"]:
    """Standard deviation of the noise of each curve against its neighbouring samples, N.

    0 for less than 16 samples; see `turning.noise`.
    """
    return np.array([noise(c.force) for c in curves])


def noise_to_weigh(curves: Sequence[Curve]) -> Float[np.ndarray, " C"]:
    """Standard deviation by which curves of one lane are weighed against each other, N.

    The root of the sum of the squares of its noise and of `FLOOR` of its largest force; where a
    curve has too few samples for its noise, the median of the others.
    """
    seen = noise_of_curves(curves)
    sizes = np.array([c.force.size for c in curves])
    known = sizes >= KNOWN
    seen = np.where(known, seen, np.median(seen[known]) if known.any() else 0.0)
    peaks = np.array([float(np.max(np.abs(c.force))) for c in curves])
    return np.hypot(seen, FLOOR * peaks)


def uneven_noise(curves: Sequence[Curve]) -> Iterator[str]:
    """That the noise of curves of one specimen differs much, where no sigma is given.

    Args:
        curves: in any order; those with a sigma of their own, or alone, are passed over.
    """
    groups: dict[str, list[Curve]] = {}
    for c in curves:
        if c.sigma is None and c.force.size >= KNOWN:
            groups.setdefault(c.specimen, []).append(c)
    found = []
    for lane in _suspicious([*groups.values()]):
        sigma = noise_of_curves(lane)
        low, high = int(np.argmin(sigma)), int(np.argmax(sigma))
        peak = float(np.max(np.abs(lane[high].force)))
        if sigma[high] > max(UNEVEN * sigma[low], MATTERS * peak):
            found.append((sigma[low], sigma[high], lane[low], lane[high]))
    if not found:
        return
    low, high, quiet, loud = max(found, key=lambda f: f[1] / max(f[0], 1e-300))
    many = f" (and in {len(found) - 1} more specimens)" if len(found) > 1 else ""
    yield (
        f"curves of {quiet.specimen} have very different noise, from {low:.2g} N ({quiet.trial}) "
        f"to {high:.2g} N ({loud.trial}){many}: noise.force = 'estimate per curve' weighs each by "
        "its own"
    )


def _suspicious(lanes: Sequence[list[Curve]]) -> list[list[Curve]]:
    """The lanes whose noise may differ by half of `UNEVEN`: a cheap look at all samples."""
    curves = [c for lane in lanes for c in lane]
    rough = []
    for block in range(0, len(curves), _BLOCK):
        part = curves[block : block + _BLOCK]
        edges = np.cumsum([0, *(c.force.size for c in part)])
        rough += rough_noise(np.concatenate([c.force for c in part]), edges).tolist()
    ends = np.cumsum([len(lane) for lane in lanes]).tolist()
    spans = [rough[end - len(lane) : end] for lane, end in zip(lanes, ends, strict=True)]
    return [lane for lane, v in zip(lanes, spans, strict=True) if max(v) > 0.5 * UNEVEN * min(v)]
