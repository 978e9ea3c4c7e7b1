"""How many threads are of use, and what they share."""

import functools
import os
import threading
from collections.abc import Callable
from typing import Any


def made_once(maxsize: int) -> Callable[[Callable[..., Any]], Any]:
    """`functools.lru_cache` for threads: while one makes a value, the others wait for it.

    What it returns has `cache_clear` too.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        cached, making = functools.lru_cache(maxsize)(function), threading.Lock()

        @functools.wraps(cached)
        def waiting(*arguments: Any, **named: Any) -> Any:
            with making:
                return cached(*arguments, **named)

        vars(waiting)["cache_clear"] = cached.cache_clear
        return waiting

    return decorate


def usable_cores() -> int:
    """Cores that this process may use; all of the machine where the system does not tell."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on every system
        return os.cpu_count() or 1
