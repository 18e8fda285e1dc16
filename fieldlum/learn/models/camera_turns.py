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
from scipy import ndimage
from scipy.spatial.transform import Rotation
from skimage.measure import block_reduce

from fieldlum.core.arrays import Array, Dates, Floats, Floats32, Indices, Mask, evenly_spread
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

# Smoothing [px], coarse to fine; the last is as wide as an edge in a rendering. Measured; no
# command repeats it. In each a capture has at most so many steps, until one is smaller than this
# share of it: single steps stop short of turns of five pixels, five find nine (six rooms of another
# renderer, captures of half a day).
_SMOOTH_PX = (3.0, 1.0, 0.7)
_MAX_STEPS, _SMALL_STEP = 5, 0.1
# A capture stands still if at the last smoothing it settles in so many steps at less than this turn
# [px] from most captures, and agrees with the room's edges. If more than this share stands still,
# only the others are searched through all smoothings: turns of 0.3 to 12 px in nine rooms of other
# renderers are the same, in half of the time where nothing is turned. With 0.5 px, a third of the
# captures turned by 0.5 px was found in part.
_STILL_STEPS, _STILL_PX, _MOSTLY_STILL = 2, 0.3, 0.7
_TILES = (6, 12)  # rows and columns of independent parts of the picture; not measured
# Standard uncertainty of heading, tilt and roll, because light from another direction moves edges:
# in clean captures of the office and of eight simulated rooms, 95 % of the turns are at most 3, 5
# and 6 times this. Measured; no command repeats it.
_LIGHT_PX = np.array((0.02, 0.05, 0.04))
# Turns in heading, tilt and roll count in these units. A pose of n captures is corrected if it
# differs by 1 + 1 / sqrt(n) units. In twelve rooms of other renderers light seems to turn a still
# camera by up to 0.27 px in heading and 0.42 px in roll, a single capture by 0.43 and 0.81 px. A
# third of the captures turned by 0.33 px does not change the error of maps, by 0.6 px it adds 3 to
# 6 % (bench/outside_rooms/turns.py).
TURN_PX = np.array((0.25, 0.25, 0.4))
# Cost of a move of the camera between two captures, in squared units of TURN_PX. A single capture
# must differ by 3.1 units to count as a separate pose, twelve captures by 0.9 units. Chosen.
MOVE_COST = 4.8
# Least correlation of the edges of a turned-back capture with the room's edges, in the median part
# of the picture; with a low sun, whose patches have other edges, a capture with less can still be
# used. Of nine consecutive captures with a lower median than the second, those under the third are
# of a moved camera: in 22 rooms of other renderers clean medians are 0.58 or more, and 0.15 to 0.67
# after a turn of 37 degrees, when no capture has more than 0.71. A turn of a single capture needs
# the last too, since a search that ends at a wrong place gives each capture another turn.
MIN_CORRELATION, _MIN_OF_NINE, _NOT_MOVED = 0.35, 0.5, 0.75
# A sun below this is low [deg]: clean captures with less than the first correlation have 3.6 to
# 11.3 in those rooms.
LOW_SUN_DEG = 20.0
# A capture is turned too far if its edges, turned by over 3 pixels more, agree better with the
# room's, by this correlation: in those rooms clean captures have at most 0.05, and of 250 single
# captures turned by 37 to 180 degrees three have less than this.
_MIN_ELSEWHERE = 0.12


@dataclass(frozen=True, slots=True)
class CameraTurns:
    """Turn of each capture's camera relative to the pose that most captures share.

    angles_deg: turn in heading (clockwise positive), tilt (up) and roll (clockwise) [n, 3], zero if
    the camera was not turned or cannot be aligned; u_deg: standard uncertainties of the turns [n,
    3]; aligned: True if the capture can be used: its picture, turned back by under 10 pixels (of
    maps with over 459 rows, of their averages over blocks), has its edges where the room's edges
    are; with a low sun, also if the captures before and after it have one pose [n].
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

    rays: true directions, unit vectors with x east, y north, z up, as the results [..., 3];
    heading_deg: azimuth of the panorama's centre column, clockwise from north; angles_deg: the
    camera's turn in heading (clockwise positive), tilt (up) and roll (clockwise) [3].
    """
    heading = np.radians(heading_deg)
    right = (np.cos(heading), -np.sin(heading), 0.0)
    forward = (np.sin(heading), np.cos(heading), 0.0)
    axes = np.array(((0.0, 0.0, -1.0), right, forward))
    return rays @ Rotation.from_rotvec(-np.radians(angles_deg) @ axes).as_matrix().T


