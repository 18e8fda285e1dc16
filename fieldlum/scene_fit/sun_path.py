"""The sun moved along its own path, for a clock that is fast or slow."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

# Apparent rotation of the sky: 360 degrees in a mean solar day; the sun's own motion in declination
# (at most 0.4 degrees a day) is below 0.003 degrees in ten minutes.
SKY_TURN_DEG_PER_MIN = 0.25


def sun_earlier(sun_direction: ArrayLike, minutes: float, latitude_deg: float) -> Array:
    """Return the sun's directions `minutes` before the given ones, [n, 3].

    sun_direction : [n, 3] unit vectors (x east, y north, z up). The sun turns about the celestial
    pole from east to west; Rodrigues' rotation formula is exact for it.
    """
    suns = np.asarray(sun_direction, float)
    angle = np.radians(SKY_TURN_DEG_PER_MIN * minutes)  # counter-clockwise about the pole
    latitude = np.radians(latitude_deg)
    pole = np.array([0.0, np.cos(latitude), np.sin(latitude)])
    along = (suns @ pole)[..., None] * pole
    return (
        suns * np.cos(angle) + np.cross(pole, suns) * np.sin(angle) + along * (1.0 - np.cos(angle))
    )


def turned(direction: ArrayLike, clockwise_deg: float) -> Array:
    """Return directions turned about the vertical, clockwise seen from above, [n, 3]."""
    d = np.asarray(direction, float)
    angle = np.radians(clockwise_deg)
    x = d[..., 0] * np.cos(angle) + d[..., 1] * np.sin(angle)
    y = -d[..., 0] * np.sin(angle) + d[..., 1] * np.cos(angle)
    return np.stack((x, y, d[..., 2]), axis=-1)


def rotation(heading_deg: float, tilt_deg: float, roll_deg: float, axis_deg: float) -> Array:
    """Return the matrix from a camera's stated axes to the true ones, [3, 3].

    heading_deg: clockwise turn about the vertical; tilt_deg: the view axis at azimuth `axis_deg`
    goes up; roll_deg: the right-hand side goes down. All in world axes (x east, y north, z up).
    """
    a = np.radians(axis_deg)
    ahead, right = np.array([np.sin(a), np.cos(a), 0.0]), np.array([np.cos(a), -np.sin(a), 0.0])
    tilt, roll = np.radians(tilt_deg), np.radians(roll_deg)
    return turned(np.eye(3), heading_deg).T @ _about(right, tilt) @ _about(ahead, roll)


def _about(axis: Array, angle_rad: float) -> Array:
    """Rodrigues' rotation matrix, right-handed about a unit axis."""
    x, y, z = axis
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle_rad) * k + (1.0 - np.cos(angle_rad)) * (k @ k)
