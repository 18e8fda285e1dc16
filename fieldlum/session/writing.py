"""Write files so that an interruption leaves the old file or the complete new one."""

from __future__ import annotations

import errno
import hashlib
import os
import tempfile
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from fieldlum.core.errors import InputError, input_errors

OLD_SCRAP_S = 86400.0  # no file takes a day to write; chosen, not measured
_RUN = uuid.uuid4().hex[:12]  # another one in each process, on any computer


@contextmanager
def replacing(path: Path, mode: str = "wb", **kwargs: Any) -> Iterator[IO[Any]]:
    """Yield a file that gets its name only when it is complete.

    The file has a temporary name in the same folder, is flushed to disk, and is then renamed. After
    an exception in the `with` block it is removed instead.
    """
    with replacing_path(path) as temporary, temporary.open(mode, **kwargs) as file:
        yield file


def check_writable(folder: Path) -> None:
    """Raise if no file can be written into a folder, which need not exist.

    For stages that compute for minutes before they write. Nothing remains of the test, and
    temporary files of killed runs are removed. Raises OSError, which names the folder that exists,
    or InputError for a place on no disk.
    """
    places = (folder.absolute(), *folder.absolute().parents)
    existing = next((place for place in places if os.path.lexists(place)), None)
    if existing is None or not existing.exists():
        expected = "a folder, or a new one in a folder that exists"
        remedy = "mount the disk, or choose another place"
        raise InputError(folder, "a place on a disk that is not there", expected, remedy)
    try:
        with tempfile.TemporaryFile(dir=existing):
            pass
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(existing)) from None
    remove_scraps(folder)


@contextmanager
def replacing_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path with the same suffix; rename it to `path` after the `with` block.

    For writers that need a path; see `replacing`. After an exception the temporary file is removed.
    """
    with input_errors(
        path.parent,
        "a folder that can be created",
        "name another folder",
        FileNotFoundError,  # a file system without folders of ours, such as /proc
    ):
        path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{_RUN}.tmp.{path.name}")
    temporary.unlink(missing_ok=True)  # a link of this name would lead the writer elsewhere
    try:
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    sync_folder(path.parent)


def remove_scraps(folder: Path) -> None:
    """Remove temporary files of `replacing` of killed runs: those that are older than a day.

    A link is never followed.
    """
    if folder.is_symlink():
        return
    for scrap in folder.glob(".*.tmp*"):
        with suppress(FileNotFoundError):  # renamed by its process just now
            if not scrap.is_dir() and time.time() - scrap.lstat().st_mtime > OLD_SCRAP_S:
                scrap.unlink()


def sync_folder(folder: Path) -> None:
    """Make a rename durable on POSIX; do nothing on systems and shares that cannot."""
    if os.name == "posix":
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.ENOTSUP, errno.EBADF):
                raise
        finally:
            os.close(handle)


def disk_is_full(error: BaseException) -> bool:
    """Return whether an error means a full disk, an exceeded quota, or a file of excessive size."""
    return isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file, in hex."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
