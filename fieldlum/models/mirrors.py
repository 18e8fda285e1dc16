"""Take images of the sun in plane mirrors out of captures, and state where other hours have them.

The eye is fixed, so that an image is in view in some directions and not in others, whatever the
hour: each capture with direct sun labels the direction of its image as visible or hidden. Other
directions follow from labels that are near and whose pixels have similar luminance in all captures.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.errors import InputError
from fieldlum.projection import equirect_pixel, equirect_rays, equirect_solid_angles
from fieldlum.session.files.arrays_npz import read_arrays
from fieldlum.sun_disc import brightest_surface_cdm2, without_disc
from fieldlum.sun_images import (
    MirrorPlane,
    bright_spots,
    find_mirrors,
    glass_reflectance,
    mirrored,
    near_sun_rad,
)

if TYPE_CHECKING:
    from fieldlum.light import Light
    from fieldlum.models.data import Dataset
    from fieldlum.session.files.model_config import ModelConfig

Array = NDArray[np.float64]

# Kernel of the labels. On three views of a mirroring facade (bench/annual_truth.py), half and twice
# these widths give 2 to 15 % more wrong hours.
_NEAR_DEG = 9.0
_ALIKE_LOG10 = 0.1  # rms difference of log10 luminance over the captures
_FAR_WEIGHT = 0.01  # of a label at any distance whose pixel is alike; chosen
_PRIOR_WEIGHT = 1e-4  # of a label with a chance of one half; less than any alike label; chosen
_MOST_MAPS = 40  # captures that compare pixels; chosen, limits the time
_PIXELS_AT_ONCE = 4096  # limits the memory
# A label that is further than two widths away, or not alike, does not make an image certain.
_SUPPORTED = float(np.exp(-2.0))
_UNSUPPORTED_CHANCE = 0.9  # chosen
_TO_BE_FOUND = 2.0  # multiple of the luminance of `bright_spots` that shows an image; chosen
LEAST_CHANCE = 0.05  # an hour with a larger chance of an image is not trusted; chosen


@dataclass(frozen=True, slots=True)
class MirroredSun:
    """The images of the sun in one mirror, in n hours.

    towards: their directions [n, 3]; normal_lx: illuminance on a plane normal to these, if the
    image is visible [n]; chance: that it is visible [n].
    """

    towards: Array
    normal_lx: Array
    chance: Array

    @property
    def possible(self) -> NDArray[np.bool_]:
        """Mask [n] of the hours in which the captures do not exclude that it is visible."""
        return self.chance > LEAST_CHANCE


@dataclass(frozen=True, slots=True)
class Mirror:
    """A plane that mirrors the sun to the camera.

    normal: unit vector [3] towards the sun's side; u_deg: its standard uncertainty per axis;
    captures: number that show an image; factor: illuminance of an image over the sun's times the
    Fresnel reflectance of glass; chance: that an image in a pixel is visible [H, W].
    """

    normal: Array
    u_deg: float
    captures: int
    factor: float
    chance: NDArray[np.float32]

    def images(self, light: Light, heading_deg: float) -> MirroredSun:
        """Return the images of the sun in the hours of `light`."""
        suns = light.shown_sun_direction
        towards, cosine = mirrored(suns, self.normal), suns @ self.normal
        pixel = _pixels(towards, self.chance.shape, heading_deg)
        ahead = (cosine > 0.0) & (light.direct_lx > 0.0) & (suns[:, 2] > 0.0)
        full_lx = self.factor * glass_reflectance(cosine) * light.direct_lx
        chance = self.chance.reshape(-1)[pixel].astype(float)
        return MirroredSun(towards, np.where(ahead, full_lx, 0.0), np.where(ahead, chance, 0.0))

    @property
    def text(self) -> str:
        """The direction of the normal, for a warning."""
        east, north, up = self.normal
        azimuth, altitude = np.degrees(np.arctan2(east, north)) % 360.0, np.degrees(np.arcsin(up))
        return (
            f"normal at azimuth {azimuth:.0f}, altitude {altitude:.0f} degrees, u "
            f"{self.u_deg:.1f} degrees"
        )


def _pixels(towards: Array, shape: tuple[int, ...], heading_deg: float) -> NDArray[np.intp]:
    """Return the index in a flattened map [H, W] of each direction [n, 3]."""
    altitude = np.degrees(np.arcsin(np.clip(towards[:, 2], -1.0, 1.0)))
    azimuth = np.degrees(np.arctan2(towards[:, 0], towards[:, 1]))
    row, column = equirect_pixel(altitude, azimuth, shape[0], shape[1], heading_deg)
    i = np.clip(row.astype(int), 0, shape[0] - 1)
    return i * shape[1] + column.astype(int) % shape[1]


def split_images(data: Dataset) -> tuple[Dataset, tuple[Mirror, ...]]:
    """Return the captures without images of the sun in plane mirrors, and these mirrors.

    The pixels of an image get the luminance of their surroundings. Data without a mirror are
    returned unchanged.
    """
    light, suns = data.light, data.light.shown_sun_direction
    spots = [
        spot
        for k, image in enumerate(data.luminance_cdm2)
        for spot in bright_spots(image, data.heading_deg, suns[k], float(light.dni_wm2[k]), k)
    ]
    if not spots:
        return data, ()
    planes = find_mirrors(spots, suns, light.direct_lx, data.shape[0])
    if not planes:
        return data, ()
    maps = data.luminance_cdm2.copy()
    for image in (image for plane in planes for image in plane.images):
        maps[image.row] = without_disc(maps[image.row], image.spot)
    data = replace(data, luminance_cdm2=maps)
    return data, tuple(_mirror(plane, data) for plane in planes)


def mirror_warnings(mirrors: Sequence[Mirror], captures: int) -> list[str]:
    """Return one warning for each mirror."""
    return [
        f"WARNING: {mirror.captures} of {captures} captures show the sun in a plane mirror "
        f"({mirror.text}): a glass facade, water or a glossy surface. Predicted maps have no "
        "mirrored sun. Hours in which it may be in view are not trusted, and their DGP is a lower "
        "bound"
        for mirror in mirrors
    ]


# ----------------------------------------------------------------------------------------------
# where an image is visible


def _mirror(plane: MirrorPlane, data: Dataset) -> Mirror:
    """Return a plane with the energy of its images and the chance that they are visible."""
    suns, direct_lx = data.light.shown_sun_direction, data.light.direct_lx
    rows = np.array([image.row for image in plane.images])
    full_lx = glass_reflectance(suns @ plane.normal) * direct_lx  # [n], for a factor of 1
    measured_lx = np.array([image.spot.normal_lx for image in plane.images])
    factor = float(np.median(measured_lx / full_lx[rows]))
    visible = np.zeros(len(data), bool)
    visible[rows] = True
    towards = mirrored(suns, plane.normal)
    pixel = _pixels(towards, data.shape, data.heading_deg)
    limit = np.array([brightest_surface_cdm2(float(dni)) for dni in data.light.dni_wm2])
    bright = factor * full_lx / equirect_solid_angles(*data.shape).reshape(-1)[pixel]
    labelled = visible | (
        (bright > _TO_BE_FOUND * limit)
        & (suns @ plane.normal > np.sin(near_sun_rad(data.shape[0]) / 2.0))
        & data.seen.reshape(-1)[pixel]
    )
    label = np.flatnonzero(labelled)
    chance = _chance(data, towards[label], pixel[label], visible[label])
    return Mirror(plane.normal, plane.u_deg, len(rows), factor, chance)


def _chance(
    data: Dataset, towards: Array, pixel: NDArray[np.intp], visible: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Return the chance [H, W] that an image is visible, from labels: directions [k, 3], pixels."""
    some = np.unique(np.linspace(0, len(data) - 1, _MOST_MAPS).round().astype(int))
    maps = np.log10(np.maximum(data.luminance_cdm2[some], 1.0)).reshape(len(some), -1)
    rays = equirect_rays(*data.shape, data.heading_deg).reshape(-1, 3)
    out = np.empty(len(rays), np.float32)
    for start in range(0, len(rays), _PIXELS_AT_ONCE):
        part = slice(start, start + _PIXELS_AT_ONCE)
        out[part] = _voted(rays[part] @ towards.T, maps[:, part], maps[:, pixel], visible)
    return out.reshape(data.shape)


