"""Join searches that saw other pixels: start between their results, and search at more pixels.

Each search ends near the best scene, displaced by the pixels that it saw. Between two such results
the displacements partly cancel, and the mean of their numbers is a start that neither would reach.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from copy import copy
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import numpy as np

from fieldlum.projection import signed_angle_deg
from fieldlum.scene_fit.bars import is_near
from fieldlum.scene_fit.evidence import gather
from fieldlum.scene_fit.guess import Bar, Guess, Solid, WindowRect, camera_is_free
from fieldlum.scene_fit.last_search import last_cost, refined_numbers
from fieldlum.scene_fit.scene_search import SceneSearch

Element = TypeVar("Element", Bar, Solid)

# Solids whose edges all differ by less are the same one; chosen: half the width of a table.
_SAME_M = 0.25


def joined(
    search: SceneSearch,
    guess: Guess,
    others: Sequence[Guess],
    *,
    pixels: int,
    seed: int,
    pool: Executor,
) -> Guess:
    """Return the guess of least cost, after searches from `guess` and from means with the others.

    search: of `guess`, the best one until now; it does not change. pixels: number to sample; a
    picture with fewer is used completely. seed: of the random pixels.
    """
    evidence = gather(search.data, search.stated.room, pixels=pixels, seed=seed)
    evidence = replace(evidence, view=search.evidence.view)
    means = [mean_guess(guess, other) for other in others]
    starts = [guess, *filter(camera_is_free, means)]

    def ended(start: Guess) -> tuple[float, Guess]:
        own = copy(search)  # a search changes its evidence, which has a store of its own
        own.evidence = replace(evidence)
        own.relight(start)
        end = refined_numbers(own, start)
        return last_cost(own, end)(end), end

    return min(pool.map(ended, starts), key=lambda pair: pair[0])[1]


def mean_guess(guess: Guess, other: Guess) -> Guess:
    """Return a guess with the mean of both guesses' numbers, and the elements of the first.

    An element without a partner in `other` stays as it is, as does the shape of a window that is an
    arch or slanted in one of them only.
    """
    turn_deg = float(signed_angle_deg(other.wall_azimuth_deg - guess.wall_azimuth_deg))
    other = replace(
        other,
        wall_azimuth_deg=guess.wall_azimuth_deg + turn_deg,
        windows=tuple(map(_with_shape, other.windows, guess.windows)),
        bars=_partners(guess.bars, other.bars, is_near),
        solids=_partners(guess.solids, other.solids, _is_same),
    )
    return _mean(guess, other)


def _with_shape(window: WindowRect, shaped: WindowRect) -> WindowRect:
    """Return the window, with the shape of `shaped` if only one of them is an arch or slanted."""
    kinds = [(w.arch_m != 0.0, w.slant_m != 0.0) for w in (window, shaped)]
    if kinds[0] == kinds[1]:
        return window
    return replace(window, arch_m=shaped.arch_m, slant_m=shaped.slant_m)


def _partners(
    elements: Sequence[Element],
    others: Sequence[Element],
    alike: Callable[[Element, Element], bool],
) -> tuple[Element, ...]:
    """Return for each element its partner, or itself without one.

    Two elements are partners if they are alike, and each is the nearest one to the other.
    """
    if not elements or not others:
        return tuple(elements)
    distance = np.array([[_distance_m(a, b) for b in others] for a in elements])  # [e, o]
    nearest, back = distance.argmin(axis=1), distance.argmin(axis=0)
    return tuple(
        others[k] if back[k] == i and alike(element, others[k]) else element
        for i, (element, k) in enumerate(zip(elements, nearest, strict=True))
    )


def _is_same(solid: Solid, other: Solid) -> bool:
    return solid.is_round == other.is_round and _distance_m(solid, other) < _SAME_M


def _distance_m(one: Bar | Solid, other: Bar | Solid) -> float:
    """Return the largest difference of two elements' edges [m]; infinite for bars that cross."""
    if isinstance(one, Bar) and isinstance(other, Bar):
        if (one.window, one.upright) != (other.window, other.upright):
            return np.inf
        return float(np.max(np.abs(np.subtract(one.span_m, other.span_m))))
    assert isinstance(one, Solid) and isinstance(other, Solid)
    corners = np.subtract((one.low_m, one.high_m), (other.low_m, other.high_m))
    return float(np.max(np.abs(corners)))


def _mean(one: Any, other: Any) -> Any:
    """Return the mean of two nested values of the same structure; what is no float stays."""
    if isinstance(one, float):
        return (one + other) / 2.0
    if isinstance(one, tuple):
        return tuple(_mean(a, b) for a, b in zip(one, other, strict=True))
    if is_dataclass(one) and not isinstance(one, type):
        names = [field.name for field in fields(one)]
        means = {name: _mean(getattr(one, name), getattr(other, name)) for name in names}
        return replace(one, **means)
    return one
