"""Capture: slots of a changed plan, late starts, and clocks that step or stop."""

from __future__ import annotations

import json
from contextlib import nullcontext
from dataclasses import replace
from datetime import timedelta

import pytest
from faulty_clock import FaultyClock
from tiny_field import FAST, T0, Field, TinyCamera

from fieldlum.capture.runner import Live, refuse_early_clock, refuse_unavailable_exposures, run
from fieldlum.capture.steady_clock import SteadyClock
from fieldlum.core.errors import DeviceError, NotEnoughDataError
from fieldlum.core.records import Exposure
from fieldlum.devices.clock import FastClock
from fieldlum.session import (
    read_journal,
    write_plan,
)
from fieldlum.session.slot_states import SlotState


@pytest.mark.contract
@pytest.mark.filterwarnings("ignore::fieldlum.core.errors.ChangedFileWarning")
def test_slots_that_a_replan_adds_to_a_running_capture_are_taken(rig: Field) -> None:
    """One before the slot that is waited for, one after the last."""
    plan, end = rig.session.slots(), T0 + timedelta(hours=2)
    between, after = (
        replace(plan[0], t_utc=t) for t in (end - timedelta(minutes=30), end + timedelta(days=20))
    )

    def watch(live: Live) -> None:
        if live.done == 2 and len(rig.session.slots()) == 3:
            slots = sorted([*plan, between, after], key=lambda slot: slot.t_utc)
            write_plan(rig.session.plan, slots, "America/Los_Angeles")

    run(
        rig.session,
        "tiny:",
        clock=rig.clock,
        options=FAST,
        watch=watch,
        trusted=lambda: False,
        open_cam=rig.open_camera,
    )
    done = [event["slot"] for event in read_journal(rig.session) if event["event"] == "done"]
    assert done == [plan[0].id, plan[1].id, between.id, plan[2].id, after.id]


@pytest.mark.contract
def test_a_broken_plan_does_not_stop_a_running_capture(rig: Field) -> None:
    def watch(live: Live) -> None:
        if live.done == 1:
            rig.session.plan.write_text("spoilt by a spreadsheet")

    run(
        rig.session,
        "tiny:",
        clock=rig.clock,
        options=FAST,
        watch=watch,
        trusted=lambda: False,
        open_cam=rig.open_camera,
    )
    assert [event["event"] for event in read_journal(rig.session)].count("done") == 3


@pytest.mark.contract
def test_late_is_missed_never_a_burst(rig: Field) -> None:
    rig.clock = FastClock(T0 + timedelta(hours=1, minutes=4))
    rig.run()
    assert rig.outcomes() == ["missed", "done", "done"]
    late = [e for e in read_journal(rig.session) if e["event"] == "late"]
    assert [e["by_s"] for e in late] == [240.0]


@pytest.mark.contract
def test_a_plan_that_the_camera_cannot_take_is_refused_at_the_start(rig: Field) -> None:
    """Later it is not: a dial that somebody turned may be turned back."""

    class Choosy(TinyCamera):
        def check_offered(self, exposure: Exposure) -> None:
            if exposure.shutter_s < 0.4:
                raise DeviceError("camera shutter: 0.25 s is not offered, the nearest is 1/2")

    with pytest.raises(
        DeviceError, match=r"1 exposures of the plan that the camera cannot be set to: .*0.25 s"
    ):
        rig.run(open_cam=lambda: Choosy(rig.clock))
    assert {event["event"] for event in read_journal(rig.session)} == {"close"}
    slots = rig.session.slots()
    begun = {slots[0].id: SlotState("done")}
    refuse_unavailable_exposures(Choosy(rig.clock), slots, begun)


@pytest.mark.contract
def test_a_plan_that_is_past_is_refused_and_nothing_is_called_missed(rig: Field) -> None:
    rig.clock = FastClock(T0 + timedelta(days=30))
    with pytest.raises(
        NotEnoughDataError, match=r"the plan has no slot left: the last was 2027-03-20 17:30 UTC"
    ):
        rig.run()
    assert read_journal(rig.session) == []


@pytest.mark.contract
def test_a_long_pause_starts_the_bracket_anew(rig: Field) -> None:
    def fault(count: int) -> None:
        if count == 3:
            rig.clock.sleep(90.0)
            raise DeviceError("slept")

    rig.camera_fault = fault
    rig.run()
    assert rig.outcomes() == ["done"] * 3
    folder = rig.session.raw / "20270320T153000Z"
    assert len(list((folder / "attempt-1").iterdir())) == 2
    assert len(json.loads((folder / "capture.json").read_text())["frames"]) == 3


