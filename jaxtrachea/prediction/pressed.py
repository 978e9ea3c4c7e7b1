"""What a fit has pressed: its curves one after the other, from their first touch, and how far."""

import dataclasses
import functools
import weakref
from typing import Any

import numpy as np

from jaxtrachea.fitting.force_share import offsets
from jaxtrachea.fitting.refusals import depths
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.fitting.study import Study
from jaxtrachea.measurements.curve import Curve
from jaxtrachea.measurements.vectors import tilt_of


@dataclasses.dataclass(frozen=True, eq=False)
class Pressed:
    """The curves of a fit, C of L lanes.

    Attributes:
        study: of the fit.
        curves: all of them, lane by lane.
        lane: of each curve; (C,).
        first_touch: displacement at first touch, mm: held, or estimated; (C,).
        force_offset: force without contact, N: held, or estimated; (C,).
        blend: rounded corner at the onset, mm, see `Lane`; NaN where none was fitted; (C,).
        errors: what predictions have found out of lanes, kept for the next.
    """

    study: Study
    curves: tuple[Curve, ...]
    lane: np.ndarray
    first_touch: np.ndarray
    force_offset: np.ndarray
    blend: np.ndarray
    errors: dict[int, Any] = dataclasses.field(default_factory=dict)

    @property
    def specimens(self) -> tuple[str, ...]:
        """Names of the fitted specimens, in the order of the data."""
        return tuple(dict.fromkeys(c.specimen for c in self.curves))

    @functools.cached_property
    def _places(self) -> dict[tuple[str, str], int]:
        return {(c.specimen, c.trial): i for i, c in enumerate(self.curves)}

    def above_touch(self, curve: Curve) -> tuple[np.ndarray, np.ndarray]:
        """Depth of a curve of the fit from first touch, mm, and its force without offset, N."""
        i = self._places[curve.specimen, curve.trial]
        depth = depths(curve.displacement, self.first_touch[i], self.study.model.options)
        return depth, np.asarray(curve.force) - self.force_offset[i]

    @functools.cached_property
    def spans(self) -> np.ndarray:
        """Range of depth from first touch and of contact position of each lane, mm; (L, 4)."""
        out = np.tile([np.inf, -np.inf] * 2, (len(self.study.curves), 1))
        options = self.study.model.options
        rows = zip(self.curves, self.lane, self.first_touch.tolist(), strict=True)
        for curve, lane, touch in rows:
            D = depths(curve.displacement, touch, options)
            s = np.nan if curve.s_c is None else curve.s_c
            ends = [np.min(D), -np.max(D), s, -s]
            out[lane] = np.fmin(out[lane] * [1, -1, 1, -1], ends) * [1, -1, 1, -1]
        return out

    def reached(self, lane: int, s: float, phi: float, direction: tuple[float, float]) -> float:
        """Depth from first touch to which a lane was pressed there, mm; -inf: it was not."""
        options, at = self.study.model.options, [s, phi, *direction]
        rows = zip(self.curves, self.lane, self.first_touch.tolist(), strict=True)
        return max(
            (
                float(np.max(np.abs(depths(c.displacement, touch, options))))
                for c, own, touch in rows
                if own == lane
                and c.s_c is not None
                and np.allclose([c.s_c, c.phi_c, *c.direction], at, rtol=0, atol=1e-6)
            ),
            default=-np.inf,
        )

    @functools.cached_property
    def angles(self) -> np.ndarray:
        """Range of contact angle of the data of each lane, rad; (L, 2)."""
        return self._range([c.phi_c for c in self.curves])

    @functools.cached_property
    def tilts(self) -> np.ndarray:
        """Range of the tool's angle to the normal of the data of each lane, rad; (L, 2)."""
        return self._range([tilt_of(c.direction) for c in self.curves])

    def _range(self, values: list[float]) -> np.ndarray:
        """Least and largest of the values of the curves of each lane; (L, 2)."""
        out = np.tile([np.inf, -np.inf], (len(self.study.curves), 1))
        for value, lane in zip(values, self.lane, strict=True):
            out[lane] = min(out[lane][0], value), max(out[lane][1], value)
        return out


_KEPT: "weakref.WeakKeyDictionary[FitResult, Pressed]" = weakref.WeakKeyDictionary()


def pressed(result: FitResult) -> Pressed:
    """What a fit has pressed, found once for each fit."""
    if result not in _KEPT:
        study = result.study
        rows = [(k, t, c) for k, lane in enumerate(study.curves) for t, c in enumerate(lane)]
        lane, trial = (np.array([row[i] for row in rows], int) for i in (0, 1))
        blend = study.lanes.blend
        _KEPT[result] = Pressed(
            study=study,
            curves=tuple(c for _, _, c in rows),
            lane=lane,
            first_touch=result.first_touch[lane, trial],
            force_offset=offsets(study, result.theta)[lane, trial],
            blend=np.full(len(rows), np.nan) if blend is None else np.asarray(blend)[lane, trial],
        )
    return _KEPT[result]
