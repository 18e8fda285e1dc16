"""Keep UTC correct when the computer's clock is set or the computer sleeps."""

import ctypes
import ctypes.util
from collections.abc import Callable, Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from fieldlum.devices.clock import Clock
from fieldlum.session import Session
from fieldlum.session.journal import EventFields

# A larger difference between the computer's clock and the steady time is a step; a smaller one is
# drift, which is followed. The drift between two checks is far smaller.
STEP_S = 2.0
_CLOCK_TOLERANCE = timedelta(minutes=2)  # for a session copied from another computer


def synchronised() -> bool | None:
    """Return whether a time server controls this computer's clock; None if unknown.

    The kernel of Linux states it; `timedatectl` shows it as NTPSynchronized.
    """
    # A struct timex of zeros: with modes 0 the call only reads.
    timex = ctypes.create_string_buffer(512)
    try:
        state = ctypes.CDLL(ctypes.util.find_library("c"), use_errno=True).adjtimex(timex)
    except (OSError, AttributeError, TypeError):  # TypeError on Windows
        return None
    return None if state < 0 else state != 5  # TIME_ERROR: not synchronised, <sys/timex.h>


def boot_id() -> str:
    """Return a text that is the same until this computer boots again; "" if the system has none."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return ""


class SteadyClock(Clock):
    """UTC at the start plus the time since then, which includes sleep.

    `check` compares it with the computer's clock and must be called regularly. A difference of up
    to 2 s is drift and is followed. A larger one, a step, is followed only if a time server
    controls that clock. Otherwise the steady time continues, so that slots keep their sun position,
    and does not follow drift until the step is undone. `check` returns steps and sleeps as journal
    events. clock: of the computer; trusted: returns whether a time server controls it, None if
    unknown; boot: identifies the computer's boot, result of `boot_id`.
    """

    def __init__(
        self, clock: Clock, trusted: Callable[[], bool | None] = synchronised, boot: str = ""
    ) -> None:
        self._clock, self._trusted, self._boot_id = clock, trusted, boot
        # The steady time was `_anchor_utc` at `_anchor_s` after the boot.
        self._anchor_utc, self._anchor_s = clock.now(), clock.boottime()
        self._slept_s = clock.boottime() - clock.monotonic()  # since the boot
        self._refused_s = 0.0  # size of the step that is not followed; it is reported once

    def now(self) -> datetime:
        """Return the steady UTC, which does not follow untrusted steps of the computer's clock.

        `check` must be called regularly: it follows trusted steps and drift.
        """
        return self._anchor_utc + timedelta(seconds=self._clock.boottime() - self._anchor_s)

    def boottime(self) -> float:
        """Return seconds since the boot; they continue while the computer sleeps."""
        return self._clock.boottime()

    def sleep(self, seconds: float) -> None:
        """Sleep for a number of seconds; not at all for a negative one."""
        self._clock.sleep(seconds)

    def mark(self) -> EventFields:
        """Return the boot's identifier and the time since it [s], for `continue_from`."""
        return {"boot_id": self._boot_id, "boottime_s": round(self.boottime(), 3)}

    def continue_from(self, then: datetime, mark: Mapping[str, Any]) -> None:
        """Continue the steady time of an earlier process, if the computer did not boot since.

        then: the earlier process's UTC when it stored `mark`; mark: result of `mark` in that
        process. `check` then detects a step between the two processes.
        """
        if self._boot_id and mark.get("boot_id") == self._boot_id:
            self._anchor_utc, self._anchor_s = then, float(mark.get("boottime_s", 0.0))

    def check(self) -> list[tuple[str, EventFields]]:
        """Return the journal events since the last call: `suspend`, `clock-step`.

        Each event is its name and its fields: `seconds`, the length of the sleep or of the step
        [s], and for a step `followed`. Sleep or steps of at most 2 s are no event.
        """
        events: list[tuple[str, EventFields]] = []
        slept_s = self._clock.boottime() - self._clock.monotonic()
        if slept_s - self._slept_s > STEP_S:
            events.append(("suspend", {"seconds": round(slept_s - self._slept_s, 1)}))
        self._slept_s = slept_s
        step_s = (self._clock.now() - self.now()).total_seconds()
        if abs(step_s - self._refused_s) > STEP_S:
            followed = abs(step_s) > STEP_S and bool(self._trusted())
            fields = {"seconds": round(step_s - self._refused_s, 1), "followed": followed}
            events.append(("clock-step", fields))
            is_undone = abs(step_s) <= STEP_S  # drift is followed again
            self._refused_s = 0.0 if followed or is_undone else step_s
            if followed:
                self._follow()
        elif self._refused_s == 0.0:
            self._follow()
        return events

    def _follow(self) -> None:
        """Set the steady time to that of the computer's clock."""
        self._anchor_utc, self._anchor_s = self._clock.now(), self._clock.boottime()


def wait_for_clock(session: Session, clock: Clock, say: Callable[[str], None]) -> None:
    """Wait while the computer's clock is over two minutes earlier than the session's last change.

    A small computer without a clock battery starts with a past time, until a time server answers. A
    bracket taken before that would get a wrong sun position. The session's last change is that of
    session.toml. A clock that a time server has set ends the waiting. say: called with notes for
    the user.
    """
    latest_utc = datetime.fromtimestamp(session.toml.stat().st_mtime, UTC)
    if clock.now() >= latest_utc - _CLOCK_TOLERANCE or synchronised():
        return
    say(
        f"this computer's clock shows {clock.now():%Y-%m-%d %H:%M} UTC, earlier than the session "
        f"({latest_utc:%Y-%m-%d %H:%M} UTC), so it has not been set. The capture waits: connect to "
        "the network, or set the clock."
    )
    while clock.now() < latest_utc - _CLOCK_TOLERANCE and not synchronised():
        clock.sleep(5.0)
    say(f"the clock is set: {clock.now():%Y-%m-%d %H:%M} UTC")
