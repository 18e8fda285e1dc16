"""Resample a panorama to fisheye pictures by flux, and add the sun by its energy."""

from __future__ import annotations

import numpy as np

from fieldlum.core.arrays import Floats, Floats32, Mask
from fieldlum.core.records import SunSource
from fieldlum.optics.projection import altitude_azimuth_deg, direction, equirect_pixel
from fieldlum.sky.sun import SUN_SOLID_ANGLE_SR
from fieldlum.year.glare.geometry import view_frame

# samples in each direction of a pixel, so that its share of the disc is known to 1/64; chosen
_DISC_SAMPLES = 8
FISHEYE_VIEW = "-vta -vh 180 -vv 180"
# radius of a disc with that solid angle
SUN_RADIUS_RAD = float(np.arccos(1.0 - SUN_SOLID_ANGLE_SR / (2.0 * np.pi)))


def fisheye_rays(size: int, samples: int = 1) -> tuple[Floats, Mask]:
    """Return unit rays [N, N, 3] of an equidistant 180-degree picture, and its circle [N, N].

    size : pixels along the picture's edge; samples : rays along a pixel's edge, so that N = size *
    samples. A ray is (right, up, forward) of the observer; row 0 is at the top. The circle is a
    mask, True within 90 degrees of the view direction.
    """
    n = size * samples
    axis = ((np.arange(n) + 0.5) / n - 0.5) * np.pi
    x, y = axis[None, :], -axis[:, None]
    angle = np.hypot(x, y)
    ratio = np.sinc(angle / np.pi)  # sin(angle) / angle
    rays = np.stack(np.broadcast_arrays(x * ratio, y * ratio, np.cos(angle)), axis=-1)
    return rays, angle <= np.pi / 2


def fisheye_solid_angles(size: int) -> Floats:
    """Return the solid angle [sr] of each pixel of an equidistant 180-degree picture, [size, size].

    It is 0 for pixels whose centre is more than 90 degrees from the view direction.
    """
    axis = ((np.arange(size) + 0.5) / size - 0.5) * np.pi
    angle = np.hypot(axis[None, :], axis[:, None])
    return np.where(angle <= np.pi / 2, np.sinc(angle / np.pi) * (np.pi / size) ** 2, 0.0)


def panorama_to_fisheye(
    luminance_cdm2: Floats,
    heading_deg: float,
    azimuth_deg: float,
    *,
    size: int = 800,
    sun: SunSource | None = None,
) -> Floats32:
    """Return an equidistant 180-degree picture (`FISHEYE_VIEW`) of a panorama, [size, size], cd/m2.

    luminance_cdm2 : the panorama [H, W = 2H]; heading_deg : azimuth of its centre column.
    azimuth_deg : the horizontal view direction of the picture. Azimuths are clockwise from north.
    sun : its light is added to the pixels of its disc; nothing is added for None or a sun behind
    the observer.

    A pixel is the mean of samples of the panorama, fine enough for both grids, so that the flux is
    preserved. Pixels outside the circle are 0.
    """
    height, width = luminance_cdm2.shape
    samples = max(2, int(np.ceil(2.0 * height / size)))
    rays, inside = fisheye_rays(size, samples)
    world = rays[inside] @ view_frame(azimuth_deg)
    row, column = equirect_pixel(*altitude_azimuth_deg(world), height, width, heading_deg)
    values = np.zeros(inside.shape, np.float32)
    values[inside] = luminance_cdm2[
        np.minimum(row.astype(int), height - 1), np.minimum(column.astype(int), width - 1)
    ]
    shares = inside.reshape(size, samples, size, samples).sum(axis=(1, 3))
    picture = values.reshape(size, samples, size, samples).sum(axis=(1, 3)) / np.maximum(shares, 1)
    picture[~(fisheye_solid_angles(size) > 0)] = 0.0
    picture = picture.astype(np.float32)
    return _with_sun(picture, sun, azimuth_deg) if sun else picture


def _with_sun(picture: Floats, sun: SunSource, azimuth_deg: float) -> Floats32:
    """Return the picture with the disc's energy added; unchanged for a sun behind the observer."""
    size = len(picture)
    x, y, z = view_frame(azimuth_deg) @ direction(sun.altitude_deg, sun.azimuth_deg)
    if z <= 0 or sun.normal_illuminance_lx <= 0:
        return picture
    angle = np.arctan2(np.hypot(x, y), z)
    stretch = angle / max(float(np.hypot(x, y)), 1e-12)
    centre = np.array([0.5 + x * stretch / np.pi, 0.5 - y * stretch / np.pi]) * size
    omega = fisheye_solid_angles(size)
    disc = _disc_pixels(_disc_shares(centre, np.array([x, y, z]), size), omega)
    if not disc.any():
        return picture
    added = disc * (sun.normal_illuminance_lx / omega[disc].sum())
    return picture + added.astype(np.float32)


def _disc_pixels(share: Floats, omega: Floats) -> Mask:
    """Return a mask of the most covered pixels, which together have the disc's solid angle, [N, N].

    Energy on half-covered rim pixels would double the solid angle of the source at 800 px, and
    halve its luminance.
    """
    order = np.argsort(share, axis=None)[::-1]
    order = order[share.ravel()[order] > 0]
    total = np.cumsum(omega.ravel()[order])
    count = int(np.argmin(np.abs(total - SUN_SOLID_ANGLE_SR))) + 1 if len(order) else 0
    out = np.zeros(share.size, bool)
    out[order[:count]] = True
    return out.reshape(share.shape) & (omega > 0)


def _disc_shares(centre: Floats, towards: Floats, size: int) -> Floats:
    """Return the share of each pixel that the sun's disc covers, [size, size]."""
    samples = _DISC_SAMPLES
    reach = int(np.ceil(2.0 * SUN_RADIUS_RAD / np.pi * size)) + 1
    left, top = (int(np.clip(np.floor(c) - reach, 0, size - 1)) for c in centre)
    right, bottom = (int(np.clip(np.floor(c) + reach + 1, 1, size)) for c in centre)
    fine_x = (left + (np.arange((right - left) * samples) + 0.5) / samples) / size - 0.5
    fine_y = 0.5 - (top + (np.arange((bottom - top) * samples) + 0.5) / samples) / size
    x, y = fine_x[None, :] * np.pi, fine_y[:, None] * np.pi
    angle = np.hypot(x, y)
    ratio = np.sinc(angle / np.pi)
    cosine = x * ratio * towards[0] + y * ratio * towards[1] + np.cos(angle) * towards[2]
    hit = (cosine >= np.cos(SUN_RADIUS_RAD)) & (angle <= np.pi / 2)
    out = np.zeros((size, size))
    cells = hit.reshape(bottom - top, samples, right - left, samples).mean(axis=(1, 3))
    out[top:bottom, left:right] = cells
    return out
