"""Checks at the start of a capture, while a person is still there to correct what is wrong."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime, timedelta

from fieldlum.capture.state import Ledger, SlotState
from fieldlum.capture.utc_clock import synchronised
from fieldlum.devices import Camera, not_offered
from fieldlum.devices.clock import Clock
from fieldlum.errors import DeviceError, NotEnoughDataError
from fieldlum.records import Slot
from fieldlum.session import Session

_CLOCK_TOLERANCE = timedelta(minutes=2)  # a session that was copied from another computer
_CLOCK_CHECK_S = 5.0


def refuse_a_past_plan(
    slots: Sequence[Slot], before: Ledger, now_utc: datetime, grace: timedelta
) -> None:
    """Last month's plan, or a clock that is far ahead: nothing is written down as missed for that.

    Raises NotEnoughDataError when no slot is ahead, and none was ever begun.
    """
    last = max((slot.t_utc for slot in slots), default=now_utc)
    if not before.slots and last + grace < now_utc:
        raise NotEnoughDataError(
            f"none of {len(slots)} slots is ahead: the last was {last:%Y-%m-%d %H:%M} UTC, and "
            f"this computer has "
            f"{now_utc:%Y-%m-%d %H:%M} UTC; set its clock, or take a new plan"
        )


def refuse_what_is_not_offered(
    camera: Camera, slots: Sequence[Slot], states: Mapping[str, SlotState]
) -> None:
    """Raises DeviceError for planned exposures that the camera cannot be set to, before the first
    bracket is done.

    Later somebody may have turned a dial, and may turn it back.
    """
    if any(state.outcome == "done" for state in states.values()):
        return
    if said := not_offered(camera, dict.fromkeys(e for slot in slots for e in slot.exposures)):
        more = f" (and {len(said) - 1} more)" if len(said) > 1 else ""
        raise DeviceError(
            f"the plan asks for what the camera does not offer: {said[0]}{more}; ask fieldlum "
            f"doctor"
        )


def wait_for_clock(
    session: Session,
    clock: Clock,
    say: Callable[[str], None],
    trusted: Callable[[], bool] = synchronised,
) -> None:
    """Wait while the computer's clock is earlier than the session itself.

    A small computer without a battery clock wakes up in the past and is right only once a time
    server answers; a bracket taken before would be filed under a wrong sun. The session's own file
    cannot be from the future, so an earlier clock is unset. Return at once when a time server
    vouches for the clock.
    """
    latest_utc = datetime.fromtimestamp(session.toml.stat().st_mtime, UTC)
    if clock.now() >= latest_utc - _CLOCK_TOLERANCE or trusted():
        return
    say(
        f"the clock is {clock.now():%Y-%m-%d %H:%M} UTC, earlier than the session "
        f"({latest_utc:%Y-%m-%d %H:%M} UTC): it is not set. Waiting until it is; connect to the "
        f"network or set it by hand."
    )
    while clock.now() < latest_utc - _CLOCK_TOLERANCE and not trusted():
        clock.sleep(_CLOCK_CHECK_S)
    say(f"the clock is set: {clock.now():%Y-%m-%d %H:%M} UTC")
