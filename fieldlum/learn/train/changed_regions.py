"""Detect unmarked changes in a part of the picture: compact regions that contradict the rest.

A person or an object darkens a region of single captures. A piece of furniture that was moved
changes a region of all captures from one day on.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from fieldlum.core.arrays import Array, Mask
from fieldlum.core.statistics import MAD_TO_SIGMA
from fieldlum.learn.models.data import Dataset
from fieldlum.learn.train.agreement import Process, Rows, process_of, thinned
from fieldlum.optics.projection import equirect_rays, equirect_solid_angles

_NOISE = 3e-3  # relative variance of a capture, when the other captures predict it; chosen
_ROUNDS = 2  # rounds, so that a detected region no longer disturbs the prediction of others; chosen
# Limits, chosen on ten rooms without a change at 46 x 23 pixels: none has a region with them. With
# 2.0 and 4.0, four of 40 draws of noise (3 % of pixels and of levels) have one.
# multiple of the deviation that 95 % of the captures have in a pixel and its neighbours
_OVER_USUAL = 3.0
_USUAL_SHARE = 0.95
_LEAST_SDS = 4.5  # least deviation of a region, in standard deviations by the process
_OVER_CAPTURE = 6.0  # least deviation of a pixel, in robust standard deviations of its capture
_LEAST_SD = 0.02
_LEAST_LOG = float(np.log(1.2))  # least deviation of a pixel, ln of light
_LEAST_REGION_LOG = float(np.log(1.25))  # least median deviation of a region, ln of light
# least lasting change, ln of light; a knocked camera changes edges by a factor of 1.27
_LEAST_STEP_LOG = float(np.log(1.4))
_LASTING = 0.6  # share of a step that must remain, whichever day is omitted; chosen
_FEWEST_PIXELS = 3  # least number of pixels of a region; chosen
_SIZE_SR = (0.02, 1.5)  # smallest and largest region: a person at 6 m and at 0.6 m; chosen
# Largest deviation next to a region over that within it: an object ends at an edge, but a wrong
# prediction fades out. Chosen.
_MOST_OUTSIDE = 0.35
_DARKEST_STEP = -0.9  # ln of light: a darker region is a wrong prediction, not furniture; chosen


def object_pixels(data: Dataset, *, with_patch: bool) -> Mask:
    """Return a mask [n, H, W], True at pixels that a person or an object darkens in a capture.

    The other captures predict each capture. With under four days that can be judged, no pixel is
    True. Brighter regions are not searched, because they can be direct sun that the room does not
    explain. with_patch: use the sun patches of `data`.
    """
    small = thinned(data)
    process = process_of(data, with_patch=with_patch, complete=True, windows=True)
    rows = np.flatnonzero(process.judged)
    objects = np.zeros((len(data), *small.shape), bool)
    if not process.shows_exceptions:
        return np.zeros(data.luminance_cdm2.shape, bool)
    for _ in range(_ROUNDS):
        log, least, sd = _deviation(process.without(objects[:, small.seen]), rows, small.seen)
        for k, row in enumerate(rows):
            dark, limit, valid = (
                _on_grid(values, small.seen) for values in (-log[k], least[k], process.valid[row])
            )
            for region in _regions(dark, limit, valid, _LEAST_SDS * float(sd[k])):
                objects[row] |= region
    return _enlarged(objects, data.shape)


def _deviation(process: Process, rows: Rows, seen_mask: Mask) -> tuple[Array, Array, Array]:
    """Return ln of measured over predicted light, and the least deviation that counts, [k, P] each.

    The third result is the standard deviation of the prediction, [k]. For a pixel that a sun patch
    hides, the patch is part of the prediction.
    """
    out, valid = process.left_out(rows, _NOISE), process.valid[rows]
    level = np.median(process.y[rows], axis=1, keepdims=True)  # [k, 1]
    predicted = np.maximum(process.y[rows] - out.error, 0.05 * level) + process.direct[rows]
    log = np.log(np.maximum(process.measured[rows], 1e-3 * level) / predicted)
    log -= _median(log, valid)
    size, sd = np.abs(log), np.sqrt(out.variance)[:, None] / level
    usual = np.quantile(np.where(valid, size / sd, 0.0), _USUAL_SHARE, axis=0)  # [P]
    usual = sd * _around(usual, seen_mask)
    own = np.sqrt((MAD_TO_SIGMA * _median(size, valid)) ** 2 + _LEAST_SD**2)
    least = np.maximum(_OVER_USUAL * usual, np.maximum(_OVER_CAPTURE * own, _LEAST_LOG))
    return log, least, sd[:, 0]


@dataclass(frozen=True, slots=True)
class MovedObject:
    """A region of the picture whose light changed from one day on, as by moved furniture.

    day: first day with the change; factor: light of the region from that day on over that before,
    for the same light outside; azimuth_deg (clockwise from north), altitude_deg: middle of the
    region as seen from the camera; size_sr: its solid angle.
    """

    day: Any
    factor: float
    azimuth_deg: float
    altitude_deg: float
    size_sr: float


def moved_object(data: Dataset, *, with_patch: bool) -> MovedObject | None:
    """Return the clearest change of a region that lasts from one day on; None if there is none.

    For each day, generalised least squares estimate the step of each pixel in addition to what the
    light explains: a = X'Qy / X'QX, with the inverse covariance Q, and with X the usual light from
    that day on.
    """
    small = thinned(data)
    process = process_of(data, with_patch=with_patch, complete=True)
    if not process.shows_exceptions:
        return None
    rows = np.flatnonzero(process.judged)
    out = process.left_out(rows, _NOISE)
    y, level = process.y[rows], np.median(process.y[rows], axis=1)
    spread = np.sqrt(np.median(out.error**2 / out.variance[:, None], axis=0))  # [P]
    valid = _on_grid(process.valid[rows].mean(axis=0) > 0.5, small.seen)
    best, clearest = None, 0.0
    for day in np.unique(process.days[rows])[2:-1]:
        step = np.where(process.days[rows] >= day, level, 0.0)
        weights = out.inverse @ step
        amount = weights @ y / (weights @ step)  # [P]
        amount -= np.median(amount)
        log = np.where(amount > _DARKEST_STEP, np.log1p(np.maximum(amount, _DARKEST_STEP)), 0.0)
        sd = _around(spread, small.seen) / np.sqrt(weights @ step)
        own = np.hypot(MAD_TO_SIGMA * np.median(np.abs(log)), _LEAST_SD)
        least = np.maximum(_OVER_CAPTURE * np.hypot(sd, own), _LEAST_LOG)
        for sign in (-1.0, 1.0):
            signed, limit = (_on_grid(v, small.seen) for v in (sign * log, least))
            for region in _regions(signed, limit, valid, _LEAST_STEP_LOG):
                clear = float(((amount / sd) ** 2)[region[small.seen]].sum())
                if clear > clearest and _lasts(process, rows, step, region[small.seen]):
                    factor = float(np.exp(sign * np.median(signed[region])))
                    first = _first_day(process, rows, level, region[small.seen])
                    best, clearest = _placed(first, factor, region, data.heading_deg), clear
    return best


def _first_day(process: Process, rows: Rows, level: Array, region: Mask) -> Any:
    """Return the day from which a step explains most of a region's light; level: [k].

    The region's usual light is fitted with each step: a region that is darker than the rest on all
    days would otherwise have an earlier step.
    """
    y = _region_light(process, rows, region)
    days, noisy = process.days[rows], process.noisy(_NOISE)[np.ix_(rows, rows)]
    gains: dict[Any, float] = {}
    for day in np.unique(days)[1:]:
        columns = np.stack((level, np.where(days >= day, level, 0.0)), axis=1)  # [k, 2]
        weights = np.linalg.solve(noisy, columns)
        explained = weights.T @ y
        gains[day] = float(explained @ np.linalg.solve(columns.T @ weights, explained))
    return max(gains, key=gains.__getitem__)


def _region_light(process: Process, rows: Rows, region: Mask) -> Array:
    """Return the mean of a region [P] in some captures, relative to all their pixels, [k]."""
    return process.y[rows][:, region].mean(axis=1) - np.median(process.y[rows], axis=1)


def _lasts(process: Process, rows: Rows, step: Array, region: Mask) -> bool:
    """Return whether the step of a region [P] is due to more than a single day."""
    y = _region_light(process, rows, region)
    noisy, days = process.noisy(_NOISE)[np.ix_(rows, rows)], process.days[rows]

    def amount(keep: Mask) -> float:
        weights = np.linalg.solve(noisy[np.ix_(keep, keep)], step[keep])
        return float(weights @ y[keep] / (weights @ step[keep]))

    complete = amount(np.ones(len(rows), bool))
    return all(amount(days != day) / complete > _LASTING for day in np.unique(days))


def _placed(day: Any, factor: float, region: Mask, heading_deg: float) -> MovedObject:
    height, width = region.shape
    omega = np.where(region, equirect_solid_angles(height, width), 0.0)
    middle = np.einsum("ij,ijk->k", omega, equirect_rays(height, width, heading_deg))
    azimuth = float(np.degrees(np.arctan2(middle[0], middle[1]))) % 360.0
    altitude = float(np.degrees(np.arctan2(middle[2], np.hypot(middle[0], middle[1]))))
    return MovedObject(day, factor, azimuth, altitude, float(omega.sum()))


# ----------------------------------------------------------------------------------------------
# regions


def _regions(deviation: Array, least: Array, valid: Mask, least_region: float) -> list[Mask]:
    """Return the regions with a deviation that ends at an edge, as masks [H, W].

    deviation [H, W]: size of the deviation; least [H, W]: smallest size that counts, 0 where
    nothing may count; valid: pixels that decide about a region, others only complete it;
    least_region: least median deviation of a region. A region is kept if its size is that of an
    object, and if the deviation next to it is much smaller.
    """
    from scipy.ndimage import label

    omega = equirect_solid_angles(*deviation.shape)
    deviates = (deviation > least) & (least > 0.0)
    labelled: tuple[Array, int] = label(deviates, np.ones((3, 3)))  # pyright: ignore
    numbers, count = labelled
    for left, right in zip(numbers[:, 0], numbers[:, -1], strict=True):
        if left and right and left != right:  # one region on both sides of the seam
            numbers[numbers == right] = left
    regions = []
    for number in range(1, count + 1):
        region = numbers == number
        sure, size = region & valid, float(omega[region].sum())
        if sure.sum() < _FEWEST_PIXELS or not _SIZE_SR[0] <= size <= _SIZE_SR[1]:
            continue
        inside = float(np.median(deviation[sure]))
        ring = _wide(region, 2) & ~_wide(region, 1) & valid
        outside = float(np.median(deviation[ring])) if ring.any() else inside
        if inside > max(_LEAST_REGION_LOG, least_region) and outside < _MOST_OUTSIDE * inside:
            regions.append(region)
    return regions


def _median(values: Array, valid: Mask) -> Array:
    """Return the median of the valid values of each row, [k, 1]; 0 without any."""
    middle = np.ma.median(np.ma.array(values, mask=~valid), axis=1, keepdims=True)
    return np.ma.filled(middle, 0.0)


def _around(values: Array, seen_mask: Mask) -> Array:
    """Return the largest value of each pixel and its neighbours, [P]."""
    from scipy.ndimage import maximum_filter

    padded = np.pad(_on_grid(values, seen_mask), ((0, 0), (1, 1)), mode="wrap")
    return np.asarray(maximum_filter(padded, 3))[:, 1:-1][seen_mask]


def _on_grid(values: Array, seen_mask: Mask) -> Array:
    out = np.zeros(seen_mask.shape, values.dtype)
    out[seen_mask] = values
    return out


def _wide(mask: Mask, pixels: int) -> Mask:
    """Return a mask [H, W] grown by some pixels, across the seam of the panorama."""
    from scipy.ndimage import binary_dilation

    padded = np.pad(mask, ((0, 0), (pixels, pixels)), mode="wrap")
    return np.asarray(binary_dilation(padded, np.ones((3, 3)), pixels), bool)[:, pixels:-pixels]


def _enlarged(thin: Mask, shape: tuple[int, int]) -> Mask:
    """Return masks [n, h, w] of thinned pictures for complete ones, with a margin, [n, H, W]."""
    step = shape[0] // thin.shape[1]
    wide = np.stack([_wide(mask, 1) if mask.any() else mask for mask in thin])
    return np.repeat(np.repeat(wide, step, axis=1), step, axis=2)
