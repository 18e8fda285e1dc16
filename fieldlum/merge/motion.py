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
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Array, Floats32, Indices, Mask
from fieldlum.core.records import Flag
from fieldlum.merge.estimator import Merged, Rows, merge_rows, rows_of
from fieldlum.merge.frames import Signal

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


class Consensus(NamedTuple):
    """The frames' consensus at m pixels, [m] each.

    value_cdm2: luminance that most frames share. clear: whether the vote is decided, see `vote`.
    sure: number of frames that share the value and have a relative noise below 1/8.
    """

    value_cdm2: Floats32
    clear: Mask
    sure: Indices


class Ballot(NamedTuple):
    """The votes of n frames at m pixels; all arrays are [n, m].

    usable: the frame can measure the pixel; then value_cdm2 is the luminance by this frame, and
    variance that of value_cdm2 [(cd/m2)^2]. saturated: the frame is saturated there; max_cdm2
    is the luminance from which on it saturates. A frame can be neither, but not both.
    """

    value_cdm2: Array
    variance: Array
    usable: Array
    saturated: Array
    max_cdm2: Array


def vote(ballot: Ballot, u_ratio: float) -> Consensus:
    """Return the luminance that most frames share at each pixel, and whether the vote is clear.

    u_ratio: relative disagreement of frames that does not count as motion. The vote is clear if all
    usable frames agree. Otherwise it is clear if at least two witnesses support the value, and more
    witnesses than dissenting frames exist. A witness is a frame that agrees and whose noise is well
    below the gap to the nearest dissenting frame, or a frame that is saturated, as the value
    explains and the dissenting values do not.
    """
    value, usable = ballot.value_cdm2, ballot.usable
    enough = _SATURATED * ballot.max_cdm2
    spread = ballot.variance + (u_ratio * value) ** 2
    best, votes = _most_shared(ballot, spread, enough)
    off = value - best
    agree = usable & (off**2 <= _VOTE_SIGMA**2 * spread)
    dissent = usable & ~agree
    gap = np.where(dissent, np.abs(off), np.inf).min(axis=0)
    brightest = np.where(dissent, value, -np.inf).max(axis=0)
    noticed = agree & (_VOTE_SIGMA**2 * spread < gap**2)
    burnt = ballot.saturated & (best >= enough) & (brightest < enough)
    witnesses, against = (noticed | burnt).sum(axis=0), dissent.sum(axis=0)
    decided = (against == 0) | ((witnesses >= _WITNESSES) & (witnesses > against))
    sure = (agree & (spread < (_SURE * best) ** 2)).sum(axis=0)
    return Consensus(best, (votes >= 0) & decided, sure)


def _most_shared(ballot: Ballot, spread: Array, enough: Array) -> tuple[Floats32, Floats32]:
    """Return the value of the group of frames with most votes [m], and its votes, -1 for none.

    Of groups with as many votes, the one whose value is more certain counts.
    """
    value, usable = ballot.value_cdm2, ballot.usable
    best, finest, best_votes = np.zeros((3, value.shape[1]), np.float32)
    best_votes -= 1.0
    for start, centre in enumerate(value):
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
    return best, best_votes


def _around(mark: Mask) -> NDArray[np.uint16]:
    """Return, for each pixel of a mask [h, w], how many pixels around it are marked."""
    size, border = (_WINDOW_PX, _WINDOW_PX), cv2.BORDER_CONSTANT
    count = cv2.boxFilter(mark.view(np.uint8), cv2.CV_16U, size, normalize=False, borderType=border)
    return np.asarray(count, np.uint16)


def _supported(mark: Mask) -> Mask:
    """Return a mask [h, w] of the marked pixels that have enough marked neighbours."""
    return mark & (_around(mark) >= _SUPPORT)


def _wider(mark: Mask, by_px: int) -> Mask:
    size = 2 * by_px + 1
    return cv2.dilate(mark.view(np.uint8), np.ones((size, size), np.uint8)).view(np.bool_)


def _over_picture(mask: Mask, change: Callable[[Mask], Mask]) -> Mask:
    """Return `change` of a mask in the shape of frames; `change` takes and returns [h, w].

    A raw frame [h / 2, 2, w] is a picture [h, w]. Of a JPEG frame [h, w, 3] it gets True where any
    colour is True, and all three colours get its result.
    """
    if mask.shape[1] != 2:
        return np.repeat(change(np.asarray(mask.any(axis=2)))[:, :, None], 3, axis=2)
    picture: Mask = np.ascontiguousarray(mask.reshape(-1, mask.shape[-1]))
    return change(picture).reshape(mask.shape)


