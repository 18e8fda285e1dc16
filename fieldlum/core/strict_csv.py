"""Read tables that other programs write; report each damaged line, never guess its values.

Every csv reader uses this module, so that the same damage has the same error everywhere.
"""

import codecs
import csv
import math
import re
import unicodedata
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path

from fieldlum.core.errors import InputError, input_errors, kind_of
from fieldlum.core.files import read_bytes
from fieldlum.core.records import parse_time

Line = tuple[int, str]
"""The number of a line in its file, from 1, and its text."""

# Share of zero bytes above which a file is no text: UTF-16 without its mark has about half, a text
# with a damaged block has few. Chosen.
_MAX_ZERO_BYTES = 0.25
# A value outside is an error. Every hourly mean of a real sky is inside: the solar constant is 1361
# W/m2, cloud edges add to it, and a thermopile's night offset is a few W/m2 below zero.
IRRADIANCE_LIMITS_WM2 = (-10.0, 1600.0)
# Causes of a wrong number of cells, or of a wrong number, as parts of an error's text.
COMMAS = ", because numbers have decimal commas"
THOUSANDS = ", because numbers have commas between thousands"
POINTS = ", because other numbers have decimal commas"
# Two cells of one number with a decimal comma, such as 12 and 5, in cells joined by line ends.
_DECIMAL_PAIR = re.compile(r"(?:^|\n)[+-]?\d+\n\d+(?=\n|$)")
_WITH_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}(\.\d*)?")  # 1,234.5
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?")
# Texts of a missing value in loggers, spreadsheets and databases, without minus signs and case.
_NO_VALUE = {"", "nan", "na", "n/a", "#n/a", "null", "none", "inf"}
# Numbers that mean a missing value, none of them an irradiance: EPW 9999, TMY3 -9900, SolarAnywhere
# -999, SURFRAD -9999.9, climate stations -99 and -99.9, Campbell 6999 and 7999 (their
# documentation).
_MISSING = {s * m for s in (-1.0, 1.0) for m in (9999.0, 99999.0, 999999.0, 6999.0, 7999.0)} | {
    *(-9900.0, -9999.9, -999.9, -999.0, -99.99, -99.9, -99.0)
}
_YEAR_FIRST = re.compile(r"(\d{4})([/.-])(\d{1,2})\2(\d{1,2})(?=[ T]|$)")  # 2027/3/20
_COMPACT = re.compile(r"^((?:19|20)\d\d)(\d\d)(\d\d)(\d\d)(\d\d)$")  # 202703201600
_UNIX = re.compile(r"(1\d{9})(\d{3}|\d{6}|\d{9})?")  # seconds since 1970, and decimals of a second
# Days of a spreadsheet from 1982 to 2119, in its system that begins in 1900 (ECMA-376, 18.17.4.1).
_SERIAL_DAY = re.compile(r"([3-7]\d{4})(?:[.,](\d+))?")
# A time of day such as 4:00:00 pm: hour, minutes with seconds, and the letter of AM or PM.
_HOUR = re.compile(r"(?<=\d[ T])(\d{1,2})((?::\d\d){1,2})(?: ?([AaPp])\.?(?:[Mm]\.?)?$)?")
_LOGGER_SERIAL = re.compile(r"\(LGR S/N: [^()]*\)$")  # as HOBOware writes it into headings
# Spellings that are left after `is_wm2` has simplified a unit; \ufffd and ? are a damaged "²".
_WM2 = {"w/m2", "wm-2", "wm2", "w/m-2", "w/m\ufffd", "w/m?"}
_MICROVOLTS = {"v": 1e6, "mv": 1e3, "uv": 1.0, "µv": 1.0, "μv": 1.0}


# ----------------------------------------------------------------------------------------------
# text


def read_text(path: Path, expected: str, remedy: str = "check the path") -> str:
    """Return the text of a file in UTF-8, UTF-16 with its mark, or a Western 8-bit encoding.

    expected, remedy: texts for errors. Raises InputError for a file that cannot be read, and for a
    file that is no text; the error states its kind, such as a PDF.
    """
    with input_errors(path, expected, remedy, OSError, MemoryError):
        data = read_bytes(path)
    if kind := kind_of(data):
        raise InputError(path, kind, expected, "name the right file, or export it as csv")
    utf16 = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    for encoding in ("utf-16",) if utf16 else ("utf-8-sig", "cp1252", "latin-1"):
        with suppress(UnicodeDecodeError):
            text = data.decode(encoding)
            break
    else:
        raise InputError(path, "damaged UTF-16 text", expected, "save it again as UTF-8")
    if text.count("\0") > _MAX_ZERO_BYTES * len(text):
        found = "a binary file, or UTF-16 without its byte order mark"
        raise InputError(path, found, expected, "save it as UTF-8")
    return text


