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
from typing import Any, NamedTuple

import numpy as np

from fieldlum.core.arrays import ArrayLike, Floats, Floats32, Indices, Mask, evenly_spread
from fieldlum.core.errors import input_errors
from fieldlum.learn.models import deserialised
from fieldlum.learn.models.training_data import Dataset
from fieldlum.optics import projection
from fieldlum.optics.projection import altitude_azimuth_deg, direction, equirect_rays, flat_pixels
from fieldlum.room.scene.box_room import glass_optics
from fieldlum.session.codec import read_arrays
from fieldlum.session.files.model_files import ModelConfig
from fieldlum.sky import sun_disc
from fieldlum.sky.daylight import Light

# A spot this near to the sun is no image: its pixels can be the sky around the sun, and a mirror
# seen at such a grazing angle does not show its normal. Chosen.
_NEAR_SUN_DEG = 10.0
# Errors of ephemeris, level and heading of the camera together; chosen as a large value.
_POINTING_DEG = 1.0
_WITHIN_PIXEL = 0.75  # pixels: half the diagonal of a pixel is 0.71
_MIN_CAPTURES = 3  # two spots agree in some normal by chance; chosen
# Share of the spots that must be images: among hundreds of random spots some agree in a normal.
# Chosen.
_MIN_SHARE = 0.05
# Panes of one facade are not exactly parallel: images up to this multiple of the tolerance away
# belong to a mirror, and spots up to the second multiple to no other mirror. Chosen.
_SAME_MIRROR, _OTHER_MIRROR = 2.0, 3.0


# ----------------------------------------------------------------------------------------------
# spots and planes


class SunImage(NamedTuple):
    """A bright spot of a map that may be an image of the sun.

    row: index of the capture in the training data; towards: unit vector from the camera to the
    spot, x east, y north, z up [3]; spot: its place, pixels and illuminance, measured as those of a
    sun disc.
    """

    row: int
    towards: Floats
    spot: sun_disc.SunDisc


class MirrorPlane(NamedTuple):
    """A plane mirror that captures show.

    normal: unit vector of the plane on the sun's side, x east, y north, z up [3]; u_deg: its
    standard uncertainty per axis; images: one image of each capture that shows the sun in the
    mirror.
    """

    normal: Floats
    u_deg: float
    images: tuple[SunImage, ...]


def mirrored(suns: ArrayLike, normal: ArrayLike) -> Floats:
    """Return the directions [n, 3] of the images of suns [n, 3] in a plane with normal [3].

    All are unit vectors in the same axes; the sign of the normal does not count.
    """
    suns, normal = np.asarray(suns, float), np.asarray(normal, float)
    return suns - 2.0 * (suns @ normal)[:, None] * normal


def tolerance_rad(height: int) -> float:
    """Return how far the sun's image in a plane mirror may be from its computed place [rad].

    It is 1 degree, for errors of the camera's pose, and 0.75 pixels of a map with `height` rows.
    """
    return float(np.radians(_POINTING_DEG) + _WITHIN_PIXEL * np.pi / height)


def near_sun_rad(height: int) -> float:
    """Return the angle [rad] around the sun in which maps of `height` rows show no image.

    It is 10 degrees (chosen), or three pixels if these are more.
    """
    return float(max(np.radians(_NEAR_SUN_DEG), 3.0 * np.pi / height))


