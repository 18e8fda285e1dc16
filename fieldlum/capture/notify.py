"""Send messages to users and heartbeats to a monitor, in the background."""

from __future__ import annotations

import hmac
import json
import logging
import os
import re
import threading
import urllib.request
import warnings
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import msgspec

from fieldlum.core.errors import InputError, input_errors, install_text
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


_CONTACT_SHEET = re.compile(r"panoramas/contact-[^/]+\.png")  # as merge names them

Post = Callable[[Message], bool]
Report = Callable[[str, str], None]


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
        report: Report = lambda event, why: None,
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
                with self._changed:
                    if self._waiting and self._waiting[0] is message:  # not dropped meanwhile
                        self._waiting.popleft()
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

    def _save(self) -> None:
        with self._changed:
            waiting = list(self._waiting)
        # on a full disk, messages are lost at a restart, but capture continues
        with suppress(OSError):
            if not waiting:
                self._file.unlink(missing_ok=True)
                return
            with replacing(self._file, "wb") as file:
                file.writelines(msgspec.json.encode(_line(self._file, m)) + b"\n" for m in waiting)


class _Line(msgspec.Struct):
    """A message as the file stores it, with a seal of this user, computer and session."""

    title: str
    body: str
    picture: str
    seal: str


def _line(file: Path, message: Message) -> _Line:
    picture = ""
    if message.picture is not None and message.picture.is_relative_to(file.parent):
        picture = message.picture.relative_to(file.parent).as_posix()
    code = _seal(file, message.title, message.body, picture)
    return _Line(message.title, message.body, picture, code)


def _seal(file: Path, *texts: str) -> str:
    return seal(json.dumps([str(file.resolve()), *texts]))


def _read(file: Path) -> tuple[list[Message], int]:
    """Return the messages that an earlier process could not send, and the number of refused ones.

    Lines without the seal of this user, computer and session are refused. A picture is attached
    only if it is a contact sheet of this session.
    """
    messages: list[Message] = []
    refused = 0
    with suppress(OSError):
        for line in file.read_bytes().splitlines():
            try:
                stored = msgspec.json.decode(line, type=_Line)
                due = _seal(file, stored.title, stored.body, stored.picture)
                if not hmac.compare_digest(stored.seal.encode(), due.encode()):
                    raise ValueError("another seal")
                picture = _contact_sheet(file, stored.picture)
                messages.append(Message(stored.title, stored.body, picture))
            except (ValueError, RecursionError):
                refused += 1
    return messages, refused


def _contact_sheet(file: Path, name: str) -> Path | None:
    """Return the path of a contact sheet of the session; None for any other name."""
    if _CONTACT_SHEET.fullmatch(name) is not None:
        with suppress(InputError):
            return inside(file.parent, name, file)
    return None


# ----------------------------------------------------------------------------------------------
# where messages are sent: from a file, because an address contains a password or a token

VARIABLE = "FIELDLUM_NOTIFY"
_READABLE_BY_OTHERS = 0o077  # permission bits of group and others (POSIX)


def read_targets(
    option: str, variable: str = "", *, name: str = "--notify"
) -> tuple[tuple[str, ...], str]:
    """Return the addresses in ``@FILE``, and a note about the file, "" if there is none.

    option: value of the option `name`; if it is empty, `variable`, the content of the environment
    variable, is used, which is ``@FILE`` or addresses separated by blanks; without both there is no
    address. A file has one address per line; empty lines and lines that begin with # are skipped.
    Raises InputError for an option that is not ``@FILE``, and for a file that cannot be read or is
    empty; no error contains an address.
    """
    if not option and variable and not variable.startswith("@"):
        return tuple(variable.split()), ""
    text = option or variable
    if not text:
        return (), ""
    if not text.startswith("@"):
        found = "an address on the command line, where every user can see it"
        raise InputError(name, found, "@FILE", "write it into a file, and name that with an @")
    path, expected = Path(text[1:]), "a UTF-8 file with one apprise address per line"
    kinds = OSError, UnicodeDecodeError
    with input_errors(path, expected, "check the path, its permissions and encoding", *kinds):
        lines = [line.strip() for line in path.read_text(encoding="utf-8").splitlines()]
    addresses = tuple(line for line in lines if line and not line.startswith("#"))
    if not addresses:
        raise InputError(path, "no address in the file", expected, "write an address into it")
    is_private = os.name != "posix" or not path.stat().st_mode & _READABLE_BY_OTHERS
    note = f"{path} can be read by other users: run chmod 600 {path}"
    return addresses, "" if is_private else note


