"""Sun position, seasons, and the components of sunlight, by pvlib; naive times are refused.

Heavy imports stay inside the functions.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, date, datetime, time, timedelta
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fieldlum.projection import direction as direction  # callers read sun.direction
from fieldlum.projection import signed_angle_deg
from fieldlum.records import Site

if TYPE_CHECKING:
    import pandas as pd

# 2 pi (1 - cos 0.2665 deg): the mean disc, as in Radiance's gendaylit.
SUN_SOLID_ANGLE_SR = 6.797e-5
# Below this altitude a horizontal error of 10 W/m2 is over 100 W/m2 of DNI: mark such values.
LOW_SUN_DEG = 5.0
# Above this altitude shares and ratios of horizontal readings can be tested. Chosen, not measured.
CLEAR_SUN_DEG = 10.0
# Global over extraterrestrial light, at least; the darkest storm transmits ten times as much, a
# file in kW has a thousandth. Chosen, not measured.
LEAST_CLEARNESS = 0.005


# Conditions of the standard atmosphere, hPa and deg C; 20 degrees or 2 km more change refraction by
# 7 % and 22 %, a hundredth of a degree with the sun at 10 degrees.
_STANDARD_PRESSURE_HPA, _STANDARD_TEMPERATURE_C = 1013.25, 12.0
_HORIZON_REFRACTION_DEG = (
    0.5667  # pvlib's default; 0.27 degrees (the disc) below it nothing is seen
)


class SunPosition(NamedTuple):
    """Sun positions, arrays [n] in deg.

    True altitude (physics), apparent altitude (pictures), azimuth clockwise from north.
    """

    altitude_deg: NDArray[np.float64]
    apparent_altitude_deg: NDArray[np.float64]
    azimuth_deg: NDArray[np.float64]


def _index(times_utc: Sequence[datetime], who: str) -> pd.DatetimeIndex:
    """Return times for pvlib. Raises ValueError for naive times, which pvlib would read as UTC."""
    import pandas as pd

    if any(t.tzinfo is None for t in times_utc):
        raise ValueError(f"naive time given to sun.{who}; add a time zone")
    return pd.DatetimeIndex(pd.to_datetime(list(times_utc), utc=True))


def position(times_utc: Sequence[datetime], site: Site) -> SunPosition:
    """Return the sun position by NREL's SPA (Reda and Andreas 2004, through pvlib).

    Raises ValueError for naive times.
    """
    from pvlib.solarposition import get_solarposition

    index = _index(times_utc, "position")
    if len(index) == 0:
        return SunPosition(np.empty(0), np.empty(0), np.empty(0))
    found = get_solarposition(
        index, site.latitude_deg, site.longitude_deg, site.altitude_m, method="nrel_numpy"
    )
    return SunPosition(
        np.asarray(found["elevation"], float),
        np.asarray(found["apparent_elevation"], float),
        np.asarray(found["azimuth"], float) % 360.0,
    )


def shown_altitude_deg(altitude_deg: ArrayLike) -> NDArray[np.float64]:
    """Return the altitude at which a picture shows the sun, from the true one, [n] deg.

    Refraction by SPA's formula (Bennett 1982, Reda and Andreas 2004) at standard pressure and 12 C:
    0.16 degrees at 5 degrees, 0.09 at 10; none for a sun that is below the visible horizon.
    """
    from pvlib import spa

    altitude = np.asarray(altitude_deg, float)
    visible = altitude >= -(0.26667 + _HORIZON_REFRACTION_DEG)
    raised = spa.atmospheric_refraction_correction(
        _STANDARD_PRESSURE_HPA,
        _STANDARD_TEMPERATURE_C,
        np.where(visible, altitude, 0.0),
        _HORIZON_REFRACTION_DEG,
    )
    return altitude + np.where(visible, raised, 0.0)


# ----------------------------------------------------------------------------------------------
# days and seasons


@lru_cache(maxsize=256)
def standard_offset(timezone: str, year: int) -> timedelta:
    """Return the UTC offset of local standard time: the year's smallest.

    Daylight saving always adds to it. The "dst" field of the time zone data is not used: for
    Ireland it marks winter as the exception.
    """
    zone = ZoneInfo(timezone)
    offsets = [
        datetime(year, month, 15, 12, tzinfo=zone).utcoffset() or timedelta()
        for month in range(1, 13)
    ]
    return min(offsets)


def zone_off_sun_h(site: Site) -> float:
    """Return the zone's standard time minus the longitude's mean solar time, -12 to 12 h.

    0 for UTC, which is the time of no place.
    """
    if site.timezone.removeprefix("Etc/") in ("UTC", "GMT", "UCT", "Zulu"):
        return 0.0
    standard = standard_offset(site.timezone, 2027)
    return (standard.total_seconds() / 3600 - site.longitude_deg / 15 + 12) % 24 - 12


def standard_time(t_utc: datetime, timezone: str) -> datetime:
    """Return a moment as local standard time, naive, for labels and dates.

    Raises ValueError for a naive time.
    """
    if t_utc.tzinfo is None:
        raise ValueError(f"naive time {t_utc}: add a time zone")
    moment = t_utc.astimezone(UTC)
    return (moment + standard_offset(timezone, moment.year)).replace(tzinfo=None)


def standard_date(t_utc: datetime, timezone: str) -> date:
    """Return the local standard date of a moment."""
    return standard_time(t_utc, timezone).date()


def standard_midnight(day: date, timezone: str) -> datetime:
    """Return the start of a local standard day, in UTC."""
    return datetime.combine(day, time(), tzinfo=UTC) - standard_offset(timezone, day.year)


def clock_changes(first: date, last: date, timezone: str) -> list[tuple[datetime, timedelta]]:
    """Return daylight-saving changes from local midnight of `first` to that after `last`.

    Each is (moment in UTC, change).
    """
    zone = ZoneInfo(timezone)
    start, found = standard_midnight(first, timezone), []
    hours = ((last - first).days + 1) * 24
    before = start.astimezone(zone).utcoffset() or timedelta()
    # Every change of the last fifty years was on a half hour of UTC.
    for hour in range(1, hours * 2 + 1):
        moment = start + timedelta(minutes=30 * hour)
        now = moment.astimezone(zone).utcoffset() or timedelta()
        if now != before:
            found.append((moment, now - before))
        before = now
    return found


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


def declination_deg(times_utc: Sequence[datetime]) -> NDArray[np.float64]:
    """Return the sun's declination, [n], in deg, to about 0.01: the true altitude at the pole."""
    return position(times_utc, Site("pole", 90.0, 0.0)).altitude_deg


