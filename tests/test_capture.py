"""Capture: the plan is run to its end whatever the devices, the disk and the clock do."""

from __future__ import annotations

import errno
import json
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fieldlum.capture.preflight import refuse_what_is_not_offered
from fieldlum.capture.runner import Live, Options, run
from fieldlum.capture.state import SlotState, fold, owed
from fieldlum.capture.status import status
from fieldlum.capture.utc_clock import SteadyClock
from fieldlum.capture.verify import doubts
from fieldlum.devices.clock import ClockFault, FastClock
from fieldlum.devices.simulated.camera import SimulatedCamera
from fieldlum.errors import DeviceError, NotEnoughDataError
from fieldlum.profiles import load_camera_profile
from fieldlum.records import CameraSetup, Exposure, IrradianceSample, Panorama, Site, SiteFile, Slot
from fieldlum.session import (
    DayFiles,
    Session,
    create_session,
    day_files,
    read_day,
    read_journal,
    sha256,
    update_session,
    write_plan,
)
from fieldlum.session import lines as lines

T0 = datetime(2027, 3, 20, 15, 30, tzinfo=UTC)
LADDER = tuple(Exposure(2.0**-i, 5.6) for i in range(3))
FAST = Options(log_around_s=60.0, threaded=False, flush=False, reserve_bytes=4096, watchdog_s=5.0)


def make_session(folder: Path, slots: int = 3, setup: CameraSetup | None = None) -> Session:
    plan = [Slot(T0 + timedelta(hours=i), 10.0, 120.0, LADDER) for i in range(slots)]
    site = SiteFile(Site("office", 47.6, -122.3, "America/Los_Angeles"), setup or CameraSetup())
    return create_session(folder, site, plan, {"set": "test"})


@dataclass
class TinyCamera:
    """Writes a few bytes a frame; `fault(count)` may raise or hang before frame number `count`."""

    clock: FastClock
    fault: Callable[[int], None] = lambda count: None
    count: int = 0
    info: Any = field(default_factory=lambda: SimpleNamespace(kind="tiny", serial="7"))

    def expose(self, exposure: Exposure, target: Path, *, heading_deg: float | None = None) -> Path:
        self.count += 1
        self.fault(self.count)
        self.clock.sleep(2.0)
        written = target.with_name(f"{target.name}.dng")
        written.write_bytes(f"{exposure} {heading_deg} {self.clock.true_utc}".encode())
        return written

    def close(self) -> None: ...


@dataclass
class OneGoCamera(TinyCamera):
    """Brackets by itself, as a Theta does."""

    brackets: int = 0
    bracket_shots: range = range(2, 14)

    def expose_bracket(self, exposures: Sequence[Exposure], targets: Sequence[Path]) -> list[Path]:
        self.brackets += 1
        return [self.expose(e, t) for e, t in zip(exposures, targets, strict=True)]


@dataclass
class TinyPyranometer:
    clock: FastClock
    fault: Callable[[int], None] = lambda count: None
    count: int = 0
    info: Any = field(default_factory=lambda: SimpleNamespace(kind="tiny"))

    def read(self) -> IrradianceSample:
        self.count += 1
        self.fault(self.count)
        return IrradianceSample(self.clock.now(), 500.0 + self.count, 100.0)

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
        ledger = fold(read_journal(self.session))
        return [ledger.slots[slot.id].outcome for slot in self.session.slots()]


@pytest.fixture
def site(tmp_path: Path) -> Field:
    return Field(make_session(tmp_path / "s"), FastClock(T0 - timedelta(minutes=5)))


@pytest.mark.contract
def test_undisturbed_run_takes_everything_once(site: Field) -> None:
    events = site.run()
    assert site.outcomes() == ["done"] * 3 and events.count("frame") == 9
    for slot in site.session.slots():
        folder = site.session.raw / slot.id
        table = json.loads((folder / "capture.json").read_text())
        assert table["complete"] and table["slot"] == slot.id
        assert [f["exposure"]["shutter_s"] for f in table["frames"]] == [1.0, 0.5, 0.25]
        assert all(sha256(folder / f["file"]) == f["sha256"] for f in table["frames"])
        assert not list(folder.glob(".*"))
        assert table["t_open_utc"] < table["t_close_utc"]
    samples = [s for path in day_files(site.session) for s in read_day(path)[0]]
    for slot in site.session.slots():  # the bracket's interval is closed on both sides
        assert any(slot.t_utc - timedelta(seconds=6) <= s.t_utc <= slot.t_utc for s in samples)
        end = slot.t_utc + timedelta(seconds=6)
        assert any(end <= s.t_utc <= end + timedelta(seconds=6) for s in samples)
    assert site.shown[-1].state == "finished" and site.shown[-1].left == 0
    assert site.run()[-1] == "close" and site.cameras[0].count == 9, (
        "nothing is owed: nothing is taken"
    )


