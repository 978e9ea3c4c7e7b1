"""One run at a time in a folder: a lock that the kernel takes from a process that dies.

The lock lies on the open file `OUT/.jaxtrachea-lock` and not in its existence: a file that a killed
process has left behind holds nobody. What it says is only for the message to the second run.
"""

import contextlib
import errno
import json
import os
import socket
from datetime import datetime
from pathlib import Path
from typing import IO

if os.name == "nt":
    import msvcrt

    def _take(stream: IO) -> None:
        # One byte far behind the end, so that others can read the text.
        stream.seek(2**30)
        msvcrt.locking(stream.fileno(), msvcrt.LK_NBLCK, 1)  # pyright: ignore
else:
    import fcntl

    def _take(stream: IO) -> None:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)


#: Name of the file in the folder of a run.
LOCK = ".jaxtrachea-lock"
#: How often another run may remove the file under our hands.
_TRIES = 100
_TAKEN = (errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES, errno.EDEADLK)
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EINVAL)


class Busy(ValueError):
    """Another run is at work in the folder."""


class NoLocks(ValueError):
    """The file system cannot keep two runs apart."""


class Lock:
    """The lock of a folder while it is held."""

    def __init__(self, path: Path, stream: IO) -> None:
        """Keep what `take` has opened."""
        self.path = path
        self._stream: IO | None = stream

    def release(self) -> None:
        """Remove the file and give the lock back; nothing if that was done before."""
        stream, self._stream = self._stream, None
        if stream is None:
            return
        with contextlib.suppress(OSError):  # Windows removes no file that is open
            if _is_at(stream, self.path):
                self.path.unlink()
        with contextlib.suppress(OSError):
            stream.close()
        if os.name == "nt":
            with contextlib.suppress(OSError):
                self.path.unlink()


def take(folder: Path) -> Lock:
    """Take the lock of a folder that exists, or say who has it; never waits.

    Raises:
        Busy: another process, or another run of this one, holds it.
        NoLocks: the file system has no locks.
        OSError: the file cannot be opened.
    """
    path = folder / LOCK
    for _ in range(_TRIES):
        stream = _locked(path)
        # The former holder may have removed the file between our opening and our lock.
        if _is_at(stream, path):
            _sign(stream)
            return Lock(path, stream)
        stream.close()
    raise NoLocks(
        f"{folder}: its file system does not say which file is open, so that two runs there would "
        "not notice each other; choose an --out on another file system, or say --no-lock and see "
        "to it yourself"
    )


def refuse_busy(folder: Path) -> None:
    """Raise if a run is at work in a folder; creates no file.

    Raises:
        Busy: as `take`.
    """
    if (folder / LOCK).is_file():
        with contextlib.suppress(NoLocks, OSError):
            _locked(folder / LOCK).close()


def _locked(path: Path) -> IO:
    """The file, opened (made if need be) and locked."""
    stream = path.open("a+", encoding="utf-8")
    try:
        _take(stream)
    except OSError as error:
        stream.close()
        if error.errno in _TAKEN:
            raise Busy(_busy(path)) from None
        if error.errno in _NO_LOCKS:
            raise NoLocks(
                f"{path.parent}: its file system has no locks ({error.strerror}), so that two runs "
                "there would not notice each other; choose an --out on another file system, or say "
                "--no-lock and see to it yourself"
            ) from None
        raise
    return stream


def _is_at(stream: IO, path: Path) -> bool:
    """Whether a path still names the open file."""
    try:
        return os.path.samestat(os.fstat(stream.fileno()), path.stat())
    except FileNotFoundError:
        return False


def _sign(stream: IO) -> None:
    """Write who holds the lock; without room for that it is held all the same."""
    content = {
        "process": os.getpid(),
        "host": socket.gethostname(),
        "since": datetime.now().astimezone().isoformat(" ", "seconds"),
    }
    with contextlib.suppress(OSError):
        stream.truncate(0)
        os.write(stream.fileno(), json.dumps(content).encode())


def _busy(path: Path) -> str:
    """What the second run is told."""
    try:
        text = json.loads(path.read_text(encoding="utf-8"))
        who = f"process {text['process']} on {text['host']} since {text['since']}"
    except (OSError, ValueError, TypeError, KeyError):  # not signed yet
        who = "its process has not signed yet"
    return (
        f"{path.parent}: another run is at work here ({who}); wait for its end, or choose another "
        "--out"
    )
