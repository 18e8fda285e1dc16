"""Require a permission for device addresses of a session that name more than a device.

An address in session.toml may come from another person. One that names a program, a file, a folder
or another computer is used only after the user of this computer named it on the command line.
"""

import re
import shlex
import shutil
from pathlib import Path

from fieldlum.core.errors import DeviceError, InputError
from fieldlum.devices import parse_uri
from fieldlum.session import sha256
from fieldlum.session.permits import Subject, is_permitted, subject

# Options whose values are numbers or single letters in every driver. All others may name a file.
_HARMLESS = re.compile(
    "seed|noise|clock_offset|f_number|delete|unit|dhi_unit|dni_unit|baud|parity|stop|"
    "timeout|silence|head"
)
_NAMES = ("kind", "profile")  # of a shipped file, unless the value is a path
_PLAIN = re.compile(r"(?!.*\.toml$)[\w.-]+", re.ASCII)
# Serial ports alone: to open another device, such as /dev/watchdog, can have an effect.
_PORT = re.compile(
    r"/dev/(?!.*\.\.)(?:tty[A-Za-z]|cu\.|serial/|rfcomm|pts/)[\w./:+-]+|usb=[\w:.-]*|COM\d+",
    re.ASCII,
)
_SERIAL = ("serial", "modbus", "cl200a", "t10a")
_NO_PLACE = ("sim", "gphoto", "rpicam")  # their place is a word or a number


def permission_subject(text: str) -> Subject | None:
    """Return what needs a permission in an address; None if it names only a device.

    The subject changes with the content of a named file and with the place of a named folder.
    Raises DeviceError for a text that is no address.
    """
    uri = parse_uri(text)
    named = [
        value
        for name, value in uri.options.items()
        if not (_HARMLESS.fullmatch(name) or (name in _NAMES and _PLAIN.fullmatch(value)))
    ]
    is_device = uri.scheme in _NO_PLACE or (uri.scheme == "theta" and not uri.place)
    if uri.scheme in _SERIAL:
        is_device = _PORT.fullmatch(uri.place) is not None
    if not is_device:
        named.append(uri.place)
    if not named:
        return None
    return subject("device", text, text, *(_state(value) for value in named))


def _state(value: str) -> str:
    """Return a named path without links and, for a file, the digest of its content."""
    path = Path(shutil.which(value) or value)
    try:
        return f"{path.resolve()} {sha256(path) if path.is_file() else ''}"
    except (OSError, ValueError):
        return value


def require_permitted(text: str, source: Path, option: str) -> None:
    """Raise InputError for an address of a session that names more than a device.

    text: the address; source: the session.toml; option: such as --camera. It is accepted if the
    user of this computer named the address before.
    """
    try:
        wanted = permission_subject(text)
    except DeviceError:
        return  # opening the device reports it
    if wanted is not None and not is_permitted(wanted):
        found = f"{option.removeprefix('--')} = {text}, which names a program, file or computer"
        expected = "an address that was named on the command line of this computer"
        command = f"fieldlum doctor {shlex.quote(str(source.parent))} {option} {shlex.quote(text)}"
        raise InputError(source, found, expected, f"if you trust it, permit it with: {command}")
