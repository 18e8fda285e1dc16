"""Find a facade opposite in the pictures: panes that are dark above the horizon.

Few captures have a sun that is low enough for a facade to hide it, so that sun patches do not show
the facade. Panes do: in overcast hours a facade has 0.2 to 0.5 of the luminance of the sky.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from fieldlum.arrays import Floats, Indices
from fieldlum.light import Light
from fieldlum.models.data import Dataset
from fieldlum.scene.geometry import WALLS
from fieldlum.scene.view import pixel_rays
from fieldlum.scene_fit.exterior import REACH_M, is_outside, opposite
from fieldlum.scene_fit.guess import Guess
from fieldlum.scene_fit.renderer import OUTSIDE, PANE, seen_in_opening, surfaces

# Chosen, not varied. The picture shows the facade's angle, but not its distance: captured patches
# choose, and where they do not, the first of these does. A parapet of a balcony is the nearest one.
_DISTANCES_M = (12.0, 6.0, 24.0, 1.5)
_LEAST_RISE = 0.07  # of the skyline, m for each m away: 4 degrees, more than haze at the horizon
_LEAST_EXTENT = 0.25  # along the wall, m for each m away: 14 degrees
_OVERCAST_SHARE = 0.3  # largest ratio of direct to diffuse light in overcast hours
_LEAST_LX, _LEAST_HOURS = 500.0, 5  # diffuse light of an overcast hour, and number of these hours
_LEAST_CDM2 = 1.0  # of a sky, far below that of any hour with daylight
_DARK_SHARE = 0.6  # of free sky's luminance, below which a pixel shows a facade
_QUANTILE = 0.9  # of overcast hours: a facade is dark in nearly all of them
_LOWEST = 0.02  # height of a unit vector to the sky just above the horizon
_LEAST_COLUMNS = 3  # of the picture, that show the facade
_LEAST_SHARE = 0.8  # of the columns between the facade's ends that show it
_SAME_COST = 1.002  # costs this near do not contradict


@dataclass(frozen=True, slots=True)
class Facade:
    """A facade parallel to a wall, as the camera sees it.

    wall: with the windows that show it. rise: height of the upper edge above the camera, and ends:
    along the wall from the camera, in m for each m away from the camera along the wall's normal.
    goes_on: whether it extends beyond the view at the low and at the high end.
    """

    wall: str
    rise: float
    ends: tuple[float, float]
    goes_on: tuple[bool, bool]


def with_skyline(cost: Callable[[Guess], float], data: Dataset, guess: Guess) -> Guess:
    """Return the guess with a facade opposite each wall whose windows show one.

    cost: of a guess, by captured sun patches, which must not rise. A guess that has something
    outside is returned as it is.
    """
    is_known = any(is_outside(guess, solid) for solid in guess.solids)
    if is_known or len(overcast_hours(data.light)) < _LEAST_HOURS:
        return guess
    for wall in dict.fromkeys(rect.wall for rect in guess.windows):
        facade = facade_seen(data, guess, wall)
        if facade is None:
            continue
        trials = [_with_facade(guess, facade, distance) for distance in _DISTANCES_M]
        costs = [cost(trial) for trial in trials]
        most = _SAME_COST * min(*costs, cost(guess))
        guess = next((t for t, c in zip(trials, costs, strict=True) if c <= most), guess)
    return guess


def overcast_hours(light: Light) -> Indices:
    """Return the hours of day with little direct sun, whose sky is even."""
    overcast = light.direct_lx < _OVERCAST_SHARE * light.diffuse_lx
    return np.flatnonzero(overcast & (light.diffuse_lx > _LEAST_LX))


def facade_seen(data: Dataset, guess: Guess, wall: str) -> Facade | None:
    """Return the facade that a wall's windows show, None for nothing."""
    along, rise, sky, row, column = _panes(data, guess, wall)
    if not (rise > 0.0).any():
        return None
    clear = float(np.quantile(sky[rise > 0.0], 0.75))
    ends, rises = [], []
    for one in np.unique(column):
        rows = np.flatnonzero(column == one)
        rows = rows[np.argsort(rise[rows])]  # upwards
        edge = _upper_edge(rise[rows], row[rows], np.minimum(sky[rows] / clear, 1.0))
        if edge is not None:
            ends.append(float(np.median(along[rows])))
            rises.append(edge)
    order = np.argsort(ends)
    end, height = np.array(ends)[order], np.array(rises)[order]
    shown = np.flatnonzero(height > _LEAST_RISE)
    if len(shown) < _LEAST_COLUMNS:
        return None
    first, last = shown[0], shown[-1]
    is_gapped = len(shown) < _LEAST_SHARE * (last - first + 1)
    if is_gapped or end[last] - end[first] < _LEAST_EXTENT:
        return None
    goes_on = bool(first == 0), bool(last == len(end) - 1)
    ends_seen = float(end[first]), float(end[last])
    return Facade(wall, float(np.median(height[shown])), ends_seen, goes_on)


