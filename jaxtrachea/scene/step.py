"""A scene as a function: `init_state`, and `step` by step forces and surface for a pose.

Pure: under `jit`, `vmap` (an environment each), `grad` through a whole contact history, and as the
body of `lax.scan`. `Session` is the compiled loop over it.
"""

import dataclasses
import hashlib
import weakref
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from jaxtrachea._arguments import ArrayLike, check_word, shaped
from jaxtrachea._numerics import full_precision, product
from jaxtrachea._packed import Packing
from jaxtrachea.contact.pose import check_rotations
from jaxtrachea.contact.shapes import Shape
from jaxtrachea.mechanics.levels.choose import AnyMaterial
from jaxtrachea.mechanics.levels.relaxing import long_run
from jaxtrachea.mechanics.press_history import History
from jaxtrachea.scene.anchor import Anchor, Instant, anchor_at
from jaxtrachea.scene.approach import approach
from jaxtrachea.scene.grip import Slip, pick
from jaxtrachea.scene.hold import hold
from jaxtrachea.scene.in_time import Before, resting
from jaxtrachea.scene.instruments import scene_of
from jaxtrachea.scene.lumen import Side, next_side, whereabouts
from jaxtrachea.scene.memory import Memory
from jaxtrachea.scene.one_row import Row
from jaxtrachea.scene.plan import Plan
from jaxtrachea.scene.rows import without_part
from jaxtrachea.scene.rub import no_slip
from jaxtrachea.scene.simulation import Pressed, Simulation, pressed
from jaxtrachea.scene.stage import (
    Poses,
    Scene,
    check_kind,
    check_material,
    touch_tube,
)
from jaxtrachea.scene.step_together import move_tools, placed
from jaxtrachea.status import PressStatus

#: Rises when the fields of a `State` or their meaning change.
STATE_VERSION = 5


class Origin(NamedTuple):
    """What a state belongs to.

    Attributes:
        version: of the fields of a `State`.
        plan: of its scene.
        numbers: digest of the arrays of its scene; empty where they were traced.
    """

    version: int
    plan: Plan
    numbers: str


class State(eqx.Module):
    """What the next step must know; a pytree of arrays, which can be saved, copied and batched.

    Attributes:
        started: there was a step.
        touching: the tool is on its anchor.
        side: a `lumen.Side`.
        last: the step before.
        anchor: the place that the tool holds.
        slip: way it has slid on it; None: no friction.
        memory: of a force that relaxes; else None.
        present: of several tools, all of whose arrays have an axis of tools first, which of them
            are there; else None.
        origin: the scene that the state belongs to (static).
    """

    started: Bool[Array, "*tools"]
    touching: Bool[Array, "*tools"]
    side: Int[Array, "*tools"]
    last: Instant
    anchor: Anchor
    slip: Slip | None
    memory: Memory | None
    present: Bool[Array, "*tools"] | None
    origin: Origin = eqx.field(static=True)


def init_state(scene: Scene, material: AnyMaterial) -> State:
    """The state before the first step: the tool was nowhere, and of several none is there.

    Args:
        scene: from `make_scene` with a path of `Poses`.
        material: as the plan needs it.

    Raises:
        ValueError: as `Session`.
    """
    check_scene(scene, material)
    state = _start(scene, resting(scene, material))
    return dataclasses.replace(state, origin=origin_of(scene))


