"""Remove the sun's disc from a merged map, and cut out the luminance around what can be sky.

The disc's illuminance is measured if a frame is not clipped there, such as one through a filter. If
every frame is clipped, the removed light is a lower bound, and the disc's pixels keep CLIPPED_HIGH;
`pair` later computes the disc's illuminance from the irradiance of that hour. Around what can be
sky, only directions in which the sun can be within a year are kept. Of these, tiles of 2 degrees
that are as bright as a sky are resampled from the same merged sensor as the panorama; others are
NaN.
"""

from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from itertools import product

import numpy as np
from scipy.ndimage import center_of_mass

from fieldlum.core.arrays import Floats, Indices, Mask
from fieldlum.core.records import CLIPPED_SUN, Flag, Panorama, Site, SunSource
from fieldlum.merge.project import LensView, ProjectedImage, blend, view_through
from fieldlum.merge.sensor_frames import SensorImage
from fieldlum.optics import projection
from fieldlum.optics.linear_light import sensor_pitch_deg
from fieldlum.optics.profiles import Lens
from fieldlum.optics.projection import Equirect
from fieldlum.sky.sky_view.picture import LOWEST_ALTITUDE_DEG, SkyGrid, SkyPicture
from fieldlum.sky.sun import OBLIQUITY_DEG, celestial_pole, position
from fieldlum.sky.sun_disc import SUN_RADIUS_RAD, SunDisc, find_disc, without_disc

# Standard uncertainty [px] of a disc's centre of energy on a mosaic, for a disc one pixel wide and
# sharp optics: 0.08 px rms over positions on the mosaic (simulation, 150 draws for each width). It
# decreases with the disc's width, but not below the second value.
_CENTRE_PX, _MIN_CENTRE_PX = 0.1, 0.02
_BLUR_RAD = np.radians(0.5)  # blur of a lens; not measured
MEASURED = "nd-frames"


def expected_sun_deg(t_utc: datetime, site: Site) -> tuple[float, float] | None:
    """Return the sun's apparent altitude and its azimuth from true north [deg].

    Return None if the complete disc is below the horizon. Raises ValueError for a naive time.
    """
    sun = position([t_utc], site)
    altitude, azimuth = float(sun.apparent_altitude_deg[0]), float(sun.azimuth_deg[0])
    return None if altitude < -np.degrees(SUN_RADIUS_RAD) else (altitude, azimuth)


def take_out_disc(
    panorama: Panorama, altitude_deg: float, azimuth_deg: float
) -> tuple[Panorama, SunDisc | None]:
    """Return the panorama without the sun's disc, and the disc.

    altitude_deg, azimuth_deg: the sun's apparent direction, clockwise from true north, near which
    the disc is searched for. The disc's pixels get the luminance of their surroundings, an
    uncertainty of 100 % and the flag FILLED. The panorama's `sun` gets the disc's illuminance, with
    one of three origins: "clipped" (all frames are clipped: a lower bound), "nd-frames" (measured
    through a filter) or "merge" (measured without a filter). If the disc is not visible, return the
    panorama unchanged and None.
    """
    recorded = 0 if panorama.flags is None else panorama.flags
    flags = np.zeros(panorama.luminance_cdm2.shape, np.uint16) | np.asarray(recorded, np.uint16)
    disc = _disc_near(panorama, (flags & Flag.CLIPPED_HIGH) > 0, altitude_deg, azimuth_deg)
    if disc is None:
        return panorama, None
    filtered = bool(((flags & Flag.ND) > 0)[disc.pixels].any())
    origin = CLIPPED_SUN if disc.clipped else MEASURED if filtered else "merge"
    flags[disc.pixels] |= np.uint16(Flag.FILLED)
    light, u_cdm2, rgb = panorama.luminance_cdm2, panorama.u_cdm2, panorama.rgb
    if u_cdm2 is not None:
        u_cdm2 = np.where(disc.pixels, disc.surroundings_cdm2, u_cdm2).astype(np.float32)
    if rgb is not None:
        remaining = np.where(disc.pixels, disc.surroundings_cdm2 / np.maximum(light, 1e-12), 1.0)
        rgb = (rgb * remaining[..., None]).astype(np.float32)
    without = replace(
        panorama,
        luminance_cdm2=without_disc(light, disc),
        u_cdm2=u_cdm2,
        flags=flags,
        sun=SunSource(altitude_deg, azimuth_deg, disc.normal_lx, origin=origin),
        rgb=rgb,
    )
    return without, disc


