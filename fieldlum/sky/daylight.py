"""Describe the daylight outside at given times: sun, Perez sky, illuminance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cached_property

import numpy as np

from fieldlum.core.arrays import Array, Floats, Floats32, Indices
from fieldlum.core.records import Site
from fieldlum.sky import sun
from fieldlum.sky.perez import PerezSky, perez_coefficients, perez_luminance, reinhart_patches

MIN_LX = 1e-3  # least total light [lx], so that features of a dark hour are finite; chosen


@dataclass(frozen=True)
class Light:
    """The light outside at n times.

    t_utc: times with a zone; dni_wm2, dhi_wm2: direct normal and diffuse horizontal irradiance [n]
    W/m2; sun_altitude_deg, sun_azimuth_deg: the sun without refraction, azimuth clockwise from
    north [n]; perez: the n skies from elsewhere (such as a rendering), None to compute them from
    the irradiance; states: the room's state at each time, such as lamp=on;blind=half
    (`core.room_states`), "" for the usual one, None for always the usual one; refraction: True if
    pictures show the sun raised by refraction, as a camera does, False if they show it at the true
    altitude, as some renderings do.
    """

    t_utc: tuple[datetime, ...]
    dni_wm2: Floats
    dhi_wm2: Floats
    sun_altitude_deg: Floats
    sun_azimuth_deg: Floats
    perez: PerezSky | None = None
    states: tuple[str, ...] | None = None
    refraction: bool = True

    def __len__(self) -> int:
        """Return the number of times."""
        return len(self.t_utc)

    def __getitem__(self, rows: slice | Array | Sequence[int]) -> Light:
        """Return the times that an index, a boolean array or a slice selects."""
        index = np.arange(len(self))[rows if isinstance(rows, slice) else np.asarray(rows)]
        names = ("dni_wm2", "dhi_wm2", "sun_altitude_deg", "sun_azimuth_deg")
        return replace(
            self,
            t_utc=tuple(self.t_utc[i] for i in index),
            perez=None if self.perez is None else self.perez[index],
            states=None if self.states is None else tuple(self.states[i] for i in index),
            **{name: getattr(self, name)[index] for name in names},
        )

    @cached_property
    def day_of_year(self) -> Indices:
        """Day of the year of each time in its own zone, from 1, [n]."""
        return np.array([t.timetuple().tm_yday for t in self.t_utc], np.intp)

    @cached_property
    def sky(self) -> PerezSky:
        """Perez skies at the n times: those of `perez`, else computed from the irradiance."""
        if self.perez is not None:
            return self.perez
        irradiance = (self.dni_wm2, self.dhi_wm2)
        return perez_coefficients(*irradiance, self.sun_altitude_deg, self.day_of_year)

    @cached_property
    def sun_direction(self) -> Floats:
        """Unit vectors towards the true sun, [n, 3]: x east, y north, z up; for sky and kernels."""
        return sun.direction(self.sun_altitude_deg, self.sun_azimuth_deg)

    @cached_property
    def apparent_altitude_deg(self) -> Floats:
        """The altitude at which pictures show the sun, [n], in deg."""
        if not self.refraction:
            return self.sun_altitude_deg
        return sun.apparent_altitude_deg(self.sun_altitude_deg)

    @cached_property
    def apparent_sun_direction(self) -> Floats:
        """Unit vectors towards the sun in pictures, [n, 3], with the axes of `sun_direction`.

        For sun patches, disc and glare.
        """
        return sun.direction(self.apparent_altitude_deg, self.sun_azimuth_deg)

    @cached_property
    def sky_cdm2(self) -> Floats32:
        """Luminance of the patches of `reinhart_patches` in cd/m2, without the sun, [n, 2305]."""
        return self.sky_at(reinhart_patches().directions)

    def sky_at(self, directions: Floats) -> Floats32:
        """Return the sky's luminance at n times in m directions, without the sun, [n, m], in cd/m2.

        directions: unit vectors, x east, y north, z up [m, 3]. Below the horizon it is the
        luminance of open ground, after a smooth transition (`perez_luminance`).
        """
        suns = self.sun_direction
        return perez_luminance(self.sky, suns, directions, dtype=np.float32)  # pyright: ignore

    @property
    def direct_lx(self) -> Floats:
        """The sun's illuminance on a plane normal to it, [n], in lx."""
        return self.sky.direct_lx

    @cached_property
    def diffuse_lx(self) -> Floats:
        """The sky's illuminance on the horizontal, summed over the patches, [n], in lx."""
        patches = reinhart_patches()
        weights = patches.solid_angles_sr * patches.directions[:, 2]  # times sin(altitude)
        return np.asarray(self.sky_cdm2 @ weights, float)

    @cached_property
    def total_lx(self) -> Floats:
        """Sum of the sky's horizontal illuminance and the sun's normal illuminance, [n], in lx.

        The features of an hour (`Features`) are divided by it. It is at least 0.001 lx (`MIN_LX`).
        The sun's part is not multiplied by the sine of its altitude, so that it is not small for a
        low sun.
        """
        return np.maximum(self.diffuse_lx + self.direct_lx, MIN_LX)

    def sky_features(self, sky_cdm2: Floats32) -> Floats32:
        """Return the sky's part of the features of n hours (`Features.sky`), [n, 2305].

        It is the luminance of each sky patch, `sky_cdm2` [n, 2305], times the root of the patch's
        solid angle, over the hour's total light (`total_lx`): products of two hours are integrals
        over the sky.
        """
        root_solid_angle = np.sqrt(reinhart_patches().solid_angles_sr).astype(np.float32)
        return sky_cdm2 * root_solid_angle / self.total_lx.astype(np.float32)[:, None]


def light_at(times_utc: Sequence[datetime], site: Site, dni_wm2: Floats, dhi_wm2: Floats) -> Light:
    """Return the light at n times, with the sun's position computed by SPA (NREL).

    dni_wm2, dhi_wm2: direct normal and diffuse horizontal irradiance, [n] or one value for all
    times [W/m2]. Raises ValueError for times without a zone.
    """
    at = sun.position(times_utc, site)
    dni, dhi = (np.full(len(times_utc), value, float) for value in (dni_wm2, dhi_wm2))
    return Light(
        t_utc=tuple(times_utc),
        dni_wm2=dni,
        dhi_wm2=dhi,
        sun_altitude_deg=at.altitude_deg,
        sun_azimuth_deg=at.azimuth_deg,
    )
