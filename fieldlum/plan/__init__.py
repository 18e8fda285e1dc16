"""Plan captures: which hours, which exposures, how long, how much storage, and how much of the year they cover."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import NDArray

from fieldlum import sun
from fieldlum.errors import NotEnoughDataError
from fieldlum.plan import choose
from fieldlum.plan.days import Hours, dark_days, daylight_hours, season_tag, set_days
from fieldlum.plan.days import today_at as today_at
from fieldlum.plan.window import sun_enters, sun_in_view
from fieldlum.profiles import Bracket, bracket_exposures, load_camera_profile
from fieldlum.records import Exposure, Progress, Site, SiteFile, Slot, quiet
from fieldlum.session import Session, create_session

SETS = ("month", "9-day", "12-day", "4-day", "even")
EVEN_COUNT = 200


@dataclass(frozen=True, slots=True)
class Request:
    """What the person asks for; `today` is the local date that "next" is counted from."""

    set: str
    today: date
    start: date | None = None
    year: int | None = None
    days: int | None = None
    count: int | None = None
    seed: int = 1


@dataclass(frozen=True, slots=True)
class Plan:
    slots: tuple[Slot, ...]
    days: tuple[date, ...]  # asked for, the dark ones too
    seconds_per_slot: float
    megabytes_per_slot: float
    warnings: tuple[str, ...]

    def about(self, request: Request) -> dict[str, Any]:
        """What session.toml keeps under [plan]."""
        asked = {"set": request.set, "start": request.start, "year": request.year, "count": request.count}
        return {
            **{key: value for key, value in asked.items() if value is not None},
            "slots": len(self.slots),
            "first": self.days[0],
            "last": self.days[-1],
            "seconds_per_slot": self.seconds_per_slot,
            "megabytes_per_slot": self.megabytes_per_slot,
        }


def make_plan(setup: SiteFile, request: Request, weather: object | None = None, progress: Progress = quiet) -> Plan:
    """The slots of a set. Pure: nothing is written.

    Raises NotEnoughDataError when no hour of the window has the sun above the horizon.
    """
    site = setup.site
    days = set_days(request.set, site, request.today, request.start, request.year, request.days)
    hours = daylight_hours(days, site)
    if not len(hours):
        raise NotEnoughDataError(
            f"polar night: the sun does not rise at {site.name} ({site.latitude_deg:g} deg) "
            f"from {days[0]} to {days[-1]}, so there is nothing to plan; choose another --start or --set"
        )
    chosen = _chosen(setup, request, hours, weather, progress)
    bracket = load_camera_profile(setup.camera.profile).bracket
    slots = make_slots(chosen, setup, bracket_exposures(bracket))
    return Plan(slots, tuple(days), *cost_of(bracket, setup), tuple(_warnings(days, chosen, site, request)))


def _chosen(setup: SiteFile, request: Request, hours: Hours, weather: object | None, progress: Progress) -> Hours:
    if request.set == "even":
        return hours[choose.even(hours, request.count or EVEN_COUNT, np.random.default_rng(request.seed))]
    return hours


def make_slots(hours: Hours, setup: SiteFile, exposures: Sequence[Exposure]) -> tuple[Slot, ...]:
    """Hours to slots, in time order, tagged: season, low-sun, sun-enters (a window), sun-in-view (of the camera)."""
    zone = setup.site.timezone
    tags = {day: season_tag(day, setup.site) for day in {sun.standard_date(t, zone) for t in hours.t_utc}}
    enters, in_view = _at_the_window(hours, setup)
    slots = []
    for i, (t, altitude, azimuth) in enumerate(zip(hours.t_utc, hours.altitude_deg, hours.azimuth_deg, strict=True)):
        said = (
            tags[sun.standard_date(t, zone)],
            "low-sun" if altitude < sun.LOW_SUN_DEG else "",
            "sun-enters" if enters[i] else "",
            "sun-in-view" if in_view[i] else "",
        )
        slots.append(Slot(t, float(altitude), float(azimuth), tuple(exposures), tuple(tag for tag in said if tag)))
    return tuple(sorted(slots, key=lambda slot: slot.t_utc))


def _at_the_window(hours: Hours, setup: SiteFile) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Without a box room nothing is known, and nothing is tagged."""
    if setup.room is None or setup.room.kind != "box":
        return np.zeros(len(hours), bool), np.zeros(len(hours), bool)
    at = (setup.room, hours.altitude_deg, hours.azimuth_deg)
    return sun_enters(*at), sun_in_view(*at)


