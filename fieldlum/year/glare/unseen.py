"""Bound the DGP of views of which no lens saw a part.

An unseen part is not dark. It gets one luminance, from 0 up to the brightest that is likely; the
bounds are the least and the largest DGP over these luminances. More light on the eye can lower DGP
(the contrast term falls with Ev), so the lower bound is not always at 0 cd/m2.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from fieldlum.core.arrays import Floats, Mask
from fieldlum.optics.projection import (
    FULLY_SEEN_SHARE,
    NOT_SEEN,
    SEEN,
    equirect_solid_angles,
    seen_words,
)
from fieldlum.year.glare.geometry import Views, angles_from_view, panorama_views, position_index
from fieldlum.year.glare.metrics import dgp
from fieldlum.year.glare.picture_view import PictureGrid, centres, picture_rays, row_blocks
from fieldlum.year.glare.sources import SOURCE_CDM2

# Share of the seen solid angle that is brighter than the brightest likely luminance: a window pane
# is larger, a single bright pixel of a reflection smaller. Chosen, not measured.
BRIGHTEST_SHARE = 0.01
_LEVELS = 12  # number of luminances between 1 cd/m2 and the brightest; chosen
# Rows of a panorama of the hemisphere: its sum of solid angle over squared position index is then
# exact to 1e-4. Chosen.
_HEMISPHERE_ROWS = 180
_THIN = 4  # use every fourth row and column, which suffices for a percentile; only for speed


@dataclass(frozen=True, slots=True)
class ViewCoverage:
    """The seen and unseen parts of d view directions.

    seen_share [d] : share (0 to 1) of the vertical illuminance of a uniform field that comes from
    seen pixels; unseen_illuminance [d] : sum over the unseen pixels of solid angle times cosine,
    sr; unseen_sources [d] : their solid angle over the square of the position index, sr. Times a
    luminance and a squared luminance, the last two give what the unseen pixels add to Ev and to
    `contrast`.
    """

    seen_share: Floats
    unseen_illuminance: Floats
    unseen_sources: Floats

    @property
    def words(self) -> tuple[str, ...]:
        """State of each direction, [d].

        "seen" from a seen_share of 0.98 on, "partly seen" from 0.5 on, otherwise "not seen".
        """
        return seen_words(self.seen_share)

    @property
    def judged(self) -> Mask:
        """Mask [d], True for directions that are seen or partly seen and therefore have figures."""
        return np.array([word != NOT_SEEN for word in self.words])

    @property
    def complete(self) -> Mask:
        """Mask [d], True for directions that are completely seen."""
        return np.array([word == SEEN for word in self.words])

    @property
    def partly(self) -> Mask:
        """Mask [d], True for partly seen directions, whose DGP has bounds."""
        return np.array([word not in (SEEN, NOT_SEEN) for word in self.words])


def view_coverage(seen_mask: Mask | None, views: Views) -> ViewCoverage:
    """Return how much of each view direction of `views` lenses saw.

    seen_mask : mask [H, W] of the panorama, True for pixels that a lens saw; None if all were seen.
    """
    count = len(views.azimuths_deg)
    if seen_mask is None or seen_mask.all():
        return ViewCoverage(np.ones(count), np.zeros(count), np.zeros(count))
    blind = ~seen_mask.ravel()
    missing = views.illuminance[blind].sum(axis=0, dtype=float)
    total = views.illuminance.sum(axis=0, dtype=float)
    omega, right, up = np.moveaxis(views.moments[blind].astype(float), 1, 0)  # [k, d] each
    ahead = np.maximum(omega, 1e-30)
    apart = (omega / position_index(right / ahead, up / ahead) ** 2).sum(axis=0)
    # A single source of all unseen pixels has the position index of its centre, which may be the
    # smaller one.
    area = np.maximum(omega.sum(axis=0), 1e-30)
    centre = position_index(right.sum(axis=0) / area, up.sum(axis=0) / area)
    together = omega.sum(axis=0) / centre**2
    return ViewCoverage(1.0 - missing / total, missing, np.maximum(apart, together))


def picture_coverage(grid: PictureGrid) -> ViewCoverage:
    """Return the same as `view_coverage` for a single picture in its own direction, d = 1.

    grid : weights of the picture's pixels, 0 for pixels that no lens saw. All sums are those of the
    hemisphere in front minus those of the picture: pi for the illuminance, and 0 for the moments of
    the solid angle to the right and upwards.
    """
    share = np.array([min(float(grid.illuminance.sum(dtype=float)) / np.pi, 1.0)])
    if share[0] >= FULLY_SEEN_SHARE:
        return ViewCoverage(share, np.zeros(1), np.zeros(1))
    omega, right, up, apart = _sums_of_picture(grid)
    area = max(2.0 * np.pi - omega, 1e-30)
    shrink = min(1.0, 0.5 * np.pi * area / max(float(np.hypot(right, up)), 1e-30))  # in front
    centre = -right / area * shrink, -up / area * shrink
    together = area / float(position_index(*centre)) ** 2
    sources = max(_hemisphere_sources() - apart, together)
    return ViewCoverage(share, np.pi * (1.0 - share), np.array([sources]))


def _sums_of_picture(grid: PictureGrid) -> Floats:
    """Return sums over a picture's pixels in front [4], in sr.

    They are of the solid angle, of this times the coordinates right and up, and of this over the
    squared position index.
    """
    height, width = grid.solid_angle.shape
    sums = np.zeros(4)
    for rows in row_blocks(height, width):
        y, x = centres(rows, height, width)
        rays = picture_rays(grid.view, x, y)
        front = grid.solid_angle[rows] > 0.0
        omega = grid.solid_angle[rows][front].astype(float)
        towards = np.stack([rays.right[front], rays.up[front], rays.forward[front]], axis=-1)
        right, up, _ = angles_from_view(towards, np.eye(3))
        parts = (omega, omega * right, omega * up, omega / position_index(right, up) ** 2)
        sums += [part.sum() for part in parts]
    return sums


@lru_cache(maxsize=1)
def _hemisphere_sources() -> float:
    """Return the sum of solid angle over squared position index of a complete hemisphere, sr."""
    views = panorama_views(_HEMISPHERE_ROWS, 2 * _HEMISPHERE_ROWS, 180.0, 180.0)
    omega, right, up = np.moveaxis(views.moments[:, :, 0].astype(float), 1, 0)
    ahead = np.maximum(omega, 1e-30)
    return float((omega / position_index(right / ahead, up / ahead) ** 2).sum())


def brightest_of_picture_cdm2(luminance_cdm2: Floats, grid: PictureGrid) -> float:
    """Return the luminance exceeded in the brightest hundredth of a picture's solid angle.

    luminance_cdm2 : [H, W]; grid : weights of its pixels. 0 for a picture without a weight.
    """
    weights = grid.solid_angle[grid.solid_angle > 0.0].astype(float)
    return _brightest(luminance_cdm2[grid.solid_angle > 0.0], weights) if len(weights) else 0.0


def _brightest(values: Floats, weights: Floats) -> float:
    """Return the value that the brightest hundredth of the weights exceeds; both are [k]."""
    order = np.argsort(values)[::-1]
    share = np.cumsum(weights[order]) / weights.sum()
    return float(values[order[int(np.searchsorted(share, BRIGHTEST_SHARE))]])


def brightest_cdm2(luminance_cdm2: Floats, seen_mask: Mask) -> Floats:
    """Return the luminance exceeded in the brightest hundredth of the seen solid angle, [n].

    luminance_cdm2 : [n, H, W] of n maps; seen_mask : True for pixels that a lens saw.
    """
    height, width = seen_mask.shape
    step = max(1, min(_THIN, height // 16))
    pick = (slice(None, None, step), slice(None, None, step))
    weights = equirect_solid_angles(height, width)[pick][seen_mask[pick]]
    out = np.empty(len(luminance_cdm2))
    for k, image in enumerate(luminance_cdm2):
        out[k] = _brightest(image[pick][seen_mask[pick]], weights)
    return out


def unseen_dgp_bounds(
    coverage: ViewCoverage, ev_lx: Floats, contrast: Floats, most_cdm2: Floats
) -> tuple[Floats, Floats]:
    """Return the least and the largest DGP over possible luminances of the unseen part, [n, d].

    ev_lx, contrast : [n, d] of the seen part, as of `glare_directions`; most_cdm2 : [n] the
    brightest likely luminance of the unseen part. If nothing is unseen, both are the DGP of the
    seen part.
    """
    low = high = dgp(ev_lx, contrast)
    if not coverage.unseen_illuminance.any():
        return low, high
    for share in np.linspace(0.0, 1.0, _LEVELS):
        level = np.maximum(most_cdm2, 1.0)[:, None] ** share  # [n, 1], 1 cd/m2 up to the most
        power = np.where(level > SOURCE_CDM2, level, 0.0) ** 2
        value = dgp(
            ev_lx + level * coverage.unseen_illuminance,
            contrast + power * coverage.unseen_sources,
        )
        low, high = np.minimum(low, value), np.maximum(high, value)
    return low, high
