"""Read bounded files; write complete files or nothing; append lines with a CRC, flushed to disk."""

import errno
import hashlib
import json
import os
import stat
import tempfile
import time
import uuid
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from io import BufferedReader
from pathlib import Path
from typing import IO, Any

from filelock import FileLock

from fieldlum.core.errors import InputError, input_errors

_RUN = uuid.uuid4().hex[:12]  # in names of temporary files; differs in each process

# Larger files are not read, because they would fill the memory. EXR pictures with as many values as
# the reader accepts have less than a GiB; the arrays of a model of 2 200 captures can have more.
MAX_FILE_BYTES, MAX_ARRAY_BYTES = 2**30, 2**32


def open_file(
    path: Path | str, flags: int, *, follow_links: bool = False, folder: int | None = None
) -> int:
    """Open a regular file, without waiting for another program; return its handle.

    flags: of os.open, without O_TRUNC, which would act before the checks; follow_links: whether
    `path` itself may be a symbolic link; folder: handle of the folder to which a relative path
    belongs, None for the current one. Raises OSError for a folder, a pipe, a device, a link that is
    not followed, and when writing, for a file with several hard links.
    """
    # Absent on Windows, where a link needs a right that users do not have. O_NONBLOCK is for a
    # named pipe; it has no effect on files.
    names = ("O_CLOEXEC", "O_NONBLOCK", *(() if follow_links else ("O_NOFOLLOW",)))
    no_file = OSError(errno.ENXIO, "a pipe, socket or device, which is no file", str(path))
    try:
        flags |= sum(getattr(os, name, 0) for name in names)
        handle = os.open(path, flags, 0o666, dir_fd=folder)
    except OSError as error:
        raise no_file if error.errno == errno.ENXIO else error from None
    about = os.fstat(handle)
    # An archive can hold a hard link to a file of the folder in which it is unpacked.
    is_shared = about.st_nlink > 1 and flags & (os.O_WRONLY | os.O_RDWR) != 0
    if stat.S_ISREG(about.st_mode) and not is_shared:
        return handle
    os.close(handle)
    if stat.S_ISREG(about.st_mode):
        raise OSError(errno.EMLINK, "a file that has another name too (hard link)", str(path))
    if stat.S_ISDIR(about.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    raise no_file


opener: Callable[[Path, int], int] = partial(open_file, follow_links=True)
"""Opens each file that is read or replaced, by its path and the flags of os.open.

fieldlum.session replaces it by one that refuses links within a session.
"""


def open_to_read(path: Path, maximum_bytes: int = MAX_FILE_BYTES) -> BufferedReader:
    """Return a file that is open for reading.

    Raises OSError for a missing file, a pipe or device, a file over `maximum_bytes`, and a link in
    a session that the user did not permit.
    """
    file = open(path, "rb", opener=lambda _, flags: opener(path, flags))  # noqa: SIM115
    size = os.fstat(file.fileno()).st_size
    if size > maximum_bytes:
        file.close()
        found = f"{size / 2**20:.1f} MiB, more than the limit of {maximum_bytes / 2**20:g} MiB"
        raise OSError(errno.EOVERFLOW, found, str(path))
    return file


def read_bytes(path: Path, maximum_bytes: int = MAX_FILE_BYTES) -> bytes:
    """Return the content of a file. Raises the errors of `open_to_read`."""
    with open_to_read(path, maximum_bytes) as file:
        return file.read()


# ----------------------------------------------------------------------------------------------
# writing


@contextmanager
def replacing(path: Path, mode: str = "wb", **kwargs: Any) -> Iterator[IO[Any]]:
    """Yield a file that gets the name `path` only when it is complete.

    The file has a temporary name in the same folder, is flushed to disk after the `with` block, and
    is then renamed. After an exception in the block it is removed instead, and an earlier file of
    this name remains. mode, kwargs: arguments of `open`. Raises the errors of `replacing_path`.
    """
    with replacing_path(path) as temporary, temporary.open(mode, **kwargs) as file:
        yield file


def write_file(path: Path, content: bytes | str) -> Path:
    """Write a complete file of bytes, or of a text in UTF-8, as `replacing` does; return `path`.

    Raises the errors of `replacing_path`.
    """
    with replacing(path) as file:
        file.write(content.encode() if isinstance(content, str) else content)
    return path


def check_writable(folder: Path) -> None:
    """Raise an error if no file can be written into a folder, which need not exist.

    Stages that compute for minutes call this first. Nothing remains of the test, and temporary
    files of killed runs are removed. Raises OSError, which names the innermost folder that exists,
    or InputError for a place on a disk that is not mounted.
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

    For writers that need a path; see `replacing`. The file exists, empty, when the block begins.
    Missing folders above `path` are created. After an exception the temporary file is removed.
    Raises InputError if the folder cannot be created, such as in /proc, OSError for other failures.
    """
    expected, remedy = "a folder that can be created", "name another folder"
    with input_errors(path.parent, expected, remedy, FileNotFoundError):
        path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{_RUN}.tmp.{path.name}")
    temporary.unlink(missing_ok=True)  # a link of this name would lead the writer elsewhere
    os.close(opener(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL))
    try:
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    sync_folder(path.parent)


def remove_scraps(folder: Path) -> None:
    """Remove the temporary files that killed runs left in a folder: those older than a day.

    Their names have the form ``.*.tmp*``. If the folder is a link, nothing is removed.
    """
    if folder.is_symlink():
        return
    for scrap in folder.glob(".*.tmp*"):
        with suppress(FileNotFoundError):  # renamed by its process just now
            if not scrap.is_dir() and time.time() - scrap.lstat().st_mtime > 86400.0:
                scrap.unlink()


def sync_folder(folder: Path) -> None:
    """Write a folder's entries to the disk, so that a rename survives a power cut.

    Do nothing on systems and shares that cannot do this. Raises OSError for other failures.
    """
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
    """Return the SHA-256 of a file up to 4 GiB, in hex. Raises the errors of `open_to_read`."""
    with open_to_read(path, MAX_ARRAY_BYTES) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


# ----------------------------------------------------------------------------------------------
# appending lines


def encode_line(row: Mapping[str, object]) -> bytes:
    """Return a line of a journal: CRC-32 of the text in hex, a space, compact JSON, newline."""
    text = json.dumps(row, separators=(",", ":"), ensure_ascii=False)
    return f"{zlib.crc32(text.encode()):08x} {text}\n".encode()


def decode_line(line: bytes) -> Any:
    """Return the JSON value in a line of `encode_line`; None for an incomplete or damaged line."""
    crc, _, text = line.rstrip(b"\n").partition(b" ")
    try:
        valid = line.endswith(b"\n") and len(crc) == 8 and int(crc, 16) == zlib.crc32(text)
        return json.loads(text) if valid else None
    except (ValueError, RecursionError):
        return None


@contextmanager
def exclusive(path: Path) -> Iterator[None]:
    """Hold the lock file `path` in a `with` block, against other processes that append.

    Continue without it on a file system that has no locks or is full, or if another process has it
    for more than 0.25 s: a capture must not wait for a stopped program.
    """
    # A line and its flush take milliseconds. Without the lock two lines could mix only on a file
    # system that splits writes, and the CRC would show it.
    lock = FileLock(path, timeout=0.25, poll_interval=0.002)
    with suppress(OSError):  # filelock's Timeout is an OSError too
        lock.acquire()
    try:
        yield
    finally:
        lock.release()


def cut_torn_tail(path: Path, is_valid: Callable[[bytes], bool]) -> int:
    """Cut a file after its last valid line; return the number of bytes moved to ``NAME.torn``.

    A kill or a power cut during a write leaves half a line, or a page of zeros. Damaged lines
    before the last valid one remain: readers skip them. is_valid: returns whether a line, with its
    line feed, is valid. A missing file gives 0. Raises InputError if the last MiB has three or more
    lines, none valid; OSError if a file cannot be read or written.
    """
    if not path.is_file():
        return 0
    with os.fdopen(open_file(path, os.O_RDWR), "rb+") as file:
        file.seek(max(0, file.seek(0, os.SEEK_END) - (1 << 20)))
        lines = file.readlines()
        # number of lines up to the last valid one
        count = next((k for k in range(len(lines), 0, -1) if is_valid(lines[k - 1])), 0)
        if not count and b"".join(lines).count(b"\n") > 2:
            found, remedy = "no valid line at the end of the file", "restore it, or move it away"
            raise InputError(path, found, "a file written by fieldlum", remedy)
        if rest := b"".join(lines[count:]):
            flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT
            with os.fdopen(open_file(path.with_name(f"{path.name}.torn"), flags), "ab") as torn:
                torn.write(rest)
            file.truncate(file.tell() - len(rest))
            os.fsync(file.fileno())
    return len(rest)


def break_hard_links(path: Path) -> None:
    """Replace a file that has other names too (hard links) by a copy that has only this name.

    Some backup programs create such links; appending would change the backup. The other names keep
    the earlier file. Raises OSError if the copy cannot be written.
    """
    if path.is_file() and not path.is_symlink() and path.stat().st_nlink > 1:
        write_file(path, read_bytes(path))


def is_replaced(handle: int, path: Path) -> bool:
    """Return whether `path` is now another regular file than that of an open handle.

    False if `path` is missing, or no regular file.
    """
    try:
        now = path.stat(follow_symlinks=False)
    except OSError:
        return False
    return stat.S_ISREG(now.st_mode) and not os.path.samestat(os.fstat(handle), now)


def append_complete(handle: int, data: bytes, *, flush: bool) -> None:
    """Append all of `data` to an open file, or nothing; with `flush`, wait for the disk.

    handle: of os.open with O_APPEND. On failure the file gets its earlier length, and the OSError
    is raised.
    """
    before = os.fstat(handle).st_size
    try:
        while data:
            data = data[os.write(handle, data) :]
        if flush:
            getattr(os, "fdatasync", os.fsync)(handle)
    except OSError:
        with suppress(OSError):
            os.ftruncate(handle, before)
        raise
