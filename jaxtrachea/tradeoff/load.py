"""What machine something is timed on, and how busy others keep it meanwhile."""

import os
import platform
import time
from pathlib import Path

#: Cores kept busy by others from which on a run says so.
QUIET = 0.3
STAT = Path("/proc/stat")


def processor() -> str:
    """Name of the processor where Linux tells it."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            names = [line.split(":", 1)[1].strip() for line in file if "model name" in line]
    except OSError:
        names = []
    return names[0] if names else platform.processor()


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


def load_warning(others: float | None) -> tuple[str, ...]:
    """That others were busy, in words; empty where the machine was quiet or is not known."""
    if others is None or others <= QUIET:
        return ()
    return (f"machine was busy ({others:.2g} cores): timings are unreliable",)


def _now() -> tuple[float, float, float] | None:
    """Seconds: of the clock, of all cores at work, of this process."""
    try:
        first = STAT.read_text("ascii").splitlines()[0].split()
        ticks = [int(v) for v in first[1:9]]
        busy = (sum(ticks) - ticks[3] - ticks[4]) / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError, IndexError, AttributeError):
        return None
    return time.perf_counter(), busy, time.process_time()
