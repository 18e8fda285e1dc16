"""Record outside every session what the user of this computer permitted.

A session is data that anybody may have written. It may name a program, a file, another computer or
a link only if the user of this computer named it once on the command line.
"""

import hashlib
import os
import platform
import sys
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import NamedTuple

from msgspec import field

from fieldlum.core.errors import InputError
from fieldlum.session.codec import JsonFile


class _PermitsFile(JsonFile, frozen=True):
    """The content of permitted.json: names of permitted subjects by digest, by computer."""

    NAME = "permitted.json"
    permitted: dict[str, dict[str, str]] = field(default_factory=dict)


class Subject(NamedTuple):
    """Something that needs a permission.

    kind: device or link; name: as the user reads it; digest: of everything that decides what
    happens, so that a change of it needs a new permission.
    """

    kind: str
    name: str
    digest: str


def subject(kind: str, name: str, *parts: str) -> Subject:
    """Return what needs a permission as a `Subject`, with a digest of its kind and of `parts`.

    kind: device or link; name: as the user reads it; parts: texts that decide what happens, such as
    a path and the SHA-256 of a file.
    """
    digest = hashlib.sha256(kind.encode())
    for part in parts:
        digest.update(hashlib.sha256(part.encode("utf-8", "surrogateescape")).digest())
    return Subject(kind, name, digest.hexdigest())


def config_folder() -> Path:
    """Return the folder fieldlum/ in the user's folder of settings; it may not exist yet.

    That is XDG_CONFIG_HOME, else ~/.config, on Windows APPDATA. Raises OSError for a user without a
    home folder.
    """
    stated = Path(os.environ.get("APPDATA" if sys.platform == "win32" else "XDG_CONFIG_HOME", ""))
    try:
        # The XDG specification ignores relative paths; one could lead into a session.
        return (stated if stated.is_absolute() else Path.home() / ".config") / "fieldlum"
    except RuntimeError as error:
        raise OSError(str(error)) from None


@cache
def computer() -> str:
    """Return a text that identifies this computer, and does not reveal its machine-id."""
    identity = platform.node()
    with suppress(OSError):
        identity = Path("/etc/machine-id").read_text(encoding="ascii").strip() or identity
    return hashlib.sha256(f"fieldlum {identity}".encode()).hexdigest()[:32]


def is_permitted(wanted: Subject) -> bool:
    """Return whether the user permitted a subject, with the same digest, on this computer."""
    return wanted.digest in _read().get(computer(), {})


def permit(*wanted: Subject) -> None:
    """Record in permitted.json in `config_folder` that the user permits some subjects.

    The permissions hold on this computer. Raises OSError if the file cannot be written.
    """
    permitted = _read()
    permitted_here = permitted.setdefault(computer(), {})
    new = {w.digest: f"{w.kind} {w.name}" for w in wanted if w.digest not in permitted_here}
    if not new:
        return
    permitted_here |= new
    folder = config_folder()
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    _PermitsFile(permitted).write(folder)


def _read() -> dict[str, dict[str, str]]:
    """Return the permitted subjects by computer and digest; empty if none can be read."""
    with suppress(InputError, OSError):
        return _PermitsFile.read(config_folder()).permitted
    return {}