def apprise_post(targets: Sequence[str], source: Path | str = "targets") -> Post:
    """Return a function that sends one message to all targets, and returns whether all succeeded.

    Raises InputError without the package apprise and for a target that it does not understand, with
    the target's number but without its text. source: what states the targets, for errors.
    """
    logging.getLogger("apprise").setLevel(logging.CRITICAL)  # its log lines contain addresses
    try:
        with warnings.catch_warnings():  # one of its services imports a deprecated module
            warnings.simplefilter("ignore", DeprecationWarning)
            import apprise

            sender = apprise.Apprise()
            understood = [sender.add(target) for target in targets]
    except ImportError:
        expected = "the package apprise"
        raise InputError(
            source, "messages cannot be sent", expected, install_text("notify")
        ) from None
    if not all(understood):
        number = f"{understood.index(False) + 1} of {len(understood)}"
        expected = "an address such as mailto://, ntfy:// or tgram://"
        remedy = "see apprise's documentation"
        raise InputError(source, f"apprise does not understand address {number}", expected, remedy)

    def post(message: Message) -> bool:
        attach = str(message.picture) if message.picture and message.picture.is_file() else None
        return bool(sender.notify(title=message.title, body=message.body, attach=attach))

    return post


# ----------------------------------------------------------------------------------------------
# heartbeats

# seconds; monitors usually tolerate several missed periods; see docs/capture.md; chosen
EVERY_S = 600.0
TIMEOUT_S = 20.0  # seconds, for a slow mobile network; not measured


def read_address(option: str) -> str:
    """Return the address in ``@FILE``: the first line that is neither empty nor a comment.

    Raises InputError for an option that is not ``@FILE``, an unreadable file, and an address that
    is neither http nor https; no error contains the address.
    """
    address = read_targets(option, name="--heartbeat")[0][0]
    if urlsplit(address).scheme not in ("http", "https"):
        found = "the address in this file does not begin with http:// or https://"
        raise InputError(option[1:], found, "an http address", "correct the address")
    return address


def fetch(address: str) -> None:
    """Fetch an address and ignore the content. Raises OSError for no answer or an HTTP error."""
    with urllib.request.urlopen(address, timeout=TIMEOUT_S) as answer:
        answer.read(1024)


class Heartbeat:
    """Fetches an address in its own thread: at once, after each `beat`, and every `every_s` s.

    use: fetches the address; its errors are ignored.
    """

    def __init__(
        self, address: str, every_s: float = EVERY_S, use: Callable[[str], None] = fetch
    ) -> None:
        self._address = address
        self._every_s = every_s
        self._use = use
        self._due = threading.Event()
        self._closing = False
        self._thread = threading.Thread(target=self._work, name="heartbeat", daemon=True)
        self._thread.start()

    def beat(self) -> None:
        """Request that the thread fetches the address now; return at once."""
        self._due.set()

    def close(self) -> None:
        """Tell the thread to end; return at once."""
        self._closing = True
        self._due.set()

    def _work(self) -> None:
        while not self._closing:
            self._due.clear()
            with suppress(Exception):  # without network or monitor, the next beat tries again
                self._use(self._address)
            self._due.wait(self._every_s)