@pytest.mark.contract
def test_a_camera_that_brackets_by_itself_is_asked_once_a_slot(site: Field) -> None:
    """And again when it failed in the middle: nothing of a half bracket is acknowledged."""
    made: list[OneGoCamera] = []

    def fault(count: int) -> None:
        if count == 5:
            raise DeviceError("unplugged")

    def open_camera() -> OneGoCamera:
        made.append(OneGoCamera(site.clock, fault, sum(c.count for c in made)))
        return made[-1]

    events = site.run(open_cam=open_camera)
    assert site.outcomes() == ["done"] * 3 and events.count("frame") == 9
    assert sum(camera.brackets for camera in made) == 4
    for slot in site.session.slots():
        table = json.loads((site.session.raw / slot.id / "capture.json").read_text())
        assert [f["exposure"]["shutter_s"] for f in table["frames"]] == [1.0, 0.5, 0.25]
        assert not list((site.session.raw / slot.id).glob(".*"))


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
def test_slots_that_a_replan_adds_to_a_running_capture_are_taken(site: Field) -> None:
    """One before the slot that is waited for, one after the last."""
    plan, end = site.session.slots(), T0 + timedelta(hours=2)
    between, after = (
        replace(plan[0], t_utc=t) for t in (end - timedelta(minutes=30), end + timedelta(days=20))
    )

    def watch(live: Live) -> None:
        if live.done == 2 and len(site.session.slots()) == 3:
            slots = sorted([*plan, between, after], key=lambda slot: slot.t_utc)
            write_plan(site.session.plan, slots, "America/Los_Angeles")

    run(
        site.session,
        "tiny:",
        clock=site.clock,
        options=FAST,
        watch=watch,
        trusted=lambda: False,
        open_cam=site.open_camera,
    )
    done = [event["slot"] for event in read_journal(site.session) if event["event"] == "done"]
    assert done == [plan[0].id, plan[1].id, between.id, plan[2].id, after.id]


@pytest.mark.contract
def test_a_broken_plan_does_not_stop_a_running_capture(site: Field) -> None:
    def watch(live: Live) -> None:
        if live.done == 1:
            site.session.plan.write_text("spoilt by a spreadsheet")

    run(
        site.session,
        "tiny:",
        clock=site.clock,
        options=FAST,
        watch=watch,
        trusted=lambda: False,
        open_cam=site.open_camera,
    )
    assert [event["event"] for event in read_journal(site.session)].count("done") == 3


@pytest.mark.contract
def test_late_is_missed_never_a_burst(site: Field) -> None:
    site.clock = FastClock(T0 + timedelta(hours=1, minutes=4))
    site.run()
    assert site.outcomes() == ["missed", "done", "done"]
    late = [e for e in read_journal(site.session) if e["event"] == "late"]
    assert [e["by_s"] for e in late] == [240.0]


@pytest.mark.contract
def test_a_plan_that_the_camera_cannot_take_is_refused_at_the_start(site: Field) -> None:
    """Later it is not: a dial that somebody turned may be turned back."""

    class Choosy(TinyCamera):
        def check_offered(self, exposure: Exposure) -> None:
            if exposure.shutter_s < 0.4:
                raise DeviceError("camera shutter: 0.25 s is not offered, the nearest is 1/2")

    with pytest.raises(
        DeviceError, match=r"the plan asks for what the camera does not offer: .*0.25 s"
    ):
        site.run(open_cam=lambda: Choosy(site.clock))
    assert {event["event"] for event in read_journal(site.session)} == {"close"}
    slots = site.session.slots()
    begun = {slots[0].id: SlotState("done")}
    refuse_what_is_not_offered(Choosy(site.clock), slots, begun)


@pytest.mark.contract
def test_a_plan_that_is_past_is_refused_and_nothing_is_called_missed(site: Field) -> None:
    site.clock = FastClock(T0 + timedelta(days=30))
    with pytest.raises(
        NotEnoughDataError, match=r"none of 3 slots is ahead: the last was 2027-03-20 17:30 UTC"
    ):
        site.run()
    assert read_journal(site.session) == []


