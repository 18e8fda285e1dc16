"""Doubts about computed sun patches: displaced edges, and pixels in which no capture shows them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats, Floats32, Mask

# How far the patches of a fitted scene are displaced, seen from the camera. In rooms of
# bench/scene_judge.py edges are 1 to 2 cm off, at some 3 m, and the sun 0.2 degrees. With 1 degree
# errors are the same within 3 %.
SCENE_SLIP_DEG = 0.5
# Standard deviation of ln L at which a value has half weight; that of the robust rounds.
_HALF_WEIGHT_SD = 0.15
# A computed patch is refuted in a pixel if at least so many captures should show it, and in most of
# them the pixel is darker than this share of it. Chosen: a displaced edge refutes single
# captures, and leaves of a tree half of them.
_LEAST_CAPTURES, _LEAST_SHARE, _MOST_POSSIBLE = 4, 0.8, 0.45


def edge_range(patch: Floats32, slip_px: float) -> tuple[NDArray, NDArray, float]:
    """Return the least and the largest patch luminance near each pixel, and a probability.

    Both arrays are [n, H, W], over the square of pixels within `slip_px` (rounded up, at least 1)
    in each direction. The third value is the probability that a pixel near a straight edge is on
    its other side once the edge is displaced by `slip_px`, 0 to 0.5.
    """
    from scipy.ndimage import maximum_filter, minimum_filter

    reach = max(1, math.ceil(slip_px))
    size = (1, 2 * reach + 1, 2 * reach + 1)
    wide = np.pad(patch, ((0, 0), (0, 0), (reach, reach)), mode="wrap")
    inner = (slice(None), slice(None), slice(reach, -reach))
    low, high = (
        minimum_filter(wide, size, mode="nearest"),
        maximum_filter(wide, size, mode="nearest"),
    )
    return low[inner], high[inner], slip_px / (2.0 * reach)


def slip_variance(
    patch: Floats32, seen: Mask, gain: Floats32, dark: Floats, slip_px: float
) -> Floats:
    """Return the variance of ln L due to sun patches displaced by `slip_px`, [n, P].

    patch: luminance of sun patches [n, H, W] cd/m2; seen: mask [H, W] of the P pixels; gain: factor
    on the patch [P]; dark: luminance without the patch [n, P] cd/m2.
    """
    low, high, odds = edge_range(patch, slip_px)
    span = np.log((dark + gain * high[:, seen]) / (dark + gain * low[:, seen]))
    return np.float32(odds) * span**2


def edge_weights(
    patch: Floats32, seen: Mask, luminance: Floats32, total_lx: Floats
) -> NDArray[np.float16]:
    """Return the weight of each captured value next to patches of a fitted scene, 0 to 1, [n, P].

    A value at the edge of a patch may show sun where the scene has shade, so it teaches little.
    patch: luminance of sun patches [n, H, W] cd/m2; seen: mask [H, W] of the P pixels; luminance:
    captured [n, P] cd/m2; total_lx: light of the sky and the sun [n].
    """
    total = total_lx[:, None]  # [n, 1]
    dark = np.median(luminance / total, axis=0) * total  # [n, P]
    slip_px = SCENE_SLIP_DEG * patch.shape[1] / 180.0
    gain = np.ones(luminance.shape[1], np.float32)
    variance = slip_variance(patch, seen, gain, dark, slip_px)
    return (1.0 / (1.0 + variance / _HALF_WEIGHT_SD**2)).astype(np.float16)


def refuted_patches(patch: Floats32, luminance: Floats32, trust: Floats) -> NDArray[np.bool_]:
    """Return the pixels whose captures are darker than their computed sun patch, [P].

    So is the ground that a room model assumes where a picture shows a neighbour's shaded wall.
    patch: luminance of sun patches [n, P] cd/m2; luminance: captured [n, P] cd/m2; trust: weight of
    each value, 0 to 1 [n, P].
    """
    lit = (patch > _LEAST_SHARE * luminance) & (trust > 0.0)
    possible = lit & (luminance > _LEAST_SHARE * patch)
    count = lit.sum(axis=0)
    return (count >= _LEAST_CAPTURES) & (possible.sum(axis=0) < _MOST_POSSIBLE * count)
