"""The model of this machine's time: kept beside the compiled programs, measured where it is not."""

from collections.abc import Callable
from typing import Literal

from jaxtrachea.cli.terminal import programs_folder

#: What was measured and not kept, by the folder: a choice and `plan --time` are one run.
_of_this_run: dict = {}


def time_model(report: Callable[[str], None]):
    """The kept `TimeModel`, or one measured now, and why that is not kept (empty: it is).

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
    if found is not None:
        return found, ""
    if folder not in _of_this_run:
        found = calibrate(report)
        why = found.doubt if folder is None else keep(found, folder)
        why = why and f"model of time: for this run only, not kept: {why}"
        _of_this_run[folder] = found, why
    return _of_this_run[folder]


def price_of(wish: Literal["path", "step", "operations"], report: Callable[[str], None]):
    """The `Price` for a word of `[plan] cost`, and what is to be said of it.

    That is: why it is operations where a time was asked for, or why its model is not kept.

    Args:
        wish: `path`, `step` or `operations`.
        report: as for `time_model`.
    """
    from jaxtrachea.tradeoff.price import OPERATIONS, price
    from jaxtrachea.tradeoff.time_model import Uncalibrated

    if wish == "operations":
        return OPERATIONS, ""
    try:
        model, why = time_model(report)
        return price(wish, model), why
    except Uncalibrated as error:
        return OPERATIONS, in_place(error)


def in_place(error: Exception) -> str:
    """Why operations are the cost where a time was asked for."""
    return f"cost: operations in place of time: {error}"
