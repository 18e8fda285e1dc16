"""Options of a capture that are not part of the plan."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from fieldlum.capture.recorder import RESERVE_BYTES
from fieldlum.capture.utc_clock import boot_id
from fieldlum.devices.clock import Clock, FastClock, RealClock
from fieldlum.session import DEFAULT_GRACE_S, Session
from fieldlum.session.ledger import owed, read_ledger

FAST_LEAD_S = 20.0  # simulated seconds before a slot: four rows of irradiance at 5 s; chosen


@dataclass(frozen=True, slots=True)
class Options:
    """Settings of a running capture that are not in the plan: times, watchdog, hook, disk."""

    # a bracket may start this late [s]; after that its slot is missed
    grace_s: float = DEFAULT_GRACE_S
    log_every_s: float = 5.0
    # log irradiance only from this time before a slot [s], in simulated time; None: always
    log_around_s: float | None = None
    # True: the log has its own thread; False: the loop polls, as a simulated clock requires
    threaded: bool = True
    watchdog_s: float = 60.0  # a device that does not answer for longer is closed and reopened
    on_misses: str = ""  # shell command to run when two slots in a row gave no bracket
    reserve_bytes: int = RESERVE_BYTES
    flush: bool = True  # False: files survive a killed process, but not a power cut
    # identifies the boot of the computer, so that a restarted capture can detect a clock step
    boot: str = ""


DEFAULTS = Options()


def prepare(session: Session, *, fast: bool) -> tuple[Clock, Options]:
    """Return the clock and the options of a capture.

    fast: a simulated clock that jumps from slot to slot. It starts a minute before the first slot,
    or where the journal ends.
    """
    grace_s = session.grace.total_seconds()
    if not fast:
        return RealClock(), Options(grace_s=grace_s, boot=boot_id())
    ledger = read_ledger(session)
    slots = owed(session.slots(), ledger)
    lead = timedelta(seconds=60)
    start = ledger.last_utc or (slots[0].t_utc - lead if slots else datetime.now(UTC))
    options = Options(grace_s=grace_s, log_around_s=FAST_LEAD_S, threaded=False, flush=False)
    return FastClock(start), options
