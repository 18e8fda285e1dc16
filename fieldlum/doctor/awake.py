"""Who keeps this computer awake: the locks that systemd knows of."""

from __future__ import annotations

import os
import re
import subprocess
from dataclasses import dataclass
from pathlib import Path

from fieldlum.devices.awake import kept_awake

# One lock a line: who (may hold spaces), uid, user, pid, command, what, why (may hold spaces),
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
    """What somebody forbids the computer to do by itself: sleep, idle, handle-lid-switch ..."""

    who: str
    what: frozenset[str]
    mode: str  # block; delay only holds it up for some seconds; block-weak yields to the user


def inhibitors(timeout_s: float = 10.0) -> list[Lock] | None:
    """What `systemd-inhibit --list` says; None where it is not there, has no bus, hangs or
    fails.
    """
    # A wide terminal: cells are cut to its width otherwise. English: words are looked for.
    surroundings = {
        **os.environ,
        "LC_ALL": "C",
        "COLUMNS": "500",
        "SYSTEMD_PAGER": "cat",
        "SYSTEMD_COLORS": "0",
    }
    try:
        said = subprocess.run(
            ["systemd-inhibit", "--list"],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=timeout_s,
            env=surroundings,
            check=False,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return parse_locks(said.stdout.decode("utf-8", "replace")) if said.returncode == 0 else None


def parse_locks(listed: str) -> list[Lock]:
    """Both forms: the table of systemd 240 and later (with or without its heading), and the
    blocks of before.
    """
    found = [_LOCK.fullmatch(line) for line in listed.splitlines()] + list(
        _LOCK_BEFORE_240.finditer(listed)
    )
    return [Lock(m["who"].strip(), frozenset(m["what"].split(":")), m["mode"]) for m in found if m]


def has_lid() -> bool:
    return any(Path("/proc/acpi/button/lid").glob("*"))


def lock_to_be_had() -> str:
    """What `capture` will hold by itself while it runs."""
    with kept_awake() as what:
        return what
