"""What a card's camera clock was: told, in the frames, or fitted to the plan; and where it was
set in between.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import timedelta
from itertools import pairwise
from zoneinfo import ZoneInfo

import numpy as np

from fieldlum.capture.match_card import (
    WITHIN_S,
    Group,
    Offset,
    find_offset,
    fitting_offsets,
    late_s,
    refine_offset,
)
from fieldlum.errors import InputError
from fieldlum.records import SiteFile, Slot

_NIGHT_S = 4 * 3600.0  # a clock is set between two days, for brackets of one day follow each other
_HOURS = range(-26, 27)
_STEP_S = 1800.0  # less is a clock that drifts
_EVIDENCE = (
    3  # brackets more that another whole hour must bring to slots before a clock counts as set
)


def clock_offset(
    groups: Sequence[Group], slots: Sequence[Slot], setup: SiteFile, told_s: float | None
) -> Offset:
    """How far the camera's clock is from UTC: as told, as the frames say, else as it fits the plan.

    Raises InputError when that is ambiguous.
    """
    if told_s is not None:
        start = Offset(told_s, "--utc-offset")
    elif tells_utc(groups):
        start = Offset(0.0, "the frames' own UTC offset")
    else:
        start = find_offset(groups, slots, _expected_s(groups, slots, setup))
    if start is None and not fitting_offsets(groups, slots):
        first, last = (min(g.t_camera for g in groups), max(g.t_camera for g in groups))
        near = min(slots, key=lambda slot: abs(slot.t_utc - first), default=None)
        raise InputError(
            "import",
            f"brackets of {first:%Y-%m-%d %H:%M} to {last:%Y-%m-%d %H:%M} by the camera's clock",
            f"the plan's slots, the nearest at {near.t_utc:%Y-%m-%d %H:%M} UTC"
            if near
            else "a plan with slots",
            "is it another card? a wrong date is set right by exiftool -AllDates",
        )
    if start is None:
        raise InputError(
            "import",
            "several UTC offsets of the camera's clock fit the plan alike",
            "the camera's offset from UTC",
            "give it, like: --utc-offset -08:00",
        )
    return refine_offset(groups, slots, start)


def tells_utc(groups: Sequence[Group]) -> bool:
    return all(frame.known_utc for group in groups for frame in group.frames)


def _expected_s(groups: Sequence[Group], slots: Sequence[Slot], setup: SiteFile) -> list[float]:
    """The place's offsets while these brackets were taken, most frequent first, then those of
    the plan, then UTC.
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
    """Brackets parted between two days where the camera's clock was set by whole hours, for
    daylight saving say.

    Hourly slots look like each other: brackets an hour off lie in their neighbours' slots. What
    tells are the ends of the days, where one of them then lies beside the plan. The fewest settings
    that the brackets support: each must bring three brackets more to slots.
    """
    days: list[list[Group]] = []
    for group in groups:
        if days and (group.t_camera - days[-1][-1].t_camera).total_seconds() < _NIGHT_S:
            days[-1].append(group)
        else:
            days.append([group])
    hits = hits_by_hour(days, slots)
    path = _steadiest(hits)
    parts: list[list[Group]] = []
    for k, day in enumerate(days):
        if k == 0 or path[k] != path[k - 1]:
            parts.append([])
        parts[-1] += day
    return parts


def hits_by_hour(days: Sequence[Sequence[Group]], slots: Sequence[Slot]) -> np.ndarray:
    """Brackets of each day near slots [days, hours], were the camera's clock so many whole hours
    before the base.

    The base is the quarter of an hour that fits all of them best.
    """
    everything = [group for day in days for group in day]
    base = next(iter(fitting_offsets(everything, slots)), 0.0) % 3600.0
    return np.array(
        [
            [
                np.sum(np.abs(late_s(day, slots, base + 3600.0 * hour)) <= WITHIN_S)
                for hour in _HOURS
            ]
            for day in days
        ]
    )


def _steadiest(hits: np.ndarray) -> list[int]:
    """The hour of each day (an index) with most hits, less `_EVIDENCE` for each change from one
    day to the next.
    """
    value, came = hits[0].astype(float), []
    for day in hits[1:]:
        best = int(np.argmax(value))
        change = value[best] - _EVIDENCE > value
        came.append(np.where(change, best, np.arange(len(value))))
        value = np.where(change, value[best] - _EVIDENCE, value) + day
    path = [int(np.argmax(value))]
    for previous in reversed(came):
        path.append(int(previous[path[-1]]))
    return path[::-1]


def clock_steps(clocks: Sequence[tuple[Sequence[Group], Offset]]) -> list[str]:
    """A line for each clock that the plan says was set: a person who began an hour early for
    days looks the same.
    """
    said: list[str] = []
    for (before, old), (after, new) in pairwise(clocks):
        step_s = new.seconds - old.seconds
        if abs(step_s) > _STEP_S:
            said.append(
                f"{before[-1].frames[0].path} to {after[0].frames[0].path}: the camera's clock "
                f"was set by "
                f"{step_s / 3600:+.3g} h between them, says the plan; if it was not, and brackets "
                f"were taken at other "
                "hours, give --utc-offset"
            )
    return said


def doubt(groups: Sequence[Group], slots: Sequence[Slot], offset: Offset) -> str:
    """What the plan says against an offset that was told, stands in the frames, or fits best of all
    civil ones.

    Empty where nothing. A camera whose date is a day off is seen here: no zone is as far away.
    """
    shifts = [3600.0 * hour for hour in _HOURS]
    hits = [
        int(np.sum(np.abs(late_s(groups, slots, offset.seconds + s)) <= WITHIN_S)) for s in shifts
    ]
    as_it_is, best = hits[shifts.index(0.0)], int(np.argmax(hits))
    if hits[best] >= as_it_is + _EVIDENCE:
        return (
            f"{offset.how}: {as_it_is} of {len(groups)} brackets lie near slots, with an offset "
            f"{shifts[best] / 3600:+g} h from this {hits[best]} would: check the camera's clock "
            f"and date"
        )
    parts = clock_parts(groups, slots)
    for before, after in pairwise(parts):
        return (
            f"{offset.how}, taken for all of them: the clock was set between "
            f"{before[-1].frames[0].path} and "
            f"{after[0].frames[0].path}, says the plan; import the two parts from folders of "
            f"their own"
        )
    return ""
