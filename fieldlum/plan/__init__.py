"""Capture plans: hours, exposures, time, storage, and the share of the year's light they cover."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import date, datetime
from pathlib import Path
from typing import Any, NamedTuple
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import NDArray

from fieldlum import sun
from fieldlum.errors import NotEnoughDataError
from fieldlum.plan import choose
from fieldlum.plan.coverage import Coverage, coverage
from fieldlum.plan.days import (
    DaylightHours,
    dark_days,
    daylight_hours,
    hours_of,
    season_tag,
    set_days,
)
from fieldlum.plan.days import today_at as today_at
from fieldlum.plan.window import sun_enters, sun_in_view
from fieldlum.profiles import Bracket, bracket_exposures, coverage_text, load_camera_profile
from fieldlum.records import Exposure, Progress, Site, SiteFile, Slot, quiet
from fieldlum.session import Session, create_session, replacing
from fieldlum.weather import Weather

# Hours of the sets `even` and `best` (Liu, Colburn and Inanici 2020; docs/planning.md).
EVEN_COUNT = 200
BEST_COUNT = 50


@dataclass(frozen=True, slots=True)
class Request:
    """The options of a plan; `today` is the local date from which "next" is counted."""

    set: str
    today: date
    start: date | None = None
    year: int | None = None
    days: int | None = None
    count: int | None = None
    seed: int = 1


@dataclass(frozen=True, slots=True)
class Months:
    """Expected squared error of a capture month, relative to the best calendar month.

    The error is the kernel's variance that the month's captures leave.
    """

    best: str  # its name
    times_best: float  # of the month planned
    by_month: tuple[float, ...]  # January first, each against the best


@dataclass(frozen=True, slots=True)
class Plan:
    """The slots of a set, their cost and coverage, and the warnings."""

    slots: tuple[Slot, ...]
    days: tuple[date, ...]  # all days of the set, including days without daylight
    seconds_per_slot: float
    megabytes_per_slot: float
    coverage: Coverage
    # Share of the model's prior variance over the year that the captures leave; None without
    # weather.
    variance_left: float | None
    months: Months | None  # for a month with weather
    warnings: tuple[str, ...]

    @property
    def hours(self) -> DaylightHours:
        """The moments and suns of the slots."""
        return hours_of(self.slots)

    def about(self, request: Request) -> dict[str, Any]:
        """Return the table [plan] of session.toml."""
        options = {
            "set": request.set,
            "start": request.start,
            "year": request.year,
            "count": request.count,
        }
        return {
            **{key: value for key, value in options.items() if value is not None},
            "revision": 0,
            "slots": len(self.slots),
            "first": self.days[0],
            "last": self.days[-1],
            "seconds_per_slot": self.seconds_per_slot,
            "megabytes_per_slot": self.megabytes_per_slot,
            "sun_band_percent": round(self.coverage.sun_band_percent, 1),
        }


class PlannedSession(NamedTuple):
    """The session and the plan that `run` wrote."""

    session: Session
    plan: Plan


def make_plan(
    setup: SiteFile, request: Request, weather: Weather | None = None, progress: Progress = quiet
) -> Plan:
    """Return the slots of a set, without writing anything.

    Raises NotEnoughDataError if no hour of the set has the sun above the horizon, or if `best` has
    no weather.
    """
    site = setup.site
    days = set_days(request.set, site, request.today, request.start, request.year, request.days)
    hours = daylight_hours(days, site)
    if not len(hours):
        raise NotEnoughDataError(
            f"polar night: the sun does not rise at {site.name} ({site.latitude_deg:g} deg) from "
            f"{days[0]} to {days[-1]}; the plan would be empty; choose another --start or --set"
        )
    task = choose.learning(site, setup.room, weather) if weather is not None else None
    chosen = _chosen(request, hours, weather, task, progress)
    profile = load_camera_profile(setup.camera.profile)
    bracket = profile.bracket
    blind = coverage_text(profile, setup.camera)
    left = choose.variance_left(task, choose.features_at(chosen, task)[1]) if task else None
    return Plan(
        make_slots(chosen, setup, bracket_exposures(bracket)),
        tuple(days),
        *cost_of(bracket, setup),
        coverage(chosen, site, weather),
        left,
        _months(task, len(days), days[0].year, left)
        if task and left and request.set == "month"
        else None,
        (
            *([blind] if blind else []),
            *_warnings(days, chosen, site, request),
            *(weather.repairs if weather else ()),
        ),
    )


def _chosen(
    request: Request,
    hours: DaylightHours,
    weather: Weather | None,
    task: choose.Learning | None,
    progress: Progress,
) -> DaylightHours:
    if request.set == "even":
        return hours[
            choose.even(
                hours, weather, request.count or EVEN_COUNT, np.random.default_rng(request.seed)
            )
        ]
    if request.set == "best":
        if task is None:
            raise NotEnoughDataError(
                "the best hours depend on the climate; state a weather year with --weather FILE"
            )
        return hours[choose.best(hours, task, request.count or BEST_COUNT, progress)]
    return hours


def _months(task: choose.Learning, days: int, year: int, left: float) -> Months:
    windows = [daylight_hours(window, task.site) for window in choose.month_windows(year, days)]
    costs = [choose.variance_left(task, choose.features_at(hours, task)[1]) for hours in windows]
    least = min(*costs, left)
    best = f"{date(year, int(np.argmin(costs)) + 1, 1):%B}"
    return Months(best, left / least, tuple(cost / least for cost in costs))


# ----------------------------------------------------------------------------------------------
# slots


def make_slots(
    hours: DaylightHours, setup: SiteFile, exposures: Sequence[Exposure]
) -> tuple[Slot, ...]:
    """Return the slots of some hours, in time order, with tags.

    Tags: the season, low-sun, sun-enters (through a window), sun-in-view (of the camera).
    """
    zone = setup.site.timezone
    tags = {
        day: season_tag(day, setup.site)
        for day in {sun.standard_date(t, zone) for t in hours.t_utc}
    }
    enters, in_view = _at_the_window(hours, setup)
    slots = []
    for i, (t, altitude, azimuth) in enumerate(
        zip(hours.t_utc, hours.altitude_deg, hours.azimuth_deg, strict=True)
    ):
        possible = (
            tags[sun.standard_date(t, zone)],
            "low-sun" if altitude < sun.LOW_SUN_DEG else "",
            "sun-enters" if enters[i] else "",
            "sun-in-view" if in_view[i] else "",
        )
        slots.append(
            Slot(
                t,
                float(altitude),
                float(azimuth),
                tuple(exposures),
                tuple(tag for tag in possible if tag),
            )
        )
    return tuple(sorted(slots, key=lambda slot: slot.t_utc))


def _at_the_window(
    hours: DaylightHours, setup: SiteFile
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return whether the sun enters, and is in view, [n] each; False without a box room."""
    if setup.room is None or setup.room.kind != "box":
        return np.zeros(len(hours), bool), np.zeros(len(hours), bool)
    at = (setup.room, hours.altitude_deg, hours.azimuth_deg)
    return sun_enters(*at), sun_in_view(*at)