def _disc_near(
    panorama: Panorama, clipped: Mask, altitude_deg: float, azimuth_deg: float
) -> SunDisc | None:
    """Return the sun's disc within 3 degrees of the sun's stated place; None if there is none.

    clipped: pixels that are clipped in all frames [H, W]; altitude_deg, azimuth_deg: the sun's
    apparent place, clockwise from true north. A compass near steel is wrong by up to 5 degrees, so
    places 5 degrees to either side are searched too. There a disc must exceed 20 klx, because a
    facade of glass mirrors up to a fifth of the sun's 100 klx.
    """
    light, heading_deg = panorama.luminance_cdm2, panorama.heading_deg
    for turn_deg in (0.0, 5.0, -5.0):
        near_deg = (altitude_deg, (azimuth_deg + turn_deg) % 360.0)
        disc = find_disc(light, heading_deg, near_deg=near_deg, clipped=clipped)
        strong = disc is not None and np.isfinite(disc.sigma_deg) and disc.normal_lx > 20_000.0
        if disc is not None and (not turn_deg or strong):
            return disc
    return None


def disc_px(lenses: Sequence[Lens]) -> float:
    """Return the diameter of the sun's disc on the sensor [px], averaged over a lens's field.

    With several lenses it is the smallest of their diameters.
    """
    return min(
        2 * SUN_RADIUS_RAD * lens.radius_px / np.radians(lens.full_angle_deg / 2) for lens in lenses
    )


def mosaic_u_rel(diameter_px: float) -> float:
    """Return the relative standard uncertainty of a small disc's illuminance due to the mosaic.

    diameter_px: of the disc on the sensor. Each colour samples only some of the pixels. The result
    is an rms over positions of the disc, for sharp optics, at most 0.5. It is accurate within 25 %
    between 0.7 and 16 pixels (the law of lattice points in a circle; bench/sun_on_mosaic.py). For
    real optics it is an upper bound: where they spread a point over two pixels, the error is 20
    times smaller.
    """
    return min(0.5, 0.3 * diameter_px**-1.5)


# ----------------------------------------------------------------------------------------------
# the disc's centre on the sensor


def sun_on_sensor(
    images: Sequence[SensorImage], disc: SunDisc, panorama: Panorama
) -> tuple[float, float, float] | None:
    """Return altitude, azimuth and standard uncertainty of the sun disc on the sensor [deg].

    images: merged sensor of each heading, of which the one whose lens axis is nearest to the disc
    is used; disc: as found in the panorama. The azimuth is clockwise from true north. Return None
    if no lens sees the disc, or if the panorama does not determine its centre (disc.sigma_deg is
    NaN).
    """
    heading_deg, pixel_rad = panorama.heading_deg, np.pi / len(panorama.luminance_cdm2)
    towards = projection.direction(disc.altitude_deg, disc.azimuth_deg - heading_deg)
    lenses = [(image, image.geometry(lens)) for image in images for lens in image.profile.lens]
    # x, y [px] and angle from the axis [rad] of the disc in each lens
    places = [tuple(map(float, projection.lens_pixels(lens, towards))) for _, lens in lenses]
    number = int(np.argmin([angle for _, _, angle in places]))
    (image, lens), (x, y, angle) = lenses[number], places[number]
    if angle >= lens.half_angle_rad or np.isnan(disc.sigma_deg):
        return None
    light, clipped = image.luminance_and_clipped()  # [height, width] of the sensor's crop
    px_per_rad = lens.radius_px / lens.half_angle_rad
    reach_px = 2.0 + px_per_rad * (SUN_RADIUS_RAD + _BLUR_RAD + 2.0 * pixel_rad)
    top, left = max(int(y - reach_px), 0), max(int(x - reach_px), 0)
    window = np.s_[top : int(y + reach_px) + 2, left : int(x + reach_px) + 2]
    brightest = np.unravel_index(int(np.argmax(light[window])), light[window].shape)
    is_clipped = bool(clipped[window][brightest])
    weight = clipped[window].astype(float)
    if not is_clipped:
        excess = light[window] - float(np.median(light[window]))
        # pixels with less than 5 % of the brightest one's excess are sky
        weight = np.where(excess > 0.05 * excess.max(initial=0.0), excess, 0.0).astype(float)
    if not weight.any():
        return None
    row, column = np.asarray(center_of_mass(weight), float)  # of pixel centres
    diameter_px = 2.0 * np.sqrt(np.count_nonzero(weight) / np.pi)
    # the halo of a clipped spot is not exactly round
    sigma_px = 0.05 * diameter_px if is_clipped else _CENTRE_PX / max(diameter_px, 1.0)
    sigma_px = max(float(sigma_px), _MIN_CENTRE_PX)
    ray = projection.lens_rays(lens, left + column + 0.5, top + row + 0.5)
    altitude, azimuth = map(float, projection.altitude_azimuth_deg(ray))
    return altitude, (azimuth + heading_deg) % 360.0, float(np.degrees(sigma_px / px_per_rad))


