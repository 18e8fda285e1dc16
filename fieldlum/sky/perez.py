"""Compute Perez all-weather skies and Reinhart patches, vectorised.

The sky is that of Radiance's gendaylit 2.5 (Perez, Seals, Michalsky 1993, Solar Energy 50(3)) with
perezlum.cal; luminous efficacies are those of Perez, Ineichen, Seals, Michalsky, Stewart 1990,
Solar Energy 44(5), at 2 cm of water. Axes: x east, y north, z up. Luminance is 179 times perezlum's
radiance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fieldlum.core.arrays import Array, Floats

SOLAR_CONSTANT_WM2 = 1367.0  # gendaylit's value
WATER_CM = 2.0  # precipitable water, gendaylit's default
GROUND_REFLECTANCE = 0.2  # gendaylit's default

# Upper bounds of the clearness bins of Perez 1990 and 1993.
_BINS = np.array([1.065, 1.23, 1.5, 1.95, 2.8, 4.5, 6.2])
# Limits of clearness and brightness, as gendaylit applies them.
_CLEARNESS = (1.0, 12.01)
_BRIGHTNESS = (0.01, 0.6)

# Perez 1993, table 1: for each bin of clearness a, b, c, d, e, each as (1, Z, Delta, Delta Z).
_SHAPE = np.fromstring(
    """
      1.3525  -0.2576  -0.2690  -1.4366
     -0.7670   0.0007   1.2734  -0.1233
      2.8000   0.6004   1.2375   1.0000
      1.8734   0.6297   0.9738   0.2809
      0.0356  -0.1246  -0.5718   0.9938

     -1.2219  -0.7730   1.4148   1.1016
     -0.2054   0.0367  -3.9128   0.9156
      6.9750   0.1774   6.4477  -0.1239
     -1.5798  -0.5081  -1.7812   0.1080
      0.2624   0.0672  -0.2190  -0.4285

     -1.1000  -0.2515   0.8952   0.0156
      0.2782  -0.1812  -4.5000   1.1766
     24.7219 -13.0812 -37.7000  34.8438
     -5.0000   1.5218   3.9229  -2.6204
     -0.0156   0.1597   0.4199  -0.5562

     -0.5484  -0.6654  -0.2672   0.7117
      0.7234  -0.6219  -5.6812   2.6297
     33.3389 -18.3000 -62.2500  52.0781
     -3.5000   0.0016   1.1477   0.1062
      0.4659  -0.3296  -0.0876  -0.0329

     -0.6000  -0.3566  -2.5000   2.3250
      0.2937   0.0496  -5.6812   1.8415
     21.0000  -4.7656 -21.5906   7.2492
     -3.5000  -0.1554   1.4062   0.3988
      0.0032   0.0766  -0.0656  -0.1294

     -1.0156  -0.3670   1.0078   1.4051
      0.2875  -0.5328  -3.8500   3.3750
     14.0000  -0.9999  -7.1406   7.5469
     -3.4000  -0.1078  -1.0750   1.5702
     -0.0672   0.4016   0.3017  -0.4844

     -1.0000   0.0211   0.5025  -0.5119
     -0.3000   0.1922   0.7023  -1.6317
     19.0000  -5.0000   1.2438  -1.9094
     -4.0000   0.0250   0.3844   0.2656
      1.0468  -0.3788  -2.4517   1.4656

     -1.0500   0.0289   0.4260   0.3590
     -0.3250   0.1156   0.7781   0.0025
     31.0625 -14.5000 -46.1148  55.3750
     -7.2312   0.4050  13.3500   0.6234
      1.5000  -0.6426   1.8564   0.5636
    """,
    sep=" ",
).reshape(8, 5, 4)

# Perez 1990, table 4: a, b (water), c (zenith), d (brightness) of each bin.
_DIFFUSE_EFFICACY = np.array(
    [
        [97.24, -0.46, 12.00, -8.91],
        [107.22, 1.15, 0.59, -3.95],
        [104.97, 2.96, -5.53, -8.77],
        [102.39, 5.59, -13.95, -13.90],
        [100.71, 5.94, -22.75, -23.74],
        [106.42, 3.83, -36.15, -28.83],
        [141.88, 1.90, -53.24, -14.03],
        [152.23, 0.35, -45.27, -7.98],
    ]
)
_DIRECT_EFFICACY = np.array(
    [
        [57.20, -4.55, -2.98, 117.12],
        [98.99, -3.46, -1.21, 12.38],
        [109.83, -4.90, -1.71, -8.81],
        [110.34, -5.84, -1.99, -4.56],
        [106.36, -3.97, -1.75, -6.16],
        [107.19, -1.25, -1.51, -26.73],
        [105.75, 0.77, -1.26, -34.44],
        [101.18, 1.58, -1.10, -8.29],
    ]
)


# ----------------------------------------------------------------------------------------------
# patches


@dataclass(frozen=True, slots=True)
class SkyPatches:
    """The division of the sky into patches, without the ground.

    directions [P, 3] : of the patches' middles; solid_angles_sr [P] : with the sum 2 pi.
    """

    directions: Floats
    solid_angles_sr: Floats

    def __len__(self) -> int:
        return len(self.solid_angles_sr)


def patches_per_row(mf: int = 4) -> list[int]:
    """Return the number of Reinhart patches in each row from the horizon up, then 1 for the zenith.

    mf : number of rows and columns into which each Tregenza patch is divided.
    """
    return [n * mf for n in (30, 30, 24, 24, 18, 12, 6) for _ in range(mf)] + [1]


@lru_cache(maxsize=4)
def reinhart_patches(mf: int = 4) -> SkyPatches:
    """Return Reinhart's division of the sky, 144 mf^2 + 1 patches.

    The order is that of Radiance's reinhartb.cal and rskysrc.cal: bin 0 is centred on north at the
    horizon, and azimuth increases clockwise. The ground is not a patch.
    """
    rows = patches_per_row(mf)
    height = np.pi / 2 / (7 * mf + 0.5)
    directions, solid_angles = [], []
    for row, count in enumerate(rows[:-1]):
        azimuth = np.arange(count) * 2 * np.pi / count
        altitude = (row + 0.5) * height
        directions.append(
            np.stack(
                (
                    np.sin(azimuth) * np.cos(altitude),
                    np.cos(azimuth) * np.cos(altitude),
                    np.full(count, np.sin(altitude)),
                ),
                axis=-1,
            )
        )
        band = np.sin((row + 1) * height) - np.sin(row * height)
        solid_angles.append(np.full(count, band * 2 * np.pi / count))
    directions.append(np.array([[0.0, 0.0, 1.0]]))
    solid_angles.append(np.array([2 * np.pi * (1 - np.cos(height / 2))]))
    out = SkyPatches(np.concatenate(directions), np.concatenate(solid_angles))
    out.directions.flags.writeable = out.solid_angles_sr.flags.writeable = False
    return out


def reinhart_index(directions: Array, mf: int = 4) -> NDArray[np.intp]:
    """Return the number of the patch of `reinhart_patches` that holds each direction [n, 3], [n].

    Directions below the horizon count as those at it.
    """
    rows = np.array(patches_per_row(mf))
    height = np.pi / 2 / (7 * mf + 0.5)
    altitude = np.arcsin(np.clip(directions[:, 2], 0.0, 1.0))
    row = np.minimum((altitude / height).astype(np.intp), len(rows) - 1)
    turn = np.arctan2(directions[:, 0], directions[:, 1]) / (2.0 * np.pi)
    return (np.cumsum(rows) - rows)[row] + np.rint(turn * rows[row]).astype(np.intp) % rows[row]


# ----------------------------------------------------------------------------------------------
# Perez


@dataclass(frozen=True, slots=True)
class PerezSky:
    """The skies at n times: arrays [n], and shape [n, 5] = Perez's a, b, c, d, e.

    The shape is A3 to A7 of perezlum. norm_cdm2 = 179 A1; ground_cdm2 = 179 A2 is the luminance of
    open ground with reflectance 0.2, in the sun. direct_lx is the sun's illuminance on a plane
    normal to it, diffuse_lx the sky's on the horizontal.
    """

    norm_cdm2: Floats
    ground_cdm2: Floats
    shape: Floats
    clearness: Floats
    brightness: Floats
    direct_lx: Floats
    diffuse_lx: Floats

    def __len__(self) -> int:
        return len(self.norm_cdm2)

    def __getitem__(self, index: object) -> PerezSky:
        return PerezSky(*(getattr(self, name)[index] for name in self.__dataclass_fields__))


def day_of_year(times_utc: Sequence[datetime]) -> Floats:
    """Return the day of the year, from 1, [n]."""
    return np.array([t.timetuple().tm_yday for t in times_utc], float)


def _eccentricity(day: Floats) -> Floats:
    angle = 2 * np.pi * (day - 1) / 365
    return (
        1.00011
        + 0.034221 * np.cos(angle)
        + 0.00128 * np.sin(angle)
        + 0.000719 * np.cos(2 * angle)
        + 0.000077 * np.sin(2 * angle)
    )


def _air_mass(zenith_deg: Floats) -> Floats:
    """Return the relative air mass by Kasten 1966, [n]."""
    return 1 / (np.cos(np.radians(zenith_deg)) + 0.15 * (93.885 - zenith_deg) ** -1.253)


def _clearness_brightness(
    dni: Floats, dhi: Floats, zenith_deg: Floats, day: Floats
) -> tuple[Floats, Floats]:
    """Return Perez's epsilon (clearness) and Delta (brightness), [n] each.

    Both are limited to the model's range, as in gendaylit.
    """
    cubed = 1.041 * np.radians(zenith_deg) ** 3
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        clearness = ((dhi + dni) / dhi + cubed) / (1 + cubed)
    clearness = np.where(dhi > 0, clearness, np.where(dni > 0, np.inf, 1.0))
    brightness = dhi * _air_mass(zenith_deg) / (SOLAR_CONSTANT_WM2 * _eccentricity(day))
    minimum, maximum = _CLEARNESS
    clearness = np.where(clearness > maximum, maximum - 0.001, np.maximum(clearness, minimum))
    return clearness, np.clip(brightness, *_BRIGHTNESS)


def _shape(zenith: Floats, clearness: Floats, brightness: Floats) -> Floats:
    """Return a, b, c, d, e, [n, 5]; zenith in radians."""
    brightness = np.where(
        (clearness > 1.065) & (clearness < 2.8), np.maximum(brightness, 0.2), brightness
    )
    x = _SHAPE[np.searchsorted(_BINS, clearness, side="right")]
    terms = np.stack((np.ones_like(zenith), zenith, brightness, brightness * zenith), axis=-1)
    shape = np.zeros((len(x), 5))
    for j in range(4):  # in this order, so that an hour does not depend on the other hours
        shape += x[:, :, j] * terms[:, j, None]
    overcast = clearness < _BINS[0]
    c, d = x[overcast, 2], x[overcast, 3]
    z, delta = zenith[overcast], brightness[overcast]
    shape[overcast, 2] = np.exp((delta * (c[:, 0] + c[:, 1] * z)) ** c[:, 2]) - c[:, 3]
    shape[overcast, 3] = -np.exp(delta * (d[:, 0] + d[:, 1] * z)) + d[:, 2] + delta * d[:, 3]
    # A positive b grows without limit towards the horizon. gendaylit then gives a black sky; here b
    # is set to 0.
    shape[:, 1] = np.minimum(shape[:, 1], 0.0)
    return shape


def _relative(shape: Floats, cos_zenith: Floats, gamma: Floats) -> Floats:
    """Return Perez's relative luminance; shape [..., 5] is broadcast against directions."""
    a, b, c, d, e = (shape[..., i] for i in range(5))
    return (1 + a * np.exp(b / cos_zenith)) * (1 + c * np.exp(d * gamma) + e * np.cos(gamma) ** 2)


