"""Model minus data of one lane, with its Jacobian: one definition for fit, uncertainty and plots.

A curve sees the skeleton and the local law through few numbers, its `Inputs`. The Jacobian is taken
in two stages, inputs by parameters and forces by inputs: the beam is differentiated once for each
position, by the beam's own parameters, and not for each sample.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxtrachea.fitting import forward_residual
from jaxtrachea.fitting.lane import Lane, weighted
from jaxtrachea.fitting.model import FitModel, values_of
from jaxtrachea.fitting.parameters import SKELETON
from jaxtrachea.fitting.relaxing import Way, numbers, parts_press, relaxed_press, relaxed_value
from jaxtrachea.mechanics.equilibrium import sensitivity
from jaxtrachea.mechanics.force_law import coefficient
from jaxtrachea.mechanics.levels.level import Closed, Motion
from jaxtrachea.mechanics.press import Contact
from jaxtrachea.mechanics.samples import no_history
from jaxtrachea.trachea.geometry import Geometry


class Residual(NamedTuple):
    """Whitened differences model - data of one lane.

    Attributes:
        value: (T, m); force samples, then markers.
        jacobian: d value / d (free columns, scaled); (T, Jf, m).
        bend: of the corner at the onset: second derivative of the value by the onset's column, as
            far as it comes from the rounded corner; None where no onset is fitted; (T, m).
    """

    value: Float[Array, "T m"]
    jacobian: Float[Array, "T Jf m"]
    bend: Float[Array, "T m"] | None = None


class Skeleton(NamedTuple):
    """Motion under a unit force at C: of C, mm/N, and of every ring (None without markers)."""

    compliance: Float[Array, "*T"]
    joints: Float[Array, "*T rings"] | None


class Inputs(NamedTuple):
    """All that the curves of one lane depend on, trial by trial.

    Attributes:
        compliance: of the skeleton as the force feels it, mm/N; (T,).
        joints: motion of every ring under a unit force, mm/N; (T, rings); None without markers.
        contact: law, onset and softening; (T,).
        force_offset: N; (T,).
        force_slope: of the force without contact, N/mm; (T,). None where the model has no such
            line.
        relaxation: numbers of the law by which the force relaxes; (T, K). None: it does not.
    """

    compliance: Float[Array, " T"]
    joints: Float[Array, "T rings"] | None
    contact: Contact
    force_offset: Float[Array, " T"]
    force_slope: Float[Array, " T"] | None = None
    relaxation: Float[Array, "T K"] | None = None


def inputs(
    model: FitModel, theta: Float[Array, " P"], lane: Lane, geometry: Geometry | None = None
) -> Inputs:
    """What the curves of one lane see of its unknowns.

    Args:
        theta: unknowns in scaled coordinates.
        geometry: the tube, may be traced; None: of the model.

    Raises:
        ValueError: a level without a closed form, which no few numbers describe.
    """
    if model.level.closed is None:
        raise ValueError(f"the skeleton {model.level.name!r} has no compliance of its own")
    free, tube = of_trials(model, theta, lane), _tube(model, geometry, theta.dtype)
    skeleton = _skeleton(model, free, _places(lane), tube)

    def at(free, value, s_c):
        return _at_contact(model, free, value, s_c, tube)

    local = jax.vmap(at)(free, lane.value, lane.s_c)
    relaxation = None
    if model.relaxes:
        relaxation = jax.vmap(lambda *v: numbers(model, values_of(model, *v)))(free, lane.value)
    return Inputs(_felt(model, skeleton), skeleton.joints, *local, relaxation)


def residual(
    model: FitModel, theta: Float[Array, " P"], lane: Lane, geometry: Geometry | None = None
) -> Residual:
    """Residuals of one lane and their Jacobian, trial by trial.

    Args:
        theta: unknowns in scaled coordinates.
        geometry: the tube, may be traced; None: of the model.
    """
    free, tube = of_trials(model, theta, lane), _tube(model, geometry, theta.dtype)
    if model.level.forward and not _apart(model):
        return Residual(*forward_residual.residual(model, free, of_press(lane), tube))
    skeleton, by_beam = _skeleton_and_derivative(model, free, _places(lane), tube)

    def one(*trial):
        return _of_trial_with_jacobian(model, tube, *trial)

    return Residual(*jax.vmap(one)(free, skeleton, by_beam, of_press(lane)))


def residual_value(
    model: FitModel, theta: Float[Array, " P"], lane: Lane, geometry: Geometry | None = None
) -> Float[Array, "T m"]:
    """`residual` without its Jacobian."""
    free, tube = of_trials(model, theta, lane), _tube(model, geometry, theta.dtype)
    if model.level.forward:
        return forward_residual.residual_value(model, free, of_press(lane), tube)
    skeleton = _skeleton(model, free, _places(lane), tube)

    def one(free, skeleton, trial):
        at = _at_contact(model, free, trial.value, trial.s_c, tube, trial.blend)
        felt = _felt(model, skeleton)
        solved = _closed(model).respond(trial.displacement, felt, at.contact)
        force, load = solved.force, solved.force if solved.load is None else solved.load
        if trial.time is not None:
            values = values_of(model, free, trial.value)
            force, load = relaxed_value(model, values, trial.time, solved)
        joints = None if skeleton.joints is None else _times(load, skeleton.joints)
        without = at.force_offset
        if at.force_slope is not None:
            without = without + at.force_slope * trial.displacement
        return _whitened(force + without, joints, trial)

    return jax.vmap(one)(free, skeleton, of_press(lane))


def of_trials(model: FitModel, v: Float[Array, " P"], lane: Lane) -> Float[Array, "T Jf"]:
    """Entries of a vector over the unknowns for every free column in every trial; 0 where none."""
    if model.common == "all":
        return jnp.broadcast_to(v, (lane.s_c.shape[0], v.shape[0]))
    index = lane.index[:, model.free_columns]
    return jnp.where(index >= 0, v[jnp.maximum(index, 0)], 0)


def of_press(lane: Lane) -> Lane:
    """The arrays of a lane that have a trial axis."""
    return lane._replace(lower=None, upper=None, active=None, index=None)


def _beam_columns(model: FitModel) -> tuple[int, ...]:
    """Which free columns change the skeleton's compliance."""
    return tuple(i for i, p in enumerate(model.free) if p.name in SKELETON)


