"""Detect a turn of the camera within a bracket, by tracking points from each frame to the next.

Phase correlation is not suitable: edges of clipped and dark areas are common to both frames and
hold it at zero. Therefore only points whose surroundings both frames see are tracked (Lucas and
Kanade 1981, by OpenCV), in the logarithm of light, so that an error of exposure is an offset. A
fisheye picture does not shift uniformly when its camera turns, and two lenses back to back shift
against each other: the unknowns are the three angles of the turn, and the lens's mapping converts
points to directions. Robust weights reduce the effect of motion.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
import numpy as np

from fieldlum.core.arrays import Array, Floats, Floats32, Mask
from fieldlum.optics.projection import LensGeometry, lens_rays, radius_of_angle, relative_radius
from fieldlum.optics.turn_fit import fit_turn
from fieldlum.session.files.sidecar import ShiftQuality

_WINDOW_PX = 11  # side of the surroundings of a point
_MAX_POINTS, _MIN_POINTS = 400, 20
_BLOCKS = 6  # parts of the picture per side whose errors are independent


@dataclass(frozen=True, slots=True)
class ReducedFrame:
    """A frame at a reduced size.

    log_light [h, w]: natural logarithm of the light, in any unit; seen [h, w]: True for pixels that
    are neither clipped nor dark; step: sensor pixels per reduced pixel, along each side.
    """

    log_light: Floats32
    seen: Mask
    step: int


def reduced(signal: Floats32, seen_mask: Mask, minimum: float, cell: int = 1) -> ReducedFrame:
    """Return a frame at a reduced size: its means over blocks, with at most 800 blocks on a side.

    signal: [h, w], linear in light with black at 0, in any unit; seen_mask: mask [h, w], False for
    pixels to ignore. A block counts as seen if all its pixels are seen and its mean is above
    `minimum`, which must not be negative. cell: a block's side is a multiple of this number of
    pixels (2 for a mosaic).
    """
    h, w = signal.shape
    side = cell * max(1, -(-max(h, w) // (cell * 800)))  # limits the time
    part, size = np.s_[: h // side * side, : w // side * side], (w // side, h // side)
    mean, share = (
        cv2.resize(values[part], size, interpolation=cv2.INTER_AREA)
        for values in (signal, seen_mask.view(np.uint8) * np.uint8(255))
    )
    complete = (share == 255) & (mean > minimum)
    return ReducedFrame(np.log(np.where(complete, mean, 1.0)).astype(np.float32), complete, side)


def shifts(
    frames: Sequence[ReducedFrame], lenses: Sequence[LensGeometry], names: Sequence[str]
) -> list[ShiftQuality]:
    """Return the turns of the camera between neighbouring frames of a bracket.

    frames: most exposed first; lenses: with centres in sensor pixels of the frames; names: of the
    frames. shift_px of a turn is its angle about any axis by the pixels per radian at the first
    lens's axis. A pair of frames without enough common points is omitted.
    """
    lens, tiny_rad, turns = lenses[0], 1e-4, []
    px_per_rad = float(lens.radius_px * radius_of_angle(lens, tiny_rad) / tiny_rad)
    for k, (long, short) in enumerate(pairwise(frames)):
        turn = _turn(long, short, lenses)
        if turn is not None:
            angle, u = turn
            px, u_px = angle * px_per_rad, u * px_per_rad
            turns.append(
                ShiftQuality(
                    long=names[k],
                    short=names[k + 1],
                    turn_deg=round(float(np.degrees(angle)), 3),
                    shift_px=round(px, 3),
                    u_px=round(u_px, 3),
                    sure_px=round(max(px - 3.0 * u_px, 0.0), 3),
                )
            )
    return turns


def _turn(
    long: ReducedFrame, short: ReducedFrame, lenses: Sequence[LensGeometry]
) -> tuple[float, float] | None:
    """Return the turn between two frames [rad] and its standard error; None for too few points.

    lenses: geometry of each lens on the sensor. The points are grouped by blocks of the picture:
    only blocks count as independent.
    """
    from scipy.spatial.transform import Rotation

    long_px, short_px = _tracked(long, short)  # [points, 2] each
    rays: list[Floats] = [np.empty((2, 0, 3))]
    blocks = [np.empty(0, np.intp)]
    extent = np.array(long.seen.shape[::-1]) * long.step
    for lens in lenses:
        # the edge of a lens's image does not move with the scene
        long_radius = relative_radius(lens, long_px[:, 0], long_px[:, 1])
        short_radius = relative_radius(lens, short_px[:, 0], short_px[:, 1])
        inside = np.maximum(long_radius, short_radius) < 0.97
        rays.append(np.stack([lens_rays(lens, *p[inside].T) for p in (long_px, short_px)]))
        column, row = (long_px[inside] * _BLOCKS / extent).astype(np.intp).T
        blocks.append(row * _BLOCKS + column)
    (long_rays, short_rays), block = np.concatenate(rays, axis=1), np.concatenate(blocks)
    parts = len(np.unique(block))
    if len(block) < _MIN_POINTS or parts < 5:
        return None
    turn, covariance = Rotation.identity(), np.eye(3)
    for _ in range(3):  # a fit is linear in the turn
        moved = turn.apply(long_rays)
        design = np.asarray(np.cross(np.eye(3), moved[:, None]), np.float64)
        design = design.swapaxes(1, 2).reshape(-1, 3)
        fit = fit_turn(design, (short_rays - moved).ravel(), np.repeat(block, 3))
        if fit is None:
            return None
        turn, covariance = Rotation.from_rotvec(fit[0]) * turn, fit[1] * parts / (parts - 3)
    angle = turn.magnitude()
    along = turn.as_rotvec() / max(angle, 1e-12)
    return float(angle), float(np.sqrt(max(along @ covariance @ along, 1e-16)))


def _tracked(long: ReducedFrame, short: ReducedFrame) -> tuple[Floats, Floats]:
    """Return sensor coordinates x, y of points in two frames, [points, 2] px each.

    A point counts if tracking it to the second frame and back ends where it began.
    """
    seen = long.seen & short.seen
    window_px = np.ones((_WINDOW_PX, _WINDOW_PX), np.uint8)
    mask = cv2.erode(seen.view(np.uint8), window_px, borderValue=0)
    first, second = _grey(long, seen), _grey(short, seen)
    start = cv2.goodFeaturesToTrack(first, _MAX_POINTS, 0.002, _WINDOW_PX / 2, mask=mask)
    if start is None:
        return np.empty((0, 2)), np.empty((0, 2))
    window: dict[str, Any] = {"winSize": (_WINDOW_PX, _WINDOW_PX), "maxLevel": 2}
    track: Any = cv2.calcOpticalFlowPyrLK
    end, is_tracked, _ = track(first, second, start, None, **window)
    back, is_back, _ = track(second, first, end, None, **window)
    apart_px = np.abs(back - start).max(axis=(1, 2))
    good = (is_tracked[:, 0] > 0) & (is_back[:, 0] > 0) & (apart_px < 0.3)
    in_long, in_short = (start[good, 0] + 0.5) * long.step, (end[good, 0] + 0.5) * long.step
    return in_long.astype(np.float64), in_short.astype(np.float64)


def _grey(small: ReducedFrame, common: Mask) -> Array:
    """Return a frame as 8-bit levels of ln light; 128 for the median, and outside of `common`."""
    middle = np.median(small.log_light[common]) if common.any() else 0.0
    # 40 levels for a factor of e: one of the 256 is 2.5 % of light, and the range is 9 EV.
    levels = np.where(common, 40.0 * (small.log_light - middle), 0.0)
    return np.clip(np.rint(levels) + 128, 0, 255).astype(np.uint8)
