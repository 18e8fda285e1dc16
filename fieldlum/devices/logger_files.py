"""Read irradiance from files of data loggers: TOA5, csv, netCDF, fieldlum's day files.

TOA5: four header lines (environment, names, units, processing) come before the rows. A row has a
quoted time WITHOUT a time zone, a record number and numbers; "NAN" is a missing number. The user
must state the logger's UTC offset. Source: help.campbellsci.com, TOA5.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path

from fieldlum.core.errors import InputError, input_errors
from fieldlum.core.records import IrradianceSample
from fieldlum.core.strict_csv import (
    COMMAS,
    Line,
    check_names,
    decimal_commas,
    is_wm2,
    lines_of,
    microvolts,
    numbered,
    read_text,
    read_time,
    split_header,
    split_heading,
    split_row,
    stated_unit,
)
from fieldlum.devices.ascii_lines import sample_of
from fieldlum.devices.learned_format import ENOUGH, constant
from fieldlum.devices.registers import MAX_WM2, MIN_WM2
from fieldlum.session import DAY_COLUMNS, read_day

_NETCDF = b"CDF"  # first bytes of a classic netCDF file (its format's specification)
QUANTITIES = ("ghi_wm2", "dhi_wm2", "dni_wm2", "temperature_c")
_UTC_TIMES = ("t_utc", "time_utc", "timestamp_utc", "datetime_utc", "utc", "time(utc)")
_TIMES = (*_UTC_TIMES, "timestamp", "datetime", "time", "date time", "date/time")
_SLASHED = re.compile(r"(\d{1,2})/(\d{1,2})/(\d{4})[ T]+(\d{1,2})(:.+)")
_COMMA = re.compile(r" is '[+-]?\d+,\d+'")
# A pyranometer's full voltage is 5 to 20 mV; the sky of a day gives more W/m2. Chosen.
_VOLTAGE_BELOW = 30.0
_COMPARED_ROWS = 50  # rows before a damaged one whose decimal points are counted; chosen
_TIME = re.compile(r"\d{4}-\d{2}-\d{2} \d{2}:\d{2}:\d{2}(?:\.\d{1,6})?")
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?")
_MILLIVOLT = 1e3  # microvolts; loggers store the voltage of a pyranometer in mV
# Usual column names in loggers' programs and in ARM's netCDF files, without "avg"; digits,
# underscores and case are ignored in the comparison.
_USUAL = {
    "ghi_wm2": (
        *("ghi", "global", "slrw", "solarwm", "total", "solarradiation", "globalhorizontal"),
        "downshorthemisp",
    ),
    "dhi_wm2": ("dhi", "diffuse", "dif", "diff", "diffusehorizontal", "downshortdiffusehemisp"),
    "dni_wm2": ("dni", "direct", "directnormal", "shortdirectnormal"),
    "temperature_c": ("ptempc", "airtc", "bodytemp"),
}


@dataclass(frozen=True, slots=True)
class LoggerFile:
    """The content of a logger's file.

    samples : in order of time when `read_logger_file` returns them; left_out : texts about lines
    that were not read and about missing records; about : a description of the kind of file; notes :
    which columns were read, and how; missing_records : how many record numbers are missing between
    the lines that could be read; jumps of a million or more are not counted.
    """

    samples: tuple[IrradianceSample, ...]
    left_out: tuple[str, ...]
    about: str
    notes: tuple[str, ...] = ()
    missing_records: int = 0


def read_logger_file(
    path: Path,
    utc_offset: timedelta | None = None,
    columns: Mapping[str, str] | None = None,
    sensitivities: Mapping[str, float] | None = None,
) -> LoggerFile:
    """Read the irradiance in a data logger's file: TOA5, csv, classic netCDF, or a day file.

    utc_offset : the logger's clock minus UTC, needed if the times have no zone; it never moves
    times that are stated in UTC. columns : names of the columns of some quantities (ghi_wm2 ...),
    or their numbers in a csv without names; the others are found by their usual names: the quantity
    itself, or names like SlrW and GHI where the file states their unit. sensitivities : of
    pyranometers whose column is a voltage, uV per W/m2.

    A damaged row is left out and named. Raises InputError for a file that cannot be read or is of
    another kind, with decimal commas or more damaged than readable rows, for a column that does not
    exist, is ambiguous or has another unit, for times without a zone and without utc_offset, and
    for dates whose day and month cannot be distinguished.
    """
    start = b""
    with suppress(OSError), path.open("rb") as file:
        start = file.read(len(_NETCDF))
    text = "" if start == _NETCDF else read_text(path, "a logger's file in csv or TOA5")
    if start == _NETCDF:
        logger_file = _read_netcdf(path, columns, sensitivities)
    elif is_toa5(text):
        if utc_offset is None:
            raise _no_zone(path)
        logger_file = parse_toa5(
            text, utc_offset, columns, source=path, sensitivities=sensitivities
        )
    elif text.startswith(",".join(DAY_COLUMNS)):
        samples, broken = read_day(path)
        lost = (f"{broken} broken rows",) if broken else ()
        logger_file = LoggerFile(tuple(samples), lost, "a day file of fieldlum")
    else:
        logger_file = _read_csv(path, text, utc_offset, columns, sensitivities)
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
    if logger_file.missing_records:
        lost += (f"{logger_file.missing_records} record numbers are missing",)
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
    when = [lower.index(name) for name in _TIMES if name in lower][:1]
    if when and lower[when[0]] == "time" and "date" in lower:
        when.insert(0, lower.index("date"))
    at = _columns(names, columns, path, {q: (q,) for q in QUANTITIES}, str.lower)
    usual = {q: () if q in at else _USUAL[q] for q in QUANTITIES}
    at = _columns(names, columns, path, usual, _stated_name) | at
    if not when or not any(quantity.endswith("_wm2") for quantity in at):
        raise InputError(
            path,
            f"columns {', '.join(names)[:120]}",
            "t_utc, and one or more of ghi_wm2, dhi_wm2 and dni_wm2",
            "write these names into the first line, or name a column: --column ghi_wm2=NAME",
        )
    units = [stated_unit(name) for name in names]
    chosen = scaled(path, names, units, at, sensitivities, blank=True)
    clock = names[when[-1]]
    at_utc = clock.lower() in _UTC_TIMES
    order = _date_order(path, lines, when)

    def time_of(row: list[str]) -> datetime:
        text = " ".join(row[k] for k in when)
        if part := _SLASHED.fullmatch(text):
            date = "-".join(part[k].zfill(2) for k in order)
            text = f"{date}T{part[4].zfill(2)}{part[5]}"
        t = read_time(text, utc=at_utc)
        if t.tzinfo is None:
            if utc_offset is None:
                raise _no_zone(path)
            t = t.replace(tzinfo=UTC) - utc_offset
        return t.astimezone(UTC)

    samples, _, left_out = _read_rows(lines, names, chosen, time_of)
    notes = chosen.notes
    if at_utc and utc_offset is not None:
        notes += (f"times of {clock} are UTC: no offset moves them",)
    return LoggerFile(tuple(samples), tuple(left_out), "CSV", notes)


def _stated_name(heading: str) -> str:
    """Return the letters of a heading without its unit W/m2; "" for a heading without it."""
    name, unit = split_heading(heading)
    return _letters(name) if is_wm2(unit) and heading.lower() not in QUANTITIES else ""


def _letters(name: str) -> str:
    return re.sub(r"[^a-z]", "", name.lower()).removesuffix("avg")


def _date_order(path: Path, lines: list[Line], when: list[int]) -> tuple[int, int, int]:
    """Return the places of year, month and day in dates such as 13/12/2015, from 1.

    when : columns of the time. Raises InputError if no date shows whether day or month is first,
    and if dates differ in it.
    """
    dates = []
    for _, line in lines:
        with suppress(ValueError, IndexError):
            row = split_row(line)
            if part := _SLASHED.fullmatch(" ".join(row[k] for k in when)):
                dates.append((int(part[1]), int(part[2]), part[0].split()[0]))
    day_first, month_first = any(a > 12 for a, _, _ in dates), any(b > 12 for _, b, _ in dates)
    if dates and day_first == month_first:
        why = (
            "some with the day first and some with the month first"
            if day_first
            else "whose day and month cannot be distinguished, because no number is above 12"
        )
        raise InputError(
            path,
            f"dates such as {dates[0][2]}, {why}",
            "dates such as 2015-12-01",
            "write the year first, or import the file together with a later day",
        )
    return (3, 2, 1) if day_first else (3, 1, 2)


def _read_netcdf(
    path: Path, columns: Mapping[str, str] | None, sensitivities: Mapping[str, float] | None
) -> LoggerFile:
    """Read the variables along the time of a classic netCDF file, such as those of ARM, in UTC."""
    import xarray as xr

    expected = "a netCDF file with a variable of times and irradiance along it"
    with input_errors(path, expected, "export it as csv", ValueError, KeyError, TypeError):
        with xr.open_dataset(path, engine="scipy") as opened:
            frame = opened.load()
        times = frame["time"].to_numpy().astype("M8[us]").tolist()
    along = {str(name): v for name, v in frame.items() if v.dims == ("time",)}
    names = ["time", *along]
    units = ["", *(str(values.attrs.get("units", "")) for values in along.values())]
    at = _usual_columns(names, columns, path)
    chosen = scaled(path, names, units, at, sensitivities)
    rows = zip(times, *(values.to_numpy().tolist() for values in along.values()), strict=True)
    lines = ((number, ",".join(map(str, row))) for number, row in enumerate(rows, start=1))
    samples, _, left_out = _read_rows(
        lines, names, chosen, lambda row: datetime.fromisoformat(row[0]).replace(tzinfo=UTC)
    )
    unused = "quality flags of the file are not used, because fieldlum checks the values itself"
    return LoggerFile(tuple(samples), tuple(left_out), "netCDF", (*chosen.notes, unused))


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


def _read_rows(
    lines: Iterable[Line],
    names: list[str],
    chosen: LoggerColumns,
    time_of: Callable[[list[str]], datetime],
    *,
    padded: bool = True,
) -> tuple[list[IrradianceSample], list[tuple[int, list[str]]], list[str]]:
    """Return the samples, the number and the cells of their lines, and a text on each other line.

    time_of : returns the UTC time of a row; padded : remove spaces around cells.
    """
    samples: list[IrradianceSample] = []
    read: list[tuple[int, list[str]]] = []
    broken: list[str] = []
    for number, line in lines:
        try:
            row = split_row(line, padded=padded)
            check_count(row, names, [cells for _, cells in read[-_COMPARED_ROWS:]])
            samples.append(sample_of(time_of(row), chosen.values(row), chosen.raw(row)))
            read.append((number, row))
        except (ValueError, OverflowError) as error:
            broken.append(f"line {number}: {error}")
    return samples, read, broken


def is_toa5(text: str) -> bool:
    """Return whether a text begins with the word TOA5, quoted or not, and a comma."""
    return text.startswith(('"TOA5",', "TOA5,"))


def parse_toa5(
    text: str,
    utc_offset: timedelta,
    columns: Mapping[str, str] | None = None,
    *,
    source: str | Path = "TOA5",
    sensitivities: Mapping[str, float] | None = None,
) -> LoggerFile:
    """Read a TOA5 table.

    columns : names of the columns of some quantities (ghi_wm2 ...); the others are found by their
    usual names, such as SlrW_Avg; utc_offset : the logger's clock minus UTC; source : for errors;
    sensitivities : of pyranometers whose column is a voltage, uV per W/m2.

    A row is omitted and listed if it is incomplete, if its time or a number cannot be read, if an
    irradiance is outside -200 to 4000 W/m2, if its time does not fit its record number, or if its
    decimals differ from the rest of the column. Raises InputError for a text that is no complete
    TOA5 table, for a named column that does not exist, without a column of irradiance, with several
    columns for a quantity or of one name, or with an irradiance in another unit than W/m2.
    """
    lines = text.split("\n")
    if not is_toa5(text) or len(lines) < 4 or _TIME.fullmatch(lines[3].split(",")[0].strip('"')):
        raise InputError(
            source,
            "no complete TOA5 header in the first four lines",
            "four header lines of a Campbell Scientific TOA5 table",
            "copy the file from the logger again",
        )
    try:
        about, names, units = (split_row(line.rstrip("\r"), padded=False) for line in lines[:3])
    except ValueError:
        raise InputError(
            source, "a broken TOA5 header", "four header lines", "copy the file again"
        ) from None
    if "TIMESTAMP" not in names or len(units) != len(names):
        raise InputError(
            source,
            f"columns {', '.join(names)[:80]}",
            "a column TIMESTAMP, and a unit for each column",
            "export the table again",
        )
    check_names(Path(source), names)
    at = _usual_columns(names, columns, source)
    chosen = scaled(source, names, units, at, sensitivities)

    def time_of(row: list[str]) -> datetime:
        stamp = row[names.index("TIMESTAMP")]
        if not _TIME.fullmatch(stamp):
            raise ValueError(f"{stamp[:30]!r} is not a time")
        return datetime.fromisoformat(stamp).replace(tzinfo=UTC) - utc_offset

    body = [(n, line.rstrip("\r")) for n, line in enumerate(lines[4:], start=5) if line.strip()]
    cut = body.pop()[0] if body and body[-1][0] == len(lines) else 0
    samples, read, broken = _read_rows(body, names, chosen, time_of, padded=False)
    if cut:
        broken.append(f"line {cut}: the line does not end with a line feed")
    record = names.index("RECORD") if "RECORD" in names else None
    numbers = [
        (line, i, int(row[record]))
        for i, (line, row) in enumerate(read)
        if record is not None and row[record].isdecimal()
    ]
    strays = _out_of_step(numbers, [sample.t_utc for sample in samples])
    broken += [
        f"line {line}: its time and record number disagree with both neighbours'"
        for line, _ in strays
    ]
    differing = _differing_decimals([row for _, row in read], at)
    broken += [f"line {read[i][0]}: {why}" for i, why in differing.items()]
    left_out = {i for _, i in strays} | set(differing)
    samples = [sample for i, sample in enumerate(samples) if i not in left_out]
    missing = sum(b - a - 1 for (*_, a), (*_, b) in pairwise(numbers) if 1 < b - a < 1_000_000)
    station, model, serial = (*about[1:4], "", "", "")[:3]
    kind = f"TOA5 of {station}, {model} {serial}".strip()
    return LoggerFile(tuple(samples), tuple(broken), kind, chosen.notes, missing)


def _differing_decimals(rows: list[list[str]], chosen: dict[str, int]) -> dict[int, str]:
    """Return the reason for each row with other decimals than the rest of its column.

    All numbers of a column but one in sixty must have the same decimals. Only numbers with equally
    many digits before the point are compared, because Campbell's FP2 writes 99.99, 999.9 and 1023.
    If numbers of several sizes have the same decimals, all are compared. A logger that drops
    trailing zeros has no usual decimals.
    """
    differing: dict[int, str] = {}
    for quantity, i in chosen.items():
        parts = {
            k: row[i].lstrip("+-").partition(".")
            for k, row in enumerate(rows)
            if _NUMBER.fullmatch(row[i])
        }
        sizes: dict[int, list[int]] = {}
        for integer, _, decimals in parts.values():
            sizes.setdefault(len(integer), []).append(len(decimals))
        usual = {size: constant(counts) for size, counts in sizes.items() if len(counts) >= ENOUGH}
        everywhere = (
            next(iter(usual.values())) if len(usual) > 1 and len(set(usual.values())) == 1 else None
        )
        for k, (integer, _, decimals) in parts.items():
            due = usual.get(len(integer), everywhere)
            if due not in (None, len(decimals)):
                differing[k] = f"{quantity} has {len(decimals)} decimals, but usually {due}"
    return differing


def _out_of_step(rows: list[tuple[int, int, int]], times: list[datetime]) -> list[tuple[int, int]]:
    """Return (line, sample) of the rows whose time does not fit their record number.

    Records have a fixed interval. For a damaged row, time minus interval times number differs from
    both neighbours, which agree with each other. After a logger's clock was set, all later rows
    change together: they are not listed.
    """
    if len(rows) < 4:
        return []
    t0 = times[rows[0][1]]
    t = [(times[i] - t0).total_seconds() for _, i, _ in rows]
    steps = sorted(
        (b - a) / (n - m)
        for (_, _, m), (_, _, n), a, b in zip(rows, rows[1:], t, t[1:], strict=False)
        if n > m
    )
    every = steps[len(steps) // 2] if steps else 0.0
    due = [at - every * number for at, (_, _, number) in zip(t, rows, strict=True)]
    near = 0.5 * every
    return [
        (rows[k][0], rows[k][1])
        for k in range(1, len(rows) - 1)
        if abs(due[k + 1] - due[k - 1])
        <= near
        < min(abs(due[k] - due[k - 1]), abs(due[k] - due[k + 1]))
    ]


def _usual_columns(
    names: list[str], asked: Mapping[str, str] | None, source: str | Path
) -> dict[str, int]:
    """Return the column index of each quantity by `_USUAL`. Raises InputError without any."""
    at = _columns(names, asked, source, _USUAL, _letters)
    if not any(q.endswith("_wm2") for q in at):
        raise InputError(
            source,
            f"no known column of irradiance among {', '.join(names)[:120]}",
            "a column of irradiance",
            "choose it: --column ghi_wm2=NAME",
        )
    return at


def _columns(
    names: list[str],
    asked: Mapping[str, str] | None,
    source: str | Path,
    usual: Mapping[str, tuple[str, ...]],
    key: Callable[[str], str],
) -> dict[str, int]:
    """Return the column index of each quantity: as asked, ignoring case, else by its usual names.

    usual : names of a column by quantity, as `key` returns them. Raises InputError for a missing or
    ambiguous column.
    """
    columns: dict[str, int] = {}
    lower = [name.lower() for name in names]
    if lost := [name for name in (asked or {}).values() if name.lower() not in lower]:
        raise InputError(
            source,
            f"no column {', '.join(lost)}",
            f"one of {', '.join(names)[:120]}",
            "correct the name after --column",
        )
    asked = {quantity: name.lower() for quantity, name in (asked or {}).items()}
    for quantity in QUANTITIES:
        if quantity in asked:
            matches = [i for i, name in enumerate(lower) if name == asked[quantity]]
        else:
            free = ((i, name) for i, name in enumerate(names) if lower[i] not in asked.values())
            matches = [i for i, name in free if key(name) in usual[quantity]]
        if len(matches) > 1:
            several = ", ".join(names[i] for i in matches)
            raise InputError(
                source,
                f"several columns for {quantity}: {several}",
                "one column",
                f"choose it: --column {quantity}=NAME",
            )
        if matches:
            columns[quantity] = matches[0]
    return columns


@dataclass(frozen=True, slots=True)
class LoggerColumns:
    """The columns of a file by quantity, and what turns their numbers into W/m2.

    at : index of the column; factor : W/m2 in a unit of the column; notes : sentences on columns;
    blank : whether an empty cell is a missing value instead of an error.
    """

    at: dict[str, int]
    factor: dict[str, float]
    notes: tuple[str, ...]
    blank: bool

    def values(self, row: list[str]) -> dict[str, float | None]:
        """Return the values of a row; None for a missing one.

        Raises ValueError for text that is no number, and for irradiance outside the limits.
        """
        return {
            q: None if self.blank and not row[i] else number_of(row[i], q, self.factor.get(q, 1.0))
            for q, i in self.at.items()
        }

    def raw(self, row: list[str]) -> str:
        """Return the texts of a row's columns."""
        return ",".join(row[i] for i in sorted(self.at.values()))


