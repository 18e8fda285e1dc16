"""Read JSON objects strictly; write them so that a kill leaves the old file or the new one."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

from fieldlum.errors import InputError
from fieldlum.session.writing import replacing
from fieldlum.strict_toml import build

T = TypeVar("T")


def read_object(path: Path, expected: str, remedy: str) -> dict[str, Any]:
    """Return the JSON object of a file. Raises InputError for a missing file or other content."""
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
    return table


def check_format(table: dict[str, Any], newest: int, path: Path) -> int:
    """Return a file's format version, 1 if absent. Raises InputError for a newer one."""
    version = table.get("format", 1)
    if not isinstance(version, int) or not 1 <= version <= newest:
        raise InputError(
            path, f"format {version}", f"format 1 to {newest}", "read it with a newer fieldlum"
        )
    return version


def build_known(cls: type[T], table: dict[str, Any], where: str) -> T:
    """Build a frozen dataclass strictly from its keys; ignore other keys, which are additions.

    Raises InputError for a missing key or a value of the wrong type.
    """
    names = {field.name for field in fields(cls)}  # type: ignore[arg-type]
    return build(cls, {key: value for key, value in table.items() if key in names}, where)


def write_object(path: Path, table: dict[str, Any]) -> None:
    """Write a JSON object; arrays become lists, values of unknown types become text."""
    with replacing(path, "w", encoding="utf-8") as file:
        json.dump(table, file, indent=1, ensure_ascii=False, default=_plain)


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else str(value)
