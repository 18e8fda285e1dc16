"""Compute how much of a year's light a plan covers: suns, and direct with diffuse irradiance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fieldlum.core.arrays import Floats, Mask
from fieldlum.core.records import Site
from fieldlum.plan.days import DaylightHours
from fieldlum.sky import sun
from fieldlum.weather import Weather

# A sun position is covered if a planned one is at most this far away. Chosen: hourly suns are 15
# deg apart.
NEAR_DEG = 10.0
# Size of the cells in which direct and diffuse irradiance count as equal. Chosen, not measured.
DNI_CELL_WM2 = 100.0
DHI_CELL_WM2 = 50.0


@dataclass(frozen=True, slots=True)
class Coverage:
    """Shares of a year that a plan covers, in percent; None for shares that need a weather file.

    sun_band_percent: of the sky area that the sun crosses in a year, within 10 deg of a planned
    sun; irradiance_percent: of the weather's daylight hours that are in the same cell of 100 W/m2
    direct by 50 W/m2 diffuse irradiance as a planned hour; both_percent: of those also within 10
    deg of a planned sun.
    """

    # area of the band of sun positions that are within NEAR_DEG of a planned one
    sun_band_percent: float
    # weather hours in a cell of DNI and DHI with a planned hour
    irradiance_percent: float | None = None
    both_percent: float | None = None  # weather hours covered in both ways


# ----------------------------------------------------------------------------------------------
# sun band


def band_directions(site: Site, declinations: int = 41) -> Floats:
    """Return directions spread evenly over the sky band of the sun, [n, 3].

    They are unit vectors (x east, y north, z up) with declinations from -23.44 to 23.44 deg, above
    the horizon. declinations: how many of them; nine times as many hour angles.
    """
    sine = (2 * (np.arange(declinations) + 0.5) / declinations - 1) * np.sin(
        np.radians(sun.OBLIQUITY_DEG)
    )
    turn = np.linspace(0, 2 * np.pi, 9 * declinations, endpoint=False)
    south, hour = (grid.ravel() for grid in np.meshgrid(sine, turn))
    across = np.sqrt(1.0 - south**2)
    latitude = np.radians(site.latitude_deg)
    up = np.sin(latitude) * south + np.cos(latitude) * across * np.cos(hour)
    north = np.cos(latitude) * south - np.sin(latitude) * across * np.cos(hour)
    return np.stack([-across * np.sin(hour), north, up], axis=-1)[up > 0]


def sun_band_percent(hours: DaylightHours, site: Site) -> float:
    """Return the percentage of the sky band of the sun that is within 10 deg of an hour's sun.

    The band is that of `band_directions`, weighted by area. Without hours the result is 0.
    """
    band = band_directions(site)
    return 100.0 * float(near_planned(band, hours).mean()) if len(band) else 0.0


def near_planned(directions: Floats, hours: DaylightHours) -> Mask:
    """Return which directions [n, 3] are within 10 deg of the sun of a planned hour, [n]."""
    if not len(hours):
        return np.zeros(len(directions), bool)
    planned = sun.direction(hours.altitude_deg, hours.azimuth_deg)
    return (directions @ planned.T).max(axis=1) >= np.cos(np.radians(NEAR_DEG))


# ----------------------------------------------------------------------------------------------
# irradiance


def _cells(irradiance: ArrayLike) -> NDArray[np.int64]:
    """Return numbers of the cells of DNI and DHI, from [2, n]."""
    dni, dhi = np.nan_to_num(np.asarray(irradiance, float))
    cells = np.floor(dni / DNI_CELL_WM2) * 1000 + np.floor(dhi / DHI_CELL_WM2)
    return cells.astype(np.int64)


def coverage(hours: DaylightHours, site: Site, weather: Weather | None = None) -> Coverage:
    """Return how much of the year's sun band some hours cover; with weather, also of its daylight.

    The shares by weather are None without hours, too.
    """
    band = sun_band_percent(hours, site)
    if weather is None or not len(hours):
        return Coverage(band)
    at = sun.position(weather.t_utc, site)
    lit = (at.altitude_deg > 0) & (weather.dhi_wm2 > 0)
    _, *planned = weather.at(hours.t_utc)
    known = np.stack(planned)[:, np.isfinite(planned[0])]
    captured = np.isin(_cells([weather.dni_wm2[lit], weather.dhi_wm2[lit]]), _cells(known))
    near = near_planned(sun.direction(at.altitude_deg[lit], at.azimuth_deg[lit]), hours)
    return Coverage(band, 100.0 * float(captured.mean()), 100.0 * float((captured & near).mean()))
