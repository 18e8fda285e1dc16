"""Match a card's brackets to slots: by exposures, by time, and by the camera's clock.

The offset of the clock from UTC is stated by the user, in EXIF, or fitted to the plan. Days on
which the clock was set during a campaign are detected too.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from itertools import chain, pairwise
from pathlib import Path
from typing import NamedTuple
from zoneinfo import ZoneInfo

import numpy as np

from fieldlum.core.errors import InputError
from fieldlum.core.records import Exposure, SiteFile, Slot, listed, utc_text
from fieldlum.optics.exposure import same_exposure

# Longest time between a slot and its bracket. Chosen: people start brackets minutes early or late,
# and slots are an hour apart.
MAX_DELAY_S = 1200.0
_QUARTER_S = 900.0  # civil clocks differ by multiples of a quarter of an hour (IANA tz database)


class CardFrame(NamedTuple):
    """A frame as EXIF describes it.

    path: of its file on the card; t_camera: time that the camera's clock showed, read as if it were
    UTC; if EXIF states the clock's offset and the user does not, it is UTC. exif_offset_s: the
    clock minus UTC [s] by EXIF, None if absent. camera: model; serial: of the body, "" if EXIF has
    none.
    """

    path: Path
    exposure: Exposure
    t_camera: datetime
    exif_offset_s: float | None = None
    camera: str = ""
    serial: str = ""


@dataclass(frozen=True, slots=True)
class Group:
    """The frames of one bracket on a camera's card, in order of time; at least one."""

    frames: tuple[CardFrame, ...]

    @property
    def t_camera(self) -> datetime:
        """Start of the bracket, the `t_camera` of its first frame."""
        return self.frames[0].t_camera


class Offset(NamedTuple):
    """The camera's clock minus UTC [s], and how it was determined.

    seconds: `CardFrame.t_camera` minus UTC. how: a clause for the user, such as "fitted to the
    plan". exif_s: offsets in EXIF [s], which are already subtracted from t_camera.
    """

    seconds: float
    how: str
    exif_s: tuple[float, ...] = ()


# Brackets of each part of a card, in order of time, with the offset of their clock.
Clocks = Sequence[tuple[Sequence[Group], Offset]]


class Match(NamedTuple):
    """A bracket on a card, and the planned slot it belongs to.

    late_s: true start minus planned start [s]; offset: of the camera's clock.
    """

    slot: Slot
    group: Group
    late_s: float
    offset: Offset


@dataclass(frozen=True, slots=True)
class Report:
    """Result of an import.

    brackets, frames: number of new ones; known: number of brackets imported before. offsets: the
    camera's clock minus UTC, for each campaign on the card. late_s: start of each bracket minus its
    slot's time [s]. left_out: sentences on files and brackets that were not imported. notes:
    sentences on imported brackets that may be wrong. slots: of the new brackets. moved: slots whose
    bracket of an earlier import was removed. rows, withdrawn: rows of a logger's file that were
    added, and removed.
    """

    brackets: int = 0
    frames: int = 0
    known: int = 0
    offsets: tuple[Offset, ...] = ()
    late_s: tuple[float, ...] = ()
    left_out: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    rows: int = 0
    withdrawn: int = 0
    slots: tuple[str, ...] = ()
    moved: tuple[str, ...] = ()


