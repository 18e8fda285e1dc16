"""Match a card's brackets to slots: by exposures, by time, and by the camera's clock.

The offset of the clock from UTC is stated by the user, in EXIF, or fitted to the plan. Days on
which the clock was set during a campaign are detected too.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from itertools import chain, pairwise
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np

from fieldlum.core.errors import InputError
from fieldlum.core.records import Exposure, SiteFile, Slot, utc_text
from fieldlum.optics.exposure import same_exposure

# Each limit is chosen between the two cases that it must separate.
WITHIN_S = 1200.0  # a bracket started by hand further from its slot belongs to another hour
_QUARTER_S = 900.0  # civil clocks differ by multiples of a quarter of an hour (IANA tz database)


@dataclass(frozen=True, slots=True)
class CardFrame:
    """A frame as EXIF describes it.

    t_camera: the camera's clock, read as if it were UTC; with a known exif_offset_s it is UTC,
    unless the user states the clock's offset. exif_offset_s: the clock minus UTC [s], if EXIF
    states it. camera: model; serial: of the body, "" if EXIF has none.
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
    """Group frames into brackets, in order of time.

    A new bracket begins after a pause, or with an exposure that the bracket already contains. The
    pause is over ten times this card's usual time between frames (60 times with several headings),
    because a bracket can take from three seconds to two minutes.

    pattern: the plan's exposures. An exposure that is twice in the plan (once through a filter,
    which EXIF does not record) is expected twice. headings: number of headings of a turned head;
    each exposure is expected once for each.
    """
    # within a second by the camera's file number, the last four digits of the name
    ordered = sorted(frames, key=lambda f: (f.t_camera, f.path.stem[-4:], f.path.name))
    gaps_s = [
        (b.t_camera - a.t_camera).total_seconds() - a.exposure.shutter_s
        for a, b in pairwise(ordered)
    ]
    usual_s = max(float(np.median(gaps_s)), 1.0) if gaps_s else 1.0
    pause_s = usual_s * (60.0 if headings > 1 else 10.0)
    groups: list[list[CardFrame]] = []
    for frame, gap_s in zip(ordered, (0.0, *gaps_s), strict=False):
        if groups:
            present = sum(same_exposure(f.exposure, frame.exposure) for f in groups[-1])
            often = max(1, sum(same_exposure(e, frame.exposure) for e in pattern)) * headings
            if gap_s <= pause_s and present < often:
                groups[-1].append(frame)
                continue
        groups.append([frame])
    return [Group(tuple(group)) for group in groups]


def split_at_gaps(groups: Sequence[Group], gap_s: float = 5 * 86400.0) -> list[list[Group]]:
    """Split brackets, in order of time, between two that begin at least `gap_s` apart.

    By default they are split into campaigns, between which the camera's clock may have been set.
    """
    times_s = [group.t_camera.timestamp() for group in groups]
    starts = np.flatnonzero(np.diff(times_s, prepend=-np.inf) >= gap_s).tolist()
    return [list(groups[a:b]) for a, b in pairwise([*starts, len(groups)])]


def planned_indices(group: Group, planned: Sequence[Exposure]) -> list[int | None]:
    """Return which planned exposure each frame of a bracket is, as an index; None for another.

    EXIF states neither filter nor heading, so of equal exposures the first one is used first; a
    frame too many is the last of them.
    """
    indices: list[int | None] = []
    for frame in group.frames:
        alike = [k for k, exposure in enumerate(planned) if same_exposure(exposure, frame.exposure)]
        unused = [k for k in alike if k not in indices]
        indices.append((unused or alike[-1:] or [None])[0])
    return indices


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
    late = np.abs([late_s(groups, slots, c) for c in candidates])  # [candidates, n]
    hits = np.sum(late <= _QUARTER_S / 2, axis=1)
    return [float(c) for c in candidates[hits == hits.max()]] if hits.max() > 0 else []


