"""Group a card's frames into brackets, and match these to slots by exposures and time."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from itertools import groupby, pairwise
from pathlib import Path

import numpy as np

from fieldlum.core.records import Exposure, Slot
from fieldlum.optics.photometry import same_exposure

WITHIN_S = 1200.0  # a bracket started by hand further from its slot belongs to another hour; chosen
# Not measured, unless a source is stated. Each limit is chosen between the two cases that it must
# separate.
_STEADY_S = 5.0  # spread of the start times of an intervalometer; starts by hand vary far more
# shortest pause between brackets, as a multiple of the usual time between frames; chosen, not
# measured
_PAUSE_FACTOR = 10.0
# additional factor for a head that is turned between two frames; chosen, not measured
_TURN_FACTOR = 6.0
_CAMPAIGN_S = 5 * 86400.0  # a gap of more days separates campaigns; chosen
_QUARTER_S = 900.0  # civil clocks differ by multiples of a quarter of an hour (IANA tz database)
_HALF_COUNT = 5000  # cameras number their files up to 9999 (DCF 2.0)


@dataclass(frozen=True, slots=True)
class CardFrame:
    """A frame as EXIF describes it.

    t_camera: the camera's clock, read as if it were UTC; if exif_offset_s is known, t_camera is
    UTC. exif_offset_s: the clock minus UTC [s], if EXIF states it. camera: model; serial: of the
    body, "" if EXIF has none.
    """

    path: Path
    exposure: Exposure
    t_camera: datetime
    exif_offset_s: float | None = None
    camera: str = ""
    serial: str = ""


@dataclass(frozen=True, slots=True)
class Group:
    """The frames of one bracket on a camera's card, in order of time."""

    frames: tuple[CardFrame, ...]

    @property
    def t_camera(self) -> datetime:
        """Start of the bracket, the `t_camera` of its first frame."""
        return self.frames[0].t_camera


@dataclass(frozen=True, slots=True)
class Offset:
    """The camera's clock minus UTC [s], and how it was determined.

    seconds: how far the frames' t_camera is ahead of UTC. exif_s: the offsets in EXIF, which
    t_camera already includes.
    """

    seconds: float
    how: str
    exif_s: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class Match:
    """A bracket on a card, and the planned slot it belongs to.

    late_s: true start minus planned start [s].
    """

    slot: Slot
    group: Group
    late_s: float


@dataclass(frozen=True, slots=True)
class Unmatched:
    """A bracket on a card that belongs to no slot, and the reason."""

    group: Group
    why: str


def usual_step_s(frames: Sequence[CardFrame]) -> float:
    """Return the median pause from the end of one frame to the start of the next [s], at least 1 s.

    It is 1 s for fewer than two frames. frames: in order of time.
    """
    gaps = [
        (b.t_camera - a.t_camera).total_seconds() - a.exposure.shutter_s
        for a, b in pairwise(frames)
    ]
    return max(float(np.median(gaps)), 1.0) if gaps else 1.0


def in_order(frames: Sequence[CardFrame]) -> list[CardFrame]:
    """Return frames ordered by the camera's time, and within one second by file number.

    Number 9999 is followed by 0001 or 0000.
    """
    ordered: list[CardFrame] = []
    for _, same in groupby(sorted(frames, key=lambda f: f.t_camera), key=lambda f: f.t_camera):
        second = list(same)
        numbers = [_number(frame) for frame in second]
        wraps = max(numbers) - min(numbers) > _HALF_COUNT
        lifted = [
            number + (2 * _HALF_COUNT if wraps and number < _HALF_COUNT else 0)
            for number in numbers
        ]
        order = sorted(range(len(second)), key=lambda i: (lifted[i], second[i].path.name))
        ordered += [second[i] for i in order]
    return ordered


def _number(frame: CardFrame) -> int:
    """Return the camera's file number, the last four digits of the name; 0 for another name."""
    match = re.search(r"(\d{4})$", frame.path.stem)
    return int(match[1]) if match else 0


def group_frames(
    frames: Sequence[CardFrame], pattern: Sequence[Exposure] = (), headings: int = 1
) -> list[Group]:
    """Group frames into brackets, in order of time.

    A new bracket begins after a pause, or with an exposure that the bracket already contains. The
    pause is over ten times this card's usual time between frames (60 times with several headings),
    because a bracket can take from three seconds to two minutes.

    pattern: the plan's exposures. An exposure that is twice in the plan (once through a filter,
    which EXIF does not record) is expected twice. headings: number of headings of a turned head;
    each exposure is expected once for each.
    """
    ordered = in_order(frames)
    pause = _PAUSE_FACTOR * usual_step_s(ordered) * (_TURN_FACTOR if headings > 1 else 1.0)
    groups: list[list[CardFrame]] = []
    for frame in ordered:
        if groups:
            last = groups[-1][-1]
            gap = (frame.t_camera - last.t_camera).total_seconds() - last.exposure.shutter_s
            taken = sum(same_exposure(f.exposure, frame.exposure) for f in groups[-1])
            often = max(1, sum(same_exposure(e, frame.exposure) for e in pattern)) * headings
            if gap <= pause and taken < often:
                groups[-1].append(frame)
                continue
        groups.append([frame])
    return [Group(tuple(group)) for group in groups]


def campaigns(groups: Sequence[Group]) -> list[list[Group]]:
    """Split brackets, in order of time, at gaps of five days or more between two starts.

    The camera's clock may have been set there.
    """
    return split_at_gaps(groups, _CAMPAIGN_S)


def split_at_gaps(groups: Sequence[Group], gap_s: float) -> list[list[Group]]:
    """Split brackets, in order of time, between two that begin at least `gap_s` apart."""
    parts: list[list[Group]] = []
    for group in groups:
        if parts and (group.t_camera - parts[-1][-1].t_camera).total_seconds() < gap_s:
            parts[-1].append(group)
        else:
            parts.append([group])
    return parts


