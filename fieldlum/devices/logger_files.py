"""Read irradiance from files of data loggers: TOA5, csv, netCDF, fieldlum's day files.

TOA5: four header lines (environment, names, units, processing) come before the rows. A row has a
quoted time WITHOUT a time zone, a record number and numbers; "NAN" is a missing number. The user
must state the logger's UTC offset. Source: help.campbellsci.com, TOA5.
"""

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.core import strict_csv
from fieldlum.core.arrays import Mask
from fieldlum.core.errors import InputError, input_errors
from fieldlum.core.files import open_to_read
from fieldlum.core.records import IrradianceSample, counted, require_known_year
from fieldlum.devices.ascii_lines import sample_of
from fieldlum.devices.modbus import MAX_WM2, MIN_WM2
from fieldlum.session import DAY_COLUMNS, read_day

# of a netCDF file; in single precision those of days and of hours can be seconds. Chosen.
_MAX_TIME_STEP_S = 1.0
_MAX_ROWS = 5_000_000  # two months of seconds, in 3 GB of memory
_NETCDF = b"CDF"  # first bytes of a classic netCDF file (its format's specification)
QUANTITIES = ("ghi_wm2", "dhi_wm2", "dni_wm2", "temperature_c")
# Letters of the names of columns of times, of dates and of times of day, without a zone.
_TIMES = {
    "stamp": "timestamp tmstamp datetime datetimestamp referencetimestamp messdatum datumzeit "
    "dateheure horodatage 日時",
    "date": "date datum dato fecha data 日期 日付",
    "hour": "time zeit uhrzeit heure hora ora tijd tid czas 时间 時刻 lst est cst mst pst",
}
_NAME_ZONE = re.compile(r"[,_(\[]*(?:utc|gmt)([+-]\d\d?(?::?\d\d)?)?[)\]]?$")
_ZONE = re.compile(r"((utc|gmt)_?)?offset|tz|(time_?)?zone")
_DAY_OR_MONTH_FIRST = re.compile(r"(\d{1,2})([/.-])(\d{1,2})\2(\d{4}|\d\d)[ T]+(.+)")
_ROUNDED_DAY = re.compile(r"\d{5}([.,]\d{1,4})?")  # of a spreadsheet; 0.0001 is 9 s
_MARKS = ",;\t|"
_PANGAEA = "/* DATA DESCRIPTION:"  # PANGAEA writes all times in UTC
_COMMA = re.compile(r" is '[+-]?[\d.]+,[\d,.]+'")
_BAD = re.compile("(?<!no_)(?<!not_)(bad|invalid|fail|error|missing)")  # words of flag_meanings
# Usual column names in loggers' programs and in ARM's netCDF files, without "avg"; digits,
# underscores and case are ignored in the comparison.
_USUAL = {
    "ghi_wm2": "ghi global slrw solarwm total solarradiation globalhorizontal downshorthemisp swd",
    "dhi_wm2": "dhi diffuse dif diff diffusehorizontal downshortdiffusehemisp",
    "dni_wm2": "dni direct directnormal shortdirectnormal dir",
    "temperature_c": "ptempc airtc bodytemp",
}


