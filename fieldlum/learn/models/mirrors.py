"""Find plane mirrors of the sun in captures; compute the sun's images in them for any hours.

The camera does not move, so that an image in one direction is visible or hidden in every hour. Each
capture with direct sun labels the direction of its image. Other directions follow from labels that
are near and whose pixels have similar luminance in all captures.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.core.arrays import Floats, Floats32, Indices, Mask, evenly_spread
from fieldlum.core.errors import input_errors
from fieldlum.learn.models import rebuilt
from fieldlum.learn.models.data import Dataset
from fieldlum.optics.projection import (
    altitude_azimuth_deg,
    equirect_pixel,
    equirect_rays,
    equirect_solid_angles,
)
from fieldlum.session.codec import read_arrays
from fieldlum.session.files.model_files import ModelConfig
from fieldlum.sky.daylight import Light
from fieldlum.sky.sun_disc import brightest_surface_cdm2, without_disc
from fieldlum.sky.sun_images import (
    MirrorPlane,
    SunImage,
    bright_spots,
    find_mirrors,
    glass_reflectance,
    mirrored,
    near_sun_rad,
    ring_around,
    tolerance_rad,
)


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
            towards,
            share * light.direct_lx,
            np.where(ahead, chances.mean(axis=0, dtype=float), 0.0),
            ahead & (chances[0] > 0.5) & self.predicted,
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
        out = [rebuilt(Mirror, table, arrays) for table in tables]
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
        maps[image.row] = without_disc(maps[image.row], image.spot)
    data = replace(data, luminance_cdm2=maps)
    return data, tuple(_mirror(plane, data) for plane in planes)


def _mirror(plane: MirrorPlane, data: Dataset) -> Mirror:
    """Return a plane with the energy of its images, and where they are visible."""
    suns, rows = data.light.apparent_sun_direction, np.array([image.row for image in plane.images])
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
    # An image is twice as bright as any surface that `bright_spots` allows.
    shows = (bright > 2.0 * limit) & front & data.seen.reshape(-1)[at]
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
