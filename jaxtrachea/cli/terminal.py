"""What all commands share: messages, tables, Ctrl-C."""

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from types import FrameType

from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
)
from rich.text import Text

from jaxtrachea.cli.terminal_table import wide_table
from jaxtrachea.files.pictures import sentence
from jaxtrachea.files.programs import count_uses, keep_bounds
from jaxtrachea.files.table import Table

__all__ = [
    "Kept", "Stages", "Stop", "cache_folder", "complain", "interrupts", "into", "programs_folder",
    "progress_bar", "quiet_compiler", "say", "say_lost", "say_written", "set_up_jax", "to_stderr",
]  # fmt: skip


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


def say(*what: str | Table, wrap: bool = True) -> None:
    """Tables, and lines as they are: what looks like markup in them is none."""
    plain = partial(Console().print, markup=False, highlight=False, emoji=False)
    for one in what:
        if not isinstance(one, Table):
            plain(one, soft_wrap=not wrap)
            continue
        plain(wide_table(one))
        if one.more:
            plain(one.more)


def say_lost(pictures: Mapping[str, str]) -> None:
    """Warn of pictures that could not be drawn; the numbers stand."""
    for name, reason in pictures.items():
        to_stderr(f"[yellow]warning:[/] {escape(sentence(name, reason))}")


def say_written(path: Path) -> None:
    """Where the files of a command are."""
    say(f"written to {path}", wrap=False)


class Interrupts:
    """Ctrl-C while a command is at work: raised where it comes, unless it is held back."""

    def __init__(self) -> None:
        """None came yet."""
        self._asked = self._held = False

    def remember(self, number: int, frame: FrameType | None) -> None:
        """What SIGINT calls."""
        self._asked = True
        if not self._held:
            signal.default_int_handler(number, frame)

    def stop_if_asked(self) -> None:
        """Raise KeyboardInterrupt if one came; to be called between steps of the work."""
        if self._asked:
            raise KeyboardInterrupt

    def hold(self) -> None:
        """Only remember them: folders are made, or files put into place, all of them or none."""
        self._held = True

    def let_through(self) -> None:
        """Raise them again, and one that came while they were held."""
        self._held = False
        self.stop_if_asked()


@contextlib.contextmanager
def interrupts() -> Iterator[Interrupts]:
    """Remember Ctrl-C, since an exception raised inside a callback of jax is printed and lost."""
    ctrl_c = Interrupts()

    def print_others(lost):
        if not issubclass(lost.exc_type, KeyboardInterrupt):
            shown(lost)

    usual = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if not usual or threading.current_thread() is not threading.main_thread():
        yield ctrl_c
        return
    shown, sys.unraisablehook = sys.unraisablehook, print_others
    signal.signal(signal.SIGINT, ctrl_c.remember)
    try:
        yield ctrl_c
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        sys.unraisablehook = shown


def quiet_compiler() -> None:
    """Keep what XLA logs off the terminal, such as "Very slow compile?" after two minutes.

    XLA logs this at the level of errors, and reads the level as jax is imported; what really fails
    is raised besides. TF_CPP_MIN_LOG_LEVEL and JAX_LOGGING_LEVEL of the user come first.
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")


def set_up_jax() -> None:
    """The command line computes in float64 and keeps its programs for the next start.

    They lie in `cache_folder()`, within the bounds of `files.programs`, or where
    JAX_COMPILATION_CACHE_DIR says, without; JAX_ENABLE_COMPILATION_CACHE=false keeps none.
    All are kept, unless JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS says which.
    """
    import jax

    from jaxtrachea.files.traces import keep_traces

    jax.config.update("jax_enable_x64", True)
    folder = programs_folder()
    keep_traces(folder)
    if folder is not None and folder == cache_folder():
        keep_bounds(folder)
        jax.config.update("jax_compilation_cache_dir", str(folder))
    if folder is not None and "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        # Also the many small ones, which jax leaves out by itself: about a quarter of a start.
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
        if folder == cache_folder():
            count_uses(folder)


def programs_folder() -> Path | None:
    """Where compiled programs are kept, `cache_folder()` unless jax is told otherwise, or None."""
    import jax

    if not jax.config.values["jax_enable_compilation_cache"]:
        return None
    chosen = jax.config.values["jax_compilation_cache_dir"]
    if chosen is None:
        return cache_folder()
    return Path(chosen) if chosen else None  # jax keeps none for an empty name


def cache_folder() -> Path | None:
    """The user's folder for compiled programs, or None where nothing can be written."""
    base = os.environ.get("LOCALAPPDATA" if os.name == "nt" else "XDG_CACHE_HOME")
    try:
        folder = (Path(base) if base else Path.home() / ".cache") / "jaxtrachea"
        folder.mkdir(parents=True, exist_ok=True)
        return folder if os.access(folder, os.W_OK) else None
    except (OSError, RuntimeError):  # RuntimeError: nobody's home
        return None


