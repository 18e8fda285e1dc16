"""Read weather years strictly and list every repair, or compute a synthetic year without a file.

`formats` reads the rows of each format; this file repairs them, and `plausibility` compares them
with the sun.
"""

import math
from dataclasses import replace
from datetime import datetime, timedelta
from itertools import pairwise
from pathlib import Path

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.errors import InputError, NotEnoughDataError, input_errors
from fieldlum.core.records import Site, SiteFile, counted
from fieldlum.core.strict_csv import lines_of, read_text
from fieldlum.optics.profiles import shipped
from fieldlum.optics.projection import direction
from fieldlum.sky import sun
from fieldlum.weather.formats import WeatherRow, WeatherTable, read_table
from fieldlum.weather.plausibility import STANDARD_TIME, check_hourly, check_plausible
from fieldlum.weather.year import TYPICAL_YEAR, Weather, synthetic_weather

SYNTHETIC = "synthetic"  # used in place of a path: a synthetic year of the site
# Gaps up to this length are interpolated and listed; longer ones are left out and listed. Chosen so
# that an interpolation never bridges a morning or an afternoon; not measured.
FILLED_GAP_HOURS = 3
# A station further away than NEAR_KM is listed among the repairs, further than FAR_KM is an error.
# Chosen so that the nearest airport passes and another climate does not; not measured.
NEAR_KM = 30.0
FAR_KM = 300.0
_HOUR = timedelta(hours=1)
# Zero offsets of pyrheliometers are smaller, and diffuse light by day is larger. Chosen.
_LOWEST_BY_DAY_WM2 = -5.0
# Labels that are an hour off, and days of another hemisphere, have dark hours with a lower sun, but
# light at noon. Chosen.
_HIGH_SUN_DEG, _HIGH_NOON_DEG = 25.0, 10.0
# Share of the hours with the sun up that may be dark: a year of PVGIS (45 N, 8 E) has 0.01. More
# are another error. Chosen.
_MAX_DARK_SHARE = 0.02


# ----------------------------------------------------------------------------------------------
# reading


def read_weather(path: str | Path, site: Site, *, label_shift_min: float = 0.0) -> Weather:
    """Read a weather file of any format of `formats` as hours at `site`.

    label_shift_min: minutes added to the times that the file states, if its labels are wrong;
    listed in `.repairs`. The path ``synthetic`` gives a synthetic year of the site.

    Smaller faults are repaired and listed in `.repairs`: night offsets, 29 February of a typical
    year, gaps up to three hours. Longer gaps are left out and listed.

    Raises InputError for a file or row that cannot be read or irradiance outside -10 to 1600 W/m2,
    with the line, for rows that are not an hour apart, a station over 300 km away, and what
    `check_plausible` finds: light at night, wrong units, exchanged columns, labels that are not at
    the middle of their hour. Raises NotEnoughDataError without a single hour that has DNI and DHI.
    """
    if str(path := Path(path)) == SYNTHETIC:
        if label_shift_min:
            raise InputError(path, "no file", "a weather file to shift", "omit --label-shift")
        return synthetic_weather(site)
    expected = "an EPW, TMY3 or CSV weather file"
    lines = lines_of(read_text(path, expected))
    if not any(line.strip() for line in lines):
        raise InputError(path, "an empty file", expected, "download the file again")
    table = read_table(path, lines, site)
    if not table.rows:
        raise NotEnoughDataError(f"{path}: the file has no hours; download the file again")
    repairs = [*table.notes]
    if label_shift_min:
        repairs.append(f"times of all rows moved by {label_shift_min:+g} min")
    repairs += _check_place(path, table.place, site)
    shift = table.shift + timedelta(minutes=label_shift_min)
    with input_errors(path, "times from year 1 to 9999", "correct the dates", OverflowError):
        rows = _in_order(path, _in_utc(table, shift, site, repairs))
    ghi, dhi, dni = _values(rows, table.place or site, repairs)
    check_hourly(path, [row.when for row in rows])
    name = f"{path.name} ({table.place.name})" if table.place else path.name
    weather = Weather(name, site, (), ghi_wm2=ghi, dhi_wm2=dhi, dni_wm2=dni, typical=table.typical)
    weather = _fill_gaps(path, weather, rows, repairs)
    # The check needs the file's own global irradiance: what was computed from the others proves
    # nothing.
    stated = {row.when: value for row, value in zip(rows, ghi, strict=True)}
    ghi = np.array([stated.get(t, math.nan) for t in weather.t_utc])
    repairs += check_plausible(path, weather, table.place or site, ghi)
    return replace(weather, repairs=tuple(repairs))


