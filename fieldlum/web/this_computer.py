"""The computer that serves the page: its battery, and whether a capture runs on it."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from fieldlum.capture.utc_clock import boot_id
from fieldlum.core.records import JsonTable
from fieldlum.web.follow import JournalState


def is_running(journal: JournalState) -> bool | None:
    """Return whether the capture that the journal shows as open runs on this computer.

    False without an open one, or if it began before this boot or on another computer. None if that
    cannot be determined.
    """
    if journal.opened is None:
        return False
    if journal.opened.get("boot_id") not in ("", None, boot_id()):
        return False
    if sys.platform == "win32":  # os.kill(pid, 0) would end the process there
        return None
    try:
        os.kill(int(journal.opened.get("pid", 0)) or -1, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, ValueError, OverflowError):
        return None
    return True


def battery() -> JsonTable | None:
    """Return {"percent", "mains"} of this computer's battery (Linux); None where there is none.

    mains: whether it has external power; the key is absent where that is unknown.
    """
    percent: int | None = None
    mains: bool | None = None
    for supply in sorted(Path("/sys/class/power_supply").glob("*")):
        try:
            kind = (supply / "type").read_text().strip()
            if kind == "Battery" and (supply / "capacity").is_file():
                percent = int((supply / "capacity").read_text())
            elif kind in ("Mains", "USB") and (supply / "online").is_file():
                mains = (supply / "online").read_text().strip() == "1" or bool(mains)
        except (OSError, ValueError):
            continue
    if percent is None:
        return None
    return {"percent": percent} if mains is None else {"percent": percent, "mains": mains}
