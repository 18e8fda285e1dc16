"""Describe the light outside: its features for learning, and the kernel between hours.

A room responds linearly to the sky's patches and to the sun. Its response varies smoothly with the
sun's direction, except for the sharp sun patch, which is known from geometry or has its own model.
The kernel is the covariance that follows: linear in the sky vector, linear in the sun's share and
smooth in its direction; a sun behind all facades adds little. `plan` uses it before any picture
exists, `models.transport` to learn from pictures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum import sun
from fieldlum.records import Progress, Room, Site, quiet
from fieldlum.sky import PerezSky, perez_coefficients, perez_luminance, reinhart_patches

Array = NDArray[np.float64]

LEAST_LX = 1e-3  # least total light [lx], so that features of a dark hour are finite; chosen
# Share of a sun behind the facade that still enters, by reflection from ground and surroundings.
# Chosen, not measured (docs/decisions/0003-light-kernel.md).
BEHIND = 0.1
# Typical cosine between facade and sun, so that the facade factor is about the beam's share.
# Chosen.
FACING = 0.8
LAMP_LX = 1000.0  # light outside [lx] at which a lamp's share is about one; chosen
# Azimuths of the walls relative to the room's south wall.
WALLS_DEG = {"south": 0.0, "west": 90.0, "north": 180.0, "east": 270.0}


@dataclass(frozen=True)
class Light:
    """The light at n times: irradiance and sun (true altitude; azimuth clockwise from north).

    `perez` : a sky known from elsewhere (the coefficients of a rendering); None: computed from the
    irradiance. `states` : the room's state at each time, as in `fieldlum.room_states`; None: the
    usual state. `refraction` : whether pictures show the sun as raised by refraction, as a camera
    does, or at the true altitude, as some renderings do.
    """

    t_utc: tuple[datetime, ...]
    dni_wm2: Array
    dhi_wm2: Array
    sun_altitude_deg: Array
    sun_azimuth_deg: Array
    perez: PerezSky | None = None
    states: tuple[str, ...] | None = None
    refraction: bool = True

    def __len__(self) -> int:
        return len(self.t_utc)

    def __getitem__(self, rows: slice | NDArray[Any] | Sequence[int]) -> Light:
        """Return the times that an index, a boolean array or a slice selects."""
        index = np.arange(len(self))[rows if isinstance(rows, slice) else np.asarray(rows)]
        return Light(
            tuple(self.t_utc[i] for i in index),
            self.dni_wm2[index],
            self.dhi_wm2[index],
            self.sun_altitude_deg[index],
            self.sun_azimuth_deg[index],
            None if self.perez is None else self.perez[index],
            None if self.states is None else tuple(self.states[i] for i in index),
            self.refraction,
        )

    @cached_property
    def sky(self) -> PerezSky:
        """Perez skies at the n times: those of `perez`, else computed from the irradiance."""
        if self.perez is not None:
            return self.perez
        return perez_coefficients(self.dni_wm2, self.dhi_wm2, self.sun_altitude_deg, self.t_utc)

    @cached_property
    def sun_direction(self) -> Array:
        """Unit vectors towards the true sun, [n, 3]: x east, y north, z up; for sky and kernels."""
        return sun.direction(self.sun_altitude_deg, self.sun_azimuth_deg)

    @cached_property
    def shown_altitude_deg(self) -> Array:
        """The altitude at which pictures show the sun, [n], in deg."""
        if not self.refraction:
            return self.sun_altitude_deg
        return sun.shown_altitude_deg(self.sun_altitude_deg)

    @cached_property
    def shown_sun_direction(self) -> Array:
        """Unit vectors towards the sun in pictures, [n, 3]; for patches, disc and glare."""
        return sun.direction(self.shown_altitude_deg, self.sun_azimuth_deg)

    @cached_property
    def sky_cdm2(self) -> NDArray[np.float32]:
        """Luminance of the Reinhart sky patches in cd/m2, without the sun, [n, 2305]."""
        return self.sky_at(reinhart_patches().directions)

    def sky_at(self, directions: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return the sky's luminance in directions [m, 3], without the sun, [n, m], in cd/m2.

        Below the horizon it is that of open ground.
        """
        return perez_luminance(self.sky, self.sun_direction, directions, dtype=np.float32)  # pyright: ignore

    @property
    def direct_lx(self) -> Array:
        """The sun's illuminance on a plane normal to it, [n], in lx."""
        return self.sky.direct_lx

    @cached_property
    def diffuse_lx(self) -> Array:
        """The sky's illuminance on the horizontal, summed over the patches, [n], in lx."""
        patches = reinhart_patches()
        return np.asarray(
            self.sky_cdm2 @ (patches.solid_angles_sr * patches.directions[:, 2]), float
        )

    @cached_property
    def total_lx(self) -> Array:
        """Sum of the sky's horizontal illuminance and the sun's normal illuminance, [n], in lx.

        Features are divided by it; it is at least 0.001 lx, and not small for a low sun.
        """
        return np.maximum(self.diffuse_lx + self.direct_lx, LEAST_LX)


