"""Capture and log: irradiance rows next to the brackets, whatever the instrument does."""

from __future__ import annotations

import json
import threading
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from tiny_field import FAST, LADDER, Field, TinyCamera, TinyPyranometer

from fieldlum.capture.disk_writer import Recorder
from fieldlum.capture.import_logger import import_rows
from fieldlum.capture.irradiance_log import log
from fieldlum.capture.runner import Options, run
from fieldlum.capture.steady_clock import SteadyClock
from fieldlum.core.errors import DeviceError, InputError
from fieldlum.core.records import Site, SiteFile, Slot
from fieldlum.devices import InstrumentInfo
from fieldlum.devices.clock import FastClock
from fieldlum.session import (
    create_session,
    day_files,
    read_day,
    read_journal,
    sole_user,
    update_session,
)
from fieldlum.session.slot_states import apply_events


@pytest.mark.contract
def test_an_instrument_that_died_does_not_keep_a_restarted_capture_from_its_brackets(
    rig: Field,
) -> None:
    def dead() -> TinyPyranometer:
        raise DeviceError("no such port")

    def run_with(uri: str) -> None:
        run(
            rig.session,
            "tiny:",
            uri,
            clock=rig.clock,
            options=FAST,
            trusted=lambda: False,
            open_cam=rig.open_camera,
            open_pyr=dead,
        )

    with pytest.raises(DeviceError, match="no such port"):  # never seen before: somebody is there
        run_with("tiny:")
    update_session(
        rig.session,
        {"devices": {"pyranometer": {"kind": "tiny"}, "uris": {"pyranometer": "tiny:"}}},
    )
    with pytest.raises(DeviceError, match="no such port"):  # mistyped
        run_with("tinny:")
    run_with("tiny:")
    assert rig.outcomes() == ["done"] * 3
    lost = [e for e in read_journal(rig.session) if e["event"] == "device-lost"]
    assert [(e["device"], e["why"]) for e in lost] == [("pyranometer", "DeviceError: no such port")]
    assert rig.session.table()["devices"]["pyranometer"] == {"kind": "tiny"}


@pytest.mark.contract
def test_bad_readings_and_a_lost_pyranometer(rig: Field) -> None:
    def fault(count: int) -> None:
        if count in (3, 8, 9, 10):
            raise DeviceError("garbage")

    rig.pyranometer_fault = fault
    rig.run()
    lost = [e for e in read_journal(rig.session) if e["event"] == "device-lost"]
    assert len(lost) >= 1 and all(e["device"] == "pyranometer" for e in lost)
    bad = [e for e in read_journal(rig.session) if e["event"] == "bad-reading"]
    assert bad and all(e["device"] == "pyranometer" and "garbage" in e["why"] for e in bad)
    assert rig.outcomes() == ["done"] * 3


@pytest.mark.contract
def test_refused_lines_are_journalled_as_they_came_and_never_fill_the_disk(rig: Field) -> None:
    class Rig(TinyPyranometer):
        """Hands out three refused lines a reading."""

        def refused(self) -> list[str]:
            return [f"line {3 * self.count + i}" for i in range(3)]

    run(
        rig.session,
        "tiny:",
        "tiny:",
        clock=rig.clock,
        options=FAST,
        trusted=lambda: False,
        open_cam=rig.open_camera,
        open_pyr=lambda: Rig(rig.clock),
    )
    told = [e["why"] for e in read_journal(rig.session) if e["event"] == "bad-reading"]
    lines, counts = (
        [w for w in told if w.startswith("line")],
        [w for w in told if w.startswith("and ")],
    )
    assert lines[:4] == ["line 3", "line 4", "line 5", "line 6"] and len(lines) <= 20 * 4
    assert counts and all(text.endswith("more lines in that hour") for text in counts)
    assert rig.outcomes() == ["done"] * 3


@pytest.mark.contract
def test_threaded_log_runs_beside(tmp_path: Path) -> None:
    from fieldlum.devices.clock import Clock

    now = datetime.now(UTC)
    slots = [Slot(now + timedelta(seconds=0.5), 10.0, 120.0, LADDER[:1])]
    session = create_session(tmp_path / "s", SiteFile(Site("office", 47.6, -122.3)), slots, {})
    fast = FastClock(now)
    options = Options(log_every_s=0.05, reserve_bytes=4096)
    cameras = [TinyCamera(fast)]
    run(
        session,
        "tiny:",
        "tiny:",
        clock=Clock(),
        options=options,
        trusted=lambda: False,
        open_cam=lambda: cameras[0],
        open_pyr=lambda: TinyPyranometer(fast),
    )
    samples = [s for path in day_files(session) for s in read_day(path)[0]]
    assert (
        len(samples) >= 3
        and apply_events(read_journal(session)).slots[slots[0].id].outcome == "done"
    )