def cost_of(bracket: Bracket, setup: SiteFile) -> tuple[float, float]:
    """Return seconds and megabytes of one slot: every exposure at every heading.

    The time includes the time for which the shutter is open.
    """
    exposures, turns = bracket_exposures(bracket), max(len(setup.camera.headings), 1)
    seconds = sum(bracket.seconds_per_frame + e.shutter_s for e in exposures)
    return round(turns * seconds, 1), round(turns * len(exposures) * bracket.megabytes_per_frame, 1)


# ----------------------------------------------------------------------------------------------
# texts


def _warnings(
    days: Sequence[date], hours: DaylightHours, site: Site, request: Request
) -> list[str]:
    texts: list[str] = []
    all_year = request.set in ("even", "best")
    dark = [] if all_year else dark_days(days, hours, site)
    if dark:
        texts.append(f"polar night: no slot on {len(dark)} of {len(days)} days ({_from_to(dark)})")
    if midnight := [] if all_year else [d for d, n in _per_day(hours, site).items() if n == 24]:
        texts.append(
            f"midnight sun: a slot every hour of {len(midnight)} of {len(days)} days "
            f"({_from_to(midnight)})"
        )
    if request.count and len(hours) < request.count:
        texts.append(f"--count {request.count}: the set has only {len(hours)} daylight hours")
    texts += clock_texts(days, site)
    if site.timezone == "UTC" and abs(site.longitude_deg) > 30:
        texts.append(
            f"timezone is UTC at longitude {site.longitude_deg:g}: days and hours are those of "
            f"UTC, not of the site"
        )
    if days[0] < request.today:
        texts.append(
            f"the plan starts on {days[0]}, which is past: its slots before now count as missed"
        )
    return texts


def _from_to(days: Sequence[date]) -> str:
    """Return runs of consecutive days by their first and last day."""
    runs: list[list[date]] = []
    for day in sorted(days):
        if runs and (day - runs[-1][-1]).days == 1:
            runs[-1].append(day)
        else:
            runs.append([day])
    return ", ".join(f"{run[0]}" if len(run) == 1 else f"{run[0]} to {run[-1]}" for run in runs)


def _per_day(hours: DaylightHours, site: Site) -> dict[date, int]:
    count: dict[date, int] = {}
    for t in hours.t_utc:
        day = sun.standard_date(t, site.timezone)
        count[day] = count.get(day, 0) + 1
    return count