@lru_cache(maxsize=1)
def _tregenza() -> tuple[Floats, Floats]:
    """Return zenith angle and azimuth of the points of gendaylit's integral, [145] each, in rad."""
    counts, zenith = (30, 30, 24, 24, 18, 12, 6, 1), (84, 72, 60, 48, 36, 24, 12, 0)
    theta = np.concatenate([np.full(n, z, float) for n, z in zip(counts, zenith, strict=True)])
    phi = np.concatenate([np.arange(n) * 360.0 / n for n in counts])
    return np.radians(theta), np.radians(phi)


def _relative_horizontal(shape: Floats, zenith: Floats) -> Floats:
    """Return the integral of the relative luminance times the cosine, [n], over 145 points.

    The rule is gendaylit's. Far outside Perez's data the formula is negative: over all of the sky,
    which the normalisation corrects (the integral is negative too), or over a part of it, which
    then has no light.
    """
    theta, phi = _tregenza()
    z = zenith[:, None]
    gamma = np.arccos(
        np.clip(np.cos(z) * np.cos(theta) + np.sin(z) * np.sin(theta) * np.cos(phi), -1, 1)
    )
    parts = _relative(shape[:, None, :], np.cos(theta), gamma) * np.cos(theta)
    sign = np.where(parts.sum(axis=1) < 0, -1.0, 1.0)
    lit = np.maximum(sign[:, None] * parts, 0.0).sum(axis=1)
    return sign * np.maximum(lit, 1e-6) * 2 * np.pi / 145


