"""Journal events as sentences for a person who does not know the journal."""

from __future__ import annotations

from typing import Literal

from fieldlum.session.tables import JournalEvent

Level = Literal["info", "warn", "fail"]

# Events that are no news on a page: the plan's calendar shows outcomes.
_SILENT = frozenset({"imported", "withdrawn"})
_WORDS: dict[str, tuple[Level, str]] = {
    "done": ("warn", "Bracket {slot} is complete, with a warning: {why}."),
    "missed": ("fail", "Bracket {slot} was not taken: {reason}."),
    "aborted": ("fail", "Bracket {slot} was ended before it was complete: {reason}."),
    "device-lost": ("fail", "The {device} stopped answering ({why}). The capture tries it again."),
    "device-back": ("info", "The {device} answers again after {away}."),
    "bad-reading": ("warn", "The {device} gave a reading that cannot be used: {why}."),
    "clock-step": (
        "warn",
        "The computer's clock jumped by {jump} s; the new time was {accepted}accepted.",
    ),
    "suspend": ("warn", "The computer slept for {slept}."),
    "disk-full": ("fail", "The disk is full: {free_mb} MB are free."),
    "late": ("info", "Bracket {slot} began {late_s} s late."),
    "hook": ("info", "Two brackets in a row are missing: the command of --on-misses was run."),
    "hook-failed": ("warn", "The command of --on-misses failed: {why}."),
    "display-lost": ("info", "The terminal of the capture was closed; the capture continues."),
    "open": ("info", "The capture was started."),
    "close": ("info", "The capture was ended."),
    "marked": ("info", "Bracket {slot} was marked: {state}."),
    "paused": ("warn", "The capture was paused until {until_utc}."),
    "resumed": ("info", "The pause was ended."),
    "note": ("info", "Note: {text}"),
}


def event_words(event: JournalEvent) -> tuple[Level, str] | None:
    """Return the level ("info", "warn" ...) and the sentence of an event of the journal.

    None for an event that needs no attention, such as a bracket done without a doubt. The sentence
    of an unknown kind of event is the name of the kind, its level "info".
    """
    kind, why = event["event"], event.get("why", "")
    if kind in _SILENT or (kind == "done" and (not why or why == "imported")):
        return None
    if kind not in _WORDS:
        return "info", kind
    level, sentence = _WORDS[kind]
    return level, sentence.format(
        slot=event.get("slot", ""),
        why=why,
        reason=why or "no reason recorded",
        device=event.get("device", "a device"),
        away=_duration(event.get("after_s")),
        slept=_duration(event.get("seconds")),
        jump=f"{event.get('seconds', 0.0):+.0f}",
        accepted="" if event.get("followed") else "not ",
        free_mb=f"{event.get('bytes_free', 0) / 1e6:.0f}",
        late_s=f"{event.get('by_s', 0.0):.0f}",
        state=event.get("state", ""),
        until_utc=event.get("until_utc", ""),
        text=event.get("text", ""),
    )


def _duration(seconds: float | None) -> str:
    value = seconds or 0.0
    if value < 120:
        return f"{value:.0f} s"
    return f"{value / 60:.0f} min" if value < 7200 else f"{value / 3600:.1f} h"
