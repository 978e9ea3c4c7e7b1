"""With which parameters of a finished fit a curve is predicted, and why perhaps with none."""

import dataclasses

import numpy as np

from jaxtrachea.fitting.covariance import SINGULAR
from jaxtrachea.fitting.result import FitResult
from jaxtrachea.prediction.pressed import pressed
from jaxtrachea.status import FitStatus, PredictionStatus

#: Parameters of a measurement, not of the specimen: zero where no measurement is meant, whatever
#: their scope, and where they are held as well.
OF_MEASUREMENT = ("onset", "force_offset", "force_slope")


@dataclasses.dataclass(frozen=True, eq=False)
class CurveParameters:
    """Parameters of one curve; F free columns, J parameters.

    Attributes:
        specimen: that the curve belongs to.
        trial: that it belongs to; "" if none is meant.
        lane: of the fit; -1 if none.
        free: estimates of the free columns, scaled coordinates; 0 where the fit has none; (F,).
        value: all parameters in their units; (J,).
        covariance: of `free`; (F, F).
        null_space: directions that the fit leaves undetermined, rows; (P, F).
        half_width: of a 95 % interval in standard errors.
        sigma: of force, N, and markers, mm; (2,).
        own: free columns that are the curve's own and not in the fit.
        status: OK, or the worst there is to say.
        message: why, in words; "" if nothing is.
        refitted_own: what own parameters take up of a change of the curve: slopes (N, k) and the
            gain that fits them (k, N); None if they are not fitted.
        blend: rounded corner of a curve whose onset was fitted, mm, see `Lane`; NaN: that of the
            options.
        index: unknown of the lane that each free column reads; -1: none; (F,).
    """

    specimen: str
    trial: str
    lane: int
    free: np.ndarray
    value: np.ndarray
    covariance: np.ndarray
    null_space: np.ndarray
    half_width: np.ndarray
    sigma: np.ndarray
    own: tuple[int, ...]
    status: PredictionStatus
    message: str
    refitted_own: tuple[np.ndarray, np.ndarray] | None = None
    blend: float = np.nan
    index: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, int))


def source_of(
    stored: FitResult,
    specimen: str,
    trial: str | None = None,
    *,
    as_specimen: str | None = None,
    measured: bool = False,
) -> CurveParameters:
    """The parameters to predict a curve with.

    Args:
        specimen: of the curve.
        trial: of the fit whose own parameters count, and whose displacement and force; None: a new
            curve.
        as_specimen: of the fit, in the place of one that it does not know.
        measured: the curve has samples that its own parameters can be fitted to, recorded as those
            of the fit; else, of a new curve, displacement counts from first touch and force without
            offset, and no others can be its own.
    """
    new = trial is None and not measured
    used, note = _whose(stored, specimen, as_specimen)
    if used is None:
        return _none(stored, specimen, trial, PredictionStatus.UNKNOWN_SPECIMEN, note)
    lane = _lane(stored, used, trial)
    if lane is None:
        known = [c.trial for c in pressed(stored).curves if c.specimen == used]
        text = f"trial {trial!r} is not in this fit; expected one of " + ", ".join(
            map(repr, known[:12])
        )
        return _none(stored, specimen, trial, PredictionStatus.UNKNOWN_SPECIMEN, text)
    status = FitStatus(int(stored.status[lane]))
    if not status.succeeded:
        return _none(stored, specimen, trial, PredictionStatus.NO_ESTIMATE, status.message)
    index, own = _columns(stored, lane, used, trial, OF_MEASUREMENT if new else ())
    lacking = [stored.study.free[f].name for f in own]
    lacking = [name for name in lacking if name not in OF_MEASUREMENT]
    if lacking and not measured:
        text = f"{', '.join(lacking)} belongs to single trials; name one of the fit with trial="
        return _none(stored, specimen, trial, PredictionStatus.NO_ESTIMATE, text)
    note = "; ".join(filter(None, [note, "" if measured else _counted(stored, trial)]))
    taken = _taken(stored, specimen, trial or "", lane, index, own, note)
    taken = dataclasses.replace(taken, blend=_corner(stored, used, trial))
    return _from_first_touch(stored, taken) if new else taken


