"""A camera offers steps; what was asked for must be one of them, or so near that it is the same."""

from __future__ import annotations

import math
from collections.abc import Iterable

from fieldlum.errors import DeviceError
from fieldlum.records import shutter_text

LARGEST_STEP_EV = 1.0 / 6.0  # half of a third of a stop


def nearest(asked: float, offered: Iterable[float], what: str, unit: str = "") -> float:
    """The offered value nearest in the log domain. Raises DeviceError when it is over 1/6 EV
    away.
    """
    choices = [value for value in offered if value > 0]
    if not (asked > 0 and choices):
        raise DeviceError(
            f"{what}: {asked:g} {unit} asked, nothing to choose from".replace("  ", " ")
        )
    best = min(choices, key=lambda value: abs(math.log2(value / asked)))
    if abs(math.log2(best / asked)) > LARGEST_STEP_EV:
        shown = shutter_text(best) if unit == "s" else f"{best:.5g}"
        raise DeviceError(
            f"{what}: {asked:.5g} {unit} is not offered, the nearest is {shown}".replace("  ", " ")
        )
    return best
