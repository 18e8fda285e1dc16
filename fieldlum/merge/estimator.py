"""Merge frames by weighting each one with the inverse of its predicted variance.

Model of a frame: y = e L + noise, with e the counts per cd/m2 and var(y) a known function of e L.
The first pass computes sum y / sum e, which only serves to predict the signal. Later passes use the
weights e / var(predicted). Their result is unbiased and reaches the Cramer-Rao bound from far
below the noise to just below saturation (Aguerrebere et al. 2014; bench/merge_estimator.py).
Weights computed from the noisy value itself would bias dark pixels by -15 %. Negative signals are
included, because clipping them would bias dark pixels too.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats32, Mask
from fieldlum.core.records import Flag, Progress, quiet

# a frame with a lower ratio does not fill pixels that other frames lost; not measured
_READABLE_SNR = 5.0
_STRIP = 1 << 17  # elements processed at a time, so that they fit in a core's cache; chosen

Strip = Floats32


class Signal(Protocol):
    """One linear, black-subtracted frame [rows, ...], which is read in strips along its first axis.

    "Counts" are raw counts above black, or for a JPEG frame its linear light. Luminances are in
    cd/m2. A strip's masks and arrays have the shape [last - first, ...].
    """

    @property
    def per_cdm2(self) -> Floats32:
        """Return counts per cd/m2, in a shape that broadcasts to the frame's."""
        ...

    @property
    def through_nd(self) -> bool:
        """Return whether a neutral-density filter was in front of the lens."""
        ...

    def strip(self, first: int, last: int) -> tuple[Strip, Mask | None]:
        """Return the counts above black of rows first to last - 1, and a mask of the same shape.

        The mask is True at saturated pixels and next to them. It is None if nothing is saturated.
        """
        ...

    def weight(self, predicted_cdm2: Strip) -> Strip:
        """Return per_cdm2 over the variance that the counts of a luminance have.

        predicted_cdm2: the luminance of each pixel. The weight is 0 where the frame would be close
        to saturation, or darker than it measures.
        """
        ...

    def usable(self, counts: Strip) -> Mask:
        """Return a mask, True for counts in the reliable range, which may predict a luminance."""
        ...

    def readable(self, counts: Strip) -> tuple[Mask, Strip]:
        """Return a mask, True for counts that are not saturated, and the variance of all counts."""
        ...

    def max_cdm2(self) -> Floats32:
        """Return the largest luminance that this frame can measure before it saturates [cd/m2].

        One value for the frame or each of its colours, in a shape that broadcasts to the frame's.
        """
        ...

    def sampled(self, rows: int, columns: int) -> tuple["Signal", Mask]:
        """Return a smaller signal of evenly spread pixels, and a mask in its shape.

        rows, columns: about how long the signal's first axis and its axis of sensor columns become.
        The mask is True for pixels at or next to saturation.
        """
        ...


@dataclass(frozen=True, slots=True)
class Merged:
    """Merged pixels, in the frames' shape: raw [h / 2, 2, w], JPEG [h, w, 3].

    value_cdm2: luminance by one colour of the camera, before vignetting and colour are corrected;
    variance: variance of value_cdm2 due to noise [(cd/m2)^2]; flags: `Flag` bits.
    """

    value_cdm2: Floats32
    variance: Floats32
    flags: NDArray[np.uint8]


