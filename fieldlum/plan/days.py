"""Compute days and hours of the capture sets.

Slots are at hh:30 of local standard time while the sun is up.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.records import Site, Slot
from fieldlum.sky import sun

# Days of docs/planning.md.
EVENT_SETS = {"9-day": ((0, 1, 3), 1), "12-day": ((0, 1, 2, 3), 1), "4-day": ((0, 1, 2, 3), 0)}
"Set: (seasons, days before and after the event)."
MONTH_DAYS = 31  # the longest month
SEASON_TAGS = ("march-equinox", "june-solstice", "september-equinox", "december-solstice")


@dataclass(frozen=True, slots=True)
class DaylightHours:
    """Moments with the sun above the horizon, and its altitude and azimuth [n] in deg.

    Angles are true, without refraction; the azimuth is clockwise from true north.
    """

    t_utc: tuple[datetime, ...]
    altitude_deg: Floats
    azimuth_deg: Floats

    def __len__(self) -> int:
        return len(self.t_utc)

    def __getitem__(self, chosen: Iterable[int]) -> DaylightHours:
        index = [int(i) for i in chosen]
        return DaylightHours(
            tuple(self.t_utc[i] for i in index), self.altitude_deg[index], self.azimuth_deg[index]
        )


def hours_of(slots: Sequence[Slot]) -> DaylightHours:
    """Return the times of slots, in their order, with the sun's angles that the plan states."""
    altitude = np.array([s.sun_altitude_deg for s in slots], float)
    azimuth = np.array([s.sun_azimuth_deg for s in slots], float)
    return DaylightHours(tuple(slot.t_utc for slot in slots), altitude, azimuth)


def daylight_hours(days: Iterable[date], site: Site) -> DaylightHours:
    """Return the times hh:30 of local standard time on `days` with the sun's centre up.

    They are in time order; a repeated day counts once.
    """
    midnights = [sun.standard_midnight(day, site.timezone) for day in sorted(set(days))]
    times = [
        midnight + timedelta(minutes=30 + 60 * hour) for midnight in midnights for hour in range(24)
    ]
    at = sun.position(times, site)
    return DaylightHours(tuple(times), at.altitude_deg, at.azimuth_deg)[
        np.flatnonzero(at.altitude_deg > 0)
    ]


def span(first: date, count: int) -> list[date]:
    """Return `count` consecutive days, beginning with `first`."""
    return [first + timedelta(days=i) for i in range(count)]


def season_date(year: int, which: int, site: Site) -> date:
    """Return the local standard date of an equinox or solstice.

    which: 0 March equinox, 1 June solstice, 2 September equinox, 3 December solstice.
    """
    return sun.standard_date(sun.season(year, which), site.timezone)


def _event_dates(
    seasons: Sequence[int], margin: int, earliest: date, year: int | None, site: Site
) -> list[date]:
    """Return the date of each equinox or solstice: in `year`, else the next possible date.

    Without `year`, `margin` days before the date must not be earlier than `earliest`.
    """
    dates = []
    for which in seasons:
        if year is not None:
            dates.append(season_date(year, which, site))
            continue
        candidates = (
            season_date(y, which, site)
            for y in (earliest.year, earliest.year + 1, earliest.year + 2)
        )
        dates.append(next(d for d in candidates if d - timedelta(days=margin) >= earliest))
    return sorted(dates)


def set_days(
    name: str, site: Site, today: date, start: date | None, year: int | None, days: int | None
) -> list[date]:
    """Return the local standard dates of a capture set, in time order.

    4-day: equinoxes and solstices; 12-day: also the days before and after; 9-day: so, without
    September. Each is of `year`, or else the next whose days are not before `start` (or `today`).

    month: `days` (default 31) from `start`; or centred on the March equinox of `year`, or on the
    next March or September equinox for which no day is before `today`. Other sets: `days` (default
    365) from `start`, else from 1 January of `year`, else from `today`.
    """
    if name in EVENT_SETS:
        seasons, margin = EVENT_SETS[name]
        events = _event_dates(seasons, margin, start or today, year, site)
        return [
            event + timedelta(days=offset)
            for event in events
            for offset in range(-margin, margin + 1)
        ]
    if name == "month":
        count = days or MONTH_DAYS
        if start is not None:
            return span(start, count)
        half = count // 2
        equinoxes = (0,) if year is not None else (0, 2)
        return span(
            _event_dates(equinoxes, half, today, year, site)[0] - timedelta(days=half), count
        )
    first = start or (date(year, 1, 1) if year is not None else today)
    return span(first, days or 365)


def season_tag(day: date, site: Site) -> str:
    """Return the equinox or solstice that is at most a day away from `day`, or "" if none is.

    The tags are march-equinox, june-solstice, september-equinox and december-solstice.
    """
    for which, tag in enumerate(SEASON_TAGS):
        if abs((day - season_date(day.year, which, site)).days) <= 1:
            return tag
    return ""


def today_at(site: Site, now_utc: datetime) -> date:
    """Return the local standard date of `site` at the moment `now_utc`."""
    return sun.standard_date(now_utc.astimezone(UTC), site.timezone)
