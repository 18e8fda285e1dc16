"""Read a Delta-T SPN1 (total and diffuse irradiance) on a serial port.

Source: SPN1 User Manual v1.0, appendix B: 9600 8N1; every character is echoed except R; replies end
in CR only. Only R, S and I may be sent: T starts a test mode in which commands change the
calibration permanently.
"""

import re
from collections.abc import Callable
from datetime import datetime
from itertools import combinations

from fieldlum.core.errors import DeviceError
from fieldlum.core.records import IrradianceSample
from fieldlum.devices import InstrumentInfo, Pyranometer
from fieldlum.devices.clock import Clock
from fieldlum.devices.serial_port import SerialLine, SerialPort, closed_on_error

_AWAKE = b"\xaf"  # the instrument's answer to R
MAX_WM2 = 2500.0  # beyond the range of the instrument, which ends at 2000 (User Manual)
# A number that is padded to six characters with blanks or zeros.
_SIX = rb"(?=.{6},)( *(?:0|[1-9]\d{0,3})\.\d|0\d{3}\.\d)"
# total and diffuse irradiance, and 1 for sunshine: tttt.t,dddd.d,s
_READING = re.compile(rb"S?" + _SIX + rb"," + _SIX + rb",[01]\r")
# Differences of answers that are a tenth of a second apart (docs/validation.md): the instrument's
# noise, and the largest difference under a steady sky.
NOISE_WM2 = 3.0
AGREE_WM2 = 25.0
_STATUS_REPLY = re.compile(rb"(?:[\x20-\x7e]*\r\n?){2,8}")  # lines of printable characters
_SERIAL = re.compile(r"(?m)^ *([A-Z]\d+) *$")
_FIRMWARE = re.compile(r"SPN1 +(v[\w.]+.*)")
# Most queries of one reading: a third answer decides if two differ (docs/validation.md). Most
# attempts to wake the instrument: a sleeping SPN1 may lose the first character.
_TRIES = 3


Reading = tuple[float, float]
"""Total and diffuse irradiance [W/m2]."""


def parse_reading(reply: bytes) -> Reading:
    """Return total and diffuse irradiance [W/m2] in an answer such as ``S 812.4, 104.9,1<CR>``.

    reply: with or without the echo S; its last number is 1 for sunshine. Raises DeviceError for any
    other bytes, and for a number over 2500 W/m2. A number that lost a character has no longer six
    characters with one decimal, and is never read as a smaller one.
    """
    match = _READING.fullmatch(reply)
    if match is None:
        raise _unexpected(reply, "total, diffuse, sunshine and a carriage return")
    total, diffuse = float(match[1]), float(match[2])
    if max(total, diffuse) > MAX_WM2:
        raise _unexpected(reply, f"at most {MAX_WM2:g} W/m2")
    return total, diffuse


def _unexpected(reply: bytes, expected: str) -> DeviceError:
    """Return the error for a reply; expected: what it should have been."""
    return DeviceError(f"SPN1 answered {reply[:40]!r}; expected {expected}; check port and cable")


def _difference_wm2(first: Reading, second: Reading) -> float:
    """Return the larger difference of two readings, in total or in diffuse irradiance [W/m2]."""
    return max(abs(a - b) for a, b in zip(first, second, strict=True))


