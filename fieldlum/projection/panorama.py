"""The panorama grid: rays, azimuths, solid angles.

Axes: x east, y north, z up. Azimuth clockwise from north. A panorama is equirectangular, row 0 at
the zenith, W = 2H; the azimuth of column centre j is heading + ((j + .5)/W - .5) * 360 degrees, so
right is clockwise.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray


def row_solid_angles(height: int, width: int) -> NDArray[np.float64]:
    """Solid angle of one pixel of each row of a panorama, [H]. [sr] All pixels sum to 4 pi."""
    edges = np.cos(np.linspace(0.0, np.pi, height + 1))
    return (edges[:-1] - edges[1:]) * 2.0 * np.pi / width


def equirect_solid_angles(height: int, width: int) -> NDArray[np.float64]:
    """Solid angle of each pixel of a panorama, [H, W]. [sr]"""
    return np.repeat(row_solid_angles(height, width)[:, None], width, axis=1)


def column_azimuths_deg(width: int, heading_deg: float) -> NDArray[np.float64]:
    """Azimuth of each column's centre, clockwise from north, in [0, 360), [W]. [deg]"""
    return (heading_deg + ((np.arange(width) + 0.5) / width - 0.5) * 360.0) % 360.0


def row_altitudes_deg(height: int) -> NDArray[np.float64]:
    """Altitude of each row's centre, [H]. [deg]"""
    return 90.0 - (np.arange(height) + 0.5) / height * 180.0


def signed_angle_deg(angle_deg: ArrayLike) -> NDArray[np.float64]:
    """Return the same angle in [-180, 180): a difference of two azimuths as a signed turn. [deg]"""
    return np.asarray((np.asarray(angle_deg, float) + 180.0) % 360.0 - 180.0, np.float64)


def direction(altitude_deg: ArrayLike, azimuth_deg: ArrayLike) -> NDArray[np.float64]:
    """Unit vectors (x east, y north, z up), [..., 3]."""
    alt, az = np.radians(altitude_deg), np.radians(azimuth_deg)
    return np.stack(
        np.broadcast_arrays(np.cos(alt) * np.sin(az), np.cos(alt) * np.cos(az), np.sin(alt)),
        axis=-1,
    )


def equirect_rays(height: int, width: int, heading_deg: float) -> NDArray[np.float64]:
    """Unit vector of each pixel's centre, [H, W, 3]."""
    return direction(
        row_altitudes_deg(height)[:, None], column_azimuths_deg(width, heading_deg)[None, :]
    )


def equirect_pixel(
    altitude_deg: ArrayLike, azimuth_deg: ArrayLike, height: int, width: int, heading_deg: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Continuous (row, column) of directions; pixel (i, j) covers [i, i+1) x [j, j+1). Columns
    wrap into [0, W).
    """
    row = (90.0 - np.asarray(altitude_deg, float)) / 180.0 * height
    turn = (np.asarray(azimuth_deg, float) - heading_deg) / 360.0 + 0.5
    return row, (turn % 1.0) * width


_COMPASS = tuple("N NNE NE ENE E ESE SE SSE S SSW SW WSW W WNW NW NNW".split())  # noqa: SIM905


def compass_name(azimuth_deg: float) -> str:
    """Return the nearest of the sixteen points of the compass: N, NNE, NE ..."""
    return _COMPASS[round(azimuth_deg / 22.5) % 16]