def lines_of(text: str) -> list[str]:
    """Return the lines of a text with line ends of any system.

    A cell with a line end in quotation marks is not supported: it gives two lines.
    """
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    return lines[:-1] if lines[-1] == "" else lines


def numbered(lines: Iterable[str], first: int = 1) -> list[Line]:
    """Return the lines that are neither empty nor comments (#), with their numbers in the file.

    first: number of the first of `lines`. A line such as ``sep=,``, which some spreadsheets need,
    is skipped too, and comments that they wrote in quotes.
    """
    return [
        (number, line)
        for number, line in enumerate(lines, start=first)
        if line.strip()[:1] not in ("", "#") and not line.startswith(("sep=", '"# '))
    ]


# ----------------------------------------------------------------------------------------------
# rows


@dataclass(frozen=True, slots=True)
class CsvTable:
    """The content of a csv file.

    path: of the file; names: of the columns; rows: the number of each row's line in the file, from
    1, and its cells, as many as names; separator: between cells, such as a comma.
    """

    path: Path
    names: tuple[str, ...]
    rows: tuple[tuple[int, tuple[str, ...]], ...]
    separator: str = ","

    def dicts(self) -> list[tuple[int, dict[str, str]]]:
        """Return the line number and the cells by column name of each row."""
        return [(line, dict(zip(self.names, cells, strict=True))) for line, cells in self.rows]


def split_row(line: str, separator: str = ",", *, padded: bool = True) -> list[str]:
    """Return the cells of a line; padded: whether to remove spaces around them.

    Raises ValueError for a quotation mark without its counterpart.
    """
    if '"' not in line:
        cells = line.split(separator)
    else:
        rows = csv.reader([line], delimiter=separator, strict=True, skipinitialspace=padded)
        try:
            cells = next(rows)
        except csv.Error:
            raise ValueError("a quotation mark without its counterpart") from None
    return [cell.strip() for cell in cells] if padded else cells


def split_header(path: Path, line: Line, separator: str = ",") -> list[str]:
    """Return the cells of a header line; path: of the file, for errors.

    Raises InputError for a quotation mark without its counterpart, and for columns that are
    separated by other marks than the commas that are expected.
    """
    if separator == "," and "," not in line[1] and (other := re.search(r"[;\t|]", line[1])):
        remedy = "save it as CSV with commas between and points in the numbers"
        raise InputError(path, f"columns separated by {other[0]!r}", "commas", remedy)
    where, remedy = f"{path}: line {line[0]}", "correct that line"
    with input_errors(where, "a line of names", remedy, ValueError):
        return split_row(line[1], separator)


def split_rows(
    path: Path, lines: Iterable[Line], count: int | None = None, separator: str = ","
) -> list[tuple[int, tuple[str, ...]]]:
    """Return the number and the cells of each line; path: of the file, for errors.

    count: number of cells that a line must have; None for that of most lines. Raises InputError,
    with the first such line, for another number of cells and for a quotation mark without its
    counterpart.
    """
    rows = []
    for number, line in lines:
        try:
            rows.append((number, tuple(split_row(line, separator))))
        except ValueError as error:
            found, expected = f"line {number}: {error}", "paired quotation marks"
            raise InputError(path, found, expected, "correct that line") from None
    if count is None:
        count = Counter(len(cells) for _, cells in rows).most_common(1)[0][0] if rows else 0
    wrong = [row for row in rows if len(row[1]) != count]
    if wrong:
        line, cells = wrong[0]
        others = f" (and {len(wrong) - 1} more such lines)" if len(wrong) > 1 else ""
        cause = surplus_cause(cells, count, [cells for _, cells in rows if len(cells) == count])
        found = f"line {line}: {len(cells)} cells{cause}{others}"
        remedy = "correct that line, or write the file again"
        remedy = "write numbers with a point and without commas" if cause else remedy
        raise InputError(path, found, f"{count} cells, one for each column", remedy)
    return rows


def plain_rows(path: Path, expected: str, remedy: str) -> str:
    """Check the rows of a csv; return its lines as a text, without comments (#) and empty lines.

    All lines must have as many cells as the first one, and no quotation marks. This is as strict as
    `split_rows`, but fast for a million rows. expected, remedy: texts for errors. Raises InputError
    with the first wrong line, or if the file cannot be read.
    """
    lines = numbered(lines_of(read_text(path, expected, remedy)))
    commas = lines[0][1].count(",") if lines else 0
    for number, line in lines:
        if line.count(",") != commas or '"' in line:
            cells = f"{commas + 1} cells without quotation marks"
            raise InputError(path, f"line {number}: {line[:60]!r}", cells, remedy)
    return "\n".join(line for _, line in lines)


