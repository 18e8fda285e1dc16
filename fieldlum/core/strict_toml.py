"""Build records from the plain values of TOML and JSON; read TOML strictly.

An unknown key of a TOML table, a wrong type or a missing value is an error.
"""

import json
import math
import re
import tomllib
import typing
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec

from fieldlum.core.errors import InputError, did_you_mean, input_errors, kind_of, require_name
from fieldlum.core.files import read_bytes

T = TypeVar("T")
TomlTable = dict[str, Any]
"""A table of a TOML file, as `tomllib` reads it."""
Positive = Annotated[float, msgspec.Meta(gt=0.0, lt=1e12)]
NotNegative = Annotated[float, msgspec.Meta(ge=0.0)]
Share = Annotated[float, msgspec.Meta(ge=0.0, lt=1.0)]
"""Numbers of a table whose range is checked when it is built."""

# Larger files are refused: the largest of fieldlum has some kB, but /dev/zero has no end. Chosen.
_MAX_BYTES = 4 * 2**20
# Types by msgspec's names, in words for a user.
_WORDS = {
    "float": "a number",
    "int": "an integer",
    "bool": "true or false",
    "str": "text",
    "object": "a table",
    "array": "a list",
}
# By a table that only one kind of file has: the kind, and what to do if it is the wrong one.
_KINDS = {
    "site": ("a SITE.toml", "name the file that fieldlum new wrote"),
    "setup": ("the session.toml of a session", "name its folder"),
    "lens": ("a camera profile", "name a shipped one or a file, as [camera] of SITE.toml does"),
}


def convert(value: object, kind: type[T], *, strict: bool = False) -> T:
    """Return a record of the type `kind`, built from plain values such as those of JSON or TOML.

    strict: whether a text that states a number is refused. Raises ValueError for a missing entry
    and for a value of another type; the error states its place.
    """
    try:
        return msgspec.convert(value, kind, strict=strict)
    except msgspec.ValidationError as error:
        raise ValueError(_reason(str(error), value)) from None


def _reason(text: str, value: Any) -> str:
    """Return what msgspec reports, in words for a user who does not know Python.

    text: of msgspec's error, which ends with the place as `$.key[0].key`; value: in which that
    place is.
    """
    text, _, place = text.partition(" - at `$")
    place = place.rstrip("`").lstrip(".")
    text = re.sub(r"Object missing required field `(.*)`", r"no entry '\1'", text)
    text = re.sub(r"Expected `(?:float|int)` ([<>].*)", r"expected a number \1", text)
    text = re.sub(r"Expected `(.*?)`, got `.*`", lambda m: f"not {_words(m[1])}", text)
    text = re.sub(r"Expected `(.*?)`", lambda m: f"not {_words(m[1])}", text)
    if "..." in place:
        return f"{place.replace('[...]', '')} has a value that is {text}"
    if place and not text.startswith("no entry"):
        for index, key in re.findall(r"\[(\d+)\]|([^.\[\]]+)", place):
            value = value[key or int(index)]
        return f"{place} = {str(value)[:60]!r}, {text}"
    return f"{text} in {place}" if place else text


def _words(kinds: str) -> str:
    """Return types such as "int | null" in words for a user."""
    return " or ".join(_WORDS.get(kind, kind) for kind in kinds.split(" | "))


def build(cls: type[T], table: TomlTable, where: str, *, strict: bool = True) -> T:
    """Return a record of the type `cls`, built from a TOML table; check every key and value.

    Nested dataclasses, tuples and Literals are built and checked too. A key that is not in the
    table gets the field's default. where: name of the file or table, for errors. strict: as
    `msgspec.convert`; with False, a text that states a number is accepted. Raises InputError for an
    unknown key, a missing key without a default, and a value of another type.
    """
    keys = typing.get_type_hints(cls)
    for key in (key for key in _KINDS if key in table and key not in keys):
        any_kind = (f"a file with the tables {', '.join(sorted(keys))}", "name another file")
        expected, remedy = next((kind for name, kind in _KINDS.items() if name in keys), any_kind)
        raise InputError(where, _KINDS[key][0], expected, remedy)
    _check_keys_and_numbers(cls, table, where)
    with input_errors(where, "", "correct the value", ValueError):
        return convert(table, cls, strict=strict)


def _check_keys_and_numbers(hint: Any, value: Any, where: str) -> None:
    """Raise InputError for an unknown key or word, or a number that is not finite, at any depth.

    hint: the type that the value must have; where: the file and the place in it, for the error.
    """
    if isinstance(value, float) and not math.isfinite(value):
        raise InputError(where, f"the value {value}", "a finite number", "correct the value")
    for part in (hint, *(typing.get_args(hint) if isinstance(value, str) else ())):
        if typing.get_origin(part) is typing.Literal:
            require_name(where, value, typing.get_args(part))
    if isinstance(value, list | tuple):
        for number, inner in enumerate(value, start=1):
            _check_keys_and_numbers(hint, inner, f"{where} #{number}")
    if not isinstance(value, dict):
        return
    kind = next((part for part in (hint, *typing.get_args(hint)) if _is_record(part)), None)
    # A table that is no record, such as one by name, can have any key.
    hints = typing.get_type_hints(kind) if kind is not None else dict.fromkeys(value)
    for key, inner in value.items():
        if key not in hints:
            keys = f"known keys: {', '.join(sorted(hints)) or 'none'}"
            remedy = did_you_mean(key, hints).removeprefix("; ") or keys
            raise InputError(where, f"unknown key '{key}'", remedy=remedy)
        _check_keys_and_numbers(hints[key], inner, f"{where} [{key}]")


def _is_record(kind: Any) -> bool:
    """Return whether a type is a dataclass or a Struct of msgspec."""
    return is_dataclass(kind) or hasattr(kind, "__struct_fields__")


def read_toml(path: Path) -> TomlTable:
    """Return the content of a TOML file as nested dicts.

    Raises InputError if the file is missing, over 4 MiB, not UTF-8, not TOML, or nested too deeply.
    """
    with input_errors(path, "a readable TOML file", "check the path of the file", OSError):
        data = read_bytes(path, _MAX_BYTES)
    try:
        # Editors of Windows write a byte order mark before the text, some of a Mac CR alone.
        text = data.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
        table = tomllib.loads(text)
        json.dumps(table, default=str)  # fails at a depth at which other readers fail too
        return table
    except UnicodeDecodeError as error:
        if kind := kind_of(data):
            raise InputError(path, kind, "a TOML file", "check the path of the file") from None
        found = f"byte {error.object[error.start]:#04x}, which is not UTF-8"
        remedy = "save it again with the encoding UTF-8"
        raise InputError(path, found, "TOML in UTF-8", remedy) from None
    except (ValueError, RecursionError) as error:  # ValueError: of numbers with 4300 digits too
        remedy = "correct that line: text in quotes, decimals with a point"
        raise InputError(path, str(error), "TOML", remedy) from None


def plain(value: Any) -> Any:
    """Return a value in the types of TOML, at any depth.

    A dataclass becomes a dict, and a tuple a list. Fields and entries that are None are omitted.
    """
    if is_dataclass(value) and not isinstance(value, type):
        return plain(asdict(value))
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items() if v is not None}
    return [plain(v) for v in value] if isinstance(value, list | tuple) else value
