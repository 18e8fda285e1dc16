"""Queue messages until they are sent: in a thread, and in a file that survives a restart."""

from __future__ import annotations

import hmac
import json
import re
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from fieldlum.core.errors import InputError
from fieldlum.devices.clock import Backoff
from fieldlum.session import replacing
from fieldlum.session.inside import inside
from fieldlum.session.permits import seal

# a month without network at ten messages a day; older messages are dropped; chosen
MAX_WAITING = 500
FIRST_PAUSE_S = 30.0  # seconds; not measured, long enough for a service that limits requests
# seconds; a message is sent at most a quarter of an hour after the network is back; chosen
MAX_PAUSE_S = 900.0
PATIENCE_AT_END_S = 10.0  # seconds; not measured, because the user waits for the command to end


@dataclass(frozen=True, slots=True)
class Message:
    """A message to a user: title, text and an optional picture, attached if the file exists."""

    title: str
    body: str
    picture: Path | None = None


_KEYS = ("title", "body", "picture", "seal")  # of a stored message
_CONTACT_SHEET = re.compile(r"panoramas/contact-[^/]+\.png")  # as merge names them

Post = Callable[[Message], bool]
Report = Callable[[str, str], None]


def _silent(event: str, why: str) -> None:
    """Report nothing; used without a listener."""


class Outbox:
    """Sends messages in order, in the background.

    post: sends one message and returns whether it was sent; file: stores the waiting ones for a
    restart. `put` returns at once, whatever the network or the disk does. A message that cannot be
    sent is tried again after 30 s, 1 min ... 15 min, and after a restart; of more than 500 waiting
    ones the oldest are dropped. `report(event, why)` is called with ``notify-lost`` when sending
    begins to fail, with ``notify-back`` when it works again, and with ``notify-refused`` for stored
    messages that this user did not write on this computer for this session: they are moved to
    NAME.refused and not sent. `why` never contains an address.
    """

    def __init__(
        self,
        post: Post,
        file: Path,
        report: Report = _silent,
        *,
        first_pause_s: float = FIRST_PAUSE_S,
    ) -> None:
        self._post = post
        self._file = file
        self._report = report
        self._backoff = Backoff(first_pause_s, MAX_PAUSE_S)
        messages, refused = _read(file)
        if refused:
            aside = file.with_name(f"{file.name}.refused")
            with suppress(OSError):
                file.replace(aside)
            report("notify-refused", f"{refused} in {aside}")
        self._waiting: deque[Message] = deque(messages, maxlen=MAX_WAITING)
        self._changed = threading.Condition()
        self._closing = False
        self._failing = False
        self._thread = threading.Thread(target=self._work, name="outbox", daemon=True)
        self._thread.start()

    def put(self, message: Message) -> None:
        """Queue a message to be sent in the background; return at once."""
        with self._changed:
            self._waiting.append(message)
            self._changed.notify_all()

    def close(self, patience_s: float = PATIENCE_AT_END_S) -> int:
        """Send waiting messages for at most `patience_s` seconds; return how many still wait."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join(patience_s)
        with self._changed:
            return len(self._waiting)

    def _work(self) -> None:
        while (message := self._next()) is not None:
            self._save()
            if self._sent(message):
                self._remove(message)
                self._save()
                self._backoff.reset()
                continue
            with self._changed:
                if self._closing:
                    return
                self._changed.wait_for(lambda: self._closing, timeout=self._backoff.next_s())

    def _next(self) -> Message | None:
        """Wait for a message; return None if the outbox is closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._closing)
            return self._waiting[0] if self._waiting else None

    def _sent(self, message: Message) -> bool:
        try:
            sent, why = self._post(message), "a service did not accept the message"
        except Exception as error:  # a service's client can raise anything, with the address in it
            sent, why = False, type(error).__name__
        if sent == self._failing:
            self._failing = not sent
            self._report("notify-lost" if self._failing else "notify-back", "" if sent else why)
        return sent

    def _remove(self, message: Message) -> None:
        with self._changed:
            if self._waiting and self._waiting[0] is message:
                self._waiting.popleft()

    def _save(self) -> None:
        with self._changed:
            waiting = list(self._waiting)
        # on a full disk, messages are lost at a restart, but capture continues
        with suppress(OSError):
            if not waiting:
                self._file.unlink(missing_ok=True)
                return
            with replacing(self._file, "w", encoding="utf-8") as file:
                for message in waiting:
                    file.write(json.dumps(_line(self._file, message), ensure_ascii=False) + "\n")


def _line(file: Path, message: Message) -> dict[str, str]:
    """Return a message as the file stores it, with a seal of this user, computer and session."""
    picture = ""
    if message.picture is not None and message.picture.is_relative_to(file.parent):
        picture = message.picture.relative_to(file.parent).as_posix()
    return {
        "title": message.title,
        "body": message.body,
        "picture": picture,
        "seal": _seal(file, message.title, message.body, picture),
    }


def _seal(file: Path, *texts: str) -> str:
    return seal(json.dumps([str(file.resolve()), *texts]))


def _read(file: Path) -> tuple[list[Message], int]:
    """Return the messages that an earlier process could not send, and the number of refused ones.

    Lines without the seal of this user, computer and session are refused. A picture is attached
    only if it is a contact sheet of this session.
    """
    messages: list[Message] = []
    refused = 0
    with suppress(OSError, UnicodeDecodeError):
        for line in file.read_text(encoding="utf-8").splitlines():
            try:
                stored = json.loads(line)
                title, body, picture, code = (stored[key] for key in _KEYS)
                if not hmac.compare_digest(code, _seal(file, title, body, picture)):
                    raise ValueError("another seal")
                messages.append(Message(title, body, _contact_sheet(file, picture)))
            except (ValueError, KeyError, TypeError, RecursionError):
                refused += 1
    return messages, refused


def _contact_sheet(file: Path, name: str) -> Path | None:
    """Return the path of a contact sheet of the session; None for any other name."""
    if _CONTACT_SHEET.fullmatch(name) is None:
        return None
    with suppress(InputError):
        return inside(file.parent, name, file)
    return None