@pytest.mark.contract
def test_an_instrument_that_died_does_not_keep_a_restarted_capture_from_its_brackets(
    site: Field,
) -> None:
    def dead() -> TinyPyranometer:
        raise DeviceError("no such port")

    def run_with(uri: str) -> None:
        run(
            site.session,
            "tiny:",
            uri,
            clock=site.clock,
            options=FAST,
            trusted=lambda: False,
            open_cam=site.open_camera,
            open_pyr=dead,
        )

    with pytest.raises(DeviceError, match="no such port"):  # never seen before: somebody is there
        run_with("tiny:")
    update_session(
        site.session,
        {"devices": {"pyranometer": {"kind": "tiny"}, "uris": {"pyranometer": "tiny:"}}},
    )
    with pytest.raises(DeviceError, match="no such port"):  # mistyped
        run_with("tinny:")
    run_with("tiny:")
    assert site.outcomes() == ["done"] * 3
    lost = [e for e in read_journal(site.session) if e["event"] == "device-lost"]
    assert [(e["device"], e["why"]) for e in lost] == [("pyranometer", "DeviceError: no such port")]
    assert site.session.table()["devices"]["pyranometer"] == {"kind": "tiny"}


@pytest.mark.contract
def test_a_lost_camera_comes_back_within_the_bracket(site: Field) -> None:
    def fault(count: int) -> None:
        if count == 5:
            raise DeviceError("unplugged")

    site.camera_fault = fault
    events = site.run()
    assert site.outcomes() == ["done"] * 3 and len(site.cameras) == 2
    assert (
        events.count("device-lost") == events.count("device-back") == 1
        and events.count("frame") == 9
    )


@pytest.mark.contract
def test_a_camera_that_stays_away_costs_slots_not_the_session(site: Field) -> None:
    opened = site.open_camera

    def refuse() -> TinyCamera:
        if site.cameras and site.clock.true_utc < T0 + timedelta(minutes=90):
            raise OSError(errno.ENODEV, "no such device")
        return opened()

    def fault(count: int) -> None:
        if count == 2:
            raise DeviceError("gone")

    site.camera_fault = fault
    site.run(open_cam=refuse)
    assert site.outcomes() == ["aborted", "aborted", "done"]
    table = json.loads((site.session.raw / "20270320T153000Z" / "capture.json").read_text())
    assert not table["complete"] and len(table["frames"]) == 1


@pytest.mark.contract
def test_a_hung_camera_is_left_behind(site: Field) -> None:
    hang = threading.Event()

    def fault(count: int) -> None:
        if count == 4:
            hang.wait(20)

    site.camera_fault = fault
    site.run(replace(FAST, watchdog_s=0.2))
    hang.set()
    assert site.outcomes() == ["done"] * 3 and len(site.cameras) == 2


@pytest.mark.contract
def test_a_long_pause_starts_the_bracket_anew(site: Field) -> None:
    def fault(count: int) -> None:
        if count == 3:
            site.clock.sleep(90.0)
            raise DeviceError("slept")

    site.camera_fault = fault
    site.run()
    assert site.outcomes() == ["done"] * 3
    folder = site.session.raw / "20270320T153000Z"
    assert len(list((folder / "attempt-1").iterdir())) == 2
    assert len(json.loads((folder / "capture.json").read_text())["frames"]) == 3


@pytest.mark.contract
def test_two_misses_run_the_hook(site: Field, tmp_path: Path) -> None:
    site.clock = FastClock(T0 + timedelta(hours=1, minutes=30))
    told = tmp_path / "told"
    events = site.run(replace(FAST, on_misses=f"echo missed > {told}"))
    assert events.count("hook") == 1


@pytest.mark.contract
def test_bad_readings_and_a_lost_pyranometer(site: Field) -> None:
    def fault(count: int) -> None:
        if count in (3, 8, 9, 10):
            raise DeviceError("garbage")

    site.pyranometer_fault = fault
    site.run()
    lost = [e for e in read_journal(site.session) if e["event"] == "device-lost"]
    assert len(lost) >= 1 and all(e["device"] == "pyranometer" for e in lost)
    bad = [e for e in read_journal(site.session) if e["event"] == "bad-reading"]
    assert bad and all(e["device"] == "pyranometer" and "garbage" in e["why"] for e in bad)
    assert site.outcomes() == ["done"] * 3