def group_frames(
    frames: Sequence[CardFrame], pattern: Sequence[Exposure] = (), headings: int = 1
) -> list[Group]:
    """Group a card's frames into brackets, in order of time.

    A new bracket begins after a pause, or with an exposure that the bracket already contains. The
    pause is over ten times this card's usual time between frames (60 times with several headings;
    both chosen), because a bracket can take from three seconds to two minutes.

    pattern: the plan's exposures. An exposure that is twice in the plan (once through a filter,
    which EXIF does not record) is expected twice. headings: number of headings of a turned head;
    each exposure is expected once for each.
    """
    # Frames of one second are in order of the camera's file number, four digits at the name's end.
    ordered = sorted(frames, key=lambda f: (f.t_camera, f.path.stem[-4:], f.path.name))
    gaps_s = _pauses_s(ordered)
    usual_s = max(float(np.median(gaps_s)), 1.0) if gaps_s else 1.0
    pause_s = usual_s * (60.0 if headings > 1 else 10.0)
    groups: list[list[CardFrame]] = []
    for frame, gap_s in zip(ordered, (0.0, *gaps_s), strict=False):
        if groups:
            present = sum(same_exposure(f.exposure, frame.exposure) for f in groups[-1])
            expected = max(1, sum(same_exposure(e, frame.exposure) for e in pattern)) * headings
            if gap_s <= pause_s and present < expected:
                groups[-1].append(frame)
                continue
        groups.append([frame])
    return [Group(tuple(group)) for group in groups]


def _pauses_s(frames: Sequence[CardFrame]) -> list[float]:
    """Return the time from the end of each frame to the next one [s]."""
    times = [(frame.t_camera.timestamp(), frame.exposure.shutter_s) for frame in frames]
    return [t - (before + shutter_s) for (before, shutter_s), (t, _) in pairwise(times)]


def split_at_gaps(groups: Sequence[Group], gap_s: float = 5 * 86400.0) -> list[list[Group]]:
    """Split brackets where one begins at least `gap_s` after the previous one; return the parts.

    groups: in order of time. By default, five days separate campaigns, between which the camera's
    clock may have been set.
    """
    times_s = [group.t_camera.timestamp() for group in groups]
    starts = np.flatnonzero(np.diff(times_s, prepend=-np.inf) >= gap_s).tolist()
    return [list(groups[start:end]) for start, end in pairwise([*starts, len(groups)])]


def planned_indices(group: Group, planned: Sequence[Exposure]) -> list[int | None]:
    """Return the index in `planned` of each frame's exposure; None for one that is not planned.

    EXIF does not state filters: frames of equal exposures get these indices in order, and surplus
    frames get the last of them. group: frames of one heading; planned: exposures of one.
    """
    indices: list[int | None] = []
    for frame in group.frames:
        alike = [k for k, exposure in enumerate(planned) if same_exposure(exposure, frame.exposure)]
        unused = [k for k in alike if k not in indices]
        indices.append((unused or alike[-1:] or [None])[0])
    return indices


def split_by_heading(group: Group, planned: Sequence[Exposure], headings: int) -> list[Group]:
    """Split a turned head's bracket into the frames of each heading; the last ones can be empty.

    EXIF does not state headings, frames can be missing, and their order can differ from the plan's.
    The split is that which covers most exposures, then that with the fewest headings, then that at
    the longest pauses and largest steps of exposure (one planned exposure counts as one second).
    planned: exposures of one heading; headings: their number.
    """

    def kind(exposure: Exposure) -> int:
        """Return the first index of an exposure in `planned`, -1 if it is not planned."""
        return next((k for k, e in enumerate(planned) if same_exposure(e, exposure)), -1)

    wanted, kinds = Counter(map(kind, planned)), [kind(f.exposure) for f in group.frames]
    turns = [0.0, *np.add(_pauses_s(group.frames), np.abs(np.diff(kinds)))]  # before each frame

    def score(start: int, end: int) -> float:
        """Return the score of some frames as those of one heading; 0 for none."""
        covered = (Counter(kinds[start:end]) & wanted).total()
        return 1e6 * covered + turns[start] - 1e4 if start < end else 0.0

    # By a number of frames: the score of the best split of these first ones, and the headings' ends
    best: dict[int, tuple[float, tuple[int, ...]]] = {0: (0.0, (0,))}
    for _ in range(headings):
        best = {
            end: max((s + score(k, end), (*ends, end)) for k, (s, ends) in best.items() if k <= end)
            for end in range(len(kinds) + 1)
        }
    return [Group(group.frames[a:b]) for a, b in pairwise(best[len(kinds)][1])]