def cost_of(bracket: Bracket, setup: SiteFile) -> tuple[float, float]:
    """Seconds and megabytes of one slot: every exposure at every heading, and the time the shutter is open."""
    exposures, turns = bracket_exposures(bracket), max(len(setup.camera.headings), 1)
    seconds = sum(bracket.seconds_per_frame + e.shutter_s for e in exposures)
    return round(turns * seconds, 1), round(turns * len(exposures) * bracket.megabytes_per_frame, 1)


def _warnings(days: Sequence[date], hours: Hours, site: Site, request: Request) -> list[str]:
    said = []
    dark = dark_days(days, hours, site) if request.set not in ("even", "best") else []
    if dark:
        said.append(f"polar night: no slot on {len(dark)} of {len(days)} days, {dark[0]} to {dark[-1]}")
    if midnight := [d for d, n in _per_day(hours, site).items() if n == 24]:
        said.append(f"midnight sun: the sun does not set on {len(midnight)} days, {midnight[0]} to {midnight[-1]}")
    said += clock_texts(days, site)
    if days[0] < request.today:
        said.append(f"the plan starts on {days[0]}, which is past: its slots before now can only be missed")
    return said


def _per_day(hours: Hours, site: Site) -> dict[date, int]:
    count: dict[date, int] = {}
    for t in hours.t_utc:
        day = sun.standard_date(t, site.timezone)
        count[day] = count.get(day, 0) + 1
    return count


def clock_texts(days: Sequence[date], site: Site) -> list[str]:
    """One sentence for every daylight-saving change on a planned day."""
    said, zone = [], ZoneInfo(site.timezone)
    for moment, change in sun.clock_changes(days[0], days[-1], site.timezone):
        if sun.standard_date(moment, site.timezone) in set(days):
            hours = change.total_seconds() / 3600
            said.append(
                f"clocks go {'forward' if hours > 0 else 'back'} by {abs(hours):g} h on "
                f"{moment.astimezone(zone):%Y-%m-%d}; slots stay at hh:30 of standard time"
            )
    return said


def run(
    setup: SiteFile, request: Request, out: Path, weather: object | None = None, progress: Progress = quiet
) -> tuple[Session, Plan]:
    """Plan and create the session folder. Raises InputError when `out` is a session already."""
    plan = make_plan(setup, request, weather, progress)
    return create_session(out, setup, plan.slots, plan.about(request)), plan


def summary(session: Session, plan: Plan) -> dict[str, Any]:
    """For --json: everything a script wants to know about the plan."""
    slots = plan.slots
    frames = sum(len(slot.exposures) for slot in slots)
    return {
        "session": str(session.root),
        "slots": len(slots),
        "days": len({slot.t_utc.date() for slot in slots}),
        "first": slots[0].id,
        "last": slots[-1].id,
        "frames": frames,
        "seconds_per_slot": plan.seconds_per_slot,
        "megabytes": round(plan.megabytes_per_slot * len(slots), 1),
        "warnings": list(plan.warnings),
    }


def sentence(summary: dict[str, Any]) -> str:
    """The same for a person."""
    return (
        f"{summary['slots']} slots, {summary['first']} to {summary['last']}: {summary['frames']} frames, "
        f"{summary['seconds_per_slot']:g} s and {summary['megabytes'] / summary['slots']:.0f} MB a slot, "
        f"{summary['megabytes'] / 1000:.1f} GB in all, in {summary['session']}"
    )