def _voted(
    cosine: Array, here: NDArray[np.float32], there: NDArray[np.float32], visible: NDArray[np.bool_]
) -> Array:
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


# ----------------------------------------------------------------------------------------------
# a model's folder


def table_of(mirrors: Sequence[Mirror]) -> list[dict[str, Any]]:
    """Return what config.json stores of mirrors."""
    return [
        {
            "normal": mirror.normal.tolist(),
            "u_deg": mirror.u_deg,
            "captures": mirror.captures,
            "factor": mirror.factor,
        }
        for mirror in mirrors
    ]


def arrays_of(mirrors: Sequence[Mirror]) -> dict[str, NDArray[Any]]:
    """Return what weights.npz stores of mirrors; empty without a mirror."""
    return {"mirror_chance": np.stack([m.chance for m in mirrors])} if mirrors else {}


def read_mirrors(folder: Path, config: ModelConfig) -> tuple[Mirror, ...]:
    """Return the mirrors of the model in a folder. Raises InputError for damaged content."""
    stored: Sequence[Mapping[str, Any]] = config.state.get("mirrors", ())
    if not stored:
        return ()
    try:
        chance = read_arrays(folder / "weights.npz")["mirror_chance"]
        if chance.shape != (len(stored), config.height, config.width):
            raise ValueError(f"mirror_chance of shape {chance.shape}")
        return tuple(
            Mirror(
                np.array(table["normal"], float).reshape(3),
                float(table["u_deg"]),
                int(table["captures"]),
                float(table["factor"]),
                chance[k].astype(np.float32),
            )
            for k, table in enumerate(stored)
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            folder,
            f"mirrors that cannot be used ({error})",
            "the mirrors that fieldlum train wrote",
            "train the model again (fieldlum train)",
        ) from None
