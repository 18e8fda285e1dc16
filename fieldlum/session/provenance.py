"""Record what a result was computed from, and decide whether it must be computed again.

A result has a note, a JSON object that is written after the result's files. Its key `inputs` has
everything that the result depends on, as plain values; large inputs are stored as a digest.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import fields, is_dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.core.records import JsonTable


def made_from(note: Path, inputs: object, outputs: Iterable[Path] = ()) -> JsonTable | None:
    """Return a result's note if it states the same inputs and all files exist, else None.

    note: JSON file that is written after the result, with its inputs under the key `inputs`;
    without that key all of it is the inputs; inputs: plain values that JSON can store; outputs: the
    result's files. A damaged note counts as missing, so that the result is computed again.
    """
    try:
        table = json.loads(note.read_text(encoding="utf-8"))
        recorded = table.get("inputs", table)
    except (OSError, ValueError, AttributeError):
        return None
    same = recorded == json.loads(json.dumps(inputs))
    return table if same and all(path.is_file() for path in outputs) else None


def digest(value: object) -> str:
    """Return the SHA-256 of plain values (those that JSON can store), in hex."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def data_digest(*values: object) -> str:
    """Return the SHA-256 of values in hex; they may be arrays, dataclasses, times or lists.

    Fields of a dataclass with `digest` False in their metadata do not count.
    """
    total = hashlib.sha256()
    for value in values:
        _feed(total, value)
    return total.hexdigest()


def _feed(total: Any, value: object) -> None:
    if isinstance(value, np.ndarray):
        total.update(f"{value.dtype.str} {value.shape}".encode())
        total.update(np.ascontiguousarray(value).reshape(-1).view(np.uint8).data)
    elif is_dataclass(value):
        total.update(type(value).__name__.encode())
        for field in fields(value):
            content = getattr(value, field.name)
            # without a later field, digests of earlier versions stay valid
            is_missing = content is None and "later" in field.metadata
            if field.metadata.get("digest", True) and not is_missing:
                _feed(total, content)
    elif isinstance(value, dict):
        for key in sorted(value, key=str):
            total.update(f"{key}:".encode())
            _feed(total, value[key])
    elif isinstance(value, list | tuple):
        total.update(f"[{len(value)}]".encode())
        for item in value:
            _feed(total, item)
    else:
        text = value.isoformat() if isinstance(value, datetime) else json.dumps(value, default=str)
        total.update(f"{text};".encode())