@pytest.mark.contract
def test_a_meter_reads_before_and_after_and_may_fail(rig: Field) -> None:
    readings = iter([100.0, 110.0, DeviceError("no light"), 90.0, *[95.0] * 20])

    class Meter:
        info = InstrumentInfo("tiny", gives=())

        def read(self) -> Any:
            value = next(readings)
            if isinstance(value, DeviceError):
                raise value
            return value

        def close(self) -> None: ...

    rig.run(open_met=Meter)
    notes = [json.loads(p.read_text()) for p in sorted(rig.session.raw.glob("*/capture.json"))]
    assert [n["illuminance_lx"] for n in notes] == [105.0, 90.0, 95.0]
    assert rig.outcomes() == ["done"] * 3


@pytest.mark.contract
def test_a_defect_within_the_log_is_told_once_and_ends_nothing(
    rig: Field, monkeypatch: pytest.MonkeyPatch
) -> None:
    from fieldlum.capture.disk_writer import Recorder
    from fieldlum.capture.irradiance_log import Logger
    from fieldlum.capture.reconnect import Keeper

    steady = SteadyClock(rig.clock, lambda: False)
    recorder = Recorder(rig.session, steady.now, 4096, flush=False)
    keeper: Keeper[Any] = Keeper(
        "pyranometer", lambda: TinyPyranometer(rig.clock), steady, recorder.write_event, 5.0
    )
    logger, polls, over = Logger(keeper, recorder, steady, 5.0), [], threading.Event()

    def broken() -> None:
        polls.append(len(polls))
        if len(polls) > 2:
            over.set()
        raise ZeroDivisionError("a defect")

    monkeypatch.setattr(logger, "poll_if_due", broken)
    logger.start()
    assert over.wait(30.0)
    logger.close()
    recorder.close()
    assert [e["why"] for e in read_journal(rig.session)] == ["ZeroDivisionError: a defect"]


@pytest.mark.contract
def test_log_alone_writes_rows(rig: Field) -> None:
    from fieldlum.capture.irradiance_log import log

    said: list[str] = []
    rows = log(
        rig.session, "sim:office?seed=1", clock=rig.clock, every_s=5.0, rows=10, say=said.append
    )
    samples = [s for path in day_files(rig.session) for s in read_day(path)[0]]
    assert rows == len(samples) == 10 and said[0].startswith("logging Delta-T SPN1 A1")
    assert rig.session.table()["devices"]["pyranometer"]["serial"].startswith("A1")
    rig.run()
    assert {"camera", "pyranometer", "uris"} <= set(rig.session.table()["devices"])
    assert (samples[-1].t_utc - samples[0].t_utc) == timedelta(seconds=45)


@pytest.mark.contract
def test_one_process_at_a_time_writes_irradiance(rig: Field, tmp_path: Path) -> None:
    rows = tmp_path / "logger.csv"
    rows.write_text("t_utc,ghi_wm2\n2027-03-20T15:30:00Z,500\n2027-03-20T15:31:00Z,501\n")
    with sole_user(rig.session, "log"):
        with pytest.raises(InputError, match="logs irradiance into this session"):
            rig.run()
        with pytest.raises(InputError, match="logs irradiance into this session"):
            import_rows(rig.session, rows, None)
        run(rig.session, "tiny:", clock=rig.clock, options=FAST, open_cam=rig.open_camera)
    assert rig.outcomes() == ["done"] * 3, "a capture without a pyranometer needs no such lock"
    assert import_rows(rig.session, rows, None).rows == 2


@pytest.mark.contract
def test_a_log_leaves_the_reserve_of_a_capture(rig: Field, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fieldlum.capture.irradiance_log.open_pyranometer", lambda *_, **__: device)
    device = TinyPyranometer(rig.clock)
    capture = Recorder(rig.session, rig.clock.now, 4096)
    assert log(rig.session, "tiny:", clock=rig.clock, every_s=5.0, rows=2, say=print) == 2
    assert (rig.session.root / ".reserve").stat().st_size == 4096
    assert not (rig.session.root / ".reserve-log").exists()
    capture.close()
