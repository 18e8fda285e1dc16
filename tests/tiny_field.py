"""A session with tiny devices that fail on request, for the tests of capture."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from places import SEATTLE

from fieldlum.capture.runner import Live, Options, run
from fieldlum.core.records import CameraSetup, Exposure, IrradianceSample, SiteFile, Slot
from fieldlum.devices import Camera, CameraInfo, InstrumentInfo, Pyranometer
from fieldlum.devices.clock import FastClock
from fieldlum.session import (
    Session,
    create_session,
    read_journal,
)
from fieldlum.session.slot_states import apply_events

TINY_CAMERA = CameraInfo("tiny", serial="7")
TINY_PYRANOMETER = InstrumentInfo("tiny", gives=())
T0 = datetime(2027, 3, 20, 15, 30, tzinfo=UTC)
LADDER = tuple(Exposure(2.0**-i, 5.6) for i in range(3))
FAST = Options(log_around_s=60.0, threaded=False, flush=False, reserve_bytes=4096, watchdog_s=5.0)


def make_session(folder: Path, slots: int = 3, setup: CameraSetup | None = None) -> Session:
    plan = [Slot(T0 + timedelta(hours=i), 10.0, 120.0, LADDER) for i in range(slots)]
    site = SiteFile(SEATTLE, setup or CameraSetup())
    return create_session(folder, site, plan, {"set": "test"})


@dataclass
class TinyCamera(Camera):
    """Writes a few bytes a frame; `fault(count)` may raise or hang before frame number `count`."""

    clock: FastClock
    fault: Callable[[int], None] = lambda count: None
    count: int = 0
    info: CameraInfo = TINY_CAMERA

    def expose(self, exposure: Exposure, target: Path, *, heading_deg: float | None = None) -> Path:
        self.count += 1
        self.fault(self.count)
        self.clock.sleep(2.0)
        written = target.with_name(f"{target.name}.dng")
        written.write_bytes(f"{exposure} {heading_deg} {self.clock.true_utc}".encode())
        return written

    def close(self) -> None: ...


@dataclass
class TinyPyranometer(Pyranometer):
    clock: FastClock
    fault: Callable[[int], None] = lambda count: None
    count: int = 0
    info: InstrumentInfo = TINY_PYRANOMETER

    def read(self) -> IrradianceSample:
        self.count += 1
        self.fault(self.count)
        return IrradianceSample(self.clock.now(), ghi_wm2=500.0 + self.count, dhi_wm2=100.0)

    def close(self) -> None: ...


@dataclass
class Field:
    """A session with its tiny devices; keeps every device that was opened."""

    session: Session
    clock: FastClock
    camera_fault: Callable[[int], None] = lambda count: None
    pyranometer_fault: Callable[[int], None] = lambda count: None
    cameras: list[TinyCamera] = field(default_factory=list)
    shown: list[Live] = field(default_factory=list)
    count: int = 0

    def open_camera(self) -> TinyCamera:
        made = TinyCamera(self.clock, self.camera_fault)
        made.count = sum(c.count for c in self.cameras)
        self.cameras.append(made)
        return made

    def run(self, options: Options = FAST, trusted: bool = False, **more: Any) -> list[str]:
        run(
            self.session,
            "tiny:",
            "tiny:",
            clock=self.clock,
            options=options,
            watch=self.shown.append,
            trusted=lambda: trusted,
            open_cam=more.pop("open_cam", self.open_camera),
            open_pyr=lambda: TinyPyranometer(self.clock, self.pyranometer_fault),
            **more,
        )
        return [event["event"] for event in read_journal(self.session)]

    def outcomes(self) -> list[str]:
        states = apply_events(read_journal(self.session))
        return [states.slots[slot.id].outcome for slot in self.session.slots()]
