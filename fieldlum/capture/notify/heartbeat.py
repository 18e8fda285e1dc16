"""Fetch an address regularly, so that an external monitor notices a failed computer."""

from __future__ import annotations

import threading
import urllib.request
from collections.abc import Callable
from contextlib import suppress
from urllib.parse import urlsplit

from fieldlum.capture.notify.targets import read_targets
from fieldlum.core.errors import InputError

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
        raise InputError(
            option[1:],
            "the address in this file does not begin with http:// or https://",
            "an http address",
            "correct the address",
        )
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
        self,
        address: str,
        every_s: float = EVERY_S,
        use: Callable[[str], None] = fetch,
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
