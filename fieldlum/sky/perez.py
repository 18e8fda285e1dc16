"""Compute Perez all-weather skies at many times, and the Reinhart patches of the sky.

The sky is that of Radiance's gendaylit 2.5 (Perez, Seals, Michalsky 1993, Solar Energy 50(3)) with
perezlum.cal; luminous efficacies are those of Perez, Ineichen, Seals, Michalsky, Stewart 1990,
Solar Energy 44(5), at 2 cm of water. Axes: x east, y north, z up. Luminance is 179 times perezlum's
radiance.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from fieldlum.core.arrays import Array, ArrayLike, Floats, Indices

SOLAR_CONSTANT_WM2 = 1367.0  # gendaylit's value
WATER_CM = 2.0  # precipitable water, gendaylit's default
GROUND_REFLECTANCE = 0.2  # gendaylit's default

# Upper bounds of the clearness bins of Perez 1990 and 1993.
_BINS = np.array([1.065, 1.23, 1.5, 1.95, 2.8, 4.5, 6.2])
# Limits of clearness and brightness, as gendaylit applies them.
_CLEARNESS = (1.0, 12.01)
_BRIGHTNESS = (0.01, 0.6)

# Coefficients of both papers by bin: the shape a to e of 1993 [8, 5, 4], the diffuse and direct
# luminous efficacies of 1990 [8, 4] each.
_TABLES = np.loadtxt(Path(__file__).with_name("perez.txt"))
_SHAPE = _TABLES[:40].reshape(8, 5, 4)
_DIFFUSE_EFFICACY, _DIRECT_EFFICACY = _TABLES[40:].reshape(2, 8, 4)


# ----------------------------------------------------------------------------------------------
# patches


@dataclass(frozen=True, slots=True)
class SkyPatches:
    """The division of the sky into P patches, without the ground.

    directions [P, 3]: unit vectors to the patches' middles, x east, y north, z up; solid_angles_sr
    [P]: with the sum 2 pi.
    """

    directions: Floats
    solid_angles_sr: Floats

    def __len__(self) -> int:
        """Return the number of patches."""
        return len(self.solid_angles_sr)


def patches_per_row(mf: int) -> list[int]:
    """Return the number of Reinhart patches in each row from the horizon up, then 1 for the zenith.

    mf: number of rows and columns into which each Tregenza patch is divided.
    """
    return [n * mf for n in (30, 30, 24, 24, 18, 12, 6) for _ in range(mf)] + [1]


@lru_cache(maxsize=4)
def reinhart_patches(mf: int = 4) -> SkyPatches:
    """Return Reinhart's division of the sky, 144 mf^2 + 1 patches.

    mf: number of rows and columns into which each Tregenza patch is divided. The order is that of
    Radiance's reinhartb.cal and rskysrc.cal: patch 0 is centred on north at the horizon, azimuth
    increases clockwise, and rows follow upwards. The ground is not a patch. The arrays are
    read-only, because results are cached.
    """
    counts = np.array(patches_per_row(mf))
    height = np.pi / 2 / (7 * mf + 0.5)  # rad; the zenith's patch has half a row
    row = np.repeat(np.arange(len(counts)), counts)  # of each patch
    azimuth = (np.arange(len(row)) - (np.cumsum(counts) - counts)[row]) * 2 * np.pi / counts[row]
    altitude = np.minimum((row + 0.5) * height, np.pi / 2)
    east, north = np.sin(azimuth) * np.cos(altitude), np.cos(azimuth) * np.cos(altitude)
    band = np.diff(np.sin(np.minimum(np.arange(len(counts) + 1) * height, np.pi / 2)))
    directions = np.stack((east, north, np.sin(altitude)), axis=-1)
    out = SkyPatches(directions, (band * 2 * np.pi / counts)[row])
    out.directions.flags.writeable = out.solid_angles_sr.flags.writeable = False
    return out


def reinhart_index(directions: Array) -> Indices:
    """Return the index of the patch of `reinhart_patches()` that contains each direction, [n].

    directions: unit vectors [n, 3], x east, y north, z up; those below the horizon count as on it.
    """
    counts = np.array(patches_per_row(4))
    height = np.pi / 2 / (len(counts) - 0.5)
    altitude = np.arcsin(np.clip(directions[:, 2], 0.0, 1.0))
    row = np.minimum((altitude / height).astype(np.intp), len(counts) - 1)
    turns = np.arctan2(directions[:, 0], directions[:, 1]) / (2.0 * np.pi)
    column = np.rint(turns * counts[row]).astype(np.intp) % counts[row]
    return (np.cumsum(counts) - counts)[row] + column


# ----------------------------------------------------------------------------------------------
# Perez


@dataclass(frozen=True, slots=True)
class PerezSky:
    """The skies at n times: arrays [n], and shape [n, 5].

    norm_cdm2: factor on Perez's relative luminance, 179 times perezlum's A1; ground_cdm2: luminance
    of open ground with reflectance 0.2, in the sun, 179 times perezlum's A2; shape: Perez's
    coefficients a, b, c, d, e, perezlum's A3 to A7; clearness: Perez's epsilon. direct_lx: the
    sun's illuminance on a plane normal to it; diffuse_lx: the sky's on the horizontal.
    """

    norm_cdm2: Floats
    ground_cdm2: Floats
    shape: Floats
    clearness: Floats
    direct_lx: Floats
    diffuse_lx: Floats

    def __getitem__(self, index: object) -> PerezSky:
        """Return the skies that an index array, a boolean array or a slice selects."""
        return PerezSky(**{n: getattr(self, n)[index] for n in self.__dataclass_fields__})


def _clearness_brightness(
    dni: Floats, dhi: Floats, zenith_deg: Floats, day: Floats
) -> tuple[Floats, Floats]:
    """Return Perez's epsilon (clearness) and Delta (brightness), [n] each.

    dni, dhi: irradiance [n] W/m2; zenith_deg: of the sun [n]; day: of the year [n]. Both are
    limited to the model's range, as in gendaylit.
    """
    from pvlib.atmosphere import get_relative_airmass
    from pvlib.irradiance import get_extra_radiation

    cubed = 1.041 * np.radians(zenith_deg) ** 3
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        clearness = ((dhi + dni) / dhi + cubed) / (1 + cubed)
    clearness = np.where(dhi > 0, clearness, np.where(dni > 0, np.inf, 1.0))
    extraterrestrial = np.asarray(get_extra_radiation(day, SOLAR_CONSTANT_WM2, "spencer"))
    brightness = dhi * get_relative_airmass(zenith_deg, "kasten1966") / extraterrestrial
    minimum, maximum = _CLEARNESS
    clearness = np.where(clearness > maximum, maximum - 0.001, np.maximum(clearness, minimum))
    return clearness, np.clip(brightness, *_BRIGHTNESS)


def _shape(zenith: Floats, clearness: Floats, brightness: Floats) -> Floats:
    """Return the coefficients a, b, c, d, e of Perez's relative luminance, [n, 5].

    zenith: angle of the sun from the zenith in n hours [n] rad; clearness, brightness: by
    `_clearness_brightness` [n]. Each coefficient is x1 + x2 zenith + brightness (x3 + x4 zenith),
    with x1 to x4 looked up by clearness; in the overcast bin c and d have formulas of their own
    (Perez, Seals and Michalsky 1993).
    """
    is_between = (clearness > 1.065) & (clearness < 2.8)
    brightness = np.where(is_between, np.maximum(brightness, 0.2), brightness)
    x = _SHAPE[np.searchsorted(_BINS, clearness, side="right")]  # [n, 5, 4]
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
    """Return Perez's luminance relative to `norm_cdm2`; arguments are broadcast.

    shape: coefficients [..., 5]; cos_zenith: of the angle from the zenith [...]; gamma: angle from
    the sun, rad [...].
    """
    a, b, c, d, e = (shape[..., i] for i in range(5))
    return (1 + a * np.exp(b / cos_zenith)) * (1 + c * np.exp(d * gamma) + e * np.cos(gamma) ** 2)


def _relative_horizontal(shape: Floats, zenith: Floats) -> Floats:
    """Return the horizontal illuminance that Perez's relative luminance gives, [n].

    It is the sum over 145 points, as in gendaylit. Far outside Perez's data the formula is
    negative: over all of the sky, which the normalisation corrects (this sum is negative too), or
    over a part of it, which then has no light. shape: by `_shape` [n, 5]; zenith: angle of the sun
    from the zenith [n] rad.
    """
    rays = reinhart_patches(1).directions  # Tregenza's
    sun = np.stack((np.zeros_like(zenith), np.sin(zenith), np.cos(zenith)), axis=-1)
    gamma = np.arccos(np.clip(cosines(sun, rays), -1, 1))
    parts = _relative(shape[:, None, :], rays[:, 2], gamma) * rays[:, 2]
    sign = np.where(parts.sum(axis=1) < 0, -1.0, 1.0)
    lit = np.maximum(sign[:, None] * parts, 0.0).sum(axis=1)
    return sign * np.maximum(lit, 1e-6) * 2 * np.pi / 145


def _ground_over_zenith(clearness: Floats, altitude: Floats) -> Floats:
    """Return the luminance of shaded white ground over that of the zenith, [n].

    clearness: Perez's epsilon [n]; altitude: of the sun [n] rad. The polynomials and formulas are
    gensky's for clear and intermediate skies; f_clear, f_between: their luminance at the zenith.
    """
    x = (altitude - np.pi / 4) / (np.pi / 4)  # -1 at the horizon, 1 at the zenith
    clear = np.polynomial.polynomial.polyval(x, (2.766521, 0.547665, -0.369832, 0.009237, 0.059229))
    between = np.polynomial.polynomial.polyval(x, (3.5556, -2.7152, -1.3081, 1.0660, 0.60227))
    zenith = np.pi / 2 - altitude
    f_clear = 0.274 * (0.91 + 10 * np.exp(-3 * zenith) + 0.45 * np.sin(altitude) ** 2)
    rise, fall = 2.739 + 0.9891 * np.sin(0.3119 + 2.6 * altitude), 0.4441 + 1.48 * altitude
    f_between = rise * np.exp(-zenith * fall)
    mixed = np.where(clearness >= 6, clear / f_clear, between / f_between) / np.pi
    return np.where(clearness <= 1, 0.777778, mixed)


def perez_coefficients(
    dni_wm2: ArrayLike, dhi_wm2: ArrayLike, sun_altitude_deg: ArrayLike, day_of_year: ArrayLike
) -> PerezSky:
    """Return skies from direct normal and diffuse horizontal irradiance, as gendaylit -W does.

    dni_wm2, dhi_wm2, sun_altitude_deg (true, without refraction), day_of_year (from 1): [n] or one
    value for all. The sun's altitude is limited to 0 to 87 degrees, as in gendaylit. A sky outside
    the model (with a positive coefficient b) is levelled towards the horizon; gendaylit gives a
    black sky. Negative irradiance counts as 0. Source: Perez, Seals and Michalsky 1993.
    """
    arguments = (dni_wm2, dhi_wm2, sun_altitude_deg, day_of_year)
    parts = np.broadcast_arrays(*map(np.atleast_1d, arguments))
    dni, dhi, altitude_deg, day = (np.asarray(part, float) for part in parts)
    dni, dhi, altitude_deg = np.maximum(dni, 0), np.maximum(dhi, 0), np.clip(altitude_deg, 0, 87)
    zenith_deg = 90.0 - altitude_deg
    zenith, altitude = np.radians(zenith_deg), np.radians(altitude_deg)
    clearness, brightness = _clearness_brightness(dni, dhi, zenith_deg, day)
    shape = _shape(zenith, clearness, brightness)
    bin_ = np.searchsorted(_BINS, clearness, side="right")
    # luminous efficacies in lm/W (Perez et al. 1990): a + b W + c f(zenith) + d g(brightness)
    a, b, c, d = _DIFFUSE_EFFICACY[bin_].T
    diffuse_lx = dhi * (a + b * WATER_CM + c * np.cos(zenith) + d * np.log(brightness))
    a, b, c, d = _DIRECT_EFFICACY[bin_].T
    efficacy = a + b * WATER_CM + c * np.exp(5.73 * zenith - 5) + d * brightness
    direct_lx = dni * np.maximum(efficacy, 0.0)
    norm = diffuse_lx / _relative_horizontal(shape, zenith)
    zenith_cdm2 = np.maximum(norm * _relative(shape, np.ones_like(zenith), zenith), 0.0)
    of_sky = zenith_cdm2 * _ground_over_zenith(clearness, altitude)
    ground = GROUND_REFLECTANCE * (of_sky + direct_lx * np.sin(altitude) / np.pi)
    return PerezSky(norm, ground, shape, clearness, direct_lx, diffuse_lx)


def cosines(a: Array, b: Array) -> Array:
    """Return the scalar products [n, m] of vectors a [n, 3] and b [m, 3], in their own dtype.

    For unit vectors these are the cosines of the angles between them. The products are always added
    in the order x, y, z. A BLAS library adds in another order for another number of rows, but files
    that a resumed run writes again must be equal bit by bit.
    """
    out = a[:, None, 0] * b[:, 0]  # [n, m]
    out += a[:, None, 1] * b[:, 1]
    out += a[:, None, 2] * b[:, 2]
    return out


def perez_luminance(
    sky: PerezSky, sun_direction: ArrayLike, directions: ArrayLike, *, dtype: type = np.float64
) -> Floats:
    """Return the luminance of n skies in m directions, [n, m], in cd/m2, without the sun disc.

    It is 179 times Radiance's perezlum. Below the horizon it is that of open ground, after a smooth
    transition. sun_direction [n, 3], to the true sun (without refraction), and directions [m, 3]
    are unit vectors, x east, y north, z up. dtype: of the arithmetic and the result.
    """
    sun = np.atleast_2d(np.asarray(sun_direction, dtype))
    rays = np.atleast_2d(np.asarray(directions, dtype))
    up = rays[:, 2].astype(np.float64)
    gamma = np.arccos(np.clip(cosines(sun, rays), -1.0, 1.0))  # [n, m]
    shape = sky.shape.astype(dtype)[:, None, :]
    relative = _relative(shape, np.maximum(up, 0.01).astype(dtype), gamma)
    bright = np.maximum(relative * sky.norm_cdm2.astype(dtype)[:, None], 0.0)
    # perezlum.cal: skybright = wmean((Dz + 1.01)^10, sky, (Dz + 1.01)^-10, ground)
    share = (1.0 / (1.0 + (up + 1.01) ** -20.0)).astype(dtype)
    return bright * share + sky.ground_cdm2.astype(dtype)[:, None] * (1 - share)
