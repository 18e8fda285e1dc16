"""Readers of weather files: one strict reader for each format."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from fieldlum import sun
from fieldlum.errors import InputError
from fieldlum.records import Site, parse_utc
from fieldlum.weather.providers import ProviderYear, best_shift, epw_time_offset, read_provider
from fieldlum.weather.year import TYPICAL_YEAR

# A cell outside of these two limits is an error. Chosen so that every hourly mean of a real sky is
# inside: the solar constant is 1367 W/m2, cloud edges add to it, and the night offset of a
# thermopile is a few W/m2 below zero. Not measured.
HIGHEST_WM2 = 1600.0
LOWEST_WM2 = -10.0
# Degrees of longitude over 15 minus the zone's hours; western China (3.3 h) is the extreme of the
# time zones in use, so that a larger difference is a wrong sign or zone. Chosen just above.
_LARGEST_ZONE_OFFSET_H = 3.5


@dataclass(frozen=True, slots=True)
class WeatherRow:
    """One hour of a file; irradiances in W/m2, NaN where missing.

    line: number in the file, from 1, or of the row if pvlib read it; when: middle of the hour in
    UTC, with the year of the file.
    """

    line: int
    when: datetime  # middle of the hour, UTC; with the year of the file
    dni: float
    dhi: float
    ghi: float


@dataclass(frozen=True, slots=True)
class WeatherTable:
    """The content of a file: rows, whether they are a typical year, and its name.

    place: that of the header, None without one; notes: choices of the reader, one sentence each.
    """

    rows: list[WeatherRow]
    typical: bool
    name: str
    place: Site | None = None
    notes: tuple[str, ...] = ()


def _of_provider(path: Path, year: ProviderYear) -> WeatherTable:
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
        rows.append(WeatherRow(number, when, *values))
    return WeatherTable(
        rows, year.typical, f"{path.name} ({year.place.name})", year.place, year.notes
    )


def _pvgis_epw(file: WeatherTable, place: Site, offset: timedelta, zone: timedelta) -> WeatherTable:
    """Return the rows of a PVGIS EPW, dated by the offset that its comments state.

    Values are of one moment: the label (hours 1 to 24) plus the stated offset. Some versions of
    PVGIS write the rows in UTC although the header states a zone; the choice that agrees better
    with sunrise and sunset is taken.
    """
    # `_read_epw` gives the middle of the hour that ends at the label: add half an hour.
    times = tuple(row.when + timedelta(minutes=30) + offset for row in file.rows)
    dni, dhi, ghi = np.array([(row.dni, row.dhi, row.ghi) for row in file.rows]).T
    year = ProviderYear(place, times, dni, dhi, ghi, typical=True)
    minutes = offset.total_seconds() / 60
    stated = f"rows moved by {minutes:+.0f} min, the irradiance time offset that PVGIS states"
    if zone:
        year = best_shift(year, {"header's zone": timedelta(0), "UTC": zone}, "row times taken in")
    rows = [replace(row, when=when) for row, when in zip(file.rows, year.t_utc, strict=True)]
    return replace(file, rows=rows, notes=(stated, *year.notes))


def read_table(path: Path, lines: list[str], site: Site) -> WeatherTable:
    """Return the content of a weather file by the reader of its format, which is recognised.

    lines: of the file; site: for formats that state no place or zone. Raises InputError for a
    header or row that the format does not allow, and for irradiance outside -10 to 1600 W/m2.
    """
    if (year := read_provider(path, lines)) is not None:
        return _of_provider(path, year)
    if path.suffix.lower() == ".epw" or lines[0].upper().startswith("LOCATION,"):
        return _read_epw(path, lines)
    if len(lines) > 1 and lines[1].startswith("Date (MM/DD/YYYY)"):
        return _read_tmy3(path, lines)
    return _read_csv(path, lines, site)


def read_lines(path: Path) -> list[str]:
    """Return the lines of a file in UTF-8 or Latin-1.

    Raises InputError for an empty, binary or unreadable file.
    """
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


def _bad_row(path: Path, found: str, expected: str) -> InputError:
    return InputError(path, found, expected, "correct that row")


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
        raise _bad_row(path, f"line {line}: {name} is '{text}'", "a number in W/m2") from None
    if value in (9999.0, 99999.0, 999999.0, -9900.0, -9999.0):
        return math.nan
    if not LOWEST_WM2 <= value <= HIGHEST_WM2:
        raise InputError(
            path,
            f"line {line}: {name} is {text} W/m2",
            f"{LOWEST_WM2:g} to {HIGHEST_WM2:g} W/m2",
            "correct or empty that cell",
        )
    return value


def _header_place(
    path: Path, line: str, columns: tuple[int, int, int, int], expected: str
) -> tuple[Site, timedelta]:
    """Return the place and the zone of a header line; the name is in its second cell.

    columns : of latitude, longitude, altitude and zone. Raises InputError for another line.
    """
    cells = line.split(",")
    try:
        latitude, longitude, altitude, zone = (float(cells[column]) for column in columns)
        name = cells[1].strip('" ') or "weather station"
        place, offset = Site(name, latitude, longitude, "UTC", altitude), timedelta(hours=zone)
    except (IndexError, ValueError):
        raise InputError(
            path,
            f"line 1 is '{line[:60]}'",
            expected,
            "correct the header, or download the file again",
        ) from None
    _check_zone(path, place, offset)
    return place, offset


def _rows_with(
    path: Path, lines: list[str], header: int, cells: int, expected: str
) -> Iterator[tuple[int, list[str]]]:
    """Yield line number and cells of each row after the header that is not empty.

    Raises InputError for a row with fewer cells.
    """
    for number, row in enumerate(csv.reader(lines[header:]), start=header + 1):
        if not row:
            continue
        if len(row) < cells:
            raise InputError(
                path,
                f"line {number}: {len(row)} cells",
                expected,
                "the file is cut: download it again",
            )
        yield number, row


def _read_epw(path: Path, lines: list[str]) -> WeatherTable:
    """Return the rows of an EPW file: eight header lines, then one row for each hour.

    Hour 1 is 00:00 to 01:00 local standard time; the sun of a row is that of the middle, 00:30.
    """
    expected = "LOCATION,city,,,,,latitude,longitude,zone,altitude"
    place, offset = _header_place(path, lines[0], (6, 7, 9, 8), expected)
    rows = []
    for number, cells in _rows_with(path, lines, 8, 16, "at least 16 cells"):
        hour_start = float(_integer(path, number, cells[3]) - 1)
        start = _moment(path, number, cells[0], cells[1], cells[2], hour_start)
        ghi = _number(path, number, "GHI", cells[13])
        dni = _number(path, number, "DNI", cells[14])
        dhi = _number(path, number, "DHI", cells[15])
        rows.append(WeatherRow(number, start + timedelta(minutes=30) - offset, dni, dhi, ghi))
    file = WeatherTable(rows, True, f"{path.name} ({place.name})", place)
    stated = epw_time_offset(lines)
    return file if stated is None else _pvgis_epw(file, place, stated, offset)


def _read_tmy3(path: Path, lines: list[str]) -> WeatherTable:
    """Return the rows of a TMY3 file: a header line, column names, then one row for each hour.

    Labels are the ends of hours, 01:00 to 24:00; the sun of a row is that of 30 minutes before.
    """
    expected = "USAF,name,state,zone,latitude,longitude,altitude"
    place, offset = _header_place(path, lines[0], (4, 5, 6, 3), expected)
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
    for number, cells in _rows_with(path, lines, 2, max(at) + 1, f"{len(names)} cells"):
        month, _, rest = cells[0].partition("/")
        day, _, year = rest.partition("/")
        hour = cells[1].partition(":")[0]
        end = _moment(path, number, year, month, day, float(_integer(path, number, hour)))
        ghi, dni, dhi = (
            _number(path, number, name, cells[k]) for name, k in zip(wanted, at, strict=True)
        )
        rows.append(WeatherRow(number, end - timedelta(minutes=30) - offset, dni, dhi, ghi))
    return WeatherTable(rows, True, f"{path.name} ({place.name})", place)


def _read_csv(path: Path, lines: list[str], site: Site) -> WeatherTable:
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
        raise InputError(
            path,
            f"no column {', '.join(missing)}",
            "columns t_utc (or month, day, hour), dni_wm2, dhi_wm2",
            "name the columns in the first row",
        )
    found = []
    for number, line in table[1:]:
        cells = dict(zip(names, next(csv.reader([line])), strict=False))
        if len(cells) < len(names):
            raise _bad_row(path, f"line {number}: {len(cells)} cells", f"{len(names)} cells")
        found.append((number, cells))
    # Hour 24 of 28 February belongs to 29 February only in a file with that day.
    leap = any(c.get("month") in ("2", "02") and c.get("day") == "29" for _, c in found)
    year = "2024" if leap else "2023"
    rows = []
    for number, cells in found:
        when = _csv_moment(path, number, cells, dated, year) - (timedelta() if dated else offset)
        dni, dhi, ghi = (
            _number(path, number, n, cells.get(n, "")) for n in ("dni_wm2", "dhi_wm2", "ghi_wm2")
        )
        rows.append(WeatherRow(number, when, dni, dhi, ghi))
    return WeatherTable(rows, not dated, path.name, place)


def _csv_moment(path: Path, line: int, cells: dict[str, str], dated: bool, year: str) -> datetime:
    """Return the time of a row: UTC if dated, else local standard time in this year."""
    if not dated:
        try:
            hour = float(cells["hour"])
        except ValueError:
            raise _bad_row(
                path, f"line {line}: hour is '{cells['hour']}'", "a number such as 12.5"
            ) from None
        return _moment(path, line, year, cells["month"], cells["day"], hour)
    try:
        return parse_utc(cells["t_utc"].strip())
    except ValueError as error:
        raise _bad_row(
            path, f"line {line}: {error}", "a UTC time such as 2027-03-20T15:30:00Z"
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
                    f"the comment '{line}'",
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
        raise _bad_row(path, f"line {line}: '{text}' in the time", "an integer") from None


def _moment(path: Path, line: int, year: str, month: str, day: str, hour: float) -> datetime:
    try:
        y, m, d = (_integer(path, line, text) for text in (year, month, day))
        start = datetime(y, m, d, tzinfo=UTC)
        if not 0 <= hour <= 24:
            raise ValueError(f"hour {hour:g} is outside 0 to 24")
    except ValueError as error:
        raise _bad_row(
            path,
            f"line {line}: no such time {year}-{month}-{day} hour {hour:g} ({error})",
            "a date of the calendar and an hour of 0 to 24",
        ) from None
    return start + timedelta(seconds=round(hour * 3600))


def _check_zone(path: Path, place: Site, offset: timedelta) -> None:
    hours = offset.total_seconds() / 3600
    if abs(hours - place.longitude_deg / 15) > _LARGEST_ZONE_OFFSET_H:
        raise InputError(
            path,
            f"time zone UTC{hours:+g} at longitude {place.longitude_deg:g} deg",
            f"about UTC{place.longitude_deg / 15:+.0f}",
            "correct the header (east is positive)",
        )
