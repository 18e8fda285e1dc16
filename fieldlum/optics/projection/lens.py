"""A lens on a sensor: angle to radius, pose, directions to sensor coordinates and back.

Sensor coordinates: (0, 0) is the top left corner of the top left pixel, x right, y down, seen from
behind the camera.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from fieldlum.core.arrays import Floats
from fieldlum.optics.projection.panorama import direction

Mapping = Literal["equidistant", "equisolid", "polynomial"]


@dataclass(frozen=True, slots=True)
class LensGeometry:
    """The mapping and pose of a lens on a sensor.

    centre_px: x right, y down, (0, 0) the sensor's top left corner. coefficients: of the polynomial
    r / radius_px = sum c_k (angle / half angle)^(k + 1). azimuth_deg: clockwise from the panorama's
    heading; tilt_deg: up; roll_deg: clockwise seen from behind the camera.
    """

    centre_px: tuple[float, float]
    radius_px: float  # of the image circle at half of full_angle_deg
    full_angle_deg: float
    mapping: Mapping = "equisolid"
    coefficients: tuple[float, ...] = ()
    azimuth_deg: float = 0.0
    tilt_deg: float = 0.0
    roll_deg: float = 0.0

    @property
    def half_angle_rad(self) -> float:
        """Half of the full angle, in radians."""
        return float(np.radians(self.full_angle_deg / 2))

    def axes(self) -> Floats:
        """Return the camera's axes right, up and forward as rows, [3, 3].

        They are unit vectors, x right of the panorama's heading, y along it, z up.
        """
        forward = direction(self.tilt_deg, self.azimuth_deg)
        right = direction(0.0, self.azimuth_deg + 90.0)
        up = np.cross(right, forward)
        roll = np.radians(self.roll_deg)
        return np.stack(
            (
                np.cos(roll) * right - np.sin(roll) * up,
                np.sin(roll) * right + np.cos(roll) * up,
                forward,
            )
        )


def relative_radius(lens: LensGeometry, x_px: ArrayLike, y_px: ArrayLike) -> Floats:
    """Return the distance of sensor points [...] from the image centre over radius_px, [...]."""
    dx, dy = np.subtract(x_px, lens.centre_px[0]), np.subtract(y_px, lens.centre_px[1])
    return np.hypot(dx, dy) / lens.radius_px


def radius_of_angle(lens: LensGeometry, angle_rad: ArrayLike) -> Floats:
    """Return the distance from the image centre over radius_px, in the shape of the angles.

    angle_rad : from the optical axis. The result is 1 at half of the full angle.
    """
    angle = np.asarray(angle_rad, float)
    half = lens.half_angle_rad
    if lens.mapping == "equisolid":
        return np.sin(angle / 2) / np.sin(half / 2)
    if lens.mapping == "equidistant":
        return angle / half
    return np.asarray(
        np.polynomial.polynomial.polyval(angle / half, (0.0, *lens.coefficients)), np.float64
    )


@lru_cache(maxsize=16)
def _inverse_table(lens: LensGeometry) -> tuple[Floats, Floats]:
    """Return radius and angle [rad] up to where the polynomial stops rising, [n] each.

    Raises ValueError if it stops rising inside the image circle.
    """
    angles = np.linspace(0.0, min(1.15 * lens.half_angle_rad, np.pi), 4001)
    radii = radius_of_angle(lens, angles)
    falling = np.flatnonzero(np.diff(radii) <= 0)
    end = int(falling[0]) + 1 if falling.size else angles.size
    if angles[end - 1] < lens.half_angle_rad * 0.999:
        raise ValueError("the lens polynomial does not rise up to the edge of the circle")
    return radii[:end], angles[:end]


def angle_of_radius(lens: LensGeometry, radius: ArrayLike) -> Floats:
    """Return the angle of radii, in rad: the inverse of `radius_of_angle`, in the same shape.

    radius : distance from the image centre over radius_px. Beyond the reach of a polynomial or
    equisolid mapping the largest angle is returned. Raises ValueError for a polynomial that does
    not rise up to half of the full angle.
    """
    r = np.asarray(radius, float)
    if lens.mapping == "equisolid":
        return 2.0 * np.arcsin(np.clip(r * np.sin(lens.half_angle_rad / 2), -1.0, 1.0))
    if lens.mapping == "equidistant":
        return r * lens.half_angle_rad
    return np.interp(r, *_inverse_table(lens))


def lens_pixels(lens: LensGeometry, rays: Floats) -> tuple[Floats, Floats, Floats]:
    """Return sensor x, y [px] and angle from the axis [rad] of unit vectors, [...] each.

    rays : [..., 3], y along the panorama's heading, z up. (0, 0) is the sensor's top left corner.
    """
    right, up, forward = np.moveaxis(np.asarray(rays, float) @ lens.axes().T, -1, 0)
    across = np.hypot(right, up)
    angle = np.arctan2(across, forward)
    scale = lens.radius_px * radius_of_angle(lens, angle) / np.maximum(across, 1e-300)
    return lens.centre_px[0] + scale * right, lens.centre_px[1] - scale * up, angle


def lens_rays(lens: LensGeometry, x_px: ArrayLike, y_px: ArrayLike) -> Floats:
    """Return the unit vectors [..., 3] of sensor coordinates [...]; the inverse of `lens_pixels`.

    The vectors have y along the panorama's heading and z up. Raises ValueError as
    `angle_of_radius` does.
    """
    dx = np.asarray(x_px, float) - lens.centre_px[0]
    dy = lens.centre_px[1] - np.asarray(y_px, float)
    radius = np.hypot(dx, dy)
    angle = angle_of_radius(lens, radius / lens.radius_px)
    across = np.sin(angle) / np.maximum(radius, 1e-300)
    return np.stack((dx * across, dy * across, np.cos(angle)), axis=-1) @ lens.axes()
