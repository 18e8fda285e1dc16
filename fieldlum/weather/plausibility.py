"""Whether a weather file can mean what it says: units, columns and labels held against the sun.

Each of these mistakes leaves numbers that look like weather: kW for W, direct and diffuse in each
other's column, the global in place of one of them, labels at the hour's end where its middle is
meant. The limits stand far from what real files show (docs/file-formats.md) and far from what the
mistakes make.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fieldlum import sun
from fieldlum.errors import InputError
from fieldlum.records import Site
from fieldlum.weather.year import Weather

Array = NDArray[np.float64]

LEAST_OF_CLEAR, MOST_OF_CLEAR = (
    0.03,
    1.3,
)  # global energy over that of a cloudless sky; kW give 0.001
MOST_EXTREME = 0.02  # share of the hours outside BSRN's extremely rare limits
DULL_CLEARNESS, LEAST_DIFFUSE = (
    0.25,
    0.9,
)  # under such a sky nearly all light is diffuse (Erbs et al. 1982)
LEAST_DULL_HOURS = 20
MOST_OPEN = 0.2  # median of |global - diffuse - direct| over the global, where all three are given
LIGHT_WM2, DARK_WM2 = 3.0, 1.0
RISEN_DEG, SUNK_DEG = 1.5, -0.5  # of the sun at both ends of an hour
# of the sunrises and sunsets; half an hour of shift gives 0.10 to 0.14 at 36 to 55 degrees north
MOST_AGAINST = 0.04
MOST_OF_FEW = 12  # a few days cannot tell
MOST_AGAINST_ALL = 0.25  # where no shift helps: another latitude or hemisphere
SHIFTS_MIN = tuple(m for m in range(-150, 151, 15) if m)
_HALF = timedelta(minutes=30)
_MENDED = "mend the columns, in W/m2"


def check_sense(path: Path, weather: Weather, station: Site, ghi_wm2: Array) -> None:
    """Raises InputError where a file's figures or labels cannot be true at `station`.

    ghi_wm2 : [n] global irradiance as the file gives it, NaN where it gives none.
    """
    altitude = sun.position(weather.t_utc, station).altitude_deg
    up = altitude > sun.CLEAR_SUN_DEG
    if not up.any():
        return
    sine = np.maximum(np.sin(np.radians(altitude)), 0.0)
    total = weather.dhi_wm2 + weather.dni_wm2 * sine
    _check_level(path, weather, station, total)
    top = sun.extraterrestrial_wm2(weather.t_utc)
    _check_limits(path, weather, altitude, top, up)
    _check_dull(path, weather, total, up & (total < DULL_CLEARNESS * top * sine) & (total > 10.0))
    _check_closure(path, ghi_wm2, total, up & (ghi_wm2 > 50.0))
    _check_labels(path, weather, station)


def check_hourly(path: Path, times: Sequence[datetime]) -> None:
    """Everything that counts hours counts rows. Raises InputError for rows that are no hours."""
    if len(times) < 3:
        return
    steps = np.diff([t.timestamp() for t in times]) / 60.0
    usual, least = float(np.median(steps)), float(steps.min())
    wrong = usual if abs(usual - 60.0) > 1.0 else least
    if abs(wrong - 60.0) > 1.0:
        raise InputError(
            path, f"rows {wrong:g} min apart", "one row an hour", "average it to whole hours first"
        )


def _check_level(path: Path, weather: Weather, station: Site, total: Array) -> None:
    share = float(total.sum() / max(sun.clearsky(weather.t_utc, station).ghi_wm2.sum(), 1.0))
    if not LEAST_OF_CLEAR <= share <= MOST_OF_CLEAR:
        found = f"{share:.2g} times the energy of cloudless skies at {station.name}"
        raise InputError(
            path, found, f"{LEAST_OF_CLEAR:g} to {MOST_OF_CLEAR:g}", f"is it in kW or kJ? {_MENDED}"
        )


def _check_limits(
    path: Path, weather: Weather, altitude: Array, top: Array, up: NDArray[np.bool_]
) -> None:
    limits = sun.bsrn_limits(altitude, top, extreme=True)
    over = [
        (name, float((values > limit[1])[up].mean()))
        for name, values, limit in (
            ("DNI", weather.dni_wm2, limits.dni_wm2),
            ("DHI", weather.dhi_wm2, limits.dhi_wm2),
        )
    ]
    name, share = max(over, key=lambda one: one[1])
    if share > MOST_EXTREME:
        found = f"{name} above what any sky gives in {100 * share:.0f} % of the hours"
        asked = f"is another component in the column of {name}? {_MENDED}"
        raise InputError(path, found, f"at most {100 * MOST_EXTREME:g} %", asked)


def _check_dull(path: Path, weather: Weather, total: Array, dull: NDArray[np.bool_]) -> None:
    if dull.sum() < LEAST_DULL_HOURS:
        return
    share = float(np.median(weather.dhi_wm2[dull] / total[dull]))
    if share < LEAST_DIFFUSE:
        found = f"under dull skies {100 * share:.0f} % of the light is diffuse"
        asked = f"does the column of DNI hold the global or the diffuse? {_MENDED}"
        raise InputError(path, found, f"over {100 * LEAST_DIFFUSE:g} %", asked)


def _check_closure(path: Path, ghi_wm2: Array, total: Array, tested: NDArray[np.bool_]) -> None:
    if not tested.any():
        return
    off = float(np.median(np.abs(ghi_wm2 - total)[tested] / ghi_wm2[tested]))
    if off > MOST_OPEN:
        found = f"GHI is off DHI + DNI sin(altitude) by {100 * off:.0f} % in the median"
        asked = f"is a column another component, or direct on a horizontal plane? {_MENDED}"
        raise InputError(path, found, f"at most {100 * MOST_OPEN:g} %", asked)


def _check_labels(path: Path, weather: Weather, station: Site) -> None:
    """Hours lit before sunrise, or dark after it: labels stand beside their hours, or it is not
    this place's sun.
    """
    against = _against(weather, station, 0)
    edges = 2 * len({sun.standard_date(t, weather.site.timezone) for t in weather.t_utc})
    most = max(int(MOST_AGAINST * edges), MOST_OF_FEW)
    if against <= most:
        return
    other = {shift: _against(weather, station, shift) for shift in SHIFTS_MIN}
    best = min(other, key=lambda shift: other[shift])
    if other[best] < 0.5 * against:
        found = (
            f"{against} hours are lit before sunrise or dark after it, {other[best]} if "
            f"labels stood {best:+d} min"
        )
        asked = "check the time zone and whether labels are an hour's start, middle or end"
        raise InputError(path, found, f"at most {most} in {edges // 2} days", asked)
    if against > MOST_AGAINST_ALL * edges:
        found = f"{against} hours of {edges // 2} days are lit before sunrise or dark after it"
        raise InputError(
            path, found, f"the sun of {station.name}", "is it the weather of another place?"
        )


def _against(weather: Weather, station: Site, shift_min: int) -> int:
    """Hours that are lit with the sun down at both ends, or dark with it up at both, if labels
    stood otherwise.
    """
    shift = timedelta(minutes=shift_min)
    light = weather.dni_wm2 + weather.dhi_wm2
    return hours_against([t + shift for t in weather.t_utc], light, station)


def hours_against(
    times_utc: Sequence[datetime], light: Array, station: Site, half: timedelta = _HALF
) -> int:
    """Count the spans from `half` before to `half` after these times that are lit with the sun down
    at both ends, or dark with it up at both; light [n] is DNI + DHI. [W/m2]
    """
    ends = [
        sun.position([t + edge for t in times_utc], station).altitude_deg for edge in (-half, half)
    ]
    lit, dark = light > LIGHT_WM2, light < DARK_WM2
    return int(
        (lit & (np.maximum(*ends) < SUNK_DEG)).sum()
        + (dark & (np.minimum(*ends) > RISEN_DEG)).sum()
    )
