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

from fieldlum.core.arrays import Floats32, Mask, UInts8
from fieldlum.core.progress import progress
from fieldlum.core.records import Flag
from fieldlum.merge.linear_frames import Signal


class FramePixels(NamedTuple):
    """Some pixels of one frame, at the same places as those of the other frames.

    signal: the frame; counts: counts above black, or the linear light of a JPEG [...]; full: mask
    in the shape of counts, True at saturated pixels and next to them; None if nothing is saturated.
    """

    signal: Signal
    counts: Floats32
    full: Mask | None

    def usable(self) -> Mask:
        """Return a mask [...] of counts in the frame's range, not next to saturated ones."""
        usable = self.signal.usable(self.counts)
        return usable if self.full is None else usable & ~self.full

    def weight(self, predicted_cdm2: Floats32) -> Floats32:
        """Return the weight of the counts in the mean of all frames [...], 0 where saturated.

        predicted_cdm2: luminance by all frames [...], from which a count's variance follows.
        """
        weight = self.signal.weight(predicted_cdm2)
        if self.full is not None:
            weight[self.full] = 0.0
        return weight


class Merged(NamedTuple):
    """Merged pixels, in the frames' shape: raw [h / 2, 2, w], JPEG [h, w, 3].

    value_cdm2: luminance by one colour of the camera, before vignetting and colour are corrected;
    variance: variance of value_cdm2 due to noise [(cd/m2)^2]; flags: `Flag` bits. h, w: rows and
    columns of the sensor's part that was read.
    """

    value_cdm2: Floats32
    variance: Floats32
    flags: UInts8