def _ground_over_zenith(clearness: Floats, altitude: Floats) -> Floats:
    """Return ground ambient over zenith luminance, [n] (gensky's clear and intermediate fits)."""
    x = (altitude - np.pi / 4) / (np.pi / 4)
    clear = np.polynomial.polynomial.polyval(x, (2.766521, 0.547665, -0.369832, 0.009237, 0.059229))
    between = np.polynomial.polynomial.polyval(x, (3.5556, -2.7152, -1.3081, 1.0660, 0.60227))
    zenith = np.pi / 2 - altitude
    f_clear = 0.274 * (0.91 + 10 * np.exp(-3 * zenith) + 0.45 * np.sin(altitude) ** 2)
    f_between = (2.739 + 0.9891 * np.sin(0.3119 + 2.6 * altitude)) * np.exp(
        -zenith * (0.4441 + 1.48 * altitude)
    )
    mixed = np.where(clearness >= 6, clear / f_clear, between / f_between) / np.pi
    return np.where(clearness <= 1, 0.777778, mixed)


def perez_coefficients(
    dni_wm2: ArrayLike,
    dhi_wm2: ArrayLike,
    sun_altitude_deg: ArrayLike,
    when: ArrayLike | Sequence[datetime],
) -> PerezSky:
    """Return skies from direct normal and diffuse horizontal irradiance, as gendaylit -W does.

    when : day of the year [n] or UTC times. The sun's altitude is limited to 0 to 87 degrees, as in
    gendaylit. A sky outside the model (with a positive coefficient b) is levelled towards the
    horizon; gendaylit gives a black sky. Negative irradiance counts as 0.
    """
    day = _days(when)
    dni, dhi, altitude_deg, day = (
        np.asarray(a, float)
        for a in np.broadcast_arrays(
            np.maximum(np.asarray(dni_wm2, float), 0),
            np.maximum(np.asarray(dhi_wm2, float), 0),
            np.clip(np.asarray(sun_altitude_deg, float), 0.0, 87.0),
            day,
        )
    )
    shape_in = dni.shape
    dni, dhi, altitude_deg, day = (np.atleast_1d(a).ravel() for a in (dni, dhi, altitude_deg, day))
    zenith_deg = 90.0 - altitude_deg
    zenith, altitude = np.radians(zenith_deg), np.radians(altitude_deg)
    clearness, brightness = _clearness_brightness(dni, dhi, zenith_deg, day)
    shape = _shape(zenith, clearness, brightness)
    bin_ = np.searchsorted(_BINS, clearness, side="right")
    f, g = _DIFFUSE_EFFICACY[bin_].T, _DIRECT_EFFICACY[bin_].T
    diffuse_lx = dhi * (f[0] + f[1] * WATER_CM + f[2] * np.cos(zenith) + f[3] * np.log(brightness))
    efficacy = g[0] + g[1] * WATER_CM + g[2] * np.exp(5.73 * zenith - 5) + g[3] * brightness
    direct_lx = dni * np.maximum(efficacy, 0.0)
    norm = diffuse_lx / _relative_horizontal(shape, zenith)
    zenith_cdm2 = np.maximum(norm * _relative(shape, np.ones_like(zenith), zenith), 0.0)
    ground = GROUND_REFLECTANCE * (
        zenith_cdm2 * _ground_over_zenith(clearness, altitude)
        + direct_lx * np.sin(altitude) / np.pi
    )
    parts = (norm, ground, shape, clearness, brightness, direct_lx, diffuse_lx)
    return PerezSky(*(np.asarray(p).reshape((*(shape_in or (1,)), *p.shape[1:])) for p in parts))


