"""Match planned camera settings to the steps that a camera offers."""

from __future__ import annotations

import math
from collections.abc import Iterable

from fieldlum.errors import DeviceError
from fieldlum.records import shutter_text

LARGEST_STEP_EV = 1.0 / 6.0  # half of a third of a stop; chosen, as capture/verify.py, TOLERANCE_EV


def nearest(asked: float, offered: Iterable[float], what: str, unit: str = "") -> float:
    """Return the offered value that is nearest to `asked` in the log domain.

    Raises DeviceError if it is more than 1/6 EV away, or if nothing is offered.
    """
    choices = [value for value in offered if value > 0]
    if not (asked > 0 and choices):
        raise DeviceError(
            f"{what}: {asked:g} {unit} planned, but the camera offers no values to set; turn "
            "it to its manual mode".replace("  ", " ")
        )
    best = min(choices, key=lambda value: abs(math.log2(value / asked)))
    if abs(math.log2(best / asked)) > LARGEST_STEP_EV:
        shown = shutter_text(best) if unit == "s" else f"{best:.5g}"
        raise DeviceError(
            f"{what}: {asked:.5g} {unit} is not offered; the nearest is {shown}: plan with "
            "that value".replace("  ", " ")
        )
    return best
