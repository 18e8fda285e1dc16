"""Decide which events of a running capture are reported; send messages and heartbeats.

The capture passes on its journal events and, about once a second, its state. Each fault causes one
message. A fault of the same kind causes another message only after it was over, or after six hours.
"""

import logging
import threading
import urllib.request
import warnings
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import date, datetime, timedelta
from pathlib import Path
from urllib.parse import urlsplit
from zoneinfo import ZoneInfo

from fieldlum.capture.reconnect import pause_s
from fieldlum.capture.runner import Live
from fieldlum.core.errors import InputError, input_errors
from fieldlum.core.files import read_bytes
from fieldlum.core.records import parse_utc
from fieldlum.session import Session, safe_paths, slot_states
from fieldlum.session.journal import EventFields

FIRST_PAUSE_S, MAX_PAUSE_S = 30.0, 900.0  # for services that limit requests; a quarter of an hour


@dataclass(frozen=True, slots=True)
class Message:
    """A message to a user: title, text and an optional picture, attached if the file exists."""

    title: str
    body: str
    picture: Path | None = None


Post = Callable[[Message], bool]


class _Background(ABC):
    """Calls `_step` in its own thread: at once, when `_due` is set, and after the pauses."""

    def __init__(self, name: str) -> None:
        self._due, self._closing = threading.Event(), False
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)
        self._thread.start()

    @abstractmethod
    def _step(self) -> float | None:
        """Do the work that is due; return the longest pause after it [s], None for no limit."""

    def _work(self) -> None:
        """Do steps when they are due, and a last one after `end`; the thread runs this."""
        is_last = False
        while not is_last:
            self._due.clear()
            is_last = self._closing  # before the step, so that all earlier work is done
            pause = self._step()
            if not is_last:
                self._due.wait(pause)

    def end(self) -> None:
        """Let the thread do a last step and end; return at once."""
        self._closing = True
        self._due.set()


class Outbox(_Background):
    """Sends messages in order, in the background.

    post: sends one message and returns whether it was sent. say: called with a note when sending
    begins to fail, and when it works again; no text contains an address. A message that cannot be
    sent is tried again after 30 s, then after pauses that double up to 15 minutes, or with the next
    one. Of more than 500 waiting messages the oldest are dropped.
    """

    def __init__(self, post: Post, say: Callable[[str], None]) -> None:
        self._post, self._say = post, say
        self._waiting: deque[Message] = deque(maxlen=500)  # a month at ten a day
        self._failures = 0  # in sequence
        super().__init__("outbox")

    def put(self, message: Message) -> None:
        """Queue a message to be sent in the background; return at once."""
        self._waiting.append(message)
        self._due.set()

    def close(self, patience_s: float = 10.0) -> int:
        """Send waiting messages for at most `patience_s` seconds; return how many are left."""
        self.end()
        self._thread.join(patience_s)
        return len(self._waiting)

    def _step(self) -> float | None:
        """Send what is waiting; return the pause until the next try [s], None if nothing waits."""
        while self._waiting:
            message = self._waiting[0]
            why = self._try(message)
            if bool(why) != bool(self._failures):  # it fails for the first time, or works again
                lost = f"note: messages cannot be sent ({why}); they wait"
                with suppress(OSError):  # the terminal may be closed
                    self._say(lost if why else "note: messages are sent again")
            if why:
                self._failures += 1
                return pause_s(self._failures, FIRST_PAUSE_S, MAX_PAUSE_S)
            self._failures = 0
            if self._waiting[0] is message:  # `put` did not drop it in the meantime
                self._waiting.popleft()
        return None

    def _try(self, message: Message) -> str:
        """Send a message; return why it was not sent, "" if it was."""
        try:
            return "" if self._post(message) else "a service did not accept the message"
        except Exception as error:  # a service's client can raise anything, with the address in it
            return type(error).__name__


# ----------------------------------------------------------------------------------------------
# where messages are sent: from a file, because an address contains a password or a token


def read_targets(option: str, *, name: str = "--notify") -> tuple[str, ...]:
    """Return the addresses in the file that an option's value ``@FILE`` names.

    option: the value; name: of the option, for errors. A file has one address per line; empty lines
    and lines that begin with # are skipped. Raises InputError for a value that is not ``@FILE``,
    and for a file that cannot be read or has no address; no error contains an address.
    """
    if not option.startswith("@"):
        found = "an address on the command line, where every user can see it"
        raise InputError(name, found, "@FILE", "write it into a file, and name that with an @")
    path, expected = Path(option[1:]), "a UTF-8 file with one apprise address per line"
    kinds = (OSError, UnicodeDecodeError)
    with input_errors(path, expected, "check the path, its permissions and encoding", *kinds):
        lines = [line.strip() for line in read_bytes(path).decode().splitlines()]
    addresses = tuple(line for line in lines if line and not line.startswith("#"))
    if not addresses:
        raise InputError(path, "no address in the file", expected, "write an address into it")
    return addresses


