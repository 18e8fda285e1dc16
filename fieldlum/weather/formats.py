"""Read weather files: a table of formats that all read their rows in the same strict way.

Each format states times in its own way: its documentation defines the span or moment of a row.
Where it leaves a choice, the choice that agrees best with sunrise and sunset is taken and listed.
"""

import json
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fieldlum.core import strict_csv
from fieldlum.core.errors import InputError, input_errors
from fieldlum.core.records import Site
from fieldlum.sky import sun
from fieldlum.weather.plausibility import contradictions
from fieldlum.weather.year import TYPICAL_YEAR

_HALF = timedelta(minutes=30)  # of an hour, by definition
# Around a row's time, light is compared with the sun over +-10 min: that separates labels that are
# half an hour apart, which +-30 min does not. Chosen.
_NARROW = timedelta(minutes=10)
_OFFSET = re.compile(r"Irradiance Time Offset \(h\):\s*(-?\d+(?:\.\d+)?)", re.IGNORECASE)
# The letters of column headings without their unit, by quantity: TMY3, SAM, NSRDB, PVGIS,
# SolarAnywhere, Solcast, CAMS (bni), Open-Meteo.
_HEADINGS = {
    "dni": "dni beam dn gbn bni directnormal directnormalirradiance directnormalirradiancedni",
    "dhi": "dhi diffuse df gdh diffusehorizontal diffuseradiation diffusehorizontalirradiancedif",
    "ghi": "ghi global gh globalhorizontal shortwaveradiation globalhorizontalirradianceghi",
}
# The same for an hourly series of PVGIS in a plane: beam and diffuse irradiance of the plane.
_IN_PLANE = {"dni": "gbi", "dhi": "gdi", "ghi": ""}
# First character, and last + 1, of the cells of a TMY2 row: year, month, day, hour, DNI, DHI, GHI
# (its manual).
_TMY2 = ((1, 3), (3, 5), (5, 7), (7, 9), (23, 27), (29, 33), (17, 21))
_AGAIN = "download the file again as hourly data"
Cells = Sequence[str]
Rows = Iterable[tuple[int, Cells]]


class WeatherRow(NamedTuple):
    """One hour of a file; irradiances in W/m2, NaN where missing.

    line: number in the file, from 1; when: the time that the file states for the hour (the hour's
    start, middle or end), on the file's own clock and stored as if it were UTC.
    """

    line: int
    when: datetime
    ghi: float
    dhi: float
    dni: float


@dataclass(frozen=True, slots=True)
class WeatherTable:
    """The content of a weather file.

    typical: whether the rows are a typical year; place: of the header, None without one; clock: the
    file's clock minus UTC; shift: from the time of a row to the middle of its hour; notes: choices
    of the reader, one sentence each.
    """

    rows: list[WeatherRow]
    _: KW_ONLY
    typical: bool
    place: Site | None = None
    clock: timedelta = timedelta()
    shift: timedelta = timedelta()
    notes: tuple[str, ...] = ()


def read_table(path: Path, lines: list[str], site: Site) -> WeatherTable:
    """Return the content of a weather file, read by the first of `FORMATS` that recognises it.

    A file that no other format recognises is read as fieldlum's own csv. lines: of the file, at
    least one; site: for formats that state no place or zone. Raises InputError for a header or row
    that the format does not allow, and for irradiance outside -10 to 1600 W/m2.
    """
    first, second = [*(text for _, text in strict_csv.numbered(lines[:50])), "", ""][:2]
    start = f"{path.suffix.lower()}\n{first.lstrip()}\n{second}".replace('"', "")
    # The last pattern is empty and matches every file.
    read = next(read for pattern, read in FORMATS if re.match(pattern, start))
    if read not in _BELOW_COMMENTS and lines[0].startswith("#"):
        found = f"a comment above the header '{first[:40]}'"
        raise InputError(path, found, "this format's header in line 1", "remove the comment")
    return read(path, lines, site)


# ----------------------------------------------------------------------------------------------
# cells, columns and headers


class _CellError(ValueError):
    """A cell that cannot be read; args: what was found, and what was expected."""


