"""Capture: every bracket of the plan is taken, whatever the camera does."""

from __future__ import annotations

import errno
import json
import threading
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import pytest
from tiny_field import FAST, T0, Field, TinyCamera, make_session

from fieldlum.capture.bracket import FrameChecks
from fieldlum.core.errors import DeviceError
from fieldlum.core.records import CameraSetup
from fieldlum.devices.clock import FastClock
from fieldlum.session import (
    day_files,
    read_day,
    read_journal,
    sha256,
)
from fieldlum.session.slot_states import apply_events, slots_to_do


@pytest.mark.contract
def test_undisturbed_run_takes_everything_once(rig: Field) -> None:
    events = rig.run()
    assert rig.outcomes() == ["done"] * 3 and events.count("frame") == 9
    for slot in rig.session.slots():
        folder = rig.session.raw / slot.id
        table = json.loads((folder / "capture.json").read_text())
        assert table["complete"] and table["slot"] == slot.id
        assert [f["exposure"]["shutter_s"] for f in table["frames"]] == [1.0, 0.5, 0.25]
        assert all(sha256(folder / f["file"]) == f["sha256"] for f in table["frames"])
        assert not list(folder.glob(".*"))
        assert table["t_open_utc"] < table["t_close_utc"]
    samples = [s for path in day_files(rig.session) for s in read_day(path)[0]]
    for slot in rig.session.slots():  # the bracket's interval is closed on both sides
        assert any(slot.t_utc - timedelta(seconds=6) <= s.t_utc <= slot.t_utc for s in samples)
        end = slot.t_utc + timedelta(seconds=6)
        assert any(end <= s.t_utc <= end + timedelta(seconds=6) for s in samples)
    assert rig.shown[-1].state == "finished" and rig.shown[-1].left == 0
    assert rig.run()[-1] == "close" and rig.cameras[0].count == 9, (
        "nothing is owed: nothing is taken"
    )


@pytest.mark.contract
def test_turned_head_takes_every_heading(tmp_path: Path) -> None:
    field_ = Field(
        make_session(tmp_path / "s", 1, CameraSetup(headings=(0.0, 180.0))), FastClock(T0)
    )
    field_.run()
    table = json.loads((field_.session.raw / "20270320T153000Z" / "capture.json").read_text())
    assert [f["heading_deg"] for f in table["frames"]] == [0.0] * 3 + [180.0] * 3
    assert len({f["file"] for f in table["frames"]}) == 6


@pytest.mark.contract
def test_a_lost_camera_comes_back_within_the_bracket(rig: Field) -> None:
    def fault(count: int) -> None:
        if count == 5:
            raise DeviceError("unplugged")

    rig.camera_fault = fault
    events = rig.run()
    assert rig.outcomes() == ["done"] * 3 and len(rig.cameras) == 2
    assert (
        events.count("device-lost") == events.count("device-back") == 1
        and events.count("frame") == 9
    )


@pytest.mark.contract
def test_a_camera_that_stays_away_costs_slots_not_the_session(rig: Field) -> None:
    opened = rig.open_camera

    def refuse() -> TinyCamera:
        if rig.cameras and rig.clock.true_utc < T0 + timedelta(minutes=90):
            raise OSError(errno.ENODEV, "no such device")
        return opened()

    def fault(count: int) -> None:
        if count == 2:
            raise DeviceError("gone")

    rig.camera_fault = fault
    rig.run(open_cam=refuse)
    assert rig.outcomes() == ["aborted", "aborted", "done"]
    table = json.loads((rig.session.raw / "20270320T153000Z" / "capture.json").read_text())
    assert not table["complete"] and len(table["frames"]) == 1


@pytest.mark.contract
def test_a_hung_camera_is_left_behind(rig: Field) -> None:
    hang = threading.Event()

    def fault(count: int) -> None:
        if count == 4:
            hang.wait(20)

    rig.camera_fault = fault
    rig.run(replace(FAST, watchdog_s=0.2))
    hang.set()
    assert rig.outcomes() == ["done"] * 3 and len(rig.cameras) == 2


@pytest.mark.contract
def test_no_camera_at_the_start_is_said_at_once(rig: Field) -> None:
    def refuse() -> TinyCamera:
        raise DeviceError("no camera found")

    with pytest.raises(DeviceError, match="no camera found"):
        rig.run(open_cam=refuse)
    assert len(slots_to_do(rig.session.slots(), apply_events(read_journal(rig.session)))) == 3


@pytest.mark.contract
def test_a_defect_in_a_bracket_costs_its_slot_alone(rig: Field) -> None:
    def check(path: Path) -> str:
        if "T163000" in str(path):
            raise ZeroDivisionError("a defect")
        return ""

    rig.run(checks=FrameChecks(darkest=check))
    assert rig.outcomes() == ["done", "aborted", "done"]
    aborted = next(e for e in read_journal(rig.session) if e["event"] == "aborted")
    assert aborted["why"] == "ZeroDivisionError: a defect" and aborted["frames"] == 3
