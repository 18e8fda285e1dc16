"""Weather, sun and skies that are not the tool's: CIE general skies with clouds on them.

Skies have the relative luminance of ISO 15469 (CIE S 011), types 1 to 15, times a smooth random
field on the sphere, scaled to the diffuse irradiance. Luminous efficacies are those of Littlefair
1985 as quoted by Littlefair 1988, Lighting Research & Technology 20(4), rounded.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import pvlib
from numpy.typing import NDArray

Array = NDArray[Any]

SUN_RADIUS_RAD = 0.004652
YEAR = 2027
# ISO 15469: a, b of the gradation and c, d, e of the indicatrix, types 1 to 15.
_CIE = np.array(
    [
        (4.0, -0.70, 0, -1.0, 0.00),
        (4.0, -0.70, 2, -1.5, 0.15),
        (1.1, -0.80, 0, -1.0, 0.00),
        (1.1, -0.80, 2, -1.5, 0.15),
        (0.0, -1.00, 0, -1.0, 0.00),
        (0.0, -1.00, 2, -1.5, 0.15),
        (0.0, -1.00, 5, -2.5, 0.30),
        (0.0, -1.00, 10, -3.0, 0.45),
        (-1.0, -0.55, 2, -1.5, 0.15),
        (-1.0, -0.55, 5, -2.5, 0.30),
        (-1.0, -0.55, 10, -3.0, 0.45),
        (-1.0, -0.32, 10, -3.0, 0.45),
        (-1.0, -0.32, 16, -3.0, 0.30),
        (-1.0, -0.15, 16, -3.0, 0.30),
        (-1.0, -0.15, 24, -2.8, 0.15),
    ]
)
_TYPES = {"overcast": (1, 2, 3, 4, 5), "partly": (6, 7, 8, 9, 10), "clear": (11, 12, 13, 14)}
_CLOUD_SD = {"overcast": 0.20, "partly": 0.30, "clear": 0.05}
_WAVES = 32  # cosines of which the clouds consist


@dataclass(frozen=True)
class Hour:
    """One hour: sun in the world's axes, light, and the numbers of its sky.

    month, day, hour: of the site's clock. apparent_deg: altitude as a camera sees it.
    """

    month: int
    day: int
    hour: float
    t_utc: pd.Timestamp
    altitude_deg: float
    apparent_deg: float
    azimuth_deg: float
    dni_wm2: float
    dhi_wm2: float
    cie: int
    cloud_sd: float
    seed: int

    @property
    def normal_lx(self) -> float:
        """Illuminance by the sun's disc on a plane normal to it."""
        h = self.apparent_deg
        return self.dni_wm2 * float(np.clip(51.8 + 1.646 * h - 0.01513 * h * h, 45.0, 107.0))

    @property
    def diffuse_lx(self) -> float:
        """Horizontal illuminance by the sky."""
        ghi = self.dhi_wm2 + self.dni_wm2 * np.sin(np.radians(self.altitude_deg))
        clear = 1 - self.dhi_wm2 / ghi
        return self.dhi_wm2 * (115.0 + 25.0 * float(clear))


def year_of_hours(latitude: float, longitude: float, hours_east: float, seed: int) -> list[Hour]:
    """Return the hours of a synthetic year with the sun above 3 degrees."""
    rng = np.random.default_rng(seed)
    local = pd.date_range(f"{YEAR}-01-01 00:30", f"{YEAR}-12-31 23:30", freq="h")
    utc = (local - pd.Timedelta(hours=hours_east)).tz_localize("UTC")
    sun = pvlib.solarposition.get_solarposition(utc, latitude, longitude)
    altitude, apparent = sun["elevation"].to_numpy(), sun["apparent_elevation"].to_numpy()
    # Cloud cover 0 to 1: a day's level with a slow change within the day; half the days are clear.
    level = np.clip(rng.beta(0.55, 0.75, 366), 0, 1)[local.dayofyear.to_numpy() - 1]
    drift = np.convolve(rng.normal(size=len(local) + 8), np.ones(5) / 5**0.5, "same")[: len(local)]
    cover = np.clip(level + 0.13 * drift, 0, 1)
    out = []
    for k in np.flatnonzero(altitude > 3.0):
        sine = np.sin(np.radians(altitude[k]))
        dni = 1000 * np.exp(-0.13 / sine**0.8) * (1 - cover[k]) ** 1.3
        dni *= 0.0 if cover[k] > 0.75 else 1.0
        dhi = 1000 * sine * (0.10 + 0.45 * cover[k] * (1.3 - cover[k])) + 8
        kind = "clear" if cover[k] < 0.25 else "partly" if cover[k] < 0.75 else "overcast"
        out.append(
            Hour(
                local[k].month,
                local[k].day,
                local[k].hour + 0.5,
                utc[k],
                float(altitude[k]),
                float(apparent[k]),
                float(sun["azimuth"].iloc[k]),
                round(float(dni), 1),
                round(float(dhi), 1),
                int(rng.choice(_TYPES[kind])),
                _CLOUD_SD[kind],
                int(rng.integers(2**31)),
            )
        )
    return out


