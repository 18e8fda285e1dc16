"""Sum what sun patches gain over dark pixels, for pairs of hour and ray that the sun reaches."""

from __future__ import annotations

import numpy as np

from fieldlum.core.arrays import Array, Floats, Floats32, Indices
from fieldlum.core.compiled import compiled


@compiled
def lit_gain(
    hour: Indices, ray: Indices, shine: Floats32, pixel: Indices, scale: Floats, below: Array,
    log_seen: Array, dark_loss: Array, weights: Floats, width: float,
) -> float:  # fmt: skip
    """Return the sum over n hours and m pixels of weight times dark loss less loss with patches.

    hour, ray, shine: lit pairs, and the irradiance of the ray's end per lx of the sun, times albedo
    [k]; pixel: of each ray [r]; scale: from shine to luminance of each hour [n]; below, log_seen,
    dark_loss [n, m], weights [m] and width: see `evidence.SceneEvidence`.
    """
    hours, pixels = below.shape
    total = np.zeros((hours, pixels))
    for k in range(len(hour)):
        total[hour[k], pixel[ray[k]]] += shine[k]
    gain = 0.0
    for at in range(hours):
        for place in range(pixels):
            if total[at, place] > 0.0:
                light = below[at, place] + total[at, place] * scale[at]
                squared = (np.log(light) - log_seen[at, place]) ** 2
                loss = squared / (squared + width**2)
                gain += weights[place] * (dark_loss[at, place] - loss)
    return gain
