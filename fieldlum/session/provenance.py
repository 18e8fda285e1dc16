"""Record what a result was computed from, and decide whether it must be computed again.

A result has a note, a JSON object that is written after the result's files. Its key `inputs` has
everything that the result depends on, as plain values; large inputs are stored as a digest.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import msgspec
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
    """Return the SHA-256 of values in hex; they may be arrays, dataclasses, times or lists."""
    packed = msgspec.msgpack.encode(values, enc_hook=_packed, order="sorted")
    return hashlib.sha256(packed).hexdigest()


def _packed(value: Any) -> object:
    if isinstance(value, np.ndarray):
        data = np.ascontiguousarray(value).reshape(-1).view(np.uint8).data
        return value.dtype.str, value.shape, hashlib.sha256(data).digest()
    return value.item() if isinstance(value, np.generic) else str(value)
