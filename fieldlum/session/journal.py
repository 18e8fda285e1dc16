"""journal.jsonl: all events of a session, appended one per line.

Several processes may append: a capture runs while `fieldlum status --mark` marks a slot.
"""

import os
import threading
from collections.abc import Iterator
from contextlib import closing, suppress
from datetime import UTC, datetime
from typing import Any, Required, TypedDict

from fieldlum.core import files
from fieldlum.core.errors import InputError, input_errors
from fieldlum.core.records import counted, listed, parse_utc, utc_text
from fieldlum.core.room_states import USAGE, merged_state
from fieldlum.session.codec import Seconds, convert
from fieldlum.session.files.capture_json import frame_from
from fieldlum.session.folder import Session
from fieldlum.session.safe_paths import open_inside

EventFields = dict[str, Any]
"""What an event states besides its kind and time; see `JournalEvent`."""


class JournalEvent(TypedDict, total=False):
    """One line of journal.jsonl; event: its kind, such as done; t_utc: ISO time.

    The other keys depend on the kind, and only those that readers use are declared. slot: id; why:
    reason; attempt: of the bracket, from 1; frame: fields of `Frame`; illuminance_lx: reading of a
    meter at the lens; by_s: how late a bracket began [s]; state: of the room, as ``lamp=on``; text:
    a remark; device: its name; after_s: time for which it was lost [s]; seconds: length of a sleep,
    or of a step of the clock; bytes_free: on the disk; pid: of the process; boot_id, boottime_s:
    identity of the computer's start, and the seconds since.
    """

    event: Required[str]
    t_utc: Required[str]
    slot: str
    why: str
    attempt: int
    frame: dict[str, Any]
    illuminance_lx: float
    by_s: Seconds
    state: str
    text: str
    device: str
    after_s: Seconds
    seconds: Seconds
    bytes_free: int
    pid: int
    boot_id: str
    boottime_s: float


class Journal:
    """The file of a session's events, to which any thread may append; each line has a CRC.

    cut_bytes: size of the incomplete last line that opening moved to journal.jsonl.torn. Raises
    InputError if the end of the file has no valid line, OSError if it cannot be opened.
    """

    def __init__(self, session: Session, *, flush: bool = True) -> None:
        """Open the journal, and move an incomplete last line to journal.jsonl.torn.

        flush: with False, lines survive a killed process but not a power cut; used for simulated
        time.
        """
        self._root, self._path, self._flush = session.root, session.journal, flush
        self._lock = threading.Lock()
        self._lock_path = self._path.with_name(".journal.lock")
        with files.exclusive(self._lock_path):  # another process may be writing a line
            self._handle = self._open()
            self.cut_bytes = files.cut_torn_tail(
                self._path, lambda line: files.decode_line(line) is not None
            )

    def _open(self) -> int:
        """Return a handle to append to the file, which is created if it is missing."""
        files.break_hard_links(self._path)
        handle = open_inside(self._root, self._path, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        if self._flush:
            files.sync_folder(self._root)
        return handle

    def append(self, event: str, t_utc: datetime, **fields: Any) -> None:
        """Append an event of a kind; with `flush` it is on the disk when this returns.

        event: the kind, such as done; fields: the other keys of its line, such as slot or why (see
        `JournalEvent`). Raises OSError, for example on a full disk, after removing a partly written
        line.
        """
        data = files.encode_line({"event": event, "t_utc": utc_text(t_utc), **fields})
        with self._lock, files.exclusive(self._lock_path):
            if files.is_replaced(self._handle, self._path):  # by a process that separated it
                with suppress(OSError):
                    earlier, self._handle = self._handle, self._open()
                    os.close(earlier)
            files.append_complete(self._handle, data, flush=self._flush)

    def close(self) -> None:
        """Close the file."""
        os.close(self._handle)


def read_journal(session: Session) -> list[JournalEvent]:
    """Return all valid events in the order of writing; damaged lines are skipped.

    The list is empty if there is no journal. Raises OSError if it cannot be read.
    """
    return [event for _, event in _lines(session) if event is not None]


def damaged_lines(session: Session) -> list[int]:
    """Return the numbers, from 1, of the journal's lines that readers skip.

    They are damaged, or have a value of a wrong type. A last line that is being written is omitted.
    Raises OSError if the journal cannot be read.
    """
    return [number for number, event in _lines(session) if event is None]


def damage_text(lines: list[int]) -> str:
    """Return a sentence on the damaged lines of a journal, by their numbers; "" for none."""
    if not lines:
        return ""
    return f"journal.jsonl has {counted(len(lines), 'damaged line')} ({listed(lines)})"


def _lines(session: Session) -> Iterator[tuple[int, JournalEvent | None]]:
    """Yield the number and the event, None if damaged, of each complete line of the journal."""
    if not session.journal.is_file():
        return
    with files.open_to_read(session.journal) as file:
        for number, line in enumerate(file, start=1):
            if line.endswith(b"\n"):
                yield number, decode_event(line)


def decode_event(line: bytes) -> JournalEvent | None:
    """Return the event in a journal line with its CRC and line feed (see `files.encode_line`).

    Return None for a damaged line or a value of a wrong type.
    """
    row = files.decode_line(line)
    try:
        convert(row, JournalEvent, strict=True)
        parse_utc(row["t_utc"])
        if "frame" in row:
            frame_from(row["frame"])
        if row["event"] == "marked":
            merged_state("", row.get("state", ""))
        return row
    except (KeyError, TypeError, ValueError, ArithmeticError, AttributeError):
        return None


# ----------------------------------------------------------------------------------------------
# marks of slots with the state of the room: lamps on, a blind down, snow outside

# Events that programs other than the capture write, with the time of their own clock. They are no
# evidence about the capture's clock.
BY_PEOPLE = frozenset({"marked", "note", "paused", "resumed"})


def mark_slot(session: Session, slot: str, state: str) -> str:
    """Record a state of the room at a slot, and return its state by all marks of the slot.

    slot: id; state: such as ``lamp=on;blind=half`` (grammar: `room_states.parse_state`), which is
    appended to the journal. This is safe during a capture. The result is "" for the usual room.
    Raises InputError for an id that is neither in the plan nor that of a panorama, and for an
    unknown word.
    """
    ids = {planned.id for planned in session.slots()}
    ids |= {path.stem for path in session.panoramas.glob("*.exr")}
    if slot not in ids:
        found = f"no slot {slot} in this session"
        expected = f"a slot's id such as {min(ids, default='20270320T153000Z')}, or the date of "
        expected += "captured slots"
        raise InputError(session.root, found, expected, "choose a slot of plan.csv")
    remedy = "name the slot and its state, for example lamp=on"
    with input_errors(session.root, USAGE, remedy, ValueError):
        merged = merged_state(marks(session).get(slot, ""), state)
    with closing(Journal(session)) as journal:
        journal.append("marked", datetime.now(UTC), slot=slot, state=state)
    return merged


def marks(session: Session) -> dict[str, str]:
    """Return the room's state at each marked slot, such as ``lamp=on;blind=half``, by slot id.

    A later mark replaces an earlier one with the same word, such as lamp.
    """
    states: dict[str, str] = {}
    for event in read_journal(session):
        if event["event"] == "marked" and "slot" in event:
            slot = str(event["slot"])
            states[slot] = merged_state(states.get(slot, ""), str(event.get("state", "")))
    return states
