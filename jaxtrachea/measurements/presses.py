"""Presses that a user asks a prediction for, as text: "s=75, D=0:6:0.5 mm, specimen=T01"."""

import dataclasses
import math
import re

import numpy as np

from jaxtrachea.units import UnitError, convert, parse_quantity

#: Presses that one text may stand for.
MAX_PRESSES = 100_000
_KEYS = {"s": "s", "D": "D", "d": "D", "displacement": "D", "phi": "phi", "tilt": "tilt",
         "speed": "speed", "hold": "hold", "specimen": "specimen", "trial": "trial"}  # fmt: skip
#: Samples of the way to the first displacement, and of a hold; where the first of the hold lies.
SAMPLES, HOLD_BEGINS = 40, 1e-3
_START = re.compile(r",(?=\s*\w+\s*=)")
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_VALUE = re.compile(rf"\s*(?P<number>{_NUMBER})\s*(?P<unit>.*?)\s*")
EXAMPLE = "as in s=75,D=0:6:0.5 or 's=7.5 cm,D=2 mm,specimen=T01'"


@dataclasses.dataclass(frozen=True, eq=False)
class Presses:
    """Contact positions and displacements.

    Attributes:
        s: mm; None if the model needs none.
        displacement: mm.
        specimen: only this one; None: all.
        trial: of the fit, whose own parameters count; None: a new curve.
        phi: contact angle from the anterior midline, rad.
        direction: of the tool, along the inward normal and the circumference.
        time: of every displacement, s; None without a speed.
    """

    s: np.ndarray | None
    displacement: np.ndarray
    specimen: str | None
    trial: str | None
    phi: float = 0.0
    direction: tuple[float, float] = (1.0, 0.0)
    time: np.ndarray | None = None


def parse_presses(text: str, *, needs_position: bool) -> Presses:
    """Read presses from text.

    Args:
        text: KEY=VALUE, separated by commas; s and D are numbers (mm) with or without a unit, or
            ranges START:STOP:STEP, in whole steps within STOP, which is a value where a step ends
            on it, or START:STOP, in 20 steps, with a unit at each number (0 needs none) or one at
            the end for all; phi, and tilt of the tool from the inward normal
            towards growing phi, are angles (degrees) with or without one; speed of the tool (mm/s)
            and how long it then stays (hold, s).
        needs_position: whether s must be given.

    Raises:
        ValueError: what was found, and what is expected.
    """
    found: dict[str, str] = {}
    for part in _START.split(text):
        key, sign, value = (v.strip() for v in part.partition("="))
        if not sign or key not in _KEYS or not value:
            raise ValueError(
                f"{part.strip()!r} is not understood; expected s, D, phi, tilt, speed, hold, "
                f"specimen or trial, {EXAMPLE}"
            )
        name = _KEYS[key]
        if name in found:
            raise ValueError(f"{name} is given twice; give --at once for each")
        found[name] = value
    if "D" not in found:
        raise ValueError(f"no displacement D; give it, {EXAMPLE}")
    if "s" not in found and needs_position:
        raise ValueError(f"no contact position s; give it, {EXAMPLE}")
    phi, tilt = (_angle(name, found.get(name, "0")) for name in ("phi", "tilt"))
    if not abs(tilt) < np.pi / 2:
        raise ValueError(f"tilt = {found['tilt']}: the tool moves inwards; expected within 90 deg")
    s = _lengths("s", found["s"]) if "s" in found else None
    D, time = _lengths("D", found["D"]), None
    if "speed" in found:
        hold = _positive("hold", found["hold"], "s", "time") if "hold" in found else 0.0
        D, time = motion_of(D, _positive("speed", found["speed"], "mm/s", "velocity"), hold)
    elif "hold" in found:
        raise ValueError("a hold begins where a ramp ends; give its speed, as in speed=5 mm/s")
    if len(D) * (1 if s is None else len(s)) > MAX_PRESSES:
        raise ValueError(f"{text!r} stands for more than {MAX_PRESSES} presses; take larger steps")
    direction = (1.0, 0.0) if tilt == 0 else (float(np.cos(tilt)), float(np.sin(tilt)))
    return Presses(s, D, found.get("specimen"), found.get("trial"), phi, direction, time)


