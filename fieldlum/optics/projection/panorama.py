"""The panorama grid: rays, azimuths, solid angles.

Axes: x east, y north, z up. Azimuth clockwise from north. A panorama is equirectangular, row 0 at
the zenith, W = 2H; the azimuth of column centre j is heading + ((j + .5)/W - .5) * 360 degrees, so
right is clockwise.
"""

import numpy as np
from numpy.typing import ArrayLike

from fieldlum.core.arrays import Array, Floats, Mask


def row_solid_angles(height: int, width: int) -> Floats:
    """Return the solid angle of one pixel of each row, in sr, [H]; all pixels sum to 4 pi."""
    edges = np.cos(np.linspace(0.0, np.pi, height + 1))
    return (edges[:-1] - edges[1:]) * 2.0 * np.pi / width


def equirect_solid_angles(height: int, width: int) -> Floats:
    """Return the solid angle of each pixel of a panorama, in sr, [H, W]."""
    return np.repeat(row_solid_angles(height, width)[:, None], width, axis=1)


def column_azimuths_deg(width: int, heading_deg: float) -> Floats:
    """Return the azimuth of each column's centre, clockwise from north, in [0, 360) deg, [W].

    heading_deg : azimuth of the panorama's middle.
    """
    return (heading_deg + ((np.arange(width) + 0.5) / width - 0.5) * 360.0) % 360.0


def row_altitudes_deg(height: int) -> Floats:
    """Return the altitude of each row's centre, from the zenith down, in deg, [H]."""
    return 90.0 - (np.arange(height) + 0.5) / height * 180.0


def wrapped(maps: Array) -> Array:
    """Return a panorama with its last column before the first and its first after the last.

    [H, W, ...] becomes [H, W + 2, ...], so that interpolation is continuous across the seam.
    """
    return np.concatenate((maps[:, -1:], maps, maps[:, :1]), axis=1)


def signed_angle_deg(angle_deg: ArrayLike) -> Floats:
    """Return angles plus or minus full turns, in [-180, 180) deg, in the same shape."""
    return np.asarray((np.asarray(angle_deg, float) + 180.0) % 360.0 - 180.0, np.float64)


def smallest_arc(used: Mask) -> tuple[int, int]:
    """Return first column and width of the shortest run of columns with all that are marked.

    used: mask of a panorama's columns [W], of which one is marked at least; the run may pass the
    last column.
    """
    columns = np.flatnonzero(used)
    gaps = np.diff(columns, append=columns[0] + len(used))
    widest = int(np.argmax(gaps))
    return int(columns[(widest + 1) % len(columns)]), len(used) - int(gaps[widest]) + 1


def direction(altitude_deg: ArrayLike, azimuth_deg: ArrayLike) -> Floats:
    """Return unit vectors (x east, y north, z up), [..., 3]; azimuth clockwise from north.

    altitude_deg, azimuth_deg : shapes that broadcast to [...].
    """
    alt, az = np.radians(altitude_deg), np.radians(azimuth_deg)
    return np.stack(
        np.broadcast_arrays(np.cos(alt) * np.sin(az), np.cos(alt) * np.cos(az), np.sin(alt)),
        axis=-1,
    )


def altitude_azimuth_deg(rays: Array) -> tuple[Floats, Floats]:
    """Return altitude and azimuth of unit vectors [..., 3], the inverse of `direction`, [...] each.

    The azimuth is in [-180, 180] deg.
    """
    altitude = np.degrees(np.arcsin(np.clip(rays[..., 2], -1.0, 1.0)))
    return altitude, np.degrees(np.arctan2(rays[..., 0], rays[..., 1]))


def equirect_rays(height: int, width: int, heading_deg: float) -> Floats:
    """Return the unit vector (x east, y north, z up) of each panorama pixel's centre, [H, W, 3].

    Row 0 is at the zenith; heading_deg : azimuth of the middle, clockwise from north.
    """
    return direction(
        row_altitudes_deg(height)[:, None], column_azimuths_deg(width, heading_deg)[None, :]
    )


def equirect_pixel(
    altitude_deg: ArrayLike, azimuth_deg: ArrayLike, height: int, width: int, heading_deg: float
) -> tuple[Floats, Floats]:
    """Return the continuous (row, column) of directions in deg, [...] each.

    Pixel (i, j) covers [i, i + 1) x [j, j + 1); row 0 is the zenith, column W / 2 the heading.
    Columns wrap into [0, W).
    """
    row = (90.0 - np.asarray(altitude_deg, float)) / 180.0 * height
    turn = (np.asarray(azimuth_deg, float) - heading_deg) / 360.0 + 0.5
    return row, (turn % 1.0) * width


_COMPASS = tuple("N NNE NE ENE E ESE SE SSE S SSW SW WSW W WNW NW NNW".split())  # noqa: SIM905


def compass_name(azimuth_deg: float) -> str:
    """Return the nearest of the sixteen points of the compass, such as NNE, of any azimuth."""
    return _COMPASS[round(azimuth_deg / 22.5) % 16]


# ----------------------------------------------------------------------------------------------
# turns about the vertical, and the axes of a camera that is not level


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
