"""Read pyranometers on Modbus RTU or TCP: ``modbus:PLACE?kind=smp&unit=1``.

PLACE is a port, usb=VID:PID:SERIAL, or tcp=HOST:PORT of a gateway (port 502 if not stated).

One driver serves all kinds; a register profile describes each. Options: kind (or the path of
another profile), unit, dhi_unit and dni_unit (more instruments of the same kind on the bus), baud,
parity, stop, timeout. Only functions 3 and 4 are sent: no register is ever written.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from fieldlum.core.errors import DeviceError
from fieldlum.core.records import IrradianceSample
from fieldlum.devices import InstrumentInfo
from fieldlum.devices.clock import Clock
from fieldlum.devices.registers import (
    Decoded,
    RegisterBlock,
    RegisterProfile,
    decode,
    load_register_profile,
)
from fieldlum.devices.serial_port import SerialLine, SerialPort, closed_on_error, device_errors
from fieldlum.devices.uri import DeviceUri, integer_option, number, one_of
from fieldlum.session import Session


@dataclass(frozen=True, slots=True)
class Unit:
    """One instrument on a Modbus bus: what it measures (ghi, dhi or dni), and its address."""

    measures: str  # ghi, dhi or dni
    address: int


class ModbusPyranometer:
    """One instrument, or several of one kind, on one bus; implements `Pyranometer`.

    Raises DeviceError if the port cannot be opened, or if an instrument does not answer or its
    answer is damaged or impossible.
    """

    def __init__(
        self,
        place: str,
        profile: RegisterProfile,
        line: SerialLine,
        units: Sequence[Unit],
        clock: Clock,
        *,
        timeout_s: float,
    ) -> None:
        self._profile, self._units, self._clock = profile, tuple(units), clock
        self._client, self.name = _connected(place, line, timeout_s)
        with closed_on_error(self):
            self._about = [
                self._ask(unit, profile.at_open + profile.poll)[0] for unit in self._units
            ]

    @property
    def info(self) -> InstrumentInfo:
        """Return what the instruments and the profile state.

        Models, serial numbers, firmware and sensitivities of several instruments are joined by
        " + "; the calibration date is the oldest.
        """

        def texts(name: str) -> str:
            parts = [d.texts.get(name) or _integer_text(d.values.get(name)) for d in self._about]
            return " + ".join(text for text in parts if text)

        model = texts("model") or f"{self._profile.maker} {self._profile.models[0]}"
        dates = [date for d in self._about if (date := d.texts.get("calibration_date"))]
        return InstrumentInfo(
            self._profile.kind,
            model,
            texts("serial"),
            texts("firmware"),
            min(dates, default=""),  # the oldest of several instruments
            texts("sensitivity"),
            " ".join(d.status for d in self._about if d.status),
            self.name,
            tuple(unit.measures for unit in self._units),
            "CRC-16",
        )

    def read(self) -> IrradianceSample:
        """Read all units, one after the other, and return one reading, with the time of the first.

        The temperature is that of the first unit that reports one. Raises DeviceError if a unit
        does not answer, or if its answer is damaged or impossible.
        """
        t_utc = self._clock.now()
        values: dict[str, float] = {}
        words, status, warm = [], [], None
        for unit in self._units:
            decoded, raw = self._ask(unit, self._profile.poll)
            values[f"{unit.measures}_wm2"] = decoded.values["irradiance_wm2"]
            words.append(raw)
            if decoded.status:
                status.append(f"{unit.measures}: {decoded.status}")
            warm = decoded.values.get("temperature_c") if warm is None else warm
        return IrradianceSample(
            t_utc,
            values.pop("ghi_wm2", None),
            **values,
            temperature_c=warm,
            status="; ".join(status),
            raw="; ".join(words),
        )

    def _ask(self, unit: Unit, blocks: tuple[RegisterBlock, ...]) -> tuple[Decoded, str]:
        """Return the register blocks of one unit, decoded, and as hexadecimal words."""
        registers: dict[int, int] = {}
        for block in blocks:
            registers.update(zip(block.numbers, self._words(unit, block), strict=True))
        raw = " ".join(f"{registers[r]:04x}" for b in self._profile.poll for r in b.numbers)
        return decode(self._profile, registers), raw

    def _words(self, unit: Unit, block: RegisterBlock) -> list[int]:
        """Return the registers of one block. Raises DeviceError."""
        from pymodbus.exceptions import ConnectionException, ModbusException

        whose = f"{self.name}: {self._profile.kind} unit {unit.address}"
        read = self._client.read_holding_registers
        if self._profile.function == 4:
            read = self._client.read_input_registers
        try:
            with device_errors(self.name):
                answer = read(block.start, count=block.count, device_id=unit.address)
        except ConnectionException:
            raise DeviceError(f"{whose}: the connection is lost; check cable and power") from None
        except ModbusException:  # no answer, or one with a wrong checksum
            raise DeviceError(
                f"{whose} does not answer; check wiring, power, unit number, baud rate and parity"
            ) from None
        if answer.isError() or len(answer.registers) != block.count:
            raise DeviceError(f"{whose} refused or cut the registers ({answer}); check the kind")
        return answer.registers

    def close(self) -> None:
        """Close the port or the connection; ignore errors of a port that was unplugged."""
        with suppress(DeviceError), device_errors(self.name):
            self._client.close()


def _connected(place: str, line: SerialLine, timeout_s: float) -> tuple[Any, str]:
    """Return a client that asks each question once, and the name of its port or host."""
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
    client.socket = port.handle
    return client, port.name


def _integer_text(value: float | None) -> str:
    return "" if value is None else f"{value:.10g}"


def open_pyranometer(
    uri: DeviceUri, *, clock: Clock, session: Session | None = None
) -> ModbusPyranometer:
    """Open the Modbus pyranometer, or the several of one kind, that a URI names.

    Raises DeviceError for unknown options or kinds, a missing or repeated unit number, a missing
    port, or an instrument that does not answer or gives an impossible value; InputError for a
    broken profile.
    """
    options = uri.read(
        kind=str,
        unit=integer_option(1, 247),
        dhi_unit=integer_option(1, 247),
        dni_unit=integer_option(1, 247),
        baud=integer_option(300, 115200),
        parity=one_of("N", "E", "O"),
        stop=integer_option(1, 2),
        timeout=number(0.05, 30.0),
    )
    if not uri.place or "kind" not in options:
        raise DeviceError(
            f"{uri.text}: expected a port and a kind, such as modbus:/dev/ttyUSB0?kind=smp&unit=1"
        )
    profile = load_register_profile(options["kind"])
    line = profile.line
    unit = options.get("unit", line.unit)
    if not unit:
        raise DeviceError(
            f"{uri.text}: no unit number, and {profile.kind} has no default; add it to the "
            f"URI: {profile.note}"
        )
    units = [Unit("ghi", unit)]
    units += [
        Unit(name, options[f"{name}_unit"]) for name in ("dhi", "dni") if f"{name}_unit" in options
    ]
    if len({u.address for u in units}) != len(units):
        raise DeviceError(f"{uri.text}: a unit number occurs twice; each unit needs its own")
    stated = {name: options[name] for name in ("baud", "parity", "stop") if name in options}
    return ModbusPyranometer(
        uri.place,
        profile,
        replace(line, **stated),
        units,
        clock,
        timeout_s=options.get("timeout", 0.5),
    )
