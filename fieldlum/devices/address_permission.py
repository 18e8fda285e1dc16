"""Require a permission for device addresses of a session that name more than a device.

An address in session.toml may come from another person. One that names a program, a file, a folder
or another computer is used only after the user of this computer named it on the command line.
"""

import re
import shlex
import shutil
from pathlib import Path

from fieldlum.core.errors import DeviceError, InputError
from fieldlum.devices import CAMERAS, METERS, PYRANOMETERS, parse_uri
from fieldlum.session import sha256
from fieldlum.session.permits import Subject, is_permitted, subject

# Options whose values are numbers or single letters in every driver. All others may name a file.
_NUMERIC_OPTIONS = re.compile(
    "seed|noise|clock_offset|f_number|delete|unit|dhi_unit|dni_unit|baud|parity|stop|"
    "timeout|silence|head"
)
_PROFILE_OPTIONS = ("kind", "profile")  # name a shipped profile, unless the value is a path
_SHIPPED_NAME = re.compile(r"(?!.*\.toml$)[\w.-]+", re.ASCII)
# Serial ports alone: to open another device, such as /dev/watchdog, can have an effect.
_SERIAL_PORT = re.compile(
    r"/dev/(?!.*\.\.)(?:tty[A-Za-z]|cu\.|serial/|rfcomm|pts/)[\w./:+-]+|usb=[\w:.-]*|COM\d+",
    re.ASCII,
)
_SERIAL_SCHEMES = ("serial", "modbus", "cl200a", "t10a")
_SAFE_SCHEMES = ("sim", "gphoto", "rpicam")  # their place is a word or a number, not a path


def permission_subject(text: str) -> Subject | None:
    """Return what the user must permit before a device address of a session is used.

    The result is None if the address `text` names only a device. The digest of the result changes
    with the text, the content of a named file and the target of a named folder. Raises DeviceError
    for a text that is no address.
    """
    uri = parse_uri(text)
    not_devices = []
    for name, value in uri.options.items():
        is_shipped = name in _PROFILE_OPTIONS and _SHIPPED_NAME.fullmatch(value)
        if not (is_shipped or _NUMERIC_OPTIONS.fullmatch(name)):
            not_devices.append(value)
    is_device = uri.scheme in _SAFE_SCHEMES or (uri.scheme == "theta" and not uri.place)
    if uri.scheme in _SERIAL_SCHEMES:
        is_device = _SERIAL_PORT.fullmatch(uri.place) is not None
    if not is_device:
        not_devices.append(uri.place)
    if not not_devices:
        return None
    return subject("device", text, text, *map(_path_and_digest, not_devices))


def _path_and_digest(value: str) -> str:
    """Return the path that a value names, without links, a space and, for a file, its SHA-256.

    Both decide what happens: a link can get another target, and a file another content. value: of
    an option, or the place of an address: a program, file, folder or network address. What does
    not exist here is returned unchanged, so that its permission holds in all folders.
    """
    path = Path(shutil.which(value) or value)
    try:
        path.lstat()
        return f"{path.resolve()} {sha256(path) if path.is_file() else ''}"
    except (OSError, ValueError):
        return value


def require_permitted(text: str, source: Path, option: str) -> None:
    """Raise InputError for a device address that needs a permission which the user did not give.

    It needs one if it names a program, a file, a folder or another computer: an address in the
    session of another person could start any program. Serial ports, USB cameras and simulated
    devices need none. The user permits an address by a command that names it. text: the address;
    source: the session.toml that states it; option: of the command, such as --camera.
    """
    if text.partition(":")[0] not in {*CAMERAS, *METERS, *PYRANOMETERS}:
        return  # opening the device reports it
    try:
        wanted = permission_subject(text)
    except DeviceError:
        return  # opening the device reports it
    if wanted is not None and not is_permitted(wanted):
        found = f"{option.removeprefix('--')} = {text}, which names a program, file or computer"
        expected = "an address that was named on the command line of this computer"
        command = f"fieldlum doctor {shlex.quote(str(source.parent))} {option} {shlex.quote(text)}"
        raise InputError(source, found, expected, f"if you trust it, permit it with: {command}")
