"""Turn directions about the vertical, and rotate the axes of a camera that is not level."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from fieldlum.core.arrays import Floats


def turned(direction: ArrayLike, clockwise_deg: float) -> Floats:
    """Return vectors [..., 3] (x east, y north, z up) turned clockwise, seen from above."""
    d = np.asarray(direction, float)
    angle = np.radians(clockwise_deg)
    x = d[..., 0] * np.cos(angle) + d[..., 1] * np.sin(angle)
    y = -d[..., 0] * np.sin(angle) + d[..., 1] * np.cos(angle)
    return np.stack((x, y, d[..., 2]), axis=-1)


def rotation(heading_deg: float, tilt_deg: float, roll_deg: float, axis_deg: float) -> Floats:
    """Return the matrix from a camera's stated axes to the true ones, [3, 3].

    Roll is applied first, then tilt, then heading. heading_deg: clockwise turn about the vertical;
    tilt_deg: the view axis at azimuth `axis_deg` goes up; roll_deg: the right-hand side goes down.
    All in world axes (x east, y north, z up).
    """
    a = np.radians(axis_deg)
    ahead, right = np.array([np.sin(a), np.cos(a), 0.0]), np.array([np.cos(a), -np.sin(a), 0.0])
    tilt, roll = np.radians(tilt_deg), np.radians(roll_deg)
    return turned(np.eye(3), heading_deg).T @ _about(right, tilt) @ _about(ahead, roll)


def _about(axis: Floats, angle_rad: float) -> Floats:
    """Rodrigues' rotation matrix, right-handed about a unit axis."""
    x, y, z = axis
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle_rad) * k + (1.0 - np.cos(angle_rad)) * (k @ k)
