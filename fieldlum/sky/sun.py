"""Compute sun position, seasons and components of sunlight by pvlib. Naive times are an error."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, date, datetime, time, timedelta
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple
from zoneinfo import ZoneInfo

import numpy as np

from fieldlum.core.arrays import ArrayLike, Floats, Mask, evenly_spread
from fieldlum.core.records import Site
from fieldlum.optics.projection import direction, signed_angle_deg  # callers read sun.direction

if TYPE_CHECKING:
    import pandas as pd

# ----------------------------------------------------------------------------------------------
# position

# 2 pi (1 - cos 0.2665 deg): the mean disc, as in Radiance's gendaylit.
SUN_SOLID_ANGLE_SR = 6.797e-5
OBLIQUITY_DEG = 23.44  # of the ecliptic in this century (IAU): the sun's largest declination
# Conditions of the standard atmosphere, hPa and deg C; 20 degrees or 2 km more change refraction by
# 7 % and 22 %, a hundredth of a degree with the sun at 10 degrees.
_STANDARD_HPA_C = (1013.25, 12.0)
_HORIZON_REFRACTION_DEG = 0.5667  # pvlib's default


class SunPosition(NamedTuple):
    """Sun positions, arrays [n] in deg.

    altitude_deg: without refraction; apparent_altitude_deg: with refraction, as in pictures;
    azimuth_deg: clockwise from north, in [0, 360).
    """

    altitude_deg: Floats
    apparent_altitude_deg: Floats
    azimuth_deg: Floats


def pandas_index(times_utc: Sequence[datetime]) -> pd.DatetimeIndex:
    """Return times as a pandas index in UTC. Raises ValueError for naive times."""
    import pandas as pd

    if any(t.tzinfo is None for t in times_utc):
        raise ValueError("naive time: add a time zone")
    return pd.DatetimeIndex(pd.to_datetime(list(times_utc), utc=True))


def position(times_utc: Sequence[datetime], site: Site) -> SunPosition:
    """Return the sun position by NREL's SPA (Reda and Andreas 2004, through pvlib).

    Arrays are in the order of times_utc, empty without times. Raises ValueError for naive times.
    """
    from pvlib.solarposition import get_solarposition

    index = pandas_index(times_utc)
    if len(index) == 0:
        return SunPosition(*np.empty((3, 0)))
    place = (site.latitude_deg, site.longitude_deg, site.altitude_m)
    table = get_solarposition(index, *place, method="nrel_numpy")
    names = ("elevation", "apparent_elevation", "azimuth")
    altitude, apparent, azimuth = (np.array(table[name], float) for name in names)
    return SunPosition(altitude, apparent, azimuth % 360.0)


def apparent_altitude_deg(altitude_deg: ArrayLike) -> Floats:
    """Return the altitude at which a picture shows the sun, from the true one, [...] deg.

    altitude_deg: true altitude of its centre [...]. Refraction by SPA's formula (Bennett 1982, Reda
    and Andreas 2004) at standard pressure and 12 C: 0.16 degrees at 5 degrees, 0.09 at 10; none for
    a sun that is below the visible horizon.
    """
    from pvlib import spa

    altitude = np.asarray(altitude_deg, float)
    visible = altitude >= -(0.26667 + _HORIZON_REFRACTION_DEG)  # SPA's radius of the disc
    arguments = (*_STANDARD_HPA_C, np.where(visible, altitude, 0.0), _HORIZON_REFRACTION_DEG)
    return altitude + np.where(visible, spa.atmospheric_refraction_correction(*arguments), 0.0)


# ----------------------------------------------------------------------------------------------
# local days, seasons, rise and set


@lru_cache(maxsize=256)
def standard_offset(timezone: str, year: int) -> timedelta:
    """Return the UTC offset of local standard time: the smallest on the 15th of the year's months.

    timezone: IANA name; raises zoneinfo.ZoneInfoNotFoundError for an unknown one. The "dst" field
    of the time zone data is not used: for Ireland it marks winter as the exception.
    """
    zone = ZoneInfo(timezone)
    noons = (datetime(year, month, 15, 12, tzinfo=zone) for month in range(1, 13))
    return min(noon.utcoffset() or timedelta() for noon in noons)


def zone_off_sun_h(site: Site) -> float:
    """Return local standard time minus mean solar time at the site's longitude, -12 to 12 h.

    The result is 0 for UTC, which is not a time zone chosen for the place.
    """
    if site.timezone.removeprefix("Etc/") in ("UTC", "GMT", "UCT", "Zulu"):
        return 0.0
    standard = standard_offset(site.timezone, 2027)
    return (standard.total_seconds() / 3600 - site.longitude_deg / 15 + 12) % 24 - 12


def standard_time(t_utc: datetime, timezone: str) -> datetime:
    """Return a moment as local standard time, without summer time, naive, for labels and dates.

    timezone: IANA name. Raises ValueError for a naive time.
    """
    if t_utc.tzinfo is None:
        raise ValueError(f"naive time {t_utc}: add a time zone")
    moment = t_utc.astimezone(UTC)
    return (moment + standard_offset(timezone, moment.year)).replace(tzinfo=None)


def standard_date(t_utc: datetime, timezone: str) -> date:
    """Return the date of a moment in local standard time of an IANA zone.

    Raises ValueError for a naive time.
    """
    return standard_time(t_utc, timezone).date()


def hour_of_year(t_utc: datetime, timezone: str) -> int:
    """Return the hour, from 0, of a year of 365 days in which a moment is, in local standard time.

    timezone: IANA name. 29 February counts as the 28th. Raises ValueError for a naive time.
    """
    local = standard_time(t_utc, timezone)
    day = min(local.day, 28) if local.month == 2 else local.day
    return (date(2027, local.month, day) - date(2027, 1, 1)).days * 24 + local.hour


def standard_midnight(day: date, timezone: str) -> datetime:
    """Return the start of a local standard day, in UTC; timezone: IANA name."""
    return datetime.combine(day, time(), tzinfo=UTC) - standard_offset(timezone, day.year)


def clock_changes(first: date, last: date, timezone: str) -> list[tuple[datetime, timedelta]]:
    """Return the clock changes of the local standard days `first` to `last`, included, in order.

    timezone: IANA name. Each is (moment in UTC, new minus old UTC offset), to the half hour: every
    change of the last fifty years was on one. Empty without a change.
    """
    zone, half_hour = ZoneInfo(timezone), timedelta(minutes=30)
    start, count = standard_midnight(first, timezone), 48 * ((last - first).days + 1)
    moments = [start + half_hour * k for k in range(count + 1)]
    offsets = [moment.astimezone(zone).utcoffset() or timedelta() for moment in moments]
    steps = [after - before for before, after in pairwise(offsets)]
    return [(moment, step) for moment, step in zip(moments[1:], steps, strict=True) if step]


@lru_cache(maxsize=128)
def season(year: int, which: int) -> datetime:
    """Return the moment of an equinox or a solstice in UTC, to the second.

    year: of the calendar; which: 0 March equinox, 1 June solstice, 2 September equinox, 3 December
    solstice: the sun's apparent right ascension by SPA is then ``90 deg * which``. Its ecliptic
    longitude, which defines the seasons, has this value up to 9 s earlier or later (2015 to 2039).
    It is within a minute of the almanac's tables from 1950 to 2050.
    """
    from pvlib import spa

    moment = datetime(year, 3 + 3 * which, 21, tzinfo=UTC)
    delta_t = spa.calculate_deltat(year, moment.month)
    # Newton with the mean rate of the angle: each step reduces the error at least sevenfold.
    for _ in range(8):
        unix_s = np.array([moment.timestamp()])
        # with sst=True: sidereal time, right ascension and declination, whatever the place is
        angles_deg = spa.solar_position_numpy(unix_s, 0, 0, 0, 0, 0, delta_t, 0, 1, sst=True)
        behind = float(signed_angle_deg(90.0 * which - np.ravel(angles_deg)[1]))
        moment += timedelta(days=behind / 360.0 * 365.2422)
    return (moment + timedelta(seconds=0.5)).replace(microsecond=0)


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


def rise_transit_set(day: date, site: Site) -> DayOfSun:
    """Return rise, transit and set of a local standard day in UTC, each to the minute.

    Rise and set are those of the upper limb, with refraction; None if the event does not happen.
    pvlib's own times are wrong by up to a day's drift (85 s at Sydney's equinox) far from
    Greenwich, and by minutes where the sun touches the horizon.
    """
    start = standard_midnight(day, site.timezone)
    times = [start + timedelta(minutes=k) for k in range(1441)]
    at = position(times, site)
    above = at.altitude_deg - RISE_ALTITUDE_DEG
    west = -direction(at.altitude_deg, at.azimuth_deg)[:, 0]
    # each event is where one of these passes 0 upwards
    events = (np.flatnonzero((v[:-1] < 0.0) & (v[1:] >= 0.0)) for v in (above, west, -above))
    return DayOfSun(*(times[minutes[0]] if minutes.size else None for minutes in events))


# ----------------------------------------------------------------------------------------------
# components of sunlight

# Below this altitude a horizontal error of 10 W/m2 is over 100 W/m2 of DNI: mark such values.
# Chosen.
LOW_SUN_DEG = 5.0
ZERO_OFFSET_WM2 = 2.0  # of a horizontal reading (ISO 9060, zero offset B of class A)
# Above this altitude shares and ratios of horizontal readings can be tested. Chosen, not measured.
CLEAR_SUN_DEG = 10.0
# Global of clear hours over that of pvlib's cloudless sky, median: 0.99 to 1.10 in three months of
# DTU's station and in four weather files, 1.13 to 1.17 in four days of Patras, 0.77 under haze that
# takes 30 % of the beam. Chosen around these.
_CLEAR_RATIO = (0.75, 1.2)


@contextmanager
def _ignore_dayofyear_warning() -> Iterator[None]:
    """Ignore a warning: pvlib 0.16 uses `dayofyear` of pandas 3.1, which has a new name."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="DatetimeIndex.dayofyear is deprecated")
        yield


def extraterrestrial_wm2(times_utc: Sequence[datetime]) -> Floats:
    """Return the irradiance on a plane normal to the sun above the atmosphere, [n], in W/m2.

    Spencer 1971, through pvlib, with its solar constant of 1366.1 W/m2. Raises ValueError for naive
    times.
    """
    from pvlib.irradiance import get_extra_radiation

    with _ignore_dayofyear_warning():
        return np.asarray(get_extra_radiation(pandas_index(times_utc)), float)


@dataclass(frozen=True, slots=True, kw_only=True)
class Irradiance:
    """Global and diffuse horizontal, direct normal irradiance [n] W/m2; NaN: unknown."""

    ghi_wm2: Floats
    dhi_wm2: Floats
    dni_wm2: Floats


def clearsky(times_utc: Sequence[datetime], site: Site) -> Irradiance:
    """Return the irradiance of a cloudless sky, [n] each, in W/m2.

    Ineichen and Perez 2002 with pvlib's monthly turbidity, which needs no network. Raises
    ValueError for naive times.
    """
    import pandas as pd
    from pvlib.location import Location

    place = Location(site.latitude_deg, site.longitude_deg, "UTC", site.altitude_m)
    index, altitude = pandas_index(times_utc), position(times_utc, site).apparent_altitude_deg
    angles = {"apparent_elevation": altitude, "apparent_zenith": 90.0 - altitude}
    known = pd.DataFrame(angles, index=index)
    with _ignore_dayofyear_warning():
        table = place.get_clearsky(index, model="ineichen", solar_position=known)
    return Irradiance(**{f"{n}_wm2": np.asarray(table[n], float) for n in ("ghi", "dhi", "dni")})


def wrong_level(
    times_utc: Sequence[datetime],
    ghi_wm2: Floats,
    dhi_wm2: Floats,
    altitude_deg: Floats,
    site: Site,
) -> str:
    """Return a text if clear rows are not as bright as a cloudless sky, "" if they are.

    The sensitivity, unit or calibration is then wrong, which no ratio of two components shows.
    ghi_wm2, dhi_wm2, altitude_deg (true): [n]. A row is clear if its diffuse irradiance is under a
    fifth of the global, the global over 50 W/m2 and the sun over 15 degrees high. As bright: the
    median ratio of the global to that of `clearsky` is 0.75 to 1.2 (chosen around measured years).
    Fewer than ten clear rows give "". Raises ValueError for naive times.
    """
    rows = np.flatnonzero((dhi_wm2 < 0.2 * ghi_wm2) & (ghi_wm2 > 50.0) & (altitude_deg > 15.0))
    if len(rows) < 10:
        return ""
    rows = rows[evenly_spread(len(rows), 500)]
    cloudless = clearsky([times_utc[row] for row in rows], site).ghi_wm2
    ratio, (low, high) = float(np.median(ghi_wm2[rows] / cloudless)), _CLEAR_RATIO
    if low < ratio < high:
        return ""
    found = f"global irradiance of clear hours is {ratio:.2f} times that of a cloudless sky"
    return f"{found}, expected {low:g} to {high:g}"


def dirint_dni(ghi_wm2: ArrayLike, times_utc: Sequence[datetime], site: Site) -> Floats:
    """Return DNI from a regular series of global irradiance by DIRINT, [n], in W/m2.

    Perez et al. 1992, through pvlib: the best of pvlib's decompositions on BSRN Payerne, June 2016,
    with RMSE 92 W/m2 (38 %) by the minute and 70 (30 %) by the hour. It uses neighbours: the series
    must be complete, sorted and evenly spaced. Zero with the sun under 3 degrees; NaN where the
    global is NaN. Raises ValueError for naive times.
    """
    from pvlib.atmosphere import alt2pres
    from pvlib.irradiance import dirint

    ghi = np.asarray(ghi_wm2, float)
    zenith = 90.0 - position(times_utc, site).altitude_deg
    with np.errstate(divide="ignore", invalid="ignore"), _ignore_dayofyear_warning():
        series = (np.maximum(ghi, 0.0), zenith, pandas_index(times_utc))
        computed = dirint(*series, pressure=alt2pres(site.altitude_m))
    dni = np.nan_to_num(np.asarray(computed, float), nan=0.0)
    # The beam never exceeds what the global allows, nor the irradiance above the atmosphere.
    ceiling = np.maximum(ghi, 0.0) / np.maximum(np.cos(np.radians(zenith)), np.sin(np.radians(1.0)))
    dni = np.minimum(dni, np.minimum(np.nan_to_num(ceiling), extraterrestrial_wm2(times_utc)))
    return np.where(np.isnan(ghi), np.nan, np.where(zenith > 87.0, 0.0, dni))


def horizontal_beam(normal: ArrayLike, altitude_deg: ArrayLike) -> Floats:
    """Return the horizontal component of direct normal light, in its unit, [n]; 0 after sunset.

    normal: irradiance or illuminance on a plane normal to the sun [n]; altitude_deg: true altitude
    of the sun [n].
    """
    return np.asarray(normal, float) * np.maximum(np.sin(np.radians(altitude_deg)), 0.0)


def dhi_by_closure(ghi_wm2: ArrayLike, dni_wm2: ArrayLike, altitude_deg: ArrayLike) -> Floats:
    """Return diffuse = global - DNI sin(altitude), never negative, [n], in W/m2.

    ghi_wm2, dni_wm2, altitude_deg (true): [n] each. With the sun below the horizon it is the
    global.
    """
    return np.maximum(np.asarray(ghi_wm2, float) - horizontal_beam(dni_wm2, altitude_deg), 0.0)


def dni_by_closure(ghi_wm2: ArrayLike, dhi_wm2: ArrayLike, altitude_deg: ArrayLike) -> Floats:
    """Return DNI = (global - diffuse) / sin(altitude), [n], in W/m2.

    ghi_wm2, dhi_wm2, altitude_deg (true): [n] each. Noise can make it negative: values are not
    clipped, so that a mean has no bias. Zero at altitudes up to 2 degrees, where it cannot be
    determined.
    """
    altitude = np.asarray(altitude_deg, float)
    sine = np.sin(np.radians(np.maximum(altitude, 2.0)))
    beam = np.asarray(ghi_wm2, float) - np.asarray(dhi_wm2, float)
    return np.where(altitude > 2.0, beam / sine, 0.0)


class Limits(NamedTuple):
    """Lowest (one number) and highest plausible value [n] of each component, in W/m2."""

    ghi_wm2: tuple[float, Floats]
    dhi_wm2: tuple[float, Floats]
    dni_wm2: tuple[float, Floats]


# By whether the extremely rare limits are meant: lowest value; factor, power and offset of the
# highest GHI, DHI and DNI.
_BSRN = {
    False: (-4.0, ((1.5, 1.2, 100.0), (0.95, 1.2, 50.0), (1.0, 0.0, 0.0))),
    True: (-2.0, ((1.2, 1.2, 50.0), (0.75, 1.2, 30.0), (0.95, 0.2, 10.0))),
}


def bsrn_limits(
    altitude_deg: ArrayLike, extraterrestrial: ArrayLike, *, extreme: bool = False
) -> Limits:
    """Return BSRN's limits of irradiance: the physically possible ones, or the extremely rare ones.

    Source: Long and Dutton 2002 (QCRad). Each of GHI, DHI and DNI has a lowest and a highest value.
    altitude_deg: [n], below 0 counts as 0; extraterrestrial: [n] on a plane normal to the sun,
    W/m2. extreme: return the narrower limits, which are exceeded extremely rarely.
    """
    sine = np.maximum(np.sin(np.radians(altitude_deg)), 0.0)
    top = np.asarray(extraterrestrial, float)
    low, terms = _BSRN[extreme]
    ghi, dhi, dni = ((low, factor * top * sine**power + offset) for factor, power, offset in terms)
    return Limits(ghi_wm2=ghi, dhi_wm2=dhi, dni_wm2=dni)


def too_weak(ghi_wm2: ArrayLike, altitude_deg: ArrayLike, extraterrestrial: ArrayLike) -> Mask:
    """Return a mask [n] of rows with less global irradiance than under any cloud.

    It is less than 0.5 % of extraterrestrial sin(altitude): the instrument is covered or dead, or
    the unit is kW/m2. The darkest storm transmits ten times as much, a file in kW/m2 has a seventh.
    ghi_wm2, altitude_deg (true), extraterrestrial [W/m2]: [n] each. False for a sun up to 10
    degrees.
    """
    is_high = np.asarray(altitude_deg, float) > CLEAR_SUN_DEG
    top = horizontal_beam(extraterrestrial, altitude_deg)
    return is_high & (np.asarray(ghi_wm2, float) < 0.005 * top)


def closure_ratio(
    ghi_wm2: ArrayLike, dhi_wm2: ArrayLike, dni_wm2: ArrayLike, altitude_deg: ArrayLike
) -> Floats:
    """Return the ratio of global to diffuse + DNI sin(altitude), 1 for consistent rows, [n].

    All arguments: [n], altitude_deg: true altitude of the sun. NaN (not testable) where the sum of
    diffuse and direct is not over 50 W/m2.
    """
    total = np.asarray(dhi_wm2, float) + horizontal_beam(dni_wm2, altitude_deg)
    return np.divide(ghi_wm2, total, out=np.full(total.shape, np.nan), where=total > 50.0)


def celestial_pole(latitude_deg: float) -> Floats:
    """Return the unit vector to the north celestial pole, [3] (x east, y north, z up)."""
    latitude = np.radians(latitude_deg)
    return np.array([0.0, np.cos(latitude), np.sin(latitude)])
