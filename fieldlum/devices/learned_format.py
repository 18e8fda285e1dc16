"""The form of a stream of lines, learned from the stream itself: what stands around its numbers,
how they are written.

A damaged line that still reads as a number often lacks the form of all the lines before it: it lost
decimals, a key, a nought of its padding. What is constant in a stream is found here without anybody
stating it.
"""

from __future__ import annotations

import re
from collections import Counter, deque
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field

RECENT, ENOUGH = (
    60,
    20,
)  # lines that count; and how many it takes before anything is called constant
_NUMBER = re.compile(
    r"(?P<blanks>[ \t]*)(?P<number>[+-]?\d+(?:\.(?P<decimals>\d+))?(?:[eE][+-]?\d{1,2})?)"
)
_PADDED = re.compile(r"[+-]?0\d")


def constant(values: Sequence[Hashable]) -> Hashable | None:
    """The value that all of them have but one in sixty; None where there is none, or too few to
    tell.
    """
    if len(values) < ENOUGH:
        return None
    value, count = Counter(values).most_common(1)[0]
    return value if len(values) - count <= max(1, len(values) // RECENT) else None


@dataclass(slots=True)
class _Number:
    """One number's place in the line, over the recent lines."""

    decimals: deque[int] = field(default_factory=lambda: deque(maxlen=RECENT))
    widths: deque[int] = field(
        default_factory=lambda: deque(maxlen=RECENT)
    )  # blanks before it included
    blanks: deque[int] = field(default_factory=lambda: deque(maxlen=RECENT))
    noughts: deque[bool] = field(default_factory=lambda: deque(maxlen=RECENT))  # 024.1

    @property
    def padded(self) -> bool:
        """Whether it is filled to a width: that shows by noughts, or by blanks that come and go."""
        return sum(self.noughts) > 1 or constant(self.blanks) is None


@dataclass(slots=True)
class LineForm:
    """Remembers the last 60 lines that fitted their profile."""

    texts: deque[str] = field(default_factory=lambda: deque(maxlen=RECENT))
    numbers: dict[int, _Number] = field(default_factory=dict)

    def unlike(self, text: str) -> str:
        """How a line differs from what was constant before it, or nothing; the line is then
        remembered.

        A form that changes for good is refused twice and is no exception any more.
        """
        found = list(_NUMBER.finditer(text))
        around = re.sub(r"[ \t]+", " ", _NUMBER.sub("#", text))
        usual = constant(self.texts)
        self.texts.append(around)
        if usual not in (None, around):
            return f"it reads {around!r} around its numbers, usual is {usual!r}"
        said = next((why for i, match in enumerate(found) if (why := self._number(i, match))), "")
        for i, match in enumerate(found):
            known = self.numbers.setdefault(i, _Number())
            known.decimals.append(len(match["decimals"] or ""))
            known.widths.append(len(match[0]))
            known.blanks.append(len(match["blanks"]))
            known.noughts.append(_PADDED.match(match["number"]) is not None)
        return said

    def _number(self, i: int, match: re.Match[str]) -> str:
        known, decimals, width = self.numbers.get(i), len(match["decimals"] or ""), len(match[0])
        if known is None:
            return ""
        usual = constant(known.decimals)
        if usual not in (None, decimals):
            return f"number {match['number']} has {decimals} decimals, usual are {usual}"
        usual = constant(known.widths) if known.padded else None
        if usual not in (None, width):
            return f"number {match[0]!r} fills {width} characters, usual are {usual}"
        return ""
