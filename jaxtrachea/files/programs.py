"""Programs that are kept for the next start, compiled or traced: which, and their bounds."""

import atexit
import contextlib
import json
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

#: Bytes of all programs beyond which those that were not used for longest go.
MOST_BYTES = 2**30
#: Days without use after which a program goes; jaxlib's next version compiles anew anyway.
MOST_DAYS = 90.0
#: Time between two looks at the bounds, s.
BETWEEN = 86_400.0
#: How the names of traces end (`files.traces`); those that JAX compiled end in "-cache".
TRACED = "-traced"
#: Names of programs: function and digest; and process and thread, if killed in the midst.
_NAME = re.compile(rf".*-[0-9a-f]{{64}}(-cache|{TRACED}(\.\d+(-\d+)?)?)", re.DOTALL)
#: File whose time of change is that of the last look.
LAST_LOOK = ".trimmed"
#: File with the counts of the last command that computed anything.
LAST_RUN = ".last_run.json"


class Program(NamedTuple):
    """A file with a compiled or traced program: its size, bytes, and when it was last used, s."""

    path: Path
    size: int
    used: float


class Uses(NamedTuple):
    """Programs of a command: loaded, compiled, and of these refused, though they were kept.

    Refused is what was damaged, or compiled with another processor's tuning.
    """

    loaded: int
    compiled: int
    refused: int


def count_uses(folder: Path) -> Callable[[], None]:
    """Count the programs of this process from here on; its end writes them into the folder.

    Returns:
        What writes the counts so far.
    """
    from jax import monitoring

    before = {p.path.name for p in programs(folder)}
    count = {"cache_hits": 0, "compile_requests_use_cache": 0}

    def listen(event: str, **_: object) -> None:
        name = event.rpartition("/")[2]
        if name in count:
            count[name] += 1

    def write() -> None:
        hits, asked = count.values()
        if asked:
            made = {p.path.name for p in programs(folder)} - before
            new = sum(TRACED not in name for name in made)
            uses = Uses(hits, asked - hits, max(asked - hits - new, 0))
            with contextlib.suppress(OSError):
                (folder / LAST_RUN).write_text(json.dumps(uses._asdict()))

    monitoring.register_event_listener(listen)
    return atexit.register(write)


def last_uses(folder: Path) -> Uses | None:
    """Those of the last command that computed anything; None: nothing is known."""
    with contextlib.suppress(OSError, ValueError, TypeError):
        return Uses(**json.loads((folder / LAST_RUN).read_text()))
    return None


def programs(folder: Path) -> Iterator[Program]:
    """The programs in a folder; other files are not looked at.

    Args:
        folder: may not exist.
    """
    for path in folder.glob("*-*-*"):
        if not _NAME.fullmatch(path.name) or not path.is_file():
            continue
        with contextlib.suppress(OSError):  # another process deletes it
            found = path.stat()
            # Where the file system keeps no time of access, that of writing.
            yield Program(path, found.st_size, max(found.st_atime, found.st_mtime))


def keep_bounds(folder: Path, now: float | None = None) -> int:
    """Delete programs beyond the bounds of size and age, at most once a day.

    Args:
        now: seconds since the epoch; None: those of the clock.
    """
    now = time.time() if now is None else now
    mark = folder / LAST_LOOK
    with contextlib.suppress(OSError):
        if 0 <= now - mark.stat().st_mtime < BETWEEN:
            return 0
    with contextlib.suppress(OSError):
        mark.touch()
    kept, gone = 0, 0
    for program in sorted(programs(folder), key=lambda program: -program.used):
        kept += program.size
        if kept > MOST_BYTES or now - program.used > MOST_DAYS * 86_400:
            gone += delete(program)
    return gone


def delete(program: Program) -> bool:
    """Whether the program could be deleted."""
    with contextlib.suppress(OSError):
        program.path.unlink()
        return True
    return False
