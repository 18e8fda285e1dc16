"""An instrument that sends lines by itself, on a serial port. Nothing is ever sent to it."""

from __future__ import annotations

import time

from fieldlum.devices import InstrumentInfo
from fieldlum.devices.ascii_lines import AsciiProfile, parse_line, sample_of
from fieldlum.devices.clock import Clock
from fieldlum.devices.serial_port import SerialPort
from fieldlum.errors import DeviceError
from fieldlum.records import IrradianceSample

_POLL_S = 0.05
_LONGEST_REST = 4096


class LineInstrument:
    """Implements `Pyranometer`: the newest line that has come since the last reading, or the next one.

    `ignored` counts the lines that did not fit the profile.
    """

    def __init__(self, place: str, profile: AsciiProfile, clock: Clock, *, silence_s: float | None = None) -> None:
        line = profile.line
        self._profile, self._clock = profile, clock
        self._silence_s = line.silence_s if silence_s is None else silence_s
        self._port = SerialPort(
            place, baud=line.baud, bits=line.bits, parity=line.parity, stop=line.stop, timeout_s=_POLL_S
        )
        self._rest: bytes | None = None  # None: the first line may have begun before we listened
        self.ignored = 0

    @property
    def info(self) -> InstrumentInfo:
        p = self._profile
        gives = tuple(e.quantity.removesuffix("_wm2") for e in p.entry if e.quantity.endswith("_wm2"))
        return InstrumentInfo(
            "ascii", p.model or p.name, p.serial, calibration_date=p.calibration_date, port=self._port.name, gives=gives
        )

    def read(self) -> IrradianceSample:
        """Raises DeviceError after a silence, or when only lines come that do not fit."""
        deadline = time.monotonic() + self._silence_s
        why = "is silent: check cable, power and baud rate"
        while True:
            newest: IrradianceSample | None = None
            for line in self._lines():
                try:
                    values = parse_line(self._profile, line)
                except DeviceError as error:
                    self.ignored, why = self.ignored + 1, str(error)
                else:
                    text = line.decode("ascii").strip()
                    newest = sample_of(self._clock.now(), values, text)
            if newest is not None:
                return newest
            if time.monotonic() > deadline:
                raise DeviceError(f"{self._port.name}: {why}")

    def _lines(self) -> list[bytes]:
        """Whole lines that have come; what follows the last end mark waits for the next call."""
        data = self._port.drain() or self._port.read(1) + self._port.drain()
        if self._rest is None:
            if b"\n" not in data:
                return []
            data = data.partition(b"\n")[2]
            self._rest = b""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > _LONGEST_REST:  # no end mark at all: the wrong baud rate
            self._rest = None
        return [line + b"\n" for line in lines]

    def close(self) -> None:
        self._port.close()
