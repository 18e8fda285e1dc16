"""Bound the DGP of views of which no lens saw a part.

An unseen part is not dark. It gets one luminance, from 0 up to the brightest that is likely; the
bounds are the minimum and maximum DGP over these luminances. More light on the eye can lower DGP
(the contrast term falls with Ev), so the lower bound is not always at 0 cd/m2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fieldlum.core.arrays import Floats, Mask
from fieldlum.optics.projection import PARTLY_SEEN, SEEN, seen_words
from fieldlum.year.glare.geometry import Views, position_index
from fieldlum.year.glare.metrics import dgp
from fieldlum.year.glare.sources import SOURCE_CDM2

# Share of the seen solid angle that is brighter than the brightest likely luminance: a window pane
# is larger, a single bright pixel of a reflection smaller. Chosen, not measured.
BRIGHTEST_SHARE = 0.01
_LEVELS = 12  # number of luminances between 1 cd/m2 and the brightest; chosen
_COMPLETE_SHARE = 0.999  # exactness of a picture's weights (`picture_views`)
_SAMPLES = 20_000  # pixels from which a percentile is taken; chosen
_BLOCK = 1 << 16  # pixels processed at a time, which bounds the memory; chosen


@dataclass(frozen=True, slots=True)
class ViewCoverage:
    """The seen and unseen parts of d view directions.

    seen_share [d] : share (0 to 1) of the vertical illuminance of a uniform field that comes from
    seen pixels; unseen_illuminance [d] : integral over the unseen part of the cosine, sr;
    unseen_sources [d] : of 1 over the square of the position index, sr. Times a luminance and a
    squared luminance, the last two give what the unseen part adds to Ev and to `contrast`; they are
    0 for a complete direction. words [d] : "seen" (a share of 0.98 or more), "partly
    seen" (0.5 or more) or "not seen".
    """

    seen_share: Floats
    unseen_illuminance: Floats
    unseen_sources: Floats
    words: tuple[str, ...]

    def is_any(self, *words: str) -> Mask:
        """Return a mask [d], True for directions whose word is one of `words`."""
        return np.array([word in words for word in self.words])

    @property
    def judged(self) -> Mask:
        """Mask [d], True for directions that are seen or partly seen and therefore have figures."""
        return self.is_any(SEEN, PARTLY_SEEN)


def view_coverage(views: Views) -> ViewCoverage:
    """Return how much of each view direction the pixels with a weight in `views` cover.

    The unseen part is the hemisphere in front without them. A single source of all of it has the
    position index of its centre, which may be smaller than that of its pixels.
    """
    seen = np.zeros_like(views.hemisphere)
    seen[0] = views.illuminance.sum(axis=0, dtype=float)
    share = np.minimum(seen[0] / views.hemisphere[0], 1.0)
    incomplete = share < _COMPLETE_SHARE
    for first in range(0, len(views.moments) if incomplete.any() else 0, _BLOCK):
        rows = slice(first, first + _BLOCK)
        part = views.moments[rows].astype(float)  # [n, 3, d]
        area = np.maximum(part[:, 0], 1e-30)
        index = position_index(part[:, 1] / area, part[:, 2] / area)
        seen[1:4] += part.sum(axis=0)
        seen[4] += (part[:, 0] / index**2).sum(axis=0)
    unseen = (views.hemisphere - seen) * incomplete
    illuminance, area, right, up, apart = unseen
    area = np.maximum(area, 1e-30)
    # the centre is at most 90 degrees from the line of sight
    shrink = np.minimum(1.0 / area, 0.5 * np.pi / np.maximum(np.hypot(right, up), 1e-30))
    together = area / position_index(right * shrink, up * shrink) ** 2
    return ViewCoverage(share, illuminance, np.maximum(apart, together), seen_words(share))


def brightest_cdm2(luminance_cdm2: Floats, views: Views) -> Floats:
    """Return the luminance exceeded in the brightest hundredth of the seen solid angle, [n].

    luminance_cdm2 : [n, H, W] of n maps; views : their weights; only seen directions count. 0
    without any.
    """
    step = luminance_cdm2[0].size // _SAMPLES | 1  # odd: not every time the same columns
    weights = views.moments[::step, 0].max(axis=1)
    flat = luminance_cdm2.reshape(len(luminance_cdm2), -1)[:, ::step]
    order = np.argsort(flat, axis=1)[:, ::-1]
    share = np.cumsum(weights[order], axis=1, dtype=float) / max(weights.sum(dtype=float), 1e-30)
    place = (share < BRIGHTEST_SHARE).sum(axis=1)[:, None].clip(max=flat.shape[1] - 1)
    found = np.take_along_axis(flat, np.take_along_axis(order, place, 1), 1)[:, 0]
    return np.where(weights.any(), found, 0.0).astype(float)


def unseen_dgp_bounds(
    coverage: ViewCoverage, ev_lx: Floats, contrast: Floats, max_cdm2: Floats
) -> tuple[Floats, Floats]:
    """Return the minimum and maximum DGP over possible luminances of the unseen part, [n, d].

    ev_lx, contrast : [n, d] of the seen part, as of `glare_directions`; max_cdm2 : [n] the
    brightest likely luminance of the unseen part. If nothing is unseen, both are the DGP of the
    seen part.
    """
    low = high = dgp(ev_lx, contrast)
    if not coverage.unseen_illuminance.any():
        return low, high
    for share in np.linspace(0.0, 1.0, _LEVELS):
        level = np.maximum(max_cdm2, 1.0)[:, None] ** share  # [n, 1], 1 cd/m2 up to the brightest
        power = np.where(level > SOURCE_CDM2, level, 0.0) ** 2
        value = dgp(
            ev_lx + level * coverage.unseen_illuminance,
            contrast + power * coverage.unseen_sources,
        )
        low, high = np.minimum(low, value), np.maximum(high, value)
    return low, high
