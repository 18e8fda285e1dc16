"""Detect unmarked changes of the room, by comparing captures with those of all other days.

Three kinds are searched: a lamp that was on in the mornings or evenings of some days; days or parts
of days of another level of light (`other_level`); and captures, days or a season that contradict
the rest for another reason. In the remaining captures, regions with an object are searched
(`changed_regions`).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fieldlum.core.arrays import Floats, Mask
from fieldlum.learn.models.data import Dataset
from fieldlum.learn.train.agreement import (
    FEWEST_DAYS,
    PRICE,
    Process,
    Rows,
    Typical,
    deviations,
    disagreement,
    process_of,
    typical,
)
from fieldlum.learn.train.changed_regions import MovedObject, moved_object, object_pixels
from fieldlum.learn.train.other_level import (
    MOST_SHARE,
    blocks_of,
    captures_of_other_level,
    cheapest_set,
    days_and_pairs,
)
from fieldlum.learn.transport.seasons import seasons
from fieldlum.sky import sun

# Least gain of a lamp or of omitting captures (difference of log costs). Nine rooms without a
# change reach 10; lamps of 10 cd/m2 reach 93 to 285; a blind half down on one day 87 to 106
# (docs/validation.md).
_LEAST_GAIN = 25.0
_LAMP_PRICE = 1.0  # cost of a capture with a lamp; less than PRICE, because its light is explained
# local standard times from which lamps may be on; chosen
_EVENINGS_H = (14.0, 15.0, 16.0, 17.0, 18.0)
_MORNINGS_H = (8.0, 9.0, 10.0)  # local standard times until which lamps may be on; chosen
_MOST_DAYS = 40  # with more days, a lamp is not searched, for time; chosen
_NOISE = 1e-2  # relative variance with which other days predict what is reported; chosen
_SUSPECT = 0.1  # of the limits: deviations that a change elsewhere may hide; chosen
# largest share of captures that may be omitted if no common factor explains them; chosen
_MOST_SHARE = 1.0 / 3.0


@dataclass(frozen=True, slots=True)
class RoomChanges:
    """The captures in which the room was not as usual, although they are not marked.

    lamp: indices of captures in which a lamp was on; unexplained: indices of captures that
    contradict the others for another reason; complete_days: days that are in `unexplained` with all
    their captures; factor: measured light over that predicted from the other days, median over the
    picture, of each of all n captures [n].
    """

    lamp: Rows
    unexplained: Rows
    complete_days: tuple[Any, ...]
    factor: Floats


_NO_ROWS = np.empty(0, np.intp)


def without_changes(data: Dataset, *, with_patch: bool) -> tuple[Dataset, list[str]]:
    """Return the captures without those of a changed room, and a warning for each change.

    Captures with an unmarked lamp and captures that contradict the others are omitted. Pixels that
    an object darkens in a capture get weight 0 in that capture. A moved piece of furniture only
    gives a warning. with_patch: use the sun patches of `data`.
    """
    notes: list[str] = []
    changes = find_changes(data, with_patch=with_patch)
    if changes is not None:
        changed = np.union1d(changes.lamp, changes.unexplained)
        notes = _warnings(data, changes)
        data = data.take(np.setdiff1d(np.arange(len(data)), changed))
    if len(np.unique(data.days)) < FEWEST_DAYS:
        return data, notes
    objects = object_pixels(data, with_patch=with_patch)
    rows = np.flatnonzero(objects.any(axis=(1, 2)))
    if len(rows):
        notes.append(
            f"WARNING: in {len(rows)} of {len(data)} captures a part of the picture is darker "
            "than the other captures predict: a person, an object or clipped highlights. The model "
            f"does not learn from these pixels; look at the captures: {_slots(data, rows)}"
        )
        counts = np.ones(objects.shape, np.float16) if data.counts is None else data.counts
        data = replace(data, counts=np.where(objects, np.float16(0.0), counts))
    moved = moved_object(data, with_patch=with_patch)
    return data, [*notes, *([] if moved is None else [_moved_warning(moved)])]


def _moved_warning(moved: MovedObject) -> str:
    return (
        f"WARNING: from {moved.day} on, for the same light outside, the room is "
        f"{moved.factor:.2f} times as bright as on the days before, in a region of "
        f"{moved.size_sr:.2f} sr at azimuth {moved.azimuth_deg:.0f}, altitude "
        f"{moved.altitude_deg:.0f} degrees: a piece of furniture was probably "
        "moved or added. The model is a mean of both states; for a model "
        "of one state, set ok = 0 in pairs.csv for the days before or after, and train again"
    )


def find_changes(data: Dataset, *, with_patch: bool) -> RoomChanges | None:
    """Return the captures of a changed room; None if there is no change, or under four days.

    with_patch: use the sun patches of `data`.
    """
    if len(np.unique(data.days)) < FEWEST_DAYS:
        return None
    process = process_of(data, with_patch=with_patch)
    if not process.shows_exceptions:
        return None
    # Clouds hide a lamp, so it is searched for under the skies that the windows showed. A blind
    # looks like a dark sky there: captures that contradict the rest are found under Perez's.
    clouded = process_of(data, with_patch=with_patch, seen_skies=True)
    hours = _hours(data)
    lamp, lit = find_lamp(clouded, hours)
    is_always_lit = len(lit) > len(lamp)
    unexplained, complete_days = find_unexplained(process.with_lamp(lit), hours)
    if len(unexplained) and not is_always_lit:
        # Changed captures can hide a lamp, and make other captures look lit.
        rest = np.setdiff1d(np.arange(len(data)), unexplained)
        usual = process_of(data.take(rest), with_patch=with_patch, seen_skies=True)
        before = np.flatnonzero(np.isin(rest, lit))
        lamp, lit = (rest[rows] for rows in find_lamp(usual, hours[rest], before))
    process = process.with_lamp(lit)
    if not len(lamp) and not len(unexplained):
        return None
    rest = np.setdiff1d(np.flatnonzero(process.judged), unexplained)
    return RoomChanges(lamp, unexplained, complete_days, process.factor(rest, _NOISE))


def _warnings(data: Dataset, changes: RoomChanges) -> list[str]:
    """Return a warning about the lamp, about each complete day, and about other captures."""
    notes = []
    if len(changes.lamp):
        days = ", ".join(sorted({str(data.days[row]) for row in changes.lamp}))
        notes.append(
            f"WARNING: {len(changes.lamp)} of {len(data)} captures ({days}) have the same "
            "additional "
            "light: a lamp was on, but not marked. These captures are not used; to learn the "
            "lamp, mark them (fieldlum status SESSION --mark SLOT lamp=on) and train again: "
            f"{_slots(data, changes.lamp)}"
        )
    groups = [(str(day), np.flatnonzero(data.days == day)) for day in changes.complete_days]
    whole = np.array([day in changes.complete_days for day in data.days[changes.unexplained]], bool)
    if not whole.all():
        groups.append(("", changes.unexplained[~whole]))
    for day, rows in groups:
        subject = (
            f"the {len(rows)} captures of {day}" if day else f"{len(rows)} of {len(data)} captures"
        )
        verbs = ("contradicts", "is") if len(rows) == 1 else ("contradict", "are")
        notes.append(
            f"WARNING: {subject} {verbs[0]} the other days and {verbs[1]} not used: the median "
            f"light is {np.median(changes.factor[rows]):.2f} times the predicted light. "
            "Possible causes are a moved blind, a lamp, snow or wrong irradiance; look at "
            "the pictures, mark what was different (fieldlum status SESSION --mark SLOT "
            f"blind=half), and train again: {_slots(data, rows)}"
        )
    return notes


def _slots(data: Dataset, rows: Rows) -> str:
    return ", ".join(data.slots[row] for row in rows)


def _hours(data: Dataset) -> Floats:
    """Return the local standard time, [n] h."""
    times = [sun.standard_time(t, data.setup.site.timezone) for t in data.light.t_utc]
    return np.array([t.hour + t.minute / 60.0 for t in times])


# ----------------------------------------------------------------------------------------------
# a lamp


def find_lamp(process: Process, hours: Floats, before: Rows = _NO_ROWS) -> tuple[Rows, Rows]:
    """Return the captures to omit because of a lamp, and all captures with a lamp, as indices.

    Both are the same for a lamp that is on in some mornings or evenings only. A lamp that is on in
    all captures is part of the room: the first result is then empty, the second has all captures
    that can be judged. Both are empty without a lamp, and with over 40 days, because the search
    would be slow. hours: local standard time of each capture [n] h. before: captures with a lamp by
    a search among more captures, which half of the evidence confirms.
    """
    rows = np.flatnonzero(process.judged)
    if len(np.unique(process.days)) > _MOST_DAYS:
        return _NO_ROWS, _NO_ROWS
    usual = typical(process, rows)
    without = disagreement(process, rows, usual)

    def cost(lit: Rows) -> float:
        if not len(lit):
            return without
        if process.lamp_light(lit, usual.noise) <= 0.0:
            return np.inf  # infinite, because the lamp was on in the other captures
        price = _LAMP_PRICE * len(lit)
        return disagreement(process.with_lamp(lit), rows, usual) + price

    blocks = [hours >= h for h in _EVENINGS_H] + [hours < h for h in _MORNINGS_H]
    lit_days = [_lit_days(process, block & process.judged, cost) for block in blocks]
    best = min(lit_days, key=cost)
    always = process.with_lamp(rows)
    if without - disagreement(always, rows, usual) > max(_LEAST_GAIN, without - cost(best)):
        return _NO_ROWS, rows
    if without - cost(best) < _LEAST_GAIN:
        lit = before if without - cost(before) > _LEAST_GAIN / 2.0 else _NO_ROWS
        return lit, lit
    lit = _each_capture(process, best, cost)
    return lit, lit


def _lit_days(process: Process, block: Mask, cost: Callable[[Rows], float]) -> Rows:
    """Return the captures of a block of hours [n], on the days on which a lamp explains most."""
    days = np.unique(process.days[block])
    of_days = [np.flatnonzero(block & (process.days == day)) for day in days]
    return cheapest_set(days_and_pairs(of_days), cost)


def _each_capture(process: Process, lit: Rows, cost: Callable[[Rows], float]) -> Rows:
    """Return `lit` after adding or removing single captures where this explains more."""
    best = cost(lit)
    for row in np.flatnonzero(process.judged):
        other = np.setxor1d(lit, [row])
        price = 2.0 * PRICE if len(other) > len(lit) else 0.0
        if (changed := cost(other)) + price < best:
            best, lit = changed, other
    return lit


# ----------------------------------------------------------------------------------------------
# captures that contradict the rest


def find_unexplained(process: Process, hours: Floats) -> tuple[Rows, tuple[Any, ...]]:
    """Return the indices of captures that contradict the others, and the complete days among them.

    Captures of another level (at most half of all), and captures, days, parts of days or seasons
    that contradict the rest (at most a third) are removed one after the other, as long as at least
    four days remain. hours: local standard time of each capture [n] h.
    """
    judged = np.flatnonzero(process.judged)
    rows, whole = judged, []
    while len(np.unique(process.days[rows])) >= FEWEST_DAYS:
        usual, gone = typical(process, rows), len(judged) - len(rows)
        blocks = blocks_of(process.days, hours, rows)
        unit = captures_of_other_level(process, rows, usual, blocks)
        if unit is None or gone + len(unit) > MOST_SHARE * len(judged):
            unit = _worst_unit(process, rows, usual, blocks)
            if unit is None or gone + len(unit) > _MOST_SHARE * len(judged):
                break
        for day in np.unique(process.days[unit]):
            of_day = rows[process.days[rows] == day]
            if len(of_day) > 1 and np.isin(of_day, unit).all():
                whole.append(day)
        rows = np.setdiff1d(rows, unit)
    out = np.union1d(np.setdiff1d(judged, rows), _rows_of(process, whole))
    return out.astype(np.intp), tuple(whole)


def _rows_of(process: Process, days: Collection[Any]) -> Rows:
    return np.flatnonzero([day in days for day in process.days])


def _worst_unit(
    process: Process, rows: Rows, usual: Typical, blocks: Sequence[Rows]
) -> Rows | None:
    """Return the capture, block or season without which the rest agrees best.

    Return None if omitting each of them gains too little.
    """
    captures, days = deviations(process, rows, usual)
    if max(captures.max(), *days.values()) <= 1.0:
        return None
    units = [np.array([row]) for row in rows[captures > _SUSPECT]]
    suspect = [day for day, size in days.items() if size > _SUSPECT]
    units += [rows[process.days[rows] == day] for day in suspect]
    units += [block for block in blocks if process.days[block[0]] in suspect]
    season = seasons(process.days)[rows]
    if season.max() > 0:  # snow is in all days of a winter
        units += [rows[season == k] for k in np.unique(season)]
    now = disagreement(process, rows, usual)
    gains = [
        now - disagreement(process, np.setdiff1d(rows, unit), usual) - PRICE * len(unit)
        for unit in units
    ]
    best = int(np.argmax(gains))
    return units[best] if gains[best] > _LEAST_GAIN else None
