"""Read a Delta-T SPN1 on a serial port."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

from fieldlum.devices import InstrumentInfo
from fieldlum.devices.ask_twice import agreed_answer
from fieldlum.devices.clock import Clock
from fieldlum.devices.serial_port import SerialLine, SerialPort
from fieldlum.devices.spn1 import (
    AGREE_WM2,
    AWAKE,
    NOISE_WM2,
    Spn1Status,
    apart_wm2,
    in_line,
    parse_reading,
    parse_status,
)
from fieldlum.errors import DeviceError
from fieldlum.records import IrradianceSample

_WAKE_TRIES = 3  # a sleeping SPN1 may lose the first character; chosen, not measured
# A total this far below the diffuse is doubtful, because the instrument's own noise is below 3
# W/m2. Larger differences were seen in the field at dawn. Chosen.
_TOTAL_BELOW_DIFFUSE_WM2 = 3.0


class Spn1:
    """An SPN1 on a serial port; implements `Pyranometer`. Sends R, S and I and nothing else.

    close_too : called by `close`, to stop a simulator behind the port. Raises DeviceError if the
    port cannot be opened or the instrument does not answer as an SPN1.
    """

    def __init__(
        self,
        place: str,
        clock: Clock,
        *,
        baud: int = 9600,
        timeout_s: float = 2.0,
        close_too: Callable[[], None] | None = None,
    ) -> None:
        self._clock, self._close_too = clock, close_too
        self._port = SerialPort(place, SerialLine(baud), timeout_s=timeout_s)
        try:
            self._status = self._ask_status()
        except DeviceError:
            self.close()
            raise

    @property
    def info(self) -> InstrumentInfo:
        """Return what the instrument reports about itself."""
        return InstrumentInfo(
            "spn1",
            "Delta-T SPN1",
            self._status.serial,
            self._status.firmware,
            port=self._port.name,
            gives=("ghi", "dhi"),
            guard="asked twice",
        )

    def read(self) -> IrradianceSample:
        """Return a reading on which two answers agree, or the middle of three evenly spaced ones.

        Several answers are needed because the line has no checksum. A total over 3 W/m2 below the
        diffuse gets a status. `raw` has the distinct answers, joined by " | ". Raises DeviceError
        for silence, or if neither two valid answers agree nor three are evenly spaced.
        """
        t_utc = self._clock.now()
        reading, answers = agreed_answer(
            self._ask_reading, parse_reading, apart_wm2, (NOISE_WM2, AGREE_WM2), in_line
        )
        is_doubtful = reading.total_wm2 < reading.diffuse_wm2 - _TOTAL_BELOW_DIFFUSE_WM2
        doubt = "total below diffuse" if is_doubtful else ""
        text = " | ".join(
            answer.decode("ascii", "backslashreplace").strip() for answer in dict.fromkeys(answers)
        )
        return IrradianceSample(
            t_utc, reading.total_wm2, reading.diffuse_wm2, status=doubt, raw=text
        )

    def _ask_reading(self) -> bytes:
        self._wake()
        self._port.write(b"S")
        reply = self._port.read_until(b"\r", 64)
        if not reply:
            raise DeviceError(
                f"{self._port.name}: SPN1 woke, but sends no reading; switch it off and on again"
            )
        return reply

    def _wake(self) -> None:
        """Send R until the answer is 0xAF; discard late replies in the line."""
        heard = b""
        for _ in range(_WAKE_TRIES):
            self._port.drain()
            self._port.write(b"R")
            heard = self._port.read(1)
            if heard == AWAKE:
                return
        answer = f"answered {heard!r}" if heard else "did not answer"
        raise DeviceError(
            f"{self._port.name}: SPN1 {answer} when woken; expected 0xAF; check cable, power and "
            f"9600 8N1"
        )

    def _ask_status(self) -> Spn1Status:
        self._wake()
        self._port.write(b"I")
        reply = self._port.read_quiet(0.25, 3.0)
        return parse_status(reply.removeprefix(b"I"))

    def close(self) -> None:
        """Close the port."""
        self._port.close()
        if self._close_too is not None:
            with suppress(OSError):
                self._close_too()
