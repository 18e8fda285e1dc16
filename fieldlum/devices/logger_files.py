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

from fieldlum.core import files, strict_csv
from fieldlum.core.arrays import Mask
from fieldlum.core.errors import InputError, input_errors
from fieldlum.core.records import IrradianceSample, counted, require_known_year
from fieldlum.devices.modbus import MAX_WM2, MIN_WM2
from fieldlum.session.day_files import DAY_COLUMNS, read_day

# Coarsest times in a netCDF file: numbers of days or hours in single precision can have steps of
# seconds. Chosen.
_MAX_TIME_STEP_S = 1.0
_MAX_ROWS = 5_000_000  # two months of seconds, in 3 GB of memory
_NETCDF = b"CDF"  # first bytes of a classic netCDF file (its format's specification)
# Usual names of columns of times, of dates, and of times of day, without marks and without a zone.
_TIME_NAMES = {
    "stamp": "timestamp tmstamp datetime datetimestamp referencetimestamp messdatum datumzeit "
    "dateheure horodatage 日時",
    "date": "date datum dato fecha data 日期 日付",
    "hour": "time zeit uhrzeit heure hora ora tijd tid czas 时间 時刻 lst est cst mst pst",
}
# End of a time column's name that states its zone; group 1: the offset, such as +01:00.
_ZONE_IN_NAME = re.compile(r"[,_(\[]*(?:utc|gmt)([+-]\d\d?(?::?\d\d)?)?[)\]]?$")
_MAX_OFFSET = timedelta(hours=14)  # of the islands of Kiribati, the largest in use
_OFFSET_COLUMN = re.compile(r"((utc|gmt)_?)?offset|tz|(time_?)?zone")
# Groups: day or month, mark, the other of the two, year, time of day.
_DAY_OR_MONTH_FIRST = re.compile(r"(\d{1,2})([/.-])(\d{1,2})\2(\d{4}|\d\d)[ T]+(.+)")
_ROUNDED_DAY = re.compile(r"\d{5}([.,]\d{1,4})?")  # of a spreadsheet; 0.0001 is 9 s
_SEPARATORS = ",;\t|"
_PANGAEA = "/* DATA DESCRIPTION:"  # PANGAEA writes all times in UTC
_DECIMAL_COMMA = re.compile(r" is '[+-]?[\d.]+,[\d,.]+'")  # in the text on a damaged row
_BAD_MEANING = re.compile("(?<!no_)(?<!not_)(bad|invalid|fail|error|missing)")
# Usual column names in loggers' programs and in ARM's netCDF files, without "avg"; digits,
# underscores and case are ignored in the comparison.
_USUAL_NAMES = {
    "ghi_wm2": "ghi global slrw solarwm total solarradiation globalhorizontal downshorthemisp swd",
    "dhi_wm2": "dhi diffuse dif diff diffusehorizontal downshortdiffusehemisp",
    "dni_wm2": "dni direct directnormal shortdirectnormal dir",
    "temperature_c": "ptempc airtc bodytemp",
}