@dataclass(frozen=True, slots=True)
class LoggerFile:
    """The content of a logger's file.

    samples : in order of time when `read_logger_file` returns them; left_out : texts about lines
    that were not read; notes : which columns were read, and how.
    """

    samples: tuple[IrradianceSample, ...]
    left_out: tuple[str, ...]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class _Table:
    """The text of a table: names and units of its columns, lines below them.

    is_logger : whether a logger's program wrote it, which states the unit of each column and puts
    no spaces around cells; cut : a text on an incomplete last line; called_bad : how many values of
    a column the file itself calls bad; mark : between cells; in_utc : whether all times are in UTC.
    """

    names: list[str]
    units: list[str]
    lines: Sequence[strict_csv.Line]
    is_logger: bool = False
    cut: tuple[str, ...] = ()
    called_bad: Mapping[str, int] = field(default_factory=dict)
    mark: str = ","
    in_utc: bool = False

    def usual(self) -> list[str]:
        """Return the letters of each name, "" for a column of a csv that is not in W/m2."""
        if self.is_logger:
            return [_letters(name) for name in self.names]
        names = (strict_csv.split_heading(name)[0] for name in self.names)
        columns = zip(names, self.units, strict=True)
        return [_letters(name) if strict_csv.is_wm2(unit) else "" for name, unit in columns]


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
    with suppress(OSError), open_to_read(path) as file:
        start = file.read(len(_NETCDF))
    request = (utc_offset, columns or {}, sensitivities or {})
    if start == _NETCDF:
        logger_file = _read(path, _netcdf(path), *request)
    else:
        text = strict_csv.read_text(path, "a logger's file in csv or TOA5")
        if text.startswith(",".join(DAY_COLUMNS)):
            samples, damaged = read_day(path)
            logger_file = LoggerFile(tuple(samples), (f"{damaged} broken rows",) if damaged else ())
        else:
            logger_file = parse_table(path, text, *request)
    _check_readable(path, logger_file)
    notes = logger_file.notes
    largest = max(s.ghi_wm2 or s.dni_wm2 or s.dhi_wm2 or 0.0 for s in logger_file.samples)
    # a pyranometer's full voltage is 5 to 20 mV; the sky of a day gives more W/m2
    if largest < 30.0 and not sensitivities:
        notes += (f"largest irradiance {largest:.3g} W/m2: a voltage needs --sensitivity",)
    ordered = tuple(sorted(logger_file.samples, key=lambda s: s.t_utc))
    return replace(logger_file, samples=ordered, notes=notes)


def _check_readable(path: Path, logger_file: LoggerFile) -> None:
    """Raise InputError for decimal commas, and for fewer readable than damaged rows.

    logger_file: what was read, with a text on each row that was not.
    """
    count, left_out = len(logger_file.samples), logger_file.left_out
    marks = (strict_csv.COMMAS, strict_csv.THOUSANDS, strict_csv.POINTS)
    commas = [t for t in left_out if t.endswith(marks) or _COMMA.search(t)]
    if len(commas) > 1:
        has_thousands = commas[0].endswith(marks[1:])
        kind = "thousands separators" if has_thousands else "decimal commas"
        found = f"{len(commas)} of {count + len(left_out)} rows have {kind}: {commas[0]}"
        remedy = "save it as CSV with commas between and points in the numbers"
        raise InputError(path, found, "numbers with a decimal point", remedy)
    if len(left_out) > count or not count:
        first = left_out[0] if left_out else "it has no rows"
        found = f"{len(left_out)} rows cannot be read, {count} can: {first}"
        found = found if count else f"no row could be read: {first}"
        remedy = "write all times in that form" if "time '" in first else "export the file again"
        raise InputError(path, found, "rows of irradiance", f"{remedy} (docs/devices.md)")


def parse_table(
    path: Path,
    text: str,
    utc_offset: timedelta | None,
    columns: Mapping[str, str],
    sensitivities: Mapping[str, float],
) -> LoggerFile:
    """Return the rows of a TOA5 or csv table, also if they are few.

    text: content of the file; path: for errors; utc_offset: None if the times state a zone.
    columns, sensitivities and errors: as for `read_logger_file`.
    """
    table = _toa5(path, text) if text.startswith(('"TOA5",', "TOA5,")) else _csv(path, text)
    return _read(path, table, utc_offset, columns, sensitivities)


# ----------------------------------------------------------------------------------------------
# formats


