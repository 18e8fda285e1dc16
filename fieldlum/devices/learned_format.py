"""Learn the format of a stream of lines: text around numbers, and numbers of decimals.

A damaged line that still reads as a number often differs from the format of all earlier lines: it
has lost decimals, a key, or a zero of its padding. The constant parts of the format are learned
from the stream, so that the user need not state them.
"""

from __future__ import annotations

import re
from collections import Counter, deque
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field

# Number of recent lines that count, and number of lines from which on a part can count as constant.
# Chosen so that a format is known after half a minute to some minutes; effect in
# docs/validation.md.
RECENT = 60
ENOUGH = 20
_NUMBER = re.compile(
    r"(?P<blanks>[ \t]*)(?P<number>[+-]?\d+(?:\.(?P<decimals>\d+))?(?:[eE][+-]?\d{1,2})?)"
)
_PADDED = re.compile(r"[+-]?0\d")


def constant(values: Sequence[Hashable]) -> Hashable | None:
    """Return the value that nearly all of `values` have, or None.

    One value may differ; from 120 values on, one in sixty. None for fewer than 20 values.
    """
    if len(values) < ENOUGH:
        return None
    value, count = Counter(values).most_common(1)[0]
    return value if len(values) - count <= max(1, len(values) // RECENT) else None


@dataclass(slots=True)
class _Number:
    """The forms that the number at one place of the line had in the recent lines."""

    decimals: deque[int] = field(default_factory=lambda: deque(maxlen=RECENT))
    widths: deque[int] = field(default_factory=lambda: deque(maxlen=RECENT))  # with leading blanks
    blanks: deque[int] = field(default_factory=lambda: deque(maxlen=RECENT))
    zero_padded: deque[bool] = field(default_factory=lambda: deque(maxlen=RECENT))  # like 024.1

    @property
    def padded(self) -> bool:
        """Whether the number has a fixed width, by leading zeros or by varying leading blanks."""
        return sum(self.zero_padded) > 1 or constant(self.blanks) is None


@dataclass(slots=True)
class LineForm:
    """The format of the last 60 lines of a stream, against which each new line is checked.

    texts : the text around the numbers, one for each line; numbers : the form of each number, by
    its place in the line (0 is the first).
    """

    texts: deque[str] = field(default_factory=lambda: deque(maxlen=RECENT))
    numbers: dict[int, _Number] = field(default_factory=dict)

    def unlike(self, text: str) -> str:
        """Return how a line differs from the format of earlier lines, or ""; learn from the line.

        The result is "" until a format is known from 20 lines. After a permanent format change, two
        lines are rejected, then the new format is accepted.
        """
        numbers = list(_NUMBER.finditer(text))
        around = re.sub(r"[ \t]+", " ", _NUMBER.sub("#", text))
        usual = constant(self.texts)
        self.texts.append(around)
        if usual not in (None, around):
            return f"the text around its numbers is {around!r}; in earlier lines it is {usual!r}"
        reasons = (self._number(i, match) for i, match in enumerate(numbers))
        reason = next((text for text in reasons if text), "")
        for i, match in enumerate(numbers):
            number = self.numbers.setdefault(i, _Number())
            number.decimals.append(len(match["decimals"] or ""))
            number.widths.append(len(match[0]))
            number.blanks.append(len(match["blanks"]))
            number.zero_padded.append(_PADDED.match(match["number"]) is not None)
        return reason

    def _number(self, i: int, match: re.Match[str]) -> str:
        number, decimals, width = self.numbers.get(i), len(match["decimals"] or ""), len(match[0])
        if number is None:
            return ""
        usual = constant(number.decimals)
        if usual not in (None, decimals):
            return (
                f"number {match['number']} has {decimals} decimals; in earlier lines it has {usual}"
            )
        usual = constant(number.widths) if number.padded else None
        if usual not in (None, width):
            return (
                f"number {match[0]!r} fills {width} characters; in earlier lines it fills {usual}"
            )
        return ""