def light_at(times_utc: Sequence[datetime], site: Site, dni_wm2: Array, dhi_wm2: Array) -> Light:
    """Return the light at n times, with the sun by SPA. Raises ValueError for times without a zone.

    dni_wm2, dhi_wm2 : [n] or one value, W/m2.
    """
    at = sun.position(times_utc, site)
    dni, dhi = (
        np.broadcast_to(np.asarray(a, float), len(times_utc)).copy() for a in (dni_wm2, dhi_wm2)
    )
    return Light(tuple(times_utc), dni, dhi, at.altitude_deg, at.azimuth_deg)


# ----------------------------------------------------------------------------------------------
# facades


@dataclass(frozen=True, slots=True)
class Facades:
    """Walls that let light in: azimuths of their outward normals [f] in deg, and weights [f]."""

    azimuths_deg: Array
    weights: Array

    @property
    def normals(self) -> Array:
        """The outward normals as unit vectors, [f, 3]."""
        return sun.direction(0.0, self.azimuths_deg)


def one_facade(azimuth_deg: float) -> Facades:
    """Return a single facade of weight 1 with this azimuth of its outward normal."""
    return Facades(np.array([azimuth_deg % 360.0]), np.ones(1))


def facades_unknown() -> Facades:
    """Return eight facades, one every 45 degrees, of weight 0.25 each, for an unknown room."""
    return Facades(np.linspace(0.0, 315.0, 8), np.full(8, 0.25))


def facades_of(room: Room | None) -> Facades:
    """Return the walls of a box room that have windows, as facades.

    A weight is the root of the wall's glass area times transmittance, over that of the wall with
    most glass. Without a box room or windows the result is `facades_unknown`.
    """
    if room is None or room.kind != "box" or not room.window:
        return facades_unknown()
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
    """The quantities that the kernel compares, per unit of total light.

    sky [n, P] : luminances weighted by the root of the solid angle; beam [n] : the sun's share;
    direction [n, 3] : of the sun; cells [n, c] : direct sun in view by cells of the picture, if sun
    patches are known; bounced [n, k] : the sun's light in a coarse model of the room, if there is
    one; lamps [n, l] : electric light, which does not follow daylight, 1 000 lx over the total
    light while on, else 0; changed [n, m] : 1 while the room is in a state (such as a blind down)
    that changes its response.
    """

    sky: NDArray[np.float32]
    beam: Array
    direction: Array
    cells: NDArray[np.float32] | None = None
    bounced: NDArray[np.float32] | None = None
    lamps: Array | None = None
    changed: Array | None = None

    def __len__(self) -> int:
        return len(self.beam)

    def __getitem__(self, rows: slice | NDArray[Any] | Sequence[int]) -> Features:
        return Features(
            self.sky[rows],
            self.beam[rows],
            self.direction[rows],
            None if self.cells is None else self.cells[rows],
            None if self.bounced is None else self.bounced[rows],
            None if self.lamps is None else self.lamps[rows],
            None if self.changed is None else self.changed[rows],
        )


def light_features(light: Light) -> Features:
    """Return the features `sky`, `beam` and `direction` of each time, without those of a room."""
    root = np.sqrt(reinhart_patches().solid_angles_sr).astype(np.float32)
    sky = light.sky_cdm2 * root / light.total_lx.astype(np.float32)[:, None]
    return Features(sky, light.direct_lx / light.total_lx, light.sun_direction)


