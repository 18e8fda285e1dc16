"""Inform users and monitors about a running capture."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from threading import Lock

from fieldlum.capture.alerts import Alerts
from fieldlum.capture.live import Live
from fieldlum.capture.notify import Heartbeat, Message, Outbox, Post
from fieldlum.session import Session
from fieldlum.session.inside import link_on_the_way
from fieldlum.session.ledger import SETTLED
from fieldlum.session.tables import EventFields

OUTBOX = "outbox.jsonl"


@dataclass(frozen=True, slots=True)
class Remote:
    """Sends messages and heartbeats about a running capture.

    `listen` takes journal events, `look` the state of the capture; both return at once. Events come
    from the capture and from the thread that logs irradiance, so a lock guards the alerts.
    """

    alerts: Alerts
    outbox: Outbox | None
    heartbeat: Heartbeat | None
    _lock: Lock = field(default_factory=Lock)

    def listen(self, event: str, t_utc: datetime, fields: EventFields) -> None:
        """Send the messages that a journal event causes.

        Also send a heartbeat if the event settles a slot (done, missed, aborted).
        """
        if self.heartbeat is not None and event in SETTLED:
            self.heartbeat.beat()
        with self._lock:
            messages = self.alerts.event(event, t_utc, fields)
        self._send(messages)

    def look(self, live: Live) -> None:
        """Send the messages that are due now."""
        with self._lock:
            messages = self.alerts.look(live.t_utc, live.disk_days, live.ghi_wm2)
        self._send(messages)

    def _send(self, messages: Sequence[Message]) -> None:
        if self.outbox is not None:
            for message in messages:
                self.outbox.put(message)


@contextmanager
def informed(
    session: Session,
    post: Post | None,
    heartbeat_address: str,
    say: Callable[[str], None],
    *,
    with_picture: bool = False,
) -> Iterator[Remote]:
    """Yield the object that a capture calls to send messages and heartbeats; then close it.

    post: sends one message; None without targets. heartbeat_address: "" without a monitor.
    with_picture: attach the latest contact sheet to the daily summary; the sheet may show people.
    """
    site = session.site_file().site

    def sheet() -> Path | None:
        return _latest_contact_sheet(session) if with_picture else None

    def report(event: str, why: str) -> None:
        with suppress(OSError):
            texts = {
                "notify-lost": f"messages cannot be sent ({why}); they are stored and sent later",
                "notify-refused": f"messages of another computer or session are not sent: {why}",
            }
            say(f"note: {texts.get(event, 'messages are sent again')}")

    outbox = Outbox(post, session.root / OUTBOX, report) if post is not None else None
    heartbeat = Heartbeat(heartbeat_address) if heartbeat_address else None
    try:
        yield Remote(Alerts(site.name, site.timezone, sheet), outbox, heartbeat)
    finally:
        if heartbeat is not None:
            heartbeat.close()
        if outbox is not None and (waiting := outbox.close()):
            say(
                f"note: {waiting} messages are stored in {session.root / OUTBOX} until they "
                "can be sent"
            )


def _latest_contact_sheet(session: Session) -> Path | None:
    """Return the contact sheet that merge wrote last; None if there is none."""
    with suppress(OSError):  # a sheet may just be replaced, or the disk may be away
        found = session.panoramas.glob("contact-*.png")
        sheets = (path for path in found if link_on_the_way(session.root, path) is None)
        return max(sheets, key=lambda path: path.stat().st_mtime, default=None)
    return None
