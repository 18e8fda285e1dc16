"""The state of a running capture, for its display and for monitors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime


@dataclass(frozen=True, slots=True)
class Live:
    """State of a running capture: counts of slots, next slot, irradiance, devices, disk.

    state: waiting, capturing or finished; left: slots still to capture; next_in_s,
    ghi_age_s: seconds; camera, pyranometer: ok, closed or lost; bytes_missing: what the next
    bracket needs and the disk lacks, without the space reserved for journal and rows; disk_days:
    days of captures that fit. None: unknown.
    """

    state: str
    t_utc: datetime
    planned: int
    done: int
    missed: int
    aborted: int
    left: int
    next_slot: str
    next_in_s: float | None
    last_frame: str
    ghi_wm2: float | None
    ghi_age_s: float | None
    camera: str
    pyranometer: str
    bytes_free: int
    bytes_missing: int
    disk_days: float | None
    last_event: str


Watch = Callable[[Live], None]
