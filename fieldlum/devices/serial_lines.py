"""An instrument that sends lines by itself, on a serial port. Nothing is ever sent to it."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from statistics import median

from fieldlum.devices import FORM_ALONE, InstrumentInfo
from fieldlum.devices.ascii_lines import AsciiProfile, body_of, parse_line, sample_of
from fieldlum.devices.clock import Clock
from fieldlum.devices.learned_format import LineForm
from fieldlum.devices.serial_port import SerialPort
from fieldlum.errors import DeviceError
from fieldlum.records import IrradianceSample

_POLL_S = 0.05
_LONGEST_REST = 4096
_VOTES = 3
_SLOWEST_VOTE_S = 2.0  # between lines; over three slower ones the light changes too much
_REFUSED_KEPT = 100
_GUARD = {"none": FORM_ALONE, "xor": "exclusive or", "crc16": "CRC-16"}


def voted(values: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The median of each quantity over lines: of three, a damaged one stands outside the other
    two, or is harmless.
    """
    return {quantity: median(line[quantity] for line in values) for quantity in values[-1]}


class LineInstrument:
    """Implements `Pyranometer` and `Streaming`: the newest line since the last reading, or the next
    one.

    Where three or more have come, at two seconds' distance or less, the median of the newest three.
    """

    def __init__(
        self, place: str, profile: AsciiProfile, clock: Clock, *, silence_s: float | None = None
    ) -> None:
        line = profile.line
        self._profile, self._clock = profile, clock
        self._silence_s = line.silence_s if silence_s is None else silence_s
        self._port = SerialPort(
            place,
            baud=line.baud,
            bits=line.bits,
            parity=line.parity,
            stop=line.stop,
            timeout_s=_POLL_S,
        )
        self._rest: bytes | None = None  # None: the first line may have begun before we listened
        self._form = LineForm()
        self._refused: list[str] = []
        self._last_read_s = clock.boottime()
        self.ignored = 0

    @property
    def info(self) -> InstrumentInfo:
        p = self._profile
        gives = tuple(
            e.quantity.removesuffix("_wm2") for e in p.entry if e.quantity.endswith("_wm2")
        )
        return InstrumentInfo(
            "ascii",
            p.model or p.name,
            p.serial,
            calibration_date=p.calibration_date,
            port=self._port.name,
            gives=gives,
            guard=_GUARD[p.checksum],
        )

    def read(self) -> IrradianceSample:
        """Raises DeviceError after a silence, or when only lines come that do not fit."""
        deadline = time.monotonic() + self._silence_s
        why = "is silent: check cable, power and baud rate"
        while True:
            sound: list[tuple[str, dict[str, float]]] = []
            for line in self._lines():
                try:
                    sound.append(self._understood(line))
                except DeviceError as error:
                    self.ignored, why = self.ignored + 1, str(error)
                    self._refused = [*self._refused, f"{why}; it was {line!r}"][-_REFUSED_KEPT:]
            if sound:
                return self._reading(sound)
            if time.monotonic() > deadline:
                raise DeviceError(f"{self._port.name}: {why}")

    def _understood(self, line: bytes) -> tuple[str, dict[str, float]]:
        values = parse_line(self._profile, line)
        if said := self._form.unlike(body_of(self._profile, line)):
            raise DeviceError(f"line is unlike all before it: {said}")
        return line.decode("ascii").strip(), values

    def _reading(self, sound: Sequence[tuple[str, dict[str, float]]]) -> IrradianceSample:
        now = self._clock.boottime()
        apart_s, self._last_read_s = (now - self._last_read_s) / len(sound), now
        newest = (
            sound[-_VOTES:] if len(sound) >= _VOTES and apart_s <= _SLOWEST_VOTE_S else sound[-1:]
        )
        texts = " | ".join(dict.fromkeys(text for text, _ in newest))
        return sample_of(self._clock.now(), voted([values for _, values in newest]), texts)

    def refused(self) -> list[str]:
        """What was refused since this was last asked: why, and the line as it came."""
        refused, self._refused = self._refused, []
        return refused

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
