"""Options of a capture that are not part of the plan."""

from __future__ import annotations

from dataclasses import dataclass

from fieldlum.capture.recorder import RESERVE_BYTES
from fieldlum.session import DEFAULT_GRACE_S


@dataclass(frozen=True, slots=True)
class Options:
    """How a capture runs."""

    # a bracket may start this late [s]; a later one is missed, and not made up for
    grace_s: float = DEFAULT_GRACE_S
    log_every_s: float = 5.0
    # log only this long before a slot (in simulated time); None: always
    log_around_s: float | None = None
    # True: the log has its own thread; False: the loop polls, for a simulated clock
    threaded: bool = True
    watchdog_s: float = 60.0  # a device that does not answer for longer is closed and reopened
    on_misses: str = ""  # shell command to run when two slots in a row gave no bracket
    reserve_bytes: int = RESERVE_BYTES
    flush: bool = True  # False: files survive a killed process, but not a power cut
    # identifies the boot of the machine, so that a restarted capture can detect a clock step
    boot: str = ""


DEFAULTS = Options()
