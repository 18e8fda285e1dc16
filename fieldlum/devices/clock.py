"""Time as a device: the real clock, and a fast one whose sleep costs nothing and that can be
stepped and suspended.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Literal, Protocol


class Clock(Protocol):
    def now(self) -> datetime:
        """Wall time, aware UTC; may be stepped by people and time servers."""
        ...

    def monotonic(self) -> float:
        """Seconds that stand still while the computer sleeps."""
        ...

    def boottime(self) -> float:
        """Seconds that go on while the computer sleeps."""
        ...

    def sleep(self, seconds: float) -> None: ...


class RealClock:
    """The computer's own clocks."""

    def now(self) -> datetime:
        return datetime.now(UTC)

    def monotonic(self) -> float:
        return (
            time.clock_gettime(time.CLOCK_MONOTONIC)
            if hasattr(time, "clock_gettime")
            else time.monotonic()
        )

    def boottime(self) -> float:
        # Only Linux has this clock; on macOS and Windows time.monotonic counts sleep, or nothing
        # does.
        return (
            time.clock_gettime(time.CLOCK_BOOTTIME)
            if hasattr(time, "CLOCK_BOOTTIME")
            else time.monotonic()
        )

    def sleep(self, seconds: float) -> None:
        time.sleep(max(seconds, 0.0))


@dataclass(frozen=True, slots=True)
class ClockFault:
    """At `at_utc` (true time) the wall clock is stepped by `seconds`, or the computer sleeps for
    `seconds`.
    """

    at_utc: datetime
    kind: Literal["step", "suspend"]
    seconds: float


class FastClock:
    """Simulated time: `sleep` returns at once and time has passed. `true_utc` is what the sun goes
    by.

    faults: wall steps and suspends that come when their time does; `step` and `suspend` make them
    by hand.
    """

    def __init__(self, start: datetime, faults: Iterable[ClockFault] = ()) -> None:
        if start.tzinfo is None:
            raise ValueError(f"naive time {start}: give it a time zone")
        self._lock = threading.RLock()
        self._true = start.astimezone(UTC)
        self._step_s = self._boot_s = self._slept_s = 0.0
        self._faults = sorted(faults, key=lambda fault: fault.at_utc)

    @property
    def true_utc(self) -> datetime:
        with self._lock:
            return self._true

    def now(self) -> datetime:
        with self._lock:
            return self._true + timedelta(seconds=self._step_s)

    def monotonic(self) -> float:
        with self._lock:
            return self._boot_s - self._slept_s

    def boottime(self) -> float:
        with self._lock:
            return self._boot_s

    def sleep(self, seconds: float) -> None:
        """Let time pass; a suspend on the way makes the sleeper wake later, as on a real
        computer.
        """
        with self._lock:
            left = max(seconds, 0.0)
            while self._faults and self._faults[0].at_utc <= self._true + timedelta(seconds=left):
                fault = self._faults.pop(0)
                wait = max((fault.at_utc - self._true).total_seconds(), 0.0)
                self._pass(wait)
                left -= wait
                self.step(fault.seconds) if fault.kind == "step" else self.suspend(fault.seconds)
            self._pass(left)

    def step(self, seconds: float) -> None:
        """Set the wall clock forward (or back)."""
        with self._lock:
            self._step_s += seconds

    def suspend(self, seconds: float) -> None:
        """The computer sleeps: wall and boot time go on, monotonic time does not."""
        with self._lock:
            self._slept_s += seconds
            self._pass(seconds)

    def _pass(self, seconds: float) -> None:
        self._true += timedelta(seconds=seconds)
        self._boot_s += seconds