class _Count(ProgressColumn):
    """Steps done of all; without a total those done, and nothing before the first."""

    def render(self, task: Task) -> Text:
        """The cell of one task."""
        done = f"{task.completed:.0f}" if task.completed else ""
        return Text(f"{task.completed:.0f}/{task.total:.0f}" if task.total else done)


def progress_bar(*, transient: bool = False) -> Progress:
    """A progress bar on stderr; a `transient` one is for terminals only, and goes when done."""
    columns = (TextColumn("{task.description}"), BarColumn(), _Count(), TimeElapsedColumn())
    console = Console(stderr=True)
    hidden = transient and not console.is_terminal
    return Progress(*columns, console=console, transient=transient, disable=hidden)


class Stages:
    """Stages of a run on one progress bar, one line each; a stage ends when the next one begins."""

    def __init__(self, bar: Progress, look: Callable[[], None]):
        """`look`: called at every step; what it raises ends the work."""
        self.bar, self.look = bar, look
        self.task: TaskID | None = None
        self.finished = self.total = self.before = self.last = 0

    def begin(self, text: str) -> Callable[[int, int], None]:
        """End the stage before; returns what its work reports to.

        Its arguments are the steps done since the last call and all of the steps, 0 if unknown. The
        total grows: a fit does some lanes again and again, with totals of their own.
        """
        self.close()
        self.task = self.bar.add_task(text, total=None)
        self.finished = self.total = self.before = self.last = 0
        return self._advance

    def _advance(self, done: int, of: int) -> None:
        self.look()
        if done and of and of != self.last:
            self.before, self.last = self.finished, of
        self.finished += done
        known = of or self.total
        self.total = max(self.total, self.before + of, self.finished) if known else 0
        if self.task is not None:
            self.bar.update(self.task, completed=self.finished, total=self.total or None)

    def close(self) -> None:
        """End the last stage: all of it is done."""
        if self.task is not None:
            self.bar.update(self.task, completed=self.finished, total=self.finished)


@contextlib.contextmanager
def into(out_dir: Path | None, default: Path) -> Iterator[tuple[Path, Callable[[], None]]]:
    """Claim the output folder and watch for Ctrl-C; failures to write become `Stop`.

    Yields:
        The folder to write into, and what raises KeyboardInterrupt if Ctrl-C came.
    """
    from jaxtrachea.files.output import OutputExists, new_output

    try:
        with interrupts() as ctrl_c:
            ctrl_c.hold()
            with new_output(out_dir, default) as folder:
                try:
                    ctrl_c.let_through()
                    yield folder, ctrl_c.stop_if_asked
                    ctrl_c.stop_if_asked()
                finally:
                    ctrl_c.hold()
    except OutputExists as error:
        raise Stop(str(error)) from None
    except OSError as error:
        where, reason = out_dir or default, error.strerror or str(error)
        raise Stop(f"{where}: cannot be written ({reason}); choose another --out") from None
