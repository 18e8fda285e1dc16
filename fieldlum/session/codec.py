"""Convert the JSON and csv files of a session to frozen records and back, by msgspec.

A file without a format version has version 1, as fieldlum 0.1.0 wrote it. Keys that a record does
not have are ignored, because newer versions may add keys. The SHA-256 of a result is recorded in a
neighbour, NAME.sha256, in the form of `sha256sum`; a file without it is not checked: somebody else
wrote it, or an earlier version.
"""

from __future__ import annotations

import json
import math
import re
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, fields
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self, TypeVar, get_type_hints

import msgspec

from fieldlum.core.errors import ChangedFileWarning, InputError, input_errors
from fieldlum.core.records import JsonTable, parse_utc, utc_text
from fieldlum.core.strict_csv import read_table
from fieldlum.session.writing import replacing, sha256, write_table

T = TypeVar("T")
Utc = Annotated[datetime, msgspec.Meta(tz=True)]
"""A time of a record: text with a time zone in the file."""

# What converting a damaged or foreign file can raise.
_WRONG = (KeyError, TypeError, ValueError, AttributeError, ArithmeticError)
_WORDS = {
    "float": "a number",
    "int": "an integer",
    "bool": "true or false",
    "str": "text",
    "null": "null",
    "object": "a table",
    "array": "a list",
}
_CELLS = {bool: "0 or 1", int: "an integer", datetime: "a UTC time such as 2027-03-20T15:30:00Z"}
_YES, _NO = ("1", "1.0", "true", "yes"), ("0", "0.0", "false", "no")


def convert(value: object, kind: type[T], *, strict: bool = False) -> T:
    """Build a record from plain values, such as those of JSON or TOML.

    strict: a text is no number. Raises ValueError for a missing entry and for a value of another
    type, with its place.
    """
    try:
        return msgspec.convert(value, kind, strict=strict)
    except msgspec.ValidationError as error:
        raise ValueError(_reason(str(error), value)) from None


def _reason(text: str, value: Any) -> str:
    """Return what msgspec reports, in words for a reader who does not know Python."""
    text, _, place = text.partition(" - at `$")
    place = place.rstrip("`").lstrip(".")
    text = re.sub(r"Object missing required field `(.*)`", r"no entry '\1'", text)
    text = re.sub(r"Expected `(.*?)`, got `.*`", lambda m: f"not {_words(m[1])}", text)
    if "..." in place:
        return f"{place.replace('[...]', '')} has a value that is {text}"
    if place and not text.startswith("no entry"):
        for index, key in re.findall(r"\[(\d+)\]|([^.\[\]]+)", place):
            value = value[key or int(index)]
        return f"{place} = {str(value)[:60]!r}, {text}"
    return f"{text} in {place}" if place else text


def _words(kinds: str) -> str:
    return " or ".join(_WORDS.get(kind, kind) for kind in kinds.split(" | "))


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
        version = table.get("format", 1)
        if not isinstance(version, int) or not 1 <= version <= cls.FORMAT:
            newer = isinstance(version, int) and version > cls.FORMAT
            remedy = "restore the file, or write it again"
            raise InputError(
                path,
                f"a file of format {version}",
                f"format 1 to {cls.FORMAT}",
                "read the file with a newer fieldlum" if newer else remedy,
            )
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
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(path, "no such file", expected, remedy) from None
    except (OSError, ValueError) as error:
        raise InputError(path, f"{error}", expected, remedy) from None
    except RecursionError:
        raise InputError(path, "JSON nested too deeply", expected, remedy) from None
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
    for name, hint, has_default in _columns_of(kind):
        text = cells.get(name, "").strip()
        if not text and has_default:
            continue
        try:
            values[name] = _value(hint, text)
        except ValueError as error:
            found = str(error) if hint is datetime else f"{name} is {text[:60]!r}"
            expected = _CELLS.get(hint, "a finite number")
            raise InputError(path, f"line {line}: {found}", expected, remedy) from None
    return kind(**values)


@cache
def _columns_of(kind: type[Any]) -> list[tuple[str, Any, bool]]:
    """Return name, type, and whether there is a default, of each field."""
    hints = get_type_hints(kind)
    return [(f.name, hints[f.name], f.default is not MISSING) for f in fields(kind)]


def _value(hint: Any, text: str) -> object:
    if hint is datetime:
        return parse_utc(text)
    if hint is bool:
        word = text.lower()
        return word in _YES if word in (*_YES, *_NO) else float(text) != 0.0
    value = msgspec.convert(text, hint, strict=False)
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError("not finite")
    return value


def write_rows(
    path: Path,
    columns: Sequence[str],
    rows: Iterable[object],
    digits: Mapping[str, str],
    *,
    end: str = "\n",
) -> None:
    """Write records as a csv; None and NaN become empty cells.

    columns: names of fields; digits: format of the numbers of a column, such as ".3f"; end: of a
    line.
    """

    def cell(name: str, value: Any) -> str:
        if value is None or (isinstance(value, float) and math.isnan(value)):
            return ""
        if isinstance(value, datetime):
            return utc_text(value)
        return format(int(value) if isinstance(value, bool) else value, digits.get(name, ""))

    cells = ([cell(name, getattr(row, name)) for name in columns] for row in rows)
    write_table(path, columns, cells, end=end)
