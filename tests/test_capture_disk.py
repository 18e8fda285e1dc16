"""Capture: full, absent and moved disks."""

from __future__ import annotations

import errno
import os
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from tiny_field import FAST, T0, Field, make_session

from fieldlum.core.records import IrradianceSample
from fieldlum.devices.clock import FastClock
from fieldlum.session import (
    DayFiles,
    day_files,
    read_day,
)
from fieldlum.web.snapshot import Snapshots


@pytest.mark.contract
def test_full_disk_is_recorded_and_survived(rig: Field) -> None:
    def fault(count: int) -> None:
        if count == 5:
            raise OSError(errno.ENOSPC, "No space left on device")

    rig.camera_fault = fault
    events = rig.run()
    assert rig.outcomes() == ["done"] * 3
    assert events.count("disk-full") == 1 and "device-lost" not in events
    assert not (rig.session.root / ".reserve").exists()


@pytest.mark.contract
def test_the_days_that_fit_are_those_of_the_place(tmp_path: Path) -> None:
    """Ten hours of one day in Seattle, which are of two days in UTC."""
    session = make_session(tmp_path / "s", 10)
    rig = Field(session, FastClock(T0 - timedelta(minutes=5)))
    rig.run()
    live, shown = rig.shown[-1], Snapshots(session)._disk(session.slots())
    days = live.bytes_free / (10 * session.slot_bytes())
    assert live.disk_days == pytest.approx(days, rel=0.01)  # sizes of capture.json differ
    assert shown["days"] == pytest.approx(days, rel=0.01)


@pytest.mark.contract
def test_a_disk_that_was_away_costs_its_frames_at_most(
    rig: Field, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A share or a stick that is gone for some minutes: rows and events wait in memory, and
    nothing ends.
    """
    away = [T0 + timedelta(hours=1, minutes=-2), T0 + timedelta(hours=1, minutes=20)]
    really = os.write

    def write(handle: int, data: bytes) -> int:
        if away[0] <= rig.clock.true_utc < away[1]:
            raise OSError(errno.EIO, "Input/output error")
        return really(handle, data)

    monkeypatch.setattr(os, "write", write)
    rig.run(replace(FAST, log_around_s=None, log_every_s=30.0))
    assert rig.outcomes() == ["done", "aborted", "done"]
    (path,) = day_files(rig.session)
    rows = [row.t_utc for row in read_day(path)[0]]
    assert max((b - a).total_seconds() for a, b in pairwise(rows)) < 60.0, "no row is lost"


@pytest.mark.contract
def test_a_moved_folder_and_a_spoilt_day_file_do_not_end_the_log(rig: Field) -> None:
    folder, moved = rig.session.irradiance, rig.session.root / "moved"

    def fault(count: int) -> None:
        if count == 10:
            folder.rename(moved)

    rig.pyranometer_fault = fault
    rig.clock = FastClock(datetime(2027, 3, 20, 15, 25, tzinfo=UTC))
    rig.session = make_session(rig.session.root.parent / "days", slots=30)
    folder, moved = rig.session.irradiance, rig.session.root / "moved"
    rig.run(replace(FAST, log_around_s=None, log_every_s=1800.0))
    assert rig.outcomes() == ["done"] * 30
    assert [path.stem for path in day_files(rig.session)] == ["2027-03-21"] and moved.is_dir()
    days = DayFiles(rig.session, flush=False)
    spoilt = rig.session.irradiance / "2027-03-21.csv"
    before = (
        spoilt.read_bytes().replace(b",", b";").removesuffix(b"\n")
    )  # as a spreadsheet saves it
    spoilt.write_bytes(before)
    days.append(IrradianceSample(datetime(2027, 3, 21, 23, tzinfo=UTC), ghi_wm2=7.0))
    days.close()
    samples, broken = read_day(spoilt)
    assert spoilt.read_bytes().startswith(before) and [row.ghi_wm2 for row in samples] == [7.0]
    assert broken == before.count(b"\n") + 1


@pytest.mark.contract
def test_disk_full_at_the_very_end_of_a_bracket(
    rig: Field, monkeypatch: pytest.MonkeyPatch
) -> None:
    from fieldlum.capture import bracket

    real, calls = bracket.write_capture, []

    def full_once(*args: Any, **kwargs: Any) -> None:
        calls.append(1)
        if len(calls) == 1:
            raise OSError(errno.ENOSPC, "No space left on device")
        real(*args, **kwargs)

    monkeypatch.setattr(bracket, "write_capture", full_once)
    events = rig.run()
    assert rig.outcomes() == ["done"] * 3 and events.count("disk-full") == 1
