"""The thread behind a page: it prepares, then answers; the page asks where it stands."""

import threading
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

Phase = Literal["reading", "compiling", "ready", "failed"]


class State(NamedTuple):
    """Where the work stands; `text` says it to the user."""

    phase: Phase
    text: str


class Worker(ABC):
    """Work that `prepare` begins and `answer` goes on with; others set what it is to do.

    Attributes:
        changed: called by the thread when there is something new to show.
        state: where the work stands.
        fault: the last error while it is ready; empty: none.
    """

    def __init__(self, name: str):
        """Nothing is begun; `name`: of what will be read."""
        self.changed: Callable[[], None] = lambda: None
        self.state, self.fault = State("reading", f"reading {name}"), ""
        self._ended = False
        self._wake = threading.Condition()

    @abstractmethod
    def prepare(self) -> Any:
        """What `answer` works with."""

    @abstractmethod
    def answer(self, made: Any) -> bool:
        """One step, waiting for something to do; whether to go on."""

    def start(self) -> None:
        """Begin in a thread of its own."""
        threading.Thread(target=self.run, name="session", daemon=True).start()

    def run(self) -> None:
        """Prepare, and answer until `end`; what fails is told in `state`."""
        try:
            made = self.prepare()
        except (ValueError, OSError) as error:
            self.tell("failed", str(error))
            return
        except Exception as error:  # of the program: the page says it, the terminal shows where
            traceback.print_exc()
            self.tell("failed", f"{type(error).__name__}: {error}; the terminal shows where")
            return
        self.tell("ready", "ready")
        while self.answer(made):
            pass

    def end(self) -> None:
        """End the thread after its step."""
        with self._wake:
            self._ended = True
            self._wake.notify()

    def tell(self, phase: Phase, text: str) -> None:
        """Say where the work stands."""
        self.state = State(phase, text)
        self.changed()
