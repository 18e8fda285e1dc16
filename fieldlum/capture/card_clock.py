"""Determine the UTC offset of a camera's clock: stated by the user, in EXIF, or fitted to the plan.

Days on which the clock was set during a campaign are detected too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import timedelta
from itertools import pairwise
from zoneinfo import ZoneInfo

import numpy as np

from fieldlum.capture.match_card import (
    WITHIN_S,
    CardFrame,
    Group,
    Offset,
    find_offset,
    fitting_offsets,
    late_s,
    refine_offset,
    split_at_gaps,
)
from fieldlum.core.errors import InputError
from fieldlum.core.records import SiteFile, Slot

# Not measured. Chosen because the brackets of a day follow each other within hours, and clocks are
# usually set between two days.
_NIGHT_S = 4 * 3600.0
_HOURS = range(-26, 27)  # civil time zones span UTC-12 to UTC+14: two of them differ by 26 h
_STEP_S = 1800.0  # a smaller change is drift of the clock; chosen
_SAME_OFFSET_S = 60.0  # EXIF states offsets in minutes
# A change of the clock counts only if it brings this many more brackets to slots. Not measured: two
# brackets can be early or late by chance.
_EVIDENCE = 3


def clock_offset(
    groups: Sequence[Group], slots: Sequence[Slot], setup: SiteFile, stated_s: float | None
) -> Offset:
    """Return the camera's clock minus UTC: as stated, else from EXIF, else fitted to the plan.

    A common delay of brackets that a timer started is added. Raises InputError if the fit finds no
    offset, or several of which none is UTC or the place's civil time.
    """
    if stated_s is not None:
        start = Offset(stated_s, "--utc-offset")
    elif tells_utc(groups):
        start = Offset(0.0, "stated in EXIF", _exif_offsets_s(groups))
    else:
        start = find_offset(groups, slots, _expected_s(groups, slots, setup))
    if start is None and not fitting_offsets(groups, slots):
        first, last = (min(g.t_camera for g in groups), max(g.t_camera for g in groups))
        near = min(slots, key=lambda slot: abs(slot.t_utc - first), default=None)
        raise InputError(
            "import",
            f"the brackets from {first:%Y-%m-%d %H:%M} to {last:%Y-%m-%d %H:%M} by the camera's "
            "clock match no slot of the plan",
            "brackets near slots, such as the slot nearest to the first bracket, at "
            f"{near.t_utc:%Y-%m-%d %H:%M} UTC"
            if near
            else "a plan with slots",
            "check that this is the right card; correct a wrong date, for example by one day: "
            'exiftool -AllDates+="0:0:1 0:0:0" FOLDER',
        )
    if start is None:
        raise InputError(
            "import",
            "several UTC offsets of the camera's clock fit the plan equally well",
            "one offset that fits best",
            "state the camera's offset, for example --utc-offset -08:00",
        )
    return refine_offset(groups, slots, start)


def tells_utc(groups: Sequence[Group]) -> bool:
    """Return whether EXIF states a UTC offset for every frame."""
    return all(f.exif_offset_s is not None for group in groups for f in group.frames)


def _exif_offsets_s(groups: Sequence[Group]) -> tuple[float, ...]:
    stated = {f.exif_offset_s for group in groups for f in group.frames}
    return tuple(sorted(offset_s for offset_s in stated if offset_s is not None))


def as_shown(frames: Sequence[CardFrame]) -> list[CardFrame]:
    """Return the frames with their times as the camera's clock showed them, not corrected by EXIF.

    A stated --utc-offset applies to the clock itself. exif_offset_s remains, for `contradiction`.
    """
    return [
        replace(f, t_camera=f.t_camera + timedelta(seconds=f.exif_offset_s or 0.0)) for f in frames
    ]


def contradiction(groups: Sequence[Group], slots: Sequence[Slot], stated_s: float) -> str:
    """Return a warning if EXIF's offset differs from the stated one by over a minute, else "".

    The warning states how many frames are within 20 minutes of slots with each of the two. groups:
    with times from `as_shown`; stated_s: clock minus UTC [s]. Without slots there is no warning.
    """
    own = [g for g in groups if g.frames[0].exif_offset_s is not None]
    offsets_s = _exif_offsets_s(own)
    if not slots or all(abs(offset_s - stated_s) <= _SAME_OFFSET_S for offset_s in offsets_s):
        return ""
    stated, exif = 0, 0
    for group in own:
        by_exif_s = group.frames[0].exif_offset_s or 0.0
        stated += len(group.frames) * _near([group], slots, stated_s)
        exif += len(group.frames) * _near([group], slots, by_exif_s)
    total = sum(len(group.frames) for group in own)
    text = (
        f"--utc-offset {hms(stated_s)} was used, but EXIF states UTC {hms_list(offsets_s)}: "
        f"with --utc-offset {stated} of {total} frames are near planned slots, with the offset in "
        f"EXIF {exif}"
    )
    if exif > stated:
        return (
            f"{text}; import the card again without --utc-offset, separately from the logger's file"
        )
    if exif == stated:
        return f"{text}; the plan fits both offsets equally: compare the camera's clock with UTC"
    return text


def hms(seconds: float) -> str:
    """Return an offset [s] as +HH:MM or -HH:MM, with :SS if the seconds are not zero."""
    minutes, rest = divmod(round(abs(seconds)), 60)
    return f"{'-' if seconds < 0 else '+'}{minutes // 60:02d}:{minutes % 60:02d}" + (
        f":{rest:02d}" if rest else ""
    )


def hms_list(offsets_s: Sequence[float]) -> str:
    """Return offsets [s] as text, such as "-08:00 and -07:00"."""
    return " and ".join(hms(offset_s) for offset_s in offsets_s)


def _near(groups: Sequence[Group], slots: Sequence[Slot], offset_s: float) -> int:
    """Return the number of brackets that are near slots if the clock has this offset."""
    return int(np.sum(np.abs(late_s(groups, slots, offset_s)) <= WITHIN_S))


def _expected_s(groups: Sequence[Group], slots: Sequence[Slot], setup: SiteFile) -> list[float]:
    """Return the likely values of the camera's clock minus UTC [s], most likely first.

    These are the UTC offsets of the place on the days of the brackets, then those of the plan, then
    zero.
    """
    zone = ZoneInfo(setup.site.timezone)
    days = {group.t_camera.date() for group in groups}
    near = [slot for slot in slots if slot.t_utc.date() in days]
    then, ever = (
        [(slot.t_utc.astimezone(zone).utcoffset() or timedelta()).total_seconds() for slot in some]
        for some in (near, slots)
    )
    return [
        *sorted(set(then), key=lambda o: -then.count(o)),
        *sorted(set(ever), key=lambda o: -ever.count(o)),
        0.0,
    ]


def clock_parts(groups: Sequence[Group], slots: Sequence[Slot]) -> list[list[Group]]:
    """Split the brackets, in order of time, at days where the camera's clock was set by hours.

    An example is daylight saving time. With hourly slots such a change is hard to see: brackets
    that are an hour off match the neighbouring slots, except at the ends of a day. Return the
    fewest parts that the brackets support: each change must bring at least three more brackets near
    slots. groups: not empty.
    """
    days = split_at_gaps(groups, _NIGHT_S)
    hits = hits_by_hour(days, slots)
    path = _steadiest(hits)
    parts: list[list[Group]] = []
    for k, day in enumerate(days):
        if k == 0 or path[k] != path[k - 1]:
            parts.append([])
        parts[-1] += day
    return parts


def hits_by_hour(days: Sequence[Sequence[Group]], slots: Sequence[Slot]) -> np.ndarray:
    """Return how many brackets of each day are near slots, for each clock offset [days, 53].

    Near is within 20 minutes. Offsets are -26 to 26 hours from a base: the minutes of the quarter
    of an hour that fits all brackets best.
    """
    everything = [group for day in days for group in day]
    base = next(iter(fitting_offsets(everything, slots)), 0.0) % 3600.0
    return np.array([[_near(day, slots, base + 3600.0 * hour) for hour in _HOURS] for day in days])


def _steadiest(hits: np.ndarray) -> list[int]:
    """Return the best offset of each day, as an index of hours.

    The sum of brackets near slots is maximised, minus `_EVIDENCE` for each change between days.
    """
    value, came = hits[0].astype(float), []
    for day in hits[1:]:
        best = int(np.argmax(value))
        change = value[best] - _EVIDENCE >= value
        came.append(np.where(change, best, np.arange(len(value))))
        value = np.where(change, value[best] - _EVIDENCE, value) + day
    path = [int(np.argmax(value))]
    for previous in reversed(came):
        path.append(int(previous[path[-1]]))
    return path[::-1]


def clock_steps(clocks: Sequence[tuple[Sequence[Group], Offset]]) -> list[str]:
    """Return a note on each change of the camera's clock by over half an hour between two parts.

    clocks: brackets of each part, in order of time, with the fitted offset. Brackets that were
    taken an hour early on some days look the same.
    """
    notes: list[str] = []
    for (before, old), (after, new) in pairwise(clocks):
        step_s = new.seconds - old.seconds
        if abs(step_s) > _STEP_S:
            notes.append(
                f"the plan suggests that the camera's clock was changed by {step_s / 3600:+.3g} h "
                f"between {before[-1].frames[0].path} and {after[0].frames[0].path}, and the "
                "brackets before and after were imported with different offsets; if the clock was "
                "not changed, but brackets were taken at other hours than planned, state "
                "--utc-offset"
            )
    return notes


def doubt(groups: Sequence[Group], slots: Sequence[Slot], offset: Offset) -> str:
    """Return why the plan contradicts a clock offset, or "".

    Two errors are detected: an offset that is wrong by full hours, up to 26 (time zone or date),
    and a clock that was set between brackets. groups: in order of time.
    """
    shifts = [3600.0 * hour for hour in _HOURS]
    hits = [_near(groups, slots, offset.seconds + s) for s in shifts]
    as_it_is, best = hits[shifts.index(0.0)], int(np.argmax(hits))
    if hits[best] >= as_it_is + _EVIDENCE:
        return (
            f"with the offset of the camera's clock ({offset.how}), {as_it_is} of {len(groups)} "
            f"brackets are near slots; with an offset changed by {shifts[best] / 3600:+g} h it "
            f"would be {hits[best]}: check the camera's clock and date, and state --utc-offset"
        )
    parts = clock_parts(groups, slots)
    for before, after in pairwise(parts):
        return (
            f"one clock offset ({offset.how}) was used for all brackets, but the plan suggests "
            f"that the camera's clock was changed between {before[-1].frames[0].path} and "
            f"{after[0].frames[0].path}: import these two parts from separate folders, each with "
            "its own --utc-offset"
        )
    return ""