def delays_s(groups: Sequence[Group], slots: Sequence[Slot], offset_s: float) -> np.ndarray:
    """Return the start of each bracket minus that of its nearest slot, [n] s; negative if early.

    groups: n brackets; slots: at least one; offset_s: the camera's clock minus UTC [s].
    """
    slots_s = np.array([slot.t_utc.timestamp() for slot in slots])
    starts_s = np.array([group.t_camera.timestamp() for group in groups]) - offset_s
    return starts_s - slots_s[np.abs(starts_s[:, None] - slots_s[None, :]).argmin(axis=1)]


def fitting_offsets(groups: Sequence[Group], slots: Sequence[Slot]) -> list[float]:
    """Return the offsets of the camera's clock [s] with which most brackets are near slots.

    Near means within 7.5 minutes. Offsets, clock minus UTC, are multiples of a quarter of an hour,
    from -12 to 14 hours; all that fit equally well are returned. The list is empty if no bracket is
    near a slot with any of them.
    """
    if not groups or not slots:
        return []
    offsets_s = _QUARTER_S * np.arange(-12 * 4, 14 * 4 + 1)
    distances_s = np.abs([delays_s(groups, slots, o) for o in offsets_s])  # [offsets, brackets]
    counts = np.sum(distances_s <= _QUARTER_S / 2, axis=1)  # [offsets]
    return offsets_s[counts == counts.max()].tolist() if counts.max() > 0 else []


def find_offset(
    groups: Sequence[Group], slots: Sequence[Slot], expected_s: Sequence[float]
) -> Offset | None:
    """Return the camera's clock minus UTC, fitted to the plan.

    groups: the card's brackets; slots: of the plan; expected_s: likely offsets [s], most likely
    first: the first that fits is used if several offsets fit equally well, or if as many brackets
    are within 20 minutes of slots with it, mostly later and with different delays: people start
    late. Return None if no offset fits, or if several fit and none of them is expected.
    """
    fitting_s = fitting_offsets(groups, slots)
    rivals = [_near_slots(groups, slots, offset_s) for offset_s in fitting_s]
    usual_s = [offset_s for offset_s in expected_s[:1] if offset_s not in fitting_s]
    late_s = delays_s(groups, slots, usual_s[0]) if usual_s and rivals else np.zeros(0)
    late_s = late_s[np.abs(late_s) <= MAX_DELAY_S]
    # A wrong clock makes all brackets early or late alike. A sixth of the median: chosen.
    if len(late_s) >= max(rivals, default=1) and np.std(late_s) > np.median(late_s) / 6.0 > 0.0:
        how = f"civil time of the place; UTC {offsets_text(fitting_s)} would fit the plan better"
        return Offset(usual_s[0], f"{how}: if you know the offset, state it with --utc-offset")
    if len(fitting_s) == 1:
        unusual = "" if fitting_s[0] in expected_s else ", but no civil time of the place: check it"
        return Offset(fitting_s[0], f"fitted to the plan{unusual}")
    chosen_s = next((offset_s for offset_s in expected_s if offset_s in fitting_s), None)
    if chosen_s is None:
        return None
    what = "civil time of the place" if chosen_s else "UTC"
    how = f"assumed to be {what}; other offsets would fit the plan too: if you know the offset, "
    return Offset(chosen_s, f"{how}state it with --utc-offset")


