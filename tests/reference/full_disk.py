"""A disk that is full, or read-only, from the n-th write into a folder on."""

import builtins
import contextlib
import errno
import io
import os
from collections.abc import Iterator
from pathlib import Path

import pytest


class Disk:
    """Counts what is written below `folder` and refuses it from the n-th time on.

    Opening a file for writing gives one that the kernel calls full when it is flushed (/dev/full);
    the file itself is left behind empty, as on a disk that is really full. A lock needs no room.

    Attributes:
        folder: what is watched.
        first: number of the first write that fails, from 1; 0: none does.
        code: the error; anything but ENOSPC is raised as the file is opened.
        count: writes so far.
    """

    def __init__(self, folder: Path, first: int = 0, code: int = errno.ENOSPC) -> None:
        """Count from nothing."""
        self.folder, self.first, self.code = str(folder.resolve()), first, code
        self.count = 0

    def _refused(self, path) -> bool:
        inside = not isinstance(path, int) and os.path.abspath(path).startswith(self.folder)
        self.count += inside
        return inside and 0 < self.first <= self.count

    def _error(self, path) -> OSError:
        return OSError(self.code, os.strerror(self.code), str(path))

    @contextlib.contextmanager
    def watched(self) -> Iterator["Disk"]:
        """Watch until the block ends."""
        opened = io.open

        def open_file(path, mode="r", *more, **named):
            lock = "a" in mode and self.code == errno.ENOSPC
            if set(mode) & set("wax+") and not lock and self._refused(path):
                if self.code != errno.ENOSPC or "r" in mode or not os.path.exists("/dev/full"):
                    raise self._error(path)
                opened(path, "ab").close()
                path, mode = "/dev/full", mode.replace("x", "w")
            return opened(path, mode, *more, **named)

        def checked(real, at):
            def function(*arguments, **named):
                if self._refused(arguments[at]):
                    raise self._error(arguments[at])
                return real(*arguments, **named)

            return function

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(io, "open", open_file)
            patch.setattr(builtins, "open", open_file)
            for name, at in (("mkdir", 0), ("rename", 1), ("replace", 1)):
                patch.setattr(os, name, checked(getattr(os, name), at))
            yield self
