"""Read the growing files of a session, each time from where the last reading ended.

A page that is open for a month must not read a month of files every few seconds, and its memory
must not grow. So each line of the journal updates one state, and a day of irradiance is a fixed
number of bins.
"""

from __future__ import annotations

import os
from collections import Counter, deque
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


class JournalFollower:
    """State that follows from the journal so far; `update` reads what is new.

    ledger: state of each slot. events: the latest 60 for the page, without frames, starts of
    brackets and illuminances. away: devices that do not answer now, with the time since when.
    opened: the last `open` event (start of a capture) without a `close`, or None.
    """

    def __init__(self, session: Session) -> None:
        self._tail = LineTail(session.journal)
        self._clear()

    def _clear(self) -> None:
        self.ledger = Ledger()
        self.events: deque[JournalEvent] = deque(maxlen=_EVENTS_KEPT)
        self.away: dict[str, datetime] = {}
        self.opened: JournalEvent | None = None

    def update(self) -> JournalFollower:
        """Read the journal's new lines, skip damaged ones; return itself."""
        again, lines = self._tail.read()
        if again:
            self._clear()
        for event in filter(None, map(decode_event, lines)):
            self._add(event)
        return self

    def _add(self, event: JournalEvent) -> None:
        kind, device = event["event"], str(event.get("device", ""))
        fold((event,), self.ledger)
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


class DayBins:
    """Mean irradiances in 720 bins of two minutes, from the logger's file of one UTC day.

    flagged: mask of bins, True with an error that the instrument reported; status: number of rows
    by such an error; last: time and global irradiance of the last row, or None.
    """

    def __init__(self, path: Path) -> None:
        self._tail = LineTail(path)
        self._clear()

    def _clear(self) -> None:
        self._sum, self._count = np.zeros((2, _BINS, 3))
        self.flagged = np.zeros(_BINS, bool)
        self.status: Counter[str] = Counter()
        self.last: tuple[datetime, float | None] | None = None

    def update(self) -> DayBins:
        """Add the new rows of the file; begin again if it was replaced. Return itself."""
        again, lines = self._tail.read()
        if again:
            self._clear()
        for sample in filter(None, map(decode_sample, lines)):
            t = sample.t_utc
            k = (t.hour * 3600 + t.minute * 60 + t.second) // BIN_S
            row = np.array([sample.ghi_wm2, sample.dni_wm2, sample.dhi_wm2], float)
            self._sum[k] += np.nan_to_num(row)
            self._count[k] += np.isfinite(row)
            if sample.status:
                self.flagged[k] = True
                self.status[sample.status] += 1
            self.last = t, sample.ghi_wm2
        return self

    @property
    def means(self) -> Floats:
        """GHI, DNI and DHI, in this order, [720, 3] in W/m2; NaN without a reading."""
        return np.where(self._count > 0, self._sum / np.maximum(self._count, 1), np.nan)


class IrradianceFollower:
    """Irradiance of UTC days, read when requested; the last six requested days stay in memory."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._days: dict[date, DayBins] = {}

    def day(self, day_utc: date) -> DayBins:
        """Return the irradiance bins of a UTC day, with the file's newest rows."""
        path = self._session.irradiance / f"{day_utc.isoformat()}.csv"
        self._days[day_utc] = self._days.pop(day_utc, None) or DayBins(path)  # now the newest
        while len(self._days) > _DAYS_KEPT:
            del self._days[next(iter(self._days))]
        return self._days[day_utc].update()

    def latest(self, now: datetime) -> tuple[datetime, float | None] | None:
        """Return time and global irradiance of the last row of today or yesterday (UTC).

        None without a row; the irradiance [W/m2] is None if the row has none.
        """
        days = (now.date(), now.date() - timedelta(days=1))
        return next((last for day in days if (last := self.day(day).last) is not None), None)
