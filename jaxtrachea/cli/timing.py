"""The model of this machine's time: kept beside the compiled programs, measured where it is not."""

from collections.abc import Callable
from typing import Literal

from jaxtrachea.cli.terminal import programs_folder


def time_model(report: Callable[[str], None]):
    """The kept `TimeModel`, or one measured now and kept.

    Args:
        report: called with what is done next; may raise to stop.

    Raises:
        Uncalibrated: there can be none on this device.
    """
    from jaxtrachea.tradeoff.calibrate import calibrate
    from jaxtrachea.tradeoff.time_model import device, keep, kept

    device()
    folder = programs_folder()
    found = None if folder is None else kept(folder)
    if found is None:
        found = calibrate(report)
        if folder is not None:
            keep(found, folder)
    return found


def price_of(wish: Literal["path", "step", "operations"], report: Callable[[str], None]):
    """The `Price` for a word of `[plan] cost`, and why it is operations where a time was asked for.

    Args:
        wish: `path`, `step` or `operations`.
        report: as for `time_model`.
    """
    from jaxtrachea.tradeoff.price import OPERATIONS, price
    from jaxtrachea.tradeoff.time_model import Uncalibrated

    if wish == "operations":
        return OPERATIONS, ""
    try:
        return price(wish, time_model(report)), ""
    except Uncalibrated as error:
        return OPERATIONS, in_place(error)


def in_place(error: Exception) -> str:
    """Why operations are the cost where a time was asked for."""
    return f"cost: operations in place of time: {error}"
