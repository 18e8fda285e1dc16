"""Read pyranometers on Modbus RTU: ``modbus:PLACE?kind=smp&unit=1``.

One driver serves all kinds; a register profile describes each. Options: kind (or the path of
another profile), unit, dhi_unit and dni_unit (more instruments of the same kind on the bus), baud,
parity, stop, timeout. Only functions 3 and 4 are sent: no register is ever written.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

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
from fieldlum.devices.serial_port import SerialLine, SerialPort, device_errors
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
        self._port = SerialPort(place, line, timeout_s=timeout_s)
        try:
            self._about = [
                self._ask(unit, profile.at_open + profile.poll)[0] for unit in self._units
            ]
        except DeviceError:
            self.close()
            raise

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
            self._port.name,
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
        import minimalmodbus

        client = minimalmodbus.Instrument(self._port.handle, unit.address)
        registers: dict[int, int] = {}
        for block in blocks:
            with device_errors(self._port.name):
                try:
                    words = client.read_registers(block.start, block.count, self._profile.function)
                except minimalmodbus.NoResponseError:
                    raise DeviceError(
                        f"{self._port.name}: {self._profile.kind} unit {unit.address} does not "
                        f"answer; check wiring, power, unit number, baud rate and parity"
                    ) from None
                except minimalmodbus.ModbusException as error:
                    raise DeviceError(
                        f"{self._port.name}: {self._profile.kind} unit {unit.address}: {error}; "
                        "check wiring, baud rate and parity"
                    ) from None
            registers.update(zip(block.numbers, words, strict=True))
        raw = " ".join(f"{registers[r]:04x}" for b in self._profile.poll for r in b.numbers)
        return decode(self._profile, registers), raw

    def close(self) -> None:
        """Close the port."""
        self._port.close()


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