def _number(name: str, text: str) -> float:
    """Return the irradiance of a cell in W/m2; NaN for a missing value.

    name: of its column, for the error. Raises _CellError for a cell that is no number or outside
    -10 to 1600 W/m2.
    """
    low, high = strict_csv.IRRADIANCE_LIMITS_WM2
    try:
        value = strict_csv.read_number(text)
    except ValueError as error:
        raise _CellError(f"{name} {error}", "a number with a decimal point, in W/m2") from None
    if value < low or value > high:
        raise _CellError(f"{name} is {text} W/m2", f"{low:g} to {high:g} W/m2 or empty")
    return value


def _columns(path: Path, names: Cells, headings: Mapping[str, str] = _HEADINGS) -> dict[str, int]:
    """Return the column of each quantity, from 0: dni, dhi, and ghi if the file has it.

    names: the file's column headings; headings: for each quantity, the possible ones, as letters
    without unit. Raises InputError if DNI or DHI is missing, or if several columns have the same
    quantity.
    """
    columns: dict[str, int] = {}
    letters = [re.sub("[^a-z]", "", strict_csv.split_heading(name)[0].lower()) for name in names]
    for quantity, keys in headings.items():
        at = [k for k, text in enumerate(letters) if text in keys.split()]
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
    lines: Rows,
    when: Callable[[Cells], datetime],
    names: Cells = (),
    columns: Mapping[str, int] | None = None,
) -> list[WeatherRow]:
    """Return the rows of a file from the cells of its lines.

    lines: line numbers and cells; when: returns the time that the cells of a line state; names: the
    file's column headings; columns: the column of each quantity, from 0; None for those that the
    headings name. A quantity without a column is NaN. Raises InputError as `_columns`, and, with
    the line, for a cell that cannot be read.
    """
    columns = _columns(path, names) if columns is None else columns
    headings = {name: names[k] if names else name.upper() for name, k in columns.items()}
    missing, rows = dict.fromkeys(_HEADINGS, math.nan), []
    for line, cells in lines:
        try:
            light = {name: _number(headings[name], cells[k]) for name, k in columns.items()}
            rows.append(WeatherRow(line, when(cells), **missing | light))
        except _CellError as error:
            found, expected = error.args
            raise InputError(path, f"line {line}: {found}", expected, "correct that row") from None
    return rows


def _below(
    path: Path, lines: list[str], header: int, mark: str = ","
) -> tuple[list[str], list[tuple[int, tuple[str, ...]]]]:
    """Return the column names in line `header` (from 0), and the lines below it.

    Each line is its number, from 1, and its cells; mark: the character between cells. Raises
    InputError for missing or repeated names, and for a line with another number of cells.
    """
    if len(lines) <= header:
        raise InputError(path, f"{len(lines)} lines", "a line of column names", _AGAIN)
    names = strict_csv.split_header(path, (header + 1, lines[header].lstrip("# ")), mark)
    strict_csv.check_names(path, names)
    rows = strict_csv.numbered(lines[header + 1 :], header + 2)
    return names, strict_csv.split_rows(path, rows, len(names), mark)


def _place(path: Path, cells: Sequence[Any], expected: str, name: str) -> tuple[Site, timedelta]:
    """Return the place of a header, and its clock minus UTC.

    cells: latitude, longitude, altitude and zone in hours, as text or numbers, None for 0;
    expected: for the error; name: of the place. Raises InputError if they are no numbers, or if the
    zone of a local clock is further from the longitude than western China's, 3.3 h, the extreme of
    the zones in use.
    """
    try:
        latitude, longitude, altitude, zone = (float(0 if cell is None else cell) for cell in cells)
        place, clock = Site(name, latitude, longitude, "UTC", altitude), timedelta(hours=zone)
    except (TypeError, ValueError):
        found = f"latitude, longitude, altitude and zone {', '.join(map(str, cells)) or 'missing'}"
        remedy = "correct the header, or download the file again"
        raise InputError(path, found, expected, remedy) from None
    # Samoa, Tonga, Kiritimati and others have the date of the east, with zones of +12 to +14.
    nearest = zone - 24 if zone >= 12 and longitude < -150 else zone
    if zone and abs(nearest - longitude / 15) > 3.5:
        found = f"time zone UTC{zone:+g} at longitude {longitude:g} deg"
        remedy = "correct the header (east is positive)"
        raise InputError(path, found, f"about UTC{longitude / 15:+.0f}", remedy)
    return place, clock


