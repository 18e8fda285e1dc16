"""Read instruments that print lines (Arduino rigs, loggers), and open serial pyranometers.

``serial:PLACE?kind=spn1`` or ``?kind=ascii&profile=NAME``; PLACE is a device file or
usb=VID:PID:SERIAL. A profile describes the lines: `regex` with named groups, `key-value`
(``G=812.4 T=24.1``) or `json` (one object per line). A line that does not fit its profile raises
DeviceError, and none of its numbers is used. Nothing is ever sent to such an instrument.
"""

import json
import re
import time
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from operator import xor
from statistics import median
from typing import Annotated, Literal

from msgspec import Meta, Struct

from fieldlum.core.errors import DeviceError, InputError
from fieldlum.core.records import IrradianceSample
from fieldlum.devices import DeviceUri, InstrumentInfo, Pyranometer
from fieldlum.devices.clock import Clock
from fieldlum.devices.modbus import MAX_WM2, MIN_WM2, read_profile
from fieldlum.devices.serial_port import SerialLine, SerialPort
from fieldlum.optics.profiles import shipped
from fieldlum.session import Session

_NUMBER = re.compile(r"[+-]?\d{1,7}(?:\.(\d{1,8}))?(?:[eE][+-]?\d{1,2})?")  # group 1: decimals
_MAX_LINE_BYTES = 1000  # bytes; a longer line has lost its end mark. Chosen, not measured.
# Limits of a plausible temperature; a number outside was misread. Chosen wider than any instrument
# housing in use; not measured.
_TEMPERATURE_LIMITS_C = (-60.0, 150.0)


@dataclass(frozen=True, slots=True)
class AsciiField:
    """One number in a line that an instrument prints: quantity = scale * number + offset.

    key : name of the number in the line, or its group in the pattern. The last three fields reject
    damaged numbers: `decimals` is the exact number of digits after the point, None for any number;
    `lowest` and `highest` are limits of the quantity, None for -200 to 4000 W/m2 or -60 to 150 C.
    """

    quantity: Literal["ghi_wm2", "dhi_wm2", "dni_wm2", "temperature_c"]
    key: str
    scale: float = 1.0
    offset: float = 0.0
    decimals: int | None = None
    lowest: float | None = None
    highest: float | None = None


@dataclass(frozen=True, slots=True)
class AsciiProfile:
    """The format of the lines that an instrument prints, from instruments/ascii/NAME.toml.

    form : how a line states its numbers; entry : the numbers that are used; pattern : regular
    expression for the form regex, with a group for each entry's key; line : settings of the serial
    port; model, serial, calibration_date : of the instrument, "" if not stated; checksum :
    the line ends in * and hexadecimal digits, which check the text before the *, without a leading
    $: two digits for xor (exclusive or of the bytes, as in NMEA), four for crc16 (CRC-16/MODBUS).
    """

    name: str
    form: Literal["regex", "key-value", "json"]
    entry: tuple[AsciiField, ...]
    pattern: str = ""
    checksum: Literal["none", "xor", "crc16"] = "none"
    model: str = ""
    serial: str = ""
    calibration_date: str = ""
    line: SerialLine = field(default_factory=SerialLine)


def load_ascii_profile(name: str) -> AsciiProfile:
    """Return the profile of an instrument's lines: a shipped one by name, any other by path.

    A path ends in .toml. Raises DeviceError for an unknown name or a missing file; InputError for a
    profile without irradiance, with a repeated quantity, or with a pattern that cannot be used.
    """
    folder = shipped("calibration") / "instruments" / "ascii"
    profile, path = read_profile(AsciiProfile, name, folder, "profile of text lines", "profile=")
    quantities = [entry.quantity for entry in profile.entry]
    if len(set(quantities)) < len(quantities) or not set(quantities) - {"temperature_c"}:
        found = f"entries for {', '.join(quantities) or 'nothing'}"
        expected = "at least one of ghi_wm2, dhi_wm2 and dni_wm2, and each quantity once"
        raise InputError(path, found, expected, "correct the [[entry]] tables")
    if profile.form == "regex":
        expected = "a regular expression with a group (?P<key>...) for each [[entry]]"
        try:
            groups = re.compile(profile.pattern, re.ASCII).groupindex
        except re.error as error:
            raise InputError(path, f"pattern: {error}", expected, "correct it") from None
        if missing := [entry.key for entry in profile.entry if entry.key not in groups]:
            found = f"pattern: no group named {', '.join(missing)}"
            raise InputError(path, found, expected, "correct it")
    return profile


