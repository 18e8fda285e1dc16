"""What the journal says: the state of each slot, and what is still owed. Pure functions over
events.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Any, Literal

from fieldlum.records import Exposure, Slot, parse_utc, utc_text

Outcome = Literal["", "started", "done", "missed", "aborted"]


@dataclass(frozen=True, slots=True)
class Frame:
    """One acknowledged frame: on disk under `file` (relative to the slot's folder) with this
    hash.
    """

    index: int
    file: str
    exposure: Exposure  # as asked; EXIF's where that departs from it, and then `doubt` says so
    heading_deg: float | None
    t_utc: datetime
    seconds: float  # from the request to the file on disk
    sha256: str
    doubt: str = ""  # what did not look right when it was checked at once
    instead_of: str = (
        ""  # file of the doubtful frame of the same exposure that this one was taken again for
    )


@dataclass(frozen=True, slots=True)
class SlotState:
    outcome: Outcome = ""
    attempt: int = 1
    frames: tuple[Frame, ...] = ()
    why: str = ""
    illuminance_lx: tuple[float, ...] = ()  # readings of a meter at the lens, during the bracket


@dataclass(slots=True)
class Ledger:
    """All of a journal, folded."""

    slots: dict[str, SlotState] = field(default_factory=dict)
    last_utc: datetime | None = None
    opened: dict[str, Any] = field(default_factory=dict)  # the last `open` event
    counts: dict[str, int] = field(default_factory=dict)


def frame_fields(frame: Frame) -> dict[str, Any]:
    """A frame as the journal and capture.json write it."""
    e = frame.exposure
    return {
        "index": frame.index,
        "file": frame.file,
        "exposure": {"shutter_s": e.shutter_s, "f_number": e.f_number, "iso": e.iso, "nd": e.nd},
        "heading_deg": frame.heading_deg,
        "t_utc": utc_text(frame.t_utc),
        "seconds": round(frame.seconds, 3),
        "sha256": frame.sha256,
        **({"doubt": frame.doubt} if frame.doubt else {}),
        **({"instead_of": frame.instead_of} if frame.instead_of else {}),
    }


def frame_from(fields: dict[str, Any]) -> Frame:
    """Inverse of `frame_fields`. Raises KeyError, TypeError or ValueError for anything else."""
    return Frame(
        int(fields["index"]),
        str(fields["file"]),
        Exposure(**fields["exposure"]),
        fields["heading_deg"],
        parse_utc(fields["t_utc"]),
        float(fields.get("seconds", 0.0)),
        str(fields["sha256"]),
        str(fields.get("doubt", "")),
        str(fields.get("instead_of", "")),
    )


def fold(events: Iterable[dict[str, Any]]) -> Ledger:
    """State = fold(events): resuming needs nothing else."""
    ledger = Ledger()
    for event in events:
        kind = event["event"]
        ledger.counts[kind] = ledger.counts.get(kind, 0) + 1
        t_utc = parse_utc(event["t_utc"])
        ledger.last_utc = t_utc if ledger.last_utc is None else max(ledger.last_utc, t_utc)
        if kind == "open":
            ledger.opened = event
        if "slot" in event:
            ledger.slots[event["slot"]] = _step(
                ledger.slots.get(event["slot"], SlotState()), kind, event
            )
    return ledger


def _step(state: SlotState, kind: str, event: dict[str, Any]) -> SlotState:
    if kind == "started":
        # A second start of the same attempt is a resumption and keeps its frames; a new attempt
        # begins empty.
        attempt = int(event.get("attempt", 1))
        return replace(
            state,
            outcome="started",
            attempt=attempt,
            frames=state.frames if attempt == state.attempt else (),
        )
    if kind in ("frame", "retake"):
        frame = frame_from(event["frame"])
        others = tuple(f for f in state.frames if f.index != frame.index)
        return replace(state, frames=(*others, frame))
    if kind == "illuminance":
        return replace(
            state, illuminance_lx=(*state.illuminance_lx, float(event["illuminance_lx"]))
        )
    if kind in ("done", "missed", "aborted"):
        return replace(state, outcome=kind, why=event.get("why", ""))
    return SlotState() if kind == "withdrawn" else state


def owed(slots: Sequence[Slot], ledger: Ledger) -> list[Slot]:
    """Planned slots that are neither done, missed nor aborted, in time order."""
    settled = ("done", "missed", "aborted")
    unsettled = (s for s in slots if ledger.slots.get(s.id, SlotState()).outcome not in settled)
    return sorted(unsettled, key=lambda slot: slot.t_utc)
