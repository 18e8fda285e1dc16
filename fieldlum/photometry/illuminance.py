"""Illuminance of a plane from a panorama, with exact solid angles, and the gate against a meter."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fieldlum.projection import direction, equirect_rays, row_solid_angles
from fieldlum.records import Float, SunSource

_FINE = 4  # sub-rows and sub-columns where the plane cuts through a pixel


def _cosine_weights(height: int, width: int, heading_deg: float, normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """cos(angle to the normal), 0 behind the plane, averaged over the pixels that the plane cuts, [H, W]."""
    cosine = equirect_rays(height, width, heading_deg) @ normal
    cut = np.abs(cosine) < 1.5 * np.pi / height
    if cut.any():
        fine = np.maximum(equirect_rays(height * _FINE, width * _FINE, heading_deg) @ normal, 0.0)
        mean = fine.reshape(height, _FINE, width, _FINE).mean(axis=(1, 3))
        return np.where(cut, mean, np.maximum(cosine, 0.0))
    return np.maximum(cosine, 0.0)


def illuminance_lx(
    luminance_cdm2: Float,
    heading_deg: float,
    normal_altitude_deg: float,
    normal_azimuth_deg: float,
    sun: SunSource | None = None,
) -> float:
    """Illuminance of a plane that looks towards (altitude, azimuth), from a panorama [H, W] and the sun beside it. [lx]

    E = sum L cos(angle) solid angle over the hemisphere in front of the plane. Non-finite pixels count as 0.
    """
    values = np.nan_to_num(np.asarray(luminance_cdm2, np.float64), posinf=0.0, neginf=0.0)
    height, width = values.shape
    normal = direction(normal_altitude_deg, normal_azimuth_deg)
    weights = _cosine_weights(height, width, heading_deg, normal) * row_solid_angles(height, width)[:, None]
    total = float((values * weights).sum())
    if sun is not None:
        cosine = float(direction(sun.altitude_deg, sun.azimuth_deg) @ normal)
        total += sun.normal_illuminance_lx * max(cosine, 0.0)
    return total


def vertical_illuminance_lx(
    luminance_cdm2: Float, heading_deg: float, azimuth_deg: float, sun: SunSource | None = None
) -> float:
    """Ev at an eye that looks horizontally towards `azimuth_deg`. [lx]"""
    return illuminance_lx(luminance_cdm2, heading_deg, 0.0, azimuth_deg, sun)


def illuminance_verdict(image_lx: float, meter_lx: float) -> Literal["pass", "warn", "reject"]:
    """Image against meter: 10 % pass, 25 % warn, above reject (Pierson et al., LEUKOS 2021, step 11)."""
    off = abs(image_lx / meter_lx - 1.0) if meter_lx > 0 else np.inf
    return "pass" if off <= 0.10 else "warn" if off <= 0.25 else "reject"