def _toa5(path: Path, text: str) -> _Table:
    """Return a TOA5 table; its last line is damaged if it does not end with a line feed.

    Raises InputError for a header of other than four lines, or without a unit for each column.
    """
    lines = text.replace("\r\n", "\n").split("\n")
    heads: list[list[str]] = []
    with suppress(ValueError):
        heads = [strict_csv.split_row(line, padded=False) for line in lines[:4]]
    if len(heads) < 4 or heads[3][0][:1].isdigit():  # the fourth line is a row of data
        found = "no complete TOA5 header in the first four lines"
        expected = "four header lines of a Campbell Scientific TOA5 table"
        raise InputError(path, found, expected, "copy the file from the logger again")
    _, names, units, _ = heads
    if "TIMESTAMP" not in names or len(units) != len(names):
        expected = "a column TIMESTAMP, and a unit for each column"
        found = f"columns {', '.join(names)[:80]}"
        raise InputError(path, found, expected, "export the table again")
    cut: tuple[str, ...] = ()
    if lines.pop():
        cut = (f"line {len(lines) + 1}: the line does not end with a line feed",)
    body = [(n, line) for n, line in enumerate(lines[4:], start=5) if line.strip()]
    return _Table(names, units, body, is_logger=True, cut=cut)


def _csv(path: Path, text: str) -> _Table:
    """Return a csv table; a column without a name is called by its number, the first one time.

    A second line of units counts before units in the names.
    """
    text = re.sub(r"(?m)^#(?=[,;\t])", '"#"', text)  # a column of numbers, and no comment
    lines = strict_csv.numbered(strict_csv.lines_of(text))
    if not lines:
        expected = "a header with t_utc and one or more of ghi_wm2, dhi_wm2, dni_wm2"
        raise InputError(path, "an empty file", expected, "copy the file from the logger again")
    above, mark = _header(lines)
    lines = lines[above:]
    names = strict_csv.split_header(path, lines[0], mark)
    with suppress(ValueError):
        strict_csv.read_time(names[0])
        numbers = ["time", *(str(k) for k in range(2, len(names) + 1))]
        return _Table(numbers, [""] * len(names), lines, mark=mark)
    units = [strict_csv.stated_unit(name) for name in names]
    below = [cell.strip(' "') for _, line in lines[1:2] for cell in line.split(mark)]
    are_units = any("/" in cell or strict_csv.is_unit(cell) for cell in below)
    if are_units and len(below) == len(names) and not re.search(r"\d\d", lines[1][1]):
        units = [cell or unit for cell, unit in zip(below, units, strict=True)]
        del lines[1]
    return _Table(names, units, lines[1:], mark=mark, in_utc=text.startswith(_PANGAEA))


def _header(lines: Sequence[strict_csv.Line]) -> tuple[int, str]:
    """Return how many lines are above the column names, such as a title, and the separator.

    The names are the first line with one of a time, below lines with other numbers of cells; the
    first line if there is none.
    """
    for above, (_, line) in enumerate(lines[:200]):
        mark = _mark_of(line)
        with suppress(ValueError):
            names = strict_csv.split_row(line, mark)
            has_time = {"stamp", "hour"} & set(map(_kind_of_time, names))
            if len(names) > 1 and has_time:
                counts = {line.count(mark) for _, line in lines[:above]}
                return (0, ",") if line.count(mark) in counts else (above, mark)
    return 0, _mark_of(lines[0][1])


def _mark_of(line: str) -> str:
    return max(_MARKS, key=re.sub('"[^"]*"', "", line).count)


def _kind_of_time(name: str) -> str:
    """Return which times a column has by its name: a key of `_TIMES`, or "" for none."""
    plain = name.lower().replace(" ", "")
    word = re.sub(r"[(\[][^()]*[)\]]$|\W|_", "", _NAME_ZONE.sub("", plain))
    if word in ("", "t") and _NAME_ZONE.search(plain):
        return "stamp"
    return next((kind for kind, words in _TIMES.items() if word in words.split()), "")


