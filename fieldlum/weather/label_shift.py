"""Estimate by how much the times of a weather file are off, from mornings and afternoons.

Under a clear sky, direct irradiance depends on the sun's altitude, in the morning as in the
afternoon. With wrong labels, one half of the day seems to have stronger direct light at the same
altitude. Unlike sunrise and sunset, this shows half an hour at all latitudes.
"""

from __future__ import annotations

from datetime import timedelta
from itertools import pairwise

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.records import Site
from fieldlum.sky import sun
from fieldlum.weather.year import Weather

# Seven files that are right have at most 8 min; labels at an end of the hour give 22 to 38 min.
# Chosen between them, on the same files (docs/validation.md).
MOST_SHIFT_MIN = 20.0
_SHIFTS_MIN = (-60.0, -30.0, 0.0, 30.0, 60.0)  # between them the result is interpolated; chosen
# Altitudes that are compared, deg. Lower ones may be behind a hill; at higher ones direct light
# hardly depends on the altitude. Chosen.
_ALTITUDES_DEG = np.arange(8.0, 33.0, 3.0)
# This quantile of DNI is of clear hours in most climates. Chosen, not measured.
_CLEAR_QUANTILE = 0.8
_LEAST_HOURS = 20  # of a half-day at an altitude; fewer have no quantile; chosen
_LEAST_DAYS = 300  # in a part of a year, mornings and afternoons differ by weather; chosen


def label_shift_min(weather: Weather, station: Site) -> float | None:
    """Return how many minutes, added to all times, make mornings and afternoons agree.

    None if the file does not show it: it has under 300 days, or no shift of up to an hour is right.
    """
    if len({t.date() for t in weather.t_utc}) < _LEAST_DAYS:
        return None
    excess = np.array([_morning_excess(weather, station, shift) for shift in _SHIFTS_MIN])
    falls = np.flatnonzero((excess[:-1] > 0.0) & (excess[1:] <= 0.0))
    if len(falls) != 1:
        return None
    k = int(falls[0])
    part = excess[k] / (excess[k] - excess[k + 1])
    return float(_SHIFTS_MIN[k] + part * (_SHIFTS_MIN[k + 1] - _SHIFTS_MIN[k]))


def label_notes(weather: Weather, station: Site) -> list[str]:
    """Return a note if the labels of a file seem to be off by more than 20 minutes."""
    shift = label_shift_min(weather, station)
    if shift is None or abs(shift) <= MOST_SHIFT_MIN:
        return []
    return [
        "direct light of mornings and afternoons agrees if all row times are moved by "
        f"{shift:+.0f} min: check the time zone, and whether a row's time is its hour's start, "
        f"middle or end (--label-shift {30 * round(shift / 30):+d})"
    ]


def _morning_excess(weather: Weather, station: Site, shift_min: float) -> float:
    """Return by how much clear mornings exceed clear afternoons at the same altitude, -1 to 1.

    shift_min : added to all times. NaN without an altitude at which both have enough hours.
    """
    shift = timedelta(minutes=shift_min)
    place = sun.position([t + shift for t in weather.t_utc], station)
    morning = place.azimuth_deg < 180.0
    excess = []
    for low, high in pairwise(_ALTITUDES_DEG):
        inside = (place.altitude_deg >= low) & (place.altitude_deg < high)
        halves = weather.dni_wm2[inside & morning], weather.dni_wm2[inside & ~morning]
        if min(len(half) for half in halves) >= _LEAST_HOURS:
            excess.append(_contrast(*halves))
    return float(np.mean(excess)) if excess else float("nan")


def _contrast(first: Floats, second: Floats) -> float:
    """Return the difference of two clear-sky levels over their sum."""
    a, b = (float(np.quantile(values, _CLEAR_QUANTILE)) for values in (first, second))
    return (a - b) / max(a + b, 20.0)  # 20 W/m2: darker hours decide nothing; chosen