@pytest.mark.contract
def test_refused_lines_are_journalled_as_they_came_and_never_fill_the_disk(site: Field) -> None:
    class Rig(TinyPyranometer):
        """Hands out three refused lines a reading."""

        def refused(self) -> list[str]:
            return [f"line {3 * self.count + i}" for i in range(3)]

    run(
        site.session,
        "tiny:",
        "tiny:",
        clock=site.clock,
        options=FAST,
        trusted=lambda: False,
        open_cam=site.open_camera,
        open_pyr=lambda: Rig(site.clock),
    )
    told = [e["why"] for e in read_journal(site.session) if e["event"] == "bad-reading"]
    lines, counts = (
        [w for w in told if w.startswith("line")],
        [w for w in told if w.startswith("and ")],
    )
    assert lines[:4] == ["line 3", "line 4", "line 5", "line 6"] and len(lines) <= 20 * 4
    assert counts and all(text.endswith("more lines in that hour") for text in counts)
    assert site.outcomes() == ["done"] * 3


EVEN_LIGHT = Panorama(np.full((46, 92), 100.0, np.float32), 180.0)


class SlippingCamera:
    """The simulated camera, whose dial slips to twice the time at the frames in `slips` (counted
    from 1).
    """

    def __init__(self, clock: FastClock, slips: set[int]) -> None:
        world = SimpleNamespace(scene=lambda t_utc: EVEN_LIGHT)
        self._camera = SimulatedCamera(
            world, load_camera_profile("sim-fisheye"), clock, overhead_s=1.0
        )  # type: ignore[arg-type]
        self._slips, self.count, self.info = slips, 0, self._camera.info

    def expose(self, exposure: Exposure, target: Path, *, heading_deg: float | None = None) -> Path:
        self.count += 1
        slip = 2.0 if self.count in self._slips else 1.0
        return self._camera.expose(replace(exposure, shutter_s=slip * exposure.shutter_s), target)

    def close(self) -> None:
        self._camera.close()


@pytest.mark.contract
def test_a_frame_unlike_what_was_asked_is_taken_again_once(site: Field) -> None:
    camera = SlippingCamera(site.clock, {2})
    site.session = make_session(site.session.root.parent / "one", slots=1)
    events = site.run(open_cam=lambda: camera, check=doubts)
    assert site.outcomes() == ["done"] and camera.count == 4 and events.count("frame") == 3
    journal = read_journal(site.session)
    told = next(e for e in journal if e["event"] == "retake")
    assert (
        told["why"] == "shutter 1 instead of 0.5" and told["frame"]["instead_of"] == "01_0.5s.dng"
    )
    assert (
        next(e for e in journal if e["event"] == "done")["why"] == "01_0.5s_again.dng taken again"
    )
    folder = site.session.raw / site.session.slots()[0].id
    frames = json.loads((folder / "capture.json").read_text())["frames"]
    assert [f["file"] for f in frames] == ["00_1s.dng", "01_0.5s_again.dng", "02_0.25s.dng"]
    assert not any("doubt" in f for f in frames) and all(
        sha256(folder / f["file"]) == f["sha256"] for f in frames
    )
    assert doubts(folder / "01_0.5s.dng", LADDER[1]) == "shutter 1 instead of 0.5", (
        "the first file is kept"
    )
    assert sorted(f.instead_of for f in fold(journal).slots[folder.name].frames) == [
        "",
        "",
        "01_0.5s.dng",
    ]


@pytest.mark.contract
def test_a_camera_set_wrongly_is_not_asked_twice_for_every_frame(site: Field) -> None:
    camera = SlippingCamera(site.clock, set(range(100)))
    site.session = make_session(site.session.root.parent / "one", slots=1)
    site.run(open_cam=lambda: camera, check=doubts)
    assert camera.count == 4, "one retake, in vain: the rest of the bracket is not taken twice"
    why = next(e for e in read_journal(site.session) if e["event"] == "done")["why"]
    assert why.count("instead of") == 3 and "taken again" not in why
    frames = json.loads(
        (site.session.raw / site.session.slots()[0].id / "capture.json").read_text()
    )["frames"]
    assert [f["exposure"]["shutter_s"] for f in frames] == [2.0, 1.0, 0.5], (
        "merge reads the exposure that they have"
    )