def find_offset(
    groups: Sequence[Group], slots: Sequence[Slot], expected_s: Sequence[float]
) -> Offset | None:
    """Return the camera's clock minus UTC, fitted to the plan.

    groups: the card's brackets; slots: of the plan; expected_s: likely offsets, most likely first:
    the first that fits is used if several offsets fit equally well. Return None if no offset fits,
    or if several fit and none of them is expected.
    """
    among = fitting_offsets(groups, slots)
    if len(among) == 1:
        return Offset(among[0], "fitted to the plan")
    chosen = next((e for e in expected_s if e in among), None)
    if chosen is None:
        return None
    what = "civil time of the place" if chosen else "UTC"
    how = f"assumed to be {what}; other offsets would fit the plan too: if you know the offset, "
    return Offset(chosen, f"{how}state it with --utc-offset")


def refine_offset(groups: Sequence[Group], slots: Sequence[Slot], offset: Offset) -> Offset:
    """Refine the offset by the median delay, if three or more brackets start equally early or late.

    groups, slots: as for `find_offset`. Only brackets within 20 minutes of a slot count. Their
    delays must agree within 5 s (median deviation), and the median must be 1 s or more; else the
    offset is returned unchanged. Such brackets were started by a timer, so that their common delay
    is an error of the camera's clock.
    """
    late = late_s(groups, slots, offset.seconds)
    near = late[np.abs(late) <= WITHIN_S]
    middle = float(np.median(near)) if len(near) >= 3 else 0.0
    if abs(middle) < 1.0 or float(np.median(np.abs(near - middle))) > 5.0:
        return offset
    how = f"{offset.how}, corrected by {middle:+.0f} s, the median of {len(near)} brackets"
    return replace(offset, seconds=offset.seconds + middle, how=how)


def match_groups(
    clocks: Sequence[tuple[Sequence[Group], Offset]], slots: Sequence[Slot]
) -> tuple[list[Match], list[tuple[Group, str]]]:
    """Match brackets to the nearest slot within 20 minutes; return matches, and why others do not.

    clocks: brackets with the offset of their clock. Matches are in order of the slots. A bracket
    must have two of the slot's exposures, or its only one. Of several brackets at one slot, the one
    with most of the slot's exposures is matched, then the nearest.
    """

    def matching(group: Group, slot: Slot) -> int:
        return len({*planned_indices(group, slot.exposures)} - {None})

    def misfit(match: Match) -> tuple[int, float]:
        return -matching(match.group, match.slot), abs(match.late_s)

    matches: dict[str, Match] = {}
    others: list[tuple[Group, str]] = []
    for group, offset in ((group, offset) for part, offset in clocks for group in part):
        t_utc = true_time(group.t_camera, offset)
        when = f"({utc_text(t_utc)})"
        slot = min(slots, key=lambda s: abs((s.t_utc - t_utc).total_seconds()), default=None)
        if slot is None or abs((t_utc - slot.t_utc).total_seconds()) > WITHIN_S:
            others.append((group, f"no slot within {WITHIN_S / 60:.0f} min {when}"))
            continue
        if matching(group, slot) < min(2, len(slot.exposures)):
            others.append((group, f"at most one of its exposures is in the plan {when}"))
            continue
        match = Match(slot, group, (t_utc - slot.t_utc).total_seconds(), offset)
        best, *worse = sorted((m for m in (matches.get(slot.id), match) if m), key=misfit)
        others += [(m.group, f"another bracket fits {slot.id} better") for m in worse]
        matches[slot.id] = best
    return sorted(matches.values(), key=lambda m: m.slot.t_utc), others


def true_time(t_camera: datetime, offset: Offset) -> datetime:
    """Return a time by the camera's clock as UTC, with the clock's offset subtracted."""
    return (t_camera - timedelta(seconds=offset.seconds)).astimezone(UTC)


# ----------------------------------------------------------------------------------------------
# the camera's clock