def bright_spots(
    luminance_cdm2: Floats, heading_deg: float, sun: Floats, dni_wm2: float, row: int
) -> list[SunImage]:
    """Return the compact spots of a map that are brighter than any surface in the sun.

    Each has the brightness and the energy that `find_disc` requires. luminance_cdm2: map [H, W];
    heading_deg: azimuth of its centre column, clockwise from north; sun: unit vector [3] to the
    sun, x east, y north, z up, whose surroundings are not searched; dni_wm2: direct normal
    irradiance of the capture; row: index of the capture, stored in the spots. The list is empty
    without spots, and has six of them at most.
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
        light = np.where(rays @ rays[peak] > np.cos(near_sun_rad(height)), np.float32(0.0), light)
    return spots


def without_lamps(
    spots: Sequence[SunImage], suns: Floats, direct_lx: Floats, height: int
) -> list[SunImage]:
    """Return the spots that can be images: dimmer than the sun, and moving as it moves.

    Omitted are spots brighter than the sun (lamps), spots at the place of a lamp, and spots that
    are in one place, within `tolerance_rad` (1 degree plus 0.75 pixels of the maps), while the sun
    moves by more than three times that angle. suns [n, 3], direct_lx [n]: direction and normal
    illuminance of the sun in all captures; height: rows of the maps.
    """
    places, rows = _places_of(spots)
    same_place = places @ places.T > np.cos(tolerance_rad(height))  # [spots, spots]
    sun_moved = suns[rows] @ suns[rows].T < np.cos(3.0 * tolerance_rad(height))
    lamp = np.array([spot.spot.normal_lx for spot in spots]) > np.asarray(direct_lx)[rows]
    stays = (same_place & (sun_moved | lamp)).any(axis=1)
    return [spots[int(k)] for k in np.flatnonzero(~lamp & ~stays)]


def find_mirrors(
    spots: Sequence[SunImage], suns: Floats, direct_lx: Floats, height: int
) -> list[MirrorPlane]:
    """Return the plane mirrors in which spots of three or more captures are images of the sun.

    spots: of all captures, by `bright_spots`; those that `without_lamps` omits do not count. suns
    [n, 3] and direct_lx [n]: direction of each capture's sun, and its illuminance on a plane normal
    to it; height: rows of the maps.
    """
    rest = without_lamps(spots, suns, direct_lx, height)
    mirrors = []
    while (mirror := _best_mirror(rest, suns, height)) is not None:
        mirrors.append(mirror)
        places, rows = _places_of(rest)
        off_rad = _angles_rad(mirrored(suns[rows], mirror.normal), places)
        others = np.flatnonzero(off_rad > _OTHER_MIRROR * tolerance_rad(height))
        rest = [rest[k] for k in others]
    return mirrors


def _best_mirror(rest: Sequence[SunImage], suns: Floats, height: int) -> MirrorPlane | None:
    """Return the mirror with the most images among the spots `rest`; None if none is certain.

    The mirror must explain the places of its images twice as well as one fixed place does. suns:
    directions of the sun by capture [n, 3]; height: rows of the maps.
    """
    if len(rest) < _MIN_CAPTURES:
        return None
    places, rows = _places_of(rest)
    across = places - suns[rows]  # [spots, 3], along the normal
    reach = tolerance_rad(height)
    normals = across / np.linalg.norm(across, axis=1, keepdims=True)  # one by each spot
    tried = [_agreeing(normal, places, rows, suns, 2.0 * reach) for normal in normals]
    chosen = max(tried, key=len)
    normal = _normal_of(across[chosen])
    for _ in range(3):
        chosen = _agreeing(normal, places, rows, suns, reach)
        if len(chosen) < max(_MIN_CAPTURES, _MIN_SHARE * len(rest)):
            return None
        normal = _normal_of(across[chosen])
    off_rad = _angles_rad(mirrored(suns[rows[chosen]], normal), places[chosen])
    middle = places[chosen].mean(axis=0)
    fixed_rad = _angles_rad(middle / np.linalg.norm(middle), places[chosen])
    if np.sqrt((off_rad**2).mean()) > 0.5 * np.sqrt((fixed_rad**2).mean()):
        return None
    # standard deviation of a place along each of two axes [rad]
    sigma = max(float(np.sqrt((off_rad**2).mean() / 2.0)), sun_disc.PIXEL_SIGMA * np.pi / height)
    _, first = np.unique(np.round(places[chosen] / (np.pi / height)), axis=0, return_index=True)
    u_rad = sigma / np.sqrt((across[chosen][first] ** 2).sum())  # places in one pixel err alike
    towards_sun = normal * np.sign((suns[rows[chosen]] @ normal).sum())
    images = _agreeing(normal, places, rows, suns, _SAME_MIRROR * reach)
    return MirrorPlane(towards_sun, float(np.degrees(u_rad)), tuple(rest[k] for k in images))


def _places_of(spots: Sequence[SunImage]) -> tuple[Floats, Indices]:
    """Return the directions of k spots [k, 3], and the indices of their captures [k]."""
    return np.stack([spot.towards for spot in spots]), np.array([spot.row for spot in spots])


def _angles_rad(a: Floats, b: Floats) -> Floats:
    """Return the angle between each unit vector of `a` and the one of `b` in the same row, [n]."""
    return np.arccos(np.clip((a * b).sum(axis=-1), -1.0, 1.0))


def _normal_of(across: Floats) -> Floats:
    """Return the unit normal [3] of the plane that best explains k images.

    across: direction of each image minus that of its sun, which is along the normal [k, 3]. The
    result has the largest sum of squared projections; its sign is arbitrary.
    """
    return np.linalg.eigh(across.T @ across)[1][:, -1]


def _agreeing(
    normal: Floats, places: Floats, rows: Indices, suns: Floats, reach_rad: float
) -> Indices:
    """Return the indices of the spots that are images in a plane, the nearest of each capture.

    normal: of the plane [3]; places [k, 3], rows [k]: directions and captures of the spots; suns:
    of all captures [n, 3]; reach_rad: how far a spot may be from the computed image.
    """
    off_rad = _angles_rad(mirrored(suns[rows], normal), places)
    order = np.argsort(off_rad, kind="stable")
    order = order[off_rad[order] <= reach_rad]
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
        """Mask [n] of the hours whose maps may show or lack the sun's image wrongly.

        True where the chance of this exceeds 5 %; such an hour is not trusted.
        """
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

        heading_deg: azimuth of the centre column of the map `chance`, clockwise from north.
        """
        suns = light.apparent_sun_direction
        towards, cosine = mirrored(suns, self.normal), suns @ self.normal
        # Standard deviation of an image's place over `tolerance_rad`, which no place exceeds
        reach = 0.5 * tolerance_rad(len(self.chance))
        right, up = projection.across_axes(towards)
        turns = np.arange(8)[:, None, None] * np.pi / 4.0
        ring = np.cos(turns) * right + np.sin(turns) * up
        around = np.cos(reach) * towards + np.sin(reach) * ring  # [8, n, 3]
        directions = np.concatenate((towards[None], around))  # the image's own one is the first
        places = flat_pixels(directions, self.chance.shape, heading_deg)
        chances = self.chance.reshape(-1)[places]  # [9, n]
        ahead = (cosine > 0.0) & (light.direct_lx > 0.0) & (suns[:, 2] > 0.0)
        share = np.minimum(self.factor * glass_optics(0.0, cosine)[1], 1.0)
        return MirroredSun(
            towards=towards,
            normal_lx=share * light.direct_lx,
            chance=np.where(ahead, chances.mean(axis=0, dtype=float), 0.0),
            shown=ahead & (chances[0] > 0.5) & self.predicted,
        )

    @property
    def warning(self) -> str:
        """The warning of `train`, without its beginning: "WARNING: 3 of 40 captures"."""
        altitude, azimuth = (round(float(v)) for v in altitude_azimuth_deg(np.array(self.normal)))
        right = f"the other days are right for {self.judged - self.wrong} of {self.judged} captures"
        if self.predicted:
            result = f"Predicted hours include the mirrored sun where captures showed it ({right})"
        else:
            cause = right if self.measured else "its images are clipped: use a shorter exposure"
            result = f"No mirrored sun is predicted: DGP is a lower bound ({cause})"
        return (
            f"show the sun in a plane mirror (normal at azimuth {azimuth % 360}, altitude "
            f"{altitude} degrees, u {self.u_deg:.1f} degrees): a glass facade, water or a glossy "
            f"surface. {result}. Hours in which it is unclear whether it is in view are not trusted"
        )


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
            if mirror.chance.shape != (config.height, config.width):
                raise ValueError("mirrors that cannot be used: a map of another size")
            if not np.isfinite([*mirror.normal, mirror.u_deg, mirror.factor]).all():
                raise ValueError("mirrors that cannot be used: a value that is not a number")
        return tuple(out)