def _apart(model: FitModel) -> bool:
    """Whether local law and skeleton relax apart: the elastic press in between has no use."""
    return model.options.relaxation == "parts"


def _closed(model: FitModel) -> Closed:
    """The closed form of a level that has one."""
    closed = model.level.closed
    assert closed is not None
    return closed


def _tube(model: FitModel, geometry: Geometry | None, dtype) -> Geometry:
    """The geometry as arrays; that of the model where none is given."""
    of = model.geometry if geometry is None else geometry
    return jax.tree.map(lambda v: jnp.asarray(v, dtype), of)


class _Places(NamedTuple):
    """Where T trials press, and whether the motion of the rings is asked for (static).

    `value`: every model parameter, used where it is not free.
    """

    s_c: Float[Array, " T"]
    value: Float[Array, "T J"]
    marked: bool


def _places(lane: Lane) -> _Places:
    return _Places(lane.s_c, lane.value, "joints" in lane.others)


def _skeleton(model: FitModel, free, places: _Places, tube: Geometry) -> Skeleton:
    """What moves under a unit force in every trial."""

    def at(free, value, s_c):
        material = _closed(model).material(values_of(model, free, value))
        return Skeleton(*_closed(model).skeleton(tube, material, s_c, joints=places.marked))

    if model.options.coupling == "total" and not places.marked:
        return Skeleton(jnp.zeros_like(places.s_c), None)
    if model.common != "nothing" and not places.marked:
        return at(free[0], places.value[0], places.s_c)
    return jax.vmap(at)(free, places.value, places.s_c)


def _skeleton_and_derivative(
    model: FitModel, free, places: _Places, tube: Geometry
) -> tuple[Skeleton, Skeleton]:
    """`_skeleton` and its derivative by each of `_beam_columns`, an axis after that of the trials.

    A trial reads its own row of `free` alone, so that one tangent serves all trials.
    """
    columns = _beam_columns(model)
    if not columns:
        skeleton = _skeleton(model, free, places, tube)
        return skeleton, jax.tree.map(lambda v: jnp.zeros((v.shape[0], 0, *v.shape[1:])), skeleton)
    along = np.eye(free.shape[1], dtype=free.dtype)[list(columns)]

    def push(tangent):
        tangents = jnp.broadcast_to(tangent, free.shape)
        return jax.jvp(lambda free: _skeleton(model, free, places, tube), (free,), (tangents,))

    return jax.vmap(push, out_axes=(None, 1))(along)


