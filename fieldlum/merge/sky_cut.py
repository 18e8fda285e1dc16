"""Cut the luminance around what can be sky from the sensor, at its own resolution.

Only directions in which the sun can be within a year are kept. Of these, tiles of 2 degrees that
are as bright as a sky are resampled from the same merged sensor as the panorama; others are NaN.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from fieldlum.core.arrays import Floats, Indices, Mask
from fieldlum.core.records import Flag
from fieldlum.merge.project import ProjectedImage, blend, view_through
from fieldlum.merge.sensor import SensorImage
from fieldlum.optics.linear_light import sensor_pitch_deg
from fieldlum.optics.profiles import CameraProfile
from fieldlum.optics.projection import Equirect, equirect_rays, smallest_arc
from fieldlum.sky.sky_view import LOWEST_ALTITUDE_DEG, SkyGrid, SkyPicture
from fieldlum.sky.sun import OBLIQUITY_DEG, celestial_pole

_TILE_DEG = 2  # divides 180; chosen
# Pixels along a block of tiles: decides speed only. A block's matrices have 1 MB at most. Chosen.
_BLOCK_PX = 60
# Finest pixel. The sun's disc has 22 such pixels; finer ones would need four times the space.
# Chosen.
_FINEST_DEG = 0.1
# Added to the sun's largest declination: half the diagonal of a tile, and two degrees for the level
# of the camera, refraction and the disc.
_MAX_DECLINATION_DEG = OBLIQUITY_DEG + _TILE_DEG / np.sqrt(2.0) + 2.0
_HEADING_ERRORS_DEG = (-5.0, 0.0, 5.0)  # of a compass near steel (sky_view)
# A tile is resampled if a part of it is brighter than this share of the picture's median luminance:
# what a window shows is brighter than the room. Chosen.
_MIN_SHARE = 1.25
_SAMPLES = 3  # places of a tile in each direction at which the panorama is read; chosen


def sky_cut(
    images: Sequence[SensorImage],
    views: Sequence[ProjectedImage],
    seen: ProjectedImage,
    profile: CameraProfile,
    target: Equirect,
    heading_deg: float,
    latitude_deg: float,
) -> SkyPicture | None:
    """Return the luminance around what can be sky with the sun's disc; None if no lens sees it.

    images: merged sensor of each heading; views: of each lens of each, on the panorama `target`, in
    the order of images, then lenses; seen: their blend. heading_deg: azimuth of the panorama's
    centre, clockwise from true north; latitude_deg: of the camera. Pixels are at least as large as
    the sensor's, within 2 %, and at least 0.1 degrees.
    """
    can_be_sun = sun_tiles(heading_deg, latitude_deg) & _any(seen.coverage > 0.0, target)
    if not can_be_sun.any():
        return None
    side = max(1, int(_TILE_DEG / max(_FINEST_DEG, sensor_pitch_deg(profile)) + 0.1))
    used = np.flatnonzero(can_be_sun.any(axis=1))
    first, (left, width) = int(used[0]), smallest_arc(np.asarray(can_be_sun.any(axis=0)))
    place = np.s_[first : int(used[-1]) + 1], (left + np.arange(width)) % can_be_sun.shape[1]
    dark_cdm2 = _MIN_SHARE * float(np.median(seen.luminance[seen.coverage > 0.0]))
    shines = (seen.luminance > dark_cdm2) | (seen.flags & Flag.CLIPPED_HIGH > 0)
    bright = (can_be_sun & _any(shines & (seen.coverage > 0.0), target))[place]
    out = np.full((bright.shape[0] * side, bright.shape[1] * side), np.nan, np.float32)
    clipped = np.zeros(out.shape, bool)
    for tiles, part in _parts(bright, first, left, side):
        light, marked = _block(images, views, profile, part, target)
        for i, j in np.argwhere(bright[tiles]):
            down, across = (tiles[0].start + i) * side, (tiles[1].start + j) * side
            into = np.s_[down : down + side, across : across + side]
            of = np.s_[i * side : (i + 1) * side, j * side : (j + 1) * side]
            out[into], clipped[into] = light[of], marked[of]
    step_deg = _TILE_DEG / side
    corner_deg = 90.0 - first * _TILE_DEG, left * _TILE_DEG - 180.0
    grid = SkyGrid(*corner_deg, step_deg, heading_deg, *out.shape)
    return SkyPicture(out, clipped, grid, dark_cdm2=dark_cdm2)


def _parts(
    bright: Mask, first: int, left: int, side: int
) -> Iterator[tuple[tuple[slice, slice], Equirect]]:
    """Yield blocks with a bright tile: their tiles, and the part of the sphere that they are.

    bright: mask of tiles, of which the first is at row `first` and column `left` of a panorama of
    tiles; side: pixels of a tile.
    """
    rows, columns = bright.shape
    step = max(1, _BLOCK_PX // side)
    for i in range(0, rows, step):
        for j in range(0, columns, step):
            tiles = slice(i, min(i + step, rows)), slice(j, min(j + step, columns))
            if bright[tiles].any():
                high, wide = bright[tiles].shape
                corner = (first + i) * side, (left + j) * side
                yield tiles, Equirect(180 // _TILE_DEG * side, (*corner, high * side, wide * side))


def _block(
    images: Sequence[SensorImage],
    views: Sequence[ProjectedImage],
    profile: CameraProfile,
    part: Equirect,
    target: Equirect,
) -> tuple[Floats, Mask]:
    """Return luminance and clipped pixels of a part of the sphere, [h, w] each."""
    coarse = _coarse_pixels(part, target)
    fine = []
    pairs = [(image, lens) for image in images for lens in profile.lens]
    for (image, lens), view in zip(pairs, views, strict=True):
        if (view.coverage[coarse] > 0).any():
            stray = None if view.stray is None else view.stray[coarse]
            fine.append(view_through(image, lens, profile, part, stray))
    if not fine:
        return np.full(part.shape, np.nan), np.zeros(part.shape, bool)
    joined = blend(fine)
    unusable = (joined.flags & (Flag.OUTSIDE_LENS | Flag.FILLED)) > 0
    light = np.where(unusable, np.nan, joined.luminance)
    clipped = (joined.flags & (Flag.CLIPPED_HIGH | Flag.BLOOM)) > 0
    return light.reshape(part.shape), clipped.reshape(part.shape)


def _coarse_pixels(part: Equirect, target: Equirect) -> Indices:
    """Return the flat index of the target's pixel at each pixel of a part, [h w]."""
    assert part.part is not None
    rows, columns = (
        (start + np.arange(count) + 0.5) / part.height * target.height
        for start, count in zip(part.part[:2], part.part[2:], strict=True)
    )
    return (
        rows.astype(int)[:, None] * 2 * target.height + columns.astype(int) % (2 * target.height)
    ).ravel()


