"""Keep this computer awake while a capture runs, by a lock of the operating system."""

from __future__ import annotations

import os
import select
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress

# A closed lid needs a lock of its own. If it is refused (for example in a remote login), the other
# two locks are still requested.
_WHAT = ("sleep:idle:handle-lid-switch", "sleep:idle")
_PATIENCE_S = 5.0  # timeout for an answer of the lock's process; chosen, not measured


@contextmanager
def kept_awake() -> Iterator[str]:
    """Keep the computer awake inside the `with` block; yield the names of the granted locks.

    The names are those of systemd, joined by colons (``sleep:idle:handle-lid-switch``), or "" if no
    lock was granted. Linux uses a lock of systemd-logind, macOS caffeinate, Windows the thread's
    execution state (the last two are untested). The lock ends with this process, even after a
    crash.
    """
    if sys.platform == "win32":
        with _windows() as what:
            yield what
        return
    process, what = _start()
    try:
        yield what
    finally:
        if process is not None:
            _ended(process)


def granted_locks() -> str:
    """Take the locks against sleep, release them, and return their names; see `kept_awake`."""
    with kept_awake() as what:
        return what


def _start() -> tuple[subprocess.Popen[bytes] | None, str]:
    if sys.platform == "darwin":
        with suppress(OSError):
            line = ["caffeinate", "-dims", "-w", str(os.getpid())]
            return subprocess.Popen(line, start_new_session=True), "sleep:idle"
    elif sys.platform.startswith("linux"):
        for what in _WHAT:
            if (process := _inhibit(what)) is not None:
                return process, what
    return None, ""


def _inhibit(what: str) -> subprocess.Popen[bytes] | None:
    """Start `cat` under the lock; return its process, or None if the lock is refused.

    The process answers once the lock is granted, and ends when this process ends.
    """
    why = ["--who=fieldlum", "--why=captures are planned", "--mode=block"]
    pipe = subprocess.PIPE
    try:
        process = subprocess.Popen(
            ["systemd-inhibit", f"--what={what}", *why, "cat"],
            stdin=pipe,
            stdout=pipe,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
    except OSError:
        return None
    assert process.stdin is not None and process.stdout is not None
    with suppress(OSError):
        process.stdin.write(b"?\n")
        process.stdin.flush()
        answered = select.select([process.stdout], [], [], _PATIENCE_S)[0]
        if answered and process.stdout.read(2) == b"?\n":
            return process
    process.kill()
    _ended(process)
    return None


def _ended(process: subprocess.Popen[bytes]) -> None:
    """End a process and close its pipes."""
    with suppress(OSError, subprocess.TimeoutExpired):
        process.terminate()
        process.wait(_PATIENCE_S)
    for pipe in (process.stdin, process.stdout):
        with suppress(OSError):
            if pipe is not None:
                pipe.close()


@contextmanager
def _windows() -> Iterator[str]:
    import ctypes

    state = getattr(ctypes, "windll").kernel32.SetThreadExecutionState  # noqa: B009
    continuous, system_required = 0x80000000, 0x00000001
    held = bool(state(continuous | system_required))
    try:
        yield "sleep:idle" if held else ""
    finally:
        state(continuous)
