"""Reading weather files: one strict reader each, then the same checks and repairs for all."""

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

SYNTHETIC = "synthetic"  # in place of a file: a synthetic year
HIGHEST_WM2 = 1600.0
LOWEST_WM2 = -10.0  # night offset of a thermopile; anything lower is no offset
FILLED_GAP_HOURS = 3  # gaps up to this are interpolated, and said so; longer ones stay out
NEAR_KM, FAR_KM = 30.0, 300.0
LONGEST_GAP = timedelta(days=800)
_HOUR = timedelta(hours=1)


# ----------------------------------------------------------------------------------------------
# reading


@dataclass(frozen=True, slots=True)
class _WeatherRow:
    line: int
    when: datetime  # middle of the hour, UTC; year as the file has it
    dni: float  # NaN: missing
    dhi: float
    ghi: float


@dataclass(frozen=True, slots=True)
class _File:
    """What a reader finds: rows, whether they make a typical year, and where the file says that
    it was measured.
    """

    rows: list[_WeatherRow]
    typical: bool
    name: str
    place: Site | None = None
    notes: tuple[str, ...] = ()


def read_weather(path: Path, site: Site, *, label_shift_min: float = 0.0) -> Weather:
    """Read an EPW, TMY3, TMY2, PVGIS, NSRDB, SolarAnywhere or CSV file as hours at `site`.

    label_shift_min : minutes added to the times that the file states, for labels that are known to
    be wrong; listed in `.repairs`. The path ``synthetic`` gives a synthetic year of the site.

    Raises InputError naming the line for what cannot be read, for irradiance outside -10 to 1600
    W/m2, for a station over 300 km away, for light at night (a wrong time zone), and for what
    `sense` finds: wrong units, columns in each other's place, labels beside their hours. Smaller
    troubles are mended and listed in `.repairs`: night offsets, 29 February of a typical year, gaps
    up to three hours; longer gaps are left out and listed.
    """
    path = Path(path)
    if str(path) == SYNTHETIC:
        return synthetic_weather(site)
    try:
        found = _shifted(_read(path, _lines(path), site), label_shift_min)
    except (csv.Error, OverflowError) as error:
        raise InputError(
            path, str(error), "an EPW, TMY3 or CSV weather file", "fetch it again"
        ) from None
    if not found.rows:
        raise NotEnoughDataError(f"{path}: no hours in it")
    repairs = [*found.notes, *_check_place(path, found.place, site)]
    rows = _in_order(path, found, site, repairs)
    columns = _values(rows, repairs)
    check_hourly(path, [row.when for row in rows])
    weather = _fill_gaps(found, site, rows, columns, repairs)
    _check_night(path, weather)
    _check_sense(path, found, rows, columns, weather)
    return replace(weather, repairs=tuple(repairs))


def _shifted(file: _File, minutes: float) -> _File:
    """Return the rows with their times moved, and a note of it."""
    if not minutes:
        return file
    shift = timedelta(minutes=minutes)
    rows = [replace(row, when=row.when + shift) for row in file.rows]
    return replace(file, rows=rows, notes=(*file.notes, f"labels moved by {minutes:+g} min"))


def _of_provider(path: Path, year: ProviderYear) -> _File:
    """Rows of a file that pvlib read. Raises InputError for irradiance that is not possible."""
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
    """An EPW of PVGIS: values are of one moment, hours 1 to 24 plus the stated offset; the rows are
    in UTC in some versions, whatever the header's zone.
    """
    # `_read_epw` gives the middle of the hour that ends at the label
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


def shipped_seattle(site: Site | None = None) -> Weather:
    """The paper's own typical year (Liu, Colburn, Inanici 2020), which ships with the tool."""
    place = site or Site("Seattle", 47.6, -122.3, "America/Los_Angeles")
    return read_weather(shipped("capture_plans") / "seattle_dni_dhi.csv", place)


def _lines(path: Path) -> list[str]:
    try:
        text = path.read_text(encoding="utf-8-sig", errors="strict")
    except UnicodeDecodeError:
        text = path.read_text(encoding="latin-1")
    except OSError as error:
        raise InputError(path, error.strerror or str(error), "a readable weather file") from None
    lines = text.splitlines()
    if not lines or "\0" in text:
        raise InputError(path, "empty or binary", "an EPW, TMY3 or CSV weather file")
    return lines


def _number(path: Path, line: int, name: str, text: str) -> float:
    """NaN for a missing value: empty, nan, or the codes of EPW (9999) and TMY3 (-9900)."""
    text = text.strip()
    if text.lower() in ("", "nan", "na"):
        return math.nan
    try:
        value = float(text)
    except ValueError:
        raise InputError(
            path, f"line {line}: {name} is '{text}'", "a number in W/m2", "mend that row"
        ) from None
    if value in (9999.0, 99999.0, 999999.0, -9900.0, -9999.0):
        return math.nan
    if not LOWEST_WM2 <= value <= HIGHEST_WM2:
        expected = f"{LOWEST_WM2:g} to {HIGHEST_WM2:g} W/m2"
        raise InputError(
            path, f"line {line}: {name} is {text}", expected, "mend or empty that cell"
        )
    return value


