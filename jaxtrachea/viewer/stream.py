"""Recorded presses of one specimen, identified sample by sample in one thread."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from jaxtrachea.viewer.worker import Worker


class Experiment(NamedTuple):
    """Presses that are taken sample by sample.

    Attributes:
        online: a `jaxtrachea.Online` that has taken no sample.
        curves: `Curve`, one a press, in the order of the record.
        units: of the unknowns.
    """

    online: Any
    curves: Sequence[Any]
    units: Mapping[str, str]


class Stream(Worker):
    """An experiment that is played, paused, and taken step by step.

    Attributes:
        playing: samples are taken by themselves.
        speed: samples a second.
        proposed: the next press is the one nearest to the proposed place, not the next of the file.
        experiment: once it is read.
        states: an `OnlineState` a sample.
        presses: number of samples before each press, and its curve.
        left: curves that are still to be pressed.
        done: all are taken, and the estimate has settled.
    """

    def __init__(self, name: str, make: Callable[[Callable[[str], None]], Experiment]):
        """Nothing is read yet.

        Args:
            name: of what is read.
            make: called by the thread; it says by its argument that it begins to compile.
        """
        super().__init__(name)
        self.make = make
        self.playing, self.speed, self.proposed, self.done = False, 10.0, False, False
        self.experiment: Experiment | None = None
        self.states: list[Any] = []
        self.presses: list[tuple[int, Any]] = []
        self.left: list[Any] = []
        self._taken = self._steps = 0

    def prepare(self) -> Experiment:
        """Read and compile."""
        self.experiment = self.make(lambda text: self.tell("compiling", text))
        self.left = list(self.experiment.curves)
        return self.experiment

    def play(self, playing: bool) -> None:
        """Go on by itself, or pause."""
        with self._wake:
            self.playing = playing
            self._wake.notify()

    def step(self) -> None:
        """Take one sample."""
        with self._wake:
            self._steps += 1
            self._wake.notify()

    def pace(self, speed: float) -> None:
        """Go on with so many samples a second."""
        with self._wake:
            self.speed = speed
            self._wake.notify()

    def choose(self, proposed: bool) -> None:
        """Take the next press where it is proposed, or as the file has them."""
        self.proposed = proposed

    def answer(self, made: Experiment) -> bool:
        """Take a sample when it is due; the last one settles the estimate."""
        with self._wake:
            self._wake.wait_for(lambda: self.playing or self._steps or self._ended)
            if not self._steps and not self._ended:
                self._wake.wait(1 / self.speed)  # a button ends it
            if self._ended:
                return False
            if not self._steps and not self.playing:
                return True
            self._steps = max(self._steps - 1, 0)
        self.take(made.online)
        if self.left or self._taken < len(self.presses[-1][1].force):
            return True
        settled = made.online.settle()
        self.playing, self.done = False, True
        self.states.append(settled)  # last: pages draw where there is a new state
        return False

    def take(self, online: Any) -> None:
        """One sample, of the next press where the present one has ended."""
        if not self.presses or self._taken == len(self.presses[-1][1].force):
            curve = self.left[0]
            if self.proposed:
                place = online.state.next_point
                curve = min(self.left, key=lambda c: abs(c.s_c - place))
            self.left = [c for c in self.left if c is not curve]
            online.press(curve.s_c)
            self.presses.append((len(self.states), curve))
            self._taken = 0
        curve = self.presses[-1][1]
        try:
            online.add(curve.displacement[self._taken], curve.force[self._taken])
            self._taken += 1
            self.states.append(online.state)
        except ValueError as error:
            self.fault = f"{curve.trial}: {error}; the rest of this press is left out"
            self._taken = len(curve.force)
