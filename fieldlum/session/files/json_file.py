"""Read JSON objects strictly; write them so that an interruption leaves the old or the new file."""

from __future__ import annotations

import json
import types
import typing
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, fields, is_dataclass
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from fieldlum.core.errors import InputError, input_errors
from fieldlum.core.records import JsonTable, parse_utc
from fieldlum.core.strict_toml import build
from fieldlum.session.digests import change_of, sealed
from fieldlum.session.writing import replacing

T = TypeVar("T")


def read_object(path: Path, expected: str, remedy: str) -> JsonTable:
    """Return the JSON object of a file; warn if it changed after `write_sealed`.

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


def check_format(table: Mapping[str, Any], newest: int, path: Path) -> int:
    """Return the value of a file's key `format`, 1 if absent.

    newest: the highest version that is accepted. Raises InputError for a version that is not an
    integer from 1 to `newest`.
    """
    version = table.get("format", 1)
    if isinstance(version, int) and 1 <= version <= newest:
        return version
    remedy = "restore the file, or write it again"
    if isinstance(version, int) and version > newest:
        remedy = "read the file with a newer fieldlum"
    raise InputError(
        path,
        f"a file of format {version}",
        f"format 1 to {newest}",
        remedy,
    )


def build_known(cls: type[T], table: Mapping[str, Any], where: str) -> T:
    """Build a frozen dataclass from its keys, strictly; ignore other keys, which are additions.

    where: the file, for the error. Raises InputError for a missing key or a value of the wrong
    type.
    """
    names = {field.name for field in fields(cls)}  # type: ignore[arg-type]
    return build(cls, {key: value for key, value in table.items() if key in names}, where)


@contextmanager
def content_of(
    table: Mapping[str, Any], newest: int, path: Path, expected: str, remedy: str
) -> Iterator[None]:
    """Turn errors within the `with` block that converts a file's content into InputError.

    These are KeyError, TypeError, ValueError, AttributeError and ArithmeticError. Raises InputError
    also for a format version that is not an integer from 1 to `newest`.
    """
    check_format(table, newest, path)
    wrong = (KeyError, TypeError, ValueError, AttributeError, ArithmeticError)
    with input_errors(path, expected, remedy, *wrong):
        yield


def from_json(cls: type[T], table: Mapping[str, Any]) -> T:
    """Build a frozen dataclass from a JSON object; convert each value to the type of its field.

    Other keys are additions and are ignored. Null counts as absent; an absent field gets its
    default, or None if its type allows that. A nested dataclass with a method `from_table` is built
    by that method. Raises KeyError for an absent field without these, TypeError or ValueError for a
    value that cannot be converted.
    """
    values: dict[str, Any] = {}
    for name, hint, has_default in _fields_of(cls):
        if table.get(name) is not None:
            values[name] = _converted(hint, table[name])
        elif not has_default:
            if type(None) not in typing.get_args(hint):
                raise KeyError(name)
            values[name] = None
    return cls(**values)


def to_json(record: Any) -> JsonTable:
    """Return a dataclass as a JSON object, as the inverse of `from_json`.

    A nested object with a method `table` is stored as that method returns it.
    """
    return {field.name: _as_json(getattr(record, field.name)) for field in fields(record)}


def _as_json(value: Any) -> Any:
    if is_dataclass(value):
        table = getattr(value, "table", None)
        return to_json(value) if table is None else table()
    if isinstance(value, Mapping):
        return {key: _as_json(inner) for key, inner in value.items()}
    return [_as_json(inner) for inner in value] if isinstance(value, list | tuple) else value


@cache
def _fields_of(cls: type[Any]) -> list[tuple[str, Any, bool]]:
    """Return name, type, and whether there is a default, of each field."""
    hints = typing.get_type_hints(cls)
    return [
        (f.name, hints[f.name], f.default is not MISSING or f.default_factory is not MISSING)
        for f in fields(cls)
    ]


def _converted(hint: Any, value: Any) -> Any:
    """Return a JSON value as the type `hint`.

    An empty text or object is None if the type allows it.
    """
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        inner = next(a for a in arguments if a is not type(None))
        return None if value is None or value in ("", {}) else _converted(inner, value)
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise TypeError(f"{value!r} is not a list")
        kinds = arguments[:1] * len(value) if arguments[-1] is ... else arguments
        return tuple(_converted(kind, item) for kind, item in zip(kinds, value, strict=True))
    if origin in (dict, Mapping) or is_dataclass(hint):
        if not isinstance(value, Mapping):
            raise TypeError(f"{value!r} is not an object")
        if origin is None:
            kind = typing.cast(type[Any], hint)
            return kind.from_table(value) if hasattr(kind, "from_table") else from_json(kind, value)
        return {str(key): _converted(arguments[1], item) for key, item in value.items()}
    if hint is datetime:
        return parse_utc(value)
    return value if hint is Any else hint(value)


def write_object(path: Path, table: Mapping[str, object]) -> None:
    """Write a JSON object; arrays become lists, and values of unknown types become text."""
    with replacing(path, "w", encoding="utf-8") as file:
        json.dump(table, file, indent=1, ensure_ascii=False, default=_plain)


def write_sealed(path: Path, table: Mapping[str, object]) -> None:
    """Write a JSON object as `write_object` does, with its sha256 in NAME.sha256."""
    with sealed(path):
        write_object(path, table)


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else str(value)
