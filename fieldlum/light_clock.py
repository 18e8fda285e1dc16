"""What the time is by the light itself: logged days of light are centred on solar noon, whatever the clouds do."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from fieldlum import sun
from fieldlum.records import Site

Array = NDArray[np.float64]

LIT_WM2 = 10.0  # the global crosses it with the sun at 1 (clear) to 4 degrees (overcast)
CLOCK_WARN_S = 1200.0  # mornings and evenings whose clouds differ twentyfold shift the middle by under 7 minutes
_SETS_DEG = 5.0  # the night's lowest sun, and the day's highest: else clouds make day and night
_LONGEST_STORM_S = 7200.0  # a darker spell within a day
_NIGHT_SUN_DEG = -3.0  # 40 lx at most, 0.4 W/m2; an hour of daylight saving lights it at every dusk or every dawn
_SEEN_DARK_S = 900.0  # before and after the day; rows further apart than this do not show when it began


def clock_off_s(t_unix_s: Array, ghi_wm2: Array, site: Site) -> float | None:
    """Median over days of (logged middle of the light minus solar noon); None where no whole day was logged.

    t_unix_s, ghi_wm2 [n]: rows in order of time. A positive answer is a clock that is fast, or an offset from UTC that
    was told too small: -43 200 to 43 200 s.
    """
    known = np.isfinite(ghi_wm2)
    middles = [0.5 * (first + last) for first, last in whole_days(t_unix_s[known], ghi_wm2[known])]
    times = [t for m in middles if _rises_and_sets(t := datetime.fromtimestamp(m, UTC), site)]
    if not times:
        return None
    at = sun.position(times, site)
    east, north, up = sun.direction(at.altitude_deg, at.azimuth_deg).T
    latitude = np.radians(site.latitude_deg)
    hour_angle = np.arctan2(-east, np.cos(latitude) * up - np.sin(latitude) * north)
    return float(np.median(hour_angle)) / np.pi * 43_200.0


def _rises_and_sets(t_utc: datetime, site: Site) -> bool:
    declination = float(sun.declination_deg([t_utc])[0])
    lowest = abs(site.latitude_deg + declination) - 90.0
    highest = 90.0 - abs(site.latitude_deg - declination)
    return lowest < -_SETS_DEG and highest > _SETS_DEG


def whole_days(t_unix_s: Array, ghi_wm2: Array) -> list[tuple[float, float]]:
    """First and last moment of each spell of light that has darkness, logged without a gap, on either side."""
    lit = ghi_wm2 > LIT_WM2
    starts = np.flatnonzero(lit & ~np.r_[True, lit[:-1]])
    ends = np.flatnonzero(lit & ~np.r_[lit[1:], True])
    if not len(starts) or not len(ends):
        return []
    ends = ends[ends >= starts[0]]
    starts = starts[: len(ends)]
    days: list[tuple[int, int]] = []
    for start, end in zip(starts, ends, strict=False):
        if days and t_unix_s[start] - t_unix_s[days[-1][1]] < _LONGEST_STORM_S:
            days[-1] = days[-1][0], int(end)
        else:
            days.append((int(start), int(end)))
    return [
        (float(t_unix_s[start]), float(t_unix_s[end]))
        for start, end in days
        if t_unix_s[start] - t_unix_s[start - 1] < _SEEN_DARK_S
        and t_unix_s[end + 1] - t_unix_s[end] < _SEEN_DARK_S
        and t_unix_s[end] - t_unix_s[start] > _LONGEST_STORM_S
    ]


def lit_at_night(t_unix_s: Array, ghi_wm2: Array, site: Site) -> list[datetime]:
    """Minutes with light while the sun is well down: the logger's clock, the offset told, or the longitude's sign.

    Unlike `clock_off_s` this needs no whole day, but tells no figure, and nothing under half an hour.
    """
    minutes = np.unique(np.floor(t_unix_s[ghi_wm2 > LIT_WM2] / 60.0))
    if len(minutes) == 0:
        return []
    moments = [datetime.fromtimestamp(60.0 * m + 30.0, UTC) for m in minutes]
    down = sun.position(moments, site).altitude_deg < _NIGHT_SUN_DEG
    return [moments[i] for i in np.flatnonzero(down)]
