"""Compute the light on each pixel of a fisheye sensor from a luminance panorama."""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.sparse import csr_array, vstack

from fieldlum.core.arrays import Floats, Floats32, Indices, Ints32
from fieldlum.core.records import Panorama, SunSource
from fieldlum.devices.simulated.world import detail_of
from fieldlum.optics import projection
from fieldlum.optics.projection import LensGeometry, angle_of_radius, lens_pixels, lens_rays
from fieldlum.room.scene.trace import DISC_RAYS, SUN_RADIUS_DEG, disc_rays
from fieldlum.sky.sky_view.picture import SkyGrid

_SUBSAMPLES = 3  # directions per sensor pixel and axis; chosen, not measured
# Standard deviation of the lens's blur. Without a finer part of the panorama it is applied to the
# sun only, because everything else is smoother. Chosen as that of a good lens; not measured.
_PSF_PX = 0.5


@dataclass(frozen=True, slots=True)
class LensSampling:
    """How the sensor pixels of one lens sample a panorama of H x W pixels.

    geometry : of the lens; pixels [n] : flat indices of the n sensor pixels that it lights; weights
    [n, H * W + h * w] : share of each pixel of the panorama, then of its finer picture of h x w
    pixels if it has one, in each sensor pixel; each row sums to 1.
    """

    geometry: LensGeometry
    pixels: Indices
    weights: csr_array


