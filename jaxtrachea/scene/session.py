"""A scene step by step: one position of the tool in, forces and surface out, without a pause.

For loops in real time (haptics, a simulator's frame): the compiled loop over `scene.step`. All is
compiled when the session is made; a step compiles nothing. State and result go in and out as one
array each (`one_row`).
"""

import copy
import dataclasses
import threading
import time
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxtrachea._arguments import check_word
from jaxtrachea.contact.pose import check_rotations, is_rotation
from jaxtrachea.contact.shapes import Shape
from jaxtrachea.mechanics.levels.choose import AnyMaterial
from jaxtrachea.mechanics.levels.relaxing import RelaxingMaterial, long_run
from jaxtrachea.mechanics.validation import check_alike
from jaxtrachea.scene.assemble import with_tool
from jaxtrachea.scene.held_force import HeldForce, LastForce, held_force, next_force, no_force
from jaxtrachea.scene.one_row import OneRow
from jaxtrachea.scene.simulation import Simulation
from jaxtrachea.scene.stage import Scene, check_kind, check_material
from jaxtrachea.scene.step import (
    NO_TIME,
    Numbers,
    State,
    changeable,
    check_scene,
    check_state,
    init_state,
    origin_of,
    stands_of,
)
from jaxtrachea.scene.step_together import placed