def _strips(shape: tuple[int, ...]) -> Iterator[tuple[int, int]]:
    step = max(1, _STRIP // int(np.prod(shape[1:])))
    for first in range(0, shape[0], step):
        yield first, min(first + step, shape[0])


def _predict(
    frames: Sequence[Callable[[], Signal]], shape: tuple[int, ...], tick: Callable[[], None]
) -> tuple[Strip, bool]:
    """Return sum y / sum e over usable counts, and whether a frame was taken through a filter.

    The quotient is at least 0, and infinite where no frame is usable.
    """
    total, exposure = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    through_nd = False
    for load in frames:
        signal = load()
        through_nd |= signal.through_nd
        for a, b in _strips(shape):
            counts, full = signal.strip(a, b)
            ok = signal.usable(counts)
            if full is not None:
                ok &= ~full
            np.add(total[a:b], counts, out=total[a:b], where=ok)
            np.add(
                exposure[a:b],
                np.broadcast_to(signal.per_cdm2, counts.shape),
                out=exposure[a:b],
                where=ok,
            )
        tick()
    for a, b in _strips(shape):
        exposed = exposure[a:b] > 0
        np.divide(total[a:b], exposure[a:b], out=total[a:b], where=exposed)
        np.maximum(total[a:b], 0.0, out=total[a:b])
        total[a:b][~exposed] = np.inf
    return total, through_nd


@dataclass(slots=True)
class _Sums:
    """Sums over the frames at each pixel, from which the merge computes value and variance.

    value: sum of w y; information: of w e; chi2: of (y - predicted)^2 / var; unfiltered: of w e
    over the frames without a filter.
    """

    value: Strip
    information: Strip
    chi2: Strip | None
    unfiltered: Strip | None


def _weigh(
    frames: Sequence[Callable[[], Signal]],
    predicted: Strip,
    chi2: bool,
    nd: bool,
    tick: Callable[[], None],
) -> _Sums:
    shape = predicted.shape
    sums = _Sums(
        np.zeros(shape, np.float32),
        np.zeros(shape, np.float32),
        np.zeros(shape, np.float32) if chi2 else None,
        np.zeros(shape, np.float32) if nd else None,
    )
    for load in frames:
        signal = load()
        for a, b in _strips(shape):
            counts, full = signal.strip(a, b)
            guess = predicted[a:b]
            w = signal.weight(guess)
            if full is not None:
                w[full] = 0.0
            if sums.chi2 is not None:
                off = counts - np.where(np.isfinite(guess), guess, 0.0) * signal.per_cdm2
                off *= off
                off *= w
                off /= signal.per_cdm2
                sums.chi2[a:b] += off
            sums.value[a:b] += counts * w
            w *= signal.per_cdm2
            sums.information[a:b] += w
            if sums.unfiltered is not None and not signal.through_nd:
                sums.unfiltered[a:b] += w
        tick()
    return sums


def merge_signals(
    frames: Sequence[Callable[[], Signal]],
    shape: tuple[int, ...],
    *,
    passes: int = 2,
    u_ratio: float = 0.003,
    motion_sigma: float = 5.0,
    resident: bool = False,
    progress: Progress = quiet,
) -> Merged:
    """Merge frames of one `shape`.

    frames: functions that load one frame each, most exposed first. Without `resident` each function
    is called in every pass. With it, all frames are in memory, and each strip goes through all
    passes while it is in a core's cache, with the same result. passes: number of weighted passes.
    u_ratio: relative disagreement of frames that does not count as motion. motion_sigma: where
    frames disagree by more than this number of standard deviations beyond u_ratio, the pixel gets
    the flag MOTION and a larger variance.

    Values of dark pixels can be negative, through noise. A pixel that every frame loses to
    saturation gets a lower bound and the flag CLIPPED_HIGH. If a frame lost it only because its
    neighbour is saturated, it gets the value of the most exposed such frame, and the flag BLOOM.
    """
    if resident:
        return _merge_by_strips(frames, shape, passes, u_ratio, motion_sigma, progress)
    steps, total = count(1), len(frames) * (passes + 1)

    def tick() -> None:
        progress(next(steps), total, "frames")

    value, nd = _predict(frames, shape, tick)
    variance, flags = np.zeros(shape, np.float32), np.zeros(shape, np.uint8)
    for number in range(passes):
        last = number == passes - 1
        sums = _weigh(frames, value, last and len(frames) > 1, last and nd, tick)
        for a, b in _strips(shape):
            _settle(
                sums, value, variance, flags, slice(a, b), len(frames), u_ratio, motion_sigma, last
            )
    _fill_lost(frames, value, variance, flags)
    return Merged(value, variance, flags)


class _Rows:
    """A strip of rows of a frame; the frame is read only once."""

    def __init__(self, whole: Signal, first: int, last: int) -> None:
        self._whole, self._strip = whole, whole.strip(first, last)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._whole, name)

    def strip(self, first: int, last: int) -> tuple[Strip, Mask | None]:
        counts, full = self._strip
        return counts[first:last], None if full is None else full[first:last]


