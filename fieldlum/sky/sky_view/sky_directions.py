"""Find the directions whose luminance follows the sky's, and how much of it passes.

Open sky behind glass keeps its ratio to the sky's luminance in that direction over the hours. All
else keeps its ratio to the diffuse or to the total illuminance better: a white facade can exceed
the sky, but it does not follow it. Real skies differ from Perez's model by a third, in broad
clouds; so the sky itself is the reference: directions that follow Perez's sky and are as bright as
the brightest of these show how each hour's sky differs, and correct it in the directions around.

A pixel at an edge, between slats or leaves is a sum of the sky's light and of a foreground, which
looks as the nearest opaque pixel does in the same hour.
"""

from dataclasses import dataclass

import numpy as np

from fieldlum.core.arrays import Floats, Floats32, Mask
from fieldlum.sky.daylight import Light

# Directions this close to the sun are not used: circumsolar brightness and a lens's flare are not
# modelled well there (Perez's gradation is steep within 10 degrees).
_NEAR_SUN_DEG = 10.0
BEAM_LX = 1000.0  # a weaker beam shows no disc and has no bright region around it; chosen
STRONG_BEAM_LX = 10.0 * BEAM_LX  # lights a facade more than an overcast sky does; chosen
# Spread of the logarithm of a real sky over Perez's (Perez et al. 1993: 10 to 40 % by type of sky).
_MAX_SKY_SPREAD = 0.45
# Directions of the reference have less than this spread, over their spread against other light. In
# each of six steps they have at least this share of the brightest ratio to Perez's sky: 0.5 omits
# tinted panes while the sky is not yet corrected, 0.15 admits them. Chosen.
_REFERENCE_FOLLOWS, _REFERENCE_SHARES = 0.8, (0.5, *5 * (0.15,))
MIN_CAPTURES = 6  # fewer do not separate the sky from other light; chosen
SOME = 500  # directions of the open sky that are used at most; only for speed
# Clouds are alike within this angle; farther away the sky's mean deviation counts, with this weight
# relative to one direction nearby. Chosen.
_CLOUD_DEG, _FAR_WEIGHT = 5.0, 0.3
_CHUNK_VALUES = 4_000_000  # of directions at a time, in one array: 30 MB; chosen


@dataclass(frozen=True, slots=True)
class Followed:
    """How the luminance of p directions follows the sky's over the captures; arrays [p].

    ratio: median over the captures of luminance divided by the sky's in that direction; spread:
    standard deviation of ln(luminance / sky) over that of ln(luminance / E), where E is the diffuse
    or the total illuminance, whichever the direction follows better (infinite in pixels that under
    six captures show); count: captures that show it; forward: ln of the factor by which luminance
    over diffuse light rises with the sun in front of the camera.
    """

    ratio: Floats
    spread: Floats
    count: Floats
    forward: Floats


