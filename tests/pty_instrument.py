"""Answer like an instrument on a pseudo-terminal, for the drivers of serial instruments."""

from __future__ import annotations

import os
import select
import threading
from collections.abc import Callable
from contextlib import suppress


class PtyInstrument(threading.Thread):
    """A thread that answers like an instrument on a pseudo-terminal; `port` is its device file.

    answer : returns the reply to each group of bytes received. The pty stays open until `unplug`,
    so that a client may close and open it.
    """

    def __init__(self, answer: Callable[[bytes], bytes]) -> None:
        import tty

        super().__init__(name="simulated instrument", daemon=True)
        self._answer = answer
        self._ours, self._theirs = os.openpty()
        tty.setraw(self._ours)
        tty.setraw(self._theirs)
        self.port = os.ttyname(self._theirs)
        self._wake_read, self._wake_write = os.pipe()
        self.start()

    def run(self) -> None:
        """Answer until `unplug`."""
        while True:
            ready = select.select([self._ours, self._wake_read], [], [])[0]
            if self._wake_read in ready:
                return
            try:
                reply = self._answer(os.read(self._ours, 256))
                while reply:
                    reply = reply[os.write(self._ours, reply) :]
            except OSError:
                return

    def unplug(self) -> None:
        """Stop answering and close the pty."""
        with suppress(OSError):
            os.write(self._wake_write, b"x")
        self.join(timeout=2.0)
        for handle in (self._ours, self._theirs, self._wake_read, self._wake_write):
            with suppress(OSError):
                os.close(handle)
