"""Decide which events of a running capture are reported by message, or by a command of the user.

The capture passes on its journal events and, about once a second, its state. Each fault causes one
message. A fault of the same kind causes another message only after it was over, or after six hours.
"""

from __future__ import annotations

import os
import subprocess
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import date, datetime, timedelta
from pathlib import Path
from zoneinfo import ZoneInfo

from fieldlum.capture.notify import Message
from fieldlum.capture.recorder import Recorder
from fieldlum.core.records import parse_utc
from fieldlum.session.ledger import SlotState
from fieldlum.session.tables import EventFields

# Not measured. Chosen so that a message means that somebody should act, and that faults which the
# capture repairs itself cause none. A device that reconnects needs at most two tries (30 s each).
DEVICE_AWAY = timedelta(minutes=10)
LOW_DISK_DAYS = 3.0  # days of captures; leaves a weekend to bring a disk; chosen
# days of captures; above this, a new alert about the disk is possible; chosen
ENOUGH_DISK_DAYS = 4.0
# a single missed slot can be due to a slow bracket before it; chosen, not measured
MISSES_IN_A_ROW = 2
QUIET = timedelta(hours=6)
_HOOK_TIMEOUT_S = 300.0  # the time until the next slot is usually longer; not measured


@dataclass(slots=True)
class DayCount:
    """Counts of the outcomes of slots on one local day, and its highest global irradiance.

    doubtful: number of the done ones with a doubt; highest_ghi_wm2: None without a reading.
    """

    done: int = 0
    missed: int = 0
    aborted: int = 0
    doubtful: int = 0
    highest_ghi_wm2: float | None = None


@dataclass(slots=True)
class Alerts:
    """The faults already reported, and the counts of the current day, in one capture.

    name, timezone: of the site; contact_sheet: called for a daily summary, returns the picture to
    attach, or None.
    """

    name: str
    timezone: str
    contact_sheet: Callable[[], Path | None] = lambda: None
    _away_since: dict[str, datetime] = field(default_factory=dict)
    _reported_away: set[str] = field(default_factory=set)
    _misses: int = 0
    _disk_is_low: bool = False
    _last: dict[str, datetime] = field(default_factory=dict)
    _day: date | None = None
    _count: DayCount = field(default_factory=DayCount)

    def event(self, event: str, t_utc: datetime, fields: EventFields) -> list[Message]:
        """Return the messages to send for a journal event and, on a new day, the daily summary."""
        messages = self._new_day(t_utc)
        if event == "device-lost":
            self._away_since.setdefault(str(fields.get("device")), t_utc)
        elif event == "device-back":
            messages += self._back(str(fields.get("device")), t_utc)
        elif event in ("done", "missed", "aborted"):
            messages += self._outcome(event, t_utc, fields)
        elif event == "clock-step":
            messages += self._clock_step(t_utc, fields)
        elif event == "disk-full":
            free = f"The disk has {fields.get('bytes_free', 0) / 1e6:.0f} MB free."
            messages += self._once("disk-full", t_utc, "the disk is full", free)
        return messages

    def look(
        self,
        t_utc: datetime,
        disk_days: float | None,
        ghi_wm2: float | None,
    ) -> list[Message]:
        """Return the messages that are due at a time, whether or not an event happened.

        disk_days: days of captures that the free disk space holds. ghi_wm2: latest global
        irradiance [W/m2]. None: unknown.
        """
        messages = self._new_day(t_utc)
        if ghi_wm2 is not None:
            highest = self._count.highest_ghi_wm2
            self._count.highest_ghi_wm2 = ghi_wm2 if highest is None else max(highest, ghi_wm2)
        for device, since in self._away_since.items():
            if device not in self._reported_away and t_utc - since >= DEVICE_AWAY:
                self._reported_away.add(device)
                minutes = (t_utc - since).total_seconds() / 60.0
                body = (
                    f"{device} stopped answering at {self._local(since)}, {minutes:.0f} minutes "
                    "ago."
                )
                messages.append(self._message(f"{device} is lost", body))
        return messages + self._disk(disk_days)

    def _back(self, device: str, t_utc: datetime) -> list[Message]:
        since = self._away_since.pop(device, None)
        if device not in self._reported_away or since is None:
            return []
        self._reported_away.discard(device)
        minutes = (t_utc - since).total_seconds() / 60.0
        return [
            self._message(
                f"{device} is back", f"{device} did not answer for {minutes:.0f} minutes."
            )
        ]

    def _outcome(self, event: str, t_utc: datetime, fields: EventFields) -> list[Message]:
        slot, why = fields.get("slot", ""), fields.get("why", "")
        setattr(self._count, event, getattr(self._count, event) + 1)
        if event == "done":
            self._misses = 0
            self._count.doubtful += bool(why)
            if "clipped" not in why:
                return []
            body = f"Bracket {self._slot(slot)}: {why}. The exposures may no longer suit the light."
            return self._once("clipped", t_utc, "a bracket is clipped", body)
        self._misses += 1
        if self._misses != MISSES_IN_A_ROW:
            return []
        body = f"The last slot was {self._slot(slot)} ({event}): {why or 'no reason recorded'}."
        return [self._message(f"{self._misses} slots in a row gave no bracket", body)]

    def _clock_step(self, t_utc: datetime, fields: EventFields) -> list[Message]:
        follows = "follows" if fields.get("followed") else "does not follow"
        body = f"The computer's clock jumped by {fields.get('seconds', 0.0):+.0f} s. "
        body += f"The capture {follows} the new time."
        return self._once("clock-step", t_utc, "the clock jumped", body)

    def _disk(self, disk_days: float | None) -> list[Message]:
        if disk_days is None:
            return []
        if self._disk_is_low:
            self._disk_is_low = disk_days < ENOUGH_DISK_DAYS
            return []
        if disk_days >= LOW_DISK_DAYS:
            return []
        self._disk_is_low = True
        body = f"The disk has room for {disk_days:.1f} more days of captures."
        return [self._message("the disk is nearly full", body)]

    def _new_day(self, t_utc: datetime) -> list[Message]:
        """Return the summary of the day that just ended; return it only once."""
        today = t_utc.astimezone(ZoneInfo(self.timezone)).date()
        if self._day is None or today <= self._day:
            self._day = self._day or today
            return []
        ended, count = self._day, self._count
        self._day, self._count = today, DayCount()
        if not (count.done or count.missed or count.aborted):
            return []
        ghi = count.highest_ghi_wm2
        body = (
            f"{count.done} brackets done ({count.doubtful} with a doubt), {count.missed} missed, "
            f"{count.aborted} aborted."
        )
        if ghi is not None:
            body += f" Highest global irradiance {ghi:.0f} W/m2."
        return [self._message(f"summary of {ended.isoformat()}", body, self.contact_sheet())]

    def _once(self, kind: str, t_utc: datetime, title: str, body: str) -> list[Message]:
        last = self._last.get(kind)
        if last is not None and t_utc - last < QUIET:
            return []
        self._last[kind] = t_utc
        return [self._message(title, body)]

    def _message(self, title: str, body: str, picture: Path | None = None) -> Message:
        return Message(f"fieldlum {self.name}: {title}", body, picture)

    def _local(self, t_utc: datetime) -> str:
        return f"{t_utc.astimezone(ZoneInfo(self.timezone)):%Y-%m-%d %H:%M}"

    def _slot(self, slot: str) -> str:
        try:
            return f"{slot} ({self._local(parse_utc(slot))})"
        except ValueError:
            return slot


