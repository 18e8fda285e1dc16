"""A serial port that says what is wrong with it as DeviceError, and finds its instrument again
after an unplug.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from fieldlum.errors import DeviceError

try:
    from termios import error as _TermiosError
except ImportError:  # Windows
    _TermiosError = OSError


@contextmanager
def told(port: str) -> Iterator[None]:
    """Turns the three unrelated errors that a serial port raises into DeviceError."""
    try:
        yield
    except (
        OSError,
        _TermiosError,
    ) as error:  # serial.SerialException is an OSError, termios.error is not
        said = str(error.args[-1] if error.args else error).splitlines()
        raise DeviceError(f"{port}: {said[0] if said else type(error).__name__}") from None


def _cannot_open(port: str, error: DeviceError) -> str:
    """What to do about a port that does not open. pyserial tells the reason in its text alone on
    Windows.
    """
    said = str(error)
    if "[Errno 2]" in said or "FileNotFoundError" in said:
        from serial.tools.list_ports import comports

        known = ", ".join(sorted(found.device for found in comports()))
        return f"{port}: no such port; ports there are: {known or 'none, so check cable and power'}"
    if "[Errno 13]" in said:
        return (
            f"{port}: no right to open it; join the port's group (often dialout) and log in again"
        )
    if "exclusively lock" in said or "[Errno 16]" in said or "PermissionError" in said:
        return (
            f"{port}: another program holds it; close that one (a terminal, another capture or log)"
        )
    if "[Errno 25]" in said or "Inappropriate ioctl" in said:
        return f"{port}: is no serial port"
    return said


def resolve(place: str) -> str:
    """The device file of a place: itself, or the port of ``usb=VID:PID`` or ``usb=VID:PID:SERIAL``.

    A USB port comes back under another name after a replug; its identity stays. Raises DeviceError.
    """
    if not place.startswith("usb="):
        return place
    from serial.tools.list_ports import comports

    wanted = place.removeprefix("usb=").lower().split(":")
    found = []
    for port in comports():
        if port.vid is None:
            continue
        name = [f"{port.vid:04x}", f"{port.pid:04x}", (port.serial_number or "").lower()]
        if name[: len(wanted)] == wanted:
            return port.device
        found.append(":".join(part for part in name if part))
    raise DeviceError(f"{place}: not plugged in; USB ports there are: {', '.join(found) or 'none'}")


class SerialPort:
    """One exclusive port with fixed settings. `exchange` asks and reads up to an end mark."""

    def __init__(
        self,
        place: str,
        *,
        baud: int,
        bits: int = 8,
        parity: str = "N",
        stop: float = 1,
        timeout_s: float,
    ) -> None:
        import serial

        self.name, self.timeout_s = resolve(place), timeout_s
        try:
            with told(self.name):
                self._port: Any = serial.Serial(
                    self.name,
                    baud,
                    bytesize=bits,
                    parity=parity,
                    stopbits=stop,
                    timeout=timeout_s,
                    write_timeout=timeout_s,
                    exclusive=True,
                )
        except DeviceError as error:
            raise DeviceError(_cannot_open(self.name, error)) from None

    @property
    def handle(self) -> Any:
        """The pyserial object, for libraries that want one."""
        return self._port

    def drain(self) -> bytes:
        """Take what lies waiting: the rest of a reply that came too late must not be taken for
        the next one.
        """
        with told(self.name):
            waiting = self._port.in_waiting
            return self._port.read(waiting) if waiting else b""

    def write(self, data: bytes) -> None:
        with told(self.name):
            self._port.write(data)

    def read(self, count: int) -> bytes:
        """Up to `count` bytes; fewer when the timeout ends."""
        with told(self.name):
            return self._port.read(count)

    def read_until(self, end: bytes, limit: int = 4096) -> bytes:
        """Up to and with `end`. What came when the timeout ends lacks it: the caller must look."""
        with told(self.name):
            return self._port.read_until(end, limit)

    def read_quiet(self, quiet_s: float, longest_s: float) -> bytes:
        """All that comes until the line has been silent for `quiet_s`."""
        out, deadline = b"", time.monotonic() + longest_s
        last = time.monotonic()
        while (now := time.monotonic()) < deadline and now - last < quiet_s:
            with told(self.name):
                data = self._port.read(self._port.in_waiting) if self._port.in_waiting else b""
            if data:
                out, last = out + data, now
            else:
                time.sleep(0.005)
        return out

    def close(self) -> None:
        with suppress(OSError, _TermiosError):
            self._port.close()