#: For what a compiled session cannot take.
CURE = "make a new Session"
#: Borders of the histogram of latencies, s: four a decade from 10 us to 1 s.
EDGES = np.logspace(-5, 0, 21)


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
    until that anchor gives way (`scene.anchor`): led along the surface by more than its depth the
    tool slides, after a jump it grasps anew, and it lets go where it leaves the undeformed tube
    (`simulate` keeps the first place of its whole path; a bonded tool never lets go). Force is
    continuous in the pose. A pose that is not finite is a row of NaN with NON_FINITE and changes
    nothing else.

    A force that relaxes is that of the place: its history goes on while the tool holds the place,
    slides with it or has lifted off, and is forgotten where the tool grasps anew further away than
    its dent is wide (`scene.memory`). That is exact as long as the place does not move.

    Material and tool are arguments of the program: `set_material` and `set_tool` compile nothing.

    Threads may share a session: its calls come one after the other. A copy (`copy.deepcopy`)
    shares the compiled program and goes its own way; one from `pickle` compiles anew.

    On the CPU 7 to 9 us of a step go away with
    `jax.config.update("jax_cpu_enable_async_dispatch", False)` before the first use of JAX.

    Attributes:
        scene: with the tool as it is now.
        material: as it is now.
        dtype: of poses.
    """

    def __init__(
        self, scene: Scene, material: AnyMaterial, *, keep: int = 10_000, stiffness: bool = False
    ):
        """Compile.

        Args:
            scene: from `make_scene` with a path of `Poses`.
            material: as the plan needs it.
            keep: latencies of so many last steps are kept.
            stiffness: whether results have `Simulation.stiffness`, as in `step`.

        Raises:
            ValueError: a scene without contact or with deforming cross-sections; a material that
                does not fit the tube.
        """
        if keep < 1:
            raise ValueError(f"keep is {keep}; expected at least 1")
        check_scene(scene, material, stiffness=stiffness)
        self.scene, self.material, self._stiffness = scene, material, stiffness
        self.dtype = np.dtype(scene.footprint.dtype)
        self._seconds, self._steps = np.zeros(keep), 0
        self._last_force = self._no_force()
        self._stands = self._nowhere()
        self._lock = threading.Lock()
        self._compile()

    def _compile(self) -> None:
        """The program of a step, and its first state."""
        given, state = changeable(self.scene, self.material), init_state(self.scene, self.material)
        row = Numbers(self.scene, given, state, stiffness=self._stiffness)
        self._timed = self.scene.plan.has("relaxation")
        self._given, self._states = row.given, row.states
        self._kept, self._filled = given, row.given.fill(given)
        self._numbers = jax.device_put(self._filled.copy())
        self._start = row.states.fill(state)
        pose = np.eye(3, dtype=self.dtype), np.zeros(3, self.dtype)
        pose = self._nowhere() if self.scene.instruments else pose
        pose += (np.zeros((), self.dtype),) if self._timed else ()
        self._program = OneRow(self.scene, row.setting, row.step, self._start, *pose, self._numbers)

    def _known(self, turn, place, there, dt=0.0):
        """Where tools stand after a step: what was no number, or at no time, is forgotten."""
        old = self._stands
        if not 0 <= dt < np.inf:
            return old
        finite = np.isfinite(place).all(1) & np.isfinite(turn).all((1, 2))
        turn = np.where(finite[:, None, None], turn, old[0])
        return turn, np.where(finite[:, None], place, old[1]), there

    def _no_force(self) -> LastForce:
        return no_force(self.dtype, len(self.scene.instruments))

    def _nowhere(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rotations and translations of several tools, and which are there: none yet."""
        count = len(self.scene.instruments)
        turn = np.tile(np.eye(3, dtype=self.dtype), (count, 1, 1))
        return turn, np.zeros((count, 3), self.dtype), np.zeros(count, bool)

    def step(
        self,
        rotation: ArrayLike | Mapping[str, tuple[ArrayLike, ArrayLike]],
        translation: ArrayLike | None = None,
        dt: ArrayLike | None = None,
        *,
        present: Mapping[str, bool] = MappingProxyType({}),
    ) -> Simulation:
        """Move the tool, or several.

        Args:
            rotation: of the tool, orthogonal with determinant 1; shape (3, 3). Of a scene of
                several tools a mapping of names to (rotation, translation): a tool that is left
                out stays where it was; one that has had no pose yet is not there.
            translation: of its origin, mm; shape (3,).
            dt: time since the step before, s; a force that relaxes needs it, nothing else reads it.
                One that is negative or no number gives a row of NaN with BACK_IN_TIME and changes
                nothing else.
            present: of several tools: False lifts one off the wall, until it is given a pose again
                or True.

        Returns:
            Fields as those of `simulate`, without the axis of rows, finished: numpy arrays; but
            what there is for every ring or vertex (`joints`, `loads`, `end_U`, `end_V`,
            `vertices`) lies on the device.

        Raises:
            ValueError: another shape, or a matrix that is no rotation; no dt where the force
                relaxes, or one that is not one number; a tool that the scene has not, a mapping
                where it has one tool, or one pose where it has several; the state stays as it was.
        """
        begin = time.perf_counter()
        check = self._checked_pose
        if self.scene.instruments or isinstance(rotation, Mapping) or present:
            given = rotation, translation, present
            pose = placed(self.scene.names, self._stands, *given, check)
            pose = tuple(np.array(v) for v in pose)
        else:
            pose = check(rotation, translation)
        if self._timed:
            if dt is None:
                raise ValueError(NO_TIME)
            took = np.asarray(dt)
            if took.ndim or took.dtype.kind not in "iuf":
                raise ValueError(f"dt is {dt!r}; expected one number, s, as in 0.001")
            pose += (took.astype(self.dtype),)
        return self._run(begin, pose)

    def _checked_pose(self, rotation, translation, of: str = "") -> tuple[np.ndarray, np.ndarray]:
        """A pose as arrays; `of`: what it is of, as in errors.

        Raises:
            ValueError: see `step`.
        """
        turn, place = np.asarray(rotation, self.dtype), np.asarray(translation, self.dtype)
        if turn.shape != (3, 3) or place.shape != (3,):
            raise ValueError(
                f"{of}rotation {turn.shape}, translation {place.shape}; expected (3, 3) and (3,)"
            )
        if not is_rotation(turn):
            check_rotations(f"{of}rotation", turn[None])
        return turn, place

    def _run(self, begin: float, pose: tuple) -> Simulation:
        """A step of the program."""
        with self._lock:
            # Two arrays: to make one of them takes longer than it saves.
            result = self._program(*pose, self._numbers)
            if self.scene.instruments:
                self._stands = self._known(*pose)
            self._last_force = next_force(self._last_force, result)
            self._seconds[self._steps % len(self._seconds)] = time.perf_counter() - begin
            self._steps += 1
        return result

    @property
    def state(self) -> State:
        """What the next step begins with: to save, restore or branch, or to `step` on from.

        A state that is given back goes on to the bit as it did. The force that was held is not in
        it: `force_or_last` is zeros until the next step. One of another scene, tool or version is
        refused, and the session stays as it was.
        """
        with self._lock:
            numbers, scene = np.array(self._program.state), self.scene
        state = jax.device_put(self._states.views(numbers))  # a copy; nothing is compiled
        return dataclasses.replace(state, origin=origin_of(scene))

    @state.setter
    def state(self, state: State) -> None:
        check_state(self.scene, state)
        own = dataclasses.replace(state, origin=self._states.like.origin)
        with self._lock:
            self._program.state = jnp.array(self._states.fill(own))
            self._last_force = self._no_force()
            if state.present is not None:
                self._stands = tuple(np.array(v) for v in stands_of(state))

    def __deepcopy__(self, memo: dict) -> "Session":
        """One that goes on from the same state by the same program."""
        new = object.__new__(Session)
        with self._lock:
            vars(new).update(vars(self))
            new._filled = self._filled.copy()
            new._program, new._lock = copy.copy(self._program), threading.Lock()
            new._seconds = self._seconds.copy()
        return new

    def __copy__(self) -> "Session":
        """As `copy.deepcopy`: two sessions never share a state."""
        return self.__deepcopy__({})

    def __getstate__(self) -> dict[str, Any]:
        """All but the program, which is compiled anew."""
        names = "scene", "material", "dtype", "_stiffness", "_seconds", "_steps", "_last_force"
        names += ("_stands",)
        with self._lock:
            kept = {name: getattr(self, name) for name in names}
            return kept | {"numbers": np.array(self._program.state)}

    def __setstate__(self, kept: dict[str, Any]) -> None:
        """Compile, and go on from there."""
        numbers = kept.pop("numbers")
        vars(self).update(kept)
        self._lock = threading.Lock()
        self._compile()
        self._program.state = jnp.array(numbers)

    @property
    def force_or_last(self) -> HeldForce:
        """Contact force to send to a device: finite, of the last step that had one.

        N, on the tube, in the frame of the poses, with the status of the last step and the steps
        for which the force has been held; zeros before the first force, and after `reset` and
        `set_tool`. It is held without limit: let it decay where `held` grows.
        """
        return held_force(self._last_force)

    def set_material(self, material: AnyMaterial) -> None:
        """Go on with other values of the material; nothing is compiled.

        The tool stays on its anchor (`reset` lets it begin anew). A single number may stand where
        the session was made with an array: it holds for every span or ring.

        Args:
            material: the values that the session was made with, no more and no less.

        Raises:
            ValueError: a value that is missing or was not there before, of another shape or dtype,
                or that no scene reads.
        """
        check_word("material", material, AnyMaterial)
        check_kind(self.scene, material)
        if not _same_kind(material, self.material):
            check_material(self.scene.geometry, material)
            _check_branches(material, self.material)
            check_alike(long_run(material), long_run(self._given.like.material), CURE)
        with self._lock:
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
        if self.scene.instruments:
            raise ValueError("a session of several tools keeps its tools; make a new Session")
        scene = with_tool(self.scene, tool)
        with self._lock:
            self._change(scene, self.material)
            self._begin_anew()

    def _change(self, scene: Scene, material: AnyMaterial) -> None:
        given = changeable(scene, material)
        self._given.refill(self._filled, self._kept, given)
        self._numbers = jax.device_put(self._filled.copy())
        self._kept = given
        self.scene, self.material = scene, material

    def _begin_anew(self) -> None:
        self._program.state = jnp.array(self._start)
        self._last_force, self._stands = self._no_force(), self._nowhere()

    def reset(self) -> None:
        """Forget where the tool was, the force that was held, and all latencies."""
        with self._lock:
            self._steps = 0
            self._begin_anew()

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


def _check_branches(new: AnyMaterial, old: AnyMaterial) -> None:
    """Refuse another number of branches.

    Raises:
        ValueError: what was expected.
    """
    if type(new) is not type(old):
        raise ValueError(f"material is {type(new).__name__}; expected {type(old).__name__}: {CURE}")
    if isinstance(new, RelaxingMaterial) and isinstance(old, RelaxingMaterial):
        found, expected = (jax.tree.map(jnp.shape, m.relaxation) for m in (new, old))
        if found != expected:
            raise ValueError(f"relaxation has shapes {found}; expected {expected}: {CURE}")


def _same_kind(new: AnyMaterial, old: AnyMaterial) -> bool:
    """Whether no value of one has another shape or dtype than in the other, which was checked."""
    was = vars(old)
    return all(
        v is was[name] or (isinstance(v, jax.Array) and isinstance(was[name], jax.Array)
                           and v.shape == was[name].shape and v.dtype == was[name].dtype)
        for name, v in vars(new).items()
    )  # fmt: skip
