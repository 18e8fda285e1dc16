"""Decode the registers of instruments, as profiles describe them."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeVar

from fieldlum.core.errors import DeviceError, InputError
from fieldlum.core.strict_toml import build, read_toml
from fieldlum.devices.serial_port import SerialLine
from fieldlum.optics.profiles import shipped

Kind = Literal["u16", "s16", "u32", "s32", "f32", "date", "text"]
WORDS = {"u16": 1, "s16": 1, "u32": 2, "s32": 2, "f32": 2, "date": 2}
# An irradiance outside these limits means a misread register [W/m2]. Chosen beyond any sun, cloud
# edge and night offset; not measured.
MIN_WM2 = -200.0
MAX_WM2 = 4000.0
Registers = Mapping[int, int]
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Line(SerialLine):
    """Factory settings of a Modbus line.

    unit : the instrument's address; 0: there is no default, so that the user must state it.
    """

    baud: int = 19200
    parity: Literal["N", "E", "O"] = "E"
    unit: int = 1


@dataclass(frozen=True, slots=True)
class RegisterBlock:
    """A block of Modbus registers that are read by one request, and therefore at one moment."""

    start: int
    count: int

    @property
    def numbers(self) -> range:
        """Numbers of the block's registers."""
        return range(self.start, self.start + self.count)


@dataclass(frozen=True, slots=True)
class Entry:
    """One value of a register profile: its name, first register, type and scale (a factor).

    power10_register : the number is divided by ten to the power in that register (Kipp & Zonen);
    words : number of registers of a text; allow : values of a status word without a fault; another
    value makes the sample suspect (empty: no check).
    """

    name: str
    register: int
    type: Kind = "u16"
    scale: float = 1.0
    power10_register: int | None = None
    words: int = 0
    allow: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class RegisterProfile:
    """Description of the registers of a kind of instrument: calibration/instruments/KIND.toml.

    poll : blocks of each reading; at_open : more blocks, read once; function : read holding (3) or
    input (4) registers, no other function is ever sent; largest_request : number of registers; note
    : about the unit number, for an error. 32-bit values have their high word first.
    """

    kind: str
    maker: str
    models: tuple[str, ...]
    source: str
    poll: tuple[RegisterBlock, ...]
    entry: tuple[Entry, ...]
    function: Literal[3, 4] = 3
    at_open: tuple[RegisterBlock, ...] = ()
    largest_request: int = 125
    line: Line = field(default_factory=Line)
    note: str = ""


@dataclass(frozen=True, slots=True)
class Decoded:
    """The decoded content of some registers.

    values : numbers by name of the entry; texts : texts and dates by name of the entry; status :
    the status words that report a fault, as NAME=NUMBER, or "".
    """

    values: dict[str, float]
    texts: dict[str, str]
    status: str


def known_kinds() -> list[str]:
    """Return the kinds of the shipped profiles, sorted."""
    return sorted(p.stem for p in (shipped("calibration") / "instruments").glob("*.toml"))


def read_profile(cls: type[T], name: str, folder: Path, what: str, option: str) -> tuple[T, Path]:
    """Return the profile of an instrument and its file: a shipped one by name, others by path.

    A path ends in .toml. folder: of the shipped profiles; what, option: the kind of profile and the
    URI's option, for the DeviceError of an unknown name or a missing file. Raises InputError for a
    broken profile.
    """
    path = Path(name) if name.endswith(".toml") else folder / f"{name}.toml"
    if not path.is_file():
        names = ", ".join(sorted(p.stem for p in folder.glob("*.toml")))
        raise DeviceError(
            f"no {what} '{name}'; expected one of {names}, or the path of a TOML file; correct "
            f"{option} in the URI"
        )
    return build(cls, read_toml(path), str(path)), path