def apprise_post(targets: Sequence[str], source: Path | str = "targets") -> Post:
    """Return a function that sends one message to all targets, and returns whether all succeeded.

    targets: apprise addresses, such as mailto://...; source: file or option that states them, for
    errors. Raises InputError for a target that apprise does not understand; the error has its
    number, but not its text, which may contain a password.
    """
    logging.getLogger("apprise").setLevel(logging.CRITICAL)  # its log lines contain addresses
    with warnings.catch_warnings():  # one of its services imports a deprecated module
        warnings.simplefilter("ignore", DeprecationWarning)
        import apprise

        sender = apprise.Apprise()
        understood = [sender.add(target) for target in targets]
    if not all(understood):
        number = f"{understood.index(False) + 1} of {len(understood)}"  # from 1
        expected = "an address such as mailto://, ntfy:// or tgram://"
        remedy = "see apprise's documentation"
        raise InputError(source, f"apprise does not understand address {number}", expected, remedy)

    def post(message: Message) -> bool:
        """Send a message to all targets; return whether all accepted it."""
        attach = str(message.picture) if message.picture and message.picture.is_file() else None
        return bool(sender.notify(title=message.title, body=message.body, attach=attach))

    return post


# ----------------------------------------------------------------------------------------------
# heartbeats


def read_address(option: str) -> str:
    """Return the heartbeat's address: the first one in the file that ``@FILE`` names.

    option: the value ``@FILE``. Raises InputError for another value, a file that cannot be read,
    and an address that is neither http nor https or has a blank; no error contains the address.
    """
    address = read_targets(option, name="--heartbeat")[0]
    if urlsplit(address).scheme not in ("http", "https") or " " in address:
        found = "the address in this file has a blank, or does not begin with http:// or https://"
        raise InputError(option[1:], found, "an http address", "correct the address")
    return address


def fetch(address: str) -> None:
    """Request an http address and ignore the answer's content.

    Raises OSError without an answer within 20 s, or for an HTTP error, ValueError for a text that
    is no address.
    """
    with urllib.request.urlopen(address, timeout=20.0) as answer:
        answer.read(1024)


class Heartbeat(_Background):
    """Requests an address in its own thread: at once, after each `beat`, and every `every_s` s.

    A monitor at the address raises an alarm when requests stop. Errors of a request are ignored.
    """

    def __init__(self, address: str, every_s: float = 600.0) -> None:
        self._address, self._every_s = address, every_s
        super().__init__("heartbeat")

    def beat(self) -> None:
        """Let the thread request the address now; return at once."""
        self._due.set()

    def _step(self) -> float:
        """Request the address once; return the pause until the next request [s]."""
        with suppress(Exception):  # without network or monitor, the next beat tries again
            if not self._closing:
                fetch(self._address)
        return self._every_s


# ----------------------------------------------------------------------------------------------
# which events of a running capture are reported


