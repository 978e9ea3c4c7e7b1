"""Several processes at one run: how they find each other, and how they notice that one is lost.

They meet through `jax.distributed`, which knows clusters (Slurm, Open MPI, Kubernetes, TPU). After
that they share nothing but the output folder, where each keeps a small file up to date: the death
of one, the first included, is seen by all others, and stops none of them before they have said so.
"""

import contextlib
import json
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from jaxtrachea.runs.meet import place

#: What a process says of itself: at work, through with its shards, stopped early.
WORKING, DONE, FAILED = "working", "done", "failed"
#: Seconds to meet, and between two looks at the others.
MEETING, LOOK = 300, 0.2


class Lost(Exception):
    """Another process is gone, or there is no meeting it."""


@dataclass(frozen=True)
class Meeting:
    """Who takes part.

    Attributes:
        process: number of this process; 0 opens the folder and writes the results.
        processes: how many there are.
        session: name of this meeting.
        heartbeat_timeout: seconds of silence after which a process counts as lost.
        devices: JAX's settings that leave this process the devices meant for it.
    """

    process: int = 0
    processes: int = 1
    session: str = ""
    heartbeat_timeout: float = 100.0
    devices: dict[str, str] = field(default_factory=dict)


def meet(
    coordinator: str | None, processes: int | None, process: int | None, heartbeat_timeout: float
) -> Meeting:
    """Wait for the other processes.

    Args:
        coordinator: HOST:PORT of process 0; None: as the cluster says, like the next two.
        processes: how many.
        process: number of this one.
        heartbeat_timeout: see `Meeting`.

    Raises:
        Lost: no cluster was found, or the others did not come.
    """
    found = place(coordinator, processes, process, MEETING)
    if "error" in found:
        raise Lost(found["error"])
    return Meeting(heartbeat_timeout=heartbeat_timeout, **found)


@dataclass
class Watch:
    """This process's file, kept up to date, and a look at those of the others.

    Attributes:
        folder: where the files lie.
        meeting: who takes part.
    """

    folder: Path
    meeting: Meeting
    _beats: int = 0
    _said: str = WORKING
    _content: dict = field(default_factory=dict)
    _seen: dict[int, tuple[str, float]] = field(default_factory=dict)
    _others: dict[int, str] = field(default_factory=dict)
    _lost: list[str] = field(default_factory=list)
    _end: threading.Event = field(default_factory=threading.Event)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    @contextlib.contextmanager
    def watching(self, **content) -> Iterator["Watch"]:
        """Say that this process works, until the block ends; how it ended is said as well.

        Args:
            content: what the others should know, JSON.
        """
        self._content = content
        self._say(WORKING)
        thread = threading.Thread(target=self._heartbeat, daemon=True)
        thread.start()
        try:
            yield self
            if self._said == WORKING:
                self._say(DONE)
        except BaseException:
            with contextlib.suppress(OSError):
                self._say(FAILED)
            raise
        finally:
            self._end.set()
            thread.join()

    def check(self) -> None:
        """Raise if a process was lost.

        Raises:
            Lost: with its number.
        """
        if self._lost:
            raise Lost(self._lost[0])

    def done(self) -> None:
        """Say that this process is through with its shards."""
        self._say(DONE)

    def wait_for_others(self) -> None:
        """Return when all others are through.

        Raises:
            Lost: one of them never will be.
        """
        for k in range(self.meeting.processes):
            if k != self.meeting.process:
                self.wait_for(k)

    def wait_for(self, process: int) -> None:
        """Return when one of the others is through.

        Raises:
            Lost: it never will be.
        """
        while self._others.get(process) != DONE:
            self.check()
            time.sleep(LOOK)

    def _say(self, what: str) -> None:
        with self._lock:
            self._said = what
            self._beats += 1
            path = _file(self.folder, self.meeting, self.meeting.process)
            beside = path.with_suffix(".new")
            content = {"says": what, "beat": self._beats} | self._content
            beside.write_text(json.dumps(content), encoding="utf-8")
            beside.replace(path)

    def _heartbeat(self) -> None:
        """Show that this process is alive and look at the others, ten times in the timeout."""
        while not self._end.wait(min(2.0, self.meeting.heartbeat_timeout / 10)):
            if self._said == WORKING:
                with contextlib.suppress(OSError):
                    self._say(WORKING)
            for k in range(self.meeting.processes):
                if k != self.meeting.process and self._others.get(k) != DONE:
                    self._look_at(k)

    def _look_at(self, k: int) -> None:
        """What process k says; silence counts from the last change of its file."""
        now, timeout = time.monotonic(), self.meeting.heartbeat_timeout
        try:
            text = _file(self.folder, self.meeting, k).read_text(encoding="utf-8")
        except OSError:
            text = ""
        before, since = self._seen.setdefault(k, ("", now))
        if text != before:
            self._seen[k] = text, now
        if before and not text:  # process 0 has cleared the folder away: all is written
            self._others[k] = DONE
        elif text:
            self._others[k] = json.loads(text)["says"]
        if self._others.get(k) == FAILED:
            self._lost.append(f"process {k} stopped early; see its own message")
        elif self._others.get(k) != DONE and text == before and now - since > timeout:
            self._lost.append(f"process {k} has been silent for {timeout:g} s; it is lost")


def _file(folder: Path, meeting: Meeting, process: int) -> Path:
    return folder / f"process-{meeting.session}-{process}.json"


def opened(folder: Path, meeting: Meeting) -> dict | None:
    """What process 0 says when it has opened the run; None while it has not."""
    try:
        return json.loads(_file(folder, meeting, 0).read_text(encoding="utf-8"))
    except OSError:
        return None
