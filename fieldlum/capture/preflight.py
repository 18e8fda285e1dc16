"""Check for faults at the start of a capture, while somebody can still correct them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime, timedelta

from fieldlum.core.errors import DeviceError, NotEnoughDataError
from fieldlum.core.records import Slot
from fieldlum.devices import Camera, not_offered
from fieldlum.devices.clock import Clock, synchronised
from fieldlum.session import Session
from fieldlum.session.ledger import Ledger, SlotState

_CLOCK_TOLERANCE = timedelta(minutes=2)  # for a session copied from another computer; not measured
_CLOCK_CHECK_S = 5.0  # chosen


def refuse_a_clock_behind(now_utc: datetime, last_utc: datetime) -> None:
    """Raise DeviceError if the clock is over 2 s before the last journal entry."""
    if now_utc < last_utc - timedelta(seconds=2):
        raise DeviceError(
            f"this computer's clock shows {now_utc:%Y-%m-%d %H:%M:%S} UTC, before the last "
            "journal entry "
            f"({last_utc:%Y-%m-%d %H:%M:%S}): set the clock, then start again"
        )


def refuse_a_past_plan(
    slots: Sequence[Slot], before: Ledger, now_utc: datetime, grace: timedelta
) -> None:
    """Raise NotEnoughDataError if every slot is past and the journal has no event of a slot.

    grace: how late a bracket may start. Otherwise all slots would be journalled as missed. The
    cause is an old plan, or a clock that is fast.
    """
    last = max((slot.t_utc for slot in slots), default=now_utc)
    if not before.slots and last + grace < now_utc:
        raise NotEnoughDataError(
            f"the plan has no slot left: the last was {last:%Y-%m-%d %H:%M} UTC, and this "
            f"computer's clock shows {now_utc:%Y-%m-%d %H:%M} UTC; correct the clock, or plan "
            "missed slots again with fieldlum plan SESSION --replan"
        )


def refuse_what_is_not_offered(
    camera: Camera, slots: Sequence[Slot], states: Mapping[str, SlotState]
) -> None:
    """Raise DeviceError for planned exposures to which the camera cannot be set.

    After the first complete bracket nothing is checked: a mismatch may then be a turned dial, which
    can be turned back. Raises NotEnoughDataError if no slot has an exposure.
    """
    if any(state.outcome == "done" for state in states.values()):
        return
    empty = [slot.id for slot in slots if not slot.exposures]
    if len(empty) == len(slots) and empty:  # hours of `simulate --year-sample` are not a plan
        raise NotEnoughDataError(
            f"no slot of the plan has an exposure (first slot: {empty[0]}); plan a new session "
            "with fieldlum plan"
        )
    if refused := not_offered(camera, dict.fromkeys(e for slot in slots for e in slot.exposures)):
        more = f" (and {len(refused) - 1} more)" if len(refused) > 1 else ""
        raise DeviceError(
            f"the plan has exposures that the camera cannot be set to: {refused[0]}{more}; run "
            f"fieldlum doctor"
        )


def wait_for_clock(
    session: Session,
    clock: Clock,
    say: Callable[[str], None],
    trusted: Callable[[], bool | None] = synchronised,
) -> None:
    """Wait while the computer's clock is over two minutes earlier than the session's last change.

    A small computer without a clock battery starts with a past time, until a time server answers. A
    bracket taken before that would be filed under a wrong sun position. Return at once if
    `trusted()`, which means that a time server has set the clock. say: called with notes for the
    user.
    """
    latest_utc = datetime.fromtimestamp(session.toml.stat().st_mtime, UTC)
    if clock.now() >= latest_utc - _CLOCK_TOLERANCE or trusted():
        return
    say(
        f"this computer's clock shows {clock.now():%Y-%m-%d %H:%M} UTC, earlier than the session "
        f"({latest_utc:%Y-%m-%d %H:%M} UTC), so it has not been set. The capture waits: "
        "connect to the network, or set the clock."
    )
    while clock.now() < latest_utc - _CLOCK_TOLERANCE and not trusted():
        clock.sleep(_CLOCK_CHECK_S)
    say(f"the clock is set: {clock.now():%Y-%m-%d %H:%M} UTC")
