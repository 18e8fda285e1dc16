"""Find what a Radiance room file runs, and refuse it unless the user permitted it.

Radiance runs every line of a scene that begins with an exclamation mark, and the lines of scenes
and octrees that it names (readobj.c, readoct.c).
"""

import re
import shlex
from pathlib import Path

from fieldlum.core.errors import InputError
from fieldlum.core.files import read_bytes
from fieldlum.session.permits import Subject, is_permitted, subject

_COMMAND = re.compile(rb"!((?:[^\\\n\r]|\\.)*)", re.DOTALL)  # a backslash continues the line
# Primitives that load an octree or a mesh, whose own scenes can have commands.
_LOADS = re.compile(rb"\b(?:instance|mesh)\b")
_LOADED = re.compile(rb"\b(?:instance|mesh)\s+\S+\s+\d+\s+(\S+)")
_WORD = re.compile(rb"[^\s;|&<>()'\"`$=]+")
_MAX_SHOWN = 80  # characters of a command in a message


def commands(path: Path) -> list[str]:
    """Return the command lines of a room file and of the files that they name, as text.

    Empty for mere geometry. Raises OSError for a file that cannot be read.
    """
    found = (line for data in _files(path) for line in _COMMAND.findall(data))
    return [line.decode("ascii", "replace").strip() for line in found]


def _runs(data: bytes, suffix: str) -> bool:
    """Return whether a file could run something; an octree always could."""
    return suffix.lower() == ".oct" or b"!" in data or _LOADS.search(data) is not None


def _files(path: Path) -> list[bytes]:
    """Return the content of a room file and of the files that its commands name, recursively.

    Relative names count from the current folder, as Radiance does, and from the room file's.
    """
    contents: dict[Path, bytes] = {}
    waiting = [path.resolve()]
    while waiting:
        file = waiting.pop(0)
        if file in contents:
            continue
        data = contents[file] = read_bytes(file)
        if not _runs(data, file.suffix) or file.suffix.lower() == ".oct":
            continue
        texts = [*_COMMAND.findall(data), *_LOADED.findall(data)]
        words = {word for text in texts for word in _WORD.findall(text)}
        for word in sorted(words):
            name = word.decode("utf-8", "surrogateescape")
            places = (Path(name), file.parent / name)
            waiting += [place.resolve() for place in places if _is_file(place)]
    return list(contents.values())


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def what_runs(path: Path) -> Subject | None:
    """Return the subject of a room file that could run something; None for mere geometry.

    Its digest covers the file and the files that its commands name.
    """
    if not path.is_file() or not _runs(read_bytes(path), path.suffix):
        return None
    return subject("room", str(path.resolve()), *_files(path))


def require_permitted(path: Path) -> None:
    """Raise InputError for a room file that could run something and is not permitted."""
    wanted = what_runs(path)
    if wanted is None or is_permitted(wanted):
        return
    expected = "a room that runs nothing, or one that the user of this computer permitted"
    remedy = f"read it, then permit it with: fieldlum permit {shlex.quote(str(path))}"
    raise InputError(path, described(path), expected, remedy)


def described(path: Path) -> str:
    """Return what a room file could run, in a few words for a message."""
    lines = commands(path)
    if path.suffix.lower() == ".oct":
        return "an octree, which can name commands to run"
    if not lines:
        return "a scene that loads octrees or meshes, which can name commands to run"
    first = lines[0] if len(lines[0]) <= _MAX_SHOWN else f"{lines[0][:_MAX_SHOWN]} ..."
    more = f" and {len(lines) - 1} more" if len(lines) > 1 else ""
    return f"a scene that runs the command: {first}{more}"
