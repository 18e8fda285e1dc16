"""The loop of a capture: wait for a slot, take its bracket, continue after every failure."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import nullcontext, suppress
from datetime import datetime, timedelta
from shutil import disk_usage
from typing import Any

from fieldlum.capture.alerts import MissedHook
from fieldlum.capture.bracket import NO_CHECKS, BracketCapture, FrameChecks, shots
from fieldlum.capture.live import Live, Watch, no_display
from fieldlum.capture.logger import Logger
from fieldlum.capture.options import DEFAULTS, Options
from fieldlum.capture.preflight import (
    refuse_a_clock_behind,
    refuse_a_past_plan,
    refuse_what_is_not_offered,
)
from fieldlum.capture.reconnect import Keeper, error_text, plain_info
from fieldlum.capture.recorder import Listen, Recorder, no_listener
from fieldlum.capture.utc_clock import SteadyClock
from fieldlum.core.errors import InputError
from fieldlum.core.records import Slot, parse_utc
from fieldlum.devices import (
    Camera,
    IlluminanceMeter,
    Pyranometer,
    open_camera,
    open_meter,
    open_pyranometer,
)
from fieldlum.devices.clock import Clock, synchronised
from fieldlum.session import (
    Session,
    disk_is_full,
    paused_until,
    sole_user,
    store_grace,
    update_session,
)
from fieldlum.session.files.capture_json import Frame
from fieldlum.session.ledger import Ledger, SlotState, read_ledger, slots_to_do
from fieldlum.session.tables import DevicesTable, DeviceTable
from fieldlum.version import __version__


def run(
    session: Session,
    camera_uri: str,
    pyranometer_uri: str = "",
    *,
    clock: Clock,
    options: Options = DEFAULTS,
    watch: Watch = no_display,
    checks: FrameChecks = NO_CHECKS,
    meter_uri: str = "",
    trusted: Callable[[], bool | None] = synchronised,
    listen: Listen = no_listener,
    open_cam: Callable[[], Camera] | None = None,
    open_pyr: Callable[[], Pyranometer] | None = None,
    open_met: Callable[[], IlluminanceMeter] | None = None,
) -> Ledger:
    """Take all brackets that are due; return when every slot of the plan has an outcome.

    Return the state of all slots. `watch` is called with the state of the capture, `listen` with
    each journal event; both must return at once. checks: of new frames. `open_cam`, `open_pyr` and
    `open_met` replace what the URIs open. Raises DeviceError if the camera cannot be set to a
    planned exposure, or the clock is before the last journal entry; the error of opening a device
    at the start, unless it is an instrument that an earlier capture of the session used; InputError
    if another process captures, imports or, with a pyranometer, logs in the session;
    NotEnoughDataError if every slot is past and none was begun, or if no slot has an exposure.
    """
    logs = open_pyr is not None or bool(pyranometer_uri)
    with sole_user(session, "capture"), sole_user(session, "log") if logs else nullcontext():
        steady = SteadyClock(clock, trusted, options.boot)
        runner = _Runner(session, steady, options, watch, checks, listen)
        try:
            runner.open(
                open_cam or (lambda: open_camera(camera_uri, clock=clock, session=session)),
                open_pyr
                or (
                    (lambda: open_pyranometer(pyranometer_uri, clock=clock, session=session))
                    if pyranometer_uri
                    else None
                ),
                open_met or ((lambda: open_meter(meter_uri, clock=clock)) if meter_uri else None),
                {"camera": camera_uri, "pyranometer": pyranometer_uri, "meter": meter_uri},
            )
            runner.work()
        finally:
            runner.close()
    return read_ledger(session)


class _Runner:
    def __init__(
        self,
        session: Session,
        clock: SteadyClock,
        options: Options,
        watch: Watch,
        checks: FrameChecks,
        listen: Listen = no_listener,
    ) -> None:
        self.session, self.clock, self.options, self.watch = session, clock, options, watch
        self.checks = checks
        self.setup = session.site_file()
        self._plan_stamp = 0
        self._plan_stamp = self._stamp()
        self.slots = session.slots()
        before = read_ledger(session)
        self.states = before.slots
        if before.last_utc is not None:
            if before.opened is not None:
                clock.carry_on(parse_utc(before.opened["t_utc"]), before.opened)
            refuse_a_clock_behind(clock.now(), before.last_utc)
        refuse_a_past_plan(self.slots, before, clock.now(), timedelta(seconds=options.grace_s))
        self.recorder = Recorder(
            session, clock.now, options.reserve_bytes, flush=options.flush, listen=listen
        )
        self.hook = MissedHook(options.on_misses, session.root, self.recorder)
        self.camera: Keeper[Camera] | None = None
        self.logger: Logger | None = None
        self.meter: Keeper[IlluminanceMeter] | None = None
        self.frame_bytes, self.bytes_per_slot = 0, 0.0
        self.last_frame = ""
        begun = [slot for slot in self.slots if self.states.get(slot.id, SlotState()).frames]
        if begun:
            self._learn_sizes(begun[-1], self.states[begun[-1].id])
        self._watched = True
        self._state, self._next, self._paused_slot = "waiting", "", ""

    def open(
        self,
        open_cam: Callable[[], Camera],
        open_pyr: Callable[[], Pyranometer] | None,
        open_met: Callable[[], IlluminanceMeter] | None,
        uris: dict[str, str],
    ) -> None:
        """Open all devices, or raise DeviceError for a missing one.

        When a capture is started again, an instrument that answered before may be missing for a
        while: the brackets do not wait for it.
        """
        options = self.options
        rest = self.clock, self.recorder.tell, options.watchdog_s
        self.camera = Keeper("camera", open_cam, *rest)
        about: DevicesTable = {"uris": uris}
        camera = self.camera.open_or_raise()
        refuse_what_is_not_offered(camera, self.slots, self.states)
        about["camera"] = plain_info(camera.info)
        if open_pyr is not None:
            keeper = Keeper("pyranometer", open_pyr, *rest)
            if info := self._open_or_raise(keeper, uris):
                about["pyranometer"] = info
            self.logger = Logger(keeper, self.recorder, self.clock, options.log_every_s)
        if open_met is not None:
            self.meter = Keeper("meter", open_met, *rest)
            if info := self._open_or_raise(self.meter, uris):
                about["meter"] = info
        self.recorder.tell(
            "open",
            **self.clock.mark(),
            pid=os.getpid(),
            fieldlum=__version__,
            cut_bytes=self.recorder.journal.cut_bytes,
        )
        self.recorder.tell_all(self.clock.check())
        try:
            devices = self.session.table().get("devices", {})
            update_session(self.session, {"devices": {**devices, **about}})
            store_grace(self.session, options.grace_s)
        except OSError as error:
            if not disk_is_full(error):
                raise
        if self.logger is not None and options.threaded:
            self.logger.start()

    def _open_or_raise(self, keeper: Keeper[Any], uris: dict[str, str]) -> DeviceTable:
        """Return the instrument's information; empty if it is away but answered before."""
        devices = self.session.table().get("devices", {})
        try:
            return plain_info(keeper.open_or_raise().info)
        except Exception as error:
            answered_before = keeper.name in devices
            if not answered_before or devices.get("uris", {}).get(keeper.name) != uris[keeper.name]:
                raise
            keeper.lost(error)
            return {}

    def work(self) -> None:
        assert self.camera is not None
        bracket = BracketCapture(
            self.session,
            self.setup.camera,
            self.camera,
            self.recorder,
            self.clock,
            self.checks,
            self._between,
            self.meter,
            self.frame_bytes,
        )
        grace = timedelta(seconds=self.options.grace_s)
        while (slot := self._next_to_do()) is not None:
            state = self.states.get(slot.id, SlotState())
            self._state, self._next = "waiting", slot.id
            if not self._wait_until(slot.t_utc):
                continue
            late_s = (self.clock.now() - slot.t_utc).total_seconds()
            if late_s <= self.options.grace_s and self._is_paused(state):
                self._state, self._paused_slot = "paused", slot.id
                self._sleep_until(self.clock.now() + timedelta(seconds=1), log=True)
                continue
            if late_s > self.options.grace_s and not (
                state.outcome == "started" and bracket.resumable(slot, state)
            ):
                state = self._too_late(bracket, slot, state, late_s)
            else:
                self._state = "capturing"
                self.recorder.refill()
                if late_s > 10.0 and state.outcome == "":
                    self.recorder.tell("late", slot=slot.id, by_s=round(late_s, 1))
                state = self._take(bracket, slot, state, slot.t_utc + grace)
                self._after_bracket(slot, state)
            self.states[slot.id] = state
            self.hook.count(slot.id, state)
            following = self._next_to_do()
            self._state, self._next = "waiting", following.id if following else ""
            self._show()
        self._state, self._next = "finished", ""
        self._show()

    def _is_paused(self, state: SlotState) -> bool:
        """Return whether the user paused the capture.

        A bracket that has begun is still finished.
        """
        now = self.clock.now()
        return state.outcome != "started" and paused_until(self.session, now) is not None

    def _next_to_do(self) -> Slot | None:
        """Return the next slot without an outcome; the plan may have changed during the capture."""
        if self._plan_changed():
            self._plan_stamp = self._stamp()
            with suppress(InputError, OSError):
                slots = self.session.slots()
                # A new plan removes no slot, but a damaged file would: then the earlier plan
                # remains.
                if {slot.id for slot in self.slots} <= {slot.id for slot in slots}:
                    self.slots = slots
        return next(iter(slots_to_do(self.slots, Ledger(dict(self.states)))), None)

    def _plan_changed(self) -> bool:
        return self._stamp() != self._plan_stamp

    def _stamp(self) -> int:
        try:
            return self.session.plan.stat().st_mtime_ns
        except OSError:
            return self._plan_stamp

    def _take(
        self, bracket: BracketCapture, slot: Slot, state: SlotState, deadline: datetime
    ) -> SlotState:
        """Take a bracket; any failure affects this slot only."""
        try:
            return bracket.take(slot, state, deadline)
        except Exception as error:
            latest = state
            with suppress(OSError):
                latest = read_ledger(self.session).slots.get(slot.id, state)
            return bracket.abort(slot, latest, error_text(error))

    def _too_late(
        self, bracket: BracketCapture, slot: Slot, state: SlotState, late_s: float
    ) -> SlotState:
        if state.outcome == "started":
            why = (
                f"interrupted, and not finished when the slot's window closed (now {late_s:.0f} s "
                "late)"
            )
            return bracket.abort(slot, state, why)
        paused = ", because the capture was paused" if self._paused_slot == slot.id else ""
        self.recorder.tell("missed", slot=slot.id, why=f"late by {late_s:.0f} s{paused}")
        return SlotState("missed", why=f"late{paused}")

    def _after_bracket(self, slot: Slot, state: SlotState) -> None:
        """Log one more row, so that rows surround the bracket; measure the bracket's size."""
        if self.logger is not None and not self.options.threaded:
            self.clock.sleep(self.logger.due_in_s)
            self.logger.poll_if_due()
        self._learn_sizes(slot, state)

    def _learn_sizes(self, slot: Slot, state: SlotState) -> None:
        sizes: list[int] = []
        with suppress(OSError):
            folder = self.session.capture_file(slot.id).parent
            paths = [folder / frame.file for frame in state.frames]
            sizes = [path.stat().st_size for path in paths if path.is_file()]
        if sizes:
            self.frame_bytes = max(sizes)
            count = len(shots(slot.exposures, self.setup.camera))
            self.bytes_per_slot = sum(sizes) / len(sizes) * count

    def _wait_until(self, t_utc: datetime) -> bool:
        """Wait until a time; return False if the plan changed before that time."""
        around = self.options.log_around_s
        if around is not None and self.logger is not None:
            self._sleep_until(t_utc - timedelta(seconds=around), log=False)
        return self._sleep_until(t_utc, log=True)

    def _sleep_until(self, t_utc: datetime, *, log: bool) -> bool:
        inline = self.logger if log and not self.options.threaded else None
        while not self._plan_changed():
            self.recorder.tell_all(self.clock.check())
            wait_s = (t_utc - self.clock.now()).total_seconds()
            if wait_s <= 0:
                return True
            if inline is not None:
                inline.poll_if_due()
                wait_s = min(wait_s, max(inline.due_in_s, 0.01))
            if self.options.threaded:
                wait_s = min(wait_s, 1.0)
                self._show()
            if self.camera is not None and wait_s <= 60.0:
                self.camera.get()  # reopen a lost camera before its slot, if possible
            self.clock.sleep(wait_s)
        return False

    def _between(self, frame: Frame | None) -> None:
        if frame is not None:
            self.last_frame = f"{frame.file} {frame.doubt}".strip()
        if self.logger is not None and not self.options.threaded:
            self.logger.poll_if_due()
        if self.options.threaded:
            self._show()

    def _show(self) -> None:
        """Update the display; continue without a display if it fails.

        Causes are a closed terminal, a pipe without a reader, a network share that is away.
        """
        try:
            self.watch(self.live())
        except Exception as error:
            if self._watched:
                self._watched = False
                self.recorder.tell("display-lost", why=error_text(error))

    def live(self) -> Live:
        outcomes = [state.outcome for state in self.states.values()]
        done_count, missed, aborted = (outcomes.count(o) for o in ("done", "missed", "aborted"))
        to_do = len(self.slots) - done_count - missed - aborted
        now = self.clock.now()
        upcoming = next((s for s in self.slots if s.id == self._next), None)
        sample = self.logger.last if self.logger else None
        free = disk_usage(self.session.root).free
        days = max(1, len({slot.t_utc.date() for slot in self.slots}))
        per_day = self.bytes_per_slot * len(self.slots) / days
        return Live(
            self._state,
            now,
            len(self.slots),
            done_count,
            missed,
            aborted,
            to_do,
            self._next,
            (upcoming.t_utc - now).total_seconds() if upcoming else None,
            self.last_frame,
            sample.ghi_wm2 if sample else None,
            (now - sample.t_utc).total_seconds() if sample else None,
            self.camera.state if self.camera else "",
            self.logger.keeper.state if self.logger else "",
            free,
            self.recorder.missing_bytes(self.bytes_per_slot),
            free / per_day if per_day else None,
            self.recorder.last_event,
        )

    def close(self) -> None:
        if self.logger is not None:
            self.logger.close()
        if self.meter is not None:
            self.meter.close()
        if self.camera is not None:
            self.camera.close()
            self.recorder.tell("close", state=self._state)
        self.recorder.close()
