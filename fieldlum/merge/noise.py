"""Estimate how much the noise of raw frames exceeds the profile's, from neighbouring frames.

A profile's gain and read noise are often those of another body. If they give too little noise,
noise is mistaken for motion and u is too small. Two frames of one scene differ by their noise: the
part that grows with the signal gives the gain, the constant part gives the read noise (photon
transfer; Janesick, SPIE 2007). The fit is robust against motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.statistics import robust_sigma
from fieldlum.merge.frames import RawSignal
from fieldlum.merge.ratios import Sample
from fieldlum.optics.photometry import PairRatio

_STEPS = 12  # levels of the signal at which a pair is evaluated; chosen
# least number of pixels in a step, and most pixels of a pair; chosen
_IN_A_STEP, _MOST = 200, 12_000
_ROUNDED_DN2 = 1 / 12  # variance of rounding to integers, a uniform distribution (GUM 4.3.7)
# Smaller factors on a variance (1.2 on the noise) are not reliably different from the profile's.
# Chosen.
_TOLD = 1.44
# The factor must also exceed 1 by this many standard errors, because read noise is uncertain where
# shot noise dominates. Chosen.
_SURE_SIGMA = 3.0


@dataclass(frozen=True, slots=True)
class SeenNoise:
    """Factors on the variances of shot noise and read noise that the profile gives.

    shot, read: measured variance over the profile's; 1 unless the frames clearly show more noise.
    """

    shot: float = 1.0
    read: float = 1.0

    @property
    def larger(self) -> float:
        """The square root of the larger factor: a factor on the noise's standard deviation."""
        return float(np.sqrt(max(self.shot, self.read)))


def seen_noise(
    samples: Sequence[Sample], pairs: Sequence[PairRatio], correction: Floats
) -> SeenNoise:
    """Return factors on the variances of the profile's shot and read noise, from raw frames.

    samples: one for each frame, most exposed first; pairs: measured exposure ratios, of which only
    those of neighbours are used. correction: fitted over assumed exposure, [frames]. Both factors
    are 1 if too few pixels can be compared.
    """
    rows = []
    for pair in pairs:
        if pair.short == pair.long + 1:
            ratio = float(np.exp(np.log(correction[pair.short]) - np.log(correction[pair.long])))
            for shot, read, measured in _steps(samples[pair.long], samples[pair.short], ratio):
                # divide by the measured variance, so that all steps have equal weight
                rows.append((shot / measured, read / measured))
    if len(rows) < 4:
        return SeenNoise()
    table = np.array(rows)
    shot, read = _factors(table)
    residuals = table @ (shot, read) - 1.0
    u_shot, u_read = np.sqrt(np.diag(np.linalg.pinv(table.T @ table)) * np.mean(residuals**2))
    sure = shot > max(_TOLD, 1 + _SURE_SIGMA * u_shot), read > max(_TOLD, 1 + _SURE_SIGMA * u_read)
    return SeenNoise(shot if sure[0] else 1.0, read if sure[1] else 1.0)


def _factors(rows: Floats) -> tuple[float, float]:
    """Return the least-squares solution of rows @ (shot, read) = 1, without negative values."""
    alone = rows.sum(axis=0) / np.maximum((rows**2).sum(axis=0), 1e-30)
    shot, read = np.linalg.lstsq(rows, np.ones(len(rows)), rcond=None)[0]
    if shot < 0:
        return 0.0, float(alone[1])
    return (float(alone[0]), 0.0) if read < 0 else (float(shot), float(read))


def _steps(long: Sample, short: Sample, correction: float) -> list[tuple[float, float, float]]:
    """Return variances of the difference of two frames [DN2], one row for each step of the signal.

    A row has the shot variance and the read variance by the profile, and the measured variance.
    """
    a, b = long.signal, short.signal
    if not (isinstance(a, RawSignal) and isinstance(b, RawSignal)):
        return []
    shape = long.counts.shape
    good = a.usable(long.counts) & b.usable(short.counts) & ~long.full & ~short.full
    at = np.flatnonzero(good)
    at = at[:: max(1, len(at) // _MOST)]
    y_long, y_short = long.counts.ravel()[at], short.counts.ravel()[at]
    ratio = correction * np.broadcast_to(b.per_cdm2 / a.per_cdm2, shape).ravel()[at]
    order = np.argsort(y_long)
    # Where noise is about one count, a median of integers would jump between counts: spread the
    # counts evenly over their width first.
    dither = np.random.default_rng(0).uniform(-0.5, 0.5, len(at))
    steps = []
    for step in np.array_split(order, int(np.clip(len(order) // _IN_A_STEP, 1, _STEPS))):
        if len(step) < _IN_A_STEP:
            continue
        r = ratio[step]
        light = np.maximum(y_long[step], 0.0)
        off = y_short[step] - r * y_long[step] + dither[step]
        spread = robust_sigma(off)
        shot = float(np.median(r * light / b.gain_e_per_dn + r**2 * light / a.gain_e_per_dn))
        read = float(np.median(b.noise_dn2 + r**2 * a.noise_dn2))
        steps.append((shot, read, max(spread**2 - _ROUNDED_DN2, _ROUNDED_DN2)))
    return steps
