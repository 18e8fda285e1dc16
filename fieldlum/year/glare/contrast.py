"""Compute contrast, window to task and uniformity of a map.

RAMMG is the mean local contrast over the levels of a picture pyramid (Rizzi, Algeri, Medeghini and
Marini 2004). In cd/m2 it follows the code of Liu, Colburn and Inanici 2020: five levels, halved by
OpenCV's bilinear resize; eight neighbours weighted 1 and 1/sqrt(2) over 4 + 2 sqrt(2); border
pixels count as no contrast; no solid angles; no wrap at the seam. The L* form is the same for
CIELAB lightness, which Rizzi describes.
"""

from __future__ import annotations

import numpy as np

from fieldlum.core.arrays import Floats, Floats32, Mask
from fieldlum.optics.projection import FULLY_SEEN_SHARE, equirect_rays, equirect_solid_angles
from fieldlum.year.glare.geometry import view_frame

RAMMG_LEVELS = 5  # as the authors' code (Liu, Colburn and Inanici 2020)
# The white of L* relative to the map's mean, so that the mean is a grey of 20 %. Chosen, not
# measured.
WHITE_OVER_MEAN = 5.0
# The task is a cone around a desk in front of an observer who looks horizontally. Chosen, not
# measured.
TASK_ALTITUDE_DEG = -30.0
TASK_RADIUS_DEG = 15.0
BAND_DEG = 20.0  # the 40-degree horizontal band of Van Den Wymelenberg and Inanici 2014
WINDOW_CDM2 = 2000.0  # brighter pixels are window, the limit of a glare source; not measured


def local_contrast(image: Floats) -> Floats:
    """Return the weighted mean absolute difference of each pixel to its eight neighbours, [H, W].

    Diagonal neighbours have the weight 1 / sqrt(2), the others 1. Pixels on the border of the image
    [H, W] are 0.
    """
    values = np.asarray(image, np.float64)
    out = np.zeros_like(values)
    height, width = values.shape
    if min(height, width) < 3:
        return out
    centre = values[1:-1, 1:-1]
    total = np.zeros_like(centre)
    for row in (-1, 0, 1):
        for column in (-1, 0, 1):
            if row or column:
                near = values[1 + row : height - 1 + row, 1 + column : width - 1 + column]
                total += np.abs(centre - near) / (np.sqrt(2.0) if row and column else 1.0)
    out[1:-1, 1:-1] = total / (4.0 + 2.0 * np.sqrt(2.0))
    return out


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


def rammg_lightness(luminance_cdm2: Floats) -> float:
    """Return RAMMG, the mean contrast of five pyramid levels, of a map's lightness L*.

    luminance_cdm2 : [H, W = 2H]. White (L* = 100) is five times the map's mean luminance, weighted
    by solid angle.
    """
    image = np.asarray(luminance_cdm2, np.float64)
    omega = equirect_solid_angles(*image.shape)
    white = max(WHITE_OVER_MEAN * float((image * omega).sum() / omega.sum()), 1e-6)
    return float(contrast_levels(lightness(image / white)).mean())


def lightness(relative: Floats) -> Floats:
    """Return CIE 1976 L*, 0 to 100, of luminance relative to white.

    relative : luminance over the luminance of white (Y / Yn), of any shape, which is the shape of
    the result; values outside 0 to 1 are clipped.
    """
    ratio = np.clip(relative, 0.0, 1.0)
    return np.where(ratio > (6 / 29) ** 3, 116.0 * np.cbrt(ratio) - 16.0, ratio * (29 / 3) ** 3)


class ViewRegions:
    """The pixels of a panorama in three regions of the view, for d view directions.

    Each region is [H * W, d]: the solid angle of a pixel in it, sr; 0 outside. task : a cone of 15
    degrees radius around the direction 30 degrees below the line of sight. band : within 20 degrees
    of the horizon, in front of the observer. half : the hemisphere in front. `ratios` computes the
    figures of maps.
    """

    def __init__(
        self,
        height: int,
        width: int,
        heading_deg: float,
        azimuths_deg: Floats,
        seen_mask: Mask | None = None,
    ) -> None:
        """Compute the weights. seen_mask: pixels that a lens saw [H, W]; None for all."""
        rays = equirect_rays(height, width, heading_deg).reshape(-1, 3)
        omega = equirect_solid_angles(height, width).ravel()
        task, band, half = [], [], []
        for azimuth in np.atleast_1d(azimuths_deg):
            ahead = rays @ view_frame(float(azimuth))[2] > 0
            to_task = rays @ view_frame(float(azimuth), TASK_ALTITUDE_DEG)[2]
            task.append(omega * (to_task > np.cos(np.radians(TASK_RADIUS_DEG))))
            band.append(omega * (ahead & (np.abs(rays[:, 2]) < np.sin(np.radians(BAND_DEG)))))
            half.append(omega * ahead)
        self.task = np.array(task, np.float32).T  # (H W, d)
        self.band = np.array(band, np.float32).T  # (H W, d)
        self.half = np.array(half, np.float32).T  # (H W, d)
        self._known = [_region_seen(part, seen_mask) for part in (self.task, self.band, self.half)]

    def ratios(self, luminance_cdm2: Floats) -> dict[str, Floats]:
        """Return three figures by name, [n, d] each, of n maps in d view directions.

        luminance_cdm2 : [n, H, W]. task_cdm2 : mean luminance of the task cone, which has 15
        degrees radius and is 30 degrees below the line of sight. window_to_task : mean luminance of
        the pixels above 2000 cd/m2 in the front hemisphere, over task_cdm2; NaN without such
        pixels. uniformity : harmonic over arithmetic mean luminance of the band within 20 degrees
        of the horizon: 1 if the band is uniform, less with dark corners. A figure is NaN if lenses
        saw less than 98 % of its region.
        """
        flat = np.asarray(luminance_cdm2, np.float32).reshape(len(luminance_cdm2), -1)
        task = flat @ self.task / self.task.sum(axis=0)
        bright = flat > WINDOW_CDM2
        power = (flat * bright) @ self.half
        area = bright.astype(np.float32) @ self.half
        window = np.divide(power, area, out=np.full_like(power, np.nan), where=area > 0)
        mean = flat @ self.band / self.band.sum(axis=0)
        inverse = (1.0 / np.maximum(flat, 0.1)) @ self.band / self.band.sum(axis=0)
        task_known, band_known, half_known = self._known
        ratio = window / np.maximum(task, 1e-6)
        uniformity = 1.0 / np.maximum(inverse * mean, 1e-9)
        return {
            "task_cdm2": np.where(task_known, task, np.nan).astype(float),
            "window_to_task": np.where(task_known & half_known, ratio, np.nan).astype(float),
            "uniformity": np.where(band_known, uniformity, np.nan).astype(float),
        }


def _region_seen(weights: Floats32, seen_mask: Mask | None) -> Mask:
    """Return whether lenses saw the regions with these weights [H * W, d], [d]."""
    if seen_mask is None or seen_mask.all():
        return np.ones(weights.shape[1], bool)
    return seen_mask.ravel() @ weights >= FULLY_SEEN_SHARE * weights.sum(axis=0)
