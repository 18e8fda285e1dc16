"""Lines without a checksum: ask again at once, and believe only what is said twice."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations
from typing import TypeVar

from fieldlum.errors import DeviceError

T = TypeVar("T")
ASKED_AT_MOST = 3


def said_twice(
    ask: Callable[[], bytes],
    parse: Callable[[bytes], T],
    apart: Callable[[T, T], float],
    limits: tuple[float, float],
    in_line: Callable[[T, T, T], bool],
) -> tuple[T, tuple[bytes, ...]]:
    """What the instrument means, and all its answers as they came.

    Two questions; a third where these two are `apart` by more than limits[0], its noise. Believed
    is the earlier of the two answers nearest to each other, within limits[1]; else the middle one
    of three that lie `in_line`: the light was changing. An answer that does not parse is near none.
    Raises DeviceError when nothing agrees; what `ask` raises (silence) goes through at once.
    """
    answers: list[bytes] = []
    sound: list[T] = []
    why = ""
    while len(answers) < ASKED_AT_MOST and (sound or len(answers) < ASKED_AT_MOST - 1):
        answers.append(ask())
        try:
            sound.append(parse(answers[-1]))
        except DeviceError as error:
            why = why or str(error)
        if len(sound) == len(answers) == 2 and apart(*sound) <= limits[0]:
            break
    pairs = sorted(combinations(sound, 2), key=lambda pair: apart(*pair))
    if pairs and apart(*pairs[0]) <= limits[1]:
        return pairs[0][0], tuple(answers)
    if len(sound) == ASKED_AT_MOST and in_line(sound[0], sound[1], sound[2]):
        return sound[1], tuple(answers)
    told = ", ".join(repr(answer[:40]) for answer in answers)
    raise DeviceError(why if not sound else f"no two answers agree: {told}")
