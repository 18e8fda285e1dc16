"""The programs that keep this computer awake: the locks of systemd."""

from __future__ import annotations

import os
import re
import subprocess
from dataclasses import dataclass
from pathlib import Path

from fieldlum.devices.awake import kept_awake

# One lock a line: who (may have spaces), uid, user, pid, command, what, why (may have spaces),
# mode.
_LOCK = re.compile(
    r"(?P<who>.*?) +\d+ +\S+ +\d+ +\S+ "
    r"+(?P<what>(?:shutdown|sleep|idle|handle-[a-z-]+)(?::[a-z-]+)*) +(?:.* )?"
    r"(?P<mode>block|block-weak|delay) *"
)
_LOCK_BEFORE_240 = re.compile(
    r"(?m)^ *Who: (?P<who>.*?)(?: \(.*)?\n *What: (?P<what>\S+)\n *Why: .*\n *Mode: (?P<mode>\S+)"
)


@dataclass(frozen=True, slots=True)
class Lock:
    """A lock that keeps the computer from an action of its own: sleep, idle, handle-lid-switch."""

    who: str
    what: frozenset[str]
    mode: str  # block; delay postpones by some seconds only; block-weak yields to the user


def inhibitors(timeout_s: float = 10.0) -> list[Lock] | None:
    """Return the locks of `systemd-inhibit --list`; None if it is missing, hangs or fails."""
    # A wide terminal, because cells are cut to its width; English, because words are searched.
    environment = {
        **os.environ,
        "LC_ALL": "C",
        "COLUMNS": "500",
        "SYSTEMD_PAGER": "cat",
        "SYSTEMD_COLORS": "0",
    }
    try:
        listed = subprocess.run(
            ["systemd-inhibit", "--list"],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=timeout_s,
            env=environment,
            check=False,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    if listed.returncode != 0:
        return None
    return parse_locks(listed.stdout.decode("utf-8", "replace"))


def parse_locks(listed: str) -> list[Lock]:
    """Parse both forms: the table of systemd 240 and later, and the blocks of older versions.

    The table may lack its heading.
    """
    rows = [_LOCK.fullmatch(line) for line in listed.splitlines()]
    blocks = list(_LOCK_BEFORE_240.finditer(listed))
    locks = [match for match in (*rows, *blocks) if match]
    return [Lock(m["who"].strip(), frozenset(m["what"].split(":")), m["mode"]) for m in locks]


def has_lid() -> bool:
    """Return whether this computer has a lid."""
    return any(Path("/proc/acpi/button/lid").glob("*"))


def lock_to_be_had() -> str:
    """Return the locks that `capture` will have while it runs."""
    with kept_awake() as what:
        return what
