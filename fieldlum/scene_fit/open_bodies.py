"""State which furniture may be a top or a complete body, where captures do not show it.

A table's top and a block of the same height have the same sun patches, unless a captured sun shines
below the top. Other hours differ.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from fieldlum.scene_fit.exterior import is_outside
from fieldlum.scene_fit.guess import Guess, Solid

# Change in cost, as a share of it, below which captures do not tell the two apart. In draw 12 it is
# 0.0004 for a table of the gallery whose body no captured sun shows, and 0.17 to 1.9 for six other
# objects. Chosen between these.
_UNCLEAR = 0.005
_ON_FLOOR_M = 0.05  # a body that begins lower reaches the floor; chosen
_TOP_M = 0.15  # largest thickness of a top; chosen
_NEW_TOP_M = 0.05  # thickness of a top that is tried; chosen
_HEIGHTS_M = (0.3, 1.3)  # of what may be a table or a block; chosen


def body_notes(cost: Callable[[Guess], float], guess: Guess, stated: int = 0) -> list[str]:
    """Return a note for each object that may or may not have a body down to the floor.

    cost: of a guess, by captured sun patches; stated: number of solids of the stated room, which
    come first and get no note.
    """
    notes: list[str] = []
    now = cost(guess)
    for number, solid in enumerate(guess.solids):
        is_open = number >= stated and not is_outside(guess, solid)
        other = _other_form(solid) if is_open else None
        if other is None:
            continue
        solids = (*guess.solids[:number], other, *guess.solids[number + 1 :])
        if cost(replace(guess, solids=solids)) - now < _UNCLEAR * now:
            (x0, y0, z0), (x1, y1, z1) = solid.low_m, solid.high_m
            fitted = "a body down to the floor" if z0 < _ON_FLOOR_M else "a top without a body"
            notes.append(
                f"the object at x {x0:.1f} to {x1:.1f} m, y {y0:.1f} to {y1:.1f} m, up to "
                f"{z1:.2f} m, is fitted as {fitted}, but the captures explain the other form as "
                "well: state it as [[room.obstruction]] and fit again"
            )
    return notes


def _other_form(solid: Solid) -> Solid | None:
    """Return a top as a body and a body as a top; None for what is neither."""
    (x, y, low), high = solid.low_m, solid.high_m[2]
    if not _HEIGHTS_M[0] <= high <= _HEIGHTS_M[1]:
        return None
    if low < _ON_FLOOR_M:
        return replace(solid, low_m=(x, y, high - _NEW_TOP_M))
    return replace(solid, low_m=(x, y, 0.0)) if high - low <= _TOP_M else None