def clock_texts(days: Sequence[date], site: Site) -> list[str]:
    """Return one sentence for every daylight-saving change on a planned day."""
    texts, zone = [], ZoneInfo(site.timezone)
    for moment, change in sun.clock_changes(days[0], days[-1], site.timezone):
        if sun.standard_date(moment, site.timezone) in set(days):
            hours = change.total_seconds() / 3600
            texts.append(
                f"clocks go {'forward' if hours > 0 else 'back'} by {abs(hours):g} h on "
                f"{moment.astimezone(zone):%Y-%m-%d}; slots stay at hh:30 of standard time"
            )
    return texts


def summary(session: Session, plan: Plan) -> dict[str, Any]:
    """Return the plan for --json."""
    slots = plan.slots
    return {
        "session": str(session.root),
        "slots": len(slots),
        "days": len(_per_day(plan.hours, session.site_file().site)),
        "first": slots[0].id,
        "last": slots[-1].id,
        "solar_noon": _solar_noon(slots[0].t_utc, session.site_file().site),
        "frames": sum(len(slot.exposures) for slot in slots),
        "seconds_per_slot": plan.seconds_per_slot,
        "megabytes": round(plan.megabytes_per_slot * len(slots), 1),
        "tags": {
            tag: sum(tag in s.tags for s in slots)
            for tag in sorted({t for s in slots for t in s.tags})
        },
        "coverage": asdict(plan.coverage),
        "variance_left_percent": None if plan.variance_left is None else 100 * plan.variance_left,
        "month": None if plan.months is None else asdict(plan.months),
        "warnings": list(plan.warnings),
    }


def _solar_noon(t_utc: datetime, site: Site) -> str:
    """Return the local time of solar noon on a slot's day: it shows a longitude of wrong sign."""
    day = sun.standard_date(t_utc, site.timezone)
    transit = sun.rise_transit_set([day], site)[0].transit
    return "" if transit is None else f"{transit.astimezone(ZoneInfo(site.timezone)):%H:%M %Z}"


def sentences(summary: dict[str, Any]) -> list[str]:
    """Return the summary as sentences."""
    slots, covered, tags = summary["slots"], summary["coverage"], summary["tags"]
    texts = [
        f"{slots} slots on {summary['days']} days, {summary['first']} to {summary['last']}, in "
        f"{summary['session']}",
        f"{summary['frames']} frames, {summary['seconds_per_slot']:g} s and "
        f"{summary['megabytes'] / slots:.0f} MB per slot, "
        f"{summary['megabytes'] / 1000:.1f} GB in total",
        f"covers {covered['sun_band_percent']:.0f} % of the year's sun band"
        + (
            ""
            if covered["irradiance_percent"] is None
            else f", {covered['irradiance_percent']:.0f} % of the weather year's skies, "
            f"{covered['both_percent']:.0f} % in both"
        ),
    ]
    if summary["solar_noon"]:
        texts.append(f"solar noon on the first day is at {summary['solar_noon']}")
    if "sun-enters" in tags:
        texts.append(
            f"the sun can enter a window in {tags['sun-enters']} slots and is in view in "
            f"{tags.get('sun-in-view', 0)}"
        )
    if summary["variance_left_percent"] is not None:
        left = f"{summary['variance_left_percent']:.2g} %"
        texts.append(
            f"leaves {left} of the model's uncertainty about the year, if the skies are as in the "
            f"weather file"
        )
    if month := summary["month"]:
        texts.append(
            f"expected squared error {month['times_best']:.2f} times that of the best month, "
            f"{month['best']}"
        )
    return texts


# ----------------------------------------------------------------------------------------------
# writing


def run(
    setup: SiteFile,
    request: Request,
    out: Path,
    weather: Weather | None = None,
    progress: Progress = quiet,
) -> PlannedSession:
    """Plan and create the session folder. Raises InputError if `out` is a session already."""
    plan = make_plan(setup, request, weather, progress)
    return PlannedSession(create_session(out, setup, plan.slots, plan.about(request)), plan)


def write_calendar(session: Session, made_utc: datetime) -> Path:
    """Write plan.ics next to plan.csv, from the slots in plan.csv, and return its path."""
    from fieldlum.plan.calendar import ics

    about = session.table()["plan"]
    data = ics(
        session.slots(),
        session.site_file().site,
        about["seconds_per_slot"],
        made_utc,
        about["revision"],
    )
    with replacing(session.root / "plan.ics") as file:
        file.write(data)
    return session.root / "plan.ics"


def write_sheets(
    session: Session, weather: Weather | None = None, notes: Sequence[str] = ()
) -> Path:
    """Write plan.html next to plan.csv: coverage plots, then a sheet for each day."""
    from fieldlum.plan.sheet import Cost, html

    about = session.table()["plan"]
    cost = Cost(about["seconds_per_slot"], about["megabytes_per_slot"])
    with replacing(session.root / "plan.html") as file:
        file.write(html(session.slots(), session.site_file(), cost, weather, notes).encode())
    return session.root / "plan.html"
