"""Files that are written whole or not at all, also on a disk that fills up meanwhile.

The HDF5 library is not told of a full disk: it would leave its file open, print a traceback for
every object in it and end the process with a segmentation fault.
"""

import contextlib
import errno
import io
import os
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

#: Errors that room on the disk cures, and errors that a permission cures.
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
CLOSED = (errno.EROFS, errno.EACCES, errno.EPERM)


def cure(error: OSError) -> str:
    """What to do about a file that could not be written, before going on."""
    if error.errno in FULL:
        return "make room on the disk"
    if error.errno in CLOSED:
        return "make the folder writable (or copy it and go on in the copy)"
    return "mend that"


def write_whole(path: Path, data: bytes) -> None:
    """Write a file at once or not at all, and onto the disk.

    Args:
        path: file, replaced if it exists.

    Raises:
        OSError: nothing was written; a file of that name is as it was.
    """
    with _put_into_place(path) as beside, beside.open("wb") as stream:
        stream.write(data)
        stream.flush()
        os.fsync(stream.fileno())


@contextlib.contextmanager
def _put_into_place(path: Path) -> Iterator[Path]:
    """A file beside another that takes its place when the block ends, and is gone if it raises."""
    beside = path.with_name(f"{path.name}.{os.getpid()}-{threading.get_ident()}")
    try:
        yield beside
        beside.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            beside.unlink()
        raise


class _Image:
    """A file as the HDF5 library writes it; the first error is kept, and nothing written after it.

    Attributes:
        error: of the disk; None so far.
    """

    def __init__(self, stream: io.FileIO):
        """A stream without buffer, open for reading and writing."""
        self.error: OSError | None = None
        self._stream = stream
        self.seek, self.tell = stream.seek, stream.tell

    def write(self, data: Any) -> int:
        """All of it, or nothing where the disk has none left."""
        left = memoryview(data).cast("B")
        while len(left) and self.error is None:
            left = left[self._do(self._stream.write, left) or 0 :]
        return memoryview(data).nbytes

    def readinto(self, buffer: Any) -> int:
        """Zeros where nothing could be written."""
        view = memoryview(buffer).cast("B")
        count = self._do(self._stream.readinto, view) or 0
        view[count:] = bytes(len(view) - count)
        return len(view)

    read = readinto  # by its name h5py tells a file from a path

    def truncate(self, size: int) -> int:
        """The file gets this size."""
        self._do(self._stream.truncate, size)
        return size

    def flush(self) -> None:
        """Nothing waits."""

    def _do(self, function: Callable[[Any], int | None], value: Any) -> int | None:
        try:
            return function(value)
        except OSError as error:
            self.error = self.error or error
            return None


@contextlib.contextmanager
def hdf5_file(path: Path) -> Iterator[Any]:
    """A new HDF5 file that is in its place when the block ends; nothing is if it raises.

    Raises:
        FileExistsError: there is one.
        OSError: it cannot be written.
    """
    import h5py

    if path.exists():
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
    with _put_into_place(path) as beside, beside.open("w+b", buffering=0) as stream:
        image = _Image(stream)
        try:
            with h5py.File(image, "w") as file:
                yield file
        finally:
            if image.error is not None:
                raise image.error
        os.fsync(stream.fileno())


def write_text(path: Path, text: str) -> None:
    """Write a text file."""
    path.write_text(text, encoding="utf-8")


def is_utf8(path: Path) -> bool:
    """Whether a path is text in UTF-8; no report or manifest can name another."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        return False
    return True