def _netcdf(path: Path) -> _Table:
    """Return the variables along the time of a classic netCDF file, such as those of ARM.

    Values that the file itself calls bad are missing. Raises InputError for times that have too few
    digits for steps of a second.
    """
    import pandas as pd
    import xarray as xr

    expected = "a netCDF file with a variable of times and irradiance along it"
    with input_errors(path, expected, "export it as csv", Exception):  # scipy raises any
        with xr.open_dataset(path, engine="scipy", decode_cf=False) as opened:
            stored = opened.load()
        since = [str(k) for k in stored.coords if " since " in str(stored[k].attrs.get("units"))]
        if len(since) != 1:
            raise ValueError("not one variable of times in units such as 'days since 2019-07-05'")
        of_time = stored[since[0]]
        calendar = str(of_time.attrs.get("calendar", "standard"))
        if calendar not in ("standard", "gregorian", "proleptic_gregorian"):
            raise ValueError(f"times of the calendar {calendar}")
        stored = stored.squeeze([d for d, n in stored.sizes.items() if n == 1 and d != since[0]])
        frame = xr.decode_cf(stored)
        unit = pd.Timedelta(1, str(of_time.attrs["units"]).split()[0])
        numbers = of_time.to_numpy()
        if numbers.size > _MAX_ROWS:
            raise ValueError(f"{numbers.size:,} times, more than {_MAX_ROWS:,}")
        step_s = float(np.spacing(np.abs(numbers).max())) * unit.total_seconds()
        if step_s > _MAX_TIME_STEP_S:
            digits = f"{8 * numbers.dtype.itemsize} bits, enough for steps of {step_s:.2g} s"
            raise ValueError(f"times with {digits}")
        times = frame[since[0]].to_numpy().astype("M8[us]").tolist()
        along = {str(name): v for name, v in frame.items() if v.dims == (since[0],)}
        bad = {name: _called_bad(stored, name) for name in along}
    units = ["", *(str(values.attrs.get("units", "")) for values in along.values())]
    columns = (values.where(~bad[name]).to_numpy().tolist() for name, values in along.items())
    rows = enumerate(zip(times, *columns, strict=True), start=1)
    lines = [(number, ",".join(map(str, row))) for number, row in rows]
    counts = {name: int(mask.sum()) for name, mask in bad.items()}
    return _Table(["t_utc", *along], units, lines, True, called_bad=counts)


def _called_bad(stored: Any, name: str) -> Mask:
    """Return which values of a variable along the time the netCDF file itself calls bad, [times].

    stored: the open dataset. Those outside valid_range or valid_min and valid_max (CF conventions
    1.11, 2.5.1), and those with a flag of a bad meaning (CF 3.5) or assessment (ARM's standard for
    data). An instrument's offset at night, down to -10 W/m2, is not bad because it is below 0.
    """
    data = stored[name]
    about: Mapping[str, Any] = data.attrs
    if data.dtype.kind not in "iuf":
        return np.zeros(data.shape, bool)
    scale, offset = about.get("scale_factor", 1.0), about.get("add_offset", 0.0)

    def in_unit(limit: Any) -> float:
        """Return a limit: integers are in the unit of the stored numbers; NaN for a text."""
        if limit.dtype.kind in "iu":
            return float(limit * scale + offset)
        return float(limit) if limit.dtype.kind == "f" else math.nan

    span = np.ravel(about.get("valid_range", (-math.inf, math.inf)))
    least, most = about.get("valid_min", span[0]), about.get("valid_max", span[-1])
    low, high = in_unit(np.ravel(least)[0]), in_unit(np.ravel(most)[0])
    values = data.to_numpy() * scale + offset
    bad = (values > high) | (values < min(low, strict_csv.IRRADIANCE_LIMITS_WM2[0]))
    for flag in (f"qc_{name}", *str(about.get("ancillary_variables", "")).split()):
        if flag in stored and stored[flag].dims == data.dims and stored[flag].dtype.kind in "iu":
            bits = stored[flag].to_numpy().astype(np.int64)
            for mask, value in _bad_flags(stored.attrs, stored[flag].attrs):
                bad |= (bits & mask) == value
    return bad