def _bad_line(text: str | bytes, why: str) -> DeviceError:
    """Return the error for a line; why: what is wrong with it, such as "has no checksum"."""
    remedy = "check cable and baud rate, or correct the profile or the instrument's program"
    return DeviceError(f"line {text[:60]!r} {why}; {remedy}")


def parse_line(profile: AsciiProfile, line: bytes) -> dict[str, float]:
    """Return the quantities in one line, by names such as ``ghi_wm2`` that state the unit.

    line: with its line feed. Raises DeviceError for a line that is damaged or does not fit the
    profile, and for a quantity outside its limits.
    """
    text = body_of(profile, line)
    words = _PARSERS[profile.form](profile, text)
    if missing := [entry.key for entry in profile.entry if entry.key not in words]:
        raise _bad_line(text, f"has no key {', '.join(missing)}")
    return {entry.quantity: _value(words[entry.key], entry, text) for entry in profile.entry}


def body_of(profile: AsciiProfile, line: bytes) -> str:
    """Return the text of a complete line without its line end and without its checksum.

    Raises DeviceError for a line without a line feed, of over 1000 bytes, with other bytes than
    ASCII text, or with a missing or wrong checksum.
    """
    if not line.endswith(b"\n") or len(line) > _MAX_LINE_BYTES:
        why = f"of {len(line)} bytes has no line feed, or over {_MAX_LINE_BYTES} bytes"
        raise _bad_line(line, why)
    data = line.rstrip(b"\r\n")
    if not data.isascii() or any(byte < ord(" ") and byte != ord("\t") for byte in data):
        raise _bad_line(line, "has bytes that are not ASCII text")
    text = data.decode("ascii")
    if profile.checksum == "none":
        return text
    body, star, digits = text.rpartition("*")
    data = body.removeprefix("$").encode("ascii")
    expected = f"{reduce(xor, data, 0):02X}" if profile.checksum == "xor" else f"{crc16(data):04X}"
    if not star:
        raise _bad_line(text, f"has no checksum; expected * and {len(expected)} hexadecimal digits")
    if digits.upper() != expected:
        raise _bad_line(text, f"has the checksum *{digits[:8]}; expected *{expected}")
    return body


def crc16(data: bytes) -> int:
    """Return the checksum CRC-16/MODBUS of some bytes (polynomial 0x8005 reflected, start 0xFFFF).

    It equals `_crc16_update` of avr-libc, which Arduino programs use.
    """
    from pymodbus.framer import FramerRTU

    # pymodbus returns the two bytes in the order in which Modbus sends them.
    return int.from_bytes(FramerRTU.compute_CRC(data).to_bytes(2, "big"), "little")


def _words_by_regex(profile: AsciiProfile, text: str) -> Mapping[str, object]:
    """Return the texts of the profile's named groups; raise DeviceError if a line does not fit."""
    match = re.fullmatch(profile.pattern, text, re.ASCII)
    if match is None:
        raise _bad_line(text, "does not fit the pattern of the instrument's profile")
    return match.groupdict()


def _words_by_keys(profile: AsciiProfile, text: str) -> Mapping[str, object]:
    """Return the texts of the values in a line of words key=value, by key.

    Raises DeviceError for a word of another form and for a key that occurs twice.
    """
    words = [word.partition("=") for word in re.split(r"[,;\s]+", text.strip(" \t,;"))]
    values = {key: value for key, equals, value in words if key and equals}
    if len(values) < len(words):
        raise _bad_line(text, "has a word that is not key=value, or a key twice")
    return values


def _words_by_json(profile: AsciiProfile, text: str) -> Mapping[str, object]:
    """Return the values of a JSON object by key, numbers as text, so that decimals can be counted.

    Raises DeviceError for a line that is no JSON object, and for a key that occurs twice.
    """

    def without_repeated_keys(pairs: list[tuple[str, object]]) -> dict[str, object]:
        """Return a JSON object as a dict; raise ValueError for a repeated key.

        pairs: its keys and values, as json passes them.
        """
        if len(dict(pairs)) < len(pairs):
            raise ValueError("a key occurs twice")
        return dict(pairs)

    as_text = dict.fromkeys(("parse_float", "parse_int", "parse_constant"), str)
    try:
        parsed = json.loads(text, object_pairs_hook=without_repeated_keys, **as_text)
    except (ValueError, RecursionError):
        parsed = None
    if not isinstance(parsed, dict):
        raise _bad_line(text, "is not a JSON object with each key once")
    return parsed