def _about(lines: Sequence[str]) -> dict[str, str]:
    """Return the values by key of lines such as ``Elevation (m): 10`` or ``"# key: value",,``."""
    stated = (line.strip('"#, ').partition(":") for line in lines)
    return {key.strip(): value.strip() for key, _, value in stated}


def _header_place(
    path: Path, lines: list[str], columns: tuple[int, int, int, int], expected: str
) -> tuple[Site, timedelta]:
    """Return the place in line 1, and its clock minus UTC.

    columns: of latitude, longitude, altitude and zone, from 0; expected: for errors.
    """
    cells = strict_csv.split_header(path, (1, lines[0]))
    values = [cells[k] for k in columns] if len(cells) > max(columns) else []
    return _place(path, values, expected, "".join(cells[1:2]) or "weather station")


def _moment(date: Cells, hour: str, minute: str = "0") -> datetime:
    """Return the time of year, month and day, an hour of 0 to 24 and a minute, all as texts.

    Raises _CellError for a date that does not exist.
    """
    try:
        year, month, day = (int(float(text)) for text in date)
        hours = float(hour) + float(minute) / 60.0
        start = datetime(year, month, day, tzinfo=UTC)
        if not 0 <= hours <= 24:
            raise ValueError(f"hour {hours:g} is outside 0 to 24")
    except (ValueError, OverflowError):
        found = f"no such time {'-'.join(date).strip('-')} hour {hour}"
        raise _CellError(found, "a date of the calendar and an hour of 0 to 24") from None
    return start + timedelta(seconds=round(hours * 3600))


def best_of(tables: Mapping[str, WeatherTable], what: str) -> WeatherTable:
    """Return the table with which the fewest hours contradict the sun, with a note on the choice.

    tables: ways to read the times of one file, by name; each has a place. what: how the note
    begins.
    """
    against: dict[str, int] = {}
    for name, table in tables.items():
        times = [row.when - table.clock + table.shift for row in table.rows]
        light = np.nan_to_num([[row.dni, row.dhi] for row in table.rows]).sum(axis=1)
        place = table.place
        assert place is not None  # sunrise is unknown without one
        ends = ([t + half for t in times] for half in (-_NARROW, _NARROW))
        altitudes = (sun.position(moments, place).altitude_deg for moments in ends)
        against[name] = contradictions(light, *altitudes)
    chosen = min(against, key=lambda name: against[name])
    counts = ", ".join(f"{name} {count}" for name, count in against.items())
    note = f"{what} {chosen}, with which the fewest hours contradict sunrise and sunset ({counts})"
    return replace(tables[chosen], notes=(*tables[chosen].notes, note))


def _best_label(table: WeatherTable) -> WeatherTable:
    """Return the table with its labels taken as start, middle or end of hours, the best of them."""
    shifts = {"hour starts": _HALF, "hour middles": timedelta(0), "hour ends": -_HALF}
    tables = {name: replace(table, shift=shift) for name, shift in shifts.items()}
    return best_of(tables, "row times taken as")


def _is_typical(rows: Sequence[WeatherRow]) -> bool:
    """Return whether the months of one year (at most 8784 hours) come from several years.

    Then two months that follow each other are about a year or more apart, unlike in a series.
    """
    days = [row.when.toordinal() for row in rows]
    return len(rows) <= 8784 and bool((np.abs(np.diff(days)) > 300).any())


# ----------------------------------------------------------------------------------------------
# the formats