def _bad_flags(of_file: Mapping[str, Any], of_flag: Mapping[str, Any]) -> Iterator[tuple[int, int]]:
    """Yield mask and value of the flags that mean bad data, by the attributes of file and flag."""
    for k in range(31):
        assessed, described = (
            str(of_flag.get(f"bit_{k + 1}_{key}", of_file.get(f"qc_bit_{k + 1}_{key}", "")))
            for key in ("assessment", "description")
        )
        if assessed == "Bad" and "valid_min" not in described:
            yield 1 << k, 1 << k
    masks = np.ravel(of_flag.get("flag_masks", -1)).tolist()
    values = np.ravel(of_flag.get("flag_values", masks)).tolist()
    words = str(of_flag.get("flag_meanings", "")).lower().split()
    for k, (value, meaning) in enumerate(zip(values, words, strict=False)):
        if _BAD.search(meaning):
            yield masks[k % len(masks)], value


def _letters(name: str) -> str:
    return re.sub(r"[^a-z]", "", name.lower()).removesuffix("avg")


# ----------------------------------------------------------------------------------------------
# rows


def _read(
    path: Path,
    table: _Table,
    utc_offset: timedelta | None,
    asked: Mapping[str, str],
    sensitivities: Mapping[str, float],
) -> LoggerFile:
    """Return the samples of a table, and a text on each line that was not read.

    utc_offset: the clock minus UTC, None if it is not stated; asked: column name by quantity;
    sensitivities: of a voltage, by quantity, uV per W/m2. Raises InputError for a file whose
    columns, times or units are unclear.
    """
    names = table.names
    if len(table.lines) > _MAX_ROWS:
        expected = f"at most {_MAX_ROWS:,} rows"
        raise InputError(path, f"{len(table.lines):,} rows", expected, "split the file by months")
    strict_csv.check_names(path, [name.lower() for name in names])
    at = _columns(path, table, asked)
    factor, notes = _factors(path, table, at, sensitivities)
    clock = _Clock(path, table, utc_offset)
    has_commas = _has_decimal_commas(table, at.values())
    samples: list[IrradianceSample] = []
    right: list[list[str]] = []
    damaged: list[str] = []
    others: list[tuple[int, int]] = []  # lines with another number of values
    for number, line in table.lines:
        try:
            row = strict_csv.split_row(line, table.mark, padded=not table.is_logger)
            if len(row) != len(names):
                is_plain = table.mark == ","
                why = strict_csv.surplus_cause(row, len(names), right[-50:]) if is_plain else ""
                others += [] if why else [(number, len(row))]
                raise ValueError(f"{len(row)} values, expected {len(names)}{why}")
            values = {q: _number(row[i], q, factor.get(q, 1.0), has_commas) for q, i in at.items()}
            raw = ",".join(row[i] for i in sorted(at.values()))
            samples.append(sample_of(clock.utc(row), values, raw))
            right.append(row)
        except (ValueError, OverflowError) as error:
            cells = [cell.strip(' "') for cell in line.split(table.mark)]
            if any(map(_kind_of_time, cells)) and cells != [name.strip(' "') for name in names]:
                below = counted(sum(n > number for n, _ in table.lines), "row")
                raise _two_tables(path, f"line {number}: other column names, for {below}") from None
            damaged.append(f"line {number}: {error}")
    for (first, count), last in zip(others, others[2:], strict=False):
        if last == (first + 2, count) and (first + 1, count) in others and count > 1:
            rows = sum(n >= first and other == count for n, other in others)
            found = (
                f"line {first}: {count} values, expected {len(names)}, as in {rows} rows from it"
            )
            raise _two_tables(path, found)
    texts = [clock.text(row) for row in right]
    if texts and all(map(_ROUNDED_DAY.fullmatch, texts)):
        is_date = not any(set(",.") & set(text) for text in texts)
        if is_date or any(s.t_utc.timestamp() % 300.0 for s in samples):
            why = (
                "is a date without a time of day" if is_date else "has too few decimals for a time"
            )
            raise InputError(path, f"'{texts[0]}' {why}", "times", "export them as dates and times")
    for name in (names[i] for i in at.values() if table.called_bad.get(names[i])):
        count = f"missing by the file itself: {counted(table.called_bad[name], 'value')} of {name}"
        notes.append(f"{count}, out of the valid range or flagged as bad")
    if clock.unread_zone:
        notes.append(f"column {clock.unread_zone} is not used: --utc-offset counts")
    if clock.read_zone and utc_offset is not None:
        notes.append(f"the offsets in column {clock.read_zone} count, not --utc-offset")
    if clock.is_utc and utc_offset is not None:
        notes.append(f"times of {clock.name} are UTC: no offset moves them")
    return LoggerFile(tuple(samples), (*damaged, *table.cut), tuple(notes))


