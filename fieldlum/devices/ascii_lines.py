"""Parse lines of instruments that print their readings (Arduino rigs, loggers).

A profile describes the lines: `regex` with named groups, `key-value` (``G=812.4 T=24.1``) or `json`
(one object per line). A line that does not fit its profile raises DeviceError, and none of its
numbers is used.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from functools import reduce
from operator import xor
from typing import Literal

from fieldlum.core.errors import DeviceError, InputError
from fieldlum.core.records import IrradianceSample
from fieldlum.devices.registers import MAX_WM2, MIN_WM2, read_profile
from fieldlum.devices.serial_port import SerialLine
from fieldlum.optics.profiles import shipped

_NUMBER = re.compile(r"[+-]?\d{1,7}(?:\.(\d{1,8}))?(?:[eE][+-]?\d{1,2})?")
_MAX_LINE_BYTES = 1000  # bytes; a longer line has lost its end mark. Chosen, not measured.
# Limits of quantities other than irradiance; a number outside was misread. Chosen wider than any
# instrument housing in use; not measured.
_LIMITS = {"temperature_c": (-60.0, 150.0)}
_CORRECT = "check the cable, or correct the instrument's program or the profile"


@dataclass(frozen=True, slots=True)
class AsciiLine(SerialLine):
    """Settings of the serial line of an instrument that prints its readings.

    silence_s : time without a line [s] after which the instrument counts as silent. It must be
    longer than the restart of an Arduino, because opening the line restarts most of them.
    """

    silence_s: float = 5.0


@dataclass(frozen=True, slots=True)
class AsciiField:
    """One number in a line that an instrument prints: quantity = scale * number + offset.

    key : name of the number in the line, or its group in the pattern. The other fields reject
    damaged numbers: `decimals`, the exact number of digits after the point; `width`, the exact
    number of characters, as printf's %6.1f or %06.1f print; `unit`, the text directly behind the
    number; `lowest` and `highest`, limits of the quantity (None: -200 to 4000 W/m2, -60 to 150 C).
    """

    quantity: Literal["ghi_wm2", "dhi_wm2", "dni_wm2", "temperature_c"]
    key: str
    scale: float = 1.0
    offset: float = 0.0
    decimals: int | None = None
    width: int | None = None
    unit: str = ""
    lowest: float | None = None
    highest: float | None = None


@dataclass(frozen=True, slots=True)
class AsciiProfile:
    """The format of the lines that an instrument prints, from instruments/ascii/NAME.toml.

    pattern : regular expression for the form regex, with a group for each entry's key; only : for
    key-value and json, a line has only the entries' keys, in their order; checksum : the line ends
    in * and hexadecimal digits, which check the text before the *, without a leading $: two digits
    for xor (exclusive or of the bytes, as in NMEA), four for crc16 (CRC-16/MODBUS).
    """

    name: str
    form: Literal["regex", "key-value", "json"]
    entry: tuple[AsciiField, ...]
    pattern: str = ""
    only: bool = False
    checksum: Literal["none", "xor", "crc16"] = "none"
    model: str = ""
    serial: str = ""
    calibration_date: str = ""
    line: AsciiLine = field(default_factory=AsciiLine)


def load_ascii_profile(name: str) -> AsciiProfile:
    """Read the profile of an instrument's lines: a shipped one by name, any other by path.

    A path ends in .toml. Raises DeviceError for an unknown name or a missing file, InputError for a
    broken profile.
    """
    folder = shipped("calibration") / "instruments" / "ascii"
    profile, path = read_profile(AsciiProfile, name, folder, "profile of text lines", "profile=")
    quantities = [e.quantity for e in profile.entry]
    is_repeated = len(set(quantities)) != len(quantities)
    if not {"ghi_wm2", "dhi_wm2", "dni_wm2"} & set(quantities) or is_repeated:
        raise InputError(
            path,
            f"entries for {', '.join(quantities) or 'nothing'}",
            "at least one of ghi_wm2, dhi_wm2 and dni_wm2, and each quantity once",
            "correct the [[entry]] tables",
        )
    if profile.form == "regex":
        try:
            groups = set(re.compile(profile.pattern, re.ASCII).groupindex)
        except re.error as error:
            raise InputError(
                path,
                f"pattern: {error}",
                "a regular expression with named groups",
                "correct the pattern",
            ) from None
        if missing := {e.key for e in profile.entry} - groups:
            raise InputError(
                path,
                f"pattern: no group named {', '.join(sorted(missing))}",
                "a group (?P<key>...) for each [[entry]]",
                "correct the pattern",
            )
    return profile


def parse_line(profile: AsciiProfile, line: bytes) -> dict[str, float]:
    """Return the quantities in one line, which ends in a line feed, by name such as ``ghi_wm2``.

    Raises DeviceError for a line that is damaged or does not fit the profile, and for a quantity
    outside its limits.
    """
    text = body_of(profile, line)
    readers = {"regex": _by_regex, "key-value": _by_keys, "json": _by_json}
    words = readers[profile.form](profile, text)
    values = {
        e.quantity: e.scale * _number(words[e.key], e, text) + e.offset for e in profile.entry
    }
    for entry in profile.entry:
        value = values[entry.quantity]
        low, high = _LIMITS.get(entry.quantity, (MIN_WM2, MAX_WM2))
        low = entry.lowest if entry.lowest is not None else low
        high = entry.highest if entry.highest is not None else high
        if not low <= value <= high:
            raise DeviceError(
                f"line {text[:60]!r}: {entry.quantity} is {value:g}; expected {low:g} to "
                f"{high:g}; check scale and offset of the profile"
            )
    return values


def body_of(profile: AsciiProfile, line: bytes) -> str:
    """Return the text of a complete line without its line end and without its checksum.

    Raises DeviceError for a line without a line feed, of over 1000 bytes, with other bytes than
    ASCII text, or with a missing or wrong checksum.
    """
    text = _complete_text(line)
    return text if profile.checksum == "none" else _without_checksum(text, profile.checksum)


def _complete_text(line: bytes) -> str:
    if not line.endswith(b"\n") or len(line) > _MAX_LINE_BYTES:
        raise DeviceError(
            f"line {line[:60]!r} of {len(line)} bytes; expected at most {_MAX_LINE_BYTES} "
            "bytes and a line feed at the end; check cable and baud rate"
        )
    body = line.rstrip(b"\r\n")
    if not body.isascii() or any(c < 32 and c != 9 for c in body):
        raise DeviceError(
            f"line {line[:60]!r} has bytes that are not ASCII text; check cable and baud rate"
        )
    return body.decode("ascii")


def _without_checksum(text: str, kind: Literal["xor", "crc16"]) -> str:
    body, star, digits = text.rpartition("*")
    data = body.removeprefix("$").encode("ascii")
    due = f"{reduce(xor, data, 0):02X}" if kind == "xor" else f"{crc16(data):04X}"
    if not star:
        raise DeviceError(
            f"line {text[:60]!r} has no checksum; expected * and {len(due)} hexadecimal digits at "
            "its end; use a profile without a checksum, or let the instrument's program print it"
        )
    if digits.upper() != due:
        raise DeviceError(
            f"line {text[:60]!r} has the checksum *{digits[:8]}; expected *{due}; check the cable"
        )
    return body


def crc16(data: bytes) -> int:
    """Return the CRC-16/MODBUS of some bytes: polynomial 0x8005 reflected, start 0xFFFF.

    This equals `_crc16_update` of avr-libc.
    """
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ 0xA001 if crc & 1 else crc >> 1
    return crc


def _by_regex(profile: AsciiProfile, text: str) -> Mapping[str, object]:
    match = re.fullmatch(profile.pattern, text, re.ASCII)
    if match is None:
        raise DeviceError(
            f"line {text[:60]!r} does not fit the pattern of the instrument's profile; correct the "
            "pattern, or the instrument's program"
        )
    return match.groupdict()


def _by_keys(profile: AsciiProfile, text: str) -> Mapping[str, object]:
    """Return the values by key; every word must be key=value, and each key must occur once."""
    texts: dict[str, str] = {}
    for word in re.split(r"[,;\s]+", text.strip(" \t,;")):
        key, equals, value = word.partition("=")
        if not equals or not key or key in texts:
            raise DeviceError(
                f"line {text[:60]!r}: {word!r} is not key=value, or its key occurs twice; "
                f"{_CORRECT}"
            )
        texts[key] = value
    return _having(profile, texts, text)


def _by_json(profile: AsciiProfile, text: str) -> Mapping[str, object]:
    def once(pairs: list[tuple[str, object]]) -> dict[str, object]:
        if len({key for key, _ in pairs}) != len(pairs):
            raise ValueError("a key occurs twice")
        return dict(pairs)

    try:
        # Read numbers as text, so that their decimals can be counted.
        parsed = json.loads(
            text, object_pairs_hook=once, parse_float=str, parse_int=str, parse_constant=str
        )
    except (ValueError, RecursionError):
        parsed = None
    if not isinstance(parsed, dict):
        raise DeviceError(f"line {text[:60]!r} is not a JSON object; {_CORRECT}")
    return _having(profile, parsed, text)


def _having(profile: AsciiProfile, record: Mapping[str, object], text: str) -> Mapping[str, object]:
    keys = [e.key for e in profile.entry]
    if missing := [key for key in keys if key not in record]:
        raise DeviceError(f"line {text[:60]!r} has no key {', '.join(missing)}; {_CORRECT}")
    if profile.only and list(record) != keys:
        raise DeviceError(
            f"line {text[:60]!r} has keys {', '.join(record)}; expected exactly "
            f"{', '.join(keys)}, in this order; {_CORRECT}"
        )
    return record


def _number(value: object, entry: AsciiField, text: str) -> float:
    word = value if isinstance(value, str) else ""
    shown = word.removesuffix(entry.unit)
    match = _NUMBER.fullmatch(shown.strip())
    if (
        match is None
        or (entry.unit and not word.endswith(entry.unit))
        or (entry.decimals is not None and len(match[1] or "") != entry.decimals)
        or (entry.width is not None and len(shown) != entry.width)
        or not math.isfinite(float(match[0]))
    ):
        raise DeviceError(
            f"line {text[:60]!r}: {entry.key} is {value!r}; expected {_form(entry)}; {_CORRECT}"
        )
    return float(match[0])


def _form(entry: AsciiField) -> str:
    form = "a number"
    form += f" of {entry.width} characters" if entry.width is not None else ""
    form += f" with {entry.decimals} decimals" if entry.decimals is not None else ""
    return form + (f" and '{entry.unit}'" if entry.unit else "")


def sample_of(t_utc: datetime, values: Mapping[str, float | None], raw: str) -> IrradianceSample:
    """Return a pyranometer sample of `values`, by name such as ``ghi_wm2``; missing ones are None.

    raw : the instrument's own text, stored with the sample.
    """
    ghi, dhi, dni = values.get("ghi_wm2"), values.get("dhi_wm2"), values.get("dni_wm2")
    return IrradianceSample(t_utc, ghi, dhi, dni, values.get("temperature_c"), raw=raw)