def refine_offset(groups: Sequence[Group], slots: Sequence[Slot], offset: Offset) -> Offset:
    """Return the offset, corrected by the brackets' median delay if their delays agree.

    Brackets that all start equally early or late were started by a timer, so that their delay is an
    error of the camera's clock. groups: the card's brackets; slots: of the plan. Only brackets
    within 20 minutes of a slot count. The offset is returned unchanged if these are fewer than
    three, if their median delay is under 1 s, or if the median deviation from it is over 5 s.
    """
    all_s = delays_s(groups, slots, offset.seconds)
    near_s = all_s[np.abs(all_s) <= MAX_DELAY_S]
    median_s = float(np.median(near_s)) if len(near_s) >= 3 else 0.0
    if abs(median_s) < 1.0 or float(np.median(np.abs(near_s - median_s))) > 5.0:
        return offset
    how = f"{offset.how}, corrected by {median_s:+.0f} s, the median of {len(near_s)} brackets"
    return offset._replace(seconds=offset.seconds + median_s, how=how)


def match_groups(
    clocks: Clocks, slots: Sequence[Slot]
) -> tuple[list[Match], list[tuple[Group, str]]]:
    """Match brackets to the nearest slot within 20 minutes.

    Return the matches in order of the slots, and each other bracket with the reason. clocks:
    brackets with the offset of their clock. A bracket must have two of the slot's exposures, or its
    only one. Of several brackets at one slot, that with the most of the slot's exposures is
    matched; of equal ones the nearest.
    """

    def count_planned(group: Group, slot: Slot) -> int:
        """Return how many of the slot's exposures a bracket has."""
        return len({*planned_indices(group, slot.exposures)} - {None})

    def misfit(match: Match) -> tuple[int, float]:
        """Return a key that is smallest for the best of several brackets at one slot.

        match: of one of them with this slot.
        """
        return -count_planned(match.group, match.slot), abs(match.late_s)

    matches: dict[str, Match] = {}
    others: list[tuple[Group, str]] = []
    for group, offset in ((group, offset) for part, offset in clocks for group in part):
        t_utc = true_time(group.t_camera, offset)
        when = f"({utc_text(t_utc)})"
        slot = min(slots, key=lambda s: abs((s.t_utc - t_utc).total_seconds()), default=None)
        if slot is None or abs((t_utc - slot.t_utc).total_seconds()) > MAX_DELAY_S:
            text = f"no slot within {MAX_DELAY_S / 60:.0f} min {when}"
            day = timedelta(hours=12)
            if slot is None or abs(t_utc - slot.t_utc) > day:  # no slot of this day is planned
                text += "; if its date is right: fieldlum plan SESSION --add DATE"
            others.append((group, text))
            continue
        if count_planned(group, slot) < min(2, len(slot.exposures)):
            others.append((group, f"at most one of its exposures is in the plan {when}"))
            continue
        match = Match(slot, group, (t_utc - slot.t_utc).total_seconds(), offset)
        best, *worse = sorted((m for m in (matches.get(slot.id), match) if m), key=misfit)
        others += [(m.group, f"another bracket fits {slot.id} better") for m in worse]
        matches[slot.id] = best
    return sorted(matches.values(), key=lambda m: m.slot.t_utc), others


def true_time(t_camera: datetime, offset: Offset) -> datetime:
    """Return a time of the camera's clock in UTC; offset: of that clock."""
    return (t_camera - timedelta(seconds=offset.seconds)).astimezone(UTC)


# ----------------------------------------------------------------------------------------------
# the camera's clock

# Not measured. Chosen because the brackets of a day follow each other within hours, and clocks are
# usually set between two days.
_NIGHT_S = 4 * 3600.0
_HOURS = range(-26, 27)  # civil time zones span UTC-12 to UTC+14: two of them differ by 26 h
# A change of the clock counts only if it brings this many more brackets near slots. Not measured:
# two brackets can be early or late by chance.
_EVIDENCE = 3
# When civil time changes, people set clocks by as much: then one bracket is enough. Chosen.
_CIVIL_EVIDENCE = 0.5
_CIVIL_NEAR = timedelta(hours=36)  # people set it within a day; half a day if the clock shows UTC


