"""Queries of instruments without a checksum: an answer counts if a second answer agrees."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations
from typing import TypeVar

from fieldlum.errors import DeviceError

T = TypeVar("T")
ASKED_AT_MOST = 3  # a third answer decides between two that differ (docs/results/parsers.md)


def agreed_answer(
    ask: Callable[[], bytes],
    parse: Callable[[bytes], T],
    apart: Callable[[T, T], float],
    limits: tuple[float, float],
    in_line: Callable[[T, T, T], bool],
) -> tuple[T, tuple[bytes, ...]]:
    """Return the value that the answers agree on, and all answers as received.

    ask : queries the instrument; parse : raises DeviceError for a damaged answer; apart : the
    difference of two values; limits : (noise of the instrument, largest difference that counts as
    agreement), in the unit of `apart`; in_line : whether three values follow an even change.

    Queries twice, and a third time if the two differ by more than the noise. Returns the earlier of
    the two values that are nearest to each other, if they agree; else the middle one of three that
    are `in_line`, because the light was changing. An answer that does not parse agrees with none.
    Raises DeviceError if nothing agrees; errors of `ask` (silence) are raised at once.
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
    raise DeviceError(why if not valid else f"no two answers agree: {shown}")
