"""Exclude frames from pixels where something moved in front of the scene.

The merge flags pixels whose frames disagree. At and around such pixels the frames vote: the value
that most frames share within their noise is the consensus. A saturated frame votes for any value
bright enough to saturate it. Frames outside the consensus are excluded there and some pixels
around, so that soft edges leave no halo. The estimator then merges the remaining frames again. If
too few frames could separate two values, or if the vote is undecided, nothing is excluded and only
the flag remains. All other pixels of the map do not change.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats32, Indices, Mask
from fieldlum.core.records import Flag
from fieldlum.merge.estimator import Merged, Signal, Strip, merge_signals

Over = Callable[[Mask, Callable[[Mask], Mask]], Mask]

# elements processed at a time, for all frames together; bounds the memory; chosen; any value gives
# the same result
_BAND = 1 << 21
_VOTE_SIGMA = 4.0  # a frame further from a value does not vote for it; chosen
# a frame further from the consensus is excluded if its neighbours are excluded too; chosen
_LEAVE_SIGMA = 3.0
# minimum number of marked pixels in a window, because single pixels are marked by chance; chosen
_SUPPORT, _WINDOW_PX = 4, 5
_CLOUDED = 10  # with this many undecided pixels in a window, its middle is undecided too; chosen
# largest relative sigma of a frame that may contradict a frame outside its limits; chosen
_SURE = 1 / 8
# distance examined around flagged pixels; distance excluded around disagreeing ones; chosen
_REACH_PX, _HALO_PX = 8, 3
# of the largest readable value: a brighter consensus explains a saturated frame; chosen
_SATURATED = 0.9
_WITNESSES = 2  # minimum number of agreeing frames; chosen


@dataclass(frozen=True, slots=True)
class Consensus:
    """The frames' consensus at m pixels, [m] each.

    value_cdm2: luminance that most frames share. clear: whether the vote is decided, see `vote`.
    sure: number of frames that share the value and have a relative noise below 1/8.
    """

    value_cdm2: Floats32
    clear: Mask
    sure: Indices


@dataclass(frozen=True, slots=True)
class Ballot:
    """The votes of n frames at m pixels; all arrays are [n, m].

    usable: the frame can measure the pixel; then value_cdm2 is the luminance by this frame, and
    variance that of value_cdm2 [(cd/m2)^2]. saturated: the frame is saturated there; max_cdm2
    is the luminance from which on it saturates. A frame can be neither, but not both.
    """

    value_cdm2: Strip
    variance: Strip
    usable: Mask
    saturated: Mask
    max_cdm2: Strip


def vote(ballot: Ballot, u_ratio: float) -> Consensus:
    """Return the luminance that most frames share at each pixel, and whether the vote is clear.

    u_ratio: relative disagreement of frames that does not count as motion. The vote is clear if all
    usable frames agree. Otherwise it is clear if at least two witnesses support the value, and more
    witnesses than dissenting frames exist. A witness is a frame that agrees and whose noise is well
    below the gap to the nearest dissenting frame, or a frame that is saturated, as the value
    explains and the dissenting values do not.
    """
    value, variance, usable = ballot.value_cdm2, ballot.variance, ballot.usable
    enough = _SATURATED * ballot.max_cdm2
    n, m = value.shape
    spread = variance + (u_ratio * value) ** 2
    best, finest = np.zeros(m, np.float32), np.zeros(m, np.float32)
    best_votes = np.full(m, -1.0, np.float32)
    for start in range(n):
        centre = value[start]
        agree = usable & ((value - centre) ** 2 <= _VOTE_SIGMA**2 * (spread + spread[start]))
        # a noisy frame agrees with every value, so that the group around it must agree again within
        # itself
        for _ in range(2):
            weight = np.where(agree, 1 / spread, 0.0)
            total = weight.sum(axis=0)
            shared = (weight * value).sum(axis=0)
            centre = np.divide(shared, total, out=centre.copy(), where=total > 0)
            agree = usable & ((value - centre) ** 2 <= _VOTE_SIGMA**2 * spread)
        votes = agree.sum(axis=0) + (ballot.saturated & (centre >= enough)).sum(axis=0)
        precision = np.where(agree, 1 / spread, 0.0).sum(axis=0)
        better = usable[start] & (
            (votes > best_votes) | ((votes == best_votes) & (precision > finest))
        )
        for kept, new in ((best, centre), (best_votes, votes), (finest, precision)):
            kept[better] = new[better]
    off = value - best
    agree = usable & (off**2 <= _VOTE_SIGMA**2 * spread)
    dissent = usable & ~agree
    gap = np.where(dissent, np.abs(off), np.inf).min(axis=0)
    brightest = np.where(dissent, value, -np.inf).max(axis=0)
    noticed = agree & (_VOTE_SIGMA**2 * spread < gap**2)
    burnt = ballot.saturated & (best >= enough) & (brightest < enough)
    witnesses = (noticed | burnt).sum(axis=0)
    against = dissent.sum(axis=0)
    clear = (best_votes >= 0) & (
        (against == 0) | ((witnesses >= _WITNESSES) & (witnesses > against))
    )
    sure = (agree & (spread < (_SURE * best) ** 2)).sum(axis=0)
    return Consensus(best.astype(np.float32), clear, sure)


def _around(mark: Mask) -> NDArray[np.uint16]:
    """Return, for each pixel of a mask [h, w], how many pixels around it are marked."""
    import cv2

    size, border = (_WINDOW_PX, _WINDOW_PX), cv2.BORDER_CONSTANT
    return np.asarray(
        cv2.boxFilter(mark.view(np.uint8), cv2.CV_16U, size, normalize=False, borderType=border),
        np.uint16,
    )


def _supported(mark: Mask) -> Mask:
    """Return a mask [h, w] of the marked pixels that have enough marked neighbours."""
    return mark & (_around(mark) >= _SUPPORT)


def _wider(mark: Mask, by_px: int) -> Mask:
    import cv2

    size = 2 * by_px + 1
    return cv2.dilate(mark.view(np.uint8), np.ones((size, size), np.uint8)).view(np.bool_)


class _Part:
    """Some rows of a frame as a signal; pixels in `left_out` do not count."""

    def __init__(self, signal: Signal, first: int, left_out: Mask) -> None:
        self._signal, self._first, self._left_out = signal, first, left_out

    def __getattr__(self, name: str) -> Any:
        return getattr(self._signal, name)

    def strip(self, first: int, last: int) -> tuple[Strip, Mask | None]:
        counts, full = self._signal.strip(first + self._first, last + self._first)
        out = self._left_out[first:last]
        return counts, out if full is None else full | out


def _parts(
    frames: Sequence[Callable[[], Signal]], first: int, left_out: Mask
) -> list[Callable[[], Signal]]:
    def part(load: Callable[[], Signal], out: Mask) -> Callable[[], Signal]:
        return lambda: cast(Signal, _Part(load(), first, out))

    return [part(load, left_out[i]) for i, load in enumerate(frames)]


def _own(signal: Signal, first: int, last: int) -> tuple[Strip, Mask, Mask]:
    """Return counts of some rows, a mask of counts that can vote, and a mask of saturated counts.

    Counts within the frame's limits can vote. Pixels next to saturated ones are in neither mask.
    """
    counts, full = signal.strip(first, last)
    usable = signal.usable(counts)
    if full is not None:
        usable &= ~full
    return counts, usable, ~signal.readable(counts)[0]


def _ballot(frames: Sequence[Callable[[], Signal]], near: Mask, first: int) -> Ballot:
    """Return the votes of the pixels in `near`, a mask of the rows from `first` on."""
    shape = (len(frames), int(near.sum()))
    value, variance, largest = (np.empty(shape, np.float32) for _ in range(3))
    usable, saturated = np.empty(shape, bool), np.empty(shape, bool)
    for i, load in enumerate(frames):
        signal = load()
        counts, own, full = _own(signal, first, first + len(near))
        per = np.broadcast_to(signal.per_cdm2, near.shape)[near]
        value[i], variance[i] = counts[near] / per, signal.readable(counts)[1][near] / per**2
        usable[i], saturated[i] = own[near], full[near]
        largest[i] = np.broadcast_to(signal.max_cdm2(), near.shape)[near]
    return Ballot(value, variance, usable, saturated, largest)


def _left_out(
    frames: Sequence[Callable[[], Signal]],
    near: Mask,
    first: int,
    u_ratio: float,
    over_picture: Over,
) -> Mask:
    """Return a mask [frames, *near.shape] of the pixels that each frame loses.

    The mask covers the rows from `first` on. A pixel loses all colours or none.
    """
    consensus = vote(_ballot(frames, near, first), u_ratio)
    value, clear = np.zeros(near.shape, np.float32), np.zeros(near.shape, bool)
    value[near], clear[near] = consensus.value_cdm2, consensus.clear
    far, beyond = np.zeros((len(frames), *near.shape), bool), np.zeros(near.shape, np.int16)
    for i, load in enumerate(frames):
        signal = load()
        counts, usable, full = _own(signal, first, first + len(near))
        expected = value * signal.per_cdm2
        spread = signal.readable(np.maximum(counts, expected))[1] + (u_ratio * expected) ** 2
        # The merge weights by the expected value, and so must the vote.
        used = usable | (~full & (signal.weight(value) > 0))
        far[i] = near & used & ((counts - expected) ** 2 > _LEAVE_SIGMA**2 * spread)
        beyond += far[i] & ~usable
    sure = np.zeros(near.shape, np.int16)
    sure[near] = consensus.sure
    clear &= (beyond == 0) | ((sure >= _WITNESSES) & (sure > beyond))
    clear = near & ~over_picture(near & ~clear, lambda mark: mark | (_around(mark) >= _CLOUDED))
    out = np.zeros_like(far)
    for i in range(len(frames)):
        marked = far[i] & clear
        if marked.any():
            out[i] = clear & over_picture(marked, lambda mark: _wider(_supported(mark), _HALO_PX))
    return out


def leave_out_moved(
    frames: Sequence[Callable[[], Signal]],
    merged: Merged,
    *,
    u_ratio: float,
    over_picture: Over,
) -> tuple[Merged, tuple[float, ...]]:
    """Merge again without the frames that disagree where something moved; return each frame's loss.

    frames: functions that load one frame each, most exposed first; u_ratio: relative disagreement
    of frames that does not count as motion. over_picture: `over_mosaic` or `over_colours` of
    frames.py. A frame's loss is the share (0 to 1) of its pixels that were excluded. The flag
    MOTION remains where a frame was excluded and where the vote was undecided; an undecided pixel
    keeps all frames. The arrays of `merged` are changed in place.
    """
    shape = merged.value_cdm2.shape
    seeds = over_picture((merged.flags & Flag.MOTION) > 0, _supported)
    near = over_picture(seeds, lambda mark: _wider(mark, _REACH_PX))
    lost = [0] * len(frames)
    value, variance, flags = merged.value_cdm2, merged.variance, merged.flags
    rows = max(1, _BAND // int(np.prod(shape[1:])))
    margin = _REACH_PX + _HALO_PX
    for first in range(0, shape[0], rows):
        last = min(first + rows, shape[0])
        if not near[first:last].any():
            continue
        a, b = max(first - margin, 0), min(last + margin, shape[0])
        out = _left_out(frames, near[a:b], a, u_ratio, over_picture)
        if not out.any():
            continue
        again = merge_signals(_parts(frames, a, out), (b - a, *shape[1:]), u_ratio=u_ratio)
        inner = slice(first - a, last - a)
        # If all frames were excluded, none would remain.
        measured = (again.flags[inner] & (Flag.CLIPPED_HIGH | Flag.BLOOM)) == 0
        changed = np.any(out, axis=0)[inner] & measured
        for old, new in ((value, again.value_cdm2), (variance, again.variance)):
            old[first:last][changed] = new[inner][changed]
        flags[first:last][changed] = again.flags[inner][changed] | np.uint8(Flag.MOTION)
        for number, mask in enumerate(out):
            lost[number] += int((mask[inner] & changed).sum())
    return Merged(value, variance, flags), tuple(count / value.size for count in lost)
