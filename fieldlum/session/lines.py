"""Append to files line by line: with a CRC, flushed to disk.

Remove an incomplete last line on opening.
"""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from filelock import FileLock

from fieldlum.core.errors import InputError
from fieldlum.session.inside import open_file

# Seconds. A line and its flush take milliseconds. After this time the line is appended without the
# lock. Two lines could then mix only on a file system that splits writes, and the CRC would show
# it. Chosen.
_MAX_LOCK_S = 0.25
_LOCK_EVERY_S = 0.002  # pause between two tries to lock [s]; not measured
# bytes that are searched for the last valid line; an incomplete line is far shorter; chosen
_TAIL_BYTES = 1 << 20


def encode_line(row: Mapping[str, object]) -> bytes:
    """Return one journal line: CRC-32 in hex, a space, compact JSON, newline."""
    text = json.dumps(row, separators=(",", ":"), ensure_ascii=False)
    return f"{zlib.crc32(text.encode()):08x} {text}\n".encode()


def decode_line(line: bytes) -> Any:
    """Return the JSON value in a complete and undamaged line; None for any other line."""
    crc, _, text = line.rstrip(b"\n").partition(b" ")
    try:
        sound = line.endswith(b"\n") and len(crc) == 8 and int(crc, 16) == zlib.crc32(text)
        return json.loads(text) if sound else None
    except (ValueError, RecursionError):
        return None


@contextmanager
def exclusive(path: Path) -> Iterator[None]:
    """Hold a lock file inside the block, against other processes that append.

    Continue without it on a file system that has no locks or is full, or if another process has it
    for more than 0.25 s: a capture must not wait for a stopped program.
    """
    lock = FileLock(path, timeout=_MAX_LOCK_S, poll_interval=_LOCK_EVERY_S)
    with suppress(OSError):  # of which Timeout is one
        lock.acquire()
    try:
        yield
    finally:
        lock.release()


def cut_torn_tail(path: Path, sound: Callable[[bytes], bool]) -> int:
    """Cut `path` after its last valid line; return the number of bytes moved to ``NAME.torn``.

    A kill or a power cut during a write leaves half a line, or a page of zeros. Damaged lines
    before the last valid one remain: readers skip them. sound: whether a line is valid. A missing
    file gives 0. Raises InputError if the last MiB has three or more lines and none is valid.
    """
    if not path.is_file():
        return 0
    with os.fdopen(open_file(path, os.O_RDWR), "rb+") as file:
        file.seek(max(0, file.seek(0, os.SEEK_END) - _TAIL_BYTES))
        lines = file.readlines()
        kept = next((k for k in range(len(lines), 0, -1) if sound(lines[k - 1])), 0)
        if not kept and b"".join(lines).count(b"\n") > 2:
            found, remedy = "no valid line at the end of the file", "restore it, or move it away"
            raise InputError(path, found, "a file written by fieldlum", remedy)
        if rest := b"".join(lines[kept:]):
            flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT
            with os.fdopen(open_file(path.with_name(f"{path.name}.torn"), flags), "ab") as torn:
                torn.write(rest)
            file.truncate(file.tell() - len(rest))
            os.fsync(file.fileno())
    return len(rest)


def append_complete(handle: int, data: bytes, *, flush: bool) -> None:
    """Append all of `data` to a file opened with O_APPEND; with `flush`, wait for the disk.

    On failure the file gets its earlier length, and the OSError is raised.
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
