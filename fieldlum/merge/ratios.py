"""Estimate the exposure ratios of one bracket from a sample of its pixels, and their agreement."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldlum.merge.estimator import Signal
from fieldlum.merge.frame_cache import FrameStore
from fieldlum.merge.frames import RawSignal
from fieldlum.photometry import PairRatio, RatioFit, fit_ratios, pair_ratio
from fieldlum.session.files.merge_report import NeighbourQuality
from fieldlum.statistics import robust_sigma

_ROWS, _COLUMNS = 96, 640  # sampled of a frame: some 100 000 pixels
_SNR_LONG = 30.0  # of a pixel in the longer frame; not measured
# Of the short frame: the brightest pixels that are numerous enough, because a black level that is
# wrong by a count affects dim ones.
_SNR_SHORT, _ENOUGH = (60.0, 15.0, 3.0), 2000
_REACH = 3  # frames of a bracket that are compared with each frame; not measured
_FREE = 0.3  # relative prior of exposures without a reference
_LEVELS = 193  # luminances at which the ratios' uncertainty is computed


@dataclass(frozen=True, slots=True)
class Sample:
    """Some pixels of one frame."""

    signal: Signal  # of the sampled pixels alone
    counts: NDArray[np.float32]
    full: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class RatioCurve:
    """Relative standard uncertainty of a merged value from the exposures, over that value.

    levels_cdm2: rising.
    """

    levels_cdm2: NDArray[np.float64]
    u_rel: NDArray[np.float64]

    def at(self, value_cdm2: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the relative uncertainty of values [n] cd/m2, by interpolation."""
        return np.interp(value_cdm2, self.levels_cdm2, self.u_rel)


def take_samples(store: FrameStore) -> list[Sample]:
    """Return the same 100 000 pixels, about, of each frame."""

    def sample(signal: Signal) -> Sample:
        small, full = signal.sampled(_ROWS, _COLUMNS)
        return Sample(small, small.strip(0, len(full))[0], full)

    return [sample(store[i]) for i in range(len(store))]


def compare(long: Sample, short: Sample, i: int, j: int) -> PairRatio | None:
    """Return the pair's exposure ratio over the assumed one; None for too few common pixels."""
    e_long, e_short = (np.broadcast_to(s.signal.per_cdm2, s.counts.shape) for s in (long, short))
    light = np.maximum(long.counts / e_long, 0.0).astype(np.float32)
    w_long, w_short = long.signal.weight(light), short.signal.weight(light)
    snr_long, snr_short = light * np.sqrt(w_long * e_long), light * np.sqrt(w_short * e_short)
    seen = (snr_long > _SNR_LONG) & ~long.full & ~short.full
    usable = (
        _brightest(seen, snr_short)
        if isinstance(long.signal, RawSignal)
        else seen & (snr_short > _SNR_SHORT[-1])
    )
    with np.errstate(divide="ignore"):
        return pair_ratio(
            long.counts.ravel(),
            short.counts.ravel(),
            usable.ravel(),
            (e_long / w_long).ravel(),
            (e_short / w_short).ravel(),
            (e_short / e_long).ravel(),
            i,
            j,
        )


def _brightest(seen: NDArray[np.bool_], snr: NDArray[np.floating]) -> NDArray[np.bool_]:
    for least in _SNR_SHORT[:-1]:
        usable = seen & (snr > least)
        if usable.sum() >= _ENOUGH:
            return usable
    return seen & (snr > _SNR_SHORT[-1])


def bracket_pairs(samples: Sequence[Sample]) -> list[PairRatio]:
    """Return all pairs up to three frames apart that see the same pixels well.

    samples: of frames sorted by exposure, longest first.
    """
    found = [
        compare(samples[i], samples[j], i, j)
        for i in range(len(samples))
        for j in range(i + 1, min(i + 1 + _REACH, len(samples)))
    ]
    return [pair for pair in found if pair is not None]


def neighbours(pairs: list[PairRatio], correction: NDArray[np.floating]) -> list[NeighbourQuality]:
    """Return how far frames next to each other in exposure disagree, after `correction`.

    correction: factors on the exposures, [frames].
    """
    delta = np.log(correction)
    return [
        NeighbourQuality(
            p.long,
            p.short,
            float(100 * (p.log_ratio - delta[p.short] + delta[p.long])),
            100 * p.u_log,
            p.pixels,
        )
        for p in pairs
        if p.short == p.long + 1
    ]


def unexplained(left: Sequence[NeighbourQuality], explained: float) -> float:
    """Return the relative u of one frame against another that is not explained yet.

    It follows from neighbours' disagreement beyond the pairs' own noise and `explained`, the
    relative u of a frame by its time and its response.
    """
    if not left:
        return 0.0
    apart = robust_sigma([n.residual_percent for n in left], 0.0) / 100
    noise = float(np.median([n.u_percent for n in left])) / 100
    return float(np.sqrt(max((apart**2 - noise**2) / 2 - explained**2, 0.0)))


def free_fit(pairs: list[PairRatio], frames: int) -> RatioFit:
    """Return the corrections by the pairs alone; their mean is 1, as is that of unseen frames.

    Neighbours that agree within 2 % may still add up to 30 % over a bracket, if the light changed
    or the response is wrong.
    """
    return fit_ratios(pairs, np.eye(frames) * _FREE**2)


def beyond(free: RatioFit, explained: float) -> float:
    """Return the relative u of a value from exposures that seem wrong.

    It is their deviation beyond `explained` (relative) and the noise of the pairs.
    """
    seen = sorted({i for p in free.pairs for i in (p.long, p.short)})
    if not seen:
        return 0.0
    centred = np.eye(len(seen)) - 1.0 / len(seen)
    noise2 = float(np.mean(np.diag(centred @ free.covariance[np.ix_(seen, seen)] @ centred)))
    return float(np.sqrt(max(np.var(np.log(free.correction[seen])) - noise2 - explained**2, 0.0)))


def ratio_curve(
    samples: Sequence[Sample], covariance: NDArray[np.floating], extra: float = 0.0
) -> RatioCurve:
    """Return the relative u of a value from uncertain exposures.

    It is s C s, with C the covariance [frames, frames] and s the frames' shares of the information
    at that level. The frames' errors are correlated (pictures contain ratios only), and a level
    depends on the few frames that see it well: a single value for the bracket would be too small
    where only an uncertain frame is readable.
    """
    small = [s.signal.sampled(1, 2)[0] for s in samples]
    largest = [float(np.max(s.largest_cdm2())) for s in small]
    levels = np.geomspace(1e-6 * min(largest), max(largest), _LEVELS)
    information = []
    for s in small:
        cell = s.strip(0, 1)[0].shape[1:]
        w = s.weight(np.broadcast_to(levels[:, None, None], (_LEVELS, *cell)).astype(np.float32))
        information.append((w * s.per_cdm2).astype(np.float64).sum(axis=(1, 2)))
    total = np.sum(information, axis=0)
    seen = total > 0
    if not seen.any():
        return RatioCurve(
            np.ones(1), np.full(1, np.hypot(np.sqrt(np.diag(covariance).max()), extra))
        )
    share = np.stack(information, axis=1)[seen] / total[seen, None]
    variance = np.einsum("li,ij,lj->l", share, covariance, share)
    return RatioCurve(levels[seen], np.sqrt(variance + extra**2))