def _places(
    shape: tuple[int, ...], heading_deg: float, angles_deg: Array | Sequence[float]
) -> Array:
    """Return the row and column at which a turned camera's map shows each pixel, [2, H, W] px.

    shape: (H, W); heading_deg: azimuth of the centre column; angles_deg [3]: turn in heading, tilt
    and roll. The centre of the first pixel is (0, 0).
    """
    height, width = shape
    rays = turned_rays(equirect_rays(height, width, heading_deg), heading_deg, angles_deg)
    row, column = equirect_pixel(*altitude_azimuth_deg(rays), height, width, heading_deg)
    return np.stack((row - 0.5, column - 0.5))


def _interpolated(maps: Array, places: Array) -> Array:
    """Return a map [H, W] interpolated at rows and columns `places` [2, H, W], [H, W].

    Interpolation is linear, and continues from the last column to the first.
    """
    in_wrapped = places + np.array((0.0, 1.0))[:, None, None]  # one column more on the left
    return ndimage.map_coordinates(wrapped(maps), in_wrapped, order=1, mode="nearest")


def turned_back(maps: Array, heading_deg: float, angles_deg: Array | Sequence[float]) -> Array:
    """Return a turned camera's map [H, W] as the camera would show it without the turn, [H, W].

    maps: one map; heading_deg: azimuth of its centre column, clockwise from north; angles_deg: the
    camera's turn in heading (clockwise positive), tilt (up) and roll (clockwise) [3]. Interpolation
    is linear between pixels. Pass ln L, so that a bright window does not spread over its frame.
    """
    return _interpolated(maps, _places(maps.shape, heading_deg, angles_deg))


def interpolation_u(maps: Array, heading_deg: float, angles_deg: Array | Sequence[float]) -> Array:
    """Return the standard uncertainty that interpolation in `turned_back` causes, [H, W].

    maps: one map [H, W], ln L or another quantity, whose unit the result has; heading_deg,
    angles_deg: as for `turned_back`. A turn by a fraction f of a pixel mixes neighbours in the
    picture, and turning it back mixes them again. What remains is taken as f (1 - f) times the
    range of values among the 3 x 3 neighbours, an own estimate.
    """
    places = _places(maps.shape, heading_deg, angles_deg)
    fraction = places - np.floor(places)
    mixed = (fraction * (1.0 - fraction)).max(axis=0)
    wide = wrapped(maps)
    contrast = (ndimage.maximum_filter(wide, 3) - ndimage.minimum_filter(wide, 3))[:, 1:-1]
    return mixed * _interpolated(contrast, places)


# ----------------------------------------------------------------------------------------------
# comparison with the room's edges


def _edges_of(logs: Array, heading_deg: float, angles_deg: Array, smooth_px: float) -> Floats32:
    """Return the edges of a capture, to align it: derivatives by row and by column, [2, H, W].

    logs: ln L of the capture [H, W]; heading_deg: azimuth of its centre column; angles_deg [3]: its
    turn in heading, tilt and roll as estimated before, which is reversed; smooth_px: standard
    deviation of the Gaussian that smooths the map first.
    """
    logs = turned_back(logs, heading_deg, angles_deg) if angles_deg.any() else logs
    smooth = ndimage.gaussian_filter(logs, smooth_px, mode=("nearest", "wrap"), truncate=3.0)  # pyright: ignore[reportArgumentType]
    across = (np.roll(smooth, -1, axis=1) - np.roll(smooth, 1, axis=1)) / 2.0
    return np.stack((np.gradient(smooth, axis=0), across)).astype(np.float32)