class DayOfSun(NamedTuple):
    """Rise, transit and set of a local standard day, in UTC; None: it does not happen.

    Rise and set are those of the upper limb, with refraction.
    """

    rise: datetime | None
    transit: datetime | None
    set: datetime | None


# True altitude of the centre at rise and set: 34' of refraction and 16' of radius.
RISE_ALTITUDE_DEG = -0.8333


def rise_transit_set(days: Sequence[date], site: Site) -> list[DayOfSun]:
    """Return rise, transit and set of days, by pvlib's SPA, refined with `position`.

    A polar night or a midnight sun has neither rise nor set. pvlib alone is wrong by up to a day's
    drift (85 s at Sydney's equinox) far from Greenwich, and by minutes where the sun touches the
    horizon.
    """
    import pandas as pd
    from pvlib.solarposition import sun_rise_set_transit_spa

    if not days:
        return []
    # pvlib assigns events to calendar days of the longitude. A zone across the date line has other
    # days, so the days before and after are computed too.
    calendar_days = sorted({day + timedelta(days=k) for day in days for k in (-1, 0, 1)})
    index = pd.DatetimeIndex([pd.Timestamp(day) for day in calendar_days]).tz_localize("UTC")
    table = sun_rise_set_transit_spa(index, site.latitude_deg, site.longitude_deg)
    columns = [
        pd.to_datetime(table[name].dropna(), utc=True).dt.floor("s")
        for name in ("sunrise", "transit", "sunset")
    ]
    rise, transit, down = ([t.to_pydatetime() for t in column] for column in columns)
    found = (_refined(rise, site), transit, _refined(down, site))
    starts = [standard_midnight(day, site.timezone) for day in days]
    return [DayOfSun(*(_within_a_day(moments, start) for moments in found)) for start in starts]


