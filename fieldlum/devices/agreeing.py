"""Lines without a checksum: ask again at once, and believe only what is said twice."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from fieldlum.errors import DeviceError

T = TypeVar("T")
ASKED_AT_MOST = 3


def said_twice(
    ask: Callable[[], bytes], parse: Callable[[bytes], T], same: Callable[[T, T], bool]
) -> tuple[T, tuple[bytes, ...]]:
    """The earlier of the first two answers that agree, and all answers as they came.

    Two questions, a third where these two do not agree. An answer that does not parse agrees with none. Raises
    DeviceError when no two agree; what `ask` raises (silence) goes through at once.
    """
    answers: list[bytes] = []
    sound: list[T] = []
    why = ""
    for asked in range(ASKED_AT_MOST):
        if asked == ASKED_AT_MOST - 1 and not sound:
            break  # two broken answers: a third has nobody to agree with
        answers.append(ask())
        try:
            now = parse(answers[-1])
        except DeviceError as error:
            why = why or str(error)
            continue
        for before in sound:
            if same(before, now):
                return before, tuple(answers)
        sound.append(now)
    told = ", ".join(repr(answer[:40]) for answer in answers)
    raise DeviceError(why if not sound else f"no two answers agree: {told}")
