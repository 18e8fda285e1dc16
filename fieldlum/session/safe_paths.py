"""Resolve the file names that a session states, and open its own files, without leaving its folder.

A session is data that anybody may have written: `../x`, `/etc/x` and symbolic links in it would
reach files of this computer.
"""

import errno
import os
import shlex
from collections.abc import Container
from itertools import accumulate
from pathlib import Path, PurePosixPath

from fieldlum.core.errors import InputError
from fieldlum.core.files import open_file
from fieldlum.session.permits import Subject, is_permitted, subject

_MAX_NAME = 255  # bytes of a name in all usual file systems; NAME_MAX in Linux
# Separators (the colon separates drives and streams on Windows) and control characters.
_FORBIDDEN = frozenset("/\\:\x7f") | frozenset(map(chr, range(32)))


def is_plain(name: object) -> bool:
    """Return whether a value is the name of a file or folder, without a path and not hidden."""
    if not isinstance(name, str) or name.startswith(".") or _FORBIDDEN & set(name):
        return False
    try:
        return 0 < len(os.fsencode(name)) <= _MAX_NAME
    except UnicodeEncodeError:
        return False


def refuse_outside(root: Path, name: str, source: str, folder: str) -> None:
    """Raise InputError if a file name that a session states leads out of the session's folder.

    root: the session's folder; name: such as panoramas/SLOT.exr; source: file that states it, for
    errors; folder: below the root, to which the name is relative, and which it may leave by `..`. A
    link on the way is rejected unless the user permitted it.
    """
    parts = list(PurePosixPath(name).parts)
    base = list(PurePosixPath(folder).parts)
    while base and parts[:1] == [".."]:
        base.pop()
        parts.pop(0)
    if not parts or not all(map(is_plain, parts)):
        expected = "the plain name of a file in this session"
        remedy = "correct the name, or restore the file from a copy"
        raise InputError(source, f"the file name {name!r}", expected, remedy)
    refuse_link(root, root.joinpath(*base, *parts))


def link_on_the_way(root: Path, path: Path) -> Path | None:
    """Return the first symbolic link on the way from `root` to a path below it; None without one.

    root itself is not checked; the path may be a link. A link that the user of this computer
    permitted does not count.
    """
    place = root
    for part in path.relative_to(root).parts:
        place = place / part
        if place.is_symlink() and not is_permitted(link_subject(place, place.resolve())):
            return place
    return None


def link_subject(link: Path, target: Path) -> Subject:
    """Return what `fieldlum permit LINK` permits: that fieldlum follows this symbolic link.

    target: `link.resolve()`. The permission holds for this place of the link, this text in it and
    this target: after a change of one of them the link needs a new one. Raises OSError if `link` is
    no link.
    """
    place = link.parent.resolve() / link.name
    return subject("link", str(place), str(place), str(place.readlink()), str(target))


def refuse_link(root: Path, path: Path) -> None:
    """Raise InputError if a link on the way from `root` to `path` was not permitted."""
    if (link := link_on_the_way(root, path)) is not None:
        found = f"a symbolic link to {link.readlink()}"
        expected = "files and folders of the session itself"
        remedy = "replace it by its content, or, if the link is yours: fieldlum permit "
        raise InputError(link, found, expected, remedy + shlex.quote(str(link)))


def refuse_links(root: Path, stems: Container[str]) -> None:
    """Raise InputError for a link, pipe or device in a session where fieldlum reads or writes.

    root: of the session; stems: names, up to their first dot, of the entries of its folder that are
    checked, with all below them. Of a hidden entry only itself is checked, because its content
    belongs to the disk or to another program. Links that the user of this computer permitted are
    followed and checked too.
    """
    for entry in list(os.scandir(root)):
        is_hidden = entry.name.startswith(".")
        if is_hidden or entry.name.partition(".")[0] in stems:
            _refuse_in(entry, is_deep=not is_hidden)


def _refuse_in(entry: os.DirEntry[str], *, is_deep: bool = True) -> None:
    """Raise InputError if an entry of a folder is a link, pipe, socket or device.

    is_deep: check the content of a folder too.
    """
    path = Path(entry.path)
    if entry.is_symlink():
        refuse_link(path.parent, path)
    elif not (entry.is_file() or entry.is_dir()):
        raise InputError(path, "a pipe, socket or device", "a file or a folder", "remove it")
    if is_deep and entry.is_dir():
        for inner in list(os.scandir(path)):
            _refuse_in(inner)


def open_inside(root: Path, path: Path, flags: int) -> int:
    """Return the handle of a file of a session, opened without following links.

    root: of the session; flags: of os.open. Each folder on the way is opened in the one before, so
    that none can be exchanged after it was checked. A link that the user permitted leads to its
    target. Raises OSError for another link.
    """
    if (link := link_on_the_way(root, path)) is not None:
        raise OSError(errno.ELOOP, "a symbolic link, which is not followed", str(link))
    if os.open not in os.supports_dir_fd:  # Windows
        return open_file(path, flags)
    *folders, place = (root / part for part in accumulate(path.relative_to(root).parts, Path))
    handle = os.open(root, os.O_RDONLY | os.O_DIRECTORY)
    try:
        for folder in folders:
            how = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW
            outer, handle = handle, os.open(_name_or_target(folder), how, dir_fd=handle)
            os.close(outer)
        return open_file(_name_or_target(place), flags, folder=handle)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from None
    finally:
        os.close(handle)


def _name_or_target(place: Path) -> Path:
    """Return the path by which a file is opened in its folder: its name, or a permitted target."""
    if place.is_symlink() and is_permitted(link_subject(place, target := place.resolve())):
        return target
    return Path(place.name)
