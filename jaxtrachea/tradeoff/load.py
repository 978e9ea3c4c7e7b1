"""How busy others keep the machine while something is timed."""

import os
import time
from pathlib import Path

#: Cores kept busy by others from which on a run says so.
QUIET = 0.3
STAT = Path("/proc/stat")


class Load:
    """Cores that others keep busy, from its making on."""

    def __init__(self):
        """Begin to watch."""
        self._begin = _now()

    def others(self) -> float | None:
        """Cores kept busy by others since then, in the mean; None where the system does not tell.

        Time that a host takes away from a virtual machine counts as others'.
        """
        if self._begin is None or (now := _now()) is None:
            return None
        wall, busy, own = (b - a for a, b in zip(self._begin, now, strict=True))
        return round(max(busy - own, 0.0) / max(wall, 1e-9), 2)


def _now() -> tuple[float, float, float] | None:
    """Seconds: of the clock, of all cores at work, of this process."""
    try:
        first = STAT.read_text("ascii").splitlines()[0].split()
        ticks = [int(v) for v in first[1:9]]
        busy = (sum(ticks) - ticks[3] - ticks[4]) / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError, IndexError, AttributeError):
        return None
    return time.perf_counter(), busy, time.process_time()