def _two_tables(path: Path, found: str) -> InputError:
    return InputError(path, found, "one table", "split the file there")


def _has_decimal_commas(table: _Table, columns: Iterable[int]) -> bool:
    """Return whether more numbers have a decimal comma than a point; never with commas between."""
    points = 0
    for _, line in table.lines if table.mark != "," else ():
        with suppress(ValueError, IndexError):
            row = strict_csv.split_row(line, table.mark)
            points += sum(("." in row[k]) - ("," in row[k]) for k in columns)
    return points < 0


def _columns(path: Path, table: _Table, asked: Mapping[str, str]) -> dict[str, int]:
    """Return the column index of each quantity: as asked, by its own, or by a usual name.

    asked: column name by quantity. Raises InputError for a column that is missing or ambiguous.
    """
    names, at = [name.lower() for name in table.names], dict[str, int]()
    all_names = ", ".join(table.names)[:120]
    if missing := [name for name in asked.values() if name.lower() not in names]:
        found, remedy = f"no column {', '.join(missing)}", "correct the name after --column"
        raise InputError(path, found, f"one of {all_names}", remedy)
    named = {name.lower() for name in asked.values()}
    free = [(i, text) for i, text in enumerate(table.usual()) if names[i] not in named]
    for quantity in QUANTITIES:
        name = asked.get(quantity, quantity).lower()
        matches = [names.index(name)] if name in names else []
        matches = matches or [i for i, letters in free if letters in _USUAL[quantity].split()]
        if len(matches) > 1:
            found = ", ".join(table.names[i] for i in matches)
            found = f"several columns for {quantity}: {found}"
            raise InputError(path, found, "one column", f"choose it: --column {quantity}=NAME")
        if matches:
            at[quantity] = matches[0]
    if not any(quantity.endswith("_wm2") for quantity in at):
        found = f"no known column of irradiance among the columns {all_names}"
        expected = "a column of irradiance, such as ghi_wm2, dhi_wm2 or dni_wm2"
        above = "remove the lines above the column names"
        is_above = len(names) == 1 and not table.is_logger
        remedy = above if is_above else "choose it: --column ghi_wm2=NAME"
        raise InputError(path, found, expected, remedy)
    return at


def _factors(
    path: Path, table: _Table, at: Mapping[str, int], sensitivities: Mapping[str, float]
) -> tuple[dict[str, float], list[str]]:
    """Return W/m2 in a unit of each column of voltage, and notes on the columns.

    at: the column index of each quantity; sensitivities: in uV per W/m2, by quantity. Raises
    InputError for a column in another unit, a voltage without sensitivity and a sensitivity
    without a voltage.
    """
    factor: dict[str, float] = {}
    notes: list[str] = []
    names, units = table.names, table.units
    if missing := [q for q in sensitivities if q not in at]:
        remedy = f"name it: --column {missing[0]}=NAME"
        raise InputError(path, f"no column for {missing[0]}", "a column", remedy)
    for quantity, i in at.items():
        unit, volts = units[i], strict_csv.microvolts(units[i])
        sensitivity = sensitivities.get(quantity)
        if sensitivity and (volts or not unit):
            factor[quantity] = (volts or 1e3) / sensitivity  # loggers store mV
            shown = unit or "mV (its unit is not stated)"
            notes.append(f"column {names[i]} read in {shown}, {sensitivity:g} uV per W/m2")
        elif quantity.endswith("_wm2") and (
            sensitivity or not (strict_csv.is_wm2(unit) or (not unit and not table.is_logger))
        ):
            expected = "mV, uV or V where a sensitivity is stated" if sensitivity else "W/m^2"
            remedy = f"choose another column: --column {quantity}=NAME"
            if volts:
                remedy = f"state the sensitivity of the pyranometer: --sensitivity {quantity}=UV"
            raise InputError(path, f"the column {names[i]} is in '{unit}'", expected, remedy)
    used = ", ".join(f"{names[i]} as {q}" for q, i in at.items())
    light = (k for k, unit in enumerate(units) if strict_csv.is_wm2(unit))
    others = [names[k] for k in light if k not in at.values()]
    unused = f"; not used: {', '.join(others)} (name one with --column)" if others else ""
    return factor, [f"columns: {used}{unused}", *notes]