def _read_epw(path: Path, lines: list[str], site: Site) -> WeatherTable:
    """Return the rows of an EPW file: a header that ends with DATA PERIODS, then hourly rows.

    Hour 1 is 00:00 to 01:00 local standard time; the sun of a row is that of the middle, 00:30.
    """
    expected = "LOCATION,city,,,,,latitude,longitude,zone,altitude"
    place, clock = _header_place(path, lines, (6, 7, 9, 8), expected)
    header = next((k for k, line in enumerate(lines) if line.startswith("DATA PERIODS")), 7) + 1
    periods = "".join(lines[header - 1 : header])
    if several := re.match(r"DATA PERIODS,\s*\d+,\s*([2-9]|\d\d)", periods):
        found = f"{several[1]} rows for each hour"
        raise InputError(path, found, "one row for each hour", "average the file to hours")
    body = strict_csv.split_rows(path, strict_csv.numbered(lines[header:], header + 1))
    for line, cells in body[:1]:
        if len(cells) < 16:
            found = f"line {line}: {len(cells)} cells"
            raise InputError(path, found, "at least 16 cells", "the file is cut: download it again")
    columns = {"ghi": 13, "dni": 14, "dhi": 15}
    rows = _rows(path, body, lambda c: _moment(c[:3], c[3]) - timedelta(hours=1), (), columns)
    table = WeatherTable(rows, typical=True, place=place, clock=clock, shift=_HALF)
    comments = [line for line in lines[:header] if line.upper().startswith("COMMENTS")]
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
    """Return the note on a time offset that the header of a PVGIS file states."""
    return f"rows moved by {60 * hours:+.0f} min, the irradiance time offset that PVGIS states"


def _read_tmy3(path: Path, lines: list[str], site: Site) -> WeatherTable:
    """Return the rows of a TMY3 or SolarAnywhere file: a header line, names, a row for each hour.

    Labels of TMY3 are the ends of hours, 01:00 to 24:00; the sun of a row is that of 30 minutes
    before. SolarAnywhere has date and time in one column, with labels of either end.
    """
    expected = "USAF,name,state,zone,latitude,longitude,altitude"
    place, clock = _header_place(path, lines, (4, 5, 6, 3), expected)
    names, body = _below(path, lines, 1)
    one_column = "ObservationTime(LST)" in names
    at = names.index("ObservationTime(LST)") if one_column else 0

    def when(cells: Cells) -> datetime:
        """Return the time that the cells of a row state, on the file's clock."""
        stamp = cells[at].split(" ") if one_column else cells[:2]
        month, day, year = (*stamp[0].split("/"), "", "")[:3]
        hour, _, minute = "".join(stamp[1:2]).partition(":")
        label = _moment((year, month, day), hour, minute)
        return label if one_column else label - _HALF

    rows = _rows(path, body, when, names)
    typical = not one_column or _is_typical(rows) or "Type: Typical" in lines[0]
    table = WeatherTable(rows, typical=typical, place=place, clock=clock)
    return _best_label(table) if one_column else table


def _read_sam(path: Path, lines: list[str], site: Site) -> WeatherTable:
    """Return the rows of a csv of NSRDB or SAM: two lines on the place, names, then the rows.

    Without a column Minute a row is of the middle of its hour (SAM's file format). NSRDB labels
    the middle with minute 30. With minute 0 the choice that agrees best with the sun is taken.
    """
    expected = "a header with Latitude, Longitude, Elevation and Time Zone"
    head = enumerate([*lines, ""][:2], start=1)
    keys, values = (strict_csv.split_header(path, line) for line in head)
    about = {key.lower(): value for key, value in zip(keys, values, strict=False)}
    spellings = {"latitude": "lat", "longitude": "lon", "elevation": "elev", "time zone": "tz"}
    cells = [about.get(key, about.get(short, "?")) for key, short in spellings.items()]
    place, clock = _place(path, cells, expected, about.get("city", "").strip("-") or "station")
    headings, body = _below(path, lines, 2)
    names = [name.title() for name in headings]
    stamp = ("Year", "Month", "Day", "Hour")
    if missing := [name for name in stamp if name not in names]:
        raise InputError(path, f"no column {missing[0]}", f"columns {', '.join(stamp)}", _AGAIN)
    at = [names.index(name) for name in stamp]
    minutes = names.index("Minute") if "Minute" in names else None

    def when(cells: Cells) -> datetime:
        """Return the time that the cells of a row state, on the file's clock."""
        *date, hour = (cells[k] for k in at)
        return _moment(date, hour, "0" if minutes is None else cells[minutes])

    rows = _rows(path, body, when, headings)
    typical = _is_typical(rows) or "TMY" in about.get("source", "").upper()
    shift = _HALF if minutes is None else timedelta()
    table = WeatherTable(rows, typical=typical, place=place, clock=clock, shift=shift)
    is_full_hour = minutes is not None and {row.when.minute for row in rows} == {0}
    return _best_label(table) if is_full_hour else table


