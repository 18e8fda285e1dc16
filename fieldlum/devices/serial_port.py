"""Open serial ports; errors of a port become DeviceErrors with its name."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any, Literal

from fieldlum.core.errors import DeviceError
from fieldlum.devices import Device

try:
    from termios import error as _TermiosError
except ImportError:  # Windows
    _TermiosError = OSError


@contextmanager
def device_errors(port: str) -> Iterator[None]:
    """Turn errors of the serial port `port` in a `with` block into DeviceError with its name."""
    try:
        yield
    except (OSError, _TermiosError) as error:
        # serial.SerialException is an OSError, termios.error is not.
        lines = str(error.args[-1] if error.args else error).splitlines()
        raise DeviceError(f"{port}: {lines[0] if lines else type(error).__name__}") from None


@contextmanager
def closed_on_error(device: Device) -> Iterator[None]:
    """Close a device if the `with` block, in which it is first used, raises DeviceError."""
    try:
        yield
    except DeviceError:
        device.close()
        raise


# The remedies of the faults that pyserial reports in its own words.
_REMEDY = (
    "name one of the connected ports, close other programs that use it, and join the port's group "
    "(often dialout)"
)


def resolve(place: str) -> str:
    """Return the device file of `place`: the place itself, or the port of ``usb=VID:PID[:SERIAL]``.

    VID and PID have four hexadecimal digits. Of several ports that match, the first is returned.
    The name of a USB port may change after a replug; its identity does not. Raises DeviceError if
    no such device is plugged in.
    """
    if not place.startswith("usb="):
        return place
    from serial.tools.list_ports import comports

    wanted = place.removeprefix("usb=").lower()
    usb_ports = [port for port in comports() if port.vid is not None]
    names = [f"{p.vid:04x}:{p.pid:04x}:{(p.serial_number or '').lower()}" for p in usb_ports]
    for name, port in zip(names, usb_ports, strict=True):
        if f"{name}:".startswith(f"{wanted}:"):
            return port.device
    ports = ", ".join(name.strip(":") for name in names) or "none"
    raise DeviceError(f"{place}: not plugged in; plug it in, or name one of these ports: {ports}")


@dataclass(frozen=True, slots=True)
class SerialLine:
    """Settings of a serial line: baud rate, data bits, parity (none, even, odd) and stop bits."""

    baud: int = 9600
    bits: int = 8
    parity: Literal["N", "E", "O"] = "N"
    stop: int = 1


class SerialPort:
    """A serial port with fixed settings, locked against other programs that lock their ports.

    timeout_s : of each read and write; port : pyserial's own object. Raises DeviceError if the port
    cannot be opened. Its methods, apart from `close`, raise it if the port fails later.
    """

    def __init__(self, place: str, line: SerialLine, *, timeout_s: float) -> None:
        """Open a port alone; place: what `resolve` resolves. Raises DeviceError, with the ports."""
        import serial

        self.name = resolve(place)
        how: dict[str, Any] = {"timeout": timeout_s, "write_timeout": timeout_s, "exclusive": True}
        settings = (line.baud, line.bits, line.parity, line.stop)
        try:
            with device_errors(self.name):
                self.port: Any = serial.Serial(self.name, *settings, **how)
        except DeviceError as error:
            from serial.tools.list_ports import comports

            ports = ", ".join(sorted(port.device for port in comports())) or "none"
            raise DeviceError(f"{error}; connected ports: {ports}; {_REMEDY}") from None

    def drain(self) -> bytes:
        """Return the bytes already received, so that a late reply is not taken for the next one."""
        with device_errors(self.name):
            waiting = self.port.in_waiting
            return self.port.read(waiting) if waiting else b""

    def write(self, data: bytes) -> None:
        """Write all bytes. Raises DeviceError if the port fails."""
        with device_errors(self.name):
            self.port.write(data)

    def read(self, count: int) -> bytes:
        """Return up to `count` bytes, fewer after the timeout. Raises DeviceError if it fails."""
        with device_errors(self.name):
            return self.port.read(count)

    def read_until(self, end: bytes, limit: int) -> bytes:
        """Return all bytes up to and including `end`. Raises DeviceError if the port fails.

        After the timeout, or after `limit` bytes, `end` may be missing: the caller must check.
        """
        with device_errors(self.name):
            return self.port.read_until(end, limit)

    def close(self) -> None:
        """Close the port; ignore errors of a port that was unplugged."""
        with suppress(OSError, _TermiosError):
            self.port.close()
