"""Frames of a card to brackets, and brackets to slots: by exposure pattern and time. Pure
functions.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from itertools import groupby, pairwise
from pathlib import Path

import numpy as np

from fieldlum.records import Exposure, Slot

SAME_EV = 1 / 6
WITHIN_S = 1200.0  # a bracket taken by hand further from its slot belongs to another hour
_STEADY_S = 5.0  # spread of an intervalometer's start times; a person's is far larger
_PAUSE_FACTOR = 10.0  # a pause is so many times the usual step between two frames
_TURN_FACTOR = 6.0  # more, where a head is turned between two frames
_CAMPAIGN_S = 5 * 86400.0
_QUARTER_S = 900.0  # civil clocks differ by whole quarters of an hour
_HALF_COUNT = 5000  # cameras count their files to 9999


@dataclass(frozen=True, slots=True)
class CardFrame:
    """A frame as its EXIF tells. t_camera: the camera's clock as if it were UTC; known_utc when
    EXIF has its offset.
    """

    path: Path
    exposure: Exposure
    t_camera: datetime
    known_utc: bool = False
    camera: str = ""  # model
    serial: str = ""  # of its body, where EXIF tells


@dataclass(frozen=True, slots=True)
class Group:
    """One bracket on the card."""

    frames: tuple[CardFrame, ...]

    @property
    def t_camera(self) -> datetime:
        return self.frames[0].t_camera


@dataclass(frozen=True, slots=True)
class Offset:
    """The camera's clock minus UTC, and how that is known."""

    seconds: float
    how: str


@dataclass(frozen=True, slots=True)
class Match:
    slot: Slot
    group: Group
    late_s: float  # true start minus planned start


@dataclass(frozen=True, slots=True)
class Unmatched:
    group: Group
    why: str


def same_exposure(a: Exposure, b: Exposure) -> bool:
    """Within a sixth of a stop in shutter, aperture and ISO, and through the same filter (a
    camera knows none).
    """
    stops = (
        math.log2(a.shutter_s / b.shutter_s),
        2.0 * math.log2(a.f_number / b.f_number),
        math.log2(a.iso / b.iso),
    )
    return all(abs(stop) <= SAME_EV for stop in stops)


def usual_step_s(frames: Sequence[CardFrame]) -> float:
    """Median time between the end of a frame and the start of the next, at least the second that
    EXIF resolves.
    """
    gaps = [
        (b.t_camera - a.t_camera).total_seconds() - a.exposure.shutter_s
        for a, b in pairwise(frames)
    ]
    return max(float(np.median(gaps)), 1.0) if gaps else 1.0


def in_order(frames: Sequence[CardFrame]) -> list[CardFrame]:
    """By the camera's time; of one second by their names, where 9999 is followed by 0001 (or
    0000).
    """
    found: list[CardFrame] = []
    for _, same in groupby(sorted(frames, key=lambda f: f.t_camera), key=lambda f: f.t_camera):
        second = list(same)
        numbers = [_number(frame) for frame in second]
        wraps = max(numbers) - min(numbers) > _HALF_COUNT
        lifted = [
            number + (2 * _HALF_COUNT if wraps and number < _HALF_COUNT else 0)
            for number in numbers
        ]
        order = sorted(range(len(second)), key=lambda i: (lifted[i], second[i].path.name))
        found += [second[i] for i in order]
    return found


def _number(frame: CardFrame) -> int:
    """The camera's own count of its files, the last four digits of a name; 0 for another name."""
    match = re.search(r"(\d{4})$", frame.path.stem)
    return int(match[1]) if match else 0


