"""The share of a person's view in a direction that a camera saw."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from fieldlum.core.arrays import Floats, Mask
from fieldlum.optics.projection.lens import LensGeometry
from fieldlum.optics.projection.panorama import (
    compass_name,
    direction,
    equirect_rays,
    equirect_solid_angles,
)

# From this share on a direction counts as seen. A dual fisheye without the nadir sees over 99 %; 2
# % of a hemisphere of 10 000 cd/m2 changes DGP by 0.04, which the bounds of DGP include. Chosen.
FULLY_SEEN_SHARE = 0.98
# Below this share a direction gets no result: a 180-degree lens sees half of the cosine-weighted
# hemisphere at 90 degrees from its axis. Chosen.
MIN_SEEN_SHARE = 0.5
SEEN = "seen"
PARTLY_SEEN = "partly seen"
NOT_SEEN = "not seen"


def seen_shares(seen_mask: Mask, heading_deg: float, azimuths_deg: ArrayLike) -> Floats:
    """Return the share, 0 to 1, of a uniform field's vertical illuminance that was seen, [d].

    seen_mask : [H, W], True for panorama pixels that a lens saw; heading_deg : azimuth of the
    panorama's middle; azimuths_deg : [d], horizontal view directions, clockwise from north.
    """
    height, width = seen_mask.shape
    rays = equirect_rays(height, width, heading_deg).reshape(-1, 3)
    ahead = direction(0.0, np.atleast_1d(np.asarray(azimuths_deg, float)))  # (d, 3)
    solid_angles = equirect_solid_angles(height, width).reshape(-1, 1)  # (H W, 1)
    cosine = np.clip(rays @ ahead.T, 0.0, None) * solid_angles  # (H W, d)
    return np.clip(seen_mask.ravel() @ cosine / cosine.sum(axis=0), 0.0, 1.0)


def seen_words(shares: Floats) -> tuple[str, ...]:
    """Return "seen" (from 0.98), "partly seen" (from 0.5) or "not seen" for each share, [d]."""
    return tuple(
        SEEN if s >= FULLY_SEEN_SHARE else PARTLY_SEEN if s >= MIN_SEEN_SHARE else NOT_SEEN
        for s in shares
    )


def seen_by_lenses(
    lenses: Sequence[LensGeometry], turns_deg: Sequence[float], height: int = 90
) -> Mask:
    """Return True for panorama pixels whose centre at least one lens sees, [height, 2 height].

    The middle of the panorama is at its heading. turns_deg : headings of the turned camera minus
    the panorama's heading; (0,) for a fixed camera.
    """
    rays = equirect_rays(height, 2 * height, 0.0)
    out = np.zeros(rays.shape[:2], bool)
    for lens in lenses:
        forward_altitude, forward_azimuth = lens.tilt_deg, lens.azimuth_deg
        for turn in turns_deg:
            axis = direction(forward_altitude, forward_azimuth + turn)
            out |= rays @ axis >= np.cos(lens.half_angle_rad)
    return out


def judged_text(seen_mask: Mask, heading_deg: float) -> str:
    """Return one sentence on which views can be judged from these pixels; empty if all can.

    Directions are rounded to degrees, clockwise from north, with points of the compass.

    seen_mask : [H, W], True for panorama pixels that a lens saw; heading_deg : azimuth of the
    panorama's middle.
    """
    azimuths = np.arange(360.0)
    words = seen_words(seen_shares(seen_mask, heading_deg, azimuths))
    if all(word == SEEN for word in words):
        return ""
    weights = equirect_solid_angles(*seen_mask.shape)
    share = float(weights[seen_mask].sum() / weights.sum())
    fully = _arcs_text([word == SEEN for word in words])
    bounds = _arcs_text([word not in (SEEN, NOT_SEEN) for word in words])
    nothing = NOT_SEEN in words
    return (
        f"the camera sees {100 * share:.0f} % of all directions: glare can be computed for views "
        f"to {fully or 'no direction'}, and only bounds of glare for views to "
        f"{bounds or 'no direction'}" + ("; other view directions get no result" if nothing else "")
    )


def _arcs_text(good: Sequence[bool]) -> str:
    """Return the arcs of consecutive good degrees around the circle as text."""
    if all(good):
        return "every direction"
    starts = [k for k in range(360) if good[k] and not good[k - 1]]
    arcs = []
    for start in starts:
        end = start
        while good[(end + 1) % 360]:
            end += 1
        arcs.append(f"{start}° ({compass_name(start)}) to {end % 360}° ({compass_name(end % 360)})")
    return ", ".join(arcs)
