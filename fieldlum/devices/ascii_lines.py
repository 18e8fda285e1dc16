"""Instruments that send a line now and then (Arduino rigs, loggers): what a line means, as data and
pure functions.

A profile says the form: `regex` with named groups, `key-value` (``G=812.4 T=24.1``) or `json` (one
object a line). A line that does not fit in every part gives no number; it is counted, not guessed
at.
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
from pathlib import Path
from typing import Any, Literal

from fieldlum.devices.registers import HIGHEST_WM2, LOWEST_WM2
from fieldlum.errors import DeviceError, InputError
from fieldlum.profiles import build, read_toml, shipped
from fieldlum.records import IrradianceSample

_NUMBER = re.compile(r"[+-]?\d{1,7}(?:\.(\d{1,8}))?(?:[eE][+-]?\d{1,2})?")
_LONGEST = 1000
_LIMITS = {"temperature_c": (-60.0, 150.0)}


@dataclass(frozen=True, slots=True)
class AsciiLine:
    """The serial line. Opening it restarts most Arduinos: their silence after that is waited
    out.
    """

    baud: int = 9600
    bits: int = 8
    parity: Literal["N", "E", "O"] = "N"
    stop: int = 1
    silence_s: float = 5.0  # without a line for this long the instrument counts as dead


@dataclass(frozen=True, slots=True)
class AsciiField:
    """quantity = scale * number + offset.

    What is known of the form tells a damaged number from a whole one: `decimals` exactly so many
    digits after the point; `width` exactly so many characters, as printf's %6.1f or %06.1f fill
    them; `unit` text right behind the number; `lowest` and `highest` of the quantity.
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
    """calibration/instruments/ascii/NAME.toml or an own file."""

    name: str
    form: Literal["regex", "key-value", "json"]
    entry: tuple[AsciiField, ...]
    pattern: str = ""  # of a regex; groups are named as the entries' keys
    only: bool = False  # key-value, json: these keys, in this order, and no others
    # The line ends in * and hexadecimal digits over what stands before it (less a leading $): the
    # exclusive or of its bytes in two, as NMEA's do; or CRC-16/MODBUS in four, which lets no damage
    # of a few bytes pass.
    checksum: Literal["none", "xor", "crc16"] = "none"
    model: str = ""
    serial: str = ""
    calibration_date: str = ""
    line: AsciiLine = field(default_factory=AsciiLine)


def load_ascii_profile(name: str) -> AsciiProfile:
    """By the name of a shipped profile or by path. Raises InputError, or DeviceError for an
    unknown name.
    """
    folder = shipped("calibration") / "instruments" / "ascii"
    path = Path(name) if name.endswith(".toml") else folder / f"{name}.toml"
    if not path.is_file():
        known = ", ".join(sorted(p.stem for p in folder.glob("*.toml")))
        raise DeviceError(
            f"no profile of lines '{name}', there are {known}, or give the path of a TOML"
        )
    profile = build(AsciiProfile, read_toml(path), str(path))
    quantities = [e.quantity for e in profile.entry]
    if not {"ghi_wm2", "dhi_wm2", "dni_wm2"} & set(quantities) or len(set(quantities)) != len(
        quantities
    ):
        raise InputError(
            path,
            f"entries for {', '.join(quantities) or 'nothing'}",
            "an irradiance, each quantity once",
        )
    if profile.form == "regex":
        try:
            groups = set(re.compile(profile.pattern, re.ASCII).groupindex)
        except re.error as error:
            raise InputError(
                path, f"pattern: {error}", "a regular expression with named groups"
            ) from None
        if missing := {e.key for e in profile.entry} - groups:
            raise InputError(
                path,
                f"no group named {', '.join(sorted(missing))}",
                "one in the pattern",
                "(?P<name>...)",
            )
    return profile


def parse_line(profile: AsciiProfile, line: bytes) -> dict[str, float]:
    """Quantities of one whole line, its end mark included. Raises DeviceError for everything
    that does not fit.
    """
    text = body_of(profile, line)
    found = {"regex": _by_regex, "key-value": _by_keys, "json": _by_json}[profile.form](
        profile, text
    )
    values = {
        e.quantity: e.scale * _number(found[e.key], e, text) + e.offset for e in profile.entry
    }
    for entry in profile.entry:
        value, (low, high) = (
            values[entry.quantity],
            _LIMITS.get(entry.quantity, (LOWEST_WM2, HIGHEST_WM2)),
        )
        low, high = (
            entry.lowest if entry.lowest is not None else low,
            entry.highest if entry.highest is not None else high,
        )
        if not low <= value <= high:
            raise DeviceError(
                f"line {text[:60]!r}: {entry.quantity} {value:g}, expected {low:g} to {high:g}"
            )
    return values


