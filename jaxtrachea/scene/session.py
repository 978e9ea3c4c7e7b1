"""A scene step by step: one position of the tool in, forces and surface out, without a pause.

For loops in real time (haptics, a simulator's frame). Everything is compiled when the session is
made; a step compiles nothing. State and result go in and out as one array each (`one_row`).
"""

import dataclasses
import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from jaxtrachea._numerics import full_precision
from jaxtrachea._packed import Packing
from jaxtrachea.contact.pose import check_rotations, is_rotation
from jaxtrachea.contact.shapes import Shape
from jaxtrachea.mechanics.admission import check_alike
from jaxtrachea.mechanics.levels.choose import AnyMaterial
from jaxtrachea.scene.anchor import (
    Anchor,
    Instant,
    anchor_at,
    as_approach,
    first_contact,
    follow,
    has_left,
    place_of,
    press_vector,
    re_anchor,
    yielded,
)
from jaxtrachea.scene.approach import approach
from jaxtrachea.scene.assemble import with_tool
from jaxtrachea.scene.held_force import HeldForce, held_force, next_force, no_force
from jaxtrachea.scene.lumen import Side, next_side, whereabouts
from jaxtrachea.scene.one_row import OneRow
from jaxtrachea.scene.simulation import Simulation, pressed
from jaxtrachea.scene.stage import Poses, Scene, check_kind, check_material, touch_tube
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.material import Material

#: Borders of the histogram of latencies, s: four a decade from 10 us to 1 s.
EDGES = np.logspace(-5, 0, 21)


class State(NamedTuple):
    """What the next step must know.

    Attributes:
        started: there was a step.
        touching: the tool is on its anchor.
        side: a `lumen.Side`.
        last: the step before.
        anchor: the place that the tool holds.
    """

    started: Bool[Array, ""]
    touching: Bool[Array, ""]
    side: Int[Array, ""]
    last: Instant
    anchor: Anchor


class Latency(NamedTuple):
    """How long steps took, from call to finished result, s.

    Attributes:
        steps: that count.
        median: -
        p99: 99th percentile.
        worst: -
        edges: borders of the histogram; (bins + 1,).
        counts: steps in each bin; faster and slower ones are in the first and last; (bins,).
    """

    steps: int
    median: float
    p99: float
    worst: float
    edges: Float[np.ndarray, " borders"]
    counts: np.ndarray


class Changeable(NamedTuple):
    """What may change from step to step: an argument of the program, not a constant in it.

    Attributes:
        material: -
        tool: its shape about its own origin.
        footprint: of the scene, which goes with the tool.
    """

    material: Material
    tool: Shape
    footprint: Float[Array, ""]


def check_scene(scene: Scene, material: AnyMaterial) -> None:
    """Refuse what a `Session` cannot take.

    Raises:
        ValueError: see `Session`.
    """
    if not scene.plan.contact or scene.tool is None:
        raise ValueError("the plan has no contact; make the scene with a path of Poses")
    if not scene.plan.mechanics.stepwise:
        raise ValueError(
            "a session has no skeleton 'sections'; use simulate, or make the scene with the "
            "Material of a line of joints"
        )
    if scene.plan.friction:
        raise ValueError(
            "the plan has friction, which depends on the whole path; use simulate, or make the "
            "scene with EffectOptions(friction='off')"
        )
    check_kind(scene, material)
    check_material(scene.geometry, material)