@lru_cache(maxsize=8)  # also for a camera that is opened again: 20 megapixels take 16 s
def lens_sampling(
    lens: LensGeometry, sensor: tuple[int, int], panorama: tuple[int, int], grid: SkyGrid | None
) -> LensSampling:
    """Return how a lens samples a panorama: each sensor pixel averages 3 x 3 directions.

    lens : turned by the camera's heading minus that of the panorama; sensor, panorama : (height,
    width) in pixels; grid : directions of the panorama's finer picture, None without one. Panorama
    and finer picture are constant over each of their pixels.
    """
    # the pixels reach beyond the circle, to include its edge
    (centre_x, centre_y), reach_px = lens.centre_px, lens.radius_px + 1.0
    top, bottom = max(int(centre_y - reach_px), 0), min(int(centre_y + reach_px) + 1, sensor[0])
    left, right = max(int(centre_x - reach_px), 0), min(int(centre_x + reach_px) + 1, sensor[1])
    step = max(1, 500_000 // max(1, right - left))  # rows at a time, 300 MB; limits memory only
    inner = (np.arange(_SUBSAMPLES) + 0.5) / _SUBSAMPLES  # places in a pixel, of its side
    count = panorama[0] * panorama[1] + (grid.height * grid.width if grid else 0)
    pixels, blocks = [], []
    for first in range(top, bottom, step):
        rows, columns = np.mgrid[first : min(first + step, bottom), left:right]
        near = np.hypot(columns + 0.5 - centre_x, rows + 0.5 - centre_y) < reach_px
        rows, columns = rows[near], columns[near]  # [pixels]
        # [pixels, 3, 3, xyz]
        rays = lens_rays(lens, columns[:, None, None] + inner, rows[:, None, None] + inner[:, None])
        source = _source_pixels(rays.reshape(-1, 3), panorama, grid)
        share = np.full(len(source), 1.0 / _SUBSAMPLES**2, np.float32)
        starts = np.arange(len(rows) + 1, dtype=np.int32) * _SUBSAMPLES**2
        block = csr_array((share, source, starts), shape=(len(rows), count))
        block.sum_duplicates()
        blocks.append(block)
        pixels.append((rows * sensor[1] + columns).astype(np.int32))
    return LensSampling(lens, np.concatenate(pixels), csr_array(vstack(blocks)))


def _source_pixels(rays: Floats, panorama: tuple[int, int], grid: SkyGrid | None) -> Ints32:
    """Return the index of the pixel that each ray meets, [n].

    It is a flat index of the panorama; within the finer picture a flat index of that, plus the
    number of pixels of the panorama. rays: unit vectors in the panorama's own frame (heading 0),
    [n, 3]; panorama: (height, width); grid: directions of the finer picture, None without one.
    """
    coarse = projection.flat_pixels(rays, panorama, 0.0)
    if grid is None:
        return coarse.astype(np.int32)
    row, column = (np.floor(place) for place in replace(grid, heading_deg=0.0).pixels(rays))
    is_inside = (row >= 0) & (row < grid.height) & (column < grid.width)
    fine = panorama[0] * panorama[1] + row * grid.width + column
    return np.where(is_inside, fine, coarse).astype(np.int32)


def channels(panorama: Panorama) -> Floats32:
    """Return R, G, B of each pixel of a panorama [cd/m2], [H * W, 3], row by row.

    They are 179 lm/W times Radiance's, so that .265 R + .670 G + .065 B is the luminance. A
    panorama without colour gives its luminance, [H * W, 1].
    """
    from fieldlum.optics.images import RADIANCE_LM_PER_W

    if panorama.rgb is None:
        return np.asarray(panorama.luminance_cdm2, np.float32).reshape(-1, 1)
    return (RADIANCE_LM_PER_W * np.asarray(panorama.rgb, np.float32)).reshape(-1, 3)


def on_sensor(panorama: Panorama, views: list[LensSampling], sensor: tuple[int, int]) -> Floats32:
    """Return the mean R, G, B [cd/m2] of the light on each sensor pixel, [h, w, 3]; grey [h, w, 1].

    The sun's disc is included; pixels outside the lenses are 0. views : by `lens_sampling`, one for
    each lens; sensor : (height, width). Only a panorama with a finer picture is blurred by the
    lens.
    """
    flat = channels(panorama)
    detail = detail_of(panorama)
    if detail is not None:
        # the finer picture has luminance only: its pixels have their colour from the panorama
        rays = replace(detail.grid, heading_deg=0.0).rays().reshape(-1, 3)
        coarse = projection.flat_pixels(rays, panorama.luminance_cdm2.shape, 0.0)
        luminance = panorama.luminance_cdm2.ravel()[coarse]
        ratio = detail.luminance_cdm2.ravel() / np.maximum(luminance, 1e-9)
        ratio = np.where(np.isfinite(ratio), ratio, 1.0)[:, None].astype(np.float32)
        flat = np.concatenate((flat, flat[coarse] * ratio))
    out = np.zeros((sensor[0] * sensor[1], flat.shape[1]), np.float32)
    for view in views:
        out[view.pixels] = view.weights @ flat
    image = out.reshape(*sensor, -1)
    if detail is not None:
        image = np.asarray(gaussian_filter(image, (_PSF_PX, _PSF_PX, 0)), np.float32)
    if panorama.sun is not None:
        for view in views:
            _add_sun(image, panorama, panorama.sun, view.geometry)
    return image


def _add_sun(image: Floats32, panorama: Panorama, sun: SunSource, lens: LensGeometry) -> None:
    """Add the visible part of the sun's disc to an image of the sensor in place, blurred.

    image: [h, w, 1 or 3] in cd/m2; lens: of one part of the sensor; a sun outside its view adds
    nothing. The sum of luminance times solid angle over the disc's pixels equals the sun's normal
    illuminance.
    """
    sun_ray = projection.direction(sun.altitude_deg, sun.azimuth_deg - panorama.heading_deg)
    x, y, angle = lens_pixels(lens, sun_ray)
    if angle >= lens.half_angle_rad:
        return
    reach, fine = 8, 8  # pixels around the disc, 16 sigma of the blur; samples per pixel and axis
    rows, columns = int(y) - reach + np.arange(2 * reach), int(x) - reach + np.arange(2 * reach)
    step = (np.arange(2 * reach * fine) + 0.5) / fine
    rays = lens_rays(lens, (columns[0] + step)[None, :], (rows[0] + step)[:, None])
    covered = (rays @ sun_ray > np.cos(np.radians(SUN_RADIUS_DEG))).astype(float)
    if DISC_RAYS in panorama.attributes:  # which rays of the disc an obstruction leaves visible
        is_visible = np.frombuffer(panorama.attributes[DISC_RAYS].encode(), np.uint8) == ord("1")
        disc = np.flatnonzero(covered)
        nearest = (rays.reshape(-1, 3)[disc] @ disc_rays(sun_ray).T).argmax(axis=1)
        covered.ravel()[disc] = is_visible[nearest]
    blurred = gaussian_filter(covered, _PSF_PX * fine)
    share = blurred.reshape(2 * reach, fine, 2 * reach, fine).sum(axis=(1, 3))  # of each pixel
    solid_angle_sr = pixel_solid_angle_sr(lens, columns[None, :] + 0.5, rows[:, None] + 0.5)
    cdm2 = share / share.sum() * sun.normal_illuminance_lx / np.maximum(solid_angle_sr, 1e-12)
    # the parts of these rows and columns that are on the sensor
    fits = ((rows >= 0) & (rows < image.shape[0]), (columns >= 0) & (columns < image.shape[1]))
    cdm2 = np.where(solid_angle_sr > 0, cdm2, 0.0)[np.ix_(*fits)]
    image[np.ix_(rows[fits[0]], columns[fits[1]])] += cdm2[..., None].astype(np.float32)


def pixel_solid_angle_sr(lens: LensGeometry, x_px: Floats, y_px: Floats) -> Floats:
    """Return the solid angle [sr] of a pixel at some points of the sensor, [...].

    x_px, y_px : column and row, [...]; the first pixel's centre is at (0.5, 0.5). The solid angle
    is 0 outside the image circle.
    """
    radius = projection.relative_radius(lens, x_px, y_px)  # 1 at the edge of the image circle
    step = 1e-4
    r = np.clip(radius, step, 1.0 - step)
    # The ring has the solid angle 2 pi * ring, and 2 pi r * 2 step * radius_px^2 pixels.
    ring = np.cos(angle_of_radius(lens, r - step)) - np.cos(angle_of_radius(lens, r + step))
    return np.where(radius <= 1.0, ring / (2 * step * r * lens.radius_px**2), 0.0)