@dataclass(slots=True)
class MissedHook:
    """Counts slots in a row without a bracket; runs `command`, if not empty, after the second.

    command: run by the shell in `folder`; recorder: receives events about it.
    """

    command: str
    folder: Path
    recorder: Recorder
    _misses: int = 0

    def count(self, slot: str, state: SlotState) -> None:
        """Count slots in a row that were not done; at the second, run the command in a thread.

        Environment variables FIELDLUM_SLOT, _OUTCOME, _REASON and _SESSION describe the slot.
        """
        self._misses = 0 if state.outcome == "done" else self._misses + 1
        if self._misses != MISSES_IN_A_ROW or not self.command:
            return
        self.recorder.tell("hook", command=self.command)
        about = {
            "FIELDLUM_SLOT": slot,
            "FIELDLUM_OUTCOME": state.outcome,
            "FIELDLUM_REASON": state.why,
            "FIELDLUM_SESSION": str(self.folder.resolve()),
        }
        arguments = (self.command, self.folder, about, self.recorder.tell)
        threading.Thread(target=_run_hook, args=arguments, daemon=True).start()


def _run_hook(
    command: str, folder: Path, about: dict[str, str], tell: Callable[..., object]
) -> None:
    """Run the user's command for missed slots, and journal a failure of it.

    Environment variables state the slot, its outcome, the reason and the session's folder.
    """
    try:
        code = subprocess.run(
            command,
            shell=True,
            cwd=folder,
            env={**os.environ, **about},
            timeout=_HOOK_TIMEOUT_S,
            stdin=subprocess.DEVNULL,
            check=False,
        ).returncode
        why = f"exit code {code}" if code else ""
    except (OSError, subprocess.SubprocessError) as error:
        why = type(error).__name__
    if why:
        tell("hook-failed", why=why)
