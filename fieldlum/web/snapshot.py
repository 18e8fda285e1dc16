"""Compute the tables that the page of `fieldlum watch` shows, from files that grow.

Each file is read from where the last reading ended: a page that is open for a month must not read a
month of files every few seconds, and its memory must not grow. So each line of the journal updates
one state, and a day of irradiance is a fixed number of bins.
"""

import os
import shutil
import threading
from collections import Counter, deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict
from datetime import UTC, date, datetime, timedelta
from functools import lru_cache
from pathlib import Path
from typing import Literal, NamedTuple, Self
from zoneinfo import ZoneInfo

import numpy as np
import psutil

from fieldlum.capture import doctor, steady_clock
from fieldlum.core.arrays import Floats
from fieldlum.core.errors import InputError
from fieldlum.core.false_colour import coloured, luminance_ends, png_of, shared_scale
from fieldlum.core.files import open_to_read
from fieldlum.core.records import JsonTable, Site, Slot, parse_utc, utc_text
from fieldlum.optics.images import read_panorama
from fieldlum.session import Session, plan_file
from fieldlum.session.day_files import decode_sample
from fieldlum.session.files.sidecar import Sidecar
from fieldlum.session.journal import JournalEvent, decode_event
from fieldlum.session.slot_states import SETTLED, SlotStates, apply_events, makeups_by_slot
from fieldlum.sky import sun
from fieldlum.web.prediction_so_far import QUIET_BEFORE_S, Moment

BIN_S = 120  # 720 points a day: more cannot be seen in a curve as wide as a page; chosen
_BINS = 86400 // BIN_S