def surplus_cause(cells: Sequence[str], count: int, right: Sequence[Sequence[str]] = ()) -> str:
    """Return why a row has more than `count` cells: `COMMAS`, `THOUSANDS`, or "" if unknown.

    cells: of the row; right: cells of other rows, with the right count. Commas separate decimals
    (`COMMAS`) if the row has no empty cell, has for each surplus cell a pair of integers such as 12
    and 5, and either no row of `right` has a decimal point, or at least as many decimal points are
    missing, compared with `right`, as cells are surplus. Else they separate thousands if there is
    for each surplus cell a pair such as 1 and 234.5.
    """
    if len(cells) > 3 * count:  # a number has at most two commas
        return ""
    if _has_decimal_commas(cells, count, right):
        return COMMAS
    pairs = sum(bool(_WITH_THOUSANDS.fullmatch(f"{a},{b}")) for a, b in pairwise(cells))
    return THOUSANDS if 0 < len(cells) - count <= pairs else ""


def _has_decimal_commas(cells: Sequence[str], count: int, right: Sequence[Sequence[str]]) -> bool:
    """Return whether a row with more than `count` cells can have decimal commas.

    Its surplus cells are then decimals after an integer, and it has no decimal points where rows of
    `count` cells (`right`) have them.
    """
    surplus, pairs = len(cells) - count, len(_DECIMAL_PAIR.findall("\n".join(cells)))
    points = max((sum("." in cell for cell in row) for row in right), default=0)
    missing = points - sum("." in cell for cell in cells)
    return 0 < surplus <= pairs and "" not in cells and (points == 0 or missing >= surplus)


def read_table(
    path: Path, expected: str, remedy: str, *, needed: Sequence[str] = (), separators: str = ","
) -> CsvTable:
    """Return the header and the rows of a csv without comments (#) and empty lines.

    expected, remedy: texts for errors. needed: names of required columns. separators: those that
    are allowed; the first of them that the header contains is used. Empty columns at the right,
    which spreadsheets write, are left out. Raises InputError for a file that cannot be read, a
    missing or repeated column, a cell below an empty name, and what `split_rows` refuses.
    """
    lines = numbered(lines_of(read_text(path, expected, remedy)))
    if not lines:
        raise InputError(path, "an empty file", expected, remedy)
    separator = next((mark for mark in separators if mark in lines[0][1]), ",")
    names = split_header(path, lines[0], separator)
    if missing := [name for name in needed if name not in names]:
        raise InputError(path, f"no column {', '.join(missing)}", expected, remedy)
    check_names(path, names)
    rows = split_rows(path, lines[1:], len(names), separator)
    width = max((number for number, name in enumerate(names, start=1) if name), default=0)
    for line, cells in rows:
        if any(cells[width:]):
            found = f"line {line}: a cell without a column name"
            raise InputError(path, found, "a name", "name its column")
    named = tuple((line, cells[:width]) for line, cells in rows)
    return CsvTable(path, tuple(names[:width]), named, separator)


def check_names(path: Path, names: Sequence[str]) -> None:
    """Raise InputError for a column name that occurs twice; empty names may.

    path: of the file, for the error.
    """
    counts = Counter(name for name in names if name)
    if repeated := [name for name, count in counts.items() if count > 1]:
        found = f"{counts[repeated[0]]} columns named {repeated[0]}"
        raise InputError(path, found, "each name once", "rename or remove one of the columns")


# ----------------------------------------------------------------------------------------------
# cells


def read_number(text: str, *, has_codes: bool = True) -> float:
    """Return the number in a cell, in the column's unit; NaN for a text that means a missing value.

    has_codes: whether numbers such as -9999 are missing values too; they are not in voltages.
    Raises ValueError for another text.
    """
    if text.lstrip("-").lower() in _NO_VALUE:
        return math.nan
    if not _NUMBER.fullmatch(text):
        raise ValueError(f"is '{text[:30]}'")
    value = float(text)
    return math.nan if has_codes and value in _MISSING else value