class _Local(NamedTuple):
    """What one trial's force depends on besides the skeleton; scalars."""

    contact: Contact
    force_offset: Float[Array, ""]
    force_slope: Float[Array, ""] | None


def _at_contact(model: FitModel, free, value, s_c, tube: Geometry, blend=None) -> _Local:
    values = values_of(model, free, value)
    material = _closed(model).material(values)
    contact = _closed(model).contact(tube, material, s_c, values["onset"], blend)
    return _Local(contact, values["force_offset"], values.get("force_slope"))


def _felt(model: FitModel, skeleton: Skeleton):
    """Compliance that the contact force depends on."""
    return _closed(model).felt(skeleton.compliance)


def _times(load: Float[Array, " N"], joints: Float[Array, " rings"]) -> Float[Array, "N rings"]:
    """Motion of every ring at every sample."""
    return load[:, None] * joints[None]


def _whitened(force, joints, trial: Lane) -> Float[Array, " m"]:
    """Difference to the data of one trial over its standard deviation, forces then markers."""
    moved = None if joints is None else joints - trial.others["joints"].data
    return _masked(force - trial.force, moved, trial)


def _masked(force, joints, trial: Lane) -> Float[Array, " m"]:
    """Observed entries over their standard deviation, exact zeros elsewhere; in one row."""
    r = weighted(force, trial.precision)
    if joints is None or "joints" not in trial.others:
        return r
    markers = weighted(joints, trial.others["joints"].precision)
    return jnp.concatenate([r, markers.reshape(*r.shape[:-1], -1)], axis=-1)


class _Pressed(NamedTuple):
    """One press of N samples and its derivatives by the Jf free columns, without data.

    Attributes:
        force: of the local law, without offset, N; (N,).
        d_force: (Jf, N).
        load: what the joints follow, N; the force unless the skeleton softens; (N,).
        d_load: (Jf, N).
        offset: force without contact, N; scalar, or (N,) where it is a line.
        d_offset: (Jf, 1), or (Jf, N).
        d_joints: of the motion of every ring under a unit force; (Jf, rings); None without rings.
        corner: second derivative of the force by the onset's column, as far as it comes from the
            rounded corner; None where no onset is fitted; (N,).
    """

    force: Float[Array, " N"]
    d_force: Float[Array, "Jf N"]
    load: Float[Array, " N"]
    d_load: Float[Array, "Jf N"]
    offset: Float[Array, "*n"]
    d_offset: Float[Array, "Jf _"]
    d_joints: Float[Array, "Jf rings"] | None
    corner: Float[Array, " N"] | None


def _press(model: FitModel, tube, free, value, skeleton, by_beam, motion: Motion) -> _Pressed:
    """One press, given the skeleton at its place."""
    D, blend = motion.displacement, motion.blend
    count = free.shape[0]

    def push(t):
        return jax.jvp(lambda f: _at_contact(model, f, value, motion.s_c, tube), (free,), (t,))

    local, d_local = jax.vmap(push, out_axes=(None, 0))(jnp.eye(count, dtype=free.dtype))
    contact, d_contact = local.contact._replace(blend=blend), d_local.contact
    c, d_skeleton = _felt(model, skeleton), _every_column(model, by_beam, count)
    d_c = _felt(model, d_skeleton)
    solved = _closed(model).respond(D, c, contact)

    def at(onset):
        return _closed(model).indentation(D, onset, blend)

    def slope(onset):
        return jax.jvp(at, (onset,), (jnp.ones_like(onset),))[1]

    by_onset = slope(contact.onset)
    d_inputs = _input_derivatives(model, d_c, d_contact)

    def pushed(by):
        by = by | {"onset": by["displacement"] * by_onset}
        out = jnp.zeros((count, *D.shape), D.dtype)
        for name, change in d_inputs.items():
            out = out + change[:, None] * by[name][None]
        return out

    of_force, of_load = sensitivity(solved, c, contact.law, contact.softening)
    d_force = pushed(of_force)
    load, d_load = solved.force, d_force
    if solved.load is not None:
        load, d_load = solved.load, pushed(of_load)
    corner = None
    if blend is not None and any(p.name == "onset" for p in model.free):
        curved = jax.jvp(slope, (contact.onset,), (jnp.ones_like(contact.onset),))[1]
        corner = of_force["displacement"] * curved * jnp.sum(d_contact.onset**2)
    offset, d_offset = _without_contact(local, d_local, D)
    pressed = _Pressed(
        force=solved.force, d_force=d_force, load=load, d_load=d_load, offset=offset,
        d_offset=d_offset, d_joints=d_skeleton.joints, corner=corner,
    )  # fmt: skip
    if not _apart(model):
        return pressed
    # Where the elastic press has no solution, none has a history from then on.
    lost, _ = no_history(solved.status, jnp.zeros_like(D, bool))
    way = Way(jnp.where(lost, jnp.nan, at(contact.onset)), c, contact)
    d_way = Way(d_contact.onset[:, None] * by_onset[None], d_c, d_contact)
    return parts_press(model, free, value, motion.time, pressed, way, d_way)


