"""Pause the capture at a user's request: while pause.json is valid, no bracket begins.

The capture only reads the file, so that it never waits for the program that writes it.
"""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta

from fieldlum.core.errors import InputError
from fieldlum.core.records import parse_utc, utc_text
from fieldlum.session.folder import Session
from fieldlum.session.journal import append_event
from fieldlum.session.writing import replacing

# A forgotten pause must cost less than half a day of daylight. Chosen.
MAX_PAUSE = timedelta(hours=4)


def pause(session: Session, duration: timedelta) -> datetime:
    """Pause the capture from now on; return the end [UTC]. A second pause replaces the first.

    Raises InputError for a duration that is not above 0 and at most 4 hours.
    """
    if not timedelta(0) < duration <= MAX_PAUSE:
        longest = f"{MAX_PAUSE.total_seconds() / 60:.0f}"
        raise InputError(
            session.root,
            f"a pause of {duration.total_seconds() / 60:.0f} minutes",
            f"1 to {longest} minutes",
            "choose a pause of that length",
        )
    now = datetime.now(UTC).replace(microsecond=0)
    until = now + duration
    with replacing(session.pause, "w", encoding="utf-8") as file:
        json.dump({"until_utc": utc_text(until)}, file)
    append_event(session, "paused", now, until_utc=utc_text(until))
    return until


def resume(session: Session) -> None:
    """End a pause; do nothing if there is none."""
    now = datetime.now(UTC)
    was_paused = paused_until(session, now) is not None
    session.pause.unlink(missing_ok=True)
    if was_paused:
        append_event(session, "resumed", now)


def paused_until(session: Session, now_utc: datetime) -> datetime | None:
    """Return the end of the present pause [UTC]; None if there is none.

    An unreadable file is ignored, and so is an end over 4 hours away: a wrong clock or a wrong file
    must not cost days of captures.
    """
    try:
        until = parse_utc(json.loads(session.pause.read_text(encoding="utf-8"))["until_utc"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None
    return until if now_utc < until <= now_utc + MAX_PAUSE else None