def _read_tmy2(path: Path, lines: list[str], site: Site) -> WeatherTable:
    """Return the rows of a TMY2 file; each is the mean of the hour that ends at its label."""
    *name, zone, ns, north, minutes, ew, east, more, altitude = ["?"] * 8 + lines[0].split()
    expected = "number, city, state, zone, N, degrees, minutes, W, degrees, minutes, altitude"
    with input_errors(path, expected, "download the file again", ValueError):
        latitude = (float(north) + float(minutes) / 60) * (-1 if ns == "S" else 1)
        longitude = (float(east) + float(more) / 60) * (-1 if ew == "W" else 1)
    numbers = [latitude, longitude, altitude, zone]
    place, clock = _place(path, numbers, expected, " ".join(name[9:-1]))
    width = len(lines[1].rstrip()) if len(lines) > 1 else 0
    for number, line in enumerate(lines[2:], start=3):
        if (characters := len(line.rstrip())) != width:
            found, expected = f"line {number}: {characters} characters", f"{width} characters"
            raise InputError(path, found, f"{expected}, as in line 2", "correct that row")
    cells = [[line[a:b].strip() for a, b in _TMY2] for line in lines[1:]]

    def start(cells: Cells) -> datetime:
        """Return the start of the hour whose end the cells of a row state, on the file's clock."""
        return _moment((f"19{cells[0]}", *cells[1:3]), cells[3]) - timedelta(hours=1)

    rows = _rows(path, enumerate(cells, start=2), start, (), {"dni": 4, "dhi": 5, "ghi": 6})
    return WeatherTable(rows, typical=True, place=place, clock=clock, shift=_HALF)


def _read_wea(path: Path, lines: list[str], site: Site) -> WeatherTable:
    """Return the rows of a .wea file of Radiance: the middles of hours, in standard time.

    Its longitude and time zone are degrees, positive to the west (gendaymtx's manual).
    """
    words = (line.partition(" ") for line in lines[:6])
    about = {key: value.strip() for key, _, value in words}
    if (unit := about.get("weather_data_file_units", "?")) != "1":
        expected = "1: direct normal and diffuse horizontal irradiance in W/m2"
        raise InputError(path, f"weather_data_file_units {unit}", expected, "write it again")
    keys = ("latitude", "longitude", "site_elevation", "time_zone")
    with input_errors(path, f"{', '.join(keys)} in the header", _AGAIN, KeyError, ValueError):
        latitude, west, altitude, zone = (float(about[key]) for key in keys)
    numbers = [latitude, -west, altitude, -zone / 15.0]
    place, clock = _place(path, numbers, "a place", about["place"])
    cells = [(k, ",".join(line.split())) for k, line in strict_csv.numbered(lines[6:], 7)]
    body = strict_csv.split_rows(path, cells, 5)
    rows = _rows(path, body, lambda c: _moment(("2023", *c[:2]), c[2]), (), {"dni": 3, "dhi": 4})
    return WeatherTable(rows, typical=True, place=place, clock=clock)


