"""Estimate the offset of a log's clock: on average, daylight is centred on solar noon."""

from datetime import UTC, datetime

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.records import Site
from fieldlum.sky import sun

LIT_WM2 = 10.0  # global irradiance [W/m2] with the sun at 1 (clear) to 4 degrees (overcast); chosen
# Smaller offsets are not reported: mornings and evenings whose clouds differ twentyfold shift the
# middle of the light by under 7 minutes. Chosen, with a margin of three.
CLOCK_WARN_S = 1200.0
_LONGEST_STORM_S = 7200.0  # longest dark spell within a day [s]; chosen, not measured
# Longest time [s] from the last dark to the first lit row, and at the end of the day. After a
# longer gap the start of the light is unknown. Chosen.
_MAX_DAWN_GAP_S = 900.0


def clock_off_s(t_unix_s: Floats, ghi_wm2: Floats, site: Site) -> float | None:
    """Return the offset of the log's clock: logged middle of the light minus solar noon [s].

    The middle is half way between the first and the last lit row of a day; the result is the median
    over the days of `complete_days`, -43 200 to 43 200 s, or None without one. Days on which the
    sun does not go 5 degrees above and below the horizon are omitted. A positive value means that
    logged times are later than the true ones: the clock is fast, or the stated offset from UTC is
    too small. t_unix_s, ghi_wm2 [n]: logged times and global irradiance, in order of time; rows
    with NaN irradiance are ignored.
    """
    finite = np.isfinite(ghi_wm2)
    days = complete_days(t_unix_s[finite], ghi_wm2[finite])
    middles = [datetime.fromtimestamp(0.5 * (first + last), UTC) for first, last in days]
    times = [t for t in middles if _rises_and_sets(t, site)]
    if not times:
        return None
    at = sun.position(times, site)
    east, north, up = sun.direction(at.altitude_deg, at.azimuth_deg).T
    latitude = np.radians(site.latitude_deg)
    hour_angle = np.arctan2(-east, np.cos(latitude) * up - np.sin(latitude) * north)  # rad
    return float(np.median(hour_angle)) / np.pi * 43_200.0


def _rises_and_sets(t_utc: datetime, site: Site) -> bool:
    """Return whether the sun goes 5 degrees above and below the horizon on that day."""
    declination = float(sun.declination_deg([t_utc])[0])
    depression = 90.0 - abs(site.latitude_deg + declination)
    highest = 90.0 - abs(site.latitude_deg - declination)
    return min(depression, highest) > 5.0  # otherwise clouds decide between day and night


def complete_days(t_unix_s: Floats, ghi_wm2: Floats) -> list[tuple[float, float]]:
    """Return the first and last lit time [unix s] of each day between two logged nights.

    A row is lit above 10 W/m2. Darkness under two hours, as in a storm, does not end a day. Omitted
    are days of less than two hours, and days without a dark row within 15 minutes before the first
    and after the last lit row. t_unix_s, ghi_wm2: times and global irradiance of the rows [n], in
    order of time; NaN counts as dark.
    """
    lit = ghi_wm2 > LIT_WM2
    # first and last rows of the lit spells that begin and end within the log
    starts = np.flatnonzero(lit & ~np.r_[True, lit[:-1]])
    ends = np.flatnonzero(lit & ~np.r_[lit[1:], True])
    ends = ends[ends >= starts.min(initial=len(lit))]
    days: list[tuple[int, int]] = []
    for start, end in zip(starts, ends, strict=False):  # a spell at the log's end has no end
        if days and t_unix_s[start] - t_unix_s[days[-1][1]] < _LONGEST_STORM_S:
            days[-1] = days[-1][0], int(end)
        else:
            days.append((int(start), int(end)))
    return [
        (float(t_unix_s[start]), float(t_unix_s[end]))
        for start, end in days
        if t_unix_s[start] - t_unix_s[start - 1] < _MAX_DAWN_GAP_S
        and t_unix_s[end + 1] - t_unix_s[end] < _MAX_DAWN_GAP_S
        and t_unix_s[end] - t_unix_s[start] > _LONGEST_STORM_S
    ]


def lit_at_night(t_unix_s: Floats, ghi_wm2: Floats, site: Site) -> list[datetime]:
    """Return the logged minutes with over 10 W/m2 while the sun is below -3 degrees.

    Each is the middle of its minute, in UTC. The sky then gives about 40 lx, or 0.4 W/m2: the
    logger's clock, the stated offset from UTC, or the sign of the longitude is wrong. Unlike
    `clock_off_s` this needs no complete day, but it does not estimate the offset, and can miss one
    of less than half an hour. t_unix_s, ghi_wm2: times and global irradiance of the rows [n], in
    any order.
    """
    minutes = np.unique(np.floor(t_unix_s[ghi_wm2 > LIT_WM2] / 60.0))
    moments = [datetime.fromtimestamp(60.0 * m + 30.0, UTC) for m in minutes]
    down = sun.position(moments, site).altitude_deg < -3.0
    return [moments[i] for i in np.flatnonzero(down)]