class LineTail:
    """State that follows from the lines of a growing file; `update` reads the new lines.

    Subclasses keep the state, with `clear` and `add`. path: of the file, which need not exist.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._offset, self._inode = path, 0, 0
        self.clear()

    def clear(self) -> None:
        """Set the state to that of an empty file."""

    def add(self, line: bytes) -> None:
        """Change the state by one line of the file; ignore a damaged line."""

    def update(self) -> Self:
        """Add the complete unread lines, and return this object.

        A replaced or shortened file is read from its beginning. A missing or unreadable file
        changes nothing: it may be on a share that is away.
        """
        with suppress(OSError), open_to_read(self._path) as file:
            about = os.fstat(file.fileno())
            if about.st_ino != self._inode or about.st_size < self._offset:
                self._offset, self._inode = 0, about.st_ino
                self.clear()
            file.seek(self._offset)
            data = file.read()
            end = data.rfind(b"\n") + 1
            self._offset += end
            for line in data[:end].splitlines(keepends=True):
                self.add(line)
        return self


class JournalFollower(LineTail):
    """State that follows from the journal so far.

    states: state of each slot. events: the latest 60 for the page, oldest first, without frames,
    retakes, starts of brackets and illuminances. away: time (UTC) since when devices do not answer,
    by device. opened: the last `open` event (start of a capture) if no `close` follows, else None.
    """

    def clear(self) -> None:
        """Set the state to that of an empty journal."""
        self.states = SlotStates()
        self.events: deque[JournalEvent] = deque(maxlen=60)  # more than a page shows
        self.away: dict[str, datetime] = {}
        self.opened: JournalEvent | None = None

    def add(self, line: bytes) -> None:
        """Change the state by an event, one line of the journal; ignore a damaged line."""
        if (event := decode_event(line)) is None:
            return
        kind, device = event["event"], str(event.get("device", ""))
        apply_events((event,), self.states)
        if kind == "open":
            self.opened, self.away = event, {}
        elif kind == "close":
            self.opened = None
        elif kind == "device-lost":
            self.away[device] = parse_utc(event["t_utc"])
        elif kind == "device-back":
            self.away.pop(device, None)
        if kind not in ("frame", "retake", "started", "illuminance"):
            self.events.append(event)


class DayBins(LineTail):
    """Mean irradiances in 720 bins of two minutes, from the logger's file of one UTC day.

    Bins are counted from midnight UTC. flagged: mask [720], True in a bin with an error that the
    instrument reported; status: number of rows by text of such an error; last: time (UTC) and
    global horizontal irradiance [W/m2], None if not measured, of the last row; None without rows.
    """

    def clear(self) -> None:
        """Set the state to that of a day without readings."""
        self._sum_wm2, self._count = np.zeros((2, _BINS, 3))  # GHI, DNI, DHI
        self.flagged = np.zeros(_BINS, bool)
        self.status: Counter[str] = Counter()
        self.last: tuple[datetime, float | None] | None = None

    def add(self, line: bytes) -> None:
        """Add a reading, one line of the file, to its bin; ignore a damaged line."""
        if (sample := decode_sample(line)) is None:
            return
        number = _bin_of(sample.t_utc)
        row_wm2 = np.array([sample.ghi_wm2, sample.dni_wm2, sample.dhi_wm2], float)
        self._sum_wm2[number] += np.nan_to_num(row_wm2)
        self._count[number] += np.isfinite(row_wm2)
        if sample.status:
            self.flagged[number] = True
            self.status[sample.status] += 1
        self.last = sample.t_utc, sample.ghi_wm2

    @property
    def means_wm2(self) -> Floats:
        """Mean GHI, DNI and DHI of each bin in W/m2, in this order, [720, 3]; NaN: no reading."""
        return np.where(self._count > 0, self._sum_wm2 / np.maximum(self._count, 1), np.nan)


def _bin_of(t_utc: datetime) -> int:
    """Return the number of the bin of a time in its UTC day, from 0."""
    return (t_utc.hour * 3600 + t_utc.minute * 60 + t_utc.second) // BIN_S


# ----------------------------------------------------------------------------------------------
# pictures


def scale_of(paths: Sequence[Path]) -> JsonTable:
    """Return one scale of false colours for several panoramas, as JSON for the page.

    low, high: its ends [cd/m2], by `shared_scale`; stamp: a text that changes when one of the files
    is written again. A panorama that cannot be read is left out: `merge` may be writing it.
    """
    ends, newest_ns = [], 0
    for path in paths:
        with suppress(InputError, OSError):
            written_ns = path.stat().st_mtime_ns
            newest_ns = max(newest_ns, written_ns)
            ends.append(_ends(path, written_ns))
    low, high = shared_scale(ends)
    return {"low": low, "high": high, "stamp": f"{newest_ns:x}"}


@lru_cache(maxsize=1024)
def _ends(path: Path, written_ns: int) -> tuple[float, float] | None:
    """Return the `luminance_ends` of a panorama; computed again if the file is written again."""
    return luminance_ends(read_panorama(path).seen_cdm2)


def picture_png(path: Path, width: int, low: float, high: float) -> bytes:
    """Return a panorama in false colour as PNG, at most `width` and 1840 pixels wide.

    A larger panorama is reduced, a smaller one is not enlarged. The scale is logarithmic from low
    to high [cd/m2]. Raises InputError for a file that is missing or cannot be read.
    """
    import cv2

    luminance_cdm2 = read_panorama(path).seen_cdm2  # [H, W]
    full_height, full_width = luminance_cdm2.shape
    # 1840 is four times the width of a panorama of 460 pixels; the limit bounds the memory.
    if full_width > (width := min(width, 1840)):
        height = max(1, round(full_height * width / full_width))
        shrunk = cv2.resize(luminance_cdm2, (width, height), interpolation=cv2.INTER_AREA)
        luminance_cdm2 = np.asarray(shrunk, np.float32)
    return png_of(coloured(luminance_cdm2, low, high))


# ----------------------------------------------------------------------------------------------
# tables


def day_curve(day: date, site: Site, bins_of: Callable[[date], DayBins]) -> JsonTable:
    """Return the irradiance of a local day in n bins of two minutes, as JSON for the page.

    Lists [n]: minutes (from local midnight to the middle of the bin), ghi, dni, dhi and clear_ghi
    (of a cloudless sky) in W/m2, None for a missing value; flagged: True where the instrument
    reported an error, or a value is outside the limits of BSRN for the sun's altitude.
    flagged_bins, impossible_bins: number of bins with the first and with the second fault; status:
    number of rows by reported error, of the one or two UTC days that the local day is in. Bins at
    night without a reading are omitted. day: by clock time at the site; bins_of: returns the bins
    of a UTC day.
    """
    zone = ZoneInfo(site.timezone)
    start = datetime(day.year, day.month, day.day, tzinfo=zone).astimezone(UTC)
    # A local day has up to 25 hours, when clocks go back; bins of another date are removed.
    times = [start + timedelta(seconds=BIN_S * (k + 0.5)) for k in range(25 * 3600 // BIN_S)]
    times = [t for t in times if t.astimezone(zone).date() == day]
    utc_days = {utc_day: bins_of(utc_day) for utc_day in sorted({t.date() for t in times})}
    means_wm2 = {utc_day: bins.means_wm2 for utc_day, bins in utc_days.items()}
    values_wm2 = np.array([means_wm2[t.date()][_bin_of(t)] for t in times])  # [bins, 3]
    flagged = np.array([utc_days[t.date()].flagged[_bin_of(t)] for t in times])
    present = np.isfinite(values_wm2).any(axis=1)
    impossible, clear_wm2 = np.zeros(len(times), bool), np.full(len(times), np.nan)
    if present.any():
        altitude_deg = sun.position(times, site).altitude_deg
        limits = sun.bsrn_limits(altitude_deg, sun.extraterrestrial_wm2(times))
        low, high = zip(limits.ghi_wm2, limits.dni_wm2, limits.dhi_wm2, strict=True)
        impossible = ((values_wm2 < low) | (values_wm2 > np.stack(high, axis=-1))).any(axis=1)
        clear_wm2 = sun.clearsky(times, site).ghi_wm2
    keep = present | (np.nan_to_num(clear_wm2) > 1.0)  # by day, or with a reading
    names, columns = ("ghi", "dni", "dhi", "clear_ghi"), (*values_wm2[keep].T, clear_wm2[keep])
    return {
        **{name: _numbers(column) for name, column in zip(names, columns, strict=True)},
        "minutes": [round((t - start).total_seconds() / 60, 1) for t in np.array(times)[keep]],
        "flagged": (flagged | impossible)[keep].tolist(),
        "flagged_bins": int(flagged.sum()),
        "impossible_bins": int(impossible.sum()),
        "status": dict(sum((bins.status for bins in utc_days.values()), Counter())),
    }


def _numbers(values: Floats) -> list[float | None]:
    """Return values [n] for JSON, to one decimal; None for those that are not finite."""
    return [None if not np.isfinite(value) else round(float(value), 1) for value in values]


Level = Literal["info", "warn", "fail"]

# Events that the list on the page omits, because its calendar shows them.
_NOT_LISTED = frozenset({"imported", "withdrawn"})
# Level and sentence of each kind of event; names in braces are fields of the event.
_SENTENCES: dict[str, tuple[Level, str]] = {
    "done": ("warn", "Bracket {slot} is complete, with a warning: {why}."),
    "missed": ("fail", "Bracket {slot} was not taken: {why}."),
    "aborted": ("fail", "Bracket {slot} was ended before it was complete: {why}."),
    "device-lost": ("fail", "The {device} stopped answering ({why}). The capture tries it again."),
    "device-back": ("info", "The {device} answers again after {after_s:.0f} s."),
    "bad-reading": ("warn", "The {device} gave a reading that cannot be used: {why}."),
    "clock-step": ("warn", "The computer's clock jumped by {seconds:+.0f} s."),
    "suspend": ("warn", "The computer slept for {seconds:.0f} s."),
    "disk-full": ("fail", "The disk is full: {bytes_free:,} bytes are free."),
    "late": ("info", "Bracket {slot} began {by_s:.0f} s late."),
    "open": ("info", "The capture was started."),
    "close": ("info", "The capture was ended."),
    "marked": ("info", "Bracket {slot} was marked: {state}."),
    "note": ("info", "Note: {text}"),
}


def event_sentence(event: JournalEvent) -> tuple[Level, str] | None:
    """Return the level (info, warn, fail) and the sentence of an event of the journal.

    The result is None for an event that needs no attention, such as a bracket done without a doubt.
    The sentence of an unknown kind of event is the name of the kind, its level "info".
    """
    kind, why = event["event"], event.get("why", "")
    if kind in _NOT_LISTED or (kind == "done" and (not why or why == "imported")):
        return None
    if kind not in _SENTENCES:
        return "info", kind
    absent = dict.fromkeys(("slot", "state", "text"), "") | {"device": "a device"}
    absent |= dict.fromkeys(("by_s", "after_s", "seconds", "bytes_free"), 0)
    level, sentence = _SENTENCES[kind]
    return level, sentence.format(**(absent | event | {"why": why or "no reason recorded"}))


def is_running(journal: JournalFollower) -> bool:
    """Return whether a capture runs on this computer, by the journal and the list of processes.

    A capture runs if the journal's open capture has the number of an existing process. No capture
    runs if the journal has no open capture, or one that began before this boot or on another
    computer.
    """
    opened = journal.opened
    if opened is not None and opened.get("boot_id") in ("", None, steady_clock.boot_id()):
        with suppress(ValueError, OverflowError):
            return psutil.pid_exists(int(opened.get("pid", 0)) or -1)
    return False


def battery() -> JsonTable | None:
    """Return the state of this computer's battery, as JSON for the page; None without a battery.

    percent: charge; mains: whether it has external power, absent if that is unknown.
    """
    state = psutil.sensors_battery() if hasattr(psutil, "sensors_battery") else None
    if state is None:
        return None
    mains = {} if state.power_plugged is None else {"mains": state.power_plugged}
    return {"percent": round(state.percent), **mains}


_FINDINGS_EVERY_S = 300.0  # chosen
# A journal this far ahead of the computer's clock comes from `capture --clock fast`. Chosen.
_REHEARSAL_AHEAD = timedelta(hours=1)


class _Present(NamedTuple):
    """The journal and the plan as they are now, and the state of each slot.

    now: UTC; rehearsal: whether it is the simulated time of a capture; states: see
    `Snapshots.calendar`; merged: ids of slots with a panorama.
    """

    journal: JournalFollower
    slots: list[Slot]
    now: datetime
    rehearsal: bool
    states: dict[str, str]
    merged: set[str]


class Snapshots:
    """Tables of one session for the page of `fieldlum watch`, usable from several threads.

    Each method reads what is new in the session's files, and waits until no other thread does.
    wall_clock: returns the present time (UTC). Raises InputError for a session.toml that cannot be
    used.
    """

    def __init__(
        self, session: Session, wall_clock: Callable[[], datetime] = lambda: datetime.now(UTC)
    ) -> None:
        self._session, self._wall_clock = session, wall_clock
        self._lock = threading.Lock()
        self._journal, folder = JournalFollower(session.journal), session.irradiance
        # the last six requested days stay in memory
        self._bins = lru_cache(6)(lambda day: DayBins(folder / f"{day.isoformat()}.csv"))
        self._setup = session.site_file()
        self._zone = ZoneInfo(self._setup.site.timezone)
        self._plan: tuple[int, list[Slot]] = (-1, [])  # when the file was written [ns], and slots
        self._findings = lru_cache(1)(self._doctor)

    def state(self) -> JsonTable:
        """Return the present state of the session, as JSON for the page.

        name, timezone: of the site; folder: the session's name; now_utc, now_local, today: present
        time, in UTC and by the site's clock, and date; rehearsal: True if time is simulated;
        running: whether a capture runs on this computer; counts: number of slots by state (see
        `calendar`); slots: number of all; next: the row in `calendar` of the slot that is running
        or next, None if none is left; latest: {"slot", "verdict", "local"} and `scale_of` of the
        newest panorama, None without one; devices: camera, camera_battery, camera_clock_offset_s
        [s], and away (UTC since when, by device); irradiance: {"t_utc", "ghi_wm2"} of the last
        reading of this UTC day or the one before, or None; disk: {"free_bytes", "days"} (days of
        captures that fit, None if unknown); computer: `battery`; events: the latest 25, {"level",
        "text", "local", "times"} each (times: how often in sequence), newest first; findings: of
        `doctor` without devices, at most five minutes old; version: changes with the plan and the
        slots' states. Raises InputError for a session.toml that cannot be read.
        """
        with self._lock:
            present = self._present()
            journal, now, merged = present.journal, present.now, present.merged
            states = list(present.states.values())
            ahead = [s for s in present.slots if present.states[s.id] in ("to do", "running")]
            days = (now.date(), now.date() - timedelta(days=1))
            sample = next((last for day in days if (last := self._bins_of(day).last)), None)
            return {
                "name": self._setup.site.name,
                "folder": self._session.root.resolve().name,
                "timezone": self._setup.site.timezone,
                "now_utc": utc_text(now),
                "now_local": f"{now.astimezone(self._zone):%a %d %b %Y, %H:%M}",
                "rehearsal": present.rehearsal,
                "running": is_running(journal),
                "counts": dict(Counter(states)),
                "slots": len(states),
                "next": self._slot_row(ahead[0], present) if ahead else None,
                "latest": self._latest(),
                "devices": self._devices(journal),
                "irradiance": sample and {"t_utc": utc_text(sample[0]), "ghi_wm2": sample[1]},
                "disk": self._disk(present.slots),
                "computer": battery(),
                "events": self._events(journal),
                "findings": self._findings(now.timestamp() // _FINDINGS_EVERY_S),
                "version": f"{self._plan[0]}-{len(merged)}-{hash(tuple(states)) & 0xFFFFFFFF:x}",
                "today": self._local_day(now).isoformat(),
            }

    def moment(self) -> Moment:
        """Return whether no bracket is running or near, and how many slots are captured.

        In such quiet time the computer may predict the year (`prediction_so_far`). It is always
        quiet if no capture runs on this computer.
        """
        with self._lock:
            present = self._present()
            outcomes = [state.outcome for state in present.journal.states.slots.values()]
            ahead = [slot.t_utc for slot in present.slots if present.states[slot.id] == "to do"]
            is_near = bool(ahead) and (ahead[0] - present.now).total_seconds() <= QUIET_BEFORE_S
            is_slot_now = present.rehearsal or is_near or "running" in present.states.values()
            is_quiet = not (is_slot_now and is_running(present.journal))
            return Moment(is_quiet=is_quiet, captured=outcomes.count("done"))

    def calendar(self) -> JsonTable:
        """Return the plan's local days with their slots, as JSON for the page.

        Its key days is a list of {"date", "slots"} in order of time. A row of slots has slot (its
        id), t_utc, local, day (texts of its time), state (done, missed, aborted, made up (by
        another slot), running, to do), picture (whether it is merged) and sun_altitude_deg (true,
        without refraction). Local is by clock time at the site.
        """
        with self._lock:
            present = self._present()
            days: dict[str, list[JsonTable]] = {}
            for slot in present.slots:
                day = self._local_day(slot.t_utc).isoformat()
                days.setdefault(day, []).append(self._slot_row(slot, present))
            return {"days": [{"date": day, "slots": rows} for day, rows in sorted(days.items())]}

    def day(self, day: date) -> JsonTable:
        """Return a local day as JSON for the page; keys: date, slots, scale and irradiance.

        slots: the day's rows of `calendar`, with the key verdict: that of `merge`, for a slot that
        is not merged the reason in the journal, or ""; scale: `scale_of` all pictures of the day;
        irradiance: `day_curve`.
        """
        with self._lock:
            present = self._present()
            today = [slot for slot in present.slots if self._local_day(slot.t_utc) == day]
            rows = [self._slot_row(slot, present) for slot in today]
            for row in rows:
                why = present.journal.states.state(row["slot"]).why
                row["verdict"] = self._verdict(row["slot"], why)
            paths = [self._session.panorama(row["slot"]) for row in rows if row["picture"]]
            curve, scale = day_curve(day, self._setup.site, self._bins_of), scale_of(paths)
            return {"date": day.isoformat(), "slots": rows, "scale": scale, "irradiance": curve}

    # ------------------------------------------------------------------------------------------
    # parts of the tables

    def _present(self) -> _Present:
        """Return journal, plan and states now; a rehearsal has its own time, in the future."""
        journal, slots = self._journal.update(), self._slots()
        now = self._wall_clock()
        last_utc = journal.states.last_utc or now
        if rehearsal := last_utc - now > _REHEARSAL_AHEAD:
            now = last_utc
        states = self._states(slots, journal, now)
        merged = {path.stem for path in self._session.panorama_files()}
        return _Present(journal, slots, now, rehearsal, states, merged)

    def _bins_of(self, day_utc: date) -> DayBins:
        """Return the bins of irradiance of a UTC day, with the file's newest rows."""
        return self._bins(day_utc).update()

    def _slots(self) -> list[Slot]:
        """Return the slots of the plan in order of time, read again only when the file changed."""
        with suppress(OSError, InputError):  # a damaged file: the earlier plan remains
            written_ns = self._session.plan.stat().st_mtime_ns
            if written_ns != self._plan[0]:
                slots = sorted(plan_file.read_plan(self._session.plan), key=lambda slot: slot.t_utc)
                self._plan = written_ns, slots
        return self._plan[1]

    def _states(self, slots: list[Slot], journal: JournalFollower, now: datetime) -> dict[str, str]:
        """Return each slot's state by its id: done, missed, aborted, made up, running or to do."""
        grace = self._session.grace
        states: dict[str, str] = {}
        for slot in slots:
            outcome = journal.states.state(slot.id).outcome
            if outcome in SETTLED:
                states[slot.id] = outcome
            elif outcome == "started" and journal.opened is not None:
                states[slot.id] = "running"
            else:
                states[slot.id] = "to do" if slot.t_utc + grace >= now else "missed"
        for missed, instead in makeups_by_slot(slots).items():
            if states.get(missed) != "done" and any(states[s.id] == "done" for s in instead):
                states[missed] = "made up"
        return states

    def _slot_row(self, slot: Slot, present: _Present) -> JsonTable:
        """Return a slot's row of `calendar`: its id, times, state, sun's altitude, and picture."""
        local = slot.t_utc.astimezone(self._zone)
        return {
            "slot": slot.id,
            "t_utc": utc_text(slot.t_utc),
            "local": f"{local:%H:%M}",
            "day": f"{local:%a %d %b %Y}",
            "state": present.states[slot.id],
            "picture": slot.id in present.merged,
            "sun_altitude_deg": round(slot.sun_altitude_deg, 1),
        }

    def _latest(self) -> JsonTable | None:
        """Return slot, verdict, time and scale of the newest panorama; None without one."""
        newest = self._session.panorama_files()[-1:]
        if not newest:
            return None
        slot = newest[0].stem
        local = ""
        with suppress(ValueError):
            local = f"{parse_utc(slot).astimezone(self._zone):%a %d %b %Y, %H:%M}"
        verdict = self._verdict(slot, "no sidecar")
        return {"slot": slot, "verdict": verdict, "local": local, **scale_of(newest)}

    def _verdict(self, slot: str, without_sidecar: str) -> str:
        """Return merge's verdict on a slot, or `without_sidecar`; an error's text if unreadable."""
        try:
            sidecar = Sidecar.find(self._session.sidecar(slot))
        except InputError as error:
            return str(error)
        return sidecar.verdict if sidecar is not None else without_sidecar

    def _devices(self, journal: JournalFollower) -> JsonTable:
        """Return the camera as session.toml records it, and since when devices are away."""
        camera = self._session.table().get("devices", {}).get("camera", {})
        offset_s = camera.get("clock_offset_s")
        # The file may have been edited: a text or a huge number is ignored.
        is_known = isinstance(offset_s, int | float) and abs(offset_s) < 1e9
        return {
            "camera": " ".join(str(camera.get(k, "")) for k in ("make", "model")).strip(),
            "camera_battery": str(camera.get("battery", "")),
            "camera_clock_offset_s": offset_s if is_known else None,
            "away": {name: utc_text(t) for name, t in journal.away.items()},
        }

    def _disk(self, slots: list[Slot]) -> JsonTable:
        """Return the free space, and the days of captures that fit, None if that is unknown."""
        free_bytes = shutil.disk_usage(self._session.root).free
        days = len({sun.standard_date(slot.t_utc, self._zone.key) for slot in slots})
        bytes_per_day = self._session.slot_bytes() * len(slots) / max(days, 1)
        days_left = free_bytes / bytes_per_day if bytes_per_day else None
        return {"free_bytes": free_bytes, "days": days_left}

    def _events(self, journal: JournalFollower) -> list[JsonTable]:
        """Return the latest 25 events, newest first; equal sentences in sequence become one."""
        rows: list[JsonTable] = []
        for event in reversed(journal.events):
            level, text = event_sentence(event) or ("", "")
            if rows and rows[-1]["text"] == text:
                rows[-1]["times"] += 1
            elif text:
                local = parse_utc(event["t_utc"]).astimezone(self._zone)
                at = f"{local:%a %d %b %H:%M}"
                rows.append({"level": level, "text": text, "local": at, "times": 1})
        return rows[:25]  # about a screen

    def _doctor(self, period: float) -> list[JsonTable]:
        """Return doctor's findings that need no device; a capture may be using the devices.

        period: number of periods of five minutes since 1970; the findings of one are computed once.
        """
        now = datetime.fromtimestamp(period * _FINDINGS_EVERY_S, UTC)
        findings = doctor.run(self._session, "", "", now, only=doctor.WITHOUT_DEVICES)
        return [asdict(finding) for finding in findings]

    def _local_day(self, t_utc: datetime) -> date:
        return t_utc.astimezone(self._zone).date()
