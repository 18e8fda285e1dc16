"""Query instruments whose answers have no checksum: two answers must agree."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations
from typing import TypeVar

from fieldlum.errors import DeviceError

T = TypeVar("T")
ASKED_AT_MOST = 3  # a third answer decides if two differ (docs/results/parsers.md)


def agreed_answer(
    ask: Callable[[], bytes],
    parse: Callable[[bytes], T],
    apart: Callable[[T, T], float],
    limits: tuple[float, float],
    in_line: Callable[[T, T, T], bool],
) -> tuple[T, tuple[bytes, ...]]:
    """Return the value on which answers agree, and all answers as received.

    ask : queries the instrument; parse : raises DeviceError for a damaged answer; apart :
    difference of two values; limits : noise of the instrument, and the largest difference that
    still counts as agreement, in the unit of `apart`; in_line : whether three values in order of
    time are evenly spaced.

    The instrument is queried twice, and a third time if the answers differ by more than the noise
    or exactly one of them is damaged. If two values agree, the earlier of the nearest two is
    returned. Otherwise, if three values are `in_line`, the light was changing and the middle one is
    returned. A damaged answer agrees with no other. Raises DeviceError if neither is the case, or
    at once if `ask` raises it, for example because the instrument is silent.
    """
    answers: list[bytes] = []
    valid: list[T] = []
    why = ""
    while len(answers) < ASKED_AT_MOST and (valid or len(answers) < ASKED_AT_MOST - 1):
        answers.append(ask())
        try:
            valid.append(parse(answers[-1]))
        except DeviceError as error:
            why = why or str(error)
        if len(valid) == len(answers) == 2 and apart(*valid) <= limits[0]:
            break
    pairs = sorted(combinations(valid, 2), key=lambda pair: apart(*pair))
    if pairs and apart(*pairs[0]) <= limits[1]:
        return pairs[0][0], tuple(answers)
    if len(valid) == ASKED_AT_MOST and in_line(valid[0], valid[1], valid[2]):
        return valid[1], tuple(answers)
    shown = ", ".join(repr(answer[:40]) for answer in answers)
    raise DeviceError(
        why if not valid else f"no two answers of the instrument agree: {shown}; check the cable"
    )