def scaled(
    source: str | Path,
    names: list[str],
    units: list[str],
    at: dict[str, int],
    sensitivities: Mapping[str, float] | None,
    *,
    blank: bool = False,
) -> LoggerColumns:
    """Return the columns with their factors; list all columns in W/m2 as used or not used.

    sensitivities : of the pyranometers, uV per W/m2, for columns of voltage; blank : whether cells
    may be empty, and units unstated. Raises InputError for
    a column in another unit, a voltage without sensitivity and a sensitivity without a voltage.
    """
    factor: dict[str, float] = {}
    notes: list[str] = []
    stated = dict(sensitivities or {})
    if lost := [q for q in stated if q not in at]:
        raise InputError(
            source, f"no column for {lost[0]}", "a column", f"name it: --column {lost[0]}=NAME"
        )
    for quantity, i in at.items():
        if not quantity.endswith("_wm2"):
            continue
        unit, volts = units[i], microvolts(units[i])
        if quantity in stated and (volts or not unit):
            factor[quantity] = (volts or _MILLIVOLT) / stated[quantity]
            shown = unit or "mV (its unit is not stated)"
            notes.append(f"column {names[i]} read in {shown}, {stated[quantity]:g} uV per W/m2")
        elif quantity in stated or not (is_wm2(unit) or (blank and not unit)):
            raise InputError(
                source,
                f"the column {names[i]} is in '{unit}'",
                "mV, uV or V where a sensitivity is stated" if quantity in stated else "W/m^2",
                f"state the sensitivity of the pyranometer: --sensitivity {quantity}=UV_PER_WM2"
                if volts
                else f"choose another column (--column {quantity}=NAME), or convert its values and "
                "its unit in the file",
            )
    used = ", ".join(f"{names[i]} as {q}" for q, i in at.items())
    others = [n for k, n in enumerate(names) if is_wm2(units[k]) and k not in at.values()]
    unused = f"; not used: {', '.join(others)} (name one with --column)" if others else ""
    return LoggerColumns(at, factor, (f"columns: {used}{unused}", *notes), blank)


def check_count(row: list[str], names: list[str], right: list[list[str]]) -> None:
    """Raise ValueError for a row with another number of cells than names; right: other rows."""
    if len(row) != len(names):
        why = COMMAS if decimal_commas(row, len(names), right) else ""
        raise ValueError(f"{len(row)} values, expected {len(names)}{why}")


def number_of(text: str, quantity: str, factor: float = 1.0) -> float | None:
    """Return a logger's number times a factor; None for NAN and INF, with or without a minus.

    Raises ValueError for a text that is not a number, and for an irradiance (a `quantity` that ends
    in _wm2) outside -200 to 4000 W/m2.
    """
    if text.upper() in ("NAN", "-NAN", "INF", "-INF"):
        return None
    if not _NUMBER.fullmatch(text):
        raise ValueError(f"{quantity} is {text[:30]!r}, expected a number with a decimal point")
    value = float(text) * factor
    if quantity.endswith("_wm2") and not MIN_WM2 <= value <= MAX_WM2:
        raise ValueError(f"{quantity} is {value:.6g}, expected {MIN_WM2:g} to {MAX_WM2:g}")
    return value