# The place of the shipped year: Liu, Colburn, Inanici 2020, section 2.
SHIPPED_SITE = Site("Seattle", 47.6, -122.3, "America/Los_Angeles")


def shipped_seattle(site: Site | None = None) -> Weather:
    """Return the shipped typical year of Seattle of Liu, Colburn and Inanici 2020.

    site: the site of the result, for which the file is checked; None: Seattle. Raises InputError
    for a site over 300 km away.
    """
    return read_weather(shipped("capture_plans") / "seattle_dni_dhi.csv", site or SHIPPED_SITE)


# ----------------------------------------------------------------------------------------------
# checks and repairs


def weather_for(setup: SiteFile, path: Path | None = None, seed: int = 1) -> Weather:
    """Return the weather year of the file `path`.

    Without a file, return the shipped year of Seattle for a site within 30 km of it, and a
    synthetic year drawn by `seed` for other sites. Raises as `read_weather`.
    """
    if path is not None:
        return read_weather(path, setup.site)
    if distance_km(setup.site, SHIPPED_SITE) <= NEAR_KM:
        return shipped_seattle(setup.site)
    return synthetic_weather(setup.site, seed)


def distance_km(a: Site, b: Site) -> float:
    """Return the distance of two sites along the great circle, in km."""
    u = direction(a.latitude_deg, a.longitude_deg)
    v = direction(b.latitude_deg, b.longitude_deg)
    return 6371.0 * math.acos(float(np.clip(u @ v, -1.0, 1.0)))  # mean radius (IUGG)


def _check_place(path: Path, place: Site | None, site: Site) -> list[str]:
    """Return a note if the file's place is over 30 km from the site, or unknown (None).

    Raises InputError if it is over 300 km from the site.
    """
    if place is None or (away := distance_km(place, site)) <= NEAR_KM:
        return [] if place else ["the file states no place: it is taken as weather of the site"]
    if away > FAR_KM:
        where = f"{place.name} ({place.latitude_deg:g}, {place.longitude_deg:g} deg)"
        found = f"weather of {where}, which is {away:.0f} km from the site"
        remedy = "use the file of a nearer station, or correct the site's coordinates"
        raise InputError(path, found, f"at most {FAR_KM:g} km", remedy)
    return [f"the weather station {place.name} is {away:.0f} km from the site"]


def _in_utc(
    table: WeatherTable, shift: timedelta, site: Site, repairs: list[str]
) -> list[WeatherRow]:
    """Return the rows with `when` at the middle of their hours in UTC.

    shift: from the time of a row to that middle. All rows of a typical year get the year
    TYPICAL_YEAR of the site's standard time: those that pass its end continue at its beginning. 29
    February is left out and listed in `repairs`; the date on the file's own clock decides, because
    the last hours of 28 February can be the 29th in another time zone.
    """
    if not table.typical:
        return [row._replace(when=row.when - table.clock + shift) for row in table.rows]
    offset = sun.standard_offset(site.timezone, TYPICAL_YEAR)
    rows = [row for row in table.rows if (row.when.month, row.when.day) != (2, 29)]
    if left_out := len(table.rows) - len(rows):
        repairs.append(f"29 February left out ({counted(left_out, 'hour')}): in no typical year")
    local = [row.when.replace(year=TYPICAL_YEAR) - table.clock + shift + offset for row in rows]
    return [
        row._replace(when=when.replace(year=TYPICAL_YEAR) - offset)
        for row, when in zip(rows, local, strict=True)
    ]


def _in_order(path: Path, rows: list[WeatherRow]) -> list[WeatherRow]:
    """Return the rows sorted by time.

    Raises InputError for an hour that occurs twice and for a gap over 800 days.
    """
    rows = sorted(rows, key=lambda row: row.when)
    for a, b in pairwise(rows):
        lines = f"lines {a.line} and {b.line}"
        if a.when == b.when:
            found, expected = f"{lines} are of the same hour", "every hour once"
            remedy = f"remove one of them; {STANDARD_TIME} if the clock follows summer time"
            raise InputError(path, found, expected, remedy)
        if b.when - a.when > timedelta(days=800):  # a mistyped year
            found = f"{lines}: {a.when:%Y-%m-%d} is followed by {b.when:%Y-%m-%d}"
            raise InputError(path, found, "at most 800 days between rows", "correct the dates")
    return rows


