"""The loop of a capture: wait for a slot, take its bracket, continue after every failure."""

import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, nullcontext, suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import partial
from shutil import disk_usage
from typing import Any, NamedTuple

from fieldlum import devices
from fieldlum.capture.bracket import NO_CHECKS, BracketCapture, FrameChecks, frame_requests
from fieldlum.capture.disk_writer import RESERVE_BYTES, Listen, Recorder
from fieldlum.capture.irradiance_log import Logger
from fieldlum.capture.reconnect import Keeper, error_text, plain_info
from fieldlum.capture.steady_clock import SteadyClock, boot_id, synchronised
from fieldlum.core.errors import DeviceError, InputError, NotEnoughDataError
from fieldlum.core.records import Slot, parse_utc
from fieldlum.devices.clock import Clock, FastClock
from fieldlum.session import DEFAULT_GRACE_S, Session, disk_is_full, slot_states, sole_user
from fieldlum.session.files.capture_json import Frame
from fieldlum.session.folder import DevicesTable, store_grace, update_session
from fieldlum.session.plan_file import read_plan
from fieldlum.sky.sun import standard_date
from fieldlum.version import __version__


class Live(NamedTuple):
    """State of a running capture, for the display and for alerts.

    state: waiting, capturing or finished. t_utc: time of this state. planned, done, missed,
    aborted, left: numbers of slots, of which `left` are still to capture. next_slot: id, "" without
    one; next_in_s: time until its start [s], negative after it. last_frame: file of the newest
    frame, and the doubt about it. ghi_wm2, ghi_age_s: newest global irradiance [W/m2], and its age
    [s]. camera, pyranometer: ok, closed or lost, "" without a pyranometer. bytes_free: on the
    session's disk. disk_days: days of captures that fit on the disk. last_event: newest event of
    the journal, or a fault of the disk. None: unknown.
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
    disk_days: float | None
    last_event: str


Watch = Callable[[Live], None]


@dataclass(frozen=True, slots=True)
class Options:
    """Settings of a running capture that are not in the plan: times, watchdog, disk.

    grace_s: how late a bracket may start; after that its slot is missed. log_every_s: time between
    readings of irradiance. log_around_s: log irradiance only from this time before a slot, in
    simulated time; None: always. threaded: whether the log has its own thread; else the loop polls,
    as a simulated clock requires. watchdog_s: a device that does not answer for longer is closed
    and reopened. reserve_bytes: disk space for journal and rows. flush: with False, files survive a
    killed process but not a power cut. boot: identifies the computer's boot, to detect a clock step
    after a restart.
    """

    grace_s: float = DEFAULT_GRACE_S
    log_every_s: float = 5.0
    log_around_s: float | None = None
    threaded: bool = True
    watchdog_s: float = 60.0
    reserve_bytes: int = RESERVE_BYTES
    flush: bool = True
    boot: str = ""


DEFAULTS = Options()


def prepare(session: Session, *, fast: bool) -> tuple[Clock, Options]:
    """Return the clock and the options of a capture.

    fast: whether time is simulated. The clock then jumps from slot to slot; it starts where the
    journal ends, or, without an event, a minute before the first slot. Raises InputError for a plan
    or session.toml that cannot be used.
    """
    grace_s = session.grace.total_seconds()
    if not fast:
        return Clock(), Options(grace_s=grace_s, boot=boot_id())
    states = slot_states.read_slot_states(session)
    slots = slot_states.slots_to_do(session.slots(), states)
    first = slots[0].t_utc - timedelta(seconds=60) if slots else datetime.now(UTC)
    # 20 s: four rows of irradiance before a slot. 3600 s: a simulated device that takes long is not
    # hung, but computes.
    options = Options(grace_s, log_around_s=20.0, threaded=False, watchdog_s=3600.0, flush=False)
    return FastClock(states.last_utc or first), options


def run(
    session: Session,
    camera_uri: str,
    pyranometer_uri: str = "",
    *,
    clock: Clock,
    options: Options = DEFAULTS,
    watch: Watch = lambda live: None,
    checks: FrameChecks = NO_CHECKS,
    meter_uri: str = "",
    trusted: Callable[[], bool | None] = synchronised,
    listen: Listen = lambda event, t_utc, fields: None,
    open_cam: Callable[[], devices.Camera] | None = None,
    open_pyr: Callable[[], devices.Pyranometer] | None = None,
    open_met: Callable[[], devices.IlluminanceMeter] | None = None,
) -> slot_states.SlotStates:
    """Take the bracket of each slot until every slot has an outcome; return the slots' states.

    camera_uri, pyranometer_uri, meter_uri: addresses such as gphoto: or serial:/dev/ttyUSB0; the
    last two "" for none. `watch` is called with the state of the capture, `listen` with each
    journal event; both must return at once. checks: of new frames. trusted: returns whether a time
    server controls the clock, None if unknown. `open_cam`, `open_pyr` and `open_met` replace what
    the URIs open.

    Raises DeviceError if the camera cannot be set to a planned exposure, or the clock is before the
    last journal entry; the error of opening a device at the start, unless it is an instrument that
    an earlier capture of the session used; InputError if another process captures, imports or, with
    a pyranometer, logs in the session; NotEnoughDataError if every slot is past and none was begun,
    or if no slot has an exposure.
    """
    uris = {"camera": camera_uri, "pyranometer": pyranometer_uri, "meter": meter_uri}
    how: dict[str, Any] = {"clock": clock, "session": session}
    openers: dict[str, Callable[[], devices.Device]] = {}
    openers["camera"] = open_cam or partial(devices.open_camera, camera_uri, **how)
    if pyranometer_uri or open_pyr:
        own = partial(devices.open_pyranometer, pyranometer_uri, **how)
        openers["pyranometer"] = open_pyr or own
    if meter_uri or open_met:
        openers["meter"] = open_met or partial(devices.open_meter, meter_uri, **how)
    logs = sole_user(session, "log") if "pyranometer" in openers else nullcontext()
    with sole_user(session, "capture"), logs:
        steady = SteadyClock(clock, trusted, options.boot)
        runner = _Runner(session, steady, options, watch, checks, listen, openers)
        with closing(runner):
            runner.open(uris)
            runner.work()
    return slot_states.read_slot_states(session)


def refuse_early_clock(now_utc: datetime, last_utc: datetime) -> None:
    """Raise DeviceError if the clock's time is over 2 s before that of the last journal entry."""
    if now_utc < last_utc - timedelta(seconds=2):
        found = f"this computer's clock shows {now_utc:%Y-%m-%d %H:%M:%S} UTC"
        last = f"before the last journal entry ({last_utc:%Y-%m-%d %H:%M:%S})"
        remedy = "set the clock, or state --clock fast again for a simulated capture"
        raise DeviceError(f"{found}, {last}: {remedy}")


