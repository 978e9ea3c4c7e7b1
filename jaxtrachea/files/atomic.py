"""Files that are written whole or not at all, also on a disk that fills up meanwhile.

HDF5 files are put together in memory: the HDF5 library that meets a full disk leaves its file open,
prints a traceback for every object in it and ends the process with a segmentation fault.
"""

import contextlib
import errno
import io
import os
import threading
from collections.abc import Iterator
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
        data: its content.

    Raises:
        OSError: nothing was written; a file of that name is as it was.
    """
    beside = path.with_name(f"{path.name}.{os.getpid()}-{threading.get_ident()}")
    try:
        with beside.open("wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        beside.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            beside.unlink()
        raise


@contextlib.contextmanager
def hdf5_file(path: Path, mode: str = "x") -> Iterator[Any]:
    """An HDF5 file in memory that is written when the block ends; nothing if it raises.

    Args:
        path: of the file.
        mode: `x`: new; `r+`: one that exists, with more written into it.

    Yields:
        The open `h5py.File`.

    Raises:
        FileExistsError: mode `x`, and there is one.
        OSError: it cannot be read or written.
    """
    import h5py

    if mode == "x" and path.exists():
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
    image = io.BytesIO(b"" if mode == "x" else path.read_bytes())
    with h5py.File(image, "w" if mode == "x" else mode) as file:
        yield file
    write_whole(path, image.getvalue())


def write_text(path: Path, text: str) -> None:
    """Write a text file."""
    path.write_text(text, encoding="utf-8")
