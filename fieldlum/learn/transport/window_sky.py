"""Estimate the sky of each capture from its windows.

Perez's model gives one smooth sky for each irradiance. A real sky has clouds, which every capture
shows through its windows. The ratio of the two skies is treated as a log-normal field that is
smooth in direction: window pixels determine it in their directions, and away from them it returns
to Perez's sky. The diffuse illuminance remains as measured. A predicted year has no windows to look
at and uses Perez's sky.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fieldlum.core.arrays import Array, Floats32
from fieldlum.learn.transport.arrays import MIN_CDM2, TrainingArrays
from fieldlum.sky.light import Features
from fieldlum.sky.perez import reinhart_patches

# Chord over which clouds change the ratio, and noise over the field's standard deviation. The
# likeliest values of each room (0.1 to 1.0, 0.01 to 0.25) change no error by over 0.3 %.
WIDTH, NOISE_SHARE = 0.4, 0.05
# of a window pixel's luminance: with more direct sun the pixel does not show the sky; chosen
LIT_SHARE = 0.02
# cd/m2: a darker sky cannot be separated from the room's reflection in the glass; chosen
MIN_SKY_CDM2 = 5.0
MIN_CHANGE = 0.05  # least rms of ln luminance that is worth a test: under that of any cloud
MIN_HOURS = 5  # captures that show a sky patch, so that its median is its usual share
MAX_PATCHES = 80  # that are used, to limit the time


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

    Return None without window pixels, or if the skies differ from Perez's by under 5 % (rms). A
    window pixel's median ratio to Perez's sky over the captures counts as the transmittance of the
    glass, so that only differences between captures matter. The diffuse illuminance of each capture
    does not change.
    """
    ratios, directions = _patch_ratios(arrays)  # [n, k], [k, 3]
    finite = ratios[np.isfinite(ratios)]
    sd = float(np.sqrt((finite**2).mean())) if len(finite) else 0.0
    if sd < MIN_CHANGE:
        return None
    field = SkyField(sd, WIDTH, NOISE_SHARE * sd)
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
    one = np.eye(len(names))[member]  # [w, k]
    counts, sums = valid @ one, np.where(valid, ratios, 0.0) @ one
    means = np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
    some = np.unique(np.linspace(0, len(names) - 1, min(len(names), MAX_PATCHES)).astype(int))
    return means[:, some], everywhere[names[some]]


def _interpolated(field: SkyField, ratios: Array, directions: Array, asked: Array) -> Array:
    """Return the expected ln of the field in directions `asked` [m, 3], [n, m].

    A patch that a capture does not show has a variance without limit there.
    """
    known = np.isfinite(ratios)  # [n, k]
    covariance = np.repeat(field.measured_covariance(directions)[None], len(ratios), axis=0)
    patches = np.arange(len(directions))
    covariance[:, patches, patches] += np.where(known, 0.0, 1e6)
    weights = np.linalg.solve(covariance, np.where(known, ratios, 0.0)[:, :, None])[:, :, 0]
    return weights @ field.covariance(directions, asked)
