"""Read and write the JSON, csv and npz files of a session; records are built by msgspec.

A file without a format version has version 1, as fieldlum 0.1.0 wrote it. Keys that a record does
not have are ignored, because newer versions may add keys. The SHA-256 of a result is recorded in a
neighbour, NAME.sha256, in the form of `sha256sum`; a file without it is not checked: somebody else
wrote it, or an earlier version.
"""

import csv
import hashlib
import json
import math
import warnings
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from datetime import UTC, datetime
from functools import cache
from io import StringIO
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self, TypeVar, get_type_hints

import msgspec
import numpy as np
from numpy.lib.npyio import NpzFile

from fieldlum.core.arrays import Array
from fieldlum.core.errors import ChangedFileWarning, InputError, input_errors
from fieldlum.core.files import MAX_ARRAY_BYTES, open_to_read, read_bytes, replacing, sha256
from fieldlum.core.records import JsonTable, parse_utc, utc_text
from fieldlum.core.strict_csv import plain_rows
from fieldlum.core.strict_toml import convert

T = TypeVar("T")
Utc = Annotated[datetime, msgspec.Meta(tz=True)]
"""A time of a record: text with a time zone in the file."""
Seconds = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
"""A duration [s] under 32 years, which can be added to a time."""

# What converting the table of a damaged file, or of one from elsewhere, can raise.
_CONVERSION_ERRORS = (KeyError, TypeError, ValueError, AttributeError, ArithmeticError)


# ----------------------------------------------------------------------------------------------
# digests


@contextmanager
def sealed(path: Path) -> Iterator[None]:
    """Write NAME.sha256 next to the file `path`, after the `with` block, which writes that file.

    If the block raises an error, no checksum file is written. An earlier checksum file is deleted
    first, because a file without one is not checked, and an interruption must not leave a wrong
    one.
    """
    checksum_file = _checksum_file(path)
    checksum_file.unlink(missing_ok=True)
    yield
    with replacing(checksum_file, "w", encoding="utf-8") as file:
        file.write(f"{sha256(path)}  {path.name}\n")


def warn_if_changed(path: Path) -> str:
    """Return a sentence, and warn with it, if a file changed after fieldlum wrote it; else "".

    A file changed if its SHA-256 is not that of its checksum file NAME.sha256; a file without one
    counts as unchanged. The warning is a ChangedFileWarning. Raises OSError if the file has a
    checksum file and cannot be read.
    """
    checksum_file = _checksum_file(path)
    try:
        recorded = read_bytes(checksum_file).decode(errors="replace").split()
    except OSError:
        return ""
    if recorded[:1] == [sha256(path)]:
        return ""
    text = (
        f"{path}: the content changed after fieldlum wrote it; expected the sha256 in "
        f"{checksum_file.name}; if you edited it, delete {checksum_file.name}, otherwise write "
        f"{path.name} again"
    )
    warnings.warn(text, ChangedFileWarning, stacklevel=2)
    return text


def _checksum_file(path: Path) -> Path:
    """Return the path of NAME.sha256, which has the SHA-256 of the file `path`."""
    return path.with_name(f"{path.name}.sha256")


# ----------------------------------------------------------------------------------------------
# what a result was computed from: its note, a JSON object that is written after its files


def current_note(note: Path, inputs: object, outputs: Iterable[Path] = ()) -> JsonTable | None:
    """Return the note of a result that need not be computed again, else None.

    A result need not be computed again if the note states the same inputs and all files exist.
    note: JSON file that is written after the result, with its inputs under the key `inputs`, or as
    all of its content; inputs: plain values that JSON can store; outputs: the result's files. A
    damaged note counts as missing. Warns of a file that changed after it was written, with
    ChangedFileWarning.
    """
    paths = list(outputs)
    try:
        table = json.loads(read_bytes(note))
        recorded = table.get("inputs", table)
    except (OSError, ValueError, AttributeError, RecursionError):
        return None
    is_same = recorded == json.loads(json.dumps(inputs))
    if not is_same or not all(path.is_file() for path in paths):
        return None
    for path in (note, *paths):
        warn_if_changed(path)
    return table


