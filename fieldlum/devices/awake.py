"""Keep this computer awake while a capture runs, by a lock of systemd-logind."""

from __future__ import annotations

import select
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

# A closed lid needs a lock of its own. If it is refused (for example in a remote login), the other
# two locks are still requested.
_WHAT = ("sleep:idle:handle-lid-switch", "sleep:idle")
_PATIENCE_S = 5.0  # for an answer of the lock's process


@contextmanager
def kept_awake() -> Iterator[str]:
    """Keep the computer awake inside the `with` block; yield the names of the granted locks.

    The names are those of systemd, joined by colons (``sleep:idle:handle-lid-switch``), or "" if no
    lock was granted. The lock ends with this process, even after a crash.
    """
    process, granted = None, ""
    for what in _WHAT:
        if (process := _inhibit(what)) is not None:
            granted = what
            break
    try:
        yield granted
    finally:
        if process is not None:
            _end(process)


def _inhibit(what: str) -> subprocess.Popen[Any] | None:
    """Start `cat` under the lock; return its process, or None if the lock is refused.

    The process answers once the lock is granted, and ends when this process ends.
    """
    command = ["systemd-inhibit", f"--what={what}", "--who=fieldlum", "--why=captures are planned"]
    pipes: dict[str, Any] = {
        "stdin": subprocess.PIPE,
        "stdout": subprocess.PIPE,
        "stderr": subprocess.DEVNULL,
    }
    try:
        process = subprocess.Popen([*command, "cat"], bufsize=0, start_new_session=True, **pipes)
    except OSError:
        return None
    assert process.stdin is not None and process.stdout is not None
    with suppress(OSError):
        process.stdin.write(b"?\n")
        answered = select.select([process.stdout], [], [], _PATIENCE_S)[0]
        if answered and process.stdout.read(2) == b"?\n":
            return process
    _end(process)
    return None


def _end(process: subprocess.Popen[Any]) -> None:
    """End a process and close its pipes."""
    with process:
        process.kill()
