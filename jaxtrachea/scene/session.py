"""A scene step by step: one position of the tool in, forces and surface out, without a pause.

For loops in real time (haptics, a simulator's frame). Everything is compiled when the session is
made; a step compiles nothing and writes into the memory of the step before.
"""

import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from jaxtrachea.mechanics.sections.material import SectionMaterial
from jaxtrachea.scene.approach import approach
from jaxtrachea.scene.declare import AnyMaterial
from jaxtrachea.scene.lumen import Side, next_side, whereabouts
from jaxtrachea.scene.seat import (
    Instant,
    Seat,
    anchored,
    arrive,
    as_approach,
    drawn,
    given_way,
    grasp,
    left,
    place_of,
    way_of,
)
from jaxtrachea.scene.simulation import Simulation, follow
from jaxtrachea.scene.stage import Poses, Scene, touch_tube
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.material import Material

#: Borders of the histogram of latencies, s: four a decade from 10 us to 1 s.
EDGES = np.logspace(-5, 0, 21)


class State(NamedTuple):
    """What the next step must know.

    Attributes:
        started: there was a step.
        touching: the tool is on its seat.
        side: a `lumen.Side`.
        last: the step before.
        seat: the place that the tool holds.
    """

    started: Bool[Array, ""]
    touching: Bool[Array, ""]
    side: Int[Array, ""]
    last: Instant
    seat: Seat


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


class Session:
    """A scene and its material, compiled for one pose at a time.

    With `contact_point` fixed the tool stays on the place it touched first, as in `simulate`,
    until that seat gives way (`scene.seat`): led along the surface by more than its depth the tool
    slides, after a jump it grasps anew, and it lets go where it leaves the undeformed tube
    (`simulate` keeps the first place of its whole path; a bonded tool never lets go). Force is
    continuous in the pose. A pose that is not finite is a row of NaN with NON_FINITE and changes
    nothing else.

    A step gives up the arrays of the step before: copy what must last longer
    (`jax.tree.map(np.array, result)`). On the CPU 7 to 9 us of a step go away with
    `jax.config.update("jax_cpu_enable_async_dispatch", False)` before the first use of JAX.
    """

    def __init__(self, scene: Scene, material: AnyMaterial, *, keep: int = 10_000):
        """Compile.

        Args:
            scene: from `make_scene` with a path of `Poses`.
            material: as the plan needs it; its numbers become constants of the program.
            keep: latencies of so many last steps are kept.

        Raises:
            ValueError: a scene without contact, with deforming cross-sections, or with friction,
                which depends on the whole path.
        """
        if keep < 1:
            raise ValueError(f"keep is {keep}; expected at least 1")
        if not scene.plan.contact:
            raise ValueError("the plan has no contact; make the scene with a path of Poses")
        if isinstance(material, SectionMaterial) or scene.plan.options.deforms_sections:
            raise ValueError(
                "a session has no skeleton 'sections'; use simulate, or make the scene with the "
                "Material of a line of joints"
            )
        if scene.plan.friction:
            raise ValueError(
                "the plan has friction, which depends on the whole path; use simulate, or make the "
                "scene with EffectOptions(friction='off')"
            )
        self.scene, self.dtype = scene, np.dtype(scene.footprint.dtype)
        pose = (np.eye(3, dtype=self.dtype), np.zeros(3, self.dtype))
        start = jax.eval_shape(_start, scene, *pose)

        @jax.jit  # traced once, for the shapes of the result and for the program
        def one(packed, *pose):
            state, result = _step(scene, material, _unpack(packed, start), *pose)
            return _pack(state), result

        def run(packed, _, *pose):
            return one(packed, *pose)

        self._start = np.asarray(_packed_start(scene, *pose))
        empty = jax.eval_shape(one, self._start, *pose)[1]
        zeros = jax.tree.map(lambda v: jnp.asarray(np.zeros(v.shape, v.dtype), v.dtype), empty)
        # Donated: the new state and result are written where the old ones were.
        made = jax.jit(run, donate_argnums=(0, 1), keep_unused=True)
        self._run = made.lower(self._start, zeros, *pose).compile()
        self._state, self._result = jnp.array(self._start), zeros
        self._seconds, self._steps = np.zeros(keep), 0

    def step(self, rotation: ArrayLike, translation: ArrayLike) -> Simulation:
        """Move the tool.

        Args:
            rotation: of the tool; shape (3, 3).
            translation: of its origin, mm; shape (3,).

        Returns:
            Fields as those of `simulate`, without the axis of rows; finished, on the device.

        Raises:
            ValueError: another shape.
        """
        begin = time.perf_counter()
        pose = np.asarray(rotation, self.dtype), np.asarray(translation, self.dtype)
        if pose[0].shape != (3, 3) or pose[1].shape != (3,):
            raise ValueError(
                f"rotation {pose[0].shape}, translation {pose[1].shape}; expected (3, 3) and (3,)"
            )
        self._state, self._result = self._run(self._state, self._result, *pose)
        jax.block_until_ready(self._result)
        self._seconds[self._steps % len(self._seconds)] = time.perf_counter() - begin
        self._steps += 1
        return self._result

    def reset(self) -> None:
        """Forget where the tool was, and all latencies."""
        self._state, self._steps = jnp.array(self._start), 0

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


