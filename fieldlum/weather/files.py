"""Readers of weather files: one strict reader for each format, then the same checks and repairs."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fieldlum import sun
from fieldlum.errors import InputError, NotEnoughDataError
from fieldlum.profiles import shipped
from fieldlum.records import Site, parse_utc
from fieldlum.weather.plausibility import check_hourly, check_sense
from fieldlum.weather.providers import ProviderYear, best_shift, epw_time_offset, read_provider
from fieldlum.weather.year import TYPICAL_YEAR, Weather, synthetic_weather

SYNTHETIC = "synthetic"  # used in place of a path: a synthetic year of the site
# A cell outside of these two limits is an error. Chosen so that every hourly mean of a real sky is
# inside: the solar constant is 1367 W/m2, cloud edges add to it, and the night offset of a
# thermopile is a few W/m2 below zero. Not measured.
HIGHEST_WM2 = 1600.0
LOWEST_WM2 = -10.0
# Gaps up to this length are interpolated and listed; longer ones are left out and listed. Chosen so
# that an interpolation never bridges a morning or an afternoon; not measured.
FILLED_GAP_HOURS = 3
# A station further away than NEAR_KM is listed among the repairs, further than FAR_KM is an error.
# Chosen so that the nearest airport passes and another climate does not; not measured.
NEAR_KM = 30.0
FAR_KM = 300.0
# A longer gap is a mistyped year. Chosen longer than two missing years; not measured.
LONGEST_GAP = timedelta(days=800)
# Degrees of longitude over 15 minus the zone's hours; western China (3.3 h) is the extreme of the
# time zones in use, so that a larger difference is a wrong sign or zone.
_LARGEST_ZONE_OFFSET_H = 3.5
# Light below this altitude counts as light at night. Chosen so that the mean of an hour may include
# light from half an hour before sunrise; not measured.
_NIGHT_BELOW_DEG = -8.0
# Share of the year's light that may be at night; a shift of one hour gives more. Not measured.
_MOST_LIGHT_AT_NIGHT = 0.01
_EARTH_RADIUS_KM = 6371.0  # mean radius (IUGG)
_HOUR = timedelta(hours=1)


# ----------------------------------------------------------------------------------------------
# reading


@dataclass(frozen=True, slots=True)
class _WeatherRow:
    """One hour of a file; irradiances in W/m2, NaN where missing."""

    line: int
    when: datetime  # middle of the hour, UTC; with the year of the file
    dni: float
    dhi: float
    ghi: float


@dataclass(frozen=True, slots=True)
class _File:
    """The content of a file: rows, whether they are a typical year, and the place of the header."""

    rows: list[_WeatherRow]
    typical: bool
    name: str
    place: Site | None = None
    notes: tuple[str, ...] = ()


def read_weather(path: Path, site: Site, *, label_shift_min: float = 0.0) -> Weather:
    """Read an EPW, TMY3, TMY2, PVGIS, NSRDB, SolarAnywhere or CSV file as hours at `site`.

    label_shift_min : minutes added to the times that the file states, for labels that are known to
    be wrong; listed in `.repairs`. The path ``synthetic`` gives a synthetic year of the site.

    Smaller faults are repaired and listed in `.repairs`: night offsets, 29 February of a typical
    year, gaps up to three hours. Longer gaps are left out and listed.

    Raises InputError, with the line, for a row that cannot be read, irradiance outside -10 to 1600
    W/m2, a station over 300 km away, light at night (a wrong time zone), and what `check_sense`
    finds: wrong units, exchanged columns, labels that are not at the middle of their hour. Raises
    NotEnoughDataError without a single hour that has DNI and DHI.
    """
    path = Path(path)
    if str(path) == SYNTHETIC:
        return synthetic_weather(site)
    try:
        found = _shifted(_read(path, _lines(path), site), label_shift_min)
    except (csv.Error, OverflowError) as error:
        raise InputError(
            path, str(error), "an EPW, TMY3 or CSV weather file", "download the file again"
        ) from None
    if not found.rows:
        raise NotEnoughDataError(f"{path}: the file has no hours; download the file again")
    repairs = [*found.notes, *_check_place(path, found.place, site)]
    rows = _in_order(path, found, site, repairs)
    columns = _values(rows, repairs)
    check_hourly(path, [row.when for row in rows])
    weather = _fill_gaps(found, site, rows, columns, repairs)
    _check_night(path, weather)
    _check_sense(path, found, rows, columns, weather)
    return replace(weather, repairs=tuple(repairs))


def _shifted(file: _File, minutes: float) -> _File:
    """Return the file with the times of its rows moved, and with a note of the shift."""
    if not minutes:
        return file
    shift = timedelta(minutes=minutes)
    rows = [replace(row, when=row.when + shift) for row in file.rows]
    return replace(file, rows=rows, notes=(*file.notes, f"labels moved by {minutes:+g} min"))


def _of_provider(path: Path, year: ProviderYear) -> _File:
    """Return the rows of a file that pvlib read.

    Raises InputError for irradiance outside -10 to 1600 W/m2.
    """
    rows = []
    columns = zip(year.t_utc, year.dni_wm2, year.dhi_wm2, year.ghi_wm2, strict=True)
    for number, (when, dni, dhi, ghi) in enumerate(columns, start=1):
        values = [
            _number(path, number, name, repr(float(value)))
            for name, value in (("DNI", dni), ("DHI", dhi), ("GHI", ghi))
        ]
        rows.append(_WeatherRow(number, when, *values))
    return _File(rows, year.typical, f"{path.name} ({year.place.name})", year.place, year.notes)


def _pvgis_epw(file: _File, place: Site, offset: timedelta, zone: timedelta) -> _File:
    """Return the rows of a PVGIS EPW, dated by the offset that its comments state.

    Values are of one moment: the label (hours 1 to 24) plus the stated offset. Some versions of
    PVGIS write the rows in UTC although the header states a zone; the choice that agrees better
    with sunrise and sunset is taken.
    """
    # `_read_epw` gives the middle of the hour that ends at the label: add half an hour.
    times = tuple(row.when + timedelta(minutes=30) + offset for row in file.rows)
    dni, dhi, ghi = np.array([(row.dni, row.dhi, row.ghi) for row in file.rows]).T
    year = ProviderYear(place, times, dni, dhi, ghi, typical=True)
    stated = f"PVGIS states an irradiance time offset of {offset.total_seconds() / 60:+.0f} min"
    if zone:
        year = best_shift(year, {"header's zone": timedelta(0), "UTC": zone}, "rows count as")
    rows = [replace(row, when=when) for row, when in zip(file.rows, year.t_utc, strict=True)]
    return replace(file, rows=rows, notes=(stated, *year.notes))


def _read(path: Path, lines: list[str], site: Site) -> _File:
    if (year := read_provider(path, lines)) is not None:
        return _of_provider(path, year)
    if path.suffix.lower() == ".epw" or lines[0].upper().startswith("LOCATION,"):
        return _read_epw(path, lines)
    if len(lines) > 1 and lines[1].startswith("Date (MM/DD/YYYY)"):
        return _read_tmy3(path, lines)
    return _read_csv(path, lines, site)


# The place of the shipped year: Liu, Colburn, Inanici 2020, section 2.
SHIPPED_SITE = Site("Seattle", 47.6, -122.3, "America/Los_Angeles")


def shipped_seattle(site: Site | None = None) -> Weather:
    """Return the typical year of Seattle of Liu, Colburn, Inanici 2020, which is shipped.

    site : the place to compute the sun for; Seattle by default.
    """
    return read_weather(shipped("capture_plans") / "seattle_dni_dhi.csv", site or SHIPPED_SITE)


def _lines(path: Path) -> list[str]:
    try:
        text = path.read_text(encoding="utf-8-sig", errors="strict")
    except UnicodeDecodeError:
        text = path.read_text(encoding="latin-1")
    except OSError as error:
        raise InputError(
            path, error.strerror or str(error), "a readable weather file", "check the path"
        ) from None
    lines = text.splitlines()
    if not lines or "\0" in text:
        raise InputError(
            path,
            "an empty or binary file",
            "an EPW, TMY3 or CSV weather file",
            "download the file again",
        )
    return lines


def _number(path: Path, line: int, name: str, text: str) -> float:
    """Return an irradiance; NaN for an empty cell, nan, and the codes 9999 (EPW), -9900 (TMY3).

    Raises InputError for a cell that is no number or outside -10 to 1600 W/m2.
    """
    text = text.strip()
    if text.lower() in ("", "nan", "na"):
        return math.nan
    try:
        value = float(text)
    except ValueError:
        raise InputError(
            path, f"line {line}: {name} is '{text}'", "a number in W/m2", "correct that row"
        ) from None
    if value in (9999.0, 99999.0, 999999.0, -9900.0, -9999.0):
        return math.nan
    if not LOWEST_WM2 <= value <= HIGHEST_WM2:
        expected = f"{LOWEST_WM2:g} to {HIGHEST_WM2:g} W/m2"
        raise InputError(
            path, f"line {line}: {name} is {text} W/m2", expected, "correct or empty that cell"
        )
    return value


def _read_epw(path: Path, lines: list[str]) -> _File:
    """Return the rows of an EPW file: eight header lines, then one row for each hour.

    Hour 1 is 00:00 to 01:00 local standard time; the sun of a row is that of the middle, 00:30.
    """
    head = lines[0].split(",")
    try:
        place = Site(
            head[1].strip() or "weather station",
            float(head[6]),
            float(head[7]),
            "UTC",
            float(head[9]),
        )
        offset = timedelta(hours=float(head[8]))
    except (IndexError, ValueError):
        raise InputError(
            path,
            f"line 1 is '{lines[0][:60]}'",
            "LOCATION,city,,,,,latitude,longitude,zone,altitude",
            "correct the header, or download the file again",
        ) from None
    _check_zone(path, place, offset)
    rows = []
    for number, cells in enumerate(csv.reader(lines[8:]), start=9):
        if not cells:
            continue
        if len(cells) < 16:
            raise InputError(
                path,
                f"line {number}: {len(cells)} cells",
                "at least 16 cells",
                "the file is cut: download it again",
            )
        hour_start = float(_integer(path, number, cells[3]) - 1)
        start = _moment(path, number, cells[0], cells[1], cells[2], hour_start)
        ghi = _number(path, number, "GHI", cells[13])
        dni = _number(path, number, "DNI", cells[14])
        dhi = _number(path, number, "DHI", cells[15])
        rows.append(_WeatherRow(number, start + timedelta(minutes=30) - offset, dni, dhi, ghi))
    file = _File(rows, True, f"{path.name} ({place.name})", place)
    stated = epw_time_offset(lines)
    return file if stated is None else _pvgis_epw(file, place, stated, offset)


def _read_tmy3(path: Path, lines: list[str]) -> _File:
    """Return the rows of a TMY3 file: a header line, column names, then one row for each hour.

    Labels are the ends of hours, 01:00 to 24:00; the sun of a row is that of 30 minutes before.
    """
    head = lines[0].split(",")
    try:
        place = Site(
            head[1].strip('" ') or "weather station",
            float(head[4]),
            float(head[5]),
            "UTC",
            float(head[6]),
        )
        offset = timedelta(hours=float(head[3]))
    except (IndexError, ValueError):
        raise InputError(
            path,
            f"line 1 is '{lines[0][:60]}'",
            "USAF,name,state,zone,latitude,longitude,altitude",
            "correct the header, or download the file again",
        ) from None
    _check_zone(path, place, offset)
    names = next(csv.reader(lines[1:2]))
    wanted = ("GHI (W/m^2)", "DNI (W/m^2)", "DHI (W/m^2)")
    if missing := [name for name in wanted if name not in names]:
        raise InputError(
            path,
            f"no column {missing[0]}",
            "columns of GHI, DNI and DHI in W/m^2",
            "check that this is a TMY3 file",
        )
    at = [names.index(name) for name in wanted]
    rows = []
    for number, cells in enumerate(csv.reader(lines[2:]), start=3):
        if not cells:
            continue
        if len(cells) <= max(at):
            raise InputError(
                path,
                f"line {number}: {len(cells)} cells",
                f"{len(names)} cells",
                "the file is cut: download it again",
            )
        month, _, rest = cells[0].partition("/")
        day, _, year = rest.partition("/")
        hour = cells[1].partition(":")[0]
        end = _moment(path, number, year, month, day, float(_integer(path, number, hour)))
        ghi, dni, dhi = (
            _number(path, number, name, cells[k]) for name, k in zip(wanted, at, strict=True)
        )
        rows.append(_WeatherRow(number, end - timedelta(minutes=30) - offset, dni, dhi, ghi))
    return _File(rows, True, f"{path.name} ({place.name})", place)


def _read_csv(path: Path, lines: list[str], site: Site) -> _File:
    """Return the rows of a csv file of hour centres.

    Columns t_utc, dni_wm2, dhi_wm2, or month, day, hour (local standard time), dni_wm2, dhi_wm2;
    ghi_wm2 is optional.
    """
    place, offset = _place_comment(path, lines, site)
    table = [
        (n, line)
        for n, line in enumerate(lines, start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    names = [name.strip() for name in next(csv.reader([table[0][1]]))] if table else []
    dated = "t_utc" in names
    wanted = ("t_utc",) if dated else ("month", "day", "hour")
    if missing := [n for n in (*wanted, "dni_wm2", "dhi_wm2") if n not in names]:
        expected = "columns t_utc (or month, day, hour), dni_wm2, dhi_wm2"
        raise InputError(
            path, f"no column {', '.join(missing)}", expected, "name the columns in the first row"
        )
    rows = []
    for number, line in table[1:]:
        cells = dict(zip(names, next(csv.reader([line])), strict=False))
        if len(cells) < len(names):
            raise InputError(
                path,
                f"line {number}: {len(cells)} cells",
                f"{len(names)} cells",
                "correct that row",
            )
        when = _csv_moment(path, number, cells, dated, offset)
        dni, dhi, ghi = (
            _number(path, number, n, cells.get(n, "")) for n in ("dni_wm2", "dhi_wm2", "ghi_wm2")
        )
        rows.append(_WeatherRow(number, when, dni, dhi, ghi))
    return _File(rows, not dated, path.name, place)


def _csv_moment(
    path: Path, line: int, cells: dict[str, str], dated: bool, offset: timedelta
) -> datetime:
    if not dated:
        try:
            hour = float(cells["hour"])
        except ValueError:
            raise InputError(
                path,
                f"line {line}: hour is '{cells['hour']}'",
                "a number such as 12.5",
                "correct that row",
            ) from None
        return _moment(path, line, "2024", cells["month"], cells["day"], hour) - offset
    try:
        return parse_utc(cells["t_utc"].strip())
    except ValueError as error:
        raise InputError(
            path,
            f"line {line}: {error}",
            "a UTC time such as 2027-03-20T15:30:00Z",
            "correct that row",
        ) from None


def _place_comment(path: Path, lines: list[str], site: Site) -> tuple[Site | None, timedelta]:
    """Return the place and zone of a line ``# place: NAME, LATITUDE, LONGITUDE, UTC-8``.

    Without such a line: no place, and the offset of the site's own standard time.
    """
    for line in lines[:20]:
        if line.startswith("# place:"):
            try:
                name, latitude, longitude, zone = (part.strip() for part in line[8:].split(","))
                place = Site(name, float(latitude), float(longitude))
                offset = timedelta(hours=float(zone.removeprefix("UTC") or 0))
            except ValueError:
                raise InputError(
                    path,
                    f"'{line}'",
                    "'# place: NAME, LATITUDE, LONGITUDE, UTC-8'",
                    "correct that line",
                ) from None
            _check_zone(path, place, offset)
            return place, offset
    return None, sun.standard_offset(site.timezone, TYPICAL_YEAR)


def _integer(path: Path, line: int, text: str) -> int:
    try:
        return int(float(text))
    except ValueError:
        raise InputError(
            path, f"line {line}: '{text}' in the time", "an integer", "correct that row"
        ) from None


def _moment(path: Path, line: int, year: str, month: str, day: str, hour: float) -> datetime:
    try:
        y, m, d = (_integer(path, line, text) for text in (year, month, day))
        start = datetime(y, m, d, tzinfo=UTC)
        if not 0 <= hour <= 24:
            raise ValueError(f"hour {hour:g}")
    except ValueError as error:
        found = f"line {line}: no such time {year}-{month}-{day} hour {hour:g} ({error})"
        raise InputError(
            path, found, "a date of the calendar and an hour of 0 to 24", "correct that row"
        ) from None
    return start + timedelta(seconds=round(hour * 3600))


# ----------------------------------------------------------------------------------------------
# checks and repairs


def distance_km(a: Site, b: Site) -> float:
    """Return the distance of two sites along the great circle, in km."""
    from fieldlum.projection import direction

    u = direction(a.latitude_deg, a.longitude_deg)
    v = direction(b.latitude_deg, b.longitude_deg)
    return _EARTH_RADIUS_KM * math.acos(float(np.clip(u @ v, -1.0, 1.0)))


def _check_zone(path: Path, place: Site, offset: timedelta) -> None:
    hours = offset.total_seconds() / 3600
    if abs(hours - place.longitude_deg / 15) > _LARGEST_ZONE_OFFSET_H:
        found = f"time zone UTC{hours:+g} at longitude {place.longitude_deg:g} deg"
        raise InputError(
            path,
            found,
            f"about UTC{place.longitude_deg / 15:+.0f}",
            "correct the header (east is positive)",
        )


def _check_place(path: Path, place: Site | None, site: Site) -> list[str]:
    if place is None:
        return []
    away = distance_km(place, site)
    if away > FAR_KM:
        found = (
            f"weather of {place.name} ({place.latitude_deg:g}, {place.longitude_deg:g}), "
            f"{away:.0f} km from the site"
        )
        raise InputError(
            path,
            found,
            f"at most {FAR_KM:g} km",
            "use the file of a nearer station, or correct the site's coordinates",
        )
    return (
        [f"the weather station {place.name} is {away:.0f} km from the site"]
        if away > NEAR_KM
        else []
    )


def _in_order(path: Path, found: _File, site: Site, repairs: list[str]) -> list[_WeatherRow]:
    """Return the rows sorted by time; those of a typical year dated in TYPICAL_YEAR.

    Leaves out 29 February of a typical year (local standard time) and lists it in `repairs`. Raises
    InputError for an hour that occurs twice and for a gap over 800 days.
    """
    rows = found.rows
    if found.typical:
        offset = sun.standard_offset(site.timezone, TYPICAL_YEAR)
        local = [(row, row.when + offset) for row in rows]
        leap = [row for row, t in local if (t.month, t.day) == (2, 29)]
        if leap:
            repairs.append(f"29 February left out ({len(leap)} hours): a typical year has 365 days")
        rows = [
            replace(row, when=t.replace(year=TYPICAL_YEAR) - offset)
            for row, t in local
            if (t.month, t.day) != (2, 29)
        ]
    rows = sorted(rows, key=lambda row: row.when)
    for a, b in pairwise(rows):
        if a.when == b.when:
            found_text = f"lines {a.line} and {b.line} are of the same hour"
            raise InputError(path, found_text, "every hour once", "remove one of the lines")
        if b.when - a.when > LONGEST_GAP:
            found_text = (
                f"lines {a.line} and {b.line}: {a.when:%Y-%m-%d} is followed by {b.when:%Y-%m-%d}"
            )
            expected = f"at most {LONGEST_GAP.days} days between two rows"
            raise InputError(path, found_text, expected, "correct the dates")
    return rows


def _values(rows: list[_WeatherRow], repairs: list[str]) -> NDArray[np.float64]:
    """Return DNI, DHI and GHI of all rows, [3, n], W/m2; set negative readings to zero, listed."""
    values = np.array([(row.dni, row.dhi, row.ghi) for row in rows]).T  # (3, n)
    negative = values < 0
    if negative.any():
        repairs.append(
            f"{int(negative.any(axis=0).sum())} hours with negative irradiance (down to "
            f"{np.nanmin(values):.1f} W/m2, "
            "a night offset) set to zero"
        )
    return np.where(negative, 0.0, values)


def _fill_gaps(
    found: _File,
    site: Site,
    rows: list[_WeatherRow],
    columns: NDArray[np.float64],
    repairs: list[str],
) -> Weather:
    """Return the year with short gaps interpolated and long gaps left out; list both in `repairs`.

    columns : DNI, DHI, GHI of the rows, [3, n], W/m2. GHI is DHI + DNI sin(altitude) where the file
    has none. Raises NotEnoughDataError without an hour that has both DNI and DHI.
    """
    times = [row.when for row in rows]
    good = np.atleast_1d(~np.isnan(columns[:2]).any(axis=0))
    if not good.any():
        raise NotEnoughDataError(
            f"{found.name}: no hour has both DNI and DHI; use a file that has both"
        )
    known = [t for t, ok in zip(times, good, strict=True) if ok]
    values = columns[:, good]
    filled, left_out = _missing_hours(known, found.typical)
    everything = sorted([*known, *filled])
    at = np.array([t.timestamp() for t in everything])
    have = np.array([t.timestamp() for t in known])
    dni = np.interp(at, have, values[0])
    dhi = np.interp(at, have, values[1])
    height = np.maximum(np.sin(np.radians(sun.position(everything, site).altitude_deg)), 0.0)
    ghi = dhi + dni * height
    given = ~np.isnan(values[2])
    ghi[np.isin(at, have[given])] = values[2][given]
    if filled:
        repairs.append(f"{len(filled)} missing hours interpolated: {_some(filled)}")
    if left_out:
        repairs.append(f"{len(left_out)} missing hours left out: {_some(left_out)}")
    return Weather(found.name, site, tuple(everything), dni, dhi, ghi, (), found.typical)


def _missing_hours(known: list[datetime], typical: bool) -> tuple[list[datetime], list[datetime]]:
    """Return the hours to interpolate and the hours to leave out."""
    fill: list[datetime] = []
    out: list[datetime] = []
    for gap in _gaps(known, typical):
        is_short = 0 < len(gap) <= FILLED_GAP_HOURS
        if is_short and known[0] < gap[0] < known[-1]:
            fill.extend(gap)
        else:
            out.extend(gap)
    return fill, out


def _gaps(known: list[datetime], typical: bool) -> Iterator[list[datetime]]:
    if typical:  # a typical year has 8760 hours, from local midnight to local midnight
        lacking = 8760 - (round((known[-1] - known[0]) / _HOUR) + 1)
        yield [known[-1] + _HOUR * (k + 1) for k in range(max(lacking, 0))]
    for a, b in pairwise(known):
        yield [a + _HOUR * (k + 1) for k in range(round((b - a) / _HOUR) - 1)]


def _some(times: list[datetime]) -> str:
    shown = ", ".join(f"{t:%m-%d %H:%M}" for t in times[:3])
    return f"{shown} ... {times[-1]:%m-%d %H:%M} UTC" if len(times) > 3 else f"{shown} UTC"


def _check_night(path: Path, weather: Weather) -> None:
    """Raise InputError for light while the sun is far below the horizon.

    Light at night shows a wrong time zone or hemisphere.
    """
    altitude = sun.position(weather.t_utc, weather.site).altitude_deg
    light = weather.dni_wm2 + weather.dhi_wm2
    total = float(light.sum())
    at_night = float(light[altitude < _NIGHT_BELOW_DEG].sum())
    if total > 0 and at_night > _MOST_LIGHT_AT_NIGHT * total:
        found = (
            f"{100 * at_night / total:.0f} % of the light falls while the sun is down at "
            f"{weather.site.name}"
        )
        remedy = (
            "check the time zone, the sign of the longitude, and whether labels are hour centres"
        )
        raise InputError(path, found, "light only while the sun is up", remedy)


def _check_sense(
    path: Path,
    found: _File,
    rows: list[_WeatherRow],
    columns: NDArray[np.float64],
    weather: Weather,
) -> None:
    """Check plausibility with the global irradiance that the file itself states.

    Elsewhere the global irradiance was computed from the other two and proves nothing.
    """
    given = {row.when: value for row, value in zip(rows, columns[2], strict=True)}
    ghi = np.array([given.get(t, math.nan) for t in weather.t_utc])
    check_sense(path, weather, found.place or weather.site, ghi)
