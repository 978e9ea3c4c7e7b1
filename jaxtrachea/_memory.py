"""Memory of the process."""

import contextlib
import ctypes


def give_back() -> None:
    """Return what was freed to the system; glibc keeps it, in an arena of each thread.

    Compiling a program frees hundreds of MB, a shard of a cohort tens.
    """
    with contextlib.suppress(OSError, AttributeError):  # another C library
        ctypes.CDLL("libc.so.6").malloc_trim(0)
