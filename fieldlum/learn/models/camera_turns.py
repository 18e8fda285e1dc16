"""Estimate the turn of each capture's camera relative to most captures: heading, tilt and roll.

Edges of the room are at the same place in every picture, but shadows and sun patches move.
Therefore the median over captures of the derivatives of ln L contains only the room's edges (Weiss,
"Deriving intrinsic images from image sequences", ICCV 2001). The derivatives of each capture are
compared with this median by least squares on the sphere (Lucas and Kanade 1981) with robust
weights. Then the captures are turned back and the median is computed again. The pose that most
captures share is zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates, maximum_filter, minimum_filter
from scipy.spatial.transform import Rotation

from fieldlum.core.arrays import Array, Floats, Floats32, Mask
from fieldlum.core.records import Progress, quiet
from fieldlum.core.statistics import huber_weights, robust_sigma
from fieldlum.optics.projection import (
    altitude_azimuth_deg,
    equirect_pixel,
    equirect_rays,
    row_altitudes_deg,
    signed_angle_deg,
    wrapped,
)
from fieldlum.optics.turn_fit import Contrasts, fit_turn

MIN_CAPTURES = 5  # fewer captures have no clear majority; not measured
MIN_ROWS = 40  # in smaller pictures an edge is as wide as a wall; not measured
_WORKING_ROWS = 230  # larger pictures are averaged to 230 to 459 rows; chosen
_FLOOR_CDM2 = 0.1  # in darker places edges are noise; chosen
# Smoothing [px], coarse to fine. The first value corrects turns of five pixels; the last is as wide
# as an edge in a rendering. Measured; no command repeats it.
_SMOOTH_PX = (3.0, 1.0, 0.7)
_TILES = (6, 12)  # independent parts of the picture, for the standard errors; not measured
# above it columns are very narrow; below -70 the tripod is in the picture; chosen
_HIGHEST_DEG = 70.0
_EDGES = 0.6  # share of the pixels that is compared, those with the strongest edges; not measured
_MAX_PIXELS = 6000  # most pixels that are compared, to limit the time; not measured
# Most captures, evenly spaced, whose median shows the room's edges, to limit the memory. Chosen.
_MAX_SHOWN = 200
# Light from another direction moves edges a little. In clean captures of the office and of eight
# simulated rooms at 116 x 58 pixels, medians over a day differ from zero by at most 0.03 px in
# heading, 0.13 px in tilt and 0.07 px in roll; 95 % of the single captures by at most 0.06, 0.25
# and 0.24 px; the largest single differences are 0.19, 0.42 and 0.45 px. Measured; no command
# repeats it.
_LIGHT_PX = np.array((0.02, 0.05, 0.04))  # standard uncertainty by this; chosen
# Turns about each axis count in this unit: two to three times the largest of these daily medians. A
# pose of n captures is corrected if it differs by 1 + 1 / sqrt(n) units. Chosen.
TURN_PX = np.array((0.08, 0.25, 0.25))
# Fewer consecutive captures share their light, so their errors are not independent: such a pose
# must differ as much as a single capture. Chosen.
MIN_POSE = 5
# In units squared. A single capture must differ by 3.1 units to count as a separate pose, twelve
# captures by 0.9 units. Chosen.
MOVE_COST = 4.8
# Least correlation of the edges of a turned-back capture with the room's edges, in the median part
# of the picture: edges of a large sun patch are strong, but only in some parts. In four rooms, two
# of them with low suns deep in the room, clean captures have 0.36 to 1; captures shifted by 12 to
# 30 px have at most 0.26, in the office of Liu et al. 2 % of them 0.36. Measured; no command
# repeats it.
MIN_CORRELATION = 0.35
UNKNOWN_TURN_DEG = 180.0  # uncertainty of a turn that the edges do not determine
MAX_TURN_PX = 10.0  # a larger turn is too far for the search to converge; not measured
# Direct light on one side of a window's reveal moves edges, so that a still camera seems to turn in
# the same way on each clear day. The sun's azimuth must predict the change within other days better
# than no effect: by this factor in the sum of absolute deviations. In a room at 70 degrees north
# without a turned camera the factors are 0.48 to 0.68. Chosen above them.
_MAX_LEFT = 0.8
_MIN_LIGHT_DAYS = 3  # two days to learn from, one to confirm; chosen
_MAX_FOLDS = 10  # parts of the days, each predicted from the others; chosen, limits the time
_LIGHT_ROUNDS = 10  # of the robust fit; chosen
_STIFFNESS = 0.02  # of the effect, px^-2: keeps an azimuth without captures near 0; chosen
_NOISE_PX = 0.02  # least residual that counts as usual, the scatter of overcast hours; chosen


@dataclass(frozen=True, slots=True)
class CameraTurns:
    """Turn of each capture's camera relative to the pose that most captures share.

    angles_deg: turn in heading (clockwise positive), tilt (up) and roll (clockwise) [n, 3], zero if
    the camera was not turned or cannot be aligned; u_deg: standard uncertainties of the turns [n,
    3]; aligned: True if the capture can be used: its turn is under 10 pixels, and its picture,
    turned back, has its edges where the room's edges are [n].
    """

    angles_deg: Array
    u_deg: Array
    aligned: Mask

    @property
    def turned(self) -> Mask:
        """Mask [n], True for captures that must be turned back.

        These are aligned captures with a turn that is not zero.
        """
        return self.aligned & self.angles_deg.any(axis=1)


@dataclass(frozen=True, slots=True)
class DirectLight:
    """The direct light of n captures, [n] each.

    share: of direct in global horizontal irradiance, 0 to 1; azimuth_deg: of the sun, clockwise
    from north; day: local standard date.
    """

    share: Floats
    azimuth_deg: Floats
    day: NDArray[Any]


# ----------------------------------------------------------------------------------------------
# geometry


def turned_rays(rays: Array, heading_deg: float, angles_deg: Array | Sequence[float]) -> Array:
    """Return the directions at which a turned camera's panorama shows `rays`, [..., 3].

    rays: unit vectors to what is seen, x east, y north, z up, as the results; heading_deg: azimuth
    of the panorama's centre column; angles_deg: the camera's turn in heading (clockwise positive),
    tilt (up) and roll (clockwise) [3].
    """
    a = np.radians(heading_deg)
    right = (np.cos(a), -np.sin(a), 0.0)
    forward = (np.sin(a), np.cos(a), 0.0)
    axes = np.array(((0.0, 0.0, -1.0), right, forward))
    vector = -np.radians(angles_deg) @ axes
    return rays @ Rotation.from_rotvec(vector).as_matrix().T


def _places(
    shape: tuple[int, int], heading_deg: float, angles_deg: Array | Sequence[float]
) -> Array:
    """Return the row and column at which a turned camera's map shows each pixel, [2, H, W] px."""
    height, width = shape
    rays = turned_rays(equirect_rays(height, width, heading_deg), heading_deg, angles_deg)
    row, column = equirect_pixel(*altitude_azimuth_deg(rays), height, width, heading_deg)
    return np.stack((row - 0.5, column - 0.5))


