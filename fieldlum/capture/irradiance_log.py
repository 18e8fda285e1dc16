"""Log irradiance: one row for each poll that the instrument answers."""

import threading
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import replace
from functools import partial

from fieldlum.capture.disk_writer import Recorder
from fieldlum.capture.reconnect import Keeper, error_text, plain_info
from fieldlum.capture.steady_clock import SteadyClock
from fieldlum.core.records import IrradianceSample
from fieldlum.devices import Pyranometer, open_pyranometer
from fieldlum.devices.clock import Clock
from fieldlum.session import Session, sole_user, update_session

# Rejected lines that are journalled in an hour: an instrument that prints remarks must not fill the
# disk (under 100 kB a day).
_REPORTED_AN_HOUR = 20


class Logger:
    """Reads a pyranometer every `every_s` seconds and writes each reading as a row.

    It has its own thread (`start`), or the capture's loop calls `poll_if_due`. keeper: holds the
    pyranometer; recorder: writes the rows; clock: gives their times; last: newest valid reading, or
    None. A reading that fails is journalled, and raises no error.
    """

    def __init__(
        self, keeper: Keeper[Pyranometer], recorder: Recorder, clock: SteadyClock, every_s: float
    ) -> None:
        self.keeper, self.every_s = keeper, every_s
        self._recorder, self._clock = recorder, clock
        self._due = float("-inf")  # boot time of the next poll [s]
        self._failures = 0  # polls in sequence without a valid answer
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self.last: IrradianceSample | None = None
        self._hour, self._refused = -1, 0  # lines refused in the present hour of the day

    def _poll(self) -> None:
        """Read the pyranometer once, and write the reading as a row of the day file.

        Write nothing if the instrument is away or its answer is invalid.
        """
        device = self.keeper.get()
        if device is None:
            return
        asked_utc = self._clock.now()
        try:
            sample = self.keeper.call(lambda d: d.read())
        except Exception as error:  # a driver can raise anything; the log must continue
            self._failures += 1
            if self.keeper.state != "lost":  # the loss is already in the journal
                self._journal_bad_reading(error_text(error))
            if self._failures >= 3:  # the port is opened again
                self._failures = 0
                self.keeper.mark_lost(error)
            return
        finally:
            self._journal_refused(device)
        self._failures = 0
        # The steady time, not the instrument's, which may be wrong.
        self.last = replace(sample, t_utc=asked_utc)
        self._recorder.write_row(self.last)

    def _journal_refused(self, device: Pyranometer) -> None:
        """Journal the lines that the driver rejected; above 20 in an hour, only their number."""
        lines, hour = device.refused(), int(self._clock.boottime() // 3600)
        if hour != self._hour:
            if self._refused > _REPORTED_AN_HOUR:
                more = self._refused - _REPORTED_AN_HOUR
                self._journal_bad_reading(f"and {more} more lines in that hour")
            self._hour, self._refused = hour, 0
        for line in lines[: max(0, _REPORTED_AN_HOUR - self._refused)]:
            self._journal_bad_reading(line[:600])
        self._refused += len(lines)

    def _journal_bad_reading(self, why: str) -> None:
        self._recorder.write_event("bad-reading", device=self.keeper.name, why=why)

    @property
    def due_in_s(self) -> float:
        """Time until the next poll [s]; 0 if the poll is overdue."""
        return max(0.0, self._due - self._clock.boottime())

    def poll_if_due(self) -> None:
        """Poll if the time has come; skip polls that were missed while the computer slept."""
        now_s = self._clock.boottime()
        if now_s >= self._due:
            next_s = self._due + self.every_s  # not from now: the polls would drift
            self._due = next_s if next_s > now_s else now_s + self.every_s
            self._poll()

    def start(self) -> None:
        """Poll in a thread until `close`; return at once."""
        self._thread = threading.Thread(target=self._loop, name="irradiance", daemon=True)
        self._thread.start()

    def _loop(self) -> None:
        """Poll when it is due, until `stop`; run in the thread."""
        reported = ""
        while not self._stop.is_set():
            try:
                self.poll_if_due()
            # After any error, the irradiance of the following days must still be logged; a repeated
            # one is reported once, otherwise it would fill the disk.
            except Exception as error:
                if (why := error_text(error)) != reported:
                    self._journal_bad_reading(why)
                reported = why
            self._stop.wait(min(self.due_in_s, 1.0) or 0.01)

    def close(self) -> None:
        """Stop the thread and close the instrument."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=10.0)
        self.keeper.close()


def log(
    session: Session,
    uri: str,
    *,
    clock: Clock,
    every_s: float,
    rows: int | None,
    say: Callable[[str], None],
) -> int:
    """Log irradiance without a camera until `rows` rows are written; return their number.

    uri: of the pyranometer; rows: None to log until the process is stopped; every_s: time between
    readings [s]; say: called with notes for the user. Faults of the instrument after the start are
    journalled, and it is opened again. Raises the error of opening it at the start, InputError if
    another process logs into this session.
    """
    steady = SteadyClock(clock)
    opener = partial(open_pyranometer, uri, clock=clock, session=session)
    with (
        sole_user(session, "log"),
        closing(Recorder(session, steady.now, reserve=".reserve-log")) as recorder,
    ):
        keeper = Keeper("pyranometer", opener, steady, recorder.write_event, 60.0)
        with closing(Logger(keeper, recorder, steady, every_s)) as logger:
            info = keeper.open_or_raise().info
            devices = session.table().get("devices", {})
            with suppress(OSError):  # the next row reports a full disk
                update_session(session, {"devices": {**devices, "pyranometer": plain_info(info)}})
            who = f"{info.model or info.kind} {info.serial}".strip()
            say(f"logging {who} every {every_s:g} s; stop with Ctrl-C")
            while rows is None or recorder.rows < rows:
                recorder.write_events(steady.check())
                logger.poll_if_due()
                clock.sleep(min(logger.due_in_s, 1.0))
    return recorder.rows