@dataclass(frozen=True, slots=True)
class LoggerFile:
    """The content of a logger's file.

    samples : readings, in order of time when `read_logger_file` returns them; left_out : a text on
    each line that could not be read, for a day file one text on their number; notes : texts on
    which columns were read, and how.
    """

    samples: tuple[IrradianceSample, ...]
    left_out: tuple[str, ...]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class _Table:
    """The text of a table: names and units of its columns, lines below them.

    is_logger : whether a logger's program wrote it, which states the unit of each column and puts
    no spaces around cells; cut : a text on an incomplete last line; bad_counts : how many values of
    each column the file itself calls bad, by its name; mark : separator of cells; in_utc : whether
    all times are in UTC.
    """

    names: list[str]
    units: list[str]
    lines: Sequence[strict_csv.Line]
    is_logger: bool = False
    cut: tuple[str, ...] = ()
    bad_counts: Mapping[str, int] = field(default_factory=dict)
    mark: str = ","
    in_utc: bool = False

    def comparable_names(self) -> list[str]:
        """Return the name of each column as `_USUAL_NAMES` has it, without marks and case.

        The name is "" for a column of a csv that is not in W/m2.
        """
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
    times that are stated in UTC. columns : names of the columns of time and some quantities
    (ghi_wm2 ...), or their numbers, from 1, in a csv without names; the others are found by their
    usual names: the quantity itself, or names like SlrW and GHI where the file states their unit.
    sensitivities : of pyranometers whose column is a voltage, uV per W/m2.

    A damaged row is omitted, with a text in `left_out`. Raises InputError for a file that cannot be
    read or is of another kind, with decimal commas or more damaged than readable rows, for a column
    that does not exist, is ambiguous or has another unit, for times without a zone and without
    utc_offset, and for dates whose day and month cannot be distinguished.
    """
    first_bytes = b""
    with suppress(OSError), files.open_to_read(path) as file:
        first_bytes = file.read(len(_NETCDF))
    options = (utc_offset, columns or {}, sensitivities or {})
    if first_bytes == _NETCDF:
        logger_file = read_rows(path, _netcdf(path), *options)
    else:
        text = strict_csv.read_text(path, "a logger's file in csv or TOA5")
        if text.startswith(",".join(DAY_COLUMNS)):
            samples, damaged = read_day(path)
            logger_file = LoggerFile(tuple(samples), (f"{damaged} broken rows",) if damaged else ())
        else:
            table = text_table(path, text, options[1].get("time", ""))
            logger_file = read_rows(path, table, *options)
    _check_readable(path, logger_file)
    notes = logger_file.notes
    largest_wm2 = max(s.ghi_wm2 or s.dni_wm2 or s.dhi_wm2 or 0.0 for s in logger_file.samples)
    # a pyranometer's full voltage is 5 to 20 mV; the sky of a day gives more W/m2
    if largest_wm2 < 30.0 and not sensitivities:
        notes += (f"largest irradiance {largest_wm2:.3g} W/m2: a voltage needs --sensitivity",)
    ordered = tuple(sorted(logger_file.samples, key=lambda s: s.t_utc))
    return replace(logger_file, samples=ordered, notes=notes)


def _check_readable(path: Path, logger_file: LoggerFile) -> None:
    """Raise InputError for decimal commas, and for fewer readable than damaged rows.

    logger_file: the rows that were read, and a text on each other one.
    """
    count, left_out = len(logger_file.samples), logger_file.left_out
    causes = (strict_csv.COMMAS, strict_csv.THOUSANDS, strict_csv.POINTS)
    commas = [text for text in left_out if text.endswith(causes) or _DECIMAL_COMMA.search(text)]
    if len(commas) > 1:
        has_thousands = commas[0].endswith((strict_csv.THOUSANDS, strict_csv.POINTS))
        kind = "thousands separators" if has_thousands else "decimal commas"
        found = f"{len(commas)} of {count + len(left_out)} rows have {kind}: {commas[0]}"
        remedy = "save it as CSV with commas between and points in the numbers"
        raise InputError(path, found, "numbers with a decimal point", remedy)
    if len(left_out) > count or not count:
        first = left_out[0] if left_out else "it has no rows"
        found = f"no row could be read: {first}"
        if count:
            found = f"{len(left_out)} rows cannot be read, {count} can: {first}"
        remedy = "write all times in that form" if "time '" in first else "export the file again"
        raise InputError(path, found, "rows of irradiance", f"{remedy} (docs/devices.md)")


# ----------------------------------------------------------------------------------------------
# formats


def text_table(path: Path, text: str, time_name: str = "") -> _Table:
    """Return the text of a TOA5 or csv file as a table; path: for errors.

    time_name: of the column of times, if the user states it; it finds the line of names.
    Raises InputError for an incomplete header, an empty file, or names that cannot be split.
    """
    is_toa5 = text.startswith(('"TOA5",', "TOA5,"))
    return _toa5(path, text) if is_toa5 else _csv(path, text, time_name)


def _toa5(path: Path, text: str) -> _Table:
    """Return the text of a TOA5 file as a table; path: for errors.

    A last line without a line feed is not complete, and is omitted. Raises InputError for a header
    of other than four lines, without TIMESTAMP, or without a unit for each column.
    """
    lines = text.replace("\r\n", "\n").split("\n")
    header: list[list[str]] = []
    with suppress(ValueError):
        header = [strict_csv.split_row(line, padded=False) for line in lines[:4]]
    if len(header) < 4 or header[3][0][:1].isdigit():  # the fourth line is a row of data
        found = "no complete TOA5 header in the first four lines"
        expected = "four header lines of a Campbell Scientific TOA5 table"
        raise InputError(path, found, expected, "copy the file from the logger again")
    _, names, units, _ = header
    if "TIMESTAMP" not in names or len(units) != len(names):
        expected = "a column TIMESTAMP, and a unit for each column"
        found = f"columns {', '.join(names)[:80]}"
        raise InputError(path, found, expected, "export the table again")
    cut: tuple[str, ...] = ()
    if lines.pop():
        cut = (f"line {len(lines) + 1}: the line does not end with a line feed",)
    body = [(n, line) for n, line in enumerate(lines[4:], start=5) if line.strip()]
    return _Table(names, units, body, is_logger=True, cut=cut)


def _csv(path: Path, text: str, time_name: str) -> _Table:
    """Return the text of a csv file as a table; path: for errors.

    Without a line of names, the first column is called time, and the others by their numbers. A
    unit in a line below the names counts more than one in the name. Raises InputError for an empty
    file, or a line of names that cannot be split into cells.
    """
    # A first name # is that of a column of row numbers; such a line is no comment.
    text = re.sub(r"(?m)^#(?=[,;\t])", '"#"', text)
    lines = strict_csv.numbered(strict_csv.lines_of(text))
    if not lines:
        expected = "a header with t_utc and one or more of ghi_wm2, dhi_wm2, dni_wm2"
        raise InputError(path, "an empty file", expected, "copy the file from the logger again")
    above, mark = _header(lines, time_name)
    lines = lines[above:]
    names = strict_csv.split_header(path, lines[0], mark)
    with suppress(ValueError):
        strict_csv.read_time(names[0])  # succeeds if the first line is a row of data
        numbers = ["time", *(str(k) for k in range(2, len(names) + 1))]
        return _Table(numbers, [""] * len(names), lines, mark=mark)
    units = [strict_csv.stated_unit(name) for name in names]
    below = [cell.strip(' "') for _, line in lines[1:2] for cell in line.split(mark)]
    are_units = any("/" in cell or strict_csv.is_unit(cell) for cell in below)
    if are_units and len(below) == len(names) and not re.search(r"\d\d", lines[1][1]):
        units = [cell or unit for cell, unit in zip(below, units, strict=True)]
        del lines[1]
    return _Table(names, units, lines[1:], mark=mark, in_utc=text.startswith(_PANGAEA))


def _header(lines: Sequence[strict_csv.Line], time_name: str) -> tuple[int, str]:
    """Return how many lines are above the column names, such as a title, and the cells' separator.

    The column names are the first line with `time_name`, or without one with a usual name of a time
    column, unless a line above it has as many cells, none of them empty, and so is a row of the
    table. Without such a line, the names are the first line.
    """
    for above, (_, line) in enumerate(lines[:200]):
        mark = _mark_of(line)
        with suppress(ValueError):
            names = strict_csv.split_row(line, mark)
            kinds = {time_name} if time_name in names else set(map(_kind_of_time, names))
            wanted = {time_name} if time_name else {"stamp", "hour"}
            if sum(map(bool, names)) > 1 and wanted & kinds:  # more than a title
                rows_above = [text.split(mark) for _, text in lines[:above]]
                is_row = any(len(row) == len(names) and all(row) for row in rows_above)
                return (0, ",") if is_row else (above, mark)
    return 0, _mark_of(lines[0][1])


def _mark_of(line: str) -> str:
    """Return the separator that occurs most often in a line outside of quotation marks."""
    return max(_SEPARATORS, key=re.sub('"[^"]*"', "", line).count)


def _kind_of_time(name: str) -> str:
    """Return which part of a time a column has, by its name: a key of `_TIME_NAMES`; "" for none.

    The key is "stamp" for date and time of day, "date", or "hour" for a time of day.
    """
    plain = name.lower().replace(" ", "")
    word = re.sub(r"[(\[][^()]*[)\]]$|\W|_", "", _ZONE_IN_NAME.sub("", plain))
    if word in ("", "t") and _ZONE_IN_NAME.search(plain):  # such as UTC, or t_utc
        return "stamp"
    return next((kind for kind, words in _TIME_NAMES.items() if word in words.split()), "")


def _netcdf(path: Path) -> _Table:
    """Return the variables along the time of a classic netCDF file, such as ARM's, as a table.

    Values that the file itself calls bad are missing. Raises InputError for a file without exactly
    one variable of times, and for times with too few digits for steps of a second.
    """
    import pandas as pd
    import xarray as xr

    expected = "a netCDF file with a variable of times and irradiance along it"
    with input_errors(path, expected, "export it as csv", Exception):  # scipy raises any
        with xr.open_dataset(path, engine="scipy", decode_cf=False) as opened:
            stored = opened.load()
        names = [str(k) for k in stored.coords if " since " in str(stored[k].attrs.get("units"))]
        if len(names) != 1:
            raise ValueError("not one variable of times in units such as 'days since 2019-07-05'")
        (time_name,) = names
        of_time = stored[time_name]
        calendar = str(of_time.attrs.get("calendar", "standard"))
        if calendar not in ("standard", "gregorian", "proleptic_gregorian"):
            raise ValueError(f"times of the calendar {calendar}")
        stored = stored.squeeze([d for d, n in stored.sizes.items() if n == 1 and d != time_name])
        decoded = xr.decode_cf(stored)
        unit = pd.Timedelta(1, str(of_time.attrs["units"]).split()[0])
        numbers = of_time.to_numpy()
        if numbers.size > _MAX_ROWS:
            raise ValueError(f"{numbers.size:,} times, more than {_MAX_ROWS:,}")
        step_s = float(np.spacing(np.abs(numbers).max())) * unit.total_seconds()
        if step_s > _MAX_TIME_STEP_S:
            digits = f"{8 * numbers.dtype.itemsize} bits, enough for steps of {step_s:.2g} s"
            raise ValueError(f"times with {digits}")
        times = decoded[time_name].to_numpy().astype("M8[us]").tolist()
        along_time = {str(name): v for name, v in decoded.items() if v.dims == (time_name,)}
        bad = {name: _called_bad(stored, name) for name in along_time}
    units = ["", *(str(values.attrs.get("units", "")) for values in along_time.values())]
    columns = (values.where(~bad[name]).to_numpy().tolist() for name, values in along_time.items())
    rows = enumerate(zip(times, *columns, strict=True), start=1)
    lines = [(number, ",".join(map(str, row))) for number, row in rows]
    counts = {name: int(mask.sum()) for name, mask in bad.items()}
    return _Table(["t_utc", *along_time], units, lines, is_logger=True, bad_counts=counts)


def _called_bad(stored: Any, name: str) -> Mask:
    """Return a mask [times]: True where a netCDF file itself calls a value of a variable bad.

    stored: the dataset, not decoded; name: of a variable along the time. Bad are values outside
    valid_range or valid_min and valid_max (CF conventions 1.11, 2.5.1), and those with a flag of a
    bad meaning (CF 3.5) or assessment (ARM's standard for data). An instrument's offset at night,
    down to -10 W/m2, is not bad because it is below valid_min.
    """
    data = stored[name]
    attributes: Mapping[str, Any] = data.attrs
    if data.dtype.kind not in "iuf":
        return np.zeros(data.shape, bool)
    scale, offset = attributes.get("scale_factor", 1.0), attributes.get("add_offset", 0.0)

    def in_unit(limit: Any) -> float:
        """Return a limit in the variable's unit; NaN for a text.

        limit: a number of numpy, from an attribute; an integer is scaled like the stored values.
        """
        if limit.dtype.kind in "iu":
            return float(limit * scale + offset)
        return float(limit) if limit.dtype.kind == "f" else math.nan

    limits = np.ravel(attributes.get("valid_range", (-math.inf, math.inf)))
    least, most = attributes.get("valid_min", limits[0]), attributes.get("valid_max", limits[-1])
    low, high = in_unit(np.ravel(least)[0]), in_unit(np.ravel(most)[0])
    values = data.to_numpy() * scale + offset
    bad = (values > high) | (values < min(low, strict_csv.IRRADIANCE_LIMITS_WM2[0]))
    for flag in (f"qc_{name}", *str(attributes.get("ancillary_variables", "")).split()):
        if flag in stored and stored[flag].dims == data.dims and stored[flag].dtype.kind in "iu":
            bits = stored[flag].to_numpy().astype(np.int64)
            for mask, value in _bad_flags(stored.attrs, stored[flag].attrs):
                bad |= (bits & mask) == value
    return bad


def _bad_flags(of_file: Mapping[str, Any], of_flag: Mapping[str, Any]) -> Iterator[tuple[int, int]]:
    """Yield the mask and the value of each flag that means bad data, in a netCDF variable of flags.

    of_file, of_flag: attributes of the file and of the variable. A datum is bad if its flag word
    has the value under the mask.
    """
    for bit in range(31):  # ARM numbers them from 1
        assessed, described = (
            str(of_flag.get(f"bit_{bit + 1}_{key}", of_file.get(f"qc_bit_{bit + 1}_{key}", "")))
            for key in ("assessment", "description")
        )
        if assessed == "Bad" and "valid_min" not in described:
            yield 1 << bit, 1 << bit
    masks = np.ravel(of_flag.get("flag_masks", -1)).tolist()
    values = np.ravel(of_flag.get("flag_values", masks)).tolist()
    words = str(of_flag.get("flag_meanings", "")).lower().split()
    for k, (value, meaning) in enumerate(zip(values, words, strict=False)):
        if _BAD_MEANING.search(meaning):
            yield masks[k % len(masks)], value


def _letters(name: str) -> str:
    """Return the letters a to z of a column name in lower case, without a last "avg"."""
    return re.sub(r"[^a-z]", "", name.lower()).removesuffix("avg")


# ----------------------------------------------------------------------------------------------
# rows


def read_rows(
    path: Path,
    table: _Table,
    utc_offset: timedelta | None,
    asked: Mapping[str, str],
    sensitivities: Mapping[str, float],
) -> LoggerFile:
    """Return the samples of a table, in its order, and a text on each line that was not read.

    path: for errors; utc_offset: the logger's clock minus UTC, None if the times state a zone;
    asked: name or number of the column of some quantities (ghi_wm2 ...), as the user states it;
    sensitivities: of pyranometers whose column is a voltage, uV per W/m2. Raises InputError for a
    column that does not exist, is ambiguous or has another unit, for times without a zone and
    without utc_offset, and for dates whose day and month cannot be distinguished.
    """
    names, count, by_commas = table.names, len(table.names), table.mark == ","
    if len(table.lines) > _MAX_ROWS:
        expected = f"at most {_MAX_ROWS:,} rows"
        raise InputError(path, f"{len(table.lines):,} rows", expected, "split the file by months")
    strict_csv.check_names(path, [name.lower() for name in names])
    index = _columns(path, table, asked)
    factor, notes = _factors(path, table, index, sensitivities)
    times = _TimeColumns(path, table, utc_offset, asked.get("time", ""))
    has_commas = _has_decimal_commas(table, index.values())
    samples: list[IrradianceSample] = []
    right_rows: list[list[str]] = []
    damaged: list[str] = []
    other_counts: list[tuple[int, int]] = []  # line numbers, and other numbers of values
    for number, line in table.lines:
        try:
            row = strict_csv.split_row(line, table.mark, padded=not table.is_logger)
            if len(row) != count:
                why = strict_csv.surplus_cause(row, count, right_rows[-50:]) if by_commas else ""
                other_counts += [] if why else [(number, len(row))]
                raise ValueError(f"{len(row)} values, expected {count}{why}")
            numbers = [_number(row[i], q, factor[q], has_commas) for q, i in index.items()]
            values: dict[str, Any] = dict(zip(index, numbers, strict=True))
            raw = ",".join(row[i] for i in sorted(index.values()))
            samples.append(IrradianceSample(times.utc(row), **values, raw=raw))
            right_rows.append(row)
        except (ValueError, OverflowError) as error:
            cells = [cell.strip(' "') for cell in line.split(table.mark)]
            if any(map(_kind_of_time, cells)) and cells != [name.strip(' "') for name in names]:
                below = counted(sum(n > number for n, _ in table.lines), "row")
                found = f"line {number}: other column names, for {below}"
                raise InputError(path, found, "one table", "split the file there") from None
            damaged.append(f"line {number}: {error}")
    _refuse_other_counts(path, other_counts, count)
    _refuse_rounded_times(path, [times.text(row) for row in right_rows], samples)
    for name in (names[i] for i in index.values() if table.bad_counts.get(names[i])):
        bad_values = f"{counted(table.bad_counts[name], 'value')} of {name}"
        why = "out of the valid range or flagged as bad"
        notes.append(f"missing by the file itself: {bad_values}, {why}")
    return LoggerFile(tuple(samples), (*damaged, *table.cut), (*notes, *times.notes(utc_offset)))


def _refuse_other_counts(path: Path, counts: Sequence[tuple[int, int]], expected: int) -> None:
    """Raise InputError if three successive lines have the same wrong number of values.

    counts: number of each line with other than `expected` values, and how many it has.
    """
    for (line, count), *next_two in zip(counts, counts[1:], counts[2:], strict=False):
        if count > 1 and next_two == [(line + 1, count), (line + 2, count)]:
            rows = sum(n >= line and other == count for n, other in counts)
            found = f"line {line}: {count} values, expected {expected}, as in {rows} rows from it"
            raise InputError(path, found, "one table", "split the file there")


def _refuse_rounded_times(path: Path, texts: list[str], samples: list[IrradianceSample]) -> None:
    """Raise InputError if all times are days of a spreadsheet with too few decimals.

    texts: of the times of `samples`. Four decimals are enough for times that are multiples of 5
    min.
    """
    if texts and all(map(_ROUNDED_DAY.fullmatch, texts)):
        why = "has too few decimals for a time"
        if is_date := not any(set(",.") & set(text) for text in texts):
            why = "is a date without a time of day"
        if is_date or any(s.t_utc.timestamp() % 300.0 for s in samples):
            raise InputError(path, f"'{texts[0]}' {why}", "times", "export them as dates and times")


def _has_decimal_commas(table: _Table, columns: Iterable[int]) -> bool:
    """Return whether more numbers in some columns have a decimal comma than a decimal point.

    columns: their indices. In a table whose cells are separated by commas, none has.
    """
    points_minus_commas = 0
    for _, line in table.lines if table.mark != "," else ():
        with suppress(ValueError, IndexError):
            row = strict_csv.split_row(line, table.mark)
            points_minus_commas += sum(("." in row[k]) - ("," in row[k]) for k in columns)
    return points_minus_commas < 0


def _columns(path: Path, table: _Table, asked: Mapping[str, str]) -> dict[str, int]:
    """Return the column index by quantity, for irradiances and temperature that the table has.

    asked: column name by quantity, as the user states it; other columns are found by the
    quantity's own name, or by a usual name. Raises InputError for a column that is missing or
    ambiguous, and for a table without irradiance.
    """
    names, index = [name.lower() for name in table.names], dict[str, int]()
    all_names = ", ".join(table.names)[:120]
    if missing := [name for name in asked.values() if name.lower() not in names]:
        found, remedy = f"no column {', '.join(missing)}", "correct the name after --column"
        raise InputError(path, found, f"one of {all_names}", remedy)
    asked_names = {name.lower() for name in asked.values()}
    comparable = enumerate(table.comparable_names())
    free = [(i, name) for i, name in comparable if names[i] not in asked_names]
    for quantity, usual_names in _USUAL_NAMES.items():
        name = asked.get(quantity, quantity).lower()
        matches = [names.index(name)] if name in names else []
        matches = matches or [i for i, free_name in free if free_name in usual_names.split()]
        if len(matches) > 1:
            found = f"several columns for {quantity}: {', '.join(table.names[i] for i in matches)}"
            raise InputError(path, found, "one column", f"choose it: --column {quantity}=NAME")
        if matches:
            index[quantity] = matches[0]
    if not any(quantity.endswith("_wm2") for quantity in index):
        found = f"no known column of irradiance among the columns {all_names}"
        expected = "a column of irradiance, such as ghi_wm2, dhi_wm2 or dni_wm2"
        remedy = "choose it: --column ghi_wm2=NAME"
        if len(names) == 1 and not table.is_logger:  # a title above was read as the names
            remedy = "remove the lines above the column names"
        raise InputError(path, found, expected, remedy)
    return index


def _factors(
    path: Path, table: _Table, index: Mapping[str, int], sensitivities: Mapping[str, float]
) -> tuple[dict[str, float], list[str]]:
    """Return the factor from a column's unit to the quantity's, by quantity; and notes on columns.

    It is W/m2 per unit of voltage, and 1 for other columns. index: of the column, by quantity;
    sensitivities: in uV per W/m2, by quantity. Raises InputError for a column in another unit, a
    voltage without sensitivity and a sensitivity without a voltage.
    """
    factor = dict.fromkeys(index, 1.0)
    notes: list[str] = []
    names, units = table.names, table.units
    if missing := [quantity for quantity in sensitivities if quantity not in index]:
        remedy = f"name it: --column {missing[0]}=NAME"
        raise InputError(path, f"no column for {missing[0]}", "a column", remedy)
    for quantity, i in index.items():
        unit, unit_uv = units[i], strict_csv.microvolts(units[i])
        sensitivity = sensitivities.get(quantity)
        can_be_wm2 = strict_csv.is_wm2(unit) or not (unit or table.is_logger)
        if sensitivity and (unit_uv or not unit):
            factor[quantity] = (unit_uv or 1e3) / sensitivity  # without a unit mV, as loggers store
            shown = unit or "mV (its unit is not stated)"
            notes.append(f"column {names[i]} read in {shown}, {sensitivity:g} uV per W/m2")
        elif quantity.endswith("_wm2") and (sensitivity or not can_be_wm2):
            expected = "mV, uV or V where a sensitivity is stated" if sensitivity else "W/m^2"
            remedy = f"choose another column: --column {quantity}=NAME"
            if unit_uv:
                remedy = f"state the sensitivity of the pyranometer: --sensitivity {quantity}=UV"
            raise InputError(path, f"the column {names[i]} is in '{unit}'", expected, remedy)
    used = ", ".join(f"{names[i]} as {quantity}" for quantity, i in index.items())
    in_wm2 = (k for k, unit in enumerate(units) if strict_csv.is_wm2(unit))
    others = [names[k] for k in in_wm2 if k not in index.values()]
    unused = f"; not used: {', '.join(others)} (name one with --column)" if others else ""
    return factor, [f"columns: {used}{unused}", *notes]


def _number(text: str, quantity: str, factor: float, has_commas: bool) -> float | None:
    """Return the value in a cell, a number times `factor`, in the quantity's unit; None if missing.

    text: of the cell, in which W/m2 may follow the number; quantity: such as ghi_wm2; has_commas:
    whether decimals have a comma, so that a point is an error. Raises ValueError for a text that is
    not a number, and for an irradiance outside -200 to 4000 W/m2.
    """
    if has_commas:
        if "." in text:
            raise ValueError(f"{quantity} is '{text}'{strict_csv.POINTS}")
        text = text.replace(",", ".")
    is_irradiance = quantity.endswith("_wm2")
    if " " in text and factor == 1.0 and is_irradiance:
        number, unit = strict_csv.split_heading(text)
        text = number if strict_csv.is_wm2(unit) else text
    try:
        value = factor * strict_csv.read_number(text, has_codes=factor == 1.0)
    except ValueError as error:
        raise ValueError(f"{quantity} {error}, expected a number with a decimal point") from None
    if math.isnan(value):
        return None
    if is_irradiance and not MIN_WM2 <= value <= MAX_WM2:
        raise ValueError(f"{quantity} is {value:.6g}, expected {MIN_WM2:g} to {MAX_WM2:g}")
    return value


class _TimeColumns:
    """The columns of a table that state the time of each row: one, or a date and a time of day.

    The offset of the times from UTC is stated in the column's name, in a column of offsets, or by
    the user. Raises InputError for a table without a time, for times without a zone and without an
    offset, and for dates such as 1/2/2015 of which day and month cannot be distinguished.
    """

    def __init__(self, path: Path, table: _Table, utc_offset: timedelta | None, asked: str) -> None:
        """Find the columns of the time, and the column of its offset if the table has one.

        path: for errors; utc_offset, asked (name of the column): as the user states them, None and
        "" if not stated.
        """
        names = [name.lower().replace(" ", "") for name in table.names]
        self._path, self._utc_offset, self._names = path, utc_offset, table.names
        self._before: datetime | None = None  # time of the row before, without a zone
        self._has_twelve_hours = True  # until an hour above 12 occurs
        zones = [_ZONE_IN_NAME.search(name) for name in names]
        kinds = list(map(_kind_of_time, names))
        stamps, dates, hours = (
            [k for k, kind in enumerate(kinds) if kind == wanted] for wanted in _TIME_NAMES
        )
        others = [[dates[0], hours[0]]] if dates and hours else [[k] for k in (*dates, *hours)]
        unnamed = [[0]] if not names[0] else []  # the index of a table, as pandas writes it
        candidates = [*([k] for k in stamps), *others] or unnamed
        if asked:
            candidates = [[[name.lower() for name in table.names].index(asked.lower())]]
        if not candidates:
            columns = f"columns {', '.join(table.names)[:120]}"
            remedy = "name it: --column time=NAME, and state --logger-utc-offset (+00:00 for UTC)"
            raise InputError(path, columns, "a column t_utc or time", remedy)
        in_utc = {k for k, zone in enumerate(zones) if zone and not zone[1]}
        self._columns = min(candidates, key=in_utc.isdisjoint)  # the first in UTC, else the first
        self._name = table.names[self._columns[-1]]
        self._is_utc = table.in_utc or not in_utc.isdisjoint(self._columns)
        offsets = (k for k, name in enumerate(names) if _OFFSET_COLUMN.fullmatch(name))
        self._offset_column = next(offsets, None)
        self._unread_offset = self._read_offset = ""  # names of columns, for notes
        if stated := next((zone[1] for k in self._columns if (zone := zones[k]) and zone[1]), ""):
            digits = stated[1:].replace(":", "")
            hour, minute = (digits, "0") if len(digits) < 3 else (digits[:-2], digits[-2:])
            offset = timedelta(hours=int(hour), minutes=int(minute))
            if offset > _MAX_OFFSET or int(minute) > 59:
                found, remedy = f"the time zone {stated} in {self._name}", "correct the header"
                raise InputError(path, found, "at most 14 hours from UTC", remedy)
            self._utc_offset = -offset if stated[0] == "-" else offset
            self._read_offset = self._name
        self._date_groups = self._date_order(table)

    def notes(self, utc_offset: timedelta | None) -> list[str]:
        """Return sentences on which offset counts, after all rows were read.

        utc_offset: as the user states it, None if not stated.
        """
        notes: list[str] = []
        if self._unread_offset:
            notes.append(f"column {self._unread_offset} is not used: --utc-offset counts")
        if self._read_offset and utc_offset is not None:
            notes.append(f"the offsets in column {self._read_offset} count, not --utc-offset")
        if self._is_utc and utc_offset is not None:
            notes.append(f"times of {self._name} are UTC: no offset moves them")
        return notes

    def text(self, row: Sequence[str]) -> str:
        """Return the cells of a row's time, separated by a space."""
        return " ".join(row[k] for k in self._columns)

    def utc(self, row: Sequence[str]) -> datetime:
        """Return the time of a row in UTC.

        row: cells of a row; rows must be given in the order of the file. Raises ValueError for a
        text that is no time; InputError for a time without an offset, or a clock that went back.
        """
        text = self.text(row)
        if date := _DAY_OR_MONTH_FIRST.fullmatch(text):
            # with points the day is first
            groups = (4, 3, 1) if date[2] == "." else self._date_groups
            year, month, day = (date[k].zfill(2) for k in groups)
            text = f"{year if len(year) == 4 else f'20{year}'}-{month}-{day} {date[5]}"
        t = strict_csv.read_time(text, utc=self._is_utc)
        require_known_year(t)
        if t.tzinfo is None and (k := self._offset_column) is not None:
            try:
                t = t.replace(tzinfo=datetime.strptime(row[k], "%z").tzinfo)
                self._read_offset = self._names[k]
            except ValueError:
                self._unread_offset = f"{self._names[k]} ({row[k]})"
        if t.tzinfo is None:
            if self._utc_offset is None:
                expected = "the logger's offset from UTC"
                remedy = "state it with --logger-utc-offset +HH:MM"
                raise InputError(self._path, "times without a time zone", expected, remedy)
            self._check_step(t)
            t = t.replace(tzinfo=UTC) - self._utc_offset
        return t.astimezone(UTC)

    def _check_step(self, t: datetime) -> None:
        """Raise InputError if the clock of the rows was set back before `t`, a time without a zone.

        The clock was set back if the time steps back as at the end of summer time, or as with hours
        of 1 to 12 without AM and PM. Rows may be in any order otherwise.
        """
        before, self._before = self._before, t
        self._has_twelve_hours = self._has_twelve_hours and t.hour <= 12
        if before is None or t >= before:
            return
        back = before - t
        remedy = "write standard time in all rows, or remove rows that occur twice"
        found = f"the clock goes back from {before:%Y-%m-%d %H:%M} to {t:%H:%M}"
        # Summer time ends before 4 h, with a step of an hour or half an hour. From 12 to 1 o'clock
        # the step is 11 h, less the time between two rows.
        if t.hour < 4 and timedelta(minutes=25) < back <= timedelta(hours=1):
            cause = "as at the end of summer time"
        elif self._has_twelve_hours and t.date() == before.date() and back > timedelta(hours=10.5):
            cause, remedy = "and no hour is above 12", "write hours of 0 to 23, or AM and PM"
        else:
            return
        raise InputError(self._path, f"{found}, {cause}", "one clock in all rows", remedy)

    def _date_order(self, table: _Table) -> tuple[int, int, int]:
        """Return the groups of `_DAY_OR_MONTH_FIRST` that are year, month and day in this table.

        A number above 12 shows the order, such as 13 in 13/12/2015; (4, 1, 3) without such dates.
        Raises InputError for dates whose order is unclear, as with a year of two digits that could
        be first too.
        """
        dates: list[re.Match[str]] = []
        for count, (_, line) in enumerate(table.lines):
            if count > 20 and not dates:
                break
            with suppress(ValueError, IndexError):
                row = strict_csv.split_row(line, table.mark)
                date = _DAY_OR_MONTH_FIRST.fullmatch(self.text(row))
                if date and date[2] != ".":
                    dates.append(date)
        day_first = any(int(date[1]) > 12 for date in dates)
        month_first = any(int(date[3]) > 12 for date in dates)
        if dates and (day_first == month_first or (day_first and len(dates[0][4]) == 2)):
            why = "whose day and month cannot be distinguished, because no number is above 12"
            why = "whose day and year cannot be distinguished" if day_first else why
            if day_first and month_first:
                why = "some with the day first and some with the month first"
            found = f"dates such as {dates[0][0].split()[0]}, {why}"
            remedy = "write the year first, or import the file together with a later day"
            raise InputError(self._path, found, "dates such as 2015-12-01", remedy)
        return (4, 3, 1) if day_first else (4, 1, 3)
