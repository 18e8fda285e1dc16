"""Compute where pixels are for an observer: angle to the line of sight, cosine, position index."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fieldlum.core.arrays import Floats, Floats32, Mask
from fieldlum.optics.projection import direction, equirect_rays, equirect_solid_angles

PAPER_VIEWS = 10  # horizontal, 36 degrees apart (Liu, Colburn and Inanici 2020)
MAX_POSITION_INDEX = 16.0  # as evalglare limits it (source of evalglare 3)


def view_azimuths_deg(heading_deg: float, views: int = PAPER_VIEWS) -> Floats:
    """Return the azimuths of `views` horizontal directions at equal steps, [views].

    The first is `heading_deg`; the others follow clockwise. All are in degrees clockwise from
    north, in [0, 360).
    """
    return (heading_deg + np.arange(views) * 360.0 / views) % 360.0


def view_frame(azimuth_deg: float, altitude_deg: float = 0.0) -> Floats:
    """Return the unit vectors right, up and forward of an upright head that looks there, [3, 3].

    Rows are the vectors, columns x east, y north, z up. azimuth_deg : of the view direction,
    clockwise from north; altitude_deg : above the horizon.
    """
    forward = direction(altitude_deg, azimuth_deg)
    right = direction(0.0, azimuth_deg + 90.0)
    return np.stack([right, np.cross(right, forward), forward])


def angles_from_view(rays: Floats, frame: Floats) -> tuple[Floats, Floats, Floats]:
    """Return each ray's coordinates right and up [rad], and the cosine of its angle to the view.

    rays : [..., 3] unit vectors (x east, y north, z up). frame : [3, 3], by `view_frame`. The
    length of (right, up) is the angle between ray and line of sight, as in a Radiance picture with
    -vta. The cosine is negative behind the observer. Each result has the shape [...].
    """
    x, y, z = np.moveaxis(rays @ frame.T, -1, 0)
    off = np.hypot(x, y)
    angle = np.arctan2(off, z)
    stretch = np.divide(angle, off, out=np.ones_like(off), where=off > 1e-12)
    return x * stretch, y * stretch, z


def position_index(right_rad: ArrayLike, up_rad: ArrayLike) -> Floats:
    """Return the position index P of glare: 1 on the line of sight, greater off it, at most 16.

    right_rad, up_rad : coordinates by `angles_from_view`; the result has their shape. Above the
    line of sight it is Guth's (IES Lighting Handbook), below it that of Iwata and Osterhaus 2010 in
    CIE coordinates. evalglare has used these forms since version 3.02.
    """
    right, up = np.asarray(right_rad, float), np.asarray(up_rad, float)
    angle = np.hypot(right, up)
    sigma = np.degrees(angle)
    tau = np.degrees(np.arctan2(np.abs(right), np.abs(up)))
    linear = (35.2 - 0.31889 * tau - 1.22 * np.exp(-2.0 * tau / 9.0)) / 1000.0
    square = (21.0 + 0.26667 * tau - 0.002963 * tau**2) / 100_000.0
    above = np.exp(linear * sigma + square * sigma**2)
    slope = np.tan(np.minimum(angle, np.pi / 2 - 1e-6)) * np.sqrt(
        1.0 + 0.3225 * np.cos(np.radians(tau)) ** 2
    )
    beta = np.degrees(np.arctan(slope))
    below = np.exp(6.49e-3 * beta + 21e-5 * beta**2)
    return np.minimum(np.where(up < 0.0, below, above), MAX_POSITION_INDEX)


@dataclass(frozen=True, slots=True)
class Views:
    """The weights of each pixel of a picture of P pixels for each of d view directions.

    A panorama has any number of horizontal directions, another picture its own one.
    azimuths_deg : [d] the view directions, clockwise from north. frames : [d, 3, 3] unit vectors
    right, up and forward of each as rows. illuminance : [P, d] solid angle times cosine to the
    view direction, sr; its product with a flat map is Ev. moments : [P, 3, d] solid angle, sr, and
    this times the pixel's coordinates right and up by `angles_from_view`. Both are 0 behind the
    observer and for pixels that no lens saw. ahead : [P, d] pixels with a weight whose centre is in
    front. hemisphere : [5, d] sums over the complete hemisphere in front: of illuminance, of
    moments, and of solid angle over squared position index.
    """

    azimuths_deg: Floats
    frames: Floats
    illuminance: Floats32
    moments: Floats32
    ahead: Mask
    hemisphere: Floats
    is_panorama: bool = True

    def rays(self, pixels: NDArray[np.int64] | slice = slice(None)) -> tuple[Floats, Floats]:
        """Return unit vectors (right, up, forward) [n, 3, d] and solid angles [n, d] of n pixels.

        Only those of pixels with a solid angle above 0 have a meaning.
        """
        omega, right, up = np.moveaxis(self.moments[pixels], 1, 0)
        right, up = right / np.maximum(omega, 1e-30), up / np.maximum(omega, 1e-30)
        angle = np.hypot(right, up)
        ratio = np.sinc(angle / np.pi)  # sin(angle) / angle
        return np.stack([right * ratio, up * ratio, np.cos(angle)], axis=1), omega


def panorama_views(
    height: int,
    width: int,
    heading_deg: float,
    azimuths_deg: ArrayLike,
    seen_mask: Mask | None = None,
) -> Views:
    """Return the weights of a panorama's pixels in d view directions, the same for all hours.

    height, width : of the panorama in pixels; heading_deg : azimuth of its centre column;
    azimuths_deg : [d] view directions; azimuths are clockwise from north. seen_mask : pixels that a
    lens saw [H, W]; None for all. The weights need 16 bytes of memory for each pixel and direction.
    """
    azimuths = np.atleast_1d(np.asarray(azimuths_deg, float))
    rays = equirect_rays(height, width, heading_deg).reshape(-1, 3)
    omega = equirect_solid_angles(height, width).ravel()
    seen = 1.0 if seen_mask is None else seen_mask.ravel()
    illuminance = np.empty((len(rays), len(azimuths)), np.float32)
    moments = np.empty((len(rays), 3, len(azimuths)), np.float32)
    frames = np.stack([view_frame(azimuth) for azimuth in azimuths])
    hemisphere = np.empty((5, len(azimuths)))
    closure = _cosine_closure(height, width)
    for i, frame in enumerate(frames):
        right, up, cosine = angles_from_view(rays, frame)
        facing_sr = omega * (cosine > 0)
        weights = facing_sr * np.stack([cosine * closure, np.ones_like(up), right, up])
        hemisphere[:4, i] = weights.sum(axis=1)
        hemisphere[4, i] = (facing_sr / position_index(right, up) ** 2).sum()
        illuminance[:, i], *parts = weights * seen
        moments[:, :, i] = np.transpose(parts)
    return Views(azimuths, frames, illuminance, moments, moments[:, 0] > 0.0, hemisphere)


def _cosine_closure(height: int, width: int) -> float:
    """Return the factor with which a uniform sphere gives exactly pi.

    The cosine in the middle of a pixel is slightly larger than its mean over the pixel.
    """
    rays = equirect_rays(height, width, 180.0).reshape(-1, 3)
    cosine = np.clip(-rays[:, 1], 0.0, None)
    return float(np.pi / (equirect_solid_angles(height, width).ravel() @ cosine))
