"""How a capture is run, where that is not the plan's to say."""

from __future__ import annotations

from dataclasses import dataclass

from fieldlum.capture.recorder import RESERVE_BYTES
from fieldlum.session import DEFAULT_GRACE_S


@dataclass(frozen=True, slots=True)
class Options:
    # a bracket may start this late; later it is missed, never caught up in a burst
    grace_s: float = DEFAULT_GRACE_S
    log_every_s: float = 5.0
    log_around_s: float | None = (
        None  # log only this long before a slot (simulated time); None: all the time
    )
    threaded: bool = (
        True  # the log in a thread of its own; else from the loop, for a simulated clock
    )
    watchdog_s: float = 60.0  # a device that is silent for longer has hung
    on_misses: str = ""  # shell command to run when two slots in a row gave no bracket
    reserve_bytes: int = RESERVE_BYTES
    flush: bool = True  # False: survives a kill, but not a power cut
    # which start of the machine this is; lets a restarted capture see a clock step made in between
    boot: str = ""


DEFAULTS = Options()