class _RoomEdges:
    """The room's edges at the m pixels where they are strongest, and how a turn changes them."""

    def __init__(self, edges: Array, seen_mask: Mask, heading_deg: float, smooth_px: float) -> None:
        """Choose the pixels, and compute how a turn of one degree changes their edges.

        edges: the room's, by `_edges_of` [2, H, W]; seen_mask: pixels that a lens saw [H, W];
        heading_deg: azimuth of the maps' centre column; smooth_px: by which the edges were
        smoothed.
        """
        height, width = seen_mask.shape
        strength = np.hypot(edges[0], edges[1])
        # Above 70 degrees columns are very narrow; below -70 the tripod is in the picture.
        compared = seen_mask & (np.abs(row_altitudes_deg(height))[:, None] < 70.0)
        self.edges, self.compared = edges, compared
        # Only the 60 % of the pixels with the strongest edges are compared.
        pixels = np.flatnonzero(compared & (strength >= np.quantile(strength[compared], 1.0 - 0.6)))
        # At most 6000 pixels limit the time: every k-th, with k rounded up. The neighbours of a
        # smoothed pixel show the same.
        self.pixels = pixels[:: max(-(-len(pixels) // 6000), int(smooth_px))]  # [m]
        self.values = self.at_pixels(edges)  # [2 m]
        row, column = np.divmod(self.pixels, width)
        tile = row * _TILES[0] // height * _TILES[1] + column * _TILES[1] // width
        # Each of the two derivatives in a tile has its own contrast.
        derivative_tile = np.concatenate((tile, tile + tile.max() + 1))
        self.tiles = np.unique(derivative_tile, return_inverse=True)[1]  # [2 m]
        slopes = np.stack([np.stack(np.gradient(edge)) for edge in edges])  # [2, 2, H, W]
        motions = _motion_px((height, width), heading_deg)
        changes = [-(slopes * motion).sum(axis=1) for motion in motions]  # [2, H, W] each
        self.changes = np.stack([self.at_pixels(change) for change in changes], axis=1)  # [2 m, 3]
        # Less weight for edges of high contrast, which move with the light: a bright window spreads
        # over its frame.
        usual = max(np.median(np.abs(self.values)), 1e-9)  # 0 in pictures without any edge
        self.weights = 1.0 / (self.values**2 + 4.0 * usual**2)

    def at_pixels(self, edges: Array) -> Array:
        """Return the values [2 m] of maps [2, H, W] at the chosen pixels."""
        return edges.reshape(2, -1)[:, self.pixels].ravel().astype(float)

    def turn(self, edges: Array) -> tuple[Array, Array, float]:
        """Return the turn that moves the room's edges to those of a capture, with its quality.

        edges: the capture's, by `_edges_of` [2, H, W]. The results are the turn in heading, tilt
        and roll [3] deg, its standard errors [3] deg, and the correlation of the edges in the
        median tile.
        """
        values = self.at_pixels(edges)
        contrasts = Contrasts(self.values, self.tiles)  # of the edges in each tile
        fit = fit_turn(self.changes, values, self.tiles, weights=self.weights, contrasts=contrasts)
        # A turn that the edges do not determine has an uncertainty of 180 degrees.
        turn, covariance = fit or (np.zeros(3), np.full((3, 3), 180.0**2))
        shared, own, room = (  # sums of products in each tile
            np.bincount(self.tiles, product)
            for product in (values * self.values, values**2, self.values**2)
        )
        correlation = float(np.median(shared / np.sqrt(np.maximum(own * room, 1e-24))))
        return turn, np.sqrt(np.diag(covariance)), correlation

    def elsewhere(self, edges: Array) -> float:
        """Return how much better a capture's edges agree with the room's at another heading.

        It is the difference of two correlations: the largest of headings over 3 pixels away, and
        the present one. edges: the capture's, by `_edges_of` [2, H, W]; strong ones count less.
        """
        room, own = (self._equalised(some) for some in (self.edges, edges))
        spectrum = np.fft.rfft(own) * np.conj(np.fft.rfft(room))
        shared = np.fft.irfft(spectrum.sum(axis=(0, 1)), own.shape[2])  # by heading [W]
        gain = shared[4:-3].max() - shared[[0, 1, -1]].max()
        return float(gain / np.sqrt(max((own**2).sum() * (room**2).sum(), 1e-24)))

    def _equalised(self, edges: Array) -> Array:
        """Return edges [2, H, W] of which those over twice the median are limited; else 0."""
        usual = np.median(np.abs(edges[:, self.compared]), axis=1)[:, None, None]
        return np.where(self.compared, edges / np.hypot(edges, 2.0 * usual + 1e-12), 0.0)


def _motion_px(shape: tuple[int, int], heading_deg: float) -> Array:
    """Return how far a turn of one degree about each axis moves each pixel, [3, 2, H, W].

    The axes are heading, tilt and roll; the motions are along rows and columns, px per degree.
    """
    motions = []
    for axis in np.eye(3):
        before, after = (_places(shape, heading_deg, half * axis) for half in (-0.5, 0.5))
        rows, columns = after - before
        # A motion across the seam is at most half the width, which is the height.
        motions.append((rows, (columns + shape[0]) % shape[1] - shape[0]))
    return np.array(motions)


def _smaller(luminance_cdm2: Floats, seen_mask: Mask) -> tuple[Floats32, Mask]:
    """Return ln L of maps and the seen pixels, averaged over blocks to 230 to 459 rows.

    luminance_cdm2: of n captures [n, H, W]; seen_mask: [H, W]. Maps that cannot be divided into
    such blocks, or have fewer rows, keep their size.
    """
    step = max(1, luminance_cdm2.shape[1] // 230)
    if luminance_cdm2.shape[1] % step or luminance_cdm2.shape[2] % step:
        step = 1
    # In places darker than 0.1 cd/m2 edges are noise.
    logs = (np.log(np.maximum(image, 0.1)) for image in luminance_cdm2)
    small = [block_reduce(log, step, np.mean).astype(np.float32) for log in logs]
    return np.stack(small), block_reduce(seen_mask, step, np.all)


def camera_turns(
    luminance_cdm2: Floats, seen_mask: Mask, heading_deg: float, sun_deg: Floats | float = np.nan
) -> CameraTurns:
    """Return how the camera of each capture was turned relative to most captures.

    luminance_cdm2: n panoramas in the order of time, without NaN [n, H, W]; seen_mask: True for
    pixels with a value [H, W]; heading_deg: azimuth of the centre column, clockwise from north;
    sun_deg: the sun's altitude in captures with direct sun, NaN in others [n]. Consecutive captures
    of one pose get their median turn; a turn too small to be certain is zero.
    With fewer than 5 captures or 40 rows of pixels, or if nothing was seen, all turns are zero and
    all captures count as aligned. Computing time is proportional to the number of captures.
    """
    count, height = luminance_cdm2.shape[:2]
    angles, u_deg = np.zeros((count, 3)), np.zeros((count, 3))
    correlation, elsewhere, settled = np.zeros(count), np.zeros(count), np.zeros(count, bool)
    # Fewer captures have no clear majority; in smaller pictures an edge is as wide as a wall.
    if count < 5 or height < 40 or not seen_mask.any():
        return CameraTurns(angles, u_deg, np.ones(count, bool))
    logs, seen_mask = _smaller(luminance_cdm2, seen_mask)
    pixel_deg = 180.0 / seen_mask.shape[0]

    def search(rows: Indices, sample: Indices, smooth_px: float, steps: int) -> None:
        """Improve the turns of captures `rows`; those of `sample` show the room's edges."""
        stored = {int(i): _edges_of(logs[i], heading_deg, angles[i], smooth_px) for i in sample}
        median = np.median(np.stack(list(stored.values())), axis=0)
        room = _RoomEdges(median, seen_mask, heading_deg, smooth_px)
        for i in rows:
            edges = stored.get(i)
            if edges is None:
                edges = _edges_of(logs[i], heading_deg, angles[i], smooth_px)
            for _ in range(steps):
                step, u_deg[i], correlation[i] = room.turn(edges)
                angles[i] += step
                settled[i] = np.abs(step).max() < _SMALL_STEP * smooth_px * pixel_deg
                if settled[i]:
                    break
                edges = _edges_of(logs[i], heading_deg, angles[i], smooth_px)
            if smooth_px == _SMOOTH_PX[-1]:
                elsewhere[i] = room.elsewhere(edges)
        angles[:] -= np.median(angles, axis=0)

    # The median of at most 200 captures shows the room's edges, which limits the memory.
    rows, sample = np.arange(count), evenly_spread(count, 200)
    progress(0, 1 + len(_SMOOTH_PX), "comparing the camera's poses")
    search(rows, sample, _SMOOTH_PX[-1], _STILL_STEPS)
    still = settled & (correlation > _NOT_MOVED) & (elsewhere < _MIN_ELSEWHERE)
    still &= np.abs(angles).max(axis=1) < _STILL_PX * pixel_deg
    if still.mean() > _MOSTLY_STILL:
        rows, sample = np.flatnonzero(~still), np.flatnonzero(still)
        sample = sample[evenly_spread(len(sample), 60)]
    angles[rows] = 0.0
    for k, smooth_px in enumerate(_SMOOTH_PX if len(rows) else ()):
        progress(1 + k, 1 + len(_SMOOTH_PX), "comparing the camera's poses")
        search(rows, sample, smooth_px, _MAX_STEPS)
    u_deg = np.hypot(u_deg, _LIGHT_PX * pixel_deg)
    of_nine = ndimage.median_filter(correlation, 9, mode="mirror")
    moved = (of_nine < _MIN_OF_NINE) & (correlation < _NOT_MOVED) | (elsewhere > _MIN_ELSEWHERE)
    # The search does not converge to larger turns.
    near = np.abs(angles).max(axis=1) < 10.0 * pixel_deg
    found = near & settled & ~moved & (correlation >= MIN_CORRELATION)
    low_sun = ~found & ~moved & (np.asarray(sun_deg) < LOW_SUN_DEG)
    poses, aligned = _poses(angles, found, low_sun, pixel_deg, correlation > _NOT_MOVED)
    return CameraTurns(poses, u_deg, aligned)


# ----------------------------------------------------------------------------------------------
# poses


def _poses(
    angles: Array, reliable: Mask, low_sun: Mask, pixel_deg: float, sure: Mask
) -> tuple[Array, Mask]:
    """Return one turn for all captures of a pose, [n, 3] deg, and the captures that have one [n].

    The turn is zero if it is uncertain. angles: the estimated turn of each capture in the order of
    time [n, 3] deg; reliable: whether it can be used [n]; low_sun: other captures, which have the
    pose of the reliable ones before and after them, if these agree [n]; pixel_deg: size of a pixel;
    sure: captures that have a turn of their own, even if no capture next to them has it [n].
    A camera does not turn until it is moved, so that consecutive captures have one pose.
    """
    out, used = np.zeros_like(angles), reliable.copy()
    rows = np.flatnonzero(reliable)
    if not len(rows):
        return out, reliable
    unit = TURN_PX * pixel_deg
    pieces = _pieces(angles[rows] / unit)
    counts = [stop - start for start, stop in pieces]
    poses = np.array([np.median(angles[rows[start:stop]], axis=0) for start, stop in pieces])
    poses -= np.median(np.repeat(poses, counts, axis=0), axis=0)  # relative to most captures
    for (start, stop), count, pose in zip(pieces, counts, poses, strict=True):
        size = np.abs(pose) / unit
        # Fewer than five captures have similar light and its errors, so that they count as one
        # capture, which must be worth the cost of two moves.
        minimum = np.sqrt(2.0 * MOVE_COST) if count < 5 else 1.0 + 1.0 / np.sqrt(count)
        if size.max() >= minimum:
            out[rows[start:stop]] = np.where(size < 1.0, 0.0, pose)
            used[rows[start:stop]] = count > 1 or sure[rows[start]]
    earlier = np.searchsorted(rows, np.arange(len(out)))  # number of reliable captures
    before, after = (out[rows[np.clip(earlier - k, 0, len(rows) - 1)]] for k in (1, 0))
    same = low_sun & (before == after).all(axis=1)
    return np.where(same[:, None], after, out), used | same


def _pieces(values: Array) -> list[tuple[int, int]]:
    """Cut a series into pieces of nearly constant values; return (start, stop) of each piece.

    values: n rows of k values, in order [n, k]. The cuts have the smallest sum of squared
    differences from the means of the pieces, plus MOVE_COST for each piece (Potts model, by dynamic
    programming).
    """
    count = len(values)
    sums = np.concatenate((np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)))
    squares = np.concatenate(((0.0,), np.cumsum((values**2).sum(axis=1))))
    # Of the first `stop` values: least cost, and where their last piece starts.
    least_cost, last_start = np.zeros(count + 1), np.zeros(count + 1, int)
    for stop in range(1, count + 1):
        lengths = stop - np.arange(stop)  # of a piece from each start
        spread = squares[stop] - squares[:stop]
        spread = spread - ((sums[stop] - sums[:stop]) ** 2).sum(axis=1) / lengths
        costs = least_cost[:stop] + spread + MOVE_COST
        last_start[stop] = int(np.argmin(costs))
        least_cost[stop] = costs[last_start[stop]]
    pieces, stop = [], count
    while stop > 0:
        pieces.append((int(last_start[stop]), stop))
        stop = int(last_start[stop])
    return pieces[::-1]


# ----------------------------------------------------------------------------------------------
# captures


def align(
    maps: Floats32, has_value: Mask, counts: Array, heading_deg: float, turns: CameraTurns
) -> None:
    """Turn maps, masks and weights of captures back to the pose that most captures share, in place.

    maps: of n captures [n, H, W] cd/m2; has_value: [n, H, W], True for measured pixels; counts:
    weights of the pixels in training, 0 to 1 [n, H, W]; heading_deg: azimuth of the centre column,
    clockwise from north; turns: by `camera_turns`. A capture that was not turned, or that cannot be
    aligned, does not change.

    Interpolation blurs sharp edges, such as a window's. Therefore each pixel's weight is multiplied
    by the weight of the uncertainty that this causes; a factor below a half becomes 0.
    """
    for k in np.flatnonzero(turns.turned):
        angles = turns.angles_deg[k]
        # The logarithm needs a value above 0; no camera resolves so little.
        logs = np.log(np.maximum(np.nan_to_num(maps[k]), 1e-3))
        maps[k] = np.exp(turned_back(logs, heading_deg, angles))
        weight = weight_of_variance(interpolation_u(logs, heading_deg, angles) ** 2)
        weight = np.where(weight < 0.5, 0.0, weight)  # 0 where interpolation blurs too much
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
    if not angles_deg.any():  # exact without a turn
        return altitude_deg, azimuth_deg
    shown = turned_rays(direction(altitude_deg, azimuth_deg), heading_deg, angles_deg)
    altitude, azimuth = (float(angle) for angle in altitude_azimuth_deg(shown))
    return altitude, azimuth % 360.0


def turn_notes(turns: CameraTurns, days: Dates) -> list[str]:
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
        text = f"the camera was turned, relative to most captures, in {_captures(rows, days)} by "
        notes.append(f"{text}{', '.join(parts)} degrees; the pictures were turned back in memory")
    if not turns.aligned.all():
        unused = f"{_captures(~turns.aligned, days)} that cannot be aligned with the others"
        cause = "the camera was turned too far or moved"
        notes.append(f"WARNING: not used: {unused}: {cause}; put them into a separate session")
    return notes


def _captures(rows: Mask, days: Dates) -> str:
    """Return how many captures `rows` selects and their days, as words."""
    return f"{counted(int(rows.sum()), 'capture')} of {listed(np.unique(days[rows]).tolist())}"
