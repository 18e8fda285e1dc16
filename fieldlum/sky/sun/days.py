"""Local days, seasons, and when the sun rises and sets."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, date, datetime, time, timedelta
from functools import lru_cache
from typing import NamedTuple
from zoneinfo import ZoneInfo

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.records import Site
from fieldlum.optics.projection import signed_angle_deg
from fieldlum.sky.sun.ephemeris import position


@lru_cache(maxsize=256)
def standard_offset(timezone: str, year: int) -> timedelta:
    """Return the UTC offset of local standard time: the smallest on the 15th of the year's months.

    The "dst" field of the time zone data is not used: for Ireland it marks winter as the exception.
    """
    zone = ZoneInfo(timezone)
    offsets = [
        datetime(year, month, 15, 12, tzinfo=zone).utcoffset() or timedelta()
        for month in range(1, 13)
    ]
    return min(offsets)


def zone_off_sun_h(site: Site) -> float:
    """Return local standard time minus the mean solar time of the longitude, -12 to 12 h.

    The result is 0 for UTC, which is no place's own time zone.
    """
    if site.timezone.removeprefix("Etc/") in ("UTC", "GMT", "UCT", "Zulu"):
        return 0.0
    standard = standard_offset(site.timezone, 2027)
    return (standard.total_seconds() / 3600 - site.longitude_deg / 15 + 12) % 24 - 12


def standard_time(t_utc: datetime, timezone: str) -> datetime:
    """Return a moment as local standard time, without summer time, naive, for labels and dates.

    Raises ValueError for a naive time.
    """
    if t_utc.tzinfo is None:
        raise ValueError(f"naive time {t_utc}: add a time zone")
    moment = t_utc.astimezone(UTC)
    return (moment + standard_offset(timezone, moment.year)).replace(tzinfo=None)


def standard_date(t_utc: datetime, timezone: str) -> date:
    """Return the date of a moment in local standard time. Raises ValueError for a naive time."""
    return standard_time(t_utc, timezone).date()


def standard_midnight(day: date, timezone: str) -> datetime:
    """Return the start of a local standard day, in UTC."""
    return datetime.combine(day, time(), tzinfo=UTC) - standard_offset(timezone, day.year)


def clock_changes(first: date, last: date, timezone: str) -> list[tuple[datetime, timedelta]]:
    """Return the clock changes from standard midnight at the start of `first` to the end of `last`.

    Each is (moment in UTC, new minus old UTC offset), in order; found to the half hour.
    """
    zone = ZoneInfo(timezone)
    start, changes = standard_midnight(first, timezone), []
    hours = ((last - first).days + 1) * 24
    before = start.astimezone(zone).utcoffset() or timedelta()
    # Every change of the last fifty years was on a half hour of UTC.
    for hour in range(1, hours * 2 + 1):
        moment = start + timedelta(minutes=30 * hour)
        now = moment.astimezone(zone).utcoffset() or timedelta()
        if now != before:
            changes.append((moment, now - before))
        before = now
    return changes


def _apparent_longitude_deg(unix_s: float) -> float:
    """Return the apparent geocentric ecliptic longitude of the sun, in deg.

    By the steps of Reda and Andreas 2004 (pvlib.spa).
    """
    from pvlib import spa

    ut = np.atleast_1d(unix_s)
    moment = datetime.fromtimestamp(unix_s, UTC)
    jde = spa.julian_ephemeris_day(
        spa.julian_day(ut), spa.calculate_deltat(moment.year, moment.month)
    )
    jce = spa.julian_ephemeris_century(jde)
    jme = spa.julian_ephemeris_millennium(jce)
    nutation = np.zeros((2, 1))  # filled in place: longitude, obliquity
    spa.longitude_obliquity_nutation(
        jce,
        spa.mean_elongation(jce),
        spa.mean_anomaly_sun(jce),
        spa.mean_anomaly_moon(jce),
        spa.moon_argument_latitude(jce),
        spa.moon_ascending_longitude(jce),
        nutation,
    )
    aberration = spa.aberration_correction(spa.heliocentric_radius_vector(jme))
    theta = spa.geocentric_longitude(spa.heliocentric_longitude(jme))
    return float(spa.apparent_sun_longitude(theta, nutation[0], aberration)[0])


@lru_cache(maxsize=128)
def season(year: int, which: int) -> datetime:
    """Return the moment at which the sun's apparent longitude is ``90 deg * which``.

    which : 0 March equinox, 1 June solstice, 2 September equinox, 3 December solstice; named by
    month, because "spring" is another season south of the equator. To the second in UTC; within a
    minute of the almanac's tables from 1950 to 2050.
    """
    month, target = (3, 6, 9, 12)[which], 90.0 * which
    moment = datetime(year, month, 21, tzinfo=UTC).timestamp()
    # Newton with the mean rate of the longitude: each step reduces the error about thirtyfold.
    for _ in range(8):
        behind = float(signed_angle_deg(target - _apparent_longitude_deg(moment)))
        moment += behind / 360.0 * 365.2422 * 86400.0
    return datetime.fromtimestamp(round(moment), UTC)


def declination_deg(times_utc: Sequence[datetime]) -> Floats:
    """Return the sun's declination, north positive, [n], in deg, correct to about 0.01 deg.

    Raises ValueError for naive times. It is computed as the true altitude of the sun at the pole.
    """
    return position(times_utc, Site("pole", 90.0, 0.0)).altitude_deg


class DayOfSun(NamedTuple):
    """Rise, transit and set of a local standard day, in UTC; None: it does not happen.

    Rise and set are those of the upper limb, with refraction.
    """

    rise: datetime | None
    transit: datetime | None
    set: datetime | None


# True altitude of the centre at rise and set: 34' of refraction and 16' of radius. Definition of
# the US Naval Observatory.
RISE_ALTITUDE_DEG = -0.8333


def rise_transit_set(days: Sequence[date], site: Site) -> list[DayOfSun]:
    """Return rise, transit and set of each local standard day, in the order of `days`.

    A polar night or a midnight sun has neither rise nor set. Crossings of the rise altitude and of
    the meridian are interpolated in positions every two minutes. pvlib's own times are wrong by up
    to a day's drift (85 s at Sydney's equinox) far from Greenwich, and by minutes where the sun
    touches the horizon.
    """
    events = []
    for day in days:
        start = standard_midnight(day, site.timezone)
        times = [start + timedelta(minutes=2 * k) for k in range(721)]
        at = position(times, site)
        above = at.altitude_deg - RISE_ALTITUDE_DEG
        west = -np.sin(np.radians(at.azimuth_deg)) * np.cos(np.radians(at.altitude_deg))
        crossings = (_rising_through_0(value, times) for value in (above, west, -above))
        events.append(DayOfSun(*crossings))
    return events


def _rising_through_0(value: Floats, times: Sequence[datetime]) -> datetime | None:
    """Return the first time at which a sampled value passes from below 0 to above, to a second."""
    at = np.flatnonzero((value[:-1] < 0.0) & (value[1:] >= 0.0))
    if not at.size:
        return None
    k = int(at[0])
    moment = times[k] + (times[k + 1] - times[k]) * float(value[k] / (value[k] - value[k + 1]))
    return (moment + timedelta(milliseconds=500)).replace(microsecond=0)
