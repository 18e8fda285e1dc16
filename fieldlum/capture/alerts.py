"""Decide which events of a running capture are reported by message.

The capture passes on its journal events and, about once a second, its state. Each fault causes one
message. A fault of the same kind causes another message only after it was over, or after six hours.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import date, datetime, timedelta
from pathlib import Path
from threading import Lock
from zoneinfo import ZoneInfo

from fieldlum.capture.notify import Heartbeat, Message, Outbox, Post
from fieldlum.capture.runner import Live
from fieldlum.core.records import parse_utc
from fieldlum.session import Session
from fieldlum.session.journal import EventFields
from fieldlum.session.safe_paths import link_on_the_way
from fieldlum.session.slot_states import SETTLED


@dataclass(slots=True)
class Alerts:
    """Sends messages and heartbeats about a running capture.

    A message means that somebody should act: faults which the capture repairs itself cause none (a
    device that reconnects needs at most two tries of 30 s; a single missed slot can be due to a
    slow bracket before it).

    `listen` takes journal events, `look` the state of the capture; both return at once. Events come
    from the capture and from the thread that logs irradiance, so a lock guards the alerts. name,
    timezone: of the site; send: sends a message; beat: sends a heartbeat; contact_sheet: called for
    a daily summary, returns the picture to attach, or None.
    """

    name: str
    timezone: str
    send: Callable[[Message], None]
    beat: Callable[[], None] = lambda: None
    contact_sheet: Callable[[], Path | None] = lambda: None
    _lock: Lock = field(default_factory=Lock)
    _away_since: dict[str, datetime] = field(default_factory=dict)
    _reported_away: set[str] = field(default_factory=set)
    _misses: int = 0
    _disk_is_low: bool = False
    _last: dict[str, datetime] = field(default_factory=dict)
    _day: date | None = None
    _counts: Counter[str] = field(default_factory=Counter)  # of the day's outcomes
    _highest_ghi_wm2: float | None = None  # of the day

    def listen(self, event: str, t_utc: datetime, fields: EventFields) -> None:
        """Send the messages that a journal event causes and, on a new day, the daily summary.

        Also send a heartbeat if the event settles a slot (done, missed, aborted).
        """
        if event in SETTLED:
            self.beat()
        with self._lock:
            self._new_day(t_utc)
            device = str(fields.get("device"))
            if event == "device-lost":
                self._away_since.setdefault(device, t_utc)
            elif event == "device-back":
                since = self._away_since.pop(device, t_utc)
                if device in self._reported_away:
                    self._reported_away.discard(device)
                    body = f"{device} did not answer for {_minutes(t_utc - since)}."
                    self._send(f"{device} is back", body)
            elif event in SETTLED:
                self._outcome(event, t_utc, fields)
            elif event == "clock-step":
                follows = "follows" if fields.get("followed") else "does not follow"
                body = f"The computer's clock jumped by {fields.get('seconds', 0.0):+.0f} s. "
                body += f"The capture {follows} the new time."
                self._send("the clock jumped", body, once=t_utc)
            elif event == "disk-full":
                free = f"The disk has {fields.get('bytes_free', 0) / 1e6:.0f} MB free."
                self._send("the disk is full", free, once=t_utc)

    def look(self, live: Live) -> None:
        """Send the messages that are due by time: lost devices, low disk, the daily summary."""
        with self._lock:
            self._new_day(live.t_utc)
            if live.ghi_wm2 is not None:
                self._highest_ghi_wm2 = max(live.ghi_wm2, self._highest_ghi_wm2 or live.ghi_wm2)
            for device, since in self._away_since.items():
                away = live.t_utc - since
                if device not in self._reported_away and away >= timedelta(minutes=10):
                    self._reported_away.add(device)
                    body = f"It stopped answering at {self._local(since)}, {_minutes(away)} ago."
                    self._send(f"{device} is lost", body)
            if live.disk_days is not None:
                limit = 4.0 if self._disk_is_low else 3.0  # leaves a weekend to bring a disk
                was_low, self._disk_is_low = self._disk_is_low, live.disk_days < limit
                if self._disk_is_low and not was_low:
                    body = f"The disk has room for {live.disk_days:.1f} more days of captures."
                    self._send("the disk is nearly full", body)

    def _outcome(self, event: str, t_utc: datetime, fields: EventFields) -> None:
        slot, why = fields.get("slot", ""), fields.get("why", "")
        self._counts[event] += 1
        with suppress(ValueError):
            slot = f"{slot} ({self._local(parse_utc(slot))})"
        if event == "done":
            self._misses = 0
            self._counts["doubtful"] += bool(why)
            if "clipped" in why:
                body = f"Bracket {slot}: {why}. The exposures may no longer suit the light."
                self._send("a bracket is clipped", body, once=t_utc)
            return
        self._misses += 1
        if self._misses == 2:
            body = f"The last slot was {slot} ({event}): {why or 'no reason recorded'}."
            self._send(f"{self._misses} slots in a row gave no bracket", body)

    def _new_day(self, t_utc: datetime) -> None:
        """Send the summary of the day that just ended, once."""
        today = t_utc.astimezone(ZoneInfo(self.timezone)).date()
        if self._day is None or today <= self._day:
            self._day = self._day or today
            return
        ended, counts, ghi = self._day, self._counts, self._highest_ghi_wm2
        self._day, self._counts, self._highest_ghi_wm2 = today, Counter(), None
        if counts:
            body = (
                f"{counts['done']} brackets done ({counts['doubtful']} with a doubt), "
                f"{counts['missed']} missed, {counts['aborted']} aborted."
            )
            body += "" if ghi is None else f" Highest global irradiance {ghi:.0f} W/m2."
            self._send(f"summary of {ended.isoformat()}", body, self.contact_sheet())

    def _send(
        self, title: str, body: str, picture: Path | None = None, once: datetime | None = None
    ) -> None:
        """Send a message; once: the time, for a title that is sent at most every six hours."""
        if once is not None:
            if title in self._last and once - self._last[title] < timedelta(hours=6):
                return
            self._last[title] = once
        self.send(Message(f"fieldlum {self.name}: {title}", body, picture))

    def _local(self, t_utc: datetime) -> str:
        return f"{t_utc.astimezone(ZoneInfo(self.timezone)):%Y-%m-%d %H:%M}"


def _minutes(duration: timedelta) -> str:
    return f"{duration.total_seconds() / 60.0:.0f} minutes"


@contextmanager
def open_alerts(
    session: Session,
    post: Post | None,
    heartbeat_address: str,
    say: Callable[[str], None],
    *,
    with_picture: bool = False,
) -> Iterator[Alerts]:
    """Yield the object that a capture calls to send messages and heartbeats; then close it.

    post: sends one message; None without targets. heartbeat_address: "" without a monitor. say:
    called with notes for the user's terminal. with_picture: attach the latest contact sheet to the
    daily summary; the sheet may show people.
    """
    site = session.site_file().site
    outbox = Outbox(post, say) if post is not None else None
    heartbeat = Heartbeat(heartbeat_address) if heartbeat_address else None
    alerts = Alerts(
        name=site.name,
        timezone=site.timezone,
        send=outbox.put if outbox else lambda message: None,
        beat=heartbeat.beat if heartbeat else lambda: None,
        contact_sheet=(lambda: _latest_contact_sheet(session)) if with_picture else lambda: None,
    )
    try:
        yield alerts
    finally:
        if heartbeat is not None:
            heartbeat.close()
        if outbox is not None and (waiting := outbox.close()):
            say(f"note: {waiting} messages could not be sent")


def _latest_contact_sheet(session: Session) -> Path | None:
    """Return the contact sheet that merge wrote last; None if there is none."""
    with suppress(OSError):  # a sheet may just be replaced, or the disk may be away
        found = session.panoramas.glob("contact-*.png")
        sheets = (path for path in found if link_on_the_way(session.root, path) is None)
        return max(sheets, key=lambda path: path.stat().st_mtime, default=None)
    return None