def _number(text: str, quantity: str, factor: float, has_commas: bool) -> float | None:
    """Return a logger's number times a factor; None for a missing value.

    A number may be followed by W/m2. has_commas: decimals have a comma, and a point is an error.
    Raises ValueError for a text that is not a number, and for an irradiance (a `quantity` that ends
    in _wm2) outside -200 to 4000 W/m2.
    """
    if has_commas:
        if "." in text:
            raise ValueError(f"{quantity} is '{text}'{strict_csv.POINTS}")
        text = text.replace(",", ".")
    own, unit = strict_csv.split_heading(text) if " " in text else (text, "")
    text = own if factor == 1.0 and strict_csv.is_wm2(unit) and quantity.endswith("_wm2") else text
    try:
        value = factor * strict_csv.read_number(text, has_codes=factor == 1.0)
    except ValueError as error:
        raise ValueError(f"{quantity} {error}, expected a number with a decimal point") from None
    if math.isnan(value):
        return None
    if quantity.endswith("_wm2") and not MIN_WM2 <= value <= MAX_WM2:
        raise ValueError(f"{quantity} is {value:.6g}, expected {MIN_WM2:g} to {MAX_WM2:g}")
    return value


class _Clock:
    """Reads the time of rows in UTC, by the offsets of a column such as utc_offset if it has one.

    Raises InputError for a table without a time, for times without a zone and without an offset,
    and for dates such as 1/2/2015 of which day and month cannot be distinguished.
    """

    def __init__(self, path: Path, table: _Table, utc_offset: timedelta | None) -> None:
        """Find the columns of the time, and its zone: stated in a heading, or as `utc_offset`.

        Raises InputError for a table without a column of times.
        """
        names = [name.lower().replace(" ", "") for name in table.names]
        self._path, self._utc_offset, self._names = path, utc_offset, table.names
        self._before: datetime | None = None
        self._is_twelve = True
        zones = [_NAME_ZONE.search(name) for name in names]
        kinds = list(map(_kind_of_time, names))
        stamps, dates, hours = (
            [k for k, kind in enumerate(kinds) if kind == wanted] for wanted in _TIMES
        )
        others = [[dates[0], hours[0]]] if dates and hours else [[k] for k in (*dates, *hours)]
        unnamed = [[0]] if not names[0] else []  # the index of a table, as pandas writes it
        found = [*([k] for k in stamps), *others] or unnamed
        if not found:
            columns = f"columns {', '.join(table.names)[:120]}"
            remedy = "name it t_utc if its times are in UTC, else time, and state --utc-offset"
            raise InputError(path, columns, "a column t_utc or time", remedy)
        in_utc = {k for k, zone in enumerate(zones) if zone and not zone[1]}
        self._at = min(found, key=in_utc.isdisjoint)  # the first one in UTC, else the first one
        self.name = table.names[self._at[-1]]
        self.is_utc = table.in_utc or not in_utc.isdisjoint(self._at)
        self._zone = next((k for k, name in enumerate(names) if _ZONE.fullmatch(name)), None)
        self.unread_zone = self.read_zone = ""
        if stated := next((zone[1] for k in self._at if (zone := zones[k]) and zone[1]), ""):
            hour, _, minute = stated[1:].partition(":")
            self._utc_offset = int(f"{stated[0]}1") * timedelta(
                hours=int(hour), minutes=int(minute or 0)
            )
            self.read_zone = self.name
        self._order = self._date_order(table)

    def text(self, row: Sequence[str]) -> str:
        """Return the cells of a row's time."""
        return " ".join(row[k] for k in self._at)

    def utc(self, row: Sequence[str]) -> datetime:
        """Return the time of a row. Raises ValueError for a text that is no time."""
        text = self.text(row)
        if part := _DAY_OR_MONTH_FIRST.fullmatch(text):
            places = (4, 3, 1) if part[2] == "." else self._order  # with points the day is first
            year, month, day = (part[k].zfill(2) for k in places)
            text = f"{year if len(year) == 4 else f'20{year}'}-{month}-{day} {part[5]}"
        t = strict_csv.read_time(text, utc=self.is_utc)
        require_known_year(t)
        if t.tzinfo is None and self._zone is not None:
            try:
                t = t.replace(tzinfo=datetime.strptime(row[self._zone], "%z").tzinfo)
                self.read_zone = self._names[self._zone]
            except ValueError:
                self.unread_zone = f"{self._names[self._zone]} ({row[self._zone]})"
        if t.tzinfo is None:
            if self._utc_offset is None:
                expected = "the logger's offset from UTC"
                remedy = "state it with --utc-offset +HH:MM"
                raise InputError(self._path, "times without a time zone", expected, remedy)
            self._check_step(t)
            t = t.replace(tzinfo=UTC) - self._utc_offset
        return t.astimezone(UTC)

    def _check_step(self, t: datetime) -> None:
        """Raise InputError for a step back from the time before, on a clock without a zone.

        Only steps that the end of summer time or twelve hours without AM and PM cause. Rows may be
        in any order otherwise.
        """
        before, self._before = self._before, t
        self._is_twelve = self._is_twelve and t.hour <= 12
        if before is None or t >= before:
            return
        back = before - t
        remedy = "write standard time in all rows, or remove rows that occur twice"
        found = f"the clock goes back from {before:%Y-%m-%d %H:%M} to {t:%H:%M}"
        if t.hour < 4 and timedelta(minutes=25) < back <= timedelta(hours=1):
            cause = "as at the end of summer time"
        elif self._is_twelve and t.date() == before.date() and back > timedelta(hours=10.5):
            cause, remedy = "and no hour is above 12", "write hours of 0 to 23, or AM and PM"
        else:
            return
        raise InputError(self._path, f"{found}, {cause}", "one clock in all rows", remedy)

    def _date_order(self, table: _Table) -> tuple[int, int, int]:
        """Return the groups of year, month and day in `_DAY_OR_MONTH_FIRST`, for 13/12/2015.

        With two digits the year could be first too, except if the second number is above 12. Raises
        InputError for dates whose order is unclear.
        """
        dates: list[re.Match[str]] = []
        for count, (_, line) in enumerate(table.lines):
            if count > 20 and not dates:
                break
            with suppress(ValueError, IndexError):
                row = strict_csv.split_row(line, table.mark)
                part = _DAY_OR_MONTH_FIRST.fullmatch(self.text(row))
                if part and part[2] != ".":
                    dates.append(part)
        day_first = any(int(part[1]) > 12 for part in dates)
        month_first = any(int(part[3]) > 12 for part in dates)
        if dates and (day_first == month_first or (day_first and len(dates[0][4]) == 2)):
            why = "whose day and month cannot be distinguished, because no number is above 12"
            why = "whose day and year cannot be distinguished" if day_first else why
            if day_first and month_first:
                why = "some with the day first and some with the month first"
            found = f"dates such as {dates[0][0].split()[0]}, {why}"
            remedy = "write the year first, or import the file together with a later day"
            raise InputError(self._path, found, "dates such as 2015-12-01", remedy)
        return (4, 3, 1) if day_first else (4, 1, 3)
