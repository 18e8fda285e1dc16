"""Find a facade opposite in the pictures: panes that are dark above the horizon.

Few captures have a sun that is low enough for a facade to hide it, so that sun patches do not show
the facade. Panes do: in overcast hours a facade has 0.2 to 0.5 of the luminance of the sky.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from fieldlum.arrays import Floats, Indices
from fieldlum.light import Light
from fieldlum.models.data import Dataset
from fieldlum.scene.geometry import WALLS
from fieldlum.scene.view import pixel_rays
from fieldlum.scene_fit.exterior import REACH_M, is_outside, opposite
from fieldlum.scene_fit.guess import Bar, Guess, WindowRect
from fieldlum.scene_fit.renderer import OUTSIDE, PANE, seen_in_opening, surfaces

# Chosen, not varied. The picture shows the facade's angle, but not its distance: captured patches
# choose, and the nearer one if they do not.
_DISTANCES_M = (6.0, 12.0, 24.0)
_LEAST_RISE = 0.07  # of the skyline, m for each m away: 4 degrees, more than haze at the horizon
_OVERCAST_SHARE = 0.3  # largest ratio of direct to diffuse light in overcast hours
_LEAST_HOURS = 5  # that are overcast
_LEAST_CDM2 = 1.0  # of a sky, far below that of any hour with daylight
_DARK_SHARE = 0.6  # of free sky's luminance, below which a pixel shows a facade
_QUANTILE = 0.9  # of overcast hours: a facade is dark in nearly all of them
_LOWEST = 0.02  # height of a unit vector to the sky just above the horizon
_LEAST_COLUMNS = 3  # of the picture, that show the facade
_LEAST_SHARE = 0.8  # of the columns between the facade's ends that show it
_SAME_COST = 1.002  # costs this near do not contradict


def with_skyline(cost: Callable[[Guess], float], data: Dataset, guess: Guess) -> Guess:
    """Return the guess with a facade opposite each window that shows one.

    cost: of a guess, by captured sun patches, which must not rise. A guess that has something
    outside is returned as it is.
    """
    is_known = any(is_outside(guess, solid) for solid in guess.solids)
    if is_known or len(overcast_hours(data.light)) < _LEAST_HOURS:
        return guess
    for number, rect in enumerate(guess.windows):
        found = _facade(data, guess, number)
        if found is None:
            continue
        rise, ends = found
        trials = [_with_facade(guess, rect, rise, ends, d) for d in _DISTANCES_M]
        least = min(map(cost, trials))
        if least <= _SAME_COST * cost(guess):
            guess = next(trial for trial in trials if cost(trial) <= _SAME_COST * least)
    return guess


def overcast_hours(light: Light) -> Indices:
    """Return the hours with little direct sun, whose sky is even."""
    return np.flatnonzero(light.direct_lx < _OVERCAST_SHARE * light.diffuse_lx)


def _facade(
    data: Dataset, guess: Guess, number: int
) -> tuple[float, tuple[float | None, float | None]] | None:
    """Return what a window shows of a facade parallel to its wall, None for nothing.

    It is the rise of the upper edge, and both ends along the wall, in m for each m away from the
    camera, along the wall's normal. An end is None if the facade extends beyond the view. number:
    of the window, from 0.
    """
    along, rise, sky, column = _panes(data, guess, number)
    clear = float(np.quantile(sky[rise > 0.0], 0.75)) if (rise > 0.0).any() else 0.0
    ends, rises = [], []
    for one in np.unique(column):
        rows = np.flatnonzero((column == one) & (rise > 0.0))
        rows = rows[np.argsort(rise[rows])]  # from the horizon upwards
        shows_horizon = rise[column == one].min() <= 0.0
        if shows_horizon and len(rows) > 1 and (sky[rows] > _DARK_SHARE * clear).any():
            ends.append(float(np.median(along[rows])))
            rises.append(_upper_edge(rise[rows], np.minimum(sky[rows] / clear, 1.0)))
    order = np.argsort(ends)
    end, height = np.array(ends)[order], np.array(rises)[order]
    shown = np.flatnonzero(height > _LEAST_RISE)
    if len(shown) < _LEAST_COLUMNS:
        return None
    first, last = shown[0], shown[-1]
    if len(shown) < _LEAST_SHARE * (last - first + 1):
        return None
    low = None if first == 0 else float(end[first])
    high = None if last == len(end) - 1 else float(end[last])
    return float(np.median(height[shown])), (low, high)


def _upper_edge(rise: Floats, sky: Floats) -> float:
    """Return the rise at which the sky begins, from the pixels of a column above the horizon.

    rise: of the pixels, upwards [k]; sky: luminance of each over that of free sky, 0 to 1 [k].
    """
    first = int(np.argmax(sky > _DARK_SHARE))
    step = rise[1] - rise[0]
    bottom = max(float(rise[first] - step / 2.0), 0.0)
    below = float(sky[first - 1]) if first else 0.0
    hidden = min((1.0 - float(sky[first])) / max(1.0 - below, _DARK_SHARE), 1.0)
    return bottom + hidden * float(rise[first] + step / 2.0 - bottom)


def _panes(data: Dataset, guess: Guess, number: int) -> tuple[Floats, Floats, Floats, Indices]:
    """Return pixels that show a window's panes: along, rise, luminance over sky, column.

    along, rise: offset along the wall and height, in m for each m away from the wall [k];
    luminance over sky: over that of the panes in each overcast hour; nearly the largest of these
    hours, because a cloud is not dark in all; below the horizon over the sky just above it [k].
    """
    height, width = data.shape
    pixel, rays = pixel_rays(height, data.heading_deg, 1)
    axis, side = WALLS[guess.windows[number].wall]
    only = replace(guess, windows=(guess.windows[number],), solids=(), bars=_bars(guess, number))
    ends = surfaces(only, rays.astype(np.float32))
    direction = rays @ guess.camera_turn.T
    shows = (ends.surface == OUTSIDE) & data.seen.ravel()[pixel]
    shows[shows] = seen_in_opening(only, ends.position_m[shows], direction[shows]) == PANE
    toward = direction[shows, axis] * (1.0 if side else -1.0)
    along, rise = (direction[shows, k] / toward for k in (1 - axis, 2))
    light = data.light[overcast_hours(data.light)]
    luminance = data.luminance_cdm2.reshape(len(data), -1)[overcast_hours(data.light)]
    above = rays[shows] * (1.0, 1.0, 0.0) + np.maximum(rays[shows], _LOWEST) * (0.0, 0.0, 1.0)
    sky = light.sky_at(above / np.linalg.norm(above, axis=1, keepdims=True))
    ratio = luminance[:, pixel[shows]] / np.maximum(sky, _LEAST_CDM2)  # [n, k]
    usual = np.quantile(ratio[:, rise > 0.0], 0.75, axis=1) if (rise > 0.0).any() else 1.0
    share = np.quantile(ratio.T / usual, _QUANTILE, axis=1)
    return along, rise, share, (pixel[shows] % width).astype(np.intp)


def _bars(guess: Guess, number: int) -> tuple[Bar, ...]:
    """Return the bars of one window, as bars of window 0."""
    return tuple(replace(bar, window=0) for bar in guess.bars if bar.window == number)


def _with_facade(
    guess: Guess,
    rect: WindowRect,
    rise: float,
    ends: tuple[float | None, float | None],
    distance_m: float,
) -> Guess:
    """Return the guess with the facade of `_facade` at a distance from a window's wall."""
    axis, side = WALLS[rect.wall]
    eye = guess.camera_m
    away_m = distance_m + abs((guess.size_m[axis] if side else 0.0) - eye[axis])
    middle = float(np.mean(rect.u_m))
    low, high = (
        middle + sign * REACH_M if end is None else eye[1 - axis] + end * away_m
        for end, sign in zip(ends, (-1.0, 1.0), strict=True)
    )
    solid = opposite(guess, rect, (low, high), distance_m, eye[2] + rise * away_m)
    return replace(guess, solids=(*guess.solids, solid))