def _every_column(model: FitModel, by_beam: Skeleton, count: int) -> Skeleton:
    """Derivatives by `_beam_columns` among those by all `count` free columns, 0 elsewhere."""
    of_beam = _beam_columns(model)

    def every(v):
        zero = jnp.zeros(v.shape[1:], v.dtype)
        columns = [v[of_beam.index(i)] if i in of_beam else zero for i in range(count)]
        return jnp.stack(columns) if columns else v[:0]

    return jax.tree.map(every, by_beam)


def _input_derivatives(model: FitModel, d_compliance, d_contact: Contact) -> dict[str, Array]:
    """Derivatives, (Jf,), of what the contact force depends on, by name; none that are 0."""
    felt = {
        "compliance" if p.name in SKELETON else coefficient(p.name) or p.name for p in model.free
    }
    softening = {} if d_contact.softening is None else d_contact.softening._asdict()
    every = {"compliance": d_compliance, "onset": d_contact.onset}
    every |= d_contact.law.coefficients() | softening
    return {name: change for name, change in every.items() if name in felt}


def _without_contact(local: _Local, d_local: _Local, D):
    """The force without contact, and its derivatives."""
    offset, d_offset = local.force_offset, d_local.force_offset[:, None]
    if local.force_slope is None or d_local.force_slope is None:
        return offset, d_offset
    return offset + local.force_slope * D, d_offset + d_local.force_slope[:, None] * D[None]


def _of_trial_with_jacobian(model: FitModel, tube, free, skeleton, by_beam, trial: Lane):
    """Whitened residual of one trial, (m,), and its Jacobian by the free columns, (Jf, m)."""
    motion = Motion(trial.s_c, trial.displacement, blend=trial.blend, time=trial.time)
    pressed = _press(model, tube, free, trial.value, skeleton, by_beam, motion)
    if trial.time is not None and not _apart(model):
        pressed = relaxed_press(model, free, trial.value, trial.time, pressed)
    joints, d_joints = None, None
    if skeleton.joints is not None and pressed.d_joints is not None:
        joints = _times(pressed.load, skeleton.joints)
        d_joints = jax.vmap(_times, (0, None))(pressed.d_load, skeleton.joints)
        d_joints = d_joints + jax.vmap(_times, (None, 0))(pressed.load, pressed.d_joints)
    value = _whitened(pressed.force + pressed.offset, joints, trial)

    def row(force, joints):
        return _masked(force, joints, trial)

    bend = None
    if pressed.corner is not None and joints is None:
        bend = _masked(pressed.corner, None, trial)
    jacobian = jax.vmap(row)(pressed.d_force + pressed.d_offset, d_joints)
    return value, jacobian, bend


def force_jacobian(
    model: FitModel,
    free: Float[Array, " Jf"],
    value: Float[Array, " J"],
    motion: Motion,
    names: tuple[str, ...] = (),
) -> Float[Array, "Jf m"]:
    """Derivative of the force at the load cell by the free columns, of a press without data.

    Shape (Jf, N); where the motion has an angle, after it those of `names`.

    Args:
        free: free parameters, scaled coordinates.
        value: all parameters in their units, used where they are not free.
        motion: of the tool; its onset is that of the parameters.
        names: numbers of a `Response` that are observed beside the force.
    """
    tube = _tube(model, None, free.dtype)
    if model.level.forward:
        names = () if motion.phi_c is None else names
        return forward_residual.force_jacobian(model, free, value, motion, tube, names)
    places = _Places(motion.s_c[None], value[None], marked=False)
    of_lane = _skeleton_and_derivative(model, free[None], places, tube)
    skeleton, by_beam = jax.tree.map(lambda v: v[0], of_lane)
    pressed = _press(model, tube, free, value, skeleton, by_beam, motion)
    if model.relaxes:
        assert motion.time is not None
        pressed = relaxed_press(model, free, value, motion.time, pressed)
    return pressed.d_force + pressed.d_offset
