"""Find images of the sun that a plane mirrors into captures: a glass facade, water, a glossy floor.

A plane with the unit normal n shows the sun of direction s at d = s - 2 (s . n) n. A bright spot of
a capture therefore gives n = (d - s) / |d - s|. Spots of several suns that agree in one normal are
images in one mirror. A lamp stays where it is while the sun moves, and gives another normal each
time.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fieldlum.core.arrays import Floats, Indices
from fieldlum.optics.projection import altitude_azimuth_deg, direction, equirect_rays
from fieldlum.sky.sun_disc import PIXEL_SIGMA, SunDisc, brightest_surface_cdm2, find_disc

GLASS_INDEX = 1.52  # refractive index of soda-lime glass (EN 572-1: 1.50 rounded; Radiance: 1.52)
# No spot this near to the sun is an image: its pixels can be the sky around the sun, and a mirror
# seen at such a grazing angle does not show its normal. Chosen.
_NEAR_SUN_DEG = 10.0
# Ephemeris, level and heading of the camera together; chosen as a large value.
_POINTING_DEG = 1.0
_WITHIN_PIXEL = 0.75  # pixels: half the diagonal of a pixel is 0.71
_FEWEST_CAPTURES = 3  # two spots agree in some normal by chance; chosen
# of the spots that may be images: among hundreds of random spots some agree in a normal; chosen
_MIN_SHARE = 0.05
# Panes of one facade are not exactly parallel: images up to this multiple of the tolerance away
# belong to a mirror, and spots up to the second multiple to no other mirror. Chosen.
_DISTORTED, _NEXT_MIRROR = 2.0, 3.0


@dataclass(frozen=True, slots=True)
class SunImage:
    """A bright spot of capture `row` that may be an image of the sun, with its direction [3]."""

    row: int
    towards: Floats
    spot: SunDisc


@dataclass(frozen=True, slots=True)
class MirrorPlane:
    """The normal [3] of a plane mirror, towards the sun; u_deg: its standard uncertainty per axis.

    images: one of each capture that shows the sun in it.
    """

    normal: Floats
    u_deg: float
    images: tuple[SunImage, ...]


def mirrored(suns: ArrayLike, normal: ArrayLike) -> Floats:
    """Return the directions [n, 3] of the images of suns [n, 3] in a plane with normal [3]."""
    suns, normal = np.asarray(suns, float), np.asarray(normal, float)
    return suns - 2.0 * (suns @ normal)[:, None] * normal


def ring_around(towards: Floats, angle_rad: float) -> Floats:
    """Return the eight directions at an angle around each of some directions [n, 3], [8, n, 3]."""
    other = np.where(np.abs(towards[:, 2:]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    right = np.cross(towards, other)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    up = np.cross(right, towards)
    turns = np.arange(8)[:, None, None] * np.pi / 4.0
    ring = np.cos(turns) * right + np.sin(turns) * up
    return np.cos(angle_rad) * towards + np.sin(angle_rad) * ring


def glass_reflectance(cosine: ArrayLike) -> Floats:
    """Return the reflectance of one air-glass surface for unpolarised light (Fresnel), [...].

    cosine: of the angle of incidence. Hecht, Optics, 4.6.2, with `GLASS_INDEX`.
    """
    inside = np.clip(np.abs(np.asarray(cosine, float)), 0.0, 1.0)
    beyond = np.sqrt(1.0 - (1.0 - inside**2) / GLASS_INDEX**2)  # cosine in the glass
    across = (inside - GLASS_INDEX * beyond) / (inside + GLASS_INDEX * beyond)
    along = (GLASS_INDEX * inside - beyond) / (GLASS_INDEX * inside + beyond)
    return (across**2 + along**2) / 2.0


def tolerance_rad(height: int) -> float:
    """Return how far an image may be from its computed place in maps with `height` rows."""
    return float(np.radians(_POINTING_DEG) + _WITHIN_PIXEL * np.pi / height)


def near_sun_rad(height: int) -> float:
    """Return the angle around the sun in which no image is searched."""
    return float(max(np.radians(_NEAR_SUN_DEG), 3.0 * np.pi / height))


def bright_spots(
    luminance_cdm2: Floats, heading_deg: float, sun: Floats, dni_wm2: float, row: int
) -> list[SunImage]:
    """Return the compact spots of a map [H, W] that no surface in the sun can be as bright as.

    Each has the brightness and the energy that `find_disc` requires. heading_deg: azimuth of the
    map's centre; sun [3]: its surroundings are not searched; dni_wm2: of the capture; row: its
    index, stored in the spots.
    """
    light = np.nan_to_num(np.asarray(luminance_cdm2, np.float32), posinf=0.0, neginf=0.0)
    height, width = light.shape
    limit = brightest_surface_cdm2(dni_wm2)
    if light.max() <= limit:
        return []
    rays = equirect_rays(height, width, heading_deg)
    light = np.where(rays @ sun > np.cos(near_sun_rad(height)), np.float32(0.0), light)
    spots = []
    for _ in range(6):  # a room has few lamps of this size
        peak = np.unravel_index(int(np.argmax(light)), light.shape)
        if light[peak] <= limit:
            break
        altitude, azimuth = (float(angle) for angle in altitude_azimuth_deg(rays[peak]))
        spot = find_disc(light, heading_deg, near_deg=(altitude, azimuth), dni_wm2=dni_wm2)
        if spot is not None:
            spots.append(SunImage(row, direction(spot.altitude_deg, spot.azimuth_deg), spot))
        around = rays @ rays[peak] > np.cos(near_sun_rad(height))
        light = np.where(around, np.float32(0.0), light)
    return spots


def without_lamps(
    spots: Sequence[SunImage], suns: Floats, direct_lx: Floats, height: int
) -> list[SunImage]:
    """Return the spots that are dimmer than the sun and move when it moves by 3 tolerances.

    A spot at the place of a brighter one, a lamp, is omitted too. suns [n, 3], direct_lx [n]: of
    all captures, whose rows the spots name. height: rows of the maps.
    """
    if not spots:
        return []
    places, rows = _places_of(spots)
    near = np.cos(tolerance_rad(height))
    moved = np.cos(3.0 * tolerance_rad(height))
    lamp = np.array([spot.spot.normal_lx for spot in spots]) > np.asarray(direct_lx)[rows]
    other_sun = (suns[rows] @ suns[rows].T < moved) | lamp  # [spots, spots]
    stays = ((places @ places.T > near) & other_sun).any(axis=1)
    return [spots[int(k)] for k in np.flatnonzero(~lamp & ~stays)]


def find_mirrors(
    spots: Sequence[SunImage], suns: Floats, direct_lx: Floats, height: int
) -> list[MirrorPlane]:
    """Return the plane mirrors in which spots of three or more captures are images of the sun.

    Spots of distant suns that stay in one place, and few among many, are no images.

    spots: of all captures, by `bright_spots`; suns [n, 3] and direct_lx [n]: direction of each
    capture's sun, and its illuminance on a plane normal to it; height: rows of the maps.
    """
    rest = without_lamps(spots, suns, direct_lx, height)
    mirrors = []
    while (mirror := _best_mirror(rest, suns, height)) is not None:
        mirrors.append(mirror)
        places, rows = _places_of(rest)
        off = _angles(mirrored(suns[rows], mirror.normal), places)
        same = off <= _NEXT_MIRROR * tolerance_rad(height)
        rest = [spot for spot, is_same in zip(rest, same, strict=True) if not is_same]
    return mirrors


def _best_mirror(rest: Sequence[SunImage], suns: Floats, height: int) -> MirrorPlane | None:
    """Return the mirror with the most images among some spots; None if no normal is certain.

    It must explain the places of the spots twice as well as one fixed place does.
    """
    if len(rest) < _FEWEST_CAPTURES:
        return None
    places, rows = _places_of(rest)
    across = places - suns[rows]  # [spots, 3], along the normal
    reach = tolerance_rad(height)
    tried = [
        _agreeing(across[k] / np.linalg.norm(across[k]), places, rows, suns, 2.0 * reach)
        for k in range(len(rest))
    ]
    chosen = max(tried, key=len)
    normal = _normal_of(across[chosen])
    for _ in range(3):
        chosen = _agreeing(normal, places, rows, suns, reach)
        if len(chosen) < max(_FEWEST_CAPTURES, _MIN_SHARE * len(rest)):
            return None
        normal = _normal_of(across[chosen])
    off = _angles(mirrored(suns[rows[chosen]], normal), places[chosen])
    middle = places[chosen].mean(axis=0)
    fixed = _angles(middle / np.linalg.norm(middle), places[chosen])
    if np.sqrt((off**2).mean()) > 0.5 * np.sqrt((fixed**2).mean()):
        return None
    sigma = max(float(np.sqrt((off**2).mean() / 2.0)), PIXEL_SIGMA * np.pi / height)
    _, first = np.unique(np.round(places[chosen] / (np.pi / height)), axis=0, return_index=True)
    u_rad = sigma / np.sqrt((across[chosen][first] ** 2).sum())  # places in one pixel err alike
    towards_sun = normal * np.sign((suns[rows[chosen]] @ normal).sum())
    images = _agreeing(normal, places, rows, suns, _DISTORTED * reach)
    return MirrorPlane(towards_sun, float(np.degrees(u_rad)), tuple(rest[k] for k in images))


def _places_of(spots: Sequence[SunImage]) -> tuple[Floats, Indices]:
    """Return the directions [k, 3] and the captures [k] of spots."""
    return np.stack([spot.towards for spot in spots]), np.array([spot.row for spot in spots])


def _angles(a: Floats, b: Floats) -> Floats:
    return np.arccos(np.clip((a * b).sum(axis=-1), -1.0, 1.0))


def _normal_of(across: Floats) -> Floats:
    """Return the direction [3] with the smallest squared distances from d - s [k, 3]."""
    return np.linalg.eigh(across.T @ across)[1][:, -1]


def _agreeing(
    normal: Floats, places: Floats, rows: Indices, suns: Floats, reach_rad: float
) -> Indices:
    """Return the indices of the spots at the images in a plane, one for each capture."""
    off = _angles(mirrored(suns[rows], normal), places)
    order = np.argsort(off, kind="stable")
    order = order[off[order] <= reach_rad]
    return np.sort(order[np.unique(rows[order], return_index=True)[1]])
