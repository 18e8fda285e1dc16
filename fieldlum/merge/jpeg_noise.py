"""Measure the noise of JPEG frames over areas as large as a map's pixel, from the bracket itself.

The noise of raw pixels is independent, so that a mean over n pixels has sqrt(n) times less noise.
The noise of JPEG pixels is not independent: quantised cosines and repeated rounding correlate
errors over blocks, more strongly in small files and uniform pictures, and edges spread errors over
their block. No single number describes this. But each frame of a bracket is compressed separately.
Therefore the noise is estimated from the scatter of cell means between neighbouring frames, after
removing what depends only on the level (response and exposure, which are other parts of the budget;
GUM, type A).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from fieldlum.core.arrays import Array, Floats, Floats32, Mask
from fieldlum.core.records import Flag
from fieldlum.core.statistics import MAD_TO_SIGMA
from fieldlum.merge.estimator import Merged, rows_of
from fieldlum.merge.frames import Signal
from fieldlum.optics.projection import LensGeometry
from fieldlum.optics.projection.grids import Target

_BANDS = 64  # rows of cells that are evaluated, enough for a smooth field; chosen
# Cells in one step of the curve over the level, and largest number of steps. Not measured.
_IN_A_STEP, _MAX_STEPS = 40, 24
_FAR = 4.0  # robust sigmas beyond which a cell is excluded, because something moved there; chosen
_REACH_CELLS = 1.5  # sigma of the neighbourhood over which noise is averaged [cells]; not measured
_PRIOR_CELLS = 2.0  # weight of the picture's mean, as a number of cells; not measured
_UNSURE = int(Flag.CLIPPED_HIGH | Flag.BLOOM)


class _Bands(NamedTuple):
    """Some bands of rows of a frame, at equal distances.

    light: luminance [bands, edge, columns, 3]. variance: its variance if pixel noise were
    independent, same shape. good: True for pixels that are good in all colours, [bands, edge,
    columns].
    """

    light: Floats32
    variance: Floats32
    good: Mask


def footprint_px(lens: LensGeometry, target: Target) -> float:
    """Return how many sensor pixels wide a target pixel is, averaged over the field, at least 1."""
    return max(1.0, lens.radius_px / lens.half_angle_rad * target.pixel_rad)


def with_seen_noise(
    merged: Merged, frames: Sequence[Signal], y_from_rgb: Sequence[float], edge_px: float
) -> Merged:
    """Return merged JPEG frames whose variances give the measured noise of means over cells.

    frames: of the bracket; y_from_rgb: weights of R, G, B in the luminance; edge_px: edge of a
    square cell in sensor pixels. Pixels with the flag MOTION keep their variance, because it
    already includes the frames' disagreement. If no two frames can be compared, all pixels do.
    """
    height, width = merged.value_cdm2.shape[:2]
    edge = int(np.clip(round(edge_px), 1, min(height, width)))
    stride = -(-(height // edge) // _BANDS)
    total, count = (np.zeros((-(-(height // edge) // stride), width // edge)) for _ in range(2))
    long = _bands_of(frames[0], merged, edge, stride)
    for signal in frames[1:]:
        short = _bands_of(signal, merged, edge, stride)
        pull2 = _pulls2(long, short, np.asarray(y_from_rgb, np.float64))
        count += np.isfinite(pull2)
        total += np.nan_to_num(pull2)
        long = short
    if not count.any():
        return merged
    ratio = _neighbourhood(total, count, (_REACH_CELLS / stride, _REACH_CELLS)).astype(np.float32)
    column = np.minimum(np.arange(width) // edge, ratio.shape[1] - 1)
    variance = merged.variance.copy()
    # Band by band, because factors for all pixels at once need too much memory.
    for band, scale in enumerate(ratio[:, column, None]):
        last = height if band == len(ratio) - 1 else (band + 1) * edge * stride
        at = slice(band * edge * stride, last)
        still = (merged.flags[at] & Flag.MOTION) == 0
        np.multiply(variance[at], scale, out=variance[at], where=still)
    return replace(merged, variance=variance)


def _bands_of(signal: Signal, merged: Merged, edge: int, stride: int) -> _Bands:
    height, width = (n // edge * edge for n in merged.value_cdm2.shape[:2])
    bands = []
    for first in range(0, height, edge * stride):
        at = slice(first, first + edge)
        (row,) = rows_of([signal], first, first + edge)
        w = signal.weight(merged.value_cdm2[at])
        good = (w > 0) & ((merged.flags[at] & _UNSURE) == 0)
        if row.full is not None:
            good &= ~row.full
        variance = np.divide(1.0, w * signal.per_cdm2, out=np.zeros_like(w), where=w > 0)
        bands.append((row.counts / signal.per_cdm2, variance, good.all(axis=-1)))
    light, variance, good = (np.stack(part)[:, :, :width] for part in zip(*bands, strict=True))
    return _Bands(light, variance, good)


def _pulls2(long: _Bands, short: _Bands, y_from_rgb: Floats) -> Floats:
    """Return how far two frames' cell luminances differ, squared, over the variance expected.

    The expected variance assumes independent noise. The result is [bands, cells]; NaN where less
    than half of a cell is good in both frames.
    """
    both = long.good & short.good
    pixels = _cell_sums(both)
    pull2 = np.full(pixels.shape, np.nan)
    enough = pixels >= 0.5 * both.shape[1] ** 2
    if enough.sum() < _IN_A_STEP:
        return pull2
    sums = (
        _cell_sums(v * both[..., None])[enough]
        for v in (long.light, short.light, long.variance, short.variance)
    )
    # A pixel that is black in one colour has no light there: avoid a division by zero.
    a, b, u2_a, u2_b = (np.maximum(v, 1e-12) for v in sums)
    apart = np.log(b / a)
    apart -= np.stack([_by_level(np.log(a[:, c]), apart[:, c]) for c in range(3)], axis=1)
    share = y_from_rgb * a
    share /= share.sum(axis=1, keepdims=True)
    variance = (share**2 * (u2_a / a**2 + u2_b / b**2)).sum(axis=1)
    squares = (share * apart).sum(axis=1) ** 2 / variance
    pull2[enough] = np.minimum(squares, (_FAR * MAD_TO_SIGMA) ** 2 * np.median(squares))
    return pull2


def _cell_sums(values: Array) -> Floats:
    """Return sums over cells: [bands, edge, columns, ...] becomes [bands, columns / edge, ...]."""
    bands, edge, columns = values.shape[:3]
    # Sum the rows first, because numpy sums two axes at once slowly.
    down = values.sum(axis=1, dtype=np.float64)
    return down.reshape(bands, columns // edge, edge, *values.shape[3:]).sum(axis=2)


def _by_level(level: Floats, apart: Floats) -> Floats:
    """Return the part of `apart` that depends only on the level.

    It is a line through the medians of steps with equal numbers of cells.
    """
    order = np.argsort(level)
    steps = np.array_split(order, int(np.clip(len(level) // _IN_A_STEP, 1, _MAX_STEPS)))
    places, medians = ([float(np.median(v[s])) for s in steps] for v in (level, apart))
    return np.interp(level, places, medians)


def _neighbourhood(total: Floats, count: Floats, sigma_cells: tuple[float, float]) -> Floats:
    """Return sum of `total` over sum of `count` in the neighbourhood of each cell.

    The mean over the picture counts as `_PRIOR_CELLS` additional cells.
    """
    down, across = sigma_cells
    # Effective number of equally weighted cells.
    area = np.prod(np.maximum(2 * np.sqrt(np.pi) * np.array(sigma_cells), 1.0))
    near, near_count = (
        area * cv2.GaussianBlur(v, (0, 0), sigmaX=across, sigmaY=down) for v in (total, count)
    )
    return (near + _PRIOR_CELLS * total.sum() / count.sum()) / (near_count + _PRIOR_CELLS)
