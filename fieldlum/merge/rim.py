"""Find lenses whose image is dark at its edge, because the profile states a larger image circle."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.merge.project import TAPER_RAD, ProjectedImage
from fieldlum.session.files.merge_report import DarkRim

# Rings from the edge of the image inwards, each of 0.5 degrees; the innermost is the reference.
_RINGS = 7
_LEAST_PIXELS = 50  # of a ring, for its median; chosen
# A ring below this share of the reference is dark. The outermost one of a real 8 mm fisheye has 0.2
# (docs/validation.md); scenes seldom darken so much within 3 degrees. Chosen.
_DARK_SHARE = 0.6
_BRIGHT_SHARE = 0.9  # the rim ends at the first ring above it; chosen
_TAPER_DEG = float(np.degrees(TAPER_RAD))


def dark_rims(views: Sequence[ProjectedImage]) -> tuple[DarkRim, ...]:
    """Return the dark rims of the lenses: at most one for each lens, none for a bright edge.

    views: of one lens at one heading each. Only pixels that a single view sees are tested, because
    `blend` gives the edge of a lens little weight elsewhere. Of several headings of a lens, the
    first with a dark rim counts.
    """
    alone = sum((view.coverage > 0).astype(int) for view in views) == 1  # [n]
    rims: dict[str, DarkRim] = {}
    for view in views:
        if view.lens is None:
            continue
        inside = alone & (view.coverage > 0.99) & (view.edge < 1.0)
        rim = dark_rim(view.luminance[inside], view.edge[inside] * _TAPER_DEG)
        if rim is not None:
            rims.setdefault(view.lens.name, DarkRim(view.lens.name, *rim))
    return tuple(rims.values())


def dark_rim(luminance_cdm2: Floats, from_edge_deg: Floats) -> tuple[float, float] | None:
    """Return the width [degrees] of a dark rim, and its edge's share of the luminance further in.

    luminance_cdm2 [n] is of the outer 3.4 degrees of a lens's image, from_edge_deg [n] the distance
    of each pixel from the edge. They are divided into seven rings. The rim is dark if the median of
    the outermost ring is at most 0.6 of the innermost one's and the medians of the outer three fall
    outwards. It extends to the first ring above 0.9. Return None otherwise, or if a ring has fewer
    than 50 pixels.
    """
    step = _TAPER_DEG / _RINGS
    ring = np.minimum((from_edge_deg / step).astype(int), _RINGS - 1)
    if (np.bincount(ring, minlength=_RINGS) < _LEAST_PIXELS).any():
        return None
    median = np.array([np.median(luminance_cdm2[ring == k]) for k in range(_RINGS)])
    share = median / max(median[-1], 1e-9)
    if share[0] > _DARK_SHARE or not (np.diff(share[:3]) > 0.0).all():
        return None
    width = int(np.argmax(share > _BRIGHT_SHARE))
    return round(width * step, 1), round(float(share[0]), 3)
