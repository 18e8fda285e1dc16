"""Define the states of a room with which captures can be marked: lamps, blinds, tint, snow.

A state is text such as ``lamp=on;blind=half``; an empty text is the usual room (lamps off, blinds
up, clear glass, no snow). Lamps add light; the other words change the room's response to daylight,
or, as use=no, leave a capture out.
"""

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.errors import did_you_mean

STATE_VALUES = {
    "lamp": ("off", "on"),
    "blind": ("up", "half", "down"),
    "tint": ("clear", "half", "full"),
    "snow": ("no", "yes"),
    "use": ("yes", "no"),
}
"""Words of a state and their values; the first value of each is the usual one and is omitted."""

LAMP_WORD = "lamp"  # the word for light that does not follow the daylight
COVER_WORDS = ("blind", "tint")  # the words for what changes the view of the sky
LAMP_OFF = "lamp=off"  # in a prediction, it also switches off a lamp that is always on
USAGE = ", ".join(f"{word}={'|'.join(values)}" for word, values in STATE_VALUES.items())


def parse_state(text: str) -> tuple[str, ...]:
    """Return the unusual parts of a state, sorted by word, such as ("blind=half", "lamp=on").

    text: parts ``word=value`` separated by semicolons. Parts with their usual value (lamp=off,
    blind=up, snow=no) are omitted, so the result is empty for a usual room. Raises ValueError for a
    word or a value that is not in STATE_VALUES, or for a repeated word.
    """
    values = sorted(_values(text).items())
    return tuple(f"{word}={value}" for word, value in values if value != STATE_VALUES[word][0])


def is_lit(text: str) -> bool:
    """Return whether a lamp is on in a state. Raises ValueError as `parse_state` does."""
    return any(part.startswith(LAMP_WORD) for part in parse_state(text))


def cover_state(text: str) -> str:
    """Return the unusual parts of a state that change the view of the sky, such as "blind=half".

    Several parts (of blind and tint) are separated by semicolons; "" without any. Raises ValueError
    as `parse_state` does.
    """
    return ";".join(part for part in parse_state(text) if part.startswith(COVER_WORDS))


def without_lamps(text: str) -> str:
    """Return the unusual parts of a state with which a capture is not of the usual room.

    Several parts (of blind, snow, tint and use) are separated by semicolons. Raises ValueError as
    `parse_state` does.
    """
    return ";".join(part for part in parse_state(text) if not part.startswith(LAMP_WORD))


def _values(text: str) -> dict[str, str]:
    """Return the value of each word in a state such as "blind=half; lamp=on".

    Raises ValueError for an unknown word or value, and for a word that is stated twice.
    """
    values: dict[str, str] = {}
    for part in filter(None, (piece.strip() for piece in text.split(";"))):
        word, _, value = (piece.strip() for piece in part.partition("="))
        if value not in STATE_VALUES.get(word, ()) or word in values:
            states = (f"{name}={option}" for name in STATE_VALUES for option in STATE_VALUES[name])
            raise ValueError(f"'{part}' is not a state of a room{did_you_mean(part, states)}")
        values[word] = value
    return values


def merged_state(text: str, change: str) -> str:
    """Return the state `text`, such as ``lamp=on;blind=half``, with the parts of `change`.

    A word in `change` replaces the same word in `text`; other words remain. Parts with their usual
    value are omitted. Raises ValueError for an unknown word or value in either text.
    """
    merged = _values(text) | _values(change)
    return ";".join(parse_state(";".join(f"{word}={value}" for word, value in merged.items())))


def indicators(states: tuple[str, ...], columns: tuple[str, ...]) -> Floats:
    """Return a table [states, columns]: 1 where the state has the part of the column, else 0.

    states: texts such as ``lamp=on;blind=half``; columns: one unusual part each, such as "lamp=on".
    Raises ValueError as `parse_state` does.
    """
    rows = [[float(part in parse_state(text)) for part in columns] for text in states]
    return np.array(rows, float).reshape(len(states), len(columns))
