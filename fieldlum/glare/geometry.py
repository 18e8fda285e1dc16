"""Where a pixel stands for a person who looks somewhere: angles, cosine, position index."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fieldlum.projection import direction, equirect_rays, equirect_solid_angles
from fieldlum.records import Float

PAPER_VIEWS = 10  # horizontal, 36 degrees apart (Liu, Colburn and Inanici 2020)
LARGEST_POSITION_INDEX = 16.0


def view_azimuths_deg(heading_deg: float, views: int = PAPER_VIEWS) -> NDArray[np.float64]:
    """`views` horizontal directions spread evenly, the first one along the heading, [views] in
    [0, 360).
    """
    return (heading_deg + np.arange(views) * 360.0 / views) % 360.0


def view_frame(azimuth_deg: float, altitude_deg: float = 0.0) -> NDArray[np.float64]:
    """Rows right, up and forward of a level head that looks there, [3, 3] (x east, y north, z
    up).
    """
    forward = direction(altitude_deg, azimuth_deg)
    right = direction(0.0, azimuth_deg + 90.0)
    return np.stack([right, np.cross(right, forward), forward])


def angles_from_view(rays: Float, frame: Float) -> tuple[Float, Float, Float]:
    """Equidistant coordinates right and up of rays [..., 3], and the cosine to the line of sight.
    [rad]

    (right, up) point away from the line of sight by the angle between them: the coordinates of a
    -vta picture.
    """
    x, y, z = np.moveaxis(rays @ frame.T, -1, 0)
    off = np.hypot(x, y)
    angle = np.arctan2(off, z)
    stretch = np.divide(angle, off, out=np.ones_like(off), where=off > 1e-12)
    return x * stretch, y * stretch, z


def position_index(right_rad: ArrayLike, up_rad: ArrayLike) -> NDArray[np.float64]:
    """Guth's position index above the line of sight, Iwata's below it; both at most 16.

    Above: IES Lighting Handbook; below: Iwata and Osterhaus 2010 in CIE coordinates. These are the
    forms that evalglare has used since its version 3.02.
    """
    right, up = np.asarray(right_rad, float), np.asarray(up_rad, float)
    angle = np.hypot(right, up)
    sigma, tau = np.degrees(angle), np.degrees(np.arctan2(np.abs(right), np.abs(up)))
    linear = (35.2 - 0.31889 * tau - 1.22 * np.exp(-2.0 * tau / 9.0)) / 1000.0
    square = (21.0 + 0.26667 * tau - 0.002963 * tau**2) / 100_000.0
    above = np.exp(linear * sigma + square * sigma**2)
    slope = np.tan(np.minimum(angle, np.pi / 2 - 1e-6)) * np.sqrt(
        1.0 + 0.3225 * np.cos(np.radians(tau)) ** 2
    )
    beta = np.degrees(np.arctan(slope))
    below = np.exp(6.49e-3 * beta + 21e-5 * beta**2)
    return np.minimum(np.where(up < 0.0, below, above), LARGEST_POSITION_INDEX)


@dataclass(frozen=True, slots=True)
class Views:
    """What each panorama pixel weighs for each of d view directions.

    illuminance : [H * W, d] solid angle times cosine, 0 behind [sr]
    moments : [H * W, 3, d] solid angle in the visible hemisphere, and that times the coordinates
    right and up frames : [d, 3, 3]
    """

    azimuths_deg: NDArray[np.float64]
    frames: NDArray[np.float64]
    illuminance: NDArray[np.float32]
    moments: NDArray[np.float32]
    shape: tuple[int, int]


def panorama_views(height: int, width: int, heading_deg: float, azimuths_deg: ArrayLike) -> Views:
    """The weights of a panorama's pixels, made once and used for every hour. Takes 16 bytes a
    pixel and direction.
    """
    azimuths = np.atleast_1d(np.asarray(azimuths_deg, float))
    rays = equirect_rays(height, width, heading_deg).reshape(-1, 3)
    omega = equirect_solid_angles(height, width).ravel()
    illuminance = np.empty((len(rays), len(azimuths)), np.float32)
    moments = np.empty((len(rays), 3, len(azimuths)), np.float32)
    frames = np.stack([view_frame(azimuth) for azimuth in azimuths])
    for i, frame in enumerate(frames):
        right, up, cosine = angles_from_view(rays, frame)
        seen = omega * (cosine > 0)
        illuminance[:, i] = seen * cosine
        moments[:, 0, i], moments[:, 1, i], moments[:, 2, i] = seen, seen * right, seen * up
    illuminance *= _cosine_closure(height, width)
    return Views(azimuths, frames, illuminance, moments, (height, width))


def _cosine_closure(height: int, width: int) -> float:
    """The factor that makes a uniform sphere give exactly pi: midpoint cosines are a little too
    large in a pixel.
    """
    rays = equirect_rays(height, width, 180.0).reshape(-1, 3)
    cosine = np.clip(-rays[:, 1], 0.0, None)
    return float(np.pi / (equirect_solid_angles(height, width).ravel() @ cosine))