@pytest.mark.contract
@pytest.mark.parametrize("trusted", [False, True])
def test_clock_step_keeps_slots_at_the_sun(rig: Field, trusted: bool) -> None:
    # Wall clock set back an hour by hand, twenty minutes after the first slot; or by a time server
    # (then it is right).
    rig.clock = FaultyClock(
        T0 - timedelta(minutes=5), [(T0 + timedelta(minutes=20), "step", -3600.0)]
    )
    events = rig.run(replace(FAST, log_around_s=None, log_every_s=30.0), trusted=trusted)
    steps = [e for e in read_journal(rig.session) if e["event"] == "clock-step"]
    assert [(e["seconds"], e["followed"]) for e in steps] == [(-3600.0, trusted)]
    frames = [e["frame"]["t_utc"] for e in read_journal(rig.session) if e["event"] == "frame"]
    assert frames == sorted(frames) and events.count("frame") == 9
    end = rig.clock.true_utc - T0
    assert end < timedelta(hours=2, minutes=1) if not trusted else end > timedelta(hours=3)


@pytest.mark.contract
def test_suspend_is_told_and_what_it_covered_is_missed(rig: Field) -> None:
    rig.clock = FaultyClock(
        T0 - timedelta(minutes=5), [(T0 + timedelta(minutes=30), "suspend", 3600.0)]
    )
    rig.run(replace(FAST, log_around_s=None, log_every_s=30.0))
    assert [e["seconds"] for e in read_journal(rig.session) if e["event"] == "suspend"] == [
        pytest.approx(3600, abs=1)
    ]
    assert rig.outcomes() == ["done", "missed", "done"]


@pytest.mark.analytic
def test_time_is_carried_over_a_restart_of_the_same_boot() -> None:
    clock = FaultyClock(T0)
    first = SteadyClock(clock, lambda: False, boot="b1")
    then, mark = first.now(), first.mark()
    clock.sleep(100.0)
    clock.step(3600.0)
    second = SteadyClock(clock, lambda: False, boot="b1")
    second.continue_from(then, mark)
    assert second.check() == [("clock-step", {"seconds": 3600.0, "followed": False})]
    assert second.now() == T0 + timedelta(seconds=100)
    third = SteadyClock(clock, lambda: False, boot="b2")
    third.continue_from(then, mark)
    assert third.check() == []


@pytest.mark.analytic
def test_drift_is_followed_again_after_a_step_was_undone() -> None:
    clock = FaultyClock(T0)
    steady = SteadyClock(clock, lambda: False)
    for seconds in (3600.0, -3600.5):
        clock.step(seconds)
        assert [name for name, _ in steady.check()] == ["clock-step"]
    assert steady.now() == T0
    assert steady.check() == []
    assert steady.now() == T0 - timedelta(seconds=0.5)


@pytest.mark.contract
def test_a_clock_before_the_journal_is_refused(rig: Field) -> None:
    rig.run()
    rig.clock = FastClock(T0 - timedelta(days=400))
    with pytest.raises(DeviceError, match="set the clock"):
        rig.run()


@pytest.mark.analytic
@pytest.mark.parametrize(("behind_s", "refused"), [(-60.0, False), (1.9, False), (2.1, True)])
def test_two_seconds_before_the_journal_are_tolerated(behind_s: float, refused: bool) -> None:
    now = T0 - timedelta(seconds=behind_s)
    with pytest.raises(DeviceError, match="set the clock") if refused else nullcontext():
        refuse_early_clock(now, T0)


@pytest.mark.contract
@pytest.mark.filterwarnings("ignore::fieldlum.core.errors.ChangedFileWarning")
def test_slots_without_exposures_are_refused_at_the_start(rig: Field) -> None:
    """A session of random hours of a year has no brackets to take."""
    slots = [replace(slot, exposures=()) for slot in rig.session.slots()]
    write_plan(rig.session.plan, slots, "UTC")
    with pytest.raises(NotEnoughDataError, match="no slot of the plan has an exposure"):
        rig.run()
    assert "aborted" not in [row["event"] for row in read_journal(rig.session)]