def _merge_by_strips(
    frames: Sequence[Callable[[], Signal]],
    shape: tuple[int, ...],
    passes: int,
    u_ratio: float,
    motion_sigma: float,
    progress: Progress,
) -> Merged:
    signals, strips = [load() for load in frames], list(_strips(shape))
    value, variance = np.empty(shape, np.float32), np.empty(shape, np.float32)
    flags = np.empty(shape, np.uint8)
    for number, (a, b) in enumerate(strips, start=1):
        rows: list[Any] = [_Rows(signal, a, b) for signal in signals]
        part = merge_signals(
            [lambda r=r: r for r in rows],
            (b - a, *shape[1:]),
            passes=passes,
            u_ratio=u_ratio,
            motion_sigma=motion_sigma,
        )
        value[a:b], variance[a:b], flags[a:b] = part.value_cdm2, part.variance, part.flags
        progress(number, len(strips), "strips")
    return Merged(value, variance, flags)


def _settle(
    sums: _Sums,
    value: Strip,
    variance: Strip,
    flags: NDArray[np.uint8],
    at: slice,
    frames: int,
    u_ratio: float,
    motion_sigma: float,
    last: bool,
) -> None:
    """Compute the merged values of one strip from its sums.

    In the last pass also variance and flags.
    """
    information = sums.information[at]
    informed = information > 0
    mean = np.divide(
        sums.value[at], information, out=np.full_like(information, np.inf), where=informed
    )
    if not last:
        value[at] = np.maximum(mean, 0.0)
        return
    np.divide(1.0, information, out=variance[at], where=informed)
    if sums.chi2 is not None:
        shift = np.where(informed, mean - np.where(np.isfinite(value[at]), value[at], 0.0), 0.0)
        chi2 = sums.chi2[at] - information * shift * shift
        freedom = frames - 1
        tolerated = (u_ratio * np.where(informed, mean, 0.0)) ** 2 * information * freedom
        moved = informed & (chi2 > motion_sigma**2 + (freedom + tolerated))
        flags[at][moved] |= np.uint8(Flag.MOTION)
        # Frames that disagree make the mean at least this uncertain.
        variance[at][moved] *= chi2[moved] / freedom
    if sums.unfiltered is not None:
        flags[at][informed & (sums.unfiltered[at] < 0.5 * information)] |= np.uint8(Flag.ND)
    value[at] = mean


def _fill_lost(
    frames: Sequence[Callable[[], Signal]], value: Strip, variance: Strip, flags: NDArray[np.uint8]
) -> None:
    """Fill the pixels that no frame could measure.

    They get the value of the most exposed readable frame, else a lower bound.
    """
    lost = ~np.isfinite(value)
    strips = [(a, b) for a, b in _strips(value.shape) if lost[a:b].any()]
    bound = np.zeros(value.shape, np.float32) if strips else value
    for load in frames if strips else ():
        signal = load()
        per, largest = (
            np.broadcast_to(v, value.shape) for v in (signal.per_cdm2, signal.max_cdm2())
        )
        for a, b in strips:
            counts, _ = signal.strip(a, b)
            readable, spread = signal.readable(counts)
            own = lost[a:b] & readable & (counts > _READABLE_SNR * np.sqrt(spread))
            value[a:b][own] = (counts / per[a:b])[own]
            variance[a:b][own] = (spread / per[a:b] ** 2)[own]
            flags[a:b][own] |= np.uint8(Flag.BLOOM)
            lost[a:b] &= ~own
            full = lost[a:b] & ~readable
            bound[a:b][full] = np.maximum(bound[a:b], largest[a:b])[full]
    for a, b in strips:
        rest = lost[a:b]
        value[a:b][rest] = bound[a:b][rest]
        variance[a:b][rest] = bound[a:b][rest] ** 2
        flags[a:b][rest] |= np.uint8(Flag.CLIPPED_HIGH)
