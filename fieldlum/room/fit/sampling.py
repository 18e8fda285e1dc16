"""Draw the pixels of the captures at which scenes are compared, and divide them into rays."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import binary_dilation

from fieldlum.core.arrays import Floats, Floats32, Indices
from fieldlum.learn.models.data import Dataset
from fieldlum.optics.projection import equirect_solid_angles
from fieldlum.room.fit.guess import Guess
from fieldlum.room.fit.light_below import LEAST_CDM2
from fieldlum.room.fit.renderer import surfaces
from fieldlum.room.scene.view import pixel_rays

# pixels nearer to a window are omitted, because they may look through it; chosen
_WINDOW_MARGIN_DEG = 4.0


def draw_pixels(
    data: Dataset, guess: Guess, rows: Indices, count: int, rng: np.random.Generator
) -> tuple[Indices, Floats, float]:
    """Return randomly drawn pixels, their weights, and the solid angle [sr] they are drawn from.

    rows: captures with direct sun; count: of the pixels. The probability is by solid angle. Pixels
    that brighten strongly in some hour are drawn four times as often, which the weights compensate.
    Pixels that may look through a window of the guess are not drawn.
    """
    height, width = data.shape
    _, middle = pixel_rays(height, data.heading_deg, 1)
    away = surfaces(guess, middle.astype(np.float32)).surface < 0
    margin = round(_WINDOW_MARGIN_DEG / 180.0 * height)
    glass = binary_dilation(away.reshape(height, width), iterations=max(1, margin))
    usable = data.seen & ~np.asarray(glass, bool)
    omega = np.where(usable, equirect_solid_angles(height, width), 0.0).ravel()
    bright = data.luminance_cdm2[rows].reshape(len(rows), -1)
    level = bright / np.maximum(np.median(bright, axis=0), LEAST_CDM2)
    peaks = (level.max(axis=0) > 2.0) & usable.ravel()
    boost = np.where(peaks, 4.0, 1.0)
    chance = omega * boost
    count = min(count, int((chance > 0.0).sum()))
    drawn = rng.choice(len(omega), count, replace=False, p=chance / chance.sum())
    chosen = np.sort(drawn)
    return chosen, 1.0 / boost[chosen], float(omega.sum())


def rays_of(data: Dataset, chosen: Indices, sub: int) -> tuple[Floats32, Indices]:
    """Return sub x sub rays in each chosen pixel [r, 3], and the index of each ray's pixel [r].

    Rays are unit vectors, x east, y north, z up by the stated heading.
    """
    pixel, rays = pixel_rays(data.shape[0], data.heading_deg, sub)
    place = np.full(data.shape[0] * data.shape[1], -1)
    place[chosen] = np.arange(len(chosen))
    of = place[pixel] >= 0
    return rays[of].astype(np.float32), place[pixel[of]]
