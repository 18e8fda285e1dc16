"""Konica Minolta CL-200A: vertical illuminance at the lens, as a check of each bracket.

Source: Konica Minolta technical note CS-A32T. 9600 7E1; frames STX .. ETX BCC CR LF, where BCC is
the exclusive or of all bytes after STX up to and including ETX, as two hexadecimal digits. None of
the commands that are sent changes the calibration.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import reduce
from operator import xor
from typing import Any, Literal

from msgspec import Struct

from fieldlum.core.errors import DeviceError
from fieldlum.devices import (
    DeviceUri,
    IlluminanceMeter,
    IlluminanceReading,
    InstrumentInfo,
    retried,
)
from fieldlum.devices.clock import Clock
from fieldlum.devices.serial_port import SerialLine, SerialPort, closed_on_error

# Commands and frame marks of CS-A32T.
PC_MODE = b"00541   "
HOLD = b"99551  0"
EXT_ON = b"004010  "
MEASURE = b"994021  "
READ_EVXY = b"00021200"
STX, ETX = b"\x02", b"\x03"
_ERRORS = {
    "1": "the receptor head was switched off; restart the meter",
    "2": "memory error; restart the meter",
    "3": "memory error; restart the meter",
    "5": "the light is over the meter's range; measure in less light",
    "7": "the light is out of the meter's range; measure in other light",
}
_PAUSE_S = 0.5  # that the meter needs after PC mode, hold and measure (CS-A32T)
_ANSWER = re.compile(r"(\d{2})(\d{2})(.)(.)(.)(.)((?:[+\-=][ \d]{4}\d){3})", re.DOTALL)


class NotReady(DeviceError):
    """Signal that the meter changes its range, or has not measured yet: measure again."""


def bcc(body: bytes) -> bytes:
    """Return the check digits (BCC) of a body without STX and ETX: two hex digits."""
    return b"%02X" % reduce(xor, body + ETX)


def frame(body: bytes) -> bytes:
    """Return a body with its frame: STX, body, ETX, check digits, CR and LF."""
    return STX + body + ETX + bcc(body) + b"\r\n"


def unframe(reply: bytes) -> str:
    """Return the body of a frame. Raises DeviceError for a damaged or incomplete frame."""
    match = re.fullmatch(rb"\x02([^\x02\x03]*)\x03([0-9A-F]{2})\r\n", reply)
    if match is None or bcc(match[1]) != match[2] or not match[1].isascii():
        expected = "expected a frame with the right check digits"
        raise DeviceError(f"CL-200A answered {reply[:40]!r}; {expected}; check the cable")
    return match[1].decode("ascii")


def _value(six: str) -> float:
    """Return a number of sign, four digits and exponent: '+12345' is 1234 x 10^(5 - 4).

    An equals sign in place of the sign means plus or minus zero.
    """
    digits = six[1:5].replace(" ", "")
    if not digits:
        raise DeviceError(f"CL-200A: a value {six!r} without digits; check the cable")
    return (-1.0 if six[0] == "-" else 1.0) * float(digits) * 10.0 ** (int(six[5]) - 4)


def parse_answer(reply: bytes) -> IlluminanceReading:
    """Return the illuminance reading in the meter's answer to command 02 (read Ev, x and y).

    Raises DeviceError for a damaged answer, an error that the meter reports, an illuminance outside
    0 to 200 000 lx, or an impossible x or y; NotReady, a DeviceError, if the meter changes its
    range or has not measured yet.
    """
    body = unframe(reply)
    match = _ANSWER.fullmatch(body)
    if match is None:
        why = f"an answer without values ({body[:30]!r})"
        raise DeviceError(f"CL-200A: {_ERRORS.get(body[5:6], why) if len(body) == 8 else why}")
    if match[4] in _ERRORS:
        raise DeviceError(f"CL-200A: {_ERRORS[match[4]]}")
    if match[4] == "4":
        raise NotReady("CL-200A has not measured yet; wait some seconds, then read it again")
    if match[5] == "6":
        raise NotReady("CL-200A changes its range; read it again in steady light")
    illuminance_lx, x, y = (_value(match[7][i : i + 6]) for i in (0, 6, 12))
    if not (0.0 <= illuminance_lx <= 200_000.0 and 0.0 <= x <= 1.0 and 0.0 <= y <= 1.0):
        found = f"{illuminance_lx:g} lx with chromaticity x {x:g}, y {y:g}"
        expected = "expected 0 to 200000 lx and x, y from 0 to 1"
        raise DeviceError(f"CL-200A: {found}; {expected}; read it again in less light")
    return IlluminanceReading(illuminance_lx, match[6] == "1")


class Cl200a(IlluminanceMeter):
    """A CL-200A on a serial port.

    place : the port; sleep : waits for a number of seconds; parity : "N" for a line of 8 bits
    without parity: for converters that remove it, and for tests on a pty. Raises DeviceError if the
    port cannot be opened, or if the meter does not answer or its answer is damaged.
    """

    def __init__(
        self, place: str, sleep: Callable[[float], None], *, parity: Literal["E", "N"] = "E"
    ) -> None:
        self._sleep = sleep
        line = SerialLine(bits=7 if parity == "E" else 8, parity=parity)
        self._port = SerialPort(place, line, timeout_s=1.5)
        about: dict[str, Any] = {"port": self._port.name, "gives": ("illuminance",)}
        self.info = InstrumentInfo("cl200a", "Konica Minolta CL-200A", **about)
        with closed_on_error(self):
            self._answer(PC_MODE)
            sleep(_PAUSE_S)
            self._port.write(frame(HOLD))
            sleep(_PAUSE_S)
            self._answer(EXT_ON)
            sleep(_PAUSE_S)

    def read(self) -> IlluminanceReading:
        """Measure, up to four times until the meter is ready, and return the illuminance.

        Raises DeviceError if the meter does not answer or is not ready after four measurements, or
        if its answer is damaged, impossible or reports an error.
        """
        return retried(self._measure, lambda error: isinstance(error, NotReady))

    def _measure(self) -> IlluminanceReading:
        self._port.drain()
        self._port.write(frame(MEASURE))
        self._sleep(_PAUSE_S)
        return parse_answer(self._answer(READ_EVXY))

    def _answer(self, command: bytes) -> bytes:
        self._port.drain()
        self._port.write(frame(command))
        reply = self._port.read_until(b"\r\n", 128)
        if not reply:
            why = "CL-200A does not answer; switch it on and check its cable"
            raise DeviceError(f"{self._port.name}: {why}")
        unframe(reply)
        return reply

    def close(self) -> None:
        """Close the port."""
        self._port.close()


class _Options(Struct):
    parity: Literal["E", "N"] = "E"


def open_meter(uri: DeviceUri, *, clock: Clock) -> Cl200a:
    """Open the meter of ``cl200a:/dev/serial/by-id/...``; option parity: E (default) or N.

    Raises DeviceError for an unknown option or value, a missing port, or no answer.
    """
    options = uri.read(_Options)
    if not uri.place:
        raise DeviceError(f"{uri.text}: no port; expected a URI like cl200a:/dev/ttyUSB0")
    return Cl200a(uri.place, clock.sleep, parity=options.parity)