def step(
    scene: Scene,
    material: AnyMaterial,
    state: State,
    rotation: ArrayLike | Mapping[str, tuple[ArrayLike, ArrayLike]],
    translation: ArrayLike | None = None,
    dt: ArrayLike | None = None,
    *,
    present: Mapping[str, ArrayLike] = MappingProxyType({}),
    stiffness: bool = False,
) -> tuple[State, Simulation]:
    """Move the tool, or several: the next state, and what happens at this pose.

    It does what `Session.step` does. A pose that is not finite is a row of NaN with NON_FINITE and
    leaves the state as it was, and so does a time that runs back, with BACK_IN_TIME. Scenes of many
    environments may differ in their arrays (`vmap` over scene, material and state; make the states
    by `vmap` of `init_state`), not in their plans.

    Args:
        scene: that the state was made for.
        material: may change from step to step.
        state: from `init_state`, or of the step before.
        rotation: of the tool, orthogonal with determinant 1 (checked where it is not traced);
            shape (3, 3). Of a scene of several tools a mapping of names to (rotation, translation),
            as in `Session.step`.
        translation: of its origin, mm; shape (3,).
        dt: time since the step before, s; a force that relaxes needs it, nothing else reads it.
        present: as in `Session.step`.
        stiffness: whether `Simulation.stiffness` is asked for (static): derivative of the force by
            the translation, the rest of this step as it is. Of an elastic force without friction
            it is symmetric, and of one that relaxes that of a motion within dt: with a dt that is
            short against the branches the instantaneous one.

    Returns:
        The next `State`, and a `Simulation` without the axis of rows.

    Raises:
        ValueError: the state of another scene or version; a pose of another shape or dtype, or no
            rotation; a material that does not fit; no dt where the force relaxes; tools that the
            scene has not, or `stiffness` of several. What is traced is checked by shape and dtype.
    """
    check_scene(scene, material, stiffness=stiffness)
    check_state(scene, state)

    def check(rotation, translation, of=""):
        return _checked_pose(scene, rotation, translation, of)

    if scene.instruments or isinstance(rotation, Mapping) or present:
        stands = () if state.present is None else stands_of(state)
        pose = placed(scene.names, stands, rotation, translation, present, check)
        pose = tuple(jnp.stack([jnp.asarray(v) for v in of_all]) for of_all in pose)
    else:
        pose = check(rotation, translation)
    if (dt := step_time(scene, dt)) is not None:
        pose += (dt,)
    given = scene, material, state, *pose
    traced = any(isinstance(v, Tracer) for v in jax.tree.leaves(given))
    return (_step if traced else _compiled)(*given, stiffness=stiffness)


def _checked_pose(scene: Scene, rotation, translation, of: str) -> tuple[Array, Array]:
    """A pose as arrays; `of`: what it is of, as in errors."""
    dtype = scene.footprint.dtype
    rotation = shaped(f"{of}rotation", rotation, (3, 3), why=" (one pose)")
    translation = shaped(f"{of}translation", translation, (3,), why=" (one pose)")
    for name, v in (("rotation", rotation), ("translation", translation)):
        if v.dtype != dtype:
            raise ValueError(f"{of}{name} is {v.dtype}; expected {dtype}, as the scene has")
    if not isinstance(rotation, Tracer):
        check_rotations(f"{of}rotation", np.asarray(rotation)[None])
    return rotation, translation


def stands_of(state: State) -> tuple[Array, Array, Array | None]:
    """Of a state of several tools: rotations, translations, and which of them are there."""
    path = state.last.path
    return path.rotation[:, 0], path.translation[:, 0], state.present


def step_time(scene: Scene, dt: ArrayLike | None) -> Array | None:
    """The time of a step in the dtype of the scene; None where nothing reads it.

    Raises:
        ValueError: none is given, and the force relaxes; or no number.
    """
    if not scene.plan.has("relaxation"):
        return None
    if dt is None:
        raise ValueError(NO_TIME)
    return shaped("dt", dt, (), dtype=scene.footprint.dtype).astype(scene.footprint.dtype)


#: Where a step is not told how long it took.
NO_TIME = "dt is None; expected the time since the step before, s: the force of this plan relaxes"


def check_scene(scene: Scene, material: AnyMaterial, *, stiffness: bool = False) -> None:
    """Refuse a scene or a material that cannot go step by step.

    Raises:
        ValueError: see `Session`.
    """
    check_word("scene", scene, Scene)
    if stiffness and scene.instruments:
        raise ValueError("stiffness is of one tool; expected stiffness=False for several")
    if not scene.plan.contact or (scene.tool is None and not scene.instruments):
        raise ValueError("the plan has no contact; make the scene with a path of Poses")
    if scene.instruments and scene.plan.tools == "one":
        raise ValueError(
            "a mapping of one tool goes through simulate alone; expected a scene that is made with "
            "its path and its tool by themselves"
        )
    if not scene.plan.mechanics.stepwise:
        raise ValueError(
            "a session has no skeleton 'sections'; use simulate, or make the scene with the "
            "Material of a line of joints"
        )
    check_kind(scene, material)
    check_material(scene.geometry, material)


