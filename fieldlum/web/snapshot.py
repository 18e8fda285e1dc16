"""Plain tables of a session for the page of `fieldlum watch`, from files that grow.

The journal is read from where the last reading ended: a page that is open for a month must not read
a month of events every few seconds, and its memory must not grow.
"""

from __future__ import annotations

import os
import shutil
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import asdict
from datetime import UTC, date, datetime, timedelta
from functools import lru_cache
from pathlib import Path
from typing import Literal, Self
from zoneinfo import ZoneInfo

import numpy as np
import psutil

from fieldlum.capture import doctor
from fieldlum.capture.status import status
from fieldlum.capture.utc_clock import boot_id
from fieldlum.core.arrays import Floats
from fieldlum.core.errors import InputError
from fieldlum.core.false_colour import colour_table, coloured, luminance_ends, png_of, shared_scale
from fieldlum.core.records import IrradianceSample, JsonTable, Site, Slot, parse_utc, utc_text
from fieldlum.optics.images import read_panorama
from fieldlum.session import Session
from fieldlum.session.codec import to_json
from fieldlum.session.day_files import decode_sample, read_day
from fieldlum.session.files.predict_json import PredictFile
from fieldlum.session.files.sidecar import Sidecar
from fieldlum.session.journal import JournalEvent, decode_event
from fieldlum.session.slot_states import SETTLED, SlotStates, fold, made_up_for
from fieldlum.sky import sun

BIN_S = 120  # 720 points a day: more cannot be seen in a curve as wide as a page; chosen