def _read_pvgis(path: Path, lines: list[str], site: Site) -> WeatherTable:
    """Return the rows of a csv of PVGIS, a typical year or an hourly series.

    Values are of one moment: the UTC time of the row plus the offset that the header states (PVGIS,
    "TMY generator" page). Times of an hourly series are the moments themselves. A series has the
    direct irradiance of a plane, which determines DNI only on a horizontal plane.
    """
    header = next((k for k, line in enumerate(lines) if line.startswith("time")), len(lines))
    about = _about(lines[:header])
    # Below the rows, an empty line and a legend follow.
    end = next((k for k, line in enumerate(lines) if k > header and not line.strip()), len(lines))
    for number, line in enumerate(lines[end:], start=end + 1):
        if re.match(r"\d{8}:", line):
            found = f"line {number}: a row below the last one"
            raise InputError(path, found, "rows without gaps", "correct that row")
    names, body = _below(path, lines[:end], header)
    keys = ("Latitude (decimal degrees)", "Longitude (decimal degrees)", "Elevation (m)")
    cells = [*(about.get(key, "?") for key in keys), None]
    place, _ = _place(path, cells, "a place in the header", "PVGIS")
    in_plane, slope = "Gb(i)" in names, about.get("Slope", "?").removesuffix(".")
    if in_plane and not re.match(r"-?0+(\.0+)? deg", slope):
        found = f"irradiance of a plane with slope {slope}"
        remedy = "download the series with slope 0 and its radiation components"
        raise InputError(path, found, "a horizontal plane (slope 0 deg)", remedy)

    def when(cells: Cells) -> datetime:
        """Return the time that the cells of a row state, on the file's clock."""
        try:
            return datetime.strptime(cells[0], "%Y%m%d:%H%M").replace(tzinfo=UTC)
        except ValueError:
            raise _CellError(f"time '{cells[0]}'", "one as 20230101:0010") from None

    columns = _columns(path, names, _IN_PLANE if in_plane else _HEADINGS)
    rows = _rows(path, body, when, names, columns)
    if in_plane:
        note = "DNI computed as Gb(i) over the sine of the sun's altitude"
        rows = _dni_from_horizontal(rows, place)
        return WeatherTable(rows, typical=False, place=place, notes=(note,))
    with input_errors(path, "a number of hours", "download the file again", ValueError):
        hours = float(about.get("Irradiance Time Offset (h)", "0"))
    notes = (_moved(hours),) if hours else ()
    return WeatherTable(rows, typical=True, place=place, shift=timedelta(hours=hours), notes=notes)


def _read_json(path: Path, lines: list[str], site: Site) -> WeatherTable:
    """Return the rows of a json of PVGIS or Open-Meteo, which has the content of the csv.

    It is written as the lines of that csv, which the reader of the csv then reads.
    """
    kinds = (KeyError, IndexError, TypeError, AttributeError, ValueError, RecursionError)
    with input_errors(path, "json of PVGIS with outputs of each hour", _AGAIN, *kinds):
        answer = json.loads("\n".join(lines))
        if isinstance(answer, list):
            raise ValueError("a list of hours without their place")
        if "utc_offset_seconds" in answer:
            keys = [*_METEO_PLACE, "utc_offset_seconds"]
            units, columns = answer["hourly_units"], answer["hourly"]
            headings = (n if n == "time" else f"{n} ({units[n]})" for n in columns)
            head = [",".join(keys), ",".join(str(answer[key]) for key in keys), ",".join(headings)]
            hours = zip(*columns.values(), strict=True)
            rows = (["" if v is None else str(v) for v in hour] for hour in hours)
            return _read_open_meteo(path, [*head, *map(",".join, rows)], site)
        outputs, about = answer["outputs"], answer["inputs"]
        hours = outputs["tmy_hourly" if "tmy_hourly" in outputs else "hourly"]
        names = sorted(hours[0], key=lambda name: not name.startswith("time"))
        place = about["location"]
        offset = next((v for k, v in place.items() if "offset" in k.lower()), 0)
        slope = about.get("mounting_system", {}).get("fixed", {}).get("slope", {}).get("value", "?")
        head = [
            f"Latitude (decimal degrees): {place['latitude']}",
            f"Longitude (decimal degrees): {place['longitude']}",
            f"Elevation (m): {place['elevation']}",
            f"Irradiance Time Offset (h): {offset}",
            f"Slope: {slope} deg.",
            ",".join(names),
        ]
        cells = [["" if hour[n] is None else str(hour[n]) for n in names] for hour in hours]
    return _read_pvgis(path, [*head, *map(",".join, cells)], site)


_METEO_PLACE = ("latitude", "longitude", "elevation")


