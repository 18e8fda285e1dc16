"""Compute the state of each slot from the journal; list slots without a bracket, and make-ups."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Literal

from fieldlum.core.records import Slot, parse_utc
from fieldlum.session.files.capture_json import Frame, frame_from
from fieldlum.session.folder import Session
from fieldlum.session.journal import BY_PEOPLE, JournalEvent, read_journal

Outcome = Literal["", "started", "done", "missed", "aborted"]
SETTLED = ("done", "missed", "aborted")  # outcomes after which a slot needs no bracket


@dataclass(frozen=True, slots=True)
class SlotState:
    """The state of one slot, from the journal.

    outcome: "" before any bracket began, "started", or final: "done", "missed", "aborted"; attempt:
    number of the last attempt at the bracket, from 1; frames: of that attempt, in the order of
    writing; why: reason of the outcome, or ""; illuminance_lx: readings of a meter at the lens,
    during the bracket.
    """

    outcome: Outcome = ""
    attempt: int = 1
    frames: tuple[Frame, ...] = ()
    why: str = ""
    illuminance_lx: tuple[float, ...] = ()


@dataclass(slots=True)
class SlotStates:
    """State of all slots of a journal, and how often each event occurred.

    slots: by slot id, only those with an event; last_utc: newest time of an event that no person
    caused; last_open: the last `open` event (start of a capture), even if that capture was closed;
    counts: by kind of event.
    """

    slots: dict[str, SlotState] = field(default_factory=dict)
    last_utc: datetime | None = None
    last_open: JournalEvent | None = None
    counts: dict[str, int] = field(default_factory=dict)

    def state(self, slot: str) -> SlotState:
        """Return the state of a slot; without an event it has no outcome and no frames."""
        return self.slots.get(slot, SlotState())


def apply_events(events: Iterable[JournalEvent], states: SlotStates | None = None) -> SlotStates:
    """Return the state of all slots after some events, from which a capture resumes.

    events: of the journal, in its order; states: the state before them, which is changed in place;
    None: before any event.
    """
    states = SlotStates() if states is None else states
    for event in events:
        kind = event["event"]
        states.counts[kind] = states.counts.get(kind, 0) + 1
        t_utc = parse_utc(event["t_utc"])
        if kind not in BY_PEOPLE:
            states.last_utc = t_utc if states.last_utc is None else max(states.last_utc, t_utc)
        if kind == "open":
            states.last_open = event
        if "slot" in event:
            slot = event["slot"]
            states.slots[slot] = _after_event(states.state(slot), kind, event)
    return states


def read_slot_states(session: Session) -> SlotStates:
    """Return the state of all slots, from the journal. Raises OSError if it cannot be read."""
    return apply_events(read_journal(session))


def captured_ids(session: Session) -> set[str]:
    """Return the ids of the slots with a complete bracket, by the session's journal.

    The set is empty without a journal; damaged lines of it are skipped.
    """
    states = read_slot_states(session).slots
    return {slot for slot, state in states.items() if state.outcome == "done"}


def _after_event(state: SlotState, kind: str, event: JournalEvent) -> SlotState:
    """Return the state of a slot after one more event of the journal.

    state: before the event; kind: of the event. The event withdrawn cancels all earlier ones; one
    of another kind than those below changes nothing.
    """
    if kind == "started":
        # A second start of the same attempt continues it with its frames.
        attempt = int(event.get("attempt", 1))
        frames = state.frames if attempt == state.attempt else ()
        return replace(state, outcome="started", attempt=attempt, frames=frames)
    if kind in ("frame", "retake") and "frame" in event:
        frame = frame_from(event["frame"])  # a retake has the index of the frame that it replaces
        others = tuple(f for f in state.frames if f.index != frame.index)
        return replace(state, frames=(*others, frame))
    if kind == "illuminance" and "illuminance_lx" in event:
        return replace(state, illuminance_lx=(*state.illuminance_lx, event["illuminance_lx"]))
    if kind in SETTLED:
        return replace(state, outcome=kind, why=event.get("why", ""))
    return SlotState() if kind == "withdrawn" else state


def slots_to_do(slots: Sequence[Slot], states: SlotStates) -> list[Slot]:
    """Return the slots that still need a bracket, in order of time.

    These are neither done, missed nor aborted in the journal.
    """
    unsettled = (slot for slot in slots if states.state(slot.id).outcome not in SETTLED)
    return sorted(unsettled, key=lambda slot: slot.t_utc)


def slots_ahead(session: Session, now_utc: datetime) -> list[Slot]:
    """Return the slots whose bracket is missing and may still start, in order of time.

    It may start until the session's grace after the slot's time. now_utc: the present time. Raises
    InputError for a plan.csv or session.toml that cannot be used.
    """
    to_do = slots_to_do(session.slots(), read_slot_states(session))
    return [slot for slot in to_do if slot.t_utc + session.grace >= now_utc]


# ----------------------------------------------------------------------------------------------
# make-up slots

MAKEUP = "makeup:"  # tag, followed by the missed slot's id


def makeups_by_slot(slots: Sequence[Slot]) -> dict[str, list[Slot]]:
    """Return the make-up slots of each slot that has some, by the id of the original slot.

    The make-up of a missed make-up is one of the original slot.
    """
    tags = ((slot.id, tag) for slot in slots for tag in slot.tags)
    missed = {slot: tag.removeprefix(MAKEUP) for slot, tag in tags if tag.startswith(MAKEUP)}
    makeups: dict[str, list[Slot]] = {}
    for slot in slots:
        if original := missed.get(slot.id):
            while original in missed:
                original = missed[original]
            makeups.setdefault(original, []).append(slot)
    return makeups


def without_capture(slots: Sequence[Slot], captured: Collection[str]) -> tuple[int, int]:
    """Return how many original slots have no capture, and how many original slots there are.

    captured: ids of captured slots. A slot has a capture if it or one of its make-ups is captured;
    make-ups are no original slots.
    """
    makeups = makeups_by_slot(slots)
    makeup_ids = {makeup.id for several in makeups.values() for makeup in several}
    original = [slot.id for slot in slots if slot.id not in makeup_ids]
    chances = ({slot, *(m.id for m in makeups.get(slot, ()))} for slot in original)
    return sum(ids.isdisjoint(captured) for ids in chances), len(original)
