"""Estimate the sky of each capture from its windows.

Perez's model gives one smooth sky for each irradiance. A real sky has clouds, which every capture
shows through its windows. The ratio of the two skies is treated as a log-normal field that is
smooth in direction: window pixels determine it in their directions, and away from them it returns
to Perez's sky. The diffuse illuminance remains as measured. A predicted year has no windows to look
at and uses Perez's sky.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from fieldlum.core.arrays import Array, Floats32, Indices
from fieldlum.learn.transport.arrays import MIN_CDM2, TrainingArrays
from fieldlum.sky.light import Features
from fieldlum.sky.perez import reinhart_patches

# Values to be tried: sd of ln luminance, chord over which the field changes, sd of a patch's mean.
# They range from a nearly clear sky to broken clouds; the likelihood chooses. Chosen.
SDS = (0.1, 0.2, 0.3, 0.45, 0.7)
WIDTHS = (0.1, 0.2, 0.35, 0.6, 1.0)
NOISES = (0.01, 0.03, 0.06, 0.12, 0.25)
# of a window pixel's luminance: with more direct sun the pixel does not show the sky; chosen
LIT_SHARE = 0.02
# cd/m2: a darker sky cannot be separated from the room's reflection in the glass; chosen
MIN_SKY_CDM2 = 5.0
MIN_CHANGE = 0.05  # least rms of ln luminance that is worth a test: half of the least sd; chosen
# least number of captures that show a sky patch, so that its median is its usual share; chosen
MIN_HOURS = 5
MAX_HOURS = 48  # number of captures from which the likelihood chooses; chosen, limits the time
MAX_PATCHES = 80  # most sky patches that are used; chosen, limits the time


@dataclass(frozen=True, slots=True)
class SkyField:
    """Statistics of a real sky's luminance over Perez's: log-normal, smooth in direction.

    sd: standard deviation of the ln of the ratio; width: distance on the unit sphere over which the
    ratio changes; noise: standard deviation of the measured ln ratio of one sky patch.
    """

    sd: float
    width: float
    noise: float

    def covariance(self, a: Array, b: Array) -> Array:
        """Return the covariance of the true ln ratio between unit vectors a [m, 3] and b [k, 3].

        The result is [m, k], without measurement noise.
        """
        return self.sd**2 * np.exp((a @ b.T - 1.0) / self.width**2)

    def measured_covariance(self, directions: Array) -> Array:
        """Return the covariance of the measured ln ratio at k unit vectors [k, 3], [k, k].

        It is `covariance` plus the variance of the noise on the diagonal.
        """
        own = self.covariance(directions, directions)
        return own + self.noise**2 * np.eye(len(directions))


@dataclass(frozen=True, slots=True)
class SeenSky:
    """The skies of n captures, estimated from what their windows show.

    luminance_cdm2: of the Reinhart sky patches [n, 2305]; field: the statistics used.
    """

    luminance_cdm2: Floats32
    field: SkyField

    def features(self, arrays: TrainingArrays) -> Features:
        """Return the features of `arrays`, with these skies instead of Perez's."""
        root = np.sqrt(reinhart_patches().solid_angles_sr).astype(np.float32)
        unit = arrays.light.total_lx.astype(np.float32)[:, None]
        return replace(arrays.features, sky=self.luminance_cdm2 * root / unit)


def seen_sky(arrays: TrainingArrays) -> SeenSky | None:
    """Return the sky of each capture, estimated from its window pixels.

    Return None without window pixels, or if the skies differ from Perez's by under 5 % (rms) or by
    no more than noise explains. A window pixel's median ratio to Perez's sky over the captures
    counts as the transmittance of the glass, so that only differences between captures matter.
    The diffuse illuminance of each capture does not change.
    """
    ratios, directions = _patch_ratios(arrays)  # [n, k], [k, 3]
    finite = ratios[np.isfinite(ratios)]
    if not len(finite) or float(np.sqrt((finite**2).mean())) < MIN_CHANGE:
        return None
    field = _likeliest(ratios, directions)
    if field is None:
        return None
    patches = reinhart_patches()
    factor = np.exp(_interpolated(field, ratios, directions, patches.directions))  # [n, 2305]
    perez = arrays.light.sky_cdm2
    horizontal = patches.solid_angles_sr * patches.directions[:, 2]  # [2305] sr
    sky = perez * factor
    kept = (perez @ horizontal) / np.maximum(sky @ horizontal, MIN_CDM2)  # [n]
    return SeenSky((sky * kept[:, None]).astype(np.float32), field)


