"""Find panes, and the transmittance of each: smooth in direction, judged by its own open sky."""

from __future__ import annotations

import numpy as np

from fieldlum.core.arrays import Floats, Mask

# A pane this small takes the transmittance of the nearest larger one: gaps between leaves and slats
# are not panes. A pane of 40 cm at 8 m has 8 square degrees. Chosen.
_MIN_PANE_DEG2 = 8.0
# Transmittance changes by 5 % in 10 degrees at 60 degrees of incidence (EN 410).
_SMOOTH_DEG = 5.0
_OPEN_SHARE = 0.75  # of the pane's bright tenth: less is a partly open pixel; chosen


def pane_transmittance(through: Floats, sky: Mask, step_deg: float) -> Floats:
    """Return the transmittance of the pane in each direction, [h, w]; through where there is none.

    through: openness times transmittance; sky: where it follows the sky. Connected directions are a
    pane.
    """
    from scipy.ndimage import distance_transform_edt, gaussian_filter, label

    labels = np.empty(sky.shape, np.int32)
    count = int(label(sky, np.ones((3, 3)), output=labels))  # pyright: ignore[reportArgumentType]
    level = np.where(sky, through, 0.0)
    sizes = np.bincount(labels.ravel(), minlength=count + 1) * step_deg**2
    large = np.flatnonzero(sizes >= _MIN_PANE_DEG2)
    large = large[large > 0]
    if not len(large):
        return np.maximum(np.nan_to_num(through), 1e-6)
    for pane in large:
        inside = labels == pane
        bright = float(np.quantile(through[inside], 0.9))
        open_ = inside & (through >= _OPEN_SHARE * bright)
        sigma = _SMOOTH_DEG / step_deg
        weight = gaussian_filter(open_.astype(float), sigma, truncate=3.0)
        mean = gaussian_filter(np.where(open_, through, 0.0), sigma, truncate=3.0)
        smooth = np.where(weight > 1e-6, mean / np.maximum(weight, 1e-9), bright)
        level[inside] = np.maximum(smooth, _OPEN_SHARE * bright)[inside]
    of_large = np.isin(labels, large)
    nearest = np.empty((2, *sky.shape), np.int32)
    distance_transform_edt(~of_large, return_distances=False, return_indices=True, indices=nearest)
    row, column = nearest
    far = np.hypot(*(nearest - np.indices(sky.shape)))
    near = ~of_large & (far * step_deg <= _SMOOTH_DEG)
    taken = level[row, column]
    own = np.maximum(np.nan_to_num(through), 1e-6)
    return np.where(of_large, level, np.where(near, np.maximum(taken, own), own))
