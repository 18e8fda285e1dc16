"""Read TOML strictly: an unknown key, a wrong type or a missing value is an error."""

from __future__ import annotations

import math
import tomllib
import types
import typing
from dataclasses import MISSING, asdict, fields, is_dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Literal, TypeVar

from fieldlum.core.errors import InputError

T = TypeVar("T")
TomlTable = dict[str, Any]
"""A table of a TOML file, as `tomllib` reads it."""

# bytes; the largest file of fieldlum has some kB, but /dev/zero has no end; chosen
_MAX_BYTES = 4_000_000


def build(cls: type[T], table: TomlTable, where: str) -> T:
    """Build the dataclass `cls` from a TOML table, and check every key and value by its type hints.

    Nested dataclasses, tuples and Literals are built and checked too. A key that is not in the
    table gets the field's default. where: name of the file or table, for errors. Raises InputError
    for an unknown key, a missing key without a default, and a value of another type.
    """
    by_name = {f.name: f for f in fields(cls)}  # type: ignore[arg-type]
    hints = typing.get_type_hints(cls)
    for key in table:
        if key not in by_name:
            near = get_close_matches(key, by_name, n=1)
            hint = (
                f"did you mean '{near[0]}'?"
                if near
                else f"known keys: {', '.join(sorted(by_name))}"
            )
            raise InputError(where, f"unknown key '{key}'", remedy=hint)
    for name, f in by_name.items():
        if name not in table and f.default is MISSING and f.default_factory is MISSING:
            raise InputError(
                where, f"no '{name}'", f"a value for '{name}'", "add this key with its value"
            )
    return cls(
        **{key: _value(hints[key], value, f"{where} [{key}]") for key, value in table.items()}
    )


def _value(hint: Any, value: Any, where: str) -> Any:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        if value is None and type(None) in arguments:
            return None
        return _value(next(a for a in arguments if a is not type(None)), value, where)
    if hint is typing.Any:
        return value
    if origin is Literal:
        if value not in arguments:
            expected = "one of " + ", ".join(map(str, arguments))
            raise InputError(where, f"the value {value!r}", expected, "correct the value")
        return value
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise InputError(where, f"the value {value!r}", "a list", "correct the value")
        inner = arguments[0] if len(arguments) == 2 and arguments[1] is Ellipsis else None
        if inner is None and len(value) != len(arguments):
            raise InputError(
                where,
                f"{len(value)} values",
                f"{len(arguments)} values",
                "correct the number of values in the list",
            )
        return tuple(
            _value(inner or arguments[i], v, f"{where} #{i + 1}") for i, v in enumerate(value)
        )
    if origin is dict:
        if not isinstance(value, dict):
            raise InputError(where, f"the value {value!r}", "a table", "correct the value")
        return {str(k): _value(arguments[1], v, f"{where}.{k}") for k, v in value.items()}
    if is_dataclass(hint):
        if not isinstance(value, dict):
            raise InputError(where, f"the value {value!r}", "a table", "correct the value")
        return build(typing.cast(type, hint), value, where)
    if hint is float:
        if (
            isinstance(value, bool)
            or not isinstance(value, int | float)
            or not math.isfinite(value)
        ):
            raise InputError(where, f"the value {value!r}", "a finite number", "correct the value")
        return float(value)
    if isinstance(hint, type) and (
        not isinstance(value, hint) or (hint is int and isinstance(value, bool))
    ):
        expected = {int: "an integer", str: "text", bool: "true or false"}[hint]
        raise InputError(where, f"the value {value!r}", expected, "correct the value")
    return value


def read_toml(path: Path) -> TomlTable:
    """Return the content of a TOML file as nested dicts.

    Raises InputError if the file is missing, over 4 MB, not UTF-8, or not TOML.
    """
    try:
        with path.open("rb") as file:
            data = file.read(_MAX_BYTES + 1)
        if len(data) > _MAX_BYTES:
            raise InputError(
                path,
                f"more than {_MAX_BYTES / 1e6:.0f} MB",
                "a TOML file",
                "check the path of the file",
            )
        # Editors of Windows write a byte order mark before the text.
        return tomllib.loads(data.decode("utf-8-sig").replace("\r\n", "\n"))
    except OSError as error:
        raise InputError(
            path, error.strerror or str(error), "a readable TOML file", "check the path of the file"
        ) from None
    except UnicodeDecodeError as error:
        raise InputError(
            path,
            f"byte {error.object[error.start]:#04x}, which is not UTF-8",
            "TOML in UTF-8",
            "save it again with the encoding UTF-8",
        ) from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(
            path, str(error), "TOML", "correct that line: text in quotes, decimals with a point"
        ) from None


def plain(value: Any) -> Any:
    """Return a value in the types of TOML: a dataclass becomes a dict, and a tuple a list.

    This applies at any depth. Fields and dict entries that are None are omitted.
    """
    if is_dataclass(value) and not isinstance(value, type):
        return plain(asdict(value))
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items() if v is not None}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    return value