def _counted(stored: FitResult, trial: str | None) -> str:
    """What displacement and force are counted from, in words; "" where records have no zero."""
    zeros = [p for p in stored.study.parameters if p.name in OF_MEASUREMENT]
    if all(p.fixed and p.value == 0 for p in zeros):
        return ""
    if trial is None:
        return "D from first touch, force without offset"
    return f"D and force as trial {trial!r} records them"


def _from_first_touch(stored: FitResult, source: CurveParameters) -> CurveParameters:
    """The source with no onset and no offset: a press that nobody records."""
    study = stored.study
    value = [0.0 if p.name in OF_MEASUREMENT else v
             for p, v in zip(study.parameters, source.value, strict=True)]  # fmt: skip
    free = [-np.inf if p.name in OF_MEASUREMENT and p.scale == "log" else v
            for p, v in zip(study.free, source.free, strict=True)]  # fmt: skip
    return dataclasses.replace(source, value=np.array(value), free=np.array(free))


def _corner(stored: FitResult, specimen: str, trial: str | None) -> float:
    """Rounded corner that the fit used for this trial; NaN for a new one."""
    fitted = pressed(stored)
    pairs = zip(fitted.curves, fitted.blend.tolist(), strict=True)
    return next((b for c, b in pairs if (c.specimen, c.trial) == (specimen, trial)), np.nan)


def _whose(stored: FitResult, specimen: str, as_specimen: str | None) -> tuple[str | None, str]:
    """Specimen of the fit that stands for this one, and what is to be said of it."""
    names = pressed(stored).specimens
    if specimen in names:
        return specimen, ""
    if as_specimen is not None:
        return as_specimen, f"predicted as specimen {as_specimen!r}"
    own = [p.name for p in stored.study.free if p.scope == "specimen"]
    if not own:
        return names[0], "a new specimen: predicted with what all specimens share"
    if len(names) == 1:
        return names[0], f"a new specimen: predicted as the only one of the fit, {names[0]!r}"
    return None, (
        f"specimen {specimen!r} is not in this fit, where {', '.join(own)} belongs to each of "
        f"{len(names)} specimens; name the one to predict it as with --as"
    )


def _lane(stored: FitResult, specimen: str, trial: str | None) -> int | None:
    """Lane that holds this specimen, and trial if one is named; one with an estimate if any has."""
    fitted = pressed(stored)
    pairs = zip(fitted.curves, fitted.lane.tolist(), strict=True)
    lanes = [
        k for c, k in pairs if c.specimen == specimen and (trial is None or c.trial == trial)
    ]  # fmt: skip
    if not lanes:
        return None
    good = [k for k in lanes if FitStatus(int(stored.status[k])).succeeded]
    return (good or lanes)[0]


def _columns(stored: FitResult, lane: int, specimen: str, trial: str | None, without):
    """Unknown that every free column reads, -1 for those that the fit does not have; and these.

    `without`: names of columns that count as such.
    """
    place = {(p.name, s, t): i for i, (p, s, t) in enumerate(stored.study.unknowns[lane])}
    index, own = [], []
    for f, p in enumerate(stored.study.free):
        key = (
            p.name,
            "" if p.scope == "shared" else specimen,
            (trial or "") if p.scope == "trial" else "",
        )
        lacks = p.name in without or (p.scope == "trial" and not trial)
        index.append(-1 if lacks else place.get(key, -1))
        held = p.auto and trial is not None  # that trial's record shows none
        if index[-1] < 0 and not held:
            own.append(f)
    return np.array(index, int), tuple(own)


