"""Resample a panorama to fisheye pictures by flux, and add the sun by its energy."""

from __future__ import annotations

import numpy as np

from fieldlum.core.arrays import Floats, Floats32
from fieldlum.core.records import SunSource
from fieldlum.optics.projection import altitude_azimuth_deg, direction, equirect_pixel
from fieldlum.sky.sun import SUN_SOLID_ANGLE_SR
from fieldlum.sky.sun_disc import SUN_RADIUS_RAD
from fieldlum.year.glare.geometry import Views
from fieldlum.year.glare.picture_view import (
    PictureView,
    picture_centres,
    picture_rays,
    picture_views,
)

FISHEYE_VIEW = "-vta -vh 180 -vv 180"


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
    view = PictureView("a", direction(0.0, azimuth_deg), direction(90.0, 0.0), 180.0, 180.0)
    samples = max(2, int(np.ceil(2.0 * height / size)))
    y, x = picture_centres(size * samples, size * samples)
    rays = picture_rays(view, x, y)[0]
    inside = rays[..., 2] > 0.0
    places = equirect_pixel(
        *altitude_azimuth_deg(rays[inside] @ view.frame), height, width, heading_deg
    )
    row, column = (
        np.minimum(p.astype(int), n - 1) for p, n in zip(places, (height, width), strict=True)
    )
    values = np.zeros(inside.shape, np.float32)
    values[inside] = luminance_cdm2[row, column]
    cells = (size, samples, size, samples)
    shares = inside.reshape(cells).sum(axis=(1, 3))
    picture = values.reshape(cells).sum(axis=(1, 3)) / np.maximum(shares, 1)
    y, x = picture_centres(size, size)
    picture[np.hypot(x, y) > 0.5] = 0.0
    if sun is not None:
        picture += disc_pixels(picture_views(view, size, size), picture.shape, sun)
    return picture.astype(np.float32)


def disc_pixels(views: Views, shape: tuple[int, int], sun: SunSource) -> Floats32:
    """Return the luminance [H, W] that the sun's disc adds to the pixels of a picture, in cd/m2.

    views : weights of the picture of this shape, in its own direction. The nearest pixels that have
    the disc's solid angle together, at least one, get the same luminance, so that they have its
    energy. A sun behind the observer or outside the picture, over a pixel's diagonal from the
    nearest one, adds nothing.
    """
    out = np.zeros(shape, np.float32)
    rays, omega = views.rays()
    towards = views.frames[0] @ direction(sun.altitude_deg, sun.azimuth_deg)
    off = np.linalg.norm(rays[:, :, 0] - towards.astype(np.float32), axis=1)  # chords, rad
    off[omega[:, 0] <= 0.0] = np.inf
    near = np.argsort(off)
    diagonal_rad = np.sqrt(2.0 * omega[near[0], 0])
    if towards[2] <= 0.0 or off[near[0]] > SUN_RADIUS_RAD + diagonal_rad:
        return out
    total = np.cumsum(omega[near, 0], dtype=float)
    disc = near[: int(np.argmin(np.abs(total - SUN_SOLID_ANGLE_SR))) + 1]
    out.flat[disc] = sun.normal_illuminance_lx / omega[disc, 0].sum(dtype=float)
    return out