def check_state(scene: Scene, state: State) -> None:
    """Refuse what is no state of this scene.

    Raises:
        ValueError: another version, plan, dtype, or other arrays; or no state.
    """
    check_word("state", state, State)
    version, plan, numbers = state.origin
    if version != STATE_VERSION:
        raise ValueError(f"state has version {version}; expected {STATE_VERSION}: begin anew")
    if plan != scene.plan:
        raise ValueError(f"state belongs to a scene of another plan: {_unlike(plan, scene.plan)}")
    dtype = scene.footprint.dtype
    found = state.anchor.point.dtype
    if found != dtype:
        raise ValueError(f"state is {found}; expected {dtype}, as the scene has")
    if numbers and digest_of(scene) not in ("", numbers):
        raise ValueError(
            "state belongs to another scene: of the same plan, but with another tube, tool or mesh;"
            " make a state by init_state"
        )


def _unlike(found: Plan, expected: Plan) -> str:
    """The first field in which two plans differ."""
    for field in dataclasses.fields(Plan):
        a, b = getattr(found, field.name), getattr(expected, field.name)
        if field.compare and a != b:
            return f"{field.name} is {a!r}; expected {b!r}"
    raise AssertionError("plans are equal")


def origin_of(scene: Scene) -> Origin:
    """What a state of this scene belongs to."""
    return Origin(STATE_VERSION, scene.plan, digest_of(scene))


#: Digests of scenes that are still there, by their `id`: a step need not read all numbers again.
_DIGESTS: dict[int, str] = {}


def digest_of(scene: Scene) -> str:
    """Of all arrays of a scene, computed once; empty if one of them is traced."""
    if (known := _DIGESTS.get(id(scene))) is not None:
        return known
    leaves = jax.tree.leaves(scene)
    if any(isinstance(v, Tracer) for v in leaves):
        return ""
    digest = _digest(leaves)
    if all(isinstance(v, jax.Array) for v in leaves):  # others may be changed in place
        _DIGESTS[id(scene)] = digest
        weakref.finalize(scene, _DIGESTS.pop, id(scene), None).atexit = False
    return digest


def _digest(leaves: list) -> str:
    made = hashlib.blake2b(digest_size=16)
    for v in map(np.asarray, leaves):
        made.update(f"{v.dtype}{v.shape}".encode())
        made.update(np.ascontiguousarray(v).tobytes())
    return made.hexdigest()


@jax.jit
def _start(scene: Scene, rest: History | None) -> State:
    """Before the first step."""
    dtype, many = scene.footprint.dtype, scene.instruments
    path = Poses(jnp.eye(3, dtype=dtype)[None], jnp.zeros((1, 3), dtype))
    shapes = jax.eval_shape(touch_tube, scene_of(scene, many[0]) if many else scene, path)
    seen = jax.tree.map(lambda v: jnp.zeros(v.shape, v.dtype), shapes)
    seen = without_part(seen) if many else seen
    no, nowhere = jnp.asarray(False), Instant(path, seen)
    state = State(
        started=no, touching=no, side=jnp.int_(Side.UNTOLD), last=nowhere,
        anchor=anchor_at(scene, nowhere), slip=no_slip(dtype) if scene.plan.friction else None,
        memory=None if rest is None else Memory(rest, jnp.zeros((), dtype), jnp.zeros((), dtype)),
        present=no if many else None, origin=origin_of(scene),
    )  # fmt: skip
    if many:
        return jax.tree.map(lambda v: jnp.broadcast_to(v, (len(many), *v.shape)), state)
    return state


class Changeable(NamedTuple):
    """What may change from step to step: an argument of the program, not a constant in it.

    Attributes:
        tool: its shape about its own origin; None: several, which stay.
        footprint: of the scene, which goes with the tool.
    """

    material: AnyMaterial
    tool: Shape | None
    footprint: Float[Array, ""]


def changeable(scene: Scene, material: AnyMaterial) -> Changeable:
    """What may change, of this scene."""
    return Changeable(material, scene.tool, scene.footprint)


