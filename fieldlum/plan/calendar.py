"""Write a plan as a calendar: one event per day, in UTC, with stable names.

By stable names a phone updates its events after a new plan instead of adding them twice.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from datetime import date, datetime, timedelta
from itertools import groupby
from zoneinfo import ZoneInfo

from fieldlum.core.records import Site, Slot, utc_text
from fieldlum.sky import sun

ALARM_BEFORE = timedelta(minutes=20)  # time to set up the camera; chosen, not measured


def by_day(slots: Sequence[Slot], site: Site) -> list[tuple[date, list[Slot]]]:
    """Return (date, slots) for each local standard date with slots, both in time order."""
    ordered = sorted(slots, key=lambda slot: slot.t_utc)
    groups = groupby(ordered, key=lambda slot: sun.standard_date(slot.t_utc, site.timezone))
    return [(day, list(group)) for day, group in groups]


def ics(
    slots: Sequence[Slot],
    site: Site,
    seconds_per_slot: float,
    made_utc: datetime,
    sequence: int = 0,
) -> bytes:
    """Return an iCalendar file (RFC 5545) with one event for each local standard day with slots.

    An event ends `seconds_per_slot` (at least a minute) after its last slot begins; its alarm is 20
    minutes before the first. made_utc: time of writing; sequence: how often the plan was changed. A
    calendar replaces an event of the same day, because it has the same UID.
    """
    from icalendar import Calendar

    calendar = Calendar()
    calendar.add("prodid", "-//fieldlum//capture plan//EN")
    calendar.add("version", "2.0")
    calendar.add("x-wr-calname", f"fieldlum {site.name}")
    place = hashlib.sha256(
        f"{site.name}|{site.latitude_deg:.4f}|{site.longitude_deg:.4f}".encode()
    ).hexdigest()[:12]
    for day, group in by_day(slots, site):
        calendar.add_component(
            _event(day, group, site, seconds_per_slot, made_utc, sequence, place)
        )
    return calendar.to_ical()


def _event(
    day: date,
    slots: list[Slot],
    site: Site,
    seconds: float,
    made_utc: datetime,
    sequence: int,
    place: str,
):
    from icalendar import Alarm, Event

    zone = ZoneInfo(site.timezone)
    event = Event()
    event.add("uid", f"{day:%Y%m%d}-{place}@fieldlum")
    event.add("dtstamp", made_utc)
    event.add("sequence", sequence)
    event.add("dtstart", slots[0].t_utc)
    event.add("dtend", slots[-1].t_utc + timedelta(seconds=max(round(seconds), 60)))
    event.add("summary", f"Capture {site.name}: {len(slots)} brackets")
    lines = [
        f"{slot.t_utc.astimezone(zone):%H:%M %Z} ({utc_text(slot.t_utc)}) sun "
        f"{slot.sun_altitude_deg:.0f} deg high, "
        f"azimuth {slot.sun_azimuth_deg:.0f}" + (f"; {' '.join(slot.tags)}" if slot.tags else "")
        for slot in slots
    ]
    event.add("description", "\n".join(lines))
    event.add("location", f"{site.name} ({site.latitude_deg:g}, {site.longitude_deg:g})")
    alarm = Alarm()
    alarm.add("action", "DISPLAY")
    alarm.add("description", f"First bracket at {slots[0].t_utc.astimezone(zone):%H:%M}")
    alarm.add("trigger", -ALARM_BEFORE)
    event.add_component(alarm)
    return event
