"""Join searches that saw other pixels: start between their results, and search at more pixels.

Each search ends near the best scene, displaced by the pixels that it saw. Between two such results
the displacements partly cancel, and the mean of their numbers is a start that neither would reach
(decision 41).
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from copy import copy
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import numpy as np

from fieldlum.projection import signed_angle_deg
from fieldlum.scene_fit.evidence import gather
from fieldlum.scene_fit.guess import Bar, Guess, Solid, camera_is_free
from fieldlum.scene_fit.last_search import last_cost, searched_again
from fieldlum.scene_fit.scene_search import SceneSearch

Element = TypeVar("Element", Bar, Solid)

# Elements whose numbers all differ by less are the same one; chosen: half the width of a table.
_SAME_M = 0.25


def joined(
    search: SceneSearch, guess: Guess, others: Sequence[Guess], pixels: int, pool: Executor
) -> Guess:
    """Return the guess of least cost, after searches from `guess` and from means with the others.

    search: of `guess`, the best one until now; it does not change. pixels: number to sample.
    """
    evidence = gather(search.data, search.stated.room, pixels=pixels, seed=pixels)
    evidence = replace(evidence, view=search.evidence.view)
    starts = [guess, *(mean_guess(guess, other) for other in others)]

    def ended(start: Guess) -> tuple[float, Guess]:
        own = copy(search)  # a search changes its evidence
        own.evidence = evidence
        own.relight(start)
        found = searched_again(own, start)
        return last_cost(own, found)(found), found

    starts = [start for start in starts if camera_is_free(start)]
    return min(pool.map(ended, starts), key=lambda pair: pair[0])[1]


def mean_guess(guess: Guess, other: Guess) -> Guess:
    """Return a guess with the mean of both guesses' numbers, and the elements of the first.

    An element without a partner in `other` stays as it is.
    """
    turn_deg = float(signed_angle_deg(other.wall_azimuth_deg - guess.wall_azimuth_deg))
    other = replace(
        other,
        wall_azimuth_deg=guess.wall_azimuth_deg + turn_deg,
        bars=tuple(_partner(bar, other.bars) for bar in guess.bars),
        solids=tuple(_partner(solid, other.solids) for solid in guess.solids),
    )
    return _mean(guess, other)


def _partner(element: Element, others: Sequence[Element]) -> Element:
    """Return the most similar element, or `element` itself if none is similar."""
    alike = [(_distance(element, other), k) for k, other in enumerate(others)]
    distance, k = min(alike, default=(np.inf, 0))
    return others[k] if distance < _SAME_M else element


def _distance(one: Bar | Solid, other: Bar | Solid) -> float:
    """Return the largest difference of two elements' lengths [m]; infinite for other kinds."""
    if isinstance(one, Bar) and isinstance(other, Bar):
        if (one.window, one.upright) != (other.window, other.upright):
            return np.inf
        return float(np.max(np.abs(np.subtract(one.span_m, other.span_m))))
    if isinstance(one, Solid) and isinstance(other, Solid) and one.is_round == other.is_round:
        corners = np.subtract((one.low_m, one.high_m), (other.low_m, other.high_m))
        return float(np.max(np.abs(corners)))
    return np.inf


def _mean(one: Any, other: Any) -> Any:
    """Return the mean of two nested values of the same structure; what is no number stays."""
    if isinstance(one, float):
        return (one + other) / 2.0
    if isinstance(one, tuple):
        return tuple(_mean(a, b) for a, b in zip(one, other, strict=True))
    if is_dataclass(one) and not isinstance(one, type):
        names = [field.name for field in fields(one)]
        means = {name: _mean(getattr(one, name), getattr(other, name)) for name in names}
        return replace(one, **means)
    return one
