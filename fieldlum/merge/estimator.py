"""The estimator: inverse-variance weights from the predicted signal, frame by frame.

Model of a frame: y = e L + noise, with e the counts per cd/m2 and var(y) known as a function of e
L. The first pass, sum y / sum e, only predicts. The second has the weights e / var(predicted): it
is unbiased and reaches the Cramer-Rao bound from far below the noise to just below saturation
(Aguerrebere et al. 2014; bench/merge_estimator.py). Weights from the noisy value itself would give
a bias of -15 % in the dark. Negative signals stay, because clipping them biases the dark. Sums are
two float32 arrays.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from fieldlum.records import Flag, Progress, quiet

_READABLE_SNR = 5.0  # a frame below it does not fill a pixel that the others lost; not measured
_STRIP = 1 << 17  # elements processed at a time: they stay in a core's cache

Strip = NDArray[np.float32]


class Signal(Protocol):
    """One frame [rows, ...], linear and black-subtracted, read in strips along its first axis.

    Luminances are in cd/m2; what is called broadcastable fits the frame's array.
    """

    @property
    def per_cdm2(self) -> NDArray[np.float32]:
        """Return counts per cd/m2, broadcastable to the array."""
        ...

    @property
    def through_nd(self) -> bool:
        """Return whether a neutral-density filter was in front of the lens."""
        ...

    def strip(self, first: int, last: int) -> tuple[Strip, NDArray[np.bool_] | None]:
        """Return counts above black, and where they are saturated or near a saturated pixel.

        The mask is None if nothing is saturated.
        """
        ...

    def weight(self, predicted_cdm2: Strip) -> Strip:
        """Return per_cdm2 / variance of the counts predicted from the luminance.

        It is 0 where the prediction nears saturation.
        """
        ...

    def usable(self, counts: Strip) -> NDArray[np.bool_]:
        """Return which counts are far enough from saturation to predict from."""
        ...

    def readable(self, counts: Strip) -> tuple[NDArray[np.bool_], Strip]:
        """Return which counts are below saturation itself, and their variance."""
        ...

    def largest_cdm2(self) -> NDArray[np.float32]:
        """Return the luminance from which this frame's counts are unreadable, broadcastable."""
        ...

    def sampled(self, rows: int, columns: int) -> tuple["Signal", NDArray[np.bool_]]:
        """Return about rows x columns evenly spread pixels, and which are near saturation.

        The pixels are a signal themselves.
        """
        ...


@dataclass(frozen=True, slots=True)
class Merged:
    """Merged pixels, in the frames' shape.

    value_cdm2: luminance in the sensor's own colours; variance: of it; flags: `Flag` bits.
    """

    value_cdm2: NDArray[np.float32]
    variance: NDArray[np.float32]
    flags: NDArray[np.uint8]


def _strips(shape: tuple[int, ...]) -> Iterator[tuple[int, int]]:
    step = max(1, _STRIP // int(np.prod(shape[1:])))
    for first in range(0, shape[0], step):
        yield first, min(first + step, shape[0])


def _predict(
    frames: Sequence[Callable[[], Signal]], shape: tuple[int, ...], tick: Callable[[], None]
) -> Strip:
    """Return sum y / sum e over usable counts, at least 0; infinite where no frame is usable."""
    total, exposure = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    for load in frames:
        signal = load()
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
        seen = exposure[a:b] > 0
        np.divide(total[a:b], exposure[a:b], out=total[a:b], where=seen)
        np.maximum(total[a:b], 0.0, out=total[a:b])
        total[a:b][~seen] = np.inf
    return total


@dataclass(slots=True)
class _Sums:
    """Sums of w y, w e, (y - predicted)^2 / var, and w e of the frames without a filter."""

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
    """Merge frames of one `shape`; `frames` load them and are called once per pass, in order.

    resident: all frames are in memory, so loading them again costs nothing. Then each strip goes
    through all passes and stays in a core's cache, with the same result.

    Callers sort the frames, most exposed first, so that the order of files does not matter.
    u_ratio: relative disagreement between frames that is not motion. A pixel that saturates in all
    frames gets its lower bound and CLIPPED_HIGH. One that is only next to such a pixel gets the
    value of the most exposed frame that is readable there, and BLOOM.
    """
    if resident:
        return _merge_by_strips(frames, shape, passes, u_ratio, motion_sigma, progress)
    done, total = [0], len(frames) * (passes + 1)

    def tick() -> None:
        done[0] += 1
        progress(done[0], total, "frames")

    value = _predict(frames, shape, tick)
    nd = any(load().through_nd for load in frames)
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
    """Some rows of a frame, as a frame that is read once."""

    def __init__(self, whole: Signal, first: int, last: int) -> None:
        self._whole, self._strip = whole, whole.strip(first, last)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._whole, name)

    def strip(self, first: int, last: int) -> tuple[Strip, NDArray[np.bool_] | None]:
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
    value, variance, flags = (
        np.empty(shape, np.float32),
        np.empty(shape, np.float32),
        np.empty(shape, np.uint8),
    )
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
    """Compute the value from the sums of one strip, in the last pass also variance and flags."""
    information = sums.information[at]
    seen = information > 0
    mean = np.divide(sums.value[at], information, out=np.full_like(information, np.inf), where=seen)
    if not last:
        value[at] = np.maximum(mean, 0.0)
        return
    np.divide(1.0, information, out=variance[at], where=seen)
    if sums.chi2 is not None:
        shift = np.where(seen, mean - np.where(np.isfinite(value[at]), value[at], 0.0), 0.0)
        chi2 = sums.chi2[at] - information * shift * shift
        allowed = (frames - 1) + (u_ratio * np.where(seen, mean, 0.0)) ** 2 * information * (
            frames - 1
        )
        moved = seen & (chi2 > motion_sigma**2 + allowed)
        flags[at][moved] |= np.uint8(Flag.MOTION)
        variance[at][moved] *= chi2[moved] / (
            frames - 1
        )  # the mean is at least as uncertain as the frames disagree
    if sums.unfiltered is not None:
        flags[at][seen & (sums.unfiltered[at] < 0.5 * information)] |= np.uint8(Flag.ND)
    value[at] = mean


def _fill_lost(
    frames: Sequence[Callable[[], Signal]], value: Strip, variance: Strip, flags: NDArray[np.uint8]
) -> None:
    """Fill pixels without any frame: the most exposed readable frame's value, or a lower bound."""
    lost = ~np.isfinite(value)
    strips = [(a, b) for a, b in _strips(value.shape) if lost[a:b].any()]
    bound = np.zeros(value.shape, np.float32) if strips else value
    for load in frames if strips else ():
        signal = load()
        per, largest = (
            np.broadcast_to(v, value.shape) for v in (signal.per_cdm2, signal.largest_cdm2())
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
