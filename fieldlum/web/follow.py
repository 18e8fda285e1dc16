"""Read the growing files of a session, each time from where the last reading ended.

A page that is open for a month must not read a month of files every few seconds, and its memory
must not grow. So each line of the journal updates one state, and a day of irradiance is a fixed
number of bins.
"""

from __future__ import annotations

import os
from collections import OrderedDict, deque
from dataclasses import dataclass, field
from datetime import date, datetime, timedelta
from pathlib import Path

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.records import parse_utc
from fieldlum.session import Session, decode_sample
from fieldlum.session.journal import decode_event
from fieldlum.session.ledger import Ledger, fold
from fieldlum.session.tables import JournalEvent

BIN_S = 120  # 720 points a day: more cannot be seen in a curve as wide as a page; chosen
_BINS = 86400 // BIN_S
_DAYS_KEPT = 6  # in memory; bounds it; chosen
_EVENTS_KEPT = 60  # in memory; more than a page shows; chosen


class LineTail:
    """Reads the lines of a growing file that are new since the last reading."""

    def __init__(self, path: Path) -> None:
        self._path, self._offset, self._inode = path, 0, 0

    def read(self) -> tuple[bool, list[bytes]]:
        """Return whether the file is new, replaced or shortened, and its complete unread lines.

        A missing or unreadable file gives False and no lines.
        """
        try:
            with self._path.open("rb") as file:
                about = os.fstat(file.fileno())
                again = about.st_ino != self._inode or about.st_size < self._offset
                if again:
                    self._offset, self._inode = 0, about.st_ino
                file.seek(self._offset)
                data = file.read()
        except OSError:  # not there yet, or a share that is away: look again later
            return False, []
        end = data.rfind(b"\n") + 1
        self._offset += end
        return again, data[:end].splitlines(keepends=True)


@dataclass(slots=True)
class JournalState:
    """State that follows from the journal so far.

    ledger: state of each slot. events: the latest 60 for the page, without frames, starts of
    brackets and illuminances. away: devices that do not answer now, with the time since when.
    opened: the last `open` event (start of a capture) without a `close`, or None.
    """

    ledger: Ledger = field(default_factory=Ledger)
    events: deque[JournalEvent] = field(default_factory=lambda: deque(maxlen=_EVENTS_KEPT))
    away: dict[str, datetime] = field(default_factory=dict)
    opened: JournalEvent | None = None

    def add(self, event: JournalEvent) -> None:
        """Update all fields by one event of the journal."""
        kind = event["event"]
        fold((event,), self.ledger)
        if kind == "open":
            self.opened, self.away = event, {}
        elif kind == "close":
            self.opened = None
        elif kind == "device-lost":
            self.away[str(event.get("device", ""))] = parse_utc(event["t_utc"])
        elif kind == "device-back":
            self.away.pop(str(event.get("device", "")), None)
        if kind not in ("frame", "retake", "started", "illuminance"):
            self.events.append(event)


class JournalFollower:
    """Keeps a `JournalState` up to date with the file; `update` reads what is new."""

    def __init__(self, session: Session) -> None:
        self._tail, self.state = LineTail(session.journal), JournalState()

    def update(self) -> JournalState:
        """Read the journal's new lines, skip damaged ones; return the state after all lines."""
        again, lines = self._tail.read()
        if again:
            self.state = JournalState()
        for line in lines:
            if (event := decode_event(line)) is not None:
                self.state.add(event)
        return self.state


class DayBins:
    """Mean irradiances in 720 bins of two minutes, from the logger's file of one UTC day.

    flagged: mask of bins, True with an error that the instrument reported; status: number of rows
    by such an error; last: time and global irradiance of the last row, or None.
    """

    def __init__(self, path: Path) -> None:
        self._tail = LineTail(path)
        self._clear()

    def _clear(self) -> None:
        self._sum = np.zeros((_BINS, 3))
        self._count = np.zeros((_BINS, 3))
        self.flagged = np.zeros(_BINS, bool)
        self.status: dict[str, int] = {}
        self.last: tuple[datetime, float | None] | None = None

    def update(self) -> None:
        """Add the new rows of the file; begin again if it was replaced or shortened."""
        again, lines = self._tail.read()
        if again:
            self._clear()
        for line in lines:
            sample = decode_sample(line)
            if sample is None:
                continue
            midnight = sample.t_utc.replace(hour=0, minute=0, second=0, microsecond=0)
            k = int((sample.t_utc - midnight).total_seconds() // BIN_S)
            for i, value in enumerate((sample.ghi_wm2, sample.dni_wm2, sample.dhi_wm2)):
                if value is not None:
                    self._sum[k, i] += value
                    self._count[k, i] += 1
            if sample.status:
                self.flagged[k] = True
                if sample.status in self.status or len(self.status) < 20:
                    self.status[sample.status] = self.status.get(sample.status, 0) + 1
            self.last = sample.t_utc, sample.ghi_wm2

    @property
    def means(self) -> Floats:
        """GHI, DNI and DHI, in this order, [720, 3] in W/m2; NaN without a reading."""
        return np.where(self._count > 0, self._sum / np.maximum(self._count, 1), np.nan)


class IrradianceFollower:
    """Irradiance of UTC days, read when requested; the last six requested days stay in memory."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._days: OrderedDict[date, DayBins] = OrderedDict()

    def day(self, day_utc: date) -> DayBins:
        """Return the irradiance bins of a UTC day, with the file's newest rows."""
        if day_utc not in self._days:
            path = self._session.irradiance / f"{day_utc.isoformat()}.csv"
            self._days[day_utc] = DayBins(path)
        self._days.move_to_end(day_utc)
        while len(self._days) > _DAYS_KEPT:
            self._days.popitem(last=False)
        self._days[day_utc].update()
        return self._days[day_utc]

    def latest(self, now: datetime) -> tuple[datetime, float | None] | None:
        """Return time and global irradiance of the last row of today or yesterday (UTC).

        None without a row; the irradiance [W/m2] is None if the row has none.
        """
        for day in (now.date(), now.date() - timedelta(days=1)):
            if (last := self.day(day).last) is not None:
                return last
        return None
