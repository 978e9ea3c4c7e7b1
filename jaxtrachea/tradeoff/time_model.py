"""How long a program takes on this machine, predicted: a + b * kernels + c * operations.

`a` is a call, `b` the start of a kernel, `c` an operation, for each dtype. The four are fitted to
the times of a few small programs of the package (`calibrate`) and kept beside the compiled programs
for the next start. Predictions are for programs of this package whose scene is a constant; they
know no caches and weigh all operations alike; docs/tradeoff.md has how far ratios of plans were
off. None is for another device.
"""

import datetime
import json
import os
import platform
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from jaxtrachea.files.atomic import write_whole
from jaxtrachea.files.programs import TIME_MODEL
from jaxtrachea.files.provenance import installed
from jaxtrachea.tradeoff.load import QUIET

#: What an operation in float32 counts where operations are the cost.
HALF = 0.5
#: Relative error of the fit above which a model is not kept.
MOST_ERROR = 1.0
#: What is kept: names of the numbers of a model.
NUMBERS = ("call", "kernel", "float32", "float64", "worst")

#: What a model belongs to, in words.
WORDS = {"processor": "processor", "cores": "number of cores", "flags": "XLA_FLAGS",
         "jaxlib": "jaxlib", "jaxtrachea": "jaxtrachea"}  # fmt: skip


class Uncalibrated(Exception):
    """No model of time can be had here; the message says why."""


class Work(NamedTuple):
    """What a program does: kernels started, and operations in each dtype."""

    kernels: float
    float32: float
    float64: float

    @property
    def operations(self) -> float:
        """Those in float32 counted half."""
        return HALF * self.float32 + self.float64


class TimeModel(NamedTuple):
    """Seconds of a call, of starting a kernel, of an operation in each dtype.

    Attributes:
        call: s.
        kernel: s.
        float32: s.
        float64: s.
        worst: largest relative error over the programs that it was fitted to.
        date: of the calibration.
        others: cores that others kept busy meanwhile; None: not known, or read from a file.
    """

    call: float
    kernel: float
    float32: float
    float64: float
    worst: float = 0.0
    date: str = ""
    others: float | None = None

    @property
    def doubt(self) -> str:
        """Why the next start should measure anew; empty: it need not."""
        if self.others is not None and self.others > QUIET:
            return f"others kept {self.others:.2g} cores busy while it was measured"
        if self.worst > MOST_ERROR:
            return f"the worst error of its fit is {100 * self.worst:.0f} %"
        return ""

    def seconds(self, work: Work) -> float:
        """Time predicted for one call, s."""
        own = work.kernels * self.kernel
        return self.call + own + work.float32 * self.float32 + work.float64 * self.float64

    @property
    def sentence(self) -> str:
        """In words."""
        return (
            f"a call {1e6 * self.call:.3g} us, a kernel {1e9 * self.kernel:.3g} ns, an operation "
            f"{1e9 * self.float64:.2g} ns in float64 and {1e9 * self.float32:.2g} ns in float32; "
            f"measured {self.date}, worst of the fit {100 * self.worst:.0f} %"
        )


def fitted(work: Sequence[Work], seconds: Sequence[float]) -> TimeModel:
    """The model that fits these times best: least squares of relative errors, no negative number.

    Args:
        work: of each program.
        seconds: that each takes.

    Raises:
        Uncalibrated: kernels or operations do not make a program slower.
    """
    from scipy.optimize import nnls

    taken = np.asarray(seconds, float)
    rows = np.array([(1.0, w.kernels, w.float32, w.float64) for w in work]) / taken[:, None]
    size = np.abs(rows).max(axis=0)
    found = nnls(rows / size, np.ones(len(taken)))[0] / size
    if not (found[1:] > 0).all():
        raise Uncalibrated("the times measured do not rise with kernels and operations")
    worst = float(np.abs(rows @ found - 1).max())
    today = datetime.datetime.now(datetime.UTC).date().isoformat()
    return TimeModel(*map(float, found), worst=worst, date=today)


def device() -> dict[str, str]:
    """What a model belongs to: processor, cores, versions, flags.

    Raises:
        Uncalibrated: the device is no CPU.
    """
    kind = jax.default_backend()
    if kind != "cpu":
        raise Uncalibrated(f"the device is a {kind}; times are modelled on a CPU only")
    return this_machine()


def this_machine() -> dict[str, str]:
    """What a model of its CPU belongs to; starts no device."""
    return {
        "processor": processor(), "cores": str(cores()), "flags": os.environ.get("XLA_FLAGS", ""),
        **{name: installed(name) for name in ("jaxlib", "jaxtrachea")},
    }  # fmt: skip


def cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def processor() -> str:
    """Name of the processor where Linux tells it."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            names = [line.split(":", 1)[1].strip() for line in file if "model name" in line]
    except OSError:
        names = []
    return names[0] if names else platform.processor()


def keep(model: TimeModel, folder: Path) -> str:
    """Write a model for the next start, or say why not: `doubt`, or it cannot be written."""
    if model.doubt:
        return model.doubt
    numbers = {name: getattr(model, name) for name in (*NUMBERS, "date")}
    text = json.dumps({"device": device(), "model": numbers}, indent=2) + "\n"
    try:
        write_whole(folder / TIME_MODEL, text.encode())
    except OSError as error:
        return f"{folder / TIME_MODEL} cannot be written ({error.strerror or error})"
    return ""


def kept(folder: Path) -> TimeModel | None:
    """The model that is kept for this device, or None: there is none, or it is damaged.

    Raises:
        Uncalibrated: the device is no CPU.
    """
    found, here = stored(folder), device()
    return None if found is None or found[0] != here else found[1]


def stored(folder: Path) -> tuple[dict[str, str], TimeModel] | None:
    """What the kept model belongs to, and the model; None: there is none, or it is damaged."""
    try:
        read = json.loads((folder / TIME_MODEL).read_text("utf-8"))
        where = {name: str(read["device"][name]) for name in this_machine()}
        numbers = [float(read["model"][name]) for name in NUMBERS]
        date = datetime.date.fromisoformat(read["model"]["date"]).isoformat()
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
        return None
    if not (np.isfinite(numbers).all() and min(numbers) >= 0 and min(numbers[1:4]) > 0):
        return None
    return where, TimeModel(*numbers, date=date)


def others_than_here(where: dict[str, str]) -> list[str]:
    """What of `stored` is not as here, in words."""
    here = this_machine()
    return [f"{WORDS[name]} {where[name]!r}" for name in here if where[name] != here[name]]
