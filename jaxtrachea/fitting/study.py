"""A study: lanes of padded arrays, with the model they are fitted by.

A *lane* is the smallest set of curves that share unknowns: the whole study if any parameter is
shared, one specimen otherwise, one trial if all free parameters belong to trials. In a *joint*
study lanes are specimens although they share unknowns: every lane holds a copy of the shared
ones, and the solver keeps the copies equal. How curves become arrays is in `lanes`, what these are
compared with in `residual`.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from jaxtrachea.fitting.lane import Lane, markers
from jaxtrachea.fitting.lane import size as entries_of_trial
from jaxtrachea.fitting.lanes import Balance, Noise, Taken, Unknown, Weighting
from jaxtrachea.fitting.model import FitModel, columns_of
from jaxtrachea.fitting.onset import first_touches
from jaxtrachea.fitting.parameters import Parameter
from jaxtrachea.measurements.read import Curve
from jaxtrachea.measurements.record_zeros import Zeros
from jaxtrachea.mechanics.levels.options import Options
from jaxtrachea.optimisation import batching
from jaxtrachea.trachea.geometry import Geometry


class Shares(NamedTuple):
    """Noise of forces that has a share of the force, as found; of every lane.

    Attributes:
        share: of the force; (lanes,).
        sigma: of a sample without force, N; (lanes,); None where it is given.
        plain: precision of the forces without the share; (lanes, T, N).
    """

    share: Float[np.ndarray, " lanes"]
    sigma: Float[np.ndarray, " lanes"] | None
    plain: Float[np.ndarray, "lanes T N"]


@dataclasses.dataclass(frozen=True, eq=False)
class Recipe:
    """Arguments of `build_study` apart from the curves.

    Attributes:
        geometry: the tube.
        options: of the model.
        parameters: the whole table, `auto` rows undecided.
        noise: see `build_study`.
        weighting: likewise.
        tool_radius: likewise.
        joint: likewise.
        asked: onsets and offsets that curves take on top of what their records show.
        zeros: what the records show, in the order of the lanes' curves; None: not looked at.
    """

    geometry: Geometry
    options: Options
    parameters: Sequence[Parameter]
    noise: Noise
    weighting: Weighting
    tool_radius: float | None
    joint: bool
    asked: Taken
    zeros: Zeros | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class Study:
    """Measurements divided into lanes, ready to be fitted with a model; from `build_study`.

    Attributes:
        model: what is fitted (static); programs are compiled for it.
        parameters: all parameters of the model, free and fixed, in column order.
        lanes: stacked arrays with the leading axis `lanes`, numpy.
        curves: for each lane, its curves in trial order.
        unknowns: for each lane, the (parameter, specimen or "", trial or "") of every unknown.
        noise_given: whether sigma of (force, markers) is known.
        marker_noise: given standard deviation of markers, mm, and share of the tool's displacement
            that it has beside it (see `Noise`); None: estimated.
        joint: whether shared unknowns are one and the same in all lanes.
        holdout_groups: names of trials, in groups that are left out together; see
            `inference.holdout_groups.with_holdout_groups`.
        balance: what weighs the same, see `Weighting`.
        change_points: displacement at which each curve shows its first touch, mm, NaN where it
            shows none; (lanes, T); None where no onset is sought.
        record_zeros: onset, force offset and slope that curves take from their own records, as
            these show them, mm, N, N/mm; NaN where they take none; None: no curve takes any.
        force_share: of the noise of forces, see `Noise`; None: it has none.
        shares: what the weights of the lanes have of it; None: nothing yet.
        recipe: how it was built; None of a study that was changed since, or read from a file.
    """

    model: FitModel
    parameters: tuple[Parameter, ...]
    lanes: Lane
    curves: tuple[tuple[Curve, ...], ...]
    unknowns: tuple[tuple[Unknown, ...], ...]
    noise_given: tuple[bool, bool]
    marker_noise: tuple[float, float] | None = None
    joint: bool = False
    holdout_groups: tuple[tuple[str, ...], ...] = ()
    balance: Balance = "curve"
    change_points: Float[np.ndarray, "lanes T"] | None = None
    record_zeros: Float[np.ndarray, "lanes T 3"] | None = None
    force_share: float | Literal["estimate"] | None = None
    shares: Shares | None = None
    # Not an argument, so that `dataclasses.replace` drops it: a changed study has none.
    recipe: Recipe | None = dataclasses.field(default=None, init=False)

    def __post_init__(self):
        """Refuse a model of another parameter table (`ValueError`)."""
        if (of_table := columns_of(self.parameters)) != self.model.columns:
            raise ValueError(
                f"the model has the columns {self.model.columns}, the parameter table gives "
                f"{of_table}; replace both together"
            )

    @functools.cached_property
    def noise_known(self) -> Bool[np.ndarray, " lanes"]:
        """Whether the sigma of all that a lane observes is given; jointly fitted: any lane."""
        known = np.full(len(self.unknowns), self.noise_given[0])
        if not self.noise_given[1]:
            for kind in markers(self.lanes):
                known &= ~(kind.precision.reshape(len(known), -1) > 0).any(axis=1)
        return np.full(len(known), known.all()) if self.joint else known

    @property
    def weighs_noise(self) -> bool:
        """Whether forces count by noise of their own, given or found."""
        seen = self.lanes.precision[self.lanes.precision > 0]
        return bool(np.ptp(seen) > 0)

    @property
    def free(self) -> tuple[Parameter, ...]:
        """Parameters that are fitted, in column order."""
        return tuple(p for p in self.parameters if not p.fixed)

    @property
    def free_columns(self) -> tuple[int, ...]:
        """Columns of the parameter table that are fitted."""
        return tuple(j for j, p in enumerate(self.parameters) if not p.fixed)

    @property
    def size(self) -> int:
        """Unknowns per lane, padding included."""
        return self.lanes.lower.shape[1]

    @property
    def first_touch(self) -> Float[np.ndarray, "lanes T"]:
        """Displacement at first touch of every trial before a fit, mm: held, or as curves show it.

        The first guess where they do not; `FitResult.first_touch` has the estimates.
        """
        return first_touch_of(self.lanes, self.parameters, self.change_points)

    @property
    def takes_zeros(self) -> Bool[np.ndarray, " lanes"]:
        """Lanes of which a curve takes an onset, force offset or slope that is `auto`."""
        columns = [j for j, p in enumerate(self.parameters) if p.auto and not p.fixed]
        return np.any(self.lanes.index[..., columns] >= 0, axis=(1, 2))

    @functools.cached_property
    def unknown_columns(self) -> Int[np.ndarray, "lanes P"]:
        """Which of `free` every unknown is; -1 where a lane has fewer unknowns."""
        number = {p.name: i for i, p in enumerate(self.free)}
        out = np.full((len(self.unknowns), self.size), -1)
        there = np.arange(self.size) < np.array([len(lane) for lane in self.unknowns])[:, None]
        out[there] = [number[p.name] for lane in self.unknowns for p, _, _ in lane]
        return out

    def of_unknowns(
        self, number: Callable[[Parameter], object], padding
    ) -> Shaped[np.ndarray, "lanes P"]:
        """A number of each unknown's parameter, `padding` where a lane has fewer; of its dtype."""
        return np.array([*map(number, self.free), padding], type(padding))[self.unknown_columns]

    @property
    def shared(self) -> Int[np.ndarray, "lanes k"]:
        """Where the unknowns that all lanes of a joint study share stand in each lane."""
        names = [p.name for p in self.free if p.scope == "shared"] if self.joint else []
        if not names:
            return np.zeros((len(self.unknowns), 0), int)
        rows = [{p.name: i for i, (p, _, _) in enumerate(lane)} for lane in self.unknowns]
        return np.array([[row[name] for name in names] for row in rows], int).reshape(
            len(self.unknowns), len(names)
        )

    def refuse_joint(self, what: str) -> None:
        """Say that something is made for lanes that are fitted one by one.

        Raises:
            ValueError: the study is joint.
        """
        if self.joint:
            raise ValueError(f"{what} needs lanes without shared unknowns; build with joint=False")

    def refuse_sections(self, what: str) -> None:
        """Say that something is too much work for a level that iterates.

        Raises:
            ValueError: this one does.
        """
        if self.model.level.iterates:
            raise ValueError(
                f"{what} is not available for the skeleton {self.model.level.name!r}; leave it out "
                "(standard errors, profiles, the bootstrap, influence, leaving out and designs "
                "are), or choose another skeleton"
            )

    @property
    def one_at_a_time(self) -> bool:
        """Whether lanes are fitted one after the other, whatever batch is asked for.

        Of a level that iterates on a CPU: lanes side by side gain nothing there, wait for the
        slowest of them, and each size is a program of half a minute.
        """
        return self.model.level.iterates and batching.on_cpu()

    @property
    def bytes_per_lane(self) -> int:
        """Memory that one of the lanes computed together takes, from above.

        Five numbers per residual entry and free column, as XLA counts them for a
        Levenberg-Marquardt step in float64 (3.7 to 5 in ten studies), and the matrices of the
        unknowns.
        """
        entries = self.lanes.s_c.shape[1] * entries_of_trial(self.lanes)
        return 8 * (5 * len(self.free) * entries + 8 * self.size**2 + 500)

    @property
    def max_batch(self) -> int:
        """Lanes worth computing together at most, a power of two (see `optimisation.batching`).

        Joint studies and other devices have no such limit; 1 where lanes are fitted
        `one_at_a_time`.
        """
        if self.one_at_a_time:
            return 1
        if self.joint or not batching.on_cpu():
            return 1 << 30
        return batching.max_in_cache(self.bytes_per_lane)

    def batch_size(self, total: int, most: int) -> int:
        """Lanes computed together, of `total`, of `most` and `max_batch`: a size of few."""
        return batching.batch_size(total, min(most, self.max_batch))

    def unoptimised(self, count: int) -> bool:
        """Whether `count` starts take less time than it takes to optimise their program.

        Joint studies run theirs again and again.
        """
        if self.joint or self.one_at_a_time or not batching.on_cpu():
            return False
        return not batching.worth_optimising(count, self.bytes_per_lane)

    def evaluates_few(self, count: int) -> bool:
        """As `unoptimised`, of `count` lanes that are evaluated a few times and not solved."""
        return self.unoptimised(-(-count // batching.EVALUATIONS))

    def take(self, lanes: Int[np.ndarray, " n"]) -> "Study":
        """The same study with these lanes, in this order; a lane may come more than once."""
        return dataclasses.replace(
            self,
            lanes=jax.tree.map(lambda v: v[lanes], self.lanes),
            curves=tuple(self.curves[k] for k in lanes),
            unknowns=tuple(self.unknowns[k] for k in lanes),
            change_points=None if self.change_points is None else self.change_points[lanes],
            record_zeros=None if self.record_zeros is None else self.record_zeros[lanes],
            shares=jax.tree.map(lambda v: v[lanes], self.shares),
        )

    def lane_name(self, lane: int) -> tuple[str, str]:
        """Specimen and trial of a lane; "(all)" where it spans several."""

        def one(names):
            return names.pop() if len(names) == 1 else "(all)"

        curves = self.curves[lane]
        return one({c.specimen for c in curves}), one({c.trial for c in curves})


def first_touch_of(lanes: Lane, parameters: Sequence[Parameter], seen: np.ndarray | None):
    """As `Study.first_touch`, of these lanes; `seen`: its `change_points`."""
    known = first_touches(lanes, parameters)
    return known if seen is None else np.where(np.isnan(seen), known, seen)
