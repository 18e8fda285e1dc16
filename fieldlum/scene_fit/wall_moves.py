"""Move one wall of a scene, while all else stays where the camera sees it.

A room's numbers are counted from its west and south wall, so that a search along single numbers
cannot move one of these walls alone; furniture that is not there then takes over its patches.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

from fieldlum.scene.geometry import WALLS
from fieldlum.scene_fit.guess import Bar, Guess, WindowRect
from fieldlum.scene_fit.search import search_moves

_FIRST_M, _LAST_M = 0.08, 0.004  # steps; the last one is that of other lengths. Chosen
_LEAST_M = 0.5  # of a room's width and depth


def with_best_walls(cost: Callable[[Guess], float], guess: Guess) -> Guess:
    """Return the guess of least cost that moves of single walls reach."""
    moves = [(wall, partial(_outwards, wall), _FIRST_M, _LAST_M) for wall in WALLS]
    return search_moves(cost, guess, moves)[0]


def _outwards(wall: str, guess: Guess, by_m: float) -> Guess:
    return with_wall_moved(guess, wall, by_m)


def with_wall_moved(guess: Guess, wall: str, by_m: float) -> Guess:
    """Return the guess with a wall `by_m` further out, and all else at its place from the camera.

    Windows and bars of that wall move with it. A room that would be under 0.5 m wide or deep stays.
    """
    axis, side = WALLS[wall]
    size = list(guess.size_m)
    size[axis] += by_m
    if size[axis] < _LEAST_M:
        return guess
    size_m = (size[0], size[1], size[2])
    if side:
        return replace(guess, size_m=size_m)

    def place(at: tuple[float, float, float]) -> tuple[float, float, float]:
        moved = list(at)
        moved[axis] += by_m
        return moved[0], moved[1], moved[2]

    def span(ends: tuple[float, float]) -> tuple[float, float]:
        return ends[0] + by_m, ends[1] + by_m

    def is_along(rect: WindowRect) -> bool:
        return WALLS[rect.wall][0] != axis

    def window(rect: WindowRect) -> WindowRect:
        return replace(rect, u_m=span(rect.u_m)) if is_along(rect) else rect

    def bar(of: Bar) -> Bar:
        moves = of.upright and is_along(guess.windows[of.window])
        return replace(of, span_m=span(of.span_m)) if moves else of

    return replace(
        guess,
        size_m=size_m,
        camera_m=place(guess.camera_m),
        windows=tuple(window(rect) for rect in guess.windows),
        bars=tuple(bar(b) for b in guess.bars),
        solids=tuple(
            replace(s, low_m=place(s.low_m), high_m=place(s.high_m)) for s in guess.solids
        ),
    )