@pytest.mark.contract
def test_half_a_frame_is_seen_at_once_and_taken_again(site: Field) -> None:
    """Its EXIF is whole: only its pixels end early. It is looked at when the camera is done."""
    seen: list[str] = []

    def opens(path: Path) -> str:
        seen.append(path.name)
        return (
            "its pixels end later"
            if seen.count("01_0.5s.dng") == 1 and path.name == "01_0.5s.dng"
            else ""
        )

    events = site.run(check_opens=opens)
    assert site.outcomes() == ["done"] * 3 and events.count("retake") == 1
    folder = site.session.raw / site.session.slots()[0].id
    frames = json.loads((folder / "capture.json").read_text())["frames"]
    assert [f["file"] for f in frames] == ["00_1s.dng", "01_0.5s_again.dng", "02_0.25s.dng"]
    assert (folder / "01_0.5s.dng").exists() and "doubt" not in frames[1]


@pytest.mark.contract
def test_pictures_that_nothing_here_reads_are_not_taken_twice_each(site: Field) -> None:
    """A camera newer than LibRaw: one second try, in vain, and every file stays, with what is
    wrong with it.
    """
    site.session = make_session(site.session.root.parent / "one", slots=1)
    events = site.run(check_opens=lambda path: "an unknown format")
    assert (
        site.outcomes() == ["done"] and events.count("retake") == 1 and site.cameras[0].count == 4
    )
    told = next(e for e in read_journal(site.session) if e["event"] == "done")["why"]
    assert told.count("an unknown format") == 3 and "taken again" not in told


@pytest.mark.contract
def test_no_retake_after_the_window(site: Field) -> None:
    camera = SlippingCamera(site.clock, {2})
    site.session = make_session(site.session.root.parent / "one", slots=1)
    events = site.run(replace(FAST, grace_s=4.0), open_cam=lambda: camera, check=doubts)
    assert "retake" not in events and site.outcomes() == ["done"] and camera.count == 3


@pytest.mark.contract
def test_a_camera_that_fails_at_the_retake_costs_nothing(site: Field) -> None:
    camera = SlippingCamera(site.clock, {2})
    whole = camera.expose

    def expose(exposure: Exposure, target: Path, *, heading_deg: float | None = None) -> Path:
        if camera.count == 2:
            camera.count += 1
            raise DeviceError("gone")
        return whole(exposure, target)

    camera.expose = expose
    site.session = make_session(site.session.root.parent / "one", slots=1)
    events = site.run(open_cam=lambda: camera, check=doubts)
    assert "retake" not in events and "device-lost" in events and site.outcomes() == ["done"]


@pytest.mark.contract
def test_full_disk_is_recorded_and_survived(site: Field) -> None:
    def fault(count: int) -> None:
        if count == 5:
            raise OSError(errno.ENOSPC, "No space left on device")

    site.camera_fault = fault
    events = site.run()
    assert site.outcomes() == ["done"] * 3
    assert events.count("disk-full") == 1 and "device-lost" not in events
    assert not (site.session.root / ".reserve").exists()


