"""Marks of slots with the state of the room: lamps on, a blind down, snow outside."""

from __future__ import annotations

from datetime import UTC, datetime

from fieldlum.core.errors import InputError, input_errors
from fieldlum.core.room_states import USAGE, merged_state
from fieldlum.session.folder import Session
from fieldlum.session.journal import append_event, read_journal

EVENT = "marked"

# Events that programs other than the capture write, with the time of their own clock. They are no
# evidence about the capture's clock.
BY_PEOPLE = frozenset({EVENT, "note", "paused", "resumed"})


def mark_slot(session: Session, slot: str, state: str) -> str:
    """Append a mark such as ``lamp=on;blind=half`` to the journal; return the slot's full state.

    The full state also has the words of earlier marks. This is safe during a capture. Raises
    InputError for an id that is neither in the plan nor that of a panorama, and for an unknown
    word.
    """
    slots = {planned.id for planned in session.slots()}
    slots |= {path.stem for path in session.panoramas.glob("*.exr")}
    if slot not in slots:
        found = f"no slot {slot} in this session"
        expected = f"a slot's id such as {min(slots, default='20270320T153000Z')}"
        raise InputError(session.root, found, expected, "choose a slot of plan.csv")
    remedy = "name the slot and its state, for example lamp=on"
    with input_errors(session.root, USAGE, remedy, ValueError):
        result = merged_state(marks(session).get(slot, ""), state)
    append_event(session, EVENT, datetime.now(UTC), slot=slot, state=state)
    return result


def marks(session: Session) -> dict[str, str]:
    """Return the room's state, such as ``lamp=on;blind=half``, by slot id, for the marked slots.

    A later mark replaces an earlier one with the same word.
    """
    states: dict[str, str] = {}
    for event in read_journal(session):
        if event["event"] == EVENT and "slot" in event:
            slot = str(event["slot"])
            states[slot] = merged_state(states.get(slot, ""), str(event.get("state", "")))
    return states
