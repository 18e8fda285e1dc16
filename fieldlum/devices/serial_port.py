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
    """Replace errors of a serial port in the `with` block by a DeviceError.

    port: name of the port, with which the error's text begins.
    """
    try:
        yield
    except (OSError, _TermiosError) as error:
        # serial.SerialException is an OSError, termios.error is not.
        lines = str(error.args[-1] if error.args else error).splitlines()
        raise DeviceError(f"{port}: {lines[0] if lines else type(error).__name__}") from None


@contextmanager
def closed_on_error(device: Device) -> Iterator[None]:
    """Close a device if the `with` block, in which its connection is tested, raises DeviceError."""
    try:
        yield
    except DeviceError:
        device.close()
        raise


# What to do about the faults that pyserial reports in its own words when it opens a port.
_REMEDY = (
    "name one of the connected ports, close other programs that use it, and join the port's group "
    "(often dialout)"
)


def resolve(place: str) -> str:
    """Return the device file of a port, such as /dev/ttyUSB0.

    place: the file itself, or ``usb=VID:PID`` or ``usb=VID:PID:SERIAL``, the identity of a USB
    port, which stays after a replug as the file may not. VID and PID have four hexadecimal digits.
    Of several ports that match, the first is returned. Raises DeviceError if none is plugged in.
    """
    if not place.startswith("usb="):
        return place
    from serial.tools.list_ports import comports

    wanted = place.removeprefix("usb=").lower()
    usb_ports = [port for port in comports() if port.vid is not None]
    identities = [f"{p.vid:04x}:{p.pid:04x}:{(p.serial_number or '').lower()}" for p in usb_ports]
    for identity, port in zip(identities, usb_ports, strict=True):
        if f"{identity}:".startswith(f"{wanted}:"):
            return port.device
    ports = ", ".join(identity.strip(":") for identity in identities) or "none"
    raise DeviceError(f"{place}: not plugged in; plug it in, or name one of these ports: {ports}")


@dataclass(frozen=True, slots=True)
class SerialLine:
    """Settings of a serial line: baud rate, data bits, parity (N, E, O) and stop bits.

    The parities are none, even and odd.
    """

    baud: int = 9600
    bits: int = 8
    parity: Literal["N", "E", "O"] = "N"
    stop: int = 1


class SerialPort:
    """A serial port with fixed settings, locked against other programs that lock their ports.

    name : its device file; port : pyserial's object. Raises DeviceError if the port cannot be
    opened. The methods, apart from `close`, raise DeviceError if the port fails later.
    """

    def __init__(self, place: str, line: SerialLine, *, timeout_s: float) -> None:
        """Open a port.

        place: device file, or usb=VID:PID or usb=VID:PID:SERIAL (see `resolve`); line: settings;
        timeout_s: longest wait of a read or write.
        """
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
        """Return the bytes that were already received, without waiting.

        Call it before a command, so that a late reply is not read as the answer to that command.
        """
        with device_errors(self.name):
            waiting = self.port.in_waiting
            return self.port.read(waiting) if waiting else b""

    def write(self, data: bytes) -> None:
        """Write all bytes. Raises DeviceError if the port fails."""
        with device_errors(self.name):
            self.port.write(data)

    def read(self, count: int) -> bytes:
        """Wait for `count` bytes and return them; return fewer after the timeout.

        Raises DeviceError if the port fails.
        """
        with device_errors(self.name):
            return self.port.read(count)

    def read_until(self, end: bytes, limit: int) -> bytes:
        """Wait for the bytes `end`, and return all bytes up to and including them.

        After the timeout, or after `limit` bytes, `end` may be missing: the caller must check.
        Raises DeviceError if the port fails.
        """
        with device_errors(self.name):
            return self.port.read_until(end, limit)

    def close(self) -> None:
        """Close the port; ignore errors of a port that was unplugged."""
        with suppress(OSError, _TermiosError):
            self.port.close()
