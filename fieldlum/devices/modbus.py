"""Read pyranometers on Modbus RTU or TCP: ``modbus:PLACE?kind=smp&unit=1``.

PLACE is a port, usb=VID:PID:SERIAL, or tcp=HOST:PORT of a gateway (port 502 if not stated).

One driver serves all kinds; a register profile describes each. Options: kind (or the path of
another profile), unit, dhi_unit and dni_unit (more instruments of the same kind on the bus), baud,
parity, stop, timeout. Only functions 3 and 4 are sent: no register is ever written.
"""

import logging
import math
import struct
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import date
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

from msgspec import Meta, Struct

from fieldlum.core.errors import DeviceError, InputError, did_you_mean
from fieldlum.core.records import IrradianceSample
from fieldlum.core.strict_toml import build, read_toml
from fieldlum.devices import DeviceUri, InstrumentInfo, Pyranometer
from fieldlum.devices.clock import Clock
from fieldlum.devices.serial_port import SerialLine, SerialPort, closed_on_error, device_errors
from fieldlum.optics.profiles import shipped
from fieldlum.session import Session

# ----------------------------------------------------------------------------------------------
# register profiles

ValueType = Literal["u16", "s16", "u32", "s32", "f32", "date", "text"]
_STRUCT_FORMATS = {"u16": ">H", "s16": ">h", "u32": ">I", "s32": ">i", "f32": ">f", "date": ">I"}
# An irradiance outside these limits means a misread register [W/m2]. Chosen beyond any sun, cloud
# edge and night offset; not measured.
MIN_WM2 = -200.0
MAX_WM2 = 4000.0
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Line(SerialLine):
    """Factory settings of a Modbus line: those of a serial line, and the address `unit`.

    unit : address of the instrument; 0 if it has no default, so that the user must state it.
    """

    baud: int = 19200
    parity: Literal["N", "E", "O"] = "E"
    unit: int = 1


@dataclass(frozen=True, slots=True)
class RegisterBlock:
    """A block of Modbus registers that are read by one request, and therefore at one moment.

    start : address of the first register in a request, from 0; count : how many registers.
    """

    start: int
    count: int

    @property
    def numbers(self) -> range:
        """Addresses of the block's registers."""
        return range(self.start, self.start + self.count)


@dataclass(frozen=True, slots=True)
class Entry:
    """One value of a register profile, such as irradiance_wm2 or the serial number.

    register : address of its first register, from 0; type : an unsigned (u) or signed (s) integer
    of 16 or 32 bits, f32 a float, date a u32 such as 20260115, or text in ASCII; scale : factor
    from the number to the unit of the name; power10_register : register of a power of ten by which
    the number is divided (Kipp & Zonen); words : number of registers of a text; allow : values of a
    status word that mean no fault; empty if it is not checked.
    """

    name: str
    register: int
    type: ValueType = "u16"
    scale: float = 1.0
    power10_register: int | None = None
    words: int = 0
    allow: tuple[int, ...] = ()

    @property
    def own_registers(self) -> range:
        """Addresses of the registers of the value itself."""
        is_text = self.type == "text"  # a register has two bytes
        count = self.words if is_text else struct.calcsize(_STRUCT_FORMATS[self.type]) // 2
        return range(self.register, self.register + count)

    @property
    def registers(self) -> set[int]:
        """Addresses of all registers that the value needs, with that of its power of ten."""
        more = () if self.power10_register is None else (self.power10_register,)
        return {*self.own_registers, *more}


