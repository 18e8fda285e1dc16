"""Journal events as sentences for a person who does not know the journal."""

from __future__ import annotations

from typing import Literal

from fieldlum.session.tables import JournalEvent

Level = Literal["info", "warn", "fail"]

# Events that are no news on a page: the plan's calendar shows outcomes.
_SILENT = frozenset({"imported", "withdrawn"})


def event_words(event: JournalEvent) -> tuple[Level, str] | None:
    """Return the level and the sentence of an event; None for an event that needs no attention."""
    kind, why, slot = event["event"], event.get("why", ""), event.get("slot", "")
    if kind in _SILENT or (kind == "done" and (not why or why == "imported")):
        return None
    device = event.get("device", "a device")
    if kind == "done":
        return "warn", f"Bracket {slot} is complete, with a warning: {why}."
    if kind in ("missed", "aborted"):
        word = "was not taken" if kind == "missed" else "was ended before it was complete"
        return "fail", f"Bracket {slot} {word}: {why or 'no reason recorded'}."
    if kind == "device-lost":
        return "fail", f"The {device} stopped answering ({why}). The capture tries it again."
    if kind == "device-back":
        return "info", f"The {device} answers again after {_duration(event.get('after_s'))}."
    if kind == "bad-reading":
        return "warn", f"The {device} gave a reading that cannot be used: {why}."
    if kind == "clock-step":
        followed = "was accepted" if event.get("followed") else "was not accepted"
        seconds = event.get("seconds", 0.0)
        return "warn", (
            f"The computer's clock jumped by {seconds:+.0f} s; the new time {followed}."
        )
    if kind == "suspend":
        return "warn", f"The computer slept for {_duration(event.get('seconds'))}."
    if kind == "disk-full":
        free = event.get("bytes_free", 0) / 1e6
        return "fail", f"The disk is full: {free:.0f} MB are free."
    if kind == "late":
        return "info", f"Bracket {slot} began {event.get('by_s', 0.0):.0f} s late."
    if kind == "hook-failed":
        return "warn", f"The command of --on-misses failed: {why}."
    if kind == "display-lost":
        return "info", "The terminal of the capture was closed; the capture continues."
    fixed = {"open": "The capture was started.", "close": "The capture was ended."}
    if kind in fixed:
        return "info", fixed[kind]
    if kind == "hook":
        return "info", "Two brackets in a row are missing: the command of --on-misses was run."
    if kind == "marked":
        return "info", f"Bracket {slot} was marked: {event.get('state', '')}."
    if kind == "paused":
        return "warn", f"The capture was paused until {event.get('until_utc', '')}."
    if kind == "resumed":
        return "info", "The pause was ended."
    if kind == "note":
        return "info", f"Note: {event.get('text', '')}"
    return "info", kind


def _duration(seconds: float | None) -> str:
    value = seconds or 0.0
    if value < 120:
        return f"{value:.0f} s"
    return f"{value / 60:.0f} min" if value < 7200 else f"{value / 3600:.1f} h"