@dataclass(frozen=True, slots=True)
class Kernel:
    """Prior covariance between hours of the light that reaches a pixel, per unit of total light.

    The defaults are from a study of one room and may change threefold with little effect
    (docs/decisions/0003-light-kernel.md). Widths are chords of the sun's direction (0.5 is about 29
    degrees).
    """

    facades: Facades
    constant: float = 1.0  # a room that follows total light; the sun; the sun on the ground
    sky: float = 2.0
    beam_width: float = 0.5
    facade: float = 1.0  # sun on the facades, smooth in the sun's direction
    cells: float = 0.5
    bounced: float = 5.0  # the sun's light in a coarse model of the room
    lamps: float = 100.0  # electric light: ten times the room's daylight at LAMP_LX outside
    changed: float = 1.0  # effect of a state of the room on its response to light

    def __call__(self, a: Features, b: Features) -> Array:
        """Return the covariance matrix, [len(a), len(b)]."""
        cosine = np.clip(a.direction @ b.direction.T, -1.0, 1.0)
        beam = np.outer(a.beam, b.beam)
        k = self.constant * (1.0 + beam + np.outer(_ground(a), _ground(b)))
        k += self.sky * (a.sky @ b.sky.T)
        on = _facade(a, self.facades) @ _facade(b, self.facades).T
        k += self.facade * on * np.exp((cosine - 1.0) / self.beam_width**2)
        if a.cells is not None and b.cells is not None:
            k += self.cells * (a.cells @ b.cells.T)
        if a.bounced is not None and b.bounced is not None:
            k += self.bounced * (a.bounced @ b.bounced.T)
        if a.changed is not None and b.changed is not None:
            k *= 1.0 + self.changed * (a.changed @ b.changed.T)
        if a.lamps is not None and b.lamps is not None:
            k += self.lamps * (a.lamps @ b.lamps.T)
        return k

    def diagonal(self, a: Features) -> Array:
        """Return the prior variance of each hour, [len(a)]."""
        k = self.constant * (1.0 + a.beam**2 + _ground(a) ** 2)
        k += self.sky * np.einsum("ij,ij->i", a.sky, a.sky)
        k += self.facade * (_facade(a, self.facades) ** 2).sum(axis=1)
        if a.cells is not None:
            k += self.cells * np.einsum("ij,ij->i", a.cells, a.cells)
        if a.bounced is not None:
            k += self.bounced * np.einsum("ij,ij->i", a.bounced, a.bounced)
        if a.changed is not None:
            k *= 1.0 + self.changed * np.einsum("ij,ij->i", a.changed, a.changed)
        if a.lamps is not None:
            k += self.lamps * np.einsum("ij,ij->i", a.lamps, a.lamps)
        return k


def _ground(a: Features) -> Array:
    return a.beam * np.maximum(a.direction[:, 2], 0.0)


def _facade(a: Features, facades: Facades) -> Array:
    """Return the sun's share on each facade, [n, f]."""
    on = BEHIND + np.maximum(a.direction @ facades.normals.T, 0.0)
    return a.beam[:, None] * on / FACING * np.sqrt(facades.weights)


# ----------------------------------------------------------------------------------------------
# choosing hours


@dataclass(frozen=True, slots=True)
class GreedySelection:
    """The hours of a greedy choice.

    index [k] : into the pool, in the order of choice; variance [k + 1] : mean predictive variance
    over the year, before any choice and after each, over the prior variance.
    """

    index: NDArray[np.intp]
    variance: Array


def greedy_hours(
    kernel: Kernel,
    year: Features,
    pool: Features,
    count: int,
    *,
    taken: Features | None = None,
    noise: float = 3e-3,
    weights: Array | None = None,
    progress: Progress = quiet,
) -> GreedySelection:
    """Choose `count` hours of `pool`, each time the one that most reduces the variance over `year`.

    year, pool : features of the hours to predict and of the hours that can be chosen. Only weather
    is needed, no picture. taken : hours already captured; weights [len(year)] : importance of each
    hour of the year; noise : variance of one capture, in units of the kernel. Cost: O((len(year) +
    len(pool)) len(pool) count).
    """
    w = np.ones(len(year)) if weights is None else np.asarray(weights, float)
    cross, own = kernel(year, pool), kernel(pool, pool)
    prior = kernel.diagonal(year)
    if taken is not None and len(taken):
        known = kernel(taken, taken) + noise * np.eye(len(taken))
        towards = np.linalg.solve(
            known, np.concatenate((kernel(taken, pool), kernel(taken, year)), axis=1)
        )
        cross = cross - kernel(year, taken) @ towards[:, : len(pool)]
        own = own - kernel(pool, taken) @ towards[:, : len(pool)]
        left = prior - np.einsum("ij,ji->i", kernel(year, taken), towards[:, len(pool) :])
    else:
        left = prior.copy()
    total = float(w @ prior)
    index, variance = [], [float(w @ left) / total]
    free = np.ones(len(pool), bool)
    for step in range(min(count, len(pool))):
        variances = np.maximum(np.diagonal(own), 0.0) + noise
        gain = np.where(free, w @ cross**2 / variances, -1.0)
        best = int(np.argmax(gain))
        index.append(best)
        free[best] = False
        variance.append(max(variance[-1] - float(gain[best]) / total, 0.0))
        row = own[best] / variances[best]
        cross = cross - np.outer(cross[:, best], row)
        own = own - np.outer(own[:, best], row)
        progress(step + 1, count, "hours chosen")
    return GreedySelection(np.array(index, np.intp), np.array(variance))