def merge_signals(
    frames: Sequence[Signal], shape: tuple[int, ...], *, u_ratio: float = 0.003
) -> Merged:
    """Return the merged pixels of frames that all have one `shape`, most exposed first.

    u_ratio: relative disagreement of frames that does not count as motion. The frames are merged in
    strips of rows, each of which goes through all passes while it is in a core's cache.
    """
    value, variance = np.empty(shape, np.float32), np.empty(shape, np.float32)
    flags = np.empty(shape, np.uint8)
    # elements that fit in a core's cache; decides speed only
    step = max(1, (1 << 17) // int(np.prod(shape[1:])))
    for first in range(0, shape[0], step):
        progress(first, shape[0], "merging rows")
        rows = slice(first, min(first + step, shape[0]))
        strips = [FramePixels(signal, *signal.strip(rows.start, rows.stop)) for signal in frames]
        value[rows], variance[rows], flags[rows] = merge_pixels(strips, u_ratio)
    return Merged(value, variance, flags)


def merge_pixels(frames: Sequence[FramePixels], u_ratio: float) -> Merged:
    """Return the merged values of the same pixels of some frames, most exposed first.

    u_ratio: relative disagreement of frames that does not count as motion. Where frames disagree
    by more than five standard deviations beyond it, the pixel gets the flag MOTION and a larger
    variance.

    Values of dark pixels can be negative, through noise. A pixel that every frame loses to
    saturation gets a lower bound and the flag CLIPPED_HIGH. If a frame lost it only because its
    neighbour is saturated, it gets the value of the most exposed such frame, and the flag BLOOM.
    """
    mean = _unweighted_mean(frames)
    weights: list[Floats32] = []
    information = mean  # inverse variance of the mean, from the first weighted pass on
    for _ in range(2):  # weights by the unweighted mean, then by their own mean
        predicted_cdm2 = np.maximum(mean, 0.0)
        weights = [frame.weight(predicted_cdm2) for frame in frames]
        information = _sum(weights, [frame.signal.per_cdm2 for frame in frames])
        mean = _quotient(_sum(weights, [frame.counts for frame in frames]), information)
    informed = information > 0
    variance = np.divide(1.0, information, out=np.zeros_like(information), where=informed)
    merged = Merged(mean, variance, np.zeros(mean.shape, np.uint8))
    if len(frames) > 1:
        _flag_motion(frames, weights, merged, u_ratio)
    if any(frame.signal.through_nd for frame in frames):
        bare = [0.0 if frame.signal.through_nd else frame.signal.per_cdm2 for frame in frames]
        mostly_filtered = _sum(weights, bare) < 0.5 * information
        merged.flags[informed & mostly_filtered] |= np.uint8(Flag.ND)
    _fill_lost(frames, merged)
    return merged


def _sum(weights: Sequence[Floats32], factors: Sequence[Floats32 | float]) -> Floats32:
    """Return the sum over frames of weights times factors."""
    total = np.zeros_like(weights[0])
    for weight, factor in zip(weights, factors, strict=True):
        total += weight * np.float32(factor)
    return total


def _quotient(total: Floats32, weight: Floats32) -> Floats32:
    """Return total over weight; infinite where there is no weight."""
    return np.divide(total, weight, out=np.full_like(weight, np.inf), where=weight > 0)


def _unweighted_mean(frames: Sequence[FramePixels]) -> Floats32:
    """Return the sum of usable counts over the sum of their counts per cd/m2, in cd/m2.

    It is infinite where no frame is usable.
    """
    total, exposure = (np.zeros(frames[0].counts.shape, np.float32) for _ in range(2))
    for frame in frames:
        usable = frame.usable()
        np.add(total, frame.counts, out=total, where=usable)
        np.add(exposure, frame.signal.per_cdm2, out=exposure, where=usable)
    return _quotient(total, exposure)


def _flag_motion(
    frames: Sequence[FramePixels], weights: Sequence[Floats32], merged: Merged, u_ratio: float
) -> None:
    """Flag the pixels at which frames disagree, and increase their variance, in place.

    frames: the same pixels of each; weights: of each frame's counts in the mean, 0 if unused;
    merged: the mean of these frames; u_ratio: relative standard uncertainty of an exposure ratio.
    chi2, the weighted sum of squared residuals, is compared with its expectation: the number of
    frames less one, to which errors of the ratios add.
    """
    informed = merged.variance > 0
    mean = np.where(informed, merged.value_cdm2, 0.0)
    chi2 = np.zeros_like(mean)
    for frame, weight in zip(frames, weights, strict=True):
        term = frame.counts - mean * frame.signal.per_cdm2  # squared in place
        term *= term
        term *= weight
        term /= frame.signal.per_cdm2
        chi2 += term
    freedom = len(frames) - 1
    tolerated = np.zeros_like(mean)
    np.divide((u_ratio * mean) ** 2 * freedom, merged.variance, out=tolerated, where=informed)
    # five standard deviations: one still pixel in two million is beyond
    moved = informed & (chi2 > 5.0**2 + (freedom + tolerated))
    merged.flags[moved] |= np.uint8(Flag.MOTION)
    merged.variance[moved] *= chi2[moved] / freedom


def _fill_lost(frames: Sequence[FramePixels], merged: Merged) -> None:
    """Fill the pixels that no frame could measure, in place.

    They get the value of the most exposed readable frame, else a lower bound: the largest luminance
    that any of the frames can read. frames: most exposed first; merged: values that are not finite
    where lost.
    """
    value, variance, flags = merged
    lost = ~np.isfinite(value)
    if not lost.any():
        return
    bound = np.zeros_like(value)
    for frame in frames:
        signal = frame.signal
        per_cdm2 = np.broadcast_to(signal.per_cdm2, value.shape)
        largest_cdm2 = np.broadcast_to(signal.max_cdm2, value.shape)
        readable, count_variance = signal.readable(frame.counts)
        # noise of a fifth: darker frames do not fill pixels that other frames lost
        filled = lost & readable & (frame.counts > 5.0 * np.sqrt(count_variance))
        value[filled] = (frame.counts / per_cdm2)[filled]
        variance[filled] = (count_variance / per_cdm2**2)[filled]
        flags[filled] |= np.uint8(Flag.BLOOM)
        lost &= ~filled
        full = lost & ~readable
        bound[full] = np.maximum(bound, largest_cdm2)[full]
    value[lost], variance[lost] = bound[lost], bound[lost] ** 2
    flags[lost] |= np.uint8(Flag.CLIPPED_HIGH)
