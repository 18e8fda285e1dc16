"""Parse the answers of a Delta-T SPN1 (total and diffuse irradiance).

Source: SPN1 User Manual v1.0, appendix B: 9600 8N1; every character is echoed except R; replies end
in CR only. Only R, S and I may be sent: T starts a test mode in which commands change the
calibration permanently.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from fieldlum.errors import DeviceError

AWAKE = b"\xaf"
LARGEST_WM2 = 2500.0  # beyond the range of the instrument, which ends at 2000 (User Manual)
# padded to six characters with blanks or zeros
_SIX = rb"(?=.{6},)( *(?:0|[1-9]\d{0,3})\.\d|0\d{3}\.\d)"
_READING = re.compile(rb"S?" + _SIX + rb"," + _SIX + rb",([01])\r")  # tttt.t,dddd.d,s
# Three differences of answers that are a tenth of a second apart [W/m2] (docs/results/parsers.md):
# the instrument's noise; the largest difference under a steady sky; the largest from the first to
# the third answer at the edge of a shadow, which the sun's half degree and the cloud's own edge
# blur.
NOISE_WM2 = 3.0
AGREE_WM2 = 25.0
STEEPEST_WM2 = 200.0
_STATUS_REPLY = re.compile(rb"(?:[\x20-\x7e]*\r\n?){2,8}")
_SERIAL = re.compile(r"(?m)^ *([A-Z]\d+) *$")
_FIRMWARE = re.compile(r"SPN1 +(v[\w.]+.*)")


@dataclass(frozen=True, slots=True)
class Spn1Reading:
    """One reading: total and diffuse irradiance, and whether the sun shone."""

    total_wm2: float
    diffuse_wm2: float
    sunshine: bool


@dataclass(frozen=True, slots=True)
class Spn1Status:
    """The instrument's answer to the command I; `lines` has all of its lines that are not blank."""

    firmware: str = ""
    serial: str = ""
    lines: tuple[str, ...] = ()


def parse_reading(reply: bytes) -> Spn1Reading:
    """Return the reading in ``S 812.4, 104.9,1<CR>``, with or without the echo S.

    The numbers are total and diffuse [W/m2] and sunshine. Raises DeviceError for any other bytes,
    and for a number over 2500 W/m2. The first two have six characters with one decimal, so that a
    number that lost a character is never read as a smaller one.
    """
    match = _READING.fullmatch(reply)
    if match is None:
        raise DeviceError(
            f"SPN1 answered {reply[:40]!r}; expected total, diffuse, sunshine and a carriage "
            "return; check the cable"
        )
    total, diffuse = float(match[1]), float(match[2])
    if max(total, diffuse) > LARGEST_WM2:
        raise DeviceError(
            f"SPN1 answered {reply[:40]!r}; expected at most {LARGEST_WM2:g} W/m2; check the cable"
        )
    return Spn1Reading(total, diffuse, match[3] == b"1")


def apart_wm2(a: Spn1Reading, b: Spn1Reading) -> float:
    """Return the larger difference of two readings, in total or in diffuse irradiance [W/m2]."""
    return max(abs(x - y) for x, y in zip(_both(a), _both(b), strict=True))


def in_line(a: Spn1Reading, b: Spn1Reading, c: Spn1Reading) -> bool:
    """Return whether `b`, read between `a` and `c`, is half way between them, to 25 W/m2.

    This must hold for the total and the diffuse, and `a` and `c` may differ by at most 200 W/m2. It
    is so in light that rises or falls steadily.
    """
    triples = zip(_both(a), _both(b), _both(c), strict=True)
    return apart_wm2(a, c) <= STEEPEST_WM2 and all(
        abs(y - (x + z) / 2.0) <= AGREE_WM2 for x, y, z in triples
    )


def _both(reading: Spn1Reading) -> tuple[float, float]:
    return reading.total_wm2, reading.diffuse_wm2


def parse_status(reply: bytes) -> Spn1Status:
    """Parse the reply to the command I: lines with firmware, units, radio and serial number.

    reply : without the echo. Raises DeviceError for another reply, and for an instrument with other
    units than W/m2.
    """
    if not (_STATUS_REPLY.fullmatch(reply) and b"SPN1 " in reply):
        raise DeviceError(
            f"SPN1 answered {reply[:40]!r}; expected lines about the instrument; check that this "
            "is the port of an SPN1"
        )
    text = reply.decode("ascii").replace("\r", "\n")
    units = re.search(r"Units: *(\S+)", text)
    if units and units[1].upper().replace("^", "") not in ("W.M-2", "W/M2"):
        raise DeviceError(
            f"SPN1 is set to {units[1]}; expected W.m-2; change the unit with Delta-T's own program"
        )
    firmware, serial = _FIRMWARE.search(text), _SERIAL.search(text)
    lines = tuple(line.strip() for line in text.splitlines() if line.strip())
    return Spn1Status(firmware[1].strip() if firmware else "", serial[1] if serial else "", lines)
