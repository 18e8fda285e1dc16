"""Read Campbell Scientific TOA5 tables.

Four header lines (environment, names, units, processing) come before the rows. A row has a quoted
time WITHOUT a time zone, a record number and numbers; "NAN" is a missing number. The user must
state the logger's UTC offset. Source: help.campbellsci.com, TOA5.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path

from fieldlum.core.errors import InputError
from fieldlum.core.records import IrradianceSample
from fieldlum.core.strict_csv import (
    COMMAS,
    check_names,
    decimal_commas,
    is_wm2,
    microvolts,
    split_row,
)
from fieldlum.devices.ascii_lines import sample_of
from fieldlum.devices.learned_format import ENOUGH, constant
from fieldlum.devices.registers import HIGHEST_WM2, LOWEST_WM2

_TIME = re.compile(r"\d{4}-\d{2}-\d{2} \d{2}:\d{2}:\d{2}(?:\.\d{1,6})?")
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?")
_COMPARED_ROWS = 50  # rows before a damaged one whose decimal points are counted; chosen
_MILLIVOLT = 1e3  # microvolts; loggers store the voltage of a pyranometer in mV
# Usual column names in loggers' programs; digits, underscores and case are ignored in the
# comparison.
_USUAL = {
    "ghi_wm2": ("ghi", "global", "slrw", "slrwavg", "solarwm", "total", "ghiavg", "globalavg"),
    "dhi_wm2": ("dhi", "diffuse", "dhiavg", "diffuseavg", "dif", "difavg", "diff", "diffavg"),
    "dni_wm2": ("dni", "direct", "dniavg", "directavg", "directnormal"),
    "temperature_c": ("ptempc", "airtc", "airtcavg", "bodytemp", "ptempcavg"),
}


@dataclass(frozen=True, slots=True)
class Toa5:
    """The content of a TOA5 table.

    samples : in the file's order; broken : omitted lines, each with the reason; missing_records :
    how many record numbers are missing between the lines that could be read; jumps of a million or
    more are not counted. notes : which columns of irradiance are used.
    """

    samples: tuple[IrradianceSample, ...]
    station: str
    model: str
    serial: str
    broken: tuple[str, ...]
    missing_records: int
    notes: tuple[str, ...] = ()


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
) -> Toa5:
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
    chosen = scaled(source, names, units, _columns(names, columns, source), sensitivities)
    samples: list[IrradianceSample] = []
    broken: list[str] = []
    records: list[int] = []
    numbered: list[tuple[int, int, int]] = []  # line, index of its sample, its record number
    read: list[tuple[int, list[str]]] = []  # line and its values
    for number, line in enumerate(lines[4:], start=5):
        if not line.strip():
            continue
        try:
            if number == len(lines):
                raise ValueError("the line does not end with a line feed")
            row = split_row(line.rstrip("\r"), padded=False)
            check_count(row, names, [cells for _, cells in read[-_COMPARED_ROWS:]])
            samples.append(_sample(row, names, chosen, utc_offset))
            read.append((number, row))
        except (ValueError, OverflowError) as error:
            broken.append(f"line {number}: {error}")
            continue
        if "RECORD" in names and (record := row[names.index("RECORD")]).isdecimal():
            records.append(int(record))
            numbered.append((number, len(samples) - 1, int(record)))
    strays = _out_of_step(numbered, [sample.t_utc for sample in samples])
    broken += [
        f"line {line}: its time and record number disagree with both neighbours'"
        for line, _ in strays
    ]
    differing = _differing_decimals([row for _, row in read], chosen.at)
    broken += [f"line {read[i][0]}: {why}" for i, why in differing.items()]
    left_out = {i for _, i in strays} | set(differing)
    samples = [sample for i, sample in enumerate(samples) if i not in left_out]
    missing = sum(b - a - 1 for a, b in pairwise(records) if 1 < b - a < 1_000_000)
    station, model, serial = (*about[1:4], "", "", "")[:3]
    return Toa5(tuple(samples), station, model, serial, tuple(broken), missing, chosen.notes)


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


def _columns(
    names: list[str], asked: Mapping[str, str] | None, source: str | Path
) -> dict[str, int]:
    """Return the column index of each quantity.

    Raises InputError for missing or ambiguous columns.
    """
    columns: dict[str, int] = {}
    asked = asked or {}
    for quantity, usual in _USUAL.items():
        if quantity in asked:
            matches = [i for i, name in enumerate(names) if name == asked[quantity]]
        else:
            matches = [
                i
                for i, name in enumerate(names)
                if name not in asked.values() and re.sub(r"[^a-z]", "", name.lower()) in usual
            ]
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
    if lost := [name for q, name in asked.items() if q not in columns]:
        raise InputError(
            source,
            f"no column {', '.join(lost)}",
            f"one of {', '.join(names)}",
            "correct the name after --column",
        )
    if not any(q.endswith("_wm2") for q in columns):
        raise InputError(
            source,
            f"no known column of irradiance among {', '.join(names)[:120]}",
            "a column of irradiance",
            "choose it: --column ghi_wm2=NAME",
        )
    return columns


def _sample(
    row: list[str], names: list[str], chosen: LoggerColumns, utc_offset: timedelta
) -> IrradianceSample:
    stamp = row[names.index("TIMESTAMP")]
    if not _TIME.fullmatch(stamp):
        raise ValueError(f"{stamp[:30]!r} is not a time")
    t_utc = datetime.fromisoformat(stamp).replace(tzinfo=UTC) - utc_offset
    return sample_of(t_utc, chosen.values(row), chosen.raw(row))


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
    if quantity.endswith("_wm2") and not LOWEST_WM2 <= value <= HIGHEST_WM2:
        raise ValueError(f"{quantity} is {value:.6g}, expected {LOWEST_WM2:g} to {HIGHEST_WM2:g}")
    return value