class Numbers:
    """A step of numbers: what changes, and the state, are one array each (`_packed`).

    A pose is followed by the time of the step where the force relaxes, and then by what changes.

    Attributes:
        given: layout of what may change.
        states: layout of the state.
    """

    def __init__(self, scene: Scene, given: Changeable, state: State, *, stiffness: bool):
        """Lay out what changes and the state, or others of their shapes."""
        self._scene, self._stiffness = scene, stiffness
        self.given, self.states = Packing(given, weak=scene.footprint.dtype), Packing(state)

    def setting(self, *given) -> tuple[Scene, AnyMaterial]:
        """Scene and material (traced)."""
        new = self.given.unpack(given[-1])
        scene = dataclasses.replace(self._scene, tool=new.tool, footprint=new.footprint)
        return scene, new.material

    def step(self, state, *given):
        """As `move_tool` (traced)."""
        scene, material = self.setting(*given)
        move = move_with_stiffness if self._stiffness else move_tool
        move = move_tools if scene.instruments else move
        moved = move(scene, material, self.states.unpack(state), *given[:-1])
        return self.states.pack(moved[0]), *moved[1:]


def _step(scene: Scene, material: AnyMaterial, state: State, *pose, stiffness: bool = False):
    """`step`, of arguments that are checked: by the program of a `Session`.

    To the bit, if the scene is no argument of the compiled function: its arrays are constants there
    as here, and those that may change are none (hence the barrier).
    """
    given = changeable(scene, material)
    numbers = Numbers(scene, given, state, stiffness=stiffness)
    row = Row(scene, numbers.setting, numbers.step)
    packed, result = row(
        numbers.states.pack(state),
        *pose,
        jax.lax.optimization_barrier(numbers.given.pack(given)),
    )
    return numbers.states.unpack(packed), result


_compiled = jax.jit(_step, static_argnames="stiffness")


def move_with_stiffness(scene: Scene, material: Any, state: State, rotation, translation, *dt):
    """As `move_tool`, with the derivative of the force by the translation."""

    def forces(translation):
        moved = move_tool(scene, material, state, rotation, translation, *dt)
        result = moved[1]
        force = result.force
        return force if result.frame is None else product(result.frame, force), moved

    stiffness, (after, result, press) = jax.jacfwd(forces, has_aux=True)(translation)
    there = jnp.isfinite(jnp.sum(result.force))
    stiffness = jnp.where(there, stiffness, jnp.nan)
    return after, result._replace(stiffness=stiffness), press


@full_precision
def move_tool(
    scene: Scene, material: Any, state: State, rotation, translation, dt=None
) -> tuple[State, Simulation, tuple[Poses, Pressed]]:
    """The next state, the result without its axis of rows, and what the surface follows from."""
    rest, back = resting(scene, material), None
    if dt is not None:
        back = ~((dt >= 0) & jnp.isfinite(dt))
        dt, translation = jnp.where(back, 0, dt), jnp.where(back, jnp.nan, translation)
    path = Poses(rotation[None], translation[None])
    each = approach(scene, path) if scene.plan.contact_point == "per_step" else None
    here = Instant(path, touch_tube(scene, path) if each is None else each.seen)
    at = jax.tree.map(lambda v: v[0], whereabouts(scene, *here))
    side = next_side(state.side, at)
    inside = (side == Side.IN_LUMEN)[None]
    if each is None:
        # The surface follows the tool where it is, not where it stands on its place.
        after, stands, each, held = hold(scene, long_run(material), state, here, inside, rest)
        before = None if after.memory is None else Before(after.memory.press, dt=dt)
        result, press = pressed(scene, material, stands, each, held.solve, before)
        if after.memory is not None:
            memory = after.memory._replace(press=press.history)
            after, press = dataclasses.replace(after, memory=memory), press._replace(history=None)
            # A loop has microseconds: what the dashpots take is a sixth of a step.
            result = result._replace(dissipated=None)
            press = press._replace(moved=press.moved._replace(dissipated=None))
        if held.total is not None and result.slip is not None:
            total = jnp.where(jnp.isnan(result.slip), jnp.nan, held.total)
            result = result._replace(slip=total)
    else:
        after, each = state, each._replace(inside=inside)
        result, press = pressed(scene, material, path, each)
    after = dataclasses.replace(after, side=side)
    result = jax.tree.map(lambda v: v[0], result)
    wrong = jnp.asarray(PressStatus.NON_FINITE, result.status.dtype)
    result = result._replace(status=jnp.where(at.known, result.status, wrong))
    if back is not None:
        wrong = jnp.asarray(PressStatus.BACK_IN_TIME, result.status.dtype)
        result = result._replace(status=jnp.where(back, wrong, result.status))
    return pick(at.known, after, state), result, (path, press)