_PARSERS = {"regex": _words_by_regex, "key-value": _words_by_keys, "json": _words_by_json}


def _value(word: object, entry: AsciiField, text: str) -> float:
    """Return the quantity of an entry, in the unit of its name.

    word: the text of the number; text: of the line, for errors. Raises DeviceError for a word that
    is no number, another number of decimals, and a quantity outside its limits.
    """
    match = _NUMBER.fullmatch(word.strip()) if isinstance(word, str) else None
    if match is None or entry.decimals not in (None, len(match[1] or "")):
        form = f" with {entry.decimals} decimals" if entry.decimals is not None else ""
        raise _bad_line(text, f"has {entry.key} {word!r}; expected a number{form}")
    value = entry.scale * float(match[0]) + entry.offset
    is_irradiance = entry.quantity.endswith("_wm2")
    low, high = (MIN_WM2, MAX_WM2) if is_irradiance else _TEMPERATURE_LIMITS_C
    low = low if entry.lowest is None else entry.lowest
    high = high if entry.highest is None else entry.highest
    if not low <= value <= high:
        raise _bad_line(text, f"has {entry.quantity} {value:g}; expected {low:g} to {high:g}")
    return value


# ----------------------------------------------------------------------------------------------
# the driver

# Time without a line [s] after which the instrument counts as silent: longer than the restart of an
# Arduino, because opening the line restarts most of them.
SILENCE_S = 5.0
_MEDIAN_LINES = 3  # the fewest of which a median rejects one damaged value
_RECENT_LINES = 60  # whose form counts: half a minute to some minutes of a stream; chosen
_ANY_NUMBER = re.compile(r"[ \t]*[+-]?\d+(?:\.(\d+))?(?:[eE][+-]?\d{1,2})?")  # group 1: decimals


class LineForm:
    """The forms of the last 60 lines of a stream, with which each new line is compared.

    The form of a line is the text around its numbers, and how many decimals each number has. A
    damaged line that can still be read often differs in its form from all earlier lines. No profile
    needs to state the form.
    """

    def __init__(self) -> None:
        self._forms: deque[str] = deque(maxlen=_RECENT_LINES)

    def difference(self, text: str) -> str:
        """Return how a line differs in form from earlier lines, and store its form; text: the line.

        The result is "" for the usual form, for the first 20 lines, and while two of the earlier
        lines have another form: after a permanent change, two lines are rejected, then the new form
        is accepted.
        """
        usual, count = Counter(self._forms).most_common(1)[0] if self._forms else ("", 0)
        is_settled = len(self._forms) >= _RECENT_LINES // 3 and len(self._forms) - count <= 1
        form = _ANY_NUMBER.sub(lambda number: "#" + "0" * len(number[1] or ""), text)
        form = re.sub(r"[ \t]+", " ", form)
        self._forms.append(form)
        if not is_settled or form == usual:
            return ""
        return f"its form is {form!r} (# and decimals), and earlier lines have {usual!r}"


