"""Provide clocks: the computer's, and a simulated one that waits without taking time."""

import time
from datetime import UTC, datetime, timedelta


class Clock:
    """The computer's clocks: wall time, and seconds that include its sleep or do not; waiting."""

    def now(self) -> datetime:
        """Return the wall time as aware UTC; users and time servers may step it."""
        return datetime.now(UTC)

    def monotonic(self) -> float:
        """Return the seconds [s] since a fixed start; on Linux without the computer's sleep."""
        return time.monotonic()

    def boottime(self) -> float:
        """Return the seconds [s] since a fixed start; on Linux with the computer's sleep."""
        # On macOS and Windows time.monotonic already counts sleep, or no clock does.
        is_linux = hasattr(time, "CLOCK_BOOTTIME")
        return time.clock_gettime(time.CLOCK_BOOTTIME) if is_linux else time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Wait for a number of seconds; not at all for a negative one."""
        time.sleep(max(seconds, 0.0))


class FastClock(Clock):
    """A simulated clock: `sleep` returns at once and moves its time forward.

    start : first time, with a time zone; true_utc : the simulated time, which `now` returns. A
    subclass can simulate a wrong clock by another `now`; the simulated sun follows true_utc. Raises
    ValueError for a start without a zone.
    """

    def __init__(self, start: datetime) -> None:
        if start.tzinfo is None:
            raise ValueError(f"naive time {start}: add a time zone")
        self.true_utc, self._boot_s = start.astimezone(UTC), 0.0

    def now(self) -> datetime:
        """Return the simulated time, aware UTC."""
        return self.true_utc

    def monotonic(self) -> float:
        """Return simulated seconds since the start."""
        return self._boot_s

    boottime = monotonic

    def sleep(self, seconds: float) -> None:
        """Advance the time by `seconds`; not at all for a negative number."""
        self.true_utc += timedelta(seconds=max(seconds, 0.0))
        self._boot_s += max(seconds, 0.0)