@dataclass(frozen=True, slots=True)
class RegisterProfile:
    """Description of the registers of a kind of instrument: calibration/instruments/KIND.toml.

    kind, maker, models : names of the instrument; source : document that the registers are from;
    poll : blocks that are read for each reading; at_open : more blocks, which are read once; entry
    : the values in the blocks; function : Modbus function that reads holding (3) or input (4)
    registers; largest_request : most registers of one request; line : factory settings; note :
    about the unit number, for an error. 32-bit values have their high word first.
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


class Decoded(NamedTuple):
    """The decoded content of some registers.

    values : numbers by name of the entry, in the unit of that name; texts : all entries as text, by
    name; status : the status words that report a fault, as NAME=NUMBER, or "".
    """

    values: dict[str, float]
    texts: dict[str, str]
    status: str


def read_profile(cls: type[T], name: str, folder: Path, what: str, option: str) -> tuple[T, Path]:
    """Return the profile of an instrument as a record `cls`, and the path of its file.

    name: of a shipped profile in `folder`, or a path that ends in .toml. what, option: kind of the
    profile and option of the URI, for errors. Raises DeviceError for an unknown name or a missing
    file, InputError for a file that does not fit the record.
    """
    path = Path(name) if name.endswith(".toml") else folder / f"{name}.toml"
    if not path.is_file():
        names = sorted(p.stem for p in folder.glob("*.toml"))
        expected = f"expected one of {', '.join(names)}, or the path of a TOML file"
        near = did_you_mean(name, names)
        raise DeviceError(f"no {what} '{name}'; {expected}; correct {option} in the URI{near}")
    return build(cls, read_toml(path), str(path)), path


def load_register_profile(kind: str) -> RegisterProfile:
    """Return the register profile of a kind of instrument: a shipped one, or that of a path.

    A path ends in .toml. Raises DeviceError for an unknown kind or a missing file; InputError for a
    profile with an impossible block, without irradiance, or with an entry outside the blocks that
    are read for it.
    """
    folder = shipped("calibration") / "instruments"
    profile, path = read_profile(RegisterProfile, kind, folder, "instrument", "kind=")
    maximum = profile.largest_request
    for block in (*profile.poll, *profile.at_open):
        if not 0 < block.count <= maximum or not 0 <= block.start <= 65535 - block.count:
            found = f"a block of {block.count} registers from register {block.start}"
            expected = f"1 to {maximum} registers in a request, from 0 to 65535"
            raise InputError(path, found, expected, "correct the block, or split it into two")
    polled = {register for block in profile.poll for register in block.numbers}
    polled_or_at_open = polled.union(*(block.numbers for block in profile.at_open))
    for entry in profile.entry:
        is_irradiance = entry.name == "irradiance_wm2"
        if not entry.registers <= (polled if is_irradiance else polled_or_at_open):
            found = f"registers of entry '{entry.name}' that are in no [[poll]] block"
            raise InputError(path, found, "all of them in such a block", "add them to a block")
    if all(entry.name != "irradiance_wm2" for entry in profile.entry):
        expected = 'an [[entry]] with name = "irradiance_wm2"'
        raise InputError(path, "no entry 'irradiance_wm2'", expected, "add it to the profile")
    return profile


def raw_value(value_type: str, words: Sequence[int]) -> float:
    """Return the number in some registers, before its scale is applied.

    value_type : u16, s16, u32, s32, f32 or date; words : content of one or two 16-bit registers, as
    many as the type has, with the high word first.
    """
    packed = struct.pack(f">{len(words)}H", *words)
    return float(struct.unpack(_STRUCT_FORMATS[value_type], packed)[0])


def date_text(number: float) -> str:
    """Return a date number 20260115 as 2026-01-15; "" unless it is of the years 1990 to 2100."""
    with suppress(ValueError):
        day = date.fromisoformat(f"{number:08.0f}")
        return day.isoformat() if 1990 <= day.year <= 2100 else ""
    return ""


def decode(profile: RegisterProfile, registers: Mapping[int, int]) -> Decoded:
    """Return the values of the profile's entries that are in some registers; others are omitted.

    registers: content of each register, by its number. A value that is not finite is omitted too.
    Raises DeviceError for an irradiance that is not finite or outside -200 to 4000 W/m2, and for a
    power of ten outside -1 to 2.
    """
    values: dict[str, float] = {}
    texts: dict[str, str] = {}
    faults: list[str] = []
    instrument = f"{profile.maker} {profile.kind}"
    for entry in profile.entry:
        if not entry.registers <= registers.keys():
            continue
        words = [registers[number] for number in entry.own_registers]
        if entry.type == "text":
            text = struct.pack(f">{len(words)}H", *words).decode("ascii", "ignore")
            texts[entry.name] = "".join(filter(str.isprintable, text)).strip()
            continue
        number = raw_value(entry.type, words)
        if entry.type == "date":
            texts[entry.name] = date_text(number)
            continue
        if entry.allow and number not in entry.allow:
            faults.append(f"{entry.name}={number:.0f}")
        if entry.power10_register is not None:
            power = raw_value("s16", [registers[entry.power10_register]])
            if not -1 <= power <= 2:
                found = f"a scale factor of 10^{power:g}; expected 10^-1 to 10^2"
                raise DeviceError(f"{instrument}: {found}; check the kind in the URI")
            number /= 10.0**power
        number *= entry.scale
        if entry.name == "irradiance_wm2" and not MIN_WM2 <= number <= MAX_WM2:
            found = f"{number:g} W/m2; expected {MIN_WM2:g} to {MAX_WM2:g} W/m2"
            raise DeviceError(f"{instrument}: {found}; check the kind in the URI")
        if math.isfinite(number):
            values[entry.name], texts[entry.name] = number, f"{number:.10g}"
    return Decoded(values, texts, " ".join(faults))


# ----------------------------------------------------------------------------------------------
# the driver

_Unit = Annotated[int, Meta(ge=1, le=247)]  # addresses of devices on a Modbus line (its standard)


class _Options(Struct):
    """Options of the URI; None for the profile's setting.

    kind: name or path of the register profile; unit, dhi_unit, dni_unit: addresses of the
    instruments for global, diffuse and direct irradiance; baud, parity, stop: of the serial line;
    timeout: longest wait for an answer [s].
    """

    kind: str = ""
    unit: _Unit | None = None
    dhi_unit: _Unit | None = None
    dni_unit: _Unit | None = None
    baud: Annotated[int, Meta(ge=300, le=115200)] | None = None
    parity: Literal["N", "E", "O"] | None = None
    stop: Annotated[int, Meta(ge=1, le=2)] | None = None
    timeout: Annotated[float, Meta(ge=0.05, le=30.0)] = 0.5


class ModbusPyranometer(Pyranometer):
    """One instrument, or several of one kind that measure different quantities, on one bus.

    bus : pymodbus's client, and the name of its port or host; units : the address of the instrument
    that measures ghi, dhi or dni, by quantity. Raises DeviceError if an instrument does not answer
    or its answer is damaged or impossible.
    """

    def __init__(
        self, bus: tuple[Any, str], profile: RegisterProfile, units: Mapping[str, int], clock: Clock
    ) -> None:
        """Ask each instrument for its description.

        In `info`, models, serial numbers, firmware and sensitivities of several instruments are
        joined by " + "; the calibration date is the oldest.
        """
        self._profile, self._units, self._clock = profile, units, clock
        self._client, self.name = bus
        blocks = profile.at_open + profile.poll
        with closed_on_error(self):
            answers = [self._ask(unit, blocks)[0] for unit in units.values()]

        def texts(name: str) -> list[str]:
            """Return the texts that the instruments answered for an entry; name: of the entry."""
            return [text for answer in answers if (text := answer.texts.get(name))]

        names = ("model", "serial", "firmware", "sensitivity")
        about: dict[str, Any] = {name: " + ".join(texts(name)) for name in names}
        about["model"] = about["model"] or f"{profile.maker} {profile.models[0]}"
        about["calibration_date"] = min(texts("calibration_date"), default="")
        about["status"] = " ".join(answer.status for answer in answers if answer.status)
        self.info = InstrumentInfo(profile.kind, **about, port=self.name, gives=tuple(units))

    def read(self) -> IrradianceSample:
        """Read all instruments, one after the other, and return one reading with the first's time.

        The temperature is that of the first instrument that reports one; `status` has the faults by
        quantity, and `raw` the polled registers. Raises DeviceError if an instrument does not
        answer, or if its answer is damaged or impossible.
        """
        t_utc, poll = self._clock.now(), self._profile.poll
        answers = {quantity: self._ask(unit, poll) for quantity, unit in self._units.items()}
        decoded = {quantity: answer for quantity, (answer, _) in answers.items()}
        light = {f"{name}_wm2": answer.values["irradiance_wm2"] for name, answer in decoded.items()}
        faults = [f"{name}: {answer.status}" for name, answer in decoded.items() if answer.status]
        temperatures = (answer.values.get("temperature_c") for answer in decoded.values())
        return IrradianceSample(
            t_utc,
            **light,
            temperature_c=next((t for t in temperatures if t is not None), None),
            status="; ".join(faults),
            raw="; ".join(raw for _, raw in answers.values()),
        )

    def _ask(self, unit: int, blocks: tuple[RegisterBlock, ...]) -> tuple[Decoded, str]:
        """Return the values in some register blocks of one instrument, and its polled registers.

        unit: address of the instrument. The registers are a text of hexadecimal words. Raises
        DeviceError without a valid answer.
        """
        registers: dict[int, int] = {}
        for block in blocks:
            registers.update(zip(block.numbers, self._words(unit, block), strict=True))
        polled = (number for block in self._profile.poll for number in block.numbers)
        return decode(self._profile, registers), " ".join(f"{registers[n]:04x}" for n in polled)

    def _words(self, unit: int, block: RegisterBlock) -> list[int]:
        """Return the 16-bit content of each register of a block, read from one instrument.

        unit: address of the instrument. Raises DeviceError if it does not answer or rejects the
        request.
        """
        from pymodbus.exceptions import ModbusException

        instrument = f"{self.name}: {self._profile.kind} unit {unit}"
        name = {3: "read_holding_registers", 4: "read_input_registers"}[self._profile.function]
        try:
            with device_errors(self.name):
                read = getattr(self._client, name)
                answer = read(block.start, count=block.count, device_id=unit)
        except ModbusException:  # no answer, one with a wrong checksum, or a lost connection
            remedy = "check wiring, power, unit number, baud rate and parity"
            raise DeviceError(f"{instrument} does not answer; {remedy}") from None
        if answer.isError() or len(answer.registers) != block.count:
            why = f"refused or cut the registers ({answer}); check the kind"
            raise DeviceError(f"{instrument} {why}")
        return answer.registers

    def close(self) -> None:
        """Close the port or the connection; ignore errors of a port that was unplugged."""
        with suppress(DeviceError), device_errors(self.name):
            self._client.close()


def _connected(place: str, line: SerialLine, timeout_s: float) -> tuple[Any, str]:
    """Return pymodbus's client of a bus, and the name of the bus: its port, or tcp=HOST:PORT.

    place: tcp=HOST or tcp=HOST:PORT, a device file, or usb=VID:PID; line: settings of a serial
    port; timeout_s: longest wait for an answer. The client sends each request once. Raises
    DeviceError if there is no connection.
    """
    from pymodbus.client import ModbusSerialClient, ModbusTcpClient

    # A missing answer raises an error here; pymodbus would print it too.
    logging.getLogger("pymodbus.logging").setLevel(logging.CRITICAL)
    if place.startswith("tcp="):
        host, _, port = place.removeprefix("tcp=").partition(":")
        if not host or not (port or "502").isdecimal():
            raise DeviceError(f"modbus:{place}: no host; expected one like modbus:tcp=10.0.0.7:502")
        client = ModbusTcpClient(host, port=int(port or 502), timeout=timeout_s, retries=0)
        if not client.connect():
            raise DeviceError(f"{place}: no connection; check host, port, cable and power")
        return client, place
    port = SerialPort(place, line, timeout_s=timeout_s)
    client = ModbusSerialClient(port.name, baudrate=line.baud, timeout=timeout_s, retries=0)
    client.socket = port.port
    return client, port.name


def open_pyranometer(uri: DeviceUri, clock: Clock, session: Session | None = None) -> Pyranometer:
    """Open the Modbus pyranometer, or the several of one kind on its bus, that a URI names.

    clock: gives the times of readings; session: not used. Raises DeviceError for unknown options or
    kinds, a missing or repeated unit number, a missing port, or an instrument that does not answer
    or gives an impossible value; InputError for a profile that cannot be used.
    """
    options = uri.read(_Options)
    if not uri.place or not options.kind:
        example = "modbus:/dev/ttyUSB0?kind=smp&unit=1"
        raise DeviceError(f"{uri.text}: expected a port and a kind, such as {example}")
    profile = load_register_profile(options.kind)
    ghi_unit = options.unit or profile.line.unit
    if not ghi_unit:
        why = f"no unit number, and {profile.kind} has no default"
        raise DeviceError(f"{uri.text}: {why}; add it to the URI: {profile.note}")
    stated_units = {"ghi": ghi_unit, "dhi": options.dhi_unit, "dni": options.dni_unit}
    units = {quantity: unit for quantity, unit in stated_units.items() if unit}
    if len(set(units.values())) < len(units):
        raise DeviceError(f"{uri.text}: a unit number occurs twice; each unit needs its own")
    stated = {"baud": options.baud, "parity": options.parity, "stop": options.stop}
    line = replace(profile.line, **{name: value for name, value in stated.items() if value})
    return ModbusPyranometer(_connected(uri.place, line, options.timeout), profile, units, clock)