def _values(rows: list[WeatherRow], place: Site, repairs: list[str]) -> Floats:
    """Return GHI, DHI and DNI of n rows, [3, n], W/m2, with each change listed in `repairs`.

    Negative readings become zero. Those below -5 W/m2 by day are a code such as -9, not an offset
    of an instrument: missing, NaN. So are a few hours by day without any light, which PVGIS writes
    for days without satellite images. place: of the sun.
    """
    values = np.array([(row.ghi, row.dhi, row.dni) for row in rows]).T  # [3, n]
    altitude = sun.position([row.when for row in rows], place).altitude_deg
    if (codes := (values < _LOWEST_BY_DAY_WM2) & (altitude > 10.0)).any():
        repairs.append(f"{counted(codes.any(0).sum(), 'hour')} negative by day count as missing")
        values[codes] = np.nan
    dark = (altitude > 0.0) & ~(values > 0.0).any(axis=0) & (values == 0.0).any(axis=0)
    spell = np.cumsum(~dark)  # one number for all dark hours in sequence
    is_noon = altitude >= np.maximum(np.roll(altitude, 1), np.roll(altitude, -1))
    is_high = (altitude > _HIGH_SUN_DEG) | (is_noon & (altitude > _HIGH_NOON_DEG))
    dark &= np.isin(spell, spell[dark & is_high])
    if 0 < dark.sum() <= _MAX_DARK_SHARE * (altitude > 0.0).sum():
        repairs.append(f"{counted(dark.sum(), 'hour')} without any light by day count as missing")
        values[:, dark] = np.nan
    negative = values < 0
    if negative.any():
        found = f"{counted(int(negative.any(axis=0).sum()), 'hour')} with negative irradiance"
        lowest = f"down to {np.nanmin(values):.1f} W/m2, a night offset"
        repairs.append(f"{found} ({lowest}) set to zero")
    return np.where(negative, 0.0, values)


def _fill_gaps(path: Path, year: Weather, rows: list[WeatherRow], repairs: list[str]) -> Weather:
    """Return the year with short gaps interpolated and long gaps left out; list both in `repairs`.

    year: without times, with the irradiances of the rows; rows: for their times. GHI is DHI + DNI
    sin(altitude) where the file has none. Raises NotEnoughDataError without an hour that has both
    DNI and DHI.
    """
    complete = np.isfinite(year.dni_wm2 + year.dhi_wm2)
    if not complete.any():
        raise NotEnoughDataError(f"{path}: no hour has both DNI and DHI; use a file that has both")
    times = [rows[k].when for k in np.flatnonzero(complete)]
    filled, left_out = _missing_hours(times, year.typical)
    all_times = sorted([*times, *filled])
    all_s, times_s = (np.array([t.timestamp() for t in some]) for some in (all_times, times))
    dni = np.interp(all_s, times_s, year.dni_wm2[complete])
    dhi = np.interp(all_s, times_s, year.dhi_wm2[complete])
    ghi = dhi + sun.horizontal_beam(dni, sun.position(all_times, year.site).altitude_deg)
    stated = year.ghi_wm2[complete]
    has_ghi = ~np.isnan(stated)
    ghi[np.isin(all_s, times_s[has_ghi])] = stated[has_ghi]
    for hours, repair in ((filled, "interpolated"), (left_out, "left out")):
        if hours:
            shown = ", ".join(f"{t:%m-%d %H:%M}" for t in hours[:3])
            shown += f" ... {hours[-1]:%m-%d %H:%M}" if len(hours) > 3 else ""
            repairs.append(f"{len(hours)} missing hours {repair}: {shown} UTC")
    return replace(year, t_utc=tuple(all_times), dni_wm2=dni, dhi_wm2=dhi, ghi_wm2=ghi)


def _missing_hours(times: list[datetime], typical: bool) -> tuple[list[datetime], list[datetime]]:
    """Return the missing hours of gaps up to three hours, to be interpolated, and those of others.

    times: of the rows, in order, an hour apart except for gaps; typical: whether they are a typical
    year, whose missing hours at the end count too.
    """
    filled: list[datetime] = []
    left_out: list[datetime] = []
    for before, after in pairwise(times):
        gap = [before + _HOUR * k for k in range(1, round((after - before) / _HOUR))]
        (filled if len(gap) <= FILLED_GAP_HOURS else left_out).extend(gap)
    if typical:  # a typical year has 8760 hours, from local midnight to local midnight
        lacking = 8759 - round((times[-1] - times[0]) / _HOUR)
        left_out += [times[-1] + _HOUR * (k + 1) for k in range(lacking)]
    return filled, left_out
