"""Compute the images of the sun in plane mirrors for any hours; store the mirrors of a model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.core.arrays import Array, Floats, Floats32, Indices, Mask
from fieldlum.core.errors import InputError
from fieldlum.core.records import JsonTable
from fieldlum.optics.projection import altitude_azimuth_deg, equirect_pixel
from fieldlum.session.files.arrays_npz import read_arrays
from fieldlum.session.files.model_config import ModelConfig
from fieldlum.sky.light import Light
from fieldlum.sky.sun_images import glass_reflectance, mirrored, ring_around, tolerance_rad

TO_SHOW = 0.5  # an image with a larger chance is predicted
MAX_DOUBT = 0.05  # an hour is not trusted if the chance of a wrong decision is larger; chosen
# Standard deviation of an image's place over `tolerance_rad`, which no place exceeds; chosen
_PLACE_SIGMA = 0.5


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
    def doubtful(self) -> Mask:
        """Mask [n], True where the chance that `shown` is wrong exceeds 5 %."""
        return np.where(self.shown, 1.0 - self.chance, self.chance) > MAX_DOUBT

    @property
    def place_deg(self) -> tuple[Floats, Floats]:
        """Altitudes and azimuths (clockwise from north) of the sun's images, [n] deg each."""
        return place_deg(self.towards)


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
        suns = light.shown_sun_direction
        towards, cosine = mirrored(suns, self.normal), suns @ self.normal
        reach = _PLACE_SIGMA * tolerance_rad(len(self.chance))
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
            ahead & (chances[0] > TO_SHOW) & self.predicted,
        )

    @property
    def warning(self) -> str:
        """Warning text of `train`, to follow "WARNING: 3 of 40 captures"."""
        azimuth, altitude = (float(v[0]) for v in place_deg(np.array([self.normal]))[::-1])
        return (
            f"show the sun in a plane mirror (normal at azimuth {round(azimuth)}, altitude "
            f"{round(altitude)} degrees, u {self.u_deg:.1f} degrees): a glass facade, water or a "
            f"glossy surface. {self._consequence()}"
        )

    def _consequence(self) -> str:
        if self.predicted:
            return (
                "Predicted hours include the mirrored sun where captures showed it; the other days "
                f"predict for {self.judged - self.wrong} of {self.judged} captures correctly "
                "whether it is in view. Hours in which the captures do not decide this are not "
                "trusted"
            )
        reason = (
            f"because the other days predict {self.wrong} of {self.judged} captures wrongly"
            if self.measured
            else "because its images are clipped: capture with a shorter exposure or a filter"
        )
        return (
            f"Predicted hours have no mirrored sun, {reason}. Hours in which it may be in view are "
            "not trusted, and their DGP is a lower bound"
        )


def place_deg(towards: Floats) -> tuple[Floats, Floats]:
    """Return altitudes and azimuths (clockwise from north) of unit vectors, [n] deg each.

    towards: [n, 3], x east, y north, z up.
    """
    altitude, azimuth = altitude_azimuth_deg(towards)
    return altitude, azimuth % 360.0


def pixels(towards: Floats, shape: tuple[int, ...], heading_deg: float) -> Indices:
    """Return the index in the flattened map of the pixel in each direction, [n].

    towards: unit vectors [n, 3]; shape: (H, W); heading_deg: azimuth of the middle of the map.
    """
    row, column = equirect_pixel(*place_deg(towards), shape[0], shape[1], heading_deg)
    i = np.clip(row.astype(int), 0, shape[0] - 1)
    return i * shape[1] + column.astype(int) % shape[1]


# ----------------------------------------------------------------------------------------------
# a model's folder


def table_of(mirrors: Sequence[Mirror]) -> list[JsonTable]:
    """Return what config.json stores of mirrors: a table for each, without `chance`."""
    return [
        {name: value for name, value in asdict(mirror).items() if name != "chance"}
        for mirror in mirrors
    ]


def arrays_of(mirrors: Sequence[Mirror]) -> dict[str, Array]:
    """Return what weights.npz stores of mirrors; empty without a mirror."""
    return {"mirror_chance": np.stack([m.chance for m in mirrors])} if mirrors else {}


def read_mirrors(folder: Path, config: ModelConfig) -> tuple[Mirror, ...]:
    """Return the mirrors of the model in `folder`; empty if it has none.

    config: its config.json. Raises InputError for missing or damaged content.
    """
    stored: Sequence[Mapping[str, Any]] = config.state.get("mirrors", ())
    if not stored:
        return ()
    try:
        chance = read_arrays(folder / "weights.npz")["mirror_chance"]
        if chance.shape != (len(stored), config.height, config.width):
            raise ValueError(f"mirror_chance has the shape {chance.shape}")
        for table in stored:
            numbers = [*table["normal"], table["u_deg"], table["factor"]]
            if len(numbers) != 5 or not np.isfinite(numbers).all():
                raise ValueError("a normal, u_deg or factor is not a number")
        return tuple(Mirror(**table, chance=chance[k]) for k, table in enumerate(stored))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            folder,
            f"mirrors that cannot be used ({error})",
            "the mirrors that fieldlum train wrote",
            "train the model again (fieldlum train)",
        ) from None
