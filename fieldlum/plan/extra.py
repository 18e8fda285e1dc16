"""Plan an additional bracket soon, at a user's request during a running capture."""

from __future__ import annotations

from datetime import datetime, timedelta

import numpy as np

from fieldlum.core.errors import InputError
from fieldlum.core.records import Slot
from fieldlum.plan import make_slots
from fieldlum.plan.days import DaylightHours
from fieldlum.plan.makeup import add_slots
from fieldlum.session import Session
from fieldlum.sky import sun

EXTRA = "extra"  # tag of such a slot
# the capture reads the plan each second, and a camera needs time to wake up; chosen
LEAD = timedelta(seconds=45)
# Between the end of the extra bracket and the next planned one, for a slow card or a repeated
# frame. Chosen.
MARGIN = timedelta(seconds=60)


def add_extra(session: Session, now_utc: datetime) -> Slot:
    """Add a slot to plan.csv at the next full minute that is over 45 s away, and return it.

    Its exposures are those of the last planned slot before it (of the first slot if there is none).
    It has the tag "extra". Raises InputError if the sun is down, if a coming extra slot is already
    planned, if one is nearer to the new slot than the duration of a bracket plus a minute, or if
    the plan has no slots.
    """
    at = (now_utc + LEAD).replace(second=0, microsecond=0) + timedelta(minutes=1)
    slots, setup = session.slots(), session.site_file()
    seconds = float(session.table().get("plan", {}).get("seconds_per_slot", 60.0))
    busy = timedelta(seconds=seconds) + MARGIN
    for slot in (slot for slot in slots if slot.t_utc >= now_utc):
        if EXTRA in slot.tags:
            raise InputError(
                session.plan,
                f"an extra bracket is already planned, at {slot.id}",
                "one extra bracket at a time",
                "request it again after that bracket",
            )
        if at - busy < slot.t_utc < at + busy:
            raise InputError(
                session.plan,
                f"the extra bracket would be too close to the planned bracket {slot.id}",
                f"{busy.total_seconds():.0f} s before and after it without a planned bracket",
                "request it again after that bracket",
            )
    if not slots:
        raise InputError(
            session.plan,
            "no slot, so the exposures of an extra bracket are unknown",
            "a plan with slots",
            "plan a new session: fieldlum plan SITE.toml --set 9-day --out FOLDER",
        )
    where = sun.position([at], setup.site)
    altitude = float(where.altitude_deg[0])
    if altitude <= 0:
        raise InputError(
            session.plan,
            f"the sun is {-altitude:.0f} deg below the horizon",
            "daylight",
            "add an extra bracket by day",
        )
    like = max((s for s in slots if s.t_utc <= at), key=lambda s: s.t_utc, default=slots[0])
    hour = DaylightHours((at,), np.array([altitude]), where.azimuth_deg)
    (slot,) = make_slots(hour, setup, like.exposures)
    extra = Slot(at, altitude, slot.sun_azimuth_deg, slot.exposures, (*slot.tags, EXTRA))
    add_slots(session, [extra])
    return extra