def read_time(text: str, *, utc: bool = False) -> datetime:
    """Return the time in a cell; utc: whether a time without a zone is in UTC, else it stays naive.

    A date may have slashes or points and no zeros (2027/3/20), an hour AM or PM, or 24:00 for the
    end of the day, and the zone may be the word UTC or GMT. Twelve digits are a time without marks
    (202703201600), ten or more the seconds, ms, us or ns since 1970 in UTC, five and decimals the
    days of a spreadsheet (46101.25). Raises ValueError for another text and for a date without a
    time of day.
    """
    if unix := _UNIX.fullmatch(text):
        return datetime.fromtimestamp(float(f"{unix[1]}.{unix[2] or 0}"), UTC)
    if serial := _SERIAL_DAY.fullmatch(text):
        part_s = round(86400.0 * float(f"0.{serial[2] or 0}"))
        t = datetime(1899, 12, 30, tzinfo=UTC) + timedelta(days=int(serial[1]), seconds=part_s)
        return t if utc else t.replace(tzinfo=None)
    stated = re.sub(" ?(UTC|GMT)$", "Z", _COMPACT.sub(r"\1-\2-\3 \4:\5", text))
    stated = _YEAR_FIRST.sub(lambda date: f"{date[1]}-{date[3]:0>2}-{date[4]:0>2}", stated)
    plain = re.sub("(?<=[ T])24:00(:00)?$", "00:00", stated)
    try:
        t = parse_time(_HOUR.sub(_iso_hour, plain)) + timedelta(days=plain != stated)
    except (ValueError, OverflowError):
        raise ValueError(f"time {text[:30]!r}, expected one like 2027-03-20T16:00:00Z") from None
    if len(text) <= len("2027-03-20"):
        raise ValueError(f"{text!r} is a date without a time of day")
    return t.replace(tzinfo=UTC) if utc and t.tzinfo is None else t


def _iso_hour(time: re.Match[str]) -> str:
    """Return a time of day with an hour of 00 to 23; the text itself for an hour such as 13 PM.

    time: match of `_HOUR`.
    """
    hour, half = int(time[1]), (time[3] or "").lower()  # half of the day: "a", "p" or ""
    if half and not 1 <= hour <= 12:
        return time[0]
    return f"{hour % 12 + 12 * (half == 'p') if half else hour:02d}{time[2]}"


def split_heading(heading: str) -> tuple[str, str]:
    """Return the name and the unit of a column heading such as ``DNI (W/m^2)`` or ``dni_wm2``.

    Without a unit of irradiance or voltage, return the heading and "".
    """
    name, unit = _in_brackets(heading)
    if unit:
        return (name, unit) if is_unit(unit) else (heading.strip(), "")
    heading = _LOGGER_SERIAL.sub("", heading)
    words = re.split(r"[\s_]+", heading.strip())
    # The longest ending that is a unit: "Watts per square meter" has four words.
    for start in range(max(len(words) - 4, 1), len(words)):
        if is_unit(unit := " ".join(words[start:])):
            return " ".join(words[:start]).rstrip(","), unit
    return heading.strip(), ""


def stated_unit(heading: str) -> str:
    """Return the unit of a heading, also one of another quantity such as kJ/m2; "" without one."""
    _, in_brackets = _in_brackets(heading)
    return in_brackets if "/" in in_brackets else split_heading(heading)[1]


def _in_brackets(heading: str) -> tuple[str, str]:
    """Return the name and the text in brackets of ``NAME (TEXT)``; "" and "" for other headings."""
    inner = _LOGGER_SERIAL.sub("", heading).strip().rstrip(")]} \t")
    start = max(inner.rfind(mark) for mark in "([{") + 1  # 0 without a bracket
    text = inner[start:].strip()
    is_last = start > 0 and not set(")]}") & set(text)
    return (inner[: start - 1].rstrip(" _\t"), text) if is_last else ("", "")


def is_unit(text: str) -> bool:
    """Return whether a text is a unit of irradiance (W/m2) or of voltage."""
    return is_wm2(text) or microvolts(text) is not None


def is_wm2(unit: str) -> bool:
    """Return whether a unit is W/m2, in any of its spellings, such as "Watts per sq. meter"."""
    text = unit.lower().translate(str.maketrans("²⁻−–", "2---"))
    text = unicodedata.normalize("NFKC", text).replace("â", "")  # full width letters and ㎡
    text = re.sub(r"met(?:er|re)s?", "m", re.sub(r"watts?", "w", text))
    text = re.sub(r"(?:square|sq\.?)[\s._]*m", "m2", re.sub(r"\s*\bper\b\s*", "/", text))
    return re.sub(r"[\s^*._·⋅()]", "", text) in _WM2


def microvolts(unit: str) -> float | None:
    """Return how many microvolts a unit of voltage has; None for another unit."""
    return _MICROVOLTS.get(unit.strip().lower())