def _patch_ratios(arrays: TrainingArrays) -> tuple[Array, Array]:
    """Return ln of seen over usual luminance of k sky patches, and the patches' directions.

    They are [n, k] and [k, 3], for the patches that windows show; NaN if a capture does not show a
    patch.
    """
    window = arrays.open_sky.index
    perez = arrays.sky[:, window]  # [n, w]
    captured = np.maximum(arrays.luminance[:, window], MIN_CDM2)
    valid = ~arrays.filled[:, window] & (perez > MIN_SKY_CDM2)
    if arrays.patch is not None:
        valid &= arrays.patch[:, window] < LIT_SHARE * captured
    # omit hours with a blind, or with a lamp that the glass reflects
    if arrays.light.states is not None:
        valid &= np.array([not state for state in arrays.light.states])[:, None]
    often = np.flatnonzero(valid.sum(axis=0) >= MIN_HOURS)
    valid, captured, perez = valid[:, often], captured[:, often], perez[:, often]
    ratios = np.where(valid, np.log(captured / np.maximum(perez, MIN_CDM2)), np.nan)
    ratios = ratios - np.nanmedian(ratios, axis=0)  # [n, w]
    everywhere = reinhart_patches().directions
    nearest = np.argmax(arrays.open_sky.directions[often] @ everywhere.T, axis=1)  # [w]
    names, member = np.unique(nearest, return_inverse=True)
    counts, sums = np.zeros((2, len(ratios), len(names)))
    for k in range(len(names)):
        counts[:, k] = valid[:, member == k].sum(axis=1)
        sums[:, k] = np.nansum(ratios[:, member == k], axis=1)
    means = np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
    some = _spread(len(names), MAX_PATCHES)
    return means[:, some], everywhere[names[some]]


def _spread(count: int, most: int) -> Indices:
    """Return at most `most` of `count` indices, evenly spread."""
    return np.unique(np.linspace(0, max(count - 1, 0), min(count, most)).astype(np.intp))


def _likeliest(ratios: Array, directions: Array) -> SkyField | None:
    """Return the most likely field for the ratios; None if noise alone is as likely."""
    with_ratio = np.flatnonzero(np.isfinite(ratios).any(axis=1))
    hours = ratios[with_ratio[_spread(len(with_ratio), MAX_HOURS)]]
    values = hours[np.isfinite(hours)]
    flat = max(-0.5 * float(((values / n) ** 2 + 2.0 * np.log(n)).sum()) for n in NOISES)
    fields = [SkyField(*settings) for settings in product(SDS, WIDTHS, NOISES)]
    groups = [(s, r, hours[np.ix_(r, s)].T) for s, r in _by_patches_seen(hours)]
    likelihoods = [_log_likelihood(field, groups, directions) for field in fields]
    best = int(np.argmax(likelihoods))
    return fields[best] if likelihoods[best] > flat else None


def _log_likelihood(
    field: SkyField,
    groups: Sequence[tuple[Indices, Indices, Array]],
    directions: Array,
) -> float:
    """Return the log likelihood of ratios without its constant.

    groups: results of `_by_patches_seen`, each with its ratios [k, n]; directions: of all patches.
    """
    covariance, total = field.measured_covariance(directions), 0.0
    for seen, rows, ratios in groups:
        lower = np.linalg.cholesky(covariance[np.ix_(seen, seen)])
        white = np.linalg.solve(lower, ratios)
        total -= 0.5 * float((white**2).sum())
        total -= len(rows) * float(np.log(np.diagonal(lower)).sum())
    return total


def _interpolated(field: SkyField, ratios: Array, directions: Array, asked: Array) -> Array:
    """Return the expected ln of the field in directions `asked` [m, 3], [n, m]."""
    out = np.zeros((len(ratios), len(asked)))
    covariance, cross = field.measured_covariance(directions), field.covariance(directions, asked)
    for patches, rows in _by_patches_seen(ratios):
        weights = np.linalg.solve(covariance[np.ix_(patches, patches)], cross[patches])  # [k, m]
        out[rows] = ratios[np.ix_(rows, patches)] @ weights
    return out


def _by_patches_seen(ratios: Array) -> list[tuple[Indices, Indices]]:
    """Group captures that show the same patches: return indices of patches and rows of captures."""
    masks, group = np.unique(np.isfinite(ratios), axis=0, return_inverse=True)
    groups = [
        (np.flatnonzero(mask), np.flatnonzero(group.ravel() == k)) for k, mask in enumerate(masks)
    ]
    return [(patches, rows) for patches, rows in groups if len(patches)]