@dataclass(frozen=True, slots=True)
class SkyReference:
    """How the real skies of n captures differ from Perez's, in m directions that show the sky.

    rays: the directions [m, 3]. log_ratio: ln of the luminance over Perez's [n, m], less each
    direction's median; NaN where not usable. brightest: transmitted share of the sky's luminance in
    the brightest directions that follow it, NaN if none does.
    """

    rays: Floats
    log_ratio: Floats
    brightest: float

    def sky(self, light: Light, rays: Floats) -> Floats32:
        """Return the sky's luminance at n captures in directions [p, 3], [n, p] cd/m2.

        light: of the captures. It is Perez's, corrected by the mean of `log_ratio` over the m
        directions, weighted by their nearness. Without such directions it is not corrected.
        """
        step = max(1, _CHUNK_VALUES // max(len(self.rays), 1))
        if len(rays) > step:
            chunks = (rays[k : k + step] for k in range(0, len(rays), step))
            return np.concatenate([self.sky(light, chunk) for chunk in chunks], axis=1)
        perez = np.maximum(light.sky_at(rays), 1e-3).astype(np.float32)
        if not len(self.rays):
            return perez
        cosine = np.clip(rays @ self.rays.T, -1.0, 1.0)  # [p, m]
        near = np.exp((cosine - 1.0) / np.radians(_CLOUD_DEG) ** 2) + _FAR_WEIGHT / len(self.rays)
        weight = (~np.isnan(self.log_ratio)).astype(float) @ near.T
        total = np.nan_to_num(self.log_ratio) @ near.T
        return perez * np.exp(total / np.maximum(weight, 1e-12)).astype(np.float32)


def sky_reference(
    luminance: Floats32, light: Light, rays: Floats, sizes_sr: Floats
) -> SkyReference:
    """Return m of p directions that show the sky, and how it differs from Perez's sky there.

    luminance [n, p] cd/m2, NaN if unusable, of n captures with the light `light` outside; rays
    [p, 3]: unit vectors, x east, y north, z up; sizes_sr [p]: solid angle of each direction. The
    first directions are bright and follow Perez's sky better than other light. Each further step
    takes those that follow the sky as the last step corrected it. Without any such direction m is
    0, and the sky is Perez's, uncorrected.
    """
    measured = usable_log(luminance, light, rays)
    reference = SkyReference(np.empty((0, 3)), np.empty((len(light), 0)), float("nan"))
    level, spread = _level_spread(measured - np.log(reference.sky(light, rays)))
    other_spread = _other_spread(measured, light)
    plausible = (spread < _MAX_SKY_SPREAD) & (spread < other_spread)
    if not plausible.any():
        return reference
    # ln of the ratio to Perez's sky behind the clearest pane; the quantile omits gross errors
    weights = sizes_sr[plausible]
    brightest = np.quantile(level[plausible], 0.98, weights=weights, method="inverted_cdf")
    follows = plausible
    for share in _REFERENCE_SHARES:
        index = np.flatnonzero(plausible & follows & (level > brightest + np.log(share)))
        index = index[:: max(1, len(index) // SOME)]
        log_ratio = measured[:, index] - np.log(light.sky_at(rays[index])) - level[index]
        reference = SkyReference(rays[index], log_ratio, float(np.exp(brightest)))
        _, spread = _level_spread(measured - np.log(reference.sky(light, rays)))
        follows = spread < _REFERENCE_FOLLOWS * other_spread
    return reference


def follow(luminance: Floats32, light: Light, rays: Floats, reference: SkyReference) -> Followed:
    """Return how the luminance of p directions follows the sky over n captures.

    luminance: cd/m2 [n, p], NaN if unusable; light: outside at the captures; rays: unit vectors, x
    east, y north, z up [p, 3]; reference: result of `sky_reference`.
    """
    step = max(1, _CHUNK_VALUES // max(len(light), 1))
    out = np.empty((4, len(rays)))
    for k in range(0, len(rays), step):
        part = slice(k, k + step)
        measured = usable_log(luminance[:, part], light, rays[part])
        level, spread = _level_spread(measured - np.log(reference.sky(light, rays[part])))
        other_spread = np.maximum(_other_spread(measured, light), 1e-3)
        count = (~np.isnan(measured)).sum(axis=0)
        spread = np.where(count < min(MIN_CAPTURES, len(light)), np.inf, spread / other_spread)
        out[:, part] = np.exp(level), spread, count, _forward(measured, light, rays[part])
    return Followed(*out)


def sky_share(luminance: Floats32, sky: Floats32, front: Floats32) -> tuple[Floats, Floats]:
    """Return the share of the sky in p mixed pixels and its standard uncertainty, [p] each.

    luminance, sky, front: of the pixel, of the sky behind the pane, of the foreground, cd/m2 [n,
    p]; NaN is ignored. It is the least-squares solution, with equal relative errors, of
    luminance - front = share (sky - front) over the n captures.
    """
    scale = np.maximum(sky, front)
    x = np.nan_to_num((sky - front) / scale)
    y = (luminance - front) / scale
    usable = np.isfinite(y)
    x, y = np.where(usable, x, 0.0), np.where(usable, y, 0.0)
    size = np.maximum((x**2).sum(axis=0), 1e-9)
    share = (x * y).sum(axis=0) / size
    residual = np.where(usable, y - share * x, 0.0)
    variance = (residual**2).sum(axis=0) / np.maximum(usable.sum(axis=0) - 1, 1) / size
    # the foreground may be half brighter or darker than the nearest opaque pixel
    other = 0.5 * np.abs((x * np.where(usable, front / scale, 0.0)).sum(axis=0)) / size
    share = np.clip(share, 0.0, 1.0)
    return share, np.sqrt(variance + (other * (1.0 - share)) ** 2)


def usable_log(luminance: Floats32, light: Light, rays: Floats) -> Floats32:
    """Return ln of luminance, at least 0.01 cd/m2, [n, p]; NaN near a shining sun.

    luminance [n, p] cd/m2; light: outside at the n captures; rays: directions of the p pixels, x
    east, y north, z up [p, 3]. Shining: over 1 000 lx of direct light.
    """
    return np.log(np.maximum(away_from_sun(luminance, light, rays), np.float32(0.01)))


def away_from_sun(luminance: Floats32, light: Light, rays: Floats) -> Floats32:
    """Return luminance [n, p] with NaN within 10 degrees of a shining sun.

    There are the disc, and brightness that no model has. Shining: over 1 000 lx of direct light.
    light: outside at the n captures; rays: directions of the pixels, x east, y north, z up [p, 3].
    """
    near = light.apparent_sun_direction @ rays.T > np.cos(np.radians(_NEAR_SUN_DEG))
    near &= (light.direct_lx > BEAM_LX)[:, None]
    return np.where(near, np.float32(np.nan), luminance)


def dark_shares(luminance: Floats32, light: Light, rays: Floats, shade: float) -> Floats:
    """Return the share of the sky in view that is darker than usual in each capture, [n].

    luminance [n, p] cd/m2, NaN if unusable; light: outside at the n captures; rays [p, 3]: unit
    vectors, x east, y north, z up. A direction is dark if its luminance over the usual one is below
    `shade`, relative to Perez's sky and also to the diffuse light: Perez's sky is too bright near
    the sun. The usual is that of the most alike 40 % of the captures, so that a blind that is down
    in up to 60 % of them changes neither it nor the choice of directions.
    """
    measured = usable_log(luminance, light, rays)
    by_diffuse, by_total = (measured - np.log(lx)[:, None] for lx in _other_lx(light))
    by_sky = measured - np.log(np.maximum(light.sky_at(rays), 1e-3))
    usual, spread = _most_alike(by_diffuse)
    usual_sky, sky_spread = _most_alike(by_sky)
    other_spread = np.minimum(spread, _most_alike(by_total)[1])
    sky = sky_spread < np.minimum(_REFERENCE_FOLLOWS * other_spread, _MAX_SKY_SPREAD)  # [p]
    log_shade = np.maximum(by_diffuse - usual, by_sky - usual_sky)[:, sky]
    return (log_shade < np.log(shade)).sum(axis=1) / max(log_shade.shape[1], 1)


def _most_alike(values: Floats | Floats32) -> tuple[Floats, Floats]:
    """Return median and standard deviation of the closest 40 % of n values [n, p], [p] each."""
    ordered, many = np.sort(values, axis=0), round(0.4 * len(values))
    width = np.nan_to_num(ordered[many:] - ordered[: len(ordered) - many], nan=np.inf)
    first = np.argmin(width, axis=0)[None]
    middle = np.take_along_axis(ordered, first + many // 2, axis=0)[0]
    # the middle 40 % of a normal distribution are 1.05 standard deviations wide
    return middle, np.take_along_axis(width, first, axis=0)[0] / 1.05


def _other_spread(measured: Floats32, light: Light) -> Floats:
    """Return the spread of ln(luminance / E), [p]; E: the better of diffuse and total illuminance.

    measured: ln of luminance in p directions [n, p]; light: outside at the n captures.
    """
    spreads = [_level_spread(measured - np.log(lx)[:, None])[1] for lx in _other_lx(light)]
    return np.minimum(*spreads)


def _other_lx(light: Light) -> tuple[Floats, Floats]:
    """Return the diffuse and the total illuminance on the horizontal, [n] each."""
    upwards = np.maximum(light.sun_direction[:, 2], 0.0)
    return light.diffuse_lx, light.diffuse_lx + light.direct_lx * upwards


def _forward(measured: Floats32, light: Light, rays: Floats) -> Floats:
    """Return ln of the factor by which p directions are brighter with the sun behind them, [p].

    The luminance is relative to the diffuse light. measured: ln of luminance [n, p]; light: outside
    at the n captures; rays [p, 3].
    """
    by_diffuse = measured - np.log(light.diffuse_lx)[:, None]
    in_front = sun_in_front(light, rays)
    with_sun, _ = _level_spread(np.where(in_front, by_diffuse, np.nan))
    without_sun, _ = _level_spread(np.where(in_front, np.nan, by_diffuse))
    return with_sun - without_sun


def sun_in_front(light: Light, rays: Floats) -> Mask:
    """Return whether the sun shines strongly from about the azimuth of directions, [n, p].

    light: at n times; rays: unit vectors, x east, y north, z up [p, 3]. Strongly: over 10 000 lx of
    direct light. About: within 72 degrees of a low sun; a high one counts only nearer, as it shines
    on a vertical facade at a grazing angle.
    """
    azimuths = rays[:, :2] / np.maximum(np.hypot(rays[:, 0], rays[:, 1]), 1e-9)[:, None]  # [p, 2]
    in_front = light.sun_direction[:, :2] @ azimuths.T > 0.3
    return in_front & (light.direct_lx > STRONG_BEAM_LX)[:, None]


def _level_spread(values: Floats | Floats32) -> tuple[Floats, Floats]:
    """Return median and robust standard deviation of n values [n, p] without NaN, [p] each.

    The latter is half the range from the 16th to the 84th percentile.
    """
    ordered = np.sort(values, axis=0)
    last = np.maximum((~np.isnan(values)).sum(axis=0) - 1, 0)

    def quantile(share: float) -> Floats:
        """Return the value below which `share` of each column's finite values are, [p]."""
        return np.take_along_axis(ordered, np.round(share * last).astype(int)[None], axis=0)[0]

    return quantile(0.5), 0.5 * (quantile(0.84) - quantile(0.16))
