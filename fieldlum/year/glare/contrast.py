"""Compute contrast, window to task and uniformity of a map.

RAMMG is the mean local contrast over the levels of a picture pyramid (Rizzi, Algeri, Medeghini and
Marini 2004). In cd/m2 it follows the code of Liu, Colburn and Inanici 2020: five levels, halved by
OpenCV's bilinear resize; eight neighbours weighted 1 and 1/sqrt(2) over 4 + 2 sqrt(2); border
pixels count as no contrast; no solid angles; no wrap at the seam.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.year.glare.geometry import Views

RAMMG_LEVELS = 5  # as the authors' code (Liu, Colburn and Inanici 2020)
# The task is a cone around a desk in front of an observer who looks horizontally. Chosen.
TASK_ALTITUDE_DEG = -30.0
TASK_RADIUS_DEG = 15.0
BAND_DEG = 20.0  # the 40-degree horizontal band of Van Den Wymelenberg and Inanici 2014
WINDOW_CDM2 = 2000.0  # brighter pixels are window, the limit of a glare source; not measured
# Share of task cone or band that must be seen: 58 rows of pixels give the cone to 5 %. Chosen.
_MIN_REGION_SHARE = 0.9


def local_contrast(image: Floats) -> Floats:
    """Return the weighted mean absolute difference of each pixel to its eight neighbours, [H, W].

    Diagonal neighbours have the weight 1 / sqrt(2), the others 1. Pixels on the border of the image
    [H, W] are 0.
    """
    values = np.asarray(image, np.float64)
    inner, out = values[1:-1, 1:-1], np.zeros_like(values)
    height, width = inner.shape
    for row, column in product((0, 1, 2), (0, 1, 2)):
        near = values[row : height + row, column : width + column]
        diagonal = row != 1 and column != 1
        out[1:-1, 1:-1] += np.abs(inner - near) / (np.sqrt(2.0) if diagonal else 1.0)
    return out / (4.0 + 2.0 * np.sqrt(2.0))


def contrast_levels(image: Floats) -> Floats:
    """Return the mean local contrast of each of five pyramid levels of an image [H, W], [5].

    The first level is the image; each further one has half the rows and columns of the level
    before.
    """
    import cv2

    level = np.asarray(image, np.float64)
    means = np.zeros(RAMMG_LEVELS)
    for k in range(RAMMG_LEVELS):
        means[k] = local_contrast(level).mean()
        height, width = level.shape
        half = (max(1, width // 2), max(1, height // 2))
        level = np.asarray(cv2.resize(level, half, interpolation=cv2.INTER_LINEAR), np.float64)
    return means


def rammg(luminance_cdm2: Floats) -> float:
    """Return RAMMG [cd/m2] of a map [H, W] in cd/m2: the mean contrast of five pyramid levels.

    Remove a sun disc from the map first, because it dominates the result.
    """
    return float(contrast_levels(luminance_cdm2).mean())


class ViewRegions:
    """The pixels of a picture in three regions of the view, for d view directions.

    Each region is [P, d]: the solid angle of a pixel in it, sr; 0 outside. task : a cone of 15
    degrees radius around the direction 30 degrees below the line of sight. band : within 20 degrees
    of the horizon, in front of the observer. half : the hemisphere in front. `ratios` computes the
    figures of maps.
    """

    def __init__(self, views: Views) -> None:
        """Compute the weights."""
        rays, omega = views.rays()
        _, up, forward = np.moveaxis(rays, 1, 0)
        self.half = omega * views.ahead  # a pixel on the edge of a fisheye is often half black
        below, radius = np.radians(TASK_ALTITUDE_DEG), np.radians(TASK_RADIUS_DEG)
        self.task = self.half * (up * np.sin(below) + forward * np.cos(below) > np.cos(radius))
        self.band = self.half * (np.abs(up) < np.sin(np.radians(BAND_DEG)))
        task_sr, band_sr = (
            2 * np.pi * (1 - np.cos(radius)),
            2 * np.pi * np.sin(np.radians(BAND_DEG)),
        )
        self._task_known = self.task.sum(axis=0) >= _MIN_REGION_SHARE * task_sr
        self._band_known = self.band.sum(axis=0) >= _MIN_REGION_SHARE * band_sr

    def ratios(self, luminance_cdm2: Floats) -> dict[str, Floats]:
        """Return three figures by name, [n, d] each, of n maps in d view directions.

        luminance_cdm2 : [n, H, W]. task_cdm2 : mean luminance of the task cone, which has 15
        degrees radius and is 30 degrees below the line of sight. window_to_task : mean luminance of
        the pixels above 2000 cd/m2 in the front hemisphere, over task_cdm2; NaN without such
        pixels. uniformity : harmonic over arithmetic mean luminance of the band within 20 degrees
        of the horizon: 1 if the band is uniform, less with dark corners. Figures are of the seen
        pixels; NaN if they are less than 90 % of the task cone, or of the band.
        """
        flat = np.asarray(luminance_cdm2, np.float32).reshape(len(luminance_cdm2), -1)
        bright = flat > WINDOW_CDM2
        with np.errstate(divide="ignore", invalid="ignore"):  # regions outside the picture
            task = flat @ self.task / self.task.sum(axis=0)
            window = (flat * bright) @ self.half / (bright.astype(np.float32) @ self.half)
            mean, inverse = (
                values @ self.band / self.band.sum(axis=0)
                for values in (flat, 1.0 / np.maximum(flat, 0.1))
            )
            figures = {
                "task_cdm2": np.where(self._task_known, task, np.nan),
                "window_to_task": np.where(
                    self._task_known, window / np.maximum(task, 1e-6), np.nan
                ),
                "uniformity": np.where(self._band_known, 1.0 / (inverse * mean), np.nan),
            }
        return {name: values.astype(float) for name, values in figures.items()}
