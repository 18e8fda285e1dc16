"""journal.jsonl: all events of a session, appended one per line.

Several processes may append: a capture runs while `fieldlum status --mark` marks a slot.
"""

from __future__ import annotations

import os
import threading
from datetime import datetime
from typing import Unpack

from fieldlum.records import utc_text
from fieldlum.session.folder import Session
from fieldlum.session.lines import (
    append_complete,
    cut_torn_tail,
    decode_line,
    encode_line,
    exclusive,
)
from fieldlum.session.tables import EventFields, JournalEvent


class Journal:
    """The session's events; any thread may append. Each line has a CRC.

    cut_bytes: size of the incomplete last line that opening moved to journal.jsonl.torn. Opening
    raises InputError if the end of the file has no valid line.
    """

    def __init__(self, session: Session, *, flush: bool = True) -> None:
        """Open the journal, and move an incomplete last line to journal.jsonl.torn.

        flush: with False, lines survive a killed process but not a power cut; used for simulated
        time.
        """
        self._path, self._flush = session.journal, flush
        self._lock = threading.Lock()
        self._handle = os.open(self._path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
        with exclusive(self._handle):  # another process may be writing a line
            self.cut_bytes = cut_torn_tail(self._path, lambda line: decode_line(line) is not None)

    def append(self, event: str, t_utc: datetime, **fields: Unpack[EventFields]) -> None:
        """Append an event; with `flush` it is on the disk when this returns.

        Raises OSError on a full disk, after removing a partly written line.
        """
        data = encode_line({"event": event, "t_utc": utc_text(t_utc), **fields})
        with self._lock, exclusive(self._handle):
            append_complete(self._handle, data, flush=self._flush)

    def close(self) -> None:
        """Close the file."""
        os.close(self._handle)


def append_event(
    session: Session, event: str, t_utc: datetime, **fields: Unpack[EventFields]
) -> None:
    """Append one event to the journal, even while another process captures.

    Raises OSError on a full disk, InputError if the end of the journal has no valid line.
    """
    journal = Journal(session)
    try:
        journal.append(event, t_utc, **fields)
    finally:
        journal.close()


def read_journal(session: Session) -> list[JournalEvent]:
    """Return all valid events in the order of writing; damaged lines are skipped.

    The list is empty if there is no journal.
    """
    if not session.journal.is_file():
        return []
    with session.journal.open("rb") as file:
        return [row for line in file if (row := decode_line(line)) is not None]