def motion_of(displacement: np.ndarray, speed: float, hold: float) -> tuple[np.ndarray, np.ndarray]:
    """A ramp from rest at first touch through all displacements, and a hold, by displacement, time.

    Where the first displacement is not 0 the way there comes before it; the hold has its samples
    evenly in the logarithm of the time.

    Args:
        displacement: mm, all further on in one direction.
        speed: mm/s, positive.
        hold: s.
    """
    if displacement[0] != 0:
        way = np.linspace(0, displacement[0], SAMPLES, endpoint=False)
        displacement = np.concatenate([way, displacement])
    time = np.concatenate([[0], np.cumsum(np.abs(np.diff(displacement)))]) / speed
    if hold > 0:
        still = hold * np.geomspace(HOLD_BEGINS, 1, SAMPLES)
        displacement = np.concatenate([displacement, np.full(SAMPLES, displacement[-1])])
        time = np.concatenate([time, time[-1] + still])
    return displacement, time


def _positive(name: str, text: str, unit: str, dimension: str) -> float:
    """A positive number, with a unit or in `unit`."""
    part = _VALUE.fullmatch(text)
    if part is None:
        raise ValueError(f"{name}={text!r}: expected a number, as in {name}=5 {unit}")
    try:
        value = convert(float(part["number"]), part["unit"] or unit, dimension)
    except UnitError as error:
        raise ValueError(f"{name}={text!r}: {error}") from None
    if not 0 < value < math.inf:
        raise ValueError(f"{name}={text!r}: expected more than 0")
    return value


def _angle(name: str, text: str) -> float:
    """An angle, rad; a bare number is in degrees, as in all tables."""
    try:
        angle = math.radians(float("_" if "_" in text else text))
    except ValueError:
        try:
            angle = parse_quantity(text, "angle")
        except UnitError as error:
            raise ValueError(f"{name}: {error}") from None
    if not math.isfinite(angle):
        raise ValueError(f"{name} = {text}: expected a finite angle")
    return angle


def _lengths(name: str, text: str) -> np.ndarray:
    """A number or a range, mm."""
    parts = [_VALUE.fullmatch(part) for part in text.split(":")]
    read = [(float(part["number"]), part["unit"]) for part in parts if part is not None]
    if len(read) < len(parts) or len(parts) > 3:
        raise ValueError(
            f"{name}={text!r} is neither a length nor a range START:STOP:STEP (whole steps from "
            f"START, none beyond STOP); write it {EXAMPLE}"
        )
    *before, last = (unit for _, unit in read)
    if not any(before):
        read = [(number, last) for number, _ in read]
    elif any(number != 0 and not unit for number, unit in read):
        raise ValueError(
            f"{name}={text!r}: some numbers have a unit and others none; give each its own, as in "
            "0:2 mm:100 um, or one at the end for all, as in 0:2:0.1 mm"
        )
    try:
        values = [convert(number, unit or "mm", "length") for number, unit in read]
    except UnitError as error:
        raise ValueError(f"{name}={text!r}: {error}") from None
    if not np.isfinite(values).all():
        raise ValueError(f"{name}={text!r}: expected finite numbers")
    if len(values) == 1:
        return np.array(values)
    start, stop = values[:2]
    step = values[2] if len(values) == 3 else (stop - start) / 20
    if start == stop:
        return np.array([start])
    if step == 0 or (stop - start) / step < 0:
        raise ValueError(
            f"{name}={text!r}: steps of {step:g} mm do not lead from {start:g} to {stop:g} mm; "
            "give START:STOP:STEP, whole steps from START, none beyond STOP"
        )
    count = (stop - start) / step
    if count > MAX_PRESSES:
        raise ValueError(f"{name}={text!r}: more than {MAX_PRESSES} values; take larger steps")
    whole = int(np.floor(count + 1e-9))
    return start + step * np.arange(whole + 1)
