"""Plausibility of a weather file: units, columns and time labels compared with the sun.

Each of these mistakes leaves numbers that look like weather: kW instead of W, direct and diffuse
exchanged, global in the column of one of them, labels at the end of the hour instead of its middle.
The limits are far from what real files show (docs/file-formats.md) and far from what the mistakes
cause.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime, timedelta
from itertools import pairwise
from pathlib import Path

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.errors import InputError
from fieldlum.core.records import Site
from fieldlum.sky import sun
from fieldlum.weather.year import Weather

# Seven files that are right have at most 8 min; labels at an end of the hour give 22 to 38 min.
# Chosen between them, on the same files (docs/validation.md).
MAX_SHIFT_MINUTES = 20.0
_SHIFTS_MIN = (-60.0, -30.0, 0.0, 30.0, 60.0)  # between them the result is interpolated; chosen
# Altitudes that are compared, deg. Lower ones may be behind a hill; at higher ones direct light
# hardly depends on the altitude. Chosen.
_ALTITUDES_DEG = np.arange(8.0, 33.0, 3.0)
# This quantile of DNI is of clear hours in most climates. Chosen, not measured.
_CLEAR_QUANTILE = 0.8
MIN_HOURS = 20  # with fewer, a median or a quantile decides nothing; chosen
_MIN_DAYS = 300  # in a part of a year, mornings and afternoons differ by weather; chosen


def label_shift_min(weather: Weather, station: Site) -> float | None:
    """Return how many minutes, added to all times, make mornings and afternoons agree.

    None if the file does not show it: it has under 300 days, or no shift of up to an hour is right.
    """
    if len({t.date() for t in weather.t_utc}) < _MIN_DAYS:
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
    if shift is None or abs(shift) <= MAX_SHIFT_MINUTES:
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
        if min(len(half) for half in halves) >= MIN_HOURS:
            excess.append(_contrast(*halves))
    return float(np.mean(excess)) if excess else float("nan")


def _contrast(first: Floats, second: Floats) -> float:
    """Return the difference of two clear-sky levels over their sum."""
    a, b = (float(np.quantile(values, _CLEAR_QUANTILE)) for values in (first, second))
    return (a - b) / max(a + b, 20.0)  # 20 W/m2: darker hours decide nothing; chosen


# Energy of the year's global irradiance over that of a cloudless sky. Chosen so that every climate
# is inside and a file in kW (0.001) or kJ (3.6) is outside; not measured.
MIN_OF_CLEAR = 0.03
MAX_OF_CLEAR = 1.3
# Share of the hours outside the extremely rare limits of BSRN (Long and Dutton 2010). Chosen so
# that single bad hours pass and an exchanged column does not; not measured.
MAX_EXTREME_SHARE = 0.02
# Below this clearness index nearly all light is diffuse (Erbs, Klein, Duffie 1982: over 97 %). A
# smaller median share than MIN_DIFFUSE_SHARE means that a column is another component.
OVERCAST_CLEARNESS = 0.25
MIN_DIFFUSE_SHARE = 0.9
# Global irradiance is never below the diffuse one, and equals it under overcast skies. Direct
# irradiance is below it in most overcast hours. Of the hours with over 20 W/m2 of diffuse, the
# files of five places have 34 to 62 % below and 1 to 3 % equal; with global as direct they have at
# most 2 % below and at least 10 % equal. Measured (docs/validation.md); chosen between.
MIN_SHARE_BELOW = 0.05
MAX_SHARE_EQUAL = 0.05
_SAME_WITHIN = 0.05  # relative, as two instruments agree; chosen
# Median of |global - diffuse - direct| over the global, where a file has all three. Chosen so that
# hourly means around a moving sun pass; not measured.
MAX_CLOSURE_ERROR = 0.2
# DNI + DHI over LIGHT_WM2 is a lit hour, under DARK_WM2 a dark one. Chosen above the rounding of
# files; not measured.
LIGHT_WM2 = 3.0
DARK_WM2 = 1.0
# The sun is up (down) if its centre is above (below) these altitudes at both ends of an hour.
# Chosen around the -0.8 deg of sunrise so that twilight decides nothing; not measured.
RISEN_DEG = 1.5
SUNK_DEG = -0.5
# Share of the sunrises and sunsets that may contradict. Half an hour of shift gives 0.10 to 0.14 at
# 36 to 55 degrees north. Chosen, a third of that.
MAX_CONTRADICTIONS = 0.04
MIN_CONTRADICTIONS = 12  # in files of a few days fewer decide nothing; not measured
# Share that is an error although no shift of the labels helps: the weather is of another latitude
# or hemisphere. Chosen so that a high horizon passes; not measured.
MAX_CONTRADICTIONS_ANYWHERE = 0.25
# Light below this altitude is light at night: hourly means include light from half an hour before
# sunrise. Chosen.
NIGHT_BELOW_DEG = -8.0
# Share of the year's light that may be at night, and of the hours around solar midnight that may be
# lit; a shift of one hour gives more. Not measured.
MAX_LIGHT_AT_NIGHT = 0.01
_MIDNIGHT_WITHIN_H = 1.5  # of solar midnight: no day of a wrong latitude reaches it; chosen
SHIFTS_MIN = tuple(m for m in range(-150, 151, 15) if m)
_HALF = timedelta(minutes=30)  # of an hour, by definition
_CORRECT_COLUMNS = "write the right columns, in W/m2"


def check_sense(path: Path, weather: Weather, station: Site, ghi_wm2: Floats) -> list[str]:
    """Raise InputError if the values or labels of a file cannot be true at `station`.

    Return a warning if some sunrises and sunsets are not those of `station`. ghi_wm2 : [n] global
    irradiance of the file, NaN where it has none, W/m2.
    """
    altitude = sun.position(weather.t_utc, station).altitude_deg
    _check_night(path, weather, station, altitude)
    up = altitude > sun.CLEAR_SUN_DEG
    if not up.any():
        return []
    total = weather.dhi_wm2 + weather.dni_wm2 * np.maximum(np.sin(np.radians(altitude)), 0.0)
    share = float(total.sum() / max(sun.clearsky(weather.t_utc, station).ghi_wm2.sum(), 1.0))
    if not MIN_OF_CLEAR <= share <= MAX_OF_CLEAR:
        raise InputError(
            path,
            f"the sum of irradiance is {share:.2g} times that of cloudless skies at {station.name}",
            f"{MIN_OF_CLEAR:g} to {MAX_OF_CLEAR:g} times",
            f"check whether values are in kW or kJ; {_CORRECT_COLUMNS}",
        )
    # Before the columns: with labels an hour off, low suns look like overcast hours with much DNI.
    doubt = _check_labels(path, weather, station)
    if (wrong := _wrong_column(weather, altitude, total, ghi_wm2)) is not None:
        found, expected, cause = wrong
        if doubt:
            raise _another_place(path, f"{doubt}; {found}")
        # Half an hour beside its sun, clear light at low altitudes looks like wrong columns.
        shift = label_shift_min(weather, station)
        if shift is None or abs(shift) <= MAX_SHIFT_MINUTES:
            remedy = f"check whether {cause}; {_CORRECT_COLUMNS}"
            raise InputError(path, found, expected, remedy)
        raise InputError(
            path,
            f"direct light of mornings and afternoons agrees only with all row times moved by "
            f"{shift:+.0f} min",
            "times at the middle of their hours",
            _label_remedy(30 * round(shift / 30)),
        )
    return [f"WARNING: {doubt}; check that the file is of this place"] if doubt else []


def _wrong_column(
    weather: Weather, altitude: Floats, total: Floats, ghi_wm2: Floats
) -> tuple[str, str, str] | None:
    """Return what shows that a column has another component, what is expected, and the cause.

    total : DHI + DNI sin(altitude), [n]. None if nothing shows it.
    """
    up, dni, dhi = altitude > sun.CLEAR_SUN_DEG, weather.dni_wm2, weather.dhi_wm2
    top = sun.extraterrestrial_wm2(weather.t_utc)
    limits = sun.bsrn_limits(altitude, top, extreme=True)
    over = {
        "DNI": float((dni > limits.dni_wm2[1])[up].mean()),
        "DHI": float((dhi > limits.dhi_wm2[1])[up].mean()),
    }
    name = max(over, key=lambda name: over[name])
    if over[name] > MAX_EXTREME_SHARE:
        found = f"{name} is above the limit of any sky in {100 * over[name]:.0f} % of the daylight"
        cause = f"the column of {name} has another component"
        return f"{found} hours", f"at most {100 * MAX_EXTREME_SHARE:g} %", cause
    clearness = total / (top * np.maximum(np.sin(np.radians(altitude)), 1e-9))
    overcast = up & (clearness < OVERCAST_CLEARNESS) & (total > 10.0)
    share = float(np.median(dhi[overcast] / total[overcast])) if overcast.any() else 1.0
    if overcast.sum() >= MIN_HOURS and share < MIN_DIFFUSE_SHARE:
        found = f"only {100 * share:.0f} % of the irradiance of overcast hours is diffuse (median)"
        return (
            found,
            f"over {100 * MIN_DIFFUSE_SHARE:g} %",
            "the column of DNI has global or diffuse",
        )
    lit = dhi > 20.0
    ratio = dni[lit] / dhi[lit] - 1.0
    below = float((ratio < -_SAME_WITHIN).mean()) if lit.any() else 1.0
    equal = float((abs(ratio) <= _SAME_WITHIN).mean()) if lit.any() else 0.0
    if lit.sum() >= MIN_HOURS and below < MIN_SHARE_BELOW and equal > MAX_SHARE_EQUAL:
        found = f"DNI equals DHI in {100 * equal:.0f} % of the daylight hours, and is below it in"
        expected = "overcast hours with less direct than diffuse irradiance"
        return f"{found} {100 * below:.1f} %", expected, "the column of DNI has global"
    tested = up & (ghi_wm2 > 50.0)
    open_share = np.abs(1.0 - total[tested] / ghi_wm2[tested])
    off = float(np.median(open_share)) if tested.any() else 0.0
    if off > MAX_CLOSURE_ERROR:
        found = f"GHI differs from DHI + DNI sin(altitude) by {100 * off:.0f} % (median)"
        cause = "a column has another component, or direct on a horizontal plane"
        return found, f"at most {100 * MAX_CLOSURE_ERROR:g} %", cause
    return None


def check_hourly(path: Path, times: Sequence[datetime]) -> None:
    """Raise InputError if the median or the shortest time between rows is not one hour.

    Other stages count rows as hours. Fewer than three rows are not checked.
    """
    if len(times) < 3:
        return
    steps = np.diff([t.timestamp() for t in times]) / 60.0
    usual, minimum = float(np.median(steps)), float(steps.min())
    wrong = usual if abs(usual - 60.0) > 1.0 else minimum
    if abs(wrong - 60.0) > 1.0:
        raise InputError(
            path,
            f"rows that are {wrong:g} min apart",
            "one row for each hour",
            "average the file to hours first",
        )


def _check_night(path: Path, weather: Weather, station: Site, altitude: Floats) -> None:
    """Raise InputError for light while the sun is far below the horizon, and state its cause.

    The cause is the time zone if moving all rows by hours removes the light. Otherwise it is a
    column with light at midnight, or another place.
    """
    light = weather.dni_wm2 + weather.dhi_wm2
    night = altitude < NIGHT_BELOW_DEG
    solar_h = np.array([t.timestamp() for t in weather.t_utc]) / 3600.0 + station.longitude_deg / 15
    midnight = night & (np.abs((solar_h + 12.0) % 24.0 - 12.0) < _MIDNIGHT_WITHIN_H)
    lit = midnight & (light > LIGHT_WM2)
    at_midnight = lit.sum() > MAX_LIGHT_AT_NIGHT * midnight.sum() and lit.sum() > MIN_CONTRADICTIONS
    share = float(light[night].sum() / max(light.sum(), 1.0))
    if share <= MAX_LIGHT_AT_NIGHT and not at_midnight:
        return
    shares = {h: _share_at_night(weather, station, h) for h in range(-12, 13)}
    best = min(shares, key=lambda hours: (shares[hours], abs(hours)))
    found = f"{100 * share:.0f} % of the irradiance is at times when the sun is down"
    if shares[best] <= min(MAX_LIGHT_AT_NIGHT, 0.2 * share):
        found += f" at {station.name}; {100 * shares[best]:.0f} % with all row times moved by"
        found += f" {best:+d} h"
        remedy = "check the file's time zone, and the sign of the site's longitude"
    elif at_midnight:
        medians = {"DNI": weather.dni_wm2[lit], "DHI": weather.dhi_wm2[lit]}
        shown = (f"{name} {np.median(values):.3g} W/m2" for name, values in medians.items())
        found += f", whatever the time zone: {lit.sum()} hours around midnight have light (median "
        found += ", ".join(shown) + ")"
        remedy = "check that column: it has another quantity, or an offset that its days have too"
    else:
        found += f" at {station.name}, whatever the time zone"
        remedy = "check that the file is of this place, and the sign of its latitude"
    raise InputError(path, found, "irradiance only while the sun is up", remedy)


def _label_remedy(shift_min: int) -> str:
    return (
        "check the time zone, and whether a row's time is its hour's start, middle or end; if "
        f"the labels are wrong, use --label-shift {shift_min:+d}"
    )


def _share_at_night(weather: Weather, station: Site, hours: int) -> float:
    """Return the share of the light at night if all rows are moved by some hours."""
    moved = [t + timedelta(hours=hours) for t in weather.t_utc]
    light = weather.dni_wm2 + weather.dhi_wm2
    night = sun.position(moved, station).altitude_deg < NIGHT_BELOW_DEG
    return float(light[night].sum() / max(light.sum(), 1.0))


def _check_labels(path: Path, weather: Weather, station: Site) -> str:
    """Raise InputError if many hours are lit before sunrise, or dark after it.

    Then the labels are not at the middle of their hours, or the weather is of another place. Fewer
    hours that no shift explains are described in the result, which is "" without any.
    """
    against = _against(weather, station, 0)
    edges = 2 * len({sun.standard_date(t, weather.site.timezone) for t in weather.t_utc})
    maximum = max(int(MAX_CONTRADICTIONS * edges), MIN_CONTRADICTIONS)
    if against <= maximum:
        return ""
    other = {shift: _against(weather, station, shift) for shift in SHIFTS_MIN}
    fewest = min(other.values())
    # Sunrise and sunset often permit several shifts. Mornings and afternoons decide between them,
    # otherwise the middle one is likeliest.
    equal = [shift for shift in SHIFTS_MIN if other[shift] <= fewest + 0.01 * edges]
    stated = label_shift_min(weather, station)
    likeliest = float(np.median(equal)) if stated is None else stated
    best = min(equal, key=lambda shift: (abs(shift - likeliest), abs(shift)))
    found = f"{against} hours have light while the sun is down or none while it is up"
    if other[best] < 0.5 * against and other[best] <= maximum:
        raise InputError(
            path,
            f"{found}; only {other[best]} hours with all row times moved by {best:+d} min",
            f"at most {maximum} such hours in {edges // 2} days",
            _label_remedy(best),
        )
    found += (
        f" at {station.name}, and no shift of the row times explains them: its days are as long as "
        f"at about {_latitude_of_days(weather, station):+.0f} degrees of latitude"
    )
    if other[best] < 0.5 * against or against > MAX_CONTRADICTIONS_ANYWHERE * edges:
        raise _another_place(path, found)
    return found


def _another_place(path: Path, found: str) -> InputError:
    return InputError(
        path,
        found,
        "the sunrises and sunsets of the file's place",
        "check that the file is of this place: the direct light would be computed with the wrong "
        "sun",
    )


def _latitude_of_days(weather: Weather, station: Site) -> float:
    """Return the latitude, in steps of 5 degrees, whose sunrises and sunsets fit the light best."""
    against = {
        latitude: _against(weather, replace(station, latitude_deg=float(latitude)), 0)
        for latitude in range(-65, 70, 5)
    }
    fewest = min(against.values())
    return float(np.median([latitude for latitude in against if against[latitude] == fewest]))


def _against(weather: Weather, station: Site, shift_min: int) -> int:
    """Count the hours that contradict the sun after a shift of all labels (`hours_against`)."""
    shift = timedelta(minutes=shift_min)
    light = weather.dni_wm2 + weather.dhi_wm2
    return hours_against([t + shift for t in weather.t_utc], light, station)


def hours_against(
    times_utc: Sequence[datetime], light: Floats, station: Site, half: timedelta = _HALF
) -> int:
    """Count the hours that contradict sunrise or sunset.

    A span from `half` before to `half` after a time contradicts if it is lit with the sun down at
    both ends, or dark with the sun up at both ends. light : [n] DNI + DHI, W/m2.
    """
    before = sun.position([t - half for t in times_utc], station).altitude_deg
    after = sun.position([t + half for t in times_utc], station).altitude_deg
    is_down = np.maximum(before, after) < SUNK_DEG
    is_up = np.minimum(before, after) > RISEN_DEG
    lit_at_night = (light > LIGHT_WM2) & is_down
    dark_by_day = (light < DARK_WM2) & is_up
    return int(lit_at_night.sum() + dark_by_day.sum())
