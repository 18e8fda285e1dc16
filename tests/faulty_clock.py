"""A simulated clock with disturbances of the wall clock."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime, timedelta

from fieldlum.devices.clock import FastClock


class FaultyClock(FastClock):
    """A simulated clock whose wall clock is stepped and which is suspended.

    faults : (true time, kind, seconds); a step sets the wall clock forward, or back if negative.
    """

    def __init__(self, start: datetime, faults: Iterable[tuple[datetime, str, float]] = ()) -> None:
        super().__init__(start)
        self._faults = sorted(faults)
        self._step_s = self._slept_s = 0.0

    def now(self) -> datetime:
        """Return wall time: true time plus all steps."""
        return self.true_utc + timedelta(seconds=self._step_s)

    def monotonic(self) -> float:
        """Return seconds since the start without those of sleep."""
        return self._boot_s - self._slept_s

    def step(self, seconds: float) -> None:
        """Set the wall clock forward by `seconds` (or back, if negative)."""
        self._step_s += seconds

    def suspend(self, seconds: float) -> None:
        """Simulate sleep: wall and boot time continue, monotonic time does not."""
        self._slept_s += seconds
        super().sleep(seconds)

    def sleep(self, seconds: float) -> None:
        """Advance the time, and apply the faults due until then; a suspend adds its duration."""
        rest_s = max(seconds, 0.0)
        while self._faults and (self._faults[0][0] - self.true_utc).total_seconds() <= rest_s:
            at_utc, kind, by_s = self._faults.pop(0)
            wait_s = max((at_utc - self.true_utc).total_seconds(), 0.0)
            super().sleep(wait_s)
            rest_s -= wait_s
            self.step(by_s) if kind == "step" else self.suspend(by_s)
        super().sleep(rest_s)