def _read_epw(path: Path, lines: list[str]) -> _File:
    """EPW: eight header lines; hour 1 is 00:00 to 01:00, so its label is the hour's start and
    the sun stands at +30.
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
            path, f"LOCATION line '{lines[0][:60]}'", "LOCATION,city,,,,,lat,lon,zone,alt"
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
                "at least 16",
                "the file is cut: fetch it again",
            )
        start = _moment(
            path, number, cells[0], cells[1], cells[2], float(_whole(path, number, cells[3]) - 1)
        )
        ghi, dni, dhi = (
            _number(path, number, n, cells[k]) for k, n in ((13, "GHI"), (14, "DNI"), (15, "DHI"))
        )
        rows.append(_WeatherRow(number, start + timedelta(minutes=30) - offset, dni, dhi, ghi))
    file = _File(rows, True, f"{path.name} ({place.name})", place)
    stated = epw_time_offset(lines)
    return file if stated is None else _pvgis_epw(file, place, stated, offset)


def _read_tmy3(path: Path, lines: list[str]) -> _File:
    """TMY3: labels are hour ends, 01:00 to 24:00, so the sun stands at -30 min."""
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
            path, f"first line '{lines[0][:60]}'", "USAF,name,state,zone,lat,lon,alt"
        ) from None
    _check_zone(path, place, offset)
    names = next(csv.reader(lines[1:2]))
    wanted = ("GHI (W/m^2)", "DNI (W/m^2)", "DHI (W/m^2)")
    if missing := [name for name in wanted if name not in names]:
        raise InputError(
            path, f"no column {missing[0]}", "GHI, DNI and DHI in W/m^2", "is this a TMY3 file?"
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
                f"{len(names)}",
                "the file is cut: fetch it",
            )
        month, _, rest = cells[0].partition("/")
        day, _, year = rest.partition("/")
        hour = cells[1].partition(":")[0]
        end = _moment(path, number, year, month, day, float(_whole(path, number, hour)))
        ghi, dni, dhi = (
            _number(path, number, name, cells[k]) for name, k in zip(wanted, at, strict=True)
        )
        rows.append(_WeatherRow(number, end - timedelta(minutes=30) - offset, dni, dhi, ghi))
    return _File(rows, True, f"{path.name} ({place.name})", place)


def _read_csv(path: Path, lines: list[str], site: Site) -> _File:
    """Columns t_utc, dni_wm2, dhi_wm2 (hour centres), or month, day, hour (centre, standard
    time), dni_wm2, dhi_wm2.
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
            path, f"no column {', '.join(missing)}", expected, "name the columns in the first line"
        )
    rows = []
    for number, line in table[1:]:
        cells = dict(zip(names, next(csv.reader([line])), strict=False))
        if len(cells) < len(names):
            raise InputError(
                path, f"line {number}: {len(cells)} cells", f"{len(names)}", "mend that row"
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
                path, f"line {line}: hour is '{cells['hour']}'", "a number such as 12.5"
            ) from None
        return _moment(path, line, "2024", cells["month"], cells["day"], hour) - offset
    try:
        return parse_utc(cells["t_utc"].strip())
    except ValueError as error:
        raise InputError(
            path, f"line {line}: {error}", "a UTC time such as 2027-03-20T15:30:00Z"
        ) from None


def _place_comment(path: Path, lines: list[str], site: Site) -> tuple[Site | None, timedelta]:
    """An optional line ``# place: NAME, LATITUDE, LONGITUDE, UTC-8``; else the site's own
    standard time.
    """
    for line in lines[:20]:
        if line.startswith("# place:"):
            try:
                name, latitude, longitude, zone = (part.strip() for part in line[8:].split(","))
                place = Site(name, float(latitude), float(longitude))
                offset = timedelta(hours=float(zone.removeprefix("UTC") or 0))
            except ValueError:
                raise InputError(path, line, "# place: NAME, LATITUDE, LONGITUDE, UTC-8") from None
            _check_zone(path, place, offset)
            return place, offset
    return None, sun.standard_offset(site.timezone, TYPICAL_YEAR)


def _whole(path: Path, line: int, text: str) -> int:
    try:
        return int(float(text))
    except ValueError:
        raise InputError(
            path, f"line {line}: '{text}' in the time", "whole numbers", "mend that row"
        ) from None


def _moment(path: Path, line: int, year: str, month: str, day: str, hour: float) -> datetime:
    try:
        y, m, d = (_whole(path, line, text) for text in (year, month, day))
        start = datetime(y, m, d, tzinfo=UTC)
        if not 0 <= hour <= 24:
            raise ValueError(f"hour {hour:g}")
    except ValueError as error:
        found = f"line {line}: no such time {year}-{month}-{day} hour {hour:g} ({error})"
        raise InputError(
            path, found, "a real date and an hour of 0 to 24", "mend that row"
        ) from None
    return start + timedelta(seconds=round(hour * 3600))


