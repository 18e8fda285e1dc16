"""Detect a turn of the camera within a bracket, by tracking points from each frame to the next.

Phase correlation is not suitable: edges of clipped and dark areas are common to both frames and
hold it at zero. Therefore only points whose surroundings both frames see are tracked (Lucas and
Kanade 1981, by OpenCV), in the logarithm of light, so that an error of exposure is an offset. A
fisheye picture does not shift uniformly when its camera turns, and two lenses back to back shift
against each other: the unknowns are the three angles of the turn, and the lens's mapping converts
points to directions. Robust weights reduce the effect of motion.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import cv2
import numpy as np

from fieldlum.core.arrays import Array, Floats, Floats32, Mask
from fieldlum.optics.projection import LensGeometry, lens_rays, radius_of_angle, relative_radius
from fieldlum.optics.turn_fit import fit_turn
from fieldlum.session.files.sidecar import ShiftQuality

_WINDOW_PX = 11  # side of the surroundings of a point, in pixels of a reduced frame
_MAX_POINTS, _MIN_POINTS = 400, 20
_BLOCKS = 6  # parts of the picture per side whose errors are independent


class ReducedFrame(NamedTuple):
    """A frame at a reduced size.

    log_light [h, w]: natural logarithm of the light, in any unit, 0 where not seen; seen [h, w]:
    True for pixels that are neither clipped nor dark; step: sensor pixels per reduced pixel, along
    each side.
    """

    log_light: Floats32
    seen: Mask
    step: int


def reduce_frame(signal: Floats32, seen_mask: Mask, minimum: float, cell: int = 1) -> ReducedFrame:
    """Return a frame at a reduced size: its means over blocks of pixels, at most 800 on a side.

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


def turns_between(
    frames: Sequence[ReducedFrame], lenses: Sequence[LensGeometry], names: Sequence[str]
) -> list[ShiftQuality]:
    """Return the turns of the camera between neighbouring frames of a bracket.

    frames: most exposed first; lenses: with centres in sensor pixels of the frames; names: of the
    frames' files. A turn's shift_px is its angle times the pixels per radian at the axis of the
    first lens; sure_px is that shift less three standard errors. A pair of frames without enough
    common points is omitted.
    """
    lens, tiny_rad, turns = lenses[0], 1e-4, []
    px_per_rad = float(lens.radius_px * radius_of_angle(lens, tiny_rad) / tiny_rad)
    for k, (long, short) in enumerate(pairwise(frames)):
        if (turn := _turn(long, short, lenses)) is None:
            continue
        angle_rad, u_rad = turn
        shift_px, u_px = angle_rad * px_per_rad, u_rad * px_per_rad
        turns.append(
            ShiftQuality(
                long=names[k],
                short=names[k + 1],
                turn_deg=round(float(np.degrees(angle_rad)), 3),
                shift_px=round(shift_px, 3),
                u_px=round(u_px, 3),
                sure_px=round(max(shift_px - 3.0 * u_px, 0.0), 3),
            )
        )
    return turns


def _turn(
    long: ReducedFrame, short: ReducedFrame, lenses: Sequence[LensGeometry]
) -> tuple[float, float] | None:
    """Return the angle between two frames and its standard error [rad]; None for too few points.

    lenses: geometry of each lens on the sensor. The standard error is that of all three angles
    together, by leaving out one block of the picture at a time: errors of neighbouring points are
    not independent, and in a dark frame a few blocks can determine the turn. The error along the
    found axis alone is too small, because noise chose that axis. None too if one block alone
    determines the turn.
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
    turn, last, block = Rotation.identity(), np.zeros(3), np.repeat(block, 3)

    def fitted(kept: Mask) -> Floats:
        """Return the small turn [3] by the kept equations; NaN if they do not determine it."""
        return (fit_turn(design[kept], target[kept], block[kept]) or (np.full(3, np.nan),))[0]

    for _ in range(3):  # a fit is linear in the turn
        turned = turn.apply(long_rays)  # [points, 3]
        # change of each vector by a small turn about each axis, [points, axes, 3]
        change = np.asarray(np.cross(np.eye(3), turned[:, None]), np.float64)
        design, target = change.swapaxes(1, 2).reshape(-1, 3), (short_rays - turned).ravel()
        last = fitted(block >= 0)
        if np.isnan(last).any():
            return None
        turn = Rotation.from_rotvec(last) * turn
    off = np.array([fitted(block != number) for number in np.unique(block)]) - last
    u_rad = float(np.sqrt((off**2).sum() * (parts - 1) / parts))
    return None if np.isnan(u_rad) else (float(turn.magnitude()), max(u_rad, 1e-8))


def _tracked(long: ReducedFrame, short: ReducedFrame) -> tuple[Floats, Floats]:
    """Return where the same points of the scene are in two frames: sensor x, y [points, 2] px each.

    A point counts if tracking it to the second frame and back ends where it began, within 0.3
    pixels of the reduced frame.
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
    # None: without a guess of where the points end
    end, is_tracked, _ = track(first, second, start, None, **window)
    back, is_back, _ = track(second, first, end, None, **window)
    apart_px = np.abs(back - start).max(axis=(1, 2))
    good = (is_tracked[:, 0] > 0) & (is_back[:, 0] > 0) & (apart_px < 0.3)
    in_long, in_short = (start[good, 0] + 0.5) * long.step, (end[good, 0] + 0.5) * long.step
    return in_long.astype(np.float64), in_short.astype(np.float64)


def _grey(frame: ReducedFrame, common: Mask) -> Array:
    """Return a frame as 8-bit levels of ln light [h, w]; 128 is the median of what `common` marks.

    common [h, w]: pixels that are seen in both frames; others get 128.
    """
    middle = np.median(frame.log_light[common]) if common.any() else 0.0
    # 40 levels for a factor of e: one of the 256 is 2.5 % of light, and the range is 9 EV.
    levels = np.where(common, 40.0 * (frame.log_light - middle), 0.0)
    return np.clip(np.rint(levels) + 128, 0, 255).astype(np.uint8)