def sun_tiles(heading_deg: float, latitude_deg: float) -> Mask:
    """Return the tiles of a panorama in which the sun's disc can be within a year, [90, 180].

    They are above -2 degrees of altitude. A heading may be wrong by 5 degrees.
    """
    rows = 180 // _TILE_DEG
    pole = celestial_pole(latitude_deg)
    out = np.zeros((rows, 2 * rows), bool)
    for wrong in _HEADING_ERRORS_DEG:
        rays = equirect_rays(rows, 2 * rows, heading_deg + wrong)
        out |= np.abs(np.degrees(np.arcsin(np.clip(rays @ pole, -1, 1)))) < _MAX_DECLINATION_DEG
    above = 90.0 - np.arange(rows) * _TILE_DEG > LOWEST_ALTITUDE_DEG
    return out & above[:, None]


def _any(marked: Mask, target: Equirect) -> Mask:
    """Return the tiles with a marked pixel of a panorama [n], [90, 180]."""
    rows = 180 // _TILE_DEG * _SAMPLES
    at = marked[_coarse_pixels(Equirect(rows, (0, 0, rows, 2 * rows)), target)]
    return np.asarray(at.reshape(rows // _SAMPLES, _SAMPLES, -1, _SAMPLES).any(axis=(1, 3)))
