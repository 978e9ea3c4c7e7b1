"""One `Session` in one thread: poses and values in, frames out, the latest of each wins.

What is slow to import is imported by the thread: the page is up before.
"""

import dataclasses
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from jaxtrachea.viewer.frame import Frame
from jaxtrachea.viewer.worker import Worker

#: Steps that the curve keeps, and bytes of frames that a recording keeps.
MOST_STEPS, MOST_BYTES = 20_000, 2**28
#: Time after which a force that relaxes is computed anew under a hand that rests, s, and the change
#: (N, mm) from which on it is shown.
REST, SEEN = 0.05, (1e-5, 1e-3)


class Live(Worker):
    """A scene under a hand.

    The thread reads and compiles, then answers poses and values one after the other. A pose of a
    tool that another one follows before its turn is left out, so the picture never lags behind the
    hand.

    Attributes:
        path: of the scene file.
        handled: the scene, once it is read.
        sliders: of its parameters, likewise.
        packet: the scene as bytes, likewise.
        frame: the last one; None: none yet.
        steps: the last steps, without their vertices.
        recording: frames that are kept; None: nothing is recorded.
        in_hand: the tool that was moved last.
    """

    def __init__(self, path: Path, set_up: Callable[[], None] = lambda: None):
        """Nothing is read yet.

        Args:
            set_up: called by the thread before it reads.
        """
        super().__init__(path.name)
        self.path, self.set_up = path, set_up
        self.handled: Any = None
        self.sliders: list[Any] = []
        self.packet = b""
        self.frame: Frame | None = None
        self.steps: list[Frame] = []
        self.recording: list[Frame] | None = None
        self.in_hand = 0
        self._values: dict[str, float] = {}
        self._poses = np.zeros((0, 12))
        self._fresh = self._reset = False
        self._began = self._before = 0.0

    def move(self, pose: np.ndarray, tool: int = 0) -> None:
        """Move a tool: rotation by rows, then translation, mm; shape (12,)."""
        with self._wake:
            self._poses[tool], self._fresh, self.in_hand = pose, True, tool
            self._wake.notify()

    def set_value(self, name: str, value: float) -> None:
        """Go on with another value of a parameter, in its unit; nothing is compiled."""
        with self._wake:
            self._values[name], self._fresh = value, True
            self._wake.notify()

    def reset(self) -> None:
        """Forget where the tools were, put them to the start, and take the values of the file."""
        with self._wake:
            self._reset = self._fresh = True
            self._values = {s.name: s.value for s in self.sliders}
            self._poses = self.handled.poses.copy()
            self._wake.notify()

    @property
    def tools(self) -> int:
        """How many there are, once the scene is read."""
        return len(self._poses)

    @property
    def values(self) -> dict[str, float]:
        """Of all sliders, as they are now."""
        return {s.name: s.value for s in self.sliders} | self._values

    def prepare(self) -> Any:
        """The session."""
        self.set_up()
        from jaxtrachea.viewer.protocol import tools_packet, tube_arrays, tube_of
        from jaxtrachea.viewer.scene import read_handled
        from jaxtrachea.viewer.values import sliders

        handled = read_handled(self.path, lambda text: self.tell("reading", text))
        self.handled = handled
        scene, self._poses = handled.staged.scene, handled.poses.copy()
        self.packet = tools_packet(
            handled.title, handled.names, handled.tools, handled.poses, tube_arrays(*tube_of(scene))
        )
        self.tell("compiling", "compiling the scene: up to a minute the first time, seconds later")
        session = handled.session()
        self.sliders = sliders(_long_run(session.material), scene.plan)
        # The first step also loads what runs at the first step only.
        self.frame = self._step(session, handled.poses)
        session.reset()
        self._fresh, self._began = True, time.monotonic()
        return session

    def answer(self, session: Any) -> bool:
        """One step; whether to go on."""
        rest = REST if session.scene.plan.has("relaxation") else None
        with self._wake:
            moved = self._wake.wait_for(lambda: self._fresh or self._ended, rest)
            if self._ended:
                return False
            poses, values, reset = self._poses.copy(), dict(self._values), self._reset
            self._fresh = self._reset = False
        try:
            if reset:
                session.reset()
            self._set(session, values)
            frame = self._step(session, poses)
        except Exception as error:  # the page says it; the next pose may do
            traceback.print_exc()
            self.fault = f"{type(error).__name__}: {error}"
            self.changed()
            return True
        if not moved and self.frame is not None and _alike(frame, self.frame):
            return True
        self.frame, self.fault = frame, ""
        self.steps.append(frame.light)
        del self.steps[:-MOST_STEPS]
        self._record(frame)
        self.changed()
        return True

    def _set(self, session: Any, values: dict[str, float]) -> None:
        """Other values of the material, where they are others."""
        import jax

        whole, now = session.material, _long_run(session.material)
        new = {
            name: jax.device_put(np.asarray(value, getattr(now, name).dtype))
            for name, value in values.items()
            if float(getattr(now, name)) != value
        }
        if new:
            changed = dataclasses.replace(now, **new)
            if now is not whole:
                changed = dataclasses.replace(whole, material=changed)
            session.set_material(changed)

    def _step(self, session: Any, poses: np.ndarray) -> Frame:
        from jaxtrachea.viewer.protocol import frame_of

        begin = time.monotonic()
        dt, self._before = begin - (self._before or begin), begin
        turned = [(pose[:9].reshape(3, 3), pose[9:]) for pose in poses]
        if names := session.scene.names:
            result = session.step(dict(zip(names, turned, strict=True)), dt=np.float64(dt))
        else:
            result = session.step(*turned[0], np.float64(dt))
        frame = frame_of(self.handled.tools, poses, result, time.monotonic() - begin)
        return frame._replace(time=begin - self._began)

    def _record(self, frame: Frame) -> None:
        if self.recording is None:
            return
        self.recording.append(frame)
        size = 0 if frame.vertices is None else frame.vertices.nbytes
        if size * len(self.recording) > MOST_BYTES:
            self.fault = "the recording is full: the first half of its frames is thinned out"
            self.recording[:] = self.recording[::2]


def _long_run(material: Any) -> Any:
    """The values in the long run, of a material that relaxes as of any other."""
    return getattr(material, "material", material)


def _alike(a: Frame, b: Frame) -> bool:
    """Whether nobody sees a difference."""
    told = [[t.status for t in f.touches] for f in (a, b)]
    if told[0] != told[1] or a.vertices is None or b.vertices is None:
        return told[0] == told[1]
    force = max(abs(x.force - y.force).max() for x, y in zip(a.touches, b.touches, strict=True))
    return bool(force < SEEN[0] and abs(a.vertices - b.vertices).max() < SEEN[1])