def _read_open_meteo(path: Path, lines: list[str], site: Site) -> WeatherTable:
    """Return the rows of a csv of Open-Meteo: the place in two lines, names, then the hours.

    Each is the mean of the hour that ends at its label (Open-Meteo's documentation), on a clock of
    `utc_offset_seconds`; labels in seconds since 1970 are UTC.
    """
    head = strict_csv.numbered(lines[:50])[:3]  # line number and text of each
    if len(head) < 3 or not head[2][1].startswith("time,"):
        found = "no line that begins with 'time' below one place"
        raise InputError(path, found, "hours of one place", "download one place, hourly")
    keys, values = (strict_csv.split_header(path, line) for line in head[:2])
    about = dict(zip(keys, values, strict=False))
    with input_errors(path, "a number of utc_offset_seconds", _AGAIN, ValueError):
        hours = float(about.get("utc_offset_seconds", "?")) / 3600.0
    cells = [*(about.get(key, "?") for key in _METEO_PLACE), hours]
    place, clock = _place(path, cells, "a place in the first two lines", "Open-Meteo")
    names, body = _below(path, lines, head[2][0] - 1)

    def when(cells: Cells) -> datetime:
        """Return the time that the cells of a row state, on the file's clock."""
        return _stated(cells[0]) + (clock if cells[0].isdecimal() else timedelta())

    rows = _rows(path, body, when, names)
    return WeatherTable(rows, typical=False, place=place, clock=clock, shift=-_HALF)


def _read_cams(path: Path, lines: list[str], site: Site) -> WeatherTable:
    """Return the rows of a csv of the CAMS radiation service, with semicolons or commas.

    The comments above the rows have the place and the column names. A row states the start and end
    of its hour, and energies in Wh/m2, which are the hour's means in W/m2.
    """
    # A row below the comments exists: by it the format was recognised.
    row, text = strict_csv.numbered(lines)[0]
    header = max((k for k in range(row) if lines[k].startswith("#")), default=0)
    about = {key.partition(" (")[0]: value for key, value in _about(lines[:header]).items()}
    cells = [*(about.get(key, "?") for key in ("Latitude", "Longitude", "Altitude")), None]
    place, _ = _place(path, cells, "a place in the comments", "CAMS")
    if not (reference := about.get("Time reference", "?")).startswith("Universal time"):
        raise InputError(path, f"time reference {reference}", "Universal time (UT)", _AGAIN)
    names, body = _below(path, lines, header, ";" if ";" in text else ",")

    def when(cells: Cells) -> datetime:
        """Return the time that the cells of a row state, on the file's clock."""
        start, _, end = cells[0].partition("/")
        return _stated(start) + (_stated(end) - _stated(start)) / 2

    return WeatherTable(_rows(path, body, when, names), typical=False, place=place)


def _stated(text: str, *, utc: bool = True) -> datetime:
    """Return a time that a cell states, in UTC.

    utc: take a time without a zone as UTC. Raises _CellError for another text, and for a time
    without a zone unless `utc`.
    """
    expected = "a UTC time such as 2027-03-20T15:30:00Z"
    try:
        t = strict_csv.read_time(text, utc=utc)
    except (ValueError, OverflowError) as error:
        raise _CellError(str(error), expected) from None
    if t.tzinfo is None:
        raise _CellError(f"time {text!r} has no zone", expected)
    return t.astimezone(UTC)


def _read_solcast(path: Path, lines: list[str], site: Site) -> WeatherTable:
    """Return the rows of a csv of Solcast: hours by their end (or start), with a zone."""
    names, body = _below(path, lines, strict_csv.numbered(lines)[0][0] - 1)
    letters = [re.sub("[^a-z]", "", name.lower()) for name in names]
    if "period" not in letters:
        raise InputError(path, "no column period", "period_end and period", _AGAIN)
    is_end = "periodend" in letters
    at, span = letters.index("periodend" if is_end else "periodstart"), letters.index("period")

    def when(cells: Cells) -> datetime:
        """Return the time that the cells of a row state, on the file's clock."""
        if cells[span] not in ("PT60M", "PT1H"):
            raise _CellError(f"period '{cells[span]}'", "hours (PT60M)")
        return _stated(cells[at], utc=False)

    rows = _rows(path, body, when, names)
    return WeatherTable(rows, typical=False, shift=-_HALF if is_end else _HALF)