def _pack(state: State) -> Float[Array, " numbers"]:
    """One array instead of 30: each costs some 2 us a step. All is held exactly."""
    leaves = jax.tree.leaves(state)
    widest = max((v.dtype for v in leaves if jnp.issubdtype(v.dtype, jnp.floating)), key=_bits)
    return jnp.concatenate([jnp.ravel(v).astype(widest) for v in leaves])


def _bits(dtype) -> int:
    return jnp.finfo(dtype).bits


def _unpack(packed: Float[Array, " numbers"], like: State) -> State:
    leaves, tree = jax.tree.flatten(like)
    ends = np.cumsum([v.size for v in leaves])
    parts = jnp.split(packed, ends[:-1])
    back = (p.reshape(v.shape).astype(v.dtype) for p, v in zip(parts, leaves, strict=True))
    return jax.tree.unflatten(tree, back)


def _start(scene: Scene, rotation, translation) -> State:
    """Before the first step; where the tool was is not read."""
    path = Poses(rotation[None], translation[None])
    seen = jax.tree.map(
        lambda v: jnp.zeros(v.shape, v.dtype), jax.eval_shape(touch_tube, scene, path)
    )
    no, nowhere = jnp.asarray(False), Instant(path, seen)
    side = jnp.asarray(Side.UNTOLD)
    return State(started=no, touching=no, side=side, last=nowhere, seat=grasp(scene, nowhere))


def _step(scene: Scene, material: Material, state: State, rotation, translation):
    """The next state, and the result without its axis of rows."""
    path = Poses(rotation[None], translation[None])
    each = approach(scene, path) if scene.plan.contact_point == "per_step" else None
    here = Instant(path, touch_tube(scene, path) if each is None else each.seen)
    at = jax.tree.map(lambda v: v[0], whereabouts(scene, *here))
    side = next_side(state.side, at)
    inside = (side == Side.IN_LUMEN)[None]
    if each is None:
        after, result = _held(scene, material, state, here, inside)
    else:
        result = follow(scene, material, path, each._replace(inside=inside))
        after = state
    after = after._replace(side=side)
    result = jax.tree.map(lambda v: v[0], result)
    wrong = jnp.asarray(PressStatus.NON_FINITE, result.status.dtype)
    return _pick(at.known, after, state), result._replace(
        status=jnp.where(at.known, result.status, wrong)
    )


def _held(scene: Scene, material: Material, state: State, here: Instant, inside):
    """A step of a tool that holds its place."""
    depth = -here.seen.gap[0]
    hit = (depth > 0) & ~inside[0]
    last = _pick(state.started, state.last, here)
    first = _pick(hit, arrive(scene, last, here), grasp(scene, here))
    if scene.plan.options.contact == "bonded":
        seat = _pick(state.touching, state.seat, first)
        touching = hit | state.touching
        place, way = place_of(scene, material, seat), way_of(scene, seat, here.path)
        way = jnp.where(touching, way, 0)
    else:
        held = state.touching & hit
        away = held & left(scene, state.seat, last, here)
        seat = _pick(held, drawn(scene, state.seat, here), first)
        seat, touching = _pick(away, grasp(scene, here), seat), hit
        place, way = place_of(scene, material, seat), way_of(scene, seat, here.path)
        way = jnp.where(hit, given_way(scene, way, jnp.where(hit, depth, 1), place), way)
        seat = anchored(scene, seat, way, here.path)
    rest, made = as_approach(scene, seat, way, here, inside)
    result = follow(scene, material, rest, made, place)
    started = jnp.asarray(True)
    after = State(started=started, touching=touching, side=state.side, last=here, seat=seat)
    return after, result


def _pick(when, a, b):
    return jax.tree.map(lambda v, w: jnp.where(when, v, w), a, b)


@jax.jit
def _packed_start(scene: Scene, rotation, translation) -> Float[Array, " numbers"]:
    return _pack(_start(scene, rotation, translation))
