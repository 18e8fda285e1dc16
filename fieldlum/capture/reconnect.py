"""Open devices when needed, drop failing ones, and reopen them after growing pauses."""

import threading
from collections.abc import Callable
from concurrent.futures import Future, wait
from contextlib import suppress
from dataclasses import asdict
from typing import Any, Generic, TypeVar

from fieldlum.core.errors import DeviceError
from fieldlum.devices import CameraInfo, Device, InstrumentInfo
from fieldlum.devices.clock import Clock
from fieldlum.session.folder import DeviceTable

# Not measured: the first pause suits a loose plug, and the longest fits into a slot's window.
FIRST_PAUSE_S, MAX_PAUSE_S = 1.0, 30.0


def error_text(error: BaseException) -> str:
    """Return an error of any kind as a text of at most 300 characters for the journal."""
    return f"{type(error).__name__}: {error}"[:300]


D = TypeVar("D", bound=Device)
R = TypeVar("R")


def pause_s(failures: int, first_s: float = FIRST_PAUSE_S, longest_s: float = MAX_PAUSE_S) -> float:
    """Return the pause [s] before the next try, which doubles with each failure up to a limit.

    failures: number of failures in sequence, from 1; first_s: the first pause; longest_s: the
    limit.
    """
    return min(first_s * 2.0 ** min(failures - 1, 30), longest_s)


class Keeper(Generic[D]):
    """Holds one device, opens it when it is first needed, and again after a failure.

    name: of the device, for the journal; open_device: opens it; clock: for the pauses between two
    tries; tell: called with the name of an event for the journal (device-lost, device-back) and its
    fields as keywords; watchdog_s: time after which a call of the device counts as hung [s].
    """

    def __init__(
        self,
        name: str,
        open_device: Callable[[], D],
        clock: Clock,
        tell: Callable[..., Any],
        watchdog_s: float,
    ) -> None:
        self.name, self._open, self._clock = name, open_device, clock
        self._tell, self._watchdog_s = tell, watchdog_s
        self._device: D | None = None
        self._failures = 0  # in sequence
        self._next_try_s = float("-inf")  # time since the boot, as `_lost_at_s`
        self._lost_at_s: float | None = None

    @property
    def state(self) -> str:
        """The device's state for the display: "ok", "closed" (not yet opened) or "lost"."""
        if self._lost_at_s is not None:
            return "lost"
        return "closed" if self._device is None else "ok"

    def get(self) -> D | None:
        """Return the device, opened if a try is due; None while it is away.

        An error of opening it is not raised, but journalled as the loss of the device.
        """
        if self._device is None and self._clock.boottime() >= self._next_try_s:
            try:
                self.open_or_raise()
            # termios.error, SerialException or a driver's defect must not end the capture
            except Exception as error:
                self.mark_lost(error)
        return self._device

    def open_or_raise(self) -> D:
        """Return the device, opened now if necessary.

        Raises the error of opening it, DeviceError if that takes longer than `watchdog_s`.
        """
        if self._device is None:
            self._device = guarded(self._open, self._watchdog_s, f"{self.name}: opening")
        return self._device

    def call(self, use: Callable[[D], R], extra_s: float = 0.0) -> R:
        """Run `use(device)` under the watchdog and return its result.

        extra_s: time [s] that is added to `watchdog_s`, such as that of a long exposure. Raises
        DeviceError if the device is away or does not answer in time, else what `use` raises.
        """
        device = self.get()
        if device is None:
            raise DeviceError(f"{self.name} is not connected; check its cable and power")
        result = guarded(lambda: use(device), self._watchdog_s + extra_s, self.name)
        # Only a successful call shows that it is back: a camera with a full card opens, then fails
        # again.
        if self._lost_at_s is not None:
            after_s = round(self._clock.boottime() - self._lost_at_s, 1)
            self._tell("device-back", device=self.name, after_s=after_s)
            self._lost_at_s, self._failures = None, 0
        return result

    def mark_lost(self, error: BaseException) -> None:
        """Close a failed device, journal its loss once, and plan the next try to open it.

        The pause doubles with each call, from 1 s to 30 s, until a call of the device succeeds.
        """
        self.close()
        now_s = self._clock.boottime()
        if self._lost_at_s is None:
            self._lost_at_s = now_s
            self._tell("device-lost", device=self.name, why=error_text(error))
        self._failures += 1
        self._next_try_s = now_s + pause_s(self._failures)

    def close(self) -> None:
        """Close the device, if it is open."""
        device, self._device = self._device, None
        if device is not None:
            with suppress(Exception):
                guarded(device.close, min(self._watchdog_s, 5.0), f"{self.name}: closing")


def plain_info(info: CameraInfo | InstrumentInfo) -> DeviceTable:
    """Return a device's information as numbers and texts by field, without empty fields."""
    stated = {name: value for name, value in asdict(info).items() if value not in (None, "", ())}
    return {name: v if isinstance(v, int | float) else str(v) for name, v in stated.items()}


def guarded(work: Callable[[], R], seconds: float, what: str) -> R:
    """Run `work()` in its own thread and return its result, or raise its error.

    seconds: longest time of the work [s]; what: names the work in the error. Raises DeviceError if
    it does not return within `seconds`; its thread then continues, and its result is ignored.
    """
    answer = Future[R]()

    def job() -> None:
        """Store the result or the error of `work()` in `answer`."""
        try:
            answer.set_result(work())
        except BaseException as error:
            answer.set_exception(error)

    threading.Thread(target=job, daemon=True).start()
    if not wait([answer], seconds).done:
        raise DeviceError(f"{what}: no answer within {seconds:g} s; check cable and power")
    return answer.result()
