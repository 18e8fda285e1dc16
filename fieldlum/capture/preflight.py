"""What a capture says at its start, while a person is still there, instead of losing every slot
of the month.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime, timedelta

from fieldlum.capture.state import Ledger, SlotState
from fieldlum.devices import Camera, not_offered
from fieldlum.errors import DeviceError, NotEnoughDataError
from fieldlum.records import Slot


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
