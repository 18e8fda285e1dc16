"""Konica Minolta CL-200A: vertical illuminance at the lens, as a check of each bracket.

Source: Konica Minolta technical note CS-A32T. 9600 7E1; frames STX .. ETX BCC CR LF, BCC being the
exclusive or of all after STX up to and with ETX, as two hexadecimal digits. Only measuring commands
are sent: none changes the calibration.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Literal

from fieldlum.devices import IlluminanceReading, InstrumentInfo
from fieldlum.devices.serial_port import SerialPort
from fieldlum.devices.uri import DeviceUri, one_of
from fieldlum.errors import DeviceError

if TYPE_CHECKING:
    from fieldlum.devices.clock import Clock

PC_MODE, HOLD, EXT_ON, MEASURE, READ_EVXY = (
    b"00541   ",
    b"99551  0",
    b"004010  ",
    b"994021  ",
    b"00021200",
)
STX, ETX = b"\x02", b"\x03"
_ERRORS = {
    "1": "its head was switched off: start it anew",
    "2": "memory error: start it anew",
    "3": "memory error: start it anew",
    "5": "over its range",
    "7": "out of its range",
}
_TRIES = 4
_ANSWER = re.compile(r"(\d{2})(\d{2})(.)(.)(.)(.)((?:[+\-=][ \d]{4}\d){3})", re.DOTALL)
_SHORT = re.compile(r"(\d{2})(\d{2})(.)(.)(.)(.)", re.DOTALL)


class NotReady(DeviceError):
    """The meter changes its range, or has not measured yet: ask again."""


def bcc(body: bytes) -> bytes:
    """Check digits of what stands between STX and BCC, ETX being added here."""
    total = 0
    for byte in body + ETX:
        total ^= byte
    return b"%02X" % total


def frame(body: bytes) -> bytes:
    return STX + body + ETX + bcc(body) + b"\r\n"


def unframe(reply: bytes) -> str:
    """The body of a whole frame. Raises DeviceError for every damage that the check digits show."""
    match = re.fullmatch(rb"\x02([^\x02\x03]*)\x03([0-9A-F]{2})\r\n", reply)
    if match is None or bcc(match[1]) != match[2] or not match[1].isascii():
        raise DeviceError(
            f"CL-200A said {reply[:40]!r}, expected a frame with the right check digits"
        )
    return match[1].decode("ascii")


def _value(six: str) -> float:
    """Sign, four digits, exponent: '+12345' is 1234 x 10^1; an equals sign stands for plus or
    minus zero.
    """
    digits = six[1:5].replace(" ", "")
    if not digits:
        raise DeviceError(f"CL-200A: field {six!r} holds no digits")
    return (-1.0 if six[0] == "-" else 1.0) * float(digits) * 10.0 ** (int(six[5]) - 4)


@dataclass(frozen=True, slots=True)
class ChromaticityReading:
    illuminance_lx: float
    x: float
    y: float
    low_battery: bool
    too_dark: bool


def parse_answer(reply: bytes) -> ChromaticityReading:
    """Illuminance and chromaticity of command 02. Raises DeviceError for damage and for the
    meter's own errors.
    """
    body = unframe(reply)
    match = _ANSWER.fullmatch(body)
    if match is None:
        short = _SHORT.fullmatch(body)
        code = short[4] if short else ""
        raise DeviceError(
            f"CL-200A: {_ERRORS.get(code, f'an answer without values ({body[:30]!r})')}"
        )
    if match[4] in _ERRORS:
        raise DeviceError(f"CL-200A: {_ERRORS[match[4]]}")
    if match[4] == "4":
        raise NotReady("CL-200A: has not measured yet")
    if match[5] == "6":
        raise NotReady("CL-200A: changes its range")
    values = [_value(match[7][i : i + 6]) for i in (0, 6, 12)]
    if not (0.0 <= values[0] <= 200_000.0 and 0.0 <= values[1] <= 1.0 and 0.0 <= values[2] <= 1.0):
        raise DeviceError(
            f"CL-200A: {values[0]:g} lx at x {values[1]:g}, y {values[2]:g}: out of its range"
        )
    return ChromaticityReading(values[0], values[1], values[2], match[6] == "1", match[4] == "6")


class Cl200a:
    """Implements `IlluminanceMeter`. sleep: the meter wants pauses between commands."""

    def __init__(
        self,
        place: str,
        sleep: Callable[[float], None],
        *,
        parity: Literal["E", "N"] = "E",
        timeout_s: float = 1.5,
    ) -> None:
        self._sleep = sleep
        # A pty has neither seven bits nor parity: "N" is for tests and for converters that strip
        # them.
        self._port = SerialPort(
            place, baud=9600, bits=7 if parity == "E" else 8, parity=parity, timeout_s=timeout_s
        )
        try:
            self._answer(PC_MODE)
            sleep(0.5)
            self._port.write(frame(HOLD))
            sleep(0.5)
            self._answer(EXT_ON)
            sleep(0.175)
        except DeviceError:
            self.close()
            raise

    @property
    def info(self) -> InstrumentInfo:
        return InstrumentInfo(
            "cl200a", "Konica Minolta CL-200A", port=self._port.name, gives=("illuminance",)
        )

    def read(self) -> IlluminanceReading:
        """Raises DeviceError for silence, damage, the meter's own errors, and when it does not
        settle.
        """
        for _ in range(_TRIES - 1):
            with suppress(NotReady):
                return self._measure()
        return self._measure()

    def _measure(self) -> IlluminanceReading:
        self._port.drain()
        self._port.write(frame(MEASURE))
        self._sleep(0.5)
        reply = self._answer(READ_EVXY)
        found = parse_answer(reply)
        return IlluminanceReading(
            found.illuminance_lx, found.low_battery, reply.decode("ascii").strip()
        )

    def _answer(self, command: bytes) -> bytes:
        self._port.drain()
        self._port.write(frame(command))
        reply = self._port.read_until(b"\r\n", 128)
        if not reply:
            raise DeviceError(
                f"{self._port.name}: CL-200A is silent: switch it on, check its cable"
            )
        unframe(reply)
        return reply

    def close(self) -> None:
        self._port.close()


def open_meter(uri: DeviceUri, *, clock: Clock) -> Cl200a:
    """``cl200a:/dev/serial/by-id/...``. Raises DeviceError."""
    options = uri.read(parity=one_of("E", "N"))
    if not uri.place:
        raise DeviceError(f"{uri.text}: no port, expected something like cl200a:/dev/ttyUSB0")
    return Cl200a(uri.place, partial(clock.sleep), **options)
