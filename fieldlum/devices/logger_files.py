"""Read irradiance from files of data loggers: Campbell TOA5, plain csv, fieldlum's day files."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

from fieldlum.devices.ascii_lines import sample_of
from fieldlum.devices.toa5 import is_toa5, number_of, parse_toa5
from fieldlum.errors import InputError, input_errors
from fieldlum.records import IrradianceSample
from fieldlum.session import DAY_COLUMNS, read_day

QUANTITIES = ("ghi_wm2", "dhi_wm2", "dni_wm2", "temperature_c")
_TIMES = ("t_utc", "time", "timestamp")


@dataclass(frozen=True, slots=True)
class LoggerFile:
    """The content of a logger's file.

    samples : in order of time when `read_logger_file` returns them; left_out : texts about lines
    that were not read and about missing records; about : a description of the kind of file.
    """

    samples: tuple[IrradianceSample, ...]
    left_out: tuple[str, ...]
    about: str


def read_logger_file(
    path: Path, utc_offset: timedelta | None = None, columns: Mapping[str, str] | None = None
) -> LoggerFile:
    """Read the irradiance in a data logger's file: TOA5, csv, or a day file of fieldlum.

    utc_offset : the logger's clock minus UTC, needed if the times have no zone; columns : names of
    the columns of some quantities (ghi_wm2 ...); the others are found by their usual names: in csv
    the quantity itself, in TOA5 also names like SlrW. Raises InputError for a file that cannot be
    read or is of another kind, for a column that does not exist, is ambiguous or has another unit,
    for times without a zone and without utc_offset, and for a file without a readable row.
    """
    with input_errors(path, "a logger's file", "check the path", OSError):
        data = path.read_bytes()
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise InputError(path, "UTF-16 text", "UTF-8", "save it again as CSV UTF-8")
    text = data.decode("utf-8-sig", "replace")
    if is_toa5(text):
        if utc_offset is None:
            raise _no_zone(path)
        table = parse_toa5(text, utc_offset, columns, source=path)
        left_out = table.broken
        if table.missing_records:
            left_out += (f"{table.missing_records} record numbers are missing",)
        about = f"TOA5 of {table.station}, {table.model} {table.serial}".strip()
        logger_file = LoggerFile(table.samples, left_out, about)
    elif text.startswith(",".join(DAY_COLUMNS)):
        samples, broken = read_day(path)
        logger_file = LoggerFile(
            tuple(samples), (f"{broken} broken rows",) if broken else (), "a day file of fieldlum"
        )
    else:
        logger_file = _read_csv(path, text, utc_offset, columns)
    if not logger_file.samples:
        why = logger_file.left_out[0] if logger_file.left_out else "it has no rows"
        raise InputError(
            path,
            f"no row could be read: {why}",
            "rows of irradiance",
            "open the file and compare a row with docs/capture.md",
        )
    return replace(logger_file, samples=tuple(sorted(logger_file.samples, key=lambda s: s.t_utc)))


def _no_zone(path: Path) -> InputError:
    return InputError(
        path,
        "times without a time zone",
        "the logger's offset from UTC",
        "state it with --utc-offset +HH:MM",
    )


def _read_csv(
    path: Path, text: str, utc_offset: timedelta | None, columns: Mapping[str, str] | None
) -> LoggerFile:
    """Read rows below a header that has a time (t_utc, time or timestamp) and an irradiance."""
    rows = csv.reader(text.splitlines())
    try:
        names = [name.strip() for name in next(rows)]
    except (StopIteration, csv.Error):
        raise InputError(
            path,
            "an empty file",
            "a header with t_utc and one or more of ghi_wm2, dhi_wm2, dni_wm2",
            "copy the file from the logger again",
        ) from None
    if len(names) == 1 and (mark := next((mark for mark in ";\t|" if mark in names[0]), "")):
        raise InputError(
            path,
            f"columns separated by {mark!r}",
            "commas",
            "save it as CSV with commas between and points in the numbers",
        )
    lower = [name.lower() for name in names]
    when = next((lower.index(name) for name in _TIMES if name in lower), None)
    if lost := [name for name in (columns or {}).values() if name.lower() not in lower]:
        raise InputError(
            path,
            f"no column {', '.join(lost)}",
            f"one of {', '.join(names)[:120]}",
            "correct the name after --column",
        )
    named = dict(columns or {})
    wanted = {name: name for name in QUANTITIES if name not in named.values()} | named
    chosen = {q: lower.index(name.lower()) for q, name in wanted.items() if name.lower() in lower}
    if when is None or not {"ghi_wm2", "dhi_wm2", "dni_wm2"} & set(chosen):
        shown = ", ".join(names)[:120]
        raise InputError(
            path,
            f"columns {shown}",
            "t_utc, and one or more of ghi_wm2, dhi_wm2 and dni_wm2",
            "write these names into the first line, or name a column: --column ghi_wm2=NAME",
        )
    samples, left_out = [], []
    try:
        for row in rows:
            try:
                if row:
                    samples.append(_sample(path, row, names, when, chosen, utc_offset))
            except ValueError as error:
                left_out.append(f"line {rows.line_num}: {error}")
    except csv.Error as error:
        left_out.append(f"line {rows.line_num} and all after it: {error}")
    return LoggerFile(tuple(samples), tuple(left_out), "CSV")


def _sample(
    path: Path,
    row: list[str],
    names: list[str],
    when: int,
    chosen: dict[str, int],
    utc_offset: timedelta | None,
) -> IrradianceSample:
    """Return the sample of a row. Raises ValueError for a broken row."""
    if len(row) != len(names):
        raise ValueError(f"{len(row)} values, expected {len(names)}")
    try:
        t = datetime.fromisoformat(row[when].strip())
    except ValueError:
        raise ValueError(
            f"time {row[when][:30]!r}, expected one like 2027-03-20T16:00:00Z"
        ) from None
    if t.tzinfo is None:
        if utc_offset is None:
            raise _no_zone(path)
        t = t.replace(tzinfo=UTC) - utc_offset
    values = {
        q: number_of(row[i].strip(), q) if row[i].strip() else None for q, i in chosen.items()
    }
    return sample_of(t.astimezone(UTC), values, ",".join(row[i] for i in sorted(chosen.values())))