class Session:
    """A scene and its material, compiled for one pose at a time.

    With `contact_point` fixed the tool stays on the place it touched first, as in `simulate`,
    until that anchor gives way (`scene.anchor`): led along the surface by more than its depth the
    tool slides, after a jump it grasps anew, and it lets go where it leaves the undeformed tube
    (`simulate` keeps the first place of its whole path; a bonded tool never lets go). Force is
    continuous in the pose. A pose that is not finite is a row of NaN with NON_FINITE and changes
    nothing else.

    Material and tool are arguments of the program: `set_material` and `set_tool` compile nothing.

    A step gives up the arrays for rings and vertices of the step before: copy what must last longer
    (`np.array(result.vertices)`). On the CPU 7 to 9 us of a step go away with
    `jax.config.update("jax_cpu_enable_async_dispatch", False)` before the first use of JAX.

    Attributes:
        scene: with the tool as it is now.
        material: as it is now.
        dtype: of poses.
    """

    def __init__(self, scene: Scene, material: AnyMaterial, *, keep: int = 10_000):
        """Compile.

        Args:
            scene: from `make_scene` with a path of `Poses`.
            material: as the plan needs it.
            keep: latencies of so many last steps are kept.

        Raises:
            ValueError: a scene without contact, with deforming cross-sections, or with friction,
                which depends on the whole path; a material that does not fit the tube.
        """
        if keep < 1:
            raise ValueError(f"keep is {keep}; expected at least 1")
        check_scene(scene, material)
        assert scene.tool is not None
        self.scene, self.material = scene, material
        self.dtype = np.dtype(scene.footprint.dtype)
        given = Changeable(material, scene.tool, scene.footprint)
        self._given = Packing(given, weak=self.dtype)
        self._numbers = jax.device_put(self._given.fill(given))
        self._compile()
        self._seconds, self._steps = np.zeros(keep), 0
        self._last_force = no_force(self.dtype)

    def _compile(self) -> None:
        """The program of a step, and its first state."""
        scene, given = self.scene, self._given
        pose = np.eye(3, dtype=self.dtype), np.zeros(3, self.dtype)
        self._start = np.asarray(_packed_start(scene, *pose))
        states = Packing(jax.eval_shape(_start, scene, *pose))

        def setting(rotation, translation, numbers):
            new = given.unpack(numbers)
            return dataclasses.replace(scene, tool=new.tool, footprint=new.footprint), new.material

        def step(state, *args):
            state, *result = _step(*setting(*args), states.unpack(state), *args[:2])
            return states.pack(state), *result

        self._program = OneRow(scene, setting, step, self._start, *pose, self._numbers)

    def step(self, rotation: ArrayLike, translation: ArrayLike) -> Simulation:
        """Move the tool.

        Args:
            rotation: of the tool, orthogonal with determinant 1; shape (3, 3).
            translation: of its origin, mm; shape (3,).

        Returns:
            Fields as those of `simulate`, without the axis of rows, finished: numpy arrays, which
            last; but what there is for every ring or vertex (`joints`, `loads`, `end_U`, `end_V`,
            `vertices`) lies on the device until the next step.

        Raises:
            ValueError: another shape, or a matrix that is no rotation; the state stays as it was.
        """
        begin = time.perf_counter()
        turn, place = np.asarray(rotation, self.dtype), np.asarray(translation, self.dtype)
        if turn.shape != (3, 3) or place.shape != (3,):
            raise ValueError(
                f"rotation {turn.shape}, translation {place.shape}; expected (3, 3) and (3,)"
            )
        if not is_rotation(turn):
            check_rotations("rotation", turn[None])
        # Two arrays: to make one of them takes longer than it saves.
        result = self._program(turn, place, self._numbers)
        self._last_force = next_force(self._last_force, result)
        self._seconds[self._steps % len(self._seconds)] = time.perf_counter() - begin
        self._steps += 1
        return result

    @property
    def force_or_last(self) -> HeldForce:
        """Contact force to send to a device: finite, of the last step that had one.

        N, on the tube, in the frame of the poses, with the status of the last step and the steps
        for which the force has been held; zeros before the first force, and after `reset` and
        `set_tool`. It is held without limit: let it decay where `held` grows.
        """
        return held_force(self._last_force)

    def set_material(self, material: Material) -> None:
        """Go on with other values of the material; nothing is compiled.

        The tool stays on its anchor (`reset` lets it begin anew). A single number may stand where
        the session was made with an array: it holds for every span or ring.

        Args:
            material: the values that the session was made with, no more and no less.

        Raises:
            ValueError: a value that is missing or was not there before, of another shape or dtype,
                or that no scene reads.
        """
        if not isinstance(material, Material):
            raise ValueError(f"material is {type(material).__name__}; expected a Material")
        check_material(self.scene.geometry, material)
        check_alike(material, self._given.like.material, "make a new Session")
        self._change(self.scene, material)

    def set_tool(self, tool: Shape) -> None:
        """Go on with a tool of another size; nothing is compiled.

        It has as many corners as the first, and is not so much larger that it would need a program
        of its own: make the session with the largest tool. A smaller one is as in a session of its
        own but for the smoothing of the contact, which may take one more patch into account. What
        the old tool held is forgotten, as by `reset`; latencies are kept.

        Args:
            tool: about its own origin, mm.

        Raises:
            ValueError: another number of corners or another dtype, or a size that the program does
                not reach (or no tool has).
        """
        self._change(with_tool(self.scene, tool), self.material)
        self._program.state = jnp.array(self._start)
        self._last_force = no_force(self.dtype)

    def _change(self, scene: Scene, material: Material) -> None:
        assert scene.tool is not None
        given = Changeable(material, scene.tool, scene.footprint)
        self._numbers = jax.device_put(self._given.fill(given))
        self.scene, self.material = scene, material

    def reset(self) -> None:
        """Forget where the tool was, the force that was held, and all latencies."""
        self._program.state, self._steps = jnp.array(self._start), 0
        self._last_force = no_force(self.dtype)

    def latency(self, edges: Float[np.ndarray, " borders"] = EDGES) -> Latency:
        """Of the steps kept.

        Raises:
            ValueError: there was no step.
        """
        if not self._steps:
            raise ValueError("no step yet")
        taken = self._seconds[: self._steps]
        counts = np.histogram(np.clip(taken, edges[0], edges[-1]), edges)[0]
        median, p99 = np.quantile(taken, (0.5, 0.99))
        return Latency(
            steps=len(taken), median=float(median), p99=float(p99), worst=float(taken.max()),
            edges=edges, counts=counts,
        )  # fmt: skip


