"""Find the sun disc in a luminance map; remove or add it by its energy.

In a map the sun is in one or a few pixels, whose luminance depends on their size: only the disc's
illuminance on a plane normal to the sun is comparable. Merge, training data and the glare of single
pictures separate map and disc with the functions of this module.
"""

from dataclasses import dataclass

import numpy as np

from fieldlum.core.arrays import Floats, Floats32, Mask
from fieldlum.optics import projection
from fieldlum.optics.projection import column_azimuths_deg, direction, row_altitudes_deg
from fieldlum.sky.daylight import Light
from fieldlum.sky.sun import SUN_SOLID_ANGLE_SR

SUN_RADIUS_RAD = 0.004652  # 0.2665 degrees, the mean disc of SUN_SOLID_ANGLE_SR
# Mean luminance over the true disc. A dimmer sun gives less than 68 lx, a DNI of 0.7 W/m2, which no
# pyranometer resolves; no sky and no matt surface of the disc's size is as bright. Chosen.
MIN_DISC_CDM2 = 1e6
# The clear-sky sun outside the atmosphere has 2.0e9 cd/m2 (133 klx), with 10 % margin. The margin
# is chosen.
MAX_DISC_CDM2 = 2.2e9
# Three times a white surface in full sun (1e5 lx / pi); only clouds within a few degrees of the sun
# are nearly as bright. Chosen.
BRIGHTEST_SURFACE_CDM2 = 1e5
# A uniform overcast sky of 60 klx; the least bound on surfaces where DNI shows that the sun is
# weak. Chosen.
_BRIGHTEST_SKY_CDM2 = 2e4
_LUMENS_PER_WATT = 93.0  # of direct sunlight, accurate to 15 %; only the bounds above depend on it
_SEARCH_RAD = np.radians(3.0)  # error of direction of a camera that was set up by hand; chosen
_CLIPPED_REACH_RAD = np.radians(1.5)  # halo of a clipped disc above the clipping level, at most
PIXEL_SIGMA = 1 / np.sqrt(12.0)  # pixels: standard deviation of a place within a pixel


@dataclass(frozen=True, slots=True)
class SunDisc:
    """The sun disc in a map.

    altitude_deg, azimuth_deg: its measured centre of energy, azimuth clockwise from north in [0,
    360); sigma_deg: standard uncertainty of the centre along each axis, NaN if the map cannot
    determine it (then the centre is the expected position). normal_lx: illuminance on a plane
    normal to the sun, in excess of the surroundings; a lower bound if `clipped`. surroundings_cdm2:
    luminance of the disc's pixels without the disc. pixels [H, W]: mask of the disc's pixels.
    clipped: whether the map is clipped at the disc.
    """

    altitude_deg: float
    azimuth_deg: float
    sigma_deg: float
    normal_lx: float
    surroundings_cdm2: float
    pixels: Mask
    clipped: bool = False


@dataclass(frozen=True, slots=True)
class _Band:
    """The rows of a map in which the disc is searched, as arrays [rows, W].

    shape: of the complete map; rows: the slice of its rows. light: luminance in cd/m2; solid_sr:
    solid angles; rays: unit vectors [rows, W, 3]; clipped: mask. pixel_rad: height of a pixel;
    reach_rad: largest distance of a disc's light from its centre, by the size of pixels and the
    lens's blur; ring_rad: width of the ring around it that is taken as the disc's surroundings.
    """

    shape: tuple[int, ...]
    rows: slice
    light: Floats
    solid_sr: Floats
    rays: Floats
    clipped: Mask
    pixel_rad: float
    reach_rad: float
    ring_rad: float

    def angle_rad(self, centre: Floats) -> Floats:
        """Return the angle in rad between each pixel and a unit vector [3], [rows, W]."""
        return np.arccos(np.clip(self.rays @ centre, -1.0, 1.0))

    def centroid(self, pixels: Mask, weight: Floats) -> Floats:
        """Return the unit vector [3] to the centre of `weight` times solid angle over `pixels`."""
        energy = (weight * self.solid_sr)[pixels]
        mean = (self.rays[pixels] * energy[:, None]).sum(axis=0)
        return mean / np.linalg.norm(mean)