# ----------------------------------------------------------------------------------------------
# from captures


def split_images(data: Dataset) -> tuple[Dataset, tuple[Mirror, ...]]:
    """Return the captures without images of the sun in plane mirrors, and these mirrors.

    The pixels of an image get the luminance of their surroundings; `data` does not change. Without
    any mirror, return `data` itself and an empty tuple.
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
    """Return the mirror of a plane: the energy of its images, and where they are visible."""
    suns, rows = data.light.apparent_sun_direction, np.array([image.row for image in plane.images])
    # of images in one surface of glass: no light passes it to reach the second [n]
    full_lx = glass_optics(0.0, suns @ plane.normal)[1] * data.light.direct_lx
    factors = np.array([image.spot.normal_lx for image in plane.images]) / full_lx[rows]
    # An image is measured if none of its pixels is clipped, moving or filled.
    counts = np.broadcast_to(1.0, data.luminance_cdm2.shape) if data.counts is None else data.counts
    valid = np.array([(counts[i.row][i.spot.pixels] > 0.0).all() for i in plane.images])
    factor = float(np.median(factors[valid] if valid.any() else factors))
    towards = mirrored(suns, plane.normal)
    places = flat_pixels(towards, data.shape, data.heading_deg)  # of the image in each capture [n]
    visible = np.isin(np.arange(len(data)), rows)
    limit = np.array([sun_disc.brightest_surface_cdm2(float(dni)) for dni in data.light.dni_wm2])
    solid_sr = projection.equirect_solid_angles(*data.shape).reshape(-1)[places]
    bright = factor * full_lx / solid_sr  # cd/m2
    # Images next to the sun, where `bright_spots` does not search, are at a grazing angle.
    front = suns @ plane.normal > np.sin(near_sun_rad(data.shape[0]) / 2.0)
    # Captures that would show the image, twice as bright as any surface, if nothing hid it.
    would_show = (bright > 2.0 * limit) & front & data.seen.reshape(-1)[places]
    judged = np.flatnonzero(visible | would_show)
    chance, wrong = _visible_chance(data, judged, towards[judged], places[judged], visible[judged])
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


def _visible_chance(
    data: Dataset, judged: Indices, towards: Floats, places: Indices, visible: Mask
) -> tuple[Floats32, int]:
    """Return the chance that an image in each pixel is visible, and how many labels contradict.

    The chance is a map [H, W], 0 to 1. A label contradicts if the labels of the other days predict
    the opposite. judged: the k labelled captures; towards [k, 3], places [k]: directions of their
    images and flat pixel indices; visible: their labels [k].
    """
    compared = evenly_spread(len(data), 40)  # captures, to compare pixels; limits the time
    maps = np.log10(np.maximum(data.luminance_cdm2[compared], 1.0)).reshape(len(compared), -1)
    rays = equirect_rays(*data.shape, data.heading_deg).reshape(-1, 3)
    chance = np.empty(len(rays), np.float32)
    for part in np.array_split(np.arange(len(rays)), len(rays) // 4096 + 1):  # limits the memory
        cosine = rays[part] @ towards.T
        chance[part] = _visible_share(cosine, maps[:, part], maps[:, places], visible)
    wrong = 0
    for day in np.unique(data.days[judged]):
        out = data.days[judged] == day
        held_out, others = places[out], places[~out]
        cosine = rays[held_out] @ towards[~out].T
        share = _visible_share(cosine, maps[:, held_out], maps[:, others], visible[~out])
        wrong += int(((share > 0.5) != visible[out]).sum())
    return chance.reshape(data.shape), wrong


def _visible_share(cosine: Floats, pixels: Floats32, labels: Floats32, visible: Mask) -> Floats:
    """Return the share of visible labels, of k, weighted by likeness to each of m pixels, [m].

    cosine: of the angles between pixels and labels [m, k]; pixels [n, m], labels [n, k]: log10
    luminance of the pixels and of the labels' pixels in n captures; visible: the labels [k].
    """
    square = (pixels**2).sum(axis=0)[:, None] + (labels**2).sum(axis=0) - 2.0 * pixels.T @ labels
    # Mean squared difference of log10 luminance over the captures, in units of 0.1 squared.
    unlike = np.maximum(square, 0.0) / len(pixels) / 0.1**2
    alike = np.exp(-0.5 * unlike.astype(float))  # [m, k]
    angle_deg = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    # Kernel of the labels; chosen. In three views of a mirroring facade, other widths (6 to 18
    # degrees, 0.05 to 0.2) change the error of DGP by -25 to +30 %, some by a factor of two
    # (docs/decisions.md).
    near = alike * np.exp(-0.5 * (angle_deg / 9.0) ** 2)
    # A distant label counts a hundredth, if its pixel is similar.
    weight = near + 0.01 * alike
    # Without any similar label the share is one half: that of an added label of weight 1e-4.
    share = (weight @ visible + 0.5e-4) / (weight.sum(axis=1) + 1e-4)
    # A label further than two widths away, or not similar, does not make an image certain.
    supported = near.max(axis=1, initial=0.0) >= np.exp(-2.0)
    return np.where(supported, share, np.minimum(share, 0.9))