def digest(value: object) -> str:
    """Return the SHA-256 of plain values (those that JSON can store), in hex."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def data_digest(*values: object) -> str:
    """Return the SHA-256 of values in hex; they may be arrays, dataclasses, times or lists.

    An array counts by its type, shape and content, a value of an unknown type by its text.
    """
    packed = msgspec.msgpack.encode(values, enc_hook=_packable, order="sorted")
    return hashlib.sha256(packed).hexdigest()


def _packable(value: Any) -> object:
    """Return what represents a value of another type: of an array its type, shape and digest."""
    if isinstance(value, np.ndarray):
        data = np.ascontiguousarray(value).reshape(-1).view(np.uint8).data
        return value.dtype.str, value.shape, hashlib.sha256(data).digest()
    return value.item() if isinstance(value, np.generic) else str(value)


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
        """Return the record in the file `place`, or in NAME in the folder `place`.

        Warn if the file changed after it was written. Raises InputError for a missing file, a newer
        format and other content.
        """
        path = place / cls.NAME
        return cls.from_table(read_object(path, cls.EXPECTED, cls.REMEDY), path)

    @classmethod
    def find(cls, place: Path) -> Self | None:
        """Return the record as `read` does, with the same errors; None if the file is missing."""
        return cls.read(place) if (place / cls.NAME).is_file() else None

    @classmethod
    def from_table(cls, table: JsonTable, path: Path) -> Self:
        """Return the record in a JSON object of any version of the format; null counts as absent.

        path: of its file. Raises InputError for a newer format and for other content.
        """
        check_format(path, table.get("format", 1), cls.FORMAT)
        with input_errors(path, cls.EXPECTED, cls.REMEDY, *_CONVERSION_ERRORS):
            stated = cls.upgraded(table, path)
            return convert({k: v for k, v in stated.items() if v is not None}, cls)

    @classmethod
    def upgraded(cls, table: JsonTable, path: Path) -> JsonTable:
        """Return the JSON object of a file of any version with the keys of the present version.

        Here it is `table` itself; classes whose keys changed override the method. path: of the
        file, for classes that need its name.
        """
        return table

    def table(self) -> JsonTable:
        """Return the JSON object, without its key `format`."""
        return to_json(self)

    def write(self, place: Path) -> None:
        """Write the file `place`; if the class has a NAME, that file in the folder `place`.

        Raises OSError if it cannot be written.
        """
        write_object(place / self.NAME, {"format": self.FORMAT, **self.table()}, digest=self.SEALED)


def check_format(path: Path, version: object, newest: int) -> None:
    """Raise InputError unless the format version of a file is 1 to `newest`."""
    if not isinstance(version, int) or not 1 <= version <= newest:
        newer = isinstance(version, int) and version > newest
        remedy = "read it with a newer fieldlum" if newer else "restore the file, or write it again"
        raise InputError(path, f"a file of format {version}", f"format 1 to {newest}", remedy)


def to_json(value: object) -> Any:
    """Return a record as the plain values of JSON; arrays and tuples become lists."""
    return json.loads(json.dumps(msgspec.to_builtins(value, enc_hook=plain_value)))


def read_object(path: Path, expected: str, remedy: str) -> JsonTable:
    """Return the JSON object of a file, by its keys; warn if it changed after it was written.

    Only a file with a digest is checked for changes. Raises InputError, with the texts `expected`
    and `remedy`, for a missing file or other content.
    """
    with input_errors(path, expected, remedy, OSError, ValueError, RecursionError, MemoryError):
        table = json.loads(read_bytes(path))
    if not isinstance(table, dict):
        raise InputError(path, f"JSON of type {type(table).__name__}", expected, remedy)
    warn_if_changed(path)
    return table


def write_object(path: Path, table: Mapping[str, object], *, digest: bool = False) -> None:
    """Write a JSON object; arrays become lists, and values of unknown types become text.

    digest: write its SHA-256 into NAME.sha256 too. Raises OSError if it cannot be written.
    """
    seal = sealed(path) if digest else nullcontext()
    # A file name that is not UTF-8 has surrogates; \udcff is also how JSON writes one.
    with seal, replacing(path, "w", encoding="utf-8", errors="backslashreplace") as file:
        json.dump(table, file, indent=1, ensure_ascii=False, default=plain_value)


def plain_value(value: Any) -> Any:
    """Return a value of a type that JSON does not have: an array as lists, others as text."""
    return value.tolist() if hasattr(value, "tolist") else str(value)


# ----------------------------------------------------------------------------------------------
# csv


def read_row(kind: type[T], where: str, cells: Mapping[str, str], remedy: str) -> T:
    """Return a dataclass of type `kind`, built from the cells of one csv line, by column name.

    An empty cell gets the field's default. where, remedy: file with line, and what to do, for the
    InputError that is raised for a wrong or missing value and for a number that is not finite.
    """
    with input_errors(where, "", remedy, ValueError):
        values: dict[str, object] = {}
        for name, hint in _hints(kind).items():
            if text := cells.get(name, ""):
                values[name] = parse_utc(text) if hint is datetime else text
                if hint is bool:
                    values[name] = _FLAGS.get(text.lower(), text)
        row = convert(values, kind)
        for name in values:
            if isinstance(value := getattr(row, name), float) and not math.isfinite(value):
                raise ValueError(f"{name} = {value}, not finite")
    return row


_hints = cache(get_type_hints)
_FLAGS = {"yes": True, "1.0": True, "no": False, "0.0": False}  # besides 1, true, 0, false


def read_columns(path: Path, expected: str, remedy: str) -> dict[str, Array]:
    """Return the columns [n] of a large csv without quotation marks, by name; warn if it changed.

    Numbers become numeric arrays, other texts arrays of objects, and the texts of the column t_utc,
    which is required, Unix times [s]. An empty cell is NaN. Raises InputError, with the texts
    `expected` and `remedy`, for a missing file or column t_utc, another number of cells in a line,
    and a time that cannot be read.
    """
    import pandas as pd

    text = plain_rows(path, expected, remedy)
    with input_errors(path, expected, remedy, ValueError, KeyError):
        table = pd.read_csv(StringIO(text), keep_default_na=False, na_values=[""])
        when = pd.to_datetime(table["t_utc"], format="ISO8601", utc=True)
        table["t_utc"] = when.to_numpy("datetime64[ns]").astype(np.int64) / 1e9
    warn_if_changed(path)
    return {str(name): table[name].to_numpy() for name in table}


def write_csv(
    path: Path, rows: Iterable[Mapping[str, Any]], columns: Iterable[str] = (), digits: int = 7
) -> None:
    """Write rows as a csv, which replaces an earlier file when it is complete.

    rows: values by column; None and NaN become empty cells, times UTC texts, and bools 0 or 1.
    columns: names of all columns; empty for the keys of the rows, in the order in which they first
    occur. digits: significant digits of floats.
    """
    if not (names := list(columns)):
        rows = list(rows)
        names = list(dict.fromkeys(key for row in rows for key in row))

    def cell(value: Any) -> str:
        """Return the text of a value: empty for None and NaN, UTC for a time, 0 or 1 for a bool."""
        if value is None or value != value:
            return ""
        if isinstance(value, float):
            return f"{value:.{digits}g}"
        if isinstance(value, datetime):
            return utc_text(value)
        return str(int(value) if isinstance(value, bool) else value)

    with replacing(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(names)
        writer.writerows([cell(row.get(name)) for name in names] for row in rows)


def write_columns(path: Path, columns: Mapping[str, Any], digits: int = 7) -> None:
    """Write arrays [n] as a csv, with its SHA-256 in NAME.sha256.

    columns: arrays by name; among them t_utc, Unix times [s], which are written as ISO texts.
    digits: significant digits of floats.
    """
    times = [datetime.fromtimestamp(t, UTC) for t in columns["t_utc"]]
    lists = [np.asarray(values).tolist() for values in {**columns, "t_utc": times}.values()]
    rows = (dict(zip(columns, cells, strict=True)) for cells in zip(*lists, strict=True))
    with sealed(path):
        write_csv(path, rows, columns, digits)


# ----------------------------------------------------------------------------------------------
# npz

# What a compressed file may expand to besides its own size. Of a model: 0.1.0 compressed its mask
# of seen pixels, and 16 MiB are one of 2 900 x 5 800 pixels. Of pictures: chosen.
MAX_COMPRESSED_BYTES, MAX_PICTURES_BYTES = 16 * 2**20, 2**30
# What reading a damaged or missing file can raise; MemoryError for an impossible shape.
NPZ_ERRORS = (OSError, ValueError, KeyError, EOFError, MemoryError, zipfile.BadZipFile)


@contextmanager
def open_arrays(path: Path, expected: str, remedy: str, newest: int = 1) -> Iterator[NpzFile]:
    """Yield the arrays of an npz file that fieldlum wrote; each is read when it is used.

    newest: version of the format that can be read. Nothing is unpickled. Raises InputError, with
    the texts `expected` and `remedy`, for a missing file, a newer one, and other content.
    """
    errors = input_errors(path, expected, remedy, *NPZ_ERRORS)
    with errors, _stored(path, MAX_PICTURES_BYTES) as stored:
        check_format(path, int(stored["format"]) if "format" in stored else 1, newest)
        yield stored


@contextmanager
def _stored(path: Path, more_bytes: int) -> Iterator[NpzFile]:
    """Yield the arrays of an npz file; raise ValueError if compression hides their size.

    more_bytes: by how much they may be larger than the file itself.
    """
    with open_to_read(path, MAX_ARRAY_BYTES) as file:
        with zipfile.ZipFile(file) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > path.stat().st_size + more_bytes:
            found = f"it is compressed and would fill {size} bytes; expected no compression"
            raise ValueError(found)
        file.seek(0)
        with np.load(file, allow_pickle=False) as stored:
            yield stored


def read_arrays(path: Path) -> dict[str, Array]:
    """Return the arrays of an npz file, of any shape, by name; nothing is unpickled.

    Raises one of `NPZ_ERRORS` for a missing or damaged file, for objects, for compressed arrays
    over 16 MiB, and for values that are not finite.
    """
    with _stored(path, MAX_COMPRESSED_BYTES) as stored:
        arrays = {name: stored[name] for name in stored.files}
    for name, values in arrays.items():
        if not isinstance(values, np.ndarray):  # bytes, of a member in another format
            raise ValueError(f"{name} is no array")
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            raise ValueError(f"{name} has values that are not finite")
    return arrays
