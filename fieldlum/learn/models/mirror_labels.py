"""Take images of the sun in plane mirrors out of captures, and learn where such images are visible.

The camera does not move, so that an image in one direction is visible or hidden in every hour. Each
capture with direct sun labels the direction of its image. Other directions follow from labels that
are near and whose pixels have similar luminance in all captures.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fieldlum.core.arrays import Floats, Floats32, Indices, Mask
from fieldlum.learn.models.data import Dataset
from fieldlum.learn.models.mirrors import TO_SHOW, Mirror, pixels
from fieldlum.optics.projection import equirect_rays, equirect_solid_angles
from fieldlum.sky.sun_disc import brightest_surface_cdm2, without_disc
from fieldlum.sky.sun_images import (
    MirrorPlane,
    SunImage,
    bright_spots,
    find_mirrors,
    glass_reflectance,
    mirrored,
    near_sun_rad,
)

# Kernel of the labels; chosen. In three views of a mirroring facade, other widths (6 to 18 degrees,
# 0.05 to 0.2) change the error of DGP by -25 to +30 %, some by a factor of two
# (docs/decisions.md).
_NEAR_DEG = 9.0
_ALIKE_LOG10 = 0.1  # rms difference of log10 luminance over the captures
_FAR_WEIGHT = 0.01  # of a label at any distance whose pixel is alike; chosen
_PRIOR_WEIGHT = 1e-4  # of a label with a chance of one half; less than any alike label; chosen
_MAX_MAPS = 40  # captures that compare pixels; chosen, limits the time
_PIXELS_AT_ONCE = 4096  # limits the memory
# A label that is further than two widths away, or not alike, does not make an image certain.
_SUPPORTED = float(np.exp(-2.0))
_UNSUPPORTED_CHANCE = 0.9  # chosen
_TO_BE_FOUND = 2.0  # multiple of the luminance of `bright_spots` that shows an image; chosen


def split_images(data: Dataset) -> tuple[Dataset, tuple[Mirror, ...]]:
    """Remove images of the sun in plane mirrors from the captures; return them and the mirrors.

    The pixels of an image get the luminance of their surroundings. If no mirror is found, return
    `data` itself and an empty tuple.
    """
    light, suns = data.light, data.light.shown_sun_direction
    spots = [
        spot
        for k, image in enumerate(data.luminance_cdm2)
        for spot in bright_spots(image, data.heading_deg, suns[k], float(light.dni_wm2[k]), k)
    ]
    planes = find_mirrors(spots, suns, light.direct_lx, data.shape[0]) if spots else []
    if not planes:
        return data, ()
    maps = data.luminance_cdm2.copy()
    for image in (image for plane in planes for image in plane.images):
        maps[image.row] = without_disc(maps[image.row], image.spot)
    data = replace(data, luminance_cdm2=maps)
    return data, tuple(_mirror(plane, data) for plane in planes)


def _mirror(plane: MirrorPlane, data: Dataset) -> Mirror:
    """Return a plane with the energy of its images, and where they are visible."""
    suns, rows = data.light.shown_sun_direction, np.array([image.row for image in plane.images])
    full_lx = glass_reflectance(suns @ plane.normal) * data.light.direct_lx  # [n], factor 1
    factors = np.array([image.spot.normal_lx for image in plane.images]) / full_lx[rows]
    valid = np.array([_is_measured(image, data) for image in plane.images])
    factor = float(np.median(factors[valid] if valid.any() else factors))
    towards = mirrored(suns, plane.normal)
    at = pixels(towards, data.shape, data.heading_deg)
    visible = np.isin(np.arange(len(data)), rows)
    limit = np.array([brightest_surface_cdm2(float(dni)) for dni in data.light.dni_wm2])
    bright = factor * full_lx / equirect_solid_angles(*data.shape).reshape(-1)[at]  # cd/m2
    # An image next to the sun, which is not searched, is at a grazing angle.
    front = suns @ plane.normal > np.sin(near_sun_rad(data.shape[0]) / 2.0)
    shows = (bright > _TO_BE_FOUND * limit) & front & data.seen.reshape(-1)[at]
    label = np.flatnonzero(visible | shows)
    chance, wrong = _chance(data, label, towards[label], at[label], visible[label])
    u_deg, count = plane.u_deg, len(rows)
    east, north, up = plane.normal.tolist()
    measured = bool(valid.any())
    return Mirror((east, north, up), u_deg, count, factor, measured, len(label), wrong, chance)


def _is_measured(image: SunImage, data: Dataset) -> bool:
    """Return whether no pixel of an image is clipped, moving or filled."""
    return data.counts is None or bool((data.counts[image.row][image.spot.pixels] > 0.0).all())


def _chance(
    data: Dataset, label: Indices, towards: Floats, at: Indices, visible: Mask
) -> tuple[Floats32, int]:
    """Return the chance [H, W] that an image is visible, and the labels wrong by the other days.

    label: captures [k]; towards, at, visible: direction [k, 3], pixel [k] and label [k] of their
    images.
    """
    some = np.unique(np.linspace(0, len(data) - 1, _MAX_MAPS).round().astype(int))
    maps = np.log10(np.maximum(data.luminance_cdm2[some], 1.0)).reshape(len(some), -1)
    rays = equirect_rays(*data.shape, data.heading_deg).reshape(-1, 3)
    chance = np.empty(len(rays), np.float32)
    for start in range(0, len(rays), _PIXELS_AT_ONCE):
        part = slice(start, start + _PIXELS_AT_ONCE)
        chance[part] = _voted(rays[part] @ towards.T, maps[:, part], maps[:, at], visible)
    wrong = 0
    for day in np.unique(data.days[label]):
        out = data.days[label] == day
        here, there = maps[:, at[out]], maps[:, at[~out]]
        held_out = _voted(rays[at[out]] @ towards[~out].T, here, there, visible[~out])
        wrong += int(((held_out > TO_SHOW) != visible[out]).sum())
    return chance.reshape(data.shape), wrong


def _voted(cosine: Floats, here: Floats32, there: Floats32, visible: Mask) -> Floats:
    """Return the weighted share of visible labels for m pixels, [m].

    cosine [m, k]: between pixels and labels; here [n, m], there [n, k]: log10 luminance over n
    captures; visible [k].
    """
    square = (here**2).sum(axis=0)[:, None] + (there**2).sum(axis=0) - 2.0 * here.T @ there
    unlike = np.maximum(square, 0.0) / len(here) / _ALIKE_LOG10**2
    alike = np.exp(-0.5 * unlike.astype(float))  # [m, k]
    angle_deg = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    near = alike * np.exp(-0.5 * (angle_deg / _NEAR_DEG) ** 2)
    weight = near + _FAR_WEIGHT * alike
    share = (weight @ visible + 0.5 * _PRIOR_WEIGHT) / (weight.sum(axis=1) + _PRIOR_WEIGHT)
    supported = near.max(axis=1, initial=0.0) >= _SUPPORTED
    return np.where(supported, share, np.minimum(share, _UNSUPPORTED_CHANCE))