# Not measured. Chosen because the brackets of a day follow each other within hours, and clocks are
# usually set between two days.
_NIGHT_S = 4 * 3600.0
_HOURS = range(-26, 27)  # civil time zones span UTC-12 to UTC+14: two of them differ by 26 h
# A change of the clock counts only if it brings this many more brackets to slots. Not measured: two
# brackets can be early or late by chance.
_EVIDENCE = 3
# By as much as civil time, and near its change, people set clocks: one bracket is enough. Chosen.
_CIVIL_EVIDENCE = 0.5
_CIVIL_NEAR = timedelta(hours=36)  # a day, and half a day for a clock that may be UTC


def clock_offset(
    groups: Sequence[Group], slots: Sequence[Slot], setup: SiteFile, stated_s: float | None
) -> Offset:
    """Return the camera's clock minus UTC: as stated, else from EXIF, else fitted to the plan.

    groups: the card's brackets in order of time; slots: of the plan; stated_s: the offset that the
    user states [s], None if none. A common delay of brackets that a timer started is added. Raises
    InputError if the fit finds no offset, or several of which none is UTC or the place's civil
    time.
    """
    if stated_s is not None:
        start = Offset(stated_s, "--utc-offset")
    elif states_utc(groups):
        start = Offset(0.0, "stated in EXIF", _exif_offsets_s(groups))
    else:
        start = find_offset(groups, slots, _expected_s(groups, slots, setup))
    if start is not None:
        return refine_offset(groups, slots, start)
    if fitting_offsets(groups, slots):
        found = "several UTC offsets of the camera's clock fit the plan equally well"
        remedy = "state the camera's offset, for example --utc-offset -08:00"
        raise InputError("the card", found, "one offset that fits best", remedy)
    first, last = groups[0].t_camera, groups[-1].t_camera
    near = min((slot.t_utc for slot in slots), key=lambda t: abs(t - first), default=None)
    span = f"the brackets from {first:%Y-%m-%d %H:%M} to {last:%Y-%m-%d %H:%M}"
    found = f"{span} by the camera's clock match no slot of the plan"
    expected = f"brackets near slots; that nearest to the first bracket is {str(near)[:16]} UTC"
    remedy = "check that this is the right card; correct a wrong date, for example by one day: "
    remedy += 'exiftool -AllDates+="0:0:1 0:0:0" FOLDER'
    raise InputError("the card", found, expected, remedy)


def states_utc(groups: Sequence[Group]) -> bool:
    """Return whether EXIF states a UTC offset for every frame."""
    return all(f.exif_offset_s is not None for group in groups for f in group.frames)


def _exif_offsets_s(groups: Sequence[Group]) -> tuple[float, ...]:
    stated = {f.exif_offset_s for group in groups for f in group.frames}
    return tuple(sorted(offset_s for offset_s in stated if offset_s is not None))


def exif_note(groups: Sequence[Group], stated_s: float | None) -> str:
    """Return a note if EXIF's offset differs from `stated_s` [s] by over a minute, else ""."""
    offsets_s = () if stated_s is None else _exif_offsets_s(groups)
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
    """Return the number of brackets that are near slots if the clock has this offset."""
    return int(np.sum(np.abs(late_s(groups, slots, offset_s)) <= WITHIN_S))


def _expected_s(groups: Sequence[Group], slots: Sequence[Slot], setup: SiteFile) -> list[float]:
    """Return the likely values of the camera's clock minus UTC [s], most likely first.

    These are the UTC offsets of the place on the days of the brackets, then those of the plan, then
    zero.
    """
    zone = ZoneInfo(setup.site.timezone)
    days = {group.t_camera.date() for group in groups}
    offsets = [(slot, slot.t_utc.astimezone(zone).utcoffset() or timedelta()) for slot in slots]
    then = Counter(offset for slot, offset in offsets if slot.t_utc.date() in days)
    ever = Counter(offset for _, offset in offsets)
    likely = [offset for offset, _ in (*then.most_common(), *ever.most_common())]
    return [offset.total_seconds() for offset in (*likely, timedelta())]


