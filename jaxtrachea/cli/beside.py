"""What a command does beside its work: load what draws while it computes, draw while it writes."""

import contextlib
import importlib
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any


def load_beside(module: str) -> None:
    """Import a module in a thread; what is wrong with it is said where it is used."""

    def load() -> None:
        with contextlib.suppress(Exception):
            importlib.import_module(module)

    threading.Thread(target=load, name="load", daemon=True).start()


@contextlib.contextmanager
def beside(function: Callable, *arguments: Any) -> Iterator[Future]:
    """A function called in a thread while the block is at work; both have ended after the block."""
    with ThreadPoolExecutor(1, "beside") as pool:
        yield pool.submit(function, *arguments)