def group_frames(
    frames: Sequence[CardFrame], pattern: Sequence[Exposure] = (), headings: int = 1
) -> list[Group]:
    """Brackets in order of time. A new one begins where an exposure comes once too often, or after
    a pause.

    pattern: the plan's exposures; one that comes twice there (the second time through a filter,
    which EXIF does not know) comes twice in a bracket, and everything comes once more for each
    heading of a turned head. A pause is ten usual steps of this very card, never a fixed time: a
    bracket lasts from three seconds to two minutes.
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
    """Groups parted where days lie between: a camera's clock may have been set anew."""
    parts: list[list[Group]] = []
    for group in groups:
        if parts and (group.t_camera - parts[-1][-1].t_camera).total_seconds() < _CAMPAIGN_S:
            parts[-1].append(group)
        else:
            parts.append([group])
    return parts


def fits(group: Group, slot: Slot) -> int:
    """How many of the slot's exposures the group holds."""
    return sum(any(same_exposure(f.exposure, e) for f in group.frames) for e in slot.exposures)


def late_s(groups: Sequence[Group], slots: Sequence[Slot], offset_s: float) -> np.ndarray:
    """Start of each group minus that of its nearest slot, with the camera's clock corrected. [s]"""
    starts = np.array([slot.t_utc.timestamp() for slot in slots])
    times = np.array([g.t_camera.timestamp() for g in groups]) - offset_s
    return times - starts[np.abs(times[:, None] - starts[None, :]).argmin(axis=1)]


def fitting_offsets(groups: Sequence[Group], slots: Sequence[Slot]) -> list[float]:
    """The whole quarters of an hour that, as the camera's clock minus UTC, fit most brackets to
    slots; none: empty.
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
    """The camera's clock minus UTC when nobody told it.

    expected_s: the place's own offsets (standard, daylight saving, UTC), preferred when several fit
    alike. None when two fit alike and neither is expected: hours look like each other; and when
    none fits.
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
        f"taken for {what}; other hours would fit the plan too, so say it by --utc-offset if you "
        f"know",
    )


def refine_offset(groups: Sequence[Group], slots: Sequence[Slot], offset: Offset) -> Offset:
    """Where all brackets start equally early or late, a timer started them: what is left is the
    camera's clock.
    """
    late = late_s(groups, slots, offset.seconds)
    near = late[np.abs(late) <= WITHIN_S]
    if len(near) < 3:
        return offset
    middle = float(np.median(near))
    if float(np.median(np.abs(near - middle))) > _STEADY_S or abs(middle) < 1.0:
        return offset
    return Offset(
        offset.seconds + middle,
        f"{offset.how}, clock {middle:+.0f} s from {len(near)} timed brackets",
    )


def match_groups(
    groups: Sequence[Group], slots: Sequence[Slot], offset: Offset
) -> tuple[list[Match], list[Unmatched]]:
    """Each slot gets the group near it that holds most of its exposures; the rest is reported
    with its reason.
    """
    matches: dict[str, Match] = {}
    unmatched: list[Unmatched] = []
    for group in groups:
        t_utc = true_time(group.t_camera, offset)
        slot = min(slots, key=lambda s: abs((s.t_utc - t_utc).total_seconds()), default=None)
        if slot is None or abs((t_utc - slot.t_utc).total_seconds()) > WITHIN_S:
            unmatched.append(Unmatched(group, f"no slot within {WITHIN_S / 60:.0f} min"))
            continue
        need = 2 if len(slot.exposures) > 1 else 1
        if fits(group, slot) < min(need, len(slot.exposures)):
            unmatched.append(Unmatched(group, "exposures are not the plan's"))
            continue
        found, rival = (
            Match(slot, group, (t_utc - slot.t_utc).total_seconds()),
            matches.get(slot.id),
        )
        if rival is not None:
            better = (fits(group, slot), -abs(found.late_s)) > (
                fits(rival.group, slot),
                -abs(rival.late_s),
            )
            unmatched.append(
                Unmatched(
                    rival.group if better else group, f"another bracket fits {slot.id} better"
                )
            )
            if not better:
                continue
        matches[slot.id] = found
    return sorted(matches.values(), key=lambda m: m.slot.t_utc), unmatched


def true_time(t_camera: datetime, offset: Offset) -> datetime:
    return (t_camera - timedelta(seconds=offset.seconds)).astimezone(UTC)
