"""UTC that neither a stepped wall clock nor a sleeping laptop can upset."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from fieldlum.devices.clock import Clock

STEP_S = (
    2.0  # a wall clock that leaves the steady one by more is a step; less is drift, and is followed
)


def synchronised() -> bool:
    """Whether the system says that its clock is held by a time server (systemd); anything else
    counts as no.
    """
    try:
        said = subprocess.run(
            ["timedatectl", "show", "-p", "NTPSynchronized", "--value"],
            capture_output=True,
            text=True,
            timeout=5,
        )
    except (OSError, subprocess.SubprocessError):
        return False
    return said.stdout.strip() == "yes"


def boot_id() -> str:
    """Which start of the machine this is; empty where the system does not tell."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return ""


class SteadyClock:
    """A `Clock`: the wall clock's UTC at the start, carried on by the time since boot (which counts
    sleep).

    A step of the wall clock is followed only when a time server vouches for it; else the steady
    time goes on, so that slots stay where the sun is. `check` reports steps and sleeps as journal
    events.
    """

    def __init__(
        self, clock: Clock, trusted: Callable[[], bool] = synchronised, boot: str = ""
    ) -> None:
        self._clock, self._trusted, self._boot_id = clock, trusted, boot
        self._anchor, self._boot = clock.now(), clock.boottime()
        self._slept = clock.boottime() - clock.monotonic()
        self._refused_s = 0.0  # a step that was seen and not followed is reported once

    def now(self) -> datetime:
        return self._anchor + timedelta(seconds=self._clock.boottime() - self._boot)

    def monotonic(self) -> float:
        return self._clock.monotonic()

    def boottime(self) -> float:
        return self._clock.boottime()

    def sleep(self, seconds: float) -> None:
        self._clock.sleep(seconds)

    def mark(self) -> dict[str, Any]:
        """What a later process needs to carry this time on."""
        return {"boot_id": self._boot_id, "boottime_s": round(self.boottime(), 3)}

    def carry_on(self, then: datetime, mark: dict[str, Any]) -> None:
        """Take up the time of an earlier process of the same boot; `check` then sees any step
        made in between.
        """
        if self._boot_id and mark.get("boot_id") == self._boot_id:
            self._anchor, self._boot = then, float(mark["boottime_s"])

    def check(self) -> list[tuple[str, dict[str, Any]]]:
        """Journal events (name, fields) since the last call: `suspend` and `clock-step`."""
        events: list[tuple[str, dict[str, Any]]] = []
        slept = self._clock.boottime() - self._clock.monotonic()
        if slept - self._slept > STEP_S:
            events.append(("suspend", {"seconds": round(slept - self._slept, 1)}))
        self._slept = slept
        step = (self._clock.now() - self.now()).total_seconds()
        if abs(step - self._refused_s) > STEP_S:
            followed = abs(step) > STEP_S and self._trusted()
            events.append(
                ("clock-step", {"seconds": round(step - self._refused_s, 1), "followed": followed})
            )
            self._refused_s = 0.0 if followed else step
            if followed:
                self._follow()
        elif self._refused_s == 0.0:
            self._follow()
        return events

    def _follow(self) -> None:
        self._anchor, self._boot = self._clock.now(), self._clock.boottime()
