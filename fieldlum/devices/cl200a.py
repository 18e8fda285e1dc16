"""Konica Minolta CL-200A and T-10A: vertical illuminance at the lens, as a check of each bracket.

Sources: Konica Minolta technical note CS-A32T (CL-200A); the T-10 communication manual (T-10-E) as
two public drivers follow it. 9600 7E1; frames STX .. ETX BCC CR LF, where BCC is the exclusive or
of all bytes after STX up to and including ETX, as two hexadecimal digits. None of the commands that
are sent changes the calibration.
"""

import re
from collections.abc import Callable
from functools import reduce
from operator import xor
from typing import Annotated, Literal

from msgspec import Meta, Struct

from fieldlum.core.errors import DeviceError
from fieldlum.devices import DeviceUri, IlluminanceMeter, InstrumentInfo, retry
from fieldlum.devices.clock import Clock
from fieldlum.devices.serial_port import SerialLine, SerialPort, closed_on_error

# Commands of CS-A32T: receptor head (99: all), number of the command, four parameters. The T-10 has
# the same first one.
PC_MODE = b"00541   "
HOLD = b"99551  0"
EXT_ON = b"004010  "
MEASURE = b"994021  "
READ_EVXY = b"00021200"
# After the number of a head: running, without the user's factor (CCF), automatic range.
READ_T10 = b"100200"
STX, ETX = b"\x02", b"\x03"  # marks of a frame: start and end of its text
_ERRORS = {
    "1": "the receptor head was switched off; restart the meter",
    "2": "memory error; restart the meter",
    "3": "memory error; restart the meter",
    "5": "the light is over the meter's range; measure in less light",
    "7": "the light is out of the meter's range; measure in other light",
}
_Parity = Literal["E", "N"]
_PAUSE_S = 0.5  # that the meter needs after PC mode, hold and measure (CS-A32T)
_RANGE_PAUSE_S = 3.0  # that a T-10 needs to find its range
# Head and command; status (hold, error, range, battery); then Ev, x and y.
_ANSWER = re.compile(r"(?s)\d{4}.(?P<error>.)(?P<range>.).(?P<values>([+\-=][ \d]{4}\d){3})")
# The same status; after the illuminance two differences, or spaces.
_T10_ANSWER = re.compile(
    r"(?s)(?P<head>\d{2})10.(?P<error>.)(?P<range>.).(?P<lux>[+\-=][ \d]{4}\d).{12}"
)


class NotReady(DeviceError):
    """The meter changes its range, or has not measured yet; a new measurement may succeed."""


def bcc(body: bytes) -> bytes:
    """Return the two hexadecimal check digits of a frame (BCC).

    body: its text, without STX and ETX.
    """
    return b"%02X" % reduce(xor, body + ETX)


def frame(body: bytes) -> bytes:
    """Return a command as it is sent: STX, the text `body`, ETX, check digits, CR and LF."""
    return STX + body + ETX + bcc(body) + b"\r\n"


def unframe(reply: bytes) -> str:
    """Return the text in a frame that the meter sent, without marks and check digits.

    Raises DeviceError for an incomplete frame or wrong check digits.
    """
    match = re.fullmatch(rb"\x02([^\x02\x03]*)\x03([0-9A-F]{2})\r\n", reply)
    if match is None or bcc(match[1]) != match[2] or not match[1].isascii():
        expected = "expected a frame with the right check digits"
        raise DeviceError(f"the meter answered {reply[:40]!r}; {expected}; check the cable")
    return match[1].decode("ascii")


def _value(text: str) -> float:
    """Return the number in six characters: sign, four digits and exponent.

    '+12345' is 1234 x 10^(5 - 4). An equals sign in place of the sign means plus or minus zero.
    Raises DeviceError for a number without digits.
    """
    sign, digits, exponent = text[0], text[1:5].replace(" ", ""), int(text[5])
    if not digits:
        raise DeviceError(f"the meter sent a value {text!r} without digits; check the cable")
    return (-1.0 if sign == "-" else 1.0) * float(digits) * 10.0 ** (exponent - 4)


def parse_answer(reply: bytes) -> float:
    """Return the illuminance [lx] in a CL-200A's answer to command 02 (read Ev, x and y).

    reply: a frame (`unframe`). Raises DeviceError for a damaged answer, an error that the meter
    reports, an illuminance outside 0 to 200 000 lx, or an impossible x or y; NotReady, a
    DeviceError, if the meter changes its range or has not measured yet.
    """
    body = unframe(reply)
    answer = _ANSWER.fullmatch(body)
    if answer is None:
        why = f"an answer without values ({body[:30]!r})"
        is_error = len(body) == 8  # head, command and status alone
        raise DeviceError(f"CL-200A: {_ERRORS.get(body[5:6], why) if is_error else why}")
    if answer["error"] in _ERRORS:
        raise DeviceError(f"CL-200A: {_ERRORS[answer['error']]}")
    if answer["error"] == "4":
        raise NotReady("CL-200A has not measured yet; wait some seconds, then read it again")
    if answer["range"] == "6":
        raise NotReady("CL-200A changes its range; read it again in steady light")
    illuminance_lx, x, y = (_value(answer["values"][i : i + 6]) for i in (0, 6, 12))
    if not (0.0 <= illuminance_lx <= 200_000.0 and 0.0 <= x <= 1.0 and 0.0 <= y <= 1.0):
        found = f"{illuminance_lx:g} lx with chromaticity x {x:g}, y {y:g}"
        expected = "expected 0 to 200000 lx and x, y from 0 to 1"
        raise DeviceError(f"CL-200A: {found}; {expected}; read it again in less light")
    return illuminance_lx


