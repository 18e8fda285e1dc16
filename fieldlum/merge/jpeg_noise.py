"""The noise of JPEG frames over areas as large as a map's pixel, as the bracket itself shows it.

A raw pixel's noise is its own, so that a mean over n of them is sqrt(n) times quieter. A JPEG's is
not: quantised cosines and values rounded twice err alike over whole blocks, the more so the coarser
the file and the flatter the picture; edges spread theirs over the block. No one figure of codes
holds for that. But frames of a bracket are compressed each for itself: how far cell means of
neighbouring frames scatter, beyond what depends on the level alone (response and exposure, which
have their own places in the budget), is that noise (GUM, type A).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.merge.estimator import Merged, Signal, Strip
from fieldlum.merge.frame_cache import FrameStore
from fieldlum.projection import LensGeometry
from fieldlum.projection.grids import Target
from fieldlum.records import Flag
from fieldlum.statistics import MAD_TO_SIGMA

_BANDS = 64  # rows of cells that are looked at: enough for a field that is smooth
_IN_A_STEP, _MOST_STEPS = (
    40,
    24,
)  # cells for one step of the curve over the level, and how many steps at most
_FAR = 4.0  # robust sigmas beyond which a cell counts no more: something moved
_REACH_CELLS = 1.5  # sigma of the neighbourhood that speaks for a place
_PRIOR_CELLS = 2.0  # the weight of the whole picture's figure in it
_UNSURE = int(Flag.CLIPPED_HIGH | Flag.BLOOM)


@dataclass(frozen=True, slots=True)
class _Bands:
    """Every so many rows of a frame, [bands, edge, columns, 3]: luminance and its variance, were
    noise each pixel's own; good [bands, edge, columns] in all colours.
    """

    light: Strip
    variance: Strip
    good: NDArray[np.bool_]


def footprint_px(lens: LensGeometry, target: Target) -> float:
    """Edge of a target pixel on the sensor, in the middle of the lens's field."""
    return max(1.0, lens.radius_px / lens.half_angle_rad * target.pixel_rad)


def with_seen_noise(
    merged: Merged, store: FrameStore, y_from_rgb: Sequence[float], edge_px: float
) -> Merged:
    """The merged JPEG frames with variances for which means over cells of `edge_px` pixels have the
    noise seen.

    What is flagged as moving keeps its variance, which is that of the frames' disagreement already.
    """
    height, width = merged.value_cdm2.shape[:2]
    edge = int(np.clip(round(edge_px), 1, min(height, width)))
    stride = -(-(height // edge) // _BANDS)
    total, count = (np.zeros((-(-(height // edge) // stride), width // edge)) for _ in range(2))
    long = _bands_of(store[0], merged, edge, stride)
    for number in range(1, len(store)):
        short = _bands_of(store[number], merged, edge, stride)
        pull2 = _pulls2(long, short, np.asarray(y_from_rgb, np.float64))
        count += np.isfinite(pull2)
        total += np.nan_to_num(pull2)
        long = short
    if not count.any():
        return merged
    ratio = _neighbourhood(total, count, (_REACH_CELLS / stride, _REACH_CELLS)).astype(np.float32)
    column = np.minimum(np.arange(width) // edge, ratio.shape[1] - 1)
    variance = merged.variance.copy()
    for band, scale in enumerate(
        ratio[:, column, None]
    ):  # band by band: whole arrays of factors are what memory lacks
        at = slice(
            band * edge * stride, height if band == len(ratio) - 1 else (band + 1) * edge * stride
        )
        np.multiply(
            variance[at], scale, out=variance[at], where=(merged.flags[at] & Flag.MOTION) == 0
        )
    return replace(merged, variance=variance)


def _bands_of(signal: Signal, merged: Merged, edge: int, stride: int) -> _Bands:
    height, width = (n // edge * edge for n in merged.value_cdm2.shape[:2])
    found = [_band(signal, merged, first, edge, width) for first in range(0, height, edge * stride)]
    light, variance, good = (np.stack(part) for part in zip(*found, strict=True))
    return _Bands(light, variance, good)


def _band(
    signal: Signal, merged: Merged, first: int, edge: int, width: int
) -> tuple[Strip, Strip, NDArray[np.bool_]]:
    """Luminance, variance [edge, width, 3], and whether a pixel is good in all colours [edge,
    width].
    """
    at = slice(first, first + edge)
    counts, full = signal.strip(first, first + edge)
    w = signal.weight(merged.value_cdm2[at])
    good = (w > 0) & ((merged.flags[at] & _UNSURE) == 0)
    if full is not None:
        good &= ~full
    variance = np.divide(1.0, w * signal.per_cdm2, out=np.zeros_like(w), where=w > 0)
    every = good[..., 0] & good[..., 1] & good[..., 2]
    return (counts / signal.per_cdm2)[:, :width], variance[:, :width], every[:, :width]


def _pulls2(long: _Bands, short: _Bands, y_from_rgb: NDArray[np.float64]) -> NDArray[np.float64]:
    """Squares of how far the two frames' luminances of a cell lie apart over the u of
    independent pixels, [bands, cells]; not a number where less than half of a cell is good in
    both.
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
    a, b, u2_a, u2_b = (
        np.maximum(v, 1e-12) for v in sums
    )  # black in one colour: no light, but no division either
    apart = np.log(b / a)
    apart -= np.stack([_by_level(np.log(a[:, c]), apart[:, c]) for c in range(3)], axis=1)
    share = y_from_rgb * a
    share /= share.sum(axis=1, keepdims=True)
    variance = (share**2 * (u2_a / a**2 + u2_b / b**2)).sum(axis=1)
    found = (share * apart).sum(axis=1) ** 2 / variance
    pull2[enough] = np.minimum(found, (_FAR * MAD_TO_SIGMA) ** 2 * np.median(found))
    return pull2


def _cell_sums(values: NDArray[Any]) -> NDArray[np.float64]:
    """Over cells of edge x edge pixels: [bands, edge, columns, ..] to [bands, columns / edge,
    ..].
    """
    bands, edge, columns = values.shape[:3]
    down = values.sum(
        axis=1, dtype=np.float64
    )  # whole rows first: both at once would go three colours at a time
    return down.reshape(bands, columns // edge, edge, *values.shape[3:]).sum(axis=2)


def _by_level(level: NDArray[np.float64], apart: NDArray[np.float64]) -> NDArray[np.float64]:
    """What of `apart` depends on the level alone: medians over steps of equally many cells,
    joined by lines.
    """
    order = np.argsort(level)
    steps = np.array_split(order, int(np.clip(len(level) // _IN_A_STEP, 1, _MOST_STEPS)))
    places, medians = ([float(np.median(v[s])) for s in steps] for v in (level, apart))
    return np.interp(level, places, medians)


def _neighbourhood(
    total: NDArray[np.float64], count: NDArray[np.float64], sigma_cells: tuple[float, float]
) -> NDArray[np.float64]:
    """Mean of `total` over `count` around each cell, with the whole picture's as so many cells
    more.
    """
    import cv2

    down, across = sigma_cells
    area = np.prod(
        np.maximum(2 * np.sqrt(np.pi) * np.array(sigma_cells), 1.0)
    )  # cells that would do as much alike
    near, seen = (
        area * cv2.GaussianBlur(v, (0, 0), sigmaX=across, sigmaY=down) for v in (total, count)
    )
    return (near + _PRIOR_CELLS * total.sum() / count.sum()) / (seen + _PRIOR_CELLS)
