"""Write the journal and rows to a disk that may be full.

A reserve file is deleted when the disk is full, to gain its space. What cannot be written waits in
memory.
"""

import errno
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from shutil import disk_usage
from typing import Any, TypeVar

from fieldlum.core.errors import InputError
from fieldlum.core.records import IrradianceSample
from fieldlum.session import DayFiles, Journal, Session, disk_is_full
from fieldlum.session.journal import EventFields
from fieldlum.session.safe_paths import open_inside

RESERVE_BYTES = 16 << 20  # bytes of twelve days of rows (75 bytes each, every 5 s); chosen

T = TypeVar("T")
Listen = Callable[[str, datetime, EventFields], None]


class Recorder:
    """The journal and the day files of one running capture.

    Writing an event or a row raises no error for faults of the disk: the recorder stores in memory
    what could not be written (of rows the newest 100 000), and tries again at the next event or
    row. now: returns UTC. reserve, reserve_bytes: name and size of a file that is deleted when the
    disk is full, to gain its space; each process has its own. flush: with False, files survive a
    killed process but not a power cut. listen: called with the name, the time and the fields of
    each event. journal, days: the open files. full: whether the disk was full and the reserve is
    deleted. rows: number written. last_event: for the display. Creating a recorder raises the
    errors of `Journal` and `DayFiles`.
    """

    def __init__(
        self,
        session: Session,
        now: Callable[[], datetime],
        reserve_bytes: int = RESERVE_BYTES,
        *,
        flush: bool = True,
        listen: Listen = lambda event, t_utc, fields: None,
        reserve: str = ".reserve",
    ) -> None:
        self._session, self._now, self._listen = session, now, listen
        self._reserve_bytes, self.flush = reserve_bytes, flush
        self._reserve = session.root / reserve
        self._lock = threading.RLock()
        self._events: deque[tuple[str, datetime, EventFields]] = deque()  # name, UTC and fields
        self._rows: deque[IrradianceSample] = deque(maxlen=100_000)  # almost six days at 5 s
        self.journal, self.days = Journal(session, flush=flush), DayFiles(session, flush=flush)
        self.full, self.rows = False, 0
        self.last_event = ""
        self.restore_reserve()

    def write_event(self, event: str, **fields: Any) -> bool:
        """Write an event with the current time to the journal; return whether it is on the disk.

        event: its kind, such as done; fields: the other keys of its line.
        """
        with self._lock:
            self.last_event = event
            t_utc = self._now()
            self._events.append((event, t_utc, fields))
            is_on_disk = self._flush_events()
        with suppress(Exception):  # a listener's defect must not end the capture
            self._listen(event, t_utc, fields)
        return is_on_disk

    def write_events(self, events: Iterable[tuple[str, EventFields]]) -> None:
        """Write several events, each a name and its fields, as `write_event` does."""
        for name, fields in events:
            self.write_event(name, **fields)

    def write_row(self, sample: IrradianceSample) -> bool:
        """Write a reading to its day file; return whether it is on the disk."""
        with self._lock:
            self._rows.append(sample)
            return self._flush_rows()

    def missing_bytes(self, size: float) -> int:
        """Return how many bytes are missing on the disk for a file of `size` bytes.

        Half of the reserve remains for the journal and the rows.
        """
        reserved = self._reserve.stat().st_size if self._reserve.is_file() else 0
        usable = self._free_bytes() + reserved - self._reserve_bytes // 2
        return max(0, round(size) - usable)

    def ensure_space(self, size: float) -> None:
        """Make sure that a file of `size` bytes fits, if necessary by deleting the reserve file.

        Raises OSError (ENOSPC) if the file does not fit and leave half of the reserve's size free.
        """
        with self._lock:
            if missing := self.missing_bytes(size):
                self.release_reserve()
                shown = f"{missing / 1e6:.2f} MB of free space are missing"
                self.last_event = f"disk-full: {shown}; delete other files"
                raise OSError(errno.ENOSPC, self.last_event)
            if self._free_bytes() < size:
                self.release_reserve()

    def _free_bytes(self) -> int:
        return disk_usage(self._reserve.parent).free

    def release_reserve(self) -> None:
        """Delete the reserve file, so that journal and rows can be written on a full disk.

        The journal gets the event disk-full. Further calls do nothing until `restore_reserve`.
        """
        with self._lock:
            if not self.full:
                self.full = True
                with suppress(OSError):
                    self._reserve.unlink(missing_ok=True)
                    self.write_event("disk-full", bytes_free=self._free_bytes())

    def restore_reserve(self) -> None:
        """Create the reserve file again if possible, and write what waits in memory.

        Called before each bracket.
        """
        with self._lock:
            try:
                _allocate(self._reserve, self._reserve_bytes)
                self.full = False
            except OSError as error:
                with suppress(OSError):
                    self._reserve.unlink(missing_ok=True)
                if disk_is_full(error):
                    self.release_reserve()
            self._flush_events()
            self._flush_rows()

    def _flush_events(self) -> bool:
        """Append the waiting events to the journal; return whether all are on the disk."""
        return self._flush(self._events, self._append_event)

    def _flush_rows(self) -> bool:
        """Append the waiting rows to the day files; return whether all are on the disk."""
        return self._flush(self._rows, self._append_row)

    def _append_event(self, event: tuple[str, datetime, EventFields]) -> None:
        """Append an event, its name, time and fields, to the journal."""
        name, t_utc, fields = event
        self.journal.append(name, t_utc, **fields)

    def _append_row(self, sample: IrradianceSample) -> None:
        """Append a reading to its day file, and count it."""
        self.days.append(sample)
        self.rows += 1

    def _flush(self, waiting: deque[T], write: Callable[[T], None]) -> bool:
        """Write the elements of `waiting` and remove them; return whether all were written.

        After a failure, delete the reserve or reopen the files, and try once more. write: writes
        one element.
        """
        is_first_failure = True
        while waiting:
            try:
                write(waiting[0])
                waiting.popleft()
            except OSError as error:
                is_full = disk_is_full(error)
                if not is_first_failure or (is_full and self.full):
                    return False
                is_first_failure = False
                self.release_reserve() if is_full else self._reopen(error)
        return True

    def _reopen(self, error: OSError) -> None:
        """Reopen journal and day files: handles fail after a disk was away or a folder moved.

        error: the failure, for the display.
        """
        self.last_event = f"not written: {error.strerror or error}"
        with suppress(OSError, InputError):
            self.days.close()
        with suppress(OSError, InputError):
            journal = Journal(self._session, flush=self.flush)
            with suppress(OSError):
                self.journal.close()
            self.journal = journal
            self.days = DayFiles(self._session, flush=self.flush)

    def close(self) -> None:
        """Write what waits in memory, close the files, and delete the reserve file.

        Errors of the disk are ignored; what cannot be written now is lost.
        """
        with self._lock:
            self._flush_events()
            self._flush_rows()
            with suppress(OSError):
                self.journal.close()
                self.days.close()
                self._reserve.unlink(missing_ok=True)


def _allocate(path: Path, size: int) -> None:
    """Create a file that occupies `size` bytes of the disk, unless it exists with this size.

    Its bytes are random, because some file systems compress zeros.
    """
    if path.is_file() and path.stat().st_size == size:
        return
    with os.fdopen(open_inside(path.parent, path, os.O_WRONLY | os.O_CREAT), "wb") as file:
        file.truncate()
        file.write(os.urandom(size))