@dataclass(slots=True)
class Alerts:
    """Sends messages and heartbeats about a running capture.

    A message means that somebody should act. Faults that the capture corrects itself cause none: a
    device that reconnects (two tries of at most 30 s), a single missed slot (a slow bracket before
    it).

    `listen` takes journal events, `check` the capture's state; both return at once. Events come
    from the capture and from the thread that logs irradiance, so a lock guards the alerts. name,
    timezone: of the site; send: sends a message; beat: sends a heartbeat; contact_sheet: returns
    the picture to attach to a daily summary, or None.
    """

    name: str
    timezone: str
    send: Callable[[Message], None]
    beat: Callable[[], None] = lambda: None
    contact_sheet: Callable[[], Path | None] = lambda: None
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _away_since: dict[str, datetime] = field(default_factory=dict)  # UTC, by device
    _misses: int = 0  # slots in sequence that gave no bracket
    _last: dict[str, datetime] = field(default_factory=dict)  # UTC of the last message, by title
    _day: date | None = None  # local date of the last event
    _counts: Counter[str] = field(default_factory=Counter)  # of the day's outcomes

    def listen(self, event: str, t_utc: datetime, fields: EventFields) -> None:
        """Send the messages that a journal event causes and, on a new day, the daily summary.

        event, t_utc, fields: name, time and further fields of the event. Also send a heartbeat if
        the event settles a slot (done, missed, aborted).
        """
        if event in slot_states.SETTLED:
            self.beat()
        with self._lock:
            self._new_day(t_utc)
            device = str(fields.get("device"))
            if event == "device-lost":
                self._away_since.setdefault(device, t_utc)
            elif event == "device-back":
                since = self._away_since.pop(device, t_utc)
                if self._last.pop(f"{device} is lost", None):
                    body = f"{device} did not answer for {_minutes(t_utc - since)}."
                    self._send(f"{device} is back", body)
            elif event in slot_states.SETTLED:
                self._outcome(event, t_utc, fields)
            elif event == "clock-step":
                follows = "follows" if fields.get("followed") else "does not follow"
                body = f"The computer's clock jumped by {fields.get('seconds', 0.0):+.0f} s. "
                body += f"The capture {follows} the new time."
                self._send("the clock jumped", body, once=t_utc)
            elif event == "disk-full":
                free = f"The disk has {fields.get('bytes_free', 0) / 1e6:.0f} MB free."
                self._send("the disk is full", free, once=t_utc)

    def check(self, live: Live) -> None:
        """Send the messages that are due by time: lost devices, low disk, the daily summary."""
        with self._lock:
            self._new_day(live.t_utc)
            for device, since in self._away_since.items():
                away = live.t_utc - since
                if away >= timedelta(minutes=10):
                    body = f"It stopped answering at {self._local(since)}, {_minutes(away)} ago."
                    self._send(f"{device} is lost", body, once=live.t_utc)
            if live.disk_days is not None and live.disk_days < 3.0:  # a weekend to bring a disk
                body = f"The disk has room for {live.disk_days:.1f} more days of captures."
                self._send("the disk is nearly full", body, once=live.t_utc)

    def _outcome(self, event: str, t_utc: datetime, fields: EventFields) -> None:
        """Count a settled slot; send a message for clipped frames and for two misses in a row."""
        slot, why = fields.get("slot", ""), fields.get("why", "")
        self._counts[event] += 1
        with suppress(ValueError):  # an id that is no time
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
        """Send the summary of the last local day once, if `t_utc` is on a later one."""
        today = t_utc.astimezone(ZoneInfo(self.timezone)).date()
        if self._day is None or today <= self._day:
            self._day = self._day or today
            return
        ended, counts = self._day, self._counts
        self._day, self._counts = today, Counter()
        if counts:
            body = (
                f"{counts['done']} brackets done ({counts['doubtful']} with a doubt), "
                f"{counts['missed']} missed, {counts['aborted']} aborted."
            )
            self._send(f"summary of {ended.isoformat()}", body, self.contact_sheet())

    def _send(
        self, title: str, body: str, picture: Path | None = None, once: datetime | None = None
    ) -> None:
        """Send a message, with a picture if one is stated.

        once: time (UTC) of a message whose title is sent at most every six hours; None for one that
        is always sent.
        """
        if once is not None:
            if title in self._last and once - self._last[title] < timedelta(hours=6):
                return
            self._last[title] = once
        self.send(Message(f"fieldlum {self.name}: {title}", body, picture))

    def _local(self, t_utc: datetime) -> str:
        """Return a time as text in the site's time zone."""
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
    """Yield the alerts of a capture in a `with` block; then send what still waits, and end.

    post: sends one message; None without targets. heartbeat_address: "" without a monitor. say:
    called with notes for the user's terminal. with_picture: attach the latest contact sheet to the
    daily summary; the sheet may show people. At the end, messages are sent for at most 10 s. Raises
    InputError if session.toml cannot be used.
    """
    site = session.site_file().site
    outbox = Outbox(post, say) if post is not None else None
    heartbeat = Heartbeat(heartbeat_address) if heartbeat_address else None
    send: Callable[[Message], None] = outbox.put if outbox else lambda message: None
    alerts = Alerts(name=site.name, timezone=site.timezone, send=send)
    if heartbeat is not None:
        alerts.beat = heartbeat.beat
    if with_picture:
        alerts.contact_sheet = lambda: _latest_contact_sheet(session)
    try:
        yield alerts
    finally:
        if heartbeat is not None:
            heartbeat.end()
        if outbox is not None and (waiting := outbox.close()):
            say(f"note: {waiting} messages could not be sent")


def _latest_contact_sheet(session: Session) -> Path | None:
    """Return the path of the contact sheet that `merge` wrote last; None if there is none."""
    with suppress(OSError):  # a sheet may just be replaced, or the disk may be away
        paths = session.panoramas.glob("contact-*.png")
        sheets = (path for path in paths if safe_paths.link_on_the_way(session.root, path) is None)
        return max(sheets, key=lambda path: path.stat().st_mtime, default=None)
    return None
