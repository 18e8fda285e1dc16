"""Estimate the turn of each capture's camera relative to most captures, and turn it back.

Edges of the room are at the same place in every picture, but shadows and sun patches move.
Therefore the median over captures of the derivatives of ln L contains only the room's edges (Weiss,
"Deriving intrinsic images from image sequences", ICCV 2001). The derivatives of each capture are
compared with this median by least squares on the sphere (Lucas and Kanade 1981) with robust
weights. Then the captures are turned back and the median is computed again. The pose that most
captures share is zero. Picture files do not change.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates, maximum_filter, minimum_filter
from scipy.spatial.transform import Rotation
from skimage.measure import block_reduce

from fieldlum.core.arrays import Array, Floats, Floats32, Mask, evenly_spread
from fieldlum.core.progress import progress
from fieldlum.core.records import counted, listed
from fieldlum.learn.models.held_out_choice import weight_of_variance
from fieldlum.optics.projection import (
    altitude_azimuth_deg,
    direction,
    equirect_pixel,
    equirect_rays,
    row_altitudes_deg,
    wrapped,
)
from fieldlum.optics.turn_fit import Contrasts, fit_turn

# Smoothing [px], coarse to fine. The first value corrects turns of five pixels; the last is as wide
# as an edge in a rendering. Measured; no command repeats it.
_SMOOTH_PX = (3.0, 1.0, 0.7)
_TILES = (6, 12)  # independent parts of the picture, for the standard errors; not measured
# Light from another direction moves edges: in clean captures of the office and of eight simulated
# rooms, 95 % of the single ones differ from zero by at most this times 3, 5 and 6. Measured; no
# command repeats it.
_LIGHT_PX = np.array((0.02, 0.05, 0.04))  # standard uncertainty by this
# Turns about each axis count in this unit. A pose of n captures is corrected if it differs by
# 1 + 1 / sqrt(n) units. In twelve rooms of other renderers light seems to turn a still camera by up
# to 0.27 px in heading and 0.42 px in roll, a single capture by 0.43 and 0.81 px. A third of the
# captures turned by 0.33 px does not change the error of maps, by 0.6 px it adds 3 to 6 %
# (bench/outside_rooms/turns.py).
TURN_PX = np.array((0.25, 0.25, 0.4))
# In units squared. A single capture must differ by 3.1 units to count as a separate pose, twelve
# captures by 0.9 units. Chosen.
MOVE_COST = 4.8
# Least correlation of the edges of a turned-back capture with the room's edges, in the median part
# of the picture: edges of a large sun patch are strong, but only in some parts. In four rooms, two
# of them with low suns deep in the room, clean captures have 0.36 to 1; captures shifted by 12 to
# 30 px have at most 0.26, in the office of Liu et al. 2 % of them 0.36. Measured; no command
# repeats it.
MIN_CORRELATION = 0.35


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
    shape: tuple[int, ...], heading_deg: float, angles_deg: Array | Sequence[float]
) -> Array:
    """Return the row and column at which a turned camera's map shows each pixel, [2, H, W] px."""
    height, width = shape
    rays = turned_rays(equirect_rays(height, width, heading_deg), heading_deg, angles_deg)
    row, column = equirect_pixel(*altitude_azimuth_deg(rays), height, width, heading_deg)
    return np.stack((row - 0.5, column - 0.5))


def _interpolated(maps: Array, places: Array) -> Array:
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
    return _interpolated(maps, _places(maps.shape, heading_deg, angles_deg))