@pytest.mark.contract
def test_a_disk_that_was_away_costs_its_frames_at_most(
    site: Field, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A share or a stick that is gone for some minutes: rows and events wait in memory, and
    nothing ends.
    """
    away = [T0 + timedelta(hours=1, minutes=-2), T0 + timedelta(hours=1, minutes=20)]
    really = lines.append_durably

    def append(handle: int, data: bytes, *, flush: bool = True) -> None:
        if away[0] <= site.clock.true_utc < away[1]:
            raise OSError(errno.EIO, "Input/output error")
        really(handle, data, flush=flush)

    monkeypatch.setattr(lines, "append_durably", append)
    site.run(replace(FAST, log_around_s=None, log_every_s=30.0))
    assert site.outcomes() == ["done", "aborted", "done"]
    (path,) = day_files(site.session)
    rows = [row.t_utc for row in read_day(path)[0]]
    assert max((b - a).total_seconds() for a, b in pairwise(rows)) < 60.0, "no row is lost"


@pytest.mark.contract
def test_a_moved_folder_and_a_spoilt_day_file_do_not_end_the_log(site: Field) -> None:
    folder, moved = site.session.irradiance, site.session.root / "moved"

    def fault(count: int) -> None:
        if count == 10:
            folder.rename(moved)

    site.pyranometer_fault = fault
    site.clock = FastClock(datetime(2027, 3, 20, 15, 25, tzinfo=UTC))
    site.session = make_session(site.session.root.parent / "days", slots=30)
    folder, moved = site.session.irradiance, site.session.root / "moved"
    site.run(replace(FAST, log_around_s=None, log_every_s=1800.0))
    assert site.outcomes() == ["done"] * 30
    assert [path.stem for path in day_files(site.session)] == ["2027-03-21"] and moved.is_dir()
    days = DayFiles(site.session, flush=False)
    spoilt = site.session.irradiance / "2027-03-21.csv"
    before = (
        spoilt.read_bytes().replace(b",", b";").removesuffix(b"\n")
    )  # as a spreadsheet saves it
    spoilt.write_bytes(before)
    days.append(IrradianceSample(datetime(2027, 3, 21, 23, tzinfo=UTC), 7.0))
    days.close()
    samples, broken = read_day(spoilt)
    assert spoilt.read_bytes().startswith(before) and [row.ghi_wm2 for row in samples] == [7.0]
    assert broken == before.count(b"\n") + 1


@pytest.mark.contract
@pytest.mark.parametrize("trusted", [False, True])
def test_clock_step_keeps_slots_at_the_sun(site: Field, trusted: bool) -> None:
    # Wall clock set back an hour by hand, twenty minutes after the first slot; or by a time server
    # (then it is right).
    site.clock = FastClock(
        T0 - timedelta(minutes=5), [ClockFault(T0 + timedelta(minutes=20), "step", -3600.0)]
    )
    events = site.run(replace(FAST, log_around_s=None, log_every_s=30.0), trusted=trusted)
    steps = [e for e in read_journal(site.session) if e["event"] == "clock-step"]
    assert [(e["seconds"], e["followed"]) for e in steps] == [(-3600.0, trusted)]
    frames = [e["frame"]["t_utc"] for e in read_journal(site.session) if e["event"] == "frame"]
    assert frames == sorted(frames) and events.count("frame") == 9
    end = site.clock.true_utc - T0
    assert end < timedelta(hours=2, minutes=1) if not trusted else end > timedelta(hours=3)


@pytest.mark.contract
def test_suspend_is_told_and_what_it_covered_is_missed(site: Field) -> None:
    site.clock = FastClock(
        T0 - timedelta(minutes=5), [ClockFault(T0 + timedelta(minutes=30), "suspend", 3600.0)]
    )
    site.run(replace(FAST, log_around_s=None, log_every_s=30.0))
    assert [e["seconds"] for e in read_journal(site.session) if e["event"] == "suspend"] == [
        pytest.approx(3600, abs=1)
    ]
    assert site.outcomes() == ["done", "missed", "done"]


@pytest.mark.analytic
def test_time_is_carried_over_a_restart_of_the_same_boot() -> None:
    clock = FastClock(T0)
    first = SteadyClock(clock, lambda: False, boot="b1")
    then, mark = first.now(), first.mark()
    clock.sleep(100.0)
    clock.step(3600.0)
    second = SteadyClock(clock, lambda: False, boot="b1")
    second.carry_on(then, mark)
    assert second.check() == [("clock-step", {"seconds": 3600.0, "followed": False})]
    assert second.now() == T0 + timedelta(seconds=100)
    third = SteadyClock(clock, lambda: False, boot="b2")
    third.carry_on(then, mark)
    assert third.check() == []


@pytest.mark.contract
def test_a_clock_before_the_journal_is_refused(site: Field) -> None:
    site.run()
    site.clock = FastClock(T0 - timedelta(days=400))
    with pytest.raises(DeviceError, match="set the clock"):
        site.run()


@pytest.mark.contract
def test_no_camera_at_the_start_is_said_at_once(site: Field) -> None:
    def refuse() -> TinyCamera:
        raise DeviceError("no camera found")

    with pytest.raises(DeviceError, match="no camera found"):
        site.run(open_cam=refuse)
    assert len(owed(site.session.slots(), fold(read_journal(site.session)))) == 3


@pytest.mark.contract
def test_status_counts_from_files_alone(site: Field) -> None:
    before = status(site.session)
    assert before["capture"]["owed"] == 3 and before["capture"]["next"] == "20270320T153000Z"
    site.run()
    after = status(site.session)
    assert (after["capture"]["done"], after["capture"]["frames"], after["merge"]["owed"]) == (
        3,
        9,
        3,
    )
    assert after["irradiance"]["rows"] == sum(len(read_day(p)[0]) for p in day_files(site.session))


@pytest.mark.contract
def test_threaded_log_runs_beside(tmp_path: Path) -> None:
    from fieldlum.devices.clock import RealClock

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
        clock=RealClock(),
        options=options,
        trusted=lambda: False,
        open_cam=lambda: cameras[0],
        open_pyr=lambda: TinyPyranometer(fast),
    )
    samples = [s for path in day_files(session) for s in read_day(path)[0]]
    assert len(samples) >= 3 and fold(read_journal(session)).slots[slots[0].id].outcome == "done"


@pytest.mark.contract
def test_a_meter_reads_before_and_after_and_may_fail(site: Field) -> None:
    readings = iter([100.0, 110.0, DeviceError("no light"), 90.0, *[95.0] * 20])

    class Meter:
        info = SimpleNamespace(kind="tiny")

        def read(self) -> Any:
            value = next(readings)
            if isinstance(value, DeviceError):
                raise value
            return SimpleNamespace(illuminance_lx=value)

        def close(self) -> None: ...

    site.run(open_met=Meter)
    notes = [json.loads(p.read_text()) for p in sorted(site.session.raw.glob("*/capture.json"))]
    assert [n["illuminance_lx"] for n in notes] == [105.0, 90.0, 95.0]
    assert site.outcomes() == ["done"] * 3


@pytest.mark.contract
def test_a_bracket_that_clips_all_over_is_told_at_once(site: Field) -> None:
    looked: list[str] = []

    def clipped(path: Path) -> str:
        looked.append(path.name)
        return "97 % of the shortest frame is clipped"

    site.run(
        check_shortest=clipped,
        check=lambda path, exposure: "ISO 200 instead of 100" if exposure.shutter_s == 1 else "",
    )
    done = [e for e in read_journal(site.session) if e["event"] == "done"]
    assert looked == ["02_0.25s.dng"] * 3
    assert "00_1s_again.dng: ISO 200" in done[0]["why"] and "97 %" in done[0]["why"]


@pytest.mark.contract
def test_frames_are_checked_against_what_was_asked(tmp_path: Path) -> None:
    import numpy as np

    from fieldlum.capture.verify import bracket_doubts, doubts
    from fieldlum.raw import unreadable, write_dng, write_jpeg

    asked = Exposure(1 / 250, 5.6)
    grey, white = np.full((16, 16, 3), 90, np.uint8), np.full((16, 16, 3), 255, np.uint8)
    write_jpeg(tmp_path / "a.jpg", grey, asked)
    write_jpeg(tmp_path / "b.jpg", white, Exposure(1 / 200, 5.6))
    assert doubts(tmp_path / "a.jpg", asked) == "" == bracket_doubts(tmp_path / "a.jpg")
    assert "shutter 0.005 instead of 0.004" in doubts(tmp_path / "b.jpg", asked)
    assert bracket_doubts(tmp_path / "b.jpg").startswith("100 % of the shortest frame")
    counts = np.full((48, 48), 16383, np.uint16)
    write_dng(tmp_path / "c.dng", counts, asked, black_dn=(64.0,) * 4, white_dn=16383.0)
    assert doubts(tmp_path / "c.dng", asked) == "" and "clipped" in bracket_doubts(
        tmp_path / "c.dng"
    )
    (tmp_path / "d.dng").write_bytes((tmp_path / "c.dng").read_bytes()[:300])
    assert doubts(tmp_path / "d.dng", asked) or bracket_doubts(tmp_path / "d.dng")
    for name in ("a.jpg", "c.dng"):
        whole = (tmp_path / name).read_bytes()
        (tmp_path / f"half_{name}").write_bytes(whole[: len(whole) - len(whole) // 4])
        assert unreadable(tmp_path / name) == "" == doubts(tmp_path / f"half_{name}", asked)
        assert unreadable(tmp_path / f"half_{name}")
    assert unreadable(tmp_path / "gone.dng") == "No such file or directory"


@pytest.mark.contract
def test_a_defect_within_the_log_is_told_once_and_ends_nothing(
    site: Field, monkeypatch: pytest.MonkeyPatch
) -> None:
    from fieldlum.capture.logger import Logger
    from fieldlum.capture.reconnect import Keeper
    from fieldlum.capture.recorder import Recorder

    steady = SteadyClock(site.clock, lambda: False)
    recorder = Recorder(site.session, steady.now, 4096, flush=False)
    keeper: Keeper[Any] = Keeper(
        "pyranometer", lambda: TinyPyranometer(site.clock), steady, recorder.tell, 5.0
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
    assert [e["why"] for e in read_journal(site.session)] == ["ZeroDivisionError: a defect"]


@pytest.mark.contract
def test_log_alone_writes_rows(site: Field) -> None:
    from fieldlum.capture.logger import log

    said: list[str] = []
    rows = log(
        site.session, "sim:office?seed=1", clock=site.clock, every_s=5.0, rows=10, say=said.append
    )
    samples = [s for path in day_files(site.session) for s in read_day(path)[0]]
    assert rows == len(samples) == 10 and said[0].startswith("logging Delta-T SPN1 A1")
    assert site.session.table()["devices"]["pyranometer"]["serial"].startswith("A1")
    site.run()
    assert {"camera", "pyranometer", "uris"} <= set(site.session.table()["devices"])
    assert (samples[-1].t_utc - samples[0].t_utc) == timedelta(seconds=45)


@pytest.mark.contract
def test_commands_exit_as_documented(site: Field, tmp_path: Path) -> None:
    from click.testing import CliRunner

    from fieldlum.cli import main

    def code(*words: str) -> int:
        return CliRunner().invoke(main, [*words]).exit_code

    folder = str(site.session.root)
    assert code("capture", folder) == 2, "no camera named, and none remembered"
    assert code("capture", folder, "--camera", "sim:nowhere", "--clock", "fast") == 4
    assert code("capture", str(tmp_path), "--camera", "sim:office") == 3
    assert code("capture", folder, "--camera", "gphoto:", "--clock", "fast") == 2, (
        "made-up times for real pictures"
    )
    assert (
        code(
            "capture", folder, "--camera", "sim:office", "--meter", "cl200a:COM3", "--clock", "fast"
        )
        == 2
    )
    assert code("log", folder, "--pyranometer", "serial:/dev/no-such-port?kind=spn1") == 4
    assert code("status", str(tmp_path)) == 3
    assert code("pair", folder) == 5, "nothing was logged"
    told = CliRunner().invoke(main, ["status", folder, "--json"])
    assert told.exit_code == 0 and json.loads(told.stdout)["capture"]["owed"] == 3
    assert (
        "0 done, 0 missed, 0 aborted, 3 owed" in CliRunner().invoke(main, ["status", folder]).stdout
    )


@pytest.mark.contract
def test_live_display_and_status_file(site: Field, tmp_path: Path) -> None:
    from rich.console import Console

    from fieldlum.cli.live import countdown, panel, shown

    with shown(site.session.site_file().site, tmp_path / "now.json") as watch:
        run(
            site.session,
            "tiny:",
            clock=site.clock,
            options=FAST,
            watch=watch,
            trusted=lambda: False,
            open_cam=site.open_camera,
            open_pyr=lambda: TinyPyranometer(site.clock),
        )
    table = json.loads((tmp_path / "now.json").read_text())
    assert (table["state"], table["done"], table["left"]) == ("finished", 3, 0)
    site.session = make_session(tmp_path / "again")
    site.clock = FastClock(T0 - timedelta(minutes=5))
    site.run()
    console = Console(record=True, width=66, file=__import__("io").StringIO())
    console.print(panel(site.shown[0], site.session.site_file().site))
    text = console.export_text()
    assert "1 done" in text and "2 left" in text and "W/m²" in text and "PDT" in text
    assert (countdown(59.6), countdown(3725), countdown(None), countdown(-3)) == (
        "01:00",
        "1:02:05",
        "-",
        "00:00",
    )


@pytest.mark.contract
def test_a_defect_in_a_bracket_costs_its_slot_alone(site: Field) -> None:
    def check(path: Path) -> str:
        if "T163000" in str(path):
            raise ZeroDivisionError("a defect")
        return ""

    site.run(check_shortest=check)
    assert site.outcomes() == ["done", "aborted", "done"]
    aborted = next(e for e in read_journal(site.session) if e["event"] == "aborted")
    assert aborted["why"] == "ZeroDivisionError: a defect" and aborted["frames"] == 3


@pytest.mark.contract
def test_disk_full_at_the_very_end_of_a_bracket(
    site: Field, monkeypatch: pytest.MonkeyPatch
) -> None:
    from fieldlum.capture import bracket

    real, calls = bracket.write_capture, []

    def full_once(*args: Any, **kwargs: Any) -> None:
        calls.append(1)
        if len(calls) == 1:
            raise OSError(errno.ENOSPC, "No space left on device")
        real(*args, **kwargs)

    monkeypatch.setattr(bracket, "write_capture", full_once)
    events = site.run()
    assert site.outcomes() == ["done"] * 3 and events.count("disk-full") == 1