class LineInstrument(Pyranometer):
    """An instrument that sends lines of text by itself.

    A reading is the newest line since the last reading, or else the next line. If three or more
    lines have arrived, on average at most two seconds apart, each quantity is the median of the
    newest three, so that one damaged value is not used. Raises DeviceError if the port cannot be
    opened.
    """

    def __init__(
        self, place: str, profile: AsciiProfile, clock: Clock, *, silence_s: float = SILENCE_S
    ) -> None:
        """Open the serial port `place`.

        silence_s: time without a valid line [s] after which reading raises DeviceError.
        """
        self._profile, self._clock, self._silence_s = profile, clock, silence_s
        self._port = SerialPort(place, profile.line, timeout_s=0.05)  # sets how often it is polled
        # Bytes of the line that is incomplete; None before the first line end, because the first
        # line may have begun before the port was opened.
        self._incomplete: bytes | None = None
        self._form = LineForm()
        self._refused: deque[str] = deque(maxlen=100)  # for `refused`
        self._last_read_s = clock.boottime()
        quantities = [entry.quantity for entry in profile.entry]
        self.info = InstrumentInfo(
            kind="ascii",
            model=profile.model or profile.name,
            serial=profile.serial,
            calibration_date=profile.calibration_date,
            port=self._port.name,
            gives=tuple(q.removesuffix("_wm2") for q in quantities if q.endswith("_wm2")),
            is_checked=profile.checksum != "none",
        )

    def read(self) -> IrradianceSample:
        """Return the values of the newest line, or the medians of the newest three if near in time.

        Only lines since the last reading count; without one, wait. Raises DeviceError if no line
        that fits the profile and the form of earlier lines arrives within the silence time
        (default: 5 s), or if the port fails.
        """
        deadline = time.monotonic() + self._silence_s
        why = "no line received; check cable, power and baud rate"
        while True:
            valid: list[tuple[str, dict[str, float]]] = []
            for line in self._lines():
                try:
                    valid.append(self._checked(line))
                except DeviceError as error:
                    why = str(error)
                    self._refused.append(f"{why}; the line was {line!r}")
            if valid:
                return self._reading(valid)
            if time.monotonic() > deadline:
                raise DeviceError(f"{self._port.name}: {why}")

    def _checked(self, line: bytes) -> tuple[str, dict[str, float]]:
        """Return the text of a line and its quantities by name; raise DeviceError if damaged."""
        values = parse_line(self._profile, line)
        if reason := self._form.difference(body_of(self._profile, line)):
            raise DeviceError(f"the line differs from earlier lines: {reason}; check the cable")
        return line.decode("ascii").strip(), values

    def _reading(self, valid: Sequence[tuple[str, dict[str, float]]]) -> IrradianceSample:
        """Return the last line's values, or the medians of the last three if they are near in time.

        valid: text and values of each line since the last reading.
        """
        now_s = self._clock.boottime()
        apart_s = (now_s - self._last_read_s) / len(valid)
        self._last_read_s = now_s
        # over longer times the light changes (docs/validation.md)
        is_median = len(valid) >= _MEDIAN_LINES and apart_s <= 2.0
        texts, values = zip(*valid[-_MEDIAN_LINES if is_median else -1 :], strict=True)
        medians = {name: median(line[name] for line in values) for name in values[-1]}
        return IrradianceSample(self._clock.now(), **medians, raw=" | ".join(dict.fromkeys(texts)))

    def refused(self) -> list[str]:
        """Return the lines rejected since the last call (the newest 100), each with the reason."""
        refused = list(self._refused)
        self._refused.clear()
        return refused

    def _lines(self) -> list[bytes]:
        """Return the complete lines received; an incomplete line is stored for the next call."""
        data = self._port.drain() or self._port.read(1) + self._port.drain()
        if self._incomplete is None:
            if b"\n" not in data:
                return []
            data = data.partition(b"\n")[2]
            self._incomplete = b""
        *lines, self._incomplete = (self._incomplete + data).split(b"\n")
        if len(self._incomplete) > _MAX_LINE_BYTES:  # without a line end the baud rate is wrong
            self._incomplete = None
        return [line + b"\n" for line in lines]

    def close(self) -> None:
        """Close the port."""
        self._port.close()


class _Spn1Options(Struct):
    """Options of the URI of an SPN1; timeout: longest wait for an answer [s]."""

    kind: Literal["spn1", "ascii"]
    baud: Annotated[int, Meta(ge=300, le=921600)] = 9600
    timeout: Annotated[float, Meta(ge=0.1, le=60.0)] = 2.0


class _LineOptions(Struct):
    """Options of the URI of an instrument that prints lines.

    profile: name or path; silence: time without a line after which reading fails [s].
    """

    kind: str
    profile: str
    silence: Annotated[float, Meta(ge=0.1, le=600.0)] = SILENCE_S


def open_pyranometer(uri: DeviceUri, clock: Clock, session: Session | None = None) -> Pyranometer:
    """Open the serial pyranometer that a URI names: an SPN1, or one that prints lines.

    clock: gives the times of readings; session: not used. Raises DeviceError for unknown options, a
    missing port, kind or profile, and for an SPN1 that does not answer; InputError for a profile
    that cannot be used.
    """
    is_ascii = uri.options.get("kind") == "ascii"
    if not uri.place or "kind" not in uri.options or (is_ascii and "profile" not in uri.options):
        expected = "serial:PORT?kind=spn1 or serial:PORT?kind=ascii&profile=NAME"
        raise DeviceError(f"{uri.text}: no port, no kind or no profile; expected {expected}")
    if is_ascii:
        stated = uri.read(_LineOptions)
        profile = load_ascii_profile(stated.profile)
        return LineInstrument(uri.place, profile, clock, silence_s=stated.silence)
    options = uri.read(_Spn1Options)
    from fieldlum.devices.spn1 import Spn1

    return Spn1(uri.place, clock, baud=options.baud, timeout_s=options.timeout)