def _at(maps: Array, places: Array) -> Array:
    """Return a map [H, W] at places [2, H, W], linear between pixels, across the seam."""
    return map_coordinates(
        wrapped(maps), places + np.array((0.0, 1.0))[:, None, None], order=1, mode="nearest"
    )


def turned_back(maps: Array, heading_deg: float, angles_deg: Array | Sequence[float]) -> Array:
    """Return a turned camera's map [H, W] as the camera would show it without the turn, [H, W].

    heading_deg: azimuth of the map's centre column; angles_deg: the camera's turn in heading, tilt
    and roll [3], as in `CameraTurns`. Interpolation is linear between pixels. Pass ln L, so that a
    bright window does not spread over its frame.
    """
    height, width = maps.shape
    return _at(maps, _places((height, width), heading_deg, angles_deg))


def interpolation_u(maps: Array, heading_deg: float, angles_deg: Array | Sequence[float]) -> Array:
    """Return the standard uncertainty that interpolation in `turned_back` causes, [H, W].

    maps: one map [H, W], ln L or another quantity, whose unit the result has. A turn by a fraction
    f of a pixel mixes neighbours in the picture, and turning it back mixes them again. What remains
    is f (1 - f) times the range of values among the 3 x 3 neighbours.
    """
    height, width = maps.shape
    places = _places((height, width), heading_deg, angles_deg)
    part = places - np.floor(places)
    mixed = (part * (1.0 - part)).max(axis=0)
    wide = wrapped(maps)
    contrast = (maximum_filter(wide, 3) - minimum_filter(wide, 3))[:, 1:-1]
    return mixed * _at(contrast, places)


