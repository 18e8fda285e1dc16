"""Find plane mirrors of the sun in captures; compute the sun's images in them for any hours.

A plane, such as a glass facade, water or a glossy floor, with the unit normal n shows the sun of
direction s at d = s - 2 (s . n) n. A bright spot of a capture therefore gives n = (d - s) /
|d - s|. Spots of several suns that agree in one normal are images in one mirror. A lamp stays where
it is while the sun moves, and gives another normal each time.

The camera does not move, so that an image in one direction is visible or hidden in every hour. Each
capture with direct sun labels the direction of its image. Other directions follow from labels that
are near and whose pixels have similar luminance in all captures.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fieldlum.core.arrays import Floats, Floats32, Indices, Mask, evenly_spread
from fieldlum.core.errors import input_errors
from fieldlum.learn.models import deserialised
from fieldlum.learn.models.training_data import Dataset
from fieldlum.optics.projection import (
    altitude_azimuth_deg,
    direction,
    equirect_pixel,
    equirect_rays,
    equirect_solid_angles,
)
from fieldlum.session.codec import read_arrays
from fieldlum.session.files.model_files import ModelConfig
from fieldlum.sky import sun_disc
from fieldlum.sky.daylight import Light

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


# ----------------------------------------------------------------------------------------------
# spots and planes


@dataclass(frozen=True, slots=True)
class SunImage:
    """A bright spot of a map that may be an image of the sun.

    row: index of the capture; towards: unit vector to it, x east, y north, z up [3]; spot: its
    place, pixels and illuminance.
    """

    row: int
    towards: Floats
    spot: sun_disc.SunDisc


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
    """Return how far an image may be from its computed place in maps with `height` rows [rad]."""
    return float(np.radians(_POINTING_DEG) + _WITHIN_PIXEL * np.pi / height)


def near_sun_rad(height: int) -> float:
    """Return the angle [rad] around the sun in which maps of `height` rows show no image."""
    return float(max(np.radians(_NEAR_SUN_DEG), 3.0 * np.pi / height))


def bright_spots(
    luminance_cdm2: Floats, heading_deg: float, sun: Floats, dni_wm2: float, row: int
) -> list[SunImage]:
    """Return the compact spots of a map that no surface in the sun can be as bright as.

    Each has the brightness and the energy that `find_disc` requires. luminance_cdm2: map [H, W];
    heading_deg: azimuth of its centre; sun: unit vector [3] to the sun, whose surroundings are not
    searched; dni_wm2: of the capture; row: its index, stored in the spots. The list is empty
    without spots.
    """
    light = np.nan_to_num(np.asarray(luminance_cdm2, np.float32), posinf=0.0, neginf=0.0)
    height, width = light.shape
    limit = sun_disc.brightest_surface_cdm2(dni_wm2)
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
        spot = sun_disc.find_disc(light, heading_deg, near_deg=(altitude, azimuth), dni_wm2=dni_wm2)
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

    It must explain the places of the spots twice as well as one fixed place does. suns: directions
    of the sun by capture [n, 3]; height: rows of the panorama.
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
    sigma = max(float(np.sqrt((off**2).mean() / 2.0)), sun_disc.PIXEL_SIGMA * np.pi / height)
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


# ----------------------------------------------------------------------------------------------
# mirrors


@dataclass(frozen=True, slots=True)
class MirroredSun:
    """The image of the sun in one plane mirror, in each of n hours.

    towards: unit vector from the camera to the image, x east, y north, z up [n, 3]; normal_lx:
    illuminance by the image, if it is visible, on a plane normal to its direction [n]; chance: that
    it is visible, 0 to 1 [n]; shown: whether predicted maps get the image [n].
    """

    towards: Floats
    normal_lx: Floats
    chance: Floats
    shown: Mask

    @property
    def shown_lx(self) -> Floats:
        """Illuminance by the image on a plane normal to its direction, 0 where not `shown` [n]."""
        return np.where(self.shown, self.normal_lx, 0.0)

    @property
    def uncertain(self) -> Mask:
        """Mask [n], True where the chance that `shown` is wrong exceeds 5 %."""
        # an hour is not trusted if the chance of a wrong decision is larger
        return np.where(self.shown, 1.0 - self.chance, self.chance) > 0.05


@dataclass(frozen=True, slots=True)
class Mirror:
    """A plane that mirrors the sun to the camera, such as a glass facade.

    normal: unit vector (east, north, up) of the plane, on the sun's side; u_deg: standard
    uncertainty of the normal per axis; captures: how many captures show the sun in it; factor:
    illuminance by the image, divided by that of the sun and by the reflectance of one glass
    surface; measured: True if the factor is known, False if it is only a lower bound, because the
    images are clipped; judged: how many captures show whether the image is visible; wrong: how many
    of these are predicted wrongly from other days; chance: that an image in the direction of a
    pixel is visible, 0 to 1 [H, W].
    """

    normal: tuple[float, float, float]
    u_deg: float
    captures: int
    factor: float
    measured: bool
    judged: int
    wrong: int
    chance: Floats32

    @property
    def predicted(self) -> bool:
        """Whether predicted maps get images: `measured`, and `wrong` is at most `captures`."""
        return self.measured and self.wrong <= self.captures

    def images(self, light: Light, heading_deg: float) -> MirroredSun:
        """Return the image of the sun in each of the n hours of `light`.

        heading_deg: azimuth of the middle of the map `chance`.
        """
        suns = light.apparent_sun_direction
        towards, cosine = mirrored(suns, self.normal), suns @ self.normal
        # Standard deviation of an image's place over `tolerance_rad`, which no place exceeds
        reach = 0.5 * tolerance_rad(len(self.chance))
        chances = np.stack(
            [
                self.chance.reshape(-1)[pixels(way, self.chance.shape, heading_deg)]
                for way in (towards, *ring_around(towards, reach))
            ]
        )  # [1 + k, n]
        ahead = (cosine > 0.0) & (light.direct_lx > 0.0) & (suns[:, 2] > 0.0)
        share = np.minimum(self.factor * glass_reflectance(cosine), 1.0)
        return MirroredSun(
            towards=towards,
            normal_lx=share * light.direct_lx,
            chance=np.where(ahead, chances.mean(axis=0, dtype=float), 0.0),
            shown=ahead & (chances[0] > 0.5) & self.predicted,
        )

    @property
    def warning(self) -> str:
        """Warning text of `train`, to follow "WARNING: 3 of 40 captures"."""
        altitude, turn = (round(float(v)) for v in altitude_azimuth_deg(np.array(self.normal)))
        azimuth = turn % 360
        right = f"the other days are right for {self.judged - self.wrong} of {self.judged} captures"
        if self.predicted:
            result = f"Predicted hours include the mirrored sun where captures showed it ({right})"
        else:
            cause = right if self.measured else "its images are clipped: use a shorter exposure"
            result = f"No mirrored sun is predicted: DGP is a lower bound ({cause})"
        return (
            f"show the sun in a plane mirror (normal at azimuth {azimuth}, altitude {altitude} "
            f"degrees, u {self.u_deg:.1f} degrees): a glass facade, water or a glossy surface. "
            f"{result}. Hours in which it is unclear whether it is in view are not trusted"
        )


def pixels(towards: Floats, shape: tuple[int, ...], heading_deg: float) -> Indices:
    """Return the index in the flattened map of the pixel in each direction, [n].

    towards: unit vectors [n, 3]; shape: (H, W); heading_deg: azimuth of the middle of the map.
    """
    row, column = equirect_pixel(*altitude_azimuth_deg(towards), shape[0], shape[1], heading_deg)
    i = np.clip(row.astype(int), 0, shape[0] - 1)
    return i * shape[1] + column.astype(int) % shape[1]


# ----------------------------------------------------------------------------------------------
# a model's folder


def read_mirrors(folder: Path, config: ModelConfig) -> tuple[Mirror, ...]:
    """Return the mirrors of the model in `folder`; empty if it has none.

    config: its config.json. Raises InputError for missing or damaged content.
    """
    tables: Sequence[Mapping[str, Any]] = config.state.get("mirrors", ())
    if not tables:
        return ()
    expected, remedy = "the mirrors of fieldlum train", "train the model again (fieldlum train)"
    with input_errors(folder, expected, remedy, OSError, ValueError, KeyError, TypeError):
        arrays = read_arrays(folder / "weights.npz")
        out = [deserialised(Mirror, table, arrays) for table in tables]
        for mirror in out:
            numbers = [*mirror.normal, mirror.u_deg, mirror.factor]
            if mirror.chance.shape != (config.height, config.width) or len(numbers) != 5:
                raise ValueError("mirrors that cannot be used: a map or a normal of another size")
            if not np.isfinite(numbers).all():
                raise ValueError("mirrors that cannot be used: a value that is not a number")
        return tuple(out)


# ----------------------------------------------------------------------------------------------
# from captures


def split_images(data: Dataset) -> tuple[Dataset, tuple[Mirror, ...]]:
    """Remove images of the sun in plane mirrors from the captures; return them and the mirrors.

    The pixels of an image get the luminance of their surroundings. If no mirror is found, return
    `data` itself and an empty tuple.
    """
    light, suns = data.light, data.light.apparent_sun_direction
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
        maps[image.row] = sun_disc.without_disc(maps[image.row], image.spot)
    data = replace(data, luminance_cdm2=maps)
    return data, tuple(_mirror(plane, data) for plane in planes)


def _mirror(plane: MirrorPlane, data: Dataset) -> Mirror:
    """Return a plane with the energy of its images, and where they are visible; see `Mirror`."""
    suns, rows = data.light.apparent_sun_direction, np.array([image.row for image in plane.images])
    full_lx = glass_reflectance(suns @ plane.normal) * data.light.direct_lx  # [n], if of glass
    factors = np.array([image.spot.normal_lx for image in plane.images]) / full_lx[rows]
    # An image is measured if none of its pixels is clipped, moving or filled.
    counts = np.broadcast_to(1.0, data.luminance_cdm2.shape) if data.counts is None else data.counts
    valid = np.array([(counts[i.row][i.spot.pixels] > 0.0).all() for i in plane.images])
    factor = float(np.median(factors[valid] if valid.any() else factors))
    towards = mirrored(suns, plane.normal)
    at = pixels(towards, data.shape, data.heading_deg)
    visible = np.isin(np.arange(len(data)), rows)
    limit = np.array([sun_disc.brightest_surface_cdm2(float(dni)) for dni in data.light.dni_wm2])
    bright = factor * full_lx / equirect_solid_angles(*data.shape).reshape(-1)[at]  # cd/m2
    # An image next to the sun, which is not searched, is at a grazing angle.
    front = suns @ plane.normal > np.sin(near_sun_rad(data.shape[0]) / 2.0)
    # An image is twice as bright as any surface that `bright_spots` allows.
    shows = (bright > 2.0 * limit) & front & data.seen.reshape(-1)[at]
    judged = np.flatnonzero(visible | shows)
    chance, wrong = _chance(data, judged, towards[judged], at[judged], visible[judged])
    east, north, up = plane.normal.tolist()
    return Mirror(
        normal=(east, north, up),
        u_deg=plane.u_deg,
        captures=len(rows),
        factor=factor,
        measured=bool(valid.any()),
        judged=len(judged),
        wrong=wrong,
        chance=chance,
    )


def _chance(
    data: Dataset, label: Indices, towards: Floats, at: Indices, visible: Mask
) -> tuple[Floats32, int]:
    """Return the chance [H, W] that an image is visible, and the labels wrong by the other days.

    label: captures [k]; towards, at, visible: direction [k, 3], pixel [k] and label [k] of their
    images.
    """
    compared = evenly_spread(len(data), 40)  # captures, to compare pixels; limits the time
    maps = np.log10(np.maximum(data.luminance_cdm2[compared], 1.0)).reshape(len(compared), -1)
    rays = equirect_rays(*data.shape, data.heading_deg).reshape(-1, 3)
    chance = np.empty(len(rays), np.float32)
    for part in np.array_split(np.arange(len(rays)), len(rays) // 4096 + 1):  # limits the memory
        chance[part] = _voted(rays[part] @ towards.T, maps[:, part], maps[:, at], visible)
    wrong = 0
    for day in np.unique(data.days[label]):
        out = data.days[label] == day
        of_images, of_labels = maps[:, at[out]], maps[:, at[~out]]
        held_out = _voted(rays[at[out]] @ towards[~out].T, of_images, of_labels, visible[~out])
        wrong += int(((held_out > 0.5) != visible[out]).sum())
    return chance.reshape(data.shape), wrong


def _voted(cosine: Floats, pixels: Floats32, labels: Floats32, visible: Mask) -> Floats:
    """Return the weighted share of visible labels for m pixels, [m].

    cosine [m, k]: between pixels and labels; pixels [n, m], labels [n, k]: log10 luminance over n
    captures; visible [k].
    """
    square = (pixels**2).sum(axis=0)[:, None] + (labels**2).sum(axis=0) - 2.0 * pixels.T @ labels
    # rms difference of log10 luminance over the captures
    unlike = np.maximum(square, 0.0) / len(pixels) / 0.1**2
    alike = np.exp(-0.5 * unlike.astype(float))  # [m, k]
    angle_deg = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    # Kernel of the labels; chosen. In three views of a mirroring facade, other widths (6 to 18
    # degrees, 0.05 to 0.2) change the error of DGP by -25 to +30 %, some by a factor of two
    # (docs/decisions.md).
    near = alike * np.exp(-0.5 * (angle_deg / 9.0) ** 2)
    # A label far away counts a hundredth, if its pixel is alike.
    weight = near + 0.01 * alike
    # a label of weight 1e-4, less than any alike one, has a chance of one half
    share = (weight @ visible + 0.5e-4) / (weight.sum(axis=1) + 1e-4)
    # A label further than two widths away, or not alike, does not make an image certain.
    supported = near.max(axis=1, initial=0.0) >= np.exp(-2.0)
    return np.where(supported, share, np.minimum(share, 0.9))
