"""Send messages to users and heartbeats to a monitor, in the background."""

import logging
import os
import threading
import urllib.request
import warnings
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from fieldlum.capture.reconnect import Backoff
from fieldlum.core.errors import InputError, input_errors, install_text
from fieldlum.core.files import read_bytes

FIRST_PAUSE_S, MAX_PAUSE_S = 30.0, 900.0  # for services that limit requests; a quarter of an hour


@dataclass(frozen=True, slots=True)
class Message:
    """A message to a user: title, text and an optional picture, attached if the file exists."""

    title: str
    body: str
    picture: Path | None = None


Post = Callable[[Message], bool]


class Outbox:
    """Sends messages in order, in the background.

    post: sends one message and returns whether it was sent. `put` returns at once, whatever the
    network does. A message that cannot be sent is tried again after 30 s, 1 min ... 15 min; of more
    than 500 waiting ones the oldest are dropped. `say` is called once when sending begins to fail,
    and when it works again; no text contains an address.
    """

    def __init__(
        self, post: Post, say: Callable[[str], None], *, first_pause_s: float = FIRST_PAUSE_S
    ) -> None:
        self._post, self._say = post, say
        self._backoff = Backoff(first_pause_s, MAX_PAUSE_S)
        self._waiting: deque[Message] = deque(maxlen=500)  # a month at ten a day
        self._changed = threading.Condition()
        self._closing = False
        self._thread = threading.Thread(target=self._work, name="outbox", daemon=True)
        self._thread.start()

    def put(self, message: Message) -> None:
        """Queue a message to be sent in the background; return at once."""
        with self._changed:
            self._waiting.append(message)
            self._changed.notify_all()

    def close(self, patience_s: float = 10.0) -> int:
        """Send waiting messages for at most `patience_s` seconds; return how many still wait."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join(patience_s)
        with self._changed:
            return len(self._waiting)

    def _work(self) -> None:
        failed = ""
        while (message := self._next()) is not None:
            why = self._try(message)
            if bool(why) != bool(failed):
                with suppress(OSError):  # the terminal may be closed
                    lost = f"note: messages cannot be sent ({why}); they wait"
                    self._say(lost if why else "note: messages are sent again")
            failed = why
            with self._changed:
                if why and self._closing:
                    return
                if why:
                    self._changed.wait_for(lambda: self._closing, self._backoff.next_s())
                elif self._waiting and self._waiting[0] is message:  # not dropped meanwhile
                    self._waiting.popleft()
                    self._backoff.reset()

    def _next(self) -> Message | None:
        """Wait for a message; return None if the outbox is closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._closing)
            return self._waiting[0] if self._waiting else None

    def _try(self, message: Message) -> str:
        """Send a message; return "" or why it was not sent."""
        try:
            return "" if self._post(message) else "a service did not accept the message"
        except Exception as error:  # a service's client can raise anything, with the address in it
            return type(error).__name__


# ----------------------------------------------------------------------------------------------
# where messages are sent: from a file, because an address contains a password or a token


def read_targets(option: str, *, name: str = "--notify") -> tuple[tuple[str, ...], str]:
    """Return the addresses in ``@FILE``, and a note about the file, "" if there is none.

    option: value of the option `name`; without it there is no address. A file has one address per
    line; empty lines and lines that begin with # are skipped. Raises InputError for an option that
    is not ``@FILE``, and for a file that cannot be read or is empty; no error contains an address.
    """
    if not option:
        return (), ""
    if not option.startswith("@"):
        found = "an address on the command line, where every user can see it"
        raise InputError(name, found, "@FILE", "write it into a file, and name that with an @")
    path, expected = Path(option[1:]), "a UTF-8 file with one apprise address per line"
    kinds = OSError, UnicodeDecodeError
    with input_errors(path, expected, "check the path, its permissions and encoding", *kinds):
        lines = [line.strip() for line in read_bytes(path).decode().splitlines()]
    addresses = tuple(line for line in lines if line and not line.startswith("#"))
    if not addresses:
        raise InputError(path, "no address in the file", expected, "write an address into it")
    is_private = os.name != "posix" or not path.stat().st_mode & 0o077
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
        found, remedy = "messages cannot be sent", install_text("notify")
        raise InputError(source, found, "the package apprise", remedy) from None
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
    with urllib.request.urlopen(address, timeout=20.0) as answer:
        answer.read(1024)


class Heartbeat:
    """Fetches an address in its own thread: at once, after each `beat`, and every `every_s` s.

    use: fetches the address; its errors are ignored.
    """

    def __init__(
        self, address: str, every_s: float = 600.0, use: Callable[[str], None] = fetch
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
