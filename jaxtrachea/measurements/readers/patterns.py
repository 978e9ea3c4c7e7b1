"""A regular expression of the user that backtracks without end is stopped.

Python's `re` cannot be stopped from another thread, and a signal stops it in the main thread of
Unix alone. So a pattern that could take long is first tried on all names in a process of its own,
which ends itself when its time is up; then it is known to be quick on them here, too.
"""

import json
import re
import subprocess
import sys
from collections.abc import Sequence

from jaxtrachea.measurements.curve import DataError

#: Time of a pattern for all names of a study, s; a plain one takes about 1 us a name.
SECONDS = 1.0
#: Longest time that the other process may take to start and answer, s.
PATIENCE = 60.0
#: Longest name of a file on common systems; up to it a pattern of two repeats takes milliseconds.
SHORT = 255
# The watchdog of faulthandler is a thread of C: it needs no turn of the interpreter, which `re`
# keeps, and exits with status 1 on every system.
_TRY = """
import faulthandler, json, os, re, sys
pattern, flags, names, seconds = json.load(sys.stdin)
pattern = re.compile(pattern, flags)
faulthandler.dump_traceback_later(seconds, exit=True, file=open(os.devnull, "w"))
for number, name in enumerate(names):
    sys.stdout.write(f"{number}\\n")
    sys.stdout.flush()
    pattern.search(name)
faulthandler.cancel_dump_traceback_later()
sys.stdout.write("done\\n")
"""
#: Pairs of pattern and name that were quick in this process's life.
_quick: set[tuple[re.Pattern, str]] = set()


def ensure_quick(pattern: re.Pattern, names: Sequence[str]) -> None:
    """Refuse a pattern that does not finish on some name.

    Args:
        pattern: to be searched in the names.
        names: file names.

    Raises:
        DataError: it took more than `SECONDS`; or it could, and cannot be tried.
    """
    names = [name for name in dict.fromkeys(names) if (pattern, name) not in _quick]
    if not names or (is_plain(pattern.pattern) and max(map(len, names)) <= SHORT):
        return
    answer = _tried(pattern, names)
    if not answer or answer[-1] != "done":
        name = names[int(answer[-1])] if answer else names[0]
        shown = name if len(name) <= 80 else f"{name[:76]} ..."
        raise DataError(
            f"the pattern {pattern.pattern!r} was stopped: it did not finish within "
            f"{SECONDS:g} s on the file name {shown!r}, as repeats of repeats like (a+)+ do",
            cure='repeat each part once, or write a template "{specimen}_A{trial}"',
        )
    _quick.update((pattern, name) for name in names)


def is_plain(pattern: str) -> bool:
    """Whether a pattern is quick by its form: few repeats, none of them of a group.

    The number of steps is then at most about the cube of the length of the name, times 16.
    """
    text = re.sub(r"\\.|\[\^?\]?[^\]]*\]", "x", pattern, flags=re.DOTALL)
    text = re.sub(r"\(\?P?[<:=!]", "(", text)
    text = re.sub(r"([*+?}])[?+]", r"\1", text)
    repeats, choices = len(re.findall(r"[*+{]", text)), len(re.findall(r"[?|]", text))
    most = 3 if text.startswith("^") else 2
    return repeats <= most and choices <= 4 and not re.search(r"\)[*+{]", text)


def _tried(pattern: re.Pattern, names: list[str]) -> list[str]:
    """Lines of the other process: the number of each name as it is begun, and "done".

    Raises:
        DataError: no other process can be started.
    """
    task = json.dumps([pattern.pattern, pattern.flags, names, SECONDS])
    try:
        if not sys.executable or getattr(sys, "frozen", False):
            raise OSError("this program has no interpreter of its own")
        done = subprocess.run(
            [sys.executable, "-I", "-S", "-c", _TRY],
            input=task,
            capture_output=True,
            text=True,
            timeout=PATIENCE,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise DataError(
            f"the pattern {pattern.pattern!r} may backtrack for long, and cannot be tried "
            f"({error})",
            cure='write a template "{specimen}_A{trial}", or repeat two parts at most',
        ) from None
    return done.stdout.split()