def directions(altitude_deg: Array, azimuth_deg: Array) -> Array:
    """Return unit vectors [..., 3] in the world's axes: x east, y north, z up."""
    h, a = np.radians(altitude_deg), np.radians(azimuth_deg)
    return np.stack([np.cos(h) * np.sin(a), np.cos(h) * np.cos(a), np.sin(h)], -1)


def sky_cdm2(hour: Hour, rays: Array) -> Array:
    """Return the luminance [n] at directions [n, 3] of the world; below the horizon 0."""
    return _relative(hour, rays) * (hour.diffuse_lx / _horizontal(hour))


def _horizontal(hour: Hour) -> float:
    sine = (np.arange(40) + 0.5) / 40
    azimuth = (np.arange(120) + 0.5) * 3.0
    rays = directions(*(x.ravel() for x in np.meshgrid(np.degrees(np.arcsin(sine)), azimuth)))
    return float((_relative(hour, rays) * rays[:, 2]).mean() * 2 * np.pi)


def _relative(hour: Hour, rays: Array) -> Array:
    a, b, c, d, e = _CIE[hour.cie - 1]
    sun = directions(np.array(hour.apparent_deg), np.array(hour.azimuth_deg))
    chi = np.arccos(np.clip(rays @ sun, -1, 1))
    up = np.maximum(rays[:, 2], 0.01)
    gradation = 1 + a * np.exp(b / up)
    indicatrix = 1 + c * (np.exp(d * chi) - np.exp(d * np.pi / 2)) + e * np.cos(chi) ** 2
    return np.where(rays[:, 2] > 0, gradation * indicatrix * _clouds(hour, rays), 0.0)


def _clouds(hour: Hour, rays: Array) -> Array:
    """Return a log-normal field of mean about 1 and features of 10 to 40 degrees."""
    rng = np.random.default_rng(hour.seed)
    waves = rng.normal(size=(_WAVES, 3)) * rng.choice([2.5, 5.0, 9.0], (_WAVES, 1))
    phase = rng.uniform(0, 2 * np.pi, _WAVES)
    field = np.cos(rays @ waves.T + phase).sum(1) * np.sqrt(2 / _WAVES)
    return np.exp(hour.cloud_sd * field - hour.cloud_sd**2 / 2)


def patch_directions(rows: int) -> tuple[Array, Array]:
    """Return unit vectors [n, 3] of sky patches in `rows` bands of equal altitude, and the bands.

    The second array [rows, 2] is the first patch and the number of patches of each band.
    """
    altitude = (np.arange(rows) + 0.5) * 90 / rows
    count = np.maximum(np.round(4 * rows * np.cos(np.radians(altitude))).astype(int), 4)
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    rays = [
        directions(np.full(n, h), (np.arange(n) + 0.5) * 360 / n)
        for h, n in zip(altitude, count, strict=True)
    ]
    return np.concatenate(rays), np.stack([first, count], 1)


def patch_index(rays: Array, bands: Array) -> Array:
    """Return the patch [n] of each direction [n, 3] above the horizon."""
    rows = len(bands)
    row = np.clip(
        (np.arcsin(np.clip(rays[:, 2], 0, 1)) / (np.pi / 2) * rows).astype(int), 0, rows - 1
    )
    azimuth = np.arctan2(rays[:, 0], rays[:, 1]) / (2 * np.pi) % 1
    first, count = bands[row].T
    return first + np.minimum((azimuth * count).astype(int), count - 1)
