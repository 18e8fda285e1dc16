"""Detect a turn of the camera within a bracket, by comparing each frame with its neighbour.

Phase correlation is not suitable: edges of clipped and dark areas are common to both frames and
hold it at zero, and the short frames of a room show little but windows. Therefore the turn is found
by least squares on the pixels that both frames see (Lucas and Kanade 1981), from coarse to fine. An
offset and a slope absorb errors of exposure and response; robust weights reduce the effect of
motion. A fisheye picture does not shift uniformly when its camera turns, and two lenses back to
back shift against each other. Therefore the unknowns are the three angles of the turn, and the
lens's mapping converts them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np

from fieldlum.core.arrays import Floats, Floats32, Mask
from fieldlum.optics.projection import LensGeometry, lens_pixels, lens_rays, radius_of_angle
from fieldlum.optics.turn_fit import fit_turn
from fieldlum.session.files.merge_report import ShiftQuality

MAX_SIDE_PX = 800  # longest side of the reduced frames [px], to limit the time; chosen
_LEVELS = 4  # number of sizes, each half of the one before; chosen
_STEPS = 2  # Gauss-Newton steps at each size; chosen
_MAX_PIXELS = 30_000  # pixels of a fit, to limit the time; chosen
_BLOCKS = 6  # independent blocks per side, for the standard error; chosen
_MIN_BLOCKS = 3  # with edges; fewer give no standard error; chosen
_MIN_PIXELS = 300  # at edges for a fit; not measured
_FLAT = 0.02  # ln light; smaller differences between neighbours are not edges; not measured
# Smaller gradients of ln light are ignored, because smooth shading does not constrain the turn. Not
# measured.
_SMOOTH_PER_RAD = 4.0
_RIM = 0.97  # of a lens's circle, because its edge does not move with the scene; chosen
_TINY_RAD = 1e-4  # step of the numerical derivatives


@dataclass(frozen=True, slots=True)
class Small:
    """A frame at a reduced size.

    log_light [h, w]: natural logarithm of the light, in any unit; seen [h, w]: True for pixels that
    are neither clipped nor dark; step: sensor pixels per reduced pixel, along each side.
    """

    log_light: Floats32
    seen: Mask
    step: int


def reduced(signal: Floats32, seen_mask: Mask, minimum: float, cell: int = 1) -> Small:
    """Return a frame at a reduced size: its means over blocks, with at most 800 blocks on a side.

    signal: [h, w], linear in light with black at 0, in any unit; seen_mask: mask [h, w], False for
    pixels to ignore. A block counts as seen if all its pixels are seen and its mean is above
    `minimum`, which must not be negative. cell: a block's side is a multiple of this number of
    pixels (2 for a mosaic).
    """
    h, w = signal.shape
    by = cell * max(1, -(-max(h, w) // (cell * MAX_SIDE_PX)))
    size = (w // by, h // by)
    part = np.s_[: size[1] * by, : size[0] * by]
    mean = cv2.resize(signal[part], size, interpolation=cv2.INTER_AREA)
    share = cv2.resize(
        seen_mask[part].view(np.uint8) * np.uint8(255), size, interpolation=cv2.INTER_AREA
    )
    complete = (share == 255) & (mean > minimum)
    return Small(np.log(np.where(complete, mean, 1.0)).astype(np.float32), complete, by)


def shifts(
    frames: Sequence[Small], lenses: Sequence[LensGeometry], names: Sequence[str]
) -> list[ShiftQuality]:
    """Return the turns of the camera between neighbouring frames of a bracket.

    frames: most exposed first; lenses: with centres in sensor pixels of the frames; names: of the
    frames. shift_px of a turn is its angle about any axis by the pixels per radian at the first
    lens's axis. A pair of frames without enough common edges is omitted.
    """
    if len(frames) < 2 or min(frames[0].log_light.shape) < 16:
        return []
    flow, inside = _flow(tuple(lenses), frames[0].step, frames[0].log_light.shape)
    flows = [flow]
    pyramids = [_pyramid(replace(frame, seen=frame.seen & inside)) for frame in frames]
    while len(flows) < len(pyramids[0]):
        flows.append(np.ascontiguousarray(0.5 * flows[-1][:, ::2, ::2], np.float32))
    lens = lenses[0]
    px_per_rad = float(lens.radius_px * radius_of_angle(lens, _TINY_RAD) / _TINY_RAD)
    turns = []
    for i in range(len(frames) - 1):
        turn = _turn(pyramids[i], pyramids[i + 1], flows)
        if turn is not None:
            angle, u = turn
            px, u_px = angle * px_per_rad, u * px_per_rad
            figures = float(np.degrees(angle)), px, u_px, max(px - 3.0 * u_px, 0.0)
            turns.append(
                ShiftQuality(names[i], names[i + 1], *(round(float(v), 3) for v in figures))
            )
    return turns


@lru_cache(maxsize=2)
def _flow(
    lenses: tuple[LensGeometry, ...], step: int, shape: tuple[int, int]
) -> tuple[Floats32, Mask]:
    """Return how reduced pixels move when the camera turns, and a mask inside the lens's rim.

    The motion is [6, h, w]: x and y for a turn about each of three axes [px/rad].
    """
    y, x = ((np.arange(n) + 0.5) * step for n in shape)
    flow, inside = np.zeros((6, *shape), np.float32), np.zeros(shape, bool)
    for lens in lenses:
        within = (
            np.hypot(x - lens.centre_px[0], y[:, None] - lens.centre_px[1]) < _RIM * lens.radius_px
        )
        rows, columns = np.nonzero(within & ~inside)
        rays = lens_rays(lens, x[columns], y[rows])
        for axis, unit in enumerate(np.eye(3)):
            turned = lens_pixels(lens, rays + _TINY_RAD * np.cross(unit, rays))[:2]
            for k, (there, here) in enumerate(zip(turned, (x[columns], y[rows]), strict=True)):
                flow[2 * axis + k, rows, columns] = (there - here) / _TINY_RAD / step
        inside |= within
    return flow, inside


def _pyramid(small: Small) -> list[tuple[Floats32, Mask]]:
    levels = [(small.log_light, small.seen)]
    while len(levels) < _LEVELS and min(levels[-1][0].shape) >= 64:
        light, seen_mask = levels[-1]
        size = (light.shape[1] // 2, light.shape[0] // 2)
        part = np.s_[: 2 * size[1], : 2 * size[0]]
        weight, total = (
            cv2.resize(v[part].astype(np.float32), size, interpolation=cv2.INTER_AREA)
            for v in (seen_mask, np.where(seen_mask, light, 0.0))
        )
        mean = np.divide(total, weight, out=np.zeros_like(total), where=weight > 0)
        levels.append((mean, weight > 0.99))
    return levels


def _turn(
    first: list[tuple[Floats32, Mask]], second: list[tuple[Floats32, Mask]], flows: list[Floats32]
) -> tuple[float, float] | None:
    """Return the turn between two frames [rad] and its standard error.

    None for too few common edges.
    """
    turn, covariance = np.zeros(3), None
    for level in range(len(flows) - 1, -1, -1):
        for _ in range(_STEPS):
            step = _step(first[level], second[level], flows[level], turn)
            if step is None:
                break  # too few edges at this size; a finer size may have more
            turn, covariance = turn + step[0], step[1]
            if np.abs(step[0]).max() * np.abs(flows[level]).max() < 0.02:
                break
    if covariance is None:
        return None
    angle = float(np.linalg.norm(turn))
    along = turn / max(angle, 1e-12)
    return angle, float(np.sqrt(max(along @ covariance @ along, 1e-16)))


def _step(
    a: tuple[Floats32, Mask], b: tuple[Floats32, Mask], flow: Floats32, turn: Floats
) -> tuple[Floats, Floats] | None:
    """Return the next correction of `turn` [3] in rad, and its covariance."""
    h, w = a[0].shape
    y, x = np.mgrid[:h, :w].astype(np.float32)
    for k in range(3):
        x += np.float32(turn[k]) * flow[2 * k, :h, :w]
        y += np.float32(turn[k]) * flow[2 * k + 1, :h, :w]
    moved = cv2.remap(b[0], x, y, cv2.INTER_LINEAR)
    in_view = cv2.remap(b[1].astype(np.float32), x, y, cv2.INTER_LINEAR) > 0.999
    near = np.ones((5, 5), np.uint8)
    both = cv2.erode((in_view & a[1]).view(np.uint8), near, borderValue=0)
    still, other = (cv2.GaussianBlur(v * both, (3, 3), 0.8) for v in (a[0], moved))
    both = cv2.erode(both, near, borderValue=0).view(np.bool_)
    mean = 0.5 * (still + other)
    down, right = np.gradient(mean, axis=0), np.gradient(mean, axis=1)
    flat = max(_FLAT, _SMOOTH_PER_RAD / max(float(np.abs(flow).max()), 1e-6))
    rows, columns = np.nonzero(both & (down**2 + right**2 > flat**2))
    if len(rows) < _MIN_PIXELS:
        return None
    thin = len(rows) // _MAX_PIXELS + 1
    at = rows, columns = rows[::thin], columns[::thin]
    level = mean[at].astype(np.float64)
    slopes = [right[at] * flow[2 * k][at] + down[at] * flow[2 * k + 1][at] for k in range(3)]
    design = np.stack(
        [*slopes, np.ones_like(level), level - level.mean()], axis=1, dtype=np.float64
    )
    block = rows * _BLOCKS // h * _BLOCKS + columns * _BLOCKS // w
    if np.unique(block).size < _MIN_BLOCKS:
        return None
    fit = fit_turn(design, (still - other)[at].astype(np.float64), block)
    return None if fit is None else (fit[0][:3], fit[1][:3, :3])