def _within_a_day(moments: Sequence[datetime], start: datetime) -> datetime | None:
    return next((t for t in moments if start <= t < start + timedelta(days=1)), None)


def _refined(moments: Sequence[datetime], site: Site) -> list[datetime]:
    """Return times after three Newton steps to the rise altitude, each at most ten minutes."""
    known = list(moments)
    for _ in range(3 if known else 0):
        before, after = (
            position([t + timedelta(seconds=s) for t in known], site).altitude_deg
            for s in (-60, 60)
        )
        rate = (after - before) / 120.0
        wanted = (RISE_ALTITUDE_DEG - (before + after) / 2) / np.where(
            np.abs(rate) > 1e-6, rate, 1e-6
        )
        steps = np.clip(wanted, -600, 600)
        known = [t + timedelta(seconds=round(float(s))) for t, s in zip(known, steps, strict=True)]
    return known


# ----------------------------------------------------------------------------------------------
# irradiance


@contextmanager
def _old_names() -> Iterator[None]:
    """Ignore a warning: pvlib 0.16 uses `dayofyear` of pandas 3.1, which has a new name."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="DatetimeIndex.dayofyear is deprecated")
        yield


def extraterrestrial_wm2(times_utc: Sequence[datetime]) -> NDArray[np.float64]:
    """Return the irradiance on a plane normal to the sun above the atmosphere, [n], in W/m2.

    Spencer 1971, through pvlib.
    """
    from pvlib.irradiance import get_extra_radiation

    with _old_names():
        return np.asarray(get_extra_radiation(_index(times_utc, "extraterrestrial_wm2")), float)


class Irradiance(NamedTuple):
    """Global, direct normal and diffuse irradiance, arrays [n] in W/m2."""

    ghi_wm2: NDArray[np.float64]
    dni_wm2: NDArray[np.float64]
    dhi_wm2: NDArray[np.float64]


def clearsky(times_utc: Sequence[datetime], site: Site) -> Irradiance:
    """Return the irradiance of a cloudless sky, [n] each, in W/m2.

    Ineichen and Perez 2002 with pvlib's monthly turbidity, which needs no network.
    """
    from pvlib.location import Location

    place = Location(site.latitude_deg, site.longitude_deg, "UTC", site.altitude_m)
    with _old_names():
        found = place.get_clearsky(_index(times_utc, "clearsky"), model="ineichen")
    return Irradiance(*(np.asarray(found[name], float) for name in ("ghi", "dni", "dhi")))


def dirint_dni(
    ghi_wm2: ArrayLike, times_utc: Sequence[datetime], site: Site
) -> NDArray[np.float64]:
    """Return DNI from a regular series of global irradiance by DIRINT, [n], in W/m2.

    Perez et al. 1992, through pvlib: the best of pvlib's decompositions on BSRN Payerne, June 2016,
    with RMSE 92 W/m2 (38 %) by the minute and 70 (30 %) by the hour. It uses neighbours: the series
    must be complete, sorted and evenly spaced. Zero with the sun under 3 degrees; NaN where the
    global is NaN.
    """
    from pvlib.atmosphere import alt2pres
    from pvlib.irradiance import dirint

    ghi = np.asarray(ghi_wm2, float)
    zenith = 90.0 - position(times_utc, site).altitude_deg
    with np.errstate(divide="ignore", invalid="ignore"), _old_names():
        found = dirint(
            np.maximum(ghi, 0.0),
            zenith,
            _index(times_utc, "dirint_dni"),
            pressure=alt2pres(site.altitude_m),
        )
    dni = np.nan_to_num(np.asarray(found, float), nan=0.0)
    # The beam never exceeds what the global allows, nor the irradiance above the atmosphere.
    ceiling = np.maximum(ghi, 0.0) / np.maximum(np.cos(np.radians(zenith)), np.sin(np.radians(1.0)))
    dni = np.minimum(dni, np.minimum(np.nan_to_num(ceiling), extraterrestrial_wm2(times_utc)))
    return np.where(np.isnan(ghi), np.nan, np.where(zenith > 87.0, 0.0, dni))


def dhi_by_closure(
    ghi_wm2: ArrayLike, dni_wm2: ArrayLike, altitude_deg: ArrayLike
) -> NDArray[np.float64]:
    """Return diffuse = global - DNI sin(altitude), never negative, [n], in W/m2."""
    beam = np.asarray(dni_wm2, float) * np.maximum(np.sin(np.radians(altitude_deg)), 0.0)
    return np.maximum(np.asarray(ghi_wm2, float) - beam, 0.0)


def dni_by_closure(
    ghi_wm2: ArrayLike, dhi_wm2: ArrayLike, altitude_deg: ArrayLike
) -> NDArray[np.float64]:
    """Return DNI = (global - diffuse) / sin(altitude), [n], in W/m2.

    Negative where noise makes it so: a mean over rows is then without bias. Zero under 2 degrees,
    where it cannot be determined.
    """
    altitude = np.asarray(altitude_deg, float)
    sine = np.sin(np.radians(np.maximum(altitude, 2.0)))
    beam = np.asarray(ghi_wm2, float) - np.asarray(dhi_wm2, float)
    return np.where(altitude > 2.0, beam / sine, 0.0)


class Limits(NamedTuple):
    """Lowest and highest plausible value [n] of each component, in W/m2."""

    ghi_wm2: tuple[float, NDArray[np.float64]]
    dhi_wm2: tuple[float, NDArray[np.float64]]
    dni_wm2: tuple[float, NDArray[np.float64]]


def bsrn_limits(
    altitude_deg: ArrayLike, extraterrestrial: ArrayLike, *, extreme: bool = False
) -> Limits:
    """Return BSRN's physically possible (default) or extremely rare limits.

    Source: Long and Dutton 2002 (QCRad).

    altitude_deg, extraterrestrial (W/m2) : [n].
    """
    mu = np.maximum(np.sin(np.radians(altitude_deg)), 0.0)
    sa = np.asarray(extraterrestrial, float)
    if extreme:
        return Limits(
            (-2.0, 1.2 * sa * mu**1.2 + 50.0),
            (-2.0, 0.75 * sa * mu**1.2 + 30.0),
            (-2.0, 0.95 * sa * mu**0.2 + 10.0),
        )
    return Limits(
        (-4.0, 1.5 * sa * mu**1.2 + 100.0),
        (-4.0, 0.95 * sa * mu**1.2 + 50.0),
        (-4.0, sa + 0.0 * mu),
    )


def too_weak(
    ghi_wm2: ArrayLike, altitude_deg: ArrayLike, extraterrestrial: ArrayLike
) -> NDArray[np.bool_]:
    """Return where the global light is less than any sky transmits, [n]; False for a low sun.

    Then the instrument is covered or dead, or the unit is kW/m2.
    """
    altitude = np.asarray(altitude_deg, float)
    top = np.asarray(extraterrestrial, float) * np.sin(np.radians(np.maximum(altitude, 0.0)))
    return (altitude > CLEAR_SUN_DEG) & (np.asarray(ghi_wm2, float) < LEAST_CLEARNESS * top)


def closure_ratio(
    ghi_wm2: ArrayLike, dhi_wm2: ArrayLike, dni_wm2: ArrayLike, altitude_deg: ArrayLike
) -> NDArray[np.float64]:
    """Return global over (diffuse + DNI sin altitude), [n].

    NaN (not testable) where that sum is under 50 W/m2.
    """
    beam = np.asarray(dni_wm2, float) * np.maximum(np.sin(np.radians(altitude_deg)), 0.0)
    total = np.asarray(dhi_wm2, float) + beam
    return np.divide(ghi_wm2, total, out=np.full(total.shape, np.nan), where=total > 50.0)
