"""Readers of weather files: a table of formats that all read their rows in the same strict way.

Each format states times in its own way: its documentation defines which span or moment a row is of.
Where it leaves a choice, the choice that agrees best with sunrise and sunset is taken and listed.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fieldlum.core.errors import InputError
from fieldlum.core.records import Site
from fieldlum.core.strict_csv import (
    IRRADIANCE_LIMITS_WM2,
    check_names,
    is_wm2,
    numbered,
    read_time,
    split_header,
    split_heading,
    split_rows,
)
from fieldlum.sky import sun
from fieldlum.weather.plausibility import hours_against
from fieldlum.weather.year import TYPICAL_YEAR

# Codes of a missing value: EPW 9999, TMY3 -9900, SolarAnywhere -999 (their documentation).
_MISSING = (9999.0, 99999.0, 999999.0, -9900.0, -9999.0, -999.0)
# Degrees of longitude over 15 minus the zone's hours; western China (3.3 h) is the extreme of the
# time zones in use, so that a larger difference is a wrong sign or zone. Chosen just above.
_LARGEST_ZONE_OFFSET_H = 3.5
_HALF = timedelta(minutes=30)  # of an hour, by definition
# A span of +-10 min separates labels that are half an hour apart, which a span of an hour does not.
# Chosen.
_NARROW = timedelta(minutes=10)
_EVERY_DAY = 5  # every fifth day decides: 73 sunrises and sunsets, at a fifth of the time; chosen
_HOURS_OF_LEAP_YEAR = 8784
# Below this altitude the direct irradiance of a horizontal plane does not determine the normal one.
# The limit of pvlib.irradiance.dni.
_LOW_SUN_DEG = 2.0
_OFFSET = re.compile(r"Irradiance Time Offset \(h\):\s*(-?\d+(?:\.\d+)?)", re.IGNORECASE)
# The letters of column headings without their unit, by quantity: TMY3, SAM, NSRDB, PVGIS,
# SolarAnywhere.
_HEADINGS = {
    "dni": {"dni", "beam", "dn", "gbn", "directnormal", "directnormalirradiancedni"},
    "dhi": {"dhi", "diffuse", "df", "gdh", "diffusehorizontal", "diffusehorizontalirradiancedif"},
    "ghi": {"ghi", "global", "gh", "globalhorizontal", "globalhorizontalirradianceghi"},
}
_IN_PLANE = {"dni": {"gbi"}, "dhi": {"gdi"}, "ghi": set[str]()}


@dataclass(frozen=True, slots=True)
class WeatherRow:
    """One hour of a file; irradiances in W/m2, NaN where missing.

    line: number in the file, from 1; when: a time within the hour that the file states, on the
    file's own clock and written as if it were UTC; in `files`, the middle of the hour in UTC.
    """

    line: int
    when: datetime
    dni: float
    dhi: float
    ghi: float


@dataclass(frozen=True, slots=True)
class WeatherTable:
    """The content of a file: rows, whether they are a typical year, and its name.

    clock: the file's clock minus UTC; shift: from the time of a row to the middle of its hour;
    place: that of the header, None without one; notes: choices of the reader, one sentence each.
    """

    rows: list[WeatherRow]
    typical: bool
    name: str
    place: Site | None = None
    clock: timedelta = timedelta()
    shift: timedelta = timedelta()
    notes: tuple[str, ...] = ()


def read_table(path: Path, lines: list[str], site: Site) -> WeatherTable:
    """Return the content of a weather file by the first of `FORMATS` that recognises it.

    lines: of the file; site: for formats that state no place or zone. Raises InputError for a
    header or row that the format does not allow, and for irradiance outside -10 to 1600 W/m2.
    """
    first, second = [*(text for _, text in numbered(lines[:50])), "", ""][:2]
    start = Start(path.suffix.lower(), first.lstrip(), second)
    read = next(form.read for form in FORMATS if form.recognises(start))
    if read is not _read_csv and lines[0].startswith("#"):
        found = f"a comment above the header '{first[:40]}'"
        raise InputError(path, found, "this format's header in line 1", "remove the comment")
    return read(path, lines, site)


# ----------------------------------------------------------------------------------------------
# cells, columns and headers


def _bad_row(path: Path, found: str, expected: str) -> InputError:
    return InputError(path, found, expected, "correct that row")


def _number(path: Path, line: int, name: str, text: str) -> float:
    """Return an irradiance; NaN for an empty cell, nan, and the codes of missing values.

    Raises InputError for a cell that is no number or outside -10 to 1600 W/m2.
    """
    if text.lower() in ("", "nan", "na"):
        return math.nan
    try:
        value = float(text)
    except ValueError:
        expected = "a number with a decimal point, in W/m2"
        raise _bad_row(path, f"line {line}: {name} is '{text}'", expected) from None
    if value in _MISSING:
        return math.nan
    low, high = IRRADIANCE_LIMITS_WM2
    if not low <= value <= high:
        found, expected = f"line {line}: {name} is {text}", f"{low:g} to {high:g}"
        raise InputError(path, f"{found} W/m2", f"{expected} W/m2", "correct or empty that cell")
    return value


def _columns(
    path: Path, names: Sequence[str], headings: Mapping[str, set[str]] = _HEADINGS
) -> dict[str, int]:
    """Return the column of each quantity: dni, dhi, and ghi if the file has it.

    Raises InputError if one is missing, or if several columns have the same quantity.
    """
    columns: dict[str, int] = {}
    letters = [re.sub("[^a-z]", "", split_heading(name)[0].lower()) for name in names]
    for quantity, keys in headings.items():
        at = [k for k, text in enumerate(letters) if text in keys]
        if len(at) > 1:
            found = f"several columns of {quantity.upper()}: {', '.join(names[k] for k in at)}"
            raise InputError(path, found, "one column", "rename or remove the others")
        if not at and quantity != "ghi":
            found = f"no column of {quantity.upper()} in W/m2 among {', '.join(names)[:120]}"
            expected = "direct normal (DNI) and diffuse horizontal (DHI) irradiance in W/m2"
            raise InputError(path, found, expected, "download it again with these columns")
        columns |= {quantity: at[0]} if at else {}
    return columns


def _rows(
    path: Path,
    cells_of_lines: Iterable[tuple[int, Sequence[str]]],
    columns: Mapping[str, int],
    when: Callable[[int, Sequence[str]], datetime],
    names: Sequence[str] = (),
) -> list[WeatherRow]:
    """Return the rows of a file; when: the time that the cells of a line state."""
    rows = []
    headings = {q: names[at] if names else q.upper() for q, at in columns.items()}
    for line, cells in cells_of_lines:
        dni, dhi, ghi = (
            _number(path, line, headings[q], cells[columns[q]]) if q in columns else math.nan
            for q in _HEADINGS
        )
        rows.append(WeatherRow(line, when(line, cells), dni, dhi, ghi))
    return rows


def _below(
    path: Path, lines: list[str], header: int
) -> tuple[list[str], list[tuple[int, tuple[str, ...]]]]:
    """Return the column names in line `header` (from 0), and the rows below them."""
    if len(lines) <= header:
        raise InputError(
            path, f"{len(lines)} lines", "a line of column names", "download the file again"
        )
    names = split_header(path, (header + 1, lines[header]))
    check_names(path, names)
    return names, split_rows(path, numbered(lines[header + 1 :], header + 2), len(names))


def _place(
    path: Path, cells: Sequence[Any], expected: str, name: str, *, local: bool = True
) -> tuple[Site, timedelta]:
    """Return a place and its clock from latitude, longitude, altitude and zone.

    Raises InputError if they are no numbers, or if the zone of a local clock is far from the
    longitude.
    """
    try:
        latitude, longitude, altitude, zone = (float(cell) for cell in cells)
        place, clock = Site(name, latitude, longitude, "UTC", altitude), timedelta(hours=zone)
    except (TypeError, ValueError):
        stated = ", ".join(map(str, cells)) or "missing"
        found = f"latitude, longitude, altitude and zone {stated}"
        remedy = "correct the header, or download the file again"
        raise InputError(path, found, expected, remedy) from None
    if local and abs(zone - longitude / 15) > _LARGEST_ZONE_OFFSET_H:
        found = f"time zone UTC{zone:+g} at longitude {longitude:g} deg"
        remedy = "correct the header (east is positive)"
        raise InputError(path, found, f"about UTC{longitude / 15:+.0f}", remedy)
    return place, clock


def _header_place(
    path: Path, lines: list[str], columns: tuple[int, int, int, int], expected: str
) -> tuple[Site, timedelta]:
    """Return the place and clock in line 1; columns : of latitude, longitude, altitude, zone."""
    cells = split_header(path, (1, lines[0]))
    name = cells[1] if len(cells) > 1 else ""
    values = [cells[k] for k in columns] if len(cells) > max(columns) else []
    return _place(path, values, expected, name or "weather station")


def _moment(path: Path, line: int, date: Sequence[str], hour: str, minute: str = "0") -> datetime:
    """Return the time of year, month and day, an hour of 0 to 24 and a minute."""
    try:
        year, month, day = (int(float(text)) for text in date)
        hours = float(hour) + float(minute) / 60.0
        start = datetime(year, month, day, tzinfo=UTC)
        if not 0 <= hours <= 24:
            raise ValueError(f"hour {hours:g} is outside 0 to 24")
    except (ValueError, OverflowError) as error:
        found = f"line {line}: no such time {'-'.join(date)} hour {hour} ({error})"
        raise _bad_row(path, found, "a date of the calendar and an hour of 0 to 24") from None
    return start + timedelta(seconds=round(hours * 3600))


def best_of(tables: Mapping[str, WeatherTable], what: str) -> WeatherTable:
    """Return the table with which the fewest hours contradict the sun, and list the choice.

    tables : the readings of one file by name; what : how the note begins.
    """
    against: dict[str, int] = {}
    for name, table in tables.items():
        some = [row for k, row in enumerate(table.rows) if (k // 24) % _EVERY_DAY == 0]
        times = [row.when - table.clock + table.shift for row in some]
        light = np.nan_to_num([[row.dni, row.dhi] for row in some]).sum(axis=1)
        place = table.place or Site("", 0.0, 0.0)
        against[name] = sum(hours_against(times, light, place, half) for half in (_HALF, _NARROW))
    chosen = min(against, key=lambda name: against[name])
    counts = ", ".join(f"{name} {count}" for name, count in against.items())
    note = f"{what} {chosen}, with which the fewest hours contradict sunrise and sunset ({counts})"
    return replace(tables[chosen], notes=(*tables[chosen].notes, note))


def _best_label(table: WeatherTable) -> WeatherTable:
    """Return the table with its labels taken as start, middle or end of the hour."""
    shifts = {"hour starts": _HALF, "hour middles": timedelta(0), "hour ends": -_HALF}
    tables = {name: replace(table, shift=shift) for name, shift in shifts.items()}
    return best_of(tables, "row times taken as")


def _is_typical(rows: Sequence[WeatherRow]) -> bool:
    """Return whether the months of one year come from several years."""
    return len({row.when.year for row in rows}) > 1 and len(rows) <= _HOURS_OF_LEAP_YEAR


# ----------------------------------------------------------------------------------------------
# the formats


def _read_epw(path: Path, lines: list[str], site: Site) -> WeatherTable:
    """Return the rows of an EPW file: eight header lines, then one row for each hour.

    Hour 1 is 00:00 to 01:00 local standard time; the sun of a row is that of the middle, 00:30.
    """
    expected = "LOCATION,city,,,,,latitude,longitude,zone,altitude"
    place, clock = _header_place(path, lines, (6, 7, 9, 8), expected)
    found = split_rows(path, numbered(lines[8:], 9))
    if found and len(found[0][1]) < 16:
        cells = f"line {found[0][0]}: {len(found[0][1])} cells"
        raise InputError(path, cells, "at least 16 cells", "the file is cut: download it again")

    def start(line: int, cells: Sequence[str]) -> datetime:
        return _moment(path, line, cells[:3], cells[3]) - timedelta(hours=1)

    rows = _rows(path, found, {"ghi": 13, "dni": 14, "dhi": 15}, start)
    table = WeatherTable(rows, True, f"{path.name} ({place.name})", place, clock, _HALF)
    comments = [line for line in lines[:8] if line.upper().startswith("COMMENTS")]
    if not (stated := _OFFSET.search("\n".join(comments))):
        return table
    # PVGIS: values are of one moment, the label (hours 1 to 24) plus the stated offset. Some
    # versions write the rows in UTC although the header states a zone.
    hours = float(stated[1])
    moved = replace(table, shift=timedelta(hours=1 + hours), notes=(_moved(hours),))
    if not clock:
        return moved
    zones = {"header's zone": moved, "UTC": replace(moved, clock=timedelta())}
    return best_of(zones, "row times taken in")


def _moved(hours: float) -> str:
    return f"rows moved by {60 * hours:+.0f} min, the irradiance time offset that PVGIS states"


def _read_tmy3(path: Path, lines: list[str], site: Site) -> WeatherTable:
    """Return the rows of a TMY3 or SolarAnywhere file: a header line, names, a row for each hour.

    Labels of TMY3 are the ends of hours, 01:00 to 24:00; the sun of a row is that of 30 minutes
    before. SolarAnywhere has date and time in one column, with labels of either end.
    """
    expected = "USAF,name,state,zone,latitude,longitude,altitude"
    place, clock = _header_place(path, lines, (4, 5, 6, 3), expected)
    names, found = _below(path, lines, 1)
    one_column = "ObservationTime(LST)" in names
    at = names.index("ObservationTime(LST)") if one_column else 0

    def when(line: int, cells: Sequence[str]) -> datetime:
        stamp = cells[at].split(" ") if one_column else cells[:2]
        month, day, year = (*stamp[0].split("/"), "", "")[:3]
        hour, _, minute = "".join(stamp[1:2]).partition(":")
        label = _moment(path, line, (year, month, day), hour, minute)
        return label if one_column else label - _HALF

    rows = _rows(path, found, _columns(path, names), when, names)
    typical = not one_column or _is_typical(rows) or "Type: Typical" in lines[0]
    table = WeatherTable(rows, typical, f"{path.name} ({place.name})", place, clock)
    return _best_label(table) if one_column else table


def _read_sam(path: Path, lines: list[str], site: Site) -> WeatherTable:
    """Return the rows of a csv of NSRDB or SAM: two lines on the place, names, then the rows.

    Without a column Minute a row is of the middle of its hour (SAM's file format). NSRDB labels
    the middle with minute 30. With minute 0 the choice that agrees best with the sun is taken.
    """
    expected = "a header with Latitude, Longitude, Elevation and Time Zone"
    keys, values = (split_header(path, line) for line in list(enumerate(lines[:2], start=1)))
    about = dict(zip(keys, values, strict=False))
    cells = [about.get(key, "") for key in ("Latitude", "Longitude", "Elevation", "Time Zone")]
    place, clock = _place(path, cells, expected, about.get("City", "").strip("-") or "station")
    names, found = _below(path, lines, 2)
    stamp = ("Year", "Month", "Day", "Hour")
    if missing := [name for name in stamp if name not in names]:
        expected = "columns " + ", ".join(stamp)
        raise InputError(path, f"no column {missing[0]}", expected, "download it again")
    at = [names.index(name) for name in stamp]
    minutes = names.index("Minute") if "Minute" in names else None

    def when(line: int, cells: Sequence[str]) -> datetime:
        *date, hour = (cells[k] for k in at)
        return _moment(path, line, date, hour, "0" if minutes is None else cells[minutes])

    rows = _rows(path, found, _columns(path, names), when, names)
    typical = _is_typical(rows) or "TMY" in about.get("Source", "").upper()
    table = WeatherTable(rows, typical, f"{path.name} ({place.name})", place, clock)
    if minutes is None:
        return replace(table, shift=_HALF)
    return _best_label(table) if {row.when.minute for row in rows} == {0} else table


def _read_tmy2(path: Path, lines: list[str], site: Site) -> WeatherTable:
    """Return the rows of a TMY2 file; each is the mean of the hour that ends at its label.

    pvlib reads its fixed columns, and returns the start of the hour.
    """
    from pvlib.iotools import read_tmy2

    width = len(lines[1].rstrip()) if len(lines) > 1 else 0
    for number, line in enumerate(lines[2:], start=3):
        if len(line.rstrip()) != width:
            found = f"line {number}: {len(line.rstrip())} characters"
            raise _bad_row(path, found, f"{width} characters, as in line 2")
    data: Any
    meta: Any
    try:
        data, meta = read_tmy2(path)
    except (KeyError, ValueError, IndexError, TypeError, AttributeError) as error:
        shown = str(error).splitlines()[0][:100] if str(error) else type(error).__name__
        raise InputError(path, shown, "a TMY2 file", "download it again as hourly data") from None
    where = [meta[key] for key in ("latitude", "longitude", "altitude", "TZ")]
    place, clock = _place(path, where, "a place in line 1", str(meta["City"]).strip())
    starts = [t.replace(tzinfo=UTC) for t in data.index.to_pydatetime()]
    values = data[["DNI", "DHI", "GHI"]].to_numpy(float).tolist()
    cells = [(line, tuple(map(repr, row))) for line, row in enumerate(values, start=2)]
    columns = {"dni": 0, "dhi": 1, "ghi": 2}
    rows = _rows(path, cells, columns, lambda line, _: starts[line - 2])
    return WeatherTable(rows, True, f"{path.name} ({place.name})", place, clock, _HALF)


def _read_pvgis_csv(path: Path, lines: list[str], site: Site) -> WeatherTable:
    """Return the rows of a csv of PVGIS, a typical year or an hourly series."""
    header = next((k for k, line in enumerate(lines) if line.startswith("time")), len(lines))
    stated_texts = (line.partition(":") for line in lines[:header])
    about = {key.strip(): value.strip() for key, _, value in stated_texts}
    # Below the rows, an empty line and a legend follow.
    end = next((k for k, line in enumerate(lines) if k > header and not line.strip()), len(lines))
    for number, line in enumerate(lines[end:], start=end + 1):
        if re.match(r"\d{8}:", line):
            raise _bad_row(path, f"line {number}: a row below the last one", "rows without gaps")
    names, found = _below(path, lines[:end], header)
    keys = ("Latitude (decimal degrees)", "Longitude (decimal degrees)", "Elevation (m)")
    stated = [*(about.get(key, "") for key in keys), "0"]
    slope = about.get("Slope", "0").split()[0]
    return _pvgis(path, names, found, stated, about.get("Irradiance Time Offset (h)", "0"), slope)


def _read_pvgis_json(path: Path, lines: list[str], site: Site) -> WeatherTable:
    """Return the rows of a json of PVGIS, a typical year or an hourly series."""
    try:
        answer = json.loads("\n".join(lines))
        outputs, about = answer["outputs"], answer["inputs"]
        hours = outputs["tmy_hourly" if "tmy_hourly" in outputs else "hourly"]
        names = list(hours[0])
        cells = [
            (k, tuple("" if hour[name] is None else str(hour[name]) for name in names))
            for k, hour in enumerate(hours, start=1)
        ]
        place = about["location"]
        stated = [*(place[key] for key in ("latitude", "longitude", "elevation")), "0"]
        offset = next((str(v) for k, v in place.items() if "offset" in k.lower()), "0")
        fixed = about.get("mounting_system", {}).get("fixed", {})
        slope = str(fixed.get("slope", {}).get("value", 0))
    except (KeyError, IndexError, TypeError, AttributeError, ValueError) as error:
        shown = f"no key {error}" if isinstance(error, KeyError) else str(error)[:100]
        expected = "json of PVGIS with outputs of each hour"
        raise InputError(path, shown, expected, "download it again as hourly data") from None
    return _pvgis(path, names, cells, stated, offset, slope)


def _pvgis(
    path: Path,
    names: Sequence[str],
    found: Iterable[tuple[int, Sequence[str]]],
    stated: Sequence[Any],
    offset: str,
    slope: str,
) -> WeatherTable:
    """Return the hours of a PVGIS file; stated : its place.

    Values are of one moment: the UTC time of the row plus the offset that the header states (PVGIS,
    "TMY generator" page). Times of an hourly series are the moments themselves. A series has the
    direct irradiance of a plane, which determines DNI only on a horizontal plane.
    """
    name = f"PVGIS at {stated[0]}, {stated[1]} deg"
    place, _ = _place(path, stated, "a place in the header", name, local=False)
    in_plane = "Gb(i)" in names
    if in_plane and slope.replace(".", "").strip("0"):
        found_slope = f"irradiance of a plane with slope {slope} deg"
        remedy = "download the series with slope 0 and its radiation components"
        raise InputError(path, found_slope, "a horizontal plane (slope 0 deg)", remedy)
    at = next((k for k, name in enumerate(names) if name.startswith("time")), 0)

    def when(line: int, cells: Sequence[str]) -> datetime:
        try:
            return datetime.strptime(cells[at], "%Y%m%d:%H%M").replace(tzinfo=UTC)
        except ValueError:
            expected = "a time such as 20230101:0010"
            raise _bad_row(path, f"line {line}: time '{cells[at]}'", expected) from None

    columns = _columns(path, names, _IN_PLANE if in_plane else _HEADINGS)
    rows = _rows(path, found, columns, when, names)
    name = f"{path.name} (PVGIS)"
    if in_plane:
        note = "DNI computed as Gb(i) over the sine of the sun's altitude"
        return WeatherTable(_normal(rows, place), False, name, place, notes=(note,))
    hours = float(offset)
    notes = (_moved(hours),) if hours else ()
    return WeatherTable(rows, True, name, place, shift=timedelta(hours=hours), notes=notes)


def _normal(rows: Sequence[WeatherRow], place: Site) -> list[WeatherRow]:
    """Return rows whose DNI is on a horizontal plane with it on a plane normal to the sun.

    Zero with the sun below 2 deg, and at most 1.1 times that of a clear sky with the sun below 10
    deg, as in pvlib.irradiance.dni: near the horizon a small error of time has a large effect.
    """
    times = [row.when for row in rows]
    altitude = sun.position(times, place).altitude_deg
    beam = np.array([row.dni for row in rows])
    normal = beam / np.sin(np.radians(np.maximum(altitude, _LOW_SUN_DEG)))
    limit = np.where(
        altitude < 10.0, 1.1 * sun.clearsky(times, place).dni_wm2, IRRADIANCE_LIMITS_WM2[1]
    )
    dni = np.where(altitude < _LOW_SUN_DEG, 0.0, np.minimum(normal, limit))
    ghi = np.where(altitude < _LOW_SUN_DEG, np.nan, beam + [row.dhi for row in rows])
    return [
        replace(row, dni=float(a), ghi=float(b)) for row, a, b in zip(rows, dni, ghi, strict=True)
    ]


def _read_csv(path: Path, lines: list[str], site: Site) -> WeatherTable:
    """Return the rows of a csv file of hour centres.

    Columns t_utc, dni_wm2, dhi_wm2, or month, day, hour (local standard time), dni_wm2, dhi_wm2;
    ghi_wm2 is optional.
    """
    place, clock = _place_comment(path, lines, site)
    table = numbered(lines)
    names = split_header(path, table[0]) if table else []
    check_names(path, names)
    dated = "t_utc" in names
    quantities = {
        split_heading(name)[0].lower(): k
        for k, name in enumerate(names)
        if is_wm2(split_heading(name)[1])
    }
    stamp = ("t_utc",) if dated else ("month", "day", "hour")
    missing = [name for name in stamp if name not in names]
    missing += [f"{name}_wm2" for name in ("dni", "dhi") if name not in quantities]
    if missing:
        expected = "columns t_utc (or month, day, hour), dni_wm2, dhi_wm2"
        remedy = "name the columns in the first row"
        raise InputError(path, f"no column {', '.join(missing)}", expected, remedy)
    found = split_rows(path, table[1:], len(names))
    at = [names.index(name) for name in stamp]
    # Hour 24 of 28 February belongs to 29 February only in a file with that day.
    leap = not dated and any((c[at[0]].lstrip("0"), c[at[1]]) == ("2", "29") for _, c in found)

    def when(line: int, cells: Sequence[str]) -> datetime:
        if not dated:
            month, day, hour = (cells[k] for k in at)
            return _moment(path, line, ("2024" if leap else "2023", month, day), hour)
        try:
            return read_time(cells[at[0]], utc=True).astimezone(UTC)
        except (ValueError, OverflowError) as error:
            expected = "a UTC time such as 2027-03-20T15:30:00Z"
            raise _bad_row(path, f"line {line}: {error}", expected) from None

    rows = _rows(path, found, quantities, when, names)
    return WeatherTable(rows, not dated, path.name, place, clock=timedelta() if dated else clock)


def _place_comment(path: Path, lines: list[str], site: Site) -> tuple[Site | None, timedelta]:
    """Return the place and zone of a line ``# place: NAME, LATITUDE, LONGITUDE, UTC-8``.

    Without such a line: no place, and the offset of the site's own standard time.
    """
    for line in lines[:20]:
        if line.startswith("# place:"):
            name, *cells = (part.strip() for part in line[8:].rsplit(",", 3))
            zone = [(cell.removeprefix("UTC") or "0") for cell in cells[2:]]
            expected = "'# place: NAME, LATITUDE, LONGITUDE, UTC-8'"
            return _place(path, [*cells[:2], "0", *zone], expected, name)
    return None, sun.standard_offset(site.timezone, TYPICAL_YEAR)


# ----------------------------------------------------------------------------------------------
# the table


class Start(NamedTuple):
    """By what a format is recognised: the file's suffix in small letters, and its first lines."""

    suffix: str
    first: str
    second: str


class Format(NamedTuple):
    """A weather format: how a file of it is recognised, and its reader (CONTRIBUTING.md)."""

    recognises: Callable[[Start], bool]
    read: Callable[[Path, list[str], Site], WeatherTable]


FORMATS = (
    Format(lambda start: start.suffix == ".tm2", _read_tmy2),
    Format(
        lambda start: start.suffix == ".epw" or start.first.upper().startswith("LOCATION,"),
        _read_epw,
    ),
    Format(lambda start: start.first.startswith("Latitude (decimal degrees)"), _read_pvgis_csv),
    Format(lambda start: start.first.startswith("{"), _read_pvgis_json),
    Format(lambda start: start.first.startswith("Source,"), _read_sam),
    Format(
        lambda start: (
            "ObservationTime(LST)" in start.second
            or start.second.lstrip('"').startswith("Date (MM/DD/YYYY)")
        ),
        _read_tmy3,
    ),
    Format(lambda start: True, _read_csv),  # the last one: its errors explain the columns
)
