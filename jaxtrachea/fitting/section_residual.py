"""Model minus data of a lane whose skeleton is of deforming cross-sections (`mechanics.sections`).

Every trial is pressed along its own path. The Jacobian is that of the equilibria by the free
columns, in forward mode: one path for all columns. A sample without equilibrium is NaN, which makes
the cost infinite wherever that sample is observed.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxtrachea._numerics import full_precision
from jaxtrachea.fitting.lane import Lane, forces, markers, weighted
from jaxtrachea.fitting.model import FitModel, values_of
from jaxtrachea.mechanics.sections.material import SectionMaterial
from jaxtrachea.mechanics.sections.press import press_sections
from jaxtrachea.mechanics.skeleton import local_frame
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.geometry import Geometry


class Tool(NamedTuple):
    """Where and how a trial presses; `phi_c` and `direction` None: on the midline, normally.

    Attributes:
        s_c: mm.
        displacement: as measured, mm; (N,).
        phi_c: rad.
        direction: along the inward normal and the circumference; (2,).
    """

    s_c: Float[Array, ""]
    displacement: Float[Array, " N"]
    phi_c: Float[Array, ""] | None = None
    direction: Float[Array, "2"] | None = None


class Answer(NamedTuple):
    """What can be observed of a press; the fields of a `Lane` of these names, without T.

    Attributes:
        force: along the tool's direction, with the offset, N.
        side_force: along that direction turned by 90 degrees, N.
        joints: of every ring at phi_c along the inward normal, mm.
        joint_side: likewise along the circumference.
        ends: of every ring's ends U and V, each y and z, mm.
    """

    force: Float[Array, " N"]
    side_force: Float[Array, " N"]
    joints: Float[Array, "N rings"]
    joint_side: Float[Array, "N rings"]
    ends: Float[Array, "N rings 2 2"]


def section_material(
    model: FitModel, free: Float[Array, " Jf"], value: Float[Array, " J"]
) -> tuple[SectionMaterial, dict[str, Array]]:
    """Material of one trial, and the value of every parameter by name.

    Results of a fit made before a parameter was there do not have it: then it is its default.
    """
    values = values_of(model, free, value)
    names = [field.name for field in dataclasses.fields(SectionMaterial) if field.name in values]
    return SectionMaterial(**{name: values[name] for name in names}), values


@full_precision
def answer(
    model: FitModel,
    free: Float[Array, " Jf"],
    value: Float[Array, " J"],
    tool: Tool,
    tube: Geometry,
) -> tuple[Answer, Int[Array, " N"]]:
    """What the model shows in one trial, and the `PressStatus` of each sample.

    Args:
        model: what is fitted (static).
        free: free parameters, scaled coordinates.
        value: all parameters in their units, used where they are not free.
        tool: where and how it presses.
        tube: the geometry.
    """
    material, values = section_material(model, free, value)
    plain = tool.phi_c is None or tool.direction is None
    phi_c = jnp.zeros_like(tool.s_c) if tool.phi_c is None else tool.phi_c
    along = jnp.asarray([1.0, 0.0], free.dtype) if tool.direction is None else tool.direction
    moved = tool.displacement - values["onset"]
    pressed = press_sections(
        tube, material, tool.s_c, phi_c, moved, along, midline=plain,
        half_width=model.options.half_width,
    )  # fmt: skip
    frame = local_frame(phi_c)[::2]  # inward normal, circumference
    force, joints = pressed.force @ frame.T, pressed.joints @ frame.T
    across = jnp.stack([-along[1], along[0]])
    found = Answer(
        force=force @ along + values["force_offset"],
        side_force=force @ across,
        joints=joints[..., 0],
        joint_side=joints[..., 1],
        ends=jnp.stack([pressed.end_U[..., 1:], pressed.end_V[..., 1:]], axis=2),
    )
    return found, pressed.status


def residual(
    model: FitModel, free: Float[Array, "T Jf"], trials: Lane, tube: Geometry
) -> tuple[Float[Array, "T m"], Float[Array, "T Jf m"]]:
    """Whitened differences of all trials, and their derivative by the free columns.

    Args:
        model: what is fitted (static).
        free: of every trial, scaled coordinates.
        trials: the arrays of a lane that have a trial axis.
        tube: the geometry.
    """
    eye = jnp.eye(free.shape[1], dtype=free.dtype)

    def one(free, trial):
        def push(tangent):
            return jax.jvp(lambda free: _seen(model, free, trial, tube), (free,), (tangent,))

        seen, slopes = jax.vmap(push, out_axes=(None, 0))(eye)
        return _row(seen, trial), jax.vmap(lambda slope: _whitened(slope, trial))(slopes)

    return jax.vmap(one)(free, trials)


def residual_value(
    model: FitModel, free: Float[Array, "T Jf"], trials: Lane, tube: Geometry
) -> Float[Array, "T m"]:
    """`residual` without its Jacobian."""

    def one(free, trial):
        return _row(_seen(model, free, trial, tube), trial)

    return jax.vmap(one)(free, trials)


def force_jacobian(
    model: FitModel,
    free: Float[Array, " Jf"],
    value: Float[Array, " J"],
    tool: Tool,
    tube: Geometry,
) -> Float[Array, "Jf m"]:
    """Derivative of the forces by the free columns, of a press without data.

    Of the force along the tool, (Jf, N); off the midline of the side force too, after it,
    (Jf, 2 N). NaN at samples without equilibrium, and too deep.
    """

    def at(free):
        found, status = answer(model, free, value, tool, tube)
        if tool.phi_c is None:
            return found.force, status
        return jnp.concatenate([found.force, found.side_force]), jnp.concatenate([status] * 2)

    def push(tangent):
        _, slope, status = jax.jvp(at, (free,), (tangent,), has_aux=True)
        solved = (status == PressStatus.OK) | (status == PressStatus.NO_CONTACT)
        return jnp.where(solved, slope, jnp.nan)

    return jax.vmap(push)(jnp.eye(free.shape[0], dtype=free.dtype))


def _seen(model: FitModel, free, trial: Lane, tube: Geometry) -> list[Array]:
    """What the model shows of every kind of observation of a trial, in the order of the row.

    Samples that nothing observes are not pressed: the tool stays at rest.
    """
    kinds = forces(trial) + markers(trial)
    looked = jnp.any(
        jnp.stack([(k.precision > 0).reshape(len(trial.force), -1).any(1) for k in kinds]), axis=0
    )
    onset = values_of(model, free, trial.value)["onset"]
    D = jnp.where(looked, trial.displacement, onset)
    tool = Tool(trial.s_c, D, trial.phi_c, trial.direction)
    found, _ = answer(model, free, trial.value, tool, tube)
    return [getattr(found, kind.name) for kind in kinds]


def _row(seen: list[Array], trial: Lane) -> Float[Array, " m"]:
    """Differences to the data over their standard deviation."""
    kinds = forces(trial) + markers(trial)
    return _whitened([v - kind.data for v, kind in zip(seen, kinds, strict=True)], trial)


def _whitened(parts: list[Array], trial: Lane) -> Float[Array, " m"]:
    """Observed entries over their standard deviation in one row."""
    kinds = forces(trial) + markers(trial)
    rows = [weighted(v, kind.precision).ravel() for v, kind in zip(parts, kinds, strict=True)]
    return jnp.concatenate(rows)
