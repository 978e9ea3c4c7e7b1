"""What all commands share: messages, tables, Ctrl-C."""

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table


class Stop(Exception):
    """Bad input: end the command with a message and exit code 2."""


class Kept(Exception):
    """Stopped, with something kept: end with a message and an exit code of its own."""

    def __init__(self, message: str, code: int = 130):
        """Say what is kept; `code` 130: stopped by the user, 3: another process was lost."""
        super().__init__(message)
        self.code = code


def to_stderr(text: str) -> None:
    """One line on stderr, in rich's markup."""
    Console(stderr=True).print(text, highlight=False, soft_wrap=True)


def complain(message: str) -> int:
    """Report bad input; returns its exit code."""
    to_stderr(f"[bold red]error:[/] {escape(message)}")
    return 2


@contextlib.contextmanager
def interrupts() -> Iterator[Callable[[], None]]:
    """Remember Ctrl-C, since an exception raised inside a callback of jax is printed and lost.

    Yields:
        What raises KeyboardInterrupt if one came; to be called between steps of the work.
    """
    asked = []

    def remember(number, frame):
        asked.append(number)
        signal.default_int_handler(number, frame)

    def stop_if_asked():
        if asked:
            raise KeyboardInterrupt

    def print_others(lost):
        if not issubclass(lost.exc_type, KeyboardInterrupt):
            shown(lost)

    usual = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if not usual or threading.current_thread() is not threading.main_thread():
        yield stop_if_asked
        return
    shown, sys.unraisablehook = sys.unraisablehook, print_others
    signal.signal(signal.SIGINT, remember)
    try:
        yield stop_if_asked
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        sys.unraisablehook = shown


def set_up_jax() -> None:
    """The command line computes in float64 and keeps compiled programs for the next start.

    They lie in `cache_folder()`, or where JAX_COMPILATION_CACHE_DIR says;
    JAX_ENABLE_COMPILATION_CACHE=false keeps none. All are kept, unless
    JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS says which.
    """
    import jax

    jax.config.update("jax_enable_x64", True)
    wanted = jax.config.values["jax_enable_compilation_cache"]
    chosen = jax.config.values["jax_compilation_cache_dir"]
    if wanted and chosen is None and (folder := cache_folder()) is not None:
        jax.config.update("jax_compilation_cache_dir", str(folder))
    if wanted and "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        # Also the many small ones, which jax leaves out by itself: about a quarter of a start.
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)


def cache_folder() -> Path | None:
    """The user's folder for compiled programs, or None where nothing can be written."""
    base = os.environ.get("LOCALAPPDATA" if os.name == "nt" else "XDG_CACHE_HOME")
    try:
        folder = (Path(base) if base else Path.home() / ".cache") / "jaxtrachea"
        folder.mkdir(parents=True, exist_ok=True)
        return folder if os.access(folder, os.W_OK) else None
    except (OSError, RuntimeError):  # RuntimeError: nobody's home
        return None


def table(title: str, head, rows, text: tuple[str, ...] = ()) -> Table:
    """A table that breaks lines between words only, and leaves out an only specimen's name."""
    named = head[0] != "specimen" or len({row[0] for row in rows}) > 1
    if not named:
        title, head, rows = f"{title}: {rows[0][0]}", head[1:], [row[1:] for row in rows]
    made = Table(
        title=escape(title), title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0)
    )
    cells = [[str(v) for v in column] for column in zip(head, *rows, strict=True)]
    least = [max(len(word) for cell in column for word in cell.split() or [""]) for column in cells]
    whole = [max(map(len, column)) for column in cells]
    widths = _shared_out(least, whole, Console().width - 2 * len(head) - 1)
    for i, name in enumerate(head):
        side = "left" if i == 0 or name in text else "right"
        made.add_column(
            escape(name), justify=side, min_width=least[i], width=widths[i], overflow="fold"
        )
    for row in rows:
        made.add_row(*map(escape, row))
    return made


def _shared_out(least: list[int], whole: list[int], width: int) -> list[int] | list[None]:
    """Widths of columns that together fill `width`, none below its longest word; None: as they are.

    Left to itself rich makes columns too narrow first, and then cuts what it widens again.
    """
    spare, wanted = width - sum(least), sum(whole) - sum(least)
    if wanted <= spare or spare < 0:
        return [None] * len(least)
    return [a + (b - a) * spare // wanted for a, b in zip(least, whole, strict=True)]


def progress_bar() -> Progress:
    """A progress bar on stderr."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
               TimeElapsedColumn())  # fmt: skip
    return Progress(*columns, console=Console(stderr=True))


@contextlib.contextmanager
def into(out_dir: Path | None, default: Path) -> Iterator[tuple[Path, Callable[[], None]]]:
    """Claim the output folder and watch for Ctrl-C; failures to write become `Stop`.

    Args:
        out_dir: what the user asks for.
        default: where to write else.

    Yields:
        The folder to write into, and what raises KeyboardInterrupt if Ctrl-C came.
    """
    from jaxtrachea.identify.output import OutputExists, new_output

    try:
        with interrupts() as stop_if_asked, new_output(out_dir, default) as folder:
            yield folder, stop_if_asked
            stop_if_asked()
    except OutputExists as error:
        raise Stop(str(error)) from None
    except OSError as error:
        where, reason = out_dir or default, error.strerror or str(error)
        raise Stop(f"{where}: cannot be written ({reason}); choose another --out") from None