def load_register_profile(kind: str) -> RegisterProfile:
    """Read a profile of registers: a shipped one by kind, any other by path.

    A path ends in .toml. Raises InputError for a broken profile, DeviceError for an unknown kind or
    a missing file.
    """
    folder = shipped("calibration") / "instruments"
    profile, path = read_profile(RegisterProfile, kind, folder, "instrument", "kind=")
    for block in (*profile.poll, *profile.at_open):
        if (
            not 0 < block.count <= profile.largest_request
            or not 0 <= block.start <= 65535 - block.count
        ):
            raise InputError(
                path,
                f"a [[poll]] or [[at_open]] block of {block.count} registers from register "
                f"{block.start}",
                f"1 to {profile.largest_request} registers in a request, from 0 to 65535",
                "correct the block, or split it into two",
            )
    polled = {r for block in profile.poll for r in block.numbers}
    read = polled | {r for block in profile.at_open for r in block.numbers}
    for entry in profile.entry:
        if not _needed_registers(entry) <= (polled if entry.name == "irradiance_wm2" else read):
            raise InputError(
                path,
                f"registers of entry '{entry.name}' that are in no [[poll]] block",
                "all registers of each entry in such a block",
                "add these registers to a [[poll]] block",
            )
    if "irradiance_wm2" not in {e.name for e in profile.entry}:
        raise InputError(
            path,
            "no entry 'irradiance_wm2'",
            'an [[entry]] with name = "irradiance_wm2"',
            "add it, with register and type; its registers must be in a [[poll]] block",
        )
    return profile


def _own_registers(entry: Entry) -> range:
    count = entry.words if entry.type == "text" else WORDS[entry.type]
    return range(entry.register, entry.register + count)


def _needed_registers(entry: Entry) -> set[int]:
    scale = set() if entry.power10_register is None else {entry.power10_register}
    return scale.union(_own_registers(entry))


def raw_value(kind: str, words: Iterable[int]) -> float:
    """Return the number in `words`, 16-bit registers with the high word first.

    kind : u16, s16, u32, s32, f32 or date.
    """
    data = b"".join(struct.pack(">H", w) for w in words)
    code = {"u16": ">H", "s16": ">h", "u32": ">I", "s32": ">i", "f32": ">f", "date": ">I"}[kind]
    return float(struct.unpack(code, data)[0])


def date_text(number: float) -> str:
    """Return 20260115 as 2026-01-15; "" unless it is a year 1990 to 2100, month and day 1 to 31."""
    text = f"{number:.0f}"
    plausible = (
        len(text) == 8
        and "1990" <= text[:4] <= "2100"
        and "01" <= text[4:6] <= "12"
        and "01" <= text[6:] <= "31"
    )
    return f"{text[:4]}-{text[4:6]}-{text[6:]}" if plausible else ""


def _text(words: Iterable[int]) -> str:
    data = b"".join(struct.pack(">H", w) for w in words)
    return "".join(c for c in data.decode("ascii", "ignore") if c.isprintable()).strip()


def decode(profile: RegisterProfile, registers: Registers) -> Decoded:
    """Return the profile's entries whose registers are in `registers` (content by number), decoded.

    A value that is not finite is omitted. Raises DeviceError for an irradiance that is not finite
    or outside -200 to 4000 W/m2, and for a power of ten outside -1 to 2.
    """
    values: dict[str, float] = {}
    texts: dict[str, str] = {}
    complaints = []
    for entry in profile.entry:
        if not _needed_registers(entry) <= registers.keys():
            continue
        words = [registers[r] for r in _own_registers(entry)]
        if entry.type == "text":
            texts[entry.name] = _text(words)
            continue
        number = raw_value(entry.type, words)
        if entry.type == "date":
            texts[entry.name] = date_text(number)
            continue
        if entry.allow and number not in entry.allow:
            complaints.append(f"{entry.name}={number:.0f}")
        if entry.power10_register is not None:
            number /= 10.0 ** _power(registers[entry.power10_register], profile)
        values[entry.name] = number * entry.scale
    irradiance = values.get("irradiance_wm2")
    if irradiance is not None and not (
        math.isfinite(irradiance) and MIN_WM2 <= irradiance <= MAX_WM2
    ):
        raise DeviceError(
            f"{profile.maker} {profile.kind}: an irradiance of {irradiance:g} W/m2; expected "
            f"{MIN_WM2:g} "
            f"to {MAX_WM2:g} W/m2; check the kind in the URI"
        )
    return Decoded(
        {k: v for k, v in values.items() if math.isfinite(v)}, texts, " ".join(complaints)
    )


def _power(word: int, profile: RegisterProfile) -> int:
    power = int(raw_value("s16", [word]))
    if not -1 <= power <= 2:
        raise DeviceError(
            f"{profile.maker} {profile.kind}: a scale factor of 10^{power}; expected "
            "10^-1 to 10^2; check the kind in the URI"
        )
    return power