# ----------------------------------------------------------------------------------------------
# the sky's luminance, in tiles of the panorama


_TILE_DEG = 2  # side of a tile; divides 180; chosen
# Added to the sun's largest declination: half the diagonal of a tile, and two degrees for the level
# of the camera, refraction and the disc.
_MAX_DECLINATION_DEG = OBLIQUITY_DEG + _TILE_DEG / np.sqrt(2.0) + 2.0
_HEADING_ERRORS_DEG = (-5.0, 0.0, 5.0)  # of a compass near steel (sky_view)
_SAMPLES = 3  # places of a tile in each direction at which the panorama is read; chosen


def sky_cut(
    views: Sequence[LensView],
    seen: ProjectedImage,
    target: Equirect,
    heading_deg: float,
    latitude_deg: float,
) -> SkyPicture | None:
    """Return the luminance of directions that the sun reaches in a year; None if no lens sees any.

    Only tiles with a pixel that is clipped, or brighter than 1.25 times the median of the panorama,
    are filled; others are NaN. views: of each lens at each heading, on the panorama `target`; seen:
    their blend. heading_deg: azimuth of the panorama's centre, clockwise from true north;
    latitude_deg: of the camera. Pixels are at least as large as the sensor's, within 2 %, and at
    least 0.1 degrees.
    """
    can_be_sun = sun_tiles(heading_deg, latitude_deg) & _tiles_with(seen.coverage > 0.0, target)
    if not can_be_sun.any():
        return None
    # The sun's disc has 22 pixels of 0.1 degrees; finer ones would need four times the space.
    side = max(1, int(_TILE_DEG / max(0.1, sensor_pitch_deg(views[0].sensor.profile)) + 0.1))
    rows = np.flatnonzero(can_be_sun.any(axis=1))
    first, (left, width) = int(rows[0]), projection.smallest_arc(np.asarray(can_be_sun.any(axis=0)))
    # the rectangle of all such tiles, which may continue from the last column to the first
    window = (np.s_[first : int(rows[-1]) + 1], (left + np.arange(width)) % can_be_sun.shape[1])
    # What a window shows is brighter than the room: only brighter tiles are resampled.
    dark_cdm2 = 1.25 * float(np.median(seen.luminance[seen.coverage > 0.0]))
    shines = (seen.luminance > dark_cdm2) | (seen.flags & Flag.CLIPPED_HIGH > 0)
    bright = (can_be_sun & _tiles_with(shines & (seen.coverage > 0.0), target))[window]
    light_cdm2 = np.full((bright.shape[0] * side, bright.shape[1] * side), np.nan, np.float32)
    clipped = np.zeros(light_cdm2.shape, bool)
    step = max(1, 60 // side)  # tiles whose matrices have 1 MB at most; decides speed only
    for i, j in product(*(range(0, count, step) for count in bright.shape)):
        tiles = bright[i : i + step, j : j + step]
        if not tiles.any():
            continue
        used = np.kron(tiles, np.ones((side, side), bool))
        place = ((first + i) * side, (left + j) * side, *used.shape)
        of_block, clipped_in_block = _block(views, Equirect(180 // _TILE_DEG * side, place), target)
        into = np.s_[i * side : (i + step) * side, j * side : (j + step) * side]
        light_cdm2[into] = np.where(used, of_block, np.nan)
        clipped[into] = used & clipped_in_block
    grid = SkyGrid(
        first_altitude_deg=90.0 - first * _TILE_DEG,
        first_azimuth_deg=left * _TILE_DEG - 180.0,
        step_deg=_TILE_DEG / side,
        heading_deg=heading_deg,
        height=light_cdm2.shape[0],
        width=light_cdm2.shape[1],
    )
    return SkyPicture(light_cdm2, clipped, grid, dark_cdm2=dark_cdm2)


def _block(views: Sequence[LensView], part: Equirect, target: Equirect) -> tuple[Floats, Mask]:
    """Return luminance [cd/m2] and a mask of the clipped pixels of a part of the sphere, [h, w].

    views: of each lens at each heading, on the panorama `target`. Pixels that no lens sees, or
    without a good sensor pixel, are NaN.
    """
    coarse = _coarse_pixels(part, target)
    fine = []
    for view in views:
        if (view.coverage[coarse] > 0).any():
            stray = None if view.stray is None else view.stray[coarse]
            fine.append(view_through(view.sensor, view.lens, part, stray))
    if not fine:
        return np.full(part.shape, np.nan), np.zeros(part.shape, bool)
    joined = blend(fine)
    unusable = (joined.flags & (Flag.OUTSIDE_LENS | Flag.FILLED)) > 0
    light = np.where(unusable, np.nan, joined.luminance)
    clipped = (joined.flags & (Flag.CLIPPED_HIGH | Flag.BLOOM)) > 0
    return light.reshape(part.shape), clipped.reshape(part.shape)


def _coarse_pixels(part: Equirect, target: Equirect) -> Indices:
    """Return the flat index of the pixel of `target` that contains each pixel of a part, [h w]."""
    rows, columns = (
        ((start + np.arange(count) + 0.5) / part.height * target.height).astype(int)
        for start, count in zip(part.corner, part.shape, strict=True)
    )
    width = 2 * target.height
    return (rows[:, None] * width + columns % width).ravel()


def sun_tiles(heading_deg: float, latitude_deg: float) -> Mask:
    """Return a mask [90, 180] of the panorama's tiles in which the sun can be within a year.

    A tile is 2 x 2 degrees; row 0 is at the zenith. Tiles that begin at the lowest altitude of a
    sky picture or below are False. heading_deg: azimuth of the middle, clockwise from true north,
    which may be wrong by 5 degrees.
    """
    rows = 180 // _TILE_DEG
    pole = celestial_pole(latitude_deg)
    reached = np.zeros((rows, 2 * rows), bool)
    for error_deg in _HEADING_ERRORS_DEG:
        rays = projection.equirect_rays(rows, 2 * rows, heading_deg + error_deg)
        declination_deg = np.degrees(np.arcsin(np.clip(rays @ pole, -1, 1)))
        reached |= np.abs(declination_deg) < _MAX_DECLINATION_DEG
    above = 90.0 - np.arange(rows) * _TILE_DEG > LOWEST_ALTITUDE_DEG
    return reached & above[:, None]


def _tiles_with(marked: Mask, target: Equirect) -> Mask:
    """Return a mask [90, 180], True for tiles with a marked pixel at one of 3 x 3 places in them.

    marked: of the pixels of the panorama `target`, flat [H W].
    """
    rows = 180 // _TILE_DEG * _SAMPLES
    at = marked[_coarse_pixels(Equirect(rows), target)]
    return np.asarray(at.reshape(rows // _SAMPLES, _SAMPLES, -1, _SAMPLES).any(axis=(1, 3)))