def clock_offset(
    groups: Sequence[Group], slots: Sequence[Slot], setup: SiteFile, stated_s: float | None
) -> Offset:
    """Return the camera's clock minus UTC: as the user states it, else from EXIF, else fitted.

    groups: the card's brackets in order of time; slots: of the plan, to which the offset is fitted;
    stated_s: the offset that the user states [s], None if none. The result is refined by
    `refine_offset`. Raises InputError if no offset fits, or if several do of which none is UTC or
    the place's civil time.
    """
    if stated_s is not None:
        offset = Offset(stated_s, "--utc-offset")
    elif exif_states_offset(groups):
        # `CardFrame.t_camera` is then UTC.
        exif_s, zone = _exif_offsets_s(groups), ZoneInfo(setup.site.timezone)
        civil = [g.t_camera.astimezone(zone).utcoffset() or timedelta() for g in groups]
        civil_s = sorted({offset.total_seconds() for offset in civil})
        text = f" (civil time of the place is UTC {offsets_text(civil_s)}: if the clock showed that"
        text = "" if {*exif_s} <= {*civil_s} else f"{text}, state --utc-offset)"
        offset = Offset(0.0, f"stated in EXIF{text}", exif_s)
    else:
        offset = find_offset(groups, slots, _expected_s(groups, slots, setup))
    if offset is not None:
        return refine_offset(groups, slots, offset)
    if fitting_offsets(groups, slots):
        found = "several UTC offsets of the camera's clock fit the plan equally well"
        remedy = "state the camera's offset, for example --utc-offset -08:00"
        raise InputError("the card", found, "one offset that fits best", remedy)
    first, last = groups[0].t_camera, groups[-1].t_camera
    nearest = min((slot.t_utc for slot in slots), key=lambda t: abs(t - first), default=None)
    span = f"the brackets from {first:%Y-%m-%d %H:%M} to {last:%Y-%m-%d %H:%M}"
    found = f"{span} by the camera's clock match no slot of the plan"
    expected = f"brackets near slots; that nearest to the first bracket is {str(nearest)[:16]} UTC"
    right = f"add their days: fieldlum plan SESSION --add {first:%Y-%m-%d}"
    wrong = 'correct them, for example by one day: exiftool -AllDates+="0:0:1 0:0:0" FOLDER'
    remedy = f"check that this is the right card; if its dates are right, {right}; if not, {wrong}"
    raise InputError("the card", found, expected, remedy)


def exif_states_offset(groups: Sequence[Group]) -> bool:
    """Return whether EXIF states the clock's offset from UTC for every frame."""
    return all(frame.exif_offset_s is not None for group in groups for frame in group.frames)


def _exif_offsets_s(groups: Sequence[Group]) -> tuple[float, ...]:
    """Return the different offsets from UTC [s] that EXIF states, smallest first."""
    stated = {frame.exif_offset_s for group in groups for frame in group.frames}
    return tuple(sorted(offset_s for offset_s in stated if offset_s is not None))


def exif_note(groups: Sequence[Group], stated_s: float | None) -> str:
    """Return a note if EXIF's offset differs by over a minute from that which the user states.

    groups: whose frames have EXIF; stated_s: the user's offset [s], None if none. The text is ""
    without such a difference.
    """
    offsets_s = _exif_offsets_s(groups)
    if stated_s is None or all(abs(offset_s - stated_s) <= 60.0 for offset_s in offsets_s):
        return ""
    exif = f"EXIF states UTC {offsets_text(offsets_s)}"
    stated = f"--utc-offset {offset_text(stated_s)} was used"
    return f"{stated}, but {exif}: if that is right, import without it"


def offset_text(seconds: float) -> str:
    """Return an offset [s] as +HH:MM or -HH:MM, with :SS if the seconds are not zero."""
    clock = f"{datetime.fromtimestamp(round(abs(seconds)), UTC):%H:%M:%S}"
    return ("-" if seconds < 0 else "+") + clock.removesuffix(":00")


def offsets_text(offsets_s: Sequence[float]) -> str:
    """Return offsets [s] as text, such as "-08:00 and -07:00"."""
    return " and ".join(offset_text(offset_s) for offset_s in offsets_s)


