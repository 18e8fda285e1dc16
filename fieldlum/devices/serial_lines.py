"""Open serial pyranometers, and read those that send lines by themselves.

``serial:PLACE?kind=spn1`` or ``?kind=ascii&profile=NAME``; PLACE is a device file or
usb=VID:PID:SERIAL. Nothing is ever sent to an instrument that sends lines.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from statistics import median

from fieldlum.core.errors import DeviceError
from fieldlum.core.records import IrradianceSample
from fieldlum.devices import FORM_ALONE, InstrumentInfo, Pyranometer
from fieldlum.devices.ascii_lines import (
    AsciiProfile,
    body_of,
    load_ascii_profile,
    parse_line,
    sample_of,
)
from fieldlum.devices.clock import Clock
from fieldlum.devices.learned_format import LineForm
from fieldlum.devices.serial_port import SerialPort
from fieldlum.devices.uri import DeviceUri, integer_option, number, one_of
from fieldlum.session import Session

_POLL_S = 0.05  # timeout of one read; only sets how often the port is polled; chosen
# this many bytes without an end mark mean a wrong baud rate; chosen, not measured
_MAX_REST_BYTES = 4096
# Number of lines whose median is taken, and largest time between them, because the light changes
# over longer times. Effect in docs/validation.md.
_VOTES = 3
_MAX_VOTE_STEP_S = 2.0
_REJECTED_STORED = 100  # number of the last rejected lines that `refused` can return
_GUARD = {"none": FORM_ALONE, "xor": "exclusive or", "crc16": "CRC-16"}


def voted(values: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return the median of each quantity over some lines, which all have the same quantities.

    One damaged value out of three is either outside the other two, so that the median omits it, or
    between them, where it does no harm.
    """
    return {quantity: median(line[quantity] for line in values) for quantity in values[-1]}


class LineInstrument:
    """An instrument that sends lines; implements `Pyranometer` and `Streaming`.

    A reading is the newest line since the last reading, or else the next line. If three or more
    lines have arrived, on average at most two seconds apart, each quantity is the median of the
    newest three. Raises DeviceError if the port cannot be opened.
    """

    def __init__(
        self, place: str, profile: AsciiProfile, clock: Clock, *, silence_s: float | None = None
    ) -> None:
        line = profile.line
        self._profile, self._clock = profile, clock
        self._silence_s = line.silence_s if silence_s is None else silence_s
        self._port = SerialPort(place, line, timeout_s=_POLL_S)
        # None: the first line may have begun before the port was opened.
        self._rest: bytes | None = None
        self._form = LineForm()
        self._refused: list[str] = []
        self._last_read_s = clock.boottime()
        self.ignored = 0

    @property
    def info(self) -> InstrumentInfo:
        """Return what the profile states about the instrument."""
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
        """Return a reading; wait for a line if there is none.

        Raises DeviceError if no line that fits the profile and the format of earlier lines arrives
        within the silence time (default: that of the profile), or if the port fails.
        """
        deadline = time.monotonic() + self._silence_s
        why = "no line received; check cable, power and baud rate"
        while True:
            valid: list[tuple[str, dict[str, float]]] = []
            for line in self._lines():
                try:
                    valid.append(self._understood(line))
                except DeviceError as error:
                    self.ignored, why = self.ignored + 1, str(error)
                    reasons = [*self._refused, f"{why}; the line was {line!r}"]
                    self._refused = reasons[-_REJECTED_STORED:]
            if valid:
                return self._reading(valid)
            if time.monotonic() > deadline:
                raise DeviceError(f"{self._port.name}: {why}")

    def _understood(self, line: bytes) -> tuple[str, dict[str, float]]:
        values = parse_line(self._profile, line)
        if reason := self._form.unlike(body_of(self._profile, line)):
            raise DeviceError(f"the line differs from earlier lines: {reason}; check the cable")
        return line.decode("ascii").strip(), values

    def _reading(self, valid: Sequence[tuple[str, dict[str, float]]]) -> IrradianceSample:
        now = self._clock.boottime()
        apart_s = (now - self._last_read_s) / len(valid)
        self._last_read_s = now
        can_vote = len(valid) >= _VOTES and apart_s <= _MAX_VOTE_STEP_S
        newest = valid[-_VOTES:] if can_vote else valid[-1:]
        texts = " | ".join(dict.fromkeys(text for text, _ in newest))
        return sample_of(self._clock.now(), voted([values for _, values in newest]), texts)

    def refused(self) -> list[str]:
        """Return the lines rejected since the last call (the newest 100), each with the reason."""
        refused, self._refused = self._refused, []
        return refused

    def _lines(self) -> list[bytes]:
        """Return the complete lines received; an incomplete line stays for the next call."""
        data = self._port.drain() or self._port.read(1) + self._port.drain()
        if self._rest is None:
            if b"\n" not in data:
                return []
            data = data.partition(b"\n")[2]
            self._rest = b""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > _MAX_REST_BYTES:  # without an end mark the baud rate is wrong
            self._rest = None
        return [line + b"\n" for line in lines]

    def close(self) -> None:
        """Close the port."""
        self._port.close()


def open_pyranometer(
    uri: DeviceUri, *, clock: Clock, session: Session | None = None
) -> Pyranometer:
    """Open the serial pyranometer that a URI names: an SPN1, or one that prints lines.

    Raises DeviceError for unknown options, a missing port, kind or profile, and for an SPN1 that
    does not answer; InputError for a broken profile.
    """
    if not uri.place:
        raise DeviceError(
            f"{uri.text}: no port; expected a URI like serial:/dev/serial/by-id/NAME?kind=spn1"
        )
    kind = one_of("spn1", "ascii")
    if uri.options.get("kind") == "ascii":
        return _open_lines(uri, clock)
    options = uri.read(kind=kind, baud=integer_option(300, 921600), timeout=number(0.1, 60.0))
    if "kind" not in options:
        raise DeviceError(f"{uri.text}: no kind; add ?kind=spn1 or ?kind=ascii&profile=NAME")
    from fieldlum.devices.spn1 import Spn1

    return Spn1(
        uri.place, clock, baud=options.get("baud", 9600), timeout_s=options.get("timeout", 2.0)
    )


def _open_lines(uri: DeviceUri, clock: Clock) -> Pyranometer:
    options = uri.read(kind=str, profile=str, silence=number(0.1, 600.0))
    if "profile" not in options:
        raise DeviceError(
            f"{uri.text}: no profile; add &profile=NAME or &profile= and the path of a TOML file"
        )
    profile = load_ascii_profile(options["profile"])
    return LineInstrument(uri.place, profile, clock, silence_s=options.get("silence"))
