"""List the programs that keep this computer awake, by the locks of systemd."""

from __future__ import annotations

import os
import re
import subprocess
from dataclasses import dataclass
from pathlib import Path

from fieldlum.devices.awake import kept_awake

# One lock per line: who (may have blanks), uid, user, pid, command, what, why (may have blanks),
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
    """A lock that prevents the computer from some actions: sleep, idle, handle-lid-switch.

    who: the program; mode: block; delay only postpones by some seconds; block-weak yields to the
    user.
    """

    who: str
    what: frozenset[str]
    mode: str


def inhibitors(timeout_s: float = 10.0) -> list[Lock] | None:
    """Return the locks of `systemd-inhibit --list`.

    None if the program is missing, hangs or fails.
    """
    # A wide terminal, because cells are cut to its width; English, because the text is parsed.
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
    """Parse the list of locks: a table in systemd 240 and later, blocks in older versions.

    The table may lack its heading.
    """
    rows = [_LOCK.fullmatch(line) for line in listed.splitlines()]
    blocks = list(_LOCK_BEFORE_240.finditer(listed))
    locks = [match for match in (*rows, *blocks) if match]
    return [Lock(m["who"].strip(), frozenset(m["what"].split(":")), m["mode"]) for m in locks]


def has_lid() -> bool:
    """Return whether this computer has a lid, by Linux's ACPI; False on other systems."""
    return any(Path("/proc/acpi/button/lid").glob("*"))


def lock_to_be_had() -> str:
    """Take the locks against sleep that `capture` takes, release them, and return their names.

    They are joined by colons, such as ``sleep:idle``; "" if none can be had.
    """
    with kept_awake() as what:
        return what