def _near_slots(groups: Sequence[Group], slots: Sequence[Slot], offset_s: float) -> int:
    """Return how many brackets are within 20 minutes of slots if the clock has this offset [s]."""
    return int(np.sum(np.abs(delays_s(groups, slots, offset_s)) <= MAX_DELAY_S))


def _expected_s(groups: Sequence[Group], slots: Sequence[Slot], setup: SiteFile) -> list[float]:
    """Return the likely values of the camera's clock minus UTC [s], most likely first.

    These are the UTC offsets of the place on the days of the brackets, then those on all days of
    the plan, then zero.
    """
    zone = ZoneInfo(setup.site.timezone)
    days = {group.t_camera.date() for group in groups}
    offsets = [(slot, slot.t_utc.astimezone(zone).utcoffset() or timedelta()) for slot in slots]
    on_days = Counter(offset for slot, offset in offsets if slot.t_utc.date() in days)
    in_plan = Counter(offset for _, offset in offsets)
    likely = [offset for offset, _ in (*on_days.most_common(), *in_plan.most_common())]
    return [offset.total_seconds() for offset in (*likely, timedelta())]


def clock_parts(groups: Sequence[Group], slots: Sequence[Slot], zone: str) -> list[list[Group]]:
    """Split the brackets at days on which the camera's clock was set by hours; return the parts.

    An example is daylight saving time. With hourly slots such a change is hard to detect: brackets
    that are an hour off match the neighbouring slots, except at the ends of a day. Return the
    fewest parts that the brackets support: each change must bring at least three more brackets near
    slots, or one if civil time in `zone` (IANA name) changed as much within 36 h and if no change
    elsewhere brings as many. Near means within 20 minutes. groups: in order of time, at least one;
    slots: of the plan, at least one.
    """
    days = split_at_gaps(groups, _NIGHT_S)
    # All offsets have the minutes of the offset that fits all brackets best, and any full hours.
    minutes_s = next(iter(fitting_offsets(groups, slots)), 0.0) % 3600.0
    offsets_s = [minutes_s + 3600.0 * hour for hour in _HOURS]
    near = np.array([[_near_slots(day, slots, offset_s) for offset_s in offsets_s] for day in days])
    civil_h = [
        _civil_h(after[0], zone, _CIVIL_NEAR) - _civil_h(before[-1], zone, -_CIVIL_NEAR)
        for before, after in pairwise(days)
    ]
    paths = [_best_path(near, changes) for changes in ([0] * len(civil_h), civil_h)]
    path = max(paths, key=lambda path: near[range(len(days)), path].sum())
    starts = [k for k in range(len(days)) if k == 0 or path[k] != path[k - 1]]
    return [list(chain(*days[start:end])) for start, end in pairwise([*starts, len(days)])]


def _civil_h(group: Group, zone: str, later: timedelta) -> int:
    """Return civil time minus UTC in `zone`, in full hours, a time `later` after a bracket."""
    moment = (group.t_camera + later).astimezone(ZoneInfo(zone))
    return round((moment.utcoffset() or timedelta()) / timedelta(hours=1))


def _best_path(near: np.ndarray, civil_h: Sequence[int]) -> list[int]:
    """Return the best clock offset of each day, as an index of hours (Viterbi's algorithm).

    near [days, hours]: numbers of brackets near slots. The sum of `near` over the days is
    maximised, minus `_EVIDENCE` for each change between days, or `_CIVIL_EVIDENCE` for one that
    equals `civil_h` [days - 1], the change of civil time [h].
    """
    # score [hours]: the highest sum of a path that ends at each hour on the present day.
    score, origins = near[0].astype(float), []
    same = np.arange(len(score))
    for of_day, civil in zip(near[1:], civil_h, strict=True):
        best = int(np.argmax(score))
        origin = np.where(score[best] - _EVIDENCE >= score, best, same)
        reached = np.maximum(score[best] - _EVIDENCE, score)
        before = np.clip(same - civil, 0, len(score) - 1)  # before the change of civil time
        follows = (civil != 0) & (score[before] - _CIVIL_EVIDENCE > reached)
        origins.append(np.where(follows, before, origin))
        score = np.where(follows, score[before] - _CIVIL_EVIDENCE, reached) + of_day
    path = [int(np.argmax(score))]
    for origin in reversed(origins):
        path.append(int(origin[path[-1]]))
    return path[::-1]


