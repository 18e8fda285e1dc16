"""Options of a capture that are not part of the plan."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from fieldlum.capture.recorder import RESERVE_BYTES
from fieldlum.capture.utc_clock import boot_id
from fieldlum.devices.clock import Clock, FastClock, RealClock
from fieldlum.session import DEFAULT_GRACE_S, Session
from fieldlum.session.ledger import read_ledger, slots_to_do

FAST_LEAD_S = 20.0  # simulated seconds before a slot: four rows of irradiance at 5 s; chosen


@dataclass(frozen=True, slots=True)
class Options:
    """Settings of a running capture that are not in the plan: times, watchdog, hook, disk.

    grace_s: how late a bracket may start; after that its slot is missed. log_around_s: log
    irradiance only from this time before a slot, in simulated time; None: always. threaded: whether
    the log has its own thread; else the loop polls, as a simulated clock requires. watchdog_s: a
    device that does not answer for longer is closed and reopened. on_misses: shell command after
    two slots in a row without a bracket. reserve_bytes: disk space for journal and rows. flush:
    with False, files survive a killed process but not a power cut. boot: identifies the computer's
    boot, to detect a clock step after a restart.
    """

    grace_s: float = DEFAULT_GRACE_S
    log_every_s: float = 5.0
    log_around_s: float | None = None
    threaded: bool = True
    watchdog_s: float = 60.0
    on_misses: str = ""
    reserve_bytes: int = RESERVE_BYTES
    flush: bool = True
    boot: str = ""


DEFAULTS = Options()


def prepare(session: Session, *, fast: bool) -> tuple[Clock, Options]:
    """Return the clock and the options of a capture.

    fast: a simulated clock that jumps from slot to slot. It starts where the journal ends, or,
    without an event, a minute before the first slot.
    """
    grace_s = session.grace.total_seconds()
    if not fast:
        return RealClock(), Options(grace_s=grace_s, boot=boot_id())
    ledger = read_ledger(session)
    slots = slots_to_do(session.slots(), ledger)
    lead = timedelta(seconds=60)
    start = ledger.last_utc or (slots[0].t_utc - lead if slots else datetime.now(UTC))
    options = Options(grace_s=grace_s, log_around_s=FAST_LEAD_S, threaded=False, flush=False)
    return FastClock(start), options
