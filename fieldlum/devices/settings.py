"""Match planned camera settings to the steps that a camera offers."""

from __future__ import annotations

import math
from collections.abc import Iterable

from fieldlum.core.errors import DeviceError
from fieldlum.core.records import shutter_text
from fieldlum.optics.photometry import SAME_SETTING_EV


def nearest(
    asked: float,
    offered: Iterable[float],
    what: str,
    unit: str = "",
    *,
    ev_per_octave: float = 1.0,
) -> float:
    """Return the value in `offered` that is nearest to the planned setting `asked`, by ratio.

    what, unit : names of the setting and its unit, for the error. ev_per_octave : EV for a factor
    of 2, which is 2 for f-numbers, 1 for shutter times and ISO. Raises DeviceError if the nearest
    value is more than 1/6 EV away, or if no positive value is offered or planned.
    """
    choices = [value for value in offered if value > 0]
    if not (asked > 0 and choices):
        raise DeviceError(
            f"{what}: {asked:g} {unit} planned, but the camera offers no values to set; turn "
            "it to its manual mode".replace("  ", " ")
        )
    best = min(choices, key=lambda value: abs(math.log2(value / asked)))
    if abs(ev_per_octave * math.log2(best / asked)) > SAME_SETTING_EV:
        shown = shutter_text(best) if unit == "s" else f"{best:.5g}"
        raise DeviceError(
            f"{what}: {asked:.5g} {unit} is not offered by the camera; the nearest value is "
            f"{shown}: plan "
            "with that value".replace("  ", " ")
        )
    return best