def refuse_past_plan(
    slots: Sequence[Slot], before: slot_states.SlotStates, now_utc: datetime, grace: timedelta
) -> None:
    """Raise NotEnoughDataError if every slot is past and the journal has no event of a slot.

    The cause is an old plan, or a clock that is fast; all slots would be journalled as missed.
    before: states by the journal; grace: how late a bracket may start.
    """
    last = max((slot.t_utc for slot in slots), default=now_utc)
    if not before.slots and last + grace < now_utc:
        found = f"the last was {last:%Y-%m-%d %H:%M} UTC, and it is {now_utc:%Y-%m-%d %H:%M} UTC"
        remedy = "correct the clock, or plan them again with fieldlum plan SESSION --replan"
        raise NotEnoughDataError(f"the plan has no slot left: {found}; {remedy}")


def refuse_unavailable_exposures(
    camera: devices.Camera, slots: Sequence[Slot], states: Mapping[str, slot_states.SlotState]
) -> None:
    """Raise DeviceError if the camera cannot be set to some planned exposures.

    states: of the slots, by id. After the first complete bracket nothing is checked: the cause may
    then be a turned dial, which can be turned back. Raises NotEnoughDataError if no slot has an
    exposure.
    """
    if any(state.outcome == "done" for state in states.values()):
        return
    empty = [slot.id for slot in slots if not slot.exposures]
    if len(empty) == len(slots) and empty:  # `simulate --count` plans hours without exposures
        found = f"no slot of the plan has an exposure (first slot: {empty[0]})"
        raise NotEnoughDataError(f"{found}; plan a new session with fieldlum plan")
    exposures = dict.fromkeys(e for slot in slots for e in slot.exposures)
    if refused := devices.not_offered(camera, exposures):
        found = f"{len(refused)} exposures of the plan that the camera cannot be set to"
        raise DeviceError(f"{found}: {refused[0]}; run fieldlum doctor")