def find_disc(
    luminance_cdm2: Floats,
    heading_deg: float,
    *,
    near_deg: tuple[float, float] | None = None,
    clipped: Mask | None = None,
    dni_wm2: float | None = None,
) -> SunDisc | None:
    """Return the sun disc in a map [H, W = 2H]; None if there is no disc.

    luminance_cdm2: the map [H, W]; heading_deg: azimuth of the map's centre. near_deg: expected
    apparent altitude and azimuth, clockwise from north, correct to 3 degrees or 2.5 pixels. Without
    it the map's brightest spot is examined, which must not be brighter than the sun can be. clipped
    [H, W]: pixels whose luminance is a lower bound. dni_wm2: direct normal irradiance, None if
    unknown.

    A disc is a compact spot. Its brightest pixel exceeds any surface or sky
    (`brightest_surface_cdm2`; without DNI 1e5 cd/m2) and three times its surroundings, and its
    energy is that of a disc of 1e6 cd/m2 (chosen) or more, with DNI at least 2 % of the sun's. If
    pixels near `near_deg` are clipped, only positions count: a compact clipped spot, or clipping at
    `near_deg`.
    """
    light = np.nan_to_num(np.asarray(luminance_cdm2, np.float64), posinf=0.0, neginf=0.0)
    height, width = light.shape
    pixel_rad = np.pi / height
    if near_deg is None:
        row, column = np.unravel_index(int(np.argmax(light)), light.shape)
        azimuth = float(column_azimuths_deg(width, heading_deg)[column])
        expected, search_rad = (float(row_altitudes_deg(height)[row]), azimuth), 0.6 * pixel_rad
    else:
        expected, search_rad = near_deg, max(_SEARCH_RAD, 2.5 * pixel_rad)
    band = _band(light, clipped, heading_deg, expected[0], search_rad)
    towards = direction(*expected)
    search = band.angle_rad(towards) <= search_rad
    if near_deg is not None and (band.clipped & search).any():
        return _clipped_disc(band, search, towards)
    disc = _measured_disc(band, search)
    if disc is None or not _is_sun(disc, band, dni_wm2):
        return None
    too_bright = disc.normal_lx > MAX_DISC_CDM2 * SUN_SOLID_ANGLE_SR
    return None if near_deg is None and too_bright else disc


def brightest_surface_cdm2(dni_wm2: float) -> float:
    """Return the luminance [cd/m2] that surfaces and the sky away from the sun never exceed.

    dni_wm2: direct normal irradiance. The result is three times the luminance of a white surface
    that faces that sun (93 lm/W), which only clouds near the sun approach, but at least 20 000
    cd/m2, a bright overcast sky. Both limits are chosen.
    """
    return max(3.0 * _LUMENS_PER_WATT * dni_wm2 / np.pi, _BRIGHTEST_SKY_CDM2)


def without_disc(luminance_cdm2: Floats, disc: SunDisc) -> Floats32:
    """Return the map [H, W] with the disc's pixels at the luminance of their surroundings."""
    return np.where(disc.pixels, disc.surroundings_cdm2, luminance_cdm2).astype(np.float32)


def add_disc(
    luminance_cdm2: Floats32, light: Light, disc_lx: Floats, heading_deg: float
) -> Floats32:
    """Return maps [n, H, W] with each disc's energy added to the pixel of the sun.

    luminance_cdm2 [n, H, W]: without discs; disc_lx [n]: illuminance on a plane normal to the sun;
    light: of n hours, with the apparent positions of the sun; heading_deg: azimuth of the maps'
    centre, clockwise from north.
    """
    place = (light.apparent_altitude_deg, light.sun_azimuth_deg)
    return add_source(luminance_cdm2, place, disc_lx, heading_deg)


def add_source(
    luminance_cdm2: Floats32,
    place_deg: tuple[Floats, Floats],
    normal_lx: Floats,
    heading_deg: float,
) -> Floats32:
    """Return n maps [n, H, W] with a source of one pixel added to each.

    luminance_cdm2 [n, H, W]: without the sources. place_deg: altitudes and azimuths [n] of the
    sources, clockwise from true north. normal_lx [n]: illuminance on a plane normal to their
    directions; heading_deg: azimuth of the maps' centre.
    """
    height, width = luminance_cdm2.shape[1:]
    row, column = projection.equirect_pixel(*place_deg, height, width, heading_deg)
    i = np.clip(row.astype(int), 0, height - 1)
    j = column.astype(int) % width
    with_disc = luminance_cdm2.copy()
    added_cdm2 = normal_lx / projection.equirect_solid_angles(height, width)[i, j]
    with_disc[np.arange(len(with_disc)), i, j] += added_cdm2.astype(np.float32)
    return with_disc


# ----------------------------------------------------------------------------------------------
# steps


def _band(
    light: Floats, clipped: Mask | None, heading_deg: float, altitude_deg: float, search_rad: float
) -> _Band:
    """Return the rows of a panorama in which a disc and its surroundings can be.

    light: luminance [H, W] cd/m2; clipped: mask of its clipped pixels [H, W], None for none;
    heading_deg: azimuth of its centre; altitude_deg: expected altitude of the sun; search_rad:
    largest distance of a disc from there.
    """
    height, width = light.shape
    pixel_rad = np.pi / height
    reach_rad = SUN_RADIUS_RAD + 1.5 * pixel_rad + np.radians(0.5)
    ring_rad = reach_rad + 3.0 * pixel_rad + np.radians(1.0)
    margin_deg = np.degrees(search_rad + ring_rad + _CLIPPED_REACH_RAD)
    altitudes, azimuths = row_altitudes_deg(height), column_azimuths_deg(width, heading_deg)
    indices = np.flatnonzero(np.abs(altitudes - altitude_deg) <= margin_deg)
    rows = slice(int(indices[0]), int(indices[-1]) + 1)
    clipped = np.zeros(light.shape, bool) if clipped is None else clipped
    solid_sr = projection.equirect_solid_angles(height, width)[rows]
    rays = direction(altitudes[rows, None], azimuths[None, :])
    lit, clipped = light[rows], clipped[rows]
    return _Band(light.shape, rows, lit, solid_sr, rays, clipped, pixel_rad, reach_rad, ring_rad)