def fits(group: Group, slot: Slot) -> int:
    """Return for how many of the slot's exposures the group has a frame.

    Filters are not compared, and each frame counts for one exposure.
    """
    return len(slot.exposures) - len(missing_exposures(group, slot.exposures))


def missing_exposures(group: Group, planned: Sequence[Exposure]) -> list[Exposure]:
    """Return the planned exposures without a frame; each frame counts for one exposure."""
    unused, missing = [frame.exposure for frame in group.frames], []
    for wanted in planned:
        match = next((k for k, own in enumerate(unused) if same_exposure(own, wanted)), None)
        if match is None:
            missing.append(wanted)
        else:
            del unused[match]
    return missing


def late_s(groups: Sequence[Group], slots: Sequence[Slot], offset_s: float) -> np.ndarray:
    """Return by how much each bracket starts after its nearest slot, [n] s; negative if before.

    offset_s: the camera's clock minus UTC, which is subtracted from the bracket's time. slots: at
    least one.
    """
    starts = np.array([slot.t_utc.timestamp() for slot in slots])
    times = np.array([g.t_camera.timestamp() for g in groups]) - offset_s
    return times - starts[np.abs(times[:, None] - starts[None, :]).argmin(axis=1)]


def fitting_offsets(groups: Sequence[Group], slots: Sequence[Slot]) -> list[float]:
    """Return the clock offsets [s] with which the largest number of brackets is near slots.

    Near means within 7.5 minutes. Offsets, clock minus UTC, are multiples of a quarter of an hour,
    from -12 to 14 hours. The list is empty if no bracket is near a slot with any of them.
    """
    if not groups or not slots:
        return []
    candidates = _QUARTER_S * np.arange(-12 * 4, 14 * 4 + 1)
    hits = np.array(
        [np.sum(np.abs(late_s(groups, slots, c)) <= _QUARTER_S / 2) for c in candidates]
    )
    return [float(c) for c in candidates[hits == hits.max()]] if hits.max() > 0 else []


def find_offset(
    groups: Sequence[Group], slots: Sequence[Slot], expected_s: Sequence[float]
) -> Offset | None:
    """Return the camera's clock minus UTC, fitted to the plan.

    expected_s: likely offsets, most likely first: the first that fits is used if several offsets
    fit equally well. Return None if no offset fits, or if several fit and none of them is expected.
    """
    among = fitting_offsets(groups, slots)
    if len(among) == 1:
        return Offset(among[0], "fitted to the plan")
    chosen = next((e for e in expected_s if e in among), None)
    if chosen is None:
        return None
    what = "civil time of the place" if chosen else "UTC"
    return Offset(
        chosen,
        f"assumed to be {what}; other offsets would fit the plan too: if you "
        "know the offset, state it with --utc-offset",
    )


def refine_offset(groups: Sequence[Group], slots: Sequence[Slot], offset: Offset) -> Offset:
    """Refine the offset by the median delay, if three or more brackets start equally early or late.

    Only brackets within 20 minutes of a slot count. Their delays must agree within 5 s (median
    deviation), and the median must be 1 s or more; else the offset is returned unchanged. Such
    brackets were started by a timer, so that their common delay is an error of the camera's clock.
    """
    late = late_s(groups, slots, offset.seconds)
    near = late[np.abs(late) <= WITHIN_S]
    if len(near) < 3:
        return offset
    middle = float(np.median(near))
    if float(np.median(np.abs(near - middle))) > _STEADY_S or abs(middle) < 1.0:
        return offset
    how = f"{offset.how}, corrected by {middle:+.0f} s, the median of {len(near)} brackets"
    return replace(offset, seconds=offset.seconds + middle, how=how)


def misfit(match: Match) -> tuple[int, float]:
    """Return a key that sorts the best match first.

    The best has frames for most of the slot's exposures, then the smallest time from the
    slot, early or late.
    """
    return -fits(match.group, match.slot), abs(match.late_s)


def match_groups(
    groups: Sequence[Group], slots: Sequence[Slot], offset: Offset
) -> tuple[list[Match], list[Unmatched]]:
    """Match brackets to the nearest slot within 20 minutes; return matches and the others.

    Matches are in order of the slots. A bracket must have two of the slot's exposures, or its only
    one. Of several brackets at one slot, the one with most of the slot's exposures is matched, then
    the nearest.
    """
    matches: dict[str, Match] = {}
    unmatched: list[Unmatched] = []
    for group in groups:
        t_utc = true_time(group.t_camera, offset)
        slot = min(slots, key=lambda s: abs((s.t_utc - t_utc).total_seconds()), default=None)
        if slot is None or abs((t_utc - slot.t_utc).total_seconds()) > WITHIN_S:
            unmatched.append(Unmatched(group, f"no slot within {WITHIN_S / 60:.0f} min"))
            continue
        if fits(group, slot) < min(2, len(slot.exposures)):
            unmatched.append(Unmatched(group, "at most one of its exposures is in the plan"))
            continue
        match = Match(slot, group, (t_utc - slot.t_utc).total_seconds())
        best, *worse = sorted((m for m in (matches.get(slot.id), match) if m), key=misfit)
        unmatched += [Unmatched(m.group, f"another bracket fits {slot.id} better") for m in worse]
        matches[slot.id] = best
    return sorted(matches.values(), key=lambda m: m.slot.t_utc), unmatched


def true_time(t_camera: datetime, offset: Offset) -> datetime:
    """Return a time by the camera's clock as UTC, with the clock's offset subtracted."""
    return (t_camera - timedelta(seconds=offset.seconds)).astimezone(UTC)
