"""Compute the illuminance of a plane from a panorama of luminance."""

from typing import Literal

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.records import SunSource
from fieldlum.optics.projection import direction


def _ray_integrals(height: int, width: int, heading_deg: float) -> Floats:
    """Return the integral of the unit vector over each pixel's solid angle, [H, W, 3] in sr.

    The pixels are those of a panorama with `height` x `width` pixels; heading_deg: azimuth of its
    centre. The vector is (east, north, up).
    """
    zenith_angle = np.linspace(0.0, np.pi, height + 1)  # of the rows' edges
    level = np.diff(zenith_angle / 2 - np.sin(2 * zenith_angle) / 4)  # integral of sin^2
    upward = np.diff(np.sin(zenith_angle) ** 2 / 2)  # integral of sin cos
    azimuth = np.radians(heading_deg) + (np.linspace(0.0, 1.0, width + 1) - 0.5) * 2 * np.pi
    east, north, step = np.diff(-np.cos(azimuth)), np.diff(np.sin(azimuth)), 2 * np.pi / width
    up = np.repeat(upward[:, None] * step, width, axis=1)
    return np.stack((level[:, None] * east, level[:, None] * north, up), axis=-1)


def _cosine_weights(height: int, width: int, heading_deg: float, normal: Floats) -> Floats:
    """Return the integral of the cosine to a plane's normal over each pixel, [H, W] in sr.

    height, width, heading_deg: of a panorama; normal: unit vector (east, north, up). The result is
    0 behind the plane, and exact except in pixels that the plane cuts.
    """
    # At least 128 rows, because pixels that the plane cuts count as their mean: a hemisphere
    # is then exact to 0.05 % (tests/test_projection.py).
    fine = max(2, -(-128 // height))
    inside = np.maximum(_ray_integrals(height * fine, width * fine, heading_deg) @ normal, 0.0)
    return inside.reshape(height, fine, width, fine).sum(axis=(1, 3))


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
    normal = direction(normal_altitude_deg, normal_azimuth_deg)
    total = float((values * _cosine_weights(height, width, heading_deg, normal)).sum())
    if sun is not None:
        cosine = float(direction(sun.altitude_deg, sun.azimuth_deg) @ normal)
        total += sun.normal_illuminance_lx * max(cosine, 0.0)
    return total


def vertical_illuminance_lx(
    luminance_cdm2: Floats, heading_deg: float, azimuth_deg: float, sun: SunSource | None = None
) -> float:
    """Return the illuminance [lx] of a vertical plane that faces `azimuth_deg`, as at an eye.

    luminance_cdm2: panorama [H, W] in cd/m2, row 0 at the zenith, with its middle at azimuth
    `heading_deg`; azimuths clockwise from north. sun: a sun that is not in the panorama, or None.
    """
    return illuminance_lx(luminance_cdm2, heading_deg, 0.0, azimuth_deg, sun)


def illuminance_verdict(image_lx: float, meter_lx: float) -> Literal["pass", "warn", "reject"]:
    """Return the verdict on a picture's illuminance, compared with a meter's.

    The difference is relative to the meter: up to 10 % is "pass", up to 25 % "warn", more, or a
    meter at 0 or below, "reject" (Pierson et al., LEUKOS 2021, step 11).
    """
    difference = abs(image_lx / meter_lx - 1.0) if meter_lx > 0 else np.inf
    return "pass" if difference <= 0.10 else "warn" if difference <= 0.25 else "reject"
