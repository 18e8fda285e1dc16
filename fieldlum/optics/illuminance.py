"""Compute the illuminance of a plane from a panorama of luminance."""

from typing import Literal

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.records import Panorama, SunSource
from fieldlum.optics import projection


def illuminance_lx(
    luminance_cdm2: Floats,
    heading_deg: float,
    normal_altitude_deg: float,
    normal_azimuth_deg: float,
    sun: SunSource | None = None,
) -> float:
    """Return the illuminance [lx] of a plane whose normal has the stated altitude and azimuth.

    luminance_cdm2: panorama [H, W], row 0 at the zenith, with its middle at azimuth heading_deg;
    pixels that are not finite count as 0. Azimuths are clockwise from north. sun: a sun that is not
    in the panorama; None adds nothing. E = sum L cos(angle) solid angle over the hemisphere in
    front of the plane.
    """
    values = np.nan_to_num(np.asarray(luminance_cdm2, np.float64), posinf=0.0, neginf=0.0)
    height, width = values.shape
    normal = projection.direction(normal_altitude_deg, normal_azimuth_deg)
    # Each pixel is divided into at least four, which count by their centre, and the panorama into
    # at least 128 rows: the sum of the weights [sr] over a hemisphere is then pi to 0.01 %.
    fine = max(2, -(-128 // height))
    size = (height * fine, width * fine)
    cosines = np.maximum(projection.equirect_rays(*size, heading_deg) @ normal, 0.0)
    cosines *= projection.row_solid_angles(*size)[:, None]
    total = float((values * cosines.reshape(height, fine, width, fine).sum(axis=(1, 3))).sum())
    if sun is not None:
        cosine = float(projection.direction(sun.altitude_deg, sun.azimuth_deg) @ normal)
        total += sun.normal_illuminance_lx * max(cosine, 0.0)
    return total


def illuminance_ahead_lx(panorama: Panorama, sun: SunSource | None = None) -> float | None:
    """Return the illuminance [lx] of a vertical plane that faces the heading, as at an eye.

    sun: a sun that is not in the panorama's pixels, or None. The result is None if the lenses saw
    less than `FULLY_SEEN_SHARE` of the plane's hemisphere, of which the rest would count as black.
    """
    heading_deg = panorama.heading_deg
    seen_share = projection.seen_shares(panorama.seen, heading_deg, [heading_deg])[0]
    if seen_share < projection.FULLY_SEEN_SHARE:
        return None
    return illuminance_lx(panorama.luminance_cdm2, heading_deg, 0.0, heading_deg, sun)


def illuminance_verdict(image_lx: float, meter_lx: float) -> Literal["pass", "warn", "reject"]:
    """Return the verdict on a picture's illuminance, compared with a meter's.

    The difference is relative to the meter: up to 10 % is "pass", up to 25 % "warn", more, or a
    meter at 0 or below, "reject" (Pierson et al., LEUKOS 2021, step 11).
    """
    difference = abs(image_lx / meter_lx - 1.0) if meter_lx > 0 else np.inf
    return "pass" if difference <= 0.10 else "warn" if difference <= 0.25 else "reject"