def _ballot(rows: Sequence[Rows], near: Mask) -> Ballot:
    """Return the votes of the pixels in `near`. Pixels next to saturated ones do not vote."""
    votes = []
    for row in rows:
        per, largest = (
            np.broadcast_to(v, near.shape)[near]
            for v in (row.signal.per_cdm2, row.signal.max_cdm2())
        )
        readable, variance = row.signal.readable(row.counts)
        value = row.counts[near] / per
        votes.append((value, variance[near] / per**2, row.usable()[near], ~readable[near], largest))
    return Ballot(*(np.stack(part) for part in zip(*votes, strict=True)))


def _left_out(rows: Sequence[Rows], near: Mask, u_ratio: float) -> Mask:
    """Return a mask [frames, *near.shape] of the pixels that each frame loses.

    A pixel loses all colours or none.
    """
    consensus = vote(_ballot(rows, near), u_ratio)
    value, clear = np.zeros(near.shape, np.float32), np.zeros(near.shape, bool)
    value[near], clear[near] = consensus.value_cdm2, consensus.clear
    far, beyond = np.zeros((len(rows), *near.shape), bool), np.zeros(near.shape, np.int16)
    for i, row in enumerate(rows):
        signal, usable = row.signal, row.usable()
        expected = value * signal.per_cdm2
        spread = signal.readable(np.maximum(row.counts, expected))[1] + (u_ratio * expected) ** 2
        # The merge weights by the expected value, and so must the vote.
        used = usable | (signal.readable(row.counts)[0] & (signal.weight(value) > 0))
        far[i] = near & used & ((row.counts - expected) ** 2 > _LEAVE_SIGMA**2 * spread)
        beyond += far[i] & ~usable
    sure = np.zeros(near.shape, np.int16)
    sure[near] = consensus.sure
    clear &= (beyond == 0) | ((sure >= _WITNESSES) & (sure > beyond))
    clear = near & ~_over_picture(near & ~clear, lambda mark: mark | (_around(mark) >= _CLOUDED))
    out = np.zeros_like(far)
    for i in range(len(far)):
        marked = far[i] & clear
        if marked.any():
            out[i] = clear & _over_picture(marked, lambda mark: _wider(_supported(mark), _HALO_PX))
    return out


def leave_out_moved(
    frames: Sequence[Signal], merged: Merged, u_ratio: float
) -> tuple[Merged, tuple[float, ...]]:
    """Merge again without the frames that disagree where something moved; return each frame's loss.

    frames: most exposed first; u_ratio: relative disagreement of frames that does not count as
    motion. A frame's loss is the share (0 to 1) of its pixels that were excluded. The flag MOTION
    remains where a frame was excluded and where the vote was undecided; an undecided pixel keeps
    all frames. The arrays of `merged` are changed in place.
    """
    value, variance, flags = merged.value_cdm2, merged.variance, merged.flags
    shape = value.shape
    seeds = _over_picture((flags & Flag.MOTION) > 0, _supported)
    near = _over_picture(seeds, lambda mark: _wider(mark, _REACH_PX))
    lost = np.zeros(len(frames))
    step, margin = max(1, _BAND // int(np.prod(shape[1:]))), _REACH_PX + _HALO_PX
    for first in range(0, shape[0], step):
        last = min(first + step, shape[0])
        a, b = max(first - margin, 0), min(last + margin, shape[0])
        rows = rows_of(frames, a, b) if near[first:last].any() else []
        out = _left_out(rows, near[a:b], u_ratio) if rows else near[:0]
        if not out.any():
            continue
        again = merge_rows(
            [
                row._replace(full=mask if row.full is None else row.full | mask)
                for row, mask in zip(rows, out, strict=True)
            ],
            u_ratio=u_ratio,
        )
        inner = slice(first - a, last - a)
        # If all frames were excluded, none would remain.
        measured = (again.flags[inner] & (Flag.CLIPPED_HIGH | Flag.BLOOM)) == 0
        changed = np.any(out, axis=0)[inner] & measured
        value[first:last][changed] = again.value_cdm2[inner][changed]
        variance[first:last][changed] = again.variance[inner][changed]
        flags[first:last][changed] = again.flags[inner][changed] | np.uint8(Flag.MOTION)
        lost += [(mask[inner] & changed).sum() for mask in out]
    return merged, tuple(lost / value.size)