@dataclass
class _Runner:
    """A running capture: its plan, the slots' states, the devices and the journal.

    openers: what opens each device, by name: camera, pyranometer, meter.
    """

    session: Session
    clock: SteadyClock
    options: Options
    watch: Watch
    checks: FrameChecks
    listen: Listen
    openers: Mapping[str, Callable[[], devices.Device]]

    def __post_init__(self) -> None:
        """Read plan and journal, refuse a wrong clock and a past plan, and prepare the devices."""
        session, clock, options = self.session, self.clock, self.options
        self.setup = session.site_file()
        self._plan_stamp_ns = 0
        # before the plan is read, so that no change is missed
        self._plan_stamp_ns = self._plan_time_ns()
        self.slots = session.slots()
        self.states = before = slot_states.read_slot_states(session)
        if before.last_utc is not None:
            if before.last_open is not None:
                clock.continue_from(parse_utc(before.last_open["t_utc"]), before.last_open)
            refuse_early_clock(clock.now(), before.last_utc)
        refuse_past_plan(self.slots, before, clock.now(), timedelta(seconds=options.grace_s))
        self.recorder = Recorder(
            session, clock.now, options.reserve_bytes, flush=options.flush, listen=self.listen
        )
        common = (clock, self.recorder.write_event, options.watchdog_s)
        keepers = {k: Keeper[Any](k, opener, *common) for k, opener in self.openers.items()}
        self.camera: Keeper[devices.Camera] = keepers["camera"]
        self.meter: Keeper[devices.IlluminanceMeter] | None = keepers.get("meter")
        self.logger: Logger | None = None
        if pyranometer := keepers.get("pyranometer"):
            self.logger = Logger(pyranometer, self.recorder, clock, options.log_every_s)
        self.bytes_per_slot, self.last_frame = session.slot_bytes(), ""
        frame_counts = [len(frame_requests(s.exposures, self.setup.camera)) for s in self.slots]
        self.frame_bytes = round(self.bytes_per_slot / (max(frame_counts, default=0) or 1))
        self._state, self._next = "waiting", self._next_to_do()

    def open(self, uris: dict[str, str]) -> None:
        """Open all devices, store what they are in session.toml, and start the log.

        uris: of the devices, by name. Raises the error of opening a device. When a capture is
        started again, an instrument that answered before may be missing for a while: the brackets
        do not wait for it.
        """
        camera = self.camera.open_or_raise()
        refuse_unavailable_exposures(camera, self.slots, self.states.slots)
        about: DevicesTable = {"uris": uris, "camera": plain_info(camera.info)}
        for keeper in (self.logger and self.logger.keeper, self.meter):
            if keeper is not None:
                self._open_instrument(keeper, about)
        process = {"pid": os.getpid(), "fieldlum": __version__}
        cut_bytes = self.recorder.journal.cut_bytes
        self.recorder.write_event("open", **self.clock.mark(), **process, cut_bytes=cut_bytes)
        self.recorder.write_events(self.clock.check())
        try:
            before = self.session.table().get("devices", {})
            update_session(self.session, {"devices": {**before, **about}})
            store_grace(self.session, self.options.grace_s)
        except OSError as error:
            if not disk_is_full(error):
                raise
        if self.logger is not None and self.options.threaded:
            self.logger.start()

    def _open_instrument(self, keeper: Keeper[Any], about: DevicesTable) -> None:
        """Open an instrument and add its information to `about`.

        Raises the error of opening it, unless an earlier capture used the same one.
        """
        before, name = self.session.table().get("devices", {}), keeper.name
        try:
            about[name] = plain_info(keeper.open_or_raise().info)
        except Exception as error:
            is_same = before.get("uris", {}).get(name) == about.get("uris", {}).get(name)
            if not (name in before and is_same):
                raise
            keeper.mark_lost(error)

    def work(self) -> None:
        """Wait for each slot and take its bracket, until every slot has an outcome."""
        while (slot := self._next) is not None:
            around_s = self.options.log_around_s
            if around_s is not None and self.logger is not None:
                self._sleep_until(slot.t_utc - timedelta(seconds=around_s), log=False)
            if not self._sleep_until(slot.t_utc):
                self._next = self._next_to_do()
                continue
            state = self.states.state(slot.id)
            late_s = (self.clock.now() - slot.t_utc).total_seconds()
            bracket = self._bracket(slot, state)
            can_resume = state.outcome == "started" and bracket.resumable()
            if late_s > self.options.grace_s and not can_resume:
                state = self._too_late(bracket, late_s)
            else:
                state = self._take(bracket, late_s)
            self.states.slots[slot.id] = state
            self._state, self._next = "waiting", self._next_to_do()
            self._show()
        self._state = "finished"
        self._show()

    def _bracket(self, slot: Slot, state: slot_states.SlotState) -> BracketCapture:
        """Return what takes the missing frames of a slot; state: of the slot, by the journal."""
        return BracketCapture(
            session=self.session,
            setup=self.setup.camera,
            camera=self.camera,
            recorder=self.recorder,
            clock=self.clock,
            checks=self.checks,
            between=self._between,
            meter=self.meter,
            frame_bytes=self.frame_bytes,
            slot=slot,
            state=state,
            deadline=slot.t_utc + timedelta(seconds=self.options.grace_s),
        )

    def _next_to_do(self) -> Slot | None:
        """Return the next slot without an outcome; the plan may have changed during the capture."""
        if self._plan_time_ns() != self._plan_stamp_ns:
            self._plan_stamp_ns = self._plan_time_ns()
            with suppress(InputError, OSError):  # another command may be changing the file
                slots = read_plan(self.session.plan)
                # A new plan removes no slot; if one is missing, the file is damaged.
                if {slot.id for slot in self.slots} <= {slot.id for slot in slots}:
                    self.slots = slots
        return next(iter(slot_states.slots_to_do(self.slots, self.states)), None)

    def _plan_time_ns(self) -> int:
        """Return when plan.csv was last changed; the last known time if it cannot be read now."""
        try:
            return self.session.plan.stat().st_mtime_ns
        except OSError:
            return self._plan_stamp_ns

    def _take(self, bracket: BracketCapture, late_s: float) -> slot_states.SlotState:
        """Take a bracket and return its slot's final state; any failure affects this slot only.

        One more row is logged after it, so that rows surround the bracket. late_s: time since the
        slot began.
        """
        self._state, slot = "capturing", bracket.slot
        self.recorder.restore_reserve()
        if late_s > 10.0 and bracket.state.outcome == "":
            self.recorder.write_event("late", slot=slot.id, by_s=round(late_s, 1))
        try:
            state = bracket.take()
        except Exception as error:
            with suppress(OSError):
                states = slot_states.read_slot_states(self.session)
                bracket.state = states.slots.get(slot.id, bracket.state)
            state = bracket.abort(error_text(error))
        if self.logger is not None and not self.options.threaded:
            self.clock.sleep(self.logger.due_in_s)
            self.logger.poll_if_due()
        self.frame_bytes = bracket.frame_bytes
        with suppress(OSError, InputError):
            self.bytes_per_slot = self.session.slot_bytes()
        return state

    def _too_late(self, bracket: BracketCapture, late_s: float) -> slot_states.SlotState:
        """Journal a slot as missed, or as aborted if its bracket was started; return its state."""
        slot = bracket.slot.id
        if bracket.state.outcome == "started":
            why = "interrupted, and not finished within the slot's window"
            return bracket.abort(f"{why} (now {late_s:.0f} s late)")
        self.recorder.write_event("missed", slot=slot, why=f"late by {late_s:.0f} s")
        return slot_states.SlotState("missed", why="late")

    def _sleep_until(self, t_utc: datetime, *, log: bool = True) -> bool:
        """Sleep and log until a time; return False if the plan changed before that time.

        log: whether the pyranometer is read in the meantime.
        """
        while self._plan_time_ns() == self._plan_stamp_ns:
            self.recorder.write_events(self.clock.check())
            wait_s = (t_utc - self.clock.now()).total_seconds()
            if wait_s <= 0:
                return True
            if self.options.threaded:
                wait_s = min(wait_s, 1.0)
                self._show()
            elif self.logger is not None and log:
                self.logger.poll_if_due()
                wait_s = min(wait_s, max(self.logger.due_in_s, 0.01))
            if wait_s <= 60.0:
                self.camera.get()  # reopen a lost camera before its slot, if possible
            self.clock.sleep(wait_s)
        return False

    def _between(self, frame: Frame | None) -> None:
        """Log irradiance if it is due, and refresh the display; see `BracketCapture.between`."""
        if frame is not None:
            self.last_frame = f"{frame.file} {frame.doubt}".strip()
        if self.options.threaded:
            self._show()
        elif self.logger is not None:
            self.logger.poll_if_due()

    def _show(self) -> None:
        """Update the display; ignore its failure.

        Causes are a closed terminal, a pipe without a reader, a network share that is away.
        """
        with suppress(Exception):
            self.watch(self.live())

    def live(self) -> Live:
        """Return the state of the capture. Raises OSError if the disk is away."""
        now, upcoming = self.clock.now(), self._next
        outcomes = Counter(state.outcome for state in self.states.slots.values())
        counts = {name: outcomes[name] for name in slot_states.SETTLED}
        sample = self.logger.last if self.logger else None
        free_bytes = disk_usage(self.session.root).free
        zone = self.setup.site.timezone
        days = max(1, len({standard_date(slot.t_utc, zone) for slot in self.slots}))
        bytes_per_day = self.bytes_per_slot * len(self.slots) / days
        return Live(
            state=self._state,
            t_utc=now,
            planned=len(self.slots),
            **counts,
            left=len(self.slots) - sum(counts.values()),
            next_slot=upcoming.id if upcoming else "",
            next_in_s=(upcoming.t_utc - now).total_seconds() if upcoming else None,
            last_frame=self.last_frame,
            ghi_wm2=sample.ghi_wm2 if sample else None,
            ghi_age_s=(now - sample.t_utc).total_seconds() if sample else None,
            camera=self.camera.state,
            pyranometer=self.logger.keeper.state if self.logger else "",
            bytes_free=free_bytes,
            disk_days=free_bytes / bytes_per_day if bytes_per_day else None,
            last_event=self.recorder.last_event,
        )

    def close(self) -> None:
        """Close all devices and the recorder."""
        for device in (self.logger, self.meter, self.camera):
            if device is not None:
                device.close()
        self.recorder.write_event("close", state=self._state)
        self.recorder.close()