def _start(scene: Scene, rotation, translation) -> State:
    """Before the first step; where the tool was is not read."""
    path = Poses(rotation[None], translation[None])
    seen = jax.tree.map(
        lambda v: jnp.zeros(v.shape, v.dtype), jax.eval_shape(touch_tube, scene, path)
    )
    no, nowhere = jnp.asarray(False), Instant(path, seen)
    side = jnp.asarray(Side.UNTOLD)
    return State(started=no, touching=no, side=side, last=nowhere, anchor=anchor_at(scene, nowhere))


@full_precision
def _step(scene: Scene, material: Material, state: State, rotation, translation):
    """The next state, the result without its axis of rows, and what the surface follows from."""
    path = Poses(rotation[None], translation[None])
    each = approach(scene, path) if scene.plan.contact_point == "per_step" else None
    here = Instant(path, touch_tube(scene, path) if each is None else each.seen)
    at = jax.tree.map(lambda v: v[0], whereabouts(scene, *here))
    side = next_side(state.side, at)
    inside = (side == Side.IN_LUMEN)[None]
    if each is None:
        after, path, each, place = _holding(scene, material, state, here, inside)
    else:
        after, each, place = state, each._replace(inside=inside), None
    result, press = pressed(scene, material, path, each, place)
    after = after._replace(side=side)
    result = jax.tree.map(lambda v: v[0], result)
    wrong = jnp.asarray(PressStatus.NON_FINITE, result.status.dtype)
    result = result._replace(status=jnp.where(at.known, result.status, wrong))
    return _pick(at.known, after, state), result, (path, press)


def _holding(scene: Scene, material: Material, state: State, here: Instant, inside):
    """The next state but for the side; pose and way of a tool that holds its place; the place."""
    depth = -here.seen.gap[0]
    hit = (depth > 0) & ~inside[0]
    last = _pick(state.started, state.last, here)
    first = _pick(hit, first_contact(scene, last, here), anchor_at(scene, here))
    if scene.plan.options.contact == "bonded":
        anchor = _pick(state.touching, state.anchor, first)
        touching = hit | state.touching
        place, way = place_of(scene, material, anchor), press_vector(scene, anchor, here.path)
        way = jnp.where(touching, way, 0)
    else:
        held = state.touching & hit
        away = held & has_left(scene, state.anchor, last, here)
        anchor = _pick(held, follow(scene, state.anchor, here), first)
        anchor, touching = _pick(away, anchor_at(scene, here), anchor), hit
        place, way = place_of(scene, material, anchor), press_vector(scene, anchor, here.path)
        way = jnp.where(hit, yielded(scene, way, jnp.where(hit, depth, 1), place), way)
        anchor = re_anchor(scene, anchor, way, here.path)
    rest, made = as_approach(scene, anchor, way, here, inside)
    started = jnp.asarray(True)
    after = State(started=started, touching=touching, side=state.side, last=here, anchor=anchor)
    return after, rest, made, place


def _pick(when, a, b):
    return jax.tree.map(lambda v, w: jnp.where(when, v, w), a, b)


@jax.jit
def _packed_start(scene: Scene, rotation, translation) -> Float[Array, " numbers"]:
    start = _start(scene, rotation, translation)
    return Packing(start).pack(start)