def agreed_sample(t_utc: datetime, ask: Callable[[], bytes]) -> IrradianceSample:
    """Return a reading on which two answers of the instrument agree, because they have no checksum.

    t_utc: time of the reading; ask: queries the instrument for one answer. It is called twice, and
    a third time if the readings differ by more than 3 W/m2 or exactly one answer is damaged; the
    earlier of the two nearest readings is returned, with all different answers, joined by " | ", as
    `raw`. A total over 3 W/m2 below the diffuse gets a status. Raises DeviceError if no two
    readings are within 25 W/m2, or at once if `ask` raises it, for example because the instrument
    is silent.
    """
    answers: list[bytes] = []
    valid: list[Reading] = []
    why = ""
    while len(answers) < _TRIES and (valid or len(answers) < _TRIES - 1):
        answers.append(ask())
        try:
            valid.append(parse_reading(answers[-1]))
        except DeviceError as error:
            why = why or str(error)
        if len(valid) == len(answers) == 2 and _difference_wm2(*valid) <= NOISE_WM2:
            break
    pairs = sorted(combinations(valid, 2), key=lambda pair: _difference_wm2(*pair))
    texts = [a.decode("ascii", "backslashreplace").strip() for a in dict.fromkeys(answers)]
    if not pairs or _difference_wm2(*pairs[0]) > AGREE_WM2:
        disagree = f"no two answers of the instrument agree: {', '.join(texts)}; check the cable"
        raise DeviceError(disagree if valid else why)
    total, diffuse = pairs[0][0]
    status = "total below diffuse" if total < diffuse - NOISE_WM2 else ""
    raw = " | ".join(texts)
    return IrradianceSample(t_utc, ghi_wm2=total, dhi_wm2=diffuse, status=status, raw=raw)


def parse_status(reply: bytes) -> tuple[str, str]:
    """Return firmware and serial number in the reply to the command I; "" where it has none.

    reply : without the echo. Raises DeviceError for another reply, and for an instrument with other
    units than W/m2.
    """
    if not (_STATUS_REPLY.fullmatch(reply) and b"SPN1 " in reply):
        raise _unexpected(reply, "lines about the instrument")
    text = reply.decode("ascii").replace("\r", "\n")
    units = re.search(r"Units: *(\S+)", text)
    if units and units[1].upper().replace("^", "") not in ("W.M-2", "W/M2"):
        remedy = "change the unit with Delta-T's own program"
        raise DeviceError(f"SPN1 is set to {units[1]}; expected W.m-2; {remedy}")
    firmware, serial = _FIRMWARE.search(text), _SERIAL.search(text)
    return firmware[1].strip() if firmware else "", serial[1] if serial else ""


class Spn1(Pyranometer):
    """An SPN1 on a serial port, to which only R (wake), S (reading) and I (description) are sent.

    Raises DeviceError if the port cannot be opened or the instrument does not answer as an SPN1.
    """

    def __init__(self, place: str, clock: Clock, *, baud: int = 9600, timeout_s: float) -> None:
        """Open the port `place`, wake the instrument and read its description.

        timeout_s: longest wait for an answer.
        """
        self._clock = clock
        self._port = SerialPort(place, SerialLine(baud), timeout_s=timeout_s)
        with closed_on_error(self):
            self._wake()
            self._port.write(b"I")
            reply = self._port.read(400)  # its lines have no end mark: until the timeout
            firmware, serial = parse_status(reply.removeprefix(b"I"))
        self.info = InstrumentInfo(
            kind="spn1",
            model="Delta-T SPN1",
            serial=serial,
            firmware=firmware,
            port=self._port.name,
            gives=("ghi", "dhi"),
        )

    def read(self) -> IrradianceSample:
        """Return a reading on which two answers agree, as `agreed_sample` does.

        Raises its errors, and DeviceError if the instrument does not answer.
        """
        return agreed_sample(self._clock.now(), self._ask_reading)

    def _ask_reading(self) -> bytes:
        """Wake the instrument and return its answer to S; raise DeviceError if there is none."""
        self._wake()
        self._port.write(b"S")
        reply = self._port.read_until(b"\r", 64)
        if not reply:
            why = "SPN1 woke, but sends no reading; switch it off and on again"
            raise DeviceError(f"{self._port.name}: {why}")
        return reply

    def _wake(self) -> None:
        """Send R until the answer is 0xAF; raise DeviceError if it is not, three times."""
        answer = b""
        for _ in range(_TRIES):
            self._port.drain()  # late replies to earlier commands
            self._port.write(b"R")
            answer = self._port.read(1)
            if answer == _AWAKE:
                return
        found = f"answered {answer!r}" if answer else "did not answer"
        remedy = "check cable, power and 9600 8N1"
        raise DeviceError(f"{self._port.name}: SPN1 {found} when woken; expected 0xAF; {remedy}")

    def close(self) -> None:
        """Close the port."""
        self._port.close()
