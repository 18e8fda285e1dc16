"""Weight each pixel of each capture in training, by merge's flags and uncertainties."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats, Mask
from fieldlum.core.records import Flag, Panorama

# A clipped value is a bound; a moving object has different values in each frame; a filled value is
# from the pixel's neighbours. Bloom and noise are part of u_cdm2.
TEACHES_NOTHING = Flag.CLIPPED_HIGH | Flag.MOTION | Flag.FILLED
_HALF = 1e-2  # relative variance at which a value has half weight, as for the irradiance; chosen
# A pixel that is flagged in most captures (a lamp that is always clipped) is used with its values.
# Chosen.
_MOSTLY = 0.5
_DOUBTFUL = 0.1  # not measured


def weight_of(relative_u: Floats) -> Floats:
    """Return 1 / (1 + u^2 / 0.01), the weight of values with relative standard uncertainty u."""
    return 1.0 / (1.0 + relative_u**2 / _HALF)


def pixel_counts(panorama: Panorama) -> NDArray[np.float16] | None:
    """Return the weight of each pixel in training, 0 to 1, [H, W].

    It is 0 where `flags` mark a clipped, moving or filled pixel, else `weight_of` the relative
    uncertainty (1 without uncertainties). None if the picture has neither flags nor uncertainties.
    """
    if panorama.flags is None and panorama.u_cdm2 is None:
        return None
    counts = np.ones(panorama.luminance_cdm2.shape)
    if panorama.u_cdm2 is not None:
        light = np.maximum(np.nan_to_num(panorama.luminance_cdm2), 1e-6)
        relative = np.nan_to_num(np.asarray(panorama.u_cdm2, float) / light, posinf=1e3)
        counts = weight_of(relative)
    if panorama.flags is not None:
        counts = np.where((panorama.flags & TEACHES_NOTHING) != 0, 0.0, counts)
    return counts.astype(np.float16)


def joined_counts(
    each: Sequence[NDArray[np.float16] | None], has_value: Mask
) -> NDArray[np.float16] | None:
    """Return the weights of the pixels of all captures [n, H, W]; None if all weights are 1.

    each: result of `pixel_counts` for each capture, where None means 1; has_value: mask [n, H, W],
    False where a value is missing, whose weight is 0. The weights of each pixel are divided by
    their maximum: an uncertainty that is common to all captures (the camera's scale) does not make
    one capture better than another. A pixel without weight in most captures gets at least 0.1.
    """
    if all(counts is None for counts in each) and has_value.all():
        return None
    ones = np.ones(has_value.shape[1:], np.float16)
    counts = np.stack([ones if weights is None else weights for weights in each])
    counts[~has_value] = 0.0
    largest = counts.max(axis=0)
    counts /= np.where(largest > 0.0, largest, np.float16(1.0))
    mostly = (counts == 0.0).mean(axis=0) > _MOSTLY
    counts[:, mostly] = np.maximum(counts[:, mostly], np.float16(_DOUBTFUL))
    return counts