def parse_t10_answer(reply: bytes, head: int) -> float:
    """Return the illuminance [lx] in a T-10's answer about a receptor head; head: 0 to 29.

    reply: a frame (`unframe`). Raises DeviceError for a damaged answer, one of another head, an
    error that the meter reports, or an illuminance outside 0 to 299 900 lx, its range; NotReady, a
    DeviceError, while the meter has no range.
    """
    body = unframe(reply)
    answer = _T10_ANSWER.fullmatch(body)
    if answer is None or int(answer["head"]) != head:
        found = f"T-10A: head {head:02d} was asked; the answer is {body[:30]!r}"
        raise DeviceError(f"{found}; expected its values; check the heads' rotary switches")
    error = answer["error"]
    if error not in " 7":  # both: normal operation
        raise DeviceError(f"T-10A: {_ERRORS.get(error, f'error {error}; restart the meter')}")
    if answer["range"] not in "12345":  # another character while it has none
        raise NotReady("T-10A changes its range; read it again in steady light")
    illuminance_lx = _value(answer["lux"])
    if not 0.0 <= illuminance_lx <= 299_900.0:
        expected = "expected 0 to 299900 lx"
        raise DeviceError(f"T-10A: {illuminance_lx:g} lx; {expected}; set its zero again")
    return illuminance_lx


class FramedMeter(IlluminanceMeter):
    """A CL-200A, or one receptor head of a chain of T-10A, on a serial port.

    place : the port; sleep : waits for a number of seconds; parity : "N" for 8 bits without parity
    in place of 7 bits with even parity, for converters that remove it, and for tests on a pty; head
    : of a T-10A, 0 to 29 as set on its rotary switch; None for a CL-200A. Raises DeviceError if the
    port cannot be opened, or if the meter does not answer or its answer is damaged.
    """

    def __init__(
        self, place: str, sleep: Callable[[float], None], *, parity: _Parity, head: int | None
    ) -> None:
        """Open the port and prepare the meter; head: number of a T-10A's head, None: a CL-200A."""
        self._sleep, self._head = sleep, head
        line = SerialLine(bits=7 if parity == "E" else 8, parity=parity)
        self._port = SerialPort(place, line, timeout_s=1.5)
        kind, self._model = ("cl200a", "CL-200A") if head is None else ("t10a", "T-10A")
        model, gives = f"Konica Minolta {self._model}", ("illuminance",)
        self.info = InstrumentInfo(kind, model=model, port=self._port.name, gives=gives)
        with closed_on_error(self):
            self._answer(PC_MODE)
            sleep(_PAUSE_S)
            if head is None:
                self._port.write(frame(HOLD))
                sleep(_PAUSE_S)
                self._answer(EXT_ON)
                sleep(_PAUSE_S)
            else:  # sets range and factor; the answer's value was measured before
                self._answer(b"%02d" % head + READ_T10)
                sleep(_RANGE_PAUSE_S)

    def read(self) -> float:
        """Measure, up to four times until the meter is ready, and return the illuminance [lx].

        Raises DeviceError if the meter does not answer or is not ready after four measurements, or
        if its answer is damaged, impossible or reports an error.
        """
        return retry(self._measure, lambda error: isinstance(error, NotReady))

    def _measure(self) -> float:
        """Measure once and return the illuminance [lx]; raise NotReady if a repetition may help."""
        if self._head is None:
            self._port.drain()
            self._port.write(frame(MEASURE))
        self._sleep(_PAUSE_S)
        if self._head is None:
            return parse_answer(self._answer(READ_EVXY))
        return parse_t10_answer(self._answer(b"%02d" % self._head + READ_T10), self._head)

    def _answer(self, command: bytes) -> bytes:
        """Send a command and return the frame of the answer; raise DeviceError without a valid one.

        command: the text of its frame.
        """
        self._port.drain()
        self._port.write(frame(command))
        reply = self._port.read_until(b"\r\n", 128)
        if not reply:
            why = f"{self._model} does not answer; switch it on and check its cable"
            raise DeviceError(f"{self._port.name}: {why}")
        unframe(reply)
        return reply

    def close(self) -> None:
        """Close the port."""
        self._port.close()


class _Options(Struct):
    """Options of the URI of a CL-200A; parity: E for even, N for none."""

    parity: _Parity = "E"


class _ChainOptions(_Options):
    """Options of the URI of a T-10A; head: number of its receptor head in the chain."""

    head: Annotated[int, Meta(ge=0, le=29)] = 0


def open_meter(uri: DeviceUri, *, clock: Clock) -> FramedMeter:
    """Open the meter of ``cl200a:/dev/serial/by-id/...`` or ``t10a:/dev/serial/by-id/...?head=3``.

    clock: waits for the meter. Options: parity, E (default) or N; of t10a also head, 0 (default) to
    29. Raises DeviceError for an unknown option or value, a missing port, or no answer.
    """
    options = uri.read(_ChainOptions if uri.scheme == "t10a" else _Options)
    head = options.head if isinstance(options, _ChainOptions) else None
    if not uri.place:
        expected = f"expected a URI like {uri.scheme}:/dev/ttyUSB0"
        raise DeviceError(f"{uri.text}: no port; {expected}")
    return FramedMeter(uri.place, clock.sleep, parity=options.parity, head=head)
