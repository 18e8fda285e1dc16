"""Define when the room is used: by EN 17037's default, or by a small csv."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, time, timedelta
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np

from fieldlum.core.arrays import Mask
from fieldlum.core.errors import InputError, NotEnoughDataError, input_errors
from fieldlum.core.records import Site
from fieldlum.core.strict_csv import read_table
from fieldlum.sky.sun import hour_of_year, position, standard_date, standard_midnight

DAYS = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")
_DAY = re.compile(r"(mon|tues?|wed(nes)?|thu(rs?)?|fri|sat(ur)?|sun)(day)?")
_HOUR = timedelta(hours=1)
EXPECTED = (
    "columns days,start,end (mon-fri,08:00,18:00), or a column occupied with 8760 rows of 0 or 1, "
    "for the hours of local standard time from 1 January 00:00"
)


@dataclass(frozen=True, slots=True)
class Occupancy:
    """When the room is used; `text` describes it for the reader.

    periods: weekday (0 is Monday), start (included) and end (excluded) in local clock time of each;
    without periods the room is never used. hourly, if set, replaces them: a mask [8760], True if
    used, from 1 January 00:00 in local standard time, without 29 February.
    """

    text: str
    periods: tuple[tuple[int, time, time], ...] = ()
    hourly: Mask | None = None

    def at(self, times_utc: Sequence[datetime], timezone: str) -> Mask:
        """Return a mask [n]: True for the times at which the room is used.

        times_utc: aware times; timezone: IANA name of the room's time zone.
        """
        if self.hourly is not None:
            rows = [hour_of_year(t, timezone) for t in times_utc]
            return self.hourly[np.array(rows, int)] if rows else np.zeros(0, bool)
        local = [t.astimezone(ZoneInfo(timezone)) for t in times_utc]
        used = [
            any(day == t.weekday() and start <= t.time() < end for day, start, end in self.periods)
            for t in local
        ]
        return np.array(used, bool)


def default_occupancy() -> Occupancy:
    """Return 08:00 to 18:00 local clock time on every day, as EN 17037's annex is usually read."""
    periods = tuple((day, time(8), time(18)) for day in range(7))
    return Occupancy("08:00 to 18:00 every day", periods)


def read_occupancy(path: Path | None) -> Occupancy:
    """Read a csv of when the room is used; None gives `default_occupancy`.

    Its columns are days, start and end, with a row for each period (mon-fri,08:00,18:00). days:
    English weekdays, in short or in full, or ranges of them, separated by blanks ("mon-wed fri").
    start, end: local clock time; end is after start, and 24:00 ends the day. An hour of the year is
    occupied if its middle (hh:30) is in a period; a period has at least one. Or the file has a
    column `occupied` with 8760 rows of 0 or 1, for the hours of local standard time from 1 January
    00:00, without 29 February.

    Raises InputError for a file that cannot be read, or for other content.
    """
    if path is None:
        return default_occupancy()
    table = read_table(path, EXPECTED, "write a line of column names and its rows")
    if "occupied" in table.names:
        return _hourly(path, table.rows, table.names.index("occupied"))
    if table.names != ("days", "start", "end"):
        found = f"columns {', '.join(table.names)}"
        raise InputError(path, found, EXPECTED, "correct the first line")
    periods: list[tuple[int, time, time]] = []
    for number, (days, *times) in table.rows:
        expected = "days and times such as mon-fri,08:00,18:00"
        with input_errors(path, expected, f"correct line {number}", ValueError):
            start, end = map(_time, times)
            if not start < end:
                raise ValueError(f"{times[0]} is not before {times[1]}")
            if not any(start <= time(hour, 30) < end for hour in range(24)):
                raise ValueError(f"{times[0]} to {times[1]} without the middle (hh:30) of an hour")
            periods += [(day, start, end) for day in _days(days)]
    if not periods:
        raise InputError(path, "no period in the file", EXPECTED, "write one row for each period")
    text = "; ".join(" ".join(row) for _, row in table.rows)
    if any(moment.minute for _, *ends in periods for moment in ends if moment != time.max):
        text += " (in hours whose middle, hh:30, is in it)"
    return Occupancy(text, tuple(periods))


def _time(cell: str) -> time:
    """Return a time of day such as 08:00 or 8:00; 24:00 is the end of the day."""
    if not (parts := re.fullmatch(r"(\d?\d)(:\d\d(?::\d\d)?)", cell)):
        raise ValueError(f"the time '{cell}'")
    return time.max if cell == "24:00" else time.fromisoformat(parts[1].zfill(2) + parts[2])


def _days(text: str) -> Iterator[int]:
    """Yield the weekdays (0 is Monday) of a text such as "mon-fri sun".

    Raises ValueError for a text that names no weekdays.
    """
    for part in re.sub(r"\s*[-\u2013]\s*", "-", text.lower()).split():
        first, dash, last = part.partition("-")
        ends = [name for name in (first, last if dash else first) if _DAY.fullmatch(name)]
        if len(ends) < 2:
            raise ValueError(f"unknown days '{text}'")
        first_day, last_day = (DAYS.index(name[:3]) for name in ends)
        yield from ((first_day + k) % 7 for k in range((last_day - first_day) % 7 + 1))


def _hourly(path: Path, rows: Sequence[tuple[int, tuple[str, ...]]], column: int) -> Occupancy:
    """Return the occupancy of a csv that has 0 or 1 for each of 8760 hours.

    rows: line number and cells of each; column: index of the cell with 0 or 1. Raises InputError
    for other cells, or another number of rows.
    """
    if len(rows) != 8760:
        raise InputError(path, f"{len(rows)} rows", EXPECTED, "write a row for each hour")
    for number, row in rows:
        if row[column] not in ("0", "1"):
            found = f"line {number}: occupied is '{row[column]}'"
            raise InputError(path, found, "0 or 1", "correct the value")
    hours = np.array([row[column] == "1" for _, row in rows])
    return Occupancy(f"{int(hours.sum())} hours from {path.name}", hourly=hours)


def occupied_hours(
    occupancy: Occupancy, times_utc: Sequence[datetime], site: Site
) -> tuple[int, int]:
    """Return the number of occupied hours on the days of a weather file, and the number of days.

    times_utc: middles of the hours with weather, aware; at least one. Only the hours of
    `known_hours` count. Raises NotEnoughDataError if no hour counts.
    """
    middles, known = known_hours(times_utc, site)
    used = occupancy.at(middles, site.timezone) & known.ravel()
    if not used.any():
        found = f"the weather file has no values for any occupied hour ({occupancy.text})"
        raise NotEnoughDataError(f"{found} on its {len(known)} days; correct --occupancy")
    return int(used.sum()), len(known)


def known_hours(times_utc: Sequence[datetime], site: Site) -> tuple[list[datetime], Mask]:
    """Return the middles of all hours on the n days of a weather file, and which of them are known.

    times_utc: middles of the hours with weather, aware; at least one. Days are dates in local
    standard time at the site. The middles are n * 24 times, the mask is [n, 24]. An hour is known
    if it has weather, or if the sun is down. One with the sun up but without weather is not,
    because it would look like an hour without light and without glare.
    """
    days = sorted({standard_date(t, site.timezone) for t in times_utc})
    starts = [standard_midnight(day, site.timezone) for day in days]
    middles = [start + (k + 0.5) * _HOUR for start in starts for k in range(24)]
    with_weather = {(t - starts[0]) // _HOUR for t in times_utc}
    known = np.array([(t - starts[0]) // _HOUR in with_weather for t in middles])
    return middles, (known | (position(middles, site).altitude_deg <= 0.0)).reshape(-1, 24)