def _upper_edge(rise: Floats, row: Indices, sky: Floats) -> float | None:
    """Return the rise at which the sky begins in a picture column, 0 for a free horizon.

    None if a bar hides the horizon or the edge, or if no sky is seen. rise: of the column's pixels,
    upwards [k]; row: of the picture [k]; sky: luminance of each over that of free sky, 0 to 1 [k].
    """
    above = int(np.argmax(rise > 0.0))
    open_pixels = np.flatnonzero((rise > 0.0) & (sky > _DARK_SHARE))
    if above == 0 or not len(open_pixels):  # no pane at or below the horizon
        return None
    first = int(open_pixels[0])
    if (np.diff(row[above - 1 : first + 1]) != -1).any():
        return None
    if first == above:
        return 0.0
    step = float(rise[first] - rise[first - 1])
    hidden = (1.0 - float(sky[first])) / max(1.0 - float(sky[first - 1]), _DARK_SHARE)
    return float(rise[first]) - step / 2.0 + min(hidden, 1.0) * step


def _panes(
    data: Dataset, guess: Guess, wall: str
) -> tuple[Floats, Floats, Floats, Indices, Indices]:
    """Return pixels that show a wall's panes: along, rise, luminance over sky, row, column.

    along, rise: offset along the wall and height, in m for each m away from the camera [k];
    luminance over sky: over that of the panes in each overcast hour; nearly the largest of these
    hours, because a cloud is not dark in all; below the horizon over the sky just above it [k].
    """
    height, width = data.shape
    pixel, rays = pixel_rays(height, data.heading_deg, 1)
    axis, side = WALLS[wall]
    numbers = [k for k, rect in enumerate(guess.windows) if rect.wall == wall]
    bars = [replace(b, window=numbers.index(b.window)) for b in guess.bars if b.window in numbers]
    windows = tuple(guess.windows[k] for k in numbers)
    only = replace(guess, windows=windows, bars=tuple(bars))
    ends = surfaces(only, rays.astype(np.float32))
    direction = rays @ guess.camera_turn.T
    shows = (ends.surface == OUTSIDE) & data.seen.ravel()[pixel]
    shows[shows] = seen_in_opening(only, ends.position_m[shows], direction[shows]) == PANE
    toward = direction[shows, axis] * (1.0 if side else -1.0)
    along, rise = (direction[shows, k] / toward for k in (1 - axis, 2))
    hours = overcast_hours(data.light)
    luminance = data.luminance_cdm2.reshape(len(data), -1)[hours]
    above = rays[shows] * (1.0, 1.0, 0.0) + np.maximum(rays[shows], _LOWEST) * (0.0, 0.0, 1.0)
    sky = data.light[hours].sky_at(above / np.linalg.norm(above, axis=1, keepdims=True))
    ratio = luminance[:, pixel[shows]] / np.maximum(sky, _LEAST_CDM2)  # [n, k]
    free = np.ones(len(hours))
    if (rise > 0.0).any():
        free = np.maximum(np.quantile(ratio[:, rise > 0.0], 0.75, axis=1), 1e-6)
    share = np.quantile(ratio.T / free, _QUANTILE, axis=1)
    row, column = np.divmod(pixel[shows].astype(np.intp), width)
    return along, rise, share, row, column


def _with_facade(guess: Guess, facade: Facade, distance_m: float) -> Guess:
    """Return the guess with a facade at a distance from its wall.

    Beyond the view it extends by 40 m, unless windows in other walls may show that it does not.
    """
    axis, side = WALLS[facade.wall]
    eye = guess.camera_m
    away_m = distance_m + abs((guess.size_m[axis] if side else 0.0) - eye[axis])
    low, high = (eye[1 - axis] + end * away_m for end in facade.ends)
    if all(rect.wall == facade.wall for rect in guess.windows):
        low -= REACH_M * facade.goes_on[0]
        high += REACH_M * facade.goes_on[1]
    rect = next(rect for rect in guess.windows if rect.wall == facade.wall)
    solid = opposite(guess, rect, (low, high), distance_m, eye[2] + facade.rise * away_m)
    return replace(guess, solids=(*guess.solids, solid))