def _dni_from_horizontal(rows: Sequence[WeatherRow], place: Site) -> list[WeatherRow]:
    """Return the rows with DNI and GHI, from rows with the beam on a horizontal plane as `dni`.

    DNI is zero with the sun below 2 deg, and at most 1.1 times that of a clear sky with the sun
    below 10 deg, as in pvlib.irradiance.dni: near the horizon a small error of time has a large
    effect.
    """
    times = [row.when for row in rows]
    altitude = sun.position(times, place).altitude_deg
    beam, dhi = np.array([(row.dni, row.dhi) for row in rows]).reshape(-1, 2).T
    clear = sun.clearsky(times, place).dni_wm2
    limit = np.where(altitude < 10.0, 1.1 * clear, strict_csv.IRRADIANCE_LIMITS_WM2[1])
    dni = np.minimum(sun.dni_by_closure(beam, 0.0, altitude), limit)
    ghi = np.where(altitude > 2.0, beam + dhi, np.nan)
    return [
        row._replace(dni=float(a), ghi=float(b)) for row, a, b in zip(rows, dni, ghi, strict=True)
    ]


def _read_csv(path: Path, lines: list[str], site: Site) -> WeatherTable:
    """Return the rows of fieldlum's own csv, whose times are the middles of hours.

    Its columns are t_utc or month, day and hour (local standard time); dni_wm2, dhi_wm2, and
    optionally ghi_wm2. Without t_utc it is a typical year.
    """
    place, clock = _place_comment(path, lines, site)
    table = strict_csv.numbered(lines)
    names = strict_csv.split_header(path, table[0]) if table else []
    strict_csv.check_names(path, names)
    dated = "t_utc" in names
    headings = enumerate(strict_csv.split_heading(name) for name in names)
    light = [(name.lower(), k) for k, (name, unit) in headings if strict_csv.is_wm2(unit)]
    strict_csv.check_names(path, [name for name, _ in light])
    quantities = dict(light)
    stamp = ("t_utc",) if dated else ("month", "day", "hour")
    missing = [name for name in stamp if name not in names]
    missing += [f"{name}_wm2" for name in ("dni", "dhi") if name not in quantities]
    if missing:
        expected = "columns t_utc (or month, day, hour), dni_wm2, dhi_wm2"
        remedy = "name the columns in the first row"
        raise InputError(path, f"no column {', '.join(missing)}", expected, remedy)
    body = strict_csv.split_rows(path, table[1:], len(names))
    at = [names.index(name) for name in stamp]
    # Hour 24 of 28 February belongs to 29 February only in a file with that day.
    leap = not dated and any((c[at[0]].lstrip("0"), c[at[1]]) == ("2", "29") for _, c in body)

    def when(cells: Cells) -> datetime:
        """Return the time that the cells of a row state, on the file's clock."""
        if not dated:
            month, day, hour = (cells[k] for k in at)
            return _moment(("2024" if leap else "2023", month, day), hour)
        return _stated(cells[at[0]])

    rows = _rows(path, body, when, names, quantities)
    return WeatherTable(rows, typical=not dated, place=place, clock=timedelta() if dated else clock)


def _place_comment(path: Path, lines: list[str], site: Site) -> tuple[Site | None, timedelta]:
    """Return the place and zone of a line ``# place: NAME, LATITUDE, LONGITUDE, UTC-8``.

    Without such a line the place is None, and the zone that of the site's standard time.
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


# A pattern by which a format is recognised, and its reader (CONTRIBUTING.md). The pattern is
# matched with the file's suffix in small letters and its first two lines.
FORMATS: tuple[tuple[str, Callable[[Path, list[str], Site], WeatherTable]], ...] = (
    (r"\.tm2\n", _read_tmy2),
    (r"\.epw\n|.*\n(?i:LOCATION),", _read_epw),
    (r".*\nplace .*\nlatitude ", _read_wea),
    (r".*\nLatitude \(decimal degrees\)", _read_pvgis),
    (r".*\n[\[{]", _read_json),
    (r".*\n(location_id,)?latitude,longitude,.*utc_offset_seconds", _read_open_meteo),
    (r".*\n\d[^,;/]+/\d[^,;/]+[;,]", _read_cams),
    (r".*\n(?i:(.*,)?period_?(end|start)(,|\n))", _read_solcast),
    (r".*\n(Source,|(?i:(?!.*dni)(.*,)?lat(itude)?,))", _read_sam),
    (r".*\n.*\n(.*ObservationTime\(LST\)|Date \(MM/DD/YYYY\))", _read_tmy3),
    ("", _read_csv),  # the last one: its errors explain the columns
)
_BELOW_COMMENTS = (_read_csv, _read_cams)  # their header can be below lines of "#"