# ----------------------------------------------------------------------------------------------
# comparison with the room's edges


def _edges_of(logs: Array, heading_deg: float, angles_deg: Array, smooth_px: float) -> Floats32:
    """Return the derivatives, by row and by column, of a smoothed map that is turned back first."""
    logs = turned_back(logs, heading_deg, angles_deg) if angles_deg.any() else logs
    modes = ("nearest", "wrap")
    smooth = gaussian_filter(logs, smooth_px, mode=modes, truncate=3.0)  # pyright: ignore[reportArgumentType]
    across = (np.roll(smooth, -1, axis=1) - np.roll(smooth, 1, axis=1)) / 2.0
    return np.stack((np.gradient(smooth, axis=0), across)).astype(np.float32)


class _RoomEdges:
    """The room's edges at the m pixels where they are strongest, and how a turn changes them."""

    def __init__(self, edges: Array, seen_mask: Mask, heading_deg: float) -> None:
        height, width = seen_mask.shape
        strength = np.hypot(edges[0], edges[1])
        inside = seen_mask & (np.abs(row_altitudes_deg(height))[:, None] < _HIGHEST_DEG)
        pixels = np.flatnonzero(inside & (strength >= np.quantile(strength[inside], 1.0 - _EDGES)))
        self.pixels = pixels[:: -(-len(pixels) // _MAX_PIXELS)]  # [m]
        self.values = self.at_pixels(edges)  # [2 m]
        row, column = np.divmod(self.pixels, width)
        tile = row * _TILES[0] // height * _TILES[1] + column * _TILES[1] // width
        # each derivative of a tile has its own contrast
        both = np.concatenate((tile, tile + tile.max() + 1))
        self.tiles = np.unique(both, return_inverse=True)[1]  # [2 m]
        slopes = np.stack([np.stack(np.gradient(edge)) for edge in edges])  # [2, 2, H, W]
        moves = _motion_px((height, width), heading_deg)
        changes = [-(slopes * move).sum(axis=1) for move in moves]
        self.changes = np.stack([self.at_pixels(change) for change in changes], axis=1)  # [2 m, 3]
        # Less weight for edges of high contrast, which move with the light: a bright window spreads
        # over its frame.
        usual = np.median(np.abs(self.values))
        self.weights = 1.0 / (self.values**2 + 4.0 * usual**2)

    def at_pixels(self, edges: Array) -> Array:
        """Return the values [2 m] of maps [2, H, W] at the chosen pixels."""
        return edges.reshape(2, -1)[:, self.pixels].ravel().astype(float)

    def turn(self, edges: Array) -> tuple[Array, Array, float]:
        """Return the turn that moves the room's edges to those of a capture.

        These are the turn [3] deg, its standard errors [3] deg, and the correlation of the edges in
        the median tile.
        """
        values = self.at_pixels(edges)
        contrasts = Contrasts(self.values, self.tiles)  # of the edges in each tile
        fit = fit_turn(self.changes, values, self.tiles, weights=self.weights, contrasts=contrasts)
        turn, covariance = fit or (np.zeros(3), np.full((3, 3), UNKNOWN_TURN_DEG**2))
        both, own, room = (
            np.bincount(self.tiles, product)
            for product in (values * self.values, values**2, self.values**2)
        )
        correlation = float(np.median(both / np.sqrt(np.maximum(own * room, 1e-24))))
        return turn, np.sqrt(np.diag(covariance)), correlation


def _motion_px(shape: tuple[int, int], heading_deg: float) -> Array:
    """Return how far a turn of one degree moves each pixel (row, column), [3, 2, H, W]."""
    height, width = shape
    rays = equirect_rays(height, width, heading_deg)
    moves = []
    for axis in np.eye(3):
        low, high = (
            altitude_azimuth_deg(turned_rays(rays, heading_deg, half * axis))
            for half in (-0.5, 0.5)
        )
        rows = (low[0] - high[0]) * height / 180.0
        columns = signed_angle_deg(high[1] - low[1]) * width / 360.0
        moves.append((rows, columns))
    return np.array(moves)


def _smaller(luminance_cdm2: Floats, seen_mask: Mask) -> tuple[Floats32, Mask]:
    """Return ln L of maps [n, h, w] and seen pixels [h, w] at the working size."""
    step = max(1, luminance_cdm2.shape[1] // _WORKING_ROWS)
    if luminance_cdm2.shape[1] % step or luminance_cdm2.shape[2] % step:
        step = 1
    height, width = (size // step for size in seen_mask.shape)
    logs = np.empty((len(luminance_cdm2), height, width), np.float32)
    for k, image in enumerate(luminance_cdm2):
        log = np.log(np.maximum(image, _FLOOR_CDM2))
        logs[k] = log.reshape(height, step, width, step).mean(axis=(1, 3))
    return logs, np.asarray(seen_mask.reshape(height, step, width, step).all(axis=(1, 3)))


def camera_turns(
    luminance_cdm2: Floats,
    seen_mask: Mask,
    heading_deg: float,
    *,
    light: DirectLight | None = None,
    progress: Progress = quiet,
) -> CameraTurns:
    """Return how the camera of each capture was turned relative to most captures.

    luminance_cdm2: panoramas in the order of time, without NaN [n, H, W]; seen_mask: True for
    pixels with a value [H, W]; heading_deg: azimuth of the centre column. light: their direct
    light; what it explains is not a turn (`turns_by_light`); None if it is unknown. Consecutive
    captures of one pose get their median turn; a turn too small to be certain is zero. With fewer
    than 5 captures or 40 rows of pixels, or if nothing was seen, all turns are zero and all
    captures count as aligned. The time grows with the captures alone.
    """
    count, height = luminance_cdm2.shape[:2]
    angles, u_deg, correlation = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros(count)
    if count < MIN_CAPTURES or height < MIN_ROWS or not seen_mask.any():
        return CameraTurns(angles, u_deg, np.ones(count, bool))
    logs, seen_mask = _smaller(luminance_cdm2, seen_mask)
    shown = np.unique(np.linspace(0, count - 1, min(count, _MAX_SHOWN)).round().astype(int))
    for k, smooth_px in enumerate(_SMOOTH_PX):
        progress(k, len(_SMOOTH_PX), "comparing the camera's poses")
        stored = {int(i): _edges_of(logs[i], heading_deg, angles[i], smooth_px) for i in shown}
        median = np.median(np.stack(list(stored.values())), axis=0)
        room = _RoomEdges(median, seen_mask, heading_deg)
        for i in range(count):
            edges = stored.get(i)
            if edges is None:
                edges = _edges_of(logs[i], heading_deg, angles[i], smooth_px)
            turn, u_deg[i], correlation[i] = room.turn(edges)
            angles[i] += turn
        angles -= np.median(angles, axis=0)
    pixel_deg = 180.0 / seen_mask.shape[0]
    u_deg = np.hypot(u_deg, _LIGHT_PX * pixel_deg)
    near = np.abs(angles).max(axis=1) < MAX_TURN_PX * pixel_deg
    aligned = (correlation >= MIN_CORRELATION) & near
    if light is not None:
        angles = angles - pixel_deg * turns_by_light(angles / pixel_deg, light)
    poses = _poses(angles, aligned, pixel_deg)
    # Rounded to four decimals as in the table, so that reading the table gives identical maps.
    return CameraTurns(np.round(poses, 4), np.round(u_deg, 4), aligned)


# ----------------------------------------------------------------------------------------------
# poses


def turns_by_light(angles_px: Array, light: DirectLight) -> Floats:
    """Return the part of apparent turns [n, 3] that the sun's azimuth explains, in pixels.

    angles_px: heading, tilt and roll of each capture [n, 3], in pixels. The median of each day is
    zero, so that only changes within a day are explained. An axis is zero unless days are predicted
    from the other ones.
    """
    out = np.zeros_like(angles_px)
    days, day = np.unique(light.day, return_inverse=True)
    if len(days) < _MIN_LIGHT_DAYS:
        return out
    azimuth = np.radians(light.azimuth_deg)
    waves = [wave(k * azimuth) for k in (1, 2) for wave in (np.cos, np.sin)]
    basis = light.share[:, None] * np.stack(waves, axis=1)  # [n, 4]
    fold = day % min(_MAX_FOLDS, len(days))

    def within_days(values: Floats) -> Floats:
        return values - np.array([np.median(values[day == k]) for k in range(len(days))])[day]

    for axis, values in enumerate(angles_px.T):
        rest = values.copy()
        for k in np.unique(fold):
            inside, others = fold == k, fold != k
            rest[inside] -= basis[inside] @ _effect(basis[others], values[others], day[others])
        if np.abs(within_days(rest)).sum() <= _MAX_LEFT * np.abs(within_days(values)).sum():
            # the level of a day may be a turn: it is not touched
            out[:, axis] = within_days(basis @ _effect(basis, values, day))
    return out


def _effect(basis: Floats, values: Floats, day: NDArray[np.intp]) -> Floats:
    """Return the coefficients of `basis` [n, k] by a robust fit; each day has its own pose, [k].

    The poses are not unknowns of the fit: weighted means of each day are subtracted from both sides
    (Frisch and Waugh 1933), so that the time grows with the captures alone.
    """
    columns = np.column_stack((basis, values))
    weights, solution = np.ones(len(values)), np.zeros(basis.shape[1])
    for _ in range(_LIGHT_ROUNDS):
        total = np.bincount(day, weights)
        sums = np.stack([np.bincount(day, weights * c) for c in columns.T], axis=1)
        within = columns - (sums / np.maximum(total, 1e-9)[:, None])[day]
        design, target = within[:, :-1], within[:, -1]
        normal = design.T @ (weights[:, None] * design) + _STIFFNESS * np.eye(len(solution))
        solution = np.linalg.solve(normal, design.T @ (weights * target))
        rest = target - design @ solution
        weights = huber_weights(rest, robust_sigma(rest, 0.0) + _NOISE_PX)
    return solution


def _poses(angles: Array, aligned: Mask, pixel_deg: float) -> Array:
    """Return one turn for all captures of a pose [n, 3]; zero for an uncertain one.

    A camera stays as it is until it is moved. So the order of time is cut into poses by the least
    sum of squares plus MOVE_COST for each cut (Potts model, by dynamic programming).
    """
    out = np.zeros_like(angles)
    rows = np.flatnonzero(aligned)
    unit = TURN_PX * pixel_deg
    pieces = _pieces(angles[rows] / unit)
    counts = [stop - start for start, stop in pieces]
    poses = np.array([np.median(angles[rows[start:stop]], axis=0) for start, stop in pieces])
    poses -= np.median(np.repeat(poses, counts, axis=0), axis=0)  # of most captures
    for (start, stop), pose in zip(pieces, poses, strict=True):
        size, count = np.abs(pose) / unit, stop - start
        # in units of TURN_PX; a short pose counts as a single capture, for which two cuts pay
        least = np.sqrt(2.0 * MOVE_COST) if count < MIN_POSE else 1.0 + 1.0 / np.sqrt(count)
        if size.max() >= least:
            out[rows[start:stop]] = np.where(size < 1.0, 0.0, pose)
    return out


def _pieces(values: Array) -> list[tuple[int, int]]:
    """Return the first row and the row after the last of each piece of `values`, [n, k]."""
    count = len(values)
    sums = np.concatenate((np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)))
    squares = np.concatenate(((0.0,), np.cumsum((values**2).sum(axis=1))))
    best, before = np.zeros(count + 1), np.zeros(count + 1, int)
    for stop in range(1, count + 1):
        length = stop - np.arange(stop)
        spread = squares[stop] - squares[:stop]
        spread = spread - ((sums[stop] - sums[:stop]) ** 2).sum(axis=1) / length
        costs = best[:stop] + spread + MOVE_COST
        before[stop] = int(np.argmin(costs))
        best[stop] = costs[before[stop]]
    pieces, stop = [], count
    while stop > 0:
        pieces.append((int(before[stop]), stop))
        stop = int(before[stop])
    return pieces[::-1]
