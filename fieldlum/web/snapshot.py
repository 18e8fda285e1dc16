"""Plain tables of a session for the page of `fieldlum watch`, from files that grow.

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

from fieldlum.capture import doctor
from fieldlum.capture.steady_clock import boot_id
from fieldlum.core.arrays import Floats
from fieldlum.core.errors import InputError
from fieldlum.core.false_colour import coloured, luminance_ends, png_of, shared_scale
from fieldlum.core.files import open_to_read
from fieldlum.core.records import JsonTable, Site, Slot, parse_utc, utc_text
from fieldlum.optics.images import read_panorama
from fieldlum.session import Session
from fieldlum.session.day_files import decode_sample
from fieldlum.session.files.sidecar import Sidecar
from fieldlum.session.journal import JournalEvent, decode_event
from fieldlum.session.plan_file import read_plan
from fieldlum.session.slot_states import SETTLED, SlotStates, apply_events, makeups_by_slot
from fieldlum.sky import sun
from fieldlum.web.prediction_so_far import QUIET_BEFORE_S, Moment

BIN_S = 120  # 720 points a day: more cannot be seen in a curve as wide as a page; chosen
_BINS = 86400 // BIN_S


class LineTail:
    """State that follows from the lines of a growing file; `update` reads those that are new."""

    def __init__(self, path: Path) -> None:
        self._path, self._offset, self._inode = path, 0, 0
        self.clear()

    def clear(self) -> None:
        """Begin with the state of an empty file."""

    def add(self, line: bytes) -> None:
        """Change the state by one line; skip a damaged one."""

    def update(self) -> Self:
        """Add the complete unread lines; read a replaced or shortened file from its beginning.

        A missing or unreadable file changes nothing: it may be on a share that is away.
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
    """What the journal states so far.

    states: state of each slot. events: the latest 60 for the page, without frames, starts of
    brackets and illuminances. away: devices that do not answer now, with the time since when.
    opened: the last `open` event (start of a capture) without a `close`, or None.
    """

    def clear(self) -> None:
        """Begin with the state of an empty file."""
        self.states = SlotStates()
        self.events: deque[JournalEvent] = deque(maxlen=60)  # more than a page shows
        self.away: dict[str, datetime] = {}
        self.opened: JournalEvent | None = None

    def add(self, line: bytes) -> None:
        """Change the state by one line; skip a damaged one."""
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

    flagged: mask of bins, True with an error that the instrument reported; status: number of rows
    by such an error; last: time and global irradiance of the last row, or None.
    """

    def clear(self) -> None:
        """Begin with the state of an empty file."""
        self._sum, self._count = np.zeros((2, _BINS, 3))
        self.flagged = np.zeros(_BINS, bool)
        self.status: Counter[str] = Counter()
        self.last: tuple[datetime, float | None] | None = None

    def add(self, line: bytes) -> None:
        """Change the state by one line; skip a damaged one."""
        if (sample := decode_sample(line)) is None:
            return
        k = _bin_of(sample.t_utc)
        row = np.array([sample.ghi_wm2, sample.dni_wm2, sample.dhi_wm2], float)
        self._sum[k] += np.nan_to_num(row)
        self._count[k] += np.isfinite(row)
        if sample.status:
            self.flagged[k] = True
            self.status[sample.status] += 1
        self.last = sample.t_utc, sample.ghi_wm2

    @property
    def means(self) -> Floats:
        """GHI, DNI and DHI, in this order, [720, 3] in W/m2; NaN without a reading."""
        return np.where(self._count > 0, self._sum / np.maximum(self._count, 1), np.nan)


def _bin_of(t_utc: datetime) -> int:
    return (t_utc.hour * 3600 + t_utc.minute * 60 + t_utc.second) // BIN_S


# ----------------------------------------------------------------------------------------------
# pictures


def scale_of(paths: Sequence[Path]) -> JsonTable:
    """Return {"low", "high", "stamp"}: one scale for several panoramas [cd/m2].

    low, high: ends by `shared_scale`. stamp: a text that changes when one of them is written again.
    A panorama that cannot be read is left out: a merge may be writing it.
    """
    ends, stamp = [], 0
    for path in paths:
        with suppress(InputError, OSError):
            written = path.stat().st_mtime_ns
            stamp = max(stamp, written)
            ends.append(_ends(path, written))
    low, high = shared_scale(ends)
    return {"low": low, "high": high, "stamp": f"{stamp:x}"}


@lru_cache(maxsize=1024)
def _ends(path: Path, stamp: int) -> tuple[float, float] | None:
    return luminance_ends(read_panorama(path).seen_cdm2)


def picture_png(path: Path, width: int, low: float, high: float) -> bytes:
    """Return a panorama in false colour as PNG, at most `width` pixels wide.

    The scale is logarithmic from low to high [cd/m2]. Raises InputError for a damaged file, OSError
    for a missing one.
    """
    import cv2

    values = read_panorama(path).seen_cdm2  # [H, W]
    # at most four times a panorama of 460 pixels, which bounds the memory
    if values.shape[1] > (width := min(width, 1840)):
        height = max(1, round(values.shape[0] * width / values.shape[1]))
        shrunk = cv2.resize(values, (width, height), interpolation=cv2.INTER_AREA)
        values = np.asarray(shrunk, np.float32)
    return png_of(coloured(values, low, high))


# ----------------------------------------------------------------------------------------------
# tables


def day_curve(day: date, site: Site, bins_of: Callable[[date], DayBins]) -> JsonTable:
    """Return the irradiance of a local day in n bins of two minutes.

    Lists [n]: minutes (bin's middle after midnight), ghi, dni, dhi and clear_ghi (of a cloudless
    sky) in W/m2, None for a missing value; flagged: True where the instrument reported an error, or
    a value is impossible for the sun's altitude. flagged_bins, impossible_bins: number of bins with
    the first and with the second fault; status: number of rows by reported error. Bins at night
    without a reading are omitted. bins_of: returns the bins of a UTC day.
    """
    zone = ZoneInfo(site.timezone)
    start = datetime(day.year, day.month, day.day, tzinfo=zone).astimezone(UTC)
    # 25 hours on the day when clocks go back: bins belong to a day by their local date
    times = [start + timedelta(seconds=BIN_S * (k + 0.5)) for k in range(25 * 3600 // BIN_S)]
    times = [t for t in times if t.astimezone(zone).date() == day]
    index = {d: bins_of(d) for d in sorted({t.date() for t in times})}
    means = {d: bins.means for d, bins in index.items()}
    values = np.array([means[t.date()][_bin_of(t)] for t in times])  # [bins, 3]
    flagged = np.array([index[t.date()].flagged[_bin_of(t)] for t in times])
    present = np.isfinite(values).any(axis=1)
    impossible, clear = np.zeros(len(times), bool), np.full(len(times), np.nan)
    if present.any():
        altitude = sun.position(times, site).altitude_deg
        limits = sun.bsrn_limits(altitude, sun.extraterrestrial_wm2(times))
        low, high = zip(limits.ghi_wm2, limits.dni_wm2, limits.dhi_wm2, strict=True)
        impossible = ((values < low) | (values > np.stack(high, axis=-1))).any(axis=1)
        clear = sun.clearsky(times, site).ghi_wm2
    keep = present | (np.nan_to_num(clear) > 1.0)
    ghi, dni, dhi, clear_ghi = (_numbers(v) for v in (*values[keep].T, clear[keep]))
    return {
        "ghi": ghi,
        "dni": dni,
        "dhi": dhi,
        "minutes": [round((t - start).total_seconds() / 60, 1) for t in np.array(times)[keep]],
        "clear_ghi": clear_ghi,
        "flagged": (flagged | impossible)[keep].tolist(),
        "flagged_bins": int(flagged.sum()),
        "impossible_bins": int(impossible.sum()),
        "status": dict(sum((bins.status for bins in index.values()), Counter())),
    }


def _numbers(values: Floats) -> list[float | None]:
    return [None if not np.isfinite(value) else round(float(value), 1) for value in values]


Level = Literal["info", "warn", "fail"]

# Events that are no news on a page: the plan's calendar shows outcomes.
_SILENT = frozenset({"imported", "withdrawn"})
# Sentences with fields of the event.
_WORDS: dict[str, tuple[Level, str]] = {
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


def event_words(event: JournalEvent) -> tuple[Level, str] | None:
    """Return the level ("info", "warn" ...) and the sentence of an event of the journal.

    None for an event that needs no attention, such as a bracket done without a doubt. The sentence
    of an unknown kind of event is the name of the kind, its level "info".
    """
    kind, why = event["event"], event.get("why", "")
    if kind in _SILENT or (kind == "done" and (not why or why == "imported")):
        return None
    if kind not in _WORDS:
        return "info", kind
    blank = dict.fromkeys(("slot", "state", "text"), "") | {"device": "a device"}
    blank |= dict.fromkeys(("by_s", "after_s", "seconds", "bytes_free"), 0)
    level, sentence = _WORDS[kind]
    return level, sentence.format(**(blank | event | {"why": why or "no reason recorded"}))


def is_running(journal: JournalFollower) -> bool:
    """Return whether the capture that the journal shows as open runs on this computer.

    False without an open one, or if it began before this boot or on another computer.
    """
    opened = journal.opened
    if opened is not None and opened.get("boot_id") in ("", None, boot_id()):
        with suppress(ValueError, OverflowError):
            return psutil.pid_exists(int(opened.get("pid", 0)) or -1)
    return False


def battery() -> JsonTable | None:
    """Return {"percent", "mains"} of this computer's battery; None where there is none.

    mains: whether it has external power; the key is absent where that is unknown.
    """
    found = psutil.sensors_battery() if hasattr(psutil, "sensors_battery") else None
    if found is None:
        return None
    mains = {} if found.power_plugged is None else {"mains": found.power_plugged}
    return {"percent": round(found.percent), **mains}


_FINDINGS_EVERY_S = 300.0  # chosen
# A journal this far ahead of the computer's clock comes from `capture --clock fast`. Chosen.
_REHEARSAL = timedelta(hours=1)


class _Present(NamedTuple):
    """The journal and the plan as they are now, and the state of each slot.

    rehearsal: whether `now` is the simulated time of a capture; merged: slots with a panorama.
    """

    journal: JournalFollower
    slots: list[Slot]
    now: datetime
    rehearsal: bool
    states: dict[str, str]
    merged: set[str]


class Snapshots:
    """Tables of one session for the page of `fieldlum watch`, usable from several threads.

    wall_clock: returns the present moment (UTC). Raises InputError for a bad session.toml.
    """

    def __init__(
        self, session: Session, wall_clock: Callable[[], datetime] = lambda: datetime.now(UTC)
    ) -> None:
        """Watch a session; wall_clock: the time in UTC."""
        self._session, self._wall_clock = session, wall_clock
        self._lock = threading.Lock()
        self._journal, folder = JournalFollower(session.journal), session.irradiance
        # the last six requested days stay in memory
        self._bins = lru_cache(6)(lambda day: DayBins(folder / f"{day.isoformat()}.csv"))
        self._setup = session.site_file()
        self._zone = ZoneInfo(self._setup.site.timezone)
        self._plan: tuple[int, list[Slot]] = (-1, [])
        self._findings = lru_cache(1)(self._doctor)

    def state(self) -> JsonTable:
        """Return the present state of the session, as JSON for the page.

        name, timezone: of the site; folder; now_utc, now_local, today: present time;
        rehearsal: True if time is simulated; running: whether a capture runs on this computer;
        counts: number of slots by state (see `calendar`); slots: their number; next: the next slot,
        as in `calendar`, None if none is left; latest: {"slot", "verdict", "local"} and the
        scale of the newest panorama, None without one; devices: camera, camera_battery,
        camera_clock_offset_s [s], and away (UTC since when, by device); irradiance: {"t_utc",
        "ghi_wm2"} of the last reading or None; disk: {"free_bytes", "days"} (days of captures that
        fit); computer: `battery`; events: {"level", "text", "local", "times"} each, newest first;
        findings: of `doctor` without devices; version: changes with the plan and the slots' states.
        """
        with self._lock:
            present = self._present()
            journal, slots, now, rehearsal, states, merged = present
            ahead = [slot for slot in slots if states[slot.id] in ("to do", "running")]
            counts = list(states.values())
            days = (now.date(), now.date() - timedelta(days=1))
            sample = next((last for day in days if (last := self._bins_of(day).last)), None)
            return {
                "name": self._setup.site.name,
                "folder": self._session.root.resolve().name,
                "timezone": self._setup.site.timezone,
                "now_utc": utc_text(now),
                "now_local": f"{now.astimezone(self._zone):%a %d %b %Y, %H:%M}",
                "rehearsal": rehearsal,
                "running": is_running(journal),
                "counts": {word: counts.count(word) for word in dict.fromkeys(counts)},
                "slots": len(slots),
                "next": self._slot_row(ahead[0], present) if ahead else None,
                "latest": self._latest(),
                "devices": self._devices(journal),
                "irradiance": sample and {"t_utc": utc_text(sample[0]), "ghi_wm2": sample[1]},
                "disk": self._disk(slots),
                "computer": battery(),
                "events": self._events(journal),
                "findings": self._findings(now.timestamp() // _FINDINGS_EVERY_S),
                "version": f"{self._plan[0]}-{len(merged)}-{hash(tuple(counts)) & 0xFFFFFFFF:x}",
                "today": self._local_day(now).isoformat(),
            }

    def moment(self) -> Moment:
        """Return whether no bracket is running or near, and how many slots are captured.

        In such quiet time the computer may compute the answer so far (`prediction_so_far`).
        """
        with self._lock:
            journal, slots, now, rehearsal, states, _ = self._present()
            ahead = [slot.t_utc for slot in slots if states[slot.id] == "to do"]
            running = is_running(journal)
            captured = sum(state.outcome == "done" for state in journal.states.slots.values())
            far = not ahead or (ahead[0] - now).total_seconds() > QUIET_BEFORE_S
            busy = running and (rehearsal or not far or "running" in states.values())
            return Moment(not busy, captured)

    def calendar(self) -> JsonTable:
        """Return {"days": [{"date", "slots"}]}: the plan's local days with their slots.

        A slot has slot (its id), t_utc, local, day (texts of its time), state (done, missed,
        aborted, made up (by another slot), running, to do), picture (whether it is merged) and
        sun_altitude_deg (true).
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

        slots: as in `calendar`, with `verdict`; scale: `scale_of` all pictures of the day;
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
    # parts

    def _present(self) -> _Present:
        """Return journal, plan and states now; a rehearsal has its own time, in the future."""
        journal, slots = self._journal.update(), self._slots()
        now = self._wall_clock()
        last = journal.states.last_utc or now
        if rehearsal := last - now > _REHEARSAL:
            now = last
        states = self._states(slots, journal, now)
        merged = {path.stem for path in self._session.panorama_files()}
        return _Present(journal, slots, now, rehearsal, states, merged)

    def _bins_of(self, day_utc: date) -> DayBins:
        """Return the irradiance of a UTC day, with the file's newest rows."""
        return self._bins(day_utc).update()

    def _slots(self) -> list[Slot]:
        """Return the plan, read again only when the file changed."""
        with suppress(OSError, InputError):  # spoilt by hand: the plan before still holds
            stamp = self._session.plan.stat().st_mtime_ns
            if stamp != self._plan[0]:
                slots = sorted(read_plan(self._session.plan), key=lambda slot: slot.t_utc)
                self._plan = stamp, slots
        return self._plan[1]

    def _states(self, slots: list[Slot], journal: JournalFollower, now: datetime) -> dict[str, str]:
        """Return done, missed, aborted, "made up", running or "to do" for each slot."""
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
        """Return what the page shows of a slot."""
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
        """Return the newest panorama with its verdict."""
        files = self._session.panorama_files()[-1:]
        if not files:
            return None
        slot = files[0].stem
        local = ""
        with suppress(ValueError):
            local = f"{parse_utc(slot).astimezone(self._zone):%a %d %b %Y, %H:%M}"
        verdict = self._verdict(slot, "no sidecar")
        return {"slot": slot, "verdict": verdict, "local": local, **scale_of(files)}

    def _verdict(self, slot: str, without_sidecar: str) -> str:
        try:
            sidecar = Sidecar.find(self._session.sidecar(slot))
        except InputError as error:
            return str(error)
        return sidecar.verdict if sidecar is not None else without_sidecar

    def _devices(self, journal: JournalFollower) -> JsonTable:
        """Return camera, battery and clock by the session, and since when devices are away."""
        table = self._session.table().get("devices", {})
        camera = table.get("camera", {})
        offset_s = camera.get("clock_offset_s")
        is_known = isinstance(offset_s, int | float) and abs(offset_s) < 1e9  # of a file
        return {
            "camera": " ".join(str(camera.get(k, "")) for k in ("make", "model")).strip(),
            "camera_battery": str(camera.get("battery", "")),
            "camera_clock_offset_s": offset_s if is_known else None,
            "away": {name: utc_text(t) for name, t in journal.away.items()},
        }

    def _disk(self, slots: list[Slot]) -> JsonTable:
        free = shutil.disk_usage(self._session.root).free
        days = len({self._local_day(slot.t_utc) for slot in slots})
        per_day = self._session.slot_bytes() * len(slots) / max(days, 1)
        return {"free_bytes": free, "days": free / per_day if per_day else None}

    def _events(self, journal: JournalFollower) -> list[JsonTable]:
        """Return the latest events, newest first; equal sentences in a row become one."""
        rows: list[JsonTable] = []
        for event in reversed(journal.events):
            level, text = event_words(event) or ("", "")
            if rows and rows[-1]["text"] == text:
                rows[-1]["times"] += 1
            elif text:
                local = parse_utc(event["t_utc"]).astimezone(self._zone)
                at = f"{local:%a %d %b %H:%M}"
                rows.append({"level": level, "text": text, "local": at, "times": 1})
        return rows[:25]  # about a screen

    def _doctor(self, period: float) -> list[JsonTable]:
        """Return doctor's findings that need no device; a capture may be using the devices.

        period: number of the five minutes of the session's time, since 1970.
        """
        now = datetime.fromtimestamp(period * _FINDINGS_EVERY_S, UTC)
        findings = doctor.run(self._session, "", "", now, only=doctor.WITHOUT_DEVICES)
        return [asdict(finding) for finding in findings]

    def _local_day(self, t_utc: datetime) -> date:
        return t_utc.astimezone(self._zone).date()
