"""Merge frames by weighting each one with the inverse of its predicted variance.

Model of a frame: y = e L + noise, with e the counts per cd/m2 and var(y) a known function of e L.
The first pass computes sum y / sum e, which only serves to predict the signal. Later passes use the
weights e / var(predicted). Their result is unbiased and reaches the Cramer-Rao bound from far
below the noise to just below saturation (Aguerrebere et al. 2014; bench/merge_estimator.py).
Weights computed from the noisy value itself would bias dark pixels by -15 %. Negative signals are
included, because clipping them would bias dark pixels too.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats32, Mask
from fieldlum.core.records import Flag
from fieldlum.merge.linear_frames import Signal


class Rows(NamedTuple):
    """Some pixels of a frame.

    counts: counts above black, or the linear light of a JPEG; full: mask in the shape of counts,
    True at saturated pixels and next to them; None if nothing is saturated.
    """

    signal: Signal
    counts: Floats32
    full: Mask | None

    def usable(self) -> Mask:
        """Return a mask in the shape of `counts` [...], True for counts that are usable."""
        usable = self.signal.usable(self.counts)
        return usable if self.full is None else usable & ~self.full


class Merged(NamedTuple):
    """Merged pixels, in the frames' shape: raw [h / 2, 2, w], JPEG [h, w, 3].

    value_cdm2: luminance by one colour of the camera, before vignetting and colour are corrected;
    variance: variance of value_cdm2 due to noise [(cd/m2)^2]; flags: `Flag` bits.
    """

    value_cdm2: Floats32
    variance: Floats32
    flags: NDArray[np.uint8]


def merge_signals(
    frames: Sequence[Signal], shape: tuple[int, ...], *, passes: int = 2, u_ratio: float = 0.003
) -> Merged:
    """Merge frames of one `shape`, most exposed first.

    Each strip of rows goes through all passes while it is in a core's cache. passes, u_ratio:
    as for `merge_rows`.
    """
    value, variance = np.empty(shape, np.float32), np.empty(shape, np.float32)
    flags = np.empty(shape, np.uint8)
    # elements that fit in a core's cache; decides speed only
    step = max(1, (1 << 17) // int(np.prod(shape[1:])))
    for a in range(0, shape[0], step):
        b = min(a + step, shape[0])
        rows = [Rows(signal, *signal.strip(a, b)) for signal in frames]
        value[a:b], variance[a:b], flags[a:b] = merge_rows(rows, passes, u_ratio)
    return Merged(value, variance, flags)


def merge_rows(rows: Sequence[Rows], passes: int = 2, u_ratio: float = 0.003) -> Merged:
    """Merge the same pixels of some frames, most exposed first.

    passes: number of weighted passes. u_ratio: relative disagreement of frames that does not count
    as motion. Where frames disagree by more than five standard deviations beyond it, the pixel gets
    the flag MOTION and a larger variance.

    Values of dark pixels can be negative, through noise. A pixel that every frame loses to
    saturation gets a lower bound and the flag CLIPPED_HIGH. If a frame lost it only because its
    neighbour is saturated, it gets the value of the most exposed such frame, and the flag BLOOM.
    """
    mean = _predicted(rows)
    weights: list[Floats32] = []
    information = mean
    for _ in range(passes):
        predicted = np.maximum(mean, 0.0)
        weights = [_weight(row, predicted) for row in rows]
        information = _sum(weights, [row.signal.per_cdm2 for row in rows])
        mean = _quotient(_sum(weights, [row.counts for row in rows]), information)
    informed = information > 0
    variance = np.divide(1.0, information, out=np.zeros_like(information), where=informed)
    flags = np.zeros(mean.shape, np.uint8)
    if len(rows) > 1:
        _flag_motion(rows, weights, Merged(mean, variance, flags), u_ratio)
    if any(row.signal.through_nd for row in rows):
        bare = [0.0 if row.signal.through_nd else row.signal.per_cdm2 for row in rows]
        flags[informed & (_sum(weights, bare) < 0.5 * information)] |= np.uint8(Flag.ND)
    _fill_lost(rows, mean, variance, flags)
    return Merged(mean, variance, flags)


def _sum(weights: Sequence[Floats32], factors: Sequence[Floats32 | float]) -> Floats32:
    """Return the sum over frames of weights times factors."""
    total = np.zeros_like(weights[0])
    for weight, factor in zip(weights, factors, strict=True):
        total += weight * np.float32(factor)
    return total


def _quotient(total: Floats32, weight: Floats32) -> Floats32:
    """Return total over weight; infinite where there is no weight."""
    return np.divide(total, weight, out=np.full_like(weight, np.inf), where=weight > 0)


def _predicted(rows: Sequence[Rows]) -> Floats32:
    """Return sum y / sum e over usable counts, infinite where no frame is usable."""
    total, exposure = (np.zeros(rows[0].counts.shape, np.float32) for _ in range(2))
    for row in rows:
        usable = row.usable()
        np.add(total, row.counts, out=total, where=usable)
        np.add(exposure, row.signal.per_cdm2, out=exposure, where=usable)
    return _quotient(total, exposure)


def _weight(row: Rows, predicted: Floats32) -> Floats32:
    """Return the weight of a frame's counts in the mean, 0 where full; predicted: cd/m2."""
    weight = row.signal.weight(predicted)
    if row.full is not None:
        weight[row.full] = 0.0
    return weight