def _days(when: ArrayLike | Sequence[datetime]) -> Floats:
    items = np.asarray(when)
    if items.dtype == object:
        return day_of_year(list(items.ravel()))
    return items.astype(float)


# Three products, added in the order x, y, z: a BLAS library adds in another order for another
# number of rows, and files that a resumed run writes again must be equal bit by bit.
def cosines(a: Array, b: Array) -> Array:
    """Return the scalar products [n, m] of vectors a [n, 3] and b [m, 3], in their own dtype.

    For unit vectors these are the cosines of the angles between them.
    """
    out = a[:, None, 0] * b[:, 0]  # [n, m]
    out += a[:, None, 1] * b[:, 1]
    out += a[:, None, 2] * b[:, 2]
    return out


def perez_luminance(
    sky: PerezSky, sun_direction: ArrayLike, directions: ArrayLike, *, dtype: type = np.float64
) -> Floats:
    """Return the luminance of n skies in m directions, [n, m], in cd/m2, without the sun disc.

    It is 179 times perezlum, including its transition to the ground. sun_direction [n, 3] and
    directions [m, 3] are unit vectors.
    """
    sun = np.atleast_2d(np.asarray(sun_direction, dtype))
    rays = np.atleast_2d(np.asarray(directions, dtype))
    up = rays[:, 2].astype(np.float64)
    gamma = np.arccos(np.clip(cosines(sun, rays), -1.0, 1.0))  # [n, m]
    shape = sky.shape.astype(dtype)[:, None, :]
    bright = (
        _relative(shape, np.maximum(up, 0.01).astype(dtype), gamma)
        * sky.norm_cdm2.astype(dtype)[:, None]
    )
    bright = np.maximum(bright, 0.0)
    # perezlum.cal: skybright = wmean((Dz + 1.01)^10, sky, (Dz + 1.01)^-10, ground)
    share = (1.0 / (1.0 + (up + 1.01) ** -20.0)).astype(dtype)
    return bright * share + sky.ground_cdm2.astype(dtype)[:, None] * (1 - share)
