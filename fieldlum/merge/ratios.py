"""The exposure ratios of one bracket, from a sample of its pixels, and how well neighbouring frames agree."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldlum.merge.estimator import Signal
from fieldlum.merge.frames import FrameStore
from fieldlum.photometry import PairRatio, RatioFit, fit_ratios, pair_ratio

_ROWS, _COLUMNS = 96, 640  # sampled of a frame: some 100 000 pixels
_SNR_LONG, _SNR_SHORT = 30.0, 3.0
_REACH = 3  # frames of a bracket that are compared with each frame


@dataclass(frozen=True, slots=True)
class Neighbours:
    """Disagreement of two frames next to each other in exposure, after all corrections. [%]"""

    long: int
    short: int
    residual_percent: float
    u_percent: float
    pixels: int


@dataclass(frozen=True, slots=True)
class _Sample:
    signal: Signal  # of the sampled pixels alone
    counts: NDArray[np.float32]
    full: NDArray[np.bool_]


def _sample(signal: Signal) -> _Sample:
    small, full = signal.sampled(_ROWS, _COLUMNS)
    return _Sample(small, small.strip(0, len(full))[0], full)


def compare(long: _Sample, short: _Sample, i: int, j: int) -> PairRatio | None:
    """The pair's exposure ratio over the assumed one; None where too few pixels are good in both."""
    e_long, e_short = (np.broadcast_to(s.signal.per_cdm2, s.counts.shape) for s in (long, short))
    light = np.maximum(long.counts / e_long, 0.0).astype(np.float32)
    w_long, w_short = long.signal.weight(light), short.signal.weight(light)
    snr_long, snr_short = light * np.sqrt(w_long * e_long), light * np.sqrt(w_short * e_short)
    usable = (snr_long > _SNR_LONG) & (snr_short > _SNR_SHORT) & ~long.full & ~short.full
    with np.errstate(divide="ignore"):
        return pair_ratio(
            long.counts.ravel(), short.counts.ravel(), usable.ravel(), (e_long / w_long).ravel(),
            (e_short / w_short).ravel(), (e_short / e_long).ravel(), i, j,
        )  # fmt: skip


def bracket_pairs(store: FrameStore) -> list[PairRatio]:
    """All pairs up to three frames apart that see the same pixels well; frames sorted by exposure, longest first."""
    samples = [_sample(store[i]) for i in range(len(store))]
    found = [
        compare(samples[i], samples[j], i, j)
        for i in range(len(samples))
        for j in range(i + 1, min(i + 1 + _REACH, len(samples)))
    ]
    return [pair for pair in found if pair is not None]


def fit_bracket(pairs: list[PairRatio], u_prior: Sequence[float]) -> RatioFit:
    return fit_ratios(len(u_prior), pairs, np.asarray(u_prior))


def neighbours(pairs: list[PairRatio], correction: NDArray[np.floating]) -> list[Neighbours]:
    """What is left between frames next to each other once `correction` is applied."""
    delta = np.log(correction)
    return [
        Neighbours(
            p.long, p.short, float(100 * (p.log_ratio - delta[p.short] + delta[p.long])), 100 * p.u_log, p.pixels
        )
        for p in pairs
        if p.short == p.long + 1
    ]
