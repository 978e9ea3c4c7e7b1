"""Memory of the process."""

import contextlib
import ctypes
from collections.abc import Callable

import numpy as np

#: Rows that `in_blocks` looks at together.
TOGETHER = 256


def give_back() -> None:
    """Return what was freed to the system; glibc keeps it, in an arena of each thread.

    Compiling a program frees hundreds of MB, a shard of a cohort tens.
    """
    with contextlib.suppress(OSError, AttributeError):  # another C library
        ctypes.CDLL("libc.so.6").malloc_trim(0)


def in_blocks(function: Callable[..., np.ndarray], *arrays: np.ndarray) -> np.ndarray:
    """What a function of arrays with the same rows returns of each row, of some rows at a time.

    Of a whole cohort what it computes by the way would take as much memory as the samples.
    """
    blocks = range(0, max(len(arrays[0]), 1), TOGETHER)
    return np.concatenate([function(*(v[k : k + TOGETHER] for v in arrays)) for k in blocks])