class JournalFollower:
    """What the journal states so far; `update` adds the lines that are new.

    states: state of each slot. events: the latest 60 for the page, without frames, starts of
    brackets and illuminances. away: devices that do not answer now, with the time since when.
    opened: the last `open` event (start of a capture) without a `close`, or None.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._begin(0)

    def _begin(self, inode: int) -> None:
        self._offset, self._inode = 0, inode
        self.states = SlotStates()
        # more than a page shows
        self.events: deque[JournalEvent] = deque(maxlen=60)
        self.away: dict[str, datetime] = {}
        self.opened: JournalEvent | None = None

    def update(self) -> Self:
        """Add the complete unread lines, all of a file that was replaced or shortened.

        A missing or unreadable file changes nothing: it may be on a share that is away.
        """
        with suppress(OSError), self._path.open("rb") as file:
            about = os.fstat(file.fileno())
            if about.st_ino != self._inode or about.st_size < self._offset:
                self._begin(about.st_ino)
            file.seek(self._offset)
            data = file.read()
            end = data.rfind(b"\n") + 1
            self._offset += end
            for line in data[:end].splitlines(keepends=True):
                if (event := decode_event(line)) is not None:
                    self._add(event)
        return self

    def _add(self, event: JournalEvent) -> None:
        kind, device = event["event"], str(event.get("device", ""))
        fold((event,), self.states)
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


# ----------------------------------------------------------------------------------------------
# pictures


def scale_of(paths: Iterable[Path]) -> JsonTable:
    """Return one scale of panoramas in cd/m2, and a text that changes when one is written again.

    A panorama that cannot be read is left out: a merge may be writing it.
    """
    ends, stamps = [], [0]
    for path in paths:
        with suppress(InputError, OSError):
            stamps.append(path.stat().st_mtime_ns)
            ends.append(_ends(path, stamps[-1]))
    low, high = shared_scale(ends)
    return {"low": low, "high": high, "stamp": f"{max(stamps):x}"}


@lru_cache(maxsize=1024)
def _ends(path: Path, stamp: int) -> tuple[float, float] | None:
    return luminance_ends(read_panorama(path).seen_cdm2)


def picture_png(path: Path, low: float, high: float) -> bytes:
    """Return a panorama in false colour as PNG, at most 1840 pixels wide: four times the usual.

    The scale is logarithmic from low to high [cd/m2]. Raises InputError for a damaged file, OSError
    for a missing one.
    """
    import cv2

    values = read_panorama(path).seen_cdm2  # [H, W]
    if values.shape[1] > 1840:
        shrunk = cv2.resize(values, (1840, 920), interpolation=cv2.INTER_AREA)
        values = np.asarray(shrunk, np.float32)
    return png_of(coloured(values, low, high))


def scale_png() -> bytes:
    """Return the colours of the scale from low to high as a PNG of 256 x 1 pixels."""
    return png_of(colour_table()[None])


# ----------------------------------------------------------------------------------------------
# tables


def day_curve(day: date, site: Site, folder: Path) -> JsonTable:
    """Return the irradiance of a local day in bins of 2 min [W/m2], and which bins are flagged.

    Flagged are values that are impossible for the sun's altitude, and bins with an error that the
    instrument reported. Bins at night without a reading are omitted; a missing value is None.
    folder: the session's day files. A day has 23 or 25 hours when clocks change.
    """
    zone = ZoneInfo(site.timezone)
    ends = (datetime(d.year, d.month, d.day, tzinfo=zone) for d in (day, day + timedelta(days=1)))
    start, end = (t.astimezone(UTC) for t in ends)
    bins = (end - start) // timedelta(seconds=BIN_S)
    times = [start + timedelta(seconds=BIN_S * (k + 0.5)) for k in range(bins)]
    total, count = np.zeros((2, len(times), 3))
    reported, kinds = np.zeros(len(times), bool), Counter[str]()
    for sample in _samples(folder, start, end):
        k = (sample.t_utc - start) // timedelta(seconds=BIN_S)
        row = np.array([sample.ghi_wm2, sample.dni_wm2, sample.dhi_wm2], float)
        total[k] += np.nan_to_num(row)
        count[k] += np.isfinite(row)
        if sample.status:
            reported[k] = True
            kinds[sample.status] += 1
    values = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    present = np.isfinite(values).any(axis=1)
    impossible, clear = np.zeros(len(times), bool), np.full(len(times), np.nan)
    if present.any():
        limits = sun.bsrn_limits(
            sun.position(times, site).altitude_deg, sun.extraterrestrial_wm2(times)
        )
        low, high = zip(limits.ghi_wm2, limits.dni_wm2, limits.dhi_wm2, strict=True)
        impossible = ((values < low) | (values > np.stack(high, axis=-1))).any(axis=1)
        clear = sun.clearsky(times, site).ghi_wm2
    keep = present | (np.nan_to_num(clear) > 1.0)
    ghi, dni, dhi, clear_ghi = (_numbers(v) for v in (*values[keep].T, clear[keep]))
    return {
        "ghi": ghi,
        "dni": dni,
        "dhi": dhi,
        "minutes": (np.flatnonzero(keep) * (BIN_S / 60) + BIN_S / 120).tolist(),
        "clear_ghi": clear_ghi,
        "flagged": (reported | impossible)[keep].tolist(),
        "flagged_bins": int(reported.sum()),
        "impossible_bins": int(impossible.sum()),
        "status": dict(kinds),
    }


def _samples(folder: Path, start: datetime, end: datetime) -> list[IrradianceSample]:
    """Return the readings of a period within two UTC days."""
    found: list[IrradianceSample] = []
    for day in sorted({start.date(), end.date()}):
        with suppress(OSError):
            found += read_day(folder / f"{day}.csv")[0]
    return [sample for sample in found if start <= sample.t_utc < end]


def _latest_sample(folder: Path, now: datetime) -> JsonTable | None:
    """Return time and global irradiance of the last row of today or yesterday (UTC)."""
    for day in (now.date(), now.date() - timedelta(days=1)):
        with suppress(OSError), (folder / f"{day}.csv").open("rb") as file:
            file.seek(-min(4096, file.seek(0, os.SEEK_END)), os.SEEK_END)
            for line in reversed(file.read().splitlines(keepends=True)):
                if (sample := decode_sample(line)) is not None:
                    return {"t_utc": utc_text(sample.t_utc), "ghi_wm2": sample.ghi_wm2}
    return None


def _numbers(values: Floats) -> list[float | None]:
    return [None if not np.isfinite(value) else round(float(value), 1) for value in values]


Level = Literal["info", "warn", "fail"]

# Events that are no news on a page: the plan's calendar shows outcomes.
_SILENT = frozenset({"imported", "withdrawn"})
_WORDS: dict[str, tuple[Level, str]] = {  # sentences with fields of the event
    "done": ("warn", "Bracket {slot} is complete, with a warning: {why}."),
    "missed": ("fail", "Bracket {slot} was not taken: {why}."),
    "aborted": ("fail", "Bracket {slot} was ended before it was complete: {why}."),
    "device-lost": ("fail", "The {device} stopped answering ({why}). The capture tries it again."),
    "device-back": ("info", "The {device} answers again after {after_s:.0f} s."),
    "bad-reading": ("warn", "The {device} gave a reading that cannot be used: {why}."),
    "clock-step": ("warn", "The computer's clock jumped by {seconds:+.0f} s."),
    "suspend": ("warn", "The computer slept for {seconds:.0f} s."),
    "disk-full": ("fail", "The disk is full."),
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
    level, sentence = _WORDS.get(kind, ("info", "{event}"))
    fields = dict.fromkeys(("slot", "state", "text"), "") | {"device": "a device"}
    numbers = dict.fromkeys(("by_s", "after_s", "seconds"), 0.0)
    why = {"why": why or "no reason recorded"}
    return level, sentence.format(**{**fields, **numbers, **event, **why})


def is_running(journal: JournalFollower) -> bool:
    """Return whether the capture that the journal shows as open runs on this computer.

    False without an open one, or if it began before this boot or on another computer.
    """
    opened = journal.opened
    if opened is None or opened.get("boot_id") not in ("", None, boot_id()):
        return False
    pid = opened.get("pid", 0)
    return 0 < pid < 2**31 and psutil.pid_exists(pid)


def battery() -> JsonTable | None:
    """Return {"percent", "mains"} of this computer's battery; None where there is none.

    mains: whether it has external power; None if that is unknown.
    """
    found = psutil.sensors_battery() if hasattr(psutil, "sensors_battery") else None
    return found and {"percent": round(found.percent), "mains": found.power_plugged}


_FINDINGS_EVERY = timedelta(minutes=5)  # not measured
# A journal this far ahead of the computer's clock comes from `capture --clock fast`. Chosen.
_REHEARSAL = timedelta(hours=1)


class Snapshots:
    """Tables of one session for the page of `fieldlum watch`, usable from several threads.

    wall_clock: returns the present moment (UTC). Raises InputError for a bad session.toml.
    """

    def __init__(
        self, session: Session, wall_clock: Callable[[], datetime] = lambda: datetime.now(UTC)
    ) -> None:
        self._session, self._wall_clock = session, wall_clock
        self._lock = threading.Lock()
        self._journal = JournalFollower(session.journal)
        self._setup = session.site_file()
        self._zone = ZoneInfo(self._setup.site.timezone)
        self._slots: list[Slot] = []
        self._states: dict[str, str] = {}  # by slot id
        self._merged: set[str] = set()  # slots with a panorama
        self._findings: tuple[datetime, list[JsonTable]] | None = None

    def state(self) -> JsonTable:
        """Return the present state: next slot, counts, newest picture, devices, events, checks."""
        with self._lock:
            now, rehearsal = self._update()
            states = list(self._states.values())
            ahead = [s for s in self._slots if self._states[s.id] in ("to do", "running")]
            version = hash((*self._states.items(), *sorted(self._merged)))
            return {
                "name": self._setup.site.name,
                "folder": self._session.root.resolve().name,
                "timezone": self._setup.site.timezone,
                "now_utc": utc_text(now),
                "now_local": f"{now.astimezone(self._zone):%a %d %b %Y, %H:%M}",
                "rehearsal": rehearsal,
                "running": is_running(self._journal),
                "counts": {word: states.count(word) for word in dict.fromkeys(states)},
                "slots": len(states),
                "next": self._slot_row(ahead[0]) if ahead else None,
                "latest": self._latest(),
                "devices": self._devices(),
                "irradiance": _latest_sample(self._session.irradiance, now),
                "free_bytes": shutil.disk_usage(self._session.root).free,
                "computer": battery(),
                "events": self._events(),
                "findings": self._doctor(now),
                "version": f"{version:x}",
                "today": self._local_day(now).isoformat(),
            }

    def answer(self) -> JsonTable:
        """Return the glare classes of the newest predicted year, None without one.

        With them is the command that comes next, as `fieldlum status` states it.
        """
        folders = self._session.annual_folders()
        newest = max(folders, key=lambda f: (f / PredictFile.NAME).stat().st_mtime, default=None)
        year = None if newest is None else PredictFile.read(newest)
        return {
            "next_step": status(self._session)["next_step"],
            "year": year
            and {
                "model": year.model,
                "weather": year.weather.name,
                "synthetic": year.weather.synthetic,
                "warnings": year.model_warnings,
                "protection": to_json(year.protection),
            },
        }

    def calendar(self) -> JsonTable:
        """Return the local days of the plan with the state of each slot.

        The states are done, missed, aborted, made up (by another slot), running, to do.
        """
        with self._lock:
            self._update()
            days: dict[str, list[JsonTable]] = {}
            for slot in self._slots:
                day = self._local_day(slot.t_utc).isoformat()
                days.setdefault(day, []).append(self._slot_row(slot))
            return {"days": [{"date": day, "slots": rows} for day, rows in sorted(days.items())]}

    def day(self, day: date) -> JsonTable:
        """Return a local day's slots with verdicts and pictures, and its irradiance.

        The scale is one for all pictures of the day [cd/m2].
        """
        with self._lock:
            self._update()
            rows = [self._slot_row(s) for s in self._slots if self._local_day(s.t_utc) == day]
            for row in rows:
                why = self._journal.states.state(row["slot"]).why
                row["verdict"] = self._verdict(row["slot"], why)
            return {
                "date": day.isoformat(),
                "slots": rows,
                "scale": scale_of(self._session.panorama(r["slot"]) for r in rows if r["picture"]),
                "irradiance": day_curve(day, self._setup.site, self._session.irradiance),
            }

    # ------------------------------------------------------------------------------------------
    # parts

    def _update(self) -> tuple[datetime, bool]:
        """Read the files, and return the time, and whether it is the simulated one of a capture."""
        journal, now = self._journal.update(), self._wall_clock()
        # a plan spoilt by hand: the one before still holds, as in capture
        with suppress(OSError, InputError):
            self._slots = sorted(self._session.slots(), key=lambda slot: slot.t_utc)
        last = journal.states.last_utc or now
        rehearsal = last - now > _REHEARSAL
        now = last if rehearsal else now
        self._states = {slot.id: self._state(slot, now) for slot in self._slots}
        for missed, instead in made_up_for(self._slots).items():
            done = any(self._states[makeup.id] == "done" for makeup in instead)
            if done and self._states.get(missed) != "done":
                self._states[missed] = "made up"
        self._merged = {path.stem for path in self._session.panorama_files()}
        return now, rehearsal

    def _state(self, slot: Slot, now: datetime) -> str:
        outcome = self._journal.states.state(slot.id).outcome
        if outcome in SETTLED:
            return outcome
        if outcome == "started" and self._journal.opened is not None:
            return "running"
        return "to do" if slot.t_utc + self._session.grace >= now else "missed"

    def _slot_row(self, slot: Slot) -> JsonTable:
        local = slot.t_utc.astimezone(self._zone)
        return {
            "slot": slot.id,
            "t_utc": utc_text(slot.t_utc),
            "local": f"{local:%H:%M}",
            "day": f"{local:%a %d %b %Y}",
            "state": self._states[slot.id],
            "picture": slot.id in self._merged,
            "sun_altitude_deg": round(slot.sun_altitude_deg, 1),
        }

    def _latest(self) -> JsonTable | None:
        """Return the newest panorama with its verdict."""
        files = self._session.panorama_files()[-1:]
        if not files:
            return None
        slot = files[0].stem
        row = {"slot": slot, "verdict": self._verdict(slot, "no sidecar"), **scale_of(files)}
        with suppress(ValueError):
            local = parse_utc(slot).astimezone(self._zone)
            row["local"] = f"{local:%a %d %b %Y, %H:%M}"
        return row

    def _verdict(self, slot: str, without_sidecar: str) -> str:
        try:
            sidecar = Sidecar.find(self._session.sidecar(slot))
        except InputError as error:
            return str(error)
        return sidecar.verdict if sidecar is not None else without_sidecar

    def _devices(self) -> JsonTable:
        camera = self._session.table().get("devices", {}).get("camera", {})
        return {
            "camera": " ".join(str(camera.get(k, "")) for k in ("make", "model")).strip(),
            "camera_battery": str(camera.get("battery", "")),
            "camera_clock_offset_s": camera.get("clock_offset_s"),
            "away": {name: utc_text(t) for name, t in self._journal.away.items()},
        }

    def _events(self) -> list[JsonTable]:
        """Return the latest events, newest first; equal sentences in a row become one."""
        rows: list[JsonTable] = []
        for event in reversed(self._journal.events):
            level, text = event_words(event) or ("", "")
            if rows and rows[-1]["text"] == text:
                rows[-1]["times"] += 1
            elif text:
                local = parse_utc(event["t_utc"]).astimezone(self._zone)
                row = {"level": level, "text": text, "local": f"{local:%a %d %b %H:%M}"}
                rows.append(row | {"times": 1})
        return rows[:25]  # about a screen

    def _doctor(self, now: datetime) -> list[JsonTable]:
        """Return doctor's findings that need no device; a capture may be using the devices."""
        if self._findings is not None and abs(now - self._findings[0]) < _FINDINGS_EVERY:
            return self._findings[1]
        findings = doctor.run(self._session, "", "", now, only=doctor.WITHOUT_DEVICES)
        self._findings = now, [asdict(finding) for finding in findings]
        return self._findings[1]

    def _local_day(self, t_utc: datetime) -> date:
        return t_utc.astimezone(self._zone).date()
