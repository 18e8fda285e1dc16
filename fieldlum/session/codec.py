"""Convert the JSON and csv files of a session to frozen records and back, by msgspec.

A file without a format version has version 1, as fieldlum 0.1.0 wrote it. Keys that a record does
not have are ignored, because newer versions may add keys. The SHA-256 of a result is recorded in a
neighbour, NAME.sha256, in the form of `sha256sum`; a file without it is not checked: somebody else
wrote it, or an earlier version.
"""

from __future__ import annotations

import csv
import json
import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, fields
from datetime import datetime
from functools import cache
from io import StringIO
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self, TypeVar, get_type_hints

import msgspec
import numpy as np

from fieldlum.core.arrays import Array
from fieldlum.core.errors import ChangedFileWarning, InputError, input_errors
from fieldlum.core.records import JsonTable, parse_utc, utc_text
from fieldlum.core.strict_csv import plain_rows, read_table
from fieldlum.core.strict_toml import convert
from fieldlum.session.writing import replacing, sha256

T = TypeVar("T")
Utc = Annotated[datetime, msgspec.Meta(tz=True)]
"""A time of a record: text with a time zone in the file."""

# What converting a damaged or foreign file can raise.
_WRONG = (KeyError, TypeError, ValueError, AttributeError, ArithmeticError)


# ----------------------------------------------------------------------------------------------
# digests


@contextmanager
def sealed(path: Path) -> Iterator[None]:
    """Write NAME.sha256 next to a file that is written within the `with` block.

    An interruption leaves a file without neighbour, which is not checked.
    """
    note = _neighbour(path)
    note.unlink(missing_ok=True)
    yield
    with replacing(note, "w", encoding="utf-8") as file:
        file.write(f"{sha256(path)}  {path.name}\n")


def change_of(path: Path) -> str:
    """Return a sentence if a file differs from what its neighbour records, and warn with it.

    Return "" for an unchanged file and for one without a neighbour. The warning is a
    ChangedFileWarning.
    """
    note = _neighbour(path)
    try:
        recorded = note.read_text(encoding="utf-8", errors="replace").split()
    except OSError:
        return ""
    if recorded[:1] == [sha256(path)]:
        return ""
    text = (
        f"{path}: the content changed after fieldlum wrote it; expected the sha256 in {note.name}; "
        f"if you edited it, delete {note.name}, otherwise write {path.name} again"
    )
    warnings.warn(text, ChangedFileWarning, stacklevel=2)
    return text


def _neighbour(path: Path) -> Path:
    return path.with_name(f"{path.name}.sha256")


# ----------------------------------------------------------------------------------------------
# JSON


class JsonFile(msgspec.Struct, frozen=True):
    """A frozen record that is stored as one JSON file; its fields are the file's keys.

    NAME: of the file, if every folder has at most one: readers and `write` then take the folder;
    FORMAT: the newest version; EXPECTED, REMEDY: for errors; SEALED: whether NAME.sha256 is
    written too.
    """

    NAME: ClassVar[str] = ""
    FORMAT: ClassVar[int] = 1
    EXPECTED: ClassVar[str] = ""
    REMEDY: ClassVar[str] = ""
    SEALED: ClassVar[bool] = False

    @classmethod
    def read(cls, place: Path) -> Self:
        """Read a file, or NAME in a folder. Raises InputError if it is missing or differs."""
        if cls.NAME and not (place / cls.NAME).is_file():
            raise InputError(place, f"no {cls.NAME} in this folder", cls.EXPECTED, cls.REMEDY)
        path = place / cls.NAME
        return cls.from_table(read_object(path, cls.EXPECTED, cls.REMEDY), path)

    @classmethod
    def find(cls, place: Path) -> Self | None:
        """Read a file as `read` does; return None if it is missing."""
        return cls.read(place) if (place / cls.NAME).is_file() else None

    @classmethod
    def from_table(cls, table: JsonTable, path: Path) -> Self:
        """Build from a JSON object; null counts as absent. path: for the InputError otherwise."""
        check_format(path, table.get("format", 1), cls.FORMAT)
        with input_errors(path, cls.EXPECTED, cls.REMEDY, *_WRONG):
            stated = _without_empty_times(cls.upgraded(table, path))
            return convert({k: v for k, v in stated.items() if v is not None}, cls)

    @classmethod
    def upgraded(cls, table: JsonTable, path: Path) -> JsonTable:
        """Return the content of a file in the form of the present version."""
        return table

    def table(self) -> JsonTable:
        """Return the JSON object, without its key `format`."""
        return to_json(self)

    def write(self, place: Path) -> None:
        """Write the file, or NAME into a folder."""
        path = place / self.NAME
        write_object(path, {"format": self.FORMAT, **self.table()}, digest=self.SEALED)


def check_format(path: Path, version: object, newest: int) -> None:
    """Raise InputError unless the format version of a file is 1 to `newest`."""
    if not isinstance(version, int) or not 1 <= version <= newest:
        newer = isinstance(version, int) and version > newest
        remedy = "read it with a newer fieldlum" if newer else "restore the file, or write it again"
        raise InputError(path, f"a file of format {version}", f"format 1 to {newest}", remedy)


def to_json(value: object) -> Any:
    """Return a record as the plain values of JSON; arrays and tuples become lists."""
    return _with_lists(msgspec.to_builtins(value, enc_hook=_plain))


def _with_lists(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _with_lists(inner) for key, inner in value.items()}
    return [_with_lists(inner) for inner in value] if isinstance(value, list | tuple) else value


