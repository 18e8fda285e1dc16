"""Compare hours by their light, as a room sees it, and choose the hours that explain a year best.

A room responds linearly to the sky's patches and to the sun. Its response varies smoothly with the
sun's direction, except for the sharp sun patch, which is known from geometry or has its own model.
The kernel is the covariance that follows: linear in the sky vector, linear in the sun's share and
smooth in its direction; a sun behind all facades adds little. `plan` uses it before any picture
exists, `learn.transport` to learn from pictures.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fieldlum.core.arrays import Array, Floats, Floats32
from fieldlum.core.records import Room
from fieldlum.sky import sun
from fieldlum.sky.daylight import Light

# Share of a sun behind the facade that still enters, by reflection from ground and surroundings.
# Chosen, not measured (docs/decisions.md).
BEHIND = 0.1
# Typical cosine between facade and sun, so that the facade factor is about the beam's share.
# Chosen.
FACING = 0.8
LAMP_LX = 1000.0  # light outside [lx] at which a lamp's share is about one; chosen
# Azimuths of the walls relative to the room's south wall.
WALLS_DEG = {"south": 0.0, "west": 90.0, "north": 180.0, "east": 270.0}


@dataclass(frozen=True, slots=True)
class Facades:
    """The f walls that let light in.

    azimuths_deg: of their outward normals, clockwise from north [f]; weights: factor on the term of
    each wall in `Kernel`, 1 for the wall of a known room with most glass [f].
    """

    azimuths_deg: Floats
    weights: Floats

    @property
    def normals(self) -> Floats:
        """The outward normals as unit vectors, [f, 3]: x east, y north, z up (always 0)."""
        return sun.direction(0.0, self.azimuths_deg)


def facades_of(room: Room | None) -> Facades:
    """Return the walls of a box room that have windows, as facades.

    The weight multiplies the wall's term in the kernel, the covariance that sun on the wall causes.
    Glass is the sum over a wall's windows of area times transmittance. The weight is the square
    root of the wall's glass divided by that of the wall with most glass, which has the weight 1;
    the root gives small windows a larger part (chosen). Without a box room or windows there are
    eight facades, one every 45 degrees, of weight 0.25 each (chosen): together they count about as
    much as one facade in the sun.
    """
    if room is None or room.kind != "box" or not room.window:
        return Facades(np.linspace(0.0, 315.0, 8), np.full(8, 0.25))
    glass = dict.fromkeys((w.wall for w in room.window), 0.0)
    for window in room.window:
        glass[window.wall] += window.width_m * window.height_m * window.transmittance
    azimuths = np.array([(room.wall_azimuth_deg + WALLS_DEG[wall]) % 360.0 for wall in glass])
    area = np.array(list(glass.values()))
    return Facades(azimuths, np.sqrt(area / area.max()))


# ----------------------------------------------------------------------------------------------
# features and kernel


@dataclass(frozen=True, slots=True)
class Features:
    """The quantities of n hours that the kernel compares, divided by the hour's total light.

    Total light is `Light.total_lx`. sky [n, 2305]: luminance of each sky patch times the root of
    its solid angle; beam [n]: the sun's normal illuminance, so its share of the total, 0 to 1;
    direction [n, 3]: unit vector to the true sun; bounced [n, k]: k features of the sun's reflected
    light in a coarse room model (`Physics.features`), None without one; lamps [n, l]: for each of l
    lamps 1 000 lx over the total light while it is on, else 0, None without lamps.
    """

    sky: Floats32
    beam: Floats
    direction: Floats
    bounced: Floats32 | None = None
    lamps: Floats | None = None

    def __len__(self) -> int:
        """Return the number of hours."""
        return len(self.beam)

    def __getitem__(self, rows: slice | Array | Sequence[int]) -> Features:
        """Return the hours that an index array, a boolean array or a slice selects."""
        parts = {name: getattr(self, name) for name in self.__dataclass_fields__}
        return replace(self, **{n: v[rows] for n, v in parts.items() if v is not None})


def light_features(light: Light) -> Features:
    """Return the features of n hours that need no room: `sky`, `beam` and `direction`."""
    sky = light.sky_features(light.sky_cdm2)
    return Features(sky, light.direct_lx / light.total_lx, light.sun_direction)


@dataclass(frozen=True, slots=True)
class Kernel:
    """Prior covariance, between two hours, of a pixel's luminance divided by the total light.

    Values are relative to the pixel's usual luminance per total light. Each field except
    `facades` and the width is the weight (prior variance) of one term. beam_width: distance
    between two unit vectors to the sun over which the term of facades changes (0.5 is about 29
    degrees). The defaults are from a study of one room and may change threefold with little
    effect (docs/decisions.md). constant: a room that follows total light, direct sun, and sun
    on the ground; sky: distribution of the sky's light; facade: sun on the facades, smooth in
    the sun's direction; bounced: the sun's light in a coarse model of the room; lamps: electric
    light, ten times the room's daylight at LAMP_LX outside.
    """

    facades: Facades
    constant: float = 1.0
    sky: float = 2.0
    beam_width: float = 0.5
    facade: float = 1.0
    bounced: float = 5.0
    lamps: float = 100.0

    def __call__(self, a: Features, b: Features) -> Floats:
        """Return the covariance between each hour of `a` and each hour of `b`, [len(a), len(b)].

        A term is omitted if `a` or `b` has None for its features.
        """
        cosine = np.clip(a.direction @ b.direction.T, -1.0, 1.0)
        return self._sum(a, b, lambda x, y: x @ y.T, np.exp((cosine - 1.0) / self.beam_width**2))

    def diagonal(self, a: Features) -> Floats:
        """Return the prior variance of each hour of `a`: the diagonal of kernel(a, a), [len(a)]."""
        return self._sum(a, a, lambda x, y: np.einsum("ij,ij->i", x, y), np.ones(len(a)))

    def _sum(
        self, a: Features, b: Features, product: Callable[[Array, Array], Floats], near: Floats
    ) -> Floats:
        """Return the sum of the kernel's terms, each a `product` of a feature of `a` and of `b`.

        product: takes arrays [len(a), k] and [len(b), k]; near: factor on the facades' term by the
        angle between two suns, in the product's shape, as the result.
        """
        beams = [f.beam[:, None] for f in (a, b)]
        grounds = (f.beam[:, None] * np.maximum(f.direction[:, 2:], 0.0) for f in (a, b))
        total = self.constant * (1.0 + product(*beams) + product(*grounds))
        total += self.sky * product(a.sky, b.sky)
        total += self.facade * product(_facade(a, self.facades), _facade(b, self.facades)) * near
        if a.bounced is not None and b.bounced is not None:
            total += self.bounced * product(a.bounced, b.bounced)
        if a.lamps is not None and b.lamps is not None:
            total += self.lamps * product(a.lamps, b.lamps)
        return total


def _facade(a: Features, facades: Facades) -> Floats:
    """Return the sun's share of the light on each of f facades in n hours, weighted, [n, f]."""
    on = BEHIND + np.maximum(a.direction @ facades.normals.T, 0.0)
    return a.beam[:, None] * on / FACING * np.sqrt(facades.weights)