def _taken(stored: FitResult, specimen, trial, lane: int, index, own, note: str) -> CurveParameters:
    """The rows of the fit in the order of the free columns."""
    known = index >= 0
    pick = np.where(known, index, 0)
    both = known[:, None] & known[None]
    free = np.where(known, stored.theta[lane][pick] if known.any() else 0.0, 0.0)
    covariance = np.zeros(both.shape)
    null_space = np.zeros((max(stored.theta.shape[1], 1), len(index)))
    said = [note] if note else []
    status = PredictionStatus.OK
    if known.any():
        covariance = np.where(both, stored.uncertainty.covariance[lane][np.ix_(pick, pick)], 0.0)
        null_space = np.where(known, stored.uncertainty.null_space[lane][:, pick], 0.0)
        held = [p.name for p, k, i in zip(stored.study.free, known, pick, strict=True)
                if k and stored.at_bound[lane, i]]  # fmt: skip
        if held:
            status = PredictionStatus.AT_BOUND
            said.append(f"{', '.join(held)} held")
    if not np.isnan(stored.with_air[lane]).all():
        status = PredictionStatus.OTHER_ZERO
        said.append("curves of the fit may begin in air, which it does not take")
    return CurveParameters(
        specimen=specimen,
        trial=trial,
        lane=lane,
        free=free,
        value=np.array([p.value for p in stored.study.parameters]),
        covariance=covariance,
        null_space=null_space,
        half_width=np.asarray(stored.half_width[lane]),
        sigma=stored.observed_sigma[lane],
        own=own,
        status=status,
        message="; ".join(said),
        index=index,
    )


def onset_of(stored: FitResult, source: CurveParameters) -> float:
    """Displacement of a curve at first touch, mm, as it is predicted."""
    return value_of(stored, source, "onset")


def value_of(stored: FitResult, source: CurveParameters, name: str) -> float:
    """A parameter of a curve as it is predicted, in its unit."""
    for p, scaled in zip(stored.study.free, source.free, strict=True):
        if p.name == name:
            return p.from_scaled(float(scaled))
    return float(source.value[[p.name for p in stored.study.parameters].index(name)])


def _none(
    stored: FitResult, specimen, trial, status: PredictionStatus, message: str
) -> CurveParameters:
    """No parameters, and why; arrays of the usual shapes, so that one program serves all."""
    F, J = len(stored.study.free), len(stored.study.parameters)
    nan = np.full(F, np.nan)
    return CurveParameters(
        specimen=specimen,
        trial=trial or "",
        lane=-1,
        free=nan,
        value=np.full(J, np.nan),
        covariance=np.full((F, F), np.nan),
        null_space=np.zeros((max(stored.theta.shape[1], 1), F)),
        half_width=np.asarray(np.nan),
        sigma=np.full(2, np.nan),
        own=(),
        status=status,
        message=message,
    )


def detection_limit(
    stored: FitResult,
    source: CurveParameters,
    where: tuple[float, float, tuple[float, float]],
    displacement: np.ndarray,
) -> np.ndarray:
    """How far the fit sees slopes where it has pressed, see `prediction_core.predicted`; (N, F).

    `where`: position, mm, angle, rad, and direction.
    """
    free, fitted = stored.study.free, pressed(stored)
    out = np.zeros((len(displacement), len(free)))
    own = np.flatnonzero(fitted.lane == source.lane)
    curves = [fitted.curves[i] for i in own]

    def place(c):
        return [np.nan if c.s_c is None else c.s_c, c.phi_c, *c.direction]

    s, phi, direction = where
    at = [s, phi, *direction]

    def is_here(c):
        return np.allclose(place(c), at, rtol=0, atol=1e-9, equal_nan=True)

    here = [i for i in own if is_here(fitted.curves[i])]
    if not here or not source.null_space.any():
        return out
    # Of a scaled coordinate; an onset's steps are as large as the presses.
    size = [1.0 if p.scale == "log" or p.name in OF_MEASUREMENT else max(abs(v), 1e-3)
            for p, v in zip(free, source.free, strict=True)]  # fmt: skip
    samples = sum(len(c.force) for c in curves)
    reached = [fitted.curves[i].displacement - fitted.first_touch[i] for i in here]
    low, high = (f([f(d) for d in reached]) for f in (np.min, np.max))
    depth = displacement - onset_of(stored, source)
    out[(depth >= low - 1e-9) & (depth <= high + 1e-9)] = size
    return SINGULAR * np.sqrt(samples) * out
