"""Read irradiance from files of data loggers: Campbell TOA5, plain csv, fieldlum's day files."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import UTC, timedelta
from pathlib import Path

from fieldlum.core.errors import InputError
from fieldlum.core.records import IrradianceSample
from fieldlum.core.strict_csv import (
    COMMAS,
    Line,
    check_names,
    lines_of,
    numbered,
    read_text,
    read_time,
    split_header,
    split_row,
    stated_unit,
)
from fieldlum.devices.ascii_lines import sample_of
from fieldlum.devices.toa5 import LoggerColumns, check_count, is_toa5, parse_toa5, scaled
from fieldlum.session import DAY_COLUMNS, read_day

QUANTITIES = ("ghi_wm2", "dhi_wm2", "dni_wm2", "temperature_c")
_UTC_TIMES = ("t_utc", "time_utc", "timestamp_utc", "datetime_utc", "utc", "time(utc)")
_TIMES = (*_UTC_TIMES, "time", "timestamp", "datetime")
_COMMA = re.compile(r" is '[+-]?\d+,\d+'")
# A pyranometer's full voltage is 5 to 20 mV; the sky of a day gives more W/m2. Chosen.
_VOLTAGE_BELOW = 30.0
_COMPARED_ROWS = 50  # rows before a damaged one whose decimal points are counted; chosen


@dataclass(frozen=True, slots=True)
class LoggerFile:
    """The content of a logger's file.

    samples : in order of time when `read_logger_file` returns them; left_out : texts about lines
    that were not read and about missing records; about : a description of the kind of file; notes :
    which columns were read, and how.
    """

    samples: tuple[IrradianceSample, ...]
    left_out: tuple[str, ...]
    about: str
    notes: tuple[str, ...] = ()


def read_logger_file(
    path: Path,
    utc_offset: timedelta | None = None,
    columns: Mapping[str, str] | None = None,
    sensitivities: Mapping[str, float] | None = None,
) -> LoggerFile:
    """Read the irradiance in a data logger's file: TOA5, csv, or a day file of fieldlum.

    utc_offset : the logger's clock minus UTC, needed if the times have no zone; it never moves
    times that are stated in UTC. columns : names of the columns of some quantities (ghi_wm2 ...),
    or their numbers in a csv without names; the others are found by their usual names: in csv the
    quantity itself, in TOA5 also names like SlrW. sensitivities : of pyranometers whose column is a
    voltage, uV per W/m2.

    A damaged row is left out and named. Raises InputError for a file that cannot be read or is of
    another kind, with decimal commas or more damaged than readable rows, for a column that does not
    exist, is ambiguous or has another unit, and for times without a zone and without utc_offset.
    """
    text = read_text(path, "a logger's file in csv or TOA5")
    if is_toa5(text):
        if utc_offset is None:
            raise _no_zone(path)
        table = parse_toa5(text, utc_offset, columns, source=path, sensitivities=sensitivities)
        about = f"TOA5 of {table.station}, {table.model} {table.serial}".strip()
        logger_file = LoggerFile(table.samples, table.broken, about, table.notes)
        missing = table.missing_records
    elif text.startswith(",".join(DAY_COLUMNS)):
        samples, broken = read_day(path)
        lost = (f"{broken} broken rows",) if broken else ()
        logger_file, missing = LoggerFile(tuple(samples), lost, "a day file of fieldlum"), 0
    else:
        logger_file = _read_csv(path, text, utc_offset, columns, sensitivities)
        missing = 0
    count, lost = len(logger_file.samples), logger_file.left_out
    commas = [text for text in lost if COMMAS in text or _COMMA.search(text)]
    if len(commas) > 1:
        raise InputError(
            path,
            f"{len(commas)} of {count + len(lost)} rows have decimal commas: {commas[0]}",
            "numbers with a decimal point",
            "save it as CSV with commas between and points in the numbers",
        )
    if len(lost) > count or not count:
        why = f"{len(lost)} rows cannot be read, {count} can: {lost[0]}" if lost else "no rows"
        raise InputError(
            path,
            why if count else f"no row could be read: {lost[0] if lost else 'it has no rows'}",
            "rows of irradiance",
            "open the file and compare a row with docs/capture.md",
        )
    notes = logger_file.notes
    largest = max(s.ghi_wm2 or s.dni_wm2 or s.dhi_wm2 or 0.0 for s in logger_file.samples)
    if largest < _VOLTAGE_BELOW and not sensitivities:
        notes += (f"largest irradiance {largest:.3g} W/m2: a voltage needs --sensitivity",)
    if missing:
        lost += (f"{missing} record numbers are missing",)
    ordered = tuple(sorted(logger_file.samples, key=lambda s: s.t_utc))
    return replace(logger_file, samples=ordered, left_out=lost, notes=notes)


def _no_zone(path: Path) -> InputError:
    return InputError(
        path,
        "times without a time zone",
        "the logger's offset from UTC",
        "state it with --utc-offset +HH:MM",
    )


def _read_csv(
    path: Path,
    text: str,
    utc_offset: timedelta | None,
    columns: Mapping[str, str] | None,
    sensitivities: Mapping[str, float] | None,
) -> LoggerFile:
    """Read rows below a header that has a time (t_utc, time or timestamp) and an irradiance."""
    names, lines = _named(path, numbered(lines_of(text)))
    lower = [name.lower() for name in names]
    when = next((lower.index(name) for name in _TIMES if name in lower), None)
    at = _columns(path, names, columns)
    if when is None or not any(quantity.endswith("_wm2") for quantity in at):
        raise InputError(
            path,
            f"columns {', '.join(names)[:120]}",
            "t_utc, and one or more of ghi_wm2, dhi_wm2 and dni_wm2",
            "write these names into the first line, or name a column: --column ghi_wm2=NAME",
        )
    units = [stated_unit(name) for name in names]
    chosen = scaled(path, names, units, at, sensitivities, blank=True)
    samples: list[IrradianceSample] = []
    left_out: list[str] = []
    right: list[list[str]] = []  # rows that were read, for comparison
    for number, line in lines:
        try:
            row = split_row(line)
            check_count(row, names, right[-_COMPARED_ROWS:])
            samples.append(_sample(path, row, names[when], row[when], chosen, utc_offset))
            right.append(row)
        except (ValueError, OverflowError) as error:
            left_out.append(f"line {number}: {error}")
    notes = chosen.notes
    if lower[when] in _UTC_TIMES and utc_offset is not None:
        notes += (f"times of {names[when]} are UTC: no offset moves them",)
    return LoggerFile(tuple(samples), tuple(left_out), "CSV", notes)


def _named(path: Path, lines: list[Line]) -> tuple[list[str], list[Line]]:
    """Return the column names and the other lines; without names, columns have their numbers."""
    if not lines:
        raise InputError(
            path,
            "an empty file",
            "a header with t_utc and one or more of ghi_wm2, dhi_wm2, dni_wm2",
            "copy the file from the logger again",
        )
    names = split_header(path, lines[0])
    try:
        read_time(names[0])
    except ValueError:
        check_names(path, [name.lower() for name in names])
        return names, lines[1:]
    return ["time", *(str(k) for k in range(2, len(names) + 1))], lines


def _columns(path: Path, names: list[str], columns: Mapping[str, str] | None) -> dict[str, int]:
    """Return the column of each quantity: those that are named, and others by their own name."""
    lower = [name.lower() for name in names]
    named = dict(columns or {})
    if lost := [name for name in named.values() if name.lower() not in lower]:
        raise InputError(
            path,
            f"no column {', '.join(lost)}",
            f"one of {', '.join(names)[:120]}",
            "correct the name after --column",
        )
    wanted = {name: name for name in QUANTITIES if name not in named.values()} | named
    return {q: lower.index(name.lower()) for q, name in wanted.items() if name.lower() in lower}


def _sample(
    path: Path,
    row: list[str],
    clock: str,
    time: str,
    chosen: LoggerColumns,
    utc_offset: timedelta | None,
) -> IrradianceSample:
    """Return the sample of a row; clock: name of its column of times. Raises ValueError."""
    t = read_time(time, utc=clock.lower() in _UTC_TIMES)
    if t.tzinfo is None:
        if utc_offset is None:
            raise _no_zone(path)
        t = t.replace(tzinfo=UTC) - utc_offset
    return sample_of(t.astimezone(UTC), chosen.values(row), chosen.raw(row))