def clock_steps(clocks: Clocks) -> list[str]:
    """Return a note on each change of the camera's clock by over half an hour between two parts.

    clocks: brackets of each part, in order of time, with the fitted offset. Brackets that were
    taken an hour early on some days look the same.
    """
    return [
        f"the plan suggests that the camera's clock was changed by {step_s / 3600:+.3g} h before "
        f"{after[0].frames[0].path}, and each part was imported with its own offset; if brackets "
        "were taken at other hours than planned, state --utc-offset"
        for (_, old), (after, new) in pairwise(clocks)
        if abs(step_s := new.seconds - old.seconds) > 1800.0  # less is drift
    ]


def offset_contradiction(groups: Sequence[Group], slots: Sequence[Slot], offset: Offset) -> str:
    """Return why the plan contradicts an offset of the camera's clock; "" if it does not.

    offset: with which the brackets `groups` are imported; slots: of the plan. Two errors are
    detected: an offset that is wrong by full hours, up to 26 (time zone or date), and a clock that
    was set to other hours for some days. groups: in order of time.
    """
    hour, found = _better_hour(groups, slots, offset)
    if hour:
        remedy = "check the camera's clock and date, and state the right --utc-offset"
        if abs(hour) == 24:
            remedy = "WARNING: the dates are a day wrong: correct them and import again: "
            remedy += f'exiftool -AllDates{"+-"[hour > 0]}="0:0:1 0:0:0" FOLDER'
        return f"{found}: {remedy}"
    days = [(day, day[0].frames[0].path) for day in split_at_gaps(groups, _NIGHT_S)]
    better = [_better_hour(day, slots, offset, f" from {first} on") for day, first in days]
    doubts = listed([found for hour, found in better if hour], 2)
    remedy = "if the clock was set, import the frames of such days alone, with that option"
    return f"{doubts}: {remedy}" if doubts else ""


def _better_hour(
    groups: Sequence[Group], slots: Sequence[Slot], offset: Offset, of_day: str = ""
) -> tuple[int, str]:
    """Return the change of the clock's offset [h] that brings most brackets near slots, and a text.

    Of equal ones the smallest is returned; 0 if it brings fewer than `_EVIDENCE` more brackets near
    slots than the offset itself. On a day one is enough, if the change is at most 12 h and other
    brackets are near slots anyway: then the day is in the plan. of_day: the first file of such a
    day, for the text; "" for other brackets.
    """
    hours = sorted(_HOURS, key=abs)
    near = [_near_slots(groups, slots, offset.seconds + 3600.0 * hour) for hour in hours]
    hour = hours[near.index(max(near))]
    evidence = 1 if of_day and near[0] and abs(hour) <= 12 else _EVIDENCE
    in_exif_s = offset.exif_s or (0.0,)
    clock_s = in_exif_s[0] + offset.seconds + 3600.0 * hour
    option = f"--utc-offset {offset_text(clock_s)}"
    # No clock is over 14 h from UTC; one option cannot replace several offsets in EXIF.
    if len(in_exif_s) > 1 or abs(clock_s) > 14 * 3600.0 or abs(hour) == 24:
        option = f"an offset changed by {hour:+g} h"
    found = f"with the offset of the camera's clock ({offset.how}), {near[0]} of {len(groups)} "
    found += f"brackets{of_day} are near slots; with {option} it would be {max(near)}"
    return hour if max(near) >= near[0] + evidence else 0, found
