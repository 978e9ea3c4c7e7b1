"""The model of a fit apart from its data: all that a compiled program depends on besides shapes."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from jaxtrachea._arguments import check_word
from jaxtrachea.fitting.parameters import Parameter, Scale
from jaxtrachea.mechanics.levels.choose import level_of
from jaxtrachea.mechanics.levels.level import Level
from jaxtrachea.mechanics.levels.options import Options
from jaxtrachea.trachea.geometry import Geometry

Common = Literal["all", "beam", "nothing"]
Loss = Literal["linear", "huber", "soft_l1", "cauchy"]


@dataclasses.dataclass(frozen=True)
class Column:
    """A column of the parameter table, as far as the model depends on it.

    Attributes:
        name: of the parameter.
        scale: see `Parameter`.
        step: see `Parameter`.
        fixed: not fitted; its value is data (`Lane.value`).
    """

    name: str
    scale: Scale
    step: float
    fixed: bool

    def __post_init__(self):
        """Refuse words that mean nothing (`ValueError`)."""
        check_word(f"{self.name}: scale", self.scale, Scale)


@dataclasses.dataclass(frozen=True)
class FitModel:
    """What is fitted, without the data: compared and hashed by value.

    Equal models of lanes of equal shapes share one compiled program. Values and bounds of the
    parameters are data.

    Attributes:
        tube: numbers of the geometry, in the order of its fields.
        options: what the model includes.
        columns: all parameters, free and fixed, in order.
        loss: `linear`, `huber`, `soft_l1` or `cauchy`.
        loss_scale: residual, in standard deviations, where the loss turns robust.
        common: what all trials of a lane have in common, in every lane: `all` unknowns, the `beam`,
            or `nothing`.
    """

    tube: tuple[float | tuple[float, ...], ...]
    options: Options
    columns: tuple[Column, ...]
    loss: Loss = "linear"
    loss_scale: float = 1.345
    common: Common = "nothing"

    def __post_init__(self):
        """Refuse words that mean nothing (`ValueError`)."""
        check_word("loss", self.loss, Loss)
        check_word("common", self.common, Common)

    @property
    def level(self) -> Level:
        """The level that the options ask for."""
        return level_of(self.options)

    @property
    def relaxes(self) -> bool:
        """Whether the force relaxes: lanes have their time."""
        return self.level.relaxes

    @property
    def geometry(self) -> Geometry:
        """The tube at rest, float64 numpy."""
        return jax.tree.unflatten(_tree(), [np.asarray(v, np.float64) for v in self.tube])

    @property
    def free(self) -> tuple[Column, ...]:
        """Columns that are fitted, in order."""
        return tuple(c for c in self.columns if not c.fixed)

    @property
    def free_columns(self) -> tuple[int, ...]:
        """Where the fitted columns stand in the parameter table."""
        return tuple(j for j, c in enumerate(self.columns) if not c.fixed)


def values_of(model: FitModel, free, value) -> dict[str, Any]:
    """Every parameter of one trial in its unit, by name.

    Args:
        free: free parameters, scaled coordinates; (F,).
        value: all parameters in their units, used where they are not free; (J,).
    """
    values = {p.name: value[j] for j, p in enumerate(model.columns)}
    for p, scaled in zip(model.free, free, strict=True):
        values[p.name] = jnp.exp(scaled) if p.scale == "log" else scaled * p.step
    return values


def columns_of(parameters: Sequence[Parameter]) -> tuple[Column, ...]:
    """The columns of a parameter table."""
    return tuple(Column(p.name, p.scale, float(p.step), p.fixed) for p in parameters)


def numbers_of(geometry: Geometry) -> tuple[float | tuple[float, ...], ...]:
    """A geometry as numbers, for `FitModel.tube`."""
    arrays = (np.asarray(getattr(geometry, f.name), float) for f in dataclasses.fields(geometry))
    return tuple(float(v) if v.ndim == 0 else tuple(v.tolist()) for v in arrays)


@functools.cache
def _tree():
    """Of a geometry, whose leaves are its fields."""
    return jax.tree.structure(Geometry.create(2.0, [1.0]))
