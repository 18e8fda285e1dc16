"""Separate, for each direction, the sky's light from the light of what is in front of the sky.

Luminance in a direction is a sum of known courses over the hours, each times a factor that is not
negative: the sky's luminance in that direction (open sky through glass), the diffuse illuminance
(surfaces in the shade), and the beam on surfaces of five orientations (facades, ground, leaves and
fabric lit from behind). The factor of the sky's luminance is openness times transmittance. A white
facade can be brighter than the sky, but it does not follow the sky's luminance in its direction.

Real skies differ from Perez's model by a third, in broad clouds. So the sky itself is the
reference: directions that follow Perez's sky better than all other light are found first, and their
common deviation from Perez in each hour corrects the sky of the directions around them.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from fieldlum.core.arrays import Floats, Floats32, Mask
from fieldlum.sky.light import Light

# Real skies against Perez's model in one direction (Perez et al. 1993 report 10 to 40 % by type of
# sky), and against the sky seen in nearby directions in the same hour (clouds are broad; measured
# in the rooms of docs/sky-view.md).
PEREZ_SD, SEEN_SKY_SD = 0.3, 0.1
# Directions this close to the sun are not used: circumsolar brightness and a lens's flare are not
# modelled well there (Perez's gradation is steep within 10 degrees).
NEAR_SUN_DEG = 10.0
_SUN_LX = 1000.0  # a weaker beam has no circumsolar region that exceeds the sky; chosen
_COLUMNS = 7
_STEPS = 4  # of reweighting; more change factors by less than 1 % of the sky's; measured
_SWEEPS = 60  # of coordinate descent; chosen
# At most this many directions that show the sky are used as its reference; only for speed.
_SKY_DIRECTIONS = 500
# Clouds are alike within this angle; farther away the sky's mean deviation counts, with this weight
# relative to one direction nearby. Chosen.
_CLOUD_DEG, _FAR_WEIGHT = 5.0, 0.3
_CHUNK_VALUES = 2_000_000  # captures times directions at a time: 60 MB; chosen
_DARK_CDM2 = 1.0  # errors of darker pixels are noise, not a share of their luminance; chosen


@dataclass(frozen=True, slots=True)
class SkyFactor:
    """What follows the sky in p directions.

    through [p]: openness times transmittance; u [p]: its standard uncertainty, with real skies;
    count [p]: captures behind it. behind [p]: share of the light in sunny hours that shines through
    from behind, as in leaves and fabric. ratio, least_ratio [p]: median and tenth percentile of
    luminance over that of the sky.
    """

    through: Floats
    u: Floats
    count: Floats
    behind: Floats
    ratio: Floats
    least_ratio: Floats


def sky_factor(
    luminance_cdm2: Floats32, usable: Mask, light: Light, rays: Floats, seen: SkyReference
) -> SkyFactor:
    """Fit the factor of the sky in p directions `rays` [p, 3] to n captures.

    luminance_cdm2, usable: [n, p]; values that are not usable (not seen, clipped) are ignored.
    """
    step = max(1, _CHUNK_VALUES // max(len(light), 1))
    parts = []
    for k in range(0, len(rays), step):
        some = slice(k, k + step)
        parts.append(_fit(luminance_cdm2[:, some], usable[:, some], light, rays[some], seen)[0])
    return SkyFactor(*(np.concatenate([getattr(part, name) for part in parts]) for name in _NAMES))


_NAMES = tuple(field.name for field in fields(SkyFactor))


@dataclass(frozen=True, slots=True)
class SkyReference:
    """The sky in m directions that show it: logarithm of its luminance over Perez's, [n, m].

    rays [m, 3]. It is NaN where not usable; each direction's median is 0.
    """

    rays: Floats
    log_ratio: Floats

    def over_perez(self, rays: Floats) -> Floats32:
        """Return the sky's luminance over Perez's in directions [p, 3], [n, p]."""
        if not len(self.rays):
            return np.ones((len(self.log_ratio), len(rays)), np.float32)
        cosine = np.clip(rays @ self.rays.T, -1.0, 1.0)  # [p, m]
        near = np.exp((cosine - 1.0) / np.radians(_CLOUD_DEG) ** 2) + _FAR_WEIGHT / len(self.rays)
        valid = ~np.isnan(self.log_ratio)
        total = np.nan_to_num(self.log_ratio) @ near.T
        weight = valid.astype(float) @ near.T
        return np.exp(total / np.maximum(weight, 1e-12)).astype(np.float32)


def seen_sky(luminance: Floats32, usable: Mask, light: Light, rays: Floats) -> SkyReference:
    """Return the directions of `rays` [p, 3] that follow the sky better than all other light.

    luminance, usable: as of `sky_factor`.
    """
    none = SkyReference(np.empty((0, 3)), np.empty((len(light), 0)))
    first, _ = _fit(luminance, usable, light, rays, none)
    _, rest = _fit(luminance, usable, light, rays, none, with_sky=False)
    usable = usable & ~_near_sun(light, rays)
    ratio = np.log(np.maximum(luminance, 1e-3) / np.maximum(light.sky_at(rays), 1e-3))
    ratio = np.where(usable, ratio, np.nan)
    off = ratio - _nan_quantile(ratio, 0.5)
    own_spread = _nan_quantile(np.abs(off), 0.5)
    rest_spread = _nan_quantile(np.abs(np.where(usable, rest, np.nan)), 0.5)
    sky = (own_spread < rest_spread) & (first.through > 3.0 * first.u)
    index = np.flatnonzero(sky)
    if not len(index):
        return none
    index = index[:: max(1, len(index) // _SKY_DIRECTIONS)]
    return SkyReference(rays[index], off[:, index])


def _fit(
    luminance: Floats32,
    usable: Mask,
    light: Light,
    rays: Floats,
    seen: SkyReference,
    *,
    with_sky: bool = True,
) -> tuple[SkyFactor, Floats]:
    """Return the factors of p directions, and residuals: logarithm of measured over fitted."""
    measured = np.where(usable, luminance, 0.0).astype(np.float32)
    courses = _courses(light, rays)  # [q, n, p]
    ratio = np.where(usable, measured / np.maximum(courses[0], 1e-3), np.nan)
    courses[0] *= seen.over_perez(rays) if with_sky else 0.0
    sd = SEEN_SKY_SD if len(seen.rays) else PEREZ_SD
    usable = usable & ~_near_sun(light, rays)
    factors = np.zeros((_COLUMNS, len(rays)), np.float32)
    model = measured
    weights = usable / _sigma(measured, measured, sd) ** 2
    gram = np.zeros((len(rays), _COLUMNS, _COLUMNS), np.float32)
    by_ray = np.ascontiguousarray(np.moveaxis(courses, 2, 0))  # [p, q, n]
    for _ in range(_STEPS):
        weighted = by_ray * weights.T[:, None]
        gram = weighted @ np.swapaxes(by_ray, 1, 2)
        target = (weighted @ measured.T[:, :, None])[..., 0]
        factors = _non_negative(gram, target, factors)
        model = np.einsum("anp,ap->np", courses, factors)
        sigma = _sigma(model, measured, sd)
        # Cauchy weights: a person at the window or a cloud's edge counts little
        weights = usable / sigma**2 / (1.0 + ((measured - model) / (2.0 * sigma)) ** 2)
    count = usable.sum(axis=0)
    misfit = (weights * (measured - model) ** 2).sum(axis=0) / np.maximum(count - _COLUMNS, 1)
    u = np.sqrt(_first_variance(gram) * np.maximum(misfit, 1.0))
    sunny = usable & (light.direct_lx > _SUN_LX)[:, None]
    lit = np.where(sunny, measured, 0.0).sum(axis=0)
    behind = factors[5] * np.where(sunny, courses[5], 0.0).sum(axis=0) / np.maximum(lit, 1e-3)
    factor = SkyFactor(
        np.where(count > 0, factors[0], np.nan).astype(float),
        np.where(count > 0, u, np.nan),
        count.astype(float),
        np.where(count > 0, behind, np.nan),
        _nan_quantile(ratio, 0.5),
        _nan_quantile(ratio, 0.1),
    )
    return factor, np.log(np.maximum(measured, 1e-2) / np.maximum(model, 1e-2))


def _courses(light: Light, rays: Floats) -> Floats32:
    """Return the course of each kind of light over the hours, in cd/m2, [q, n, p].

    0: the sky's luminance; 1: a white surface in the shade; 2 to 6: a white surface in the sun that
    faces the camera, turned to the right, to the left, away (lit from behind), and upwards.
    """
    sky = np.asarray(light.sky_at(rays), np.float32)
    level = np.zeros_like(rays)
    level[:, :2] = rays[:, :2] / np.maximum(np.hypot(rays[:, 0], rays[:, 1]), 1e-9)[:, None]
    right = np.stack([level[:, 1], -level[:, 0], np.zeros(len(rays))], axis=-1)
    half, most = 0.5, np.sqrt(0.75)  # cosine and sine of 60 degrees
    up = np.broadcast_to((0.0, 0.0, 1.0), rays.shape)
    facing = (-level, most * right - half * level, -most * right - half * level, level, up)
    suns, white = light.shown_sun_direction, light.direct_lx[:, None] / np.pi
    lit = [white * np.maximum(suns @ normal.T, 0.0) for normal in facing]
    shade = np.broadcast_to(light.diffuse_lx[:, None] / np.pi, sky.shape)
    return np.stack([sky, shade, *lit]).astype(np.float32)


def _near_sun(light: Light, rays: Floats) -> Mask:
    near = light.shown_sun_direction @ rays.T > np.cos(np.radians(NEAR_SUN_DEG))
    return near & (light.direct_lx > _SUN_LX)[:, None]


def _sigma(model: Floats32, measured: Floats32, sd: float) -> Floats32:
    """Return the standard error of each value, [n, p]: the share `sd` of its luminance."""
    return np.float32(sd) * np.maximum(np.maximum(model, 0.5 * measured), _DARK_CDM2)


def _non_negative(gram: Floats, target: Floats, start: Floats32) -> Floats32:
    """Return the non-negative least squares of normal equations, by coordinate descent, [q, p].

    gram [p, q, q]; target [p, q]; start [q, p].
    """
    x = start.copy()
    rows = np.moveaxis(gram, 0, 2)  # [q, q, p]
    for _ in range(_SWEEPS):
        for j in range(len(x)):
            own = np.maximum(rows[j, j], 1e-12)
            gain = target[:, j] - np.einsum("bp,bp->p", rows[j], x) + rows[j, j] * x[j]
            x[j] = np.maximum(gain / own, 0.0)
    return x


def _first_variance(gram: Floats) -> Floats:
    """Return the variance of the sky's factor, with all other factors free, [p].

    If the sky's course is a sum of the others (overcast hours only), it is large.
    """
    size = np.maximum(np.sqrt(np.einsum("paa->pa", gram).astype(float)), 1e-12)
    scaled = gram / (size[:, :, None] * size[:, None, :])
    # A factor without light in any hour has no row; the ridge keeps such matrices invertible.
    scaled = scaled + 1e-6 * np.eye(len(scaled[0]))
    return np.linalg.inv(scaled)[:, 0, 0] / size[:, 0] ** 2


def _nan_quantile(values: Floats, share: float) -> Floats:
    """Return a quantile of each column without its NaN, [p]; NaN for an empty column."""
    ordered = np.sort(values, axis=0)
    count = (~np.isnan(values)).sum(axis=0)
    place = (np.maximum(count - 1, 0) * share).astype(int)
    return np.take_along_axis(ordered, place[None], axis=0)[0]
