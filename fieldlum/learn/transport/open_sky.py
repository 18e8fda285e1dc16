"""Find the pixels that show sky through glass, and the luminance of the sky behind them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fieldlum.core.arrays import Array, Floats, Floats32, Indices, Mask
from fieldlum.core.statistics import nan_percentiles
from fieldlum.sky.light import Light

LEAST_CDM2 = 0.1  # in darker pixels relative errors have no meaning; not measured
WINDOW_SHARE = 0.05  # a pixel with a smaller share of open sky counts as a surface; chosen
# Largest ratio of two scatters for a window pixel: of its luminance over the sky behind it, and
# over the total light. Chosen.
WINDOW_SCATTER = 0.5


@dataclass(frozen=True, slots=True)
class OpenSky:
    """The k window pixels: those of the camera's pixels that show sky through glass.

    index: their positions in the list of the P pixels that the lens saw [k]; share: captured
    luminance over that of the sky behind the glass (transmittance times unobstructed share, 0 to 1)
    [k]; directions: unit vectors from the camera, x east, y north, z up [k, 3].
    """

    index: Indices
    share: Floats32
    directions: Array  # [k, 3]

    def luminance(self, light: Light) -> Floats32:
        """Return the Perez sky's luminance behind these pixels times `share`, [n, k] cd/m2."""
        return light.sky_at(self.directions) * self.share

    def mask(self, seen_mask: Mask) -> Mask:
        """Return a mask [H, W], True at window pixels.

        seen_mask: mask [H, W], True at the P pixels that the lens saw, to which `index` refers.
        """
        flat = np.zeros(int(seen_mask.sum()), bool)
        flat[self.index] = True
        out = np.zeros(seen_mask.shape, bool)
        out[seen_mask] = flat
        return out


def open_sky_from_captures(
    luminance: Floats, patch: Floats | None, light: Light, rays: Array
) -> OpenSky:
    """Find the window pixels without any geometry: they follow the Perez sky behind them.

    luminance, patch: of captures and of sun patches [n, P] cd/m2, patch is None if unknown; rays:
    unit vectors of the pixels [P, 3]. A pixel above the horizon is a window if, over the hours, the
    logarithm of luminance over sky scatters less than half as much as that of luminance over total
    light, and luminance over sky is that of glass (0.05 to 1.2). Its `share` is the 10th
    percentile of luminance over sky, so that the sky rarely exceeds the captured luminance.
    """
    above = np.flatnonzero(rays[:, 2] > 0.0)
    behind = light.sky_at(rays[above])
    captured = np.maximum(luminance[:, above], LEAST_CDM2)
    ratio, plain = (
        np.log(captured / behind),
        np.log(captured / light.total_lx[:, None].astype(np.float32)),
    )
    if patch is not None:
        lit = patch[:, above] > 0.3 * captured
        ratio, plain = np.where(lit, np.nan, ratio), np.where(lit, np.nan, plain)
        dark = lit.all(axis=0)
        ratio[:, dark], plain[:, dark] = 0.0, 0.0
    low, middle, high = nan_percentiles(ratio, (10, 50, 90))
    spread = np.subtract(*nan_percentiles(plain, (90, 10)))
    share = np.exp(low)
    keep = (high - low < WINDOW_SCATTER * spread) & (share > WINDOW_SHARE) & (middle < np.log(1.2))
    return OpenSky(above[keep], share[keep].astype(np.float32), rays[above[keep]])