# ----------------------------------------------------------------------------------------------
# checks and repairs


def distance_km(a: Site, b: Site) -> float:
    """Along the great circle."""
    from fieldlum.projection import direction

    u, v = (direction(s.latitude_deg, s.longitude_deg) for s in (a, b))
    return 6371.0 * math.acos(float(np.clip(u @ v, -1.0, 1.0)))


def _check_zone(path: Path, place: Site, offset: timedelta) -> None:
    hours = offset.total_seconds() / 3600
    if (
        abs(hours - place.longitude_deg / 15) > 3.5
    ):  # western China and the Line Islands are the extremes
        found = f"time zone UTC{hours:+g} at longitude {place.longitude_deg:g}"
        raise InputError(
            path,
            found,
            f"about UTC{place.longitude_deg / 15:+.0f}",
            "mend the header (east is positive)",
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
            "take a nearer file, or mend the site's coordinates",
        )
    return (
        [f"the weather station {place.name} is {away:.0f} km from the site"]
        if away > NEAR_KM
        else []
    )


def _in_order(path: Path, found: _File, site: Site, repairs: list[str]) -> list[_WeatherRow]:
    """Typical years put into TYPICAL_YEAR of local standard time, 29 February out; sorted; no
    hour twice.
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
            found_text = f"lines {a.line} and {b.line}: the same hour twice"
            raise InputError(path, found_text, "every hour once", "take one of them out")
        if b.when - a.when > LONGEST_GAP:
            found_text = (
                f"lines {a.line} and {b.line}: {a.when:%Y-%m-%d} is followed by {b.when:%Y-%m-%d}"
            )
            raise InputError(path, found_text, "years without holes of years", "mend the dates")
    return rows


def _values(rows: list[_WeatherRow], repairs: list[str]) -> NDArray[np.float64]:
    """dni, dhi, ghi, [3, n]; small negative readings set to zero and said so."""
    values = np.array([(row.dni, row.dhi, row.ghi) for row in rows]).T
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
    """Hours without values: interpolated where few, left out where many; both are said."""
    times = [row.when for row in rows]
    good = np.atleast_1d(~np.isnan(columns[:2]).any(axis=0))
    if not good.any():
        raise NotEnoughDataError(f"{found.name}: no hour has both DNI and DHI")
    known = [t for t, ok in zip(times, good, strict=True) if ok]
    values = columns[:, good]
    filled, left_out = _missing_hours(known, found.typical)
    everything = sorted([*known, *filled])
    at, have = (np.array([t.timestamp() for t in ts]) for ts in (everything, known))
    dni, dhi = (np.interp(at, have, values[k]) for k in (0, 1))
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
    """Hours to interpolate and hours to leave out."""
    fill: list[datetime] = []
    out: list[datetime] = []
    for gap in _gaps(known, typical):
        (
            fill if 0 < len(gap) <= FILLED_GAP_HOURS and known[0] < gap[0] < known[-1] else out
        ).extend(gap)
    return fill, out


def _gaps(known: list[datetime], typical: bool) -> Iterator[list[datetime]]:
    if typical:  # a year begins and ends at local midnight: 8760 hours in all
        lacking = 8760 - (round((known[-1] - known[0]) / _HOUR) + 1)
        yield [known[-1] + _HOUR * (k + 1) for k in range(max(lacking, 0))]
    for a, b in pairwise(known):
        yield [a + _HOUR * (k + 1) for k in range(round((b - a) / _HOUR) - 1)]


def _some(times: list[datetime]) -> str:
    shown = ", ".join(f"{t:%m-%d %H:%M}" for t in times[:3])
    return f"{shown} ... {times[-1]:%m-%d %H:%M} UTC" if len(times) > 3 else f"{shown} UTC"


def _check_night(path: Path, weather: Weather) -> None:
    """A wrong time zone or hemisphere shows as light from a sun far below the horizon."""
    altitude = sun.position(weather.t_utc, weather.site).altitude_deg
    light = weather.dni_wm2 + weather.dhi_wm2
    total = float(light.sum())
    at_night = float(
        light[altitude < -8.0].sum()
    )  # an hour's mean can hold light half an hour before sunrise
    if total > 0 and at_night > 0.01 * total:
        found = (
            f"{100 * at_night / total:.0f} % of the light falls while the sun is down at "
            f"{weather.site.name}"
        )
        remedy = (
            "check the time zone, the sign of the longitude, and whether labels are hour centres"
        )
        raise InputError(path, found, "none", remedy)


def _check_sense(
    path: Path,
    found: _File,
    rows: list[_WeatherRow],
    columns: NDArray[np.float64],
    weather: Weather,
) -> None:
    """With the global irradiance only where the file itself gave it: elsewhere it was made from
    the other two.
    """
    given = {row.when: value for row, value in zip(rows, columns[2], strict=True)}
    ghi = np.array([given.get(t, math.nan) for t in weather.t_utc])
    check_sense(path, weather, found.place or weather.site, ghi)