def read_object(path: Path, expected: str, remedy: str) -> JsonTable:
    """Return the JSON object of a file; warn if it changed after it was written with a digest.

    Raises InputError, with the texts `expected` and `remedy`, for a missing file or other content.
    """
    with input_errors(path, expected, remedy, OSError, ValueError, RecursionError):
        table = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(table, dict):
        raise InputError(path, f"JSON of type {type(table).__name__}", expected, remedy)
    change_of(path)
    return table


def _without_empty_times(value: Any) -> Any:
    """Return JSON values without the empty texts in place of times that fieldlum 0.1.0 wrote."""
    if isinstance(value, dict):
        shown = ((k, v) for k, v in value.items() if v != "" or not k.endswith("_utc"))
        return {key: _without_empty_times(inner) for key, inner in shown}
    return [_without_empty_times(inner) for inner in value] if isinstance(value, list) else value


def write_object(path: Path, table: Mapping[str, object], *, digest: bool = False) -> None:
    """Write a JSON object; arrays become lists, and values of unknown types become text.

    digest: write its SHA-256 into NAME.sha256 too.
    """
    if digest:
        with sealed(path):
            return write_object(path, table)
    with replacing(path, "w", encoding="utf-8") as file:
        json.dump(table, file, indent=1, ensure_ascii=False, default=_plain)


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else str(value)


# ----------------------------------------------------------------------------------------------
# csv


def read_rows(
    kind: type[T], path: Path, expected: str, remedy: str, needed: Sequence[str] = ()
) -> list[T]:
    """Return the records in the lines of a csv; see `read_row`.

    expected, remedy: for the InputError of a missing file, or one without the columns `needed`.
    """
    table = read_table(path, expected, remedy, needed=needed)
    return [read_row(kind, path, line, cells, remedy) for line, cells in table.dicts()]


def read_row(kind: type[T], path: Path, line: int, cells: Mapping[str, str], remedy: str) -> T:
    """Build a dataclass from the cells of one csv line, by column name.

    Empty cells get the field's default. line: its number, for the InputError that is raised for a
    wrong or missing value and for a number that is not finite.
    """
    values: dict[str, object] = {}
    for name, (read, expected), has_default in _columns_of(kind):
        text = cells.get(name, "").strip()
        if not text and has_default:
            continue
        try:
            values[name] = read(text)
        except ValueError as error:
            found = str(error) if read is parse_utc else f"{name} is {text[:60]!r}"
            raise InputError(path, f"line {line}: {found}", expected, remedy) from None
    return kind(**values)


def _number(text: str) -> float:
    if not math.isfinite(value := float(text)):
        raise ValueError("not finite")
    return value


def _flag(text: str) -> bool:
    word = text.lower()
    return word in ("true", "yes") or (word not in ("false", "no") and float(word) != 0.0)


_CELLS: dict[Any, tuple[Callable[[str], object], str]] = {
    str: (str, "text"),
    int: (int, "an integer"),
    float: (_number, "a finite number"),
    bool: (_flag, "0 or 1"),
    datetime: (parse_utc, "a UTC time such as 2027-03-20T15:30:00Z"),
}


@cache
def _columns_of(kind: type[Any]) -> list[tuple[str, tuple[Callable[[str], object], str], bool]]:
    """Return name, reader with what it expects, and whether there is a default, of each field."""
    hints = get_type_hints(kind)
    return [(f.name, _CELLS[hints[f.name]], f.default is not MISSING) for f in fields(kind)]


def write_rows(
    path: Path, rows: Iterable[Any], columns: Sequence[str], digits: Mapping[str, str]
) -> None:
    """Write records as a csv that gets its name when it is complete; None and NaN become empty.

    columns: names of fields; digits: format of the floats of a column, such as ".3f".
    """

    def cell(name: str, value: Any) -> str:
        if value is None or value != value:
            return ""
        if isinstance(value, datetime):
            return utc_text(value)
        if isinstance(value, float):
            return format(value, digits.get(name, ""))
        return str(int(value) if isinstance(value, bool) else value)

    with replacing(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows([cell(name, getattr(row, name)) for name in columns] for row in rows)


def read_columns(path: Path, expected: str, remedy: str) -> dict[str, Array]:
    """Return the columns of a large csv without quotation marks, by name; warn if it changed.

    Texts of t_utc become Unix times [s]. An empty cell is NaN. Raises InputError for a missing
    file, another number of cells in a line, and a time that cannot be read.
    """
    import pandas as pd

    text = plain_rows(path, expected, remedy)
    with input_errors(path, expected, remedy, ValueError, KeyError):
        table = pd.read_csv(StringIO(text), keep_default_na=False, na_values=[""])
        when = pd.to_datetime(table["t_utc"], format="ISO8601", utc=True)
        table["t_utc"] = when.to_numpy("datetime64[ns]").astype(np.int64) / 1e9
    change_of(path)
    return {str(name): table[name].to_numpy() for name in table}


def write_columns(path: Path, columns: Mapping[str, Any]) -> None:
    """Write columns as a csv, with its SHA-256 in NAME.sha256; NaN becomes an empty cell.

    t_utc: Unix times [s]. Numbers have seven significant digits.
    """
    import pandas as pd

    when = pd.to_datetime(columns["t_utc"], unit="s", utc=True).round("ms")
    style = "%Y-%m-%dT%H:%M:%SZ" if (when.microsecond == 0).all() else "%Y-%m-%dT%H:%M:%S.%fZ"
    table = pd.DataFrame({**columns, "t_utc": when})
    with sealed(path), replacing(path, "w", newline="", encoding="utf-8") as file:
        table.to_csv(file, index=False, float_format="%.7g", date_format=style, lineterminator="\n")