def body_of(profile: AsciiProfile, line: bytes) -> str:
    """The text of a whole line, its checksum looked at and taken off. Raises DeviceError."""
    text = _whole_text(line)
    return text if profile.checksum == "none" else _without_checksum(text, profile.checksum)


def _whole_text(line: bytes) -> str:
    if not line.endswith(b"\n") or len(line) > _LONGEST:
        raise DeviceError(f"line {line[:60]!r} has no end")
    body = line.rstrip(b"\r\n")
    if not body.isascii() or any(c < 32 and c != 9 for c in body):
        raise DeviceError(f"line {line[:60]!r} holds bytes that are no text")
    return body.decode("ascii")


def _without_checksum(text: str, kind: Literal["xor", "crc16"]) -> str:
    body, star, digits = text.rpartition("*")
    data = body.removeprefix("$").encode("ascii")
    due = f"{reduce(xor, data, 0):02X}" if kind == "xor" else f"{crc16(data):04X}"
    if not star or digits.upper() != due:
        raise DeviceError(f"line {text[:60]!r}: its checksum is not *{due}")
    return body


def crc16(data: bytes) -> int:
    """CRC-16/MODBUS: polynomial 0x8005 reflected, from 0xFFFF; `_crc16_update` of avr-libc."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ 0xA001 if crc & 1 else crc >> 1
    return crc


def _by_regex(profile: AsciiProfile, text: str) -> dict[str, Any]:
    match = re.fullmatch(profile.pattern, text, re.ASCII)
    if match is None:
        raise DeviceError(f"line {text[:60]!r} does not fit the pattern")
    return match.groupdict()


def _by_keys(profile: AsciiProfile, text: str) -> dict[str, Any]:
    """Every word must be key=value, no key twice, no key of the profile missing."""
    found: dict[str, Any] = {}
    for word in re.split(r"[,;\s]+", text.strip(" \t,;")):
        key, equals, value = word.partition("=")
        if not equals or not key or key in found:
            raise DeviceError(
                f"line {text[:60]!r}: {word!r} is no key=value, or its key stands there twice"
            )
        found[key] = value
    return _having(profile, found, text)


def _by_json(profile: AsciiProfile, text: str) -> dict[str, Any]:
    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        if len({key for key, _ in pairs}) != len(pairs):
            raise ValueError("a key twice")
        return dict(pairs)

    try:
        # Numbers stay texts, so that their decimals can be counted.
        found = json.loads(
            text, object_pairs_hook=once, parse_float=str, parse_int=str, parse_constant=str
        )
    except (ValueError, RecursionError):
        raise DeviceError(f"line {text[:60]!r} is no JSON object") from None
    if not isinstance(found, dict):
        raise DeviceError(f"line {text[:60]!r} is no JSON object")
    return _having(profile, found, text)


def _having(profile: AsciiProfile, found: dict[str, Any], text: str) -> dict[str, Any]:
    keys = [e.key for e in profile.entry]
    if missing := [key for key in keys if key not in found]:
        raise DeviceError(f"line {text[:60]!r} lacks {', '.join(missing)}")
    if profile.only and list(found) != keys:
        raise DeviceError(
            f"line {text[:60]!r} has keys {', '.join(found)}, expected {', '.join(keys)} and no "
            f"others"
        )
    return found


def _number(value: Any, entry: AsciiField, text: str) -> float:
    shown = value.removesuffix(entry.unit) if isinstance(value, str) else ""
    match = _NUMBER.fullmatch(shown.strip())
    if (
        match is None
        or (entry.unit and not value.endswith(entry.unit))
        or (entry.decimals is not None and len(match[1] or "") != entry.decimals)
        or (entry.width is not None and len(shown) != entry.width)
        or not math.isfinite(float(match[0]))
    ):
        raise DeviceError(f"line {text[:60]!r}: {entry.key} is {value!r}, expected {_form(entry)}")
    return float(match[0])


def _form(entry: AsciiField) -> str:
    said = "a number"
    said += f" of {entry.width} characters" if entry.width is not None else ""
    said += f" with {entry.decimals} decimals" if entry.decimals is not None else ""
    return said + (f" and '{entry.unit}'" if entry.unit else "")


def sample_of(t_utc: datetime, values: Mapping[str, float | None], raw: str) -> IrradianceSample:
    """A sample of the quantities there are."""
    ghi, dhi, dni = values.get("ghi_wm2"), values.get("dhi_wm2"), values.get("dni_wm2")
    return IrradianceSample(t_utc, ghi, dhi, dni, values.get("temperature_c"), raw=raw)
