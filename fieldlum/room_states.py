"""Define the states of a room with which captures can be marked: lamps, blinds, snow.

A state is text such as ``lamp=on;blind=half``; an empty text is the usual room (lamps off, blinds
up, no snow). Lamps add light; the other words change the room's response to daylight.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

KNOWN = {"lamp": ("off", "on"), "blind": ("up", "half", "down"), "snow": ("no", "yes")}
"""Words and their values; the first value of each is the usual one and is not written."""

ADDED = "lamp"  # the word for light that does not follow the daylight
OFF = "lamp=off"  # in a prediction, it also switches off a lamp that is always on
USAGE = ", ".join(f"{word}={'|'.join(values)}" for word, values in KNOWN.items())


def parse_state(text: str) -> tuple[str, ...]:
    """Return the unusual parts of a state in a fixed order, such as ("blind=half", "lamp=on").

    Raises ValueError for a word or a value that is not in KNOWN, or for a repeated word.
    """
    parts: dict[str, str] = {}
    for part in filter(None, (piece.strip() for piece in text.split(";"))):
        word, _, value = (piece.strip() for piece in part.partition("="))
        if word not in KNOWN or value not in KNOWN[word] or word in parts:
            raise ValueError(f"'{part}' is not a state of a room; known: {USAGE}")
        parts[word] = value
    return tuple(
        f"{word}={value}" for word, value in sorted(parts.items()) if value != KNOWN[word][0]
    )


def state_text(parts: Iterable[str]) -> str:
    """Join the parts of a state, sorted, with semicolons; the inverse of `parse_state`."""
    return ";".join(sorted(parts))


def merged_state(text: str, change: str) -> str:
    """Return the state `text`, such as ``lamp=on;blind=half``, with the values in `change`.

    A word with its usual value is not in the result. Raises ValueError as `parse_state`.
    """
    parse_state(change)
    words = {part.partition("=")[0].strip() for part in change.split(";") if part.strip()}
    unchanged = [part for part in parse_state(text) if part.partition("=")[0] not in words]
    return state_text((*unchanged, *parse_state(change)))


def indicators(states: tuple[str, ...], columns: tuple[str, ...]) -> NDArray[np.float64]:
    """Return 1 where a state has the part of a column, such as "lamp=on", else 0, [n, columns]."""
    rows = [[float(part in parse_state(text)) for part in columns] for text in states]
    return np.array(rows, float).reshape(len(states), len(columns))