def _flag_motion(
    rows: Sequence[Rows], weights: Sequence[Floats32], merged: Merged, u_ratio: float
) -> None:
    """Flag pixels whose frames disagree: they make the mean at least this uncertain.

    rows: the same pixels of each frame; weights: of each frame's counts in the mean, 0 if unused;
    merged: changed in place; u_ratio: relative standard uncertainty of an exposure ratio. chi2 is
    compared with its expectation (freedom), to which errors of the ratios add.
    """
    informed = merged.variance > 0
    mean = np.where(informed, merged.value_cdm2, 0.0)
    chi2 = np.zeros_like(mean)
    for row, weight in zip(rows, weights, strict=True):
        off = row.counts - mean * row.signal.per_cdm2
        off *= off
        off *= weight
        off /= row.signal.per_cdm2
        chi2 += off
    freedom = len(rows) - 1
    tolerated = np.zeros_like(mean)
    np.divide((u_ratio * mean) ** 2 * freedom, merged.variance, out=tolerated, where=informed)
    # five standard deviations: one still pixel in two million is beyond
    moved = informed & (chi2 > 5.0**2 + (freedom + tolerated))
    merged.flags[moved] |= np.uint8(Flag.MOTION)
    merged.variance[moved] *= chi2[moved] / freedom


def _fill_lost(
    rows: Sequence[Rows], value: Floats32, variance: Floats32, flags: NDArray[np.uint8]
) -> None:
    """Fill the pixels that no frame could measure.

    They get the value of the most exposed readable frame, else a lower bound. rows: frames from the
    most to the least exposed; value [cd/m2], variance, flags: changed in place, value NaN where
    lost.
    """
    lost = ~np.isfinite(value)
    if not lost.any():
        return
    bound = np.zeros_like(value)
    for row in rows:
        signal = row.signal
        per_cdm2 = np.broadcast_to(signal.per_cdm2, value.shape)
        largest_cdm2 = np.broadcast_to(signal.max_cdm2, value.shape)
        readable, spread = signal.readable(row.counts)
        # noise of a fifth: darker frames do not fill pixels that other frames lost
        filled = lost & readable & (row.counts > 5.0 * np.sqrt(spread))
        value[filled] = (row.counts / per_cdm2)[filled]
        variance[filled] = (spread / per_cdm2**2)[filled]
        flags[filled] |= np.uint8(Flag.BLOOM)
        lost &= ~filled
        full = lost & ~readable
        bound[full] = np.maximum(bound, largest_cdm2)[full]
    value[lost], variance[lost] = bound[lost], bound[lost] ** 2
    flags[lost] |= np.uint8(Flag.CLIPPED_HIGH)