def clock_parts(groups: Sequence[Group], slots: Sequence[Slot], zone: str) -> list[list[Group]]:
    """Split the brackets, in order of time, at days where the camera's clock was set by hours.

    An example is daylight saving time. With hourly slots such a change is hard to see: brackets
    that are an hour off match the neighbouring slots, except at the ends of a day. Return the
    fewest parts that the brackets support: each change must bring at least three more brackets near
    slots, or one if civil time in `zone` (IANA name) changed as much within 36 h and if no change
    elsewhere brings as many. groups: not empty.
    """
    days = split_at_gaps(groups, _NIGHT_S)
    # The minutes of the quarter of an hour that fits all brackets best, and each full hour.
    base = next(iter(fitting_offsets(groups, slots)), 0.0) % 3600.0
    hits = [[_near_slots(day, slots, base + 3600.0 * hour) for hour in _HOURS] for day in days]
    civil_h = [
        _civil_h(after[0], zone, _CIVIL_NEAR) - _civil_h(before[-1], zone, -_CIVIL_NEAR)
        for before, after in pairwise(days)
    ]
    paths = [_best_path(np.array(hits), changes) for changes in ([0] * len(civil_h), civil_h)]
    path = max(paths, key=lambda path: sum(day[k] for day, k in zip(hits, path, strict=True)))
    starts = [k for k in range(len(days)) if k == 0 or path[k] != path[k - 1]]
    return [list(chain(*days[a:b])) for a, b in pairwise([*starts, len(days)])]


def _civil_h(group: Group, zone: str, later: timedelta) -> int:
    """Return civil time minus UTC, in full hours, at `later` after a bracket."""
    moment = (group.t_camera + later).astimezone(ZoneInfo(zone))
    return round((moment.utcoffset() or timedelta()) / timedelta(hours=1))


def _best_path(hits: np.ndarray, civil_h: Sequence[int]) -> list[int]:
    """Return the best offset of each day, as an index of hours.

    hits [days, hours]: numbers of brackets near slots. Their sum is maximised, minus `_EVIDENCE`
    for each change between days, or `_CIVIL_EVIDENCE` for one that equals `civil_h` [days - 1].
    """
    value, came = hits[0].astype(float), []
    stay = np.arange(len(value))
    for day, civil in zip(hits[1:], civil_h, strict=True):
        best = int(np.argmax(value))
        origin = np.where(value[best] - _EVIDENCE >= value, best, stay)
        reached = np.maximum(value[best] - _EVIDENCE, value)
        before = np.clip(stay - civil, 0, len(value) - 1)
        follows = (civil != 0) & (value[before] - _CIVIL_EVIDENCE > reached)
        came.append(np.where(follows, before, origin))
        value = np.where(follows, value[before] - _CIVIL_EVIDENCE, reached) + day
    path = [int(np.argmax(value))]
    for previous in reversed(came):
        path.append(int(previous[path[-1]]))
    return path[::-1]


def clock_steps(clocks: Sequence[tuple[Sequence[Group], Offset]]) -> list[str]:
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


def offset_contradiction(
    groups: Sequence[Group], slots: Sequence[Slot], offset: Offset, zone: str
) -> str:
    """Return why the plan contradicts a clock offset, or "".

    Two errors are detected: an offset that is wrong by full hours, up to 26 (time zone or date),
    and a clock that was set between brackets. groups: in order of time; zone: IANA name.
    """
    shifts = [3600.0 * hour for hour in _HOURS]
    hits = [_near_slots(groups, slots, offset.seconds + s) for s in shifts]
    as_it_is, best = hits[shifts.index(0.0)], int(np.argmax(hits))
    if hits[best] >= as_it_is + _EVIDENCE:
        return (
            f"with the offset of the camera's clock ({offset.how}), {as_it_is} of {len(groups)} "
            f"brackets are near slots; with an offset changed by {shifts[best] / 3600:+g} h it "
            f"would be {hits[best]}: check the camera's clock and date, and state --utc-offset"
        )
    if len(parts := clock_parts(groups, slots, zone)) == 1:
        return ""
    return (
        f"one clock offset ({offset.how}) was used for all brackets, but the plan suggests that "
        f"the camera's clock was changed before {parts[1][0].frames[0].path}: import the two parts "
        "from separate folders, each with its own --utc-offset"
    )