def _measured_disc(band: _Band, search: Mask) -> SunDisc | None:
    """Return the brightest spot within the mask `search` as a disc; None if it is not compact."""
    brightest = int(np.argmax(np.where(search, band.light, -np.inf)))
    peak = float(band.light.flat[brightest])
    about = band.angle_rad(band.rays.reshape(-1, 3)[brightest]) <= 2.0 * band.reach_rad
    bright = about & (band.light >= 0.5 * peak)
    # a compact spot has at most the area of four suns and of nine pixels
    largest_sr = 4.0 * SUN_SOLID_ANGLE_SR + 9.0 * float(band.solid_sr.flat[brightest])
    if peak <= 0.0 or band.solid_sr[bright].sum() > largest_sr:
        return None
    return _disc_at(band, band.centroid(bright, band.light), band.reach_rad)


def _clipped_disc(band: _Band, search: Mask, towards: Floats) -> SunDisc | None:
    """Return a disc that is clipped in every frame, with a lower bound of its illuminance.

    A compact clipped spot is the disc. If a larger area is clipped (a window in a bracket that is
    too short), nothing can be measured: the disc is at its expected position if the map is clipped
    there, else the result is None. towards: unit vector to the expected position [3]; search: mask
    of the band around it [rows, W].
    """
    spot = band.clipped & search
    centre = band.centroid(spot, np.ones_like(band.light))
    extent = float(band.angle_rad(centre)[spot].max())
    if extent <= max(_CLIPPED_REACH_RAD, band.reach_rad):
        reach = max(extent + 0.5 * band.pixel_rad, band.reach_rad)
        return _disc_at(band, centre, reach, clipped=True)
    if not (spot & (band.angle_rad(towards) <= band.reach_rad)).any():
        return None
    return _disc_at(band, towards, band.reach_rad, clipped=True, measured=False)


def _disc_at(
    band: _Band, centre: Floats, reach_rad: float, *, clipped: bool = False, measured: bool = True
) -> SunDisc:
    """Return the light within `reach_rad` of a centre, in excess of the surroundings, as a disc.

    centre: unit vector [3]; clipped: count the band's clipped pixels as part of the disc; measured:
    move the centre to the centroid of the light, and state its uncertainty. A pixel belongs to the
    disc if it is 5 % brighter than the ring's quantile 0.9, so that bars and walls in the ring do
    not make the sky a part of the sun, and if it has 5 % of the brightest pixel's excess: dimmer
    pixels are the bright sky around the sun.
    """
    angle = band.angle_rad(centre)
    around = band.light[(angle > reach_rad) & (angle <= reach_rad + band.ring_rad)]
    surroundings = float(np.median(around)) if around.size else 0.0
    bright = float(np.quantile(around, 0.9)) if around.size else 0.0
    within_reach = angle <= reach_rad
    excess = np.where(within_reach, band.light - surroundings, 0.0)
    minimum = min(0.05 * float(excess.max(initial=0.0)), _BRIGHTEST_SKY_CDM2)
    inside = (band.light > 1.05 * bright) & (excess > minimum)
    excess = np.where(inside, excess, 0.0)
    energy = excess * band.solid_sr
    sigma = np.degrees(band.pixel_rad) * PIXEL_SIGMA if measured else np.nan
    if measured and inside.any():
        centre = band.centroid(inside, excess)
    if clipped:
        inside = inside | (within_reach & band.clipped)
    pixels = np.zeros(band.shape, bool)
    pixels[band.rows] = inside
    altitude_deg, azimuth_deg = (float(angle) for angle in projection.altitude_azimuth_deg(centre))
    return SunDisc(
        altitude_deg,
        azimuth_deg % 360.0,
        sigma_deg=float(sigma),
        normal_lx=float(energy.sum()),
        surroundings_cdm2=surroundings,
        pixels=pixels,
        clipped=clipped,
    )


def _is_sun(disc: SunDisc, band: _Band, dni_wm2: float | None) -> bool:
    """Return whether a spot is too bright and has too much energy for a surface or a sky.

    Less than 2 % of the sun's illuminance by DNI is scattered light, not part of the sun. dni_wm2:
    direct irradiance, None if unknown.
    """
    inside = disc.pixels[band.rows]
    if not inside.any():
        return False
    peak, minimum_lx = float(band.light[inside].max()), MIN_DISC_CDM2 * SUN_SOLID_ANGLE_SR
    surface = BRIGHTEST_SURFACE_CDM2
    if dni_wm2 is not None:
        surface = brightest_surface_cdm2(dni_wm2)
        minimum_lx = max(minimum_lx, 0.02 * _LUMENS_PER_WATT * dni_wm2)
    contrast = peak > 3.0 * disc.surroundings_cdm2
    return peak > surface and contrast and disc.normal_lx >= minimum_lx