def interpolation_u(maps: Array, heading_deg: float, angles_deg: Array | Sequence[float]) -> Array:
    """Return the standard uncertainty that interpolation in `turned_back` causes, [H, W].

    maps: one map [H, W], ln L or another quantity, whose unit the result has; heading_deg,
    angles_deg: as for `turned_back`. A turn by a fraction f of a pixel mixes neighbours in the
    picture, and turning it back mixes them again. What remains is f (1 - f) times the range of
    values among the 3 x 3 neighbours.
    """
    places = _places(maps.shape, heading_deg, angles_deg)
    part = places - np.floor(places)
    mixed = (part * (1.0 - part)).max(axis=0)
    wide = wrapped(maps)
    contrast = (maximum_filter(wide, 3) - minimum_filter(wide, 3))[:, 1:-1]
    return mixed * _interpolated(contrast, places)


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
        """Choose the pixels, and compute how a turn of one degree changes their edges.

        edges: the room's, by `_edges_of` [2, H, W]; seen_mask: pixels that a lens saw [H, W];
        heading_deg: azimuth of the maps' centre column.
        """
        height, width = seen_mask.shape
        strength = np.hypot(edges[0], edges[1])
        # above it columns are very narrow; below -70 the tripod is in the picture
        compared = seen_mask & (np.abs(row_altitudes_deg(height))[:, None] < 70.0)
        # Only the 60 % of the pixels with the strongest edges are compared.
        pixels = np.flatnonzero(compared & (strength >= np.quantile(strength[compared], 1.0 - 0.6)))
        # At most 6000 pixels limit the time.
        self.pixels = pixels[:: -(-len(pixels) // 6000)]  # [m]
        self.values = self.at_pixels(edges)  # [2 m]
        row, column = np.divmod(self.pixels, width)
        tile = row * _TILES[0] // height * _TILES[1] + column * _TILES[1] // width
        # each derivative of a tile has its own contrast
        derivative_tile = np.concatenate((tile, tile + tile.max() + 1))
        self.tiles = np.unique(derivative_tile, return_inverse=True)[1]  # [2 m]
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
        # uncertainty of a turn that the edges do not determine
        turn, covariance = fit or (np.zeros(3), np.full((3, 3), 180.0**2))
        shared, own, room = (
            np.bincount(self.tiles, product)
            for product in (values * self.values, values**2, self.values**2)
        )
        correlation = float(np.median(shared / np.sqrt(np.maximum(own * room, 1e-24))))
        return turn, np.sqrt(np.diag(covariance)), correlation


def _motion_px(shape: tuple[int, int], heading_deg: float) -> Array:
    """Return how far a turn of one degree moves each pixel (row, column), [3, 2, H, W]."""
    moves = []
    for axis in np.eye(3):
        before, after = (_places(shape, heading_deg, half * axis) for half in (-0.5, 0.5))
        rows, columns = after - before
        moves.append((rows, (columns + shape[0]) % shape[1] - shape[0]))  # across the seam
    return np.array(moves)


def _smaller(luminance_cdm2: Floats, seen_mask: Mask) -> tuple[Floats32, Mask]:
    """Return ln L of maps [n, h, w] and seen pixels [h, w], averaged to 230 to 459 rows."""
    step = max(1, luminance_cdm2.shape[1] // 230)
    if luminance_cdm2.shape[1] % step or luminance_cdm2.shape[2] % step:
        step = 1
    # in darker places edges are noise
    logs = (np.log(np.maximum(image, 0.1)) for image in luminance_cdm2)
    small = [block_reduce(log, step, np.mean).astype(np.float32) for log in logs]
    return np.stack(small), block_reduce(seen_mask, step, np.all)


def camera_turns(luminance_cdm2: Floats, seen_mask: Mask, heading_deg: float) -> CameraTurns:
    """Return how the camera of each capture was turned relative to most captures.

    luminance_cdm2: panoramas in the order of time, without NaN [n, H, W]; seen_mask: True for
    pixels with a value [H, W]; heading_deg: azimuth of the centre column. Consecutive captures of
    one pose get their median turn; a turn too small to be certain is zero. With fewer than 5
    captures or 40 rows of pixels, or if nothing was seen, all turns are zero and all captures count
    as aligned. Computing time is proportional to the number of captures.
    """
    count, height = luminance_cdm2.shape[:2]
    angles, u_deg, correlation = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros(count)
    # fewer captures have no clear majority; in smaller pictures an edge is as wide as a wall
    if count < 5 or height < 40 or not seen_mask.any():
        return CameraTurns(angles, u_deg, np.ones(count, bool))
    logs, seen_mask = _smaller(luminance_cdm2, seen_mask)
    shown = evenly_spread(count, 200)  # their median shows the room's edges; limits the memory
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
    # a larger turn is too far for the search to converge
    near = np.abs(angles).max(axis=1) < 10.0 * pixel_deg
    aligned = (correlation >= MIN_CORRELATION) & near
    return CameraTurns(_poses(angles, aligned, pixel_deg), u_deg, aligned)


# ----------------------------------------------------------------------------------------------
# poses


def _poses(angles: Array, aligned: Mask, pixel_deg: float) -> Array:
    """Return one turn for all captures of a pose [n, 3] deg; zero for an uncertain one.

    angles: the turn of each capture [n, 3] deg; aligned: whether it is reliable [n]; pixel_deg:
    size of a pixel.

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
        # in units of TURN_PX; under five captures share their light, so that they count as a single
        # capture, for which two cuts pay
        minimum = np.sqrt(2.0 * MOVE_COST) if count < 5 else 1.0 + 1.0 / np.sqrt(count)
        if size.max() >= minimum:
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


# ----------------------------------------------------------------------------------------------
# captures


def align(
    maps: Floats32,
    has_value: Mask,
    counts: NDArray[np.float16],
    heading_deg: float,
    turns: CameraTurns,
) -> None:
    """Turn maps, masks and weights of captures back to the pose that most captures share, in place.

    maps: [n, H, W] cd/m2; has_value: [n, H, W], True for measured pixels; counts: weights of the
    pixels in training [n, H, W]; heading_deg: azimuth of the centre column. A capture that was not
    turned, or that cannot be aligned, does not change.

    Interpolation blurs sharp edges, such as a window's. Therefore each pixel's weight is multiplied
    by the weight of the uncertainty that this causes; a factor below a half becomes 0.
    """
    for k in np.flatnonzero(turns.turned):
        angles = turns.angles_deg[k]
        # The logarithm needs a value above 0; no camera resolves so little.
        logs = np.log(np.maximum(np.nan_to_num(maps[k]), 1e-3))
        maps[k] = np.exp(turned_back(logs, heading_deg, angles))
        weight = weight_of_variance(interpolation_u(logs, heading_deg, angles) ** 2)
        # Interpolation made these pixels too uncertain.
        weight = np.where(weight < 0.5, 0.0, weight)
        share = turned_back(has_value[k].astype(float), heading_deg, angles)
        has_value[k] = share > 1.0 - 1e-6
        counts[k] = weight * turned_back(counts[k].astype(float), heading_deg, angles)


def shown_place(
    altitude_deg: float, azimuth_deg: float, heading_deg: float, angles_deg: Floats
) -> tuple[float, float]:
    """Return the altitude and azimuth [deg] at which a turned camera's panorama shows a direction.

    altitude_deg, azimuth_deg: the true direction, azimuth clockwise from north; heading_deg:
    azimuth of the panorama's centre column; angles_deg: the camera's turn in heading (clockwise
    positive), tilt (up) and roll (clockwise) [3].
    """
    if not angles_deg.any():
        return altitude_deg, azimuth_deg
    shown = turned_rays(direction(altitude_deg, azimuth_deg), heading_deg, angles_deg)
    altitude, azimuth = (float(angle) for angle in altitude_azimuth_deg(shown))
    return altitude, azimuth % 360.0


def turn_notes(turns: CameraTurns, days: NDArray[np.datetime64]) -> list[str]:
    """Return sentences for the user: one for each pose that was corrected, one on unused captures.

    Captures that cannot be aligned are not used. The list is empty if all captures are aligned and
    no camera was turned. days: local date of each capture [n].
    """
    notes = []
    for pose in np.unique(turns.angles_deg[turns.turned], axis=0):
        rows = turns.turned & (turns.angles_deg == pose).all(axis=1)
        u = np.median(turns.u_deg[rows], axis=0)
        names = ("heading", "tilt", "roll")
        parts = [f"{n} {a:+.2f} +- {e:.2f}" for n, a, e in zip(names, pose, u, strict=True)]
        notes.append(
            f"the camera was turned, relative to most captures, in {_captures(rows, days)} by "
            f"{', '.join(parts)} degrees; the pictures were turned back in memory"
        )
    if not turns.aligned.all():
        notes.append(
            f"WARNING: not used: {_captures(~turns.aligned, days)} that cannot be aligned with the "
            "others: the camera was turned too far or moved; put them into a separate session"
        )
    return notes


def _captures(rows: Mask, days: NDArray[np.datetime64]) -> str:
    return f"{counted(int(rows.sum()), 'capture')} of {listed(np.unique(days[rows]).tolist())}"
